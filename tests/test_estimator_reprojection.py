"""Reprojection fit: eccentricity of LED images, and poses and covariances of fits."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from estimator_correspondences import device, simulated
from estimator_synthetic import Array, View, grid, view_of

from estimator.camera.pose import Pose
from estimator.errors import EstimationFailure
from estimator.io.camera import Distortion
from estimator.io.device import DeviceFrame
from estimator.solvers.observations import centroid_images, corrected_for_eccentricity, observe, pose_slopes
from estimator.solvers.reprojection import fit
from estimator.spots.identify import Correspondence

RADIUS_M = 0.03
LED_M = np.array([[3.0, 3.2, 3.4]])


def face(shape: str) -> Array:
    """Points that stand for equal areas of a face of radius or half side 1, (n, 2): midpoints of 300 x 300 cells."""
    side = (np.arange(300) + 0.5) / 150 - 1
    points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    return points if shape == "square" else points[(points**2).sum(axis=1) <= 1]


@pytest.mark.parametrize("shape", ["disc", "square"])
@pytest.mark.parametrize("tilts", [(0.0, 0.0), (35.0, 0.0), (20.0, -50.0), (60.0, 60.0)])
@pytest.mark.parametrize("aside", [(0.0, 0.0), (0.2, -0.15)])
def test_the_centroid_of_a_face_is_the_image_of_a_point_above_it(
    shape: str, tilts: tuple[float, float], aside: tuple[float, float]
) -> None:
    """By the pixels' own law: radiance times the solid angle dA h / d^3 an area of the face lights, times cos^4 over
    the cos^3 that the plane is turned away by. The next order is some 10 (r / h)^4 h of the world's 2 m, 5e-7 at a
    height of 2 m, that is 2e-7 on the plane; the effect itself is (r / h)^2 = 2e-4.
    """
    view = view_of((3.0 + aside[0], 3.2 + aside[1], 3.4), 2.0, *tilts)
    offsets = face(shape) * RADIUS_M
    points = LED_M + np.column_stack([offsets, np.zeros(len(offsets))]) - view.position_m
    seen = points @ view.R_cam_world.T
    distance = np.linalg.norm(seen, axis=1)
    cosine = seen[:, 2] / distance
    light = points[:, 2] / distance**3 * cosine**4 / cosine**3
    centroid = (light[:, None] * seen[:, :2] / seen[:, 2:]).sum(axis=0) / light.sum()
    lift = np.array([RADIUS_M**2 * (4 / 3 if shape == "square" else 1)])
    pose = Pose(np.array(view.position_m), view.R_cam_world)
    (found,), _ = centroid_images(pose, LED_M, lift)
    assert np.abs(found - centroid).max() < 2e-7


def test_the_centroid_of_a_luminaire_has_its_terms_of_fourth_order() -> None:
    """Of a 60 cm square in 3.2 m, by its light in 200 x 200 points (their error is 200^-2 of the eccentricity, 3e-7).

    The terms of sixth order are some (r / h)^6, 7e-7; those of fourth, which the tolerance has to see, are 1e-5.
    """
    pose = Pose(np.array([5.0, 2.5, 0.75]), np.eye(3))
    led_m = np.array([[6.25, 3.75, 3.95]])
    along = (np.arange(200) + 0.5) / 200 * 0.6 - 0.3
    x, y = np.meshgrid(along, along)
    points = led_m - pose.position_m + np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    light = (points**2).sum(axis=1) ** -2.0
    centroid = (light[:, None] * points).sum(axis=0)
    (found,), _ = centroid_images(pose, led_m, np.array([0.6**2 / 3]))
    assert np.abs(found - centroid[:2] / centroid[2]).max() < 1e-6
    above = led_m - pose.position_m + [0, 0, 0.6**2 / 3 * 3.2 / (3.2**2 + 2 * 1.25**2)]
    assert np.abs(above[0, :2] / above[0, 2] - centroid[:2] / centroid[2]).max() > 5e-6


def test_the_light_in_the_test_is_that_of_an_even_image() -> None:
    """dA h / d^3 is a solid angle: over a face that is half of the sky it adds up to 2 pi."""
    r = (np.arange(200_000) + 0.5) * 0.01
    assert (2 * np.pi * r * 0.01 / (r**2 + 1) ** 1.5).sum() == pytest.approx(2 * np.pi, rel=1e-3)


@pytest.mark.parametrize("gravity", [True, False])
def test_exact_points_are_fitted_exactly_from_a_rough_start(gravity: bool) -> None:
    leds = grid(5, 4, 0.14, (3, 2, 2.7))
    view = view_of((3, 2, 2.7), 2.6, 30, -20, 140)
    seen = observe(device(view, 0.1 if gravity else 180.0), simulated(view, leds))
    start = Pose(np.array(view.position_m) + [0.2, -0.1, 0.3], view_of((3, 2, 2.7), 2.6, 25, -14, 130).R_cam_world)
    found = fit(seen, start)
    # Double precision of 2.6 m, made some thousands of times more by the pattern.
    np.testing.assert_allclose(found.pose.position_m, view.position_m, atol=1e-9)
    np.testing.assert_allclose(found.pose.R_cam_world, view.R_cam_world, atol=1e-9)


def test_the_covariance_is_that_of_small_errors() -> None:
    """Linear propagation by hand: move each pixel by a thousandth of its sigma and see where the fit goes."""
    leds = grid(3, 2, 0.2, (3, 2, 2.7))
    view = view_of((3, 2, 2.7), 2.6, 30, -20, 140)
    frame = device(view, 0.2)
    start = Pose(np.array(view.position_m), view.R_cam_world)
    sigma_px, share = 0.05, 1e-3
    spots = simulated(view, leds, sigma_px)
    seen = observe(frame, spots)
    moved = []
    for k in range(len(leds)):
        for axis in range(2):
            plane = seen.image.copy()
            plane[k, axis] += share * sigma_px / 1500
            moved.append(fit(replace(seen, image=plane), start).pose.position_m)
    for axis in range(2):
        tilt = seen.tilt_rad.copy()
        tilt[axis] += share * np.radians(0.2)
        moved.append(fit(replace(seen, tilt_rad=tilt), start).pose.position_m)
    steps = (np.array(moved) - view.position_m) / share
    # Second order is a share of the first, the steps' size; digits are lost to 1e-9 m of 1e-3 sigma, 5e-6 m.
    np.testing.assert_allclose(fit(seen, start).covariance_m2, steps.T @ steps, rtol=5e-3, atol=1e-12)


def test_leds_all_in_one_place_fix_nothing() -> None:
    view = view_of((3, 2, 2.7), 2.6)
    leds = np.tile([[3.0, 2.0, 2.7]], (4, 1))
    seen = observe(device(view, 0.1), simulated(view, leds, 0.05))
    with pytest.raises(EstimationFailure, match="position: the observations do not determine a pose"):
        fit(seen, Pose(np.array(view.position_m), view.R_cam_world))


def fish_eye(rays: Array) -> Array:
    """FORMAT.md's equidistant projection, units of the image distance."""
    across = np.linalg.norm(rays[..., :2], axis=-1, keepdims=True)
    return np.asarray(np.arctan2(across, rays[..., 2:]) * rays[..., :2] / across)


