"""Projections of the format: camera axes to normalized image coordinates and back (datasets/FORMAT.md, Projection).

Normalized image coordinates (x, y) are in units of the image distance, from the principal point; `Camera.to_pixels`
maps them to pixels.
"""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import POSE_PARAMETERS, Pose, rotation
from estimator.io.camera import Camera, Distortion

Floats = NDArray[np.float64]

# A point closer than this to the image-plane directions of a perspective lens has no image: 89.9 deg off the axis.
MIN_DEPTH_SHARE = 1e-3
# Distortion is inverted to this residual, in units of the image distance: 1e-8 px at 15 000 px to the image distance.
MAX_RESIDUAL = 1e-12
# Local magnification of an image by its distortion above which the coefficients describe no lens.
MAX_MAGNIFICATION = 1e3
# OpenCV 4 has the form with criteria under a name of its own.
undistort_points = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
# Its fixed-point iteration gains a constant factor a step, which approaches 1 where the lens folds the image.
UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 10_000, 1e-14)


class Projection(Protocol):
    """A lens: maps directions in camera axes to normalized image coordinates."""

    @property
    def rectilinear(self) -> bool:
        """Whether straight lines are imaged as straight lines: a pinhole."""

    def project(self, p_cam: Floats) -> tuple[Floats, Floats]:
        """Image (n, 2) of points (n, 3) in camera axes, and its Jacobian (n, 2, 3); NaN outside the valid range."""

    def unproject(self, image: Floats) -> Floats:
        """Unit vectors (n, 3) in camera axes of normalized image coordinates (n, 2); NaN outside the valid range."""

    def defocus_depth_m(self, p_cam: Floats) -> Floats:
        """Depth (n,) that determines the defocus of points (n, 3), metres."""


@dataclass(frozen=True)
class Perspective:
    """Pinhole with optional Brown-Conrady distortion, which OpenCV computes.

    Valid: directions less than 89.9 deg off the axis, up to where the distortion folds the image.
    """

    distortion: Distortion | None = None

    @property
    def rectilinear(self) -> bool:
        """Whether there is no distortion."""
        return self.distortion is None

    def project(self, p_cam: Floats) -> tuple[Floats, Floats]:
        """See `Projection.project`."""
        x, y, z = p_cam.T
        with np.errstate(all="ignore"):
            valid = z > MIN_DEPTH_SHARE * np.linalg.norm(p_cam, axis=1)
            z = np.where(valid, z, np.nan)
            plane = np.stack([x / z, y / z], axis=1)
            jacobian = np.zeros((len(p_cam), 2, 3))
            jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1 / z
            jacobian[:, :, 2] = -plane / z[:, None]
            if self.distortion is None or len(p_cam) == 0:
                return plane, jacobian
            image, slope = _distorted(plane, self.distortion)
            # Beyond the fold the image is reversed, or its radius shrinks.
            folded = (np.linalg.det(slope) <= 0) | (np.einsum("ni,nij,nj->n", plane, slope, plane) < 0)
            return np.where(folded[:, None], np.nan, image), slope @ jacobian

    def unproject(self, image: Floats) -> Floats:
        """See `Projection.unproject`."""
        plane = image
        if self.distortion is not None and len(image):
            coefficients, eye = _coefficients(self.distortion), np.eye(3)
            source = np.ascontiguousarray(image)[:, None]
            plane = undistort_points(source, eye, coefficients, R=eye, P=eye, criteria=UNDISTORT_CRITERIA)
            plane = plane.reshape(-1, 2)
        rays = np.column_stack([plane, np.ones(len(plane))])
        if self.distortion is not None:
            with np.errstate(all="ignore"):
                again, jacobian = self.project(rays)
                found = np.linalg.norm(again - image, axis=1) <= MAX_RESIDUAL
                found &= np.abs(jacobian[:, :, :2]).max(axis=(1, 2)) <= MAX_MAGNIFICATION
            rays[~found] = np.nan
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def defocus_depth_m(self, p_cam: Floats) -> Floats:
        """Depth along the optical axis: the image is sharp in a plane."""
        return np.asarray(p_cam[:, 2])


@dataclass(frozen=True)
class Equidistant:
    """Fish-eye: a point at the angle theta off the axis is imaged at the radius theta.

    Valid: all directions but the one straight behind. `cv2.fisheye` with k = 0 is the same up to 90 deg, where it
    ends.
    """

    @property
    def rectilinear(self) -> bool:
        """False."""
        return False

    def project(self, p_cam: Floats) -> tuple[Floats, Floats]:
        """See `Projection.project`."""
        x, y, z = p_cam.T
        with np.errstate(all="ignore"):
            rho = np.maximum(np.hypot(x, y), 1e-12 * np.abs(z))
            scale = np.arctan2(rho, z) / rho
            distance2 = rho * rho + z * z
            # (d scale / d rho) / rho, from d theta / d rho = z / distance2; and d theta / dz = -rho / distance2.
            scale_slope = (z / distance2 - scale) / (rho * rho)
            across = p_cam[:, :2]
            jacobian = np.empty((len(p_cam), 2, 3))
            jacobian[:, :, :2] = across[:, :, None] * across[:, None, :] * scale_slope[:, None, None]
            jacobian[:, 0, 0] += scale
            jacobian[:, 1, 1] += scale
            jacobian[:, :, 2] = -across / distance2[:, None]
            return across * scale[:, None], jacobian

    def unproject(self, image: Floats) -> Floats:
        """See `Projection.unproject`."""
        theta = np.linalg.norm(image, axis=1)
        rays = np.column_stack([image * np.sinc(theta / np.pi)[:, None], np.cos(theta)])
        rays[~(theta < np.pi)] = np.nan
        return rays

    def defocus_depth_m(self, p_cam: Floats) -> Floats:
        """Distance from the projection centre: the image is sharp on a sphere."""
        return np.asarray(np.linalg.norm(p_cam, axis=1))


