"""Leveling by gravity: from an accelerometer reading to a level camera's pixels (Huynh & Yoo 2016, Eqs. 5 to 10)."""

import math

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.io.camera import normalized, to_pixels
from estimator.io.device import Accelerometer

Floats = NDArray[np.float64]

# A ray at a smaller sine of elevation meets the ceiling some thousand room heights away.
MIN_ELEVATION_SINE = 1e-3
# Lower limit of the accelerometer's error, for devices that state none: 0.06 um at 3.5 m.
MIN_TILT_SIGMA_DEG = 1e-6


def tilt_from_gravity(accelerometer_m_s2: tuple[float, float, float] | None) -> tuple[float, float]:
    """Tilts (tilt_x, tilt_y), radians, from an accelerometer reading (x, y, z) in camera axes.

    At rest the reading is `Rx(tilt_x) Ry(tilt_y) (0, 0, +9.80665)`; it does not depend on yaw. Raises
    EstimationFailure for a reading of zero, and without one.
    """
    if accelerometer_m_s2 is None:
        raise EstimationFailure("leveling", "the device has no accelerometer")
    x, y, z = accelerometer_m_s2
    magnitude = math.hypot(x, y, z)
    if magnitude == 0:
        raise EstimationFailure("leveling", "the accelerometer reads no gravity")
    return math.atan2(y, z), -math.asin(min(max(x / magnitude, -1.0), 1.0))


def tilt_sigmas(accelerometer: Accelerometer, tilt_y: float) -> Floats:
    """Standard deviations (2,), radians, of the tilts by `tilt_from_gravity`; at least MIN_TILT_SIGMA_DEG."""
    sigma = np.radians(max(accelerometer.error_deg, MIN_TILT_SIGMA_DEG))
    # tilt_x turns the direction of gravity by cos(tilt_y) only; at tilt_y = 90 deg it is undefined.
    lever = max(np.cos(tilt_y), MIN_ELEVATION_SINE) if accelerometer.kind == "imu" else 1.0
    return np.array([sigma / lever, sigma])


def printed_eq6(tilt_x: float, tilt_y: float) -> Floats:
    """Eq. 6 as printed, (3, 3), at zeta = 0: two elements lack a factor, so it is no rotation once both tilts are set.

    The corrected equation is `estimator.camera.pose.rotation`.
    """
    cx, sx = np.cos(tilt_x), np.sin(tilt_x)
    cy, sy = np.cos(tilt_y), np.sin(tilt_y)
    return np.array([[cy, 0, -sy], [sx * sy, cx, sx], [0, -sx, cx * cy]])


def level(pixels: Floats, K: Floats, R_cam_world: Floats) -> Floats:
    """Pixels (n, 2) of a level camera at the same place, by the homography `K R^T K^-1` (Eq. 10 without translation).

    The level camera's image plane is unlimited, so the pixels may lie beyond the sensor. Raises EstimationFailure for a
    pixel at or below the horizon.
    """
    image = normalized(pixels, K)
    rays = np.column_stack([image, np.ones(len(image))])
    level_rays = rays @ R_cam_world
    if (level_rays[:, 2] <= MIN_ELEVATION_SINE * np.linalg.norm(rays, axis=1)).any():
        raise EstimationFailure("leveling", "a spot is at or below the horizon")
    return to_pixels(level_rays[:, :2] / level_rays[:, 2:], K)