def barrel(rays: Array) -> Array:
    """FORMAT.md's distortion with k1 alone, -0.12."""
    plane = rays[..., :2] / rays[..., 2:]
    return np.asarray(plane * (1 - 0.12 * (plane**2).sum(axis=-1, keepdims=True)))


BARREL = Distortion(k1=-0.12, k2=0.0, k3=0.0, p1=0.0, p2=0.0)


def bent_spots(
    view: View, leds: Array, lens: Callable[[Array], Array], changes: dict[str, object]
) -> tuple[DeviceFrame, list[Correspondence]]:
    """Discs of 2 cm through a lens: centroids on the sensor, by the light that a cosine of the axis times a solid angle
    gathers.
    """
    offsets = np.column_stack([face("disc")[::4], np.zeros(len(face("disc")[::4]))])
    offsets[:, :2] -= offsets[:, :2].mean(axis=0)
    points = leds[:, None] + 0.02 * offsets - view.position_m
    rays = points @ view.R_cam_world.T
    light = rays[..., 2] / (rays**2).sum(axis=2) ** 2
    pixels = (light[..., None] * lens(rays)).sum(axis=1) / light.sum(axis=1)[:, None] @ view.K[:2, :2].T + view.K[:2, 2]
    frame = device(view, 0.1)
    frame = replace(frame, camera=frame.camera.model_copy(update=changes))
    seen = [
        replace(
            one,
            led=one.led.model_copy(update={"radius_m": 0.02}),
            spot=replace(one.spot, u_px=float(u), v_px=float(v)),
        )
        for one, (u, v) in zip(simulated(view, leds, 0.01), pixels, strict=True)
    ]
    return frame, seen


