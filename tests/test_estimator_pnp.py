"""Perspective-n-point: exact on exact pixels, refused by name where it cannot be."""

import cv2
import numpy as np
import pytest
from estimator_synthetic import Array, grid, view_of

from estimator.errors import EstimationFailure
from estimator.methods.pnp import position_from_pixels

TABLE_1 = np.array([[0.5, 1.5, 3.5], [0.3, 1.9, 3.5], [0.8, 1.2, 3.5], [0.9, 1.1, 3.5]])
TRIANGLE = np.array([[0.0, 0, 4], [3.0, 0, 4], [0, 3.0, 4]])
SQPNP, IPPE = (cv2.SOLVEPNP_SQPNP,), (cv2.SOLVEPNP_IPPE,)
BOTH = SQPNP + IPPE


@pytest.mark.parametrize("yaw_deg", [0.0, 130.0])
@pytest.mark.parametrize(("tilt_x_deg", "tilt_y_deg"), [(0, 0), (30, -20), (60, 0), (-40, 50), (60, 60)])
@pytest.mark.parametrize("leds", [TABLE_1, grid(5, 4, 0.14, (3, 2, 2.7))], ids=["table 1", "grid"])
def test_pnp_recovers_the_exact_position_from_exact_pixels(
    leds: Array, tilt_x_deg: float, tilt_y_deg: float, yaw_deg: float
) -> None:
    view = view_of(leds.mean(axis=0), 2.6, tilt_x_deg, tilt_y_deg, yaw_deg, (4000, 3000, 15000.0))
    found = position_from_pixels(leds, view.project(leds), view.K, BOTH)
    np.testing.assert_allclose(found, view.position_m, atol=1e-6)


def test_pnp_takes_skew_and_any_principal_point() -> None:
    view = view_of((3, 2, 2.7), 2.6, 20, 10)
    K = np.array([[15000.0, 300.0, 1800], [0, 14000.0, 1600], [0, 0, 1]])
    leds = grid(5, 4, 0.14, (3, 2, 2.7))
    seen = (leds - view.position_m) @ view.R_cam_world.T @ K.T
    np.testing.assert_allclose(
        position_from_pixels(leds, seen[:, :2] / seen[:, 2:], K, BOTH), view.position_m, atol=1e-6
    )


def test_pnp_works_with_leds_at_different_heights() -> None:
    leds = grid(3, 3, 0.2, (3, 2, 2.7))
    leds[::2, 2] += 0.15
    view = view_of((3, 2, 2.7), 2.5, 25, -30, 40)
    np.testing.assert_allclose(position_from_pixels(leds, view.project(leds), view.K, BOTH), view.position_m, atol=1e-6)


def test_pnp_puts_the_camera_below_the_leds() -> None:
    """From above, the same LEDs have a pose that fits; it is excluded."""
    leds = grid(3, 3, 0.2, (3, 2, 2.7))
    view = view_of((3, 2, 2.7), 2.5)
    mirrored = view.project(leds)
    mirrored[:, 0] = 2 * view.K[0, 2] - mirrored[:, 0]
    with pytest.raises(EstimationFailure, match="position: no pose has the camera below"):
        position_from_pixels(leds, mirrored, view.K, BOTH)


def test_pnp_refuses_lines_and_too_few() -> None:
    line = np.array([[x, 2 * x, 2.7] for x in (0.0, 0.1, 0.2, 0.35)])
    view = view_of((0.1, 0.2, 2.7), 2.5, 10, 5)
    with pytest.raises(EstimationFailure, match="position: the LEDs are on one line"):
        position_from_pixels(line, view.project(line), view.K, BOTH)
    with pytest.raises(EstimationFailure, match="position: LEDs identified: 3, needed: 4"):
        position_from_pixels(TRIANGLE, view.project(TRIANGLE), view.K, BOTH)


def test_ippe_alone_refuses_leds_in_no_plane() -> None:
    leds = grid(3, 3, 0.2, (3, 2, 2.7))
    leds[::2, 2] += 0.15
    view = view_of((3, 2, 2.7), 2.5, 25, -30, 40)
    with pytest.raises(EstimationFailure, match="position: the LEDs are not in one plane"):
        position_from_pixels(leds, view.project(leds), view.K, IPPE)


@pytest.mark.parametrize("method", [SQPNP, IPPE])
def test_either_method_alone_is_exact_on_a_grid(method: tuple[int]) -> None:
    leds = grid(5, 4, 0.14, (3, 2, 2.7))
    view = view_of((3, 2, 2.7), 2.6, 30, -20, 10)
    np.testing.assert_allclose(
        position_from_pixels(leds, view.project(leds), view.K, method), view.position_m, atol=1e-6
    )
