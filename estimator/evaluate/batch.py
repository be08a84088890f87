"""Batch estimation: variants over the frames of a dataset, shot by shot, timed. Every frame gets a row."""

import operator
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np

from estimator.errors import EstimationFailure, InputError
from estimator.io.dataset import Dataset, FrameRecord, read_frame
from estimator.io.device import DeviceFrame, Led
from estimator.io.estimates import EstimateRow, LedRange
from estimator.io.records import MAX_NUMBER, is_covariance
from estimator.methods.variant import Estimate, Variant

Rows = dict[str, list[EstimateRow]]
"""Rows by variant name, one a frame."""


def estimate_dataset(
    dataset: Dataset, variants: Sequence[Variant], on_frame: Callable[[], None]
) -> dict[str, tuple[EstimateRow, ...]]:
    """Rows of every variant, one a frame; each image is read once, and `on_frame` is called after each frame.

    A frame whose image cannot be read fails for every variant, with the reason `read: ...`.
    """
    rows: Rows = {variant.name: [] for variant in variants}
    for records in shots(dataset):
        for name, of_shot in estimate_shot(dataset, records, variants).items():
            rows[name] += of_shot
        for _ in records:
            on_frame()
    return {name: tuple(of_variant) for name, of_variant in rows.items()}


def shots(dataset: Dataset) -> list[tuple[FrameRecord, ...]]:
    """Frames of each shot, in order; they were exposed at once and are estimated together."""
    return [tuple(records) for _, records in groupby(dataset.frames, lambda record: record.shot)]


def estimate_shot(dataset: Dataset, records: Sequence[FrameRecord], variants: Sequence[Variant]) -> Rows:
    """Rows of every variant for the frames of one shot."""
    rows: Rows = {variant.name: [] for variant in variants}
    shot = [(record, _read(dataset, record)) for record in records]
    for record, frame in shot:
        for variant in variants:
            if isinstance(frame, EstimationFailure):
                row = _failed(record.frame, frame, dataset.leds, time_s=0.0)
            else:
                other_cameras = tuple(
                    other for _, other in shot if isinstance(other, DeviceFrame) and other is not frame
                )
                row = estimate_frame(variant, replace(frame, other_cameras=other_cameras), record.frame)
            rows[variant.name].append(row)
    return rows


def _read(dataset: Dataset, record: FrameRecord) -> DeviceFrame | EstimationFailure:
    try:
        frame = read_frame(dataset, record, with_other_cameras=False)
    except InputError as error:
        return EstimationFailure("read", str(error))
    for part in frame.parts:
        # Variants share the image: one that changes it in place must fail.
        part.image_dn.setflags(write=False)
    return frame


def estimate_frame(variant: Variant, frame: DeviceFrame, index: int) -> EstimateRow:
    """Row of one variant for one frame; `time_s` is wall time from the digital numbers to the position.

    The frame fails on any exception, a result that is not an Estimate, numbers that are not finite, a covariance that
    is not positive definite, and a range to an LED that is not on the map.
    """
    start = time.perf_counter()
    try:
        estimate = variant.estimate(frame)
        return _ok(index, estimate, frame.leds, time.perf_counter() - start)
    except EstimationFailure as failure:
        return _failed(index, failure, frame.leds, time.perf_counter() - start)
    except (Exception, SystemExit) as error:
        crash = EstimationFailure("variant", f"crashed ({type(error).__name__})")
        return _failed(index, crash, frame.leds, time.perf_counter() - start)


def _ok(index: int, estimate: object, leds: Mapping[int, Led], time_s: float) -> EstimateRow:
    if not isinstance(estimate, Estimate):
        raise EstimationFailure("variant", "returned no Estimate")
    ranges = _led_ranges(estimate.ranges_m, leds)
    position_m = np.asarray(estimate.position_m, dtype=np.float64)
    if position_m.shape != (3,):
        raise EstimationFailure("position", "the result is not three numbers", estimate.ranges_m)
    if not np.abs(position_m).max() <= MAX_NUMBER:  # also for NaN
        raise EstimationFailure("position", "the result is not a finite number", estimate.ranges_m)
    covariance = None
    if estimate.covariance_m2 is not None:
        matrix = np.asarray(estimate.covariance_m2, dtype=np.float64)
        if matrix.shape != (3, 3) or not is_covariance(matrix.ravel().tolist()):
            raise EstimationFailure("covariance", "not a symmetric, positive definite matrix", estimate.ranges_m)
        covariance = tuple(matrix.ravel().tolist())
    x, y, z = position_m.tolist()
    return EstimateRow(
        frame=index,
        status="ok",
        reason="",
        position_m=(x, y, z),
        covariance_m2=covariance,
        ambiguous=bool(estimate.ambiguous),
        ranges=ranges,
        time_s=time_s,
    )


def _failed(index: int, failure: EstimationFailure, leds: Mapping[int, Led], time_s: float) -> EstimateRow:
    try:
        ranges = _led_ranges(failure.ranges_m, leds)
    except (EstimationFailure, TypeError, ValueError, OverflowError):
        ranges = ()  # keep the first reason of the failure
    return EstimateRow(frame=index, status="failed", reason=str(failure), position_m=None, ranges=ranges, time_s=time_s)


def _led_ranges(ranges_m: Mapping[int, float], leds: Mapping[int, Led]) -> tuple[LedRange, ...]:
    ranges = {operator.index(led): float(range_m) for led, range_m in ranges_m.items()}
    if not ranges.keys() <= leds.keys():
        raise EstimationFailure("ranges", "to an LED that is not on the map")
    if not all(abs(range_m) <= MAX_NUMBER for range_m in ranges.values()):
        raise EstimationFailure("ranges", "the result is not a finite number")
    return tuple(LedRange(led=led, range_m=range_m) for led, range_m in ranges.items())
