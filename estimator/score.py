"""Estimates against the truth: per frame and per variant. The only module that opens truth.parquet."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pyarrow as pa
from pydantic import Field, ValidationError

from estimator.dataset import Dataset, Led, LedId, read_dataset
from estimator.errors import InputError
from estimator.estimates import EstimateRow, read_estimates
from estimator.files import write_atomically
from estimator.tables import Number, Row, Triple, first_problem, read_rows

TRUTH_COLUMNS = {"frame": pa.int64(), "position_m": pa.list_(pa.float64())}
Size = Annotated[float, Field(ge=0)]


class TruthRow(Row):
    """Where the camera of one frame was, world metres."""

    frame: int
    position_m: Triple


class RangeError(Row):
    """Estimated minus true distance to an LED."""

    led: LedId
    error_m: Number


class FrameScore(Row):
    """One frame of one variant; errors are null where it failed. `vertical_error_m` is signed, positive is too high."""

    frame: int
    status: Literal["ok", "failed"]
    reason: str
    true_m: Triple
    estimate_m: Triple | None
    error_3d_m: Size | None
    horizontal_error_m: Size | None
    vertical_error_m: Number | None
    range_errors: tuple[RangeError, ...]
    time_s: Size


class Summary(Row):
    """Of the absolute errors of the frames that succeeded, metres; `p95_m` is interpolated linearly."""

    median_m: Size
    mean_m: Size
    rmse_m: Size
    p95_m: Size
    max_m: Size


class VariantScore(Row):
    """One variant over all frames. Summaries are over its `ok` frames, null without any; read them beside `failed`.

    The median range error is over all distances the variant made, failed frames' included, for a frame can fail after
    its distances are made.
    """

    variant: str
    frames: int
    ok: int
    failed: int
    failures: dict[str, int]
    error_3d: Summary | None
    horizontal: Summary | None
    vertical: Summary | None
    ranges: int
    median_range_error_m: Size | None
    median_time_s: Size | None
    rows: tuple[FrameScore, ...]


class Scores(Row):
    """scores.json: all that a report needs of a dataset, the truth included."""

    format: Literal["estimator-scores"] = "estimator-scores"
    version: Literal[1] = 1
    dataset: str
    room_m: Triple
    led_map: tuple[Led, ...]
    variants: tuple[VariantScore, ...]


def score_variant(
    variant: str, estimates: Sequence[EstimateRow], true_m: Sequence[Triple], leds: Mapping[int, Led]
) -> VariantScore:
    """Score one variant's rows against the true positions of the same frames, world metres."""
    rows = tuple(score_frame(row, truth, leds) for row, truth in zip(estimates, true_m, strict=True))
    good = [row for row in rows if row.status == "ok"]
    range_errors_m = [abs(error.error_m) for row in rows for error in row.range_errors]
    return VariantScore(
        variant=variant,
        frames=len(rows),
        ok=len(good),
        failed=len(rows) - len(good),
        failures=dict(Counter(row.reason for row in rows if row.status == "failed").most_common()),
        error_3d=_summary([row.error_3d_m for row in good]),
        horizontal=_summary([row.horizontal_error_m for row in good]),
        vertical=_summary([row.vertical_error_m for row in good]),
        ranges=len(range_errors_m),
        median_range_error_m=float(np.median(range_errors_m)) if range_errors_m else None,
        median_time_s=float(np.median([row.time_s for row in good])) if good else None,
        rows=rows,
    )


def score_frame(estimate: EstimateRow, true_m: Triple, leds: Mapping[int, Led]) -> FrameScore:
    """Score one frame: position errors where there is a position, range errors for the ranges there are."""
    truth = np.array(true_m)
    error = horizontal = vertical = None
    if estimate.position_m is not None:
        difference = np.array(estimate.position_m) - truth
        error, horizontal = float(np.linalg.norm(difference)), float(np.linalg.norm(difference[:2]))
        vertical = float(difference[2])
    range_errors = tuple(
        RangeError(led=r.led, error_m=r.range_m - float(np.linalg.norm(np.array(leds[r.led].position_m) - truth)))
        for r in estimate.ranges
    )
    return FrameScore(
        frame=estimate.frame,
        status=estimate.status,
        reason=estimate.reason,
        true_m=true_m,
        estimate_m=estimate.position_m,
        error_3d_m=error,
        horizontal_error_m=horizontal,
        vertical_error_m=vertical,
        range_errors=range_errors,
        time_s=estimate.time_s,
    )


