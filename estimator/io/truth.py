"""True positions of the frames. This is the only module that opens truth.parquet; only the scorer imports it."""

from pathlib import Path

import pyarrow as pa

from estimator.errors import InputError
from estimator.io.records import Covariance, Row, Triple, read_rows

COLUMNS = {"frame": pa.int64(), "position_m": pa.list_(pa.float64()), "bound_m2": pa.list_(pa.float64())}


class TruthRow(Row):
    """True position of a frame's camera, world metres, and its Cramer-Rao bound if the dataset has one.

    `bound_m2` is a covariance, row by row: no unbiased estimator has a smaller one.
    """

    frame: int
    position_m: Triple
    bound_m2: Covariance | None


def read_truth(path: Path, frame_count: int) -> tuple[TruthRow, ...]:
    """Read truth.parquet; raises InputError if it is missing or damaged, or has not one row a frame, in order."""
    rows = read_rows(path, COLUMNS, TruthRow)
    if [row.frame for row in rows] != list(range(frame_count)):
        raise InputError(f"{path}: {len(rows)} rows, needed one for each of the {frame_count} frames, in order")
    return rows
