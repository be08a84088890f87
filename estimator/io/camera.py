"""Cameras as devices know them: intrinsics, distortion, pose on the rig, and their uncertainty (datasets/FORMAT.md)."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from estimator.io.records import Entry, Rotation, Share, Triple
from estimator.io.shutter import GLOBAL, Shutter

Floats = NDArray[np.float64]


def normalized(pixels: Floats, K: Floats) -> Floats:
    """Normalized image coordinates (n, 2), `K^-1 [u, v, 1]`, in units of the image distance, of pixels (n, 2).

    `K` is upper triangular.
    """
    (fx, skew, _), (_, fy, _) = K[:2].tolist()
    inverse = np.array([[1 / fx, -skew / (fx * fy)], [0.0, 1 / fy]])
    return np.asarray((pixels - K[:2, 2]) @ inverse.T)


def to_pixels(image: Floats, K: Floats) -> Floats:
    """Pixels (n, 2), `K [x, y, 1]`, of normalized image coordinates (n, 2): the inverse of `normalized`."""
    return np.asarray(image @ K[:2, :2].T + K[:2, 2])


Length = Annotated[float, Field(gt=0, le=1e6)]
Coefficient = Annotated[float, Field(ge=-100, le=100)]
Sigma = Annotated[float, Field(ge=0, le=1e6)]
MAX_DISTANCE_ERROR = 1e-12
"""Relative difference of `image_distance_mm` from the mean of fx and fy: rounding of a double."""
MAX_KERNEL_ERROR = 1e-6
MAX_SKEW_PX = 1e4


class Distortion(Entry):
    """Brown-Conrady coefficients in OpenCV's convention, for normalized image coordinates.

    Other keys are refused: without a coefficient of the calibration, undistorted pixels would be wrong.
    """

    k1: Coefficient
    k2: Coefficient
    k3: Coefficient
    p1: Coefficient
    p2: Coefficient

    @model_validator(mode="before")
    @classmethod
    def _no_other_coefficients(cls, entry: Any) -> Any:
        if isinstance(entry, Mapping) and (unknown := [key for key in entry if key not in cls.model_fields]):
            raise ValueError(f"unknown key {unknown[0]!r}; allowed: {', '.join(cls.model_fields)}")
        return entry


IntrinsicName = Literal["focal", "aspect", "cx_px", "cy_px", "k1", "p1", "p2"]
INTRINSICS: tuple[IntrinsicName, ...] = ("focal", "aspect", "cx_px", "cy_px", "k1", "p1", "p2")
"""Names of the errors of a camera's intrinsics, in the order of all arrays of them.

