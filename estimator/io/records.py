"""Parquet files as validated rows, and one-line messages about invalid ones."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, TypeVar, cast, dataclass_transform

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, ValidationError
from pydantic.dataclasses import dataclass

from estimator.errors import InputError

R = TypeVar("R")
T = TypeVar("T")


class Row(BaseModel):
    """Validated, immutable record: types are strict (no "1" for 1), and no number is NaN or infinite."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False, extra="ignore")


class FrameRow(Row):
    """Row of a table with a row for each frame."""

    frame: int = Field(ge=0)


class Entry(Row):
    """Record of dataset.json: it has exactly its own keys, for a reader must not skip what changes the meaning."""

    model_config = ConfigDict(extra="forbid")


@dataclass_transform(kw_only_default=True, frozen_default=True)
def small_row(record: type[T]) -> type[T]:
    """Decorator of a record like Row of which a frame has dozens: it takes a fifth of the memory.

    The types of its fields have to be strict by themselves.
    """
    config = ConfigDict(strict=False, allow_inf_nan=False, extra="ignore")
    return cast("type[T]", dataclass(frozen=True, slots=True, kw_only=True, config=config)(record))


INT64_MAX = 2**63 - 1
LedId = Annotated[int, Field(ge=0, le=INT64_MAX), Strict()]
# The square of a number must not overflow.
MAX_NUMBER = 1e100
Number = Annotated[float, Field(ge=-MAX_NUMBER, le=MAX_NUMBER), Strict()]
Positive = Annotated[float, Field(gt=0, le=MAX_NUMBER)]
NotNegative = Annotated[float, Field(ge=0, le=MAX_NUMBER)]
Share = Annotated[float, Field(ge=0, le=1)]
Size = Annotated[float, Field(ge=0), Strict()]
"""Computed, and so allowed to exceed MAX_NUMBER."""
# Arrow returns lists: convert the container, keep the numbers strict.
Triple = Annotated[tuple[Number, Number, Number], Strict(False)]
NotNegativeTriple = Annotated[tuple[NotNegative, NotNegative, NotNegative], Strict(False)]

MAX_ROTATION_ERROR = 1e-9


def is_rotation(values: object) -> bool:
    """Whether nine numbers, row by row or as three rows, are a rotation matrix, to 1e-9 in each entry of R R^T."""
    matrix = np.reshape(np.asarray(values, dtype=np.float64), (3, 3))
    # Also false for NaN.
    near = np.abs(matrix @ matrix.T - np.eye(3)).max() <= MAX_ROTATION_ERROR
    return bool(near and np.linalg.det(matrix) > 0)


def _check_rotation(values: R) -> R:
    if not is_rotation(values):
        raise ValueError("has to be a rotation matrix (orthonormal to 1e-9, determinant +1)")
    return values


Rotation = Annotated[tuple[Triple, Triple, Triple], AfterValidator(_check_rotation)]
"""Three rows."""
FlatRotation = Annotated[
    tuple[Number, ...], Strict(False), Field(min_length=9, max_length=9), AfterValidator(_check_rotation)
]
"""Row by row."""

MIN_VARIANCE = 1e-60
"""Smaller variances would overflow in e^T C^-1 e."""
MAX_ASYMMETRY = 1e-6
MIN_EIGENVALUE = 1e-14
"""Of the correlation matrix: with a smaller one, its inverse keeps less than two digits in double precision."""
CLEAR_DETERMINANT = 1e-9
"""Of the correlation matrix: far above MIN_EIGENVALUE and the determinant's rounding."""


