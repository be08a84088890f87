"""Codes: every code and phase is compared with a signal, by matched filters, and the best one is taken if it is clear.

The model of the level of line i is `a + b g_i`, where `g_i` is the mean of a code's chips over the line's exposure; a
and b > 0 are free. The weighted correlation r of levels and gains then orders the hypotheses, and 1 - r^2 is a
hypothesis' misfit. Error of the transmitter's clock within one LED image is neglected: a thousandth of 1 ms is 1 us.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.io.downlink import Codes, Downlink
from estimator.receiver.signal import ChipWave, Ints, Signal, folded, overlaps

MIN_CORRELATION = 0.9
MIN_MISFIT_RATIO = 1.5
"""The misfit of the best code of another LED has to be this many times the best one's."""
MIN_MISFIT_DIFFERENCE = 0.01
"""... and larger by this much: levels that are 2 % of the bright ones off (`signal.ENVELOPE_SHARE`) leave a misfit of
some 0.002 by themselves. Short images, which show a part of a code, may fit two codes nearly exactly. Over the poses of
office200, wrong codes were better than the right one by up to 0.003 (docs/measure_downlink.py identities)."""
MIN_MISFIT = 1e-12
MIN_LINES = 8
CLOCK_SIGMAS = 3.0
PHASES = 4
"""Phases within a chip that are tried for every code; those of the best codes are refined."""
REFINED = 6
REFINED_PHASES = 7
PHASE_STEP_CHIPS = 2e-3
CONSTANT = 1e-4
"""Variance of gains, of chips 0 and 1, below which a code counts as constant over the lines."""

Singles = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class CodeMatch:
    """The code that fits a signal best: its LED, correlation, and its wave.

    `misfit_ratio` is the misfit of the best code of another LED over its own, `misfit_difference` that less its own.
    """

    led: int
    correlation: float
    misfit_ratio: float
    misfit_difference: float
    wave: ChipWave

    @property
    def clear(self) -> bool:
        """Whether the LED is taken as identified."""
        told_apart = self.misfit_ratio >= MIN_MISFIT_RATIO and self.misfit_difference >= MIN_MISFIT_DIFFERENCE
        return self.correlation >= MIN_CORRELATION and told_apart


