"""Received power: an LED image's light by Lambert's law, for methods that were made for a photodiode beside the camera.

The pupil receives from a small face of area A and radiance L, seen at the distance d, the angle phi off the face's
normal and the angle theta off the optical axis, the power L A cos(phi) cos(theta) D / d^2, with the pupil's area D. All
of it falls into the LED's image, whatever the lens does to its shape, so the image's flux over gain and exposure is the
photodiode's signal. dataset.json states no radiance: what is known are ratios, if the LEDs have one radiance.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]


def with_power(correspondences: Sequence[Correspondence]) -> list[Correspondence]:
    """The correspondences whose flux is measured and whole; raises EstimationFailure if there is none."""
    if not all(one.led.has_size for one in correspondences):
        raise EstimationFailure("power", "the map does not say how large its LEDs are")
    measured = [one for one in correspondences if np.isfinite(one.spot.flux_e)]
    if not measured:
        raise EstimationFailure("power", "the flux of LED images with stripes is not measured")
    whole = [one for one in measured if not one.spot.saturated]
    if not whole:
        raise EstimationFailure("power", "all LED images are saturated")
    return whole


def fluxes(correspondences: Sequence[Correspondence]) -> Floats:
    """Flux of each LED image over its face's mean square extent, (n,): proportional to L cos(phi) cos(theta) / d^2."""
    return np.array([one.spot.flux_e / (one.led.half_width_m**2 * _AREAS[one.led.shape]) for one in correspondences])


_AREAS = {"disc": np.pi, "square": 4.0}


def predicted_fluxes(vectors_m: Floats, up: Floats) -> Floats:
    """`fluxes` (n,) of horizontal faces at `vectors_m` (n, 3), up to a factor; `up` (3,) is the world's z.

    Both are in camera axes.
    """
    distances2 = (vectors_m**2).sum(axis=1)
    return np.asarray((vectors_m @ up) * vectors_m[:, 2] / distances2**2)
