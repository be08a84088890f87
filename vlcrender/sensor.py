"""The sensor: expected electrons to digital numbers.

Shot noise alone by default: electrons are Poisson, and at a gain of 1 e/DN the difference of two exposures is exactly
Skellam. Clipping at full well comes before the gain; conversion rounds, it does not truncate.
"""

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from vlcrender.settings import Settings

Electrons = NDArray[np.float32] | NDArray[np.float64] | NDArray[np.uint32]


class Sensor(Settings):
    """A sensor with photon shot noise, full well, linear gain and rounding."""

    bits: Literal[8, 10, 12] = 12
    gain_e_per_dn: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    full_well_e: Annotated[float, Field(gt=0, le=1e9)] = 6000.0
    black_level_dn: Annotated[int, Field(ge=0, le=4095)] = 0
    noise: Literal["shot", "none"] = "shot"

    @model_validator(mode="after")
    def _black_level_leaves_room(self) -> Self:
        if self.black_level_dn >= self.largest_dn:
            raise ValueError(
                f"black_level_dn = {self.black_level_dn}: has to be below {self.largest_dn}, the largest number "
                f"of {self.bits} bits"
            )
        return self

    @property
    def largest_dn(self) -> int:
        """The digital number at which the converter saturates."""
        return int(2**self.bits - 1)

    def quantise(self, electrons: Electrons) -> NDArray[np.uint32]:
        """Convert electrons: round(e / gain) + black level, within 0 and the converter's largest number."""
        if self.gain_e_per_dn == 1.0 and electrons.dtype == np.uint32:  # counts are numbers already
            dn = electrons + np.uint32(self.black_level_dn)
        else:
            dn = np.rint(electrons / np.float64(self.gain_e_per_dn)) + self.black_level_dn
        clipped: NDArray[np.uint32] = np.clip(dn, 0, self.largest_dn).astype(np.uint32)
        return clipped


def clip_full_well(electrons: Electrons, full_well_e: float) -> Electrons:
    """Clip at the full well: what a photodiode cannot hold is lost."""
    if electrons.dtype == np.uint32:
        return np.minimum(electrons, np.uint32(min(full_well_e, 2**32 - 1)))
    return np.minimum(electrons, full_well_e)
