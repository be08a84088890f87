"""Progress of `generate`: one report type for the room's light and the frames, their rate, and the time that is left.

The library draws nothing: `Pace` makes the words, the command line shows them.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

FRAMES_STAGE = "frames"


@dataclass(frozen=True)
class Progress:
    """A report: `done` of `total` of a stage is finished."""

    stage: str
    """"frames", or before the first frame "poses" or a step of the room's light, such as "reflected light"."""
    done: float
    """Number of finished frames; share of any other stage."""
    total: float
    """Number of frames; 1 for any other stage."""


ProgressCallback = Callable[[Progress], None]

RECENT = 200
"""Reports over which the rate is the mean: it follows views that differ, and not single frames."""
FIRST_LINE_S, GROWTH, MAX_INTERVAL_S = 10.0, 1.5, 600.0
"""Of lines in a log: time to the first one, and how intervals grow, up to the largest."""


class Pace:
    """Rate of frames and the time that is left, from the reports of this run alone: resumed frames took no time."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """clock: seconds."""
        self._clock = clock
        self._start_s = clock()
        self._recent: deque[tuple[float, float]] = deque(maxlen=RECENT)
        self._last_line_s = self._start_s
        self._interval_s = FIRST_LINE_S

    def add(self, progress: Progress) -> None:
        """Take a report of frames."""
        self._recent.append((self._clock(), progress.done))

    @property
    def rate_hz(self) -> float | None:
        """Frames a second lately; None before two reports at different times."""
        if len(self._recent) < 2:
            return None
        (start_s, start), (end_s, end) = self._recent[0], self._recent[-1]
        return (end - start) / (end_s - start_s) if end_s > start_s and end > start else None

    def text(self, progress: Progress) -> str:
        """Rate and time left, such as "3.1 frames/s, 26 min left"; the time taken at the end; empty where unknown."""
        if progress.done >= progress.total:
            return f"done in {duration_text(self._clock() - self._start_s)}"
        rate_hz = self.rate_hz
        if rate_hz is None:
            return ""
        pace = f"{rate_hz:.3g} frames/s" if rate_hz >= 1 else f"{duration_text(1 / rate_hz)} a frame"
        return f"{pace}, {duration_text((progress.total - progress.done) / rate_hz)} left"

    def line_is_due(self, progress: Progress) -> bool:
        """Whether a log wants a line now: at growing intervals, and at the end of a run that had one."""
        now_s = self._clock()
        had_one = self._last_line_s > self._start_s
        if now_s - self._last_line_s < self._interval_s and not (had_one and progress.done >= progress.total):
            return False
        if had_one:
            self._interval_s = min(GROWTH * self._interval_s, MAX_INTERVAL_S)
        self._last_line_s = now_s
        return True


def duration_text(seconds: float) -> str:
    """A duration in two digits or so: "0.52 s", "26 min", "3.5 h", "12 days"."""
    for unit, length_s, limit in (("s", 1.0, 99.5), ("min", 60.0, 99.5), ("h", 3600.0, 48.0)):
        if seconds < limit * length_s:
            return f"{seconds / length_s:.2g} {unit}"
    return f"{seconds / 86400:.3g} days"
