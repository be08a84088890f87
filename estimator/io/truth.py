"""True positions of the frames. This is the only module that opens truth.parquet; only the scorer imports it."""

from pathlib import Path
from typing import Annotated

import pyarrow as pa
from pydantic import Field, Strict

from estimator.errors import InputError
from estimator.io.records import Covariance, LedId, Row, Size, Triple, read_rows

COLUMNS = {
    "frame": pa.int64(),
    "position_m": pa.list_(pa.float64()),
    "bound_m2": pa.list_(pa.float64()),
    "bound_exact_m2": pa.list_(pa.float64()),
    "map": pa.int64(),
    "leds": pa.list_(pa.struct([("led", pa.int64()), ("visible_fraction", pa.float64())])),
}

# An LED whose image is on the sensor but for rounding.
WHOLE = 1 - 1e-6


class TrueLed(Row):
    """An LED that lights pixels of a frame, and the share of its image on the sensor."""

    led: LedId
    visible_fraction: Size


class TruthRow(Row):
    """True position of a frame's camera, world metres, its building, its LEDs, and its bounds if the dataset has them.

    `bound_m2` is a covariance, row by row: no unbiased estimator has a smaller one. It counts what the device does not
    know exactly; `bound_exact_m2` is that of a device that knows its camera and map exactly. `map` is the number of the
    building as built that the device is in.
    """

    frame: int
    position_m: Triple
    bound_m2: Covariance | None
    bound_exact_m2: Covariance | None
    map: int = Field(ge=0)
    leds: Annotated[tuple[TrueLed, ...], Strict(False)]

    @property
    def good_leds(self) -> int:
        """Number of LEDs whose whole image is on the sensor."""
        return sum(led.visible_fraction >= WHOLE for led in self.leds)


def read_truth(path: Path, frame_count: int) -> tuple[TruthRow, ...]:
    """Read truth.parquet; raises InputError if it is missing or damaged, or has not one row a frame, in order."""
    rows = read_rows(path, COLUMNS, TruthRow)
    if [row.frame for row in rows] != list(range(frame_count)):
        raise InputError(f"{path}: {len(rows)} rows, needed one for each of the {frame_count} frames, in order")
    return rows
