"""Tilt out: from a gravity reading to the homography that levels the camera (Huynh & Yoo 2016, Eqs. 5 to 10)."""

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.io.dataset import Accelerometer

# A ray lower than this above the horizon meets the ceiling some thousand room heights away.
MIN_SINE = 1e-3
# An accelerometer said to be without error is taken to have this one: 0.06 um at 3.5 m.
MIN_TILT_SIGMA_DEG = 1e-6


def tilt_from_gravity(accelerometer_m_s2: tuple[float, float, float]) -> tuple[float, float]:
    """The two angles gravity shows, (tilt_x, tilt_y) in radians, from a reading in camera axes.

    At rest the reading is `Rx(tilt_x) Ry(tilt_y) (0, 0, +9.80665)`; turning about the vertical, yaw, changes nothing.
    Raises EstimationFailure where the reading is zero.
    """
    x, y, z = accelerometer_m_s2
    size = float(np.linalg.norm(accelerometer_m_s2))
    if size == 0:
        raise EstimationFailure("rectify", "the accelerometer reads no gravity")
    return float(np.arctan2(y, z)), float(-np.arcsin(np.clip(x / size, -1, 1)))


def tilt_sigmas(accelerometer: Accelerometer, tilt_y: float) -> NDArray[np.float64]:
    """Standard deviations of the angles `tilt_from_gravity` gives, (2,), radians; never below BEST_TILT_DEG."""
    sigma = np.radians(max(accelerometer.error_deg, MIN_TILT_SIGMA_DEG))
    # tilt_x turns gravity's direction by cos(tilt_y) alone; where it is upright, tilt_x means nothing.
    lever = max(np.cos(tilt_y), MIN_SINE) if accelerometer.kind == "imu" else 1.0
    return np.array([sigma / lever, sigma])


def rotation(tilt_x: float, tilt_y: float) -> NDArray[np.float64]:
    """`R_cam_world`, (3, 3), for tilts in radians and no yaw: Eq. 5 multiplied out, which corrects Eq. 6."""
    cx, sx = np.cos(tilt_x), np.sin(tilt_x)
    cy, sy = np.cos(tilt_y), np.sin(tilt_y)
    return np.array([[cy, 0, -sy], [sx * sy, cx, sx * cy], [cx * sy, -sx, cx * cy]])


def printed_eq6(tilt_x: float, tilt_y: float) -> NDArray[np.float64]:
    """Eq. 6 as printed, (3, 3), at zeta = 0: two of its elements lack a factor, and it is no rotation once tilted."""
    cx, sx = np.cos(tilt_x), np.sin(tilt_x)
    cy, sy = np.cos(tilt_y), np.sin(tilt_y)
    return np.array([[cy, 0, -sy], [sx * sy, cx, sx], [0, -sx, cx * cy]])


def leveling_homography(K: NDArray[np.float64], R_cam_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """`K R^T K^-1`, (3, 3): takes pixels to those of a level camera at the same place (Eq. 10 without translation)."""
    return np.asarray(K @ R_cam_world.T @ np.linalg.inv(K))


def level(pixels: NDArray[np.float64], K: NDArray[np.float64], R_cam_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels (n, 2) as a level camera would see them, (n, 2); its image plane is endless, so they may be anywhere.

    Raises EstimationFailure where a pixel looks at or below the horizon: no level camera looking up sees that.
    """
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    leveled = homogeneous @ leveling_homography(K, R_cam_world).T
    rays = homogeneous @ np.linalg.inv(K).T
    if (leveled[:, 2] <= MIN_SINE * np.linalg.norm(rays, axis=1)).any():
        raise EstimationFailure("rectify", "a spot is at or below the horizon")
    return np.asarray(leveled[:, :2] / leveled[:, 2:])
