"""Cameras and poses: intrinsics, and the tilts of Huynh & Yoo 2016.

Camera axes are OpenCV's: x right, y down, z forward. The level pose looks straight up with R_cam_world = I.
Pixels are continuous (u, v) = (column, row), (0, 0) at the image's top-left corner, pixel centres at +0.5.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, ValidatorFunctionWrapHandler, WrapValidator, model_validator

from vlcrender.camera.calibration import read_calibration
from vlcrender.camera.distortion import Distortion
from vlcrender.camera.glare import Glare
from vlcrender.camera.projection import Equidistant, FieldOfView, Perspective, Projection
from vlcrender.camera.shutter import GlobalShutter, Shutter
from vlcrender.config.presets import with_presets
from vlcrender.config.toml_model import Settings, check

Pixels = Annotated[int, Field(ge=8, le=20000)]
Positive = Annotated[float, Field(gt=0, le=1e6)]
Shift = Annotated[float, Field(ge=-1000, le=1000)]

SENSOR_MARGIN = 1 / 20
"""Share of the sensor's width and height beyond its borders out to which a lens has to be valid."""
MAX_LATERAL_COLOUR = 0.02
"""Largest lateral colour, as a share of the distance from the axis; the lens has to be valid that far too."""
BORDER_POINTS = 65
"""Pixel positions along each side of a border whose field of view is wanted."""


