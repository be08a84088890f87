"""Frames of two workers beside one's, and what is busy meanwhile: full office frames and LED regions, with all files.

    python benchmarks/workers.py [FRAMES] [REPEATS]

Wall-clock time of `generate`, the difference between FRAMES and a quarter of them, so that start-up cancels; CPU time
of all processes; and the share of time in which the machine's cores are idle. Two workers are wanted to be 1.7 times as
fast as one, unless they leave no core idle: one process already uses all cores for rays and noise, and one for EXR,
hash and preview. The last lines are rates of background and noise in one process, with one thread and with all cores.
Run it without other work, which it would take for that of the workers.
"""

import os
import resource
import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
from target import Targets, alternating_s

import vlcrender as vr
from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.core.backend import dr
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import load_scene
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

ROOT = Path(__file__).parent.parent
WANTED = 1.7
MAX_IDLE = 0.1
"""Share of time in which the cores may be idle where two workers are not WANTED times as fast as one."""


def usage() -> np.ndarray:
    """Wall-clock time, CPU time of this process and its finished children, and the machine's idle time, s."""
    cpu_s = sum(
        spent.ru_utime + spent.ru_stime
        for spent in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )
    return np.array([time.perf_counter(), cpu_s, psutil.cpu_times().idle])


def generate(recipe: str, frames: int, workers: int) -> np.ndarray:
    """`usage` of making a data set."""
    with tempfile.TemporaryDirectory() as folder:
        plan = vr.load_recipe(ROOT / "datasets" / recipe, [f"poses.count={frames}", "bound=false"])
        before = usage()
        vr.generate(plan, Path(folder) / "set", workers=workers)
        return usage() - before


def compare(targets: Targets, name: str, recipe: str, frames: int, repeats: int) -> None:
    """Frames of one worker and of two, in turn."""
    cores = os.cpu_count() or 1
    rounds = []
    for _ in range(repeats):
        of_workers = [generate(recipe, frames, n) - generate(recipe, frames // 4, n) for n in (1, 2)]
        rounds.append(np.array(of_workers) / (frames - frames // 4))
    (one_s, one_cpu_s, one_idle_s), (two_s, two_cpu_s, two_idle_s) = np.median(rounds, axis=0)
    for workers, wall_s, cpu_s, idle_s in ((1, one_s, one_cpu_s, one_idle_s), (2, two_s, two_cpu_s, two_idle_s)):
        print(
            f"{name}, {workers} at work: {1e3 * wall_s:.0f} ms a frame, {1e3 * cpu_s:.0f} ms of CPU time, "
            f"cores idle {idle_s / (cores * wall_s):.0%}"
        )
    speed, idle = one_s / two_s, two_idle_s / (cores * two_s)
    if speed >= WANTED:
        targets.at_least(f"{name}: frames a second of two workers / of one", speed, WANTED)
    else:
        targets.beside(f"{name}: frames a second of two workers / of one", speed)
        targets.at_most(f"{name}: share of time that two workers leave cores idle", idle, MAX_IDLE)


def rates() -> None:
    """Print the rates of one process by threads."""
    renderer, camera = Renderer(load_scene(ROOT / "scenes/office.toml")), Camera()
    posed = PosedCamera(camera, Pose((3.15, 3.1, 0.6), tilt_x_deg=6.0, tilt_y_deg=-8.0, yaw_deg=20.0))
    electrons = renderer.expected_image(posed).expected_electrons(160e-6)
    works = [
        lambda: renderer.background_cd_m2(posed),
        lambda: expose(Sensor(), electrons, "bench", exposure_s=160e-6),
    ]
    for threads in (1, os.cpu_count() or 1):
        dr.set_thread_count(threads)
        background_s, noise_s = (statistics.median(seconds) for seconds in alternating_s(works, 3))
        mpx = electrons.size / 1e6
        print(f"{threads} threads: background {mpx / background_s:.0f} Mpx/s, noise {mpx / noise_s:.0f} Mpx/s")


def main() -> None:
    """Measure, print, and hold."""
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 12
    repeats = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    targets = Targets()
    print(f"load before the start {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    compare(targets, "full frames", "quickstart.toml", frames, repeats)
    compare(targets, "LED regions", "office200.toml", 10 * frames, repeats)
    rates()
    targets.finish()


if __name__ == "__main__":
    main()
