"""Denoisers: Algorithm 1 corrected is a mean of neighbours, as printed it is not; and the others."""

from dataclasses import replace

import numpy as np
import pytest
from estimator_synthetic import view_of
from scipy import stats
from test_estimator_maximum_likelihood import frame_of

from estimator.errors import EstimationFailure
from estimator.methods.huynh2016 import huynh2016_with
from estimator.spots.denoise import (
    DENOISERS,
    Denoiser,
    Image,
    algorithm_1,
    box_mean,
    neighbourhood_mean,
    stabilise,
    unbiased_inverse,
    variance_stabilised,
)
from estimator.spots.led_light import Light, LightSums
from estimator.spots.light_loops import light_sums


def test_each_pixel_becomes_the_mean_of_its_120_neighbours() -> None:
    image = np.random.default_rng(1).poisson(300, (23, 31)).astype(np.float32)
    result = neighbourhood_mean(image)
    for row, column in [(5, 5), (11, 15), (17, 25), (6, 20)]:
        square = image[row - 5 : row + 6, column - 5 : column + 6].astype(np.float64)
        neighbours = np.delete(square.ravel(), 60)
        assert len(neighbours) == 120
        # float32 keeps 24 bits: 6e-8 of the value at each of a few steps.
        np.testing.assert_allclose(result[row, column], neighbours.mean(), rtol=3e-7)


def test_it_is_c_minus_the_mean_difference() -> None:
    """The paper's wording: mu_S is the mean of c - c_k (Eq. 14), and the adjusted intensity is c - mu_S."""
    image = np.random.default_rng(2).poisson(50, (11, 11)).astype(np.float32)
    differences = image[5, 5] - np.delete(image.ravel(), 60)
    np.testing.assert_allclose(neighbourhood_mean(image)[5, 5], image[5, 5] - differences.mean(), rtol=3e-7)


def test_at_the_border_the_mean_is_over_the_neighbours_there_are() -> None:
    image = np.random.default_rng(3).poisson(50, (14, 17)).astype(np.float32)
    result = neighbourhood_mean(image)
    first = np.delete(image[:6, :6].ravel(), 0)
    np.testing.assert_allclose(result[0, 0], first.mean(), rtol=3e-7)
    side = np.delete(image[3:14, 11:].ravel(), 5 * 6 + 5)
    np.testing.assert_allclose(result[8, 16], side.mean(), rtol=3e-7)


@pytest.mark.parametrize("name", ["corrected", "literal"])
def test_means_that_denoisers_share_give_the_same_and_stay_as_they_were(name: str) -> None:
    image = np.random.default_rng(4).poisson(50, (14, 17)).astype(np.float32)
    means = neighbourhood_mean(image)
    denoiser = DENOISERS[name]
    assert denoiser.by_means is not None
    np.testing.assert_array_equal(denoiser.by_means(image, means), denoiser.apply(image, 0.0))
    np.testing.assert_array_equal(means, neighbourhood_mean(image))


def test_a_flat_image_stays_flat_and_the_input_stays_as_it_was() -> None:
    image = np.full((20, 30), 7.0, np.float32)
    np.testing.assert_allclose(neighbourhood_mean(image), 7.0, rtol=1e-7)
    assert (image == 7).all()


def test_shot_noise_shrinks_to_1_in_120() -> None:
    image = np.random.default_rng(4).poisson(100, (400, 400)).astype(np.float32)
    inner = neighbourhood_mean(image)[5:-5:12, 5:-5:12]
    # 33 x 33 squares that do not overlap: independent means with variance 100 / 120. The sample variance of n normal
    # values has a relative standard error of sqrt(2 / (n - 1)).
    n = inner.size
    assert abs(inner.var(ddof=1) / (100 / 120) - 1) < 5 * np.sqrt(2 / (n - 1))