True from stated: fx (1 + focal) (1 + aspect / 2), fy (1 + focal) (1 - aspect / 2), cx + cx_px, cy + cy_px, and the
coefficients of distortion plus k1, p1, p2. `focal` and `aspect` are relative, cx_px and cy_px in pixels.
"""


class CameraUncertainty(Entry):
    """Standard deviations of the stated intrinsics and mounting of a camera; keys as in dataset.json.

    The errors are independent and normal. Those of `device_sigma` are the same in every frame of a device, those of
    `shot_sigma` new in every frame. `offset_sigma_m` and `rotation_sigma_deg` are those of the mounting on the rig,
    along and about each axis.
    """

    parameters: tuple[IntrinsicName, ...]
    device_sigma: tuple[Sigma, ...]
    shot_sigma: tuple[Sigma, ...]
    offset_sigma_m: Sigma
    rotation_sigma_deg: Sigma

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        if len(set(self.parameters)) != len(self.parameters):
            raise ValueError("parameters have to be unique")
        if not len(self.parameters) == len(self.device_sigma) == len(self.shot_sigma):
            raise ValueError("device_sigma and shot_sigma need one number for each of parameters")
        return self

    def device_sigmas(self) -> Floats:
        """Standard deviations (7,) of the errors of a device, in the order of INTRINSICS; 0 where there is no entry."""
        return self._in_order(self.device_sigma)

    def shot_sigmas(self) -> Floats:
        """Standard deviations (7,) of the errors of a frame, in the order of INTRINSICS; 0 where there is no entry."""
        return self._in_order(self.shot_sigma)

    def _in_order(self, sigmas: tuple[float, ...]) -> Floats:
        stated: dict[str, float] = dict(zip(self.parameters, sigmas, strict=True))
        return np.array([stated.get(name, 0.0) for name in INTRINSICS])


class Camera(Entry):
    """Camera of a device: intrinsics, lens, and mounting on the rig; keys as in dataset.json.

    `K` maps normalized image coordinates to continuous pixels with pixel centres at +0.5. `uncertainty` is None where
    the device does not state how well it knows its camera; deviations of 0 state that the camera is exact.
    """

    width_px: int = Field(ge=8, le=20000)
    height_px: int = Field(ge=8, le=20000)
    K: tuple[Triple, Triple, Triple]
    pixel_pitch_um: Length
    focal_length_mm: Length
    image_distance_mm: Length
    f_number: Length
    projection: Literal["perspective", "equidistant"]
    distortion: Distortion | None
    focus_distance_m: Length | Literal["infinity"] | None
    psf: Literal["none", "diffraction", "measured"]
    psf_wavelength_nm: Length
    psf_kernel: tuple[tuple[Share, ...], ...] | None
    R_cam_rig: Rotation
    offset_m: Triple
    uncertainty: CameraUncertainty | None = None
    shutter: Shutter = GLOBAL

    @field_validator("K")
    @classmethod
    def _upper_triangular(cls, k: tuple[Triple, Triple, Triple]) -> tuple[Triple, Triple, Triple]:
        if k[0][0] <= 0 or k[1][1] <= 0 or k[1][0] != 0 or k[2] != (0.0, 0.0, 1.0):
            raise ValueError("K has to be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0")
        return k

    @model_validator(mode="after")
    def _image_is_near_the_axis(self) -> Self:
        (fx, skew, u), (_, fy, v), _ = self.K
        if not (-self.width_px <= u <= 2 * self.width_px and -self.height_px <= v <= 2 * self.height_px):
            raise ValueError("K: the principal point has to lie at most one image beside the image")
        if not (0.5 <= fx / fy <= 2 and abs(skew) <= MAX_SKEW_PX):
            raise ValueError(f"K: fx / fy has to be from 0.5 to 2, and the skew at most {MAX_SKEW_PX:g} px")
        return self

    @model_validator(mode="after")
    def _focal_lengths_agree(self) -> Self:
        in_pixels = (self.K[0][0] + self.K[1][1]) / 2
        image_distance_px = self.image_distance_mm * 1000 / self.pixel_pitch_um
        if not abs(image_distance_px - in_pixels) <= MAX_DISTANCE_ERROR * in_pixels:
            raise ValueError("image_distance_mm over the pixel pitch has to be the mean of fx and fy of K")
        return self

    @model_validator(mode="after")
    def _kernel_where_measured(self) -> Self:
        rows = self.psf_kernel
        if (rows is None) != (self.psf != "measured"):
            raise ValueError('psf_kernel has to be given with psf "measured", and only then')
        if rows is not None:
            if len(rows) % 2 == 0 or len(rows) > 255 or any(len(row) != len(rows) for row in rows):
                raise ValueError("psf_kernel has to be square, with an odd number of rows of at most 255")
            if abs(sum(map(sum, rows)) - 1) > MAX_KERNEL_ERROR:
                raise ValueError("psf_kernel has to have the sum 1")
        return self

    @model_validator(mode="after")
    def _no_distortion_of_a_fish_eye(self) -> Self:
        if self.projection == "equidistant" and self.distortion is not None:
            raise ValueError('distortion has to be null with projection "equidistant"')
        if self.projection == "equidistant" and self.uncertainty is not None:
            of_distortion = [INTRINSICS.index(name) for name in ("k1", "p1", "p2")]
            if (self.uncertainty.device_sigmas() + self.uncertainty.shot_sigmas())[of_distortion].any():
                raise ValueError('sigmas of k1, p1 and p2 have to be 0 with projection "equidistant"')
        return self

    @property
    def states_no_errors(self) -> bool:
        """Whether the device states no error of the intrinsics: that they are exact, or nothing of them."""
        stated = self.uncertainty
        return stated is None or not any((*stated.device_sigma, *stated.shot_sigma))

    def matrix(self) -> Floats:
        """`K` as a (3, 3) array, pixels."""
        return np.array(self.K, dtype=np.float64)

    def normalized(self, pixels: Floats) -> Floats:
        """Normalized image coordinates (n, 2) of this camera's pixels (n, 2)."""
        return normalized(pixels, self.matrix())

    def to_pixels(self, image: Floats) -> Floats:
        """This camera's pixels (n, 2) of normalized image coordinates (n, 2)."""
        return to_pixels(image, self.matrix())

    @property
    def pixel_angle_rad(self) -> float:
        """Angle of one pixel on the optical axis, 1 / fx, radians."""
        return 1 / self.K[0][0]

    @property
    def line_count(self) -> int:
        """Lines that the shutter reads: rows of the sensor, or columns."""
        return self.shutter.line_count(self.width_px, self.height_px)

    def line_of(self, u_px: Floats, v_px: Floats) -> Floats:
        """Continuous line coordinates, in readout order, of pixels (u, v) of any shape: line i is from i to i + 1."""
        return self.shutter.line_of(u_px, v_px, self.width_px, self.height_px)

    def times_s(self, u_px: Floats, v_px: Floats) -> Floats:
        """Middle of the exposure of pixels (u, v) of any shape, relative to the frame's middle line, seconds."""
        return (self.line_of(u_px, v_px) - self.line_count / 2) * self.shutter.row_time_s

    def R_cam_rig_array(self) -> Floats:
        """`R_cam_rig` as a (3, 3) array."""
        return np.array(self.R_cam_rig, dtype=np.float64)
