"""Scores: estimates compared with the truth, by frame and by variant. Every frame counts, failed or not."""

import errno
import logging
from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, TypeAdapter, model_validator

from estimator.errors import InputError
from estimator.evaluate.entry import MadeBy, VariantEntry, entry_of
from estimator.evaluate.frame_score import FrameScore, Position, frame_columns, frame_row, score_frame
from estimator.evaluate.frames import FramePose, bound_quantiles_m, frame_pose
from estimator.evaluate.identities import IdentityScore, IdentityTally
from estimator.evaluate.known import KnownEstimates, estimate_paths
from estimator.evaluate.sources import sources_of
from estimator.evaluate.statistics import (
    AgainstBound,
    DeviceScore,
    GoodLeds,
    Groups,
    Interval,
    MapScore,
    Nees,
    OfAll,
    RatioToBound,
    Summary,
    against_bound,
    median_interval,
    nees,
    nees_by_map,
    of_all,
    ratio_to_bound,
    rmse_interval,
    root_mean_square,
    summary,
)
from estimator.io.atomic import write_atomically
from estimator.io.dataset import iter_frames, read_device
from estimator.io.estimates import EstimateRow
from estimator.io.led_map import AnyLed
from estimator.io.lock import locked
from estimator.io.records import Positive, Row, Size
from estimator.io.truth import TruthRow, iter_truth, read_true_map
from estimator.io.withheld import read_withheld

if TYPE_CHECKING:
    import pandas as pd

logger = logging.getLogger(__name__)

VERSION = 5
# Enough for a position without gravity: frames with more are counted with these.
ENOUGH_LEDS = 4


Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class VariantScore(Row):
    """Score of one variant over all frames.

    `of_all` counts failed frames as infinite errors. The other summaries are over the `ok` frames, null without one:
    read them together with `success_rate`, the share of `ok` frames. The two intervals are those of `error_3d`.
    `against_exact_bound` is null where every frame's exact bound is its bound. Range
    errors are of all ranges that the variant computed, including those of frames that failed afterwards.
    """

    variant: str
    entry: VariantEntry
    frames: int
    ok: int
    failed: int
    success_rate: float | None = Field(ge=0, le=1)
    ambiguous: int
    failures: dict[str, int]
    of_all: OfAll | None
    error_3d: Summary | None
    median_interval: Interval | None
    rmse_interval: Interval | None
    horizontal: Summary | None
    vertical: Summary | None
    ranges: int
    range_error: Summary | None
    against_bound: AgainstBound | None
    against_exact_bound: AgainstBound | None
    ratio_to_bound: RatioToBound | None
    nees: Nees | None
    nees_by_map: Nees | None
    by_device: tuple[DeviceScore, ...]
    by_map: tuple[MapScore, ...]
    by_good_leds: tuple[GoodLeds, ...]
    downlink: IdentityScore | None
    median_time_s: Size | None
    rows: tuple[FrameScore, ...]


