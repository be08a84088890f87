"""Projections of lenses: from directions in camera axes to positions on the sensor, and back.

Positions on the sensor are (x, y), from the optical axis in units of the image distance f_i, as in datasets/FORMAT.md.
Methods with `xp` serve NumPy arrays (`xp` = numpy) and Dr.Jit arrays (`xp` = drjit) alike, elementwise.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.distortion import Distortion

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ON_AXIS = 1e-30
"""Added to squared radii: 0 / 0 on the axis becomes its limit, and nothing else changes, in float32 as in float64."""
WITHIN_FOLD = 0.999
"""Points beyond the fold of a distortion are moved to this part of its radius, which is still beyond the sensor."""
MIN_DEPTH_SHARE = 1e-3
"""A point of an object at less than this part of the object's radius before the lens is beside or behind the lens."""


class FieldOfView(Protocol):
    """The directions from which light reaches a sensor and a margin around it."""

    def may_contain(self, p_cam: Array, radii_m: Array) -> Mask:
        """Whether spheres about the points (n, 3) in camera axes, of these radii (n,), may be seen in part, (n,).

        True wherever one is; also for some that are not.
        """


class Projection(Protocol):
    """The mapping of a lens, with the facts that depend on it."""

    @property
    def keeps_lines_straight(self) -> bool:
        """Whether the image of every straight line is straight: a pinhole without distortion."""

    @property
    def focuses_on_plane(self) -> bool:
        """Whether defocus depends on the depth along the axis; otherwise on the distance from the lens."""

    @property
    def extends_beyond_sensor(self) -> bool:
        """Whether the mapping holds far beyond the sensor, where a distortion is not calibrated."""

    def project(self, x: Any, y: Any, z: Any, xp: Any = np) -> tuple[Any, Any]:
        """Position on the sensor of a point (x, y, z) in camera axes, any unit. Valid where `images` is true."""

    def unproject(self, x: Any, y: Any, xp: Any = np) -> tuple[Any, Any, Any]:
        """Direction (x, y, z) in camera axes of a position on the sensor."""

    def images(self, x: Array, y: Array, z: Array) -> Mask:
        """Valid range of `project`: whether the lens images points (x, y, z) in camera axes at all."""

    def into_range(self, p_cam: Array, radius_m: float) -> Array | None:
        """Points (n, 3) of an object's outline, moved into the valid range of `project` without entering the sensor.

        radius_m: of the object. None where the lens does not image the object whole.
        """

    def illumination(self, x: Any, y: Any, xp: Any, luminance: Any) -> tuple[Any, Any]:
        """Luminance times relative illumination at a position on the sensor, and the tangent of the field angle."""

    def field_of_view(self, x: Array, y: Array) -> FieldOfView:
        """Field of view within a closed border, given by positions (x, y) on the sensor along it."""

    def problem_on(self, x: Array, y: Array) -> str | None:
        """Why the lens cannot image onto these positions on the sensor, or None."""


@dataclass(frozen=True)
class Perspective:
    """Pinhole, x = x_cam / z_cam and y = y_cam / z_cam, then Brown-Conrady distortion where given."""

    distortion: Distortion | None = None

    @property
    def keeps_lines_straight(self) -> bool:
        """Whether the lens has no distortion."""
        return self.distortion is None

    @property
    def focuses_on_plane(self) -> bool:
        """True: thin lens, sensor parallel to the pupil."""
        return True

    @property
    def extends_beyond_sensor(self) -> bool:
        """Whether the lens has no distortion, which is known on the sensor and close to it only."""
        return self.distortion is None

    def project(self, x: Any, y: Any, z: Any, xp: Any = np) -> tuple[Any, Any]:
        """Position on the sensor of a point (x, y, z) in camera axes."""
        x, y = x / z, y / z
        if self.distortion is not None:
            x, y, *_ = self.distortion.distort(x, y)
        return x, y

    def unproject(self, x: Any, y: Any, xp: Any = np) -> tuple[Any, Any, Any]:
        """Direction (x, y, 1) in camera axes of a position on the sensor."""
        if self.distortion is not None:
            x, y = self.distortion.undistort(x, y)
        return x, y, 1.0 + 0.0 * x

    def images(self, x: Array, y: Array, z: Array) -> Mask:
        """Whether points lie before the lens and, with distortion, within the radius where it folds the image."""
        imaged: Mask = z > 0
        if self.distortion is not None:
            imaged &= x * x + y * y < self.distortion.fold_radius2 * z * z
        return imaged

    def into_range(self, p_cam: Array, radius_m: float) -> Array | None:
        """Points with those beyond the fold moved in to it; None where one is beside or behind the lens."""
        if not (p_cam[:, 2] > MIN_DEPTH_SHARE * radius_m).all():
            return None
        if self.distortion is None:
            return p_cam
        limit = WITHIN_FOLD * np.sqrt(self.distortion.fold_radius2) * p_cam[:, 2]
        radius = np.hypot(p_cam[:, 0], p_cam[:, 1])
        moved = p_cam.copy()
        moved[:, :2] *= np.minimum(1.0, limit / np.maximum(radius, np.finfo(float).tiny))[:, None]
        return moved

    def illumination(self, x: Any, y: Any, xp: Any, luminance: Any) -> tuple[Any, Any]:
        """cos^4 of the field angle, over the distortion's Jacobian determinant."""
        x, y, _ = self.unproject(x, y, xp)
        tangent = xp.sqrt(x * x + y * y)
        cos2 = 1.0 / (1.0 + x * x + y * y)
        light = luminance * cos2 * cos2
        if self.distortion is not None:
            light = light / self.distortion.distort(x, y).determinant
        return light, tangent

    def field_of_view(self, x: Array, y: Array) -> FieldOfView:
        """The four planes through the projection centre that bound all that the border encloses."""
        x, y, _ = self.unproject(x, y)
        # A curved border has its extreme between two of 64 points a side: off by a 1 / (8 * 64^2) of its curvature.
        slack = 0.0 if self.distortion is None else 1e-3 * float(np.hypot(np.ptp(x), np.ptp(y)))
        return ViewPyramid(
            float(x.min()) - slack, float(x.max()) + slack, float(y.min()) - slack, float(y.max()) + slack
        )

    def problem_on(self, x: Array, y: Array) -> str | None:
        """Folds of the distortion on these positions."""
        if self.distortion is None or not self.distortion.folds(x, y):
            return None
        given = ", ".join(f"{key} = {value:g}" for key, value in self.distortion if value)
        return (
            f"distortion: {given} folds the image on or near the sensor; the distorted radius has to grow with the "
            "radius"
        )


