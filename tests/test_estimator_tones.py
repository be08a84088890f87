"""Tones: frequencies of square waves in the levels of lines, and whose they are."""

import json

import numpy as np
import pytest
from striped_images import Array, gains

from estimator.io.downlink import Downlink
from estimator.receiver.signal import Signal
from estimator.receiver.tones import (
    ToneFit,
    band_hz,
    envelope_of,
    fit_tone,
    match_tone,
    match_tones,
    readout_axis,
)

ROW_S, EXPOSURE_S = 10e-6, 40e-6
BAND = 1000.0, 8000.0


def signal(
    frequency_hz: float, lines: int, rng: np.random.Generator, share: float = 0.02, bell: bool = False
) -> Signal:
    """Levels of a tone with noise of `share` of the level; `bell`: of a lamp whose luminance falls off by 20 times."""
    start = np.arange(lines) * ROW_S + 0.01 * rng.random()
    wave = gains(np.array([1.0, 0.0]), 0.5e6 / frequency_hz, 1e6 * start, 1e6 * EXPOSURE_S)
    y = np.linspace(-1, 1, lines)
    envelope = 1000 * (np.exp(-3 * y**2) if bell else np.ones(lines))
    level = envelope * wave * (1 + share * rng.standard_normal(lines)) + 3 * rng.standard_normal(lines)
    return Signal(start, EXPOSURE_S, level, 1 / ((share * envelope) ** 2 + 9.0))


@pytest.mark.parametrize(("lines", "limit_hz"), [(58, 60.0), (120, 30.0)])
def test_a_tone_s_frequency_is_found_within_its_standard_deviation(lines: int, limit_hz: float) -> None:
    """The stated deviation is of 0.03 periods over the image, 50 Hz for 58 lines of 10 us, and of the noise."""
    rng = np.random.default_rng(1)
    off, scaled = [], []
    for frequency in rng.uniform(1700, 6500, 30).tolist():
        fit = fit_tone(signal(frequency, lines, rng), BAND)
        assert fit is not None
        assert fit.clear
        off.append(abs(fit.frequency_hz - frequency))
        scaled.append((fit.frequency_hz - frequency) / fit.sigma_hz)
    assert np.median(off) < limit_hz
    assert np.abs(scaled).max() < 4


def test_the_falling_luminance_of_a_lamp_does_not_bias_a_low_tone() -> None:
    rng = np.random.default_rng(2)
    off = []
    for frequency in (2000.0, 2500.0, 3000.0) * 4:
        one = signal(frequency, 110, rng, bell=True)
        fit = fit_tone(one, BAND, envelope=envelope_of(one, 60))
        assert fit is not None
        off.append(fit.frequency_hz - frequency)
    # 0.03 periods of an image of 1.1 ms.
    assert np.abs(np.mean(off)) < 30


def test_steady_light_noise_and_the_border_of_the_band_are_no_tones() -> None:
    rng = np.random.default_rng(3)
    start = np.arange(80) * ROW_S
    noise = Signal(start, EXPOSURE_S, 1000 + 30 * rng.standard_normal(80), np.full(80, 1 / 900))
    assert fit_tone(Signal(start, EXPOSURE_S, np.full(80, 7.0), np.ones(80)), BAND) is None
    for fit in (fit_tone(noise, BAND), fit_tone(signal(7900.0, 80, rng), (1000.0, 7000.0))):
        assert fit is None or not fit.clear
    assert fit_tone(signal(3000.0, 8, rng), BAND) is None


def fitted(frequency_hz: float, sigma_hz: float = 20.0, share: float = 0.9) -> ToneFit:
    return ToneFit(frequency_hz, sigma_hz, 0.0, share, 0.1, 4.0, False, np.zeros(1))


