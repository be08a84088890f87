"""Likelihood: information and gradient by the full information matrix, and amplitudes of simulated frames."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from estimator_synthetic import grid, poisson, render, view_of
from numpy.typing import NDArray
from scipy.stats import chi2
from test_estimator_maximum_likelihood import frame_of

from estimator.camera.pose import Pose
from estimator.camera.projection import project
from estimator.io.device import DeviceFrame
from estimator.pixels.goodness_of_fit import excess_chi2
from estimator.pixels.led_model import IMAGE_PARAMETERS, PROFILE_PARAMETERS, ImageState
from estimator.pixels.led_pixels import (
    MAX_IMAGE_SIGMA_PX,
    LedPixels,
    ReadingGains,
    gather_led_pixels,
    leds_in_view,
)
from estimator.pixels.likelihood import (
    BACKGROUND_SIGMAS,
    COEFFICIENTS,
    Noise,
    PhotometricFit,
    fit_photometry,
    score,
)

Floats = NDArray[np.float64]
TARGET = (3.5, 3.6, 3.5)
VIEW = view_of(TARGET, 3.0, 25.0, -15.0, 30.0)
SIX = grid(3, 2, 0.14, TARGET)
SURE = np.eye(6) * 1e-12


def true_pose(frame: DeviceFrame) -> Pose:
    return Pose(np.array(VIEW.position_m), VIEW.R_cam_world)


def gathered(frame: DeviceFrame, pose: Pose, covariance: Floats = SURE) -> LedPixels:
    """Readings of the LEDs in view, whose map is exact."""
    leds = len(frame.leds)
    state = ImageState.as_told(pose, frame.camera, leds)
    return gather_led_pixels(frame, leds_in_view(frame, state, covariance, np.zeros(leds), np.zeros(leds, dtype=bool)))


def drawn(led_e: float, seed: int, full_well_e: float = 60000.0) -> DeviceFrame:
    image = poisson(render(VIEW, SIX, 0.01, led_e, samples=48), seed)
    frame = frame_of(VIEW, SIX, np.minimum(image, int(full_well_e)).astype(np.uint32))
    return DeviceFrame(**{**vars(frame), "sensor": frame.sensor.model_copy(update={"full_well_e": full_well_e})})


def explained(frame: DeviceFrame) -> tuple[LedPixels, PhotometricFit]:
    pixels = gathered(frame, true_pose(frame))
    used = np.ones(len(pixels.leds), dtype=bool)
    photometry = None
    for _ in range(4):
        photometry = fit_photometry(pixels, pixels.rendered, used, Noise.of(frame), photometry)
    assert photometry is not None
    return pixels, photometry


def test_information_about_an_image_is_the_schur_complement_of_all_of_it() -> None:
    """Pose and profile of all LEDs, against the full matrix with each group's background and amplitude."""
    pixels, photometry = explained(drawn(600.0, 1))
    readings, groups = len(pixels.electrons), len(pixels.led)
    profile = np.zeros((len(pixels.leds), PROFILE_PARAMETERS))
    design = np.zeros((readings, 9 + COEFFICIENTS * groups))
    brightness = photometry.amplitude[pixels.group]
    design[pixels.edges, :6] = pixels.rendered.slopes(pixels.cells) * brightness[pixels.edges, None]
    design[:, 6:9] = pixels.face * (brightness * pixels.light(pixels.rendered))[:, None]
    basis = [*pixels.background.T, *photometry.by_light]
    for k in range(COEFFICIENTS):
        design[np.arange(readings), 9 + k * groups + pixels.group] = basis[k]
    full = design.T @ (design * photometry.weight[:, None])
    for k, sigma in enumerate(BACKGROUND_SIGMAS, start=1):
        own = 9 + k * groups + np.arange(groups)
        full[own, own] += 1 / (sigma * photometry.level) ** 2
    scale = np.sqrt(np.diag(full))
    covariance = np.linalg.inv(full / np.outer(scale, scale)) / np.outer(scale, scale)
    information, gradient = score(pixels, pixels.rendered, photometry, profile)
    chosen = [*range(6), *range(IMAGE_PARAMETERS, IMAGE_PARAMETERS + PROFILE_PARAMETERS)]
    found = np.linalg.inv(information.sum(axis=0)[np.ix_(chosen, chosen)])
    # The level of the prior is that of the fit after the covariance was made: it moves by some 1e-4 in a step.
    np.testing.assert_allclose(found, covariance[:9, :9], rtol=1e-4, atol=1e-4 * np.abs(found).max())
    residual = design.T @ (photometry.weight * (pixels.electrons - photometry.expected))
    np.testing.assert_allclose(gradient.sum(axis=0)[chosen], residual[:9], rtol=1e-9)


