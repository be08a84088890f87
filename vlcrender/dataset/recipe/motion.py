"""Motion of the rig: poses of a camera during a frame, for the midpoint rule and for the lines of a rolling shutter."""

from collections.abc import Callable
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from vlcrender.camera.intrinsics import Pose, transform
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import Mounted, pose_of
from vlcrender.camera.shutter import RollingShutter
from vlcrender.config.toml_model import Settings
from vlcrender.errors import InputError
from vlcrender.rendering.readout import LinePoses, RollingPoses, knots_of
from vlcrender.scene.loader import Scene

STEP_PX = 0.5
"""Largest motion of an image point from one pose to the next, pixels. The midpoint rule then smooths an edge by at most
(1/4 px) / sqrt(3) in addition to the pixel's own area."""
KNOTS_A_STEP = 4
"""Knots of a rolling readout for each STEP_PX of motion. Of 1/8 px between two knots, a pixel of an edge errs by a
quarter at most, 3 % of the LED's light, where its coverage has a kink. With 1/2 px such errors exceed the shot noise of
LEDs of some 1000 electrons."""
MAX_STEPS = 2000
"""Largest number of poses in an exposure, or of steps in a readout."""
MAX_LINE_PX = 0.5
"""Largest motion of the image from line to line of a rolling shutter: at 1 px an image would run along with it."""

AngularVelocity = Annotated[float, Field(ge=-1e5, le=1e5)]
LinearVelocity = Annotated[float, Field(ge=-1e3, le=1e3)]


class Motion(Settings):
    """Constant velocities. The pose of a frame is its pose in the middle of its middle line's exposure."""

    angular_velocity_deg_s: tuple[AngularVelocity, AngularVelocity, AngularVelocity] = (0.0, 0.0, 0.0)
    """Angular velocity about the axes of the camera `main`, right-handed, degrees a second."""
    linear_velocity_m_s: tuple[LinearVelocity, LinearVelocity, LinearVelocity] = (0.0, 0.0, 0.0)
    """Velocity of the projection centre of `main`, world axes, metres a second."""

    @property
    def angular_velocity_rad_s(self) -> NDArray[np.float64]:
        """Angular velocity about the axes of `main`, (3,), rad/s."""
        velocity: NDArray[np.float64] = np.radians(np.array(self.angular_velocity_deg_s))
        return velocity

    @property
    def at_rest(self) -> bool:
        """Whether both velocities are 0."""
        return not (any(self.angular_velocity_deg_s) or any(self.linear_velocity_m_s))

    def velocities_of(self, mounted: Mounted, main: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Velocities of a camera with `main` at a pose: angular about its own axes, rad/s; linear, world axes, m/s."""
        swing = np.cross(self.angular_velocity_rad_s, mounted.offset_m)
        linear = np.array(self.linear_velocity_m_s) + transform(main.rotation.T, swing)
        return transform(mounted.rotation, self.angular_velocity_rad_s), linear

    def pose_at(self, middle: Pose, time_s: float) -> Pose:
        """The pose `time_s` after the pose `middle`."""
        # The camera turns by this rotation in its own axes; directions in camera axes turn by the inverse.
        turned = Rotation.from_rotvec(np.array(self.angular_velocity_deg_s) * time_s, degrees=True).as_matrix()
        moved = np.array(middle.position_m) + np.array(self.linear_velocity_m_s) * time_s
        return pose_of(moved, turned.T @ middle.rotation)


def poses_during(
    motion: Motion | None, mounted: Mounted, middle: Pose, exposure_s: float, scene: Scene
) -> tuple[Pose, ...] | RollingPoses:
    """Poses of one camera during a frame; `middle` is the pose of `main` in the middle of the camera's middle line.

    Evenly spaced over the exposure (midpoint rule); of each line, where the camera moves and its shutter rolls. Raises
    InputError where the image moves by more than MAX_STEPS * STEP_PX, or by more than MAX_LINE_PX from line to line.
    """
    if motion is None:
        return (mounted.posed(middle).pose,)
    moving = motion

    def posed_at(time_s: float) -> PosedCamera:
        return mounted.posed(moving.pose_at(middle, time_s))

    steps = _steps(posed_at, exposure_s, scene, f"during the exposure of {exposure_s} s")
    times_s = ((np.arange(steps) + 0.5) / steps - 0.5) * exposure_s
    camera, shutter = mounted.camera, mounted.camera.shutter
    if not isinstance(shutter, RollingShutter) or motion.at_rest:
        return tuple(posed_at(float(time_s)).pose for time_s in times_s)
    lines = shutter.line_count(camera.width_px, camera.height_px)
    readout_s = (lines - 1) * shutter.row_time_s
    intervals = _steps(posed_at, readout_s, scene, f"during the readout of {lines} lines in {readout_s:.4g} s")
    line_px = intervals * STEP_PX / (lines - 1)
    if intervals > 1 and line_px > MAX_LINE_PX:
        raise InputError(
            f"motion: moves the image by up to {line_px:.2f} px from line to line; a rolling shutter images at most "
            f"{MAX_LINE_PX} px: lower the velocity or camera.shutter.row_time_us"
        )

    def line_s(line: float) -> float:
        u_v = (0.5 * camera.width_px, line + 0.5) if shutter.along_rows else (line + 0.5, 0.5 * camera.height_px)
        return float(camera.times_s(*u_v))

    def poses_of_line(line: float) -> list[Pose]:
        return [posed_at(line_s(line) + float(time_s)).pose for time_s in times_s]

    of_lines_s = np.array([line_s(line) for line in range(lines)])
    return RollingPoses(
        steps=tuple(
            _line_poses(moving, mounted, middle, of_lines_s + time_s, shutter.along_rows) for time_s in times_s
        ),
        knots=knots_of(camera, min(KNOTS_A_STEP * intervals, lines - 1) + 1, poses_of_line),
        pose_at=lambda time_s: posed_at(time_s).pose,
    )


def _line_poses(
    motion: Motion, mounted: Mounted, middle: Pose, times_s: NDArray[np.float64], along_rows: bool
) -> LinePoses:
    """Poses of one camera at many times (n,), as `Motion.pose_at` and `Mounted.posed` give them one by one."""
    turned = Rotation.from_rotvec(times_s[:, None] * motion.angular_velocity_rad_s).as_matrix()
    # not `@`: the last bits of a matrix product may depend on threads and processor
    of_main = np.einsum("nji,jk->nik", turned, middle.rotation)
    offsets_m = np.einsum("nji,j->ni", of_main, mounted.offset_m)
    positions_m = np.array(middle.position_m) + times_s[:, None] * np.array(motion.linear_velocity_m_s) + offsets_m
    return LinePoses(positions_m, np.einsum("ij,njk->nik", mounted.rotation, of_main), along_rows)


def _steps(posed_at: Callable[[float], PosedCamera], duration_s: float, scene: Scene, during: str) -> int:
    """Number of parts of a duration in each of which the image moves by at most STEP_PX."""
    displacement_px = _max_displacement_px([posed_at(time_s) for time_s in (-duration_s / 2, duration_s / 2)], scene)
    steps = max(1, int(np.ceil(displacement_px / STEP_PX)))
    if steps > MAX_STEPS:
        raise InputError(
            f"motion: moves the image by {displacement_px:.0f} px {during}; at most {MAX_STEPS * STEP_PX:.0f} px are "
            "allowed"
        )
    return steps


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
