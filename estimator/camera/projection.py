"""World to pixels for any lens of the format, and how pixels move with the pose (datasets/FORMAT.md, Projection)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.camera.leveling import rotation
from estimator.io.dataset import Camera

Floats = NDArray[np.float64]

POSE_PARAMETERS = 6
"""Position x, y, z in metres, then tilt_x, tilt_y and yaw in radians: the order of every derivative by the pose."""
# What is less than this in front of a perspective lens, as a share of its distance, is beside it: 89.9 deg.
MIN_DEPTH_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class TiltedPose:
    """Where a camera is, (3,) world metres, and the rig's tilts and yaw in radians (FORMAT.md, Tilt)."""

    position_m: Floats
    tilt_x: float
    tilt_y: float
    yaw: float

    def R_rig_world(self) -> Floats:
        """`Rx(tilt_x) Ry(tilt_y) Rz(yaw)`, (3, 3)."""
        return np.asarray(rotation(self.tilt_x, self.tilt_y) @ _about_z(self.yaw))

    def moved(self, step: Floats) -> "TiltedPose":
        """This pose and a step (6,) of its parameters."""
        return TiltedPose(
            self.position_m + step[:3], self.tilt_x + step[3], self.tilt_y + step[4], float(self.yaw + step[5])
        )


@dataclass(frozen=True, eq=False)
class Projected:
    """Images of n points: `pixels` (n, 2), NaN where the lens does not image a point; `slopes` (n, 2, 6) by the pose.

    `p_cam` (n, 3) are the points in camera axes, metres. `light` (n,) is the light a pixel gets there from a surface of
    one luminance, up to a factor that is the same all over the sensor.
    """

    pixels: Floats
    slopes: Floats
    p_cam: Floats
    light: Floats


def pose_of_rotation(position_m: Floats, R_cam_world: Floats, camera: Camera) -> TiltedPose:
    """The pose of a camera at a position (3,) with a rotation (3, 3)."""
    R = np.array(camera.R_cam_rig).T @ R_cam_world
    # R[:, 2] = Rx Ry (0, 0, 1) and R = (Rx Ry) Rz.
    tilt_x, tilt_y = float(np.arctan2(R[1, 2], R[2, 2])), float(-np.arcsin(np.clip(R[0, 2], -1.0, 1.0)))
    turn = rotation(tilt_x, tilt_y).T @ R
    return TiltedPose(position_m, tilt_x, tilt_y, float(np.arctan2(turn[0, 1], turn[0, 0])))


def project(points_m: Floats, pose: TiltedPose, camera: Camera) -> Projected:
    """Images of world points (n, 3) and their derivatives by the pose."""
    R_cam_rig = np.array(camera.R_cam_rig)
    offset = points_m - pose.position_m
    R = R_cam_rig @ pose.R_rig_world()
    p_cam = offset @ R.T
    with np.errstate(all="ignore"):
        on_sensor, lens = _perspective(p_cam, camera) if camera.projection == "perspective" else _equidistant(p_cam)
    K = camera.matrix()
    pixels = on_sensor @ K[:2, :2].T + K[:2, 2]
    to_pixels = K[:2, :2] @ lens
    slopes = np.empty((len(points_m), 2, POSE_PARAMETERS))
    slopes[:, :, :3] = (to_pixels.reshape(-1, 3) @ -R).reshape(-1, 2, 3)
    for column, turn in enumerate(_rotation_slopes(pose), start=3):
        turned = offset @ (R_cam_rig @ turn).T
        slopes[:, :, column] = (to_pixels * turned[:, None]).sum(axis=2)
    return Projected(pixels, slopes, p_cam, _light(p_cam, lens))


def _light(p_cam: Floats, lens: Floats) -> Floats:
    """cos(theta), for the pupil seen at an angle, times the solid angle that an area of the sensor sees.

    With the rows m1, m2 of the lens's slope an area across the ray is imaged (m1 x m2) . p / |p| times as large, and a
    solid angle is area over |p|^2. For a pinhole this is cos^4(theta).
    """
    distance = np.linalg.norm(p_cam, axis=1)
    area = np.abs((np.cross(lens[:, 0], lens[:, 1]) * p_cam).sum(axis=1)) * distance
    return np.asarray(np.maximum(p_cam[:, 2], 0.0) / distance / area)


def _about_z(angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def _rotation_slopes(pose: TiltedPose) -> tuple[Floats, Floats, Floats]:
    """Derivatives of `Rx Ry Rz` by tilt_x, tilt_y and yaw, each (3, 3)."""
    about_x = np.array([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    about_y = np.array([[0.0, 0, -1], [0, 0, 0], [1, 0, 0]])
    about_z = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 0]])
    R, Rx = pose.R_rig_world(), rotation(pose.tilt_x, 0.0)
    return about_x @ R, Rx @ about_y @ Rx.T @ R, R @ about_z


def _perspective(p_cam: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """Places on the sensor (n, 2) in units of the image distance, and slopes (n, 2, 3) by the point."""
    x, y, z = p_cam.T
    seen = z > MIN_DEPTH_SHARE * np.linalg.norm(p_cam, axis=1)
    z = np.where(seen, z, np.nan)
    a, b = x / z, y / z
    slopes = np.zeros((len(p_cam), 2, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = 1 / z
    slopes[:, 0, 2], slopes[:, 1, 2] = -a / z, -b / z
    plane = np.column_stack([a, b])
    if camera.distortion is None:
        return plane, slopes
    d = camera.distortion
    r2 = a * a + b * b
    s = 1 + r2 * (d.k1 + r2 * (d.k2 + r2 * d.k3))
    s_slope = 2 * (d.k1 + r2 * (2 * d.k2 + r2 * 3 * d.k3))  # ds/da = s_slope a
    distorted = np.column_stack(
        [a * s + 2 * d.p1 * a * b + d.p2 * (r2 + 2 * a * a), b * s + d.p1 * (r2 + 2 * b * b) + 2 * d.p2 * a * b]
    )
    bend = np.empty((len(p_cam), 2, 2))
    bend[:, 0, 0] = s + a * a * s_slope + 2 * d.p1 * b + 6 * d.p2 * a
    bend[:, 0, 1] = bend[:, 1, 0] = a * b * s_slope + 2 * d.p1 * a + 2 * d.p2 * b
    bend[:, 1, 1] = s + b * b * s_slope + 6 * d.p1 * b + 2 * d.p2 * a
    # Beyond the fold the radius shrinks, or the image is the wrong way round: no pixel.
    folded = (np.linalg.det(bend) <= 0) | (s + r2 * s_slope <= 0)
    return np.where(folded[:, None], np.nan, distorted), bend @ slopes


def _equidistant(p_cam: Floats) -> tuple[Floats, Floats]:
    """As `_perspective`, of a fish-eye: (x, y) = theta (x, y) / rho."""
    x, y, z = p_cam.T
    rho = np.maximum(np.hypot(x, y), 1e-12 * np.abs(z))
    theta = np.arctan2(rho, z)
    size2 = rho * rho + z * z
    scale = theta / rho
    # d(theta)/d(rho) = z / size2 and d(theta)/dz = -rho / size2
    scale_slope = (z / size2 - scale) / (rho * rho)
    slopes = np.empty((len(p_cam), 2, 3))
    for row, along in enumerate((x, y)):
        slopes[:, row, 0] = along * x * scale_slope
        slopes[:, row, 1] = along * y * scale_slope
        slopes[:, row, row] += scale
        slopes[:, row, 2] = -along / size2
    return np.column_stack([x, y]) * scale[:, None], slopes