def projection_of(camera: Camera) -> Projection:
    """Projection of a camera of the format."""
    return Perspective(camera.distortion) if camera.projection == "perspective" else Equidistant()


def _coefficients(distortion: Distortion) -> Floats:
    """Coefficients in OpenCV's order."""
    return np.array([distortion.k1, distortion.k2, distortion.p1, distortion.p2, distortion.k3])


def _distorted(plane: Floats, distortion: Distortion) -> tuple[Floats, Floats]:
    """Distorted image (n, 2) of pinhole coordinates (n, 2), and its Jacobian (n, 2, 2)."""
    at_depth_1 = np.column_stack([plane, np.ones(len(plane))])
    image, jacobian = cv2.projectPoints(at_depth_1, np.zeros(3), np.zeros(3), np.eye(3), _coefficients(distortion))[:2]
    # Columns 3 and 4 are by the translation along x and y, which at depth 1 shifts the pinhole coordinates.
    return image.reshape(-1, 2), jacobian[:, 3:5].reshape(-1, 2, 2)


@dataclass(frozen=True, eq=False)
class ProjectedPoints:
    """Images of n points: `pixels` (n, 2), NaN outside the lens's valid range; `slopes` (n, 2, 6) by the pose.

    `p_cam` (n, 3) are the points in camera axes, metres. `motion_slopes` (n, 2, 6) are the derivatives by the velocity
    of a camera with a rolling shutter; None without.
    """

    pixels: Floats
    slopes: Floats
    p_cam: Floats
    motion_slopes: Floats | None = None


def project(points_m: Floats, pose: Pose, camera: Camera) -> ProjectedPoints:
    """Images of world points (n, 3), and their derivatives by the POSE_PARAMETERS."""
    p_cam = pose.in_camera(points_m)
    image, jacobian = projection_of(camera).project(p_cam)
    K = camera.matrix()
    to_pixels = np.empty_like(jacobian)
    to_pixels[:, 0] = K[0, 0] * jacobian[:, 0] + K[0, 1] * jacobian[:, 1]
    to_pixels[:, 1] = K[1, 0] * jacobian[:, 0] + K[1, 1] * jacobian[:, 1]
    slopes = np.empty((len(points_m), 2, POSE_PARAMETERS))
    slopes[:, :, :3] = (to_pixels.reshape(-1, 3) @ -pose.R_cam_world).reshape(-1, 2, 3)
    # A turn a of the camera's axes moves a point p in them by a x p, and its image by J (a x p) = (p x J) a.
    turned = np.empty_like(to_pixels)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        turned[:, :, i] = p_cam[:, j, None] * to_pixels[:, :, k] - p_cam[:, k, None] * to_pixels[:, :, j]
    skews = [slope @ pose.R_cam_world.T for slope in rotation_slopes(pose, camera)]
    axes = np.array([(skew[2, 1], skew[0, 2], skew[1, 0]) for skew in skews])
    slopes[:, :, 3:] = (turned.reshape(-1, 3) @ axes.T).reshape(-1, 2, 3)
    return ProjectedPoints(camera.to_pixels(image), slopes, p_cam)


def images_px(points_m: Floats, pose: Pose, camera: Camera) -> tuple[Floats, Floats]:
    """Images (n, 2) of world points (n, 3), and these in camera axes (n, 3): `project` without derivatives."""
    p_cam = pose.in_camera(points_m)
    return camera.to_pixels(projection_of(camera).project(p_cam)[0]), p_cam


def relative_illumination(pixels: Floats, camera: Camera) -> Floats:
    """Irradiance (n,) of the sensor at pixels (n, 2) by a surface of uniform luminance, up to a common factor.

    NaN outside the lens's valid range. It is cos(theta), by which the pupil is foreshortened, times the solid angle
    that an area of the sensor subtends: 1 / |(m1 x m2) . p| with the rows m1, m2 of the projection's Jacobian at the
    unit vector p. For a pinhole the product is cos^4(theta).
    """
    projection = projection_of(camera)
    rays = projection.unproject(camera.normalized(pixels))
    jacobian = projection.project(rays)[1]
    with np.errstate(all="ignore"):
        area = np.abs((np.cross(jacobian[:, 0], jacobian[:, 1]) * rays).sum(axis=1))
        return np.asarray(np.maximum(rays[:, 2], 0.0) / area)


def rotation_slopes(pose: Pose, camera: Camera) -> tuple[Floats, Floats, Floats]:
    """Derivatives of `R_cam_world = R_cam_rig Rx Ry Rz` by tilt_x, tilt_y and yaw, each (3, 3)."""
    about_x = np.array([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    about_y = np.array([[0.0, 0, -1], [0, 0, 0], [1, 0, 0]])
    about_z = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 0]])
    R_cam_rig = camera.R_cam_rig_array()
    R_rig_world = R_cam_rig.T @ pose.R_cam_world
    Rx = rotation(pose.rig_angles(camera)[0], 0.0)
    return (
        R_cam_rig @ about_x @ R_rig_world,
        R_cam_rig @ Rx @ about_y @ Rx.T @ R_rig_world,
        pose.R_cam_world @ about_z,
    )
