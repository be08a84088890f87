"""Tones: the frequency of a square wave from the levels of an LED image by lines, and the LED that sends it.

The model of the level of line i, at y_i along the LED image, is
`e_i (a_0 + a_1 y_i + (b_0 + b_1 y_i + b_2 y_i^2) g_i(f, phase))`, where g_i is the mean of a square wave of 0 and 1
over the line's exposure, exactly, and e_i a rough envelope. The polynomials are fitted with the wave: dividing by a
smoothed profile alone would bias low tones. Every frequency of a band is tried at every phase, and the best is refined
by least squares. What stays is compared with the fit without a wave: the share of the stripes' energy that the tone
explains. A frequency at the border of the band, or one that explains less than a half, is none.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.optimize import least_squares

from estimator.io.downlink import Downlink, Tones
from estimator.receiver.signal import Floats, Signal

MIN_SHARE = 0.5
MIN_LINES = 12
# Steps of the trial frequencies, as a share of one period over the LED image; phases of a period that are tried.
FREQUENCY_STEP = 0.08
PHASES = 16
# Trials this near to the band's ends are at its border.
BORDER_STEPS = 1.5
# An LED image with less than this many periods determines no frequency.
MIN_PERIODS = 0.9
# The exposure blurs waves of shorter periods than it: at one period nothing is left of a tone.
MAX_CYCLES_PER_EXPOSURE = 0.9
# Lines a period below which stripes cannot be told.
MIN_LINES_PER_PERIOD = 2.5
# A second frequency further than this from the best, in periods over the LED image, must explain clearly less.
SIDE_LOBE = 0.8
# Standard deviation of a frequency by what the model leaves out, in periods over the LED image. Ours.
MODEL_PERIODS = 0.03
GATE_SIGMA = 4.0
# The frequency of another LED has to be this many times further from the measured one than that of the LED.
CLEARANCE = 2.5


@dataclass(frozen=True, eq=False)
class ToneFit:
    """A square wave in the levels of an LED image.

    `frequency_hz` with its standard deviation `sigma_hz`; `phase` is the part of a period that has passed at the start
    of the first line. `share` is the share of the stripes' energy that the wave explains, `second_share` that of the
    best frequency elsewhere in the band. `periods` lie in the LED image. `at_border` says that the best trial is at the
    end of the band. `level` (n,) is the fitted level of each line.
    """

    frequency_hz: float
    sigma_hz: float
    phase: float
    share: float
    second_share: float
    periods: float
    at_border: bool
    level: Floats

    @property
    def clear(self) -> bool:
        """Whether the frequency is one: within the band, and most of the stripes' energy."""
        return not self.at_border and self.share >= MIN_SHARE and self.periods >= MIN_PERIODS


def band_hz(line_time_s: float, exposure_s: float, lines: int) -> tuple[float, float]:
    """Frequencies that an LED image of so many lines can show: lowest and highest."""
    low = MIN_PERIODS / (lines * line_time_s)
    high = min(1 / (MIN_LINES_PER_PERIOD * line_time_s), MAX_CYCLES_PER_EXPOSURE / exposure_s)
    return low, high


