"""Shutters: when each line of a sensor is exposed.

Lines are rows, or columns for a readout to the right or left. Line i in readout order is exposed from i row times after
the start of the frame, for the exposure time. The middle of a frame is the middle of the exposure of its middle line.
"""

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vlcrender.config.toml_model import Settings

Array = NDArray[np.float64]


class GlobalShutter(Settings):
    """All pixels are exposed at the same time."""

    kind: Literal["global"] = "global"
    """Which shutter."""

    @property
    def row_time_s(self) -> float:
        """Time from one line to the next, s."""
        return 0.0

    def line_count(self, width_px: int, height_px: int) -> int:
        """Number of lines of a sensor."""
        return height_px

    def line_starts_s(self, width_px: int, height_px: int) -> Array:
        """Start of each line's exposure after the frame's, s, in an array that broadcasts over the sensor's pixels."""
        return np.zeros((1, 1))

    def times_s(self, u_px: Any, v_px: Any, width_px: int, height_px: int) -> Any:
        """Time of pixel positions after the middle of the frame, s."""
        return 0.0 * v_px


class RollingShutter(Settings):
    """Lines are exposed one after another."""

    kind: Literal["rolling"]
    """Which shutter."""
    row_time_us: Annotated[float, Field(gt=0, le=1e4)]
    """Time from the start of one line's exposure to that of the next, us."""
    direction: Literal["down", "up", "right", "left"] = "down"
    """Order of the lines: rows from the top "down" or from the bottom "up", columns to the "right" or "left"."""

    @property
    def row_time_s(self) -> float:
        """Time from one line to the next, s."""
        return self.row_time_us * 1e-6

    @property
    def along_rows(self) -> bool:
        """Whether lines are rows."""
        return self.direction in ("down", "up")

    def line_count(self, width_px: int, height_px: int) -> int:
        """Number of lines of a sensor."""
        return height_px if self.along_rows else width_px

    def line_starts_s(self, width_px: int, height_px: int) -> Array:
        """Start of each line's exposure after the frame's, s: (height, 1) for rows, (1, width) for columns."""
        lines = np.arange(self.line_count(width_px, height_px), dtype=np.float64)
        if self.direction in ("up", "left"):
            lines = lines[::-1]
        starts: Array = lines * self.row_time_s
        return starts[:, None] if self.along_rows else starts[None, :]

    def times_s(self, u_px: Any, v_px: Any, width_px: int, height_px: int) -> Any:
        """Time of pixel positions (u, v) after the middle of the frame, s: (line coordinate - lines / 2) row times.

        Continuous, and exact at the middle of each line: the middle of line i is at the coordinate i + 1/2.
        """
        along = (v_px - height_px / 2) if self.along_rows else (u_px - width_px / 2)
        return along * (-self.row_time_s if self.direction in ("up", "left") else self.row_time_s)


Shutter = Annotated[GlobalShutter | RollingShutter, Field(discriminator="kind")]
