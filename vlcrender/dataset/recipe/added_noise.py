"""Noise of a given level beside the sensor's own: the readings of a noise level in decibels that are in use.

Huynh & Yoo 2016, Fig. 9, has levels of 0 to -9 dB and does not say of what. Each reading gives another verdict.
"""

from collections.abc import Sequence
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from vlcrender.camera.roi import RegionImage
from vlcrender.config.toml_model import Settings, key_error
from vlcrender.dataset.recipe.auto_exposure import MIN_LEVEL_DB, NoiseLevelMetering
from vlcrender.sensor.sensor import Sensor


class AddedNoise(Settings):
    """A noise level: noise power over the power that `relative_to` names.

    "photon" adds nothing to the sensor's noise: it sets the exposure time, in place of `exposure_s` and [exposure]. All
    others add normal noise of mean 0 to the digital numbers before rounding, the same sigma in all pixels of a frame.
    The powers are of the frame without noise, in digital numbers above the black level, clipped where pixels saturate.
    The device is not told; `bound` and the error budget count it as noise of the pixels.
    """

    level_db: Annotated[float, Field(ge=-100, le=30)]
    """Noise power over the power that `relative_to` names, dB."""
    relative_to: Literal["photon", "peak", "image-variance", "full-scale"]
    """"photon": the exposure time gives the brightest LED pixel 10^(-level_db / 10) electrons, at least -60 dB, at most
    1 s. sigma^2 = 10^(level_db / 10) times: "peak", the square of the brightest pixel that is read out;
    "image-variance", the variance of all pixels of a full frame; "full-scale", the square of the ADC's range above the
    black level."""

    @model_validator(mode="after")
    def _a_time_can_give_the_level(self) -> Self:
        if self.relative_to == "photon" and self.level_db < MIN_LEVEL_DB:
            raise key_error("level_db", f'is {self.level_db:g}; with relative_to = "photon" at least {MIN_LEVEL_DB:g}')
        return self

    @property
    def metering(self) -> NoiseLevelMetering | None:
        """The exposure control that gives the level; None where noise is added instead."""
        if self.relative_to != "photon":
            return None
        return NoiseLevelMetering(kind="noise-level", level_db=self.level_db)

    def sigma_dn(self, sensor: Sensor, expected_e: Sequence[RegionImage]) -> float | None:
        """Standard deviation of the added noise in a frame, digital numbers; None where none is added.

        expected_e: the frame's regions in electrons, a full frame for "image-variance".
        """
        if self.relative_to == "photon":
            return None
        amplitude = 10 ** (self.level_db / 20)
        if self.relative_to == "full-scale":
            return amplitude * (sensor.largest_dn - sensor.black_level_dn)
        clipped = [np.minimum(image, sensor.saturation_e) for _, image in expected_e]
        if self.relative_to == "peak":
            size_e = max(float(image.max()) for image in clipped)
        else:
            (whole,) = clipped
            size_e = float(whole.std(dtype=np.float64))
        return amplitude * size_e / sensor.gain_at_iso_e_per_dn