def test_every_led_in_view_has_its_readings() -> None:
    pixels, _ = explained(drawn(4000.0, 2))
    assert sorted(led.id for led in pixels.leds) == [10, 11, 12, 13, 14, 15]
    assert not pixels.more
    # An ellipse of 5 px semi-axes lights pixels up to 1 px beyond; one more tells the background: pi 6.5^2 and some.
    counts = np.bincount(pixels.group, pixels.pixel_counts)
    assert (counts > 80).all()
    assert (counts < 200).all()


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


@pytest.mark.parametrize("scale", [1.0, 1e-3])
@pytest.mark.parametrize(("spread", "determined"), [(1e-4, True), (1e-5, False)])
def test_light_that_is_even_over_its_pixels_has_no_amplitude(spread: float, determined: bool, scale: float) -> None:
    """Light that differs by a relative e from pixel to pixel differs from background by e^2 of its square: 1e-9 is the
    limit, whatever the unit of light; double precision sums a hundred squares to 1e-14.
    """
    sign = np.where(np.arange(100) % 2 == 0, 1.0, -1.0)
    waves = np.arange(100)[:, None] * [0.1, 0.2, 0.3] * np.pi
    light, n = scale * (1 + spread * sign), np.ones(100)
    pixels = SimpleNamespace(
        **{"pixel_counts": n, "electrons": 500 + sign, "group": np.zeros(100, dtype=np.int64), "gains": None},
        **{"led": np.zeros(1, dtype=np.int64), "starts": np.array([0, 100]), "light": lambda _: light},
        background=np.column_stack([n, np.sin(waves)]),
        sum_by_group=lambda values: values.sum(keepdims=True),
    )
    frame = frame_of(VIEW, SIX, np.zeros((1, 1), dtype=np.uint32))
    fitted = fit_photometry(pixels, None, np.ones(1, dtype=bool), Noise.of(frame))  # type: ignore[arg-type]
    assert (fitted.amplitude[0] != 0) == determined


def test_a_true_led_is_explained_and_a_shifted_one_is_not() -> None:
    frame = drawn(4000.0, 4)
    pixels, photometry = explained(frame)
    assert (excess_chi2(pixels, photometry) < 0).all()
    shifted = gathered(frame, true_pose(frame).moved(np.array([0.0, 0.0, 0.0, 0.5 / 1500, 0.0, 0.0]), frame.camera))
    photometry = fit_photometry(shifted, shifted.rendered, np.ones(6, dtype=bool), Noise.of(frame))
    assert (excess_chi2(shifted, photometry) > 0).all()


def test_leds_whose_image_is_uncertain_are_left_out() -> None:
    frame = drawn(4000.0, 5)
    moves = project(SIX, true_pose(frame), frame.camera).slopes[:, :, 5]
    spread = SURE.copy()
    spread[5, 5] = (MAX_IMAGE_SIGMA_PX / np.median(np.linalg.norm(moves, axis=1))) ** 2
    pixels = gathered(frame, true_pose(frame), spread)
    assert len(pixels.leds) == 3
    assert pixels.more


