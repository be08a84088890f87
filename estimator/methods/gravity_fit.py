"""MAP fit: generalised least squares of the reprojection errors, with a Gaussian gravity prior.

Spots are weighted by the covariance of their centroids and of the errors of camera and map that the device states
(`estimator.solvers.uncertainty`), the accelerometer's reading by its standard deviation on each tilt axis. Where the
device states no errors and the residuals reveal none, camera and map are taken as exact; `estimator.solvers.robust_fit`
says what is assumed otherwise. The model includes the eccentricity of discs and squares
(`estimator.solvers.observations`). LEDs in a plane have two poses of nearly equal reprojection error, LEDs close to one
line a continuum of them; both poses are initial values, and gravity decides. Wrong identities are excluded by
consensus. With a rolling shutter the velocity of the camera is fitted as well, with the gyroscope's reading or a hand's
motion as a prior (`estimator.solvers.shutter_motion`).
"""

import weakref
from collections.abc import Sequence
from itertools import combinations, islice

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import Pose
from estimator.io.device import DeviceFrame
from estimator.methods.camera_statement import Judged, over_frames
from estimator.methods.centroid_sigma import with_centroid_sigma
from estimator.methods.pnp import candidates, in_a_plane
from estimator.methods.up2p import upright_pairs, upright_pose
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.observations import Observations, centroid_images, observe, observe_once
from estimator.solvers.robust_fit import Consensus, consensus
from estimator.solvers.trilateration import determine_orientation
from estimator.spots.correspondences import find_correspondences
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]

# Another minimum with more than a hundredth of the best one's likelihood is possible: exp(-9.21 / 2) = 1 / 100.
AMBIGUOUS_CHI2 = 9.21
# Every triple of 7 LEDs; of 12 LEDs, half of them outliers, one triple in nine holds inliers alone.
MAX_TRIPLES = 72
# Distance within which the pose from three noisy spots puts another spot.
TRIPLE_PX = 3.0
MAX_TRIPLE_STARTS = 3
MIN_FOR_IPPE = 4


def gravity_fit(frame: DeviceFrame, centroid_sigma_px: float = 0.0) -> Estimate:
    """Position, its covariance, and whether another position is nearly as likely; raises EstimationFailure.

    `centroid_sigma_px` is the standard deviation of centroids by errors that the device does not state.
    """
    return judged(frame, centroid_sigma_px).estimate


def judged(frame: DeviceFrame, centroid_sigma_px: float = 0.0) -> Judged:
    """The same, and what the frame says of its camera."""
    observations = observe_once(frame, find_correspondences(frame), centroid_sigma_px)
    agreed = agreement_of(frame, observations, centroid_sigma_px)
    return judged_by(agreed)


def fit_correspondences(
    frame: DeviceFrame, correspondences: Sequence[Correspondence], centroid_sigma_px: float = 0.0
) -> Estimate:
    """The estimate from identified spots; of the frame, camera, accelerometer and map are used."""
    return judged_by(agreement(observe(frame, correspondences, centroid_sigma_px))).estimate


def judged_by(agreed: Consensus) -> Judged:
    """The estimate of a consensus, and what it says of the camera."""
    estimate = Estimate(agreed.best.pose.position_m, covariance_m2=agreed.covariance_m2, ambiguous=ambiguous(agreed))
    return Judged(estimate, agreed.contradicted, agreed.doubt_m2)


def agreement(observations: Observations) -> Consensus:
    """Consensus of spots and gravity, or of the spots alone if gravity disagrees; raises EstimationFailure."""

    def more_starts() -> list[Pose]:
        return [*upright_pairs(observations), *_from_triples(observations)]

    gravity_optional = determine_orientation(observations.leds_m)
    return consensus(observations, initial_poses(observations), more_starts, gravity_optional)


def agreement_of(frame: DeviceFrame, observations: Observations, centroid_sigma_px: float = 0.0) -> Consensus:
    """`agreement` of a frame's own spots, as observed with `centroid_sigma_px`, once for all variants of the frame."""
    # The reference does not keep the frame, which holds the results, and no other frame equals it.
    key = "agreement", weakref.ref(frame), centroid_sigma_px
    return frame.once(key, lambda: agreement(observations))


def ambiguous(agreed: Consensus) -> bool:
    """Whether another local minimum has at least a hundredth of the best one's likelihood."""
    return any(other.cost - agreed.best.cost < AMBIGUOUS_CHI2 for other in agreed.others)


def initial_poses(observations: Observations) -> list[Pose]:
    """Initial poses: the upright one by gravity, and without gravity IPPE's two, or SQPNP's for LEDs in no plane."""
    starts = [pose for pose in [upright_pose(observations)] if pose is not None]
    if len(observations.leds_m) >= MIN_FOR_IPPE:
        centre = observations.leds_m.mean(axis=0)
        method = cv2.SOLVEPNP_IPPE if in_a_plane(observations.leds_m) else cv2.SOLVEPNP_SQPNP
        model, image = (
            np.ascontiguousarray(observations.leds_m - centre),
            np.ascontiguousarray(observations.still_image),
        )
        found = candidates(model, image, method, refined=False)
        starts += [Pose(centre - R_cam_world.T @ shift, R_cam_world) for R_cam_world, shift in found]
    return starts


def _from_triples(observations: Observations) -> list[Pose]:
    """Poses from three spots each (P3P) with the smallest reprojection errors of the other spots, truncated."""
    count = len(observations.leds_m)
    triples = list(combinations(range(count), 3))
    if len(triples) > MAX_TRIPLES:
        generator = np.random.Generator(np.random.Philox(key=count))
        triples = [triples[k] for k in generator.choice(len(triples), MAX_TRIPLES, replace=False)]
    gate = TRIPLE_PX * observations.camera.pixel_angle_rad
    if observations.motion is not None and (upright := upright_pose(observations)) is not None:
        gate += float(np.sqrt(np.diag(observations.motion.covariance(observations.leds_m, upright)).max()))
    gate2, image = gate**2, observations.still_image
    ranked: list[tuple[float, int, Pose]] = []
    for triple in triples:
        chosen = list(triple)
        try:
            _, vectors, shifts = cv2.solveP3P(
                observations.leds_m[chosen], image[chosen], np.eye(3), None, flags=cv2.SOLVEPNP_P3P
            )
        except cv2.error:
            continue
        for vector, shift in zip(vectors, shifts, strict=True):
            R_cam_world = cv2.Rodrigues(vector)[0]
            pose = Pose(-R_cam_world.T @ shift.ravel(), R_cam_world)
            offset = centroid_images(pose, observations.leds_m, observations.lift_m2)[0] - image
            error = float(np.minimum((offset**2).sum(axis=1), gate2).sum())
            # Of three LEDs on one line the solver may return NaN, which has no place in an order.
            if np.isfinite(error):
                ranked.append((error, len(ranked), pose))
    return [pose for *_, pose in islice(sorted(ranked, key=lambda one: one[:2]), MAX_TRIPLE_STARTS)]


def gravity_fit_with(name: str) -> Variant:
    """The variant `gravity-fit:centroid-sigma=PIXELS`; raises InputError."""
    return with_centroid_sigma(name, gravity_fit)


GRAVITY_FIT = over_frames(
    "gravity-fit",
    "reprojection fit of position and orientation, gravity as a prior, wrong LEDs left out, with covariance",
    judged,
    Needs(3, optional=("accelerometer", "gyroscope")),
)
