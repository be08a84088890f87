"""Accelerometers: the specific force that a device at rest reads, in camera axes.

Two models: the tilt errors of Huynh & Yoo 2016, and an inertial measurement unit with datasheet parameters.
"""

from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field
from scipy.spatial.transform import Rotation

from vlcrender.camera.intrinsics import Pose, rotation_cam_world, transform
from vlcrender.config.presets import preset
from vlcrender.config.toml_model import Settings, check
from vlcrender.core.random_keys import stream

STANDARD_GRAVITY_M_S2 = 9.80665
REFERENCE_TEMPERATURE_C = 25.0
"""Temperature at which datasheets state the zero-g offset."""


class TiltError(Settings):
    """The accelerometer of Huynh & Yoo 2016, section 3.3.2: an angle error on each tilt axis."""

    kind: Literal["tilt-error"] = "tilt-error"
    """Model of the accelerometer."""
    error_deg: Annotated[float, Field(ge=0, le=45)] = 0.1
    """Standard deviation of the independent normal errors on tilt_x and tilt_y, degrees."""

    def tilt_errors_deg(self, pose: Pose) -> tuple[float, float]:
        """Standard deviations of the errors on tilt_x and tilt_y, degrees; the same in every pose."""
        return self.error_deg, self.error_deg

    def reading_m_s2(self, pose: Pose, generator: np.random.Generator) -> NDArray[np.float64]:
        """Specific force at rest, shape (3,), camera axes: R_cam_world @ (0, 0, +g) of the tilts with their errors."""
        error_x, error_y = self.error_deg * generator.standard_normal(2)
        rotation = rotation_cam_world(pose.tilt_x_deg + error_x, pose.tilt_y_deg + error_y, 0.0)
        reading: NDArray[np.float64] = rotation @ np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2])
        return reading


