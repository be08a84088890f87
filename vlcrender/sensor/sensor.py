"""The sensor: parameters of an EMVA 1288 camera, in electrons up to the gain, and its quantisation.

The chain, in this order (`signal_chain.expose` runs it):

1. mean photoelectrons of each pixel, `expected_e`, after crosstalk
2. PRNU scales the mean. It is a spread of quantum efficiency: a pixel of response 1 + p has the Poisson variance
   (1 + p) mu; multiplying the drawn electrons would give (1 + p)^2 mu
3. dark current adds its mean electrons for the exposure time at the sensor's temperature; hot pixels have a dark
   current of their own in addition, exponentially distributed
4. one Poisson draw: the shot noise of light and dark current together
5. DSNU, a fixed pattern, is added
6. the full well clips, before anything is read out
7. read noise and the fixed offsets of row and column are added
8. the gain divides; ADC noise is added, in digital numbers
9. the number is rounded (not truncated), the black level is added, and the sum is clipped to 0 and the largest number

`noise = "shot"`, the default, has the Poisson draw as its only noise (steps 1, 4, 6, 8, 9): at 1 e/DN the difference of
two exposures is exactly Skellam. `noise = "none"` has no draw either.

Source: EMVA Standard 1288, Release 4.0 Linear (2021), sections 2 and 3. Differences: sigma_d is split into read and ADC
noise, and rows and columns have offsets, which Release 4.0 separates from DSNU.
"""

import math
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
"""Largest mean of `poisson`: beyond it the rounding of float32 in the kernels would bias the draws."""
SPREADS = ("prnu", "dsnu_e", "read_noise_e", "adc_noise_dn", "row_offset_e", "column_offset_e")
"""Keys that are standard deviations."""