class Scores(Row):
    """Scores of a dataset, the content of scores.json: all that a report needs, including the truth."""

    format: Literal["estimator-scores"] = "estimator-scores"
    version: Literal[5] = 5
    sources: dict[str, Sha256] = Field(default_factory=dict)
    """SHA-256 of each file that the scores are made of, by its path below the dataset or its results."""
    dataset: str
    room_m: tuple[Positive, Positive, Positive] | None
    led_map: tuple[AnyLed, ...]
    made_by: MadeBy | None = None
    bound_quantiles_m: tuple[Size, ...] | None = None
    frames: tuple[FramePose, ...] = ()
    variants: tuple[VariantScore, ...]

    @model_validator(mode="after")
    def _same_frames(self) -> "Scores":
        first = list(range(len(self.variants[0].rows))) if self.variants else []
        if any([row.frame for row in variant.rows] != first for variant in self.variants):
            raise ValueError("every variant has to have the frames 0, 1, 2, ... in order, and all the same")
        return self

    def to_pandas(self) -> "pd.DataFrame":
        """Table of the variants' scores.

        Returns
        -------
        pandas.DataFrame
            One row a variant. The columns are the keys of a variant in scores.json (datasets/FORMAT.md) without the
            lists (`failures`, `by_...`, `rows`); a summary gives a column for each of its
            keys, `error_3d_median_m`, `nees_mean` and so on. Units stand in the names. Missing values are NaN, and
            infinite ones of `of_all` infinity.

        Raises
        ------
        InputError
            pandas is not installed.
        """
        return import_pandas().DataFrame(self.summary_rows(), columns=list(_summary_row(None)))

    def summary_rows(self) -> list[dict[str, object]]:
        """The rows of `to_pandas`, values by column name; None where there is no value."""
        return [_summary_row(variant) for variant in self.variants]

    def frames_to_pandas(self) -> "pd.DataFrame":
        """Table of the frames' scores.

        Returns
        -------
        pandas.DataFrame
            One row a frame and variant. The columns are `variant` and the keys of a row in scores.json
            (datasets/FORMAT.md) without `range_errors`; positions give three columns, `true_x_m` to `estimate_z_m`.
            Missing values are NaN.

        Raises
        ------
        InputError
            pandas is not installed.
        """
        pd = import_pandas()
        columns = ["variant", *frame_columns()]
        rows = [frame_row(variant.variant, row) for variant in self.variants for row in variant.rows]
        return pd.DataFrame(rows, columns=columns)


def import_pandas() -> Any:
    """The module pandas; raises InputError where it is not installed."""
    try:
        import pandas
    except ImportError:
        raise InputError("pandas is not installed: pip install pandas") from None
    return pandas


SUMMARIES: dict[str, type[Row]] = {
    "of_all": OfAll,
    "error_3d": Summary,
    "median_interval": Interval,
    "rmse_interval": Interval,
    "horizontal": Summary,
    "vertical": Summary,
    "range_error": Summary,
    "against_bound": AgainstBound,
    "against_exact_bound": AgainstBound,
    "ratio_to_bound": RatioToBound,
    "nees": Nees,
    "nees_by_map": Nees,
    "downlink": IdentityScore,
}
"""Keys of a variant that hold several values."""


LISTS = ("entry", "failures", "by_device", "by_map", "by_good_leds", "rows", "by_rows", "by_distance", "by_tilt")
"""Keys of a variant, or of its `downlink`, that hold any number of values, which have no place in a row."""


def _summary_row(score: VariantScore | None) -> dict[str, object]:
    """Values of a variant by column name; None everywhere for None, which gives the columns."""
    row: dict[str, object] = {}
    for field in VariantScore.model_fields:
        value = None if score is None else getattr(score, field)
        if field in LISTS:
            continue
        if field not in SUMMARIES:
            row[field] = value
            continue
        for part in (key for key in SUMMARIES[field].model_fields if key not in LISTS):
            entry = None if value is None else getattr(value, part)
            infinite = field == "of_all" and value is not None and entry is None
            row[f"{field}_{part}"] = float("inf") if infinite else entry
    return row


def score_variant(
    variant: str,
    estimates: Sequence[EstimateRow],
    truth: Sequence[TruthRow],
    leds_m: Mapping[int, Position],
    devices: Sequence[int] | None = None,
    downlink: IdentityScore | None = None,
    entry: VariantEntry | None = None,
) -> VariantScore:
    """Score of one variant's rows by the truth of the same frames; all are of one device if `devices` is None.

    `downlink` is the score of its identities, `entry` what is stated about the variant, by its name if None.
    """
    of_frame = [0] * len(estimates) if devices is None else devices
    rows = [
        score_frame(row, true, leds_m, device) for row, true, device in zip(estimates, truth, of_frame, strict=True)
    ]
    return summarised(variant, rows, downlink, entry_of(variant) if entry is None else entry)


