"""Check of a camera that states no errors by the residuals of a fit, and what an unchecked one may cost.

A camera states no errors if it says that it is exact, or says nothing. Where the residuals contradict it by
MAX_CAMERA_SIGMA, both are taken as one as sold. They differ where the residuals cannot contradict it: the statement
is then trusted, unless other frames of the device contradict it (`estimator.methods.camera_statement`), and a camera
without one adds to the covariance.
"""

from dataclasses import dataclass, field
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
    (3, k) are the derivatives of the fitted position by the errors. `excess` (k,) are the residuals that each error
    leaves, over their noise, root mean square, at least 1: where all centroids err by more than they state, their
    sigmas are as much larger.
    """

    found: Floats
    sigmas: Floats
    assumed: Floats
    moved: Floats
    excess: Floats = field(default_factory=lambda: np.ones(1))

    @property
    def revealed(self) -> bool:
        """Whether one of them explains the residuals better than an exact camera does, by MAX_CAMERA_SIGMA.

        Errors that the residuals cannot show, larger than those of a camera as sold, do not count.
        """
        visible = self.sigmas < self.assumed
        return bool((np.abs(self.found) > MAX_CAMERA_SIGMA * self.excess * self.sigmas)[visible].any())

    def unchecked_m2(self) -> Floats:
        """Covariance (3, 3) of the position by intrinsics that the residuals do not check.

        Residuals that would reveal an error of CHECKED_FOCAL check the camera, which is taken as exact: zero. Otherwise
        the focal length counts, and so does each other intrinsic of which they would not reveal an error as large as
        that of a camera as sold: with the mean square error that the residuals leave and the camera as sold has.
        """
        if MAX_CAMERA_SIGMA * self.sigmas[0] <= CHECKED_FOCAL:
            return np.zeros((3, 3))
        counts = MAX_CAMERA_SIGMA * self.sigmas > self.assumed
        counts[0] = True
        return self._left_open_m2(counts)

    def left_open_m2(self) -> Floats:
        """Covariance (3, 3) of the position by all that the residuals leave open of a camera that is not exact."""
        return self._left_open_m2(np.ones(len(self.sigmas), dtype=bool))

    def _left_open_m2(self, counts: NDArray[np.bool_]) -> Floats:
        weight = self.assumed**2 / (self.assumed**2 + self.sigmas**2)
        mean_square = weight * self.sigmas**2 + (weight * self.found) ** 2
        return np.asarray((self.moved * (mean_square * counts)) @ self.moved.T)


@lru_cache(maxsize=1)  # both checks of a fit
def camera_errors(observations: Observations, best: Fit) -> CameraErrors:
    """Errors of the intrinsics by the residuals of spots, of a camera that states none."""
    assumed = observations.with_assumed_camera().uncertainty
    count = len(assumed.intrinsics)
    slopes = observations.from_pixels @ assumed.slopes_px(best.pose)[:, :, :count]
    # Residuals are those of the model minus the image: an error of the camera adds its slopes to them.
    left_open, moved = best.response(slopes)
    size2 = np.maximum((left_open**2).sum(axis=0), np.finfo(float).tiny)
    found = -(left_open.T @ best.residuals) / size2
    freedom = max(int(best.slopes.any(axis=1).sum()) - best.slopes.shape[1] - 1, 1)
    rest = float(best.residuals @ best.residuals) - found**2 * size2
    excess = np.sqrt(np.maximum(rest / freedom, 1.0))
    return CameraErrors(found, 1 / np.sqrt(size2), assumed.sigmas[:count], moved, excess)


def contradicts_camera(observations: Observations, best: Fit) -> bool:
    """Whether the spots contradict a camera that is taken as exact; see `CameraErrors.revealed`.

    False where the spots have errors of camera or map beside their noise.
    """
    return not observations.correlated and camera_errors(observations, best).revealed
