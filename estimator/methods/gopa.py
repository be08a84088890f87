"""GOPA: Hosseinianfar, Chizari & Salehi, "GOPA: geometrical optics positioning algorithm using spatial color coded LEDs
(extended version)", arXiv 1807.06931, 2018: angles of arrival on a virtual level plane.

Published, as far as known from its abstract: a smartphone's front camera and accelerometer; LEDs are told apart by the
colours around them; by the phone's inclination the image is taken to a virtual plane, which is level and has no limited
field of view; the position follows from angles of arrival, on the device; mean errors in an experiment 0.54 cm in two
dimensions, and in three 1.24 cm level, 1.85 cm turned, 6.02 cm tilted and turned.

Chosen here: identities are given; centroids; the angles of arrival are the leveled lines of sight. On the virtual plane
the image of LEDs at one height is their plane, turned by the yaw, which follows by least squares; the position is the
point nearest to all lines of sight through their LEDs (`estimator.methods.up2p.upright_pose`). LEDs at unequal heights
disturb the yaw.
"""

from estimator.camera.leveling import tilt_from_gravity
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.up2p import upright_pose
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.observations import observe
from estimator.spots.correspondences import find_correspondences


def gopa(frame: DeviceFrame) -> Estimate:
    """Position from leveled lines of sight; raises EstimationFailure."""
    tilt_from_gravity(frame.accelerometer_m_s2)
    observations = observe(frame, find_correspondences(frame))
    pose = upright_pose(observations)
    if pose is None:
        raise EstimationFailure("position", f"LEDs identified: {len(observations.leds_m)}, needed: 2, apart and above")
    return Estimate(pose.position_m)


GOPA = Variant(
    "gopa",
    "Hosseinianfar et al. 2018: a virtual level plane by gravity, angles of arrival, least squares",
    gopa,
    needs=Needs(2, sensors=("accelerometer",)),
)