@dataclass(frozen=True)
class Equidistant:
    """Fish-eye: a direction at field angle theta is imaged at radius theta, which may exceed 90 deg."""

    @property
    def keeps_lines_straight(self) -> bool:
        """False."""
        return False

    @property
    def focuses_on_plane(self) -> bool:
        """False: a fish-eye has no plane of focus, so that its defocus follows the distance."""
        return False

    @property
    def extends_beyond_sensor(self) -> bool:
        """True."""
        return True

    def project(self, x: Any, y: Any, z: Any, xp: Any = np) -> tuple[Any, Any]:
        """Position on the sensor of a point (x, y, z) in camera axes."""
        radius = xp.sqrt(x * x + y * y + ON_AXIS)
        scale = xp.atan2(radius, z) / radius
        return x * scale, y * scale

    def unproject(self, x: Any, y: Any, xp: Any = np) -> tuple[Any, Any, Any]:
        """Unit vector (x, y, z) in camera axes of a position on the sensor; z < 0 beyond 90 deg."""
        theta = xp.sqrt(x * x + y * y + ON_AXIS)
        scale = xp.sin(theta) / theta
        return x * scale, y * scale, xp.cos(theta)

    def images(self, x: Array, y: Array, z: Array) -> Mask:
        """Everywhere but straight behind the lens."""
        imaged: Mask = (z > 0) | (x != 0) | (y != 0)
        return imaged

    def into_range(self, p_cam: Array, radius_m: float) -> Array | None:
        """The points as given."""
        return p_cam

    def illumination(self, x: Any, y: Any, xp: Any, luminance: Any) -> tuple[Any, Any]:
        """cos(theta) sin(theta) / theta, 0 beyond 90 deg."""
        x_cam, y_cam, z_cam = self.unproject(x, y, xp)
        cosine = xp.maximum(z_cam, 0.0)
        sine = xp.sqrt(x_cam * x_cam + y_cam * y_cam + ON_AXIS)
        tangent = sine / (cosine + ON_AXIS)
        light = luminance * cosine * (sine / xp.sqrt(x * x + y * y + ON_AXIS))
        return light, tangent

    def field_of_view(self, x: Array, y: Array) -> FieldOfView:
        """The cone that reaches the border's position farthest from the axis."""
        return ViewCone(float(np.hypot(x, y).max()))

    def problem_on(self, x: Array, y: Array) -> str | None:
        """Field angles of 180 deg and more."""
        max_angle_deg = float(np.degrees(np.hypot(x, y).max()))
        if max_angle_deg < 180:
            return None
        return (
            f'projection = "equidistant": the sensor extends to {max_angle_deg:.0f} deg off the axis; '
            "less than 180 deg are allowed"
        )


@dataclass(frozen=True)
class ViewPyramid:
    """Field of view between least and greatest x_cam / z_cam, and least and greatest y_cam / z_cam."""

    min_x: float
    max_x: float
    min_y: float
    max_y: float

    def may_contain(self, p_cam: Array, radii_m: Array) -> Mask:
        """Whether spheres reach before the lens and inside all four planes."""
        x, y, z = p_cam[:, 0], p_cam[:, 1], p_cam[:, 2]
        seen: Mask = z > -radii_m
        for across, low, high in ((x, self.min_x, self.max_x), (y, self.min_y, self.max_y)):
            seen &= across - low * z >= -radii_m * np.sqrt(1 + low * low)
            seen &= across - high * z <= radii_m * np.sqrt(1 + high * high)
        return seen


@dataclass(frozen=True)
class ViewCone:
    """Field of view within an angle off the optical axis, radians."""

    max_angle_rad: float

    def may_contain(self, p_cam: Array, radii_m: Array) -> Mask:
        """Whether spheres reach into the cone."""
        x, y, z = p_cam[:, 0], p_cam[:, 1], p_cam[:, 2]
        distance = np.sqrt(x * x + y * y + z * z)
        with np.errstate(divide="ignore", invalid="ignore"):
            angular_radius = np.arcsin(np.minimum(radii_m / distance, 1.0))
        theta = np.arctan2(np.hypot(x, y), z)
        seen: Mask = theta - angular_radius <= self.max_angle_rad
        return seen
