"""The camera: intrinsics, pose, and the one place that turns our axes into Mitsuba's.

Camera axes are OpenCV's: x right, y down, z forward. The level pose looks straight up with R_cam_world = I.
Pixels are continuous (u, v) = (column, row), (0, 0) at the image's top-left corner, pixel centres at +0.5.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, ValidatorFunctionWrapHandler, WrapValidator, model_validator

from vlcrender.camera.distortion import Distortion, distort, fold_radius2, folds, undistort
from vlcrender.config.toml_model import Settings

Pixels = Annotated[int, Field(ge=8, le=20000)]
Positive = Annotated[float, Field(gt=0, le=1e6)]

MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0])
"""Mitsuba's camera looks along +z with x to the image's left and y up; ours has x right and y down."""

BEYOND_SENSOR = 1 / 20
"""A lens has to be sane out to this share of the sensor's width and height beyond its borders."""
ON_AXIS = 1e-30
"""Added to squared radii: 0 / 0 on the axis becomes its limit, and nothing else changes, in float32 as in float64."""


def _number_or_infinity(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
    try:
        return handler(value)
    except ValidationError:
        # a union's own errors name its members, of which a TOML file knows nothing
        raise ValueError('has to be a distance in m above 0, or "infinity"') from None


FocusDistance = Annotated[Positive | Literal["infinity"] | None, WrapValidator(_number_or_infinity)]


class Camera(Settings):
    """A camera and its lens. The defaults are Table 1 of Huynh & Yoo 2016 at f/2.2, sharp everywhere."""

    width_px: Pixels = 4000
    height_px: Pixels = 3000
    pixel_pitch_um: Positive = 1.2
    focal_length_mm: Positive = 18.0
    f_number: Annotated[float, Field(ge=0.5, le=100)] = 2.2
    principal_point_px: tuple[float, float] | None = None
    """Where the optical axis meets the image; the image's centre where not given."""
    skew_px: Annotated[float, Field(ge=-1e4, le=1e4)] = 0.0
    transmittance: Annotated[float, Field(gt=0, le=1)] = 0.9
    """Of the lens, at all wavelengths."""

    projection: Literal["perspective", "equidistant"] = "perspective"
    """How far from the axis light at field angle theta lands: f_i tan(theta), or f_i theta (a fish-eye lens)."""
    distortion: Distortion | None = None
    focus_distance_m: FocusDistance = None
    """From the projection centre to what is sharp, or "infinity". Everything is sharp where not given."""
    psf: Literal["none", "diffraction", "measured"] = "none"
    """What a sharp point of light becomes: a point, the Airy pattern, or `psf_kernel`."""
    psf_wavelength_nm: Annotated[float, Field(ge=200, le=2000)] = 550.0
    psf_kernel: tuple[tuple[Annotated[float, Field(ge=0, le=1)], ...], ...] | None = None
    """Rows of an odd number of pixels each, as many rows, that add up to 1; `psf` has to be "measured"."""
    vignetting_deg: Annotated[float, Field(gt=0, lt=90)] | None = None
    """Field angle at which a second stop hides the whole pupil. Nothing hides it where not given."""

    @model_validator(mode="after")
    def _principal_point_is_near_the_image(self) -> Self:
        u, v = self.center_px
        if not (-self.width_px <= u <= 2 * self.width_px and -self.height_px <= v <= 2 * self.height_px):
            raise ValueError(
                f"principal_point_px = [{u}, {v}]: lies more than one image beside the "
                f"{self.width_px} x {self.height_px} image"
            )
        return self

    @model_validator(mode="after")
    def _focus_is_beyond_the_focal_length(self) -> Self:
        focus = self.focus_distance_m
        if isinstance(focus, float) and focus * 1000 <= self.focal_length_mm:
            raise ValueError(
                f"focus_distance_m = {focus}: has to exceed the focal length of {self.focal_length_mm / 1000} m"
            )
        return self

    @model_validator(mode="after")
    def _psf_kernel_is_a_kernel(self) -> Self:
        rows = self.psf_kernel
        if (rows is not None) != (self.psf == "measured"):
            raise ValueError(f'psf = "{self.psf}": psf_kernel has to be given with psf = "measured", and only then')
        if rows is None:
            return self
        if len(rows) % 2 == 0 or len(rows) > 255 or any(len(row) != len(rows) for row in rows):
            raise ValueError("psf_kernel: has to be square, with an odd number of rows of at most 255")
        total = sum(map(sum, rows))
        if abs(total - 1) > 1e-6:
            raise ValueError(f"psf_kernel: adds up to {total:.9g}; it has to be 1 within 1e-6")
        return self

    @model_validator(mode="after")
    def _every_pixel_has_oneray_of_sensor(self) -> Self:
        x, y = pixel_on_sensor(self, *_pixels_in_and_around(self))
        if self.projection == "equidistant":
            if self.distortion is not None:
                raise ValueError('distortion: is for projection = "perspective" only')
            widest = float(np.degrees(np.hypot(x, y).max()))
            if widest >= 180:
                raise ValueError(
                    f'projection = "equidistant": the sensor reaches {widest:.0f} deg off the axis, 180 are too many'
                )
        elif self.distortion is not None and folds(self.distortion, x, y):
            given = ", ".join(f"{key} = {value:g}" for key, value in self.distortion if value)
            raise ValueError(
                f"distortion: {given} folds the image on or near the sensor; the distorted radius has to grow with "
                f"the radius out to {BEYOND_SENSOR:.0%} beyond the borders"
            )
        return self

    @property
    def center_px(self) -> tuple[float, float]:
        """The principal point (u, v)."""
        return self.principal_point_px or (self.width_px / 2, self.height_px / 2)

    @property
    def image_distance_mm(self) -> float:
        """f_i = f s / (s - f), from the pupil to the sensor; the focal length where focused at infinity or nowhere."""
        if not isinstance(self.focus_distance_m, float):
            return self.focal_length_mm
        focus_mm = self.focus_distance_m * 1000
        return self.focal_length_mm * focus_mm / (focus_mm - self.focal_length_mm)

    @property
    def aperture_mm(self) -> float:
        """Diameter of the pupil, D = f / N."""
        return self.focal_length_mm / self.f_number

    @property
    def working_f_number(self) -> float:
        """f_i / D: what counts for exposure and diffraction. The f-number where focused at infinity or nowhere."""
        return self.f_number * (self.image_distance_mm / self.focal_length_mm)

    @property
    def focal_px(self) -> float:
        """Image distance f_i in pixels: the scale of the image, the same as the focal length at infinity focus."""
        return self.image_distance_mm * 1000 / self.pixel_pitch_um

    @property
    def matrix(self) -> NDArray[np.float64]:
        """K, shape (3, 3): [u, v, 1] ~ K p_cam."""
        u, v = self.center_px
        return np.array([[self.focal_px, self.skew_px, u], [0.0, self.focal_px, v], [0.0, 0.0, 1.0]])

    def view_angles_deg(self) -> tuple[float, float]:
        """Full angles across and down of a sensor centred on the axis.

        Huynh & Yoo 2016, Eq. 15, for a pinhole, which gives 15.19 deg for their camera, not 24.
        """
        half = np.array([-0.5, 0.5])
        zero = np.zeros(2)
        x, _, zx = ray_of_sensor(self, half * self.width_px / self.focal_px, zero)
        _, y, zy = ray_of_sensor(self, zero, half * self.height_px / self.focal_px)
        left, right = np.degrees(np.arctan2(x, zx))
        top, bottom = np.degrees(np.arctan2(y, zy))
        return float(right - left), float(bottom - top)


@dataclass(frozen=True)
class Pose:
    """Where the camera is: projection centre in the world, and tilts as in Huynh & Yoo 2016, Eq. 5."""

    position_m: tuple[float, float, float]
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0
    yaw_deg: float = 0.0

    @property
    def rotation(self) -> NDArray[np.float64]:
        """R_cam_world, shape (3, 3): p_cam = R_cam_world (p_world - position)."""
        return rotation_cam_world(self.tilt_x_deg, self.tilt_y_deg, self.yaw_deg)


def rotation_cam_world(tilt_x_deg: float, tilt_y_deg: float, yaw_deg: float) -> NDArray[np.float64]:
    """Rx(tilt_x) Ry(tilt_y) Rz(yaw) in the paper's signs: raising tilt_x moves a lamp overhead to +v, tilt_y to -u."""
    a, b, c = np.radians([tilt_x_deg, tilt_y_deg, yaw_deg])
    rx = np.array([[1, 0, 0], [0, np.cos(a), np.sin(a)], [0, -np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, -np.sin(b)], [0, 1, 0], [np.sin(b), 0, np.cos(b)]])
    rz = np.array([[np.cos(c), np.sin(c), 0], [-np.sin(c), np.cos(c), 0], [0, 0, 1]])
    product: NDArray[np.float64] = rx @ ry @ rz
    return product


def ray_of_pixel(camera: Camera, u: Any, v: Any, xp: Any = np) -> tuple[Any, Any, Any]:
    """Direction (x, y, z) in camera axes in which a pixel position (u, v) looks, elementwise.

    `u` and `v` are arrays of any shape, NumPy's with `xp` = numpy or Dr.Jit's with `xp` = drjit. Perspective: z = 1.
    Equidistant: unit length; beyond 90 deg off the axis z is negative. Valid to BEYOND_SENSOR outside the sensor.
    """
    return ray_of_sensor(camera, *pixel_on_sensor(camera, u, v), xp)


def pixel_on_sensor(camera: Camera, u: Any, v: Any) -> tuple[Any, Any]:
    """Where pixel positions (u, v) are on the sensor: K^-1 applied to them, from the axis, in units of f_i."""
    # Python floats: a NumPy scalar times a Dr.Jit array would become a NumPy array
    inverse = np.linalg.inv(camera.matrix).tolist()
    x = inverse[0][0] * u + inverse[0][1] * v + inverse[0][2]
    y = inverse[1][1] * v + inverse[1][2]
    return x, y


def ray_of_sensor(camera: Camera, x: Any, y: Any, xp: Any = np) -> tuple[Any, Any, Any]:
    """`ray_of_pixel` of a place on the sensor, as `pixel_on_sensor` gives it."""
    if camera.projection == "equidistant":
        theta = xp.sqrt(x * x + y * y + ON_AXIS)
        scale = xp.sin(theta) / theta
        return x * scale, y * scale, xp.cos(theta)
    if camera.distortion is not None:
        x, y = undistort(camera.distortion, x, y)
    return x, y, 1.0 + 0.0 * x


def pixel_of_point(camera: Camera, x: Any, y: Any, z: Any, xp: Any = np) -> tuple[Any, Any]:
    """Where a point (x, y, z) in camera axes, any unit, is imaged: (u, v) in pixels. Arrays as in `ray_of_pixel`.

    Says nothing of whether the lens images the point at all: see `image_of_points`.
    """
    if camera.projection == "equidistant":
        radius = xp.sqrt(x * x + y * y + ON_AXIS)
        scale = xp.atan2(radius, z) / radius
        x, y = x * scale, y * scale
    else:
        x, y = x / z, y / z
        if camera.distortion is not None:
            x, y = distort(camera.distortion, x, y)
    (fx, skew, cx), (_, fy, cy), _ = camera.matrix.tolist()
    return x * fx + y * skew + cx, y * fy + cy


def image_of_points(camera: Camera, p_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels (..., 2) of points (..., 3) in camera axes; NaN for those the lens does not image.

    A perspective lens images what is in front of it, as far out as its distortion does not fold the image; an
    equidistant lens everything but what is straight behind it.
    """
    x, y, z = p_cam[..., 0], p_cam[..., 1], p_cam[..., 2]
    with np.errstate(all="ignore"):
        if camera.projection == "equidistant":
            seen = (z > 0) | (x != 0) | (y != 0)
        else:
            seen = z > 0
            if camera.distortion is not None:
                seen &= x * x + y * y < fold_radius2(camera.distortion) * z * z
        pixels = np.stack(pixel_of_point(camera, x, y, z), axis=-1)
    return np.where(seen[..., None], pixels, np.nan)


def project(
    camera: Camera, pose: Pose, points_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Project world points (..., 3): pixels (..., 2), NaN as in `image_of_points`, and depth z_cam in metres."""
    p_cam = transform(pose.rotation, points_m - np.array(pose.position_m))
    return image_of_points(camera, p_cam), p_cam[..., 2]


def rays_world(camera: Camera, pose: Pose, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions in the world of pixels (..., 2), shape (..., 3), as long as `ray_of_pixel` makes them."""
    return np.stack(ray_world(camera, pose, pixels[..., 0], pixels[..., 1]), axis=-1)


def ray_world(camera: Camera, pose: Pose, u: Any, v: Any) -> tuple[Any, Any, Any]:
    """`rays_world` as (x, y, z) of NumPy arrays u and v that broadcast, which is faster for megapixels of a window."""
    x, y, z = ray_of_pixel(camera, u, v)
    east, north, up = (x * r[0] + y * r[1] + z * r[2] for r in pose.rotation.T)
    return east, north, up


def _pixels_in_and_around(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A grid (33, 33) of pixel positions out to BEYOND_SENSOR outside the sensor."""
    across = np.linspace(-BEYOND_SENSOR, 1 + BEYOND_SENSOR, 33)
    u, v = np.meshgrid(across * camera.width_px, across * camera.height_px)
    return u, v


def transform(matrix: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Apply a matrix (rows, 3) to vectors (..., 3). Shape (..., rows).

    Written out, not `@`: the last bits of a matrix product may depend on threads and processor, and frames may not.
    """
    result: NDArray[np.float64] = (
        vectors[..., 0:1] * matrix[:, 0] + vectors[..., 1:2] * matrix[:, 1] + vectors[..., 2:3] * matrix[:, 2]
    )
    return result


def mitsuba_to_world(pose: Pose) -> NDArray[np.float64]:
    """Mitsuba's `to_world` of a sensor at this pose, shape (4, 4), a proper rotation."""
    matrix = np.eye(4)
    matrix[:3, :3] = pose.rotation.T @ MITSUBA_FROM_OPENCV
    matrix[:3, 3] = pose.position_m
    return matrix
