"""Regions of interest: the rectangles of a sensor that are read out."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vlcrender.camera.intrinsics import Camera
from vlcrender.config.toml_model import Settings

PIXELS_AT_ONCE = 50_000
"""Pixels of a band of rows: so few that arrays of them stay in the processor's cache."""


class LedRegions(Settings):
    """Read out a region around each LED image, in place of the whole sensor."""

    kind: Literal["leds"]
    """Which regions: "leds", a region around each LED image."""
    margin_px: Annotated[float, Field(ge=0, le=10000)] = 20.0
    """Pixels added on each side of the pixels that an LED lights, px. Estimators need them for the background."""
    overscan: bool = False
    """Whether regions extend beyond the sensor where the image of an LED does; no real camera takes such frames."""


@dataclass(frozen=True)
class Roi:
    """A region: `rows` x `columns` pixels from pixel (row, column) of the sensor; may extend beyond the sensor."""

    row: int
    column: int
    rows: int
    columns: int

    @classmethod
    def of_sensor(cls, camera: Camera) -> Self:
        """All pixels of a camera's sensor."""
        return cls(0, 0, camera.height_px, camera.width_px)

    @property
    def end_row(self) -> int:
        """First row below the region."""
        return self.row + self.rows

    @property
    def end_column(self) -> int:
        """First column to the right of the region."""
        return self.column + self.columns

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows, self.columns

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.rows * self.columns

    def centers_px(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixel positions u (1, columns) and v (rows, 1) of the pixels' centres, which broadcast."""
        u = np.arange(self.column, self.end_column, dtype=np.float64) + 0.5
        v = np.arange(self.row, self.end_row, dtype=np.float64) + 0.5
        return u[None, :], v[:, None]

    def bands(self) -> Iterator[slice]:
        """Slices of the region's rows, from the first on, of some PIXELS_AT_ONCE pixels each."""
        rows = max(1, PIXELS_AT_ONCE // self.columns)
        for start in range(0, self.rows, rows):
            yield slice(start, start + rows)

    def padded(self, by_px: int) -> "Roi":
        """The region with `by_px` more pixels on each side."""
        return Roi(self.row - by_px, self.column - by_px, self.rows + 2 * by_px, self.columns + 2 * by_px)

    def overlaps(self, other: "Roi") -> bool:
        """Whether the two regions share a pixel."""
        down = self.row < other.end_row and other.row < self.end_row
        return down and self.column < other.end_column and other.column < self.end_column

    def contains(self, other: "Roi") -> bool:
        """Whether every pixel of the other region is in this one."""
        down = self.row <= other.row and other.end_row <= self.end_row
        return down and self.column <= other.column and other.end_column <= self.end_column

    def union(self, other: "Roi") -> "Roi":
        """The smallest region that contains both."""
        row, column = min(self.row, other.row), min(self.column, other.column)
        rows = max(self.end_row, other.end_row) - row
        return Roi(row, column, rows, max(self.end_column, other.end_column) - column)

    def intersection(self, other: "Roi") -> "Roi":
        """The pixels in both regions, which have to overlap."""
        row, column = max(self.row, other.row), max(self.column, other.column)
        rows = min(self.end_row, other.end_row) - row
        return Roi(row, column, rows, min(self.end_column, other.end_column) - column)

    def slices(self, inner: "Roi") -> tuple[slice, slice]:
        """Slices of an array of this region's pixels that select the pixels of `inner`."""
        row, column = inner.row - self.row, inner.column - self.column
        return slice(row, row + inner.rows), slice(column, column + inner.columns)


class RegionImage(NamedTuple):
    """A region and its pixels."""

    roi: Roi
    image: NDArray[Any]
    """(rows, columns)."""


def pixel_numbers(rois: Sequence[Roi]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Columns and rows on the sensor of all pixels of all regions, region by region, row by row, (pixels,) each."""
    columns = [np.tile(np.arange(roi.column, roi.end_column, dtype=np.int32), roi.rows) for roi in rois]
    rows = [np.repeat(np.arange(roi.row, roi.end_row, dtype=np.int32), roi.columns) for roi in rois]
    return np.concatenate(columns), np.concatenate(rows)


def led_regions(led_rois: Iterable[Roi], camera: Camera, settings: LedRegions) -> tuple[Roi, ...]:
    """Regions to read out, without overlaps, by first row, then column. `led_rois`: the pixels that each LED lights.

    Pixel (0, 0) alone where no LED lights a pixel: a frame is never empty.
    """
    sensor = Roi.of_sensor(camera)
    margin = int(np.ceil(settings.margin_px))
    # The region of an LED image that is whole on the sensor stays on the sensor, with overscan too.
    padded = [r.padded(margin).intersection(sensor) if sensor.contains(r) else r.padded(margin) for r in led_rois]
    return tuple(sorted(merged(padded), key=lambda r: (r.row, r.column))) or (Roi(0, 0, 1, 1),)


def merged(regions: Iterable[Roi]) -> list[Roi]:
    """Regions without overlaps: those that overlap are replaced by their union, until none do."""
    separate: list[Roi] = []
    for roi in regions:
        while overlapping := next((r for r in separate if r.overlaps(roi)), None):
            separate.remove(overlapping)
            roi = roi.union(overlapping)
        separate.append(roi)
    return separate