def summarised(
    variant: str, rows: Sequence[FrameScore], downlink: IdentityScore | None, entry: VariantEntry
) -> VariantScore:
    """Score of one variant by the scores of all its frames, in order."""
    good = [row for row in rows if row.status == "ok"]
    sure = [row for row in good if row.nees is not None]
    groups = groups_of(good)
    # Of frames that share errors and are of one device, no interval can be made.
    dependent = groups_of(rows).devices > 1
    unsure, one_device = dependent and groups.devices < 2, dependent and groups_of(sure).devices < 2
    squares = [row.nees for row in sure if row.nees is not None]
    errors_m = [row.error_3d_m for row in good if row.error_3d_m is not None]
    range_errors_m = [error.error_m for row in rows for error in row.range_errors]
    return VariantScore(
        variant=variant,
        entry=entry,
        frames=len(rows),
        ok=len(good),
        failed=len(rows) - len(good),
        success_rate=len(good) / len(rows) if rows else None,
        ambiguous=sum(row.ambiguous for row in good),
        failures=dict(Counter(row.reason for row in rows if row.status == "failed").most_common()),
        of_all=of_all([row.error_3d_m for row in rows]),
        error_3d=summary(errors_m),
        median_interval=None if unsure else median_interval(errors_m, groups),
        rmse_interval=None if unsure else rmse_interval(errors_m, groups),
        horizontal=summary([row.horizontal_error_m for row in good if row.horizontal_error_m is not None]),
        vertical=summary([row.vertical_error_m for row in good if row.vertical_error_m is not None]),
        ranges=len(range_errors_m),
        range_error=summary(range_errors_m),
        against_bound=_against(good, "bound_m"),
        against_exact_bound=None if _same_bounds(rows) else _against(good, "bound_exact_m"),
        ratio_to_bound=_ratio_to_bound(good, unsure),
        nees=None if one_device else nees(squares, groups_of(sure)),
        nees_by_map=nees_by_map(squares, groups_of(sure)),
        by_device=_by_device(rows),
        by_map=_by_map(rows),
        by_good_leds=_by_good_leds(rows),
        downlink=downlink,
        median_time_s=float(np.median([row.time_s for row in good])) if good else None,
        rows=tuple(rows),
    )


def groups_of(rows: Sequence[FrameScore]) -> Groups:
    """Devices and maps of frames."""
    return Groups.of([row.device for row in rows], [row.map for row in rows])


def _against(good: Sequence[FrameScore], field: Literal["bound_m", "bound_exact_m"]) -> AgainstBound | None:
    pairs = [(row.error_3d_m, getattr(row, field)) for row in good]
    both = [(error_m, bound_m) for error_m, bound_m in pairs if error_m is not None and bound_m is not None]
    return against_bound([error_m for error_m, _ in both], [bound_m for _, bound_m in both])


def _ratio_to_bound(good: Sequence[FrameScore], unsure: bool) -> RatioToBound | None:
    """Ratio over the frames with a positive bound; without an interval where none can be made."""
    some = [row for row in good if row.bound_m]
    errors_m = [row.error_3d_m for row in some if row.error_3d_m is not None]
    bounds_m = [row.bound_m for row in some if row.bound_m is not None]
    return ratio_to_bound(errors_m, bounds_m, None if unsure else groups_of(some))


def _same_bounds(rows: Sequence[FrameScore]) -> bool:
    return all(row.bound_exact_m == row.bound_m for row in rows)


def _by_device(rows: Sequence[FrameScore]) -> tuple[DeviceScore, ...]:
    groups = sorted({(row.device, row.map) for row in rows})
    of_group = [[row for row in rows if (row.device, row.map) == group] for group in groups]
    return tuple(
        DeviceScore(device=device, map=one, **_in_group(some))
        for (device, one), some in zip(groups, of_group, strict=True)
    )


def _by_map(rows: Sequence[FrameScore]) -> tuple[MapScore, ...]:
    found = []
    for one in sorted({row.map for row in rows}):
        some = [row for row in rows if row.map == one]
        found.append(MapScore(map=one, devices=len({row.device for row in some}), **_in_group(some)))
    return tuple(found)


