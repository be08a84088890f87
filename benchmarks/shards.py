"""Shards against a file for each frame: files, bytes, CPU time, and whether pixels, estimates and scores are the same.

    python benchmarks/shards.py [FRAMES [FRAMES_PER_FILE]]

LED regions of small frames of the office (400 x 300); the shards have no previews. CPU time of all threads to generate
each set and to read its frames, in one process after a warm-up. Previews are measured with a tenth of the frames, of
4000 x 3000 pixels (recipe office200), too.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from target import Targets

import estimator as est
import vlcrender as vr

DATASETS = Path(__file__).parent.parent / "datasets"
SMALL = (
    *("camera.width_px=400", "camera.height_px=300", "camera.pixel_pitch_um=12.0", "exposure_s=1.6e-6"),
    *("poses.border_px=4.0", 'regions={ kind = "leds", margin_px = 2 }'),
)
VARIANT = "gravity-fit"


def made(folder: Path, frames: int, *more: str, recipe: str = "quickstart") -> float:
    """Generate a set; CPU time in seconds."""
    plan = vr.load_recipe(DATASETS / f"{recipe}.toml", [f"poses.count={frames}", *more])
    start = time.process_time()
    vr.generate(plan, folder)
    return time.process_time() - start


def pixels(folder: Path) -> tuple[list[list[tuple[int, int, bytes]]], float]:
    """Every part of every frame, and the CPU time to read them, s."""
    start, dataset = time.process_time(), est.read_dataset(folder)
    found = [
        [(part.row, part.column, np.asarray(part.image_dn).tobytes()) for part in est.read_frame(dataset, record).parts]
        for record in dataset.frames
    ]
    return found, time.process_time() - start


def judged(folder: Path) -> object:
    """Estimates and scores of a variant, without times."""
    rows = est.run(folder, [VARIANT])[VARIANT]
    score = est.score(folder).variants[0]
    left_out = {"median_time_s": True, "rows": {"__all__": {"time_s"}}}
    return [row.model_dump(exclude={"time_s"}) for row in rows], score.model_dump(exclude=left_out)


def main() -> None:
    """Measure and print."""
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    per_file = int(sys.argv[2]) if len(sys.argv) > 2 else 50
    with tempfile.TemporaryDirectory() as name:
        made(Path(name) / "warm", 2, *SMALL)
        folders = [Path(name) / one for one in ("single", "shards", "no previews")]
        options = ((), (f"files.frames_per_file={per_file}", "files.previews=0"), ("files.previews=0",))
        seconds = [made(folder, frames, *SMALL, *more) for folder, more in zip(folders, options, strict=True)]
        found = [pixels(folder) for folder in folders[:2]]
        counts = [sum(1 for path in folder.rglob("*") if path.is_file()) for folder in folders]
        sizes = [sum(path.stat().st_size for path in (folder / "frames").iterdir()) for folder in folders]
        print(f"files: {counts[0]} in all, {counts[2]} without previews, {counts[1]} with shards of {per_file} frames")
        print(f"bytes of frames: {sizes[0]}, {sizes[1]} in shards")
        print(f"CPU time without previews / with: {seconds[2] / seconds[0]:.2f}")
        large = [
            made(Path(name) / f"large{previews}", frames // 10, f"files.previews={previews}", recipe="office200")
            for previews in (1, 0, frames)
        ][1:]
        print(f"the same of {frames // 10} frames of 4000 x 3000: {large[0] / large[1]:.2f}")
        print(f"CPU time of shards / a file a frame, both without previews: {seconds[1] / seconds[2]:.2f}")
        print(f"CPU time to read shards / files: {found[1][1] / found[0][1]:.2f}")
        targets = Targets()
        targets.at_least("the same pixels", float(found[0][0] == found[1][0]), 1.0)
        targets.at_least(
            f"the same estimates and scores of {VARIANT}", float(judged(folders[0]) == judged(folders[1])), 1.0
        )
        targets.finish()


if __name__ == "__main__":
    main()
