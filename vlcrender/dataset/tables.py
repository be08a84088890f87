"""Parquet tables of row models: written whole or not at all, read back row by row."""

from collections.abc import Iterable, Mapping
from itertools import islice
from pathlib import Path
from typing import TypeVar

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import ValidationError

from vlcrender.config.toml_model import Settings
from vlcrender.dataset.files import first_line, whole_file
from vlcrender.dataset.schema import arrow_schema
from vlcrender.errors import InputError

R = TypeVar("R", bound=Settings)

ROWS_AT_ONCE = 1000
"""Rows of a row group: bounds the memory of writing a table."""


Constants = Mapping[str, float | str]
"""Columns with the same value in each row, after those of the model."""


def write_table(path: Path, rows: Iterable[R], model: type[R], constants: Constants | None = None) -> None:
    """Write rows as a Parquet table; it appears whole or not at all. Raises InputError where it cannot be written."""
    constants = constants or {}
    schema, remaining = _schema(model, constants), iter(rows)
    with whole_file(path) as partial, pq.ParquetWriter(partial, schema) as writer:
        while group := [{**row.model_dump(), **constants} for row in islice(remaining, ROWS_AT_ONCE)]:
            writer.write_table(pa.Table.from_pylist(group, schema=schema))


def _schema(model: type[Settings], constants: Constants) -> pa.Schema:
    types = {str: pa.string(), float: pa.float64()}
    return pa.schema([*arrow_schema(model), *((name, types[type(value)]) for name, value in constants.items())])


def read_table(path: Path, model: type[R], constants: Constants | None = None) -> list[R]:
    """Read a Parquet table of rows of this model.

    Raises InputError where the file is missing or no Parquet, or its columns or cells differ from the model's or from
    `constants`.
    """
    constants = constants or {}
    if not path.is_file():
        raise InputError(f"{path}: is missing")
    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as Parquet: {first_line(str(error))}") from None
    schema = _schema(model, constants)
    if not table.schema.equals(schema):
        # Arrow's own equality: a file names the items of its lists otherwise.
        only = [f"{field.name}: {field.type}" for field in schema if not any(map(field.equals, table.schema))]
        only += [f"{field.name}: {field.type}" for field in table.schema if not any(map(field.equals, schema))]
        difference = ", ".join(sorted(only)) or "their order"
        raise InputError(f"{path}: columns differ from FORMAT.md: {difference}")
    rows: list[R] = []
    for number, row in enumerate(table.to_pylist()):
        for name, value in constants.items():
            if (found := row.pop(name)) != value:
                raise InputError(f"{path}: row {number}: {name} is {found!r}; the dataset's is {value!r}")
        try:
            rows.append(model.model_validate(row))
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            cell = ".".join(map(str, problem["loc"]))
            state = "is empty" if problem["input"] is None else first_line(problem["msg"])
            raise InputError(f"{path}: row {number}: {cell}: {state}") from None
    return rows
