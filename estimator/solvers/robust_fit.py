"""Robust fit: the pose that explains gravity and the spots, which spots it leaves out, and how large the errors are.

Data snooping finds outliers (`estimator.solvers.data_snooping`). Where all spots pass with the errors that the device
states, that fit is the result. Otherwise several explanations compete, each fitted to the spots that it leaves in, from
poses that put most spots about right:

- errors as stated, and outliers;
- stated errors of camera, map and gravity that are larger or smaller by a common factor, estimated from the residuals;
- where the map's errors are not stated: a further error of each centroid, of a size estimated from the residuals. A
  camera that states nothing then has the errors of one as sold (`estimator.solvers.uncertainty`), because the
  residuals hardly reveal a focal length, and one that is stated as exact has them where the spots contradict it;
- errors as stated without gravity, where that is optional and contradicts the spots.

The explanation with the largest restricted likelihood is taken; an outlier lies anywhere in OUTLIER_RADIUS. An
exact camera that the spots contradict (`estimator.solvers.camera_check`) is no explanation if there is another.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimator.camera.motion import MOTION_PARAMETERS
from estimator.camera.pose import Pose
from estimator.camera.projection import projection_of
from estimator.errors import EstimationFailure
from estimator.solvers.camera_check import camera_errors, contradicts_camera
from estimator.solvers.chi_square import chi2_limit
from estimator.solvers.data_snooping import (
    MODEL_ERROR_PX,
    OUTLIER_PROBABILITY,
    START_GATE,
    degrees_of_freedom,
    distances_px,
    enough,
    gates_px,
    passing,
    scalable,
    snooped,
    uses_gravity,
)
from estimator.solvers.local_minima import minima
from estimator.solvers.observations import Observations, corrected_for_eccentricity
from estimator.solvers.reprojection import Fit, fit

Floats = NDArray[np.float64]

# With fewer spots there is no pose.
MIN_SPOTS = 3
MAX_ROBUST_STARTS = 3
# Share of the image's width within which an outlier may lie anywhere: as far as a decoded pixel may be from a spot.
OUTLIER_RADIUS = 0.01
# Inliers, and their share, from which on a pose that they agree on is no chance: ten degrees of freedom.
MIN_SURE_INLIERS = 8
MIN_SURE_SHARE = 2 / 3
# An exact camera has to be a hundred times as likely as one as sold, where neither explains all spots.
CAUTION_CHI2 = 2 * np.log(100)
# Largest error of a centroid that is taken as one of map or camera, 3 cm at 3 m, and largest factor of stated errors:
# larger ones are no explanation.
MAX_ADDED_RAD = 0.01
MAX_SCALE = 20.0


@dataclass(frozen=True, eq=False)
class Consensus:
    """A fitted pose and the spots it is based on.

    `best` is the best fit, `others` are fits of other local minima to the same spots, best first; `inliers` (n,) are
    the spots used; `gravity` says whether the accelerometer was used. `model` are the observations with the size of
    errors that explains them, None where all spots are explained as stated; `adapted` says that the residuals gave it.
    `unchecked_m2` (3, 3) is what a camera that neither the device nor the residuals vouch for adds to the position's
    covariance; `doubt_m2` (3, 3) is what a camera that the device alone vouches for would add, were it not exact.
    `contradicted` says that a camera which states no errors is taken as one as sold.
    """

    best: Fit
    others: tuple[Fit, ...]
    inliers: NDArray[np.bool_]
    gravity: bool
    model: Observations | None = None
    adapted: bool = False
    unchecked_m2: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    doubt_m2: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    contradicted: bool = False

    @property
    def covariance_m2(self) -> Floats:
        """Covariance of the position, (3, 3), with `unchecked_m2`.

        It is scaled by chi-square per degree of freedom if chi-square is too large by OUTLIER_PROBABILITY. With errors
        of a size by the residuals, of n degrees of freedom, it is that of Student's distribution, n / (n - 2) times.
        """
        if self.adapted:
            return self.best.covariance_m2 * self.student_ratio + self.unchecked_m2
        total, freedom = self.best.chi2, self._freedom
        scale = total / freedom if freedom > 0 and total > chi2_limit(OUTLIER_PROBABILITY, freedom) else 1.0
        return self.best.covariance_m2 * scale + self.unchecked_m2

    @property
    def _freedom(self) -> int:
        return 2 * len(self.best.spots_chi2) + (2 if self.gravity else 0) - 6

    @property
    def stated_scale(self) -> float:
        """Factor, at least 1, by which what the device states is too small, as far as the residuals tell."""
        return 1.0 if self.model is None else max(self.model.scale, 1.0)

    @property
    def student_ratio(self) -> float:
        """Variance of Student's distribution over that of a normal one, n / (n - 2) of n degrees of freedom; 1 where
        the residuals do not give the size of errors.
        """
        freedom = max(self._freedom, 3)
        return freedom / (freedom - 2) if self.adapted else 1.0

    def of_inliers(self) -> Observations:
        """The observations of the inliers, with the size of errors that explains them."""
        if self.model is None:
            raise ValueError("a consensus on all spots as stated has no model")
        return self.model.only(self.inliers)


def consensus(
    observations: Observations,
    starts: Sequence[Pose],
    more_starts: Callable[[], Iterable[Pose]],
    gravity_optional: bool = False,
) -> Consensus:
    """Fit from every initial pose; if the best fit does not explain all spots, find the best explanation.

    `more_starts` gives initial poses for observations with outliers. `gravity_optional` says that the accelerometer's
    reading may be the outlier. For a lens that bends straight lines the fit is repeated with centroids corrected by the
    first pose. Raises EstimationFailure if too few spots agree, or no pose has the LEDs in front of the camera and
    above it.
    """
    agreed = _consensus(observations, starts, more_starts, gravity_optional)
    if projection_of(observations.camera).rectilinear:
        return agreed
    poses = [found.pose for found in (agreed.best, *agreed.others)]
    corrected = corrected_for_eccentricity(observations, agreed.best.pose)
    return _consensus(corrected, poses, more_starts, gravity_optional)


def _consensus(
    observations: Observations,
    starts: Sequence[Pose],
    more_starts: Callable[[], Iterable[Pose]],
    gravity_optional: bool,
) -> Consensus:
    everything = np.ones(len(observations.leds_m), dtype=bool)
    if len(everything) < MIN_SPOTS:
        raise EstimationFailure("position", f"LEDs identified: {len(everything)}, needed: {MIN_SPOTS}")
    fits = minima(observations, starts)
    if fits and _explains_all(fits[0], observations):
        agreed = Consensus(fits[0], fits[1:], everything, uses_gravity(observations))
        if _plausible(agreed, observations):
            return _with_doubt(agreed, observations)
        rough = [one.pose for one in fits]
    else:
        rough = [*(one.pose for one in fits), *starts, *more_starts()]
    found = _explanations(observations, rough)
    limit = chi2_limit(OUTLIER_PROBABILITY, 2)
    if gravity_optional and not any(one.best.tilt_chi2 <= limit and not one.adapted for one in found):
        found += _explanations(observations.without_gravity(), rough, sizes=(False,))
    if not found:
        raise EstimationFailure("position", "no pose explains gravity and most of the spots")
    best = min(found, key=lambda one: (_contradicts_camera(one, observations), _score(one, observations)))
    fits = minima(best.of_inliers(), [best.best.pose, *starts])
    if fits:
        best = replace(best, best=fits[0], others=fits[1:])
    return _with_doubt(best, observations)


def _with_doubt(agreed: Consensus, observations: Observations) -> Consensus:
    """A consensus with what it says of a camera that states no errors."""
    model = observations if agreed.model is None else agreed.of_inliers()
    if model.correlated:
        return replace(agreed, contradicted=not observations.correlated)
    errors = camera_errors(model, agreed.best)
    if observations.camera.uncertainty is None:
        return replace(agreed, unchecked_m2=errors.unchecked_m2())
    return replace(agreed, doubt_m2=errors.left_open_m2())


def _explanations(
    observations: Observations, rough: Sequence[Pose], sizes: Sequence[bool] = (False, True)
) -> list[Consensus]:
    """Explanations of the spots by errors as stated with outliers, and by errors of a size by the residuals.

    `sizes` says which: False for as stated, True for by the residuals. `rough` are poses to begin with. An explanation
    with many inliers and few outliers needs no other.
    """
    ranked, assumed = _ranked(observations, rough), observations.with_assumed_camera()
    models = [observations] if assumed is observations else [observations, assumed]
    # A camera that is stated as exact is one as sold only where the spots contradict it.
    trusted = observations.camera.uncertainty is not None
    attempts = [(model, adapted) for adapted in sizes for model in models]
    if trusted:
        attempts.sort(key=lambda one: one[0] is not observations)
    found: list[Consensus] = []
    for model, adapted in attempts:
        contradicted = any(_contradicts_camera(one, observations) for one in found)
        if adapted and model is not assumed and contradicted:
            continue
        if trusted and model is not observations and found and not contradicted:
            break
        explained = _snooped_consensus(model, ranked, adapted)
        if explained is None:
            continue
        # Larger errors than those of centroids are of the map or camera: one that states nothing is then not exact.
        added_px = 0.0 if explained.model is None else explained.model.added_sigma_px
        if model is not assumed and not trusted and added_px > MODEL_ERROR_PX:
            continue
        found.append(explained)
        count = len(explained.inliers)
        sure = explained.inliers.sum() >= max(MIN_SURE_INLIERS, MIN_SURE_SHARE * count)
        if sure and not adapted and _plausible(explained, model):
            break
    return found


def _plausible(agreed: Consensus, observations: Observations) -> bool:
    """Whether chi-square of inliers and gravity is as the errors say, and the spots do not contradict the camera."""
    best, freedom = agreed.best, max(degrees_of_freedom(observations, agreed.inliers), 1)
    if best.tilt_chi2 > chi2_limit(OUTLIER_PROBABILITY, 2) or best.chi2 > chi2_limit(OUTLIER_PROBABILITY, freedom):
        return False
    return not _contradicts_camera(agreed, observations)


def _contradicts_camera(agreed: Consensus, observations: Observations) -> bool:
    """Whether the inliers contradict a camera that is taken as exact."""
    model = observations if agreed.model is None else agreed.model
    return contradicts_camera(model if agreed.inliers.all() else model.only(agreed.inliers), agreed.best)


def _snooped_consensus(
    observations: Observations, ranked: Sequence[tuple[Pose, Floats]], adapted: bool
) -> Consensus | None:
    """Spots that pass data snooping, from the pose that puts most of them about right; None if too few do.

    `ranked` are poses and distances by `_ranked`. `adapted`: the size of the errors is estimated from the residuals.
    """
    for pose, distance_px in ranked[:MAX_ROBUST_STARTS]:
        spread_px = _spread_px(distance_px)
        near = distance_px <= START_GATE * spread_px
        within = near | (distance_px <= gates_px(observations, pose))
        if adapted and not enough(within):
            # No majority agrees to the best ones' errors: all spots have errors of one size.
            within = np.isfinite(distance_px)
            spread_px = float(np.sqrt((distance_px[within] ** 2).mean() / 2))
        trial = observations
        if adapted and not scalable(observations):
            trial = replace(observations, added_sigma_px=spread_px)
        # Wrong identities within the errors stated may be too many for data snooping; the nearest spots have fewer.
        found = snooped(trial, pose, within, adapted)
        if found is None and (near != within).any():
            found = snooped(trial, pose, near, adapted)
        if found is not None:
            model, best, inliers = found
            if adapted and not _credible(model):
                continue
            return Consensus(best, (), inliers, uses_gravity(observations), model, adapted)
    return None


def _credible(model: Observations) -> bool:
    """Whether errors by the residuals are of a size that a map or camera may have."""
    added_rad = model.added_sigma_px * model.camera.pixel_angle_rad
    return bool(added_rad <= MAX_ADDED_RAD and model.scale <= MAX_SCALE)


def _ranked(observations: Observations, poses: Sequence[Pose]) -> list[tuple[Pose, Floats]]:
    """Poses with the distances (n,) of the spots from where they put them, pixels; best half of the spots first.

    The best ones are refitted to that half. A spot with its LED behind the camera is infinitely far.
    """
    half = len(observations.leds_m) // 2 + 1

    def judged(pose: Pose, velocity: Floats | None = None) -> tuple[float, Pose, Floats]:
        distance_px = distances_px(observations, pose, velocity)
        return float((np.sort(distance_px)[:half] ** 2).sum()), pose, distance_px

    ranked = sorted((judged(pose) for pose in poses), key=lambda one: one[0])
    ranked = [one for one in ranked if np.isfinite(one[0])][:MAX_ROBUST_STARTS]
    refitted = []
    for _, pose, distance_px in ranked:
        nearest = np.zeros(len(distance_px), dtype=bool)
        nearest[np.argsort(distance_px, kind="stable")[: max(half, MIN_SPOTS)]] = True
        chosen = replace(observations.only(nearest), added_sigma_px=_spread_px(distance_px))
        try:
            found = fit(chosen, pose)
        except EstimationFailure:
            continue
        if found.pose.position_m[2] < observations.leds_m[:, 2].min():
            refitted.append(judged(found.pose, found.velocity))
    both = sorted([*refitted, *ranked], key=lambda one: one[0])
    return [(pose, distance_px) for cost, pose, distance_px in both if np.isfinite(cost)]


def _spread_px(distance_px: Floats) -> float:
    """Standard deviation of a coordinate, from the median of distances in the plane; at least MODEL_ERROR_PX."""
    median = float(np.sort(distance_px)[len(distance_px) // 2])
    return max(median / float(np.sqrt(2 * np.log(2))), MODEL_ERROR_PX)


def _score(agreed: Consensus, observations: Observations) -> float:
    """Minus twice the logarithm of the restricted likelihood of all spots (in pixels) and gravity.

    Restricted: of what the pose leaves open, so that few spots which a pose fits by chance do not win. An outlier is
    anywhere within OUTLIER_RADIUS of the image's width, and a wrong reading of gravity in any direction.
    """
    model = agreed.model if agreed.model is not None else observations
    chosen = model.only(agreed.inliers)
    covariance = chosen.covariance(agreed.best.pose)
    of_pixels = -2 * np.log(np.abs(np.linalg.det(chosen.from_pixels))).sum()
    spots = float(np.linalg.slogdet(2 * np.pi * covariance)[1] + of_pixels)
    radius_px = OUTLIER_RADIUS * observations.camera.width_px
    outliers = 2 * np.log(np.pi * radius_px**2) * float((~agreed.inliers).sum())
    tilts = (
        2 * float(np.log(model.tilt_sigma_rad).sum()) + 2 * np.log(2 * np.pi)
        if agreed.gravity
        else 2 * np.log(2 * np.pi)
    )
    # Of two explanations that are about as likely, the one that trusts a camera to be exact is the bolder.
    bold = 0.0 if model.correlated else CAUTION_CHI2
    return bold + float(agreed.best.chi2 + spots + agreed.best.log_determinant + outliers + tilts)


def _explains_all(found: Fit, observations: Observations) -> bool:
    """Whether a fit explains all spots and gravity, with a motion that its prior allows."""
    if found.tilt_chi2 > chi2_limit(OUTLIER_PROBABILITY, 2):
        return False
    if found.motion_chi2 > chi2_limit(OUTLIER_PROBABILITY, MOTION_PARAMETERS):
        return False
    if observations.correlated:
        return found.chi2 <= chi2_limit(OUTLIER_PROBABILITY, max(degrees_of_freedom(observations), 1)) and bool(
            passing(found, observations, adapted=False).all()
        )
    return bool(_explained(found, observations).all())


def _explained(found: Fit, observations: Observations) -> NDArray[np.bool_]:
    """Spots, (n,), that a fit explains by their noise and MODEL_ERROR_PX."""
    limit = chi2_limit(OUTLIER_PROBABILITY, 2)
    if observations.added_sigma_px == 0 and found.spots_chi2.max() <= limit:
        return np.ones(len(found.spots_chi2), dtype=bool)  # by their noise alone
    offset = observations.images(found.pose, found.velocity)[0] - observations.image
    spread = np.linalg.inv(observations.whitening)
    model_error2 = (MODEL_ERROR_PX * observations.camera.pixel_angle_rad) ** 2
    covariance = spread @ spread.transpose(0, 2, 1) + model_error2 * np.eye(2)
    distance2 = np.einsum("ni,ni->n", offset, np.linalg.solve(covariance, offset[:, :, None])[:, :, 0])
    return np.asarray(distance2 <= limit)
