"""The full EMVA 1288 chain: each term alone, fixed patterns, and independence of threads and regions."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose, expose_regions, variance_e2

ROWS, COLUMNS = 500, 800
N = ROWS * COLUMNS
FINE = {"noise": "full", "bits": 14, "gain_e_per_dn": 0.25, "full_well_e": 4e6}
"""A quarter electron a digital number: rounding adds (1/4)^2 / 12 = 0.0052 e2 to a variance."""
ROUNDING_E2 = 0.25**2 / 12
BLACK = 4000
EVERYTHING = Sensor(
    noise="full",
    prnu=0.02,
    dark_current_e_s=500.0,
    dsnu_e=2.0,
    read_noise_e=3.0,
    adc_noise_dn=0.5,
    row_offset_e=1.5,
    column_offset_e=1.0,
    black_level_dn=64,
    iso=200.0,
)


def exposed(sensor: Sensor, mean: float, key: str = "a", exposure_s: float = 0.0, camera: str = "main") -> np.ndarray:
    """Electrons above the black level, (ROWS, COLUMNS)."""
    image = expose(sensor, np.full((ROWS, COLUMNS), mean, dtype=np.float32), key, exposure_s=exposure_s, camera=camera)
    assert image.max() < sensor.largest_dn, "the ADC must not clip the measured values"
    return (image.astype(float) - sensor.black_level_dn) * sensor.gain_at_iso_e_per_dn


@pytest.mark.parametrize("gain", [0.5, 1.0, 2.0, 4.0])
def test_the_full_chain_without_noise_terms_is_shot_noise_alone(gain: float) -> None:
    """Halves included, which go to the even number before the black level is added."""
    means = np.linspace(0, 7000, N, dtype=np.float32).reshape(ROWS, COLUMNS)
    shot, full = (Sensor(noise=noise, gain_e_per_dn=gain, black_level_dn=63) for noise in ("shot", "full"))
    assert np.array_equal(*(expose(sensor, means, "a", exposure_s=0.1) for sensor in (full, shot)))


# Variance of the variance of n normal numbers: 2 sigma^4 / (n - 1); of Poisson numbers (2 mu^2 + mu) / n. Five sigma.


@pytest.mark.parametrize("sigma", [0.5, 3.0, 20.0])
def test_read_noise_is_normal_and_new_in_every_frame(sigma: float) -> None:
    sensor = Sensor(**FINE, read_noise_e=sigma, black_level_dn=BLACK)
    first, second = exposed(sensor, 0.0, "a").ravel(), exposed(sensor, 0.0, "b").ravel()
    assert abs(first.mean()) < 5 * np.sqrt((sigma**2 + ROUNDING_E2) / N)
    expected = sigma**2 + ROUNDING_E2
    assert abs(first.var(ddof=1) - expected) < 5 * np.sqrt(2 / N) * expected
    z = first / np.sqrt(expected)
    # Third and fourth moments of a normal law: variances 15 and 96 over n. Rounding changes the fourth by
    # (gain / sigma)^4 / 120 at the most, 5e-4 for a sigma of two steps; 5 sigma are 0.08.
    assert abs((z**3).mean()) < 5 * np.sqrt(15 / N)
    assert abs((z**4).mean() - 3) < 5 * np.sqrt(96 / N)
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(N)


@pytest.mark.slow
def test_prnu_spreads_the_mean_and_not_the_electrons() -> None:
    """Temporal variance of a pixel of response 1 + p is (1 + p) mu; multiplied electrons would have (1 + p)^2 mu."""
    mu, prnu = 400.0, 0.1
    sensor = Sensor(**FINE, prnu=prnu)
    frames = [exposed(sensor, mu, f"frame {i}") for i in range(40)]
    mean = np.mean(frames, axis=0)
    # The variance of 40-frame means over pixels: PRNU's (prnu mu)^2 plus shot noise mu / 40 and rounding.
    expected = (prnu * mu) ** 2 + (mu + ROUNDING_E2) / 40
    assert abs(mean.var() - expected) < 5 * np.sqrt(2 / N) * expected
    temporal = np.var(frames, axis=0, ddof=1)
    # Slope of temporal variance over the pixel's mean: 1 for ours. The responses are known but for shot noise, which
    # by regression dilution takes (mu / 40) / (prnu mu)^2 = 0.6 % off; but the noise of a Poisson sample's variance
    # goes along with that of its mean (covariance: third central moment mu over n), which puts the same back.
    # Of N pixels: sd 2 mu^2 / 39 each, over the spread of means.
    se = np.sqrt(2 * mu**2 / 39 / N) / (prnu * mu)
    slope = np.polyfit(mean.ravel(), temporal.ravel(), 1)[0]
    assert abs(slope - 1) < 5 * se
    assert abs(slope - 2) > 5 * se, "the slope of multiplied electrons, d (1 + p)^2 / d p"


@pytest.mark.parametrize(("celsius", "times"), [(25.0, 1.0), (32.0, 2.0), (18.0, 0.5), (46.0, 8.0)])
def test_dark_current_grows_with_time_and_doubles_with_temperature(celsius: float, times: float) -> None:
    sensor = Sensor(**FINE, dark_current_e_s=30.0, dark_current_doubling_c=7.0, temperature_c=celsius)
    for exposure_s in (0.5, 4.0):
        dark = exposed(sensor, 0.0, f"{celsius} {exposure_s}", exposure_s)
        mean = 30.0 * times * exposure_s
        assert abs(dark.mean() - mean) < 5 * np.sqrt(mean / N)
        assert abs(dark.var(ddof=1) - mean) < 5 * np.sqrt((2 * mean**2 + mean) / N), "with shot noise of its own"


def test_light_and_dark_current_are_one_poisson_draw() -> None:
    sensor = Sensor(**FINE, dark_current_e_s=100.0)
    electrons = exposed(sensor, 50.0, "both", 0.1)
    mean = 60.0
    assert abs(electrons.mean() - mean) < 5 * np.sqrt(mean / N)
    assert abs(electrons.var(ddof=1) - mean) < 5 * np.sqrt((2 * mean**2 + mean) / N)
    assert np.array_equal(electrons, np.rint(electrons)), "counts"


def test_dsnu_is_a_pattern_that_frames_share() -> None:
    sensor = Sensor(**FINE, dsnu_e=40.0, black_level_dn=BLACK)
    first, second = exposed(sensor, 0.0, "a"), exposed(sensor, 0.0, "b", 2.0)
    assert np.array_equal(first, second)
    expected = 40.0**2 + ROUNDING_E2
    assert abs(first.mean()) < 5 * np.sqrt(expected / N)
    assert abs(first.var(ddof=1) - expected) < 5 * np.sqrt(2 / N) * expected
    # Steps of 1/160 sigma move the distribution function by half a step, 0.4 / 320; what is allowed here is 0.016.
    assert stats.kstest(first.ravel()[:20000] / 40.0, "norm").pvalue > 1e-4


@pytest.mark.parametrize(("key", "axis", "lines"), [("row_offset_e", 1, ROWS), ("column_offset_e", 0, COLUMNS)])
def test_offsets_are_those_of_whole_rows_and_columns(key: str, axis: int, lines: int) -> None:
    image = exposed(Sensor(**FINE, **{key: 6.0}, black_level_dn=BLACK), 0.0)
    assert not np.ptp(image, axis=axis).any()
    offsets = image.mean(axis=axis)
    assert abs(np.corrcoef(offsets[:-1], offsets[1:])[0, 1]) < 5 / np.sqrt(lines)
    expected = 6.0**2 + ROUNDING_E2
    assert abs(offsets.var(ddof=1) - expected) < 5 * np.sqrt(2 / lines) * expected


def test_the_well_clips_before_read_noise_is_added() -> None:
    """Behind the clip read noise is whole; clipping after it would halve the distribution and its variance."""
    sensor = Sensor(**{**FINE, "full_well_e": 500.0}, read_noise_e=4.0)
    image = exposed(sensor, 1000.0)  # 22 sigma above the well
    expected = 4.0**2 + ROUNDING_E2
    assert abs(image.mean() - 500) < 5 * np.sqrt(expected / N)
    assert abs(image.var(ddof=1) - expected) < 5 * np.sqrt(2 / N) * expected


@pytest.mark.parametrize("iso", [50.0, 100.0, 800.0])
def test_noise_after_the_gain_falls_with_iso_in_electrons(iso: float) -> None:
    sensor = Sensor(noise="full", gain_e_per_dn=4.0, iso=iso, bits=14, black_level_dn=200, adc_noise_dn=3.0)
    image = expose(sensor, np.zeros((ROWS, COLUMNS), dtype=np.float32), f"{iso}", exposure_s=0.0).astype(float)
    expected = 3.0**2 + 1 / 12
    assert abs(image.var(ddof=1) - expected) < 5 * np.sqrt(2 / N) * expected, "the same in digital numbers"
    assert sensor.dark_noise_e == pytest.approx(3.0 * 4.0 * 100 / iso)


def test_twice_the_iso_is_twice_the_numbers() -> None:
    for iso in (100.0, 200.0):
        image = expose(
            Sensor(noise="full", iso=iso), np.full((ROWS, COLUMNS), 1000, dtype=np.float32), "iso", exposure_s=0.0
        )
        dn_per_e = iso / 100
        assert abs(image.mean() - 1000 * dn_per_e) < 5 * dn_per_e * np.sqrt(1000 / N)
        expected = dn_per_e**2 * 1000
        assert abs(image.astype(float).var(ddof=1) - expected) < 5 * dn_per_e**2 * np.sqrt((2e6 + 1000) / N)


@pytest.mark.parametrize("bits", [8, 10, 12, 14])
def test_black_level_and_both_limits_of_the_adc(bits: int) -> None:
    sensor = Sensor(noise="full", bits=bits, full_well_e=1e5, black_level_dn=20, read_noise_e=40.0, gain_e_per_dn=2.0)
    dark = expose(sensor, np.zeros((ROWS, COLUMNS), dtype=np.float32), "dark", exposure_s=0.0).astype(float)
    # Read noise has 20 DN: 0 DN takes all below -1 sigma but half a step, and what is above the black level is whole.
    assert dark.min() == 0
    share = stats.norm.cdf(-19.5 / 20)
    assert abs((dark == 0).mean() - share) < 5 * np.sqrt(share / N)
    share = stats.norm.cdf(-0.5 / 20)
    assert abs((dark > 20).mean() - share) < 5 * np.sqrt(share / N)
    bright = expose(sensor, np.full((10, 10), 9e4, dtype=np.float32), "bright", exposure_s=0.0)
    assert (bright == 2**bits - 1).all()


def test_the_predicted_variance_is_the_sample_variance() -> None:
    """Over individual sensors with unknown patterns; one pixel per row and column, since these share offsets."""
    mean = 800.0
    sensors = [EVERYTHING.model_copy(update={"serial": serial}) for serial in range(200)]
    roi = np.full((40, 40), mean, dtype=np.float32)
    diagonal = [
        np.diag(expose(sensor, roi, f"frame {sensor.serial}", exposure_s=0.2)).astype(float) for sensor in sensors
    ]
    electrons = (np.concatenate(diagonal) - 64) * EVERYTHING.gain_at_iso_e_per_dn
    expected = float(variance_e2(EVERYTHING, roi, 0.2)[0, 0])
    n = len(electrons)
    assert abs(electrons.mean() - (mean + 100)) < 5 * np.sqrt(expected / n)
    assert abs(electrons.var(ddof=1) - expected) < 5 * np.sqrt(2 / n) * expected  # nearly normal: excess 1 / 800
    assert np.isinf(variance_e2(EVERYTHING, np.full((1, 1), 5950, dtype=np.float32), 0.2)).all()


@pytest.mark.parametrize(
    ("term", "mean", "lines"),
    [
        ({"prnu": 0.2}, 200.0, 0),
        ({"dark_current_e_s": 50.0}, 0.0, 0),
        ({"dsnu_e": 5.0}, 0.0, 0),
        ({"read_noise_e": 5.0}, 0.0, 0),
        ({"adc_noise_dn": 8.0}, 0.0, 0),
        ({"row_offset_e": 5.0}, 0.0, ROWS // 4),
        ({"column_offset_e": 5.0}, 0.0, COLUMNS // 4),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_binned_sensor_has_the_noise_of_the_sums(term: dict[str, float], mean: float, lines: int) -> None:
    fine = Sensor(**FINE, **term, black_level_dn=2000, serial=1)
    sums = exposed(fine, mean, "fine", 2.0).reshape(ROWS // 4, 4, COLUMNS // 4, 4).sum(axis=(1, 3))
    small = fine.binned(4)
    binned = exposed(small, 16 * mean, "binned", 2.0)
    n = lines or sums.size  # offsets: as many draws as lines
    expected = float(variance_e2(small, np.full((1, 1), 16 * mean, dtype=np.float32), 2.0)[0, 0])
    # The sums are of finer numbers, of whose rounding there is less: both variances, 5 sigma each.
    for sample, rounding in ((sums, 16 * ROUNDING_E2), (binned, 256 * ROUNDING_E2)):
        v = expected - 256 * ROUNDING_E2 + rounding
        assert abs(sample.var() - v) < 5 * np.sqrt(2 / (n - 1)) * v
        assert abs(sample.mean() - 16 * mean - small.dark_electrons(2.0)) < 5 * np.sqrt(v / n)
    assert small.white_dn == fine.white_dn


def patterns(serial: int, camera: str = "main") -> np.ndarray:
    """The fixed pattern of an individual sensor: offsets in electrons."""
    sensor = Sensor(**FINE, dsnu_e=10.0, prnu=0.3, black_level_dn=BLACK, serial=serial)
    return exposed(sensor, 0.0, "any", camera=camera)


def test_patterns_are_an_individuals_own() -> None:
    first = patterns(7).ravel()
    assert np.array_equal(first, patterns(7).ravel())
    for other in (patterns(8), patterns(70), patterns(7, "left")):
        assert abs(np.corrcoef(first, other.ravel())[0, 1]) < 4 / np.sqrt(N)


def test_the_two_patterns_of_a_pixel_are_independent() -> None:
    offset = patterns(3).ravel()
    response = exposed(Sensor(**FINE, prnu=0.3, serial=3), 1000.0).ravel()
    expected = (0.3 * 1000) ** 2 + 1000  # the response and shot noise
    assert abs(response.var(ddof=1) - expected) < 5 * np.sqrt(2 / N) * expected
    assert abs(np.corrcoef(offset, response)[0, 1]) < 4 / np.sqrt(N)


@pytest.mark.parametrize("sensor", [Sensor(), EVERYTHING], ids=["shot", "full"])
def test_neighbouring_seeds_and_frames_share_nothing(sensor: Sensor) -> None:
    """Frames without the fixed patterns, which they share, are uncorrelated."""
    means = np.full((ROWS, COLUMNS), 300.0, dtype=np.float32)
    keys = ["2016/0/shot-noise", "2017/0/shot-noise", "2016/1/shot-noise", "20160/0/shot-noise"]
    shown = sensor if sensor.noise == "shot" else sensor.model_copy(update={"prnu": 0, "dsnu_e": 0})
    shown = shown.model_copy(update={"row_offset_e": 0, "column_offset_e": 0})
    frames = [expose(shown, means, key, exposure_s=0.0).astype(float).ravel() for key in keys]
    correlations = np.corrcoef(frames)[np.triu_indices(len(keys), 1)]
    assert np.abs(correlations).max() < 4 / np.sqrt(N)
    if sensor.noise == "full":  # as differences of frames take them out too
        left = [
            expose(sensor, means, key, exposure_s=0.0).astype(float).ravel() for key in (*keys, "2018/0/shot-noise")
        ]
        differences = [left[0] - left[1], left[2] - left[3]]
        # PRNU stays in the draws' variances: a difference's variance follows the pixel's mean, its sign does not.
        assert abs(np.corrcoef(differences)[0, 1]) < 4 / np.sqrt(N)


def test_a_region_gets_the_noise_of_the_whole_frame(rng: np.random.Generator) -> None:
    means = rng.uniform(0, 3000, (60, 80)).astype(np.float32)
    frame = expose(EVERYTHING, means, "frame", exposure_s=0.1)
    part = expose(EVERYTHING, means[20:31, 5:70], "frame", 20, 5, exposure_s=0.1)
    assert np.array_equal(part, frame[20:31, 5:70])
    beyond = expose(EVERYTHING, np.pad(means, 7, mode="edge"), "frame", -7, -7, exposure_s=0.1)
    assert np.array_equal(beyond[7:-7, 7:-7], frame)


@pytest.mark.parametrize("noise", ["full", "shot", "none"])
def test_several_regions_get_the_noise_of_the_whole_frame(rng: np.random.Generator, noise: str) -> None:
    sensor = EVERYTHING.model_copy(update={"noise": noise})
    means = rng.uniform(0, 3000, (60, 80)).astype(np.float32)
    frame = RegionImage(Roi(0, 0, 60, 80), expose(sensor, means, "frame", exposure_s=0.1))
    rois = [Roi(20, 5, 11, 65), Roi(2, 3, 1, 2), Roi(40, 70, 20, 10)]
    parts = [RegionImage(roi, means[frame.roi.slices(roi)]) for roi in rois]
    exposed = expose_regions(sensor, parts, "frame", exposure_s=0.1)
    assert [roi for roi, _ in exposed] == rois
    for roi, image in exposed:
        assert np.array_equal(image, frame.image[frame.roi.slices(roi)])


@pytest.mark.slow
def test_threads_make_no_difference(tmp_path: Path) -> None:
    """One thread, two, and all, each in a process of its own."""
    code = (
        "import sys, numpy as np; from test_signal_chain import EVERYTHING; from vlcrender.core.backend import dr; "
        "from vlcrender.sensor.signal_chain import expose; dr.set_thread_count(int(sys.argv[1])); "
        "means = np.linspace(0, 4000, 120000, dtype=np.float32).reshape(300, 400); "
        "np.save(sys.argv[2], expose(EVERYTHING, means, 'key', exposure_s=0.1))"
    )
    for threads in (1, 2):
        command = [sys.executable, "-c", code, str(threads), str(tmp_path / f"{threads}.npy")]
        subprocess.run(command, cwd=Path(__file__).parent, env=dict(os.environ), check=True)
    means = np.linspace(0, 4000, 120000, dtype=np.float32).reshape(300, 400)
    for threads in (1, 2):
        image = np.load(tmp_path / f"{threads}.npy")
        assert np.array_equal(image, expose(EVERYTHING, means, "key", exposure_s=0.1))


@pytest.mark.parametrize("mean", [-1.0, np.nan])
def test_impossible_means_are_refused(mean: float) -> None:
    with pytest.raises(ValueError, match="are allowed"):
        expose(EVERYTHING, np.array([[1.0, mean]], dtype=np.float32), "bad", exposure_s=0.0)


def test_a_full_pixel_shows_no_dsnu() -> None:
    """DSNU is part of the collected charge, which the well clips: 40 e of it leave a pixel 100 sigma above the well."""
    sensor = Sensor(**{**FINE, "full_well_e": 500.0}, dsnu_e=5.0)
    image = exposed(sensor, 3000.0)
    assert (image == 500).all()


def test_dark_current_does_not_follow_the_pixels_response() -> None:
    """PRNU is a spread of quantum efficiency: electrons of the dark current need no photon."""
    plain, uneven = Sensor(**FINE, dark_current_e_s=1000.0), Sensor(**FINE, dark_current_e_s=1000.0, prnu=0.3)
    assert np.array_equal(exposed(plain, 0.0, exposure_s=0.5), exposed(uneven, 0.0, exposure_s=0.5))


def test_read_noise_is_independent_of_the_shot_noise_of_its_pixel() -> None:
    """The same exposure with and without read noise: the difference is the read noise itself, to a quarter electron.

    Correlations of n independent pairs have the standard error 1 / sqrt(n), also of the squares.
    """
    for mean in (2.0, 60.0):
        quiet, noisy = (
            exposed(Sensor(**FINE, black_level_dn=BLACK, read_noise_e=sigma), mean).ravel() for sigma in (0.0, 20.0)
        )
        shot, read = quiet - mean, noisy - quiet
        for a, b in ((shot, read), (shot, read**2), (shot**2, read), (shot**2, read**2)):
            assert abs(np.corrcoef(a, b)[0, 1]) < 5 / np.sqrt(N)


def test_the_offsets_of_rows_and_columns_are_drawn_apart() -> None:
    """The corner pixel belongs to row 0 and column 0: over sensors, its two offsets are uncorrelated.

    A correlation of n independent pairs has the standard error 1 / sqrt(n).
    """
    corners = [
        [
            float(
                expose(
                    Sensor(**FINE, **{key: 50.0}, black_level_dn=BLACK, serial=serial),
                    np.zeros((1, 1), dtype=np.float32),
                    "corner",
                    exposure_s=0.0,
                )[0, 0]
            )
            for serial in range(100)
        ]
        for key in ("row_offset_e", "column_offset_e")
    ]
    assert np.std(corners, axis=1).min() > 50  # a row's and a column's offsets do differ between sensors, 200 DN
    assert abs(np.corrcoef(corners)[0, 1]) < 5 / np.sqrt(100)


@pytest.mark.parametrize(("well_e", "limit_e"), [(3000.0, 3000.0), (1e5, 2 * (4095 - 1000))])
def test_a_pixel_saturates_at_the_well_or_at_the_adc_above_the_black_level(well_e: float, limit_e: float) -> None:
    """At `saturation_e` the number is at its limit, at 4 e (2 DN) less it is below."""
    sensor = Sensor(noise="none", gain_e_per_dn=2.0, full_well_e=well_e, black_level_dn=1000)
    assert sensor.saturation_e == limit_e
    below, at, above = expose(
        sensor, np.array([[limit_e - 4, limit_e, limit_e + 500]], dtype=np.float32), "x", exposure_s=0.0
    )[0]
    assert below + 2 == at == above == sensor.white_dn
    variance = variance_e2(sensor, np.array([[limit_e - 1, limit_e]], dtype=np.float32), 0.0)
    assert np.isfinite(variance).tolist() == [[True, False]]


@pytest.mark.parametrize(
    ("term", "added_e2"),
    [
        ({}, 0.0),
        ({"prnu": 0.1}, 10.0**2),
        ({"dark_current_e_s": 30.0}, 60.0),
        ({"dsnu_e": 3.0}, 9.0),
        ({"read_noise_e": 4.0}, 16.0),
        ({"adc_noise_dn": 2.0}, 1.0),
        ({"row_offset_e": 5.0}, 25.0),
        ({"column_offset_e": 6.0}, 36.0),
    ],
    ids=lambda value: next(iter(value), "none") if isinstance(value, dict) else "",
)
def test_each_term_adds_its_variance(term: dict[str, float], added_e2: float) -> None:
    """A mean of 100 e for 2 s at half an electron a digital number: 100 + (1/2)^2 / 12 by photons and rounding.

    Exact in float64, to rounding.
    """
    sensor = Sensor(noise="full", gain_e_per_dn=0.5, **term)
    variance = variance_e2(sensor, np.full((1, 1), 100.0, dtype=np.float32), 2.0)
    assert variance[0, 0] == pytest.approx(100 + 0.25 / 12 + added_e2, rel=1e-12)
    counts = sensor.model_copy(update={"noise": "shot", "gain_e_per_dn": 1.0})
    assert variance_e2(counts, np.full((1, 1), 100.0, dtype=np.float32), 2.0)[0, 0] == 100


def test_the_same_exposure_has_the_same_numbers_in_every_version() -> None:
    """Pinned numbers hold the signs, the order and the keys that no law of the noise tells apart.

    If they change, so does every dataset: raise DATA_VERSION (dataset/format/schema.py), so that no unfinished
    set goes on with other bits.
    """
    means = np.array([[0, 1, 5, 20, 300, 1500], [0, 2, 9, 40, 800, 1200]], dtype=np.float32)
    numbers = {
        "shot": [[0, 3, 2, 16, 305, 1456], [0, 3, 8, 28, 784, 1202]],
        "full": [[184, 159, 185, 198, 796, 3080], [149, 190, 164, 208, 1695, 2611]],
    }
    for sensor in (Sensor(), EVERYTHING):
        found = expose(sensor, means, "2016/7/shot-noise", 30, 40, exposure_s=0.1)
        assert found.tolist() == numbers[sensor.noise]
