"""LED maps from files: the rows of a CSV or JSON file as the [[led]] tables of a scene."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from vlcrender.config.columns import ANGLE, LENGTH, Column, Row, read_columns
from vlcrender.config.toml_model import Settings, check
from vlcrender.errors import InputError
from vlcrender.scene.schema import HalfPower, Length, Luminance

COLUMNS = {
    "id": Column(("led", "led_id")),
    "x": Column((), LENGTH),
    "y": Column((), LENGTH),
    "z": Column(("height",), LENGTH),
    "radius": Column((), LENGTH),
    "side": Column((), LENGTH),
    "luminance": Column((), {"cd_m2": 1.0, "cd/m2": 1.0, "nit": 1.0}),
    "flux": Column(("luminous_flux",), {"lm": 1.0}),
    "half_power": Column((), ANGLE),
    "shape": Column(is_text=True),
}
"""Columns of a map, without their units. Each row has x, y, z, a radius or a side, and a luminance or a flux."""
MAX_LEDS = 100_000


class LedMapFile(Settings):
    """A CSV or JSON file with LEDs, and values of LEDs for which the file has no column."""

    file: str
    """Path from the scene's folder, `.csv` or `.json`: columns id, x, y, z, radius or side, luminance or flux,
    half_power, shape, with units in their names, such as `x_cm`."""
    units: Literal["m", "cm", "mm", "in", "ft"] | None = None
    """Unit of lengths whose columns name none; a JSON file may state it too, as `units`."""
    shape: Literal["disc", "square"] | None = None
    """Shape of LEDs whose row has none; squares have a side, discs a radius."""
    radius_m: Length | None = None
    """Radius of discs whose row has none, metres."""
    side_m: Length | None = None
    """Whole side of squares whose row has none, metres."""
    luminance_cd_m2: Luminance | None = None
    """Luminance along the normal of LEDs whose row has neither luminance nor flux, cd/m2."""
    flux_lm: Annotated[float, Field(gt=0, le=1e9)] | None = None
    """Luminous flux of LEDs whose row has neither luminance nor flux, lm. Luminance is flux (m + 1) / (2 pi area)."""
    half_power_deg: HalfPower = 60.0
    """Angle of half luminous intensity of LEDs whose row has none, degrees."""


class _Table(Settings):
    """The key `led_map` of a scene, checked by itself."""

    led_map: LedMapFile


@dataclass(frozen=True)
class LedLines:
    """Rows of a file behind the [[led]] tables of a scene, the last ones, for messages."""

    first: int
    """Number of the first LED of the file among the [[led]] tables."""
    places: tuple[str, ...] = ()
    """File and line of each LED."""

    def named(self, message: str) -> str:
        """A message with `led[N]`, a table that the scene file has not, replaced by the place in the file."""

        def place(found: re.Match[str]) -> str:
            number = int(found[1]) - self.first
            return f"{self.places[number]}{': ' if found[2] else ''}" if 0 <= number < len(self.places) else found[0]

        return re.sub(r"\bled\[(\d+)\](\.?)", place, message)


def with_led_map(tree: Mapping[str, Any], folder: Path, source: str) -> tuple[dict[str, Any], LedLines]:
    """A scene's tree with the LEDs of its `led_map` behind those of `led`, and where they stand.

    folder: where relative paths start. Raises InputError that names the line and the column.
    """
    result = dict(tree)
    own = result.get("led", [])
    given = result.pop("led_map", None)
    if given is None or not isinstance(own, list):
        return result, LedLines(0)
    table = {"file": given} if isinstance(given, str) else given
    settings = check({"led_map": table}, _Table, source).led_map
    try:
        rows = read_columns(folder / settings.file, COLUMNS, settings.units, "leds")
    except InputError as error:
        raise InputError(f"{source}: led_map: {error}") from None
    if not rows or len(rows) > MAX_LEDS:
        raise InputError(f"{source}: led_map: {folder / settings.file}: {len(rows)} LEDs; 1 to {MAX_LEDS} are allowed")
    try:
        leds = [_led(number, row, settings) for number, row in enumerate(rows)]
    except InputError as error:
        raise InputError(f"{source}: led_map: {error}") from None
    result["led"] = [*own, *leds]
    return result, LedLines(len(own), tuple(row.where for row in rows))


def of_led_map(assignments: Iterable[str]) -> tuple[list[str], list[str]]:
    """Assignments of `led_map`, which act before its file is read, and all others."""
    given = list(assignments)
    early = [text for text in given if text.partition("=")[0].partition(".")[0].strip() == "led_map"]
    return early, [text for text in given if text not in early]


def _led(number: int, row: Row, settings: LedMapFile) -> dict[str, Any]:
    """The [[led]] table of a row."""
    missing = [axis for axis in "xyz" if axis not in row.cells]
    if missing:
        raise InputError(f"{row.where}: no {missing[0]}; each LED has x, y and z")
    led_id = row.number("id")
    if led_id is not None and not led_id.is_integer():
        raise InputError(f"{row.where}: column 'id': {led_id:g} is not a whole number")
    angle = row.number("half_power")
    half_power_deg = settings.half_power_deg if angle is None else angle
    shape, size = _shape_and_size(row, settings)
    led = {
        "id": number if led_id is None else int(led_id),
        "position_m": [row.number(axis) for axis in "xyz"],
        "shape": shape,
        "side_m" if shape == "square" else "radius_m": size,
        "half_power_deg": half_power_deg,
    }
    return {**led, "luminance_cd_m2": _luminance_cd_m2(row, settings, half_power_deg, shape, size)}


def _shape_and_size(row: Row, settings: LedMapFile) -> tuple[str, float]:
    radius, side = row.number("radius"), row.number("side")
    if radius is not None and side is not None:
        raise InputError(f"{row.where}: has a radius and a side; give one of them")
    own = "disc" if radius is not None else "square" if side is not None else None
    said = row.cells.get("shape") or own or settings.shape or ("square" if settings.side_m is not None else "disc")
    shape = str(said).lower()
    if shape not in ("disc", "square"):
        raise InputError(f"{row.where}: column 'shape': {said!r} is not disc or square")
    if own not in (None, shape):
        raise InputError(f"{row.where}: column 'shape': a {shape} has no {'radius' if radius is not None else 'side'}")
    name = "side" if shape == "square" else "radius"
    size = row.number(name) if own else settings.side_m if shape == "square" else settings.radius_m
    if size is None:
        raise InputError(f"{row.where}: no {name}; add a column {name}_m, or {name}_m under [led_map]")
    if not size > 0:
        raise InputError(f"{row.where}: column {name!r}: {size:g} has to be above 0")
    return shape, size


def _luminance_cd_m2(row: Row, settings: LedMapFile, half_power_deg: float, shape: str, size: float) -> float:
    luminance, flux = row.number("luminance"), row.number("flux")
    if luminance is None and flux is None:
        luminance, flux = settings.luminance_cd_m2, settings.flux_lm
    if (luminance is None) == (flux is None):
        state = "neither luminance nor flux" if luminance is None else "luminance and flux"
        raise InputError(f"{row.where}: has {state}; give luminance_cd_m2 or flux_lm, as a column or in [led_map]")
    if luminance is not None:
        return luminance
    assert flux is not None
    if not 5 < half_power_deg < 89:
        raise InputError(f"{row.where}: column 'half_power': {half_power_deg:g} deg has to be above 5 and below 89")
    order = -np.log(2) / np.log(np.cos(np.radians(half_power_deg)))
    area_m2 = size**2 if shape == "square" else np.pi * size**2
    return float(flux * (order + 1) / (2 * np.pi * area_m2))
