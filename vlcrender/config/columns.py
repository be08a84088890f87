"""Tables of measured values, CSV or JSON: columns by their names, with units, and refusals that name line and column.

A unit stands at the end of a column's name, `x_cm`, `x (cm)` or `x [cm]`. A JSON file has a list of objects, or an
object with the list and with `units`, the unit of lengths whose names have none.
"""

import csv
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlcrender.errors import InputError

LENGTH = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
ANGLE = {"deg": 1.0, "rad": 180 / math.pi}
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
MAX_BYTES = 50_000_000


@dataclass(frozen=True)
class Column:
    """A column: other names of it, and its units with the factor of each to the unit of the results."""

    also: tuple[str, ...] = ()
    units: Mapping[str, float] | None = None
    """Factors by unit; None for a column without a unit."""
    is_text: bool = False


@dataclass(frozen=True)
class Row:
    """A row of a table: where it stands, as messages say it, and its cells by the names of columns."""

    where: str
    cells: Mapping[str, float | str]

    def number(self, name: str) -> float | None:
        """The number in a cell, in the unit of the results; None where the row has none."""
        value = self.cells.get(name)
        return None if value is None else float(value)


def read_text(path: Path) -> str:
    """A text file. Raises InputError for a file that is missing, not UTF-8 or larger than MAX_BYTES."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: has more than {MAX_BYTES} bytes")
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def read_columns(path: Path, columns: Mapping[str, Column], units: str | None, list_key: str) -> list[Row]:
    """The rows of a CSV or JSON file.

    columns: all columns that there may be; those whose name starts with "_" are left out, any other is refused. units:
    unit of lengths without a unit in their name; it overrides the file's. list_key: key of the list in a JSON object.
    Cells that are empty are left out. Raises InputError that starts with path, line and column.
    """
    text = read_text(path)
    if path.suffix.lower() == ".json":
        stated, rows = _of_json(path, text, list_key)
        units = units or stated
    else:
        rows = _of_csv(path, text)
    if units is not None and units not in LENGTH:
        raise InputError(f"{path}: units = {units!r}: allowed are {', '.join(LENGTH)}")
    meanings: dict[str, tuple[str, Column, float] | None] = {}
    found = []
    for where, cells in rows:
        values: dict[str, float | str] = {}
        for heading, cell in cells.items():
            if heading not in meanings:
                meanings[heading] = _meaning(where, heading, columns, units)
            meaning = meanings[heading]
            if meaning is None or cell is None or cell == "":
                continue
            name, column, factor = meaning
            if name in values:
                raise InputError(f"{where}: column {heading!r}: another column says {name} already")
            values[name] = str(cell).strip() if column.is_text else _number(where, heading, cell) * factor
        found.append(Row(where, values))
    return found


def _of_csv(path: Path, text: str) -> list[tuple[str, Mapping[str, Any]]]:
    lines = ["" if line.lstrip().startswith("#") else line for line in text.splitlines()]
    first = next((line for line in lines if line.strip()), "")
    reader = csv.reader(lines, delimiter=max(",;\t", key=first.count), skipinitialspace=True)
    headings: list[str] | None = None
    rows: list[tuple[str, Mapping[str, Any]]] = []
    try:
        for row in reader:
            where = f"{path}: line {reader.line_num}"
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            if headings is None:
                headings = cells
                if twice := [name for name in cells if cells.count(name) > 1]:
                    raise InputError(f"{where}: column {twice[0]!r} is there twice")
                continue
            if len(cells) != len(headings):
                raise InputError(f"{where}: {len(cells)} cells; the header has {len(headings)} columns")
            rows.append((where, dict(zip(headings, cells, strict=True))))
    except csv.Error as error:
        raise InputError(f"{path}: line {reader.line_num}: is not CSV: {error}") from None
    return rows


def _of_json(path: Path, text: str, list_key: str) -> tuple[str | None, list[tuple[str, Mapping[str, Any]]]]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON: {error}") from None
    stated = None
    if isinstance(content, dict):
        if unknown := sorted(set(content) - {"units", list_key}):
            raise InputError(f"{path}: unknown key {unknown[0]!r}; allowed: {list_key}, units")
        stated, content = content.get("units"), content.get(list_key)
    if not (stated is None or isinstance(stated, str)):
        raise InputError(f"{path}: units = {json.dumps(stated)}: allowed are {', '.join(LENGTH)}")
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise InputError(f"{path}: has to be a list of objects, or an object with the list as {list_key!r}")
    return stated, [(f"{path}: {list_key}[{number}]", row) for number, row in enumerate(content)]


def _meaning(
    where: str, heading: str, columns: Mapping[str, Column], units: str | None
) -> tuple[str, Column, float] | None:
    """The column that a heading names, and the factor of its unit; None for a column that is left out."""
    if heading.startswith("_"):
        return None
    for name, column in columns.items():
        for base in (name, *column.also):
            unit = _unit_behind(base, heading)
            if unit is None:
                continue
            if column.units is None:
                if unit:
                    continue
                return name, column, 1.0
            if not unit and column.units is LENGTH and units is not None:
                unit = units
            if not unit:
                named = " or ".join(f"{base}_{unit}" for unit in column.units)
                more = f", or give units ({', '.join(LENGTH)})" if column.units is LENGTH else ""
                raise InputError(f"{where}: column {heading!r} has no unit: name it {named}{more}")
            if unit not in column.units:
                raise InputError(f"{where}: column {heading!r}: unit {unit!r} is not one of {', '.join(column.units)}")
            return name, column, column.units[unit]
    allowed = ", ".join(_shown(name, column) for name, column in columns.items())
    raise InputError(f"{where}: unknown column {heading!r}; allowed: {allowed}, and names that start with _")


def _shown(name: str, column: Column) -> str:
    return name if column.units is None else f"{name}_{'|'.join(unit for unit in column.units if '/' not in unit)}"


def _unit_behind(base: str, heading: str) -> str | None:
    """The unit of a heading that is `base` with a unit, "" for one without, None for another heading."""
    rest = heading.strip().lower()
    if not rest.startswith(base):
        return None
    rest = rest[len(base) :]
    if rest.startswith("_"):
        return rest[1:] or None
    rest = rest.strip()
    if rest and (rest[0], rest[-1]) not in (("(", ")"), ("[", "]")):
        return None
    return rest[1:-1].strip()


def _number(where: str, heading: str, cell: Any) -> float:
    try:
        number = float(cell) if isinstance(cell, str | int | float) and not isinstance(cell, bool) else math.nan
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        shown = repr(cell) if len(repr(cell)) <= 40 else repr(cell)[:37] + "..."
        raise InputError(f"{where}: column {heading!r}: {shown} is not a finite number")
    return number
