"""Runs variants over a dataset, frame by frame, and times them."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np

from estimator.dataset import Dataset, DeviceFrame, FrameRecord, read_frame
from estimator.errors import EstimationFailure, InputError
from estimator.estimates import EstimateRow, LedRange
from estimator.pipeline import Variant
from estimator.tables import LARGEST


def estimate_dataset(
    dataset: Dataset, variants: Sequence[Variant], on_frame: Callable[[], None]
) -> dict[str, tuple[EstimateRow, ...]]:
    """Every variant's rows, one a frame; each image is read once, and `on_frame` is called after each.

    An image that cannot be read is a failed frame of every variant, with the reason `read: ...`.
    """
    rows: dict[str, list[EstimateRow]] = {variant.name: [] for variant in variants}
    for _, records in groupby(dataset.frames, lambda record: record.shot):
        shot = [(record, _read(dataset, record)) for record in records]
        for record, frame in shot:
            for variant in variants:
                if isinstance(frame, EstimationFailure):
                    row = _failed(record.frame, frame, time_s=0.0)
                else:
                    mates = tuple(mate for _, mate in shot if isinstance(mate, DeviceFrame) and mate is not frame)
                    row = estimate_frame(variant, replace(frame, mates=mates), record.frame)
                rows[variant.name].append(row)
            on_frame()
    return {name: tuple(of_variant) for name, of_variant in rows.items()}


def _read(dataset: Dataset, record: FrameRecord) -> DeviceFrame | EstimationFailure:
    try:
        return read_frame(dataset, record)
    except InputError as error:
        return EstimationFailure("read", str(error))


def estimate_frame(variant: Variant, frame: DeviceFrame, index: int) -> EstimateRow:
    """One variant's answer to one frame; `time_s` is wall time from the digital numbers to the position."""
    start = time.perf_counter()
    try:
        estimate = variant.estimate(frame)
        time_s = time.perf_counter() - start
        # Also false for NaN.
        numbers = [*estimate.position_m, *estimate.ranges_m.values()]
        if estimate.covariance_m2 is not None:
            numbers += estimate.covariance_m2.ravel().tolist()
        if not np.abs(numbers).max() <= LARGEST:
            raise EstimationFailure("position", "the result is not a finite number")
    except EstimationFailure as failure:
        return _failed(index, failure, time.perf_counter() - start)
    x, y, z = (float(value) for value in estimate.position_m)
    ranges = tuple(LedRange(led=led, range_m=range_m) for led, range_m in estimate.ranges_m.items())
    covariance = None
    if estimate.covariance_m2 is not None:
        covariance = tuple(map(float, estimate.covariance_m2.ravel()))
    return EstimateRow(
        frame=index,
        status="ok",
        reason="",
        position_m=(x, y, z),
        covariance_m2=covariance,
        ambiguous=estimate.ambiguous,
        ranges=ranges,
        time_s=time_s,
    )


def _failed(index: int, failure: EstimationFailure, time_s: float) -> EstimateRow:
    ranges = tuple(LedRange(led=led, range_m=range_m) for led, range_m in failure.ranges_m.items())
    return EstimateRow(frame=index, status="failed", reason=str(failure), position_m=None, ranges=ranges, time_s=time_s)
