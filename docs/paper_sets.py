"""Sets of docs/paper/, and how they are measured: frames, estimates, tables, plots and scores of a set.

A set is a recipe of docs/paper/ with the variants that run on it. What is finished is kept: frames by `vlcrender`
itself, estimates by the digests of the frames and of the estimator's source.
"""

import csv
import hashlib
import json
import math
import resource
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import estimator as est
import vlcrender as vr
from estimator.evaluate.frame_columns import FrameColumns, read_frame_columns
from estimator.evaluate.table import Key, Statistic, Table, TableRow, table_of_columns
from estimator.evaluate.table_text import table_csv
from estimator.io.sweep import dataset_folders
from estimator.report.plot import plot

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "paper"
"""Recipes, and the kept tables, plots and scores."""
STATISTICS = ("mean", "median", "p95", "success_rate")
BOUND = "bound (RMS)"
DIGITS = 6


class OutOfTime(Exception):
    """The minutes of `--minutes` are over."""


@dataclass(frozen=True)
class Clock:
    """Ends a run: `check` raises OutOfTime after the deadline, in seconds of `time.monotonic`."""

    deadline_s: float

    def check(self, *_: object) -> None:
        """Raise OutOfTime after the deadline; a progress callback of both packages."""
        if time.monotonic() > self.deadline_s:
            raise OutOfTime


@dataclass(frozen=True)
class PaperSet:
    """A recipe of docs/paper/ by its name, the variants to run, and what `--full` overrides."""

    name: str
    variants: tuple[str, ...]
    full: Mapping[str, object]


@dataclass(frozen=True)
class View:
    """A table of a set, and its plot: a statistic of `metric` by the keys `x`, of the cells `where` says."""

    name: str
    title: str
    set: str
    x: tuple[str, ...]
    where: Mapping[str, float | str] = field(default_factory=dict)
    variants: tuple[str, ...] | None = None
    by: tuple[str, ...] = ("variant",)
    metric: str = "error_3d_m"
    shown: str = "mean"
    bins: Mapping[str, int | Sequence[float]] = field(default_factory=dict)
    lines: tuple[tuple[float, str], ...] = ()
    log: tuple[str, ...] | None = None
    bound: bool = False


def cpu_s() -> float:
    """CPU time of this process and of its finished children, seconds."""
    own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def program_digest() -> str:
    """SHA-256 of the estimator's source."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / "estimator").rglob("*.py")):
        digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def data_digest(folder: Path) -> str:
    """SHA-256 of all frames and their truth, by the digests of the frames in frames.parquet."""
    digest = hashlib.sha256()
    for cell in dataset_folders(folder):
        for name in ("frames.parquet", "truth.parquet"):
            digest.update((cell / name).read_bytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class Measured:
    """A finished set: its folder, digest, number of frames, and CPU time of frames and estimates, seconds."""

    folder: Path
    digest: str
    frames: int
    generate_s: float
    estimate_s: float


def measure(one: PaperSet, out: Path, seeds: int, full: bool, workers: int, clock: Clock) -> Measured:
    """Frames and estimates of a set, made where they are missing. Raises OutOfTime."""
    folder = out / (f"{one.name}-full" if full else one.name)
    state_file = folder.with_suffix(".json")
    state: dict[str, Any] = json.loads(state_file.read_text()) if state_file.is_file() else {}
    overrides = {"sweep.0.values": list(range(1, seeds + 1)), **(one.full if full else {})}

    @contextmanager
    def timed(key: str) -> Iterator[None]:
        start = cpu_s()
        try:
            yield
        finally:
            state[key] = state.get(key, 0.0) + cpu_s() - start
            state_file.write_text(json.dumps(state, indent=1))

    with timed("generate_s"):
        vr.generate(PAGE / f"{one.name}.toml", folder, overrides=overrides, workers=workers, progress=clock.check)
    digest, program = data_digest(folder), program_digest()
    if (state.get("data"), state.get("program")) != (digest, program):
        state |= {"data": digest, "program": program, "variants": [], "estimate_s": 0.0}
    missing = [name for name in one.variants if name not in state["variants"]]
    if missing:
        with timed("estimate_s"):
            est.run(folder, missing, workers, clock.check)
            state["variants"] += missing
    frames = sum(len(est.read_dataset(cell).frames) for cell in dataset_folders(folder))
    return Measured(folder, digest, frames, state["generate_s"], state.get("estimate_s", 0.0))


@cache
def frame_columns(folder: Path) -> FrameColumns:
    """Columns of all frames and variants of a set, read once."""
    return read_frame_columns([folder])


def table_of(view: View, folder: Path, extra: tuple[str, ...] = ()) -> Table:
    """All statistics of a view; `extra` are further keys. The bound is a group of its own."""

    def cells(metric: str, statistics: Sequence[str]) -> Table:
        keys = (*view.x, *extra)
        whole = table_of_columns(frame_columns(folder), (*keys, *view.where), view.by, statistics, metric, view.bins)
        rows = [
            replace(row, keys=row.keys[: len(keys)])
            for row in whole.rows
            if [key.value for key in row.keys[len(keys) :]] == list(view.where.values())
            and (view.variants is None or row.group[0] in view.variants)
        ]
        return replace(whole, x=keys, rows=tuple(rows))

    table = cells(view.metric, STATISTICS)
    if not view.bound:
        return table
    limits = [row for row in cells("bound_m", ("rmse",)).rows if row.group == table.rows[0].group]
    bounds = (replace(row, group=(BOUND,), statistics=row.statistics * len(STATISTICS)) for row in limits)
    return replace(table, rows=(*table.rows, *bounds))


def with_statistic(table: Table, name: str) -> Table:
    """The table with one of its statistics; rows without a value of it are left out."""
    at = table.statistics.index(name)
    rows = [replace(row, statistics=(row.statistics[at],)) for row in table.rows]
    return replace(
        table, statistics=(name,), rows=tuple(row for row in rows if not math.isnan(row.statistics[0].value))
    )


def key_text(value: float | str) -> str:
    """A key's value; a range such as "[20.0, 40.0]" as `20 to 40`, and as `0` where both ends are the same."""
    if isinstance(value, str):
        ends = [f"{float(end):g}" for end in value.strip("[]").split(",")] if value.startswith("[") else [value]
        return " to ".join(dict.fromkeys(ends))
    return f"{value:g}"


