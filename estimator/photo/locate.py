"""Positions from photographs: the chain from a file to answers, as `estimator photo` runs it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure, InputError
from estimator.io.device import DecodedSpot, DeviceFrame, Part
from estimator.io.downlink import Downlink, Tones
from estimator.io.shutter import GLOBAL, Shutter
from estimator.photo.attitude import Attitude
from estimator.photo.calibration import Calibration, calibration_of_film, simple_calibration
from estimator.photo.decode import FLOOR, MIN_AXIS_RATIO, FoundLamp, find, readout_ratio
from estimator.photo.led_table import LedTable, Mirror
from estimator.photo.overlay import Mark
from estimator.photo.pictures import Orientation, Picture, Tone, read_picture
from estimator.photo.save import digital_numbers, photograph_sensor
from estimator.photo.solve import Centre, Solved, solve
from estimator.spots.detect import Spot, detect
from estimator.spots.identify import gate_px
from estimator.spots.led_light import Readout
from estimator.spots.striped_blobs import Along

Floats = NDArray[np.float64]

# Exposure where nothing says it, as a share of the shortest period: short enough not to blur the stripes.
UNKNOWN_EXPOSURE_SHARE = 0.05


@dataclass(frozen=True)
class Options:
    """What the photographer states beside map, calibration and attitude; None where EXIF or the picture are asked."""

    tone: Tone = "srgb"
    orientation: Orientation = "stored"
    exposure_s: float | None = None
    focal_px: float | None = None
    readout: Literal["auto", "rows", "columns"] = "auto"
    line_rate_hz: float | None = None
    mirror: Literal["auto", "x", "y", "none"] = "auto"
    centroid_sigma_px: float | None = None
    spots: tuple[tuple[int, float, float], ...] = ()


@dataclass(frozen=True, eq=False)
class Located:
    """A photograph with the lamps that were found in it and the answers; `remarks` are lines for the photographer.

    `frame` has the picture, the identities and all that is known, as a dataset's frame; `marks` are for the overlay.
    """

    picture: Picture
    lamps: tuple[FoundLamp, ...]
    solved: Solved
    frame: DeviceFrame
    marks: tuple[Mark, ...]
    remarks: tuple[str, ...] = field(default_factory=tuple)


def locate(path: Path, table: LedTable, calibration: Calibration | None, held: Attitude, options: Options) -> Located:
    """Locate the camera of a photograph.

    Parameters
    ----------
    path
        The picture.
    table
        The LED map.
    calibration
        Intrinsics; None for a pinhole by `focal_px`, or by EXIF's focal length.
    held
        What is known of the camera's attitude.
    options
        The rest.

    Raises
    ------
    InputError
        The picture cannot be read, or something that is needed is not stated.
    EstimationFailure
        The picture has no position: the message says which stage failed, and why.
    """
    picture = read_picture(path, options.tone, options.orientation)
    exif, size_px = picture.exif, (picture.width_px, picture.height_px)
    fitted = _calibration(picture, calibration, options).for_size(*size_px)
    remarks = [*fitted.remarks]
    if exif.orientation not in (None, 1) and options.orientation == "stored":
        remarks.append(f"EXIF orientation {exif.orientation} is not applied: pixels as stored")
    exposure_s = options.exposure_s if options.exposure_s is not None else exif.exposure_s
    frequencies_hz = table.frequencies_hz()
    if exposure_s is None:
        shortest_s = 1 / max(frequencies_hz.values(), default=1000.0)
        exposure_s = UNKNOWN_EXPOSURE_SHARE * shortest_s
        remarks.append(f"exposure unknown: taken as {1e6 * exposure_s:.0f} us; --exposure states it")
    along: Along | None = None
    lamps: list[FoundLamp] = []
    if options.line_rate_hz is not None and frequencies_hz:
        along, said = _axis(picture, options)
        remarks.append(said)
        lamps = find(picture, along, 1 / options.line_rate_hz, exposure_s, frequencies_hz, _any_square(table))
    elif not options.spots:
        missing = "--line-rate" if frequencies_hz else "frequencies in the map"
        raise InputError(f"{path}: identities need {missing}, or --spots")
    shutter = GLOBAL
    if along is not None and options.line_rate_hz is not None:
        direction: Literal["down", "right"] = "down" if along == "rows" else "right"
        shutter = Shutter(kind="rolling", row_time_us=1e6 / options.line_rate_hz, direction=direction)
    camera = fitted.camera(shutter, exif.f_number, exif.focal_length_mm)
    frame = DeviceFrame(
        parts=(Part(0, 0, digital_numbers(picture)),),
        camera=camera,
        sensor=photograph_sensor(),
        accelerometer_m_s2=held.accelerometer_m_s2,
        accelerometer=held.accelerometer,
        exposure_s=exposure_s,
        spots=(),
        leds=table.leds("none"),
        downlink=_downlink(table) if along is not None else None,
    )
    centres = _centres_by_hand(picture, lamps, options) if options.spots else _centres(lamps)
    _check_identified(centres, lamps, along, picture)
    mirrors: tuple[Mirror, ...] = ("none", "x") if options.mirror == "auto" else (options.mirror,)
    solved = solve(frame, table, centres, mirrors, options.centroid_sigma_px)
    spots = tuple(DecodedSpot(led=led, u_px=u, v_px=v) for led, u, v in solved.spots)
    frame = replace(frame, leds=table.leds(solved.mirror), spots=spots)
    remarks += [
        f"LED {table.label(led)}: {off_px:.0f} px off where the map has it, left out"
        for led, off_px in solved.misplaced
    ]
    return Located(picture, tuple(lamps), solved, frame, _marks(centres, lamps, solved, table), tuple(remarks))


def _calibration(picture: Picture, calibration: Calibration | None, options: Options) -> Calibration:
    size_px = picture.width_px, picture.height_px
    if calibration is not None:
        if options.focal_px is not None:
            raise InputError("--camera and --focal-px: give one")
        return calibration
    if options.focal_px is not None:
        return simple_calibration(options.focal_px, size_px, f"--focal-px {options.focal_px:g}")
    if picture.exif.focal_length_35mm is not None:
        found = calibration_of_film(picture.exif.focal_length_35mm, size_px)
        return replace(found, remarks=(f"focal length of {found.K[0, 0]:.0f} px by {found.source}, to some 3 %",))
    raise InputError(f"{picture.path}: EXIF states no focal length; give --camera or --focal-px")


def _any_square(table: LedTable) -> bool:
    return any(entry.side is not None for entry in table.entries)


def _downlink(table: LedTable) -> Downlink:
    frequencies = table.frequencies_hz()
    tones = Tones(
        send="tone",
        duty=0.5,
        depth=1.0,
        clock_error=0.0,
        leds=tuple(frequencies),
        frequencies_hz=tuple(frequencies.values()),
    )
    return Downlink(demodulation="given", transmitters=(tones,))


def _axis(picture: Picture, options: Options) -> tuple[Along, str]:
    """What lines are, and a remark that says so."""
    found, ratio = readout_ratio(picture)
    if options.readout == "auto":
        if ratio < MIN_AXIS_RATIO:
            raise EstimationFailure(
                "readout", f"gradients along both axes are alike ({ratio:.2g} times); give --readout"
            )
        return found, f"readout axis: lines are {found} ({ratio:.1f} times the gradient energy of the other axis)"
    said = f"readout axis: lines are {options.readout}, as given"
    if options.readout != found and ratio >= MIN_AXIS_RATIO:
        said += f"; the stripes say {found} ({ratio:.1f} times the gradient energy)"
    return options.readout, said


def _centres(lamps: Sequence[FoundLamp]) -> list[Centre]:
    """Centres of the lamps; one that the border cuts too much for its visible part to tell the centre is no LED's."""
    centres = []
    for one in lamps:
        (uu, uv), (vu, vv) = one.lamp.covariance_px2.tolist()
        candidates = one.candidates if one.lamp.measured else ()
        centres.append(Centre(one.lamp.u_px, one.lamp.v_px, (uu, uv, vu, vv), candidates))
    return centres


