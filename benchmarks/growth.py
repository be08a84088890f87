"""Growth of cost with the size of the world: LEDs of a scene, poses of a set, pixels of a frame. Then two large rooms.

    python benchmarks/growth.py [ROUNDS]

Worlds are k x k panels of 25 LEDs with the density of `office`: 7, 20 and 45 panels a side have 1 225, 10 000 and
50 625 LEDs. Ratios are medians of CPU time, measured in turn in one run. Then the warehouse is baked, and frames of an
airport of 50 000 LEDs are made, from the scene file to the estimated positions. Exits with 1 where a figure is larger
than wanted.
"""

import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from target import Targets, alternating_s, ratio

import estimator as est
import vlcrender as vr
from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import LedRegions
from vlcrender.dataset.recipe.pose_sampling import AimedPoses, pose_of_frame
from vlcrender.light.lightmap import bake
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene, load_scene
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

ROOT = Path(__file__).parent.parent
WORLD = """
format = "vlcrender-scene"
version = 1
name = "world"
led_spectrum = "LED-B3"
led_reflectance = 0.5
room = {{ size_m = [{x_m}, {y_m}, {z_m}], reflectance = {{ floor = 0.2, ceiling = 0.8, walls = 0.5 }} }}
ambient = {{ illuminance_lux = 100.0, spectrum = "LED-B3" }}
bake = {{ texel_m = {texel_m}, paths = {paths} }}
[[panels]]
columns = {columns}
rows = {rows}
first_center_m = [{first_x_m}, {first_y_m}, {panel_m}]
pitch_m = [{pitch_x_m}, {pitch_y_m}]
size_m = [0.6, 0.6, 0.05]
reflectance = 0.7
[panels.leds]
columns = 5
rows = 5
pitch_m = [0.13, 0.13]
radius_m = {radius_m}
luminance_cd_m2 = [4000.0, 16000.0]
first_id = 0
"""
AIRPORT_RECIPE = """
format = "vlcrender-recipe"
version = 1
name = "airport"
scene = "airport.toml"
seed = 1
exposure_s = 160e-6
camera = { width_px = 4000, height_px = 3000, focal_length_mm = 9.0, f_number = 2.2 }
sensor = { preset = "phone-1.2um" }
accelerometer = { error_deg = 0.1 }
poses = { kind = "aimed", count = 2, tilt_x_deg = [0.0, 20.0], tilt_y_deg = [0.0, 20.0], height_m = [0.1, 1.8] }
"""
SIDES = {"1 225": 7, "10 000": 20, "50 625": 45}
POSES = 50
FRAMES = 8
WAREHOUSE_S = 60.0
CORES = 2
"""Cores of the machine on which a bake's time is wanted."""


def world(columns: int, rows: int, pitch_m: tuple[float, float], height_m: float, **changes: float) -> str:
    """A scene of columns x rows panels at this distance, under the ceiling."""
    values = {"texel_m": 1.0, "paths": 8, "radius_m": 0.01, **changes}
    return WORLD.format(
        columns=columns,
        rows=rows,
        x_m=columns * pitch_m[0],
        y_m=rows * pitch_m[1],
        z_m=height_m,
        panel_m=height_m - 0.05,
        first_x_m=pitch_m[0] / 2,
        first_y_m=pitch_m[1] / 2,
        pitch_x_m=pitch_m[0],
        pitch_y_m=pitch_m[1],
        **values,
    )


def loading(files: dict[str, Path], rounds: int, targets: Targets) -> None:
    """Time to load a scene."""
    seconds = alternating_s([lambda path=path: load_scene(path) for path in files.values()], rounds, time.process_time)
    few, many, most = seconds
    targets.at_most("load 10 000 LEDs / 1 225", ratio(many, few), 12)
    print(f"load 50 625 LEDs / 1 225 {ratio(most, few):55.1f}; {statistics.median(most):.2f} s")


def poses(scene: Scene, rounds: int, targets: Targets) -> None:
    """Time of a pose in sets of different sizes."""

    def draw(count: int) -> None:
        aimed = AimedPoses(kind="aimed", count=count, tilt_x_deg=(0, 60), tilt_y_deg=(0, 60), height_m=(0.1, 1.8))
        for frame in range(POSES):
            # the same tilts and tries in both sets: a frame's other numbers do not depend on `count`
            pose_of_frame(aimed, frame, 1, Camera(), scene)

    many, few = alternating_s([lambda: draw(1_000_000), lambda: draw(200)], rounds, time.process_time)
    targets.at_most("a pose of 1 000 000 / of 200", ratio(many, few), 1.2)