def _summary(errors_m: Sequence[float | None]) -> Summary | None:
    if not errors_m:
        return None
    size_m = np.abs(np.array(errors_m, dtype=np.float64))
    return Summary(
        median_m=float(np.median(size_m)),
        mean_m=float(size_m.mean()),
        rmse_m=float(np.sqrt((size_m**2).mean())),
        p95_m=float(np.percentile(size_m, 95)),
        max_m=float(size_m.max()),
    )


def score_dataset(folder: Path) -> Scores:
    """Score every file in `estimates/` and write scores.json; raises InputError where a file is missing or damaged."""
    dataset = read_dataset(folder)
    paths = _estimate_paths(folder)
    if not paths:
        raise InputError(f"{folder / 'estimates'}: no estimates to score; make them with `estimator run {folder}`")
    true_m = _read_truth(folder / "truth.parquet", len(dataset.frames))
    scores = Scores(
        dataset=dataset.name,
        room_m=dataset.room_m,
        led_map=tuple(dataset.leds.values()),
        variants=tuple(score_variant(path.stem, _read_known(path, dataset), true_m, dataset.leds) for path in paths),
    )
    write_atomically(folder / "scores.json", scores.model_dump_json(indent=1).encode() + b"\n")
    return scores


def read_or_score(folder: Path) -> Scores:
    """scores.json where it is newer than all estimates and covers them, else new scores; raises InputError."""
    path, estimates = folder / "scores.json", _estimate_paths(folder)
    if not path.exists() or any(estimate.stat().st_mtime > path.stat().st_mtime for estimate in estimates):
        return score_dataset(folder)
    try:
        scores = Scores.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise InputError(f"{path}: {first_problem(error)}") from None
    if estimates and [score.variant for score in scores.variants] != [estimate.stem for estimate in estimates]:
        return score_dataset(folder)
    return scores


TABLE_HEADERS = ("ok", "failed", "median", "mean", "RMSE", "p95", "max", "horizontal", "vertical", "range", "time")


def table_cells(score: VariantScore) -> tuple[str, ...]:
    """A variant's row under TABLE_HEADERS: 3D errors from median to max, then medians of the rest."""
    parts = [score.error_3d] * 5 + [score.horizontal, score.vertical]
    fields = ["median_m", "mean_m", "rmse_m", "p95_m", "max_m", "median_m", "median_m"]
    lengths_m = [None if part is None else getattr(part, field) for part, field in zip(parts, fields, strict=True)]
    lengths = [length_text(length_m) for length_m in [*lengths_m, score.median_range_error_m]]
    time_s = score.median_time_s
    return (str(score.ok), str(score.failed), *lengths, "–" if time_s is None else f"{time_s * 1e3:.0f} ms")


def length_text(metres: float | None) -> str:
    """A length for people, to three digits: `12.3 mm`, `1.23 m`; a dash for None."""
    if metres is None:
        return "–"
    for size_m, unit in ((1.0, "m"), (1e-3, "mm")):
        if abs(metres) >= size_m:
            return f"{metres / size_m:.3g} {unit}" if abs(metres) < 1000 else f"{metres:.2g} m"
    return f"{metres / 1e-6:.3g} µm"


def _estimate_paths(folder: Path) -> list[Path]:
    return sorted((folder / "estimates").glob("*.parquet"), key=lambda path: path.stem)


def _read_truth(path: Path, frame_count: int) -> list[Triple]:
    rows = read_rows(path, TRUTH_COLUMNS, TruthRow)
    if [row.frame for row in rows] != list(range(frame_count)):
        raise InputError(f"{path}: {len(rows)} rows, needed one for each of the {frame_count} frames, in order")
    return [row.position_m for row in rows]


def _read_known(path: Path, dataset: Dataset) -> tuple[EstimateRow, ...]:
    """Estimates whose ranges are to LEDs of the map."""
    rows = read_estimates(path, len(dataset.frames))
    for row in rows:
        for led_range in row.ranges:
            if led_range.led not in dataset.leds:
                raise InputError(f"{path}: frame {row.frame}: a range to LED {led_range.led}, which is not in led_map")
    return rows
