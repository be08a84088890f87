"""Projections of the format: camera axes to normalized image coordinates and back (datasets/FORMAT.md, Projection).

Normalized image coordinates (x, y) are in units of the image distance, from the principal point; `Camera.to_pixels`
maps them to pixels.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import Pose
from estimator.compiled import compact, compiled
from estimator.io.camera import Camera, Distortion

Floats = NDArray[np.float64]
Row = tuple[float, float, float]

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
    """Pinhole with optional Brown-Conrady distortion, which OpenCV undoes.

    Valid: directions less than 89.9 deg off the axis, up to where the distortion folds the image.
    """

    distortion: Distortion | None = None

    @property
    def rectilinear(self) -> bool:
        """Whether there is no distortion."""
        return self.distortion is None

    def project(self, p_cam: Floats) -> tuple[Floats, Floats]:
        """See `Projection.project`."""
        plane, jacobian = _pinhole(compact(p_cam))
        if self.distortion is None:
            return plane, jacobian
        return _distorted(plane, jacobian, _coefficients(self.distortion))

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
        return _equidistant(compact(p_cam))

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


@compiled
def _pinhole(p_cam: Floats) -> tuple[Floats, Floats]:
    """Image (n, 2) of points (n, 3) by a pinhole, and its Jacobian (n, 2, 3); NaN beside and behind the camera."""
    plane, jacobian = np.empty((len(p_cam), 2)), np.zeros((len(p_cam), 2, 3))
    for i in range(len(p_cam)):
        x, y, z = p_cam[i, 0], p_cam[i, 1], p_cam[i, 2]
        if not z > MIN_DEPTH_SHARE * math.sqrt(x * x + y * y + z * z):
            z = np.nan
        by_depth = 1 / z
        plane[i, 0], plane[i, 1] = x * by_depth, y * by_depth
        jacobian[i, 0, 0] = jacobian[i, 1, 1] = by_depth
        jacobian[i, 0, 2], jacobian[i, 1, 2] = -plane[i, 0] * by_depth, -plane[i, 1] * by_depth
    return plane, jacobian


@compiled
def _distorted(plane: Floats, jacobian: Floats, coefficients: Floats) -> tuple[Floats, Floats]:
    """Distorted image (n, 2) of pinhole coordinates (n, 2), NaN where it is folded, and its Jacobian (n, 2, 3).

    `jacobian` (n, 2, 3) is that of the pinhole coordinates.
    """
    image, distorted = np.empty_like(plane), np.empty_like(jacobian)
    k1, k2, p1, p2, k3 = coefficients
    for i in range(len(plane)):
        a, b = plane[i, 0], plane[i, 1]
        r2 = a * a + b * b
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
        v = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
        # By a the radial factor changes by 2 a `slope`, by b by 2 b `slope`.
        slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
        u_a = radial + 2 * (a * a * slope + p1 * b + 3 * p2 * a)
        v_b = radial + 2 * (b * b * slope + 3 * p1 * b + p2 * a)
        across = 2 * (a * b * slope + p1 * a + p2 * b)
        # Beyond the fold the image is reversed, or its radius shrinks.
        folded = (u_a * v_b <= across * across) | (a * a * u_a + 2 * a * b * across + b * b * v_b < 0)
        image[i, 0], image[i, 1] = np.nan if folded else u, np.nan if folded else v
        for k in range(3):
            distorted[i, 0, k] = u_a * jacobian[i, 0, k] + across * jacobian[i, 1, k]
            distorted[i, 1, k] = across * jacobian[i, 0, k] + v_b * jacobian[i, 1, k]
    return image, distorted


@compiled
def _equidistant(p_cam: Floats) -> tuple[Floats, Floats]:
    """Image (n, 2) of points (n, 3) by a fish-eye, and its Jacobian (n, 2, 3)."""
    image, jacobian = np.empty((len(p_cam), 2)), np.empty((len(p_cam), 2, 3))
    for i in range(len(p_cam)):
        x, y, z = p_cam[i, 0], p_cam[i, 1], p_cam[i, 2]
        rho = max(math.sqrt(x * x + y * y), 1e-12 * abs(z))
        scale, distance2 = math.atan2(rho, z) / rho, rho * rho + z * z
        # (d scale / d rho) / rho, from d theta / d rho = z / distance2; and d theta / dz = -rho / distance2.
        slope = (z / distance2 - scale) / (rho * rho)
        image[i, 0], image[i, 1] = x * scale, y * scale
        jacobian[i, 0, 0], jacobian[i, 1, 1] = scale + x * x * slope, scale + y * y * slope
        jacobian[i, 0, 1] = jacobian[i, 1, 0] = x * y * slope
        jacobian[i, 0, 2], jacobian[i, 1, 2] = -x / distance2, -y / distance2
    return image, jacobian


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
    R_cam_world, axes = compact(pose.R_cam_world), rotation_axes(pose, camera)
    pixels, slopes = _posed(compact(p_cam), image, jacobian, camera.matrix(), R_cam_world, axes)
    return ProjectedPoints(pixels, slopes, p_cam)


@compiled
def _posed(
    p_cam: Floats, image: Floats, jacobian: Floats, K: Floats, R_cam_world: Floats, axes: Floats
) -> tuple[Floats, Floats]:
    """Pixels (n, 2) of points, and their derivatives (n, 2, 6) by the POSE_PARAMETERS.

    `image` (n, 2) and `jacobian` (n, 2, 3) are those of the points `p_cam` (n, 3) in camera axes; by the angles of the
    pose the world turns about the `axes` (3, 3), one a row, of the camera.
    """
    pixels, slopes = np.empty((len(p_cam), 2)), np.empty((len(p_cam), 2, 6))
    # As numbers they stay in registers: elements of arrays would be read again after each result written.
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = _rows(R_cam_world)
    lines, about = _rows(K), _rows(axes)
    for i in range(len(p_cam)):
        px, py, pz = p_cam[i, 0], p_cam[i, 1], p_cam[i, 2]
        for row in range(2):
            by_x, by_y, origin = lines[row]
            pixels[i, row] = by_x * image[i, 0] + by_y * image[i, 1] + origin
            x = by_x * jacobian[i, 0, 0] + by_y * jacobian[i, 1, 0]
            y = by_x * jacobian[i, 0, 1] + by_y * jacobian[i, 1, 1]
            z = by_x * jacobian[i, 0, 2] + by_y * jacobian[i, 1, 2]
            slopes[i, row, 0] = -(x * xx + y * yx + z * zx)
            slopes[i, row, 1] = -(x * xy + y * yy + z * zy)
            slopes[i, row, 2] = -(x * xz + y * yz + z * zz)
            # A turn a of the world moves a point p by a x p, and its image by J (a x p) = (p x J) a.
            turned_x, turned_y, turned_z = py * z - pz * y, pz * x - px * z, px * y - py * x
            for k in range(3):
                ax, ay, az = about[k]
                slopes[i, row, 3 + k] = turned_x * ax + turned_y * ay + turned_z * az
    return pixels, slopes


@compiled
def _rows(matrix: Floats) -> tuple[Row, Row, Row]:
    """Rows of a matrix (3, 3)."""
    return (
        (matrix[0, 0], matrix[0, 1], matrix[0, 2]),
        (matrix[1, 0], matrix[1, 1], matrix[1, 2]),
        (matrix[2, 0], matrix[2, 1], matrix[2, 2]),
    )


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
    return _foreshortened(compact(jacobian), compact(rays))


@compiled
def _foreshortened(jacobian: Floats, rays: Floats) -> Floats:
    """Of unit vectors (n, 3), the cosine to the axis over the area of the parallelepiped with the rows m1, m2, (n,)."""
    values = np.empty(len(rays))
    for i in range(len(rays)):
        (a, b, c), (d, e, f), (x, y, z) = jacobian[i, 0], jacobian[i, 1], rays[i]
        volume = (b * f - c * e) * x + (c * d - a * f) * y + (a * e - b * d) * z
        values[i] = max(z, 0.0) / abs(volume)
    return values


def rotation_axes(pose: Pose, camera: Camera) -> Floats:
    """Axes, in those of the camera, that the world turns about with the rig's tilt_x, tilt_y, yaw, (3, 3), one a row.

    The rotation is `R_cam_world = R_cam_rig Rx Ry Rz`.
    """
    R_cam_rig = camera.R_cam_rig_array()
    return _axes(R_cam_rig, float(pose.rig_angles(camera)[0]), compact(pose.R_cam_world))


@compiled
def _axes(R_cam_rig: Floats, tilt_x: float, R_cam_world: Floats) -> Floats:
    """See `rotation_axes`."""
    axes, sine, cosine = np.empty((3, 3)), math.sin(tilt_x), math.cos(tilt_x)
    for k in range(3):
        axes[0, k] = -R_cam_rig[k, 0]
        axes[1, k] = sine * R_cam_rig[k, 2] - cosine * R_cam_rig[k, 1]
        axes[2, k] = -R_cam_world[k, 2]
    return axes


def rotation_slopes(pose: Pose, camera: Camera) -> tuple[Floats, Floats, Floats]:
    """Derivatives of `R_cam_world` by the rig's tilt_x, tilt_y and yaw, each (3, 3)."""
    about_x, about_y, about_z = (
        np.cross(axis, pose.R_cam_world, axisb=0, axisc=0) for axis in rotation_axes(pose, camera)
    )
    return about_x, about_y, about_z
