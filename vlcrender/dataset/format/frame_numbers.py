"""Numbers of a frame that the summary of a set is made of, and the summary as dataset.json has it."""

from collections.abc import Sequence

import numpy as np

from vlcrender.camera.roi import RegionImage
from vlcrender.config.toml_model import Settings
from vlcrender.rendering.expected_image import ExpectedImage
from vlcrender.sensor.sensor import Sensor

MAX_SAMPLES = 10_000
"""Pixels of a region's background, or somewhat more, of which the median is taken, evenly spread."""


class FrameNumbers(Settings):
    """Numbers of one frame, before its noise."""

    pixels: int
    """Pixels that are read out."""
    saturated: int
    """Those whose mean is at the full well or at the upper limit of the ADC."""
    brightest_e: float
    """Mean electrons of the brightest pixel, before saturation."""
    background_e: float
    """Median of the background without LEDs, electrons: of full frames mostly the ceiling."""

    @classmethod
    def of(
        cls, image: ExpectedImage, expected_e: Sequence[RegionImage], sensor: Sensor, exposure_s: float
    ) -> "FrameNumbers":
        """The numbers of a frame: `image` its view a second, `expected_e` the electrons of its exposure."""
        limit_e = sensor.saturation_e - (sensor.dark_electrons(exposure_s) if sensor.noise == "full" else 0.0)
        samples = []
        for part in image.parts:
            step = max(1, int(np.sqrt(part.roi.pixels * len(image.parts) / MAX_SAMPLES)))
            samples.append(part.background_e_per_s[::step, ::step].ravel())
        return cls(
            pixels=sum(roi.pixels for roi, _ in expected_e),
            saturated=sum(int(np.count_nonzero(electrons >= limit_e)) for _, electrons in expected_e),
            brightest_e=max(float(electrons.max()) for _, electrons in expected_e),
            background_e=float(np.median(np.concatenate(samples))) * exposure_s,
        )


class LedCounts(Settings):
    """Numbers of LEDs that are whole in a frame, over all frames."""

    min: int
    median: float
    max: int


class Summary(Settings):
    """What a set is like, for a person to check."""

    saturated_share: float | None
    """Share of the pixels read out that are saturated; None where a frame's numbers are not known."""
    leds: LedCounts
    field_of_view_deg: dict[str, float]
    """Angle of view across of each camera, degrees."""
    brightest_e: float | None
    """Electrons of the brightest pixel of all frames, before saturation; None as `saturated_share`."""
    background_e: float | None
    """Median over frames of the background without LEDs, electrons; None as `saturated_share`."""
    saturation_e: float
    """Electrons at which a pixel saturates."""
    bytes: int
    """Sizes of all files of frames, and of the tables."""
    warnings: tuple[str, ...]
    """What is odd."""
