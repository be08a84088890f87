"""Option of variants that fit centroids: `NAME:centroid-sigma=PIXELS`, the error that the device does not state.

It is the standard deviation of each coordinate of a centroid, in pixels, beside that by the pixels' noise: for a map, a
camera or an image that is not as exact as the noise, where the device says nothing of their errors.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

from estimator.errors import InputError
from estimator.io.device import DeviceFrame
from estimator.methods.variant import Estimate, Variant

OPTION = "centroid-sigma"
MAX_SIGMA_PX = 1000.0


@dataclass(frozen=True)
class WithCentroidSigma:
    """A method as a function of a frame alone, with a standard deviation of centroids, pixels."""

    method: Callable[[DeviceFrame, float], Estimate]
    sigma_px: float

    def __call__(self, frame: DeviceFrame) -> Estimate:
        """The method's estimate; raises EstimationFailure."""
        return self.method(frame, self.sigma_px)


def with_centroid_sigma(name: str, method: Callable[[DeviceFrame, float], Estimate]) -> Variant:
    """The variant `NAME:centroid-sigma=PIXELS`; raises InputError for another option or a value that is not allowed."""
    base, _, options = name.partition(":")
    option, equals, value = options.partition("=")
    if option != OPTION or not equals:
        raise InputError(f"variant {name}: {options!r} is no option; allowed: {OPTION}=PIXELS")
    # No exponent or sign: the text is a file name.
    if not re.fullmatch(r"\d+(\.\d+)?", value) or not float(value) <= MAX_SIGMA_PX:
        raise InputError(f"variant {name}: {OPTION}={value!r} is not a number of pixels from 0 to {MAX_SIGMA_PX:.0f}")
    summary = f"{base} with a further standard deviation of {value} px in each coordinate of a centroid"
    return Variant(name, summary, WithCentroidSigma(method, float(value)))
