"""Pose of a camera, and rotations by the tilts and yaw of the format (datasets/FORMAT.md, Tilt)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compact, compiled
from estimator.io.camera import Camera

Floats = NDArray[np.float64]

POSE_PARAMETERS = 6
"""Position x, y, z in metres, then the rig's tilt_x, tilt_y and yaw in radians: order of all pose derivatives."""


# Cosine of tilt_y below which tilt_x and yaw turn about one axis, to rounding.
MIN_COSINE = 1e-7


def rotation(tilt_x: float, tilt_y: float, yaw: float = 0.0) -> Floats:
    """`Rx(tilt_x) Ry(tilt_y) Rz(yaw)`, (3, 3), for angles in radians."""
    (sx, cx), (sy, cy), (sz, cz) = ((math.sin(angle), math.cos(angle)) for angle in (tilt_x, tilt_y, yaw))
    return np.array(
        [
            [cy * cz, cy * sz, -sy],
            [sx * sy * cz - cx * sz, sx * sy * sz + cx * cz, sx * cy],
            [cx * sy * cz + sx * sz, cx * sy * sz - sx * cz, cx * cy],
        ]
    )


def rotation_angles(matrix: Floats) -> Floats:
    """The (tilt_x, tilt_y, yaw) of a rotation matrix (3, 3), radians: the inverse of `rotation`.

    With a tilt_y of 90 deg the matrix determines the difference of tilt_x and yaw alone, or their sum: yaw is then 0.
    """
    (xx, xy, xz), (_, yy, yz), (_, zy, zz) = matrix.tolist()
    cos_tilt_y = math.hypot(yz, zz)
    tilt_y = math.atan2(-xz, cos_tilt_y)
    if cos_tilt_y < MIN_COSINE:
        return np.array([math.atan2(-zy, yy), tilt_y, 0.0])
    return np.array([math.atan2(yz, zz), tilt_y, math.atan2(xy, xx)])


@dataclass(frozen=True, eq=False)
class Pose:
    """Projection centre `position_m` (3,), world metres, and rotation `R_cam_world` (3, 3) of a camera."""

    position_m: Floats
    R_cam_world: Floats

    @classmethod
    def of_rig_angles(cls, position_m: Floats, angles: Floats, camera: Camera) -> "Pose":
        """Pose of a camera at a position (3,) whose rig has the (tilt_x, tilt_y, yaw), (3,) radians."""
        tilt_x, tilt_y, yaw = np.asarray(angles).tolist()
        return cls(position_m, camera.R_cam_rig_array() @ rotation(tilt_x, tilt_y, yaw))

    def rig_angles(self, camera: Camera) -> Floats:
        """The rig's (tilt_x, tilt_y, yaw), (3,) radians."""
        return rotation_angles(camera.R_cam_rig_array().T @ self.R_cam_world)

    def moved(self, step: Floats, camera: Camera) -> "Pose":
        """This pose plus a step (6,) of its POSE_PARAMETERS."""
        return Pose.of_rig_angles(self.position_m + step[:3], self.rig_angles(camera) + step[3:], camera)

    def in_camera(self, points_m: Floats) -> Floats:
        """World points (n, 3) in camera axes, (n, 3), metres."""
        return _in_camera(compact(points_m), compact(self.position_m), compact(self.R_cam_world))


@compiled
def _in_camera(points_m: Floats, position_m: Floats, R_cam_world: Floats) -> Floats:
    """See `Pose.in_camera`."""
    p_cam = np.empty_like(points_m)
    for i in range(len(points_m)):
        x, y, z = points_m[i, 0] - position_m[0], points_m[i, 1] - position_m[1], points_m[i, 2] - position_m[2]
        for k in range(3):
            p_cam[i, k] = R_cam_world[k, 0] * x + R_cam_world[k, 1] * y + R_cam_world[k, 2] * z
    return p_cam