def fit_tone(
    signal: Signal, band: tuple[float, float], duty: float = 0.5, envelope: Floats | None = None
) -> ToneFit | None:
    """The square wave that fits a signal best, of a band of frequencies (lowest, highest), Hz.

    `envelope` (n,) is the level that the lines would have without a wave, roughly; constant by default.

    None for a signal of fewer than MIN_LINES lines, one without stripes, and an empty band.
    """
    count = len(signal)
    if count < MIN_LINES or not signal.centred.any():
        return None
    times = signal.start_s - signal.start_s[0]
    duration = float(times[-1] + signal.exposure_s)
    step_hz = FREQUENCY_STEP / duration
    low, high = max(band[0], step_hz), band[1]
    if not high > low + 2 * BORDER_STEPS * step_hz:
        return None
    y = 2 * times / times[-1] - 1
    root = np.sqrt(signal.weight / signal.weight.mean())
    base = np.ones(count) if envelope is None else envelope
    trend, envelope = np.stack([base, base * y]), np.stack([base, base * y, base * y**2])
    level = signal.level * root
    null = _left(envelope * root, level)
    if null <= 0:
        return None
    frequencies = np.arange(low, high + step_hz / 2, step_hz)
    phases = np.arange(PHASES) / PHASES
    left = np.empty((len(frequencies), PHASES))
    for row, frequency in enumerate(frequencies.tolist()):
        bright = _bright_share(times * frequency + phases[:, None], frequency * signal.exposure_s, duty)
        left[row] = _batch_left(bright, trend, envelope, root, level)
    best_of = left.min(axis=1)
    row = int(best_of.argmin())
    start = np.array([frequencies[row], phases[int(left[row].argmin())]])
    scale = np.array([step_hz, 1.0 / PHASES])

    def residuals(x: Floats) -> Floats:
        frequency, phase = (start + x * scale).tolist()
        bright = _bright_share(times * frequency + phase, frequency * signal.exposure_s, duty)
        return _residuals(np.concatenate([trend, envelope * bright]) * root, level)

    found = least_squares(residuals, np.zeros(2), method="lm", diff_step=[1e-3], max_nfev=120)
    if not (np.abs(found.x[0]) < 2 / FREQUENCY_STEP and 2 * found.cost <= best_of[row] * (1 + 1e-9)):
        found = least_squares(residuals, np.zeros(2), method="trf", bounds=(-3, 3), diff_step=[1e-3], max_nfev=60)
    frequency, phase = (start + found.x * scale).tolist()
    left_over = 2 * float(found.cost)
    freedom = max(count - 7, 1)
    slopes = np.asarray(found.jac, dtype=np.float64)
    try:
        variance = float(np.linalg.inv(slopes.T @ slopes)[0, 0]) * left_over / freedom
    except np.linalg.LinAlgError:
        return None
    away = np.abs(frequencies - frequency) > SIDE_LOBE / duration
    second = 1 - float(best_of[away].min()) / null if away.any() else 0.0
    bright = _bright_share(times * frequency + phase, frequency * signal.exposure_s, duty)
    return ToneFit(
        frequency_hz=frequency,
        sigma_hz=float(np.hypot(np.sqrt(variance) * step_hz, MODEL_PERIODS / duration)),
        phase=float(phase % 1.0),
        share=1 - left_over / null,
        second_share=second,
        periods=frequency * duration,
        at_border=not low + BORDER_STEPS * step_hz <= frequency <= high - BORDER_STEPS * step_hz,
        level=signal.level - residuals(found.x) / root,
    )


def envelope_of(signal: Signal, length: int) -> Floats:
    """Rough envelope (n,) of the stripes: the running maximum over `length` lines and more, smoothed over as many."""
    level = np.maximum(signal.level, 0.0)
    highest = maximum_filter1d(level, length, mode="nearest")
    smooth = gaussian_filter1d(highest, length / 3, mode="nearest")
    return np.asarray(np.maximum(smooth, 1e-3 * level.max()))


def _bright_share(at: Floats, during: float, duty: float) -> Floats:
    """Bright share of exposures that start `at` periods into a wave, of any shape, and last `during` periods."""

    def integral(t: Floats) -> Floats:
        whole = np.floor(t)
        return np.asarray(whole * duty + np.minimum(t - whole, duty))

    return (integral(at + during) - integral(at)) / max(during, 1e-12)


def _residuals(rows: Floats, level: Floats) -> Floats:
    """Residuals (n,) of levels by least squares on rows (k, n)."""
    return np.asarray(level - rows.T @ np.linalg.lstsq(rows.T, level, rcond=None)[0])


def _left(rows: Floats, level: Floats) -> float:
    """Sum of squares that rows (k, n) leave of levels (n,)."""
    return float((_residuals(rows, level) ** 2).sum())


