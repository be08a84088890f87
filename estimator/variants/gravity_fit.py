"""The pose that best explains spots and gravity together: reprojection errors weighed, the reading of gravity a prior.

Nobody's method in particular: what one would build today. Spots weigh by the covariance of their centroids; the
accelerometer's reading by its standard deviation on each tilt axis; the images of discs and squares are taken for what
they are (`solvers/reprojection.py`). LEDs in a plane have two poses that look nearly alike, LEDs close to one line a
whole arc of them: both are fits that start from there, and gravity decides. Wrong identities are left out by consensus.
"""

from collections.abc import Sequence
from itertools import combinations, islice

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.io.dataset import DeviceFrame
from estimator.solvers.reprojection import Observations, Pose, observations, projected
from estimator.solvers.robust_fit import Consensus, consensus
from estimator.solvers.trilateration import fix_orientation
from estimator.spots.correspondences import correspondences
from estimator.spots.identify import Correspondence
from estimator.variants.pnp import candidates, in_a_plane
from estimator.variants.up2p import upright_pose
from estimator.variants.variant import Estimate, Variant

Floats = NDArray[np.float64]

# Another minimum is taken for possible from one hundredth of the best one's likelihood on: exp(-9.21 / 2) = 1 / 100.
AMBIGUOUS_CHI2 = 9.21
# Every triple of 7 LEDs, or one of 12 with half of them wrong nine times over.
MAX_TRIPLES = 72
# A pixel that a pose from three noisy spots still puts another spot within.
TRIPLE_PX = 3.0
BEST_TRIPLES = 3
MIN_FOR_IPPE = 4


def gravity_fit(frame: DeviceFrame) -> Estimate:
    """Position, its covariance, and whether another position is nearly as likely; raises EstimationFailure."""
    return fit_correspondences(frame, correspondences(frame))


def fit_correspondences(frame: DeviceFrame, sighted: Sequence[Correspondence]) -> Estimate:
    """The same from spots that are identified already; of the frame, its camera and gravity count."""
    agreed = agreement(observations(frame, sighted))
    return Estimate(agreed.best.pose.position_m, covariance_m2=agreed.covariance_m2, ambiguous=ambiguous(agreed))


def agreement(seen: Observations) -> Consensus:
    """The pose, and what of spots and gravity it rests on; raises EstimationFailure."""
    starts = _starts(seen)
    try:
        return consensus(seen, starts, lambda: _from_triples(seen))
    except EstimationFailure:
        if not fix_orientation(seen.leds_m):
            raise
        # The reading itself may be what is wrong.
        return consensus(seen.without_gravity(), starts, lambda: _from_triples(seen))


def ambiguous(agreed: Consensus) -> bool:
    """Whether another local minimum has at least a hundredth of the best one's likelihood."""
    return any(other.cost - agreed.best.cost < AMBIGUOUS_CHI2 for other in agreed.others)


def _starts(seen: Observations) -> list[Pose]:
    """Upright as gravity reads, and without it both of IPPE's poses, or SQPNP's for LEDs in no plane."""
    starts = [pose for pose in [upright_pose(seen)] if pose is not None]
    if len(seen.leds_m) >= MIN_FOR_IPPE:
        centre = seen.leds_m.mean(axis=0)
        method = cv2.SOLVEPNP_IPPE if in_a_plane(seen.leds_m) else cv2.SOLVEPNP_SQPNP
        model, image = np.ascontiguousarray(seen.leds_m - centre), np.ascontiguousarray(seen.plane)
        starts += [Pose(turn, centre - turn.T @ shift) for turn, shift in candidates(model, image, method, False)]
    return starts


def _from_triples(seen: Observations) -> list[Pose]:
    """The poses from three spots each (P3P) that put most of the other spots right."""
    pixel_rad = 1 / seen.camera.K[0][0]
    count = len(seen.leds_m)
    triples = list(combinations(range(count), 3))
    if len(triples) > MAX_TRIPLES:
        generator = np.random.Generator(np.random.Philox(key=count))
        triples = [triples[k] for k in generator.choice(len(triples), MAX_TRIPLES, replace=False)]
    scored: list[tuple[float, int, Pose]] = []
    for triple in triples:
        chosen = list(triple)
        try:
            _, turns, shifts = cv2.solveP3P(
                seen.leds_m[chosen], seen.plane[chosen], np.eye(3), None, flags=cv2.SOLVEPNP_P3P
            )
        except cv2.error:
            continue
        for turn, shift in zip(turns, shifts, strict=True):
            R_cam_world = cv2.Rodrigues(turn)[0]
            pose = Pose(R_cam_world, -R_cam_world.T @ shift.ravel())
            offset = projected(pose, seen.leds_m, seen.lift_m2)[0] - seen.plane
            off = np.minimum((offset**2).sum(axis=1), (TRIPLE_PX * pixel_rad) ** 2).sum()
            scored.append((float(off), len(scored), pose))
    return [pose for *_, pose in islice(sorted(scored, key=lambda one: one[:2]), BEST_TRIPLES)]


GRAVITY_FIT = Variant(
    "gravity-fit",
    "reprojection fit of position and orientation, gravity as a prior, wrong LEDs left out, with covariance",
    gravity_fit,
)
