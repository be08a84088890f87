"""Progress of `generate`: one report type for the room's light and the frames. The library draws nothing."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Progress:
    """A report: `done` of `total` of a stage is finished."""

    stage: Literal["light", "frames"]
    """The room's light is computed before the first frame."""
    done: float
    """Number of finished frames; share of the present step of the light."""
    total: float
    """Number of frames; 1 for light."""
    step: str = ""
    """Step of the light, such as "reflected light"; empty for frames."""


ProgressCallback = Callable[[Progress], None]
