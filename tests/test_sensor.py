"""The sensor's statistics: Poisson electrons, Skellam differences, and the boundary cases of the ADC."""

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import stats

from vlcrender.core.random_keys import stream
from vlcrender.sensor.poisson import MAX_MEAN
from vlcrender.sensor.sensor import MAX_WELL_E, Sensor, clip_full_well
from vlcrender.sensor.signal_chain import expose

N = 400_000
MEANS = [0.2, 3.0, 40.0, 3000.0]
WIDE = Sensor(full_well_e=MAX_WELL_E, gain_e_per_dn=1.0)


def draw(mean: float, name: str) -> np.ndarray:
    """N digital numbers of a wide-open sensor at 1 e/DN: electrons."""
    return expose(WIDE, np.full((400, N // 400), mean, dtype=np.float32), name, exposure_s=0.0).ravel().astype(np.int64)


def chi_square_p(sample: np.ndarray, distribution: stats.rv_discrete) -> float:
    """Goodness of fit over the integers, tails pooled so that each class expects 20 or more."""
    low, high = (int(distribution.ppf(q)) for q in (25 / len(sample), 1 - 25 / len(sample)))
    edges = np.arange(low, high + 1)
    step = max(1, len(edges) // 200)
    edges = edges[::step]
    cdf = distribution.cdf(edges)
    expected = len(sample) * np.diff(np.concatenate([[0.0], cdf, [1.0]]))
    observed = np.bincount(np.searchsorted(edges, sample), minlength=len(edges) + 1)
    keep = expected > 5
    return float(stats.chisquare(observed[keep], expected[keep] * observed[keep].sum() / expected[keep].sum()).pvalue)


@pytest.mark.parametrize("mean", MEANS)
def test_mean_and_variance_are_both_lambda(mean: float) -> None:
    sample = draw(mean, "moments")
    # se(mean) = sqrt(lambda/n); Var(s^2) = (2 lambda^2 + lambda)/n for Poisson. 5 sigma.
    assert abs(sample.mean() - mean) < 5 * np.sqrt(mean / N)
    assert abs(sample.var(ddof=1) - mean) < 5 * np.sqrt((2 * mean**2 + mean) / N)


@pytest.mark.parametrize("mean", MEANS)
def test_electrons_are_poisson(mean: float) -> None:
    # one in 10 000 true samples would fail
    assert chi_square_p(draw(mean, "poisson"), stats.poisson(mean)) > 1e-4


@pytest.mark.parametrize("mean", MEANS)
def test_the_difference_of_two_exposures_is_skellam(mean: float) -> None:
    difference = draw(mean, "first") - draw(mean, "second")
    assert chi_square_p(difference, stats.skellam(mean, mean)) > 1e-4
    # Var(s^2_D) = 2 mu / n + 2 (2 mu)^2 / (n - 1)
    assert abs(difference.var(ddof=1) - 2 * mean) < 5 * np.sqrt(2 * mean / N + 2 * (2 * mean) ** 2 / (N - 1))


@pytest.mark.parametrize("mean", [0.2, 3.0])
def test_the_same_test_rejects_gaussian_noise(mean: float, rng: np.random.Generator) -> None:
    gaussian = np.rint(mean + np.sqrt(mean) * rng.standard_normal(N)).astype(np.int64)
    assert chi_square_p(gaussian, stats.poisson(mean)) < 1e-10


def test_neighbouring_pixels_are_independent() -> None:
    sample = draw(40.0, "neighbours").astype(float)
    correlation = np.corrcoef(sample[:-1], sample[1:])[0, 1]
    assert abs(correlation) < 5 / np.sqrt(N)


def test_without_noise_the_expected_image_is_rounded() -> None:
    sensor = Sensor(noise="none")
    image = expose(sensor, np.array([[0.0, 0.49, 0.51, 1.5, 2.5, 99.7]], dtype=np.float32), "x", exposure_s=0.0)
    assert image.tolist() == [[0, 0, 1, 2, 2, 100]]  # halves go to the even number, as IEEE 754 rounds
    assert image.dtype == np.uint32


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_the_adc_saturates_at_its_largest_number(bits: int) -> None:
    sensor = Sensor(bits=bits, gain_e_per_dn=2.0, full_well_e=1e6, black_level_dn=16)
    full = 2.0 * (2**bits - 1 - 16)
    electrons = np.array([0.0, 1.9, full - 2, full, full + 500])
    assert sensor.quantise(electrons).tolist() == [16, 17, 2**bits - 2, 2**bits - 1, 2**bits - 1]


def test_full_well_clips_electrons_before_gain() -> None:
    assert clip_full_well(np.array([0.0, 5999.0, 6000.0, 1e6]), 6000.0).tolist() == [0, 5999, 6000, 6000]
    assert expose(
        Sensor(full_well_e=100.0, gain_e_per_dn=0.5, noise="none"),
        np.array([[1000.0]], dtype=np.float32),
        "x",
        exposure_s=0.0,
    ).tolist() == [[200]]


def test_the_largest_full_well_is_the_largest_mean_of_the_draws() -> None:
    assert MAX_WELL_E == MAX_MEAN
    sensor = Sensor(full_well_e=MAX_WELL_E, gain_e_per_dn=1000.0, bits=14)
    assert (
        expose(sensor, np.full((2, 2), 1e12, dtype=np.float32), "x", exposure_s=0.0) >= (MAX_WELL_E - 1e4) / 1000
    ).all()
    with pytest.raises(ValidationError, match="full_well_e"):
        Sensor(full_well_e=2 * MAX_WELL_E)


def test_streams_share_nothing_between_neighbouring_seeds_frames_and_names() -> None:
    keys = [(7, 0, "a"), (8, 0, "a"), (7, 1, "a"), (7, 0, "b"), (70, 0, "a")]
    samples = np.stack([stream(*key).standard_normal(N) for key in keys])
    correlations = np.corrcoef(samples)[np.triu_indices(len(keys), 1)]
    assert np.abs(correlations).max() < 5 / np.sqrt(N)


def test_a_stream_is_the_same_every_time() -> None:
    assert np.array_equal(stream(2**62, 5, "a").integers(0, 2**60, 10), stream(2**62, 5, "a").integers(0, 2**60, 10))
