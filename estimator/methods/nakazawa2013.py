"""Nakazawa et al., "Indoor positioning using a high-speed, fish-eye lens-equipped camera in visible light
communication", Indoor Positioning and Indoor Navigation 2013: the collinearity equations with a fish-eye lens.

Published, as far as known from its abstract and that of their paper of 2014: a high-speed CMOS camera (up to 48 kHz)
behind a fish-eye lens of 160 to 180 deg; LEDs send identities at 9.6 kbit/s in 4-PPM; they are detected in the image of
the ceiling, and the position follows from the relation of fish-eye image coordinates and world coordinates; within
10 cm. No accelerometer is named. Huynh & Yoo 2016 (their [13]) add: the collinearity condition, any orientation, and an
accuracy that is limited by the lens's distortion, which has to be calibrated.

Chosen here: the lens is exactly equidistant, as the dataset states (theirs had to be calibrated). The residuals are
those on the sensor, with equal weights there. Centroids, nonlinear least squares, at least four LEDs, and the initial
value as in `yoshino2008`.
"""

from estimator.camera.projection import Equidistant, projection_of
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.collinearity import position_by_collinearity
from estimator.spots.correspondences import centroids_px, find_correspondences, led_positions_m


def nakazawa2013(frame: DeviceFrame) -> Estimate:
    """Position from the centroids of one frame of a fish-eye lens; raises EstimationFailure."""
    projection = projection_of(frame.camera)
    if not isinstance(projection, Equidistant):
        raise EstimationFailure("camera", "has a normal lens, needed a fish-eye")
    correspondences = find_correspondences(frame)
    image = frame.camera.normalized(centroids_px(correspondences))
    return Estimate(position_by_collinearity(led_positions_m(correspondences), image, projection))


NAKAZAWA2013 = Variant(
    "nakazawa2013",
    "Nakazawa et al. 2013: collinearity equations, a fish-eye lens, no gravity",
    nakazawa2013,
    needs=Needs(4, sensors=("fish-eye lens",)),
)
