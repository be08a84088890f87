"""Fits with errors of camera, map and gravity: stated, stated wrongly, and not stated at all."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from estimator_correspondences import device, simulated
from estimator_synthetic import Array, grid, view_of

from estimator.camera.pose import Pose
from estimator.io.camera import INTRINSICS, CameraUncertainty, Distortion
from estimator.io.device import Accelerometer, DeviceFrame
from estimator.io.led_map import DiscLed, Luminaire
from estimator.methods import gravity_fit, pnp, up2p
from estimator.methods.variant import Estimate
from estimator.solvers.data_snooping import snooped
from estimator.solvers.observations import observe
from estimator.solvers.ordinary_covariance import ordinary_covariance
from estimator.spots.identify import Correspondence

TARGET = (3.0, 2.0, 3.0)
LEDS_M = np.vstack([grid(3, 3, 0.12, (3.0 + x, 2.0, 3.0)) for x in (-0.2, 0.2)])
"""Two luminaires of 40 cm with nine LEDs each."""
LUMINAIRE = np.arange(18) // 9
VIEW = view_of(TARGET, 2.6, 25, -15, 40, (4000, 3000, 15000.0))
SIGMA_PX = 0.02
CAMERA = np.array([1e-3, 1e-4, 5.0, 5.0, 0.015, 3e-4, 3e-4])
CAMERA_SHOT = np.array([3e-4, 0.0, 3.0, 3.0, 0.0, 0.0, 0.0])
LUMINAIRE_M, LUMINAIRE_DEG, LED_M = 3e-3, 0.2, 3e-4
ACCELEROMETER_DEG = 0.3
Fit = Callable[[DeviceFrame, list[Correspondence]], Estimate]
FITS = {
    "gravity-fit": gravity_fit.fit_correspondences,
    "up2p": up2p.fit_correspondences,
    "pnp": pnp.fit_correspondences,
}


@dataclass(frozen=True)
class Told:
    """What the device is told in a draw: the true values moved by errors, with `stated` times their deviations."""

    frame: DeviceFrame
    spots: list[Correspondence]


def told(rng: np.random.Generator, stated: float | None = 1.0) -> Told:
    """A draw of all errors; `stated` None states none."""
    errors = rng.standard_normal(7) * CAMERA + rng.standard_normal(7) * CAMERA_SHOT
    focal, aspect, cx, cy, k1, p1, p2 = errors.tolist()
    fx, fy = 15000 * (1 + focal) * (1 + aspect / 2), 15000 * (1 + focal) * (1 - aspect / 2)
    uncertainty = None
    if stated is not None:
        uncertainty = CameraUncertainty(
            parameters=INTRINSICS,
            device_sigma=tuple((stated * CAMERA).tolist()),
            shot_sigma=tuple((stated * CAMERA_SHOT).tolist()),
            offset_sigma_m=0.0,
            rotation_sigma_deg=0.0,
        )
    frame = device(VIEW, ACCELEROMETER_DEG, rng, uncertainty)
    camera = frame.camera.model_copy(
        update={
            "K": ((fx, 0.0, 2000 + cx), (0.0, fy, 1500 + cy), (0.0, 0.0, 1.0)),
            "distortion": Distortion(k1=k1, k2=0.0, k3=0.0, p1=p1, p2=p2),
        }
    )
    moved = LEDS_M + rng.standard_normal(LEDS_M.shape) * LED_M
    for key in (0, 1):
        of = key == LUMINAIRE
        centre = LEDS_M[of].mean(axis=0)
        turn = np.radians(LUMINAIRE_DEG) * rng.standard_normal(3)
        moved[of] += rng.standard_normal(3) * LUMINAIRE_M + np.cross(turn, LEDS_M[of] - centre)
    luminaires, spots = {}, []
    for k, (one, (x, y, z)) in enumerate(zip(simulated(VIEW, LEDS_M, SIGMA_PX, rng), moved.tolist(), strict=True)):
        known = {"luminaire": int(LUMINAIRE[k]), "sigma_m": (LED_M * stated,) * 3} if stated is not None else {}
        led = DiscLed.model_validate({"id": k, "position_m": (x, y, z), "radius_m": 1e-6, **known})
        spots.append(replace(one, led=led))
    if stated is not None:
        for key in (0, 1):
            x, y, z = moved[key == LUMINAIRE].mean(axis=0).tolist()
            luminaires[key] = Luminaire(
                id=key,
                position_m=(x, y, z),
                sigma_m=(LUMINAIRE_M * stated,) * 3,
                sigma_rotation_deg=(LUMINAIRE_DEG * stated,) * 3,
            )
    accelerometer = Accelerometer(kind="tilt-error", error_deg=ACCELEROMETER_DEG * (1.0 if stated is None else stated))
    return Told(replace(frame, camera=camera, luminaires=luminaires, accelerometer=accelerometer), spots)


def errors_and_nees(fit: Fit, draws: list[Told]) -> tuple[Array, Array, Array]:
    """Errors (n, 3), their squares in units of the covariance (n,), and the covariances' traces (n,)."""
    estimates = [fit(one.frame, one.spots) for one in draws]
    errors = np.array([estimate.position_m - VIEW.position_m for estimate in estimates])
    covariances = np.array([estimate.covariance_m2 for estimate in estimates])
    nees = np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])
    return errors, nees, np.trace(covariances, axis1=1, axis2=2)


