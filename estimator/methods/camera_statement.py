"""Statement of a device that its camera is exact: trusted until the device's own frames contradict it.

A frame contradicts it if an error of an intrinsic explains the frame better than an exact camera does, by four standard
deviations (`estimator.solvers.camera_check`); its own estimate then takes the camera as one as sold. But some frames
cannot show a wrong focal length: in a level view of LEDs at one height, focal length and range are one number. The
camera is the same in all frames of a device. Where some of them contradict the statement, the others count all
errors of the camera that they leave open. Estimates use other frames of the same device,
never the truth. A frame by itself trusts the statement unless it contradicts it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.variant import DeviceMethod, Estimate, Needs, Variant

# Frames of a device, and their share, that contradict it by no chance: one does so by chance in some 2000.
MIN_CONTRADICTING = 2
MIN_CONTRADICTING_SHARE = 0.01


@dataclass(frozen=True, eq=False)
class Judged:
    """A frame's own estimate and what the frame says of a camera that states no errors.

    `contradicts` says that the frame contradicts an exact camera. `doubt_m2` (3, 3) is what the covariance lacks if the
    camera is stated as exact and the statement is not trusted.
    """

    estimate: Estimate
    contradicts: bool
    doubt_m2: NDArray[np.float64]


def judged_by_device(frames: Sequence[Judged]) -> list[Estimate | EstimationFailure]:
    """Estimates of the frames of a device, in their order."""
    doubted = contradicted_by(frames)
    return [_doubted(frame) if doubted else frame.estimate for frame in frames]


def contradicted_by(frames: Sequence[Judged]) -> bool:
    """Whether so many frames of a device contradict an exact camera that it is no chance."""
    contradicting = sum(frame.contradicts for frame in frames)
    return contradicting >= max(MIN_CONTRADICTING, MIN_CONTRADICTING_SHARE * len(frames))


def _doubted(frame: Judged) -> Estimate:
    covariance_m2 = frame.estimate.covariance_m2
    return (
        frame.estimate
        if covariance_m2 is None
        else replace(frame.estimate, covariance_m2=covariance_m2 + frame.doubt_m2)
    )


def over_frames(name: str, summary: str, judge: Callable[[DeviceFrame], Judged], needs: Needs) -> Variant:
    """The variant of a method that judges each frame by itself."""
    return Variant.over_device(name, summary, DeviceMethod(judge, judged_by_device), needs)
