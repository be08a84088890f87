"""Conventions of other tools: axes of cameras, order of quaternions, origin of pixel positions, distortion models.

Ours (datasets/FORMAT.md): camera axes x right, y down, z forward; `p_cam = R_cam_world @ (p_world - position)`; pixel
centres at +0.5. Whatever a tool cannot express exactly is refused.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vlcrender.errors import InputError

Array = NDArray[np.float64]
Five = tuple[float, float, float, float, float]
MAX_FIELD_ANGLE_DEG = 90.0
"""OpenCV, COLMAP, Kalibr and ROS divide by z before they apply a fish-eye model."""


@dataclass(frozen=True)
class Intrinsics:
    """Image size, K and lens of a camera, in our convention until `with_integer_centres` is called."""

    camera: str
    width_px: int
    height_px: int
    fx: float
    fy: float
    cx: float
    cy: float
    skew: float
    projection: Literal["perspective", "equidistant"]
    distortion: Five | None
    """k1, k2, k3, p1, p2; None without distortion."""

    @property
    def is_fisheye(self) -> bool:
        """Whether the projection is equidistant."""
        return self.projection == "equidistant"

    @property
    def brown(self) -> Five:
        """k1, k2, k3, p1, p2; zeros without distortion."""
        return self.distortion or (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def matrix(self) -> list[list[float]]:
        """K, three rows."""
        return [[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]

    def with_integer_centres(self) -> "Intrinsics":
        """The same camera for tools whose pixel centres have integer positions (OpenCV): u and v are 0.5 smaller."""
        return replace(self, cx=self.cx - 0.5, cy=self.cy - 0.5)

    def without_skew(self, to: str) -> "Intrinsics":
        """This camera. Raises InputError where its axes are skewed, for tools that ignore K[0][1]."""
        if self.skew != 0:
            raise InputError(f"{to}: camera {self.camera} has a skew of {self.skew:g} px, which {to} cannot express")
        return self

    def within_half_space(self, to: str) -> "Intrinsics":
        """This camera. Raises InputError where a fish-eye sees 90 deg off the axis or more."""
        if self.is_fisheye:
            across = max(self.cx, self.width_px - self.cx) / self.fx
            down = max(self.cy, self.height_px - self.cy) / self.fy
            angle_deg = float(np.degrees(np.hypot(across, down)))
            if angle_deg >= MAX_FIELD_ANGLE_DEG:
                raise InputError(
                    f"{to}: the sensor of camera {self.camera} extends to {angle_deg:.1f} deg off the axis; the "
                    f"fish-eye model of {to} ends at {MAX_FIELD_ANGLE_DEG:g} deg"
                )
        return self

    def without_k3(self, to: str) -> "Intrinsics":
        """This camera. Raises InputError where its distortion has the coefficient k3."""
        if self.brown[2] != 0:
            raise InputError(
                f"{to}: camera {self.camera} has the distortion k3 = {self.brown[2]:g}, which {to} cannot express"
            )
        return self

    def pinhole(self, to: str) -> "Intrinsics":
        """This camera. Raises InputError where its lens has a distortion or is a fish-eye."""
        if self.is_fisheye:
            raise InputError(f"{to}: camera {self.camera} is a fish-eye (equidistant), which {to} cannot express")
        if any(self.brown):
            raise InputError(f"{to}: camera {self.camera} has a distortion, which {to} cannot express")
        return self


def translation(rotation: Array, position_m: Array) -> Array:
    """t (3,) of `p_cam = R_cam_world @ p_world + t`, m."""
    moved: Array = 0.0 - rotation @ position_m  # no -0.0
    return moved


def opengl_camera_to_world(rotation: Array, position_m: Array) -> Array:
    """Camera-to-world matrix (4, 4) with the axes of OpenGL and Blender: x right, y up, z backward."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.T * np.array([1.0, -1.0, -1.0])
    matrix[:3, 3] = position_m
    return matrix


def quaternion_xyzw(rotation: Array) -> list[float]:
    """Unit quaternion x, y, z, w of a rotation matrix, w >= 0 (TUM, ROS)."""
    found: list[float] = Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()
    return found


def quaternion_wxyz(rotation: Array) -> list[float]:
    """Unit quaternion w, x, y, z of a rotation matrix, w >= 0 (COLMAP)."""
    x, y, z, w = quaternion_xyzw(rotation)
    return [w, x, y, z]


def text(numbers: "list[float] | tuple[float, ...] | Array") -> str:
    """Numbers with a space between, each with the digits that give the same double again."""
    return " ".join(repr(float(number)) for number in numbers)


def yaml_number(number: float) -> str:
    """A number for YAML 1.1, which takes 1e-05 for text: it needs a point before the exponent."""
    written = repr(float(number))
    return written.replace("e", ".0e") if "e" in written and "." not in written else written


def yaml_list(numbers: "list[float] | tuple[float, ...]") -> str:
    """Numbers as a flow sequence of YAML."""
    return f"[{', '.join(map(yaml_number, numbers))}]"
