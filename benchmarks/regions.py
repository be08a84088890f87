"""Speed of LED regions: poses a second, and the time of a full frame over the time of its regions.

    python benchmarks/regions.py [POSES]

Table 1's four LEDs on a 4000 x 3000 sensor, with overscan so that every pose has all four; with noise, without files.
Compare rates within one run only: machines differ and are shared.
"""

import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import LedRegions
from vlcrender.core.backend import dr
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import load_scene
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

EXPOSURE_S = 160e-6
WORKERS = 2


@cache
def renderer() -> Renderer:
    """The renderer of this process."""
    return Renderer(load_scene(Path(__file__).parent.parent / "scenes/table1.toml"))


def shoot(number: int, regions: LedRegions | None) -> int:
    """Render and expose the pose of this number, on a diagonal of the floor; returns the number of pixels."""
    share = number * 0.618034 % 1.0
    pose = Pose((0.2 + 6.6 * share, 0.2 + 6.6 * (1 - share), 0.05))
    mean = renderer().expected_image(PosedCamera(Camera(), pose), regions)
    sensor, key = Sensor(), f"bench {number}"
    return sum(
        expose(
            sensor, part.expected_electrons(EXPOSURE_S), key, part.roi.row, part.roi.column, exposure_s=EXPOSURE_S
        ).size
        for part in mean.parts
    )


def shoot_regions(numbers: range) -> int:
    """Render and expose the LED regions of these poses; returns the number of pixels."""
    return sum(shoot(number, LedRegions(kind="leds", overscan=True)) for number in numbers)


def one_thread() -> None:
    """Limit Dr.Jit to one thread: idle threads spin and slow down the other process."""
    dr.set_thread_count(1)


def main() -> None:
    """Measure and print."""
    poses = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    shoot_regions(range(5))
    start = time.perf_counter()
    pixels = shoot_regions(range(poses)) / poses
    regions_s = (time.perf_counter() - start) / poses
    shoot(0, None)
    start = time.perf_counter()
    for number in range(3):
        shoot(number, None)
    full_s = (time.perf_counter() - start) / 3
    chunks = [range(first, poses, 4 * WORKERS) for first in range(4 * WORKERS)]
    with ProcessPoolExecutor(WORKERS, get_context("spawn"), one_thread) as pool:
        list(pool.map(shoot_regions, [range(5)] * 2 * WORKERS))
        start = time.perf_counter()
        list(pool.map(shoot_regions, chunks))
        pooled_s = (time.perf_counter() - start) / poses
    print(f"table1, 4000 x 3000, four LED regions of {pixels:.0f} pixels in all, {poses} poses")
    print(f"one process        {1 / regions_s:6.0f} poses/s")
    print(f"{WORKERS} processes        {1 / pooled_s:6.0f} poses/s")
    print(f"full frame / regions in one process        {full_s / regions_s:6.0f}")


if __name__ == "__main__":
    main()
