"""Gravity gives the tilt: two LEDs then fix the rest, the yaw and the position.

`up2p` is PoseLib's upright two-point solver (Kukelova, Bujnak & Pajdla 2010) inside a RANSAC of our own, for its Python
interface has the solver alone. Gravity's reading counts here as free of error, so a pair's pose puts the other spots
wrong by as much as that error turns them; what is counted in favour of a pose is wide enough for this. The refinement
then leaves gravity out and fits position and orientation to the spots that agree. Where these cannot give an
orientation (fewer than four, or on one line), it takes the tilt as read.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from estimator.camera.leveling import MIN_SINE, rotation
from estimator.errors import EstimationFailure
from estimator.io.dataset import DeviceFrame
from estimator.solvers.reprojection import Observations, Pose, observations, projected
from estimator.solvers.robust_fit import consensus
from estimator.solvers.trilateration import fix_orientation
from estimator.spots.correspondences import correspondences
from estimator.spots.identify import Correspondence
from estimator.variants.variant import Estimate, Variant

try:
    import poselib
except ImportError:
    poselib = None

Floats = NDArray[np.float64]

# Every pair of 16 LEDs.
MAX_PAIRS = 120
# Spots are counted for a pose up to this many standard deviations of the reading, and some pixels for their centroids.
GATE_SIGMA = 3.0
GATE_PX = 3.0
BEST_PAIRS = 3
# World axes to PoseLib's, whose upright axis is y.
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def up2p(frame: DeviceFrame) -> Estimate:
    """Upright two-point RANSAC and refinement; raises EstimationFailure, also where PoseLib is not installed."""
    if poselib is None:
        raise EstimationFailure("up2p", "PoseLib is not installed (pip install vlcrender[poselib])")
    return fit_correspondences(frame, correspondences(frame))


def fit_correspondences(frame: DeviceFrame, sighted: Sequence[Correspondence]) -> Estimate:
    """The same from spots that are identified already; of the frame, its camera and gravity count."""
    seen = observations(frame, sighted)
    starts = _from_pairs(seen)
    if fix_orientation(seen.leds_m):
        seen = seen.without_gravity()
    agreed = consensus(seen, starts[:1], lambda: starts[1:])
    return Estimate(agreed.best.pose.position_m, covariance_m2=agreed.covariance_m2)


def _from_pairs(seen: Observations) -> list[Pose]:
    """The poses from two spots each that put most of the other spots about right, the best first."""
    pixel_rad = 1 / seen.camera.K[0][0]
    level, above = _leveled(seen)
    tilt = rotation(*seen.tilt_rad)
    pairs = list(combinations(np.flatnonzero(above).tolist(), 2))
    if len(pairs) > MAX_PAIRS:
        generator = np.random.Generator(np.random.Philox(key=len(pairs)))
        pairs = [pairs[k] for k in generator.choice(len(pairs), MAX_PAIRS, replace=False)]
    gate = GATE_SIGMA * float(seen.tilt_sigma_rad.max()) + GATE_PX * pixel_rad
    scored: list[tuple[float, int, Pose]] = []
    for pair in pairs:
        found = poselib.up2p(level[list(pair)] @ Y_UP.T, seen.leds_m[list(pair)] @ Y_UP.T)
        for upright in found:
            yaw = Y_UP.T @ upright.R @ Y_UP
            pose = Pose(tilt @ yaw, Y_UP.T @ upright.center())
            offset, depth = projected(pose, seen.leds_m, seen.lift_m2)
            off = np.where(depth > 0, ((offset - seen.plane) ** 2).sum(axis=1), np.inf)
            scored.append((float(np.minimum(off, gate**2).sum()), len(scored), pose))
    return [pose for *_, pose in sorted(scored, key=lambda one: one[:2])[:BEST_PAIRS]]


def upright_pose(seen: Observations) -> Pose | None:
    """The upright pose by least squares over all spots, as a start; None where fewer than two are above the horizon.

    With LEDs at one height the levelled plane is theirs turned by the yaw, made smaller by the height and moved, which
    is linear in complex numbers. The position is then the point nearest to all lines of sight.
    """
    level, above = _leveled(seen)
    if above.sum() < 2:
        return None
    rays, leds_m = level[above], seen.leds_m[above]
    image = (rays[:, 0] + 1j * rays[:, 1]) / rays[:, 2]
    planar = leds_m[:, 0] + 1j * leds_m[:, 1]
    spread = planar - planar.mean()
    turned = np.vdot(spread, image - image.mean())
    if turned == 0:
        return None
    # Rz(yaw) takes x + iy to exp(-i yaw) (x + iy).
    R_cam_world = rotation(*seen.tilt_rad) @ _about_z(-float(np.angle(turned)))
    lines = np.column_stack([seen.plane, np.ones(len(seen.plane))])[above] @ R_cam_world
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    across = np.eye(3) - lines[:, :, None] * lines[:, None, :]
    try:
        position_m = np.linalg.solve(across.sum(axis=0), (across @ leds_m[:, :, None]).sum(axis=0)[:, 0])
    except np.linalg.LinAlgError:
        return None
    return Pose(R_cam_world, position_m)


def _leveled(seen: Observations) -> tuple[Floats, NDArray[np.bool_]]:
    """Lines of sight with the tilt as read taken out, (n, 3) of unit length, and which of them go up."""
    rays = np.column_stack([seen.plane, np.ones(len(seen.plane))])
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ rotation(*seen.tilt_rad)
    return rays, rays[:, 2] > MIN_SINE


def _about_z(yaw: float) -> Floats:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


UP2P = Variant(
    "up2p", "PoseLib's upright two-point solver in RANSAC, tilt from gravity, then a fit of the spots that agree", up2p
)
