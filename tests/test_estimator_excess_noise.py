"""Noise that a sensor has beside what it states is measured inside LED images, and weighs centroids and pixels."""

from dataclasses import replace

import numpy as np
import pytest
from estimator_correspondences import EXACT
from estimator_synthetic import grid, render, view_of
from numpy.typing import NDArray
from scipy.stats import chi2
from test_estimator_maximum_likelihood import frame_of, misread

from estimator.io.device import DeviceFrame
from estimator.io.sensor import Sensor
from estimator.methods import maximum_likelihood
from estimator.methods.gravity_fit import gravity_fit
from estimator.methods.maximum_likelihood import ml
from estimator.pixels.led_pixels import LedPixels, LedsInView, gather_led_pixels
from estimator.spots.correspondences import find_correspondences
from estimator.spots.excess_noise import _variances, excess_noise_e2

Floats = NDArray[np.float64]
SHOT = Sensor(
    **dict.fromkeys(("prnu", "dark_current_e_s", "dsnu_e", "read_noise_e", "adc_noise_dn"), 0.0),
    **{"row_offset_e": 0.0, "column_offset_e": 0.0, "black_level_dn": 0.0, "full_well_e": 1e6, "gain_e_per_dn": 1.0},
    bits=20,
    noise="shot",
    mosaic="none",
)
FULL = SHOT.model_copy(
    update={
        **{"noise": "full", "prnu": 0.02, "dsnu_e": 8.0, "read_noise_e": 20.0, "adc_noise_dn": 1.0},
        **{"row_offset_e": 40.0, "column_offset_e": 30.0, "gain_e_per_dn": 6.0},
    }
)
LEVEL_E = 4000.0


Image = tuple[Floats, NDArray[np.bool_]]


def lit(sensor: Sensor, more_e: float = 0.0, seed: int = 1, count: int = 40, side: int = 13) -> list[Image]:
    """Pixels inside LED images with the sensor's noise, and more of it; the light falls by 0.3 % a pixel."""
    random = np.random.default_rng(seed)
    light = LEVEL_E * (1 - 0.003 * np.arange(side))
    if sensor.mosaic != "none":
        light = light * np.where(np.arange(side) % 2, 0.4, 1.0)
    shape = count, side, side
    electrons = random.poisson(light * (1 + sensor.prnu * random.standard_normal(shape))).astype(float)
    fixed_e = np.hypot(np.hypot(sensor.dsnu_e, sensor.read_noise_e), more_e)
    electrons += fixed_e * random.standard_normal(shape)
    electrons += sensor.row_offset_e * random.standard_normal((count, side, 1))
    electrons += sensor.column_offset_e * random.standard_normal((count, 1, side))
    gain = sensor.gain
    read = gain * np.rint(electrons / gain + sensor.adc_noise_dn * random.standard_normal(shape))
    return [(one, np.ones(one.shape, dtype=bool)) for one in read]


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(25, 25), (13, 40), (3, 3), (1, 9), (6, 2)])
@pytest.mark.parametrize("mosaic", ["none", "rggb"])
def test_variances_are_of_the_pixels_with_two_neighbours_inside(
    precision: type, shape: tuple[int, int], mosaic: str
) -> None:
    """By NumPy's differences of slices, summed in double precision in another order."""
    rng = np.random.default_rng(9)
    electrons, inside = (1.37 * rng.poisson(3000, shape)).astype(precision), rng.random(shape) < 0.9
    sensor, apart = FULL.model_copy(update={"mosaic": mosaic}), 1 if mosaic == "none" else 2
    expected, counts = [], []
    for pixels, known, offset_e in ((electrons, inside, 30.0), (electrons.T, inside.T, 40.0)):
        own, before, after = np.s_[:, apart:-apart], np.s_[:, : -2 * apart], np.s_[:, 2 * apart :]
        off = (pixels[own] - (pixels[before] + pixels[after]) / 2)[known[own] & known[before] & known[after]]
        expected.append((off.astype(np.float64) ** 2).sum() / (1.5 * max(off.size, 1)) - offset_e**2)
        counts.append(off.size)
    variances_e2, count = _variances(electrons, inside, sensor)
    assert count == min(counts)
    np.testing.assert_allclose(variances_e2, expected, rtol=1e-12)


@pytest.mark.parametrize(
    "sensor", [SHOT, FULL, FULL.model_copy(update={"mosaic": "rggb"})], ids=["shot", "full", "rggb"]
)
@pytest.mark.parametrize("side", [3, 5, 13])
def test_a_sensor_that_is_as_stated_has_no_excess(sensor: Sensor, side: int) -> None:
    """Six standard deviations of the mean, and half of the variance at least: none of a hundred draws is beyond."""
    assert all(excess_noise_e2(lit(sensor, seed=seed, side=side), sensor) == 0 for seed in range(100))