class CodeBook:
    """Codes of one chip duration and length, ready for comparison."""

    def __init__(self, chip_s: float, transmitters: Sequence[Codes]) -> None:
        """Make the book of transmitters whose chips are `chip_s` long; their codes have one length."""
        self.chip_s = chip_s
        self.leds = np.array([led for one in transmitters for led in one.leds], dtype=np.int64)
        self.depths = np.array([one.depth for one in transmitters for _ in one.leds])
        self.chips: Ints = np.array(
            [list(map(int, code)) for one in transmitters for code in one.codes], dtype=np.int64
        )
        self.length = self.chips.shape[1]
        self._products: dict[int, Singles] = {}

    def _product(self, lag: int) -> Singles:
        """Chips times those `lag` later, (codes, length)."""
        if lag not in self._products:
            self._products[lag] = (self.chips * np.roll(self.chips, -lag, axis=1)).astype(np.float32)
        return self._products[lag]

    def correlations(self, signal: Signal) -> Singles:
        """Correlation with each code at each phase, (codes, length PHASES): phase p starts p / PHASES chips late.

        A code that is constant over the lines has the correlation -1.
        """
        w = signal.weight / signal.weight.sum()
        spread = float(np.sqrt(w @ signal.centred**2))
        # An exposure meets chips up to so many apart; each pair of places in the period counts once.
        reach = min(int(np.ceil(signal.exposure_s / self.chip_s)), self.length // 2)
        # Circulant filters (length, length PHASES) of: levels, weights, and products of chips at each lag.
        filters = np.zeros((3 + reach, self.length, self.length, PHASES), dtype=np.float32)
        turned = (np.arange(self.length)[:, None] - np.arange(self.length)) % self.length
        for part in range(PHASES):
            shares = folded(overlaps(signal, self.chip_s, part / PHASES), self.length)
            weighted = shares * w[:, None]
            gram = weighted.T @ shares
            filters[0, :, :, part] = (signal.centred @ weighted)[turned] / (spread or 1.0)
            filters[1, :, :, part] = weighted.sum(axis=0)[turned]
            place = np.arange(self.length)
            for lag in range(reach + 1):
                times = 1 if lag in (0, self.length / 2) else 2
                filters[2 + lag, :, :, part] = times * gram[place, (place + lag) % self.length][turned]
        flat = filters.reshape(len(filters), self.length, -1)
        product = self._product(0) @ flat[0]
        variance = -np.square(self._product(0) @ flat[1])
        for lag in range(reach + 1):
            variance += self._product(lag) @ flat[2 + lag]
        found = product / np.sqrt(np.maximum(variance, CONSTANT))
        return np.where(variance > CONSTANT, found, -1).astype(np.float32)

    def wave(self, row: int, phase: float, at_s: float) -> ChipWave:
        """Wave of a code of the book that is `phase` chips into its period at the time `at_s`."""
        return ChipWave(self.chips[row], self.chip_s, float(self.depths[row]), at_s, phase % self.length)

    def at_first(self, misfit: Singles, later_s: float, clock_error: float) -> Singles:
        """Misfits (codes, phases) by the phase that a signal `later_s` before had: the least that the clock allows."""
        later, slack = self._later(later_s, clock_error)
        reach = min(int(np.ceil(slack * PHASES)), misfit.shape[1] // 2)
        start = round(later * PHASES)
        tried = [np.roll(misfit, -(start + shift), axis=1) for shift in range(-reach, reach + 1)]
        return np.asarray(np.min(tried, axis=0), dtype=np.float32)

    def near(self, signal: Signal, row: int, phase: float, first: Signal, clock_error: float) -> CodeMatch:
        """Match of one code with a signal, near the phase that it had at the first line of another one."""
        later, slack = self._later(float(signal.start_s[0] - first.start_s[0]), clock_error)
        steps = int(np.ceil(slack * PHASES))
        tried = phase + later + np.arange(-steps, steps + 1) / PHASES
        found = [self.refined(signal, row, one) for one in tried]
        best, correlation = max(found, key=lambda one: one[1])
        return CodeMatch(int(self.leds[row]), correlation, 1.0, 0.0, self.wave(row, best, float(signal.start_s[0])))

    def _later(self, later_s: float, clock_error: float) -> tuple[float, float]:
        """Chips that pass in a time, modulo the length, and by how many more or less by the clock's error."""
        chips = later_s / self.chip_s
        return chips % self.length, CLOCK_SIGMAS * clock_error * abs(chips)

    def refined(self, signal: Signal, row: int, phase: float) -> tuple[float, float]:
        """Phase near `phase`, chips, at which a code fits best, and its correlation there."""
        at_s, step = float(signal.start_s[0]), 1.0 / PHASES
        correlation = -1.0
        while step > PHASE_STEP_CHIPS:
            tried = phase + step * np.linspace(-1, 1, REFINED_PHASES)
            found = [
                signal.correlation(self.wave(row, one, at_s).gains(signal.start_s, signal.exposure_s)) for one in tried
            ]
            best = int(np.argmax(found))
            phase, correlation, step = float(tried[best]), found[best], step * 2 / (REFINED_PHASES - 1)
        return phase % self.length, correlation


def code_books(downlink: Downlink) -> tuple[CodeBook, ...]:
    """Code books of a downlink, one for each chip duration and length."""
    kinds: dict[tuple[float, int], list[Codes]] = {}
    for one in downlink.transmitters:
        if isinstance(one, Codes):
            kinds.setdefault((one.chip_us, len(one.codes[0])), []).append(one)
    return tuple(CodeBook(chip_us * 1e-6, some) for (chip_us, _), some in kinds.items())


def match_code_of_frames(
    signals: Sequence[Signal], books: Sequence[CodeBook], clock_error: float
) -> list[CodeMatch | None]:
    """The LED whose code fits the signals of one LED in the frames of a burst best, as a match for each signal.

    The phase goes on from frame to frame by their times, within CLOCK_SIGMAS standard deviations of the clock's
    relative error. Correlation and misfits are those of all lines; levels are free in each frame. None where nothing is
    found.
    """
    used = [signal for signal in signals if len(signal) >= MIN_LINES and signal.centred.any()]
    if not used:
        return [None] * len(signals)
    power = [float(signal.weight @ signal.centred**2) for signal in used]
    found: list[tuple[float, int, list[CodeMatch]]] = []
    for book in books:
        misfit = np.zeros((len(book.leds), book.length * PHASES), dtype=np.float32)
        for signal, of_signal in zip(used, power, strict=True):
            explained = np.square(np.maximum(book.correlations(signal), 0))
            unexplained = (of_signal * (1 - explained)).astype(np.float32)
            misfit = misfit + book.at_first(unexplained, float(signal.start_s[0] - used[0].start_s[0]), clock_error)
        phases = misfit.argmin(axis=1)
        best = np.take_along_axis(misfit, phases[:, None], axis=1)[:, 0]
        for row in np.argsort(best)[:REFINED].tolist():
            matches = [book.near(signal, row, phases[row] / PHASES, used[0], clock_error) for signal in used]
            left = sum(p * (1 - max(one.correlation, 0.0) ** 2) for p, one in zip(power, matches, strict=True))
            found.append((left / sum(power), int(book.leds[row]), matches))
    found.sort(key=lambda one: one[0])
    misfit_of, led, matches = found[0]
    second = min((one[0] for one in found if one[1] != led), default=1.0)
    ratio = second / max(misfit_of, MIN_MISFIT)
    joint = float(np.sqrt(max(1 - misfit_of, 0.0)))
    of_signal_number = iter(
        [replace(one, correlation=joint, misfit_ratio=ratio, misfit_difference=second - misfit_of) for one in matches]
    )
    return [next(of_signal_number) if any(signal is one for one in used) else None for signal in signals]


def match_phase(signal: Signal, book: CodeBook, led: int) -> CodeMatch | None:
    """The phase of the code that an LED of the book is known to send; its rivals are the other phases of that code.

    None for a signal of few lines or without stripes, as with `match_code`.
    """
    if len(signal) < MIN_LINES or not signal.centred.any():
        return None
    row = int(np.flatnonzero(book.leds == led)[0])
    correlations = book.correlations(signal)[row]
    best = int(correlations.argmax())
    # The correlation of phases less than a chip from the best is that of the best one.
    rivals = np.roll(np.arange(len(correlations)), -best)[PHASES : 1 - PHASES]
    second = int(rivals[correlations[rivals].argmax()])
    (phase, correlation), (_, rival) = (book.refined(signal, row, one / PHASES) for one in (best, second))
    misfits = [max(1 - max(one, 0.0) ** 2, MIN_MISFIT) for one in (rival, correlation)]
    wave = book.wave(row, phase, float(signal.start_s[0]))
    return CodeMatch(led, correlation, misfits[0] / misfits[1], misfits[0] - misfits[1], wave)


def match_code(signal: Signal, books: Sequence[CodeBook]) -> CodeMatch | None:
    """The LED whose code fits a signal best; None for a signal of few lines or without stripes."""
    if len(signal) < MIN_LINES or not signal.centred.any():
        return None
    found: list[tuple[float, int, CodeBook, int, float]] = []
    for book in books:
        correlations = book.correlations(signal)
        phases = correlations.argmax(axis=1)
        best = np.take_along_axis(correlations, phases[:, None], axis=1)[:, 0]
        for row in np.argsort(-best)[:REFINED].tolist():
            phase, correlation = book.refined(signal, row, phases[row] / PHASES)
            found.append((correlation, int(book.leds[row]), book, row, phase))
    if not found:
        return None
    found.sort(key=lambda one: -one[0])
    correlation, led, book, row, phase = found[0]
    second = max((one[0] for one in found if one[1] != led), default=0.0)
    misfits = [max(1 - max(one, 0.0) ** 2, MIN_MISFIT) for one in (second, correlation)]
    wave = book.wave(row, phase, float(signal.start_s[0]))
    return CodeMatch(led, correlation, misfits[0] / misfits[1], misfits[0] - misfits[1], wave)