def _centres_by_hand(picture: Picture, lamps: Sequence[FoundLamp], options: Options) -> list[Centre]:
    """Centres of the spots that were given by hand: of the lamp next to each.

    Without a line rate lamps are steady, and are found by their light.
    """
    if lamps:
        spots = [replace(one.lamp.spot(), touches_border=not one.lamp.measured) for one in lamps]
    else:
        coded = picture.coded
        readout = Readout(0, 0, coded, coded, picture.clipped, FLOOR)
        near = np.array([(u, v) for _, u, v in options.spots])
        spots = list(detect([readout], coded.size, 0, near, near_px=gate_px(picture.width_px)))
    gate = gate_px(picture.width_px)
    centres, taken = [], set[int]()
    for led, u, v in options.spots:
        distance = [float(np.hypot(spot.u_px - u, spot.v_px - v)) for spot in spots]
        nearest = int(np.argmin(distance)) if distance else -1
        if nearest < 0 or distance[nearest] > gate:
            raise InputError(f"--spots: no lamp within {gate:.0f} px of ({u:g}, {v:g})")
        if nearest in taken:
            raise InputError(
                f"--spots: two spots are at the lamp at ({spots[nearest].u_px:.0f}, {spots[nearest].v_px:.0f})"
            )
        taken.add(nearest)
        centres.append(_centre_of(spots[nearest], (led,)))
    return centres


