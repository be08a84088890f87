"""Memory and rate of a long run: resident sets of parent and workers after a fifth of the frames, and at the end.

    python benchmarks/long_run.py [FRAMES] [SCALE]

LED regions of the office at a quarter of the resolution (SCALE 4), made by `generate` with two workers, then estimated
with `pnp` and scored. Exits with 1 where a process of `generate` has grown by more than wanted.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

import psutil
from target import Targets

import estimator as est
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
    scale = int(sys.argv[2]) if len(sys.argv) > 2 else 4
    targets, seen, at_s = Targets(), dict[int, list[float]](), dict[int, float]()

    def note(progress: vr.Progress) -> None:
        if progress.stage == "frames" and progress.done in (frames // 5, frames):
            seen[int(progress.done)], at_s[int(progress.done)] = resident_mib(), time.perf_counter()

    plan = vr.load_recipe(ROOT / "datasets/office200.toml", [f"poses.count={frames}", "bound=false"], scale=scale)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["VLCRENDER_CACHE"] = folder
        made = Path(folder) / "set"
        vr.generate(plan, made, workers=WORKERS, progress=note)
        print(f"after generate {resident_mib()[0]:.0f} MiB in the parent")
        start_s = time.perf_counter()
        est.run(made, ["pnp"])
        ran_s = time.perf_counter()
        (score,) = est.score(made).variants
        print(
            f"estimator run: {frames / (ran_s - start_s):.3g} frames/s; score: {time.perf_counter() - ran_s:.2g} s, "
            f"{score.ok} of {score.frames} frames ok; {resident_mib()[0]:.0f} MiB"
        )
    early, late = seen[frames // 5], seen[frames]
    rate_hz = (frames - frames // 5) / (at_s[frames] - at_s[frames // 5])
    print(f"generate: {rate_hz:.3g} frames/s")
    print(f"{frames} frames; MiB after a fifth {[round(m) for m in early]}, after all {[round(m) for m in late]}")
    for number, (before, after) in enumerate(zip(early, late, strict=True)):
        name = f"worker {number}" if number else "parent"
        targets.at_most(f"{name}: resident set after {frames} frames / after {frames // 5}", after / before, GROWTH)
    targets.finish()


if __name__ == "__main__":
    main()
