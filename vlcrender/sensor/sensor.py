"""The sensor: what of electrons becomes digital numbers. The EMVA 1288 camera, all in electrons up to the gain.

The whole chain, in this order (`exposure.expose` runs it):

1. mean photoelectrons of the pixel, `expected_e`
2. PRNU scales that mean. It is a spread of quantum efficiency: were it to multiply the electrons drawn, a pixel of
   response 1 + p would have variance (1 + p)^2 mu, and not the (1 + p) mu of a Poisson variable
3. the mean of the dark current's electrons is added: those of the exposure's time at the sensor's temperature
4. one Poisson draw: the shot noise of light and dark current together
5. DSNU, a fixed pattern, is added
6. the full well clips: what a photodiode cannot hold is lost before anything is read
7. read noise, and the fixed offsets of row and column, are added
8. the gain divides; the converter's own noise is added, in digital numbers
9. the number is rounded (not truncated), the black level added, and the sum clipped to 0 and the converter's largest

`noise = "shot"`, the default, has of all noise the draw alone (1, 4, 6, 8, 9): at 1 e/DN the difference of two
exposures is exactly Skellam. `noise = "none"` has not even that.

Source: EMVA Standard 1288, Release 4.0 Linear (2021), sections 2 and 3, whose noise model is this one but for the split
of sigma_d into read and converter noise, and for row and column offsets, which 4.0 splits off DSNU.
"""

from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from vlcrender.config.presets import preset
from vlcrender.config.toml_model import Settings, check
from vlcrender.sensor.quantum_efficiency import SiliconOrTable

Electrons = NDArray[np.float32] | NDArray[np.float64] | NDArray[np.uint32]
Spread = Annotated[float, Field(ge=0, le=1e6)]
"""A standard deviation."""
Celsius = Annotated[float, Field(ge=-100, le=150)]
Iso = Annotated[float, Field(ge=1, le=1e7)]


MAX_WELL_E = 2.0**22
"""What `poisson` draws at most: beyond it the float32 arithmetic of the kernels would show."""
SPREADS = ("prnu", "dsnu_e", "read_noise_e", "adc_noise_dn", "row_offset_e", "column_offset_e")
"""Keys of standard deviations."""


