"""Upright two-point pose: exact for exact points, and in agreement with other methods."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from estimator_correspondences import device, simulated
from estimator_synthetic import Array, View, grid, view_of
from test_estimator_robust_fit import LEDS, VIEW, observed

import estimator.methods.up2p
from estimator.camera.leveling import level, tilt_from_gravity
from estimator.camera.pose import rotation
from estimator.errors import EstimationFailure
from estimator.methods.gravity_fit import agreement, judged_by
from estimator.methods.pnp import position_from_pixels
from estimator.methods.up2p import _judged as judged
from estimator.methods.up2p import fit_correspondences, pair_poses, upright_pose
from estimator.solvers.observations import Observations, observe
from estimator.solvers.ranging import law_of_sines, led_ranges
from estimator.solvers.trilateration import position_from_ranges

poselib = pytest.importorskip("poselib")


def random_view(rng: np.random.Generator, leds_m: Array) -> View:
    """Anywhere below the LEDs, turned and tilted up to 60 deg, with the LEDs about its axis."""
    tilts = rng.uniform(-60, 60, 2)
    height_m = rng.uniform(1.5, 3.4)
    return view_of(leds_m.mean(axis=0), height_m, *tilts, rng.uniform(-180, 180), (4000, 3000, 15000.0))


@pytest.mark.slow
def test_up2p_sqpnp_and_the_range_fit_agree_on_exact_points() -> None:
    """Three independent methods at 200 poses agree to a micrometre."""
    rng = np.random.default_rng(11)
    for _ in range(200):
        leds = grid(4, 3, 0.13, (3.5, 3.6, 3.5)) + np.append(rng.uniform(-0.03, 0.03, 2), 0)
        leds[:, :2] += rng.uniform(-0.03, 0.03, (12, 2))
        view = random_view(rng, leds)
        frame, pixels = device(view, 0.0), view.project(leds)
        upright_m = fit_correspondences(frame, simulated(view, leds)).position_m
        sqpnp_m = position_from_pixels(leds, pixels, view.K, (cv2.SOLVEPNP_SQPNP,))
        leveled = level(pixels, view.K, rotation(*tilt_from_gravity(frame.accelerometer_m_s2)))
        ranges_m = position_from_ranges(leds, led_ranges(leveled, view.K, leds, law_of_sines))
        for found_m in (upright_m, sqpnp_m, ranges_m):
            assert np.abs(found_m - view.position_m).max() < 1e-6


def test_poselib_s_two_points_alone_give_the_pose() -> None:
    """Before any refinement: its axes and ours are brought together rightly, for any pair."""
    rng = np.random.default_rng(12)
    for _ in range(50):
        leds = grid(2, 1, 0.3, (3.5, 3.6, 3.5)) + rng.uniform(-0.1, 0.1, (2, 3))
        view = random_view(rng, leds)
        seen = observe(device(view, 0.0), simulated(view, leds))
        poses = estimator.methods.up2p.pair_poses(seen)
        assert min(np.abs(pose.position_m - view.position_m).max() for pose in poses) < 1e-8
        assert min(np.abs(pose.R_cam_world - view.R_cam_world).max() for pose in poses) < 1e-8


def test_the_upright_start_is_exact_on_exact_points() -> None:
    leds = grid(3, 2, 0.2, (3, 2, 2.7))
    view = view_of((3, 2, 2.7), 2.6, 30, -20, 140)
    pose = upright_pose(observe(device(view, 0.0), simulated(view, leds)))
    assert pose is not None
    np.testing.assert_allclose(pose.position_m, view.position_m, atol=1e-10)
    np.testing.assert_allclose(pose.R_cam_world, view.R_cam_world, atol=1e-10)


def test_no_upright_start_below_the_horizon() -> None:
    leds = grid(3, 2, 0.2, (3, 2, 2.7))
    view = view_of((3, 2, 2.7), 2.6, 0, 0)
    frame = device(view_of((3, 2, 2.7), 2.6, 120, 0), 0.0)
    assert upright_pose(observe(frame, simulated(view, leds))) is None


def test_the_refinement_frees_the_tilt() -> None:
    """Two degrees of tilt error are 10 cm to a method that believes the reading; exact points undo it."""
    leds = grid(5, 4, 0.14, (3, 2, 2.7))
    view = view_of((3, 2, 2.7), 2.6, 20, -10, 40)
    wrong = device(view_of((3, 2, 2.7), 2.6, 22, -10, 40), 1.0)
    found_m = fit_correspondences(wrong, simulated(view, leds)).position_m
    np.testing.assert_allclose(found_m, view.position_m, atol=1e-6)


def test_without_poselib_there_is_a_named_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimator.methods.up2p, "poselib", None)
    with pytest.raises(EstimationFailure, match="up2p: PoseLib is not installed"):
        estimator.methods.up2p.up2p(device(view_of((3, 2, 2.7), 2.6), 0.1))


def test_the_first_of_the_poses_by_two_spots_ignores_how_far_outliers_are() -> None:
    """Four of nine spots off by 300 px to one side: squared errors without a limit rank a pose between them and the
    true ones first. Exact spots and a tilt read without error, so that a pair of true ones gives the true pose.
    """
    offsets = np.zeros((9, 2))
    offsets[[0, 1, 3, 4]] = [[300.0, 0.0], [300.0, 20.0], [290.0, 0.0], [300.0, -20.0]]
    first = pair_poses(observed(offsets, np.full(9, 0.02)))[0]
    np.testing.assert_allclose(first.position_m, VIEW.position_m, atol=1e-6)


def displaced() -> Observations:
    """Nine spots that state 0.02 px and are 3 px off, and gravity to 0.05 deg."""
    return observed(3.0 * np.random.default_rng(13).standard_normal((9, 2)), np.full(9, 0.02), 0.05)


def test_the_poses_by_two_spots_come_best_first() -> None:
    """By the squared distances in pixels, of which none here reaches the limit: 3 deg, three sigma of the tilts."""
    offsets = 3.0 * np.random.default_rng(13).standard_normal((9, 2))
    seen = observed(offsets, np.full(9, 0.02), 1.0)
    sums = [
        float(((p_cam[:, :2] / p_cam[:, 2:] - seen.image) ** 2).sum())
        for p_cam in (pose.in_camera(seen.leds_m) for pose in pair_poses(seen))
    ]
    assert len(sums) == 3
    assert sums[0] < sums[1] < sums[2]
    # A spot's error has a mean square of 18 px^2, and those of the widest pair, interpolated, add as much at most.
    assert sums[0] * seen.camera.matrix()[0, 0] ** 2 < 9 * 2 * 18


def test_gravity_counts_beside_errors_that_the_residuals_reveal() -> None:
    """Nine spots of a device that states no errors, displaced by 3 px, as by LEDs that are 3 mm off the map. They leave
    2 * 9 - 6 degrees of freedom to the size of their errors, and determine the tilt to 0.6 deg; the accelerometer reads
    it to 0.05 deg. So the estimate is that of `gravity-fit`, of the same minimum but for the tolerance of the search, a
    ten-thousandth of the standard deviations.
    """
    seen = displaced()
    found, expected = judged(seen).estimate, judged_by(agreement(seen)).estimate
    assert expected.covariance_m2 is not None
    assert found.covariance_m2 is not None
    sigma_m = np.sqrt(np.trace(expected.covariance_m2))
    np.testing.assert_allclose(found.position_m, expected.position_m, atol=1e-4 * sigma_m)
    np.testing.assert_allclose(found.covariance_m2, expected.covariance_m2, rtol=1e-3, atol=1e-3 * sigma_m**2)


def test_gravity_that_contradicts_displaced_spots_does_not_count() -> None:
    """The same spots; readings off by 10 deg to either side, said to be good to 0.05 deg, 16 standard deviations of
    the tilt by the spots, give one and the same estimate: that of the spots alone.
    """
    seen = displaced()
    wrong = [replace(seen, tilt_rad=seen.tilt_rad + np.radians([off_deg, 0.0])) for off_deg in (10.0, -10.0)]
    one_m, other_m = (judged(reading).estimate.position_m for reading in wrong)
    np.testing.assert_allclose(one_m, other_m, atol=1e-6)


def test_gravity_does_not_count_beside_a_camera_as_sold() -> None:
    """Five spots and a focal length that is stated as exact and 1 % wrong, which they contradict: other readings of
    gravity, within its error, change nothing.
    """
    from_centre = VIEW.project(LEDS) - np.array([2000.0, 1500.0])
    for seed in range(4):
        noise = 0.02 * np.random.default_rng(seed).standard_normal((9, 2))
        seen = observed(0.01 * from_centre + noise, np.full(9, 0.02), 0.05).only(np.arange(9) % 2 == 0)
        readings = [replace(seen, tilt_rad=seen.tilt_rad + np.radians([off_deg, 0.0])) for off_deg in (0.03, -0.03)]
        one, other = map(judged, readings)
        assert one.contradicts
        np.testing.assert_allclose(one.estimate.position_m, other.estimate.position_m, atol=1e-6)
