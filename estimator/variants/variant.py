"""What a pipeline takes and gives: one frame in, one position out, under a name."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimator.io.dataset import DeviceFrame

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Estimate:
    """A frame's answer, in world axes and metres."""

    position_m: Floats
    """The projection centre of the frame's camera, (3,)."""
    ranges_m: dict[int, float] = field(default_factory=dict)
    """Distances from it to LEDs, by LED id, where the pipeline makes them."""
    covariance_m2: Floats | None = None
    """Of the position, (3, 3), where the pipeline says how sure it is."""
    ambiguous: bool = False
    """Whether another position fits what was seen nearly as well."""


@dataclass(frozen=True)
class Variant:
    """A pipeline, the name it goes by, and a line about it; `estimate` raises EstimationFailure."""

    name: str
    summary: str
    estimate: Callable[[DeviceFrame], Estimate]
