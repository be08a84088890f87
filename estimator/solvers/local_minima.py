"""Local minima of a reprojection fit: several poses may explain the spots of LEDs in a plane."""

from collections.abc import Iterable, Sequence

import numpy as np

from estimator.camera.pose import Pose
from estimator.errors import EstimationFailure
from estimator.solvers.observations import Observations, centroid_images
from estimator.solvers.reprojection import Fit, coarse_fit, fit

# Poses closer than both lead to one minimum.
SAME_MINIMUM_RAD = 0.01
SAME_MINIMUM_M = 0.1
# A minimum whose sum of squares is so many times that of another is no candidate, whatever its last digits are.
HOPELESS_RATIO = 100.0


def minima(observations: Observations, starts: Iterable[Pose], robust: bool = False) -> tuple[Fit, ...]:
    """Distinct local minima from the initial poses, best first, with all LEDs in front of the camera and above it.

    A minimum is left out where its sum of squares is HOPELESS_RATIO times that of one before. A robust fit needs most
    LEDs in front of the camera only: an outlier must not exclude its pose.
    """
    fits: list[Fit] = []
    for start in starts:
        if any(_same_minimum(start, other.pose) for other in fits):
            continue
        try:
            near = start if robust or not fits else _promising(observations, start, fits)
            if near is None:
                continue
            found = fit(observations, near, "soft_l1" if robust else "linear")
        except EstimationFailure:
            continue
        below = found.pose.position_m[2] < observations.leds_m[:, 2].min()
        in_front = centroid_images(found.pose, observations.leds_m, observations.lift_m2)[1] > 0
        possible = below and (2 * in_front.sum() > len(in_front) if robust else in_front.all())
        distinct = not any(_same_minimum(found.pose, other.pose) for other in fits)
        if possible and np.isfinite(found.cost) and distinct:
            fits.append(found)
    return tuple(sorted(fits, key=lambda one: one.cost))


def _promising(observations: Observations, start: Pose, known: Sequence[Fit]) -> Pose | None:
    """A pose nearer to the minimum from an initial one; None if it is one of those known, or hopeless beside them."""
    pose, cost = coarse_fit(observations, start)
    drop = cost > HOPELESS_RATIO * (1 + min(one.cost for one in known))
    return None if drop or any(_same_minimum(pose, one.pose) for one in known) else pose


def _same_minimum(one: Pose, other: Pose) -> bool:
    """Whether two poses lead to one minimum: 0.6 deg is less than the distance of the two minima of LEDs in a plane."""
    rotated = np.linalg.norm(one.R_cam_world - other.R_cam_world)
    moved = np.linalg.norm(one.position_m - other.position_m)
    return bool(rotated < SAME_MINIMUM_RAD and moved < SAME_MINIMUM_M)
