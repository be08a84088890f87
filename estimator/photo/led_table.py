"""LED maps of photographs: CSV or JSON tables of positions, frequencies, sizes, in any unit and handedness."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estimator.errors import InputError
from estimator.io.led_map import AnyLed, DiscLed, SquareLed

Floats = NDArray[np.float64]
Mirror = Literal["none", "x", "y"]

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
NAMES = {
    "id": ("id", "led", "led_id", "name", "label"),
    "x": ("x",),
    "y": ("y",),
    "z": ("z", "height", "h"),
    "frequency_hz": ("frequency_hz", "frequency", "freq", "f", "hz", "f_hz", "tone"),
    "radius": ("radius", "r"),
    "side": ("side", "a"),
    "shape": ("shape",),
    "position": ("position", "xyz"),
}
"""Names of a column or key, whatever their case and the unit behind them, such as `x_cm`."""
MAX_LEDS = 10_000
MAX_COORDINATE_M = 1e6


@dataclass(frozen=True)
class LedEntry:
    """LED of a table: `label`, position (x, y, z) and size in the table's units; None where the table says nothing."""

    id: int
    label: str
    position: tuple[float, float, float]
    frequency_hz: float | None
    radius: float | None
    side: float | None


@dataclass(frozen=True, eq=False)
class LedTable:
    """An LED map as it was given; `unit` is the name of its unit of length."""

    entries: tuple[LedEntry, ...]
    unit: str

    @property
    def unit_m(self) -> float:
        """Metres of one unit."""
        return UNITS_M[self.unit]

    def frequencies_hz(self) -> dict[int, float]:
        """Frequencies by id, of the LEDs that have one."""
        return {entry.id: entry.frequency_hz for entry in self.entries if entry.frequency_hz is not None}

    def leds(self, mirror: Mirror) -> dict[int, AnyLed]:
        """LEDs by id, metres, in right-handed axes: one axis of a left-handed table is reversed."""
        signs = mirror_signs(mirror)
        made: dict[int, AnyLed] = {}
        for entry in self.entries:
            x, y, z = (self.unit_m * signs * np.array(entry.position)).tolist()
            if entry.side is not None:
                made[entry.id] = SquareLed(id=entry.id, position_m=(x, y, z), side_m=entry.side * self.unit_m)
            else:
                radius_m = None if entry.radius is None else entry.radius * self.unit_m
                made[entry.id] = DiscLed(id=entry.id, position_m=(x, y, z), radius_m=radius_m)
        return made

    def label(self, led: int) -> str:
        """What the table calls an LED."""
        return next(entry.label for entry in self.entries if entry.id == led)


def mirror_signs(mirror: Mirror) -> Floats:
    """Factors (3,) from the table's axes to right-handed ones, and back."""
    return np.array({"none": (1.0, 1.0, 1.0), "x": (-1.0, 1.0, 1.0), "y": (1.0, -1.0, 1.0)}[mirror])