def draws(count: int, stated: float | None = 1.0) -> list[Told]:
    """Draws of the same errors whatever is stated."""
    return [told(np.random.default_rng([11, k]), stated) for k in range(count)]


@pytest.mark.slow
@pytest.mark.parametrize("name", FITS)
def test_the_covariance_counts_the_stated_errors(name: str) -> None:
    """The sum of n squared errors in units of the covariance is chi^2 of 3 n degrees, 3 n +- sqrt(6 n)."""
    n = 100
    _, nees, _ = errors_and_nees(FITS[name], draws(n))
    assert abs(nees.sum() - 3 * n) < 5 * np.sqrt(6 * n)


@pytest.mark.slow
def test_the_fit_is_as_good_as_its_covariance_and_equal_weights_are_not() -> None:
    """The mean squared error is the mean trace of the covariance, which has the smallest trace that weights can give:
    that of a sum of squares over n draws of 3 numbers differs by at most sqrt(2 / n) of itself, were it one number.
    """
    n = 100
    errors, _, traces = errors_and_nees(FITS["gravity-fit"], draws(n))
    assert abs((errors**2).sum(axis=1).mean() / traces.mean() - 1) < 4 * np.sqrt(2 / n)
    equal, _, _ = errors_and_nees(FITS["pnp"], draws(n))
    assert (equal**2).sum() > 1.5 * (errors**2).sum()


@pytest.mark.slow
@pytest.mark.parametrize("stated", [1 / 3, 3.0])
@pytest.mark.parametrize("name", ["gravity-fit", "up2p"])
def test_sigmas_three_times_off_cost_no_frame_and_little(name: str, stated: float) -> None:
    """The same draws: the position's error grows by 15 % at most, as the issue asks for."""
    n = 30
    errors, _, _ = errors_and_nees(FITS[name], draws(n))
    off, _, _ = errors_and_nees(FITS[name], draws(n, stated))
    assert np.sqrt((off**2).sum()) < 1.15 * np.sqrt((errors**2).sum())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gravity-fit", "up2p"])
