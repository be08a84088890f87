"""Tables of a metric by settings: statistics with 95 % intervals of the frames at each value of one or more keys."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimator.errors import InputError
from estimator.evaluate.frame_columns import Column, FrameColumns, read_frame_columns
from estimator.evaluate.intervals import Integers, mean_interval, quantile_interval, share_interval
from estimator.evaluate.score import import_pandas

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]

MAX_DISTINCT = 24
"""A key with more distinct numbers is binned."""
BINS = 10
STATISTICS = "mean, rmse, median, pN such as p75, success_rate, median_of_all, pN_of_all, of_all (median and p95)"


@dataclass(frozen=True)
class Key:
    """Value of a key in a row of a table: a text, a number, or a bin from `low` to below `high` with its centre."""

    value: float | str
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Statistic:
    """A statistic of a row: its value, and the ends of its 95 % interval.

    NaN: there is none. An infinite value is that of failed frames; an infinite end is no limit.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class TableRow:
    """Frames of one group at one value of each key: number of them, and of those with an estimate."""

    keys: tuple[Key, ...]
    group: tuple[str, ...]
    frames: int
    answered: int
    statistics: tuple[Statistic, ...]
    """In the order of the table's."""
    failures: Mapping[str, int]
    """Number of failed frames by reason, most frequent first; N stands for any number."""


@dataclass(frozen=True)
class Table:
    """Statistics of a metric by the values of the keys `x` and of the columns `by`, a row each; see `table`."""

    metric: str
    x: tuple[str, ...]
    by: tuple[str, ...]
    statistics: tuple[str, ...]
    rows: tuple[TableRow, ...]

    def records(self) -> list[dict[str, float | str | None]]:
        """Rows by column name: keys (with `_low` and `_high` where binned), `by`, `frames`, `answered`, and so on.

        A statistic has the columns `METRIC_STATISTIC`, and these with `_low` and `_high`. None: there is none.
        `failures` is a text, `3 x REASON; 1 x REASON`.
        """
        binned = [any(row.keys[index].low is not None for row in self.rows) for index in range(len(self.x))]
        found = []
        for row in self.rows:
            record: dict[str, float | str | None] = {}
            for name, key, bins in zip(self.x, row.keys, binned, strict=True):
                record |= {name: key.value} | ({f"{name}_low": key.low, f"{name}_high": key.high} if bins else {})
            record |= dict(zip(self.by, row.group, strict=True)) | {"frames": row.frames, "answered": row.answered}
            for name, one in zip(self.statistics, row.statistics, strict=True):
                column = name if name == SUCCESS_RATE else f"{self.metric}_{name}"
                ends = {column: one.value, f"{column}_low": one.low, f"{column}_high": one.high}
                record |= {key: None if math.isnan(value) else value for key, value in ends.items()}
            found.append(record | {"failures": failures_text(row)})
        return found

    def to_pandas(self) -> "pd.DataFrame":
        """Table of `records`; raises InputError where pandas is not installed."""
        frame: pd.DataFrame = import_pandas().DataFrame(self.records())
        return frame


def failures_text(row: TableRow) -> str:
    """Failed frames by reason, most frequent first: `3 x REASON; 1 x REASON`."""
    return "; ".join(f"{count} x {reason}" for reason, count in row.failures.items())


SUCCESS_RATE = "success_rate"
MOMENTS = {"mean": 1, "rmse": 2}
"""Statistics that are roots of the mean of a power: the power."""
Bins = int | Sequence[float]
"""Number of bins of equal width, or their edges, rising."""


