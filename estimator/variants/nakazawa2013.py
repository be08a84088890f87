"""Nakazawa et al., "Indoor positioning using a high-speed, fish-eye lens-equipped camera in visible light
communication", Indoor Positioning and Indoor Navigation 2013: the collinearity equations with a fish-eye lens.

Known of it, from its abstract and that of their paper of 2014: a high-speed CMOS camera (up to 48 kHz) behind a
fish-eye lens of 160 to 180 deg; lamps send identities at 9.6 kbit/s in 4-PPM; they are found in the image of the
ceiling, and the position follows from the relation of fish-eye image coordinates and world coordinates; within 10 cm.
No accelerometer is named. Huynh & Yoo 2016 (their [13]) add: the collinearity condition, any orientation, and an
accuracy that suffers from the lens's distortion, for which calibration is needed.

Filled in: the lens is equidistant, and exactly so, for the dataset says so (theirs had to be calibrated); the
equations are fitted where the image is, on the sensor, and so with even weights there; centroids, Gauss-Newton, at
least four LEDs, and the initial value as in yoshino2008.
"""

import numpy as np

from estimator.errors import EstimationFailure
from estimator.io.dataset import DeviceFrame
from estimator.solvers.collinearity import position_by_collinearity
from estimator.spots.correspondences import centroids_px, correspondences, led_positions_m
from estimator.variants.variant import Estimate, Variant


def nakazawa2013(frame: DeviceFrame) -> Estimate:
    """Position from the centroids of one frame of a fish-eye lens. May fail by name."""
    if frame.camera.projection != "equidistant":
        raise EstimationFailure("camera", "has a normal lens, needed a fish-eye")
    seen = correspondences(frame)
    on_sensor = np.column_stack([centroids_px(seen), np.ones(len(seen))]) @ np.linalg.inv(frame.camera.matrix()).T
    return Estimate(position_by_collinearity(led_positions_m(seen), on_sensor[:, :2], "equidistant"))


NAKAZAWA2013 = Variant(
    "nakazawa2013", "Nakazawa et al. 2013: collinearity equations, a fish-eye lens, no gravity", nakazawa2013
)