def rounded(value: float) -> float | None:
    """A number to six digits; None where there is none or no limit."""
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None


def kept_row(row: TableRow) -> dict[str, Any]:
    """A row of a table as docs/paper/ keeps it."""
    numbers = {
        name: [rounded(number) for number in (one.value, one.low, one.high)]
        for name, one in zip(STATISTICS, row.statistics, strict=True)
    }
    keys = [key.value if key.low is None else f"{key.low:g} to {key.high:g}" for key in row.keys]
    return {
        "x": keys,
        "group": ", ".join(row.group),
        "frames": row.frames,
        "answered": row.answered,
        "failures": dict(row.failures),
        **numbers,
    }


def keep_view(item: str, view: View, folder: Path, kept_in: Path) -> dict[str, Any]:
    """Table and plot of a view, written to the folder `kept_in`; returns the kept table."""
    table = table_of(view, folder)
    (kept_in / f"{item}-{view.name}.csv").write_text(table_csv(table))
    draw(item, view, kept_in)
    rows = [kept_row(row) for row in table.rows]
    names = {"name": view.name, "title": view.title, "x": list(view.x), "metric": view.metric, "shown": view.shown}
    return {**names, "rows": rows, "seeds": seeds_inside(view, folder, rows)}


def draw(item: str, view: View, kept_in: Path) -> None:
    """Draw the plot of a view from its table of all statistics, both in the folder `kept_in`."""
    stem = kept_in / f"{item}-{view.name}"
    column = f"{view.metric}_{view.shown}"
    rows = []
    with stem.with_suffix(".csv").open(newline="") as file:
        for record in csv.DictReader(file):
            keys = tuple(
                Key(_number(record[name]), *(_end(record.get(f"{name}{end}")) for end in ("_low", "_high")))
                for name in view.x
            )
            value, low, high = (float(record[f"{column}{end}"] or "nan") for end in ("", "_low", "_high"))
            counts = int(record["frames"]), int(record["answered"])
            group = tuple(record[name] for name in view.by)
            rows.append(TableRow(keys, group, *counts, (Statistic(value, low, high),), {}))
    drawn = with_statistic(Table(view.metric, view.x, view.by, (view.shown,), tuple(rows)), view.shown)
    stem.with_suffix(".svg").write_text(plot(drawn, view.log, view.lines if len(view.x) == 1 else ()))


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _end(text: str | None) -> float | None:
    return float(text) if text else None


def seeds_inside(view: View, folder: Path, rows: Sequence[Mapping[str, Any]]) -> list[int]:
    """Number of means of one seed whose 95 % interval holds the mean of all seeds, and number of such means."""
    whole = {(tuple(row["x"]), row["group"]): row["mean"][0] for row in rows}
    of_seeds = [kept_row(row) for row in table_of(replace(view, bound=False), folder, ("seed",)).rows]
    inside = []
    for row in of_seeds:
        mean, (_, low, high) = whole.get((tuple(row["x"][:-1]), row["group"])), row["mean"]
        if None not in (mean, low, high):
            inside.append(low <= mean <= high)
    return [sum(inside), len(inside)]


def keep_scores(one: PaperSet, folder: Path) -> None:
    """Errors of every frame in docs/paper/scores/SET.csv: swept values, pose, bound, and a column for each variant."""
    columns = frame_columns(folder).columns
    swept = [name for name in columns if name in _swept_names(folder)]
    extras = ("tilt_x_deg", "tilt_y_deg", "yaw_deg", "capturable", "bound_m")
    frame_keys = [*swept, "pose", "camera", *(name for name in extras if name in columns and name not in swept)]
    by_frame: dict[tuple[Any, ...], dict[str, Any]] = {}
    for index in range(len(columns["variant"])):
        # The frame's number: repeats of a pose have the same other keys.
        of_frame = tuple(_cell(columns[name][index]) for name in frame_keys)
        record = by_frame.setdefault(
            (*of_frame, int(columns["frame"][index])), dict(zip(frame_keys, of_frame, strict=True))
        )
        record[columns["variant"][index]] = _cell(columns["error_3d_m"][index])
    path = PAGE / "scores" / f"{one.name}.csv"
    path.parent.mkdir(exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*frame_keys, *one.variants], lineterminator="\n")
        writer.writeheader()
        writer.writerows(by_frame.values())


def _swept_names(folder: Path) -> list[str]:
    sweep = json.loads((folder / "sweep.json").read_text())
    return [entry["name"] for entry in sweep["sweep"]]


def _cell(value: object) -> str:
    if isinstance(value, float | np.floating):
        return "" if math.isnan(value) else f"{value:.{DIGITS}g}"
    return "" if value is None else str(value)


Extra = Callable[[Mapping[str, Measured]], tuple[list[dict[str, Any]], dict[str, float]]]
"""Further measurement of an item: grids and single figures.

A grid has `title`, `head` and `rows`, and may have `plot` and `svg`, the name and the text of a plot.
"""