def _batch_left(bright: Floats, trend: Floats, envelope: Floats, root: Floats, level: Floats) -> Floats:
    """Sums of squares (p,) that the model leaves with waves (p, n)."""
    count = len(bright)
    waves = bright[:, None, :] * (envelope * root)
    rows = np.concatenate([np.broadcast_to(trend * root, (count, *trend.shape)), waves], axis=1)
    gram = rows @ rows.transpose(0, 2, 1)
    # A wave that is constant over the lines makes the rows dependent.
    gram += 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(rows.shape[1])
    right = rows @ level
    solution = np.linalg.solve(gram, right[:, :, None])[:, :, 0]
    return np.asarray(np.maximum(level @ level - (solution * right).sum(axis=1), 0.0))


@dataclass(frozen=True, eq=False)
class ToneMatch:
    """LEDs whose tone a signal may hold: `leds` of one nominal frequency, and the fit."""

    leds: tuple[int, ...]
    nominal_hz: float
    fit: ToneFit


def match_tone(
    fit: ToneFit, frequencies_hz: Mapping[int, float], clock_error: float = 0.0, added_sigma_hz: float = 0.0
) -> ToneMatch | None:
    """The LEDs, by id, whose frequency a fitted one is; None where it is none of them, or not clearly one.

    It lies within GATE_SIGMA standard deviations of the fit and of the clocks, relative, and of `added_sigma_hz`, and
    every other frequency is CLEARANCE times further away.
    """
    if not fit.clear or not frequencies_hz:
        return None
    nominal = np.unique(np.array(list(frequencies_hz.values())))
    off = np.abs(nominal - fit.frequency_hz)
    best = int(off.argmin())
    gate = GATE_SIGMA * float(np.sqrt(fit.sigma_hz**2 + (clock_error * nominal[best]) ** 2 + added_sigma_hz**2))
    if off[best] > gate or (np.delete(off, best) < CLEARANCE * off[best]).any():
        return None
    leds = tuple(led for led, frequency in frequencies_hz.items() if frequency == nominal[best])
    return ToneMatch(leds, float(nominal[best]), fit)


def tones_of(downlink: Downlink) -> dict[int, float]:
    """Nominal frequencies of all LEDs that send tones, by id, Hz."""
    return {
        led: frequency
        for one in downlink.transmitters
        if isinstance(one, Tones)
        for led, frequency in zip(one.leds, one.frequencies_hz, strict=True)
    }


def match_tones(signals: Sequence[Signal], downlink: Downlink, line_time_s: float) -> list[ToneMatch | None]:
    """The tone of each signal of a frame, of those that LEDs of the downlink send; None for a signal without."""
    frequencies = tones_of(downlink)
    if not frequencies:
        return [None] * len(signals)
    transmitters = [one for one in downlink.transmitters if isinstance(one, Tones)]
    clock_error = max(one.clock_error for one in transmitters)
    duties = sorted({one.duty for one in transmitters})
    lowest, highest = min(frequencies.values()), max(frequencies.values())
    matches: list[ToneMatch | None] = []
    for signal in signals:
        low, high = band_hz(line_time_s, signal.exposure_s, len(signal))
        band = max(low, 0.7 * lowest), min(high, 1.3 * highest)
        fits = [one for duty in duties if (one := fit_tone(signal, band, duty)) is not None]
        best = max(fits, key=lambda one: one.share, default=None)
        matches.append(None if best is None else match_tone(best, frequencies, clock_error))
    return matches


def readout_axis(image: NDArray[np.float32]) -> tuple[str, float]:
    """What lines of a picture of striped LED images are, "rows" or "columns", and by how many times.

    Stripes have most of their gradients along the readout axis; the outline of a lamp has about as much along both.
    `image` (rows, columns) is a cut-out of LED images. The ratio is that of the energies of the two gradients.
    """
    pixels = image.astype(np.float64)
    down, right = np.diff(pixels, axis=0)[:, :-1], np.diff(pixels, axis=1)[:-1]
    by_rows, by_columns = float((down**2).sum()), float((right**2).sum())
    if by_rows >= by_columns:
        return "rows", by_rows / max(by_columns, 1e-12)
    return "columns", by_columns / max(by_rows, 1e-12)
