"""Shutter of a camera: when each line of the sensor is exposed; and the gyroscope (datasets/FORMAT.md)."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from estimator.io.records import Entry, NotNegative

Floats = NDArray[np.float64]

MAX_ROW_TIME_US = 1e4


class Shutter(Entry):
    """Shutter of a camera; keys as in dataset.json.

    Kind "rolling": line i = 0, 1, ... in readout order, over the whole sensor, is exposed from `start_s` of the frame
    plus i `row_time_us` on. `direction` tells where the readout goes: "down" and "up" read rows, "right" and "left"
    columns. Kind "global": all lines are exposed at once; `row_time_us` is then 0 and `direction` "down".
    """

    kind: Literal["global", "rolling"]
    row_time_us: float = Field(ge=0, le=MAX_ROW_TIME_US)
    direction: Literal["down", "up", "right", "left"]

    @model_validator(mode="before")
    @classmethod
    def _all_at_once(cls, entry: Any) -> Any:
        """A global shutter has its kind alone."""
        alone = {"kind": "global", "row_time_us": 0.0, "direction": "down"}
        if isinstance(entry, Mapping) and entry.get("kind") == "global":
            if entry != alone and (unknown := entry.keys() - {"kind"}):
                raise ValueError(f"unknown key {min(unknown)!r}; a global shutter has its kind alone")
            return alone
        return entry

    @model_validator(mode="after")
    def _takes_time(self) -> "Shutter":
        if self.kind == "rolling" and self.row_time_us == 0:
            raise ValueError('row_time_us has to be more than 0 with kind "rolling"')
        return self

    @property
    def rolls(self) -> bool:
        """Whether lines are exposed one after another."""
        return self.kind == "rolling"

    @property
    def along(self) -> Literal["rows", "columns"]:
        """What a line is: a row or a column of the sensor."""
        return "rows" if self.direction in ("down", "up") else "columns"

    @property
    def row_time_s(self) -> float:
        """Time between the starts of two lines, seconds; 0 for a global shutter."""
        return self.row_time_us * 1e-6

    def line_count(self, width_px: int, height_px: int) -> int:
        """Lines of a whole sensor."""
        return height_px if self.along == "rows" else width_px

    def line_of(self, u_px: Floats, v_px: Floats, width_px: int, height_px: int) -> Floats:
        """Continuous line coordinates, in readout order, of pixels (u, v) of any shape: line i is from i to i + 1."""
        coordinates = {
            "down": lambda: np.asarray(v_px, dtype=np.float64),
            "up": lambda: height_px - np.asarray(v_px, dtype=np.float64),
            "right": lambda: np.asarray(u_px, dtype=np.float64),
            "left": lambda: width_px - np.asarray(u_px, dtype=np.float64),
        }
        return coordinates[self.direction]()


GLOBAL = Shutter(kind="global", row_time_us=0.0, direction="down")
"""Shutter of a camera that states none."""


class Gyroscope(Entry):
    """Errors of the gyroscope on each axis, standard deviations, rad/s; keys as in dataset.json.

    `noise_rad_s` is new in every frame, `bias_rad_s` the same in every frame of a device.
    """

    noise_rad_s: NotNegative
    bias_rad_s: NotNegative
