"""Likelihood: information and gradient by the full information matrix, and amplitudes of simulated frames."""

import numpy as np
import pytest
from estimator_synthetic import grid, poisson, render, view_of
from numpy.typing import NDArray
from test_estimator_maximum_likelihood import frame_of

from estimator.camera.pose import Pose
from estimator.camera.projection import project
from estimator.io.device import DeviceFrame
from estimator.pixels.led_pixels import MAX_IMAGE_SIGMA_PX, LedPixels, gather_led_pixels
from estimator.pixels.likelihood import Noise, PhotometricFit, excess_chi2, fit_photometry, score

Floats = NDArray[np.float64]
TARGET = (3.5, 3.6, 3.5)
VIEW = view_of(TARGET, 3.0, 25.0, -15.0, 30.0)
SIX = grid(3, 2, 0.14, TARGET)
SURE = np.eye(6) * 1e-12


def true_pose(frame: DeviceFrame) -> Pose:
    return Pose(np.array(VIEW.position_m), VIEW.R_cam_world)


def drawn(led_e: float, seed: int, full_well_e: float = 60000.0) -> DeviceFrame:
    image = poisson(render(VIEW, SIX, 0.01, led_e, samples=48), seed)
    frame = frame_of(VIEW, SIX, np.minimum(image, int(full_well_e)).astype(np.uint32))
    return DeviceFrame(**{**vars(frame), "sensor": frame.sensor.model_copy(update={"full_well_e": full_well_e})})


def explained(frame: DeviceFrame) -> tuple[LedPixels, PhotometricFit]:
    pixels = gather_led_pixels(frame, true_pose(frame), SURE)
    used = np.ones(len(pixels.leds), dtype=bool)
    photometry = None
    for _ in range(4):
        photometry = fit_photometry(pixels, pixels.rendered, used, Noise.of(frame), photometry)
    assert photometry is not None
    return pixels, photometry


def test_information_about_the_pose_is_the_schur_complement_of_all_of_it() -> None:
    pixels, photometry = explained(drawn(600.0, 1))
    readings, edges, groups = len(pixels.electrons), len(pixels.cells), len(pixels.led)
    design = np.zeros((readings, 6 + 2 * groups))
    brightness = pixels.weights * photometry.amplitude[pixels.group[:edges]]
    design[:edges, :6] = pixels.rendered.slopes(pixels.cells) * brightness[:, None]
    design[np.arange(readings), 6 + pixels.group] = pixels.pixel_counts
    design[np.arange(readings), 6 + groups + pixels.group] = photometry.light
    full = design.T @ (design * photometry.weight[:, None])
    scale = np.sqrt(np.diag(full))
    covariance = np.linalg.inv(full / np.outer(scale, scale)) / np.outer(scale, scale)
    information, gradient = score(pixels, pixels.rendered, photometry)
    found = np.linalg.inv(information)
    np.testing.assert_allclose(found, covariance[:6, :6], rtol=1e-6, atol=1e-6 * np.abs(found).max())
    residual = design.T @ (photometry.weight * (pixels.electrons - photometry.expected))
    np.testing.assert_allclose(gradient, residual[:6], rtol=1e-9)


def test_every_led_in_view_has_its_readings() -> None:
    pixels, _ = explained(drawn(4000.0, 2))
    assert sorted(led.id for led in pixels.leds) == [10, 11, 12, 13, 14, 15]
    assert not pixels.more
    # An ellipse of 5 px semi-axes, its edge 2 px of margin either way, its ring 8 px more: some hundred and a thousand.
    counts = np.bincount(pixels.group, pixels.pixel_counts)
    assert (counts > 400).all()
    assert (counts < 1200).all()


@pytest.mark.parametrize("full_well_e", [60000.0, 2950.0])
def test_amplitudes_are_those_drawn_also_near_to_full(full_well_e: float) -> None:
    """Amplitudes of 2950 - 40 e, each within 5 of its standard deviations, and their mean within 4 of its.

    Where a face is as bright as a full pixel, half of its pixels are cut off: to leave out only those would take 0.8
    standard deviations of a pixel off, 43 e.
    """
    pixels, photometry = explained(drawn(2950.0, 3, full_well_e))
    sigma = photometry.amplitude / photometry.signal_to_noise
    off = photometry.amplitude - 2910.0
    assert (np.abs(off) < 5 * sigma).all()
    assert abs((off / sigma**2).sum()) < 4 * np.sqrt((1 / sigma**2).sum())
    assert len(pixels.leds) == 6


def test_a_true_led_is_explained_and_a_shifted_one_is_not() -> None:
    frame = drawn(4000.0, 4)
    pixels, photometry = explained(frame)
    assert (excess_chi2(pixels, pixels.rendered, photometry) < 0).all()
    shifted = gather_led_pixels(
        frame, true_pose(frame).moved(np.array([0.0, 0.0, 0.0, 0.5 / 1500, 0.0, 0.0]), frame.camera), SURE
    )
    photometry = fit_photometry(shifted, shifted.rendered, np.ones(6, dtype=bool), Noise.of(frame))
    assert (excess_chi2(shifted, shifted.rendered, photometry) > 0).all()


def test_leds_whose_image_is_uncertain_are_left_out() -> None:
    frame = drawn(4000.0, 5)
    moves = project(SIX, true_pose(frame), frame.camera).slopes[:, :, 5]
    spread = SURE.copy()
    spread[5, 5] = (MAX_IMAGE_SIGMA_PX / np.median(np.linalg.norm(moves, axis=1))) ** 2
    pixels = gather_led_pixels(frame, true_pose(frame), spread)
    assert len(pixels.leds) == 3
    assert pixels.more
