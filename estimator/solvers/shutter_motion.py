"""Motion of a camera with a rolling shutter as parameters of a fit: its prior, and how it moves spots.

While a sensor is read out line after line, a camera in a hand moves: at 15 000 px to the image distance, 3000 lines of
10 us and 5 deg/s, spots are displaced by up to 20 px against the pose at mid-readout. The fits take the velocity
(`estimator.camera.motion`) as six parameters beside those of the pose, constant while a frame is read out, with a
normal prior, so that two or three spots, which do not determine it, still have a pose.

- With a reading of the gyroscope, the angular velocity is the reading, with the standard deviations of noise and bias.
- Without one it is 0, with HAND_RATE_SIGMA_DEG_S about each axis. The linear velocity is 0, with HAND_SPEED_SIGMA_M_S
  along each axis. Both are ours, for a device in a hand that is held still or swept slowly: they cover the motions of
  up to 20 deg/s and some 5 cm/s that docs/downlink.md is measured with. No source is claimed.

A global shutter has no such parameters.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.camera.motion import seen_in_motion, turned_back
from estimator.camera.pose import Pose
from estimator.io.device import DeviceFrame

Floats = NDArray[np.float64]

HAND_RATE_SIGMA_DEG_S = 20.0
HAND_SPEED_SIGMA_M_S = 0.05
# Lower limit of a gyroscope's error, for one that states none: 1e-5 deg/s, a nanometre at 3 m in 30 ms.
MIN_RATE_SIGMA_RAD_S = 2e-7


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """Expected velocity (6,) of a camera and its standard deviations (6,); see `estimator.camera.motion`."""

    velocity: Floats
    sigmas: Floats


def motion_prior(frame: DeviceFrame) -> MotionPrior | None:
    """Prior of the velocity while a frame is read out, by its gyroscope or of a hand; None for a global shutter."""
    if frame.camera.shutter.kind == "global":
        return None
    rate, sigmas = np.zeros(3), np.full(3, np.radians(HAND_RATE_SIGMA_DEG_S))
    if frame.gyro_rad_s is not None and frame.gyroscope is not None:
        rate = np.array(frame.gyro_rad_s)
        total = float(np.hypot(frame.gyroscope.noise_rad_s, frame.gyroscope.bias_rad_s))
        sigmas = np.full(3, max(total, MIN_RATE_SIGMA_RAD_S))
    speed = np.full(3, HAND_SPEED_SIGMA_M_S)
    return MotionPrior(np.concatenate([rate, np.zeros(3)]), np.concatenate([sigmas, speed]))


@dataclass(frozen=True, eq=False)
class ShutterMotion:
    """Times (n,) of n spots, seconds after the middle of the readout, and the prior of the camera's velocity."""

    times_s: Floats
    prior: MotionPrior

    def only(self, chosen: NDArray[np.bool_]) -> "ShutterMotion":
        """The chosen spots, (n,)."""
        return replace(self, times_s=self.times_s[chosen])

    def slopes(self, points_m: Floats, pose: Pose) -> Floats:
        """Derivatives (n, 2, 6) of points (n, 3) in the pinhole's image plane by the velocity, at that of the prior.

        A point that is not in front of the camera has none: 0.
        """
        seen = seen_in_motion(points_m, pose, self.prior.velocity, self.times_s)
        slopes = image_slopes(seen.p_cam) @ seen.by_motion
        slopes[seen.p_cam[:, 2] <= 0] = 0.0
        return np.asarray(slopes)

    def covariance(self, points_m: Floats, pose: Pose) -> Floats:
        """Covariance (2n, 2n) of points in the pinhole's image plane by the prior of the velocity."""
        flat = (self.slopes(points_m, pose) * self.prior.sigmas).reshape(2 * len(points_m), -1)
        return np.asarray(flat @ flat.T)

    def turned_back(self, image: Floats) -> Floats:
        """Spots (n, 2) in the pinhole's image plane as at mid-readout, by the prior's angular velocity."""
        return turned_back(image, self.prior.velocity, self.times_s)

    def residuals(self, velocity: Floats) -> Floats:
        """A velocity less that of the prior, in standard deviations, (6,)."""
        return np.asarray((velocity - self.prior.velocity) / self.prior.sigmas)


def image_slopes(p_cam: Floats) -> Floats:
    """Derivatives (n, 2, 3) of (x / z, y / z) by points (n, 3) in camera axes."""
    x, y, z = p_cam.T
    z = np.where(np.abs(z) < 1e-9, 1e-9, z)
    o = np.zeros_like(z)
    return np.array([[1 / z, o, -x / z**2], [o, 1 / z, -y / z**2]]).transpose(2, 0, 1)
