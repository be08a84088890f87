"""Rahman, Haque & Kim, "Indoor positioning by LED visible light communication and image sensors", International
Journal of Electrical and Computer Engineering 1(2), 2011: ranges from two image sensors, position by least squares.

Known of it, from its abstract and Huynh & Yoo 2016 (their [14]): four LEDs send their positions to two image sensors
near the unknown position, which follows from the geometry of the LEDs' images on both, without measuring angles;
distances first, then quadratic equations; LEDs may have to be moved slightly in z; a few centimetres in simulation,
15 cm in Huynh & Yoo's Table 3, better with higher resolution or more way between the sensors; sensors parallel to the
ceiling.

Filled in: the sensors lie in one plane, and a range follows from the disparity (stereo.py); centroids; the position is
this frame's own camera's. The differences of the quadratic equations are solved by linear least squares for x and y,
and z comes from the spheres (position_from_ranges): moving LEDs in z finds no height, see position_by_shifted_leds.
Ranges from disparity do not change when both cameras tilt together, so in this form nothing has to be level.
"""

import numpy as np

from estimator.errors import EstimationFailure
from estimator.io.dataset import DeviceFrame
from estimator.solvers.stereo import led_vectors
from estimator.solvers.trilateration import position_from_ranges
from estimator.spots.correspondences import led_positions_m
from estimator.variants.variant import Estimate, Variant


def rahman2011(frame: DeviceFrame) -> Estimate:
    """Position from ranges by disparity, by linear least squares. May fail by name."""
    seen, vectors_m = led_vectors(frame)
    distances_m = np.linalg.norm(vectors_m, axis=1)
    ranges_m = {correspondence.led.id: float(d) for correspondence, d in zip(seen, distances_m, strict=True)}
    try:
        return Estimate(position_from_ranges(led_positions_m(seen), distances_m), ranges_m)
    except EstimationFailure as failure:
        raise EstimationFailure(failure.stage, failure.why, ranges_m) from None


RAHMAN2011 = Variant("rahman2011", "Rahman et al. 2011: ranges from two parallel cameras, least squares", rahman2011)
