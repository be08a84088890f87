"""Sweeps of a recipe: values of its keys, and the cells that they make, each of which is a dataset of its own.

Several sweeps make their product. With `uniform` a value is drawn for each pose, and each pose is a cell.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from vlcrender.config.toml_model import Settings, key_error, toml_text
from vlcrender.core.random_keys import stream
from vlcrender.errors import InputError

MAX_CELLS = 100_000
"""Largest number of cells of a sweep."""
POSE_RANGE = "pose_range"
"""The recipe's key that makes a cell of one pose."""

SWEEP_FILE = "sweep.json"
"""File of a sweep's folder that lists the cells."""
SWEEP_FORMAT = "vlcrender-sweep"
SWEEP_VERSION = 1
"""`version` of sweep.json."""

Value = float | str
"""A cell's value as the truth has it."""
Key = Annotated[str, Field(min_length=1, max_length=200)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_]{1,100}$")]
Number = int | float


class SweepTable(Settings):
    """Values of one key of the recipe or scene, or of several keys that change together. Give exactly one of `values`,
    `grid` and `uniform`.
    """

    key: Key | Annotated[tuple[Key, ...], Field(min_length=2)]
    """Dotted key of the recipe, or `scene.` and a dotted key of the scene file. An item of a list has its number,
    counted from 0, or its `name`. A list of keys: they change together, and each of `values` is a list of as many."""
    values: Annotated[tuple[Any, ...], Field(min_length=1)] | None = None
    """The values, in order."""
    grid: tuple[Number, Number, Annotated[int, Field(ge=2, le=MAX_CELLS)]] | None = None
    """[first, last, count]: equally spaced values, both ends included; integers where both ends and the step are."""
    uniform: tuple[float, float] | None = None
    """[lowest, highest]: a value drawn for each pose, the same whatever else is swept. Each pose is then a cell."""
    name: Name | Annotated[tuple[Name, ...], Field(min_length=2)] | None = None
    """Name of the column in the truth; a list where `key` is one. The last word of each key where not given."""

    @model_validator(mode="after")
    def _one_way_to_give_values(self) -> Self:
        given = [way for way in ("values", "grid", "uniform") if getattr(self, way) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise key_error("key", f"{self.key!r}: give exactly one of values, grid and uniform; found {found}")
        if isinstance(self.key, tuple) and self.values is None:
            raise key_error("key", f"{', '.join(self.key)}: keys that change together have values, not {given[0]}")
        return self

    @model_validator(mode="after")
    def _rows_are_as_wide_as_keys(self) -> Self:
        if isinstance(self.key, tuple):
            for value in self.values or ():
                if not isinstance(value, list) or len(value) != len(self.key):
                    raise key_error(
                        "values", f"{value!r} of {', '.join(self.key)}: has to be a list of {len(self.key)} values"
                    )
        many = len(self.name) if isinstance(self.name, tuple) else 1
        if self.name is not None and many != len(self.keys):
            raise key_error("name", f"gives {many} of {len(self.keys)} names, one for each key")
        return self

    @model_validator(mode="after")
    def _ranges_go_up(self) -> Self:
        if self.uniform is not None and self.uniform[0] > self.uniform[1]:
            raise key_error("uniform", f"{list(self.uniform)} of {self.key}: the lower value comes first")
        return self

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys, without spaces about their words."""
        keys = self.key if isinstance(self.key, tuple) else (self.key,)
        return tuple(".".join(word.strip() for word in key.split(".")) for key in keys)

    @property
    def names(self) -> tuple[str, ...]:
        """The name of each key's column."""
        if self.name is None:
            return tuple(key.rpartition(".")[2] for key in self.keys)
        return self.name if isinstance(self.name, tuple) else (self.name,)

    @property
    def kind(self) -> Literal["values", "grid", "uniform"]:
        """How the values are given."""
        return "uniform" if self.uniform is not None else "grid" if self.grid is not None else "values"

    @property
    def count(self) -> int:
        """Number of values; 1 where each pose has its own."""
        if self.grid is not None:
            return self.grid[2]
        return 1 if self.values is None else len(self.values)

    def row(self, number: int, seed: int, pose: int | None) -> tuple[Any, ...]:
        """The values of the keys, in order, for value number `number`; `seed` and `pose` of a uniform value."""
        if self.uniform is not None:
            low, high = self.uniform
            share = float(stream(seed, pose or 0, f"sweep {self.keys[0]}").uniform())
            return (low + (high - low) * share,)
        if self.grid is not None:
            return (_grid_value(*self.grid, number),)
        assert self.values is not None  # _one_way_to_give_values
        value = self.values[number]
        return tuple(value) if isinstance(self.key, tuple) and isinstance(value, list) else (value,)

    @cached_property
    def numeric(self) -> tuple[bool, ...]:
        """Whether all values of each key are numbers."""
        if self.values is None:
            return (True,)
        rows = [self.row(number, 0, None) for number in range(self.count)]
        return tuple(all(_is_number(value) for value in column) for column in zip(*rows, strict=True))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _grid_value(first: Number, last: Number, count: int, number: int) -> Number:
    if isinstance(first, int) and isinstance(last, int) and (last - first) % (count - 1) == 0:
        return first + (last - first) // (count - 1) * number
    return float(last) if number == count - 1 else first + (last - first) * number / (count - 1)


class SweepTables(Settings):
    """The `[[sweep]]` tables of a recipe file."""

    sweep: tuple[SweepTable, ...]
    """The sweeps."""

    @model_validator(mode="after")
    def _keys_and_names_differ(self) -> Self:
        keys = [key for table in self.sweep for key in table.keys]
        for key in keys:
            # A scene's file and its keys are apart: both may be swept.
            twins = [other for other in keys if other == key or (key != "scene" and other.startswith(f"{key}."))]
            if len(twins) > 1:
                both = f"{key} twice" if twins.count(key) > 1 else " and ".join(sorted(twins))
                raise key_error("sweep", f"sweeps {both}: give each key one sweep")
        names = Counter(name for table in self.sweep for name in table.names)
        for name, times in names.items():
            if times > 1:
                of = " and ".join(
                    key for t in self.sweep for key, own in zip(t.keys, t.names, strict=True) if own == name
                )
                raise key_error("sweep", f"{of} are both named {name!r}: give them different names")
        return self


@dataclass(frozen=True)
class Cell:
    """One cell of a sweep."""

    number: int
    pose: int | None
    """Its pose, as numbered in the recipe, where each pose is a cell; else None."""
    values: Mapping[str, Value]
    """The value of each name, as the truth has it."""
    assignments: tuple[str, ...]
    """The values as `key=value` texts."""

    @property
    def folder(self) -> str:
        """Path below the sweep's folder."""
        return f"cells/{self.number:06d}"

    def __str__(self) -> str:
        """The cell in a message: its number and values, such as "sweep cell 3 (iso = 200)"."""
        values = ", ".join(f"{name} = {value}" for name, value in self.values.items())
        return f"sweep cell {self.number} ({values})"


@dataclass(frozen=True)
class Sweep:
    """The cells of a recipe's sweeps, in order: the last sweep varies fastest, and poses faster still."""

    tables: tuple[SweepTable, ...]
    seed: int
    """Seed of values drawn for each pose: the recipe's."""
    poses: range | None
    """Numbers of the recipe's poses where each is a cell; else None."""

    def __post_init__(self) -> None:
        """Raise InputError where there are too many cells."""
        if len(self) > MAX_CELLS:
            factors = [str(table.count) for table in self.tables if table.uniform is None]
            factors += [] if self.poses is None else [f"{len(self.poses)} poses"]
            raise InputError(
                f"sweep: {' x '.join(factors)} = {len(self)} cells of {', '.join(self.names)}; at most {MAX_CELLS} are "
                "allowed"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all columns."""
        return tuple(name for table in self.tables for name in table.names)

    def entries(self) -> list[dict[str, str]]:
        """What sweep.json says of the swept keys."""
        return [
            {"name": name, "key": key, "kind": table.kind}
            for table in self.tables
            for name, key in zip(table.names, table.keys, strict=True)
        ]

    @property
    def combinations(self) -> int:
        """Number of combinations of the values that are not drawn."""
        return math.prod(table.count for table in self.tables)

    def __len__(self) -> int:
        """Number of cells."""
        return self.combinations * (1 if self.poses is None else len(self.poses))

    def __iter__(self) -> Iterator[Cell]:
        """All cells, made one by one."""
        return (self.cell(number) for number in range(len(self)))

    def cell(self, number: int) -> Cell:
        """The cell of a number."""
        rest, pose = number, None
        if self.poses is not None:
            rest, place = divmod(number, len(self.poses))
            pose = self.poses[place]
        values: dict[str, Value] = {}
        assignments: list[str] = []
        for table in reversed(self.tables):
            rest, own = divmod(rest, table.count)
            row = table.row(own, self.seed, pose)
            texts = [toml_text(value, key) for key, value in zip(table.keys, row, strict=True)]
            assignments[:0] = [f"{key}={text}" for key, text in zip(table.keys, texts, strict=True)]
            shown = [
                float(value) if numeric else value if isinstance(value, str) else text
                for value, text, numeric in zip(row, texts, table.numeric, strict=True)
            ]
            values = {**dict(zip(table.names, shown, strict=True)), **values}
        if pose is not None:
            assignments.append(f"{POSE_RANGE}=[{pose}, {pose}]")
        return Cell(number, pose, values, tuple(assignments))


class SweptKey(Settings):
    """A swept key in sweep.json."""

    name: Name
    key: Key
    kind: Literal["values", "grid", "uniform"]


class CellEntry(Settings):
    """A cell in sweep.json."""

    folder: Annotated[str, Field(pattern=r"^cells/[0-9]{6}$")]
    pose: int | None
    values: dict[str, Value]


class SweepFile(Settings):
    """sweep.json."""

    format: Literal["vlcrender-sweep"]
    version: Literal[1]
    name: str
    sweep: tuple[SweptKey, ...]
    cells: tuple[CellEntry, ...]
    provenance: dict[str, Any]
    seal: str | None = None
    """SHA-256 of this file's content without the seal, see manifest.py."""


def sweep_tree(name: str, sweep: Sweep) -> dict[str, Any]:
    """sweep.json of a recipe's cells, without its provenance."""
    return {
        "format": SWEEP_FORMAT,
        "version": SWEEP_VERSION,
        "name": name,
        "sweep": sweep.entries(),
        "cells": [{"folder": cell.folder, "pose": cell.pose, "values": dict(cell.values)} for cell in sweep],
    }


def sweep_columns(values: Mapping[str, Value]) -> dict[str, Value]:
    """The columns of a cell's truth.parquet that hold its values, by name."""
    return {f"sweep_{name}": value for name, value in values.items()}