def is_covariance(values: Sequence[float]) -> bool:
    """Whether nine finite numbers, row by row, are a symmetric, positive definite 3 x 3 matrix."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = numbers = [float(value) for value in values]
    # Also false for NaN.
    if not all(abs(number) <= MAX_NUMBER for number in numbers):
        return False
    if not (xx >= MIN_VARIANCE and yy >= MIN_VARIANCE and zz >= MIN_VARIANCE):
        return False
    x, y, z = math.sqrt(xx), math.sqrt(yy), math.sqrt(zz)
    of_yx, of_zx, of_zy = yx / (x * y), zx / (x * z), zy / (y * z)
    if max(abs(of_yx - xy / (x * y)), abs(of_zx - xz / (x * z)), abs(of_zy - yz / (y * z))) > MAX_ASYMMETRY:
        return False
    # The eigenvalues' sum is 3. If all are positive, two of them have a product of 2.25 at most, which leaves the third
    # the determinant over 2.25.
    minor = 1 - of_yx * of_yx
    determinant = minor - of_zx * of_zx - of_zy * of_zy + 2 * of_yx * of_zx * of_zy
    if minor > 0 and determinant > CLEAR_DETERMINANT:
        return True
    correlations = np.array([[1.0, of_yx, of_zx], [of_yx, 1.0, of_zy], [of_zx, of_zy, 1.0]])
    return bool(np.linalg.eigvalsh(correlations).min() >= MIN_EIGENVALUE)


def _check_covariance(values: tuple[float, ...]) -> tuple[float, ...]:
    if not is_covariance(values):
        raise ValueError("has to be a symmetric, positive definite 3 x 3 matrix, row by row")
    return values


Covariance = Annotated[
    tuple[Number, ...], Strict(False), Field(min_length=9, max_length=9), AfterValidator(_check_covariance)
]

UNION_TAGS = ("disc", "square", "code", "tone", "packet")

RowT = TypeVar("RowT", bound=Row)
FrameRowT = TypeVar("FrameRowT", bound=FrameRow)
ROWS_AT_ONCE = 256
BUFFER_BYTES = 2**16
"""Bytes of a column that are read of a Parquet file at once."""


def first_problem(error: ValidationError) -> str:
    """First of pydantic's errors on one line: `where: what is allowed (got value)`."""
    problem = error.errors(include_url=False)[0]
    # pydantic adds the tag of a tagged union, which is no key.
    where = ".".join(str(part) for part in problem["loc"] if part not in UNION_TAGS) or "the document"
    value = repr(problem["input"])
    value = value if len(value) <= 60 else value[:57] + "..."
    got = "" if problem["type"] in ("missing", "json_invalid") else f" (got {value})"
    return f"{where}: {problem['msg']}{got}"


def missing_key(value: object) -> str | None:
    """First key, as `where.key`, that has a default and that a validated value was made without; None if there is none.

    The value is a row, or a list, tuple or mapping with rows in it at any depth.
    """
    entries: Iterable[tuple[object, object]] = ()
    if isinstance(value, Row):
        for name in type(value).model_fields:
            if name not in value.model_fields_set:
                return name
        entries = vars(value).items()
    elif isinstance(value, Mapping):
        entries = value.items()
    elif isinstance(value, list | tuple):
        entries = enumerate(value)
    for where, entry in entries:
        if missing := missing_key(entry):
            return f"{where}.{missing}"
    return None


def read_rows(
    path: Path,
    columns: Mapping[str, pa.DataType],
    row: type[RowT],
    optional: Mapping[str, pa.DataType] = MappingProxyType({}),
) -> tuple[RowT, ...]:
    """Rows of `iter_rows`, all in memory."""
    return tuple(iter_rows(path, columns, row, optional))


def iter_rows(
    path: Path,
    columns: Mapping[str, pa.DataType],
    row: type[RowT],
    optional: Mapping[str, pa.DataType] = MappingProxyType({}),
) -> Iterator[RowT]:
    """Rows of a model from the named columns of a Parquet file, the optional ones if there; others are ignored.

    Not more than ROWS_AT_ONCE are in memory. Raises InputError if the file is missing or damaged, a column is missing
    or of another type, or a value is not allowed.
    """
    with _parquet(path) as file:
        there = {name: kind for name, kind in optional.items() if name in file.schema_arrow.names}
        _check_columns(path, file.schema_arrow, {**columns, **there})
        whole = [name for name, kind in {**columns, **there}.items() if pa.types.is_integer(kind)]
        number = 0
        for batch in file.iter_batches(ROWS_AT_ONCE, columns=[*columns, *there]):
            for record in batch.to_pylist():
                try:
                    validated = row.model_validate(_with_integers(record, whole))
                except ValidationError as error:
                    raise InputError(f"{path}: row {number}.{first_problem(error)}") from None
                yield validated
                number += 1


def iter_frame_rows(
    path: Path,
    columns: Mapping[str, pa.DataType],
    row: type[FrameRowT],
    frame_count: int,
    optional: Mapping[str, pa.DataType] = MappingProxyType({}),
) -> Iterator[FrameRowT]:
    """Rows of `iter_rows`; also raises InputError if there is not one for each frame, in order."""
    rows = row_count(path)
    refusal = InputError(f"{path}: {rows} rows, needed one for each of the {frame_count} frames, in order")
    if rows != frame_count:
        raise refusal
    for number, one in enumerate(iter_rows(path, columns, row, optional)):
        if one.frame != number:
            raise refusal
        yield one


