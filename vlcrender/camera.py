"""The camera: intrinsics, pose, and the one place that turns our axes into Mitsuba's.

Camera axes are OpenCV's: x right, y down, z forward. The level pose looks straight up with R_cam_world = I.
Pixels are continuous (u, v) = (column, row), (0, 0) at the image's top-left corner, pixel centres at +0.5.
"""

from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from vlcrender.settings import Settings

Pixels = Annotated[int, Field(ge=8, le=20000)]
Positive = Annotated[float, Field(gt=0, le=1e6)]

MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0])
"""Mitsuba's camera looks along +z with x to the image's left and y up; ours has x right and y down."""


class Camera(Settings):
    """A pinhole camera focused at infinity. The defaults are Table 1 of Huynh & Yoo 2016 at f/2.2."""

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

    @model_validator(mode="after")
    def _principal_point_is_near_the_image(self) -> Self:
        u, v = self.center_px
        if not (-self.width_px <= u <= 2 * self.width_px and -self.height_px <= v <= 2 * self.height_px):
            raise ValueError(
                f"principal_point_px = [{u}, {v}]: lies more than one image beside the "
                f"{self.width_px} x {self.height_px} image"
            )
        return self

    @property
    def center_px(self) -> tuple[float, float]:
        """The principal point (u, v)."""
        return self.principal_point_px or (self.width_px / 2, self.height_px / 2)

    @property
    def focal_px(self) -> float:
        """Focal length in pixels."""
        return self.focal_length_mm * 1000 / self.pixel_pitch_um

    @property
    def matrix(self) -> NDArray[np.float64]:
        """K, shape (3, 3): [u, v, 1] ~ K p_cam."""
        u, v = self.center_px
        return np.array([[self.focal_px, self.skew_px, u], [0.0, self.focal_px, v], [0.0, 0.0, 1.0]])

    def view_angles_deg(self) -> tuple[float, float]:
        """Full angles of view across and down (Huynh & Yoo 2016, Eq. 15, which then gives 15.19 deg, not 24)."""
        size_mm = np.array([self.width_px, self.height_px]) * self.pixel_pitch_um / 1000
        across, down = np.degrees(2 * np.arctan(size_mm / (2 * self.focal_length_mm)))
        return float(across), float(down)


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


def project(
    camera: Camera, pose: Pose, points_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Project world points (..., 3). Returns pixels (..., 2) and depth z_cam in metres; pixels are NaN behind."""
    p_cam = transform(pose.rotation, points_m - np.array(pose.position_m))
    depth = p_cam[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = transform(camera.matrix[:2], p_cam / depth[..., None])
    return np.where(depth[..., None] > 0, pixels, np.nan), depth


def rays_world(camera: Camera, pose: Pose, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions in the world, not normalised (z_cam = 1), of pixels (..., 2). Shape (..., 3)."""
    ones = np.ones((*pixels.shape[:-1], 1))
    inverse = np.linalg.inv(camera.matrix).astype(np.float64)
    p_cam = transform(inverse, np.concatenate([pixels, ones], axis=-1))
    return transform(pose.rotation.T, p_cam)


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