class Imu(Settings):
    """The accelerometer of an inertial measurement unit, mounted on the camera with a small unknown misalignment.

    A reading is the mean of `samples` samples `round(M (R_imu_cam R_cam_world (0, 0, g)) + b + n)`:

    - M = I + scale errors on the diagonal + cross-axis sensitivities off the diagonal,
    - b = zero-g offset + drift with temperature from 25 deg C,
    - R_imu_cam = rotation by the misalignment's rotation vector,
    - n = white noise: density times sqrt(bandwidth * pi/2), the noise bandwidth of a first-order filter,
    - round = to the ADC's nearest number; its 2^bits numbers span +-range_g, and it saturates at both ends.

    M, b and R_imu_cam belong to one device: they are drawn from its `serial` and are the same in every frame and data
    set. Each of their components is normal with mean 0 and the standard deviation given here, the same for all axes, as
    "typical" values of datasheets are. Noise is drawn for each sample. The reading states the IMU's axes as the
    camera's: a device does not know its misalignment.
    """

    kind: Literal["imu"]
    """Model of the accelerometer."""
    bias_m_s2: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Standard deviation of the zero-g offset at 25 deg C, m/s2."""
    bias_drift_m_s2_per_k: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Standard deviation of the offset's drift with temperature, m/s2 per kelvin."""
    temperature_c: Annotated[float, Field(ge=-60, le=150)] = REFERENCE_TEMPERATURE_C
    """Temperature of the device, deg C."""
    scale_percent: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Standard deviation of each axis's sensitivity error, percent."""
    cross_axis_percent: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Standard deviation of each axis's sensitivity to acceleration along each other axis, percent."""
    misalignment_deg: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Standard deviation of the rotation between camera and device about each axis, degrees."""
    noise_density_ug_rthz: Annotated[float, Field(ge=0, le=1e5)] = 0.0
    """Noise density, micro-g per root hertz."""
    bandwidth_hz: Annotated[float, Field(gt=0, le=1e5)] = 100.0
    """-3 dB frequency of the device's low-pass filter, hertz."""
    samples: Annotated[int, Field(ge=1, le=10_000)] = 1
    """Samples averaged to one reading; their noise is independent."""
    range_g: Annotated[float, Field(ge=1, le=1000)] = 4.0
    """Full scale: each axis reads from -range_g to +range_g, in standard gravities."""
    bits: Annotated[int, Field(ge=8, le=24)] = 16
    """Bits of the ADC over the whole range."""
    serial: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Number of the individual device: its offset, sensitivity and misalignment derive from it."""

    @classmethod
    def preset(cls, name: str) -> Self:
        """The accelerometer of a preset, such as "bmi270". Raises InputError with the names there are."""
        return check(preset("accelerometers", name)["accelerometer"], cls, f"accelerometer preset {name}")

    @property
    def lsb_m_s2(self) -> float:
        """Step of the ADC, m/s2."""
        return 2 * self.range_g * STANDARD_GRAVITY_M_S2 / 2.0**self.bits

    @property
    def noise_m_s2(self) -> float:
        """Standard deviation of the noise of one sample, m/s2."""
        return self.noise_density_ug_rthz * 1e-6 * STANDARD_GRAVITY_M_S2 * float(np.sqrt(self.bandwidth_hz * np.pi / 2))

    @property
    def error_deg(self) -> float:
        """Standard deviation over devices of the error on each tilt axis, to first order, of a level device.

        A small acceleration a across gravity turns its direction by a / g: offset, drift, noise, rounding, and g times
        the cross-axis sensitivity. Misalignment adds its own angle. Scale errors turn gravity only where the device is
        tilted, by at most scale / sqrt(2) at 45 deg, and are left out. Rounding is not reduced by `samples`: it
        averages out only where noise exceeds the ADC's step.
        """
        across_m_s2 = (
            self.bias_m_s2,
            self.bias_drift_m_s2_per_k * (self.temperature_c - REFERENCE_TEMPERATURE_C),
            self.noise_m_s2 / np.sqrt(self.samples),
            self.lsb_m_s2 / np.sqrt(12),
            self.cross_axis_percent / 100 * STANDARD_GRAVITY_M_S2,
        )
        turned_deg = np.degrees(np.linalg.norm(across_m_s2) / STANDARD_GRAVITY_M_S2)
        return float(np.hypot(turned_deg, self.misalignment_deg))

    @property
    def shot_error_deg(self) -> float:
        """The part of `error_deg` that is new in each reading: noise and rounding."""
        across_m_s2 = (self.noise_m_s2 / np.sqrt(self.samples), self.lsb_m_s2 / np.sqrt(12))
        return float(np.degrees(np.linalg.norm(across_m_s2) / STANDARD_GRAVITY_M_S2))

    @property
    def device_error_deg(self) -> float:
        """The part of `error_deg` that stays with a device: offset, drift, cross-axis sensitivity and misalignment."""
        return float(np.sqrt(max(self.error_deg**2 - self.shot_error_deg**2, 0.0)))

    def tilt_errors_deg(self, pose: Pose) -> tuple[float, float]:
        """Standard deviations over devices of the errors on tilt_x and tilt_y in a pose, to first order.

        The direction of gravity in camera axes, (-sin y, sin x cos y, cos x cos y), errs by `error_deg` on each axis
        across it. Raising tilt_x by an angle turns the direction by cos(tilt_y) times that angle, so tilt_x errs by
        error_deg / cos(tilt_y).
        """
        return self.error_deg / float(np.cos(np.radians(pose.tilt_y_deg))), self.error_deg

    def reading_m_s2(self, pose: Pose, generator: np.random.Generator) -> NDArray[np.float64]:
        """Specific force that the device reads at rest in this pose, shape (3,), its own axes taken as camera axes."""
        gravity_imu = transform(self._rotation_imu_cam() @ pose.rotation, np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2]))
        noise = self.noise_m_s2 * generator.standard_normal((self.samples, 3))
        samples = transform(self._sensitivity(), gravity_imu) + self._offset_m_s2() + noise
        half = 2 ** (self.bits - 1)
        reading: NDArray[np.float64] = np.clip(np.rint(samples / self.lsb_m_s2), -half, half - 1).mean(axis=0)
        return reading * self.lsb_m_s2

    def _device_normals(self, name: str, shape: tuple[int, ...] = (3,)) -> NDArray[np.float64]:
        """Standard normal numbers of this device's property `name`; the same in every frame."""
        return stream(self.serial, 0, f"imu {name}").standard_normal(shape)

    def _offset_m_s2(self) -> NDArray[np.float64]:
        drift = self.bias_drift_m_s2_per_k * (self.temperature_c - REFERENCE_TEMPERATURE_C)
        return self.bias_m_s2 * self._device_normals("bias") + drift * self._device_normals("bias drift")

    def _sensitivity(self) -> NDArray[np.float64]:
        scale = self.scale_percent / 100 * self._device_normals("scale")
        cross = self.cross_axis_percent / 100 * self._device_normals("cross-axis", (3, 3))
        np.fill_diagonal(cross, 1 + scale)
        return cross

    def _rotation_imu_cam(self) -> NDArray[np.float64]:
        vector_deg = self.misalignment_deg * self._device_normals("misalignment")
        return Rotation.from_rotvec(vector_deg, degrees=True).as_matrix()


AnyAccelerometer = TiltError | Imu


def _tilt_error_by_default(table: Any) -> Any:
    """Give a table without a kind the kind of the paper's model."""
    return {"kind": "tilt-error", **table} if isinstance(table, dict) else table


Accelerometer = Annotated[AnyAccelerometer, Field(discriminator="kind"), BeforeValidator(_tilt_error_by_default)]