def test_the_noise_of_a_dark_pixel_by_hand() -> None:
    """3 e/DN: dark signal nonuniformity 4 e, read noise 12 e, the ADC's 2 DN are 6 e, rounding is 3 / sqrt(12) e, rows
    differ by 5 e and columns by 7 e. The full well of 6000 e is 2000 DN above the black level of 64.
    """
    frame = frame_of(VIEW, SIX, np.zeros((300, 400), dtype=np.uint32))
    values = {
        **{"noise": "full", "gain_e_per_dn": 3.0, "dsnu_e": 4.0, "read_noise_e": 12.0, "adc_noise_dn": 2.0},
        **{"row_offset_e": 5.0, "column_offset_e": 7.0, "prnu": 0.05, "black_level_dn": 64.0, "full_well_e": 6000.0},
    }
    noise = Noise.of(replace(frame, sensor=frame.sensor.model_copy(update=values)))
    assert noise.dark_e2 == pytest.approx(16 + 144 + 36 + 9 / 12 + 25 + 49)
    assert noise.prnu2 == pytest.approx(0.0025)
    # Four standard deviations of the noise that is added after clipping: read noise, offsets and the ADC's.
    assert noise.saturation_e == pytest.approx(6000 - 4 * np.sqrt(144 + 25 + 49 + 36))


def test_halos_that_touch_do_not_add_up() -> None:
    """Two faces of 5 px radius, 1 px apart, the second ten times brighter: readings go to 1 px beyond the pixels that a
    face lights, so those about the first hold the edge of the second, whose pixels are left out. Without noise the
    amplitudes are the ones rendered, to four times the mean over a hundred edge pixels of 0.3 / 100^1.5 of 40 000 e,
    1.2 e.
    """
    view = view_of(TARGET, 3.0, 0.0, 0.0, 0.0)
    leds = np.array(TARGET) + [[-0.011, 0.0, 0.0], [0.011, 0.0, 0.0]]
    image = np.rint(render(view, leds, 0.01, [4040.0, 40040.0], samples=100)).astype(np.uint32)
    frame = frame_of(view, leds, image)
    pixels = gathered(frame, Pose(np.array(view.position_m), view.R_cam_world))
    photometry = fit_photometry(pixels, pixels.rendered, np.ones(2, dtype=bool), Noise.of(frame))
    for _ in range(3):
        photometry = fit_photometry(pixels, pixels.rendered, np.ones(2, dtype=bool), Noise.of(frame), photometry)
    assert photometry.amplitude == pytest.approx([4000.0, 40000.0], abs=5.0)
    # And the darkest pixels, the background, are expected to be that.
    background = photometry.expected[pixels.light(pixels.rendered) == 0.0]
    assert background == pytest.approx(np.full(len(background), 40.0), abs=1.5)


def test_a_true_led_is_left_out_once_in_50_000() -> None:
    """An LED's chi-square has a freedom of its readings less five; its own scatter is sqrt(2 freedom), and five of them
    are exceeded by chance once in 50 000 at most, four ten times as often. Beyond them the model may be wrong at the
    edge by 0.05 of the amplitude A times 4 s (1 - s), s the share covered.
    """
    pixels, photometry = explained(drawn(600.0, 1))
    # Next to the axis the fall-off is within 1e-4 of 1.
    share, group = pixels.rendered.light[pixels.cells], pixels.group[pixels.edges]
    readings = np.bincount(pixels.group)
    freedom = readings - 5
    wrong_e = 0.05 * photometry.amplitude[group] * 4 * share * (1 - share)
    allowed = np.bincount(group, wrong_e**2 * photometry.weight[pixels.edges])
    for sigmas, sign in ((4.9, -1), (5.1, 1)):
        # All readings off by as many of their standard deviations.
        off = np.sqrt((freedom + sigmas * np.sqrt(2 * freedom) + allowed) / readings)[pixels.group]
        electrons = photometry.expected + off / np.sqrt(photometry.weight)
        excess = excess_chi2(replace(pixels, electrons=electrons), photometry)
        assert (np.sign(excess) == sign).all()
    assert (chi2.sf(freedom + 5 * np.sqrt(2 * freedom), freedom) < 2e-5).all()
    assert (chi2.sf(freedom + 4 * np.sqrt(2 * freedom), freedom) > 1e-4).all()