def test_the_printed_lines_computed_one_by_one() -> None:
    """Lines 8 to 12 as they stand, SSoID assigned and not summed, for one pixel; Eq. 13 for lambda_1."""
    image = np.random.default_rng(5).poisson(60, (15, 17)).astype(np.float32)
    mu, n = 0.0, 120
    for row in range(1, 12):
        for column in range(3, 14):
            if (row, column) != (6, 8):
                mu += (float(image[6, 8]) - float(image[row, column])) / n
                ssoid = (float(image[6, 8]) - float(image[row, column])) ** 2 / n
                sigma = mu - ssoid
    # The differences are of numbers up to 100, in float32; mu, of their size, rounds at 1e-5, and sigma^2 doubles that.
    assert algorithm_1(image)[6, 8] == pytest.approx((sigma**2 + mu) / 2, rel=1e-4, abs=1e-4)


def test_the_printed_lines_leave_only_the_edges_of_an_led_image() -> None:
    """Where the pixel is as bright as all around it, mu = SSoID = 0, however bright that is."""
    image = np.zeros((60, 60), np.float32)
    image[15:45, 15:45] = 3000
    result = algorithm_1(image)
    assert result[30, 30] == result[3, 3] == 0
    assert neighbourhood_mean(image)[30, 30] == 3000
    assert result.max() > 1e6


def test_the_covariance_of_a_centroid_of_box_means_by_each_raw_pixel() -> None:
    """A raw pixel adds 1 / 25 of an electron to the means of the 5 x 5 pixels around it, and moves the centroid by
    (du, dv) / flux for each of these that is in the support: an outer product with its variance.

    The support touches a border, and pixels beyond the rectangle are neither read nor in the support.
    """
    rng, shape = np.random.default_rng(8), (9, 12)
    support, variance_e2 = rng.random(shape) < 0.6, rng.uniform(1.0, 9.0, shape)
    above_e = np.full(shape, 100.0)
    sums = LightSums(*light_sums(above_e, support, variance_e2, 20, 30))
    light = Light(20, 30, support, above_e, variance_e2, np.inf, np.empty(0), sums)
    rows, columns = np.nonzero(support)
    centre, expected = np.array([20.5 + columns.mean(), 30.5 + rows.mean()]), np.zeros((2, 2))
    for row in range(9):
        for column in range(12):
            of_pixel = np.zeros(2)
            for i in range(max(row - 2, 0), min(row + 3, 9)):
                for j in range(max(column - 2, 0), min(column + 3, 12)):
                    of_pixel += support[i, j] * (np.array([20.5 + j, 30.5 + i]) - centre) / 25 / above_e[support].sum()
            expected += variance_e2[row, column] * np.outer(of_pixel, of_pixel)
    np.testing.assert_allclose(light.covariance_px2(2), expected, rtol=1e-10)


def test_the_box_mean_counts_the_pixel_too() -> None:
    image = np.random.default_rng(6).poisson(300, (23, 31)).astype(np.float32)
    np.testing.assert_allclose(box_mean(image)[11, 15], image[6:17, 10:21].mean(dtype=np.float64), rtol=3e-7)


@pytest.mark.parametrize("mean_e", [0.0, 0.3, 1.0, 4.0, 20.0, 300.0, 5000.0])
def test_the_inverse_is_unbiased_and_the_noise_even(mean_e: float) -> None:
    """Exact expectations over the Poisson distribution. The closed form is good to 0.02 e by its authors; the algebraic
    inverse errs by 0.25 e from some 3 e on. The stabilised variance differs from 1 by a term in 1 / mean^2 and more.
    """
    counts = np.arange(int(mean_e + 12 * np.sqrt(mean_e) + 30), dtype=np.float32)
    weights = stats.poisson.pmf(counts, mean_e)
    values = stabilise(counts[None], 0.0)[0].astype(np.float64)
    mean = weights @ values
    # float32 keeps 6e-8 of the electrons.
    assert abs(unbiased_inverse(np.array([[mean]], np.float32), 0.0)[0, 0] - mean_e) < 0.02 + 3e-7 * mean_e
    if mean_e >= 20:
        assert abs(weights @ values**2 - mean**2 - 1) < 0.01


