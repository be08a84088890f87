"""MAP fit with gravity: covariance consistency, ambiguity, and observations that are left out."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from estimator_correspondences import device, simulated
from estimator_synthetic import Array, View, grid, view_of

from estimator.errors import EstimationFailure
from estimator.methods.gravity_fit import fit_correspondences
from estimator.methods.pnp import position_from_pixels
from estimator.methods.variant import Estimate

TABLE_1 = np.array([[0.5, 1.5, 3.5], [0.3, 1.9, 3.5], [0.8, 1.2, 3.5], [0.9, 1.1, 3.5]])


def draws(view: View, leds_m: Array, sigma_px: float, error_deg: float, count: int) -> list[Estimate]:
    """Answers to as many draws of centroids' and accelerometer's errors."""
    rng = np.random.default_rng(7)
    return [
        fit_correspondences(device(view, error_deg, rng), simulated(view, leds_m, sigma_px, rng)) for _ in range(count)
    ]


def nees(answers: list[Estimate], view: View) -> Array:
    """Squared errors in units of the stated covariance, (n,)."""
    errors = np.array([answer.position_m - view.position_m for answer in answers])
    return np.array(
        [e @ np.linalg.solve(a.covariance_m2, e) for e, a in zip(errors, answers, strict=True)]  # type: ignore[arg-type]
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("leds", "sigma_px", "error_deg"),
    [
        pytest.param(grid(5, 4, 0.14, (3, 2, 3.0)), 0.02, 0.5, id="the spots say all"),
        pytest.param(grid(2, 2, 0.1, (3, 2, 3.0)), 0.05, 0.1, id="gravity says as much"),
        pytest.param(TABLE_1, 0.05, 0.1, id="table 1, near a line"),
        pytest.param(grid(4, 1, 0.14, (3, 2, 3.0)), 0.02, 0.1, id="on a line"),
        pytest.param(grid(2, 2, 0.2, (3, 2, 3.0))[:3], 0.02, 0.1, id="three"),
    ],
)
def test_the_covariance_is_consistent(leds: Array, sigma_px: float, error_deg: float) -> None:
    """Over n draws the squared errors in units of the covariance add up to chi^2 of 3 n degrees: 3 n +- sqrt(6 n).

    The errors are small enough for the problem to be all but linear: 0.5 deg is a hundredth, and where it counts
    least. Five sigma of a sum of 120 are 37 %: half or twice the variance would be seen.
    """
    n = 120
    view = view_of(leds.mean(axis=0), 2.8, 25, -15, 40, (4000, 3000, 3000.0))
    found = nees(draws(view, leds, sigma_px, error_deg, n), view)
    assert abs(found.sum() - 3 * n) < 5 * np.sqrt(6 * n)


def test_gravity_decides_between_the_two_poses_of_a_plane() -> None:
    """Table 1's LEDs from its floor at (1.17, 3.5): without gravity a third of such draws are off by metres."""
    view = View(4000, 3000, 15000.0, (1.17, 3.5, 0.01))
    rng = np.random.default_rng(3)
    worst_pnp = 0.0
    for _ in range(20):
        seen = simulated(view, TABLE_1, 0.02, rng)
        answer = fit_correspondences(device(view, 0.1, rng), seen)
        error = answer.position_m - view.position_m
        assert answer.covariance_m2 is not None
        # 1e-6 of chi^2 with three degrees of freedom.
        assert error @ np.linalg.solve(answer.covariance_m2, error) < 30.7
        pixels = np.array([(one.spot.u_px, one.spot.v_px) for one in seen])
        pnp_m = position_from_pixels(TABLE_1, pixels, view.K, (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_IPPE))
        worst_pnp = max(worst_pnp, float(np.linalg.norm(pnp_m - view.position_m)))
    assert worst_pnp > 1.0


@pytest.mark.slow
def test_two_equal_poses_are_ambiguous_and_gravity_resolves_them() -> None:
    """Four LEDs in 6 cm, 3 m away, 0.1 px: perspective over the pattern is 0.06 / 3 sin(15 deg) of its 60 px, 0.3 px,
    so that both of the plane's poses fit. They are 30 deg apart: an accelerometer good to 20 deg cannot tell, one to
    0.5 deg can.
    """
    leds = grid(2, 2, 0.06, (3, 2, 3.0))
    view = view_of((3, 2, 3.0), 3.0, 15, 0, 10, (800, 600, 3000.0))
    unsure = draws(view, leds, 0.1, 20.0, 60)
    # Errors of 20 deg are not small; no estimate may have a large error without the flag.
    far = [np.linalg.norm(a.position_m - view.position_m) > 0.5 for a in unsure]
    flagged = [a.ambiguous for a in unsure]
    assert any(flagged)
    assert any(far)
    assert not any(f and not a for f, a in zip(far, flagged, strict=True))
    sure = draws(view, leds, 0.1, 0.5, 60)
    assert not any(a.ambiguous for a in sure)
    assert nees(sure, view).max() < 30.7


def test_an_accelerometer_without_error_is_exact() -> None:
    """LEDs on a line give no tilt about it; gravity does, exactly."""
    leds = grid(4, 1, 0.14, (3, 2, 3.0))
    view = view_of((3, 2, 3.0), 2.8, 25, -15, 40)
    answer = fit_correspondences(device(view, 0.0), simulated(view, leds))
    # Pixels are exact; the reading has a standard deviation of 1e-5 deg.
    np.testing.assert_allclose(answer.position_m, view.position_m, atol=1e-7)


def test_two_leds_are_refused() -> None:
    view = view_of((3, 2, 3.0), 2.8, 25, -15, 40)
    leds = grid(2, 1, 0.14, (3, 2, 3.0))
    with pytest.raises(EstimationFailure, match="position: LEDs identified: 2, needed: 3"):
        fit_correspondences(device(view, 0.1), simulated(view, leds))


def test_leds_at_different_heights_are_taken() -> None:
    leds = grid(3, 3, 0.2, (3, 2, 2.7))
    leds[::2, 2] += 0.15
    view = view_of((3, 2, 2.7), 2.5, 25, -30, 40)
    answer = fit_correspondences(device(view, 0.1), simulated(view, leds))
    np.testing.assert_allclose(answer.position_m, view.position_m, atol=1e-8)


def test_a_spot_that_cannot_be_undistorted_is_left_out() -> None:
    """A fish-eye, and a spot 85 deg off its axis: the others give the position."""
    leds = grid(3, 3, 0.2, (3, 2, 2.7))
    view = view_of((3, 2, 2.7), 2.5, size=(4000, 3000, 1000.0))
    frame = device(view, 0.1)
    frame = replace(frame, camera=frame.camera.model_copy(update={"projection": "equidistant"}))
    rays = (leds - view.position_m) @ view.R_cam_world.T
    theta = np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2])
    theta[0] = np.radians(85)
    across = rays[:, :2] / np.maximum(np.linalg.norm(rays[:, :2], axis=1, keepdims=True), 1e-300)
    pixels = 1000 * theta[:, None] * across + view.K[:2, 2]
    seen = [
        replace(one, spot=replace(one.spot, u_px=float(u), v_px=float(v)))
        for one, (u, v) in zip(simulated(view, leds), pixels, strict=True)
    ]
    np.testing.assert_allclose(fit_correspondences(frame, seen).position_m, view.position_m, atol=1e-8)
