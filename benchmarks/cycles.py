"""A full office frame beside Cycles: ratio of CPU times, and of the mean luminance of what is not an LED.

    python3.11 -m venv out/cycles && out/cycles/bin/python -m pip install bpy==5.0.1
    python benchmarks/cycles.py [SCALE] [SAMPLES]

Blender's `bpy` needs another NumPy than vlcrender, so it has an environment of its own; without it this is skipped. The
ambient light is left out, which is defined at the first surface. SCALE divides the number of pixels along each side;
SAMPLES are Cycles' samples a pixel.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import OpenEXR
from full_frame import EXPOSURE_S, POSE
from target import Targets

from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.dataset.format.exr import exr_attributes, write_exr
from vlcrender.dataset.format.preview import write_preview
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene, load_scene
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

ROOT = Path(__file__).parent.parent
PYTHON = ROOT / "out/cycles/bin/python"
BOUNCES = 16
STANDOFF_M = 1e-4
"""Distance of LEDs below their panel, so that rays meet them first."""
NEAR_LEDS_PX = 3
LIGHT_TOLERANCE = 0.01
"""Of the ratio of mean luminances: for the bake's interpolation and Cycles' noise. Bounces beyond the sixteenth carry
0.5^16 of the reflected light where half of it is absorbed at each."""


def described(scene: Scene, posed: PosedCamera) -> dict[str, object]:
    """The scene and camera for `cycles_scene.py`. A camera with its principal point in the middle."""
    camera, leds = posed.camera, scene.leds
    return {
        "surfaces": [
            {
                "corner_m": surface.corner_m.tolist(),
                "edge_u_m": surface.edge_u_m.tolist(),
                "edge_v_m": surface.edge_v_m.tolist(),
                "reflectance": surface.reflectance,
            }
            for surface in scene.surfaces
        ],
        "leds": [
            {
                "center_m": [x, y, z - STANDOFF_M],
                "radius_m": float(leds.half_widths_m[i]),
                "luminance_cd_m2": float(leds.luminances_cd_m2[i]),
            }
            for i, (x, y, z) in enumerate(leds.centers_m.tolist())
        ],
        "led_reflectance": scene.settings.led_reflectance,
        "camera": {
            "to_world": (posed.mitsuba_to_world() @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist(),
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "sensor_width_mm": camera.width_px * camera.pixel_pitch_um / 1000,
            "focal_mm": camera.image_distance_mm,
        },
    }


def _camera(scale: int) -> Camera:
    whole = Camera()
    return Camera(
        width_px=whole.width_px // scale,
        height_px=whole.height_px // scale,
        pixel_pitch_um=whole.pixel_pitch_um * scale,
    )


def main() -> None:
    """Measure and print."""
    if not PYTHON.is_file():
        print(f"Cycles is skipped: {PYTHON.relative_to(ROOT)} is not there; see benchmarks/cycles.py")
        return
    scale = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    samples = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    scene = load_scene(ROOT / "scenes/office.toml", ["ambient.illuminance_lux=0"])
    camera, sensor = _camera(scale), Sensor()
    renderer, posed, whole = Renderer(scene), PosedCamera(camera, POSE), Roi.of_sensor(camera)
    targets = Targets()
    with tempfile.TemporaryDirectory() as folder:
        tree, image = Path(folder) / "scene.json", Path(folder) / "cycles.exr"
        tree.write_text(json.dumps(described(scene, posed)), encoding="utf-8")

        def frame() -> float:
            start_s = time.process_time()
            electrons = renderer.expected_image(posed).expected_electrons(EXPOSURE_S)
            dn = expose(sensor, electrons, "bench", exposure_s=EXPOSURE_S)
            write_exr(Path(folder) / "frame.exr", [(whole, dn)], whole, exr_attributes(camera, "main", EXPOSURE_S, 0))
            write_preview(Path(folder) / "frame.png", [(whole, dn)], whole, sensor.largest_dn)
            return time.process_time() - start_s

        frame()
        before_s = frame()
        command = [PYTHON, "-I", Path(__file__).parent / "cycles_scene.py", tree, image, samples, BOUNCES]
        done = subprocess.run(list(map(str, command)), stdout=subprocess.PIPE, text=True, check=True)
        (line,) = (line for line in done.stdout.splitlines() if line.startswith("CPU time "))
        cycles_s = float(line.removeprefix("CPU time "))
        ours_s = (before_s + frame()) / 2
        with OpenEXR.File(str(image), separate_channels=True) as file:
            cycles_cd_m2 = file.channels()["R"].pixels.astype(np.float64)
    size = f"{camera.width_px} x {camera.height_px}"
    print(f"office, {size}; CPU time; Cycles: {samples} samples a pixel, {BOUNCES} bounces")
    targets.beside("Cycles / a frame of ours", cycles_s / ours_s)
    room = np.ones(cycles_cd_m2.shape, bool)
    for patch in renderer.expected_image(posed).patches:
        roi = patch.roi
        rows = slice(max(roi.row - NEAR_LEDS_PX, 0), roi.end_row + NEAR_LEDS_PX)
        room[rows, max(roi.column - NEAR_LEDS_PX, 0) : roi.end_column + NEAR_LEDS_PX] = False
    ours_cd_m2 = np.asarray(renderer.background_cd_m2(posed))
    u, v = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    cycles_cd_m2 *= relative_illumination(camera, u, v)
    light = float(cycles_cd_m2[room].mean() / ours_cd_m2[room].mean())
    targets.at_most("mean luminance beside LEDs, Cycles / ours, off 1 by", abs(light - 1), LIGHT_TOLERANCE)
    print(
        f"mean luminance beside LEDs: Cycles {cycles_cd_m2[room].mean():.4g}, ours {ours_cd_m2[room].mean():.4g} cd/m2"
    )
    targets.finish()


if __name__ == "__main__":
    main()