class Sensor(Settings):
    """A sensor. The keys from `prnu` to `serial` have an effect with `noise = "full"` only."""

    bits: Literal[8, 10, 12, 14] = 12
    """Bits of the ADC: digital numbers run from 0 to 2^bits - 1."""
    gain_e_per_dn: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    """Electrons per digital number at `base_iso`: 1 / K of EMVA 1288."""
    iso: Iso = 100.0
    """ISO of the frames. Electrons per digital number fall in proportion: half as many at twice the ISO."""
    base_iso: Iso = 100.0
    """ISO at which `gain_e_per_dn` is given."""
    full_well_e: Annotated[float, Field(gt=0, le=MAX_WELL_E)] = 6000.0
    """Electrons that a pixel holds; more are lost."""
    black_level_dn: Annotated[int, Field(ge=0, le=16382)] = 0
    """Digital number of a pixel without signal; below the largest number."""
    noise: Literal["shot", "none", "full"] = "shot"
    """"shot": photon noise alone. "full": the whole chain. "none": rounded means."""
    crosstalk: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Share of a pixel's electrons that its four neighbours collect, a quarter each, 0 to 0.5. Electrons diffuse one by
    one: shot noise stays independent from pixel to pixel."""
    prnu: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Photoresponse nonuniformity: standard deviation of the pixels' response over its mean. Fixed pattern."""
    dark_current_e_s: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Dark current at `reference_temperature_c`, electrons a second in each pixel."""
    reference_temperature_c: Celsius = 25.0
    """Temperature at which `dark_current_e_s` is given, deg C."""
    dark_current_doubling_c: Annotated[float, Field(ge=1, le=100)] = 6.0
    """Temperature rise that doubles the dark current, deg C."""
    temperature_c: Celsius = 25.0
    """Temperature of the sensor during the frames, deg C."""
    hot_pixel_share: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    """Share of the pixels that are hot, 0 to 0.1. Fixed pattern."""
    hot_pixel_e_s: Annotated[float, Field(gt=0, le=1e9)] = 5000.0
    """Mean additional dark current of hot pixels at `reference_temperature_c`, electrons a second; exponentially
    distributed over them."""
    dsnu_e: Spread = 0.0
    """Dark signal nonuniformity: standard deviation of the pixels' offsets, electrons. Fixed pattern."""
    read_noise_e: Spread = 0.0
    """Standard deviation of the noise before the gain, electrons; new in each frame and pixel."""
    adc_noise_dn: Spread = 0.0
    """Standard deviation of the noise after the gain, digital numbers; new in each frame and pixel."""
    row_offset_e: Spread = 0.0
    """Standard deviation of the offsets that whole rows share, electrons. Fixed pattern."""
    column_offset_e: Spread = 0.0
    """Standard deviation of the offsets that whole columns share, electrons. Fixed pattern."""
    serial: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Number of the individual sensor: its fixed patterns derive from it and are the same in every frame."""
    mosaic: Literal["none", "rggb", "bggr", "grbg", "gbrg"] = "none"
    """Colours of the pixels (0, 0), (0, 1), (1, 0), (1, 1) as (row, column), repeated over the sensor."""
    quantum_efficiency: SiliconOrTable = "silicon"
    """Electrons per photon over wavelength: "silicon" (a 3 um deep photodiode), or a table of measured values."""

    @classmethod
    def preset(cls, name: str) -> Self:
        """The sensor of a preset, such as "phone-1.2um". Raises InputError with the names there are."""
        return check(preset("sensors", name)["sensor"], cls, f"sensor preset {name}")

    @model_validator(mode="after")
    def _black_level_leaves_room(self) -> Self:
        if self.black_level_dn >= self.largest_dn:
            raise ValueError(
                f"black_level_dn = {self.black_level_dn}: must be below {self.largest_dn}, the largest number "
                f"of {self.bits} bits"
            )
        return self

    @model_validator(mode="after")
    def _full_well_exceeds_the_noise(self) -> Self:
        noise_e = float(np.hypot(self.dark_noise_e, self.dsnu_e))
        if self.full_well_e <= noise_e:
            raise ValueError(
                f"full_well_e = {self.full_well_e:g}: must exceed the noise of {noise_e:.4g} e in the dark "
                "(read_noise_e, adc_noise_dn and dsnu_e together)"
            )
        return self

    @model_validator(mode="after")
    def _mosaic_has_its_colours(self) -> Self:
        coloured = self.quantum_efficiency != "silicon" and self.quantum_efficiency.coloured
        if (self.mosaic != "none") != coloured:
            raise ValueError(
                f'mosaic = "{self.mosaic}": give quantum_efficiency red, green and blue with a mosaic, values without'
            )
        return self

    @property
    def largest_dn(self) -> int:
        """Largest number of the ADC."""
        return int(2**self.bits - 1)

    @property
    def white_dn(self) -> int:
        """Digital number of a full well, or the largest number of the ADC where that is less."""
        return min(self.largest_dn, round(self.full_well_e / self.gain_at_iso_e_per_dn) + self.black_level_dn)

    @property
    def saturation_e(self) -> float:
        """Electrons at which a pixel saturates: the full well, or the upper limit of the ADC where that is less."""
        return min(self.full_well_e, (self.largest_dn - self.black_level_dn) * self.gain_at_iso_e_per_dn)

    @property
    def gain_at_iso_e_per_dn(self) -> float:
        """Electrons per digital number at the ISO of the frames: 1 / K of EMVA 1288."""
        return self.gain_e_per_dn * (self.base_iso / self.iso)

    @property
    def dark_noise_e(self) -> float:
        """Temporal noise of a pixel in the dark without dark current, electrons: sigma_d of EMVA 1288.

        Read and ADC noise, both normal and new in each frame; without the 1/12 DN^2 of rounding.
        """
        return float(np.hypot(self.read_noise_e, self.adc_noise_dn * self.gain_at_iso_e_per_dn))

    def dark_electrons(self, exposure_s: float) -> float:
        """Mean electrons of the dark current; double every `dark_current_doubling_c` (EMVA 1288, 2.6)."""
        doublings = (self.temperature_c - self.reference_temperature_c) / self.dark_current_doubling_c
        return float(self.dark_current_e_s * 2.0**doublings * exposure_s)

    def hot_electrons(self, exposure_s: float) -> float:
        """Mean electrons of the additional dark current over all hot pixels, which grows with temperature alike."""
        doublings = (self.temperature_c - self.reference_temperature_c) / self.dark_current_doubling_c
        return float(self.hot_pixel_e_s * 2.0**doublings * exposure_s)

    def acting(self) -> dict[str, Any]:
        """Sensor parameters in effect at the ISO, temperature and noise mode of the frames, as in dataset.json.

        Dark current, standard deviations and hot pixels are 0 unless `noise` is "full".
        """
        full = self.noise == "full"
        return {
            "bits": self.bits,
            "gain_e_per_dn": self.gain_at_iso_e_per_dn,
            "full_well_e": self.full_well_e,
            "black_level_dn": self.black_level_dn,
            "noise": self.noise,
            "crosstalk": self.crosstalk,
            "hot_pixel_share": self.hot_pixel_share if full else 0.0,
            "hot_pixel_e_s": self.hot_electrons(1.0) if full and self.hot_pixel_share > 0 else 0.0,
            "dark_current_e_s": self.dark_electrons(1.0) if full else 0.0,
            **{key: getattr(self, key) if full else 0.0 for key in SPREADS},
            "mosaic": self.mosaic,
        }

    def quantise(self, electrons: Electrons) -> NDArray[np.uint32]:
        """Digital numbers: round(e / gain) + black level, clipped to 0 and the largest number of the ADC."""
        gain = self.gain_at_iso_e_per_dn
        dn = np.rint(electrons / np.float64(gain)) + self.black_level_dn
        clipped: NDArray[np.uint32] = np.clip(dn, 0, self.largest_dn).astype(np.uint32)
        return clipped

    def binned(self, by: int) -> "Sensor":
        """The sensor with `by` x `by` pixels summed into one; digital numbers keep their range.

        Means grow by by^2, independent noise by `by`, and a row offset by by^1.5: `by` columns share each of `by`
        independent row offsets. Crosstalk across the border of the larger pixel falls with its circumference over its
        area; a larger pixel is hot if one of its pixels is.
        """
        means = {key: getattr(self, key) * by**2 for key in ("gain_e_per_dn", "full_well_e", "dark_current_e_s")}
        noise = {key: getattr(self, key) * by for key in ("dsnu_e", "read_noise_e")}
        shares = {key: getattr(self, key) / by for key in ("prnu", "adc_noise_dn")}
        offsets = {key: getattr(self, key) * by**1.5 for key in ("row_offset_e", "column_offset_e")}
        defects = {
            "crosstalk": self.crosstalk / by,
            "hot_pixel_share": -math.expm1(by**2 * math.log1p(-self.hot_pixel_share)),
        }
        return self.model_copy(update={**means, **noise, **shares, **offsets, **defects})


def clip_full_well(electrons: Electrons, full_well_e: float) -> Electrons:
    """Clip electrons at the full well."""
    return np.minimum(electrons, full_well_e)
