"""Memory of a long run: resident sets of the parent and of both workers after a fifth of the frames, and at the end.

    python benchmarks/long_run.py [FRAMES]

LED regions of the office at a quarter of the resolution, made by `generate` with two workers. Exits with 1 where a
process has grown by more than wanted.
"""

import os
import sys
import tempfile
from pathlib import Path

import psutil
from target import Targets

import vlcrender as vr

ROOT = Path(__file__).parent.parent
WORKERS = 2
GROWTH = 1.05
"""Largest ratio wanted of resident sets, after all frames over after a fifth."""


def resident_mib() -> list[float]:
    """Resident sets of this process and of its workers, MiB, the parent first; not of Python's resource tracker."""
    workers = [child for child in psutil.Process().children() if "spawn_main" in " ".join(child.cmdline())]
    return [process.memory_info().rss / 2**20 for process in [psutil.Process(), *workers]]


def main() -> None:
    """Measure, print, and hold."""
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 3000
    targets, seen = Targets(), dict[int, list[float]]()

    def note(progress: vr.Progress) -> None:
        if progress.stage == "frames" and progress.done in (frames // 5, frames):
            seen[int(progress.done)] = resident_mib()

    plan = vr.load_recipe(ROOT / "datasets/office200.toml", [f"poses.count={frames}", "bound=false"], scale=4)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["VLCRENDER_CACHE"] = folder
        vr.generate(plan, Path(folder) / "set", workers=WORKERS, progress=note)
    early, late = seen[frames // 5], seen[frames]
    print(f"{frames} frames; MiB after a fifth {[round(m) for m in early]}, after all {[round(m) for m in late]}")
    for number, (before, after) in enumerate(zip(early, late, strict=True)):
        name = f"worker {number}" if number else "parent"
        targets.at_most(f"{name}: resident set after {frames} frames / after {frames // 5}", after / before, GROWTH)
    targets.finish()


if __name__ == "__main__":
    main()
