"""Interface of a variant: a function from a frame to an estimate, under a name."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimator.io.device import DeviceFrame

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimate of one frame, in world axes and metres."""

    position_m: Floats
    """Projection centre of the frame's camera, (3,)."""
    ranges_m: dict[int, float] = field(default_factory=dict)
    """Distances from it to LEDs, by LED id, if the method computes them."""
    covariance_m2: Floats | None = None
    """Covariance of the position, (3, 3), if the method reports one."""
    ambiguous: bool = False
    """Whether another position fits the frame nearly as well."""


@dataclass(frozen=True)
class Variant:
    """A positioning method under a name, with a summary of one line; `estimate` raises EstimationFailure."""

    name: str
    summary: str
    estimate: Callable[[DeviceFrame], Estimate]
