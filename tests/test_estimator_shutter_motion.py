"""Rolling shutter: spots that a moving camera sees line after line, projected apart, and what fits make of them."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from estimator_correspondences import POINT_M, device
from estimator_synthetic import Array, View, grid, view_of
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from estimator.camera.motion import seen_in_motion, turned_back
from estimator.camera.pose import Pose
from estimator.io.device import DeviceFrame
from estimator.io.led_map import DiscLed
from estimator.io.shutter import Gyroscope, Shutter
from estimator.methods import gravity_fit, pnp, self_calibrated, up2p
from estimator.methods.variant import Estimate
from estimator.solvers import second_order
from estimator.solvers.observations import Observations, moving_slopes, observe
from estimator.solvers.reprojection import fit
from estimator.solvers.shutter_motion import HAND_RATE_SIGMA_DEG_S, ShutterMotion, motion_prior
from estimator.spots.detect import Spot
from estimator.spots.identify import Correspondence

TARGET = (3.5, 3.6, 3.45)
SENSOR: tuple[int, int, float] = (4000, 3000, 15000.0)
LEDS = grid(6, 5, 0.1, TARGET)
ROW_TIME_US = 10.0
SIGMA_PX = 0.02
TILT_DEG = 0.5
GYRO_RAD_S = np.radians(0.3)
SPEED_M_S = 0.05


def line_of(direction: str, pixels: Array, view: View) -> Array:
    """Lines in readout order, from the middle one, by the words of FORMAT.md."""
    u, v = pixels.T
    lines: dict[str, Array] = {
        "down": v - view.height_px / 2,
        "up": view.height_px / 2 - v,
        "right": u - view.width_px / 2,
        "left": view.width_px / 2 - u,
    }
    return lines[direction]


def moving_pixels(view: View, leds_m: Array, velocity: Array, direction: str = "down") -> Array:
    """Pixels (n, 2) of points that a camera of a pose at mid-readout sees when their line is exposed."""
    pixels = view.project(leds_m)
    # A line's time moves a point by 5 % of a line at most: 0.05^10 of the 80 px of the first step is nothing.
    for _ in range(10):
        for k, time_s in enumerate((line_of(direction, pixels, view) * ROW_TIME_US * 1e-6).tolist()):
            R = Rotation.from_rotvec(velocity[:3] * time_s).as_matrix().T @ view.R_cam_world
            seen = view.K @ R @ (leds_m[k] - view.position_m - velocity[3:] * time_s)
            pixels[k] = seen[:2] / seen[2]
    return pixels


def spots(leds_m: Array, pixels: Array, sigma_px: float = SIGMA_PX) -> list[Correspondence]:
    return [
        Correspondence(
            DiscLed(id=k, position_m=(x, y, z), radius_m=POINT_M),
            Spot(u, v, sigma_px**2 * np.eye(2), u, v, 50, 1000.0, touches_border=False, saturated=False),
        )
        for k, ((x, y, z), (u, v)) in enumerate(zip(leds_m.tolist(), pixels.tolist(), strict=True))
    ]


def with_shutter(frame: DeviceFrame, direction: str = "down") -> DeviceFrame:
    shutter = Shutter.model_validate({"kind": "rolling", "row_time_us": ROW_TIME_US, "direction": direction})
    return replace(frame, camera=frame.camera.model_copy(update={"shutter": shutter}))


def with_gyroscope(frame: DeviceFrame, reading_rad_s: Array, sigma_rad_s: float = GYRO_RAD_S) -> DeviceFrame:
    x, y, z = reading_rad_s.tolist()
    gyroscope = Gyroscope(noise_rad_s=sigma_rad_s * 0.6, bias_rad_s=sigma_rad_s * 0.8)
    return replace(frame, gyro_rad_s=(x, y, z), gyroscope=gyroscope)


def drawn_velocity(rng: np.random.Generator, rate_deg_s: float) -> Array:
    axis = rng.normal(size=3)
    return np.concatenate([np.radians(rate_deg_s) * axis / np.linalg.norm(axis), SPEED_M_S * rng.normal(size=3)])


def drawn_view(rng: np.random.Generator) -> View:
    tilt_x, tilt_y = rng.uniform(-25, 25, 2)
    return view_of(TARGET, rng.uniform(2.2, 3.1), tilt_x, tilt_y, rng.uniform(0, 360), SENSOR)


Fitter = Callable[[DeviceFrame, Sequence[Correspondence]], Estimate]


def errors(
    fitter: Fitter, rate_deg_s: float, leds: int, draws: int, gyro: bool = False, rolls: bool = True, seed: int = 1
) -> tuple[Array, Array]:
    """Distances (draws,) from the truth, metres, and normalised squared errors (draws,)."""
    rng = np.random.default_rng([seed, leds, int(rate_deg_s)])
    distances, nees = [], []
    for _ in range(draws):
        view, velocity = drawn_view(rng), drawn_velocity(rng, rate_deg_s)
        pixels = moving_pixels(view, LEDS, velocity)
        seen = np.flatnonzero(((pixels > 20) & (pixels < [SENSOR[0] - 20, SENSOR[1] - 20])).all(axis=1))
        seen = rng.permutation(seen)[:leds]
        frame = device(view, TILT_DEG, rng)
        frame = with_shutter(frame) if rolls else frame
        if gyro:
            frame = with_gyroscope(frame, velocity[:3] + GYRO_RAD_S * rng.normal(size=3))
        noisy = pixels[seen] + SIGMA_PX * rng.normal(size=(len(seen), 2))
        found = fitter(frame, spots(LEDS[seen], noisy))
        error = found.position_m - view.position_m
        assert found.covariance_m2 is not None
        distances.append(float(np.linalg.norm(error)))
        nees.append(float(error @ np.linalg.solve(found.covariance_m2, error)))
    return np.array(distances), np.array(nees)


def interval(freedom: int) -> tuple[float, float]:
    """The 99.9 % interval of chi2."""
    return float(chi2.isf(0.9995, freedom)), float(chi2.isf(0.0005, freedom))


def test_derivatives_of_moving_points_are_those_by_differences() -> None:
    """Central differences of steps h: (h^2 / 6) times third derivatives of some units a metre, and rounding; the term
    that the derivatives by the angular velocity leave out is (20 deg/s 15 ms)^2 / 6 = 5e-6 of 3 m 15 ms.
    """
    rng = np.random.default_rng(3)
    points, times = rng.uniform(-0.5, 0.5, (8, 3)) + [3, 3.5, 3.4], rng.uniform(-0.015, 0.015, 8)
    pose = Pose(np.array([3.1, 3.3, 0.7]), view_of(TARGET, 2.6, 20, -15, 130).R_cam_world)
    velocity = drawn_velocity(rng, 20.0)
    seen = seen_in_motion(points, pose, velocity, times)
    for k in range(6):
        step = 1e-3 * np.eye(6)[k]
        after, before = (seen_in_motion(points, pose, velocity + sign * step, times).p_cam for sign in (1, -1))
        np.testing.assert_allclose((after - before) / 2e-3, seen.by_motion[:, :, k], atol=5e-7)
    after, before = (seen_in_motion(points, pose, velocity, times + h).p_cam for h in (1e-4, -1e-4))
    np.testing.assert_allclose((after - before) / 2e-4, seen.rate, atol=1e-6)


def test_slopes_of_the_fit_are_those_by_differences() -> None:
    rng = np.random.default_rng(4)
    view, velocity = view_of(TARGET, 2.6, 20, -15, 130, SENSOR), drawn_velocity(rng, 20.0)
    seen = observe(with_shutter(device(view, TILT_DEG)), spots(LEDS, moving_pixels(view, LEDS, velocity)))
    centre = LEDS.mean(axis=0)
    R = view.R_cam_world
    x = np.concatenate([Rotation.from_matrix(R).as_rotvec(), R @ (centre - view.position_m), velocity])

    def image(x: Array) -> Array:
        R = Rotation.from_rotvec(x[:3]).as_matrix()
        return seen.images(Pose(centre - R.T @ x[3:6], R), x[6:])[0]

    pose = Pose(np.array(view.position_m), view.R_cam_world)
    slopes = moving_slopes(seen, pose, velocity, x)
    for k in range(12):
        step = 1e-5 * np.eye(12)[k]
        by_difference = (image(x + step) - image(x - step)) / 2e-5
        # The lift of a point of 1 um, the term of third order in the turn, and rounding of 1e-16 / 1e-5.
        np.testing.assert_allclose(slopes[:, :, k], by_difference, atol=2e-7)


@pytest.mark.parametrize("direction", ["down", "up", "right", "left"])
def test_a_known_motion_is_undone_in_every_direction_of_readout(direction: str) -> None:
    """The gyroscope is exact, the speed is 0: points without noise are fitted to the spots' own 1e-4 px, 1e-7 m, times
    the pattern's some hundred; the residual prior of the speed, 5 cm/s, pulls nothing because it is true.
    """
    rng = np.random.default_rng(5)
    view, velocity = view_of(TARGET, 2.6, 10, -15, 130, SENSOR), drawn_velocity(rng, 20.0)
    velocity[3:] = 0
    frame = with_gyroscope(with_shutter(device(view, 1e-3), direction), velocity[:3], 0.0)
    points = spots(LEDS, moving_pixels(view, LEDS, velocity, direction), 0.0)
    found = gravity_fit.fit_correspondences(frame, points)
    assert np.linalg.norm(found.position_m - view.position_m) < 1e-5
    wrong = gravity_fit.fit_correspondences(with_gyroscope(frame, -velocity[:3], 0.0), points)
    assert np.linalg.norm(wrong.position_m - view.position_m) > 0.01


@pytest.mark.slow
def test_a_rate_that_is_estimated_costs_millimetres_where_an_ignored_one_costs_centimetres() -> None:
    """5 deg/s, 18 mm lens, rows of 10 us (issue 12): a median of at most 10 mm."""
    estimated, nees = errors(gravity_fit.fit_correspondences, 5.0, 30, 60)
    ignored, _ = errors(gravity_fit.fit_correspondences, 5.0, 30, 20, rolls=False)
    assert np.median(estimated) < 0.010
    assert np.median(ignored) > 0.030
    low, high = interval(3 * 60)
    assert low < nees.sum() < high


@pytest.mark.slow
@pytest.mark.parametrize("fitter", [gravity_fit.fit_correspondences, up2p.fit_correspondences])
@pytest.mark.parametrize("gyro", [True, False])
def test_errors_agree_with_the_covariance(fitter: Fitter, gyro: bool) -> None:
    """chi2 of three degrees a draw, within its 99.9 % interval; up to 20 deg/s a hand's prior is a wide one, and the
    rates of this test, a length of 20 deg/s, are 1 / 3 of its squares: the sum may be smaller.
    """
    if fitter is up2p.fit_correspondences:
        pytest.importorskip("poselib")
    draws = 40
    _, nees = errors(fitter, 20.0, 10, draws, gyro)
    low, high = interval(3 * draws)
    assert nees.sum() < high
    if gyro:
        assert low < nees.sum()


@pytest.mark.parametrize("gyro", [True, False])
@pytest.mark.parametrize("leds", [2, 3])
def test_the_prior_holds_what_few_leds_do_not_determine(leds: int, gyro: bool) -> None:
    """Two and three spots are fewer numbers than pose and motion have; the covariance is finite and honest, and the
    mean over 20 draws of a chi2 of three degrees is below 3 + 3.3 sqrt(6 / 20) = 4.8 in 99.9 % of trials.
    """

    def fitted(frame: DeviceFrame, seen: Sequence[Correspondence]) -> Estimate:
        observations = observe(frame, seen)
        start = up2p.upright_pose(observations)
        assert start is not None
        found = fit(observations, start)
        return Estimate(found.pose.position_m, covariance_m2=found.covariance_m2)

    distances, nees = errors(fitted, 5.0, leds, 20, gyro, seed=2)
    assert np.isfinite(distances).all()
    assert nees.mean() < 4.8


@pytest.mark.slow
@pytest.mark.parametrize("gyro", [True, False])
def test_pnp_counts_the_motion_that_it_does_not_fit(gyro: bool) -> None:
    """The wide prior of a hand is an upper limit for 20 deg/s in all; with a gyroscope, 99.9 % of chi2."""
    draws = 40
    distances, nees = errors(pnp.fit_correspondences, 20.0, 30, draws, gyro)
    low, high = interval(3 * draws)
    assert nees.sum() < high
    if gyro:
        assert low < nees.sum()
        blind, _ = errors(pnp.fit_correspondences, 20.0, 30, draws, gyro=False)
        assert np.median(distances) < np.median(blind) / 3


@pytest.mark.parametrize("wrong", [1, 10])
def test_wrong_identities_are_left_out_in_motion(wrong: int) -> None:
    """Displaced by as much as the motion displaces spots. A true one that a wrong one pulls along may go with it."""
    rng = np.random.default_rng(7)
    view, velocity = view_of(TARGET, 2.6, 10, -15, 130, SENSOR), drawn_velocity(rng, 20.0)
    pixels = moving_pixels(view, LEDS, velocity) + SIGMA_PX * rng.normal(size=(len(LEDS), 2))
    displaced = rng.permutation(len(LEDS))[:wrong]
    pixels[displaced] += rng.choice([-1.0, 1.0], (wrong, 2)) * rng.uniform(20, 60, (wrong, 2))
    observations = observe(with_shutter(device(view, TILT_DEG, rng)), spots(LEDS, pixels))
    agreed = gravity_fit.agreement(observations)
    excluded = set(np.flatnonzero(~agreed.inliers).tolist())
    assert excluded >= set(displaced.tolist())
    assert len(excluded) <= wrong + 1
    assert agreed.best.velocity.shape == (6,)
    error = agreed.best.pose.position_m - view.position_m
    assert error @ np.linalg.solve(agreed.covariance_m2, error) < chi2.isf(1e-4, 3)


def test_a_global_shutter_has_no_motion() -> None:
    """A reading of the gyroscope says nothing of an exposure that all lines share: the same estimate to the bit."""
    rng = np.random.default_rng(8)
    view = drawn_view(rng)
    frame = device(view, TILT_DEG, rng)
    points = spots(LEDS, view.project(LEDS) + SIGMA_PX * rng.normal(size=(len(LEDS), 2)))
    turning = with_gyroscope(frame, np.array([0.3, -0.2, 0.1]))
    assert motion_prior(turning) is None
    for fitter in (gravity_fit.fit_correspondences, pnp.fit_correspondences):
        one, other = fitter(frame, points), fitter(turning, points)
        np.testing.assert_array_equal(one.position_m, other.position_m)
        np.testing.assert_array_equal(np.asarray(one.covariance_m2), np.asarray(other.covariance_m2))
    assert observe(turning, points).motion is None


def test_the_prior_is_the_gyroscopes_or_a_hands() -> None:
    frame = with_shutter(device(view_of(TARGET, 2.6), TILT_DEG))
    alone, read = motion_prior(frame), motion_prior(with_gyroscope(frame, np.array([0.3, -0.2, 0.1])))
    assert alone is not None
    assert read is not None
    np.testing.assert_array_equal(alone.velocity, np.zeros(6))
    np.testing.assert_allclose(alone.sigmas[:3], np.radians(HAND_RATE_SIGMA_DEG_S))
    np.testing.assert_allclose(read.velocity, [0.3, -0.2, 0.1, 0, 0, 0])
    # Noise and bias are independent: 0.6^2 + 0.8^2 = 1.
    np.testing.assert_allclose(read.sigmas[:3], GYRO_RAD_S)


def test_turning_back_undoes_a_turn() -> None:
    rng = np.random.default_rng(9)
    view, velocity = view_of(TARGET, 2.6, 10, -15, 130, SENSOR), drawn_velocity(rng, 20.0)
    velocity[3:] = 0
    pixels = moving_pixels(view, LEDS, velocity)
    focal, middle = SENSOR[2], np.array(SENSOR[:2]) / 2
    times_s = line_of("down", pixels, view) * ROW_TIME_US * 1e-6
    still = turned_back((pixels - middle) / focal, velocity, times_s)
    np.testing.assert_allclose(still, (view.project(LEDS) - middle) / focal, atol=1e-12)


def test_a_frame_of_a_rolling_shutter_keeps_its_own_estimate() -> None:
    """The common fit of a device's frames knows no motion."""
    rng = np.random.default_rng(10)
    view, velocity = drawn_view(rng), drawn_velocity(rng, 5.0)
    frame = with_shutter(device(view, TILT_DEG, rng))
    points = spots(LEDS, moving_pixels(view, LEDS, velocity))
    fitted = self_calibrated.fit_correspondences(frame, points)
    assert fitted.view is None
    np.testing.assert_array_equal(fitted.estimate.position_m, gravity_fit.fit_correspondences(frame, points).position_m)


