"""Batch estimation: variants over the frames of a dataset, burst by burst and then device by device, timed.

Every frame gets a row. Where identities are not given, the frames of a burst are received together first.
"""

import operator
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np

from estimator.errors import EstimationFailure, InputError
from estimator.io.dataset import Dataset, FrameRecord, read_frame
from estimator.io.device import DeviceFrame, Identity
from estimator.io.estimates import EstimateRow, FoundSpot, LedRange
from estimator.io.led_map import Led
from estimator.io.records import MAX_NUMBER, is_covariance
from estimator.io.shared import SharedResults
from estimator.methods.variant import DeviceMethod, Estimate, Variant
from estimator.receiver.receive import receive_frames
from estimator.spots.found import found_spots

ReadFrame = tuple[FrameRecord, DeviceFrame | EstimationFailure]
"""A record, and its frame or why it cannot be used."""
Rows = dict[str, list[EstimateRow]]
"""Rows by variant name, one a frame."""


@dataclass(frozen=True, eq=False)
class Observed:
    """A frame as the method of a device observed it: `value`, or why it could not; and the time that it took."""

    frame: int
    device: int
    value: object | EstimationFailure
    time_s: float
    identities: tuple[Identity, ...] | None = None
    spots: tuple[FoundSpot, ...] | None = None
    told: Mapping[int, Led] = field(default_factory=dict)
    """LEDs that packets told, where the dataset has no map."""


OfDevice = dict[str, list[Observed]]
"""Observed frames by the name of the variant."""


@dataclass(frozen=True, eq=False)
class ShotResult:
    """Result of a shot: `rows` of the variants that are done with it, and frames `observed`, by name, of the others."""

    rows: Rows
    observed: OfDevice


def estimate_dataset(
    dataset: Dataset, variants: Sequence[Variant], on_frame: Callable[[], None]
) -> dict[str, tuple[EstimateRow, ...]]:
    """All rows of `estimate_frames` by variant, one a frame, in order."""
    rows: dict[str, list[EstimateRow]] = {variant.name: [] for variant in variants}
    for part in estimate_frames(dataset, dataset.frames, variants, on_frame):
        for name, some in part.items():
            rows[name] += some
    return {name: tuple(of_variant) for name, of_variant in rows.items()}


def estimate_frames(
    dataset: Dataset, records: Iterable[FrameRecord], variants: Sequence[Variant], on_frame: Callable[[], None]
) -> Iterator[Rows]:
    """Rows of every variant in the order of the frames, some at a time; each image is read once.

    `records` are those of all frames; `dataset.frames` is not used. `on_frame` is called after each step of a frame. A
    frame has one step, and a second one if a variant uses all frames of a device: they are estimated together, after
    all images. A frame whose image cannot be read fails for every variant, with the reason `read: ...`.
    """
    results = ((len(some), estimate_burst(dataset, some, variants)) for some in bursts(dataset, records))
    return in_order(results, lambda found: (estimate_device(dataset, one, variants) for one in found), on_frame)


def steps(variants: Iterable[Variant]) -> int:
    """Steps of a frame, as `estimate_dataset` counts them."""
    return 1 if all(variant.of_device is None for variant in variants) else 2


def bursts(dataset: Dataset, records: Iterable[FrameRecord]) -> Iterator[tuple[FrameRecord, ...]]:
    """Frames that are estimated together, in order: those of a burst if they have to be received, else of a shot.

    The frames of a shot were exposed at once.
    """
    key = operator.attrgetter("burst" if receives(dataset) else "shot")
    return (tuple(together) for _, together in groupby(records, key))


def receives(dataset: Dataset) -> bool:
    """Whether a receiver has to decode the identities of a dataset."""
    return dataset.downlink is not None and dataset.downlink.demodulation == "pixels"


def devices(observed: Iterable[OfDevice]) -> list[OfDevice]:
    """Observed frames by variant name of each device, devices and frames in order; none without such a variant."""
    found: dict[int, OfDevice] = {}
    for of_burst in observed:
        for name, of_shot in of_burst.items():
            for one in of_shot:
                found.setdefault(one.device, {}).setdefault(name, []).append(one)
    return [found[device] for device in sorted(found)]


