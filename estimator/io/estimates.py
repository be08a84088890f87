"""Estimates of a variant on disk: estimates/VARIANT.parquet, one row a frame (datasets/FORMAT.md)."""

import hashlib
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field, Strict, model_validator

from estimator.errors import InputError
from estimator.io.atomic import whole_file
from estimator.io.device import Identity
from estimator.io.records import (
    ROWS_AT_ONCE,
    Covariance,
    FrameRow,
    LedId,
    Number,
    Size,
    Triple,
    iter_frame_rows,
    read_metadata,
    small_row,
)

COLUMNS = {
    "frame": pa.int64(),
    "status": pa.string(),
    "reason": pa.string(),
    "position_m": pa.list_(pa.float64()),
    "covariance_m2": pa.list_(pa.float64()),
    "ambiguous": pa.bool_(),
    "ranges": pa.list_(pa.struct([("led", pa.int64()), ("range_m", pa.float64())])),
    "time_s": pa.float64(),
    "identities": pa.list_(
        pa.struct(
            [
                ("led", pa.int64()),
                ("u_px", pa.float64()),
                ("v_px", pa.float64()),
                ("correlation", pa.float64()),
                ("bits", pa.string()),
                ("position_m", pa.list_(pa.float64())),
            ]
        )
    ),
}

SPOT_COLUMNS = {
    "spots": pa.list_(pa.struct([("led", pa.int64()), *((name, pa.float64()) for name in ("u_px", "v_px", "snr"))])),
}
"""Null where the run states no spots; files without the column are such."""
FRAMES_SHA256 = "frames_sha256"
"""Key of the file's metadata with the SHA-256 of the dataset's frames.parquet."""

# Most file systems allow names of 255 bytes; the name of the temporary file is longer than the variant's.
NAME = r"[A-Za-z0-9][A-Za-z0-9._:=,+-]{0,199}"
NAME_RULE = "at most 200 of A-Z a-z 0-9 . _ : = , + -, a letter or digit first"


@small_row
class LedRange:
    """Distance from the camera's projection centre to an LED, metres."""

    led: LedId
    range_m: Number


@small_row
class FoundSpot:
    """Identified spot: centroid, continuous pixels, and signal to noise of its brightest pixel; None where unknown."""

    led: LedId
    u_px: Number
    v_px: Number
    snr: Size | None


class EstimateRow(FrameRow):
    """Estimate of one frame: a world position in metres, or `failed` and a reason `stage: what went wrong`.

    `covariance_m2` is the covariance of the position, row by row, if the variant reports one. `identities` are the LED
    images that the receiver found, decoded or not; None where identities are given. `spots` are those that were found
    and identified, the same for every variant; None where they are not stated.
    """

    status: Literal["ok", "failed"]
    reason: str
    position_m: Triple | None
    ranges: Annotated[tuple[LedRange, ...], Strict(False)]
    time_s: float = Field(ge=0, le=1e9)
    covariance_m2: Covariance | None = None
    ambiguous: bool = False
    identities: Annotated[tuple[Identity, ...], Strict(False)] | None = None
    spots: Annotated[tuple[FoundSpot, ...], Strict(False)] | None = None

    @model_validator(mode="after")
    def _status_fits(self) -> "EstimateRow":
        ok = self.status == "ok"
        if ok != (self.position_m is not None) or ok != (self.reason == ""):
            raise ValueError("an ok row has a position and no reason, a failed one a reason and no position")
        return self


def estimates_path(folder: Path, variant: str) -> Path:
    """Path of a variant's estimates in a dataset; raises InputError for a name that cannot be a file name."""
    if not re.fullmatch(NAME, variant):
        raise InputError(f"variant {variant!r}: the name becomes a file's; allowed: {NAME_RULE}")
    return folder / "estimates" / f"{variant}.parquet"


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes, 64 hex digits. Raises InputError where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None


def frames_sha256(dataset: Path) -> str:
    """SHA-256 of a dataset's frames.parquet, which says what its estimates are of. Raises InputError."""
    return sha256_of(dataset / "frames.parquet")


def write_estimates(folder: Path, variant: str, rows: Iterable[EstimateRow], digest: str | None = None) -> Path:
    """Write a variant's rows, replacing an older file atomically; returns the path. Raises InputError, OSError.

    digest: `frames_sha256` of the dataset at the time its frames were read; of `folder` now if None.
    """
    path = estimates_path(folder, variant)
    with estimates_file(folder, variant, digest or frames_sha256(folder)) as add:
        add(rows)
    return path


@contextmanager
def estimates_file(folder: Path, variant: str, digest: str) -> Iterator[Callable[[Iterable[EstimateRow]], None]]:
    """Function that adds rows to a variant's file, which replaces an older one after the block, if nothing is raised.

    Not more than ROWS_AT_ONCE rows are in memory. digest: as of `write_estimates`. Raises InputError, OSError.
    """
    path = estimates_path(folder, variant)
    path.parent.mkdir(exist_ok=True)
    schema = pa.schema([*COLUMNS.items(), *SPOT_COLUMNS.items()], {FRAMES_SHA256: digest})
    waiting: list[dict[str, object]] = []
    # The temporary file has no name: nothing is left where the process dies.
    with tempfile.TemporaryFile(dir=path.parent) as unnamed:
        with pq.ParquetWriter(unnamed, schema) as writer:

            def write() -> None:
                writer.write_table(pa.Table.from_pylist(waiting, schema))
                waiting.clear()

            def add(rows: Iterable[EstimateRow]) -> None:
                for row in rows:
                    waiting.append(row.model_dump())
                    if len(waiting) == ROWS_AT_ONCE:
                        write()

            yield add
            if waiting:
                write()
        unnamed.seek(0)
        with whole_file(path) as file:
            shutil.copyfileobj(unnamed, file)


def read_estimates(path: Path, frame_count: int, digest: str | None = None) -> tuple[EstimateRow, ...]:
    """Read one variant's rows; raises InputError if they are damaged or not one a frame, in order.

    digest: `frames_sha256` of the dataset, where estimates of another one are to be refused.
    """
    if digest is not None:
        check_digest(path, digest)
    return tuple(iter_estimates(path, frame_count))


def iter_estimates(path: Path, frame_count: int) -> Iterator[EstimateRow]:
    """Rows of `read_estimates`, of which some are in memory at a time."""
    return iter_frame_rows(path, COLUMNS, EstimateRow, frame_count, SPOT_COLUMNS)


def check_digest(path: Path, digest: str) -> None:
    """Raise InputError for estimates of another dataset than the one whose `frames_sha256` is `digest`."""
    stated = read_metadata(path).get(FRAMES_SHA256)
    if stated is None:
        raise InputError(f"{path}: does not say which frames it is of (no {FRAMES_SHA256}); run `estimator run` again")
    if stated.lower() != digest:
        raise InputError(
            f"{path}: estimates of another dataset: {FRAMES_SHA256} is {stated[:12]}..., but frames.parquet has "
            f"{digest[:12]}...; run `estimator run` again"
        )
