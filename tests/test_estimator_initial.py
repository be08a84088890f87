"""Initial values of maximum likelihood, and how far its search goes from them."""

from dataclasses import replace

import numpy as np
from estimator_synthetic import grid, poisson, render, view_of
from scipy.stats import chi2
from test_estimator_maximum_likelihood import SIX, TARGET, frame_of, misread, most_likely, with_exact_camera

from estimator.camera.pose import Pose
from estimator.io.device import DeviceFrame
from estimator.pixels.initial import gravity_of, start_at_spots
from estimator.pixels.nuisances import NO_COMPONENTS, PROFILE, Priors
from estimator.spots.correspondences import find_correspondences

DIM_VIEW = view_of(TARGET, 3.0, 25.0, -15.0, 30.0, size=(320, 240, 1500.0))


def dim_frames() -> list[DeviceFrame]:
    """Four draws of six LEDs of 60 e before 40 e."""
    expected = render(DIM_VIEW, SIX, 0.01, 100.0, samples=16)
    generator = np.random.default_rng(0)
    return [misread(DIM_VIEW, frame_of(DIM_VIEW, SIX, poisson(expected, seed)), generator) for seed in range(4)]


def test_the_search_ends_where_the_rest_of_the_way_is_short() -> None:
    """The noise of dim LEDs makes the likelihood's curvature differ by some 10 % from the information, and each step
    leaves as much of itself. After a step of a tenth of a sigma a hundredth is left, whose square adds nothing to a
    variance. Two searches, from two starts, agree to 0.1 sigma: the pixels next to an edge, which tell the background,
    are those at the start. A search that ended at a step of one sigma would leave steps of 0.1 to 0.2 sigma here.
    """
    truth = Pose(np.array(DIM_VIEW.position_m), DIM_VIEW.R_cam_world)
    for frame in dim_frames():
        one = most_likely(frame, truth)
        assert one.last.solution.step2 < 0.1**2
        other = most_likely(frame, one.pose)
        moved = other.pose.position_m - one.pose.position_m
        assert moved @ np.linalg.solve(one.covariance[:3, :3], moved) < 0.1**2


def test_the_search_does_not_go_back_and_forth_over_a_kink() -> None:
    """The share of a pixel that an edge just enters grows with the root of its way: the noise of such a pixel curves
    the likelihood more than twice as much as the information says, and full steps never end. In the second draw they
    go back and forth by 0.15 sigma.
    """
    frame = dim_frames()[1]
    found = most_likely(frame, Pose(np.array(DIM_VIEW.position_m), DIM_VIEW.R_cam_world))
    error = found.pose.position_m - DIM_VIEW.position_m
    assert error @ np.linalg.solve(found.covariance[:3, :3], error) < chi2.ppf(0.9999, 3)


def test_the_start_accounts_for_the_eccentricity_of_large_faces() -> None:
    """Faces of 15 cm radius at 3 m: under the lens's cos^4 their centroids are those of points r^2 h / d^2 above the
    LEDs, 7.5 mm and less. The next order is r^4 / h^3, 19 um, and centroids of edges in 12 x 12 parts are right to
    0.02 px, 40 um at 1500 px, over the lever of four directions: 0.2 mm.
    """
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0, size=(800, 600, 1500.0))
    leds_m = grid(3, 2, 0.4, TARGET)
    x, y = np.meshgrid(np.arange(800) + 0.5 - 400, np.arange(600) + 0.5 - 300)
    falloff = (1 + (x**2 + y**2) / 1500.0**2) ** -2
    image = np.rint(render(view, leds_m, 0.15, 4000.0, samples=12) * falloff).astype(np.uint32)
    frame = frame_of(view, leds_m, image)
    frame = replace(frame, leds={key: led.model_copy(update={"radius_m": 0.15}) for key, led in frame.leds.items()})
    frame = with_exact_camera(frame)
    away = Pose(np.array(view.position_m) + [0.05, -0.05, 0.05], view.R_cam_world)
    priors = Priors.of(frame)
    start = start_at_spots(frame, gravity_of(frame), priors, find_correspondences(frame), away, NO_COMPONENTS)
    assert np.abs(start.pose.position_m - view.position_m).max() < 0.2e-3


def test_a_gradient_of_luminance_moves_a_spot_as_a_shift_of_its_led_does() -> None:
    """Luminance 1 + g x / r over a disc of radius r has its centroid at g r / 4: gradients of sigma 0.05 are shifts of
    0.05 r / 4, 0.125 mm, and the spots' pose is as uncertain by either, but for the light.s centre, some 1e-5 here.
    """
    frame = with_exact_camera(dim_frames()[0])
    radius_m = 0.01
    covariances = []
    for columns, sigma in ((PROFILE, 0.05), (slice(0, 3), 0.05 * radius_m / 4)):
        priors = Priors.of(frame)
        priors.leds[:, columns][:, :2] = sigma
        truth = Pose(np.array(DIM_VIEW.position_m), DIM_VIEW.R_cam_world)
        start = start_at_spots(frame, gravity_of(frame), priors, find_correspondences(frame), truth, NO_COMPONENTS)
        covariances.append(start.covariance)
    np.testing.assert_allclose(covariances[1], covariances[0], rtol=1e-3)