def table(
    directories: str | Path | Sequence[str | Path],
    x: Sequence[str] = (),
    by: Sequence[str] = ("variant",),
    statistics: Sequence[str] = ("median",),
    metric: str = "error_3d_m",
    bins: Mapping[str, Bins] | None = None,
    variants: Sequence[str] | None = None,
) -> Table:
    """Statistics of a metric at each value of some keys, for each group of frames, with 95 % intervals.

    Keys and metrics are columns: swept names; `tilt_deg`, `distance_m`, `leds`, `x_m` and others of the truth; the keys
    of a frame in scores.json, such as `error_3d_m`, `nees` or `bound_m`; and those of frames.parquet, such as `camera`
    (datasets/FORMAT.md). A wrong name is answered with all of them.

    Parameters
    ----------
    directories
        Folders of datasets or sweeps with estimates; several are told apart by the column `set`.
    x
        Keys. One of more than 24 distinct numbers is binned.
    by
        Columns whose values make groups; `set` is added where there are several directories.
    statistics
        Any of `mean`, `rmse`, `median`, `pN` (percentile, `p75`), `success_rate`, and `median_of_all` and `pN_of_all`,
        in which failed frames count as infinite (`of_all`: median and p95). The others are over frames that have the
        metric.
    metric
        A column of numbers; of signed errors the size counts.
    bins
        By key: a number of bins, 10 if not given, or their edges. A bin holds its lower edge, the last one both. Frames
        outside the edges are left out.
    variants
        Variants to read; all if None.

    Returns
    -------
    Table
        Rows in order of the keys, then of the groups. Frames without a value of a key are left out. Intervals count the
        frames of a pose, or of a device where a set has several, as dependent.

    Raises
    ------
    InputError
        A file is missing or damaged, or a name is unknown.
    """
    folders = [directories] if isinstance(directories, str | Path) else list(directories)
    groups = list(dict.fromkeys(by))
    if len(folders) > 1 and "set" not in (*x, *by):
        groups.insert(0, "set")
    names = [name for one in statistics for name in (("median_of_all", "p95_of_all") if one == "of_all" else (one,))]
    for name in names:
        if name not in (*MOMENTS, SUCCESS_RATE):
            _share(name)
    if len(set(x) | set(groups)) < len(x) + len(groups):
        raise InputError(f"keys {', '.join([*x, *groups])}: one is given twice")
    if not (x or groups):
        raise InputError("keys: needed one key, or one column for groups")
    for key in bins or {}:
        if key not in x:
            raise InputError(f"bins of {key}: is not one of the keys: {', '.join(x) or 'there are none'}")
    return table_of_columns(read_frame_columns(folders, variants), x, groups, names, metric, bins or {})


def table_of_columns(
    frames: FrameColumns,
    x: Sequence[str],
    by: Sequence[str],
    statistics: Sequence[str],
    metric: str,
    bins: Mapping[str, Bins],
) -> Table:
    """The table of frames that were read before, of which several may be made; as `table`, raises InputError."""
    values = frames.column(metric, "metric")
    if values.dtype == object:
        raise InputError(f"metric {metric}: holds texts, needed numbers")
    sizes = np.abs(values.astype(np.float64))
    keys: list[tuple[Integers, list[Key]]] = [_keys(name, frames.column(name, "key"), bins.get(name)) for name in x]
    groups = [_distinct(frames.column(name, "column")) for name in by]
    codes = [code for code, _ in keys] + [code for code, _ in groups]
    place = np.array(codes, dtype=np.int64).reshape(len(codes), len(sizes))
    inside = np.flatnonzero((place >= 0).all(axis=0))
    found, of_row = np.unique(place[:, inside], axis=1, return_inverse=True)
    failed = frames.columns["status"] == "failed"
    rows = []
    for number, code in enumerate(found.T.tolist()):
        of = inside[of_row.ravel() == number]
        reasons = Counter(re.sub(r"\d+(\.\d+)?", "N", text) for text in frames.columns["reason"][of[failed[of]]])
        row = TableRow(
            keys=tuple(labels[index] for index, (_, labels) in zip(code, keys, strict=False)),
            group=tuple(_text(labels[index]) for index, (_, labels) in zip(code[len(x) :], groups, strict=True)),
            frames=len(of),
            answered=int((~failed[of]).sum()),
            statistics=tuple(
                _statistic(name, sizes[of], ~failed[of], [one[of] for one in frames.samples]) for name in statistics
            ),
            failures=dict(reasons.most_common()),
        )
        rows.append(row)
    return Table(metric, tuple(x), tuple(by), tuple(statistics), tuple(rows))


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.10g}"