def row_count(path: Path) -> int:
    """Number of rows of a Parquet file. Raises InputError if the file is missing or damaged."""
    with _parquet(path) as file:
        return int(file.metadata.num_rows)


def read_metadata(path: Path) -> dict[str, str]:
    """Key-value metadata of a Parquet file. Raises InputError if the file is missing or damaged."""
    with _parquet(path) as file:
        metadata = file.metadata.metadata or {}
        return {key.decode(errors="replace"): value.decode(errors="replace") for key, value in metadata.items()}


def read_scalars(path: Path) -> dict[str, list[float | str | None]]:
    """Columns of a Parquet file that hold one number or text a row, by name; a truth value is 1 or 0.

    Raises InputError if the file is missing or damaged, or a number is not finite.
    """
    with _parquet(path) as file:
        names = [field.name for field in file.schema_arrow if _is_scalar(field.type)]
        columns: dict[str, list[float | str | None]] = file.read(columns=names).to_pydict()
    for name, column in columns.items():
        for index, value in enumerate(column):
            if isinstance(value, float) and not math.isfinite(value):
                raise InputError(f"{path}: row {index}: {name}: has to be a finite number (got {value})")
    return columns


def _is_scalar(kind: pa.DataType) -> bool:
    kind = _plain(kind)
    return bool(_is_number(kind) or pa.types.is_boolean(kind) or _is_text(kind))


@contextmanager
def _parquet(path: Path) -> Iterator[pq.ParquetFile]:
    """An open Parquet file; what fails while it is open becomes an InputError."""
    try:
        # By default, the bytes of all row groups stay in memory as long as the file is open.
        with pq.ParquetFile(path, pre_buffer=False, buffer_size=BUFFER_BYTES) as file:
            yield file
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise InputError(f"{path}: not a readable Parquet file ({first_line(error)})") from None


def _with_integers(record: dict[str, object], names: Sequence[str]) -> dict[str, object]:
    """A record whose whole floats in some columns are integers: pandas has floats where a column has nulls."""
    for name in names:
        value = record[name]
        if isinstance(value, float) and value.is_integer():
            record[name] = int(value)
    return record


def _check_columns(path: Path, schema: pa.Schema, columns: Mapping[str, pa.DataType]) -> None:
    for name, wanted in columns.items():
        found = schema.get_all_field_indices(name)
        if len(found) != 1:
            has = ", ".join(schema.names) or "none"
            raise InputError(f"{path}: column {name!r} is there {len(found)} times, needed once; columns: {has}")
        actual = schema.field(found[0]).type
        is_real = pa.types.is_integer(wanted) and pa.types.is_floating(actual)
        if not (is_real or _same_type(actual, wanted)):
            raise InputError(f"{path}: column {name!r} has type {actual}, needed {wanted}")


def _plain(kind: pa.DataType) -> pa.DataType:
    """The type of a dictionary's values; any other type itself."""
    return kind.value_type if pa.types.is_dictionary(kind) else kind


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def _is_text(kind: pa.DataType) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind))


def _is_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def _same_type(actual: pa.DataType, wanted: pa.DataType) -> bool:
    """Whether an Arrow type can hold the values of a wanted one, by check 2 of datasets/FORMAT.md.

    Integers, floats, texts and lists are such in every width and layout. The null type has nulls alone, which the rows'
    model allows or not.
    """
    actual = _plain(actual)
    if pa.types.is_null(actual):
        return True
    if pa.types.is_list(wanted):
        return _is_list(actual) and _same_type(actual.value_type, wanted.value_type)
    if pa.types.is_struct(wanted):
        if not pa.types.is_struct(actual):
            return False
        fields = {field.name: field.type for field in actual}
        return all(field.name in fields and _same_type(fields[field.name], field.type) for field in wanted)
    if pa.types.is_string(wanted):
        return _is_text(actual)
    if pa.types.is_integer(wanted):
        return bool(pa.types.is_integer(actual))
    if pa.types.is_floating(wanted):
        return _is_number(actual)
    return bool(actual == wanted)


def first_line(error: BaseException) -> str:
    """First line of an exception's text, at most 120 characters; its type if it has no text."""
    lines = str(error).splitlines()
    return lines[0][:120] if lines else type(error).__name__
