"""Stated standard errors of photon transfer against the scatter of repeated measurements, one quantity at a time.

A score is the deviation from the truth over the stated error. Over n repeats its mean has the standard error
1 / sqrt(n) and its spread 1 / sqrt(2 n), where the error is right; five of each are allowed.
"""

from collections.abc import Iterable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr
from test_datasheet import numpy_camera

from vlcrender.core.quantity import Quantity
from vlcrender.emva1288.photon_transfer import (
    Point,
    fit_gain,
    fit_responsivity,
    linearity,
    measure,
    take_pair,
)
from vlcrender.sensor.nonuniformity import Patterns, patterns, response_variance

REPEATS = 200
FIVE_OF_SPREAD = 5 / np.sqrt(2 * REPEATS)
"""0.25: an error too small by a factor of the root of 2 is found."""


def assert_errors_are_stated(found: Iterable[Quantity], truth: float) -> None:
    scores = np.array([(quantity.value - truth) / quantity.error for quantity in found])
    assert abs(scores.mean()) < 5 / np.sqrt(len(scores))
    assert abs(scores.std(ddof=1) - 1) < 5 / np.sqrt(2 * len(scores))


def pair(rng: np.random.Generator, gain: float, electrons: float, dark_e: float = 0.0, side: int = 16) -> Point:
    """Two exposures of a camera with this gain (DN/e), mean and dark noise; the black level is 1000 DN."""

    def shoot(*_: float) -> NDArray[np.uint32]:
        signal = rng.poisson(electrons, (side, side)) + dark_e * rng.standard_normal((side, side))
        return np.rint(1000 + gain * signal).astype(np.uint32)

    return take_pair(shoot, electrons / 0.5)


@pytest.mark.parametrize(("gain", "electrons"), [(0.5, 400.0), (20.0, 0.1)])
def test_the_variance_of_a_pair_errs_as_stated(rng: np.random.Generator, gain: float, electrons: float) -> None:
    """Of bright light nearly normal; of faint light the fourth cumulant, K^4 mu, makes 5 of 7 parts of the error's
    square: K^4 mu / 2 beside 2 (K^2 mu)^2.

    Rounding adds 1/12 DN^2 to the first; the second's numbers are whole.
    """
    points = [pair(rng, gain, electrons, side=32) for _ in range(REPEATS)]
    truth = gain**2 * electrons + (1 / 12 if gain < 1 else 0.0)
    assert_errors_are_stated([point.variance(gain**4 * electrons) for point in points], truth)
    assert_errors_are_stated([point.mean for point in points], 1000 + gain * electrons)


def test_the_gain_errs_as_stated(rng: np.random.Generator) -> None:
    """Dark noise of 30 e, of which the error is in all points alike, makes half of the gain's error."""
    found = []
    for _ in range(REPEATS):
        dark, *points = (pair(rng, 0.5, electrons, dark_e=30.0) for electrons in range(0, 700, 100))
        found.append(fit_gain(dark, points))
    assert_errors_are_stated(found, 0.5)


def test_the_gain_is_fitted_up_to_70_percent_of_saturation() -> None:
    """EMVA 1288, 6.6: near saturation the brightest pixels are full, and the variance falls off its line."""
    found = measure(numpy_camera(0, side=32))
    saturation = found.signals_dn[found.saturation_index]
    used = [point for point, signal in zip(found.points, found.signals_dn, strict=True) if signal <= 0.7 * saturation]
    assert found.gain == fit_gain(found.dark, used)
    assert 0.65 * saturation < used[-1].mean_dn - found.dark.mean_dn <= 0.7 * saturation


@pytest.mark.parametrize(("prnu", "dark_e"), [(0.2, 0.0), (0.0, 60.0)])
def test_the_responsivity_errs_as_stated(rng: np.random.Generator, prnu: float, dark_e: float) -> None:
    """0.25 DN per photon. With PRNU, the mean response of these pixels; without, the noise of the dark mean."""
    found = []
    for _ in range(REPEATS):
        response = 1 + prnu * rng.standard_normal((16, 16))
        dark = pair(rng, 0.5, 0.0, dark_e)
        points = [pair(rng, 0.5, electrons * response, dark_e) for electrons in (100.0, 200.0, 300.0)]
        points = [Point(200.0 * n, p.exposure_s, p.mean_dn, p.variance_dn2, p.pixels) for n, p in enumerate(points, 1)]
        bright = patterns(np.rint(1000 + 0.5 * rng.poisson(300 * response)).astype(np.uint32) for _ in range(4))
        found.append(fit_responsivity(dark, points, bright))
    assert_errors_are_stated(found, 0.25)


