"""Gains of exposures: means of the waves of LEDs during the exposure of each line of a sensor."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vlcrender.modulation.wave import TwoLevelWave, Wave

Array = NDArray[np.float64]
SAME_CHIP = 1e-6
"""Chips of two waves coincide where the waves are whole chips apart to this share of a chip."""


class LineGains(Mapping[int, Array]):
    """Gain of each LED whose light is not steady, by its id: the mean of its wave, for each line.

    A gain has the shape of `starts_s`. It is exact, and computed when it is first asked for.
    """

    def __init__(self, waves: Mapping[int, Wave], starts_s: Array, exposure_s: float) -> None:
        """Gains of exposures from each of `starts_s`, by the clock of the waves."""
        self._waves, self._starts_s, self._exposure_s = waves, starts_s, exposure_s
        self._gains: dict[int, Array] = {}

    def __getitem__(self, led_id: int) -> Array:
        """The gain of an LED. Raises KeyError for a steady one."""
        if led_id not in self._gains:
            self._gains[led_id] = self._waves[led_id].mean(self._starts_s, self._exposure_s)
        return self._gains[led_id]

    def __iter__(self) -> Iterator[int]:
        """Ids of the LEDs."""
        return iter(self._waves)

    def __len__(self) -> int:
        """Number of LEDs."""
        return len(self._waves)


@dataclass(frozen=True, eq=False)
class _ChipSum:
    """The sum of waves of one clock whose chips coincide."""

    first: TwoLevelWave
    """The wave whose phase counts."""
    levels: Array
    """Sum of the levels of each chip, weighted, (n,)."""

    def mean(self, starts_s: Array, duration_s: float) -> Array:
        """Mean during exposures of this duration from each start."""
        count = len(self.levels)
        sums = np.concatenate([[0.0], np.cumsum(self.levels)]) / count
        first, during = self.first.phase(starts_s), duration_s / self.first.period_s
        last = np.floor(first + during)
        until = last * sums[-1] + np.interp((first + during - last) * count, np.arange(count + 1), sums)
        return np.asarray((until - np.interp(first * count, np.arange(count + 1), sums)) / during)


@dataclass(frozen=True, eq=False)
class MeanWave:
    """The mean of the light of many LEDs."""

    chips: tuple[_ChipSum, ...]
    others: tuple[tuple[float, Wave], ...]
    """Shares of all light, and their waves."""
    steady: float
    """Share of steady light."""

    @classmethod
    def of(cls, waves: Mapping[int, Wave], weights: Mapping[int, float]) -> Self:
        """The mean of the LEDs with these weights, by id; LEDs without a wave are steady."""
        total = sum(weights.values())
        sums: dict[tuple[float, float, int], list[_ChipSum]] = {}
        others: dict[Wave, float] = {}
        for led_id, weight in weights.items():
            wave = waves.get(led_id)
            if isinstance(wave, TwoLevelWave) and wave.chips:
                of_clock = sums.setdefault((wave.nominal_period_s, wave.clock_error, len(wave.lit)), [])
                _add(of_clock, wave, weight / total)
            elif wave is not None:
                others[wave] = others.get(wave, 0.0) + weight / total
        steady = sum(weight for led_id, weight in weights.items() if led_id not in waves) / total
        return cls(tuple(s for group in sums.values() for s in group), tuple((w, o) for o, w in others.items()), steady)

    def mean(self, starts_s: Array, duration_s: float) -> Array:
        """Mean light during exposures of this duration from each start, over its mean in time; exact."""
        means: Array = np.full(np.shape(starts_s), self.steady)
        for of_chips in self.chips:
            means += of_chips.mean(starts_s, duration_s)
        for share, wave in self.others:
            means += share * wave.mean(starts_s, duration_s)
        return means


def _add(sums: list[_ChipSum], wave: TwoLevelWave, weight: float) -> None:
    """Add a wave to the sum whose chips its own coincide with; to a new one where there is none."""
    count = len(wave.lit)
    for number, of_chips in enumerate(sums):
        later = (wave.start_phase - of_chips.first.start_phase) * count
        if abs(later - round(later)) < SAME_CHIP:
            levels = of_chips.levels + weight * np.roll(wave.levels, -round(later))
            sums[number] = _ChipSum(of_chips.first, levels)
            return
    sums.append(_ChipSum(wave, weight * wave.levels))
