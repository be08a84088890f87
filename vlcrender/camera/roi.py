"""Windows: the parts of a sensor that are read out."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vlcrender.camera.intrinsics import Camera
from vlcrender.config.toml_model import Settings


class LedRegions(Settings):
    """Read out a window around each LED alone."""

    kind: Literal["leds"]
    margin_px: Annotated[float, Field(ge=0, le=10000)] = 20.0
    """Pixels added on each side of the pixels that an LED lights. An estimator needs them for the background."""
    overscan: bool = False
    """Whether LEDs that are not whole on the sensor have their whole windows all the same."""


@dataclass(frozen=True)
class Roi:
    """A rectangle of pixels, `rows` x `columns` from pixel (row, column) of the sensor on; may reach beyond it."""

    row: int
    column: int
    rows: int
    columns: int

    @classmethod
    def of_sensor(cls, camera: Camera) -> Self:
        """All that a camera has."""
        return cls(0, 0, camera.height_px, camera.width_px)

    @property
    def end_row(self) -> int:
        """First row below."""
        return self.row + self.rows

    @property
    def end_column(self) -> int:
        """First column to the right."""
        return self.column + self.columns

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.rows * self.columns

    def centers_px(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """u (1, columns) and v (rows, 1) of the pixels' centres, which broadcast."""
        u = np.arange(self.column, self.end_column, dtype=np.float64) + 0.5
        v = np.arange(self.row, self.end_row, dtype=np.float64) + 0.5
        return u[None, :], v[:, None]

    def padded(self, by_px: int) -> "Roi":
        """The window with `by_px` pixels more on each side."""
        return Roi(self.row - by_px, self.column - by_px, self.rows + 2 * by_px, self.columns + 2 * by_px)

    def overlaps(self, other: "Roi") -> bool:
        """Whether the two share a pixel."""
        down = self.row < other.end_row and other.row < self.end_row
        return down and self.column < other.end_column and other.column < self.end_column

    def contains(self, other: "Roi") -> bool:
        """Whether every pixel of the other is in this one."""
        down = self.row <= other.row and other.end_row <= self.end_row
        return down and self.column <= other.column and other.end_column <= self.end_column

    def union(self, other: "Roi") -> "Roi":
        """The smallest window that holds both."""
        row, column = min(self.row, other.row), min(self.column, other.column)
        rows = max(self.end_row, other.end_row) - row
        return Roi(row, column, rows, max(self.end_column, other.end_column) - column)

    def intersection(self, other: "Roi") -> "Roi":
        """The pixels in both, which have to be some."""
        row, column = max(self.row, other.row), max(self.column, other.column)
        rows = min(self.end_row, other.end_row) - row
        return Roi(row, column, rows, min(self.end_column, other.end_column) - column)

    def slices(self, inner: "Roi") -> tuple[slice, slice]:
        """Where `inner` lies in an array that holds this window's pixels."""
        row, column = inner.row - self.row, inner.column - self.column
        return slice(row, row + inner.rows), slice(column, column + inner.columns)


def led_regions(lit: Iterable[Roi], camera: Camera, settings: LedRegions) -> tuple[Roi, ...]:
    """Windows around the pixels that LEDs light, apart from each other, by first row, then column.

    Pixel (0, 0) alone where no LED lights any: a frame has to hold something.
    """
    sensor = Roi.of_sensor(camera)
    margin = int(np.ceil(settings.margin_px))
    # What is whole on the sensor is read out as by the real one, overscan or not.
    padded = [w.padded(margin).intersection(sensor) if sensor.contains(w) else w.padded(margin) for w in lit]
    return tuple(sorted(merged(padded), key=lambda w: (w.row, w.column))) or (Roi(0, 0, 1, 1),)


def merged(regions: Iterable[Roi]) -> list[Roi]:
    """Windows that overlap become the one around them, until none do."""
    apart: list[Roi] = []
    for roi in regions:
        while touching := next((w for w in apart if w.overlaps(roi)), None):
            apart.remove(touching)
            roi = roi.union(touching)
        apart.append(roi)
    return apart