def _in_group(rows: Sequence[FrameScore]) -> dict[str, Any]:
    errors_m = [row.error_3d_m for row in rows if row.error_3d_m is not None]
    squares = [row.nees for row in rows if row.nees is not None]
    return {
        "frames": len(rows),
        "failed": sum(row.status == "failed" for row in rows),
        "rmse_m": float(root_mean_square(np.array(errors_m))) if errors_m else None,
        "nees": float(np.mean(squares)) if squares else None,
    }


def _by_good_leds(rows: Sequence[FrameScore]) -> tuple[GoodLeds, ...]:
    found = []
    for count in range(ENOUGH_LEDS + 1):
        some = [row for row in rows if min(row.good_leds, ENOUGH_LEDS) == count]
        failed = sum(row.status == "failed" for row in some)
        found.append(GoodLeds(good_leds=count, frames=len(some), failed=failed))
    return tuple(found)


def score(directory: str | Path) -> Scores:
    """Compare all estimates of a dataset with the truth, and write scores.json.

    Parameters
    ----------
    directory
        Folder of a dataset with estimates, or of results, as `run` writes them. Where it cannot be written, as on a
        read-only file system, scores.json is not written, with a warning.

    Returns
    -------
    Scores
        Scores by variant and by frame, also as tables: `to_pandas`, `frames_to_pandas`.

    Raises
    ------
    InputError
        There are no estimates, or they are of another dataset; a file is missing or damaged; another run uses the
        folder.
    """
    folder = Path(directory)
    with locked(folder, "estimator score"):
        return _score(folder)


def _score(folder: Path) -> Scores:
    """`score` of a folder that is locked."""
    dataset, frame_count = read_device(folder)
    paths = estimate_paths(folder)
    if not paths:
        raise InputError(f"{folder / 'estimates'}: no estimates to score; make them with `estimator run {folder}`")
    if read_withheld(dataset.folder) is not None:
        raise InputError(
            f"{dataset.folder}: truth is withheld; score bundles: estimator score BUNDLE.zip "
            f"--dataset {dataset.folder} --truth KEYFILE"
        )
    sources = sources_of(folder, paths)
    true_map = () if dataset.leds or not frame_count else read_true_map(dataset.folder / "truth_map.parquet")
    known = [KnownEstimates.of(path, dataset, frame_count, sources["frames.parquet"]) for path in paths]
    rows: list[list[FrameScore]] = [[] for _ in paths]
    tallies = [IdentityTally(dataset, true_map) for _ in paths]
    poses: list[FramePose] = []
    bounds_m2 = array("d")
    records, truth = iter_frames(dataset, frame_count), iter_truth(dataset.folder / "truth.parquet", frame_count)
    # One frame at a time: only what scores.json holds of it stays in memory.
    for record, true, *estimates in zip(records, truth, *(one.rows() for one in known), strict=True):
        poses.append(frame_pose(record, true))
        bounds_m2.extend(true.bound_m2 or ())
        for estimate, of, scored, tally in zip(estimates, known, rows, tallies, strict=True):
            scored.append(score_frame(estimate, true, of.leds_m, record.device))
            tally.add(estimate, true, record)
    scores = Scores(
        sources=sources,
        dataset=dataset.name,
        room_m=dataset.room_m,
        led_map=tuple(dataset.leds.values()),
        made_by=MadeBy.here(),
        bound_quantiles_m=bound_quantiles_m(np.array(bounds_m2).reshape(-1, 3, 3)),
        frames=tuple(poses),
        variants=tuple(
            summarised(path.stem, scored, tally.score(), entry_of(path.stem, dataset))
            for path, scored, tally in zip(paths, rows, tallies, strict=True)
        ),
    )
    try:
        write_atomically(folder / "scores.json", TypeAdapter(Scores).dump_json(scores, indent=1), b"\n")
    except OSError as error:
        if error.errno not in (errno.EROFS, errno.EACCES, errno.EPERM):
            raise
        logger.warning("%s: not written: %s", folder / "scores.json", error.strerror)
    return scores