def read_led_table(path: Path, units: str | None = None) -> LedTable:
    """Read an LED map.

    Parameters
    ----------
    path
        CSV with a header, or JSON: a list of objects, or an object with the list as `leds` and the unit as `units`.
        Each LED has `x`, `y`, `z` (or `position`, a list); `id`, `frequency_hz`, `radius`, `side` and `shape` are
        optional. Of several LEDs with one frequency, the geometry decides.
    units
        Unit of lengths: "m", "cm", "mm", "in" or "ft"; overrides a `units` of the file, but not units in the names of
        its columns (`x_cm`), which have to agree. Default: the file's, or metres.

    Raises
    ------
    InputError
        The file is missing or no such table; the message names the row and the column.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file in UTF-8") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    stated, rows = _json_rows(path, text) if path.suffix.lower() == ".json" else (None, _csv_rows(path, text))
    named = _named_unit(path, rows)
    if named and units and named != units:
        raise InputError(f"{path}: the columns are in {named}, but --units says {units}")
    unit = units or named or stated or "m"
    if unit not in UNITS_M:
        raise InputError(f"{path}: units {unit!r}; allowed: {', '.join(UNITS_M)}")
    if not rows:
        raise InputError(f"{path}: no LED")
    if len(rows) > MAX_LEDS:
        raise InputError(f"{path}: {len(rows)} LEDs, at most {MAX_LEDS} are allowed")
    entries = [_entry(f"{path}: LED {number}", number, row) for number, row in enumerate(rows)]
    for entry in entries:
        if max(map(abs, entry.position)) * UNITS_M[unit] > MAX_COORDINATE_M:
            raise InputError(f"{path}: LED {entry.label}: beyond {MAX_COORDINATE_M:g} m of the origin")
    labels = [entry.label for entry in entries]
    if twice := {label for label in labels if labels.count(label) > 1}:
        raise InputError(f"{path}: id {min(twice)} is there twice; ids have to be unique")
    return LedTable(tuple(entries), unit)


def _json_rows(path: Path, text: str) -> tuple[str | None, list[Mapping[str, Any]]]:
    try:
        content = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({str(error).splitlines()[0]})") from None
    stated = None
    if isinstance(content, dict):
        stated = content.get("units")
        content = content.get("leds", {key: value for key, value in content.items() if key != "units"})
    if isinstance(content, dict):
        # LEDs by name: objects, or positions alone.
        content = [{"id": k, **(v if isinstance(v, dict) else {"position": v})} for k, v in content.items()]
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise InputError(f"{path}: needed a list of LEDs, or an object with one as leds")
    rows: list[Mapping[str, Any]] = []
    for row in content:
        places = [value for key, value in row.items() if _bare(key) in NAMES["position"] and isinstance(value, list)]
        axes = dict(zip("xyz", places[0], strict=False)) if places else {}
        rows.append({**row, **axes})
    return stated if isinstance(stated, str) else None, rows


def _csv_rows(path: Path, text: str) -> list[Mapping[str, Any]]:
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    try:
        dialect: Any = csv.Sniffer().sniff("\n".join(lines[:5]), delimiters=",;\t ")
    except csv.Error:
        dialect = csv.excel
    try:
        return [{key: value for key, value in row.items() if key} for row in csv.DictReader(lines, dialect=dialect)]
    except csv.Error as error:
        raise InputError(f"{path}: not CSV ({error})") from None


def _entry(where: str, number: int, row: Mapping[str, Any]) -> LedEntry:
    found = {}
    for name, allowed in NAMES.items():
        keys = [key for key in row if isinstance(key, str) and _bare(key) in allowed]
        if len(keys) > 1:
            raise InputError(f"{where}: {' and '.join(keys)} are the same; give one")
        if keys and row[keys[0]] not in (None, ""):
            found[name] = row[keys[0]]
    if missing := [axis for axis in "xyz" if axis not in found]:
        raise InputError(f"{where}: no {missing[0]}; needed x, y, z; columns: {', '.join(map(str, row))}")
    x, y, z = (_number(where, axis, found[axis]) for axis in "xyz")
    shape = str(found.get("shape", "square" if "side" in found else "disc")).strip().lower()
    if shape not in ("disc", "square"):
        raise InputError(f"{where}: shape {shape!r}; allowed: disc, square")
    sizes = {name: _positive(where, name, found[name]) for name in ("radius", "side", "frequency_hz") if name in found}
    if shape == "disc" and "side" in sizes:
        raise InputError(f"{where}: a disc has a radius, not a side")
    if shape == "square" and "side" not in sizes:
        raise InputError(f"{where}: a square needs its side")
    label = str(found.get("id", sizes.get("frequency_hz", number))).strip()
    if label.endswith(".0"):
        label = label[:-2]
    return LedEntry(
        number,
        label,
        (x, y, z),
        sizes.get("frequency_hz"),
        sizes.get("radius") if shape == "disc" else None,
        sizes.get("side"),
    )


def _bare(key: str) -> str:
    """A column's name in lower case without a unit: `X (cm)` and `x_cm` are x."""
    name = key.strip().lower()
    for bracket in "([":
        name = name.partition(bracket)[0].strip()
    if name not in NAMES["frequency_hz"]:
        for unit in (*UNITS_M, "hz"):
            name = name.removesuffix(f"_{unit}")
    return name


def _named_unit(path: Path, rows: Sequence[Mapping[str, Any]]) -> str | None:
    """The unit that the names of the columns of lengths state; None if they state none."""
    lengths = [name for key in ("x", "y", "z", "radius", "side", "position") for name in NAMES[key]]
    found = {
        unit
        for row in rows
        for key in row
        if isinstance(key, str) and _bare(key) in lengths
        for unit in UNITS_M
        if key.strip().lower().endswith((f"_{unit}", f"({unit})", f"[{unit}]"))
    }
    if len(found) > 1:
        raise InputError(f"{path}: columns in {' and '.join(sorted(found))}; needed one unit")
    return next(iter(found), None)


def _number(where: str, name: str, given: Any) -> float:
    try:
        number = float(given) if not isinstance(given, bool) else np.nan
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        raise InputError(f"{where}: {name} {given!r} is not a number")
    return number


def _positive(where: str, name: str, given: Any) -> float:
    number = _number(where, name, given)
    if not number > 0:
        raise InputError(f"{where}: {name} {number:g} has to be more than 0")
    return number


def read_spots(path: Path, table: LedTable) -> list[tuple[int, float, float]]:
    """Spots by hand: `led`, `u_px`, `v_px` (or u, v) of each, in CSV or JSON; raises InputError."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or 'not a text file in UTF-8'}") from None
    rows: Sequence[Mapping[str, Any]]
    if path.suffix.lower() == ".json":
        try:
            content = json.loads(text)
        except (json.JSONDecodeError, RecursionError) as error:
            raise InputError(f"{path}: not JSON ({str(error).splitlines()[0]})") from None
        rows = content if isinstance(content, list) and all(isinstance(row, dict) for row in content) else []
    else:
        rows = _csv_rows(path, text)
    known = {entry.label: entry.id for entry in table.entries}
    spots = []
    for number, row in enumerate(rows):
        where = f"{path}: spot {number}"
        led = next((row[key] for key in ("led", "id", "name", "label") if key in row), None)
        label = str(led).strip()
        label = label[:-2] if label.endswith(".0") else label
        if label not in known:
            raise InputError(f"{where}: LED {led!r} is not in the map; allowed: {', '.join(known)}")
        u, v = (next((row[key] for key in (f"{axis}_px", axis) if key in row), None) for axis in "uv")
        spots.append((known[label], _number(where, "u_px", u), _number(where, "v_px", v)))
    if not spots:
        raise InputError(f"{path}: no spots; needed led, u_px, v_px of each")
    if len({led for led, *_ in spots}) != len(spots):
        raise InputError(f"{path}: an LED is there twice")
    return spots
