"""Speed of a full office frame as ratios within one run: stages, bare work, and Mitsuba's path integrator.

    python benchmarks/full_frame.py [REPEATS]

Prints medians over the repeats. Compare ratios only: machines differ and are shared.
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.core.backend import dr, mi
from vlcrender.dataset.exr import exr_attributes, write_exr
from vlcrender.dataset.preview import write_preview
from vlcrender.rendering.path_traced import scene_dict
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import load_scene
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

POSE = Pose((3.15, 3.1, 0.6), tilt_x_deg=6.0, tilt_y_deg=-8.0, yaw_deg=20.0)
EXPOSURE_S = 160e-6


def median_s(work: Callable[[], object], repeats: int) -> float:
    """Median wall time of a call, after one call that is not measured."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def render(loaded: "mi.Scene", integrator: "mi.Integrator", samples_per_pixel: int) -> None:
    """Render and wait: a call returns before its kernels have finished."""
    dr.eval(mi.render(loaded, integrator=integrator, spp=samples_per_pixel))
    dr.sync_thread()


def main() -> None:
    """Measure and print."""
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    scene = load_scene(Path(__file__).parent.parent / "scenes/office.toml")
    camera, sensor, renderer = Camera(), Sensor(), Renderer(scene)
    posed = PosedCamera(camera, POSE)
    mean = renderer.expected_image(posed)
    expected = mean.expected_electrons(EXPOSURE_S)
    whole = Roi.of_sensor(camera)
    dn = expose(sensor, expected, "bench", exposure_s=EXPOSURE_S)
    loaded = mi.load_dict(scene_dict(scene, posed), optimize=False)
    depth, path = mi.load_dict({"type": "depth"}), mi.load_dict({"type": "path", "max_depth": 8})
    with tempfile.TemporaryDirectory() as folder:
        exr, png = Path(folder) / "frame.exr", Path(folder) / "frame.png"
        attributes = exr_attributes(camera, "main", EXPOSURE_S, 0)
        stages: dict[str, Callable[[], object]] = {
            "rays and LED patches": lambda: renderer.expected_image(posed),
            "expected electrons": lambda: mean.expected_electrons(EXPOSURE_S),
            "Poisson noise and digital numbers": lambda: expose(sensor, expected, "bench", exposure_s=EXPOSURE_S),
            "EXR (PIZ) and its SHA-256": lambda: write_exr(exr, [(whole, dn)], whole, attributes),
            "preview": lambda: write_preview(png, [(whole, dn)], whole, sensor.largest_dn),
        }
        seconds = {name: median_s(work, repeats) for name, work in stages.items()}
        frame = sum(seconds.values())
        bare = median_s(lambda: render(loaded, depth, 1), repeats) + seconds["EXR (PIZ) and its SHA-256"]
    path_16 = median_s(lambda: render(loaded, path, 16), 1)
    print(f"office, 4000 x 3000, {len(mean.patches)} LEDs in the image, medians of {repeats}")
    for name, value in seconds.items():
        print(f"  {100 * value / frame:5.1f} %  {name}")
    print(f"full frame / (Mitsuba depth at 1 sample a pixel + one PIZ write)   {frame / bare:6.2f}")
    print(f"Mitsuba path at 16 samples a pixel, 8 bounces / full frame             {path_16 / frame:6.1f}")
    peak_gib = _peak_memory_gib()
    print(f"peak memory of this process, the path render included              {peak_gib:6.2f} GiB")
    assert np.isfinite(expected).all()


def _peak_memory_gib() -> float:
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


if __name__ == "__main__":
    main()