@pytest.mark.parametrize(("shift_px", "is_explained"), [(0.03, True), (0.1, False)])
def test_a_bright_led_may_be_displaced_by_a_twentieth_of_a_pixel(shift_px: float, is_explained: bool) -> None:
    """A shift d changes an edge pixel by d |cos| of the amplitude, d^2 / 2 squared and averaged over the rim; the model
    error is 0.05^2 16 s^2 (1 - s)^2, 0.05^2 16 / 30 averaged over shares. They are equal at d = 0.05 px.
    """
    frame = frame_of(VIEW, SIX, np.rint(render(VIEW, SIX, 0.01, 4000.0, samples=48)).astype(np.uint32))
    pose = true_pose(frame).moved(np.array([0.0, 0.0, 0.0, shift_px / 1500, 0.0, 0.0]), frame.camera)
    pixels = gathered(frame, pose)
    photometry = fit_photometry(pixels, pixels.rendered, np.ones(6, dtype=bool), Noise.of(frame))
    assert ((excess_chi2(pixels, photometry) < 0) == is_explained).all()


@pytest.mark.parametrize(("sigmas", "is_used"), [(3.3, True), (2.7, False)])
def test_faces_are_used_up_to_three_standard_deviations_below_saturation(sigmas: float, is_used: bool) -> None:
    """Of a normal variable that is cut there the mean is 4e-4 standard deviations low. Without noise in the image, the
    expectation is the face's to a thousandth, where 0.3 standard deviations are 5 thousandths.
    """
    frame = frame_of(VIEW, SIX, np.rint(render(VIEW, SIX, 0.01, 3000.0, samples=48)).astype(np.uint32))
    full_well_e = 3000.0 + sigmas * np.sqrt(3000.0)
    frame = replace(frame, sensor=frame.sensor.model_copy(update={"full_well_e": full_well_e}))
    pixels = gathered(frame, true_pose(frame))
    photometry = fit_photometry(pixels, pixels.rendered, np.ones(6, dtype=bool), Noise.of(frame))
    assert ((photometry.weight[pixels.uniform_light > 0] > 0) == is_used).all()


@pytest.mark.parametrize("bright", [2, 6])
def test_saturated_leds_are_left_out_beside_others(bright: int) -> None:
    """Faces of three times the full well say where their edge is only if the amplitude is known: they are used where
    all LEDs are so.
    """
    full_well_e = 3000.0
    led_e = np.where(np.arange(6) < bright, 3 * full_well_e, 0.5 * full_well_e)
    image = np.minimum(np.rint(render(VIEW, SIX, 0.01, led_e.tolist())), full_well_e).astype(np.uint32)
    frame = frame_of(VIEW, SIX, image)
    frame = replace(frame, sensor=frame.sensor.model_copy(update={"full_well_e": full_well_e}))
    pixels = gathered(frame, true_pose(frame))
    assert [pixels.leds[k].id for k in pixels.led] == ([12, 13, 14, 15] if bright == 2 else [10, 11, 12, 13, 14, 15])


def test_a_phase_that_the_light_does_not_tell_is_that_of_the_prior() -> None:
    """The prior of a wave's phase is about the decoded one, 0, whatever the fit before said: light that does not change
    with the phase leaves it there, after steps of half a line at most.
    """
    frame = drawn(4000.0, 1)
    pixels, before = explained(frame)
    groups = len(pixels.led)
    waves = ReadingGains((lambda lines: np.ones(len(lines)),) * groups, np.zeros(len(pixels.electrons)), pixels.starts)
    pixels = replace(pixels, gains=waves)
    used = np.ones(len(pixels.leds), dtype=bool)
    for start, expected in ((0.4, 0.0), (-0.4, 0.0), (0.7, 0.2)):
        begun = replace(before, phase=np.full(groups, start))
        found = fit_photometry(pixels, pixels.rendered, used, Noise.of(frame), begun)
        # The amplitudes of the two fits, whose ratio is a factor of the step, agree to far better than that.
        np.testing.assert_allclose(found.phase, expected, atol=1e-6)


