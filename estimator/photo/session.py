"""A run of `estimator photo`: statements of the command line, pictures one after another, tables, overlays, dataset."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure, InputError
from estimator.photo.attitude import attitude
from estimator.photo.calibration import read_calibration
from estimator.photo.led_table import LedTable, read_led_table, read_spots
from estimator.photo.locate import Located, Options, locate
from estimator.photo.overlay import write_overlay
from estimator.photo.pictures import Orientation, Tone
from estimator.photo.report import (
    ANSWER_NOTE,
    LAMP_HEADERS,
    LAMP_NOTE,
    TRUTH_NOTE,
    answer_headers,
    answer_rows,
    lamp_rows,
)
from estimator.photo.save import save

Floats = NDArray[np.float64]
PrintTable = Callable[[str, Sequence[str], Sequence[Sequence[str]], str], None]

MAX_LINE_RATE_HZ = 1e7
MAX_EXPOSURE_S = 100.0
_UNITS_S = {"us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0, "": 1.0}


@dataclass(frozen=True)
class PhotoRequest:
    """Statements of the command line; see `estimator photo --help`."""

    images: Sequence[Path]
    leds: Path
    camera: Path | None = None
    units: str | None = None
    mirror: Literal["auto", "x", "y", "none"] = "auto"
    exposure: str | None = None
    focal_px: float | None = None
    tone: Tone = "srgb"
    orientation: Orientation = "stored"
    readout: Literal["auto", "rows", "columns"] = "auto"
    line_rate: float | None = None
    spots: Path | None = None
    gravity: str | None = None
    tilt: str | None = None
    level: float | None = None
    attitude_sigma: float | None = None
    centroid_sigma: float | None = None
    truth: str | None = None
    overlay: Path | None = None
    save: Path | None = None


def run_photo(request: PhotoRequest, say: Callable[[str], None], table: PrintTable) -> list[Located]:
    """Locate the camera of each picture; print tables, write overlays, and a dataset if asked.

    A picture without a position does not stop the others. Raises InputError if a statement is not allowed, and, after
    all pictures, if one of them has no position.
    """
    leds = read_led_table(request.leds, request.units)
    calibration = None if request.camera is None else read_calibration(request.camera)
    held = attitude(request.gravity, request.tilt, request.level, request.attitude_sigma)
    options = _options(request, leds)
    truth = None if request.truth is None else _triple("--truth", request.truth)
    if request.save is not None and (request.save / "dataset.json").exists():
        raise InputError(f"--save {request.save}: is there already; give the name of a new folder")
    if request.overlay is not None and len(request.images) > 1 and request.overlay.suffix:
        raise InputError(f"--overlay {request.overlay}: give a folder for several pictures")
    found: list[Located] = []
    failures: list[str] = []
    for image in request.images:
        try:
            located = locate(image, leds, calibration, held, options)
        except EstimationFailure as failure:
            failures.append(f"{image}: {failure}")
            continue
        found.append(located)
        for remark in (held.said, *located.remarks, f"map: {located.solved.handed}"):
            say(f"{image.name}: {remark}")
        say(f"{image.name}: further standard deviation of a centroid: {located.solved.sigma_px:.2f} px")
        if located.lamps:
            table(f"{image.name}: lamps", LAMP_HEADERS, lamp_rows(located, leds), LAMP_NOTE)
        note = ANSWER_NOTE if truth is None else f"{ANSWER_NOTE} {TRUTH_NOTE}"
        headers = answer_headers(leds.unit, truth is not None)
        table(f"{image.name}: positions", headers, answer_rows(located.solved.answers, truth), note)
        path = _overlay_path(request, image)
        write_overlay(path, located.picture, located.marks)
        say(str(path))
    if request.save is not None and found:
        save(request.save, request.save.name, [one.frame for one in found], _provenance(request, found, leds))
        say(str(request.save))
    if failures:
        raise InputError("; ".join(failures))
    return found


def _options(request: PhotoRequest, leds: LedTable) -> Options:
    for name, value, largest in (
        ("--line-rate", request.line_rate, MAX_LINE_RATE_HZ),
        ("--focal-px", request.focal_px, 1e7),
        ("--centroid-sigma", request.centroid_sigma, 1e3),
    ):
        if value is not None and not 0 < value <= largest:
            raise InputError(f"{name} {value:g}: needed a number above 0 and at most {largest:g}")
    return Options(
        tone=request.tone,
        orientation=request.orientation,
        exposure_s=None if request.exposure is None else exposure_s(request.exposure),
        focal_px=request.focal_px,
        readout=request.readout,
        line_rate_hz=request.line_rate,
        mirror=request.mirror,
        centroid_sigma_px=request.centroid_sigma,
        spots=() if request.spots is None else tuple(read_spots(request.spots, leds)),
    )


def exposure_s(text: str) -> float:
    """Exposure time, seconds, of `6e-5`, `1/8000`, `60us` or `0.06ms`; raises InputError."""
    found = re.fullmatch(r"\s*([0-9.eE+-]+)\s*(?:/\s*([0-9.eE+-]+))?\s*(us|µs|ms|s|)\s*", text)
    try:
        value = float(found[1]) / float(found[2] or 1) * _UNITS_S[found[3]] if found else np.nan
    except (ValueError, ZeroDivisionError):
        value = np.nan
    if not 0 < value <= MAX_EXPOSURE_S:
        raise InputError(f"--exposure {text!r}: needed a time such as 6e-5, 1/8000, 60us or 0.06ms")
    return float(value)


def _triple(option: str, text: str) -> Floats:
    try:
        numbers = np.array([float(part) for part in text.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise InputError(f"{option} {text!r}: needed x,y,z")
    return numbers


def _overlay_path(request: PhotoRequest, image: Path) -> Path:
    name = f"{image.stem}_spots.png"
    if request.overlay is None:
        return Path(name)
    if request.overlay.is_dir() or not request.overlay.suffix:
        request.overlay.mkdir(parents=True, exist_ok=True)
        return request.overlay / name
    return request.overlay


def _provenance(request: PhotoRequest, found: Sequence[Located], leds: LedTable) -> dict[str, object]:
    return {
        "photographs": [one.picture.path.name for one in found],
        "led_map": request.leds.name,
        "units": leds.unit,
        "mirror": found[0].solved.mirror,
    }
