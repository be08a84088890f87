"""Ratios held against what is wanted: printed beside their peer, and a non-zero exit where one falls short.

Every benchmark measures itself and its peer in one run, alternately, and compares medians of their ratios: machines
differ, are shared and change their speed, so seconds are not comparable.
"""

import gc
import importlib
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import ModuleType


def alternating_s(
    works: list[Callable[[], object]], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> list[list[float]]:
    """Seconds (works, repeats) of calls made in turn, after one round that is not measured.

    `clock` may be `time.process_time`, which other processes disturb less and which counts all threads.
    """
    for work in works:
        work()
    seconds: list[list[float]] = [[] for _ in works]
    for _ in range(repeats):
        for work, times in zip(works, seconds, strict=True):
            gc.collect()
            start = clock()
            work()
            times.append(clock() - start)
    return seconds


def peer(name: str) -> ModuleType | None:
    """A package of the extra `bench`, or None with a line that names it where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        print(f"{name} is not installed (extra `bench`): skipped", flush=True)
        return None


def ratio(numerator_s: list[float], denominator_s: list[float]) -> float:
    """Median of the ratios of the rounds."""
    return statistics.median(above / below for above, below in zip(numerator_s, denominator_s, strict=True))


@dataclass
class Targets:
    """The ratios of one benchmark; `finish` ends the process with status 1 if any falls short."""

    missed: list[str] = field(default_factory=list)

    def at_most(self, name: str, value: float, limit: float) -> None:
        """Print a ratio that should not be larger than `limit`."""
        self._print(name, value, f"<= {limit:g}", value <= limit)

    def at_least(self, name: str, value: float, limit: float) -> None:
        """Print a ratio or rate that should not be smaller than `limit`."""
        self._print(name, value, f">= {limit:g}", value >= limit)

    def beside(self, name: str, value: float) -> None:
        """Print a ratio beside a peer of which nothing is wanted."""
        print(f"{name:72} {value:8.3f}", flush=True)

    def finish(self) -> None:
        """Exit with status 1 and the names of what was missed, if anything was."""
        if self.missed:
            sys.exit(f"missed: {', '.join(self.missed)}")

    def _print(self, name: str, value: float, wanted: str, met: bool) -> None:
        print(f"{name:72} {value:8.3f}  wanted {wanted}{'' if met else '  MISSED'}", flush=True)
        if not met:
            self.missed.append(name)
