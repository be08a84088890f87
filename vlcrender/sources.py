"""LEDs as the small sources that light the room's surfaces."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.scene import Leds

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sources:
    """Points that face down: intensity in a direction at an angle theta from straight down is I cos^m(theta).

    centers_m: (n, 3), intensities_cd: I, (n,), orders: m, (n,).
    """

    centers_m: Array
    intensities_cd: Array
    orders: Array

    def __len__(self) -> int:
        """Count the points."""
        return len(self.orders)


def point_sources(leds: Leds) -> Sources:
    """One point an LED, I = L A: it is small against its distance, and the error is about (radius / distance)^2."""
    return Sources(leds.centers_m, leds.luminances_cd_m2 * leds.areas_m2, leds.orders)
