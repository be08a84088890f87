"""Check of a camera that states no errors by the residuals of a fit, and what an unchecked focal length may cost."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from estimator.solvers.observations import Observations
from estimator.solvers.reprojection import Fit

Floats = NDArray[np.float64]

# Standard deviations of an error of the camera's intrinsics, one of seven, beyond which the residuals reveal it: by
# chance in one of 2000 frames.
MAX_CAMERA_SIGMA = 4.0
# Relative error of an unstated focal length that the residuals have to be able to reveal for it to be taken as exact:
# half the smallest that is said of real cameras, 0.1 %, so that one of 0.1 % is missed in one of 30 000 frames at most.
CHECKED_FOCAL = 5e-4


def contradicts_camera(observations: Observations, best: Fit) -> bool:
    """Whether one of the errors that are assumed of a camera as sold explains the residuals of a fit better.

    Better by MAX_CAMERA_SIGMA standard deviations, and not of a size that the residuals cannot show.
    """
    found, errors, priors, _ = _camera_errors(observations, best)
    visible = errors < priors
    return bool((np.abs(found) > MAX_CAMERA_SIGMA * errors)[visible].any())


@lru_cache(maxsize=1)  # both checks of a fit
def _camera_errors(observations: Observations, best: Fit) -> tuple[Floats, Floats, Floats, Floats]:
    """Errors of the intrinsics (k,) that each by itself explain the residuals of a fit best.

    Also their standard deviations by the residuals, (k,), and as assumed of a camera as sold, (k,), and the derivatives
    (3, k) of the fitted position by them. The first is the focal length's.
    """
    assumed = observations.with_assumed_camera().uncertainty
    count = len(assumed.intrinsics)
    slopes = observations.from_pixels @ assumed.slopes_px(best.pose)[:, :, :count]
    # Residuals are those of the model minus the image: an error of the camera adds its slopes to them.
    left_open, moved = best.response(slopes)
    size2 = np.maximum((left_open**2).sum(axis=0), np.finfo(float).tiny)
    return -(left_open.T @ best.residuals) / size2, 1 / np.sqrt(size2), assumed.sigmas[:count], moved


def unchecked_focal_m2(observations: Observations, best: Fit) -> Floats:
    """Covariance (3, 3) of the position by the focal length of a camera that states nothing, where it is not checked.

    Residuals that would reveal an error of CHECKED_FOCAL check it, and it is taken as exact: zero. Otherwise it has the
    mean square error that residuals leave and the camera as sold has.
    """
    if observations.correlated or observations.camera.uncertainty is not None:
        return np.zeros((3, 3))
    found, errors, priors, moved = _camera_errors(observations, best)
    if MAX_CAMERA_SIGMA * errors[0] <= CHECKED_FOCAL:
        return np.zeros((3, 3))
    weight = priors[0] ** 2 / (priors[0] ** 2 + errors[0] ** 2)
    mean_square = weight * errors[0] ** 2 + (weight * found[0]) ** 2
    return np.asarray(mean_square * np.outer(moved[:, 0], moved[:, 0]))