def test_the_second_order_of_the_position_is_that_of_draws() -> None:
    """The distance from the LEDs is known to 0.1 mm, the direction to 0.03 rad: along the line of sight, 2.5 m long,
    the position scatters by 2.5 m times 0.03^2 / 2 a turn axis, and by derivatives alone by 0.1 mm.

    The mean square of 200 000 draws errs by some 2 / sqrt(200 000) = 0.5 %, four times that at 5 sigma with the fourth
    power's heavy tail; terms of the next order are 0.03^2 of it.
    """
    x = np.array([0.3, -2.0, 1.1, 0.2, -0.3, 2.5])
    R0, by_vector = (np.asarray(one) for one in cv2.Rodrigues(x[:3]))
    to_turn = np.array([[t[2, 1], t[0, 2], t[1, 0]] for t in (s @ R0.T for s in by_vector.reshape(3, 3, 3))]).T
    turns = 0.03 * np.random.default_rng(11).normal(size=(200_000, 3))
    shifts = 1e-4 * np.random.default_rng(12).normal(size=(200_000, 3))
    R = Rotation.from_rotvec(turns).as_matrix() @ R0
    moved = np.einsum("nji,nj->ni", R, x[3:] + shifts) - R0.T @ x[3:]
    sight = R0.T @ x[3:] / np.linalg.norm(x[3:])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = 0.03**2 * np.linalg.inv(to_turn) @ np.linalg.inv(to_turn).T
    covariance[3:, 3:] = 1e-8 * np.eye(3)
    found = sight @ second_order.of_pose_vector(x, covariance) @ sight + 1e-8
    assert ((moved @ sight) ** 2).mean() == pytest.approx(found, rel=0.02)


def test_observations_choose_times_with_their_spots() -> None:
    view = view_of(TARGET, 2.6, 10, -15, 130, SENSOR)
    seen: Observations = observe(with_shutter(device(view, TILT_DEG)), spots(LEDS, view.project(LEDS)))
    chosen = np.arange(len(LEDS)) % 3 == 0
    assert isinstance(seen.motion, ShutterMotion)
    few = seen.only(chosen).motion
    assert few is not None
    np.testing.assert_array_equal(few.times_s, seen.motion.times_s[chosen])
    v = view.project(LEDS)[:, 1]
    np.testing.assert_allclose(seen.motion.times_s, (v - SENSOR[1] / 2) * ROW_TIME_US * 1e-6, atol=1e-15)
