"""Data snooping (Baarda 1968): which spots of a fit are outliers, and the size of errors that is not known.

Each spot's displacement from where the other observations put it is tested against its own covariance, and the worst
spots are left out until none is beyond OUTLIER_PROBABILITY. Several spots go at once, and while wrong ones take part
right ones may look as bad, more so where errors of camera and map move spots together. So spots that were left out are
tested again in the end, one at a time, against the spots that stayed.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import Pose
from estimator.errors import EstimationFailure
from estimator.solvers.chi_square import chi2_limit, pair_limit
from estimator.solvers.observations import Observations, centroid_images
from estimator.solvers.reprojection import Fit, fit

Floats = NDArray[np.float64]

# Probability that a true spot's chi-square exceeds the limit: one spot in a million.
OUTLIER_PROBABILITY = 1e-6
# Upper limit of centroid errors that the image model leaves out: an edge of the background behind an LED, a lens that
# bends the image of an LED. A spot is an outlier only beyond this and its noise.
MODEL_ERROR_PX = 0.1
# With fewer spots, an outlier cannot be told from the inliers.
MIN_INLIERS = 4
# Standard deviations about a rough pose within which spots take part in data snooping.
START_GATE = 5.0
# Median of chi-square with two degrees of freedom.
CHI2_MEDIAN = 2 * np.log(2)
# Spots beyond the limit that are excluded together have at least this share of the largest chi-square: a wrong spot
# pulls the fit, and with it the residuals of true spots.
MIN_EXCLUDED_SHARE = 0.5
# Repetitions that estimate the size of errors, by the median of spots with outliers and by all spots without, and the
# largest change of its square in one.
ROBUST_ROUNDS = MOMENT_ROUNDS = 3
MAX_RATIO = 100.0


def snooped(
    observations: Observations, pose: Pose, inliers: NDArray[np.bool_], adapted: bool
) -> tuple[Observations, Fit, NDArray[np.bool_]] | None:
    """Data snooping from a pose and the spots to begin with; the observations returned have the size of errors."""
    model, rounds = observations, ROBUST_ROUNDS if adapted else 0
    while enough(inliers):
        chosen = model.only(inliers)
        try:
            for _ in range(rounds):
                found = fit(chosen, pose)
                model = _with_errors(model, float(np.median(found.outlier_chi2())) / CHI2_MEDIAN)
                chosen, pose = model.only(inliers), found.pose
            found = fit(chosen, pose)
        except EstimationFailure:
            return None
        pose, rounds = found.pose, min(rounds, 1)
        depth_m = centroid_images(pose, chosen.leds_m, chosen.lift_m2)[1]
        if not (pose.position_m[2] < chosen.leds_m[:, 2].min() and 2 * (depth_m > 0).sum() > len(depth_m)):
            return None
        passes = passing(found, chosen, adapted)
        if 2 * passes.sum() < len(passes):
            return None
        if not passes.all():
            displaced = np.where(passes, 0.0, found.outlier_chi2(_model_error(chosen)))
            inliers = inliers.copy()
            inliers[np.flatnonzero(inliers)[displaced >= MIN_EXCLUDED_SHARE * displaced.max()]] = False
            continue
        found, inliers = _with_returned(model, found, inliers, adapted)
        if adapted:
            try:
                model, found = _settled(model, found, inliers)
            except EstimationFailure:
                return None
        return model, found, inliers
    return None


def _with_returned(
    model: Observations, found: Fit, inliers: NDArray[np.bool_], adapted: bool
) -> tuple[Fit, NDArray[np.bool_]]:
    """A fit and its inliers, and those of the spots left out that pass data snooping beside the inliers alone.

    They are taken back one at a time, the nearest to where the fit puts it first, where all spots pass with it.
    """
    distance_px = distances_px(model, found.pose, found.velocity)
    left_out = np.flatnonzero(~inliers & (distance_px <= gates_px(model, found.pose)))
    for spot in left_out[np.argsort(distance_px[left_out], kind="stable")].tolist():
        more = inliers.copy()
        more[spot] = True
        chosen = model.only(more)
        try:
            again = fit(chosen, found.pose)
        except EstimationFailure:
            continue
        if passing(again, chosen, adapted).all():
            found, inliers = again, more
    return found, inliers


def _settled(model: Observations, found: Fit, inliers: NDArray[np.bool_]) -> tuple[Observations, Fit]:
    """The size of errors with which chi-square is its degrees of freedom, and the fit with it."""
    for _ in range(MOMENT_ROUNDS):
        freedom = max(degrees_of_freedom(model, inliers), 1)
        model = _with_errors(model, found.chi2 / freedom)
        found = fit(model.only(inliers), found.pose)
    return model, found


def _with_errors(observations: Observations, ratio: float) -> Observations:
    """Observations whose adapted variance is larger by a ratio."""
    ratio = min(max(ratio, 1 / MAX_RATIO), MAX_RATIO)
    if scalable(observations):
        tilt_sigma_rad = observations.tilt_sigma_rad * np.sqrt(ratio)
        return replace(observations, scale=observations.scale * np.sqrt(ratio), tilt_sigma_rad=tilt_sigma_rad)
    return replace(observations, added_sigma_px=observations.added_sigma_px * np.sqrt(ratio))


def passing(found: Fit, observations: Observations, adapted: bool) -> NDArray[np.bool_]:
    """Spots (n,) that pass data snooping; with errors of a size by the residuals the test is Fisher's."""
    freedom = degrees_of_freedom(observations)
    limit = pair_limit(OUTLIER_PROBABILITY, max(freedom, 1)) if adapted else chi2_limit(OUTLIER_PROBABILITY, 2)
    return np.asarray(found.outlier_chi2(_model_error(observations)) <= limit)


