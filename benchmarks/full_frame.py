"""Cost of a full office frame beside Mitsuba, NumPy and OpenCV: ratios of CPU time within one run.

python benchmarks/full_frame.py [REPEATS]
"""

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from target import Targets, alternating_s, ratio

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.core.backend import dr, mi
from vlcrender.dataset.format.exr import exr_attributes, write_exr
from vlcrender.dataset.format.preview import MAX_SIDE_PX, write_preview
from vlcrender.rendering.path_traced import scene_dict
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import load_scene
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

POSE = Pose((3.15, 3.1, 0.6), tilt_x_deg=6.0, tilt_y_deg=-8.0, yaw_deg=20.0)
EXPOSURE_S = 160e-6
FULL = Sensor(
    noise="full",
    prnu=0.01,
    dark_current_e_s=10.0,
    dsnu_e=1.0,
    read_noise_e=2.0,
    adc_noise_dn=0.3,
    row_offset_e=0.2,
    column_offset_e=0.2,
    black_level_dn=64,
)


def render(loaded: "mi.Scene", integrator: "mi.Integrator", samples_per_pixel: int) -> None:
    """Render and wait: a call returns before its kernels have finished."""
    dr.eval(mi.render(loaded, integrator=integrator, spp=samples_per_pixel))
    dr.sync_thread()


def preliminary(loaded: "mi.Scene", camera: Camera) -> None:
    """Mitsuba's intersections of one ray a pixel, without surface data: triangle and distance."""
    index = dr.arange(mi.UInt32, camera.width_px * camera.height_px)
    row = index // camera.width_px
    film = mi.Point2f(
        (mi.Float(index - row * camera.width_px) + 0.5) / camera.width_px, (mi.Float(row) + 0.5) / camera.height_px
    )
    ray, _ = loaded.sensors()[0].sample_ray(0.0, 0.5, film, mi.Point2f(0.5))
    hit = loaded.ray_intersect_preliminary(ray, coherent=True)
    dr.eval(hit.t, hit.prim_index)
    dr.sync_thread()


def main() -> None:
    """Measure and print."""
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    scene = load_scene(Path(__file__).parent.parent / "scenes/office.toml")
    camera, sensor, renderer = Camera(), Sensor(), Renderer(scene)
    posed, whole = PosedCamera(camera, POSE), Roi.of_sensor(camera)
    mean = renderer.expected_image(posed)
    expected = mean.expected_electrons(EXPOSURE_S)
    dn = expose(sensor, expected, "bench", exposure_s=EXPOSURE_S)
    loaded = mi.load_dict(scene_dict(scene, posed), optimize=False)
    depth, direct, path = (
        mi.load_dict(tree) for tree in ({"type": "depth"}, {"type": "direct"}, {"type": "path", "max_depth": 8})
    )
    generator = np.random.Generator(np.random.SFC64(1))
    targets = Targets()

    def compare(ours: Callable[[], Any], peer: Callable[[], Any], repeats: int = repeats) -> float:
        return ratio(*alternating_s([ours, peer], repeats, time.process_time))

    with tempfile.TemporaryDirectory() as folder:
        exr, png = Path(folder) / "frame.exr", Path(folder) / "frame.png"
        attributes = exr_attributes(camera, "main", EXPOSURE_S, 0)

        def frame() -> None:
            electrons = renderer.expected_image(posed).expected_electrons(EXPOSURE_S)
            image = expose(sensor, electrons, "bench", exposure_s=EXPOSURE_S)
            write_exr(exr, [(whole, image)], whole, attributes)
            write_preview(png, [(whole, image)], whole, sensor.largest_dn)

        def bare() -> None:
            render(loaded, depth, 1)
            write_exr(exr, [(whole, dn)], whole, attributes)

        print(f"office, 4000 x 3000, {len(mean.patches)} LEDs in the image; CPU time, medians of {repeats} ratios")
        targets.at_most("full frame / (Mitsuba depth at 1 sample a pixel + PIZ)", compare(frame, bare), 1.0)
        background = compare(lambda: renderer.background_cd_m2(posed), lambda: preliminary(loaded, camera))
        targets.at_most("background / Mitsuba's preliminary intersections", background, 2.0)
        noise = compare(
            lambda: expose(sensor, expected, "bench", exposure_s=EXPOSURE_S), lambda: generator.poisson(expected)
        )
        targets.at_most("noise and digital numbers / NumPy's SFC64 Poisson", noise, 0.45)
        chain = compare(
            lambda: expose(FULL, expected, "bench", exposure_s=EXPOSURE_S),
            lambda: expose(sensor, expected, "bench", exposure_s=EXPOSURE_S),
        )
        targets.beside("full sensor chain / shot noise alone", chain)
        try:
            import cv2
        except ImportError:
            print("OpenCV is not installed: preview not compared")
        else:

            def picture() -> None:
                small = cv2.resize(dn.astype(np.uint16), (MAX_SIDE_PX, 600), interpolation=cv2.INTER_AREA)
                grey = 255 * (small / np.float32(sensor.largest_dn)) ** np.float32(1 / 2.2)
                cv2.imwrite(str(png), grey.astype(np.uint8))

            ours = compare(lambda: write_preview(png, [(whole, dn)], whole, sensor.largest_dn), picture)
            targets.at_most("preview / OpenCV's area means and PNG", ours, 1.3)
        for name, integrator, samples in (("direct", direct, 16), ("path, 8 bounces,", path, 16)):
            other = compare(lambda i=integrator, n=samples: render(loaded, i, n), frame, 1)
            print(f"Mitsuba {name} at {samples} samples a pixel / full frame {other:12.1f}")
    targets.finish()


if __name__ == "__main__":
    main()
