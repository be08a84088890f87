"""Check of a camera that states no errors by the residuals of a fit, and what an unchecked focal length may cost."""

from dataclasses import dataclass
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


@dataclass(frozen=True, eq=False)
class CameraErrors:
    """Errors of the intrinsics (k,), the focal length's first, that each by itself explain the residuals of a fit best.

    `sigmas` (k,) are their standard deviations by the residuals, `assumed` (k,) those of a camera as sold; `moved`
    (3, k) are the derivatives of the fitted position by the errors.
    """

    found: Floats
    sigmas: Floats
    assumed: Floats
    moved: Floats

    @property
    def revealed(self) -> bool:
        """Whether one of them explains the residuals better than an exact camera does, by MAX_CAMERA_SIGMA.

        Errors that the residuals cannot show, larger than those of a camera as sold, do not count.
        """
        visible = self.sigmas < self.assumed
        return bool((np.abs(self.found) > MAX_CAMERA_SIGMA * self.sigmas)[visible].any())

    def unchecked_focal_m2(self) -> Floats:
        """Covariance (3, 3) of the position by a focal length that the residuals do not check.

        Residuals that would reveal an error of CHECKED_FOCAL check it, and it is taken as exact: zero. Otherwise it has
        the mean square error that residuals leave and the camera as sold has.
        """
        found, sigma, assumed = (float(one[0]) for one in (self.found, self.sigmas, self.assumed))
        if MAX_CAMERA_SIGMA * sigma <= CHECKED_FOCAL:
            return np.zeros((3, 3))
        weight = assumed**2 / (assumed**2 + sigma**2)
        mean_square = weight * sigma**2 + (weight * found) ** 2
        return np.asarray(mean_square * np.outer(self.moved[:, 0], self.moved[:, 0]))


@lru_cache(maxsize=1)  # both checks of a fit
def camera_errors(observations: Observations, best: Fit) -> CameraErrors:
    """Errors of the intrinsics by the residuals of spots, as of a camera that states none."""
    assumed = observations.with_assumed_camera().uncertainty
    count = len(assumed.intrinsics)
    slopes = observations.from_pixels @ assumed.slopes_px(best.pose)[:, :, :count]
    # Residuals are those of the model minus the image: an error of the camera adds its slopes to them.
    left_open, moved = best.response(slopes)
    size2 = np.maximum((left_open**2).sum(axis=0), np.finfo(float).tiny)
    found = -(left_open.T @ best.residuals) / size2
    return CameraErrors(found, 1 / np.sqrt(size2), assumed.sigmas[:count], moved)


def unchecked_focal_m2(observations: Observations, best: Fit) -> Floats:
    """Covariance (3, 3) of the position by the focal length of a camera that states nothing, where it is not checked.

    Zero where the spots have errors of camera or map beside their noise.
    """
    if observations.correlated or observations.camera.uncertainty is not None:
        return np.zeros((3, 3))
    return camera_errors(observations, best).unchecked_focal_m2()