def _model_error(observations: Observations) -> float:
    """MODEL_ERROR_PX in normalized coordinates."""
    return MODEL_ERROR_PX * observations.camera.pixel_angle_rad


def enough(inliers: NDArray[np.bool_]) -> bool:
    """Whether inliers are most of the spots, and enough of them."""
    return bool(inliers.sum() >= MIN_INLIERS and 2 * inliers.sum() > len(inliers))


def scalable(observations: Observations) -> bool:
    """Whether the map's errors are stated, so that a common factor can explain larger residuals."""
    return any(parameter.group == "map" for parameter in observations.uncertainty.parameters)


def uses_gravity(observations: Observations) -> bool:
    """Whether the accelerometer is used."""
    return bool(np.isfinite(observations.tilt_sigma_rad).all())


def degrees_of_freedom(observations: Observations, inliers: NDArray[np.bool_] | None = None) -> int:
    """Degrees of freedom: two numbers a spot, of all or of inliers (n,), and two of gravity, less six of the pose."""
    count = len(observations.leds_m) if inliers is None else int(inliers.sum())
    return 2 * count + (2 if uses_gravity(observations) else 0) - 6


def distances_px(observations: Observations, pose: Pose, velocity: Floats | None) -> Floats:
    """Distances (n,) of spots from where a pose puts them, pixels; infinite for an LED behind the camera."""
    image, depth_m = observations.images(pose, velocity)
    offset = np.linalg.solve(observations.from_pixels, (observations.image - image)[:, :, None])[:, :, 0]
    return np.asarray(np.where(depth_m > 0, np.linalg.norm(offset, axis=1), np.inf))


def gates_px(observations: Observations, pose: Pose) -> Floats:
    """Distances (n,) that errors as stated explain, with an upright pose: START_GATE standard deviations, pixels."""
    count = len(observations.leds_m)
    blocks = observations.total_covariance(pose).reshape(count, 2, count, 2)[np.arange(count), :, np.arange(count)]
    of_tilt = observations.tilt_sigma_rad.max() if uses_gravity(observations) else 0.0
    variance = np.trace(blocks, axis1=1, axis2=2) + of_tilt**2
    return np.asarray(START_GATE * np.sqrt(variance) / observations.camera.pixel_angle_rad)
