"""Parquet tables of row models: written whole or not at all, read back row by row."""

from collections.abc import Iterable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import ValidationError

from vlcrender.config.toml_model import Settings
from vlcrender.dataset.format.files import first_line, whole_file
from vlcrender.dataset.format.rows import arrow_schema
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

    The columns may be in any order and of any type that `holds` the values; other columns are ignored. Raises
    InputError where the file is missing or no Parquet, or its columns or cells differ from the model's or from
    `constants`.
    """
    constants = constants or {}
    if not path.is_file():
        raise InputError(f"{path}: is missing")
    try:
        table = pq.read_table(path)
        there = set(table.schema.names)  # decodes them
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as Parquet: {first_line(str(error))}") from None
    schema = _schema(model, constants)
    optional = {name for name, field in model.model_fields.items() if not field.is_required()}
    different = []
    for field in schema:
        found = table.schema.get_all_field_indices(field.name)
        if len(found) > 1 or (not found and field.name not in optional):
            different.append(f"{field.name}: {len(found)} times, needed once")
        elif found:
            kind = table.schema.field(found[0]).type
            # pandas has floats for integers where a column has nulls; the model demands whole ones.
            is_real = pa.types.is_integer(field.type) and pa.types.is_floating(kind)
            if not (is_real or holds(kind, field.type)):
                different.append(f"{field.name}: {kind}, needed {field.type}")
    if different:
        raise InputError(f"{path}: columns differ from FORMAT.md: {', '.join(different)}")
    names = [field.name for field in schema if field.name in there]
    try:
        all_cells = table.select(names).to_pylist()
    except (pa.ArrowException, ValueError) as error:  # a text that is no UTF-8, for one
        raise InputError(f"{path}: cannot be read as Parquet: {first_line(str(error))}") from None
    rows: list[R] = []
    for number, cells in enumerate(all_cells):
        row = {name: _known(cell, schema.field(name).type) for name, cell in cells.items()}
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


def holds(found: pa.DataType, wanted: pa.DataType) -> bool:
    """Whether an Arrow type can hold the values of a wanted one, by check 2 of FORMAT.md.

    Programs spell one type differently: integers and floats of any width, large strings, dictionaries, lists of any
    layout, and the null type for a column of nulls.
    """
    if pa.types.is_dictionary(found):
        found = found.value_type
    if pa.types.is_null(found):
        return True
    if pa.types.is_struct(wanted):
        if not pa.types.is_struct(found):
            return False
        of = {field.name: field.type for field in found}
        return all(field.name in of and holds(of[field.name], field.type) for field in wanted)
    if pa.types.is_list(wanted) or pa.types.is_fixed_size_list(wanted):
        is_list = pa.types.is_list(found) or pa.types.is_large_list(found) or pa.types.is_fixed_size_list(found)
        return is_list and holds(found.value_type, wanted.value_type)
    if pa.types.is_string(wanted):
        return bool(pa.types.is_string(found) or pa.types.is_large_string(found) or pa.types.is_string_view(found))
    if pa.types.is_integer(wanted):
        return bool(pa.types.is_integer(found))
    if pa.types.is_floating(wanted):
        return bool(pa.types.is_floating(found) or pa.types.is_integer(found))
    return bool(found == wanted)


def _known(cell: Any, kind: pa.DataType) -> Any:
    """A cell without the fields of structs that FORMAT.md does not know."""
    if pa.types.is_struct(kind) and isinstance(cell, dict):
        return {field.name: _known(cell[field.name], field.type) for field in kind if field.name in cell}
    if (pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind)) and isinstance(cell, list):
        return [_known(item, kind.value_type) for item in cell] if pa.types.is_struct(kind.value_type) else cell
    return cell
