"""Cameras that move while a rolling shutter reads their lines: each line has a pose of its own.

Rays into the room have the pose of their pixel's line. Images of LEDs are computed at poses, the knots, so close that
no point of the image moves by more than an eighth of a pixel from one to the next, and interpolated for the lines
between them. To first order interpolation moves no edge: it smooths an edge that moves by d from knot to knot by a
standard deviation of d / 2 at most. Each line's exposure is a mean over poses, as that of a global shutter.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi

Array = NDArray[np.float64]

LINE_TOLERANCE_PX = 1e-10
"""Accuracy of an LED's image at its own line's time."""
MAX_LINE_ROUNDS = 200


@dataclass(frozen=True)
class LinePoses:
    """A pose for each line of a sensor, in the order of its rows or columns, or one pose for all lines."""

    positions_m: Array
    """Projection centres, world, (lines, 3)."""
    rotations: Array
    """R_cam_world, (lines, 3, 3)."""
    along_rows: bool
    """Whether lines are rows."""

    @classmethod
    def of(cls, pose: Pose) -> Self:
        """The one pose of all lines."""
        return cls(np.array([pose.position_m]), pose.rotation[None], along_rows=True)


def mean_poses(during: Sequence[LinePoses]) -> LinePoses:
    """Means of the poses of each line at several times, next to each other: rays then have the mean directions."""
    positions_m, rotations = (
        np.mean([getattr(poses, name) for poses in during], axis=0) for name in ("positions_m", "rotations")
    )
    return LinePoses(positions_m, rotations, during[0].along_rows)


@dataclass(frozen=True)
class Knot:
    """Lines around one line, with the poses of that line's exposure."""

    lines: Roi
    """The lines in whose images the knot has a share."""
    weights: Array
    """The share in each of them, (lines, 1) or (1, lines); the shares of all knots in a line add up to 1."""
    poses: tuple[Pose, ...]
    """Poses spread evenly over the exposure of the knot's line."""

    def weights_in(self, roi: Roi) -> Array:
        """The shares in a region of these lines, in an array that broadcasts over its pixels."""
        rows, columns = self.lines.slices(roi)
        return self.weights[rows] if self.weights.shape[1] == 1 else self.weights[:, columns]


@dataclass(frozen=True)
class RollingPoses:
    """The poses of a moving camera during the readout of one frame."""

    steps: tuple[LinePoses, ...]
    """Poses of all lines, at times spread evenly over each line's exposure."""
    knots: tuple[Knot, ...]
    pose_at: Callable[[float], Pose]
    """Pose at a time after the middle of the frame, s."""

    @property
    def ends(self) -> tuple[Pose, Pose]:
        """Poses of the first and of the last knot."""
        return self.knots[0].poses[0], self.knots[-1].poses[-1]


def knots_of(camera: Camera, count: int, poses_of_line: Callable[[float], Sequence[Pose]]) -> tuple[Knot, ...]:
    """`count` knots, evenly spaced from the sensor's first line to its last.

    poses_of_line: poses during the exposure of a line, by the number of its row or column, not always whole.
    """
    shutter, sensor = camera.shutter, Roi.of_sensor(camera)
    along_rows = camera.line_starts_s().shape[1] == 1
    lines = shutter.line_count(camera.width_px, camera.height_px)
    places = np.linspace(0.0, lines - 1.0, count)
    spacing, numbers = places[1] - places[0], np.arange(lines)
    knots = []
    for place in places.tolist():
        weights = np.clip(1 - np.abs(numbers - place) / spacing, 0.0, None)
        first, last = np.flatnonzero(weights)[[0, -1]].tolist()
        weights = weights[first : last + 1]
        if along_rows:
            band, of_band = Roi(first, 0, last + 1 - first, sensor.columns), weights[:, None]
        else:
            band, of_band = Roi(0, first, sensor.rows, last + 1 - first), weights[None, :]
        knots.append(Knot(band, of_band, tuple(poses_of_line(place))))
    return tuple(knots)


def image_at_own_line(posed: PosedCamera, pose_at: Callable[[float], Pose], point_m: Array) -> tuple[float, float]:
    """Pixel (u, v) of a world point (3,) at the time at which the line that holds its image is exposed.

    The time is continuous, `Camera.times_s` of the pixel. posed: the camera in the middle of the frame. NaN where the
    lens does not image the point. Converges where an image moves by less than one line in a row time.
    """
    u, v = posed.project(point_m).tolist()
    for _ in range(MAX_LINE_ROUNDS):
        before = u, v
        u, v = posed.at(pose_at(float(posed.camera.times_s(u, v)))).project(point_m).tolist()
        if not np.hypot(u - before[0], v - before[1]) > LINE_TOLERANCE_PX:
            break
    return u, v
