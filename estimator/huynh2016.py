"""Huynh & Yoo, Sensors 2016: denoise, find the LEDs, level by gravity, ranges from pairs, position from ranges."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.dataset import DeviceFrame
from estimator.denoise import REACH_PX, neighbourhood_mean
from estimator.errors import EstimationFailure
from estimator.identify import Sighting
from estimator.pipeline import Estimate
from estimator.position import position_from_ranges
from estimator.ranging import PairLaw, law_of_sines, led_ranges, printed_eq3
from estimator.rectify import level, rotation, tilt_from_gravity
from estimator.sighting import centroids_px, led_positions_m, sightings
from estimator.undistort import pinhole_pixels

Floats = NDArray[np.float64]


def huynh2016(frame: DeviceFrame) -> Estimate:
    """Huynh & Yoo 2016 with its slips corrected, and centroids in place of brightest pixels."""
    seen = sightings(frame, neighbourhood_mean, REACH_PX)
    return _two_step(frame, seen, centroids_px(seen), law_of_sines)


def huynh2016_as_printed(frame: DeviceFrame) -> Estimate:
    """Huynh & Yoo 2016 to the letter where the letter computes: brightest pixels and Eq. 3 with its extra cosines.

    Corrected are Eq. 2 (as printed its angles depend on the unit of length), Eq. 6 (its matrix is no rotation) and
    Algorithm 1 (the adjusted intensity is not said; it takes c - mu_S). Eq. 4 has no z with LEDs at one height: z is
    taken from the spheres, as in `huynh2016`, and not by moving LEDs in z.
    """
    seen = sightings(frame, neighbourhood_mean, REACH_PX)
    pixels = np.array([(sighting.spot.brightest_u_px, sighting.spot.brightest_v_px) for sighting in seen])
    return _two_step(frame, seen, pixels, printed_eq3)


def _two_step(frame: DeviceFrame, seen: Sequence[Sighting], pixels: Floats, pair_law: PairLaw) -> Estimate:
    """The paper's way from pixels (n, 2), once the lens is taken out: level them by gravity, ranges, position."""
    K = frame.camera.matrix()
    leds_m = led_positions_m(seen)
    level_px = level(pinhole_pixels(pixels, frame.camera), K, rotation(*tilt_from_gravity(frame.accelerometer_m_s2)))
    distances_m = led_ranges(level_px, K, leds_m, pair_law)
    ranges_m = {sighting.led.id: float(d) for sighting, d in zip(seen, distances_m, strict=True)}
    try:
        return Estimate(position_from_ranges(leds_m, distances_m), ranges_m)
    except EstimationFailure as failure:
        raise EstimationFailure(failure.stage, failure.why, ranges_m) from None
