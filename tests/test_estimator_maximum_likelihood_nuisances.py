"""Maximum likelihood with what devices do not know: gradients, halos, wrong maps, sizes and focal lengths."""

from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from estimator_synthetic import View, grid, poisson, render, view_of
from scipy.stats import chi2
from test_estimator_maximum_likelihood import (
    SAMPLES,
    TARGET,
    TWELVE,
    WIDE_VIEW,
    Floats,
    frame_of,
    misread,
    with_exact_camera,
)

from estimator.camera.pose import Pose
from estimator.io.device import DeviceFrame
from estimator.io.led_map import Luminaire
from estimator.methods import maximum_likelihood
from estimator.methods.gravity_fit import gravity_fit
from estimator.methods.maximum_likelihood import Maximum, maximize, ml
from estimator.pixels import initial
from estimator.pixels.initial import Start, gravity_of, start_at_spots
from estimator.pixels.nuisances import NO_COMPONENTS, SIZE, Gravity, Priors
from estimator.spots.correspondences import find_correspondences

DRAWS = 20
"""Draws of a mismatch: the mean of their normalised squared errors has a standard deviation of sqrt(6 / 20) = 0.55."""
UNIFORM = render(WIDE_VIEW, TWELVE, 0.01, 4000.0, samples=SAMPLES)


def face_coordinates(led_m: Floats) -> tuple[Floats, Floats]:
    """Coordinates of all pixels on the plane of an LED in radii from its centre, along x and y of the world."""
    rows, columns = np.indices(UNIFORM.shape) + 0.5
    rays = np.stack(
        [(columns - WIDE_VIEW.K[0, 2]) / 1500, (rows - WIDE_VIEW.K[1, 2]) / 1500, np.ones(UNIFORM.shape)], -1
    )
    rays = rays @ WIDE_VIEW.R_cam_world
    at = np.array(WIDE_VIEW.position_m) + rays * ((led_m[2] - WIDE_VIEW.position_m[2]) / rays[..., 2])[..., None]
    return (at[..., 0] - led_m[0]) / 0.01, (at[..., 1] - led_m[1]) / 0.01


def with_gradients(generator: np.random.Generator) -> Floats:
    """Expected image with a gradient of 4 %, one standard deviation, along x and y of each face."""
    image = UNIFORM.copy()
    for led_m in TWELVE:
        a, b = face_coordinates(led_m)
        gx, gy = 0.04 * generator.standard_normal(2)
        face = np.hypot(a, b) < 1.5
        image[face] += (UNIFORM - 40)[face] * (gx * a + gy * b)[face]
    return image


def with_halo(share: float) -> Floats:
    """Expected image with a share of all light in a halo of 30 px, a Gaussian."""
    light = UNIFORM - 40
    return 40 + (1 - share) * light + share * np.asarray(cv2.GaussianBlur(light, (0, 0), 30))


def errors_of(frames: Iterable[DeviceFrame], view: View) -> tuple[Floats, Floats]:
    """Errors, metres, and normalised squared errors; an estimation failure fails the test."""
    errors, nees = [], []
    for frame in frames:
        estimate = ml(frame)
        assert estimate.covariance_m2 is not None
        error = estimate.position_m - view.position_m
        errors.append(float(np.linalg.norm(error)))
        nees.append(float(error @ np.linalg.solve(estimate.covariance_m2, error)))
    return np.array(errors), np.array(nees)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["gradient", "halo"])
def test_glare_and_gradients_leave_the_covariance_honest(kind: str) -> None:
    """Neither is stated. The sum of normalised squared errors is below the 99.9 % quantile of chi-square; it may be
    smaller than chi-square allows, since a covariance that is widened is an estimate from 12 LEDs.
    """
    generator = np.random.default_rng(3)
    images = [with_gradients(generator) if kind == "gradient" else with_halo(0.05) for _ in range(DRAWS)]
    frames = (
        misread(WIDE_VIEW, frame_of(WIDE_VIEW, TWELVE, poisson(image, seed)), generator)
        for seed, image in enumerate(images)
    )
    errors, nees = errors_of(frames, WIDE_VIEW)
    assert nees.sum() < chi2.ppf(0.999, 3 * DRAWS)
    # A gradient of 4 % moves a centroid by 0.04 r / 4, 0.1 mm, of 12 LEDs, amplified some tenfold by the narrow view.
    assert errors.max() < 10e-3


