"""Cameras that are rigidly mounted beside each other and exposed at once; the rig's axes are those of `main`."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vlcrender.camera.intrinsics import Camera, Pose, rotation_cam_world
from vlcrender.config.toml_model import Settings

MAIN = "main"
Offset = Annotated[float, Field(ge=-10, le=10)]
Angle = Annotated[float, Field(ge=-180, le=180)]
GIMBAL_LOCK = 1e-9
"""cos(tilt_y) below which tilt_x and yaw turn about one axis, and all is given to yaw."""


class RigCamera(Settings):
    """A camera beside `main`."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,49}$")]
    offset_m: tuple[Offset, Offset, Offset]
    """Its projection centre in the axes of `main`."""
    tilt_x_deg: Angle = 0.0
    tilt_y_deg: Angle = 0.0
    yaw_deg: Angle = 0.0
    """R_cam_rig = Rx(tilt_x) Ry(tilt_y) Rz(yaw), as a pose's R_cam_world."""
    camera: Camera | None = None
    """The same as `main` where not given."""


@dataclass(frozen=True)
class Mounted:
    """A camera with its place on the rig: p_cam = R_cam_rig @ (p_rig - offset_m)."""

    name: str
    camera: Camera
    rotation: NDArray[np.float64]
    offset_m: NDArray[np.float64]

    def pose(self, main: Pose) -> Pose:
        """Where this camera is when `main` is there."""
        if self.name == MAIN:
            return main
        return pose_of(np.array(main.position_m) + main.rotation.T @ self.offset_m, self.rotation @ main.rotation)


def mounted_cameras(main: Camera, rig: tuple[RigCamera, ...]) -> tuple[Mounted, ...]:
    """All cameras of a rig, `main` first."""
    beside = (
        Mounted(
            entry.name,
            entry.camera or main,
            rotation_cam_world(entry.tilt_x_deg, entry.tilt_y_deg, entry.yaw_deg),
            np.array(entry.offset_m),
        )
        for entry in rig
    )
    return (Mounted(MAIN, main, np.eye(3), np.zeros(3)), *beside)


def pose_of(position_m: NDArray[np.float64], rotation: NDArray[np.float64]) -> Pose:
    """The pose with this projection centre (3,) and R_cam_world (3, 3)."""
    r = rotation
    cos_y = float(np.hypot(r[1, 2], r[2, 2]))
    tilt_y = np.arctan2(-r[0, 2], cos_y)
    if cos_y < GIMBAL_LOCK:
        tilt_x, yaw = 0.0, np.arctan2(-r[1, 0], r[1, 1])
    else:
        tilt_x, yaw = np.arctan2(r[1, 2], r[2, 2]), np.arctan2(r[0, 1], r[0, 0])
    x, y, z = map(float, position_m)
    return Pose((x, y, z), *(float(np.degrees(angle)) for angle in (tilt_x, tilt_y, yaw)))