def _number_or_infinity(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
    try:
        return handler(value)
    except ValidationError:
        # A union's own errors name its members, which are not in the TOML file.
        raise ValueError('has to be a distance in m above 0, or "infinity"') from None


FocusDistance = Annotated[Positive | Literal["infinity"] | None, WrapValidator(_number_or_infinity)]


class Camera(Settings):
    """A camera and its lens. The defaults are Table 1 of Huynh & Yoo 2016 at f/2.2, sharp everywhere."""

    width_px: Pixels = 4000
    """Columns of the sensor."""
    height_px: Pixels = 3000
    """Rows of the sensor."""
    pixel_pitch_um: Positive = 1.2
    """Side of a pixel, um; pixels are square."""
    focal_length_mm: Positive = 18.0
    """Focal length of the lens, mm."""
    f_number: Annotated[float, Field(ge=0.5, le=100)] = 2.2
    """Focal length over the diameter of the pupil."""
    principal_point_px: tuple[float, float] | None = None
    """Pixel (u, v) where the optical axis meets the sensor; the image's centre where not given."""
    aspect_ratio: Annotated[float, Field(ge=0.5, le=2)] = 1.0
    """fx / fy of K, for an image with another scale across than down. The mean of fx and fy is f_i in pixels."""
    skew_px: Annotated[float, Field(ge=-1e4, le=1e4)] = 0.0
    """Skew of the pixel axes, K[0, 1], px."""
    transmittance: Annotated[float, Field(gt=0, le=1)] = 0.9
    """Transmittance of the lens, the same at all wavelengths."""

    projection: Literal["perspective", "equidistant"] = "perspective"
    """Distance from the axis of the image at field angle theta: f_i tan(theta), or f_i theta (a fish-eye lens)."""
    distortion: Distortion | None = None
    """Brown-Conrady distortion of a perspective lens; none where not given."""
    focus_distance_m: FocusDistance = None
    """Distance from the projection centre to the plane of focus, m, or "infinity"; all is sharp where not given."""
    psf: Literal["none", "diffraction", "measured"] = "none"
    """Point spread function in focus: a point, the Airy pattern, or `psf_kernel`."""
    psf_wavelength_nm: Annotated[float, Field(ge=200, le=2000)] = 550.0
    """Wavelength of the Airy pattern, nm."""
    psf_kernel: tuple[tuple[Annotated[float, Field(ge=0, le=1)], ...], ...] | None = None
    """Measured point spread function: an odd number of rows, as many columns, sum 1; with psf = "measured" only."""
    off_axis_sigma_um: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Off-axis blur: standard deviation of a normal blur at the sensor's corner farthest from the axis, um. It grows
    with the square of the distance from the axis."""
    lateral_colour_um: tuple[Shift, Shift] | None = None
    """Lateral colour: distance by which the red and the blue image lie outside the green one at the sensor's corner
    farthest from the axis, um, negative for inside; in proportion to the distance from the axis. For sensors with a
    mosaic."""
    vignetting_deg: Annotated[float, Field(gt=0, lt=90)] | None = None
    """Field angle at which a second stop hides the whole pupil, deg; no mechanical vignetting where not given."""
    glare: Glare | None = None
    """Veiling glare of the lens; none where not given."""
    shutter: Shutter = GlobalShutter()
    """When each line of the sensor is exposed; all lines at once where not given."""

    @classmethod
    def preset(cls, name: str) -> Self:
        """The camera of a preset, such as "phone-wide", with its sensor's pixels; `Sensor.preset` gives the sensor.

        Raises InputError with the names there are.
        """
        where = f"camera preset {name}"
        return check(with_presets({"camera": {"preset": name}}, [], where)["camera"], cls, where)

    @classmethod
    def calibrated(cls, path: str | Path, pixel_pitch_um: float, name: str | None = None, **keys: Any) -> Self:
        """The camera of a calibration file, as `calibration` under [camera] of a recipe makes it.

        path: OpenCV's YAML or npz, Kalibr, ROS camera_info or COLMAP. name: its camera, where it has several. keys:
        further fields, such as `f_number`. Raises InputError for a file that is no calibration, and for a lens that
        no camera of this class has.
        """
        found, focus_m = read_calibration(Path(path), name), keys.get("focus_distance_m")
        of_file = found.camera_keys(pixel_pitch_um, focus_m if isinstance(focus_m, int | float) else None)
        return check({**keys, "pixel_pitch_um": pixel_pitch_um, **of_file}, cls, str(path))

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
    def _lateral_colour_is_small(self) -> Self:
        if self.lateral_colour_um is not None:
            limit_um = MAX_LATERAL_COLOUR * self.corner_radius_px * self.pixel_pitch_um
            if max(map(abs, self.lateral_colour_um)) > limit_um:
                raise ValueError(
                    f"lateral_colour_um = {list(self.lateral_colour_um)}: at most {limit_um:.4g} to either side, "
                    f"{MAX_LATERAL_COLOUR:.0%} of the corner's distance from the axis"
                )
        return self

    @model_validator(mode="after")
    def _glare_is_wider_than_a_blur(self) -> Self:
        if self.glare is not None:
            lowest_um = max(6, max(self.width_px, self.height_px) / 100) * self.pixel_pitch_um
            if self.glare.radius_um < lowest_um:
                raise ValueError(
                    f"glare.radius_um = {self.glare.radius_um:g}: must be at least {lowest_um:g}, which is 6 pixels "
                    "and 1 % of the sensor's longer side; a narrower blur is a psf"
                )
        return self

    @model_validator(mode="after")
    def _every_pixel_has_one_direction(self) -> Self:
        if self.projection == "equidistant" and self.distortion is not None:
            raise ValueError('distortion: is for projection = "perspective" only')
        across = np.linspace(-SENSOR_MARGIN, 1 + SENSOR_MARGIN, 33)
        u, v = np.meshgrid(across * self.width_px, across * self.height_px)
        problem = self.lens_projection.problem_on(*self.sensor_position(u, v))
        if problem is not None:
            raise ValueError(f"{problem} out to {SENSOR_MARGIN:.0%} beyond the sensor's borders")
        return self

    @property
    def lens_projection(self) -> Projection:
        """The mapping between directions and positions on the sensor that `projection` names."""
        return Equidistant() if self.projection == "equidistant" else Perspective(self.distortion)

    @property
    def center_px(self) -> tuple[float, float]:
        """The principal point (u, v)."""
        return self.principal_point_px or (self.width_px / 2, self.height_px / 2)

    @property
    def corner_radius_px(self) -> float:
        """Distance of the sensor's corner farthest from the principal point."""
        u, v = self.center_px
        return float(np.hypot(max(abs(u), abs(self.width_px - u)), max(abs(v), abs(self.height_px - v))))

    def for_colour(self, colour: int) -> "Camera":
        """The camera as light of one colour sees it: 0 red, 1 green, 2 blue.

        An image enlarged by m about the axis is the same image on pixels smaller by m: each gets 1 / m^2 of the light.
        """
        if self.lateral_colour_um is None:
            return self
        shift_um = (self.lateral_colour_um[0], 0.0, self.lateral_colour_um[1])[colour]
        enlarged = 1 + shift_um / (self.corner_radius_px * self.pixel_pitch_um)
        return self.model_copy(
            update={
                "lateral_colour_um": None,
                "pixel_pitch_um": self.pixel_pitch_um / enlarged,
                "skew_px": self.skew_px * enlarged,
            }
        )

    @property
    def image_distance_mm(self) -> float:
        """f_i = f s / (s - f), from the pupil to the sensor; the focal length where the focus is infinity or none."""
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
        """f_i / D, for exposure and diffraction; the f-number where the focus is infinity or none."""
        return self.f_number * (self.image_distance_mm / self.focal_length_mm)

    @property
    def focal_px(self) -> float:
        """Image distance f_i in pixels: the scale of the image, the same as the focal length at infinity focus."""
        return self.image_distance_mm * 1000 / self.pixel_pitch_um

    @property
    def focal_xy_px(self) -> tuple[float, float]:
        """(fx, fy): the scale of the image across and down, with the mean `focal_px`."""
        fy = 2 * self.focal_px / (1 + self.aspect_ratio)
        return self.aspect_ratio * fy, fy

    @property
    def matrix(self) -> NDArray[np.float64]:
        """K, shape (3, 3): [u, v, 1] ~ K p_cam."""
        return _matrix(*self.center_px, *self.focal_xy_px, self.skew_px)

    def inverse_matrix(self) -> list[list[Any]]:
        """K^-1, rows of Python floats: a NumPy scalar times a Dr.Jit array would become a NumPy array."""
        return _inverse(*self.center_px, *self.focal_xy_px, self.skew_px)

    def line_starts_s(self) -> NDArray[np.float64]:
        """Start of each line's exposure after the frame's, s: (height, 1) or (1, width); (1, 1) of a global shutter."""
        return self.shutter.line_starts_s(self.width_px, self.height_px)

    def middle_s(self, exposure_s: float) -> float:
        """Time from the start of a frame to the middle of its middle line's exposure, s."""
        lines = self.shutter.line_count(self.width_px, self.height_px)
        return (lines - 1) / 2 * self.shutter.row_time_s + exposure_s / 2

    def times_s(self, u_px: Any, v_px: Any) -> Any:
        """Time of pixel positions after the middle of a frame, s, of any shape."""
        return self.shutter.times_s(u_px, v_px, self.width_px, self.height_px)

    def view_angles_deg(self) -> tuple[float, float]:
        """Full angles of view across and down, for a sensor centred on the axis.

        Huynh & Yoo 2016, Eq. 15, for a pinhole: 15.19 deg for their camera, not the printed 24.
        """
        half = np.array([-0.5, 0.5])
        zero = np.zeros(2)
        lens = self.lens_projection
        fx, fy = self.focal_xy_px
        x, _, zx = lens.unproject(half * self.width_px / fx, zero)
        _, y, zy = lens.unproject(zero, half * self.height_px / fy)
        left, right = np.degrees(np.arctan2(x, zx))
        top, bottom = np.degrees(np.arctan2(y, zy))
        return float(right - left), float(bottom - top)

    def sensor_position(self, u: Any, v: Any) -> tuple[Any, Any]:
        """Position on the sensor, K^-1 [u, v, 1]: (x, y) from the axis in units of f_i. Arrays as in `unproject`."""
        inverse = self.inverse_matrix()
        x = inverse[0][0] * u
        if self.skew_px != 0:  # without skew an x of columns stays one row
            x = x + inverse[0][1] * v
        return x + inverse[0][2], inverse[1][1] * v + inverse[1][2]

    def unproject(self, u: Any, v: Any, xp: Any = np) -> tuple[Any, Any, Any]:
        """Direction (x, y, z) in camera axes of pixel positions (u, v), elementwise.

        `u` and `v` are arrays of any shape, NumPy's with `xp` = numpy or Dr.Jit's with `xp` = drjit. Perspective:
        z = 1. Equidistant: unit length, with z < 0 beyond 90 deg off the axis. Valid to SENSOR_MARGIN outside the
        sensor.
        """
        return self.lens_projection.unproject(*self.sensor_position(u, v), xp)

    def project(self, x: Any, y: Any, z: Any, xp: Any = np) -> tuple[Any, Any]:
        """Pixel position (u, v) of a point (x, y, z) in camera axes, any unit. Arrays as in `unproject`.

        The caller knows that the lens images the point: see `image_of_points`.
        """
        x, y = self.lens_projection.project(x, y, z, xp)
        (fx, skew, cx), (_, fy, cy), _ = self.matrix.tolist()
        return x * fx + y * skew + cx, y * fy + cy

    def image_of_points(self, p_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixel positions (..., 2) of points (..., 3) in camera axes; NaN where the lens does not image the point.

        A perspective lens images points before it, within the radius where its distortion folds the image; an
        equidistant lens all points but those straight behind it.
        """
        x, y, z = p_cam[..., 0], p_cam[..., 1], p_cam[..., 2]
        with np.errstate(all="ignore"):
            imaged = self.lens_projection.images(x, y, z)
            pixels = np.stack(self.project(x, y, z), axis=-1)
        pixels[~imaged] = np.nan
        return pixels

    def field_of_view(self, margin_px: float = 0.0) -> FieldOfView:
        """Directions from which light reaches the sensor or up to `margin_px` beside it."""
        return self.field_of_view_of(-margin_px, -margin_px, self.width_px + margin_px, self.height_px + margin_px)

    def field_of_view_of(self, left_px: float, top_px: float, right_px: float, bottom_px: float) -> FieldOfView:
        """Directions from which light reaches a rectangle of pixel positions, on the sensor or close to it."""
        return _field_of_view(self, left_px, top_px, right_px, bottom_px)


@lru_cache(maxsize=64)
def _inverse(u: float, v: float, fx: float, fy: float, skew_px: float) -> list[list[Any]]:
    inverse: list[list[Any]] = np.linalg.inv(_matrix(u, v, fx, fy, skew_px)).tolist()
    return inverse


def _matrix(u: float, v: float, fx: float, fy: float, skew_px: float) -> NDArray[np.float64]:
    return np.array([[fx, skew_px, u], [0.0, fy, v], [0.0, 0.0, 1.0]])


@lru_cache(maxsize=64)
def _field_of_view(camera: Camera, left_px: float, top_px: float, right_px: float, bottom_px: float) -> FieldOfView:
    t = np.linspace(0.0, 1.0, BORDER_POINTS)
    u, v = left_px + t * (right_px - left_px), top_px + t * (bottom_px - top_px)
    u_border = np.concatenate([u, u, np.full(BORDER_POINTS, u[0]), np.full(BORDER_POINTS, u[-1])])
    v_border = np.concatenate([np.full(BORDER_POINTS, v[0]), np.full(BORDER_POINTS, v[-1]), v, v])
    return camera.lens_projection.field_of_view(*camera.sensor_position(u_border, v_border))


@dataclass(frozen=True)
class Pose:
    """Position and attitude of a camera: R_cam_world = Rx(tilt_x) Ry(tilt_y) Rz(yaw), Huynh & Yoo 2016, Eq. 5.

    The level pose looks straight up, with +x of the room to the right in the image and +y down.
    """

    position_m: tuple[float, float, float]
    """Projection centre, world, m."""
    tilt_x_deg: float = 0.0
    """Raising it moves the image of an LED overhead to +v, deg."""
    tilt_y_deg: float = 0.0
    """Raising it moves the image of an LED overhead to -u, deg."""
    yaw_deg: float = 0.0
    """Raising it turns the image from +u towards -v, deg."""

    @property
    def rotation(self) -> NDArray[np.float64]:
        """R_cam_world, shape (3, 3): p_cam = R_cam_world (p_world - position)."""
        return rotation_cam_world(self.tilt_x_deg, self.tilt_y_deg, self.yaw_deg)


def rotation_cam_world(tilt_x_deg: float, tilt_y_deg: float, yaw_deg: float) -> NDArray[np.float64]:
    """Rx(tilt_x) Ry(tilt_y) Rz(yaw) in the paper's signs: raising tilt_x moves an LED image to +v, tilt_y to -u."""
    a, b, c = np.radians([tilt_x_deg, tilt_y_deg, yaw_deg])
    rx = np.array([[1, 0, 0], [0, np.cos(a), np.sin(a)], [0, -np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, -np.sin(b)], [0, 1, 0], [np.sin(b), 0, np.cos(b)]])
    rz = np.array([[np.cos(c), np.sin(c), 0], [-np.sin(c), np.cos(c), 0], [0, 0, 1]])
    product: NDArray[np.float64] = rx @ ry @ rz
    return product


def transform(matrix: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Apply a matrix (rows, 3) to vectors (..., 3). Shape (..., rows).

    Written out, not `@`: the last bits of a matrix product may depend on threads and processor, and frames may not.
    """
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    result = np.empty((*vectors.shape[:-1], len(matrix)))
    for row, (of_x, of_y, of_z) in enumerate(matrix.tolist()):
        result[..., row] = x * of_x + y * of_y + z * of_z
    return result
