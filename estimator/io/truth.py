"""True positions of the frames and LEDs. Scores and tables alone import this module, which opens the truth's files."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import pyarrow as pa
from pydantic import Field, Strict

from estimator.errors import InputError
from estimator.io.led_map import LedSize
from estimator.io.records import (
    Covariance,
    FlatRotation,
    FrameRow,
    LedId,
    Number,
    Row,
    Triple,
    iter_frame_rows,
    read_rows,
    read_scalars,
    small_row,
)

COLUMNS = {
    "frame": pa.int64(),
    "position_m": pa.list_(pa.float64()),
    "bound_m2": pa.list_(pa.float64()),
    "bound_exact_m2": pa.list_(pa.float64()),
    "map": pa.int64(),
    "R_cam_world": pa.list_(pa.float64()),
    "tilt_x_deg": pa.float64(),
    "tilt_y_deg": pa.float64(),
    "yaw_deg": pa.float64(),
    "leds": pa.list_(
        pa.struct(
            [
                *(("led", pa.int64()), ("u_px", pa.float64()), ("v_px", pa.float64())),
                *(("visible_fraction", pa.float64()), ("bits", pa.string())),
            ]
        )
    ),
}
MAP_COLUMNS = {
    **{"map": pa.int64(), "led": pa.int64(), "position_m": pa.list_(pa.float64()), "size_m": pa.float64()},
}

# An LED whose image is on the sensor but for rounding.
WHOLE = 1 - 1e-6
WHOLE_AND_ROUNDING = 1 + 1e-6


Angle = Annotated[float, Field(ge=-360, le=360)]
"""Degrees."""


@small_row
class TrueLed:
    """An LED that lights pixels of a frame: its centre's pixel, and the share of its image on the sensor.

    `bits` are the chips of one period that it sends; None without chips.
    """

    led: LedId
    u_px: Number
    v_px: Number
    visible_fraction: Annotated[float, Field(ge=0, le=WHOLE_AND_ROUNDING), Strict()]
    bits: Annotated[str, Strict()] | None


class TruthRow(FrameRow):
    """True position of a frame's camera, world metres, its building, its LEDs, and its bounds if the dataset has them.

    `bound_m2` is a covariance, row by row: no unbiased estimator has a smaller one. It counts what the device does not
    know exactly; `bound_exact_m2` is that of a device that knows its camera and map exactly. `map` is the number of the
    building as built that the device is in.
    """

    position_m: Triple
    bound_m2: Covariance | None
    bound_exact_m2: Covariance | None
    map: int = Field(ge=0)
    R_cam_world: FlatRotation
    tilt_x_deg: Angle
    tilt_y_deg: Angle
    yaw_deg: Angle
    leds: Annotated[tuple[TrueLed, ...], Strict(False)]

    @property
    def good_leds(self) -> int:
        """Number of LEDs whose whole image is on the sensor."""
        return sum(led.visible_fraction >= WHOLE for led in self.leds)


class TrueMapLed(Row):
    """An LED of a building as built: its centre, world metres, and its radius or side."""

    map: int = Field(ge=0)
    led: LedId
    position_m: Triple
    size_m: LedSize


def read_true_map(path: Path) -> tuple[TrueMapLed, ...]:
    """Read truth_map.parquet; raises InputError if it is missing or damaged."""
    return read_rows(path, MAP_COLUMNS, TrueMapLed)


def read_truth(path: Path, frame_count: int) -> tuple[TruthRow, ...]:
    """Read truth.parquet; raises InputError if it is missing or damaged, or has not one row a frame, in order."""
    return tuple(iter_truth(path, frame_count))


def iter_truth(path: Path, frame_count: int) -> Iterator[TruthRow]:
    """Rows of `read_truth`, of which some are in memory at a time."""
    return iter_frame_rows(path, COLUMNS, TruthRow, frame_count)


SWEPT = "sweep_"
"""Start of the names of the columns with the values of a sweep."""


def read_true_scalars(path: Path, frame_count: int) -> dict[str, list[float | str | None]]:
    """Columns of truth.parquet that hold one number or text a frame, by name; raises InputError as `read_truth`.

    Among them are `tilt_x_deg`, `tilt_y_deg`, `yaw_deg` and, in a cell of a sweep, `sweep_NAME` for each swept name.
    """
    columns = read_scalars(path)
    for name, column in columns.items():
        if len(column) != frame_count:
            raise InputError(f"{path}: {len(column)} values of {name!r}, needed one for each of {frame_count} frames")
    return columns
