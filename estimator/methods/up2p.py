"""Upright two-point pose: gravity gives the tilt, two LEDs then determine yaw and position.

`up2p` is PoseLib's upright two-point solver (Kukelova, Bujnak & Pajdla 2010) inside a RANSAC of this package, because
PoseLib's Python interface has the solver alone. The solver assumes gravity to be exact, so the error of the reading
displaces the other spots under the pose of a pair; the gate at which pairs are ranked includes that displacement. The
refinement then fits position and orientation to the spots that agree, without gravity. If these do not determine the
orientation (fewer than four, or on one line), or the device states errors of camera or map, beside which gravity
counts, gravity is used as a prior. The same holds where the residuals reveal errors that no camera explains, as of a
wrong map, unless gravity contradicts the spots.

With a rolling shutter the pairs are solved with the turns undone that the gyroscope says, and the refinement fits the
velocity with the pose, as `gravity-fit` does, with gravity as a prior.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from estimator.camera.leveling import MIN_ELEVATION_SINE
from estimator.camera.pose import POSE_PARAMETERS, Pose, rotation
from estimator.compiled import compact, compiled
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.camera_statement import Judged, over_frames
from estimator.methods.centroid_sigma import with_centroid_sigma
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.chi_square import pair_limit
from estimator.solvers.local_minima import minima
from estimator.solvers.observations import Observations, observe, observe_once
from estimator.solvers.robust_fit import Consensus, consensus
from estimator.solvers.trilateration import determine_orientation
from estimator.spots.correspondences import find_correspondences
from estimator.spots.identify import Correspondence

try:
    import poselib
except ImportError:
    poselib = None

Floats = NDArray[np.float64]

# Every pair of 16 LEDs.
MAX_PAIRS = 120
# Gate for inliers: standard deviations of the accelerometer, plus pixels for the centroids.
GATE_SIGMA = 3.0
GATE_PX = 3.0
MAX_PAIR_STARTS = 3
# Probability that spots alone contradict a true reading of gravity; its loss costs little.
GRAVITY_PROBABILITY = 1e-3
# World axes to PoseLib's, whose vertical axis is y.
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def up2p(frame: DeviceFrame, centroid_sigma_px: float = 0.0) -> Estimate:
    """Upright two-point RANSAC and refinement; raises EstimationFailure, also if PoseLib is not installed.

    `centroid_sigma_px` is the standard deviation of centroids by errors that the device does not state.
    """
    return judged(frame, centroid_sigma_px).estimate


def judged(frame: DeviceFrame, centroid_sigma_px: float = 0.0) -> Judged:
    """The same, and what the frame says of its camera."""
    check_poselib()
    correspondences = find_correspondences(frame)
    _check_gravity(frame)
    return _judged(observe_once(frame, correspondences, centroid_sigma_px))


def check_poselib() -> None:
    """Raise EstimationFailure if PoseLib is not installed."""
    if poselib is None:
        raise EstimationFailure("up2p", "PoseLib is not installed (pip install vlcrender[poselib])")


def fit_correspondences(
    frame: DeviceFrame, correspondences: Sequence[Correspondence], centroid_sigma_px: float = 0.0
) -> Estimate:
    """The estimate from identified spots; of the frame, camera, accelerometer and map are used."""
    _check_gravity(frame)
    return _judged(observe(frame, correspondences, centroid_sigma_px)).estimate


def _check_gravity(frame: DeviceFrame) -> None:
    if frame.accelerometer is None:
        raise EstimationFailure("leveling", "the device has no accelerometer")


def _judged(observations: Observations) -> Judged:
    starts = pair_poses(observations)

    def agreement(seen: Observations) -> Consensus:
        return consensus(seen, starts[:1], lambda: [*starts[1:], *upright_pairs(observations)])

    if determine_orientation(observations.leds_m) and not observations.displaced:
        agreed = agreement(observations.without_gravity())
        if agreed.adapted and not agreed.contradicted and _agrees_with_gravity(agreed, observations, starts[:1]):
            with suppress(EstimationFailure):
                agreed = agreement(observations)
    else:
        agreed = agreement(observations)
    estimate = Estimate(agreed.best.pose.position_m, covariance_m2=agreed.covariance_m2)
    return Judged(estimate, agreed.contradicted, agreed.doubt_m2)


def _agrees_with_gravity(alone: Consensus, observations: Observations, starts: Sequence[Pose]) -> bool:
    """Whether gravity agrees with a consensus of spots alone, whose errors are of a size by the residuals.

    The test is Fisher's: of the increase of chi-square by the two tilts, against the size's degrees of freedom.
    """
    beside = replace(alone.of_inliers(), tilt_sigma_rad=observations.tilt_sigma_rad)
    fits = minima(beside, [alone.best.pose, *starts])
    freedom = max(2 * int(alone.inliers.sum()) - POSE_PARAMETERS, 1)
    return bool(fits) and fits[0].chi2 - alone.best.chi2 <= pair_limit(GRAVITY_PROBABILITY, freedom)


def pair_poses(observations: Observations) -> list[Pose]:
    """Poses from two spots each with the smallest truncated reprojection errors of all spots, best first."""
    level, above = _leveled(observations)
    tilt_x, tilt_y = observations.tilt_rad.tolist()
    tilt = rotation(tilt_x, tilt_y)
    pairs = list(combinations(np.flatnonzero(above).tolist(), 2))
    if len(pairs) > MAX_PAIRS:
        generator = np.random.Generator(np.random.Philox(key=len(pairs)))
        pairs = [pairs[k] for k in generator.choice(len(pairs), MAX_PAIRS, replace=False)]
    gate = GATE_SIGMA * float(observations.tilt_sigma_rad.max()) + GATE_PX * observations.camera.pixel_angle_rad
    chosen, leds_up = np.array(pairs, dtype=np.int64).reshape(-1, 2), observations.leds_m @ Y_UP.T
    of_pairs = zip((level @ Y_UP.T)[chosen], leds_up[chosen], strict=True)
    found = [upright.Rt for level_up, leds_of_pair in of_pairs for upright in poselib.up2p(level_up, leds_of_pair)]
    if not found:
        return []
    solutions = np.array(found)
    errors = _truncated_errors(solutions, tilt @ Y_UP.T, leds_up, compact(observations.still_image), gate**2)
    poses = []
    for k in errors.argsort(kind="stable")[:MAX_PAIR_STARTS].tolist():
        R, t = solutions[k, :, :3], solutions[k, :, 3]
        poses.append(Pose(-(R.T @ t) @ Y_UP, tilt @ (Y_UP.T @ R @ Y_UP)))
    return poses


@compiled
def _truncated_errors(solutions: Floats, R_cam_level: Floats, leds_up: Floats, image: Floats, limit: float) -> Floats:
    """Sums (m,) of the squared distances, each at most `limit`, of spots from the images by PoseLib's solutions.

    `solutions` (m, 3, 4) map LEDs `leds_up` (n, 3), with a vertical y axis, to leveled axes of the same kind, and
    `R_cam_level` (3, 3) these to the camera's. The spots are `image` (n, 2), normalized; the eccentricity of centroids
    is far below the limit. An LED behind the camera counts with the limit.
    """
    errors = np.zeros(len(solutions))
    to_camera = np.empty((3, 4))
    for k in range(len(solutions)):
        for row in range(3):
            for column in range(4):
                to_camera[row, column] = 0.0
                for of in range(3):
                    to_camera[row, column] += R_cam_level[row, of] * solutions[k, of, column]
        (xx, xy, xz, x0), (yx, yy, yz, y0), (zx, zy, zz, z0) = to_camera[0], to_camera[1], to_camera[2]
        for i in range(len(leds_up)):
            x, y, z = leds_up[i, 0], leds_up[i, 1], leds_up[i, 2]
            depth, error2 = zx * x + zy * y + zz * z + z0, limit
            if depth > 0:
                off_x = (xx * x + xy * y + xz * z + x0) / depth - image[i, 0]
                off_y = (yx * x + yy * y + yz * z + y0) / depth - image[i, 1]
                error2 = min(off_x * off_x + off_y * off_y, limit)
            errors[k] += error2
    return errors


def upright_pose(observations: Observations) -> Pose | None:
    """Upright pose by least squares over all spots, an initial value; None if fewer than two are above the horizon.

    With LEDs at one height, the leveled image is the LEDs' plane rotated by the yaw, scaled by the height and shifted,
    which is linear in complex numbers. The position is then the point nearest to all lines of sight.
    """
    level, above = _leveled(observations)
    if above.sum() < 2:
        return None
    return _upright(rotation(*observations.tilt_rad.tolist()), level[above], observations.leds_m[above])


def upright_pairs(observations: Observations) -> list[Pose]:
    """Upright poses by pairs of spots, at most MAX_PAIRS: initial values for observations with outliers."""
    level, above = _leveled(observations)
    tilt = rotation(*observations.tilt_rad.tolist())
    pairs = list(combinations(np.flatnonzero(above).tolist(), 2))
    if len(pairs) > MAX_PAIRS:
        generator = np.random.Generator(np.random.Philox(key=len(pairs)))
        pairs = [pairs[k] for k in generator.choice(len(pairs), MAX_PAIRS, replace=False)]
    poses = [_upright(tilt, level[list(pair)], observations.leds_m[list(pair)]) for pair in pairs]
    return [pose for pose in poses if pose is not None]


def _upright(tilt: Floats, level: Floats, leds_m: Floats) -> Pose | None:
    """Upright pose by least squares from leveled unit vectors (n, 3) to LEDs (n, 3); None if they determine none.

    `tilt` (3, 3) maps leveled axes to the camera's.
    """
    image = (level[:, 0] + 1j * level[:, 1]) / level[:, 2]
    planar = leds_m[:, 0] + 1j * leds_m[:, 1]
    spread = planar - planar.mean()
    product = np.vdot(spread, image - image.mean())
    if product == 0:
        return None
    # Rz(yaw) maps x + iy to exp(-i yaw) (x + iy).
    turned = product / abs(product)
    yaw = np.array([[turned.real, -turned.imag, 0.0], [turned.imag, turned.real, 0.0], [0.0, 0.0, 1.0]])
    lines = level @ yaw
    across = np.eye(3) - lines[:, :, None] * lines[:, None, :]
    try:
        position_m = np.linalg.solve(across.sum(axis=0), (across @ leds_m[:, :, None]).sum(axis=0)[:, 0])
    except np.linalg.LinAlgError:
        return None
    return Pose(position_m, tilt @ yaw)


def _leveled(observations: Observations) -> tuple[Floats, NDArray[np.bool_]]:
    """Unit vectors (n, 3) to the spots in leveled axes by the accelerometer, and which of them point up."""
    rays = _rays(observations)
    level = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ rotation(*observations.tilt_rad.tolist())
    return level, level[:, 2] > MIN_ELEVATION_SINE


def _rays(observations: Observations) -> Floats:
    """Vectors (n, 3) to the spots at unit depth, camera axes, with the turns undone that the gyroscope says."""
    return np.column_stack([observations.still_image, np.ones(len(observations.image))])


def up2p_with(name: str) -> Variant:
    """The variant `up2p:centroid-sigma=PIXELS`; raises InputError."""
    return with_centroid_sigma(name, up2p)


UP2P = over_frames(
    "up2p",
    "PoseLib's upright two-point solver in RANSAC, tilt from gravity, then a fit of the spots that agree",
    judged,
    Needs(3, sensors=("accelerometer",), optional=("gyroscope",), package="poselib"),
)
