"""Motion of the rig during an exposure: poses for the midpoint rule."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import Mounted, pose_of
from vlcrender.config.toml_model import Settings
from vlcrender.errors import InputError
from vlcrender.scene.loader import Scene

STEP_PX = 0.5
"""Largest motion of an image point from one pose to the next, pixels. The midpoint rule then smooths an edge by at most
(1/4 px) / sqrt(3) in addition to the pixel's own area."""
MAX_STEPS = 2000
"""Largest number of poses in an exposure."""

AngularVelocity = Annotated[float, Field(ge=-1e5, le=1e5)]
LinearVelocity = Annotated[float, Field(ge=-1e3, le=1e3)]


class Motion(Settings):
    """Constant velocities during the exposure. The pose of a frame is its pose at mid-exposure."""

    angular_velocity_deg_s: tuple[AngularVelocity, AngularVelocity, AngularVelocity] = (0.0, 0.0, 0.0)
    """Angular velocity about the axes of the camera `main`, right-handed, degrees a second."""
    linear_velocity_m_s: tuple[LinearVelocity, LinearVelocity, LinearVelocity] = (0.0, 0.0, 0.0)
    """Velocity of the projection centre of `main`, world axes, metres a second."""

    @property
    def angular_velocity_rad_s(self) -> NDArray[np.float64]:
        """Angular velocity about the axes of `main`, (3,), rad/s."""
        return np.radians(np.array(self.angular_velocity_deg_s))

    def pose_at(self, middle: Pose, time_s: float) -> Pose:
        """The pose `time_s` after mid-exposure."""
        # The camera turns by this rotation in its own axes; directions in camera axes turn by the inverse.
        turned = Rotation.from_rotvec(np.array(self.angular_velocity_deg_s) * time_s, degrees=True).as_matrix()
        moved = np.array(middle.position_m) + np.array(self.linear_velocity_m_s) * time_s
        return pose_of(moved, turned.T @ middle.rotation)


def poses_during(
    motion: Motion | None, mounted: Mounted, middle: Pose, exposure_s: float, scene: Scene
) -> tuple[Pose, ...]:
    """Poses of one camera, evenly spaced over the exposure (midpoint rule); `middle` is the pose of `main`.

    Raises InputError where the image moves by more than MAX_STEPS * STEP_PX.
    """
    if motion is None:
        return (mounted.posed(middle).pose,)
    ends = [mounted.posed(motion.pose_at(middle, time_s)) for time_s in (-exposure_s / 2, exposure_s / 2)]
    displacement_px = _max_displacement_px(ends, scene)
    steps = max(1, int(np.ceil(displacement_px / STEP_PX)))
    if steps > MAX_STEPS:
        raise InputError(
            f"motion: moves the image by {displacement_px:.0f} px during the exposure of {exposure_s} s; at most "
            f"{MAX_STEPS * STEP_PX:.0f} px are allowed"
        )
    times_s = ((np.arange(steps) + 0.5) / steps - 0.5) * exposure_s
    return tuple(mounted.posed(motion.pose_at(middle, float(time_s))).pose for time_s in times_s)


def _max_displacement_px(ends: list[PosedCamera], scene: Scene) -> float:
    """Largest displacement of an image point, pixels, among points on the sensor or within its width beside it."""
    size = np.array([ends[0].camera.width_px, ends[0].camera.height_px])
    grid = np.stack(np.meshgrid([0.0, 0.5, 1.0], [0.0, 0.5, 1.0]), axis=-1).reshape(-1, 2) * size
    centers = scene.leds.centers_m
    nearest_m = float(np.abs(centers[:, 2] - ends[0].pose.position_m[2]).min())
    around = [end.position_m + end.rays_world(grid) * nearest_m for end in ends]
    points: NDArray[np.float64] = np.concatenate([centers, *around])
    start, stop = (end.project(points) for end in ends)
    near = ((start >= -size) & (start <= 2 * size)).all(axis=1) | ((stop >= -size) & (stop <= 2 * size)).all(axis=1)
    way = np.hypot(*(stop - start).T)[near]
    return float(np.nanmax(way, initial=0.0))
