"""LEDs as point sources, for the direct illumination of the room's surfaces."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.scene.leds import Leds

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sources:
    """n point sources that face down: luminous intensity I cos^m(theta) at an angle theta from straight down."""

    centers_m: Array
    """Positions, (n, 3), world."""
    intensities_cd: Array
    """Intensity I straight down, (n,)."""
    orders: Array
    """Lambertian order m, (n,)."""

    def __len__(self) -> int:
        """Number of sources."""
        return len(self.orders)


def point_sources(leds: Leds) -> Sources:
    """Point sources of LEDs, of intensity I = L A.

    A bare LED is one point; the error is about (radius / distance)^2. The part of a diffuser that an LED lights is
    Lambertian and becomes four points: the centroids of light of its quadrants about the LED's foot. Their error is
    below 7 % at 10 times the LED's distance from the diffuser, and 0.6 % at 30 times (tested).
    """
    bare = np.array([diffuser is None for diffuser in leds.diffusers])
    centers, intensities = [leds.centers_m[bare]], [(leds.luminances_cd_m2 * leds.areas_m2)[bare]]
    for i in np.flatnonzero(~bare):
        diffuser = leds.diffusers[i]
        assert diffuser is not None  # the LED is not bare
        at, light = diffuser.quadrants()
        centers.append(np.column_stack([at, np.full(len(at), leds.centers_m[i, 2])]))
        intensities.append(leds.luminances_cd_m2[i] * light)
    orders = np.append(leds.orders[bare], np.ones(sum(map(len, intensities[1:]))))
    return Sources(np.concatenate(centers), np.concatenate(intensities), orders)