def in_order(
    results: Iterable[tuple[int, ShotResult]],
    solve: Callable[[Sequence[OfDevice]], Iterable[Rows]],
    on_frame: Callable[[], None],
) -> Iterator[Rows]:
    """Rows of every variant in the order of the frames, some at a time, once more at the end.

    `results` are those of all bursts, in order, each after its number of frames. Only what variants that use all frames
    of a device observed stays in memory: `solve` makes the rows of each device of it.
    """
    observed = []
    for frames, result in results:
        for _ in range(frames):
            on_frame()
        observed.append(result.observed)
        yield result.rows
    found = devices(observed)
    rows: Rows = {}
    for device, solved in zip(found, solve(found), strict=True):
        for _ in next(iter(device.values())):
            on_frame()
        for name, some in solved.items():
            rows.setdefault(name, []).extend(some)
    yield {name: sorted(some, key=lambda row: row.frame) for name, some in rows.items()}


def estimate_burst(dataset: Dataset, records: Sequence[FrameRecord], variants: Sequence[Variant]) -> ShotResult:
    """Rows for the frames of one burst, or shot, and the frames observed for variants that use all of a device.

    Where identities are not given, the frames of each camera are received together, and a frame's share of that time
    counts as its own. Variants share what they compute alike of an image, such as its spots.
    """
    shared = SharedResults()
    read = [(record, _read(dataset, record, shared)) for record in records]
    time_s = 0.0
    if receives(dataset):
        start = time.perf_counter()
        read = _received(read)
        time_s = (time.perf_counter() - start) / len(read)
        shared.settle()
    result = ShotResult({}, {})
    for _, shot in groupby(read, lambda one: one[0].shot):
        _estimate_shot(result, tuple(shot), variants, dataset.leds, time_s)
    return result


def _received(read: Sequence[ReadFrame]) -> list[ReadFrame]:
    """Frames of a burst with what the receiver decoded of those of each camera."""
    found = {record.frame: frame for record, frame in read}
    for camera in {record.camera: None for record, _ in read}:
        frames = {
            record.frame: frame for record, frame in read if record.camera == camera and isinstance(frame, DeviceFrame)
        }
        try:
            found |= zip(frames, receive_frames(list(frames.values())), strict=True)
        except EstimationFailure as failure:
            found |= dict.fromkeys(frames, failure)
        except Exception as error:
            found |= dict.fromkeys(frames, EstimationFailure("receive", f"crashed ({type(error).__name__})"))
    return [(record, found[record.frame]) for record, _ in read]


def _estimate_shot(
    result: ShotResult,
    shot: Sequence[ReadFrame],
    variants: Sequence[Variant],
    leds: Mapping[int, Led],
    received_s: float,
) -> None:
    """Add the rows and observed frames of one shot; `received_s` is the time that each frame's reception took."""
    for record, frame in shot:
        whole = frame
        identities = frame.identities if isinstance(frame, DeviceFrame) else None
        if isinstance(frame, DeviceFrame):
            others = tuple(other for _, other in shot if isinstance(other, DeviceFrame) and other is not frame)
            whole = replace(frame, other_cameras=others)
        spots = _spots_of(whole)
        for variant in variants:
            if variant.of_device is not None:
                told = frame.leds if isinstance(frame, DeviceFrame) and not leds else {}
                observed = _observed(variant.of_device, whole, record)
                observed = replace(observed, time_s=observed.time_s + received_s, identities=identities)
                observed = replace(observed, spots=spots, told=told)
                result.observed.setdefault(variant.name, []).append(observed)
                continue
            if isinstance(whole, EstimationFailure):
                row = _failed(record.frame, whole, leds, time_s=0.0)
            else:
                row = estimate_frame(variant, whole, record.frame)
            stated = {"time_s": row.time_s + received_s, "identities": identities, "spots": spots}
            row = row.model_copy(update=stated)
            result.rows.setdefault(variant.name, []).append(row)


def _spots_of(frame: DeviceFrame | EstimationFailure) -> tuple[FoundSpot, ...] | None:
    """Spots of a frame; None where it cannot be used. A variant that needs them too is charged with their time."""
    if isinstance(frame, EstimationFailure):
        return None
    try:
        return found_spots(frame)
    except Exception:  # spots are a statement beside the estimates: no fault in them may end a run
        return None


