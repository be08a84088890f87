"""Periodic waves of an LED's light about their mean, 1, with exact integrals.

A wave has a shape, a nominal period, a clock and a phase. At the time t of the rig's clock it has made
x = t (1 + clock_error) / nominal period + phase periods, and its integral over one period is the period: the mean over
whole periods is 1.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Wave(ABC):
    """A periodic wave with mean 1."""

    nominal_period_s: float
    """Period by the wave's own clock, seconds."""
    clock_error: float = field(default=0.0, kw_only=True)
    """Relative error of its clock's rate: positive is fast, a frequency f is sent as f (1 + clock_error)."""
    start_phase: float = field(default=0.0, kw_only=True)
    """Periods that the wave has made at the time 0, 0 to 1."""

    @property
    def period_s(self) -> float:
        """Period by the rig's clock, seconds."""
        return self.nominal_period_s / (1 + self.clock_error)

    def started(self, clock_error: float, phase: float) -> Self:
        """This wave by a clock with this error, at this phase at the time 0."""
        return replace(self, clock_error=clock_error, start_phase=phase)

    @property
    def bits(self) -> str | None:
        """The chips of one period, "1" for lit, from phase 0 on; None for a wave without chips."""
        return None

    @abstractmethod
    def _of_phase(self, phase: Array) -> Array:
        """Integral of the wave over its phase from 0 to each of `phase`, 0 to 1, in periods; 1 at 1."""

    @abstractmethod
    def harmonics(self, count: int) -> NDArray[np.complex128]:
        """Fourier coefficients c_k, k = 1, 2, ..., of the first `count` harmonics, (count,).

        The wave is 1 + sum of 2 Re(c_k e^(2 pi i k x)), x its phase in periods.
        """

    def _antiderivative(self, periods: Array) -> Array:
        whole = np.floor(periods)
        return whole + self._of_phase(periods - whole)

    def phase(self, t_s: Array | float) -> Array:
        """Phase at each time of the rig's clock, periods, 0 to below 1."""
        periods = np.asarray(t_s, dtype=np.float64) / self.period_s + self.start_phase
        return np.asarray(periods - np.floor(periods))

    def integral(self, t_s: Array | float) -> Array:
        """Integral of the wave from time 0 to each time of the rig's clock, seconds; exact."""
        periods = np.asarray(t_s, dtype=np.float64) / self.period_s + self.start_phase
        from_zero = self._antiderivative(periods) - self._antiderivative(np.array(self.start_phase))
        return np.asarray(self.period_s * from_zero)

    def mean(self, start_s: Array | float, duration_s: float) -> Array:
        """Mean of the wave during exposures of this duration from each start, both by the rig's clock; exact.

        The number of past periods is taken off first, so that a late start costs no digits. Raises ValueError for a
        duration of 0 or less.
        """
        if duration_s <= 0:
            raise ValueError(f"duration_s = {duration_s:g}: has to be above 0")
        first, during = self.phase(start_s), duration_s / self.period_s
        return np.asarray((self._antiderivative(first + during) - self._antiderivative(first)) / during)


@dataclass(frozen=True)
class TwoLevelWave(Wave):
    """A wave of two levels: chips of a code or packet, or a tone's or a dimmer's pulse.

    Lit it is 1 / (D + (1 - D) (1 - depth)), D the lit share of the period; dark it is 1 - depth of that.
    """

    lengths: tuple[float, ...]
    """Lengths of the pieces of one period, in any unit."""
    lit: tuple[bool, ...]
    """Whether each piece is lit."""
    depth: float
    """1 - dark level / lit level, above 0 to 1."""
    chips: bool = False
    """Whether the pieces are chips, which `bits` tells."""

    @classmethod
    def of_chips(cls, chips: str, chip_s: float, depth: float) -> "TwoLevelWave":
        """The wave of chips such as "0110", "1" for lit, each of this duration."""
        lit = tuple(chip == "1" for chip in chips)
        return cls(len(chips) * chip_s, (1.0,) * len(chips), lit, depth, chips=True)

    @classmethod
    def of_pulse(cls, frequency_hz: float, duty: float, depth: float) -> "TwoLevelWave":
        """A square wave: lit for the share `duty` of each period, then dark."""
        return cls(1 / frequency_hz, (duty, 1 - duty), (True, False), depth)

    @property
    def bits(self) -> str | None:
        """The chips of one period, "1" for lit; None for a pulse."""
        return "".join("01"[lit] for lit in self.lit) if self.chips else None

    @cached_property
    def _edges(self) -> Array:
        """Ends of the pieces, in periods, from 0 to 1, (n + 1,)."""
        ends = np.cumsum((0.0, *self.lengths))
        return np.asarray(ends / ends[-1])

    @cached_property
    def levels(self) -> Array:
        """Level of each piece, (n,); their mean over the period is 1."""
        relative = np.where(self.lit, 1.0, 1.0 - self.depth)
        return np.asarray(relative / (relative * np.diff(self._edges)).sum())

    @cached_property
    def _cumulated(self) -> Array:
        sums = np.cumsum((0.0, *(self.levels * np.diff(self._edges))))
        return np.asarray(sums / sums[-1])

    def _of_phase(self, phase: Array) -> Array:
        return np.asarray(np.interp(phase, self._edges, self._cumulated))

    def harmonics(self, count: int) -> NDArray[np.complex128]:
        """Fourier coefficients of the first `count` harmonics, (count,), as of `Wave.harmonics`."""
        k = np.arange(1, count + 1)
        turns = np.exp(-2j * np.pi * k[:, None] * self._edges)
        pieces = (turns[:, :-1] - turns[:, 1:]) * self.levels
        return np.asarray(pieces.sum(axis=1) / (2j * np.pi * k))


@dataclass(frozen=True)
class CosineWave(Wave):
    """1 + depth cos(2 pi x): the ripple of lamps on the mains."""

    depth: float
    """Amplitude over the mean, above 0 to 1."""

    def _of_phase(self, phase: Array) -> Array:
        return np.asarray(phase + self.depth * np.sin(2 * np.pi * phase) / (2 * np.pi))

    def harmonics(self, count: int) -> NDArray[np.complex128]:
        """Fourier coefficients of the first `count` harmonics, (count,): depth / 2, then zeros."""
        coefficients = np.zeros(count, dtype=np.complex128)
        coefficients[:1] = self.depth / 2
        return coefficients
