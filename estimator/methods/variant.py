"""Interface of a variant: a function from a frame to an estimate, under a name."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
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
class DeviceMethod:
    """Method over all frames of one device, in two steps, so that one image at a time is in memory.

    `observe` reduces a frame to what `solve` needs of it. Its result holds no image and can be pickled: worker
    processes observe frames and solve devices. `solve` takes the results of one device's frames, in the order of the
    frames, and returns an Estimate, or an EstimationFailure, for each. A frame for which `observe` raises
    EstimationFailure has failed, and `solve` does not get it.
    """

    observe: Callable[[DeviceFrame], Any]
    solve: Callable[[Sequence[Any]], Sequence[Estimate | EstimationFailure]]

    def alone(self, frame: DeviceFrame) -> Estimate:
        """Estimate of a frame by itself, as if the device had taken no other; raises EstimationFailure."""
        (result,) = self.solve([self.observe(frame)])
        if isinstance(result, EstimationFailure):
            raise result
        return result


@dataclass(frozen=True)
class Needs:
    """What a method needs of a frame."""

    leds: int
    """Smallest number of identified LEDs."""
    faces: Literal["any", "disc", "square"] = "any"
    """Shape that the face of each LED has to have, or of one LED for `square`."""
    sizes: bool = False
    """Whether the map has to say the sizes of the LEDs."""
    sensors: tuple[Literal["accelerometer", "second camera", "fish-eye lens"], ...] = ()
    """Sensors beside one camera that have to be there."""
    optional: tuple[Literal["accelerometer", "gyroscope"], ...] = ()
    """Sensors whose readings are used where they are there."""
    attitude: Literal["any", "level"] = "any"
    """Attitude of the camera that the method allows."""
    package: str = ""
    """Python package that has to be installed, an extra of this distribution; none where empty."""


@dataclass(frozen=True)
class Variant:
    """A positioning method under a name, with a summary of one line; `estimate` raises EstimationFailure.

    A variant that uses all frames of a device has them by `of_device`; its `estimate` uses the one frame alone. `needs`
    is None where they are not stated. `family` and `mark` choose how pages and plots show it
    (`estimator.methods.looks`); where they are empty, the name does.
    """

    name: str
    summary: str
    estimate: Callable[[DeviceFrame], Estimate]
    of_device: DeviceMethod | None = None
    needs: Needs | None = None
    family: str = ""
    mark: str = ""

    def missing(self) -> str | None:
        """What has to be installed before the variant can answer, as text; None where nothing is missing."""
        package = "" if self.needs is None else self.needs.package
        if not package or find_spec(package) is not None:
            return None
        return f"{package} is not installed (pip install vlcrender[{package}])"

    @classmethod
    def over_device(cls, name: str, summary: str, method: DeviceMethod, needs: Needs | None = None) -> "Variant":
        """The variant of a method over all frames of a device."""
        return cls(name, summary, method.alone, method, needs)
