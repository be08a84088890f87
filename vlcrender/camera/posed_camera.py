"""A camera at a pose: world points to pixels and pixels to world rays, and the camera's axes in Mitsuba."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose, transform

Array = NDArray[np.float64]

MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0])
"""Mitsuba's camera looks along +z with x to the image's left and y up; OpenCV's has x right and y down."""


@dataclass(frozen=True)
class PosedCamera:
    """A camera and its pose, p_cam = R_cam_world @ (p_world - position)."""

    camera: Camera
    pose: Pose

    def at(self, pose: Pose) -> "PosedCamera":
        """The same camera at another pose."""
        return replace(self, pose=pose)

    @cached_property
    def position_m(self) -> Array:
        """Projection centre, world, (3,)."""
        return np.array(self.pose.position_m)

    @cached_property
    def rotation(self) -> Array:
        """R_cam_world, (3, 3)."""
        return self.pose.rotation

    def camera_coordinates(self, points_m: Array) -> Array:
        """World points (..., 3) in camera axes, m, (..., 3)."""
        return transform(self.rotation, points_m - self.position_m)

    def project(self, points_m: Array) -> Array:
        """Pixel positions (..., 2) of world points (..., 3); NaN where the lens does not image the point."""
        return self.camera.image_of_points(self.camera_coordinates(points_m))

    def focus_depths_m(self, points_m: Array) -> Array:
        """Distances (n,) on which the defocus of world points (n, 3) depends: along the axis, or for a fish-eye lens
        from the projection centre.
        """
        towards_m = points_m - self.position_m
        if self.camera.lens_projection.focuses_on_plane:
            return transform(self.rotation[2:], towards_m)[:, 0]
        distances: Array = np.linalg.norm(towards_m, axis=1)
        return distances

    def rays_world(self, pixels: Array) -> Array:
        """World directions (..., 3) of pixel positions (..., 2), as long as `Camera.unproject` makes them."""
        return np.stack(self.ray_world(pixels[..., 0], pixels[..., 1]), axis=-1)

    def ray_world(self, u: Any, v: Any) -> tuple[Any, Any, Any]:
        """`rays_world` as (x, y, z) of arrays u and v that broadcast: faster for regions of many pixels."""
        x, y, z = self.camera.unproject(u, v)
        x_world, y_world, z_world = (x * r[0] + y * r[1] + z * r[2] for r in self.rotation.T)
        return x_world, y_world, z_world

    def mitsuba_to_world(self) -> Array:
        """`to_world` of a Mitsuba sensor here, (4, 4), a proper rotation."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation.T @ MITSUBA_FROM_OPENCV
        matrix[:3, 3] = self.pose.position_m
        return matrix
