"""Flicker: the modulation of light at each frequency against the limits of IEEE Std 1789-2015.

The standard limits the modulation of light at a frequency f, 100 (max - min) / (max + min) percent: low risk up to
0.025 f below 90 Hz and 0.08 f from there to 1250 Hz, no observable effect up to 0.01 f below 90 Hz and 0.0333 f from
there to 3000 Hz, f in hertz; no limit above. The standard was not at hand: the numbers are those of its section 8.1 as
two public programs state them. Here each line of a wave's spectrum, a sine about the mean, is held against the limits
on its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.modulation.keys import Send
from vlcrender.modulation.transmission import Transmitter, nominal_waves
from vlcrender.modulation.wave import Wave

Array = NDArray[np.float64]

STEP_HZ = 90.0
LOW_RISK_END_HZ = 1250.0
NO_EFFECT_END_HZ = 3000.0


def low_risk_percent(frequency_hz: Array) -> Array:
    """Largest modulation of low risk at each frequency, percent; infinite above 1250 Hz."""
    return _limit(frequency_hz, 0.025, 0.08, LOW_RISK_END_HZ)


def no_effect_percent(frequency_hz: Array) -> Array:
    """Largest modulation without observable effect at each frequency, percent; infinite above 3000 Hz."""
    return _limit(frequency_hz, 0.01, 0.0333, NO_EFFECT_END_HZ)


def _limit(frequency_hz: Array, below: float, above: float, end_hz: float) -> Array:
    limit = np.where(frequency_hz < STEP_HZ, below, above) * frequency_hz
    # the end belongs to the range: a wave that repeats at 1250 Hz is limited, whatever the rounding of its period
    return np.where(frequency_hz > end_hz * (1 + 1e-9), np.inf, limit)


def spectrum(wave: Wave, end_hz: float = NO_EFFECT_END_HZ) -> tuple[Array, Array]:
    """Frequencies of a wave's lines up to an end, Hz, and the modulation of each, amplitude over mean in percent.

    At least the line at the repetition rate is returned.
    """
    count = max(1, int(end_hz * wave.period_s * (1 + 1e-9)))
    return np.arange(1, count + 1) / wave.period_s, 200 * np.abs(wave.harmonics(count))


@dataclass(frozen=True)
class Line:
    """A line of a spectrum beside a limit."""

    frequency_hz: float
    percent: float
    """Modulation."""
    limit_percent: float
    """Infinite where there is none."""

    @property
    def share(self) -> float:
        """Modulation over its limit: above 1 exceeds it."""
        return self.percent / self.limit_percent


@dataclass(frozen=True)
class Flicker:
    """The lines of a wave that are nearest to the limits, or farthest beyond."""

    low_risk: Line
    no_effect: Line


def flicker(wave: Wave) -> Flicker:
    """How much a wave flickers."""
    frequencies, percents = spectrum(wave)
    lines = []
    for limits in (low_risk_percent(frequencies), no_effect_percent(frequencies)):
        worst = int(np.argmax(percents / limits))
        lines.append(Line(float(frequencies[worst]), float(percents[worst]), float(limits[worst])))
    return Flicker(*lines)


@dataclass(frozen=True)
class FlickerOfWaves:
    """Flicker of all LEDs of a scene with the same kind of wave."""

    send: Send
    where: str
    """The first table of the scene file with this wave, such as "panels[0]"."""
    leds: int
    worst: Flicker
    """The largest share of each limit, not always of the same LED."""
    low_risk_exceeded: int
    """LEDs beyond the limit of low risk."""
    no_effect_exceeded: int


def flicker_of(transmitters: Sequence[Transmitter]) -> tuple[FlickerOfWaves, ...]:
    """Flicker of a scene by kind of wave, in the order of the transmitters; steady light is left out."""
    waves = nominal_waves(transmitters)
    members: dict[Send, list[Transmitter]] = {}
    for transmitter in transmitters:
        if transmitter.downlink is not None and transmitter.modulated:
            members.setdefault(transmitter.downlink.send, []).append(transmitter)
    known: dict[Wave, Flicker] = {}
    found = []
    for send, own in members.items():
        flickers = [_known(waves[led], known) for transmitter in own for led in transmitter.led_ids]
        low, none = [one.low_risk for one in flickers], [one.no_effect for one in flickers]
        worst = Flicker(max(low, key=lambda line: line.share), max(none, key=lambda line: line.share))
        exceeded = [sum(line.share > 1 for line in lines) for lines in (low, none)]
        found.append(FlickerOfWaves(send, own[0].where, len(flickers), worst, exceeded[0], exceeded[1]))
    return tuple(found)


def _known(wave: Wave, known: dict[Wave, Flicker]) -> Flicker:
    """The flicker of a wave, by its shape: the phase does not matter."""
    wave = wave.started(0.0, 0.0)
    if wave not in known:
        known[wave] = flicker(wave)
    return known[wave]


ADVICE: Mapping[Send, str] = {
    "code": "shorten chip_us or code_length, or lower depth",
    "packet": "shorten chip_us, or lower depth",
    "tone": "raise first_hz or frequency_hz, or lower depth",
    "pwm": "raise frequency_hz, or lower depth",
    "mains": "lower depth",
}
"""What to change in a scene whose light flickers too much."""


def flicker_warning(found: Sequence[FlickerOfWaves]) -> str | None:
    """One line about the kind of wave that is farthest beyond the limit of low risk; None where all are within it."""
    beyond = [one for one in found if one.low_risk_exceeded]
    if not beyond:
        return None
    worst = max(beyond, key=lambda one: one.worst.low_risk.share)
    line = worst.worst.low_risk
    return (
        f"{worst.where}.downlink: {worst.low_risk_exceeded} of {worst.leds} LEDs flicker beyond the low risk of IEEE "
        f"1789, up to {line.share:.2f} times: {line.percent:.3g} % at {line.frequency_hz:.4g} Hz, where "
        f"{line.limit_percent:.3g} % is allowed; {ADVICE[worst.send]}"
    )