def wrong_map(frame: DeviceFrame, generator: np.random.Generator, sigma_m: float, stated: bool) -> DeviceFrame:
    """The device believes another map."""
    leds = {
        key: led.model_copy(
            update={
                "position_m": tuple((np.array(led.position_m) + sigma_m * generator.standard_normal(3)).tolist()),
                "sigma_m": (sigma_m,) * 3 if stated else None,
            }
        )
        for key, led in frame.leds.items()
    }
    return replace(frame, leds=leds)


@pytest.mark.slow
@pytest.mark.parametrize("stated", [True, False])
def test_a_wrong_map_widens_the_covariance(stated: bool) -> None:
    """Each LED 1 mm off along x, y and z. Stated, normalised squared errors are chi-square: within the 99.9 % interval.
    Not stated, a standard deviation is estimated from 12 LEDs, and a camera as sold is assumed: below its quantile.
    """
    generator = np.random.default_rng(5)
    frames = (
        wrong_map(
            misread(WIDE_VIEW, frame_of(WIDE_VIEW, TWELVE, poisson(UNIFORM, seed)), generator), generator, 1e-3, stated
        )
        for seed in range(DRAWS)
    )
    _, nees = errors_of(frames, WIDE_VIEW)
    low, high = chi2.ppf([0.0005, 0.9995], 3 * DRAWS)
    assert nees.sum() < high
    if stated:
        assert nees.sum() > low


def hung(frame: DeviceFrame, generator: np.random.Generator, stated: float) -> DeviceFrame:
    """Luminaires of three LEDs that hang 3 mm off along each axis, the LEDs in them 0.3 mm; stated as `stated` times
    that.
    """
    off_m = 3e-3 * generator.standard_normal((4, 3))
    leds = {}
    for key, led in frame.leds.items():
        number = (key - 10) // 3
        place = np.array(led.position_m) + off_m[number] + 3e-4 * generator.standard_normal(3)
        sigma_m = (stated * 3e-4,) * 3
        leds[key] = led.model_copy(
            update={"position_m": tuple(place.tolist()), "sigma_m": sigma_m, "luminaire": number}
        )
    centres = [np.mean([led.position_m for led in leds.values() if led.luminaire == k], axis=0) for k in range(4)]
    luminaires = {
        k: Luminaire(
            id=k, position_m=tuple(centre.tolist()), sigma_m=(stated * 3e-3,) * 3, sigma_rotation_deg=(0.0,) * 3
        )
        for k, centre in enumerate(centres)
    }
    return replace(frame, leds=leds, luminaires=luminaires)


@pytest.mark.slow
def test_a_map_stated_three_times_too_sure_costs_no_accuracy() -> None:
    """The residuals tell the factor, which leaves the weights of luminaires and LEDs against each other as they are: an
    error of each LED by itself would take luminaires for twelve independent LEDs. The position is then that of the true
    statement, within the share of a standard deviation by which pixels and gravity weigh otherwise: the RMSE within 15
    %. The covariance counts the factor: below the quantile of chi-square, where it would be nine times too small.
    """
    rmse_m = {}
    for stated in (1.0, 1 / 3):
        generator = np.random.default_rng(8)
        frames = (
            hung(misread(WIDE_VIEW, frame_of(WIDE_VIEW, TWELVE, poisson(UNIFORM, seed)), generator), generator, stated)
            for seed in range(DRAWS)
        )
        errors, nees = errors_of(map(with_exact_camera, frames), WIDE_VIEW)
        rmse_m[stated] = np.sqrt((errors**2).mean())
        assert nees.sum() < chi2.ppf(0.999, 3 * DRAWS)
    assert rmse_m[1 / 3] < 1.15 * rmse_m[1.0]


def test_shapes_of_faces_do_not_tell_the_tilt_where_the_map_errs() -> None:
    """Real LEDs do not hang level, and their sizes are not exact. Their places, 1 mm uncertain, determine the position
    then: what the pixels tell beside the centroids is the size, 5 % uncertain, of which 12 LEDs would give the range to
    5 % / sqrt(12) of 3 m, 43 mm, beside 21 mm by places: a quarter in variance at most. Level faces tell far more.
    """
    generator = np.random.default_rng(6)
    frame = misread(WIDE_VIEW, frame_of(WIDE_VIEW, TWELVE, poisson(UNIFORM, 6), error_deg=1.0), generator)
    frame = wrong_map(frame, generator, 1e-3, stated=True)
    frame = replace(
        frame, leds={key: led.model_copy(update={"radius_sigma_m": 0.0005}) for key, led in frame.leds.items()}
    )
    by_pixels, by_spots = (method(frame).covariance_m2 for method in (ml, gravity_fit))
    assert by_pixels is not None
    assert by_spots is not None
    assert 0.75 < np.trace(by_pixels) / np.trace(by_spots) < 1.02


