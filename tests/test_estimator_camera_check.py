"""Check of a camera that states no errors: by pixels, and what its errors then say."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from estimator_correspondences import EXACT
from estimator_synthetic import grid, poisson, render, view_of
from scipy.stats import chi2
from test_estimator_maximum_likelihood import SAMPLES, TARGET, frame_of, most_likely

from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.io.camera import CameraUncertainty
from estimator.io.device import DeviceFrame
from estimator.methods.camera_statement import Judged
from estimator.methods.maximum_likelihood import judged
from estimator.pixels.camera_check import camera_errors_by_pixels
from estimator.pixels.initial import gravity_of
from estimator.pixels.led_model import SIZE_PARAMETER
from estimator.pixels.likelihood import Noise, fit_photometry, score
from estimator.pixels.nuisances import Gravity, Nuisances, Priors
from estimator.solvers.camera_check import CameraErrors

VIEW = view_of(TARGET, 3.0, 15.0, -10.0, 30.0, size=(900, 700, 1500.0))
LEDS_M = grid(4, 3, 0.4, TARGET)
POSE = Pose(np.array(VIEW.position_m), VIEW.R_cam_world)
DRAWS = 3


def frames(focal: float, pp_px: float = 0.0, stated: CameraUncertainty | None = None) -> list[DeviceFrame]:
    """Draws of noise; the device is told a focal length that is too short by `focal`, relative, a principal point that
    is off by `pp_px` along u and v, and what it is told to think of them.
    """
    expected, found = render(VIEW, LEDS_M, 0.01, samples=SAMPLES), []
    for seed in range(DRAWS):
        frame = frame_of(VIEW, LEDS_M, poisson(expected, seed))
        (fx, skew, cx), (_, fy, cy), last = frame.camera.K
        K = (fx / (1 + focal), skew, cx + pp_px), (0.0, fy / (1 + focal), cy - pp_px), last
        told = frame.camera.model_copy(update={"K": K, "uncertainty": stated})
        found.append(replace(frame, camera=told))
    return found


def errors_of_camera(frame: DeviceFrame) -> CameraErrors:
    gravity, priors = gravity_of(frame), Priors.of(frame)
    found = most_likely(frame, POSE)
    pixels, result, of_leds = found.pixels, found.last, priors.only(found.pixels.index)
    state = result.nuisances.state(result.pose, frame.camera, of_leds)
    rendered = pixels.model.render(state, np.arange(SIZE_PARAMETER))
    photometry = fit_photometry(pixels, rendered, result.used, Noise.of(frame), result.photometry)
    information, gradient = (one.sum(axis=0) for one in score(pixels, rendered, photometry))
    return camera_errors_by_pixels(frame, gravity, of_leds, result, information, gradient)


@pytest.mark.slow
@pytest.mark.parametrize("focal", [0.0, 1e-3])
def test_the_pixels_tell_the_focal_length_s_error_and_its_standard_deviation(focal: float) -> None:
    """Deviations from the true error, in standard deviations: chi-square of one degree of freedom a draw."""
    errors = [errors_of_camera(frame) for frame in frames(focal)]
    squares = [((one.found[0] - focal) / one.sigmas[0]) ** 2 for one in errors]
    assert sum(squares) < chi2.isf(1e-4, DRAWS)
    # A standard deviation of some 0.01 %: far below the error.
    assert 5e-5 < errors[0].sigmas[0] < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("stated", [None, EXACT])
def test_a_focal_length_that_displaces_no_image_much_is_revealed_by_all_together(
    stated: CameraUncertainty | None,
) -> None:
    """0.1 % is 3 mm of range, hundreds of standard deviations, and some hundredths of a pixel that a pose leaves open:
    each LED's image agrees with the exact camera, and all together contradict it by ten standard deviations. Whether
    the device says that its camera is exact, or nothing, is all the same.
    """
    assert sum(nees_of(judged(frame)) for frame in frames(1e-3, stated=stated)) < chi2.isf(1e-4, 3 * DRAWS)


@pytest.mark.slow
@pytest.mark.parametrize(("focal", "pp_px"), [(1e-3, 0.0), (0.0, 5.0)])
def test_the_pixels_contradict_a_camera_that_is_stated_as_exact_and_is_not(focal: float, pp_px: float) -> None:
    """With the exact camera's own covariance the NEES would be above a thousand for the focal length."""
    found = [judged(frame) for frame in frames(focal, pp_px, EXACT)]
    assert all(one.contradicts for one in found)
    assert sum(map(nees_of, found)) < 20 * DRAWS