def stack(rng: np.random.Generator, pattern: NDArray[np.float64], noise: float, frames: int = 4) -> Patterns:
    return patterns(
        np.rint(pattern + noise * rng.standard_normal(pattern.shape)).astype(np.uint32) for _ in range(frames)
    )


def test_variances_of_rows_columns_and_pixels_err_as_stated(rng: np.random.Generator) -> None:
    """Of 60 rows and 80 columns. A variance of 59 degrees of freedom is known to 18 %, which is also how well its own
    error is known: the deviation over it is spread by 1 + 3 / 59 rather than 1, within what is allowed.
    """
    found = []
    for _ in range(REPEATS):
        rows, columns = 3 * rng.standard_normal((60, 1)), 2 * rng.standard_normal(80)
        found.append(stack(rng, 500 + rows + columns + 4 * rng.standard_normal((60, 80)), 4.0))
    for variances, truth in (
        ([p.row for p in found], 9.0),
        ([p.column for p in found], 4.0),
        ([p.pixel for p in found], 16.0),
    ):
        scores = np.array([(quantity.value - truth) / quantity.error for quantity in variances])
        assert abs(scores.std(ddof=1) - 1) < FIVE_OF_SPREAD
    means = np.array([(p.mean_dn - 500) / p.mean_error for p in found])
    assert abs(means.mean()) < 5 / np.sqrt(REPEATS)
    assert abs(means.std(ddof=1) - 1) < FIVE_OF_SPREAD


@pytest.mark.parametrize(
    ("response", "offset", "noise_bright", "noise_dark"),
    [
        (30.0, 0.0, 2.0, 2.0),  # 2 A^4
        (10.0, 30.0, 2.0, 2.0),  # 4 A^2 B^2
        (5.0, 30.0, 20.0, 2.0),  # 4 (A^2 + B^2) N1^2
        (0.0, 30.0, 2.0, 20.0),  # 4 B^2 N0^2
        (0.0, 0.0, 20.0, 2.0),  # 2 N1^4
        (0.0, 0.0, 2.0, 20.0),  # 2 N0^4
    ],
    ids=["A4", "A2B2", "A2B2N1", "B2N0", "N1", "N0"],
)
def test_the_response_variance_errs_as_stated(
    rng: np.random.Generator, response: float, offset: float, noise_bright: float, noise_dark: float
) -> None:
    """Each term of the stated error in turn makes most of it. Signal 1000 DN, 40 x 40 pixels, 4 frames."""
    found = []
    for _ in range(REPEATS):
        fixed = 1000 + offset * rng.standard_normal((40, 40))
        light = 1000 + response * rng.standard_normal((40, 40))
        found.append(response_variance(stack(rng, fixed, noise_dark), stack(rng, fixed + light, noise_bright)))
    assert_errors_are_stated(found, (response / 1000) ** 2)


def test_the_linearity_error_of_a_linear_camera_errs_as_stated(rng: np.random.Generator) -> None:
    """50 means with normal errors of 0.5 %, 46 of them in the range.

    The line takes up 2 of 46 degrees of freedom, so that the mean deviation is smaller than stated by 1 / 46 of it: of
    sqrt(2 / pi) = 0.8 errors, where its own error is sqrt(1 - 2 / pi) / sqrt(46) = 0.09 errors. That is 0.2 of its own.
    """
    photons = np.arange(1, 51) * 100.0
    found = []
    for _ in range(REPEATS):
        points = [
            # The mean of two pixels: its squared error is half of their variance.
            Point(p, 0.01, float(1000 + p * (1 + 0.005 * rng.standard_normal())), 2 * (0.005 * p) ** 2, 1)
            for p in photons
        ]
        deviation, noise = linearity(Point(0.0, 0.01, 1000.0, 1.0, 10**9), points)
        found.append((deviation.value - noise) / deviation.error)
    assert abs(np.mean(found) + 0.2) < 5 / np.sqrt(REPEATS)
    assert abs(np.std(found, ddof=1) - 1) < FIVE_OF_SPREAD


