"""Rahman, Haque & Kim, "Indoor positioning by LED visible light communication and image sensors", International
Journal of Electrical and Computer Engineering 1(2), 2011: ranges from two image sensors, position by least squares.

Published, as far as known from its abstract and Huynh & Yoo 2016 (their [14]): four LEDs send their positions to two
image sensors near the unknown position, which follows from the geometry of the LEDs' images on both, without measuring
angles; distances first, then quadratic equations; LEDs may have to be shifted slightly along z; a few centimetres in
simulation, 15 cm in Huynh & Yoo's Table 3, better with higher resolution or a longer baseline; sensors parallel to the
ceiling.

Chosen here: the sensors lie in one plane, and a range follows from the disparity (`estimator.solvers.stereo`);
centroids; the position is that of this frame's camera. The differences of the quadratic equations are solved by linear
least squares for x and y, and z follows from the spheres (`position_from_ranges`): shifting LEDs along z does not
determine the height, see `position_by_shifted_leds`. Ranges from disparity do not change when both cameras tilt
together, so in this form the cameras need not be level.
"""

import numpy as np

from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.stereo import led_vectors
from estimator.solvers.trilateration import position_from_ranges
from estimator.spots.correspondences import led_positions_m


def rahman2011(frame: DeviceFrame) -> Estimate:
    """Position from ranges by disparity, by linear least squares; raises EstimationFailure."""
    correspondences, vectors_m = led_vectors(frame)
    distances_m = np.linalg.norm(vectors_m, axis=1)
    ranges_m = {one.led.id: float(d) for one, d in zip(correspondences, distances_m, strict=True)}
    try:
        return Estimate(position_from_ranges(led_positions_m(correspondences), distances_m), ranges_m)
    except EstimationFailure as failure:
        raise EstimationFailure(failure.stage, failure.why, ranges_m) from None


RAHMAN2011 = Variant(
    "rahman2011",
    "Rahman et al. 2011: ranges from two parallel cameras, least squares",
    rahman2011,
    needs=Needs(3, sensors=("second camera",)),
)