class Sensor(Settings):
    """A sensor. The keys from `prnu` to `serial` act with `noise = "full"` only."""

    bits: Literal[8, 10, 12, 14] = 12
    gain_e_per_dn: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    """At `base_iso`."""
    iso: Iso = 100.0
    base_iso: Iso = 100.0
    """What gain and converter noise are given for: at twice this ISO a digital number is half as many electrons."""
    full_well_e: Annotated[float, Field(gt=0, le=MAX_WELL_E)] = 6000.0
    black_level_dn: Annotated[int, Field(ge=0, le=16382)] = 0
    noise: Literal["shot", "none", "full"] = "shot"
    prnu: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Standard deviation of the pixels' response over its mean."""
    dark_current_e_s: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """At `reference_temperature_c`."""
    reference_temperature_c: Celsius = 25.0
    dark_current_doubling_c: Annotated[float, Field(ge=1, le=100)] = 6.0
    """So many degrees more double the dark current."""
    temperature_c: Celsius = 25.0
    dsnu_e: Spread = 0.0
    read_noise_e: Spread = 0.0
    adc_noise_dn: Spread = 0.0
    """After the gain, so that in electrons it falls with ISO."""
    row_offset_e: Spread = 0.0
    column_offset_e: Spread = 0.0
    serial: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Which individual: the fixed patterns (PRNU, DSNU, offsets) are its own, the same in every frame."""
    mosaic: Literal["none", "rggb", "bggr", "grbg", "gbrg"] = "none"
    """Colours of the pixels (0, 0), (0, 1), (1, 0), (1, 1) as (row, column), and so on everywhere."""
    quantum_efficiency: SiliconOrTable = "silicon"

    @classmethod
    def preset(cls, name: str) -> Self:
        """The sensor of a preset, such as "phone-1.2um". Raises InputError with the names there are."""
        return check(preset("sensors", name)["sensor"], cls, f"sensor preset {name}")

    @model_validator(mode="after")
    def _black_level_leaves_room(self) -> Self:
        if self.black_level_dn >= self.largest_dn:
            raise ValueError(
                f"black_level_dn = {self.black_level_dn}: has to be below {self.largest_dn}, the largest number "
                f"of {self.bits} bits"
            )
        return self

    @model_validator(mode="after")
    def _full_well_exceeds_the_noise(self) -> Self:
        noise_e = float(np.hypot(self.dark_noise_e, self.dsnu_e))
        if self.full_well_e <= noise_e:
            raise ValueError(
                f"full_well_e = {self.full_well_e:g}: has to exceed the noise of {noise_e:.4g} e in the dark "
                "(read_noise_e, adc_noise_dn and dsnu_e together)"
            )
        return self

    @model_validator(mode="after")
    def _mosaic_has_its_colours(self) -> Self:
        coloured = self.quantum_efficiency != "silicon" and self.quantum_efficiency.coloured
        if (self.mosaic != "none") != coloured:
            raise ValueError(
                f'mosaic = "{self.mosaic}": quantum_efficiency needs red, green and blue with a mosaic, and only then'
            )
        return self

    @property
    def largest_dn(self) -> int:
        """The digital number at which the converter saturates."""
        return int(2**self.bits - 1)

    @property
    def white_dn(self) -> int:
        """The digital number of a full well, or the converter's largest where that is less."""
        return min(self.largest_dn, round(self.full_well_e / self.gain_at_iso_e_per_dn) + self.black_level_dn)

    @property
    def saturation_e(self) -> float:
        """Electrons at which a pixel saturates: the full well, or the converter's end where that comes first."""
        return min(self.full_well_e, (self.largest_dn - self.black_level_dn) * self.gain_at_iso_e_per_dn)

    @property
    def gain_at_iso_e_per_dn(self) -> float:
        """Electrons a digital number at the sensor's ISO: 1 / K of EMVA 1288."""
        return self.gain_e_per_dn * (self.base_iso / self.iso)

    @property
    def dark_noise_e(self) -> float:
        """Temporal noise of a pixel in the dark without dark current, electrons: sigma_d of EMVA 1288.

        Read noise and the converter's, both normal and of every frame anew; rounding (1/12 DN^2) not counted.
        """
        return float(np.hypot(self.read_noise_e, self.adc_noise_dn * self.gain_at_iso_e_per_dn))

    def dark_electrons(self, exposure_s: float) -> float:
        """Mean electrons of the dark current: doubles every `dark_current_doubling_c` (EMVA 1288, 2.6)."""
        doublings = (self.temperature_c - self.reference_temperature_c) / self.dark_current_doubling_c
        return float(self.dark_current_e_s * 2.0**doublings * exposure_s)

    def acting(self) -> dict[str, Any]:
        """What acts on frames, as dataset.json tells of it: at the ISO and temperature of the frames.

        Standard deviations are 0 where `noise` leaves them out.
        """
        full = self.noise == "full"
        return {
            "bits": self.bits,
            "gain_e_per_dn": self.gain_at_iso_e_per_dn,
            "full_well_e": self.full_well_e,
            "black_level_dn": self.black_level_dn,
            "noise": self.noise,
            "dark_current_e_s": self.dark_electrons(1.0) if full else 0.0,
            **{key: getattr(self, key) if full else 0.0 for key in SPREADS},
            "mosaic": self.mosaic,
        }

    def quantise(self, electrons: Electrons) -> NDArray[np.uint32]:
        """Convert electrons: round(e / gain) + black level, within 0 and the converter's largest number."""
        gain = self.gain_at_iso_e_per_dn
        if gain == 1.0 and electrons.dtype == np.uint32:  # counts are numbers already
            counts = np.minimum(electrons, np.uint32(self.largest_dn - self.black_level_dn))
            counts += np.uint32(self.black_level_dn)
            return counts.astype(np.uint32, copy=False)
        dn = np.rint(electrons / np.float64(gain)) + self.black_level_dn
        clipped: NDArray[np.uint32] = np.clip(dn, 0, self.largest_dn).astype(np.uint32)
        return clipped

    def binned(self, by: int) -> "Sensor":
        """The sensor whose pixels are sums of `by` x `by` of this one's, digital numbers keeping their range.

        Means grow with the area, independent noise with its root, a row's offset with the root of the rows beside the
        columns that share it.
        """
        means = {key: getattr(self, key) * by**2 for key in ("gain_e_per_dn", "full_well_e", "dark_current_e_s")}
        noise = {key: getattr(self, key) * by for key in ("dsnu_e", "read_noise_e")}
        shares = {key: getattr(self, key) / by for key in ("prnu", "adc_noise_dn")}
        offsets = {key: getattr(self, key) * by**1.5 for key in ("row_offset_e", "column_offset_e")}
        return self.model_copy(update={**means, **noise, **shares, **offsets})


def clip_full_well(electrons: Electrons, full_well_e: float) -> Electrons:
    """Clip at the full well: what a photodiode cannot hold is lost."""
    if electrons.dtype == np.uint32:
        return np.minimum(electrons, np.uint32(min(full_well_e, 2**32 - 1)))
    return np.minimum(electrons, full_well_e)
