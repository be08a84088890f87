"""The accelerometer: what a device at rest reads, in camera axes, with the paper's errors or a real part's."""

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
"""At which datasheets state the zero-g offset."""


class TiltError(Settings):
    """The accelerometer of Huynh & Yoo 2016, section 3.3.2: an angle error on each tilt axis."""

    kind: Literal["tilt-error"] = "tilt-error"
    error_deg: Annotated[float, Field(ge=0, le=45)] = 0.1
    """Standard deviation of the error on tilt_x and on tilt_y, which are independent and normal."""

    def tilt_errors_deg(self, pose: Pose) -> tuple[float, float]:
        """Standard deviations of the errors on tilt_x and tilt_y: the same in every pose."""
        return self.error_deg, self.error_deg

    def reading_m_s2(self, pose: Pose, generator: np.random.Generator) -> NDArray[np.float64]:
        """Specific force at rest, shape (3,), camera axes: R_cam_world @ (0, 0, +g) of the tilts with their errors."""
        error_x, error_y = self.error_deg * generator.standard_normal(2)
        rotation = rotation_cam_world(pose.tilt_x_deg + error_x, pose.tilt_y_deg + error_y, 0.0)
        reading: NDArray[np.float64] = rotation @ np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2])
        return reading


class Imu(Settings):
    """The accelerometer of an inertial measurement unit, fixed to the camera but for a small unknown rotation.

    One sample is `round(M (R_imu_cam R_cam_world (0, 0, g)) + b + n)`, a reading the mean of `samples` of them:

    - M = I + scale errors on the diagonal + cross-axis sensitivities off it,
    - b = zero-g offset + its drift with temperature, from the reference of 25 deg C,
    - R_imu_cam = the rotation by the misalignment's rotation vector,
    - n = white noise of the density times sqrt(bandwidth * pi/2), the noise bandwidth of a first-order filter,
    - round = to the converter's nearest number, its range of +-range_g being 2^bits of them; it saturates at the ends.

    M, b and R_imu_cam belong to one device: they are drawn from its `serial`, the same in every frame and data set.
    Each of their numbers is normal with mean 0 and the standard deviation given here, for each axis alike; "typical"
    values of datasheets are such. Noise is drawn for each sample. What an axis gets is read as the camera's axis:
    nobody knows better.
    """

    kind: Literal["imu"]
    bias_m_s2: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Zero-g offset at 25 deg C."""
    bias_drift_m_s2_per_k: Annotated[float, Field(ge=0, le=1)] = 0.0
    temperature_c: Annotated[float, Field(ge=-60, le=150)] = REFERENCE_TEMPERATURE_C
    scale_percent: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Error of the sensitivity."""
    cross_axis_percent: Annotated[float, Field(ge=0, le=20)] = 0.0
    """What an axis reads of an acceleration along each of the others."""
    misalignment_deg: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Rotation between camera and device, about each axis."""
    noise_density_ug_rthz: Annotated[float, Field(ge=0, le=1e5)] = 0.0
    """Micro-g over the root of a hertz."""
    bandwidth_hz: Annotated[float, Field(gt=0, le=1e5)] = 100.0
    """Frequency at which the filter has lost 3 dB."""
    samples: Annotated[int, Field(ge=1, le=10_000)] = 1
    """Samples averaged to a reading, far enough apart in time that their noise is independent."""
    range_g: Annotated[float, Field(ge=1, le=1000)] = 4.0
    bits: Annotated[int, Field(ge=8, le=24)] = 16
    serial: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Which device of its kind it is."""

    @classmethod
    def preset(cls, name: str) -> Self:
        """The accelerometer of a preset, such as "bmi270". Raises InputError with the names there are."""
        return check(preset("accelerometers", name)["accelerometer"], cls, f"accelerometer preset {name}")

    @property
    def lsb_m_s2(self) -> float:
        """Step of the converter."""
        return 2 * self.range_g * STANDARD_GRAVITY_M_S2 / 2.0**self.bits

    @property
    def noise_m_s2(self) -> float:
        """Standard deviation of the noise of a sample."""
        return self.noise_density_ug_rthz * 1e-6 * STANDARD_GRAVITY_M_S2 * float(np.sqrt(self.bandwidth_hz * np.pi / 2))

    @property
    def error_deg(self) -> float:
        """Standard deviation over devices of the error on each tilt axis, to first order, of a level device.

        A small acceleration a across gravity turns its direction by a / g: offset, drift, noise and rounding do so, and
        g times the cross-axis sensitivity; misalignment turns it by itself. Scale errors turn it only where the device
        is tilted, by at most scale / sqrt(2) at 45 deg. Rounding is counted whole: it averages away only where noise
        is larger than the converter's step.
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

    def tilt_errors_deg(self, pose: Pose) -> tuple[float, float]:
        """Standard deviations over devices of the errors on tilt_x and tilt_y in a pose, to first order.

        Gravity's direction in camera axes, (-sin y, sin x cos y, cos x cos y), is off by `error_deg` either way.
        Raising tilt_x turns it by cos(tilt_y) alone, so that tilt_x is off by the more.
        """
        return self.error_deg / float(np.cos(np.radians(pose.tilt_y_deg))), self.error_deg

    def reading_m_s2(self, pose: Pose, generator: np.random.Generator) -> NDArray[np.float64]:
        """What the device reads at rest in this pose, shape (3,), in what it takes for camera axes."""
        gravity_imu = transform(self._rotation_imu_cam() @ pose.rotation, np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2]))
        noise = self.noise_m_s2 * generator.standard_normal((self.samples, 3))
        samples = transform(self._sensitivity(), gravity_imu) + self._offset_m_s2() + noise
        half = 2 ** (self.bits - 1)
        reading: NDArray[np.float64] = np.clip(np.rint(samples / self.lsb_m_s2), -half, half - 1).mean(axis=0)
        return reading * self.lsb_m_s2

    def _of_this_device(self, what: str, shape: tuple[int, ...] = (3,)) -> NDArray[np.float64]:
        """Standard normal numbers that this device has for ever, apart for each of its properties."""
        return stream(self.serial, 0, f"imu {what}").standard_normal(shape)

    def _offset_m_s2(self) -> NDArray[np.float64]:
        drift = self.bias_drift_m_s2_per_k * (self.temperature_c - REFERENCE_TEMPERATURE_C)
        return self.bias_m_s2 * self._of_this_device("bias") + drift * self._of_this_device("bias drift")

    def _sensitivity(self) -> NDArray[np.float64]:
        scale = self.scale_percent / 100 * self._of_this_device("scale")
        cross = self.cross_axis_percent / 100 * self._of_this_device("cross-axis", (3, 3))
        np.fill_diagonal(cross, 1 + scale)
        return cross

    def _rotation_imu_cam(self) -> NDArray[np.float64]:
        vector_deg = self.misalignment_deg * self._of_this_device("misalignment")
        return Rotation.from_rotvec(vector_deg, degrees=True).as_matrix()


AnyAccelerometer = TiltError | Imu


def _paper_unless_said(table: Any) -> Any:
    """A table without a kind is the paper's: recipes from before there were two."""
    return {"kind": "tilt-error", **table} if isinstance(table, dict) else table


Accelerometer = Annotated[AnyAccelerometer, Field(discriminator="kind"), BeforeValidator(_paper_unless_said)]
