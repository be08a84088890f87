"""Parquet tables of row models: written whole or not at all, read back row by row."""

from collections.abc import Iterable
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


def write_table(path: Path, rows: Iterable[R], model: type[R]) -> None:
    """Write rows as a Parquet table; it appears whole or not at all. Raises InputError where it cannot be written."""
    schema, remaining = arrow_schema(model), iter(rows)
    with whole_file(path) as partial, pq.ParquetWriter(partial, schema) as writer:
        while group := [row.model_dump() for row in islice(remaining, ROWS_AT_ONCE)]:
            writer.write_table(pa.Table.from_pylist(group, schema=schema))


def read_table(path: Path, model: type[R]) -> list[R]:
    """Read a Parquet table of rows of this model.

    Raises InputError where the file is missing or no Parquet, or its columns or cells differ from the model's.
    """
    if not path.is_file():
        raise InputError(f"{path}: is missing")
    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as Parquet: {first_line(str(error))}") from None
    schema = arrow_schema(model)
    if not table.schema.equals(schema):
        # Arrow's own equality: a file names the items of its lists otherwise.
        only = [f"{field.name}: {field.type}" for field in schema if not any(map(field.equals, table.schema))]
        only += [f"{field.name}: {field.type}" for field in table.schema if not any(map(field.equals, schema))]
        difference = ", ".join(sorted(only)) or "their order"
        raise InputError(f"{path}: columns differ from FORMAT.md: {difference}")
    rows: list[R] = []
    for number, row in enumerate(table.to_pylist()):
        try:
            rows.append(model.model_validate(row))
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            cell = ".".join(map(str, problem["loc"]))
            state = "is empty" if problem["input"] is None else first_line(problem["msg"])
            raise InputError(f"{path}: row {number}: {cell}: {state}") from None
    return rows