def test_wrong_identities_are_left_out(name: str) -> None:
    """Two LEDs exchanged, which is worth decimetres: the estimate is that by the other spots."""
    for k in range(8):
        one = told(np.random.default_rng([12, k]))
        spots = list(one.spots)
        spots[3], spots[14] = (
            replace(spots[3], led=one.spots[14].led),
            replace(spots[14], led=one.spots[3].led),
        )
        without = [spot for index, spot in enumerate(one.spots) if index not in (3, 14)]
        expected, found = FITS[name](one.frame, without), FITS[name](one.frame, spots)
        np.testing.assert_allclose(found.position_m, expected.position_m, atol=1e-6)
        np.testing.assert_allclose(found.covariance_m2, expected.covariance_m2, rtol=1e-3)  # type: ignore[arg-type]


def test_right_spots_that_were_left_out_with_wrong_ones_return() -> None:
    """Two LEDs of two luminaires exchanged; data snooping begins without them and a right spot of each luminaire. The
    errors of the map move spots by 17 px, those of an LED in its luminaire by 2 px; LEDs are 700 px apart.
    """
    for k in range(4):
        one = told(np.random.default_rng([12, k]))
        spots = list(one.spots)
        spots[3], spots[14] = replace(spots[3], led=one.spots[14].led), replace(spots[14], led=one.spots[3].led)
        start, wrong = Pose(np.array(VIEW.position_m), VIEW.R_cam_world), np.isin(np.arange(18), [3, 14])
        begun = ~wrong & ~np.isin(np.arange(18), [0, 10])
        found = snooped(observe(one.frame, spots), start, begun, adapted=False)
        assert found is not None
        np.testing.assert_array_equal(found[2], ~wrong)


@pytest.mark.slow
@pytest.mark.parametrize("name", FITS)
def test_errors_that_are_not_stated_are_revealed_by_the_residuals(name: str) -> None:
    """Nothing stated, and the map and camera off by millimetres and 0.1 %: an answer, and NEES below 20, as the issue
    asks for. With the centroids' covariance alone it would be (3 mm / 10 um)^2, 1e5.
    """
    _, nees, traces = errors_and_nees(FITS[name], draws(10, None))
    assert nees.mean() < 20
    assert np.sqrt(traces.mean()) < 0.5


def seen_with_focal(error: float, tilt_x_deg: float, rng: np.random.Generator, stated: bool) -> tuple[Array, Estimate]:
    """The true position, and the estimate of a camera whose focal length is off."""
    view = view_of(TARGET, 2.6, tilt_x_deg, 0, 40, (4000, 3000, 15000.0))
    frame = device(view, 0.5, rng, device(view, 0.5).camera.uncertainty if stated else None)
    K = ((15000 * (1 + error), 0.0, 2000.0), (0.0, 15000 * (1 + error), 1500.0), (0.0, 0.0, 1.0))
    frame = replace(frame, camera=frame.camera.model_copy(update={"K": K}))
    return np.array(view.position_m), gravity_fit.fit_correspondences(frame, simulated(view, LEDS_M, 0.005, rng))


@pytest.mark.slow
@pytest.mark.parametrize("tilt_x_deg", [2.0, 40.0])
@pytest.mark.parametrize("focal", [1e-3, 1e-2])
def test_a_focal_length_that_is_not_stated_may_be_wrong(focal: float, tilt_x_deg: float) -> None:
    """A level view does not reveal it (focal length and range are one number there), a tilted one does."""
    rng = np.random.default_rng(4)
    nees = []
    for _ in range(8):
        true_m, estimate = seen_with_focal(focal, tilt_x_deg, rng, stated=False)
        error = estimate.position_m - true_m
        assert estimate.covariance_m2 is not None
        nees.append(error @ np.linalg.solve(estimate.covariance_m2, error))
    assert np.mean(nees) < 20