def _centre_of(spot: Spot, candidates: tuple[int, ...]) -> Centre:
    (uu, uv), (vu, vv) = spot.covariance_px2.tolist()
    return Centre(spot.u_px, spot.v_px, (uu, uv, vu, vv), () if spot.touches_border else candidates)


def _check_identified(
    centres: Sequence[Centre], lamps: Sequence[FoundLamp], along: Along | None, picture: Picture
) -> None:
    """Say what the lamps are where none is an LED of the map."""
    if any(centre.candidates for centre in centres):
        return
    causes = [
        (sum(one.tone is None for one in lamps), "without stripes"),
        (
            sum(one.tone is not None and not one.tone.clear for one in lamps),
            "whose stripes are no tone of the map's band",
        ),
        (sum(one.tone is not None and one.tone.clear and not one.candidates for one in lamps), "of another tone"),
        (sum(bool(one.candidates) for one in lamps), "cut by the border too much"),
    ]
    told = ", ".join(f"{count} {cause}" for count, cause in causes if count) or "none found"
    found, ratio = readout_ratio(picture)
    hint = (
        f"; the stripes say that lines are {found}: try --readout {found}"
        if along is not None and along != found and ratio >= MIN_AXIS_RATIO
        else ""
    )
    raise EstimationFailure("identify", f"no lamp sends a tone of the map (lamps: {told}){hint}")


def _marks(centres: Sequence[Centre], lamps: Sequence[FoundLamp], solved: Solved, table: LedTable) -> tuple[Mark, ...]:
    residual_of: dict[int, Floats] = {}
    best = next((answer for answer in solved.answers if answer.residuals_px is not None), None)
    if best is not None and best.residuals_px is not None:
        residual_of = {led: residual for (led, *_), residual in zip(solved.spots, best.residuals_px, strict=True)}
    marks = []
    for centre, led in zip(centres, solved.leds, strict=True):
        at = np.array([centre.u_px, centre.v_px])
        one = next((lamp for lamp in lamps if np.hypot(*(at - (lamp.lamp.u_px, lamp.lamp.v_px))) < 1e-6), None)
        angle = np.linspace(0, 2 * np.pi, 25)
        contour = at + 20 * np.column_stack([np.cos(angle), np.sin(angle)]) if one is None else one.lamp.contour_px()
        name = "?" if led is None else table.label(led)
        tone = f" {one.tone.frequency_hz:.0f} Hz" if one is not None and one.tone is not None else ""
        why = (
            ""
            if one is None or led is not None
            else f"\n{'cut by the border too much' if one.candidates else one.why_not()}"
        )
        residual = None if led is None else residual_of.get(led)
        off = "" if residual is None else f"\nresidual {residual[0]:+.1f}, {residual[1]:+.1f} px"
        marks.append(Mark(centre.u_px, centre.v_px, contour, f"{name}{tone}{off}{why}", led is not None, residual))
    return tuple(marks)
