"""LC-VLP: Pan, Yang, Wei, Zhu, Wang, Wu & Nie, "Visible light positioning with Lamé curve LEDs: a generic approach for
camera pose estimation", arXiv 2602.01577, 2026: the pose under which contours are Lamé curves on the LEDs' plane.

Published, as far as known from its abstract: Lamé curves, |x / a|^k + |y / b|^k = 1, stand for all common shapes of
LEDs, which send their curves' parameters; the pose is the solution of nonlinear least squares, by iteration; the
initial value is that of a perspective-n-point method without correspondences (FreePnP); better than perspective arcs by
30 % and more in simulation, and below 4 cm in experiments.

Chosen here: a residual is the distance of a point of the contour, taken to the LED's plane along its line of sight,
from the curve, measured along the line from the LED's centre, metres: a (|x / a|^k + |y / a|^k)^(1 / k) - a. The map
says the parameters: k = 2 for a disc and infinity for a square, both of equal semi-axes a. Identities are given, so the
initial value in FreePnP's place is the best pair's pose by `up2p`, which uses gravity; the fit does not.
Levenberg-Marquardt by SciPy on the position and a rotation vector.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from estimator.camera.leveling import tilt_from_gravity
from estimator.camera.pose import Pose
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.up2p import check_poselib, pair_poses
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.observations import observe
from estimator.spots.contours import Contour, find_contours
from estimator.spots.correspondences import find_correspondences

Floats = NDArray[np.float64]

EXPONENTS = {"disc": 2.0, "square": np.inf}
MIN_LEDS = 2


@dataclass(frozen=True, eq=False)
class Curve:
    """Lamé curve of equal semi-axes `half_m` and exponent `k` about `centre_m` (3,), and its contour (n, 2) in view."""

    centre_m: Floats
    half_m: float
    k: float
    image: Floats

    @classmethod
    def of(cls, contour: Contour) -> "Curve":
        """The curve of an LED."""
        led = contour.led
        return cls(np.array(led.position_m), led.half_width_m, EXPONENTS[led.shape], contour.image)

    def residuals_m(self, pose: Pose) -> Floats:
        """Distances (n,) of the contour from the curve on its plane, metres; positive outside."""
        rays = np.column_stack([self.image, np.ones(len(self.image))]) @ pose.R_cam_world
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (self.centre_m[2] - pose.position_m[2]) / rays[:, 2]
            points_m = pose.position_m[:2] + depth[:, None] * rays[:, :2] - self.centre_m[:2]
        return np.asarray(np.linalg.norm(points_m, ord=self.k, axis=1) - self.half_m)


def lc_vlp(frame: DeviceFrame) -> Estimate:
    """Position from the contours of all identified LEDs; raises EstimationFailure."""
    check_poselib()
    tilt_from_gravity(frame.accelerometer_m_s2)
    curves = [Curve.of(contour) for contour in find_contours(frame)]
    starts = pair_poses(observe(frame, find_correspondences(frame)))
    if not starts or len(curves) < MIN_LEDS:
        raise EstimationFailure("position", f"LEDs identified: {len(curves)}, needed: {MIN_LEDS}")
    return Estimate(fit_curves(curves, starts[0]).position_m)


def fit_curves(curves: Sequence[Curve], start: Pose) -> Pose:
    """Pose with the least squared residuals of the curves, from an initial one; raises EstimationFailure."""

    def pose_of(step: Floats) -> Pose:
        turned = Rotation.from_rotvec(step[3:]).as_matrix() @ start.R_cam_world
        return Pose(start.position_m + step[:3], np.asarray(turned))

    def residuals(step: Floats) -> Floats:
        pose = pose_of(step)
        return np.concatenate([curve.residuals_m(pose) for curve in curves])

    try:
        found = least_squares(residuals, np.zeros(6), method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    except ValueError:
        raise EstimationFailure("position", "a contour meets the horizon of its initial pose") from None
    pose = pose_of(found.x)
    if not (found.success and all(pose.position_m[2] < curve.centre_m[2] for curve in curves)):
        raise EstimationFailure("position", "the fit of the contours does not converge below the LEDs")
    return pose


LC_VLP = Variant(
    "lc-vlp",
    "Pan et al. 2026: contours as Lamé curves on the LEDs' plane, nonlinear least squares from a pair's pose",
    lc_vlp,
    needs=Needs(2, sizes=True, sensors=("accelerometer",), package="poselib"),
)
