"""Stereo: vectors from disparity, and the positions by rahman2011 and kim."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from estimator_synthetic import Array, View, grid, view_of

from estimator.errors import EstimationFailure
from estimator.io.camera import Camera
from estimator.io.device import DeviceFrame
from estimator.io.sensor import Sensor
from estimator.methods.catalogue import VARIANTS
from estimator.methods.kim import position_from_vectors
from estimator.solvers.stereo import stereo_partner, triangulated
from estimator.solvers.trilateration import position_from_ranges

LEDS = grid(4, 3, 0.13, (3, 2, 3.45))
BASELINE_M = np.array([0.08, -0.06])
LEVEL = np.eye(3)
NOISE = 0.02 / 15000


def rahman(here: Array, there: Array) -> Array:
    return position_from_ranges(LEDS, np.linalg.norm(triangulated(here, there, BASELINE_M), axis=1))


def kim(here: Array, there: Array) -> Array:
    return position_from_vectors(LEDS, triangulated(here, there, BASELINE_M))


def images(view: View) -> tuple[Array, Array]:
    """What a pinhole there sees, and one moved by BASELINE_M in its image plane, in units of the image distance."""
    seen = (LEDS - view.position_m) @ view.R_cam_world.T
    moved = seen - [*BASELINE_M, 0]
    return seen[:, :2] / seen[:, 2:], moved[:, :2] / moved[:, 2:]


@pytest.mark.parametrize("yaw_deg", [0.0, 35.0, -170.0])
def test_level_cameras_are_found_exactly(yaw_deg: float) -> None:
    view = view_of((3.1, 1.8, 3.45), 2.5, yaw_deg=yaw_deg)
    # 1e-16 of rounding over the disparity of 0.04; times (distance / pattern)^2 = 40 for the ranges.
    np.testing.assert_allclose(rahman(*images(view)), view.position_m, atol=1e-11)
    np.testing.assert_allclose(kim(*images(view)), view.position_m, atol=1e-11)


def test_tilted_ranges_stay_right_and_vectors_do_not() -> None:
    """A tilt of t moves the vectors' end by depth tan(t) across, to first order in t, and depth t^2 / 2 in height."""
    tilt = np.radians(1)
    view = view_of((3, 2, 3.45), 2.5, tilt_x_deg=1)
    np.testing.assert_allclose(rahman(*images(view)), view.position_m, atol=1e-11)
    error = np.abs(kim(*images(view)) - view.position_m)
    # Foreshortening by 1 - t^2 / 2 turns nothing; the LEDs lie within 0.25 m of the axis, a tenth of the depth.
    assert error[1] == pytest.approx(2.5 * np.tan(tilt), rel=1e-2)
    assert error[0] < 1e-3
    assert error[2] < 2.5 * tilt**2


def test_depth_is_the_baseline_over_the_disparity_and_nothing_across_it_counts() -> None:
    """3 m away and 0.1 m between the cameras: 1/30 of disparity."""
    baseline = np.array([0.1, 0.0])
    vectors = triangulated(np.array([[0.2, 0.05]]), np.array([[0.2 - 1 / 30, 0.07]]), baseline)
    np.testing.assert_allclose(vectors, [[0.6, 0.15, 3.0]], atol=1e-14)


@pytest.mark.parametrize("disparity", [0.0, -0.01, np.nan])
def test_a_disparity_that_is_none_is_refused(disparity: float) -> None:
    with pytest.raises(EstimationFailure, match="stereo: the disparity of an LED is not positive"):
        triangulated(np.array([[0.2, 0.0]]), np.array([[0.2 - disparity, 0.0]]), np.array([0.1, 0.0]))