def with_wrong_sizes(seed: int, view: View, image: Floats) -> tuple[DeviceFrame, Floats]:
    """A frame whose sizes are told 5 % wrong, as stated, beside places 1 mm off; the true relative errors, (12,)."""
    generator = np.random.default_rng(seed)
    frame = misread(view, frame_of(view, TWELVE, poisson(image, seed)), generator)
    frame = wrong_map(frame, generator, 1e-3, stated=True)
    told_m = 0.01 * (1 + 0.05 * generator.standard_normal(12))
    leds = {
        key: led.model_copy(update={"radius_m": radius_m, "radius_sigma_m": 0.0005})
        for (key, led), radius_m in zip(frame.leds.items(), told_m.tolist(), strict=True)
    }
    return replace(frame, leds=leds), 0.01 / told_m - 1


def test_leds_of_another_size_than_told_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sizes 5 % off move the rims of images too small for spots to tell them by 0.2 px, beside a noise of 0.01 px: the
    pose, which the sizes hardly concern, is found in less steps than they are. All twelve LEDs are explained.
    """
    frame, _ = with_wrong_sizes(7, WIDE_VIEW, UNIFORM)
    found: list[Maximum] = []

    def spied(frame: DeviceFrame, gravity: Gravity, priors: Priors, start: Start) -> Maximum:
        found.append(maximize(frame, gravity, priors, start))
        return found[-1]

    monkeypatch.setattr(maximum_likelihood, "maximize", spied)
    ml(frame)
    assert [one.leds for one in found] == [tuple(frame.leds)]


def test_the_areas_of_spots_tell_sizes() -> None:
    """Images of 17 px: the start's sizes are the true ones to four standard deviations of the radius, and to the error
    of the pose along the axis, 0.5 % of the distance.
    """
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0, size=(1600, 1200, 6000.0))
    frame, errors = with_wrong_sizes(8, view, render(view, TWELVE, 0.01, 4000.0, samples=12))
    priors = Priors.of(frame)
    spots = find_correspondences(frame)
    pose = Pose(np.array(view.position_m), view.R_cam_world)
    start = start_at_spots(frame, gravity_of(frame), priors, spots, pose, NO_COMPONENTS)
    assert np.abs(start.nuisances.leds[:, SIZE] - errors).max() < 4 * initial.START_RADIUS_PX / 17 + 0.005


@pytest.mark.slow
def test_a_wrong_focal_length_is_revealed_by_a_wide_tilted_view() -> None:
    """1 % of 3 m is 30 mm in range, at a standard deviation of some micrometres if the focal length were exact. At
    400 px off the axis it is 4 px, of which a pose cannot take up tan 25 deg times 400 / 1500, 0.5 px.
    """
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0, size=(1200, 900, 1500.0))
    leds_m = grid(4, 3, 0.4, TARGET)
    frame = frame_of(view, leds_m, poisson(render(view, leds_m, 0.01, samples=12), 1))
    (fx, skew, cx), (_, fy, cy), last = frame.camera.K
    stated = frame.camera.model_copy(update={"K": ((1.01 * fx, skew, cx), (0.0, 1.01 * fy, cy), last)})
    _, nees = errors_of([replace(frame, camera=stated)], view)
    assert nees[0] < chi2.ppf(0.999, 3)


def test_a_focal_length_that_no_view_checks_widens_the_covariance() -> None:
    """Seen from below, a focal length 0.5 % too long is a camera 15 mm further down, to the last pixel. Of a camera as
    sold, 1 %, that is half a standard deviation of 30 mm; of one that states to be exact, hundreds.
    """
    view = view_of(TARGET, 3.0, size=(400, 300, 1500.0))
    frame = frame_of(view, TWELVE, poisson(render(view, TWELVE, 0.01, samples=12), 1), error_deg=0.01)
    (fx, skew, cx), (_, fy, cy), last = frame.camera.K
    told = frame.camera.model_copy(update={"K": ((1.005 * fx, skew, cx), (0.0, 1.005 * fy, cy), last)})
    unstated = replace(frame, camera=told)
    _, nees = errors_of([unstated, with_exact_camera(unstated)], view)
    assert nees[0] < chi2.ppf(0.99, 3)
    assert nees[1] > 1000
