"""The law of the noise by chi-square and moments; the same checks fail where noise is missing, doubled or Gaussian."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats
from test_sensor import chi_square_p

from vlcrender.sensor.poisson import poisson
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

N = 400_000
MEANS = [0.2, 1.0, 3.0, 12.0, 300.0, 3000.0, 20_000.0]
SMALL_MEANS = [0.2, 1.0, 3.0]
Sample = np.ndarray


def counts(mean: float, key: str) -> Sample:
    return poisson(np.full((400, N // 400), mean, dtype=np.float32), key).ravel().astype(np.int64)


def follows_poisson(sample: Sample, mean: float) -> bool:
    """Chi-square (one in 10 000 true samples fails) and the moments to the fourth, 5 sigma each."""
    v = mean  # every cumulant is the mean; central moments from them, to the eighth
    moments = [
        *(1.0, 0.0, v, v, 3 * v**2 + v, 10 * v**2 + v, 15 * v**3 + 25 * v**2 + v),
        *(105 * v**3 + 56 * v**2 + v, 105 * v**4 + 490 * v**3 + 119 * v**2 + v),
    ]
    return chi_square_p(sample, stats.poisson(mean)) > 1e-4 and _moments_fit(sample - mean, moments)


def follows_skellam(sample: Sample, mean: float) -> bool:
    """The same for differences of two counts of equal mean: cumulants 2 mu of even order, 0 of odd."""
    v = 2 * mean
    moments = [1.0, 0.0, v, 0.0, 3 * v**2 + v, 0.0, 15 * v**3 + 15 * v**2 + v]
    moments += [0.0, 105 * v**4 + 210 * v**3 + 63 * v**2 + v]
    return chi_square_p(sample, stats.skellam(mean, mean)) > 1e-4 and _moments_fit(sample, moments)


def _moments_fit(centred: Sample, moments: list[float]) -> bool:
    """The mean of x^p has variance (m_2p - m_p^2) / n; for p = 2 that is the Var(s^2) of a known mean."""
    powers = [float((centred.astype(float) ** p).mean()) for p in range(5)]
    errors = [5 * np.sqrt((moments[2 * p] - moments[p] ** 2) / len(centred)) for p in range(5)]
    return all(abs(powers[p] - moments[p]) <= errors[p] for p in range(1, 5))


@pytest.mark.parametrize("mean", MEANS)
def test_counts_are_poisson_and_differences_skellam(mean: float) -> None:
    mean = float(np.float32(mean))
    first, second = counts(mean, "first"), counts(mean, "second")
    assert follows_poisson(first, mean)
    assert follows_skellam(first - second, mean)


def test_the_default_sensor_gives_counts_as_they_are() -> None:
    """Counts are digital numbers below the limits of well and ADC."""
    means = np.linspace(0, 3500, N, dtype=np.float32).reshape(400, -1)
    assert np.array_equal(expose(Sensor(), means, "a", exposure_s=0.0), poisson(means, "a"))


BROKEN: dict[str, Callable[[Sample, float], Sample]] = {
    "missing": lambda sample, mean: np.full_like(sample, round(mean)),
    "doubled": lambda sample, mean: np.rint(mean + 2 * (sample - mean)).astype(np.int64),
    "of twice the variance": lambda sample, mean: np.rint(mean + np.sqrt(2) * (sample - mean)).astype(np.int64),
    "shared by neighbours": lambda sample, mean: np.repeat(sample[::2] + sample[1::2], 2) // 2,
}


@pytest.mark.slow
@pytest.mark.parametrize("mean", MEANS)
@pytest.mark.parametrize("broken", BROKEN)
def test_missing_or_wrong_noise_does_not_pass(broken: str, mean: float) -> None:
    mean = float(np.float32(mean))
    first, second = (BROKEN[broken](counts(mean, key), mean) for key in ("first", "second"))
    assert not follows_poisson(first, mean)
    assert not follows_skellam(first - second, mean)


@pytest.mark.parametrize("mean", SMALL_MEANS)
def test_gaussian_noise_does_not_pass_at_small_means(mean: float, rng: np.random.Generator) -> None:
    first, second = (np.rint(mean + np.sqrt(mean) * rng.standard_normal(N)).astype(np.int64) for _ in range(2))
    assert not follows_poisson(first, mean)
    assert not follows_skellam(first - second, mean)
