"""Circle centres: "Correcting perspective distortion for circle centerpoint coordinates in camera based visible light
positioning", IEEE International Conference on Autonomous Robot Systems and Competitions (ICARSC) 2022, pp. 232-236:
perspective-n-point on ellipses' centres, corrected by its own pose.

Published, as far as known from its abstract: the centre of a tilted disc's image is not the image of the disc's centre;
an expression for the difference; OpenCV's solvePnP, unchanged, is repeated with the difference subtracted; no further
sensor; in a simulation with four discs and a tilt about one axis, two repetitions bring an error of up to 1 cm below
0.1 mm.

Chosen here: the ellipse's centre is that of a cone fitted to the contour of the LED's image, not the centroid of its
light, which a lens's fall-off moves as well. The difference is that of the dual conic's pole
(`estimator.solvers.cones.ellipse_centres`). The pose is that of `pnp`, which refines both solutions of a planar pattern
and keeps the better one; it is repeated until the position is still.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import Pose
from estimator.io.device import DeviceFrame
from estimator.methods.pnp import pose_from_pixels
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.cones import disc_cones, ellipse_centre, ellipse_centres

Floats = NDArray[np.float64]

METHODS = (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_IPPE)
CONVERGED_M = 1e-9
# Each repetition multiplies the error by some (radius / distance)^2.
MAX_ROUNDS = 10


def circle_centre(frame: DeviceFrame) -> Estimate:
    """Position from the centres of discs' images; raises EstimationFailure."""
    found = disc_cones(frame)
    centres = np.array([ellipse_centre(cone) for cone in found.cones])
    return Estimate(pose_from_centres(found.leds_m, found.radii_m, centres).position_m)


def pose_from_centres(leds_m: Floats, radii_m: Floats, centres: Floats) -> Pose:
    """Pose from discs at `leds_m` (n, 3) of `radii_m` (n,) and the centres (n, 2) of their ellipses at unit depth.

    Raises EstimationFailure as `pose_from_pixels`.
    """
    pose = pose_from_pixels(leds_m, centres, np.eye(3), METHODS)
    for _ in range(MAX_ROUNDS):
        p_cam = pose.in_camera(leds_m)
        off = ellipse_centres(p_cam, radii_m, pose.R_cam_world[:, 2]) - p_cam[:, :2] / p_cam[:, 2:]
        before, pose = pose, pose_from_pixels(leds_m, centres - off, np.eye(3), METHODS)
        if np.linalg.norm(pose.position_m - before.position_m) < CONVERGED_M:
            break
    return pose


CIRCLE_CENTRE = Variant(
    "circle-centre",
    "ICARSC 2022: perspective-n-point on the centres of discs' ellipses, corrected by its pose and repeated",
    circle_centre,
    needs=Needs(4, faces="disc", sizes=True),
)
