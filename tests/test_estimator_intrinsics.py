"""Errors of a camera's intrinsics: those of datasets/FORMAT.md by hand, and their slopes by differences."""

import numpy as np
import pytest
from test_estimator_device import CAMERA

from estimator.camera.intrinsics import intrinsic_slopes_px, with_errors
from estimator.camera.pose import Pose
from estimator.camera.projection import project

# With skew, distortion along y moves u too.
TOLD = CAMERA.model_copy(update={"K": ((3000.0, 7.0, 800.0), (0.0, 3010.0, 600.0), (0.0, 0.0, 1.0))})
ERRORS = np.array([0.01, 0.002, 3.0, -4.0, 0.1, 0.01, -0.02])


def test_the_true_camera_is_the_told_one_plus_its_errors() -> None:
    """fx (1 + focal) (1 + aspect / 2), fy (1 + focal) (1 - aspect / 2), cx + cx_px, and coefficients of distortion."""
    true = with_errors(TOLD, ERRORS)
    assert true.K[0] == pytest.approx((3000 * 1.01 * 1.001, 7.0, 803.0))
    assert true.K[1] == pytest.approx((0.0, 3010 * 1.01 * 0.999, 596.0))
    assert true.distortion is not None
    assert (true.distortion.k1, true.distortion.k2, true.distortion.p1, true.distortion.p2) == (0.1, 0.0, 0.01, -0.02)
    assert with_errors(true, np.zeros(7)) == true


@pytest.mark.parametrize("parameter", range(7))
def test_slopes_are_those_of_a_camera_with_errors(parameter: int, rng: np.random.Generator) -> None:
    """Central differences of 1e-6: pixels of 1e3 keep 1e-13 of themselves, slopes so 1e-4."""
    true = with_errors(TOLD, ERRORS)
    p_cam = np.column_stack([rng.uniform(-0.3, 0.3, (20, 2)), np.ones(20)])
    pose = Pose(np.zeros(3), np.eye(3))
    slopes = intrinsic_slopes_px(p_cam, true.normalized(project(p_cam, pose, true).pixels), true)
    step = 1e-6 * np.eye(7)[parameter]
    if parameter < 2:
        # Errors on top of errors multiply: focal by (1 + focal), aspect by (1 +- aspect / 2).
        focal, aspect = ERRORS[:2]
        by_axis = [1 + focal] * 2 if parameter == 0 else [1 + aspect / 2, 1 - aspect / 2]
        slopes[:, :, parameter] /= by_axis
    ends = [project(p_cam, pose, with_errors(TOLD, ERRORS + sign * step)).pixels for sign in (1, -1)]
    np.testing.assert_allclose(slopes[:, :, parameter], (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-4)
