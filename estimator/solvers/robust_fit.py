"""Robust fit: the pose that explains gravity and all spots, or else the largest consistent set of them (inliers)."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from estimator.camera.pose import Pose
from estimator.camera.projection import projection_of
from estimator.errors import EstimationFailure
from estimator.solvers.reprojection import Fit, Observations, centroid_images, corrected_for_eccentricity, fit

Floats = NDArray[np.float64]

# Probability that a true spot's chi-square exceeds the limit: one spot in a million.
OUTLIER_PROBABILITY = 1e-6
# Upper limit of centroid errors that the image model leaves out: an edge of the background behind an LED, a lens that
# bends the image of an LED. A spot is an outlier only beyond this and its noise.
MODEL_ERROR_PX = 0.1
# With fewer spots, an outlier cannot be told from the inliers.
MIN_SPOTS = 3
MIN_INLIERS = 4
MAX_ROBUST_STARTS = 3
# Poses closer than both lead to one minimum.
SAME_MINIMUM_RAD = 0.01
SAME_MINIMUM_M = 0.1


@dataclass(frozen=True, eq=False)
class Consensus:
    """A fitted pose and the spots it is based on.

    `best` is the best fit, `others` are fits of other local minima to the same spots, best first; `inliers` (n,) are
    the spots used; `gravity` says whether the accelerometer was used.
    """

    best: Fit
    others: tuple[Fit, ...]
    inliers: NDArray[np.bool_]
    gravity: bool

    @property
    def covariance_m2(self) -> Floats:
        """Covariance of the position, (3, 3).

        It is scaled by chi-square per degree of freedom if chi-square is too large by OUTLIER_PROBABILITY.
        """
        freedom = 2 * len(self.best.spots_chi2) + (2 if self.gravity else 0) - 6
        total = self.best.chi2
        scale = total / freedom if freedom > 0 and total > chi2.isf(OUTLIER_PROBABILITY, freedom) else 1.0
        return self.best.covariance_m2 * scale


def consensus(
    observations: Observations, starts: Sequence[Pose], more_starts: Callable[[], Iterable[Pose]]
) -> Consensus:
    """Fit from every initial pose; if the best fit does not explain all spots, find the inliers and fit those.

    `more_starts` gives initial poses for observations with outliers. For a lens that bends straight lines the fit is
    repeated with centroids corrected by the first pose. Raises EstimationFailure if too few spots agree, or no pose has
    the LEDs in front of the camera and above it.
    """
    agreed = _consensus(observations, starts, more_starts)
    if projection_of(observations.camera).rectilinear:
        return agreed
    poses = [found.pose for found in (agreed.best, *agreed.others)]
    return _consensus(corrected_for_eccentricity(observations, agreed.best.pose), poses, more_starts)


def _consensus(
    observations: Observations,
    starts: Sequence[Pose],
    more_starts: Callable[[], Iterable[Pose]],
) -> Consensus:
    gravity = bool(np.isfinite(observations.tilt_sigma_rad).all())
    everything = np.ones(len(observations.leds_m), dtype=bool)
    if len(everything) < MIN_SPOTS:
        raise EstimationFailure("position", f"LEDs identified: {len(everything)}, needed: {MIN_SPOTS}")
    fits = minima(observations, starts)
    if fits and _explains_all(fits[0], observations):
        return Consensus(fits[0], fits[1:], everything, gravity)
    for robust in minima(observations, [*starts, *more_starts()], robust=True)[:MAX_ROBUST_STARTS]:
        inliers = _explained(robust, observations)
        while inliers.sum() >= MIN_INLIERS and 2 * inliers.sum() > len(inliers):
            chosen = observations.only(inliers)
            fits = minima(chosen, [robust.pose, *starts])
            if fits and _explains_all(fits[0], chosen):
                return Consensus(fits[0], fits[1:], inliers, gravity)
            if not fits or _explained(fits[0], chosen).all():
                break
            # Remove the worst spot alone: it pulls the fit, and with it the residuals of true spots.
            inliers = inliers.copy()
            inliers[np.flatnonzero(inliers)[np.argmax(fits[0].spots_chi2)]] = False
    raise EstimationFailure("position", "no pose explains gravity and most of the spots")


def minima(observations: Observations, starts: Iterable[Pose], robust: bool = False) -> tuple[Fit, ...]:
    """Distinct local minima from the initial poses, best first, with all LEDs in front of the camera and above it.

    A robust fit needs most LEDs in front of the camera only: an outlier must not exclude its pose.
    """
    fits: list[Fit] = []
    for start in starts:
        if any(_same_minimum(start, other.pose) for other in fits):
            continue
        try:
            found = fit(observations, start, "soft_l1" if robust else "linear")
        except EstimationFailure:
            continue
        depth_m = centroid_images(found.pose, observations.leds_m, observations.lift_m2)[1]
        below = found.pose.position_m[2] < observations.leds_m[:, 2].min()
        in_front = depth_m > 0
        possible = below and (2 * in_front.sum() > len(in_front) if robust else in_front.all())
        distinct = not any(_same_minimum(found.pose, other.pose) for other in fits)
        if possible and np.isfinite(found.cost) and distinct:
            fits.append(found)
    return tuple(sorted(fits, key=lambda one: one.cost))


def _same_minimum(one: Pose, other: Pose) -> bool:
    """Whether two poses lead to one minimum: 0.6 deg is less than the distance of the two minima of LEDs in a plane."""
    rotated = np.linalg.norm(one.R_cam_world - other.R_cam_world)
    moved = np.linalg.norm(one.position_m - other.position_m)
    return bool(rotated < SAME_MINIMUM_RAD and moved < SAME_MINIMUM_M)


def _explains_all(found: Fit, observations: Observations) -> bool:
    """Whether a fit explains all spots and gravity."""
    return found.tilt_chi2 <= chi2.isf(OUTLIER_PROBABILITY, 2) and bool(_explained(found, observations).all())


def _explained(found: Fit, observations: Observations) -> NDArray[np.bool_]:
    """Spots, (n,), that a fit explains by their noise and MODEL_ERROR_PX."""
    offset = centroid_images(found.pose, observations.leds_m, observations.lift_m2)[0] - observations.image
    spread = np.linalg.inv(observations.whitening)
    model_error2 = (MODEL_ERROR_PX * observations.camera.pixel_angle_rad) ** 2
    covariance = spread @ spread.transpose(0, 2, 1) + model_error2 * np.eye(2)
    distance2 = np.einsum("ni,ni->n", offset, np.linalg.solve(covariance, offset[:, :, None])[:, :, 0])
    return np.asarray(distance2 <= chi2.isf(OUTLIER_PROBABILITY, 2))
