"""Automatic exposure: the time at which a frame's expected image reaches a target. The image is linear in time."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from vlcrender.config.toml_model import Settings
from vlcrender.rendering.expected_image import ExpectedImage

LongestTime = Annotated[float, Field(gt=0, le=100)]
"""Seconds; also the exposure of a frame that shows nothing to meter."""


class PeakMetering(Settings):
    """Expose until the brightest pixel of the noise-free image holds a share of what saturates it."""

    kind: Literal["peak"]
    share_of_saturation: Annotated[float, Field(gt=0, le=1)]
    max_s: LongestTime

    def time_s(self, view: ExpectedImage, saturation_e: float) -> float:
        """Exposure time of a view, seconds."""
        rate = max(float(part.expected_electrons(1.0).max()) for part in view.parts)
        return _time_s(self.share_of_saturation * saturation_e, rate, self.max_s)


class NoiseLevelMetering(Settings):
    """Expose for a noise level at the brightest LED pixel of the noise-free image: of photon noise of mean lambda,
    noise power over signal power is 1 / lambda, -10 log10(lambda) dB.

    Our reading of the noise levels of Huynh & Yoo 2016, Fig. 9, which the paper does not define.
    """

    kind: Literal["noise-level"]
    level_db: Annotated[float, Field(ge=-60, le=30)]
    max_s: LongestTime = 1.0

    def time_s(self, view: ExpectedImage, saturation_e: float) -> float:
        """Exposure time of a view, seconds; the sensor does not matter."""
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
