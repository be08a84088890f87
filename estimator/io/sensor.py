"""Sensors as devices know them: digital numbers, full well and noise (datasets/FORMAT.md)."""

import math
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from estimator.io.records import Entry, Share

Floats = NDArray[np.float64]
# Pixels within this many standard deviations of the full well count as possibly full.
FULL_SIGMA = 4.0


Electrons = Annotated[float, Field(ge=1e-9, le=1e12)]
Spread = Annotated[float, Field(ge=0, le=1e12)]


class Sensor(Entry):
    """Sensor of a device; keys as in dataset.json: `dn = round(min(e, full_well_e) / gain_e_per_dn) + black_level_dn`.

    Gain and full well are None where the device does not know them, as of a photograph: electrons are then digital
    numbers. Noise other than shot noise is given by standard deviations, as in a data sheet. `crosstalk` is the share
    of a pixel's electrons that its four neighbours collect, a quarter each.
    """

    bits: int = Field(ge=1, le=32)
    gain_e_per_dn: Electrons | None
    full_well_e: Electrons | None
    black_level_dn: float = Field(ge=0)
    noise: Literal["shot", "none", "full"]
    crosstalk: Share = 0.0
    hot_pixel_share: Share = 0.0
    hot_pixel_e_s: Spread = 0.0
    prnu: Spread
    dark_current_e_s: Spread
    dsnu_e: Spread
    read_noise_e: Spread
    adc_noise_dn: Spread
    row_offset_e: Spread
    column_offset_e: Spread
    mosaic: Literal["none", "rggb", "bggr", "grbg", "gbrg"]

    @model_validator(mode="after")
    def _black_is_a_code(self) -> Self:
        if not (self.black_level_dn.is_integer() and self.black_level_dn <= 2**self.bits - 1):
            raise ValueError(f"black_level_dn {self.black_level_dn}: has to be whole, up to {2**self.bits - 1}")
        return self

    @property
    def gain(self) -> float:
        """Electrons a digital number; 1 where the device does not state them."""
        return 1.0 if self.gain_e_per_dn is None else self.gain_e_per_dn

    def _well_dn(self) -> float:
        """Digital number at the full well, infinite where the device does not state it."""
        full_e = np.inf if self.full_well_e is None else self.full_well_e
        return float(np.rint(full_e / self.gain)) + self.black_level_dn

    def saturation_dn(self) -> float:
        """Digital number of a saturated pixel: at the full well, or the ADC's last code if that is lower."""
        return min(2.0**self.bits - 1, self._well_dn())

    def clipping_dn(self) -> float:
        """Lowest digital number that a saturated pixel may have.

        It is FULL_SIGMA standard deviations below the full well, of all noise that is added after clipping. The ADC's
        last code needs no such margin: a pixel that reads less has not reached it.
        """
        added_e = math.hypot(self.read_noise_e, self.row_offset_e, self.column_offset_e)
        spread_dn = math.hypot(added_e / self.gain, self.adc_noise_dn)
        return min(2.0**self.bits - 1, self._well_dn() - FULL_SIGMA * spread_dn)

    def floor_e2(self) -> float:
        """Signal-independent variance of a pixel, electrons squared.

        Offsets of whole rows and columns are left out: subtracting a spot's local background removes most of them.
        """
        added = self.dsnu_e**2 + self.read_noise_e**2 + (self.adc_noise_dn * self.gain) ** 2
        return added + self.rounding_e2()

    def rounding_e2(self) -> float:
        """Variance of the ADC's rounding, electrons squared; 0 where whole electrons are counted."""
        return self.gain**2 / 12 if self.noise == "full" or self.gain != 1 else 0.0
