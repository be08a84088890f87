"""Leveling by gravity: exact, and in the right direction."""

import numpy as np
import pytest
from estimator_synthetic import GRAVITY_M_S2, View, grid, view_of

from estimator.camera.leveling import level, printed_eq6, tilt_from_gravity, tilt_sigmas
from estimator.camera.pose import rotation
from estimator.errors import EstimationFailure
from estimator.io.device import Accelerometer

K = np.array([[1000.0, 0, 200], [0, 1000.0, 150], [0, 0, 1]])


def test_a_reading_by_hand() -> None:
    """Rx(30 deg) (0, 0, g) = (0, g / 2, g sqrt(3) / 2); Ry(30 deg) (0, 0, g) = (-g / 2, 0, g sqrt(3) / 2)."""
    g = GRAVITY_M_S2
    np.testing.assert_allclose(tilt_from_gravity((0, g / 2, g * np.sqrt(3) / 2)), (np.pi / 6, 0), atol=1e-15)
    np.testing.assert_allclose(tilt_from_gravity((-g / 2, 0, g * np.sqrt(3) / 2)), (0, np.pi / 6), atol=1e-15)
    np.testing.assert_allclose(tilt_from_gravity((0, 0, g)), (0, 0), atol=1e-15)


@pytest.mark.parametrize("yaw_deg", [0.0, 35.0, -120.0])
@pytest.mark.parametrize(("tilt_x_deg", "tilt_y_deg"), [(0, 0), (60, 0), (0, -60), (60, 60), (-33, 47), (80, 20)])
def test_tilt_comes_back_from_gravity_whatever_the_yaw(tilt_x_deg: float, tilt_y_deg: float, yaw_deg: float) -> None:
    view = View(400, 300, 1500.0, (0, 0, 0), tilt_x_deg, tilt_y_deg, yaw_deg)
    x, y, z = view.gravity_m_s2
    np.testing.assert_allclose(np.degrees(tilt_from_gravity((x, y, z))), (tilt_x_deg, tilt_y_deg), atol=1e-12)


def test_the_rotation_is_the_formats_product() -> None:
    view = View(400, 300, 1500.0, (0, 0, 0), 33, -47)
    np.testing.assert_allclose(rotation(np.radians(33), np.radians(-47)), view.R_cam_world, atol=1e-15)


def test_the_printed_eq_6_is_right_for_tilt_x_alone() -> None:
    """Its element (2, 3) lacks cos(xi); (3, 1) is 0, with sin(zeta) as a factor that should be sin(xi) cos(zeta)."""
    np.testing.assert_allclose(printed_eq6(0.5, 0.0), rotation(0.5, 0.0), atol=1e-15)
    wrong = printed_eq6(0.5, 0.3) - rotation(0.5, 0.3)
    assert wrong[1, 2] == pytest.approx(np.sin(0.5) * (1 - np.cos(0.3)))
    assert wrong[2, 0] == pytest.approx(-np.cos(0.5) * np.sin(0.3))
    assert np.count_nonzero(np.abs(wrong) > 1e-15) == 2


def test_raising_tilt_x_moves_an_led_overhead_down_and_tilt_y_moves_it_left() -> None:
    """So a pixel at v = cy + f tan(30 deg) is overhead for tilt_x = 30 deg, and u = cx - f tan(30 deg) for tilt_y."""
    tangent = np.tan(np.pi / 6)
    overhead = [[200.0, 150.0]]
    np.testing.assert_allclose(level(np.array([[200, 150 + 1000 * tangent]]), K, rotation(np.pi / 6, 0)), overhead)
    np.testing.assert_allclose(level(np.array([[200 - 1000 * tangent, 150]]), K, rotation(0, np.pi / 6)), overhead)


@pytest.mark.parametrize("yaw_deg", [0.0, 70.0])
@pytest.mark.parametrize(("tilt_x_deg", "tilt_y_deg"), [(20, 0), (0, 20), (-35, 40), (60, 60)])
def test_leveled_pixels_are_those_of_a_level_camera_at_the_same_place(
    tilt_x_deg: float, tilt_y_deg: float, yaw_deg: float
) -> None:
    leds = grid(3, 3, 0.2, (3, 3, 3))
    tilted = view_of((3, 3, 3), 2.5, tilt_x_deg, tilt_y_deg, yaw_deg, (4000, 3000, 15000.0))
    same_place = View(4000, 3000, 15000.0, tilted.position_m, yaw_deg=yaw_deg)
    x, y, z = tilted.gravity_m_s2
    leveled = level(tilted.project(leds), tilted.K, rotation(*tilt_from_gravity((x, y, z))))
    # Pixels up to 6e4, a few roundings of 1e-16 each, magnified by 1 / cos^2 of 75.5 deg = 16.
    np.testing.assert_allclose(leveled, same_place.project(leds), atol=1e-8)


def test_pixels_of_a_level_camera_are_unchanged() -> None:
    pixels = np.array([[200.0, 150.0], [13.5, 270.25]])
    # Pixels up to 300, through K^-1 and K: a few roundings of 300 * 1e-16.
    np.testing.assert_allclose(level(pixels, K, rotation(0, 0)), pixels, atol=1e-12)


@pytest.mark.parametrize("v_px", [150.0, 160.0])
def test_the_horizon_is_refused(v_px: float) -> None:
    """At tilt_x = 90 deg the image's centre looks at the horizon, and its lower half up."""
    upright = rotation(np.pi / 2, 0)
    level(np.array([[200.0, 250.0]]), K, upright)
    with pytest.raises(EstimationFailure, match=r"leveling: .*horizon"):
        level(np.array([[200.0, 250.0], [200.0, 300.0 - v_px]]), K, upright)


def test_no_gravity_is_refused() -> None:
    with pytest.raises(EstimationFailure, match=r"leveling: .*gravity"):
        tilt_from_gravity((0.0, 0.0, 0.0))


def test_the_error_of_a_real_part_in_tilt_x_grows_with_tilt_y() -> None:
    """Gravity in camera axes is (-sin y, sin x cos y, cos x cos y): raising tilt_x turns it by cos(tilt_y) alone."""
    real, papers = (Accelerometer(kind=kind, error_deg=1.0) for kind in ("imu", "tilt-error"))
    level, aside = (np.degrees(tilt_sigmas(real, np.radians(tilt))) for tilt in (0.0, 60.0))
    np.testing.assert_allclose(level, [1.0, 1.0])
    np.testing.assert_allclose(aside, [2.0, 1.0])
    np.testing.assert_allclose(np.degrees(tilt_sigmas(papers, np.radians(60.0))), [1.0, 1.0])
    up = np.array([-np.sin(1.0), np.sin(0.3) * np.cos(1.0), np.cos(0.3) * np.cos(1.0)])
    across = np.cross(up, [1.0, 0.0, 0.0])
    turned = up + 1e-6 * across / np.linalg.norm(across)
    x, _ = tilt_from_gravity(tuple((9.8 * turned).tolist()))
    assert abs(abs(x - 0.3) / 1e-6 - tilt_sigmas(real, 1.0)[0] / np.radians(1.0)) < 1e-3