def test_read_noise_is_stabilised_and_subtracted() -> None:
    """Poisson and Gaussian noise together, 10 e and 3 e: mean and variance within 5 standard errors of 10 and 1.

    The closed form is off by up to 0.02 e, and the variance by a term of order 1 / 19^2.
    """
    rng, n = np.random.default_rng(7), 400_000
    values = stabilise((rng.poisson(10, (1, n)) + rng.normal(0, 3, (1, n))).astype(np.float32), 3.0).astype(np.float64)
    mean = unbiased_inverse(np.array([[values.mean()]], np.float32), 3.0)[0, 0]
    assert abs(mean - 10) < 5 * np.sqrt(19 / n) + 0.02
    assert abs(values.var() - 1) < 5 * np.sqrt(2 / n) + 0.02


def test_variance_stabilised_smooths_surfaces_and_keeps_edges() -> None:
    """Over the 5 x 5 pixels noise falls; a step of 3000 e to 40 e, 80 times the noise, keeps its place and height."""
    rng = np.random.default_rng(8)
    expected = np.full((100, 100), 40.0)
    expected[:, 50:] = 3000.0
    result = variance_stabilised(rng.poisson(expected).astype(np.float32), 0.0)
    for side in (np.s_[:, :45], np.s_[:, 55:]):
        assert result[side].std() < 0.5 * np.sqrt(expected[side].mean())
    # One column's mean has a standard error of sqrt(40 / 100) at most, and no bright pixel may leak in.
    assert abs(result[:, 49].mean() - 40) < 5 * np.sqrt(40 / 100)
    assert abs(result[:, 50].mean() - 3000) < 5 * np.sqrt(3000 / 100)


@pytest.mark.parametrize("name", DENOISERS)
def test_every_denoiser_takes_any_image_and_leaves_it(name: str) -> None:
    for shape in [(1, 1), (1, 40), (3, 7), (60, 80)]:
        image = np.random.default_rng(9).poisson(5, shape).astype(np.float32) - 3
        before = image.copy()
        result = DENOISERS[name].apply(image, 1.5)
        assert result.dtype == np.float32
        assert result.shape == shape
        assert np.isfinite(result).all()
        np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize("name", DENOISERS)
def test_no_denoiser_exceeds_its_radius(name: str) -> None:
    denoiser = DENOISERS[name]
    image = np.random.default_rng(10).poisson(50, (40, 40)).astype(np.float32)
    other = image.copy()
    other[20, 20] += 500
    changed = np.argwhere(denoiser.apply(image, 0.0) != denoiser.apply(other, 0.0)) - 20
    assert np.abs(changed).max() == denoiser.radius_px


def test_the_denoiser_is_told_the_noise_beside_shot_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 3 e/DN: dark signal nonuniformity 4 e, read noise 12 e, the ADC's 2 DN are 6 e, rounding 3 / sqrt(12) e."""
    told: list[float] = []

    def listen(image: Image, noise_e: float) -> Image:
        told.append(noise_e)
        raise EstimationFailure("denoise", "enough was heard")

    monkeypatch.setitem(DENOISERS, "anscombe", Denoiser(listen, 0))
    view = view_of((3.5, 3.6, 3.5), 3.0, size=(40, 30, 1500.0))
    frame = frame_of(view, np.array([[3.5, 3.6, 3.5]]), np.zeros((30, 40), dtype=np.uint32))
    values = {"noise": "full", "gain_e_per_dn": 3.0, "dsnu_e": 4.0, "read_noise_e": 12.0, "adc_noise_dn": 2.0}
    with pytest.raises(EstimationFailure, match="enough was heard"):
        huynh2016_with("huynh2016:denoise=anscombe").estimate(
            replace(frame, sensor=frame.sensor.model_copy(update=values))
        )
    assert told == pytest.approx([np.sqrt(16 + 144 + 36 + 0.75)])
