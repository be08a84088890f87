"""Dry run of `generate`: what a plan makes, how long that takes and how large it is, from a few frames of the plan.

The frames go to a temporary folder. The room's light is baked if the cache has not got it, as the run itself would.
"""

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vlcrender.dataset.format.files import EXPECTED, FRAMES, PREVIEWS, PROCESSED
from vlcrender.dataset.format.rows import FrameRecord
from vlcrender.dataset.format.summary import disk_use, size_text
from vlcrender.dataset.recipe.plan import Plan
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.dataset.run.frame_job import Job, make_frame
from vlcrender.dataset.run.possible import check_possible
from vlcrender.dataset.run.progress import duration_text
from vlcrender.light.lightmap import bake

TIMED_FRAMES = 3
"""Frames whose time is taken, evenly spread over the plan, after one that compiles the kernels."""


@dataclass(frozen=True)
class DryRun:
    """What was found. Times and sizes are estimates, on this machine with its present load."""

    plan: Plan
    workers: int
    frames_timed: int
    light_s: float
    """Time of the room's light: about 0 where the cache had it."""
    start_s: float
    """Time of the first frame beyond that of others: kernels are compiled."""
    wall_s: float
    """Mean time of a frame in one process."""
    cpu_s: float
    """Mean processor time of a frame."""
    bytes_a_frame: float
    """Mean size of a frame's files, and of its rows in the tables as JSON, which is about as large."""

    @property
    def seconds(self) -> float:
        """Estimated time of the run without the light: no faster than the processors are."""
        a_frame_s = max(self.wall_s / self.workers, self.cpu_s / (os.cpu_count() or 1))
        return self.start_s + self.plan.frame_count * a_frame_s

    @property
    def bytes(self) -> float:
        """Estimated size of the set."""
        return self.plan.frame_count * self.bytes_a_frame

    def lines(self) -> list[str]:
        """Aligned lines for a person."""
        plan, recipe = self.plan, self.plan.recipe
        light = duration_text(self.light_s) if self.light_s > 1 else "in the cache"
        rows = [
            ("frames", f"{plan.frame_count} = {_factors(plan)}"),
            *([("cells", f"{len(plan.cells)} of {', '.join(plan.cells.sweep.names)}")] if plan.cells else []),
            ("cameras", ", ".join(f"{c.name} {c.camera.width_px} x {c.camera.height_px} px" for c in recipe.cameras)),
            ("files", ", ".join(f"{count} {name}" for name, count in file_counts(plan).items())),
            ("light", light),
            ("time", f"about {duration_text(self.seconds)} ({_workers(self.workers)}, {_frame_text(self.wall_s)})"),
            ("size", f"about {size_text(self.bytes)} ({size_text(self.bytes_a_frame)} a frame)"),
        ]
        measured = f"time and size: estimates from {_plural(self.frames_timed, 'frame')} of this plan on this machine"
        if plan.cells is not None:
            measured += ", of its first cell; cells that share views or files take less"
        return [
            *(f"{name:<9}{text}" for name, text in rows),
            *(f"warning: {text}" for text in plan.warnings),
            measured,
        ]


def dry_run(plan: Plan, workers: int = 1, report: Callable[[str, float], None] = lambda stage, share: None) -> DryRun:
    """Check a plan, make a few of its frames in a temporary folder, and estimate the whole.

    report: gets a stage and the share of it that is done. Raises InputError as `generate` does for an impossible plan.
    """
    check_possible(plan, lambda share: report("poses", share))
    before_s = time.perf_counter()
    bake(plan.scene, progress=report)
    light_s = time.perf_counter() - before_s
    # A shard is made whole: its frames alone have nearly the same size.
    files = plan.recipe.files.model_copy(update={"frames_per_file": 1})
    recipe = plan.recipe.model_copy(update={"files": files})
    count = recipe.frame_count
    numbers = sorted({place * (count - 1) // TIMED_FRAMES for place in range(1, TIMED_FRAMES + 1)} - {0})
    with tempfile.TemporaryDirectory(prefix="vlcrender-dry-run-") as folder:
        job = Job.of(Plan(recipe, plan.scene), Path(folder))
        for name in (FRAMES, EXPECTED, PREVIEWS, PROCESSED):
            (Path(folder) / name).mkdir()
        (first, first_s, first_cpu_s) = _timed(job, 0)
        records, walls_s, cpus_s = [first], [first_s], [first_cpu_s]
        for done, number in enumerate(numbers, 1):
            report("timing frames", done / (len(numbers) + 1))
            record, wall_s, cpu_s = _timed(job, number)
            records.append(record)
            walls_s.append(wall_s)
            cpus_s.append(cpu_s)
        report("timing frames", 1.0)
        size = disk_use(Path(folder)) + sum(len(record.model_dump_json()) for record in records)
    own = slice(1, None) if len(walls_s) > 1 else slice(None)
    wall_s, cpu_s = (sum(times[own]) / len(times[own]) for times in (walls_s, cpus_s))
    return DryRun(
        plan=plan,
        workers=workers,
        frames_timed=len(records),
        light_s=light_s,
        start_s=max(0.0, walls_s[0] - wall_s),
        wall_s=wall_s,
        cpu_s=cpu_s,
        bytes_a_frame=size / len(records),
    )


def _timed(job: Job, frame: int) -> tuple[FrameRecord, float, float]:
    """A frame, made, with its time and its processor time in seconds."""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    record = make_frame(job, frame)
    return record, time.perf_counter() - wall_s, time.process_time() - cpu_s


def file_counts(plan: Plan) -> dict[str, int]:
    """Number of files of each kind that a plan makes, without tables and dataset.json; zeros are left out."""
    counts: dict[str, int] = {}

    def add(name: str, count: int) -> None:
        if count:
            counts[name] = counts.get(name, 0) + count

    recipes = [(plan.recipe, plan.recipe.frame_count)]
    if plan.cells is not None:  # cells differ in what is swept; files of cells are counted as the first one has them
        recipes = [(plan.recipe, frames) for frames in plan.cells.frame_counts]
    for recipe, frames in recipes:
        per_file = recipe.files.frames_per_file
        add("shards" if per_file > 1 else f"frames ({recipe.files.format})", -(-frames // per_file))
        add("previews", frames if recipe.files.previews is None else min(frames, recipe.files.previews))
        add("expected images", frames if recipe.expected else 0)
        add("processed pictures", frames if recipe.processed is not None else 0)
    return counts


def _factors(plan: Plan) -> str:
    recipe: Recipe = plan.recipe
    factors = [
        (len(recipe.pose_numbers), "pose"),
        (recipe.repeats, "repeat"),
        (recipe.burst_frames, "shot of a burst"),
        (len(recipe.cameras), "camera"),
        (1 if plan.cells is None else len(plan.cells), "cell"),
    ]
    shown = [_plural(count, name) for count, name in factors if count > 1 or name == "pose"]
    product = 1
    for count, _ in factors:
        product *= count
    return " x ".join(shown) if product == plan.frame_count else "the frames of all cells"


def _plural(count: int, name: str) -> str:
    head, of, tail = name.partition(" of ")
    return f"{count} {head}{'' if count == 1 else 's'}{of}{tail}"


def _workers(workers: int) -> str:
    return _plural(workers, "worker")


def _frame_text(wall_s: float) -> str:
    return f"{duration_text(wall_s)} a frame in one process"
