"""Yoshino, Haruyama & Nakagawa, "High-accuracy positioning system using visible LED lights and image sensor",
IEEE Radio and Wireless Symposium 2008: the collinearity equations with one normal lens.

Published, as far as known from Huynh & Yoo 2016 (their [12]) alone: one image sensor with a normal lens, LEDs that send
their positions, the collinearity condition solved in one step, any orientation, no noise reduction, 7 cm. The paper
itself was not available.

Chosen here: the spots are centroids of the raw image. The unknowns are position and rotation, by nonlinear least
squares with equal weights. The initial value, which is not published, is found from the spots
(`estimator.solvers.collinearity.starts`). The accelerometer is not used. At least four LEDs: with three, several poses
fit.
"""

from estimator.camera.projection import Perspective, projection_of
from estimator.camera.undistort import pinhole_image
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.collinearity import position_by_collinearity
from estimator.spots.correspondences import centroids_px, find_correspondences, led_positions_m


def yoshino2008(frame: DeviceFrame) -> Estimate:
    """Position from the centroids of one frame of a normal lens, undistorted; raises EstimationFailure."""
    if not isinstance(projection_of(frame.camera), Perspective):
        raise EstimationFailure("camera", "has a fish-eye lens, needed a normal one")
    correspondences = find_correspondences(frame)
    image = pinhole_image(centroids_px(correspondences), frame.camera)
    return Estimate(position_by_collinearity(led_positions_m(correspondences), image, Perspective()))


YOSHINO2008 = Variant(
    "yoshino2008",
    "Yoshino et al. 2008: collinearity equations, one normal lens, no gravity",
    yoshino2008,
    needs=Needs(4),
)
