"""Progress of `generate`: one report type for the room's light and the frames. The library draws nothing."""

from collections.abc import Callable
from dataclasses import dataclass

FRAMES_STAGE = "frames"


@dataclass(frozen=True)
class Progress:
    """A report: `done` of `total` of a stage is finished."""

    stage: str
    """"frames", or before the first frame a step of the room's light, such as "reflected light"."""
    done: float
    """Number of finished frames; share of a step of the light."""
    total: float
    """Number of frames; 1 for a step of the light."""


ProgressCallback = Callable[[Progress], None]