def test_light_levels_are_50_even_steps_to_where_the_noise_collapses() -> None:
    """EMVA 1288: 50 levels or more. The last has half of the largest variance, as nine halvings of the light find it.

    Within 5 % of the light the variance falls from nearly its maximum to half, so by 4 % of it in the last step, 0.3 %
    of the light. Variances of 1024 pairs are known to sqrt(2 / 1024), 4.4 %: five of both errors.
    """
    found = measure(numpy_camera(3, side=32))
    photons = np.array([point.photons for point in found.points])
    assert photons == pytest.approx(np.arange(1, 51) / 50 * photons[-1], rel=1e-12)
    assert [point.photons for point in found.faint] == [2.0**n for n in range(len(found.faint))]
    assert found.faint[-1].photons < photons[-1]
    largest = found.points[found.saturation_index].variance_dn2
    assert found.points[-1].variance_dn2 / largest == pytest.approx(0.5, abs=0.04 + 5 * 0.044 * np.hypot(1, 0.5))


@pytest.mark.parametrize("sigma", [0.45, 0.55])
def test_rounding_errs_at_most_by_the_stated_limits(sigma: float) -> None:
    """Mean and variance of rounded normal numbers, exactly, over all places m between two integers.

    Their largest deviations from m and s^2 + 1/12 are the limits, of which an error that is uniform within them is
    1 / sqrt(3). The limits are first terms of series; the next are smaller by exp(-6 pi^2 s^2) < 1e-5, and the square
    of the mean's deviation, exp(-4 pi^2 s^2) / pi^2, is 0.2 % of the variance's limit at most.
    """
    m = np.linspace(0, 1, 1001)[:, None]
    k = np.arange(-10, 12)
    share = ndtr((k + 0.5 - m) / sigma) - ndtr((k - 0.5 - m) / sigma)
    mean = share @ k
    variance = (share * (k - mean[:, None]) ** 2).sum(axis=1)
    point = Point(0.0, 0.01, 0.0, sigma**2 + 1 / 12, 10**15)
    assert np.sqrt(3) * point.mean.error == pytest.approx(np.abs(mean - m[:, 0]).max(), rel=1e-4)
    assert np.sqrt(3) * point.variance().error == pytest.approx(np.abs(variance - sigma**2 - 1 / 12).max(), rel=5e-3)


def test_rounding_hides_noise_of_less_than_half_a_number() -> None:
    """Without dither the mean errs by up to 1/2 and the variance by up to 1/4, uniform."""
    point = Point(0.0, 0.01, 0.0, 0.2, 10**15)
    assert np.sqrt(3) * point.mean.error == pytest.approx(0.5)
    assert np.sqrt(3) * point.variance().error == pytest.approx(0.25)


@pytest.mark.parametrize("sigma", [0.15, 0.2, 0.25])
def test_a_pattern_under_noise_that_does_not_dither_errs_within_its_stated_error(
    sigma: float, rng: np.random.Generator
) -> None:
    """Offsets of 0.5 DN under noise of a fifth of a digital number.

    The mean of rounded numbers is off by up to exp(-2 pi^2 s^2) / pi, with the place of the pixel between two numbers:
    a pattern of variance exp(-4 pi^2 s^2) / (2 pi^2), 0.010 DN^2 at 0.2 DN, where sampling errs by 0.002 DN^2. It adds
    to the pattern itself as a bias, so that two stated errors cover it; the error stays below a quarter of the pattern.
    """
    offsets = 500 + 0.5 * rng.standard_normal((200, 200))
    found = stack(rng, offsets, sigma, frames=64).pixel
    assert abs(found.value - 0.25) < 2 * found.error
    assert found.error < 0.25 / 4


def test_the_linearity_error_counts_from_the_dark_level() -> None:
    """Signals 100, 220, 300, 380 (30, 70, 100, 130 photons) above a dark level of 50; the last, 1000, is beyond 95 %.

    The line that minimises relative deviations, by numpy's least squares on rows divided by their signal.
    """
    dark = Point(0.0, 1e-3, 50.0, 1.0, 10_000)
    photons, signals = np.array([30.0, 70.0, 100.0, 130.0]), np.array([100.0, 220.0, 300.0, 380.0])
    points = [Point(p, 1e-3, 50.0 + s, 1.0, 10_000) for p, s in zip([*photons, 400.0], [*signals, 1000.0], strict=True)]
    rows = np.stack([np.ones(4), photons], axis=1) / signals[:, None]
    line = np.linalg.lstsq(rows, np.ones(4), rcond=None)[0]
    found, _ = linearity(dark, points)
    assert found.value == pytest.approx(np.abs(1 / (rows @ line) - 1).mean(), rel=1e-9)
    assert found.value > 1e-3