@pytest.mark.parametrize(
    "sensor", [SHOT, FULL, FULL.model_copy(update={"mosaic": "bggr"})], ids=["shot", "full", "bggr"]
)
@pytest.mark.parametrize("more_e", [90.0, 1000.0])
def test_the_excess_is_measured(sensor: Sensor, more_e: float) -> None:
    """Of n squares the mean has a relative standard deviation of sqrt(35 / 9 n), the median of 40 such means that of
    their mean times sqrt(pi / 2). The levels of a mosaic change the PRNU's variance by 0.02^2 1200^2 = 576 e^2.
    """
    images = lit(sensor, more_e, side=25)
    total_e2 = LEVEL_E + (0.02 * LEVEL_E) ** 2 * (sensor.prnu > 0) + 400 + 64 + 36 + more_e**2
    sigma_e2 = np.sqrt(np.pi / 2 / 40 * 35 / 9 / (25 * 23)) * total_e2
    assert abs(excess_noise_e2(images, sensor) - more_e**2) < 4 * sigma_e2 + 576 * (sensor.mosaic != "none")


def test_the_mean_square_of_differences_scatters_as_the_limit_assumes() -> None:
    """Of 4000 draws the variance is known to sqrt(2 / 4000) = 2.2 %; the 23 differences of a row have fewer neighbours
    at its ends, which makes it smaller by 4 %.
    """
    sensor = SHOT.model_copy(update={"noise": "full", "read_noise_e": 5000.0})
    found = np.array([_variances(*image, SHOT)[0] for image in lit(sensor, count=4000, side=25)])
    relative = found.var(axis=0) / 5000.0**4 * (25 * 23)
    np.testing.assert_allclose(relative, 0.97 * 35 / 9, rtol=0.1)


@pytest.mark.parametrize("along", [0, 1])
def test_stripes_are_no_noise(along: int) -> None:
    """Of an LED that sends with a rolling shutter, in lines along rows or columns."""
    lines = np.random.default_rng(5).integers(0, 2, 13) * LEVEL_E
    stripes = np.broadcast_to(np.expand_dims(lines, along), (13, 13))
    assert excess_noise_e2([(electrons + stripes, inside) for electrons, inside in lit(SHOT)], SHOT) == 0


def test_few_leds_with_a_structure_do_not_decide() -> None:
    given = lit(SHOT, count=5)
    checked = LEVEL_E * (np.add.outer(np.arange(13), np.arange(13)) % 2), np.ones((13, 13), dtype=bool)
    assert excess_noise_e2([checked, checked, *given[:3]], SHOT) == 0
    assert excess_noise_e2([checked] * 5, SHOT) > LEVEL_E


def test_a_sensor_without_a_gain_has_no_noise_to_compare_with() -> None:
    assert excess_noise_e2(lit(SHOT, 1000.0), SHOT.model_copy(update={"gain_e_per_dn": None})) == 0


def test_a_black_image_has_no_excess() -> None:
    black = np.zeros((30, 30)), np.ones((30, 30), dtype=bool)
    with np.errstate(all="raise"):
        assert excess_noise_e2([black] * 6, SHOT) == 0


def test_pixels_that_are_not_inside_do_not_count() -> None:
    """A square of six by six pixels: 24 differences, whose mean's standard deviation is sqrt(35 / 9 / 24) = 0.4."""
    ((electrons, _),) = lit(SHOT, 1000.0, count=1, side=25)
    inside = np.zeros(electrons.shape, dtype=bool)
    inside[4:10, 8:14] = True
    measured = excess_noise_e2([(electrons, inside)], SHOT)
    assert 0.1e6 < measured < 3e6
    outside = np.where(inside, electrons, 1e9)
    assert excess_noise_e2([(outside, inside)], SHOT) == measured
    assert excess_noise_e2([(electrons, np.zeros_like(inside))], SHOT) == 0
    assert excess_noise_e2([], SHOT) == 0


VIEW = view_of((3.5, 3.6, 3.5), 3.0, 25.0, -15.0, 30.0, size=(420, 340, 2100.0))
LEDS_M = grid(3, 2, 0.16, (3.5, 3.6, 3.5))
BLACK_DN = 1000
EXPECTED_E = render(VIEW, LEDS_M, 0.01, 3000.0, samples=48)
MORE_E = 200.0
"""Of an LED image's pixels a variance of 43 000 e^2, where 3 000 are stated."""


