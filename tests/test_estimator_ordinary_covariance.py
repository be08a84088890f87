"""Covariance by ordinary least squares: how large residuals have to be to count as errors of the map."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from estimator_correspondences import device, simulated
from estimator_synthetic import Array, grid, view_of

from estimator.camera.pose import Pose
from estimator.io.led_map import DiscLed
from estimator.solvers.observations import Observations, centroid_images, observe, pose_slopes, pose_vector
from estimator.solvers.ordinary_covariance import ordinary_covariance

TARGET = (3.0, 2.0, 3.0)
LEDS = grid(3, 2, 0.4, TARGET)
RADIUS_M = 0.2
VIEW = view_of(TARGET, 2.0, 25, -15, 40, (4000, 3000, 3000.0))
TRUTH = Pose(np.array(VIEW.position_m), VIEW.R_cam_world)
FREEDOM = 2 * len(LEDS) - 6
LIMIT = 38.2583
"""Chi-square of FREEDOM = 6 exceeds x with the probability exp(-x / 2) (1 + x / 2 + (x / 2)^2 / 2): 1e-6."""


def observed(sigma_px: float) -> Observations:
    """Large discs, seen aslant, with the centroids of points and their errors."""
    spots = [
        replace(
            one,
            led=DiscLed(id=one.led.id, position_m=one.led.position_m, radius_m=RADIUS_M),
            spot=replace(one.spot, covariance_px2=sigma_px**2 * np.eye(2)),
        )
        for one in simulated(VIEW, LEDS)
    ]
    return observe(device(VIEW, 0.5), spots)


def left_open(observations: Observations) -> tuple[Array, Array]:
    """Eccentricities of the spots that no pose makes up for, (2n,), and an orthonormal basis of all such, (2n, 6)."""
    slopes = pose_slopes(observations, TRUTH)[0].reshape(-1, 6)
    basis = np.linalg.svd(slopes)[0][:, 6:]
    points = centroid_images(TRUTH, LEDS, np.zeros(len(LEDS)))[0]
    eccentric = (centroid_images(TRUTH, LEDS, observations.lift_m2)[0] - points).ravel()
    return basis @ basis.T @ eccentric, basis


@pytest.mark.parametrize(("share", "widened"), [(0.98, False), (1.02, True)])
def test_residuals_that_eccentricity_explains_are_no_errors_of_the_map(share: float, widened: bool) -> None:
    """The expected square of the residuals is that of six of the centroids' errors and of the eccentricities, which are
    as large here: the covariance is widened where it is LIMIT / 6 times as much as both together.
    """
    sigma = float(np.linalg.norm(left_open(observed(1.0))[0])) / np.sqrt(FREEDOM)  # of a coordinate, normalized
    made = observed(sigma * VIEW.focal_px)
    eccentric, basis = left_open(made)
    square = share * LIMIT / FREEDOM * 2 * float(eccentric @ eccentric)
    points = centroid_images(TRUTH, LEDS, np.zeros(len(LEDS)))[0]
    made = replace(made, image=points + (np.sqrt(square) * basis[:, 0]).reshape(-1, 2))
    small = replace(made, image=points)
    ratio = np.trace(ordinary_covariance(made, TRUTH)) / np.trace(ordinary_covariance(small, TRUTH))
    # Most of it is the known movement by eccentricity, which nothing widens.
    assert ratio > 1.01 if widened else ratio == pytest.approx(1.0, rel=1e-9)


def test_slopes_by_the_pose_are_those_of_differences() -> None:
    """Of spots and position. Central differences of step h are off by h^2, 1e-10, and by rounding over h, 1e-11."""
    made, h = observed(1.0), 1e-5
    centre = LEDS.mean(axis=0)

    def moved(x: Array) -> tuple[Array, Array]:
        R_cam_world = cv2.Rodrigues(x[:3])[0]
        pose = Pose(centre - R_cam_world.T @ x[3:], R_cam_world)
        return centroid_images(pose, LEDS, np.zeros(len(LEDS)))[0], pose.position_m

    x = pose_vector(made, TRUTH)
    np.testing.assert_allclose(moved(x)[1], TRUTH.position_m, atol=1e-14)
    of_spots, of_position = pose_slopes(made, TRUTH)
    for k, step in enumerate(h * np.eye(6)):
        (ahead, to), (behind, back) = moved(x + step), moved(x - step)
        np.testing.assert_allclose(of_spots[:, :, k], (ahead - behind) / (2 * h), atol=1e-9)
        np.testing.assert_allclose(of_position[:, k], (to - back) / (2 * h), atol=1e-9)


def test_the_limit_is_one_in_a_million() -> None:
    half = LIMIT / 2
    assert np.exp(-half) * (1 + half + half**2 / 2) == pytest.approx(1e-6, rel=1e-4)
