"""Runs variants over a dataset, frame by frame, and times them."""

import time
from collections.abc import Callable, Sequence

import numpy as np

from estimator.dataset import Dataset, DeviceFrame, read_frame
from estimator.errors import EstimationFailure, InputError
from estimator.estimates import EstimateRow, LedRange
from estimator.tables import LARGEST
from estimator.variants import Variant


def estimate_dataset(
    dataset: Dataset, variants: Sequence[Variant], on_frame: Callable[[], None]
) -> dict[str, tuple[EstimateRow, ...]]:
    """Every variant's rows, one a frame; each image is read once, and `on_frame` is called after each.

    An image that cannot be read is a failed frame of every variant, with the reason `read: ...`.
    """
    rows: dict[str, list[EstimateRow]] = {variant.name: [] for variant in variants}
    for record in dataset.frames:
        try:
            frame = read_frame(dataset, record)
        except InputError as error:
            for variant in variants:
                rows[variant.name].append(_failed(record.frame, EstimationFailure("read", str(error)), time_s=0.0))
        else:
            for variant in variants:
                rows[variant.name].append(estimate_frame(variant, frame, record.frame))
        on_frame()
    return {name: tuple(of_variant) for name, of_variant in rows.items()}


def estimate_frame(variant: Variant, frame: DeviceFrame, index: int) -> EstimateRow:
    """One variant's answer to one frame; `time_s` is wall time from the digital numbers to the position."""
    start = time.perf_counter()
    try:
        estimate = variant.estimate(frame)
        time_s = time.perf_counter() - start
        # Also false for NaN.
        if not np.abs([*estimate.position_m, *estimate.ranges_m.values()]).max() <= LARGEST:
            raise EstimationFailure("position", "the result is not a finite number")
    except EstimationFailure as failure:
        return _failed(index, failure, time.perf_counter() - start)
    x, y, z = (float(value) for value in estimate.position_m)
    ranges = tuple(LedRange(led=led, range_m=range_m) for led, range_m in estimate.ranges_m.items())
    return EstimateRow(frame=index, status="ok", reason="", position_m=(x, y, z), ranges=ranges, time_s=time_s)


def _failed(index: int, failure: EstimationFailure, time_s: float) -> EstimateRow:
    ranges = tuple(LedRange(led=led, range_m=range_m) for led, range_m in failure.ranges_m.items())
    return EstimateRow(frame=index, status="failed", reason=str(failure), position_m=None, ranges=ranges, time_s=time_s)