@pytest.mark.parametrize("method", [rahman, kim])
def test_the_error_is_what_the_noise_predicts(method: Callable[[Array, Array], Array]) -> None:
    """To first order C = noise^2 J J^T, J by differences at exact images: e^T C^-1 e is chi-square of 3 degrees.

    Its mean over n draws has a standard error of sqrt(6 / n). Second order: noise over disparity, 1e-4.
    """
    view = view_of((3.1, 1.8, 3.45), 2.5, yaw_deg=20)
    exact = np.concatenate(images(view)).ravel()

    def position(flat: Array) -> Array:
        return method(*flat.reshape(2, -1, 2))

    h = 1e-7
    J = np.column_stack([(position(exact + h * axis) - position(exact - h * axis)) / (2 * h) for axis in np.eye(48)])
    precision = np.linalg.inv(NOISE**2 * J @ J.T)
    rng, draws = np.random.default_rng(4), 2000
    errors = np.array([position(exact + rng.normal(0, NOISE, 48)) - view.position_m for _ in range(draws)])
    squares = np.einsum("ni,ij,nj->n", errors, precision, errors)
    assert abs(squares.mean() - 3) < 5 * np.sqrt(6 / draws)


def test_depth_scatters_as_its_square() -> None:
    """sigma_z = z^2 sigma sqrt(2) / b, for two images that are off independently."""
    z_m, baseline_m, n = 3.0, 0.1, 20_000
    noise = np.random.default_rng(5).normal(0, NOISE, (2, n, 2))
    here = noise[0]
    there = noise[1] - [baseline_m / z_m, 0]
    depth = triangulated(here, there, np.array([baseline_m, 0.0]))[:, 2]
    assert abs(depth.std() / (z_m**2 * NOISE * np.sqrt(2) / baseline_m) - 1) < 5 / np.sqrt(2 * n)


def test_two_leds_have_a_yaw_and_one_has_none() -> None:
    view = view_of((3, 2, 3.45), 2.5, yaw_deg=77)
    vectors = (LEDS - view.position_m) @ view.R_cam_world.T
    np.testing.assert_allclose(position_from_vectors(LEDS[:2], vectors[:2]), view.position_m, atol=1e-12)
    with pytest.raises(EstimationFailure, match="position: LEDs identified: 1, needed: 2"):
        position_from_vectors(LEDS[:1], vectors[:1])


def frame_of(offset_m: tuple[float, float, float] = (0, 0, 0), R_cam_rig: Array = LEVEL) -> DeviceFrame:
    """A frame without content, with a camera at a place on the rig."""
    camera = Camera.model_construct(offset_m=offset_m, R_cam_rig=tuple(map(tuple, R_cam_rig)))
    return DeviceFrame((), camera, Sensor.model_construct(), (0.0, 0.0, 9.8), 0.0, 1e-3, (), {})


def turned(degrees: float) -> Array:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def test_the_partner_is_the_parallel_camera_with_the_longest_baseline() -> None:
    near, far = frame_of((0.05, 0, 0)), frame_of((-0.2, 0.1, 0))
    behind, askew = frame_of((1.0, 0, 0.3)), frame_of((1.0, 0, 0), turned(5))
    other, baseline_m = stereo_partner(replace(frame_of(), other_cameras=(near, behind, far, askew)))
    assert other is far
    np.testing.assert_allclose(baseline_m, [-0.2, 0.1])


def test_the_baseline_is_in_the_cameras_own_axes() -> None:
    """Both turned by 90 deg: x of the rig is -y of the cameras."""
    one, other = frame_of((0, 0, 0), turned(90)), frame_of((0.1, 0, 0), turned(90))
    np.testing.assert_allclose(stereo_partner(replace(one, other_cameras=(other,)))[1], [0, -0.1], atol=1e-15)


@pytest.mark.parametrize(
    "other_cameras",
    [(frame_of((0, 0, 0.1)),), (frame_of((0.1, 0, 0), turned(0.1)),), (frame_of((0, 0, 0)),)],
    ids=["in front", "askew", "at the same place"],
)
def test_other_rigs_are_refused(other_cameras: tuple[DeviceFrame, ...]) -> None:
    with pytest.raises(EstimationFailure, match="stereo: no second camera is parallel to this one and beside it"):
        stereo_partner(replace(frame_of(), other_cameras=other_cameras))


@pytest.mark.parametrize("name", ["rahman2011", "kim"])
def test_one_camera_is_refused(name: str) -> None:
    with pytest.raises(EstimationFailure, match="stereo: no second camera took this shot"):
        VARIANTS[name].estimate(frame_of())
