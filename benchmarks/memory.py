"""Peak memory of making full office frames, after 20 and after all of them: the two should agree.

python benchmarks/memory.py [FRAMES]
"""

import resource
import sys
import tempfile
from pathlib import Path

from target import Targets

from vlcrender.dataset.format.files import EXPECTED, FRAMES, PREVIEWS
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run.frame_job import Job, make_frame


def peak_gib() -> float:
    """Largest resident set of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    """Measure and print."""
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    peaks: list[float] = []
    root = Path(__file__).parent.parent
    plan = load_plan(root / "datasets/quickstart.toml", [f"poses.count={frames}"])
    with tempfile.TemporaryDirectory() as folder:
        for name in (FRAMES, EXPECTED, PREVIEWS):
            (Path(folder) / name).mkdir()
        job = Job.of(plan, Path(folder))
        for frame in range(frames):
            record = make_frame(job, frame)
            (Path(folder) / record.device.file).unlink()
            if frame + 1 in (20, frames):
                peaks.append(peak_gib())
                print(f"peak memory after {frame + 1:4d} full frames   {peaks[-1]:.2f} GiB", flush=True)
    targets = Targets()
    targets.at_most(f"peak memory after {frames} frames / after 20", peaks[-1] / peaks[0], 1.05)
    targets.finish()


if __name__ == "__main__":
    main()
