"""Gyroscopes: the angular velocity that a device reads."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vlcrender.config.toml_model import Settings

Rate = Annotated[float, Field(ge=0, le=1000)]


class Gyroscope(Settings):
    """A gyroscope on the camera `main`: a bias that stays with the device, and noise that is new in each shot."""

    noise_deg_s: Rate
    """Standard deviation of a reading's noise about each axis, deg/s; a reading is the mean over a frame's readout."""
    bias_deg_s: Rate
    """Standard deviation, over devices, of the bias about each axis, deg/s."""

    @property
    def noise_rad_s(self) -> float:
        """Standard deviation of the noise about each axis, rad/s."""
        return float(np.radians(self.noise_deg_s))

    @property
    def bias_rad_s(self) -> float:
        """Standard deviation of the bias about each axis, rad/s."""
        return float(np.radians(self.bias_deg_s))

    def reading_rad_s(
        self, angular_velocity_rad_s: NDArray[np.float64], device: np.random.Generator, shot: np.random.Generator
    ) -> NDArray[np.float64]:
        """Reading (3,) of an angular velocity (3,), rad/s, same axes. Generators of the device's bias and the noise."""
        bias = self.bias_rad_s * device.standard_normal(3)
        reading: NDArray[np.float64] = angular_velocity_rad_s + bias + self.noise_rad_s * shot.standard_normal(3)
        return reading