@pytest.mark.slow
def test_the_pixels_do_not_contradict_an_exact_camera() -> None:
    found = [judged(frame) for frame in frames(0.0, stated=EXACT)]
    assert not any(one.contradicts for one in found)
    assert sum(map(nees_of, found)) < chi2.isf(1e-4, 3 * DRAWS)


def nees_of(one: Judged) -> float:
    error = one.estimate.position_m - VIEW.position_m
    return float(error @ np.linalg.solve(one.estimate.covariance_m2, error))  # type: ignore[arg-type]


def test_errors_that_cannot_be_seen_reveal_nothing() -> None:
    """Five standard deviations reveal an error, but not where they exceed those of a camera as sold."""
    found, sigmas, moved = np.array([0.0, 5.0]), np.ones(2), np.zeros((3, 2))
    assert CameraErrors(found, sigmas, np.array([2.0, 2.0]), moved).revealed
    assert not CameraErrors(found, sigmas, np.array([2.0, 0.5]), moved).revealed
    assert not CameraErrors(found / 2, sigmas, np.array([2.0, 2.0]), moved).revealed


def test_an_unchecked_camera_costs_its_mean_square_error() -> None:
    """Sigma 0.1 % with a prior of 1 % and 0.2 % found: by hand; below an eighth of 0.1 % the camera is checked.

    Beside the focal length the second intrinsic would be revealed, 0.8 of its prior at four sigmas, and the third
    not, 1.2.
    """
    moved = np.array([[0.0, 1.0, 1.0], [1.0, 1.0, 0.0], [3.0, 1.0, 2.0]])
    found, assumed = np.array([2e-3, 0.3, 0.1]), np.array([1e-2, 1.0, 1.0])
    errors = CameraErrors(found, np.array([1e-3, 0.2, 0.3]), assumed, moved)
    weight, third = 1e-4 / (1e-4 + 1e-6), 1 / 1.09
    expected = (weight * 1e-6 + (weight * 2e-3) ** 2) * np.outer(moved[:, 0], moved[:, 0])
    expected += (third * 0.09 + (third * 0.1) ** 2) * np.outer(moved[:, 2], moved[:, 2])
    np.testing.assert_allclose(errors.unchecked_m2(), expected, rtol=1e-12)
    assert not CameraErrors(found, np.array([1.2e-4, 0.2, 0.3]), assumed, moved).unchecked_m2().any()


def test_gravity_keeps_a_tilt_from_making_up_for_the_focal_length() -> None:
    """Information of 2e4 each about a tilt and the focal length, 1.5e4 in common, and 1 / (0.01 rad)^2 = 1e4 of gravity
    about the tilt: 2e4 - 1.5e4^2 / 3e4 = 12500 is left of the focal length's, and a gradient of 25 says 0.002.
    """
    frame = frame_of(VIEW, LEDS_M, np.zeros((700, 900), dtype=np.uint32))
    priors = Priors.of(frame)
    gravity = Gravity(POSE.rig_angles(frame.camera)[:2], np.full(2, 0.01))
    used = np.ones(len(LEDS_M), dtype=bool)
    result = SimpleNamespace(pose=POSE, nuisances=Nuisances.zero(priors), used=used)
    information, gradient = 2e4 * np.eye(SIZE_PARAMETER), np.zeros(SIZE_PARAMETER)
    information[3, POSE_PARAMETERS] = information[POSE_PARAMETERS, 3] = 1.5e4
    gradient[POSE_PARAMETERS] = 25.0
    errors = camera_errors_by_pixels(frame, gravity, priors, result, information, gradient)  # type: ignore[arg-type]
    assert errors.found[0] == pytest.approx(0.002, rel=1e-9)
