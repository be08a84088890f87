"""Memory and rate of a long run: resident sets about a fifth of the frames, and at the end.

    python benchmarks/long_run.py [FRAMES] [SCALE]

LED regions of the office at a quarter of the resolution (SCALE 4), made by `generate` with two workers; the first fifth
of the frames and all are then estimated with `pnp` and scored, each by a command in a process of its own (Linux). Exits
with 1 where `generate`'s parent, one of its workers or a command has grown by more than wanted.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
import pyarrow.parquet as pq
from target import Targets

import vlcrender as vr

ROOT = Path(__file__).parent.parent
WORKERS = 2
GROWTH = 1.05
"""Largest ratio wanted of resident sets, after all frames over after a fifth."""
SCORE_BYTES = 5000
"""Largest growth wanted of `score`, bytes a frame and variant.

Scores hold a row and a pose of each frame, and scores.json is in memory before it is written. A row has 23 references
(56 + 23 * 8 bytes), two tuples of three numbers (2 * 64), and some 19 numbers of 24 to 32 bytes, 0.5 kB: 0.9 kB. A pose
has 9 + 2 numbers and a tuple: 0.5 kB. As text they are 1.0 kB and 0.4 kB, which the serializer has twice where its
buffer becomes bytes: 2.8 kB. The lists of the summaries are 0.3 kB. All else, such as LEDs and spots, is flat.
"""
SAMPLES = 100
"""Times at which resident sets are read: after each hundredth of the frames. Medians of those about a fifth of the
frames and of the last fifth are compared: a frame in work takes 20 to 90 MiB more for a moment, and the allocator keeps
some of that for a while.
"""
RESAMPLED = 1000
"""Frames from which on the bootstrap of `score` works on parts of the same size; below, its arrays grow with frames."""
PART_BYTES = 2_000_000 * 8
"""Size of such a part (MAX_RESAMPLED_AT_ONCE), allowed once beside SCORE_BYTES: more frames make several parts, of
which two may be in memory; a step of 14 MB was measured from 1000 to 5000 frames.
"""
PEAK = """
import sys
from estimator.cli import app
app(sys.argv[1:])
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""
"""Program that runs a command and prints its largest resident set, kB. That of `getrusage` begins at the parent's."""


def resident_mib() -> list[float]:
    """Resident sets of this process and of its workers, MiB, the parent first; not of Python's resource tracker."""
    workers = [child for child in psutil.Process().children() if "spawn_main" in " ".join(child.cmdline())]
    return [process.memory_info().rss / 2**20 for process in [psutil.Process(), *workers]]


def first_of(made: Path, to: Path, frames: int) -> Path:
    """The first frames of a set, as a set."""
    to.mkdir()
    (to / "frames").symlink_to(made / "frames")
    description = json.loads((made / "dataset.json").read_text())
    (to / "dataset.json").write_text(json.dumps({**description, "frame_count": frames}))
    for name in ("frames.parquet", "truth.parquet"):
        pq.write_table(pq.read_table(made / name).slice(0, frames), to / name)
    return to


def peak_mib(*command: str) -> float:
    """Largest resident set of a command of the estimator, MiB."""
    done = subprocess.run([sys.executable, "-c", PEAK, *command], capture_output=True, text=True, check=True)
    return int(done.stdout.split()[-1]) / 2**10


def main() -> None:
    """Measure, print, and hold."""
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 5000
    scale = int(sys.argv[2]) if len(sys.argv) > 2 else 4
    targets, seen, at_s = Targets(), list[list[float]](), list[float]()

    def note(progress: vr.Progress) -> None:
        if progress.stage == "frames" and progress.done and progress.done % max(frames // SAMPLES, 1) == 0:
            seen.append(resident_mib())
            at_s.append(time.perf_counter())

    plan = vr.load_recipe(ROOT / "datasets/office200.toml", [f"poses.count={frames}", "bound=false"], scale=scale)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["VLCRENDER_CACHE"] = folder
        made = Path(folder) / "set"
        vr.generate(plan, made, workers=WORKERS, progress=note)
        print(f"after generate {resident_mib()[0]:.0f} MiB in the parent")
        sets = [first_of(made, Path(folder) / "first", frames // 5), made]
        start_s = time.perf_counter()
        ran = [peak_mib("run", str(one), "--variant", "pnp") for one in sets]
        ran_s = time.perf_counter()
        scored = [peak_mib("score", str(one)) for one in sets]
        print(
            f"estimator run: {(frames + frames // 5) / (ran_s - start_s):.3g} frames/s; "
            f"score: {time.perf_counter() - ran_s:.2g} s of both sets; "
            f"MiB of a fifth and of all: run {[round(m) for m in ran]}, score {[round(m) for m in scored]}"
        )
    fifth = len(seen) // 5
    early, late = (
        [statistics.median(of) for of in zip(*samples, strict=True)]
        for samples in (seen[fifth // 2 : fifth + fifth // 2], seen[-fifth:])
    )
    rate_hz = (frames - frames // 5) / (at_s[-1] - at_s[fifth - 1])
    print(f"generate: {rate_hz:.3g} frames/s")
    print(f"{frames} frames; MiB about a fifth {[round(m) for m in early]}, last fifth {[round(m) for m in late]}")
    for number, (before, after) in enumerate(zip(early, late, strict=True)):
        name = f"worker {number}" if number else "parent"
        targets.at_most(f"{name}: resident set after {frames} frames / after {frames // 5}", after / before, GROWTH)
    targets.at_most(f"run: resident set of {frames} frames / of {frames // 5}", ran[1] / ran[0], GROWTH)
    growth_bytes = (2**20 * (scored[1] - scored[0]) - PART_BYTES) / (frames - frames // 5)
    if frames // 5 >= RESAMPLED:
        targets.at_most("score: growth of the resident set beyond PART_BYTES, bytes a frame", growth_bytes, SCORE_BYTES)
    else:
        targets.beside(f"score: growth, bytes a frame; bootstrap included below {5 * RESAMPLED} frames", growth_bytes)
    targets.finish()


if __name__ == "__main__":
    main()
