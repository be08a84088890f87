"""Counter-based Poisson draws: the law at every mean, and draws of a pixel independent of its neighbours."""

import numpy as np
import pytest
from scipy import stats
from test_sensor import chi_square_p

from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.sensor.poisson import MAX_MEAN, _log_probability, poisson

N = 1_000_000
MEANS = [0.05, 0.2, 1.0, 9.9, 10.0, 12.0, 40.0, 3000.0, 20000.0, 300000.0]


def draw(mean: float, key: str) -> np.ndarray:
    return poisson(np.full((1000, N // 1000), mean, dtype=np.float32), key).ravel().astype(np.int64)


@pytest.mark.parametrize("mean", MEANS)
def test_counts_are_poisson(mean: float) -> None:
    sample = draw(mean, "law")
    mean = float(np.float32(mean))
    # one in 10 000 true samples would fail
    assert chi_square_p(sample, stats.poisson(mean)) > 1e-4
    # se(mean) = sqrt(lambda/n); Var(s^2) = (2 lambda^2 + lambda)/n. 5 sigma.
    assert abs(sample.mean() - mean) < 5 * np.sqrt(mean / N)
    assert abs(sample.var(ddof=1) - mean) < 5 * np.sqrt((2 * mean**2 + mean) / N)


@pytest.mark.parametrize("mean", [0.2, 12.0, 3000.0])
def test_third_and_fourth_cumulants_are_lambda_too(mean: float) -> None:
    """Of standardised draws: skewness 1/sqrt(lambda), excess kurtosis 1/lambda."""
    z = (draw(mean, "cumulants") - mean) / np.sqrt(mean)
    # Variances of the sample's third and fourth moments from the law's own moments up to the eighth.
    moments = [float(stats.poisson(mean).expect(lambda k, p=p: ((k - mean) / np.sqrt(mean)) ** p)) for p in range(9)]
    for p in (3, 4):
        se = np.sqrt((moments[2 * p] - moments[p] ** 2) / N)
        assert abs((z**p).mean() - moments[p]) < 5 * se


def test_a_mean_of_zero_draws_zero() -> None:
    assert not poisson(np.zeros((10, 100), dtype=np.float32), "dark").any()


def test_a_region_gets_the_draws_of_the_whole_frame(rng: np.random.Generator) -> None:
    means = rng.uniform(0, 100, (60, 80)).astype(np.float32)
    frame = poisson(means, "frame")
    assert np.array_equal(poisson(means[20:31, 5:70], "frame", 20, 5), frame[20:31, 5:70])
    # independent of the means of other pixels
    others = np.where(np.arange(60)[:, None] < 30, means, np.float32(7.0))
    assert np.array_equal(poisson(others, "frame")[:30], frame[:30])


def test_pixels_beyond_the_sensor_have_draws_of_their_own() -> None:
    padded = poisson(np.full((40, 40), 1000.0, dtype=np.float32), "beyond", -20, -20)
    assert np.array_equal(padded[20:, 20:], poisson(np.full((20, 20), 1000.0, dtype=np.float32), "beyond"))
    rows = padded.astype(float)
    assert np.abs(np.corrcoef(rows) - np.eye(40)).max() < 0.75  # 5 / sqrt(40): no row is another's
    assert len({row.tobytes() for row in padded}) == 40


def test_streams_are_independent() -> None:
    first, second = draw(40.0, "one"), draw(40.0, "two")
    for other in (second, np.roll(first, 1), np.roll(first, 4)):
        assert abs(np.corrcoef(first, other)[0, 1]) < 5 / np.sqrt(N)


@pytest.mark.parametrize("mean", [-1.0, np.nan, np.inf, 2 * MAX_MEAN])
def test_other_means_are_refused(mean: float) -> None:
    with pytest.raises(ValueError, match="are allowed"):
        poisson(np.array([[1.0, mean]], dtype=np.float32), "bad")


def test_the_log_probability_is_that_of_the_poisson_law() -> None:
    """Against SciPy in float64, within 8 standard deviations of the mean, for counts of 1 and more.

    Stirling's series ends at k^-5 / 1260, so it errs by its next term, k^-7 / 1680, at most. Each of some 10
    operations in float32 rounds by 6e-8 of numbers up to k + mu; the deviance cancels in |x| >= 0.1 and the logarithm
    of 2 pi k is below 17.
    """
    for mu in (10.0, 11.7, 25.0, 100.0, 900.0, 3e4, 4e6):
        low, high = max(1, int(mu - 8 * np.sqrt(mu))), int(mu + 8 * np.sqrt(mu))
        k = np.unique(np.linspace(low, high, 500).astype(int))
        with exact_math():
            means = dr.full(mi.Float, np.float32(mu), len(k))
            found = _log_probability(mi.Float(k.astype(np.float32)), means).numpy()
        expected = stats.poisson(float(np.float32(mu))).logpmf(k)
        x = np.abs(k - mu) / (k + mu)
        size = np.where(x >= 0.1, k + mu, 17 + np.abs(expected))
        assert (np.abs(found - expected) <= k**-7.0 / 1680 + 10 * 6e-8 * size).all()
    with exact_math():
        assert float(_log_probability(mi.Float(0.0), mi.Float(12.5))[0]) == -12.5