@pytest.mark.parametrize(("steps", "measured"), [("alike", True), ("apart", True), ("fine", False)])
def test_pixels_of_a_background_that_are_rounded_alike_have_no_rounding_errors(
    rng: np.random.Generator, steps: str, measured: bool
) -> None:
    """By hand: of a variance of 100 of which 90 is by the ADC's steps, pixels that read the same have 10 left. Where
    the rounding errors are apart, n = 400 squares have a mean within 4 sqrt(2 / n) = 0.28 of the variance, which is
    not exceeded. Steps of less than the noise, and lit pixels, are left alone.
    """
    stated = np.full(800, 100.0)
    unlit = np.arange(800) < 400
    off = rng.normal(0, 10.0, 800) if steps == "apart" else np.zeros(800)
    noise = Noise(90.0, 0.0, 1e6, 20.0 if steps == "fine" else 90.0)
    found = noise.reduced_where_alike(stated, off, np.ones(800), unlit, np.zeros(800, dtype=np.int64))
    assert (found[~unlit] == 100).all()
    assert (found <= 100).all()
    if steps == "alike":
        np.testing.assert_allclose(found[unlit], 10.0)
    else:
        assert (found[unlit] > (72 if measured else 99.9)).all()


def test_each_background_has_the_variance_measured_in_it() -> None:
    """One LED's background is rounded alike, another's is not: readings a step to either side of their mean."""
    group = np.repeat([0, 1], 50)
    off = np.where(group == 1, 10.0 * (-1) ** np.arange(100), 0.0)
    found = Noise(90.0, 0.0, 1e6, 90.0).reduced_where_alike(
        np.full(100, 100.0), off, np.ones(100), np.ones(100, dtype=bool), group
    )
    np.testing.assert_allclose(found, np.where(group == 0, 10.0, 100.0))


def test_readings_beside_an_led_image_have_the_weight_of_their_own_noise() -> None:
    """An ADC with steps of 3 000 electrons reads an even background of some 100 as 0: these readings have the
    background's own variance, less than the 750 000 by the steps, which pixels inside the LED image keep.
    """
    frame = drawn(200_000.0, 3, full_well_e=1e6)
    pixels = gathered(frame, true_pose(frame))
    pixels = replace(pixels, electrons=3000.0 * np.round(pixels.electrons / 3000.0))
    used = np.ones(len(pixels.leds), dtype=bool)
    photometry = fit_photometry(pixels, pixels.rendered, used, Noise(750_000.0, 0.0, 1e6, 750_000.0))
    stated = 1 / (pixels.pixel_counts * (np.maximum(photometry.expected / pixels.pixel_counts, 0) + 750_000.0))
    unlit = pixels.light(pixels.rendered) < 1e-4 * pixels.pixel_counts
    assert unlit.sum() > 20
    assert (photometry.weight[unlit] > 10 * stated[unlit]).all()
    inside = pixels.light(pixels.rendered) > 0.5 * pixels.pixel_counts
    np.testing.assert_allclose(photometry.weight[inside], stated[inside], rtol=1e-6)


def test_no_pixel_has_less_noise_than_half_of_the_background_s() -> None:
    """A background of 0.05 electrons a pixel by shot noise alone, as some LED's readings extrapolate it, is negative in
    places, where a single electron would outweigh all other pixels.
    """
    image = poisson(render(VIEW, SIX, 0.01, 8.0, background_e=0.05, samples=48), 7)
    frame = frame_of(VIEW, SIX, image.astype(np.uint32))
    pixels = gathered(frame, true_pose(frame))
    used = np.ones(len(pixels.leds), dtype=bool)
    photometry = fit_photometry(pixels, pixels.rendered, used, Noise(0.0, 0.0, 1e6))
    assert photometry.expected.min() < 0
    unlit = pixels.light(pixels.rendered) < 1e-3 * pixels.background[:, 0]
    sums, sizes = (pixels.sum_by_group(np.where(unlit, of, 0.0)) for of in (pixels.electrons, pixels.pixel_counts))
    variance = 1 / (photometry.weight * pixels.pixel_counts)
    assert (variance > 0.49 * (sums / sizes)[pixels.group]).all()
    assert (variance / (sums / sizes)[pixels.group]).min() < 0.6  # half, and half a count of some ten
