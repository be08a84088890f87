"""Rigs: cameras mounted rigidly beside each other and exposed at once. The axes of a rig are the axes of `main`."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vlcrender.camera.intrinsics import Camera, Pose, rotation_cam_world
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.config.toml_model import Settings

MAIN = "main"
Offset = Annotated[float, Field(ge=-10, le=10)]
Angle = Annotated[float, Field(ge=-180, le=180)]
GIMBAL_LOCK = 1e-9
"""cos(tilt_y) below which tilt_x and yaw turn about the same axis; the whole turn is then yaw."""


class RigCamera(Settings):
    """A camera beside `main`."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,49}$")]
    """Name of the camera: a letter, then at most 49 letters, digits, "_" or "-"; not "main"."""
    offset_m: tuple[Offset, Offset, Offset]
    """Projection centre in the axes of `main`, m."""
    tilt_x_deg: Angle = 0.0
    """tilt_x of R_cam_rig = Rx(tilt_x) Ry(tilt_y) Rz(yaw), deg, with the signs of a pose's R_cam_world."""
    tilt_y_deg: Angle = 0.0
    """tilt_y of R_cam_rig, deg."""
    yaw_deg: Angle = 0.0
    """yaw of R_cam_rig, deg."""
    camera: Camera | None = None
    """The camera; the same as `main` where not given."""


@dataclass(frozen=True)
class Mounted:
    """A camera mounted on a rig: p_cam = R_cam_rig @ (p_rig - offset_m)."""

    name: str
    camera: Camera
    rotation: NDArray[np.float64]
    offset_m: NDArray[np.float64]

    def posed(self, main: Pose) -> PosedCamera:
        """This camera at its pose, for a pose of `main`."""
        if self.name == MAIN:
            return PosedCamera(self.camera, main)
        position_m = np.array(main.position_m) + main.rotation.T @ self.offset_m
        return PosedCamera(self.camera, pose_of(position_m, self.rotation @ main.rotation))


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
