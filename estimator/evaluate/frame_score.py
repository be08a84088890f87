"""Score of one frame of one variant: its errors by the truth, and what the errors may depend on."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, Strict, model_validator

from estimator.evaluate.statistics import squared_in_sigmas
from estimator.io.estimates import EstimateRow
from estimator.io.records import LedId, Number, Size, Triple, small_row
from estimator.io.truth import TruthRow

Position = tuple[float, float, float]
Whole = Annotated[int, Strict()]
Count = Annotated[int, Field(ge=0), Strict()]


@small_row
class RangeError:
    """Estimated minus true distance to an LED, metres."""

    led: LedId
    error_m: Number


@small_row
class FrameScore:
    """Score of one frame of one variant; positions in world metres. Errors are null for a failed frame.

    `vertical_error_m` is signed, positive is too high. `bound_m` is the root of the trace of the frame's Cramer-Rao
    bound, null without one, `bound_exact_m` that of a device that knows camera and map exactly; `nees` is `e^T C^-1 e`
    if the variant reports a covariance C. `good_leds` counts the LEDs whose whole image is on the sensor.

    Of the frame itself: `tilt_deg`, the angle of the true optical axis off the zenith; `leds`, the number of LEDs that
    light a pixel, and `distance_m`, their mean distance by the map that the device has, null without an LED;
    `spots_found`, the number of spots that the estimator found and identified, and `snr`, the median over them of the
    signal to noise of their brightest pixel, both null where the estimates state no spots.
    """

    frame: Whole
    device: Whole
    map: Whole
    good_leds: Count
    tilt_deg: Annotated[float, Field(ge=0, le=180), Strict()]
    leds: Count
    distance_m: Size | None
    spots_found: Count | None
    snr: Size | None
    status: Literal["ok", "failed"]
    reason: Annotated[str, Strict()]
    true_m: Triple
    estimate_m: Triple | None
    error_3d_m: Size | None
    horizontal_error_m: Size | None
    vertical_error_m: Number | None
    bound_m: Size | None
    bound_exact_m: Size | None
    nees: Size | None
    ambiguous: Annotated[bool, Strict()]
    range_errors: tuple[RangeError, ...]
    time_s: Size

    @model_validator(mode="after")
    def _status_fits(self) -> "FrameScore":
        errors = (self.estimate_m, self.error_3d_m, self.horizontal_error_m, self.vertical_error_m)
        if any((error is None) == (self.status == "ok") for error in errors):
            raise ValueError("an ok frame has an estimate and errors, a failed one none")
        return self


def frame_columns() -> list[str]:
    """Columns of the frames' table beside the variant: the keys of a row without lists, positions by axis."""
    columns: list[str] = []
    for field in (one.name for one in fields(FrameScore)):
        if field in ("true_m", "estimate_m"):
            columns += [f"{field.removesuffix('_m')}_{axis}_m" for axis in "xyz"]
        elif field != "range_errors":
            columns.append(field)
    return columns


def frame_row(variant: str, row: FrameScore) -> dict[str, object]:
    """Values of a frame of a variant by column name, `variant` among them."""
    values: dict[str, object] = {"variant": variant}
    for field in (one.name for one in fields(FrameScore)):
        value = getattr(row, field)
        if field in ("true_m", "estimate_m"):
            point = (None, None, None) if value is None else value
            values |= {f"{field.removesuffix('_m')}_{axis}_m": size for axis, size in zip("xyz", point, strict=True)}
        elif field != "range_errors":
            values[field] = value
    return values


def score_frame(estimate: EstimateRow, truth: TruthRow, leds_m: Mapping[int, Position], device: int = 0) -> FrameScore:
    """Score of one frame: position errors if it has a position, range errors for its ranges to LEDs at `leds_m`."""
    true_m, spots = np.array(truth.position_m), estimate.spots
    error = horizontal = vertical = squares = None
    if estimate.position_m is not None:
        difference_m = np.array(estimate.position_m) - true_m
        error, horizontal = float(np.linalg.norm(difference_m)), float(np.linalg.norm(difference_m[:2]))
        vertical = float(difference_m[2])
        if estimate.covariance_m2 is not None:
            squares = squared_in_sigmas(difference_m, estimate.covariance_m2)
    range_errors = tuple(
        RangeError(led=r.led, error_m=r.range_m - float(np.linalg.norm(np.array(leds_m[r.led]) - true_m)))
        for r in estimate.ranges
    )
    return FrameScore(
        frame=estimate.frame,
        device=device,
        map=truth.map,
        good_leds=truth.good_leds,
        tilt_deg=tilt_deg(truth),
        leds=sum(led.visible_fraction > 0 for led in truth.leds),
        distance_m=mean_distance_m(truth, leds_m),
        spots_found=None if spots is None else len(spots),
        snr=_median([spot.snr for spot in spots or () if spot.snr is not None]),
        status=estimate.status,
        reason=estimate.reason,
        true_m=truth.position_m,
        estimate_m=estimate.position_m,
        error_3d_m=error,
        horizontal_error_m=horizontal,
        vertical_error_m=vertical,
        bound_m=_root_of_trace(truth.bound_m2),
        bound_exact_m=_root_of_trace(truth.bound_exact_m2),
        nees=squares,
        ambiguous=estimate.ambiguous,
        range_errors=range_errors,
        time_s=estimate.time_s,
    )


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _root_of_trace(covariance_m2: Sequence[float] | None) -> float | None:
    return None if covariance_m2 is None else float(np.sqrt(covariance_m2[0] + covariance_m2[4] + covariance_m2[8]))


def tilt_deg(truth: TruthRow) -> float:
    """Angle of a frame's true optical axis off the zenith, degrees."""
    return float(np.degrees(np.arccos(np.clip(truth.R_cam_world[8], -1, 1))))


def mean_distance_m(truth: TruthRow, leds_m: Mapping[int, Position]) -> float | None:
    """Mean distance from a frame's camera to the LEDs at `leds_m` that light a pixel; None without one."""
    seen_m = [leds_m[led.led] for led in truth.leds if led.visible_fraction > 0 and led.led in leds_m]
    if not seen_m:
        return None
    return float(np.linalg.norm(np.array(seen_m).reshape(-1, 3) - truth.position_m, axis=1).mean())