@pytest.mark.parametrize(
    ("lens", "changes"),
    [
        pytest.param(fish_eye, {"projection": "equidistant"}, id="fish-eye"),
        pytest.param(barrel, {"distortion": BARREL}, id="barrel"),
    ],
)
def test_eccentricity_by_a_lens_is_corrected(lens: Callable[[Array], Array], changes: dict[str, object]) -> None:
    """Centroids on the sensor, summed up over discs of 2 cm, 2 m away, by the light that a cosine of the axis times a
    solid angle gathers. What is left goes with (r / h)^4 = 1e-8 of 2 m, which the pattern makes some hundred times
    more: 2 um. Left alone, (r / h)^2 = 1e-4 of a plane that is bent by a tenth makes some tens of micrometres.
    """
    leds = grid(3, 3, 0.6, (3, 3.2, 3.4))
    view = view_of((3, 3.2, 3.4), 2.0, 15, -10, 30, (4000, 3000, 1500.0))
    frame, seen = bent_spots(view, leds, lens, changes)
    observed = observe(frame, seen)
    start = Pose(np.array(view.position_m), view.R_cam_world)
    bent = fit(observed, start).pose
    assert np.linalg.norm(bent.position_m - view.position_m) > 1e-5
    straight = fit(corrected_for_eccentricity(observed, bent), start).pose
    assert np.linalg.norm(straight.position_m - view.position_m) < 2e-6


def test_the_cost_is_chi_square() -> None:
    """By hand: a spot 3 sigma to the right of its fit has a chi-square of 9, a tilt 2 sigma off one of 4. The
    other spots are a thousand times more exact, so that the pose does not give way.
    """
    leds = grid(5, 4, 0.14, (3, 2, 2.7))
    view = view_of((3, 2, 2.7), 2.6, 30, -20, 140)
    spots = simulated(view, leds, 1e-3)
    spots[7] = replace(spots[7], spot=replace(spots[7].spot, u_px=spots[7].spot.u_px + 3, covariance_px2=np.eye(2)))
    observed = observe(device(view, 1.0), spots)
    observed = replace(observed, tilt_rad=observed.tilt_rad + [2 * np.radians(1.0), 0.0])
    found = fit(observed, Pose(np.array(view.position_m), view.R_cam_world))
    # It gives way by this spot's share of the information, 1e-6.
    assert found.spots_chi2[7] == pytest.approx(9.0, rel=1e-3)
    assert found.tilt_chi2 == pytest.approx(4.0, rel=1e-3)
    assert found.cost == pytest.approx(found.chi2, rel=1e-9)
    assert found.chi2 == pytest.approx(13.0, rel=1e-3)


