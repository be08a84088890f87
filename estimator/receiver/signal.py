"""Signals: the light of an LED image by lines, on the rig's clock, and the wave that is decoded from it."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimator.io.device import DeviceFrame
from estimator.io.shutter import Shutter
from estimator.spots.striped import Lamp

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Error of a line's level that its noise does not include, as a share of the bright lines' level: chord, background,
# vignetting, face. It is the same for all lines: dark ones, of little noise, would else decide alone. Ours.
ENVELOPE_SHARE = 0.02
BRIGHT_PERCENTILE = 90.0


@dataclass(frozen=True, eq=False)
class Signal:
    """Levels of an LED image by lines, in the order of time.

    `start_s` (n,) is the start of each line's exposure on the rig's clock, `exposure_s` its duration, `level` (n,) the
    line's light in any unit, and `weight` (n,) the inverse of its variance.
    """

    start_s: Floats
    exposure_s: float
    level: Floats
    weight: Floats

    def __len__(self) -> int:
        """Number of lines."""
        return len(self.start_s)

    @cached_property
    def centred(self) -> Floats:
        """Levels less their weighted mean, (n,)."""
        return np.asarray(self.level - np.average(self.level, weights=self.weight))

    def correlation(self, gains: Floats) -> float:
        """Weighted correlation of the levels with gains (n,), -1 to 1; 0 if either is constant."""
        other = gains - np.average(gains, weights=self.weight)
        product = float((self.weight * self.centred) @ other)
        size = float((self.weight * self.centred) @ self.centred) * float((self.weight * other) @ other)
        return product / float(np.sqrt(size)) if size > 0 else 0.0

    def scaled(self, factor: float) -> "Signal":
        """The signal with its levels multiplied."""
        return replace(self, level=self.level * factor, weight=self.weight / factor**2)


@dataclass(frozen=True, eq=False)
class LedImage:
    """LED image in one frame: its centre, pixels, the second moments (2, 2) of its area, px^2, and its signal."""

    u_px: float
    v_px: float
    moments_px2: Floats
    signal: Signal


def led_image(lamp: Lamp, frame: DeviceFrame) -> LedImage:
    """LED image of a lamp that was found in a frame."""
    return LedImage(lamp.u_px, lamp.v_px, lamp.moments_px2, signal_of(lamp, frame))


def lines_of(shutter: Shutter, lines: Ints, line_count: int) -> Ints:
    """Lines in readout order, (n,), of rows or columns of the sensor (n,)."""
    return lines if shutter.direction in ("down", "right") else line_count - 1 - lines


def signal_of(lamp: Lamp, frame: DeviceFrame) -> Signal:
    """Signal of an LED image in a frame."""
    profile = lamp.profile
    lines = lines_of(frame.camera.shutter, profile.lines, frame.camera.line_count)
    order = np.argsort(lines)
    level = profile.level_e[order]
    bright = float(np.percentile(level, BRIGHT_PERCENTILE)) if len(level) else 0.0
    variance = 1 / profile.weight[order] + (ENVELOPE_SHARE * bright) ** 2
    start_s = frame.start_s + lines[order] * frame.camera.shutter.row_time_s
    return Signal(np.asarray(start_s, dtype=np.float64), frame.exposure_s, level, 1 / variance)


@dataclass(frozen=True, eq=False)
class ChipWave:
    """Periodic wave of chips: `chips` (L,) of 0 and 1, `chip_s` each, `start_chips` chips into its period at `at_s`.

    Its mean is 1; a dark chip has the share 1 - `depth` of a bright one's level.
    """

    chips: Ints
    chip_s: float
    depth: float
    at_s: float
    start_chips: float

    @cached_property
    def levels(self) -> Floats:
        """Level of each chip, (L,), mean 1."""
        relative = 1 - self.depth * (1 - self.chips)
        return np.asarray(relative / relative.mean())

    def gains(self, start_s: Floats, exposure_s: float) -> Floats:
        """Mean of the wave over exposures that start at (n,), exact."""
        at = (start_s - self.at_s) / self.chip_s + self.start_chips
        during = exposure_s / self.chip_s
        return np.asarray((self._integral(at + during) - self._integral(at)) / during)

    def _integral(self, at: Floats) -> Floats:
        """Integral from chip 0 to positions (n,), chips; a whole period adds its length, as the mean is 1."""
        length = len(self.chips)
        whole = np.floor(at / length)
        ends = np.concatenate([[0.0], np.cumsum(self.levels)])
        return np.asarray(whole * length + np.interp(at - whole * length, np.arange(length + 1), ends))


@dataclass(frozen=True, eq=False)
class PulseWave:
    """Square wave of mean 1: bright for the share `duty` of each period; at `at_s` it has made `phase` periods.

    Dark it has the share 1 - `depth` of the bright level.
    """

    frequency_hz: float
    duty: float
    depth: float
    at_s: float
    phase: float

    def gains(self, start_s: Floats, exposure_s: float) -> Floats:
        """Mean of the wave over exposures that start at (n,), exact."""
        at = (start_s - self.at_s) * self.frequency_hz + self.phase
        during = exposure_s * self.frequency_hz
        return np.asarray((self._integral(at + during) - self._integral(at)) / during)

    def _integral(self, at: Floats) -> Floats:
        bright = 1 / (self.duty + (1 - self.duty) * (1 - self.depth))
        whole = np.floor(at)
        return np.asarray(whole + np.interp(at - whole, [0.0, self.duty, 1.0], [0.0, self.duty * bright, 1.0]))


@dataclass(frozen=True, eq=False)
class WaveGains:
    """Gains of an LED at the lines of one frame, by the wave that was decoded (`estimator.io.device.LineGains`)."""

    wave: ChipWave | PulseWave
    frame_start_s: float
    row_time_s: float
    exposure_s: float

    def __call__(self, lines: Floats) -> Floats:
        """Gains (n,) at lines (n,), counted in readout order from 0 on; between two whole lines too."""
        start_s = self.frame_start_s + np.asarray(lines, dtype=np.float64) * self.row_time_s
        return self.wave.gains(np.asarray(start_s), self.exposure_s)

    def advanced(self, seconds: float) -> "WaveGains":
        """The gains if the wave were `seconds` further in its period."""
        return replace(self, wave=replace(self.wave, at_s=self.wave.at_s - seconds))


def overlaps(signal: Signal, chip_s: float, phase: float) -> Floats:
    """Share of each line's exposure in chips 0, 1, ..., (n, chips), where the first line starts `phase` into chip 0."""
    at = (signal.start_s - signal.start_s[0]) / chip_s + phase
    during = signal.exposure_s / chip_s
    chips = np.arange(int(np.floor(at[-1] + during)) + 1)
    covered = np.minimum(at[:, None] + during, chips + 1) - np.maximum(at[:, None], chips)
    return np.asarray(np.clip(covered, 0, None) / during)


def folded(shares: Floats, period: int) -> Floats:
    """Overlaps (n, chips) with chips of equal place in the period added, (n, period)."""
    missing = -shares.shape[1] % period
    whole = np.pad(shares, ((0, 0), (0, missing))).reshape(len(shares), -1, period)
    return np.asarray(whole.sum(axis=1), dtype=np.float64)