def noisier(seed: int) -> DeviceFrame:
    """A frame of a sensor that states shot noise alone, and has another noise of MORE_E beside it."""
    random = np.random.default_rng(seed)
    electrons = random.poisson(EXPECTED_E) + MORE_E * random.standard_normal(EXPECTED_E.shape)
    frame = frame_of(VIEW, LEDS_M, np.rint(electrons + BLACK_DN).astype(np.uint32))
    sensor = frame.sensor.model_copy(update={"black_level_dn": float(BLACK_DN)})
    frame = replace(frame, sensor=sensor, camera=frame.camera.model_copy(update={"uncertainty": EXACT}))
    return misread(VIEW, frame, random)


def test_the_scatter_of_centroids_agrees_with_their_covariance() -> None:
    """Squared Mahalanobis distances of n centroids sum to chi2 with 2 n degrees of freedom. By the stated noise they
    would be ten times as large.
    """
    clean = frame_of(VIEW, LEDS_M, np.rint(EXPECTED_E).astype(np.uint32))
    at = {one.led.id: (one.spot.u_px, one.spot.v_px) for one in find_correspondences(clean)}
    total: float = 0.0
    count = 0
    for seed in range(60):
        for one in find_correspondences(noisier(seed)):
            error = np.subtract((one.spot.u_px, one.spot.v_px), at[one.led.id])
            total += float(error @ np.linalg.solve(one.spot.covariance_px2, error))
            count += 1
    assert count == 60 * len(LEDS_M)
    low, high = chi2.ppf([0.0005, 0.9995], 2 * count)
    assert low < total < high


def test_ml_weighs_its_pixels_by_the_noise_that_they_have() -> None:
    """Its errors agree with its covariance, and it is better than the fit of centroids, as it is with stated noise.

    With the stated noise alone no LED is explained, and faces, sizes and places become unknown: the error is
    millimetres.
    """
    draws, total = 30, 0.0
    of_ml, of_fit = [], []
    for seed in range(draws):
        frame = noisier(seed)
        estimate = ml(frame)
        error = estimate.position_m - VIEW.position_m
        assert estimate.covariance_m2 is not None
        total += float(error @ np.linalg.solve(estimate.covariance_m2, error))
        of_ml.append(float(error @ error))
        of_fit.append(float(((gravity_fit(frame).position_m - VIEW.position_m) ** 2).sum()))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * draws)
    assert low < total < high
    assert np.mean(of_ml) < np.mean(of_fit)


def test_centroids_count_the_noise_found_as_if_it_were_stated() -> None:
    frame = noisier(3)
    louder = replace(frame, sensor=frame.sensor.model_copy(update={"noise": "full", "read_noise_e": MORE_E}))
    loud = {one.led.id: one.spot.covariance_px2 for one in find_correspondences(louder)}
    found = {one.led.id: one.spot.covariance_px2 for one in find_correspondences(frame)}
    # Some 60 pixels inside an LED image have 40 differences along rows and 40 along columns, which share pixels: the
    # mean of all 80 squares has a standard deviation of sqrt(53 / 9 / 80) = 0.27, the median of six 0.14.
    for led, covariance_px2 in found.items():
        assert np.trace(covariance_px2) == pytest.approx(np.trace(loud[led]), rel=0.5)


def test_noise_that_hides_most_leds_ends_the_search_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixels within three standard deviations of saturation are not used: of LEDs at two thirds of the full well, with
    noise of a third of it, the rims alone are left. Their images would wander; the answer is that of the spots.
    """
    gathered: list[int] = []

    def counted(frame: DeviceFrame, view: LedsInView, parameters: NDArray[np.int64]) -> LedPixels:
        gathered.append(1)
        return gather_led_pixels(frame, view, parameters)

    monkeypatch.setattr(maximum_likelihood, "gather_led_pixels", counted)
    random = np.random.default_rng(4)
    noisy = random.poisson(EXPECTED_E) + 1500.0 * random.standard_normal(EXPECTED_E.shape)
    frame = frame_of(VIEW, LEDS_M, np.clip(np.rint(noisy + BLACK_DN), 0, 4500 + BLACK_DN).astype(np.uint32))
    wells = {"black_level_dn": float(BLACK_DN), "full_well_e": 4500.0}
    frame = replace(frame, sensor=frame.sensor.model_copy(update=wells))
    estimate = ml(frame)
    assert len(gathered) <= 2
    assert estimate.covariance_m2 is not None
    error = estimate.position_m - VIEW.position_m
    assert error @ np.linalg.solve(estimate.covariance_m2, error) < chi2.ppf(0.9999, 3)