def _distinct(column: Column) -> tuple[Integers, list[float | str]]:
    """Number of each row's value among the sorted distinct values, -1 where it is missing; and these values."""
    missing = np.array([value is None or value != value for value in column.tolist()], dtype=bool)
    texts = any(isinstance(value, str) for value in column[~missing].tolist())
    present = [str(value) if texts else value for value in column[~missing].tolist()]
    distinct: list[float | str] = sorted(set(present))
    number = {value: index for index, value in enumerate(distinct)}
    codes = np.full(len(column), -1, dtype=np.int64)
    codes[~missing] = [number[value] for value in present]
    return codes, distinct


def _keys(name: str, column: Column, bins: Bins | None) -> tuple[Integers, list[Key]]:
    """Number of each row's value or bin, -1 where it has none, and what they are."""
    codes, distinct = _distinct(column)
    if not distinct:
        raise InputError(f"key {name}: no frame has a value of it")
    texts = isinstance(distinct[0], str)
    if bins is None and (texts or len(distinct) <= MAX_DISTINCT):
        return codes, [Key(value) for value in distinct]
    if texts:
        raise InputError(f"bins of {name}: it holds texts, needed numbers")
    numbers = column.astype(np.float64)
    edges = _edges(name, BINS if bins is None else bins, float(np.nanmin(numbers)), float(np.nanmax(numbers)))
    codes = np.searchsorted(edges, numbers, side="right").astype(np.int64) - 1
    codes[numbers == edges[-1]] = len(edges) - 2
    codes[~((numbers >= edges[0]) & (numbers <= edges[-1]))] = -1
    pairs = zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    return codes, [Key((low + high) / 2, low, high) for low, high in pairs]


def _edges(name: str, bins: Bins, low: float, high: float) -> Floats:
    if isinstance(bins, int):
        if not 1 <= bins <= 1000:
            raise InputError(f"bins of {name}: {bins}, needed 1 to 1000, or edges")
        return np.linspace(low, high if high > low else low + 1, bins + 1)
    edges = np.array(bins, dtype=np.float64)
    if len(edges) < 2 or not np.isfinite(edges).all() or not (np.diff(edges) > 0).all():
        raise InputError(f"bins of {name}: needed two or more edges, rising")
    return edges


def _share(name: str) -> tuple[float, bool]:
    """Share of a quantile, 0 to 1, and whether it is of all frames. Raises InputError for another name."""
    found = re.fullmatch(r"(median|p(\d{1,2}))(_of_all)?", name)
    if not found or found[2] in ("0", "00"):
        raise InputError(f"statistic {name}: unknown; allowed: {STATISTICS}")
    return (0.5 if found[1] == "median" else int(found[2]) / 100), found[3] is not None


def _statistic(name: str, sizes: Floats, answered: NDArray[np.bool_], samples: Sequence[Integers]) -> Statistic:
    """A statistic of a row's frames: sizes of the metric (n,), NaN where missing, and which frames have an estimate."""
    if name == SUCCESS_RATE:
        return _with_ends(float(answered.mean()), share_interval(answered, samples))
    there = ~np.isnan(sizes)
    if name not in MOMENTS and _share(name)[1]:
        share, filled = _share(name)[0], np.where(there, sizes, np.inf)
        value = float(np.sort(filled)[max(0, math.ceil(share * len(filled) - 1e-9) - 1)])
        return _with_ends(value, quantile_interval(filled, share, samples))
    if not there.any():
        return Statistic(math.nan, math.nan, math.nan)
    present, of_present = sizes[there], [one[there] for one in samples]
    if power := MOMENTS.get(name):
        limits = mean_interval(present**power, of_present)
        ends = None if limits is None else tuple(max(end, 0.0) ** (1 / power) for end in limits)
        return _with_ends(float(np.mean(present**power)) ** (1 / power), ends)
    share = _share(name)[0]
    return _with_ends(float(np.percentile(present, 100 * share)), quantile_interval(present, share, of_present))


def _with_ends(value: float, limits: tuple[float, float] | None) -> Statistic:
    """A statistic of sizes, of which none is below 0."""
    low, high = limits or (math.nan, math.nan)
    return Statistic(value, low if low > 0 or math.isnan(low) else 0.0, high)
