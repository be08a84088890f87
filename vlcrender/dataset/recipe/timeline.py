"""Times of frames: bursts of shots, and their starts on the rig's clock.

The waves of LEDs run on from time 0 of a dataset. Each burst has a slot of the timeline of its own, in the order of the
frames, and starts at random within it, so that waves have another phase in each.
"""

from typing import Annotated

from pydantic import Field

from vlcrender.config.toml_model import Settings
from vlcrender.core.random_keys import stream

JITTER_S = 1.0
"""Length of the part of a slot in which a burst may start: far longer than the period of any wave."""


class Burst(Settings):
    """Shots in quick succession, such as of a video. Each is a shot of its own."""

    frames: Annotated[int, Field(ge=1, le=1000)]
    """Shots in each burst."""
    frame_rate_hz: Annotated[float, Field(gt=0, le=1e5)]
    """Shots a second: the start of a shot is this much later than that of the one before, Hz."""

    def offset_s(self, number: int) -> float:
        """Time from the start of a burst to the start of its shot of this number, s."""
        return number / self.frame_rate_hz


def start_of_burst_s(seed: int, burst: int, longest_s: float) -> float:
    """Start of a burst on the rig's clock, s: at random within the first JITTER_S of its slot.

    longest_s: time from the start of a burst to the start of its last line's exposure.
    """
    return burst * (JITTER_S + longest_s) + JITTER_S * float(stream(seed, burst, "start").uniform())
