"""Automatic exposure: the time at which the expected image reaches a target; the image is linear in time.

Metering counts the mean of modulated light in time, whatever its phase in the frame.
"""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from vlcrender.config.toml_model import Settings
from vlcrender.rendering.expected_image import ExpectedImage

MaxTime = Annotated[float, Field(gt=0, le=100)]
"""Longest exposure time, seconds."""
MIN_LEVEL_DB = -60.0
"""Smallest noise level that an exposure time is chosen for: 10^6 electrons in a pixel."""


class PeakMetering(Settings):
    """Expose until the brightest pixel of the noise-free image holds a share of its saturation."""

    kind: Literal["peak"]
    """Metering method."""
    share_of_saturation: Annotated[float, Field(gt=0, le=1)]
    """Electrons of the brightest pixel over the electrons at which a pixel saturates."""
    max_s: MaxTime
    """Longest exposure time, seconds; also the time of a frame without light."""

    def time_s(self, view: ExpectedImage, saturation_e: float) -> float:
        """Exposure time of an expected image, seconds."""
        rate = max(float(part.expected_electrons(1.0).max()) for part in view.parts)
        return _time_s(self.share_of_saturation * saturation_e, rate, self.max_s)


class NoiseLevelMetering(Settings):
    """Expose for a noise level at the brightest LED pixel of the noise-free image.

    Photon noise of mean lambda has the noise power over signal power 1 / lambda, which is -10 log10(lambda) dB. This is
    our reading of the noise levels of Huynh & Yoo 2016, Fig. 9, which the paper does not define. `[added_noise]` with
    relative_to = "photon" is the same.
    """

    kind: Literal["noise-level"]
    """Metering method."""
    level_db: Annotated[float, Field(ge=MIN_LEVEL_DB, le=30)]
    """Noise power over signal power, dB."""
    max_s: MaxTime = 1.0
    """Longest exposure time, seconds; also the time of a frame without LED light."""

    def time_s(self, view: ExpectedImage, saturation_e: float) -> float:
        """Exposure time of an expected image, seconds; independent of the sensor's saturation."""
        rate = 0.0
        for part in view.parts:
            image = part.expected_electrons(1.0)
            lit = np.zeros(image.shape, dtype=bool)
            for patch in part.patches:
                lit[part.roi.slices(patch.roi)] |= patch.electrons_per_s > 0
            rate = max(rate, float(image[lit].max(initial=0.0)))
        return _time_s(10 ** (-self.level_db / 10), rate, self.max_s)


Metering = Annotated[PeakMetering | NoiseLevelMetering, Field(discriminator="kind")]


def _time_s(target_e: float, rate_e_s: float, max_s: float) -> float:
    return min(target_e / rate_e_s, max_s) if rate_e_s > 0 else max_s