def test_an_error_of_the_model_adds_to_the_variance_of_a_displacement() -> None:
    """By hand: a spot of 1 px of standard deviation, 3 px off, and a model that errs by 4 px: 9 / (1 + 16)."""
    leds = grid(5, 4, 0.14, (3, 2, 2.7))
    view = view_of((3, 2, 2.7), 2.6, 30, -20, 140)
    spots = simulated(view, leds, 1e-3)
    spots[7] = replace(spots[7], spot=replace(spots[7].spot, u_px=spots[7].spot.u_px + 3, covariance_px2=np.eye(2)))
    observed = observe(device(view, 1.0), spots)
    found = fit(observed, Pose(np.array(view.position_m), view.R_cam_world))
    # The other spots are a thousand times more exact: their share of the variance is 1e-6, and the lens's scale changes
    # over the image by less than 1e-3 where the spot moved.
    assert found.outlier_chi2()[7] == pytest.approx(9.0, rel=1e-3)
    error = 4 * observed.camera.pixel_angle_rad
    assert found.outlier_chi2(error)[7] == pytest.approx(9 / 17, rel=1e-3)


def test_scores_and_redundancies_are_those_of_generalised_least_squares() -> None:
    """P = C^-1 - C^-1 J (J^T C^-1 J)^-1 J^T C^-1 and q = P r as dense matrices, of five spots with elliptic errors.

    At the minimum found J^T C^-1 r is not exactly zero: the sum is 1e-8 of itself from it, r some 1e-4 of its sigmas.
    """
    leds = grid(5, 1, 0.3, (3, 2, 2.7)) + np.array([[0, 0.3, 0], [0, 0, 0.1], [0, 0.2, 0], [0, -0.4, 0], [0, 0, 0]])
    view = view_of((3, 2, 2.7), 2.0, 20, -10, 40)
    rng = np.random.default_rng(8)
    spots = []
    for one in simulated(view, leds):
        root = rng.normal(0, 0.3, (2, 2))
        u, v = (one.spot.u_px, one.spot.v_px) + root @ rng.standard_normal(2)
        spots.append(replace(one, spot=replace(one.spot, u_px=u, v_px=v, covariance_px2=root @ root.T)))
    seen = observe(device(view, 1.0), spots).without_gravity()
    found = fit(seen, Pose(np.array(view.position_m), view.R_cam_world))
    precision = np.zeros((10, 10))
    for k, whitening in enumerate(seen.whitening):
        precision[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = whitening.T @ whitening
    J, r = pose_slopes(seen, found.pose)[0].reshape(10, 6), (seen.images(found.pose)[0] - seen.image).ravel()
    P = precision - precision @ J @ np.linalg.solve(J.T @ precision @ J, J.T @ precision)
    scale = np.sqrt(np.diag(precision)).reshape(5, 2)
    blocks = np.array([P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(5)])
    in_sigmas = 1 / (scale[:, :, None] * scale[:, None, :])
    np.testing.assert_allclose(found.spots_redundancy * in_sigmas, blocks * in_sigmas, atol=1e-9)
    np.testing.assert_allclose(found.spots_score / scale, (P @ r).reshape(5, 2) / scale, atol=1e-3)


def test_tilts_to_both_sides_of_180_deg_are_near() -> None:
    """A camera upside down: held at 179 deg, read as -179 deg, which is 2 deg off and not 358."""
    leds = grid(5, 4, 0.14, (3, 2, 0.0))
    view = View(400, 300, 1500.0, (3.0, 2.0, 2.6), 179.0, 0.0, 0.0)
    observed = observe(device(view, 1.0), simulated(view, leds, 1e-3))
    observed = replace(observed, tilt_rad=np.array([np.radians(-179.0), 0.0]))
    found = fit(observed, Pose(np.array(view.position_m), view.R_cam_world))
    assert found.tilt_chi2 == pytest.approx(4.0, rel=1e-3)