@pytest.mark.parametrize(
    ("fit", "leds"),
    [
        pytest.param(fitted(2030.0), (7,), id="near"),
        pytest.param(fitted(2990.0), (8, 9), id="two of a frequency"),
        pytest.param(fitted(2090.0), None, id="beyond the standard deviation"),
        pytest.param(fitted(2400.0, 200.0), None, id="between two"),
        pytest.param(fitted(2000.0, share=0.4), None, id="too little of the energy"),
    ],
)
def test_a_frequency_is_an_led_s_where_no_other_is_near(fit: ToneFit, leds: tuple[int, ...] | None) -> None:
    match = match_tone(fit, {7: 2000.0, 8: 3000.0, 9: 3000.0})
    assert (match and match.leds) == leds


def test_no_led_of_28_tones_is_taken_for_another() -> None:
    """120 lines: a distance of 200 Hz between tones is 0.24 periods, eight standard deviations of the model."""
    rng = np.random.default_rng(4)
    frequencies = (1500 + 200 * np.arange(28)).tolist()
    tones = {"send": "tone", "duty": 0.5, "depth": 1.0, "clock_error": 1e-4}
    downlink = Downlink.model_validate_json(
        json.dumps(
            {
                "demodulation": "pixels",
                "transmitters": [{**tones, "leds": list(range(28)), "frequencies_hz": frequencies}],
            }
        )
    )
    sent = list(range(0, 28, 2))
    matches = match_tones([signal(frequencies[k], 120, rng) for k in sent], downlink, ROW_S)
    identified = [match.leds for match in matches if match is not None]
    assert all(match is None or match.leds == (k,) for k, match in zip(sent, matches, strict=True))
    assert len(identified) >= 0.8 * len(sent)


def test_the_readout_axis_is_the_one_with_the_gradients() -> None:
    y, x = np.mgrid[-40:40, -40:40]
    glow = np.exp(-(x**2 + y**2) / 400.0)
    striped: Array = glow * (y // 6 % 2)
    assert readout_axis(striped.astype(np.float32))[0] == "rows"
    assert readout_axis(striped.T.astype(np.float32))[0] == "columns"
    assert readout_axis(striped.astype(np.float32))[1] > 5


def test_the_band_is_what_an_image_can_show() -> None:
    assert band_hz(20e-6, 60e-6, 50) == pytest.approx((900.0, 15000.0))


def test_noise_adds_to_the_standard_deviation_of_a_frequency_what_the_slopes_of_the_wave_say() -> None:
    """Beside the model's 0.03 periods, as by least squares on seven parameters, whose slopes are differences here.

    The fit takes the noise from what is left of 120 lines, of which a variance is known to sqrt(2 / 113): five times.
    """
    count, frequency, noise, rng = 120, 3000.0, 200.0, np.random.default_rng(7)
    start, y = np.arange(count) * ROW_S, np.linspace(-1, 1, count)

    def wave(hz: float, late_s: float) -> Array:
        return gains(np.array([1.0, 0.0]), 0.5e6 / hz, 1e6 * (start + late_s), 1e6 * EXPOSURE_S)

    bright = wave(frequency, 0.0)
    by_hz = (wave(frequency + 0.1, 0.0) - wave(frequency - 0.1, 0.0)) / 0.2
    by_s = (wave(frequency, 1e-8) - wave(frequency, -1e-8)) / 2e-8
    level = 1000 * bright
    slopes = np.stack([1000 * by_hz, 1000 * by_s, np.ones(count), y, bright, bright * y, bright * y**2], axis=1)
    expected_hz2 = noise**2 * np.linalg.inv(slopes.T @ slopes)[0, 0]
    fit = fit_tone(Signal(start, EXPOSURE_S, level + noise * rng.standard_normal(count), np.ones(count)), BAND)
    assert fit is not None
    of_model_hz = 0.03 / (start[-1] + EXPOSURE_S)
    assert fit.sigma_hz**2 - of_model_hz**2 == pytest.approx(expected_hz2, rel=5 * np.sqrt(2 / 113))
