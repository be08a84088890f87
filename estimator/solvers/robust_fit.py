"""Which spots to believe: the pose that explains what is seen, or all of it but what a pose cannot explain."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from estimator.errors import EstimationFailure
from estimator.solvers.reprojection import Fit, Observations, Pose, corrected_for_eccentricity, fit, projected

Floats = NDArray[np.float64]

# A million frames have one sum of squares beyond this by chance.
CHANCE = 1e-6
# What the image model leaves out (a wall's edge behind a lamp, a lens bending within a spot) moves centroids by less.
# Only what is further off than chance and this make it is put down to a wrong identity.
MODEL_ERROR_PX = 0.1
# With fewer, a spot that does not fit cannot be told from those that do.
MIN_WITHOUT_DOUBT = 3
MIN_AMONG_DOUBTFUL = 4
MAX_ROBUST = 3
NEAR_RAD = 0.01
NEAR_M = 0.1


@dataclass(frozen=True, eq=False)
class Consensus:
    """A pose, and which of the spots it rests on."""

    best: Fit
    others: tuple[Fit, ...]
    """Other local minima over the same spots, from the best on."""
    inliers: NDArray[np.bool_]
    """Of the spots, (n,)."""
    gravity: bool
    """Whether its reading took part."""

    @property
    def covariance_m2(self) -> Floats:
        """Of the position, (3, 3): widened by chi^2 a degree of freedom where chance does not explain that."""
        freedom = 2 * len(self.best.spots_chi2) + (2 if self.gravity else 0) - 6
        total = self.best.chi2
        widened = total / freedom if freedom > 0 and total > chi2.isf(CHANCE, freedom) else 1.0
        return self.best.covariance_m2 * widened


def consensus(seen: Observations, starts: Sequence[Pose], more_starts: Callable[[], Iterable[Pose]]) -> Consensus:
    """Fit from every start; where chance does not explain the best fit, find out which spots to believe and fit those.

    `more_starts` are poses to begin from when some spots are wrong. Through a lens that bends, all is done again once a
    pose is known. Raises EstimationFailure where too few spots agree, or no pose has the LEDs before and above it.
    """
    agreed = _consensus(seen, starts, more_starts)
    if seen.camera.projection == "perspective" and seen.camera.distortion is None:
        return agreed
    poses = [found.pose for found in (agreed.best, *agreed.others)]
    return _consensus(corrected_for_eccentricity(seen, agreed.best.pose), poses, more_starts)


def _consensus(
    seen: Observations,
    starts: Sequence[Pose],
    more_starts: Callable[[], Iterable[Pose]],
) -> Consensus:
    pixel_rad = 1 / seen.camera.K[0][0]
    gravity = bool(np.isfinite(seen.tilt_sigma_rad).all())
    everything = np.ones(len(seen.leds_m), dtype=bool)
    if len(everything) < MIN_WITHOUT_DOUBT:
        why = f"LEDs identified: {len(everything)}, needed: {MIN_WITHOUT_DOUBT}"
        raise EstimationFailure("position", why)
    fits = minima(seen, starts)
    if fits and _explains(fits[0], seen, pixel_rad):
        return Consensus(fits[0], fits[1:], everything, gravity)
    for robust in minima(seen, [*starts, *more_starts()], robust=True)[:MAX_ROBUST]:
        inliers = _agrees(robust, seen, pixel_rad)
        while inliers.sum() >= MIN_AMONG_DOUBTFUL and 2 * inliers.sum() > len(inliers):
            chosen = seen.only(inliers)
            fits = minima(chosen, [robust.pose, *starts])
            if fits and _explains(fits[0], chosen, pixel_rad):
                return Consensus(fits[0], fits[1:], inliers, gravity)
            if not fits or _agrees(fits[0], chosen, pixel_rad).all():
                break
            # One at a time: the worst draws the fit, and the others with it, to itself.
            inliers = inliers.copy()
            inliers[np.flatnonzero(inliers)[np.argmax(fits[0].spots_chi2)]] = False
    raise EstimationFailure("position", "no pose explains gravity and most of the spots")


def minima(seen: Observations, starts: Iterable[Pose], robust: bool = False) -> tuple[Fit, ...]:
    """The local minima from the starts on, each once, the best first, of those with all LEDs before and above it."""
    fits: list[Fit] = []
    for start in starts:
        if any(_near(start, other.pose) for other in fits):
            continue
        try:
            found = fit(seen, start, "soft_l1" if robust else "linear")
        except EstimationFailure:
            continue
        position_m = found.pose.position_m
        depth_m = projected(found.pose, seen.leds_m, seen.lift_m2)[1]
        below = position_m[2] < seen.leds_m[:, 2].min()
        ahead = depth_m > 0
        # Robustly fitted, a pose is not to be thrown away for a wrong LED's sake.
        possible = below and (2 * ahead.sum() > len(ahead) if robust else ahead.all())
        if possible and np.isfinite(found.cost) and not any(_near(found.pose, other.pose) for other in fits):
            fits.append(found)
    return tuple(sorted(fits, key=lambda one: one.cost))


def _near(one: Pose, other: Pose) -> bool:
    """Whether two poses lead to one minimum: 0.6 deg is less than two minima of any plane are apart."""
    turned = np.linalg.norm(one.R_cam_world - other.R_cam_world)
    moved = np.linalg.norm(one.position_m - other.position_m)
    return bool(turned < NEAR_RAD and moved < NEAR_M)


def _explains(found: Fit, seen: Observations, pixel_rad: float) -> bool:
    """Whether a fit explains all spots and the reading of gravity."""
    return found.tilt_chi2 <= chi2.isf(CHANCE, 2) and bool(_agrees(found, seen, pixel_rad).all())


def _agrees(found: Fit, seen: Observations, pixel_rad: float) -> NDArray[np.bool_]:
    """Which spots a fit explains, (n,), by chance and by what the model leaves out."""
    offset = projected(found.pose, seen.leds_m, seen.lift_m2)[0] - seen.plane
    spread = np.linalg.inv(seen.whitening)
    covariance = spread @ spread.transpose(0, 2, 1) + (MODEL_ERROR_PX * pixel_rad) ** 2 * np.eye(2)
    distance2 = np.einsum("ni,ni->n", offset, np.linalg.solve(covariance, offset[:, :, None])[:, :, 0])
    return np.asarray(distance2 <= chi2.isf(CHANCE, 2))
