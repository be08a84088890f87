"""Yoshino, Haruyama & Nakagawa, "High-accuracy positioning system using visible LED lights and image sensor",
IEEE Radio and Wireless Symposium 2008: the collinearity equations with one normal lens.

Known of it, from Huynh & Yoo 2016 (their [12]) alone: one image sensor with a normal lens, LEDs that send their
positions, the collinearity condition solved in one step, any orientation, no noise reduction, 7 cm. The text itself
was not to be had.

Filled in: the spots are centroids of the raw image; the unknowns are position and rotation, by Gauss-Newton, all LEDs
weighted alike; the initial value, of which nothing is known, is found from the spots (collinearity.starts). No
accelerometer takes part. At least four LEDs: with three, several poses fit.
"""

import numpy as np

from estimator.camera.undistort import pinhole_pixels
from estimator.errors import EstimationFailure
from estimator.io.dataset import DeviceFrame
from estimator.solvers.collinearity import position_by_collinearity
from estimator.spots.correspondences import centroids_px, correspondences, led_positions_m
from estimator.variants.variant import Estimate, Variant


def yoshino2008(frame: DeviceFrame) -> Estimate:
    """Position from the centroids of one frame of a normal lens, whose distortion is undone. May fail by name."""
    if frame.camera.projection != "perspective":
        raise EstimationFailure("camera", "has a fish-eye lens, needed a normal one")
    seen = correspondences(frame)
    pixels = pinhole_pixels(centroids_px(seen), frame.camera)
    image = (np.column_stack([pixels, np.ones(len(seen))]) @ np.linalg.inv(frame.camera.matrix()).T)[:, :2]
    return Estimate(position_by_collinearity(led_positions_m(seen), image, "perspective"))


YOSHINO2008 = Variant(
    "yoshino2008", "Yoshino et al. 2008: collinearity equations, one normal lens, no gravity", yoshino2008
)