def estimate_device(dataset: Dataset, observed: Mapping[str, Sequence[Observed]], variants: Sequence[Variant]) -> Rows:
    """Rows for the frames of one device, observed by every variant that uses all frames of a device.

    A row's `time_s` is the time in which its frame was observed, and its share of the common solution's.
    """
    rows: Rows = {}
    for variant in variants:
        if variant.of_device is not None and variant.name in observed:
            rows[variant.name] = _solved(variant.of_device, observed[variant.name], dataset.leds)
    return rows


def _observed(method: DeviceMethod, frame: DeviceFrame | EstimationFailure, record: FrameRecord) -> Observed:
    start = _now_s(frame)
    value: object | EstimationFailure = frame
    if isinstance(frame, DeviceFrame):
        try:
            value = method.observe(frame)
        except EstimationFailure as failure:
            value = failure
        except (Exception, SystemExit) as error:
            value = _crash(error)
    return Observed(record.frame, record.device, value, _now_s(frame) - start)


def _solved(method: DeviceMethod, observed: Sequence[Observed], leds: Mapping[int, Led]) -> list[EstimateRow]:
    usable = [one for one in observed if not isinstance(one.value, EstimationFailure)]
    results: dict[int, object] = {one.frame: one.value for one in observed}
    known = leds or {led: entry for one in observed for led, entry in one.told.items()}
    start = time.perf_counter()
    try:
        found = list(method.solve([one.value for one in usable])) if usable else []
        if len(found) != len(usable):
            raise EstimationFailure("variant", "returned another number of results than of frames")
        results.update(zip((one.frame for one in usable), found, strict=True))
    except EstimationFailure as failure:
        results.update((one.frame, failure) for one in usable)
    except (Exception, SystemExit) as error:
        results.update((one.frame, _crash(error)) for one in usable)
    share_s = (time.perf_counter() - start) / max(len(usable), 1)
    rows = []
    for one in observed:
        result, time_s = results[one.frame], one.time_s + (share_s if one in usable else 0.0)
        try:
            if isinstance(result, EstimationFailure):
                raise result
            row = _ok(one.frame, result, known, time_s)
        except EstimationFailure as failure:
            row = _failed(one.frame, failure, known, time_s)
        except (Exception, SystemExit) as error:
            row = _failed(one.frame, _crash(error), known, time_s)
        rows.append(row.model_copy(update={"identities": one.identities, "spots": one.spots}))
    return rows


def _crash(error: BaseException) -> EstimationFailure:
    return EstimationFailure("variant", f"crashed ({type(error).__name__})")


def _read(dataset: Dataset, record: FrameRecord, shared: SharedResults) -> DeviceFrame | EstimationFailure:
    try:
        frame = read_frame(dataset, record, with_other_cameras=False)
    except InputError as error:
        return EstimationFailure("read", str(error))
    for part in frame.parts:
        # Variants share the image: one that changes it in place must fail.
        part.image_dn.setflags(write=False)
    return replace(frame, shared=shared)


def estimate_frame(variant: Variant, frame: DeviceFrame, index: int) -> EstimateRow:
    """Row of one variant for one frame; `time_s` is wall time from the digital numbers to the position.

    What another variant of the frame has computed before, such as the spots, counts with the time that it took then.
    The frame fails on any exception, a result that is not an Estimate, numbers that are not finite, a covariance that
    is not positive definite, and a range to an LED that is not on the map.
    """
    start = _now_s(frame)
    try:
        estimate = variant.estimate(frame)
        return _ok(index, estimate, frame.leds, _now_s(frame) - start)
    except EstimationFailure as failure:
        return _failed(index, failure, frame.leds, _now_s(frame) - start)
    except (Exception, SystemExit) as error:
        return _failed(index, _crash(error), frame.leds, _now_s(frame) - start)


def _now_s(frame: DeviceFrame | EstimationFailure) -> float:
    """Wall time, to which results found in place of computed ones add the time that they took."""
    shared = frame.shared if isinstance(frame, DeviceFrame) else None
    return time.perf_counter() + (0.0 if shared is None else shared.spared_s)


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