def test_three_leds_seen_level_do_not_vouch_for_a_camera() -> None:
    """A principal point 40 px off, as of a camera as sold: with six coordinates and gravity the residuals say nothing.

    Of a tilt of 0.15 deg that gravity allows, 2.6 m away, 7 mm of position; the spots' own covariance is micrometres.
    """
    rng, nees = np.random.default_rng(7), []
    for _ in range(8):
        view = view_of(TARGET, 2.6, 2.0, 0, 40, (4000, 3000, 15000.0))
        frame = device(view, 0.5, rng, None)
        K = ((15000.0, 0.0, 2000.0 + 40 * rng.standard_normal()), (0.0, 15000.0, 1500.0 + 40 * rng.standard_normal()))
        frame = replace(frame, camera=frame.camera.model_copy(update={"K": (*K, (0.0, 0.0, 1.0))}))
        estimate = gravity_fit.fit_correspondences(frame, simulated(view, LEDS_M, 0.005, rng)[:6:2])
        error = estimate.position_m - view.position_m
        nees.append(error @ np.linalg.solve(estimate.covariance_m2, error))  # type: ignore[arg-type]
    assert np.mean(nees) < 20


@pytest.mark.parametrize("stated", [True, False])
def test_an_exact_camera_keeps_its_accuracy_where_the_view_checks_it(stated: bool) -> None:
    """Tilted by 40 deg: the residuals would reveal 0.05 %, so that whether it is stated to be exact is all the same."""
    rng = np.random.default_rng(5)
    for _ in range(8):
        true_m, estimate = seen_with_focal(0.0, 40.0, rng, stated)
        assert estimate.covariance_m2 is not None
        assert np.sqrt(np.trace(estimate.covariance_m2)) < 1e-4
        error = estimate.position_m - true_m
        # 1e-6 of chi^2 with three degrees of freedom.
        assert error @ np.linalg.solve(estimate.covariance_m2, error) < 30.7


@pytest.mark.slow
def test_a_centroid_sigma_takes_the_place_of_unstated_errors() -> None:
    """Centroids with errors of 1 px that state 0.02 px, an exact camera: with an option of 1 px, chi^2 of 3 n degrees.

    50 draws, five standard deviations of their sum.
    """
    n, rng, nees = 50, np.random.default_rng(6), 0.0
    for _ in range(n):
        frame = device(VIEW, 0.5, rng)
        spots = [
            replace(one, spot=replace(one.spot, covariance_px2=0.02**2 * np.eye(2)))
            for one in simulated(VIEW, LEDS_M, 1.0, rng)
        ]
        estimate = gravity_fit.fit_correspondences(frame, spots, 1.0)
        error = estimate.position_m - VIEW.position_m
        nees += error @ np.linalg.solve(estimate.covariance_m2, error)  # type: ignore[arg-type]
    assert abs(nees - 3 * n) < 5 * np.sqrt(6 * n)


def test_the_covariance_of_equal_weights_is_that_of_small_errors() -> None:
    """Linear propagation by hand: centroids with sigmas of 0.1 and 0.4 px, each moved by a hundredth of its own."""
    view = view_of(TARGET, 2.6, 25, -15, 40, (4000, 3000, 3000.0))
    sigmas = np.where(np.arange(18) % 3 == 0, 0.4, 0.1)
    spots = [
        replace(one, spot=replace(one.spot, covariance_px2=sigma**2 * np.eye(2)))
        for one, sigma in zip(simulated(view, LEDS_M), sigmas, strict=True)
    ]
    frame, share = device(view, 0.5), 1e-2
    pixels = np.array([(one.spot.u_px, one.spot.v_px) for one in spots])
    methods = (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_IPPE)
    moved = []
    for k in range(len(spots)):
        for axis in range(2):
            both = []
            for sign in (-1, 1):
                off = pixels.copy()
                off[k, axis] += sign * share * sigmas[k]
                both.append(pnp.position_from_pixels(LEDS_M, off, view.K, methods))
            moved.append((both[1] - both[0]) / (2 * share))
    steps = np.array(moved)
    found = ordinary_covariance(observe(frame, spots), Pose(np.array(view.position_m), view.R_cam_world))
    # OpenCV's refinement ends at some 1e-7 m of steps of 1e-5 m.
    np.testing.assert_allclose(found, steps.T @ steps, rtol=2e-2, atol=1e-3 * np.trace(found))