def frames(scenes: dict[str, Scene], folder: Path, rounds: int, targets: Targets) -> None:
    """Time of LED regions for each LED in view, at the same places under the middle panels."""
    renderers = {name: Renderer(scene, bake(scene, folder)) for name, scene in scenes.items()}

    def ms_of_led(name: str) -> float:
        middle, total_s, leds = SIDES[name] // 2 + 0.5, 0.0, 0
        for number in range(FRAMES):
            place = (middle + 0.03 * number, middle - 0.02 * number, 0.6 + 0.1 * number)
            posed = PosedCamera(Camera(), Pose(place, 3.0 + number, -4.0 - number, 20.0 * number))
            start = time.process_time()
            leds += len(renderers[name].expected_image(posed, LedRegions(kind="leds")).patches)
            total_s += time.process_time() - start
        return 1e3 * total_s / leds

    few, most = [], []
    for _ in range(rounds + 1):
        few.append(ms_of_led("1 225"))
        most.append(ms_of_led("50 625"))
    targets.at_most("an LED in view of 50 625 / of 1 225", ratio(most[1:], few[1:]), 1.1)


def pixels(rounds: int, targets: Targets) -> None:
    """Time of a pixel of full frames with shot noise, the same view on 12 and on 108 Mpx."""
    renderer, pose = Renderer(load_scene(ROOT / "scenes/office.toml")), Pose((3.15, 3.1, 0.6), 6.0, -8.0, 20.0)
    fine = Camera(width_px=12_000, height_px=9_000, pixel_pitch_um=0.4)

    def shoot(camera: Camera) -> None:
        expected = renderer.expected_image(PosedCamera(camera, pose)).expected_electrons(160e-6)
        expose(Sensor(), expected, "bench", exposure_s=160e-6)

    large, small = alternating_s([lambda: shoot(fine), lambda: shoot(Camera())], rounds, time.process_time)
    targets.at_most("a pixel of 108 Mpx / of 12 Mpx", ratio(large, small) / 9, 1.1)


def warehouse(folder: Path, targets: Targets) -> None:
    """Bake of the warehouse."""
    start, cpu = time.perf_counter(), time.process_time()
    scene = load_scene(ROOT / "scenes/warehouse.toml")
    light = bake(scene, folder)
    cpu_s, wall_s = time.process_time() - cpu, time.perf_counter() - start
    print(f"warehouse: {len(scene.leds)} LEDs, {len(light.albedo)} places, {wall_s:.1f} s on {os.cpu_count()} cores")
    targets.at_most(f"warehouse: load and bake, CPU time over {CORES} cores, s", cpu_s / CORES, WAREHOUSE_S)


def airport(folder: Path, targets: Targets) -> None:
    """A hall of 200 x 100 m with 50 000 LEDs, from the scene file to the estimated position of a frame."""
    (folder / "airport.toml").write_text(world(50, 40, (4.0, 2.5), 10.0, texel_m=2.0, paths=64, radius_m=0.02))
    (folder / "recipe.toml").write_text(AIRPORT_RECIPE)
    seconds = {"load": 0.0, "bake, 2 frames and files": 0.0, "estimates": 0.0}
    start = time.perf_counter()
    plan = vr.load_recipe(folder / "recipe.toml")
    seconds["load"] = time.perf_counter() - start
    start = time.perf_counter()
    vr.generate(plan, folder / "airport")
    seconds["bake, 2 frames and files"] = time.perf_counter() - start
    start = time.perf_counter()
    dataset = est.read_dataset(folder / "airport")
    frames = [est.read_frame(dataset, number) for number in range(2)]
    found_m = np.array([est.estimate(frame, "gravity-fit").position_m for frame in frames])
    seconds["estimates"] = time.perf_counter() - start
    true_m = np.array(pq.read_table(folder / "airport/truth.parquet", columns=["position_m"])["position_m"].to_pylist())
    print(f"airport: {len(plan.scene.leds)} LEDs; " + ", ".join(f"{name} {s:.1f} s" for name, s in seconds.items()))
    targets.at_most(
        "airport: error of the position, worst of 2 frames, m", np.linalg.norm(found_m - true_m, axis=1).max(), 0.1
    )


def main() -> None:
    """Measure, print, and hold."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    targets = Targets()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["VLCRENDER_CACHE"] = name
        files = {}
        for leds, side in SIDES.items():
            files[leds] = folder / f"world{side}.toml"
            files[leds].write_text(world(side, side, (1.0, 1.0), 3.5))
        loading(files, rounds, targets)
        scenes = {leds: load_scene(path) for leds, path in files.items()}
        poses(scenes["1 225"], rounds, targets)
        frames({leds: scenes[leds] for leds in ("1 225", "50 625")}, folder, rounds, targets)
        pixels(max(1, rounds // 2), targets)
        warehouse(folder, targets)
        airport(folder, targets)
    targets.finish()


if __name__ == "__main__":
    main()
