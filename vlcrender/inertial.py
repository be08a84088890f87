"""The accelerometer: what a device at rest reads, in camera axes."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vlcrender.camera import Pose, rotation_cam_world
from vlcrender.settings import Settings

STANDARD_GRAVITY_M_S2 = 9.80665


class Accelerometer(Settings):
    """The accelerometer of Huynh & Yoo 2016, section 3.3.2: an angle error on each tilt axis."""

    error_deg: Annotated[float, Field(ge=0, le=45)] = 0.1
    """Standard deviation of the error on tilt_x and on tilt_y, which are independent and normal."""

    def reading_m_s2(self, pose: Pose, generator: np.random.Generator) -> NDArray[np.float64]:
        """Specific force at rest, shape (3,), camera axes: R_cam_world @ (0, 0, +g) of the tilts with their errors."""
        error_x, error_y = self.error_deg * generator.standard_normal(2)
        rotation = rotation_cam_world(pose.tilt_x_deg + error_x, pose.tilt_y_deg + error_y, 0.0)
        reading: NDArray[np.float64] = rotation @ np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2])
        return reading
