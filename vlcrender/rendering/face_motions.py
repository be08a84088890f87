"""How the pose, the lens and the LEDs' own errors move the images of LEDs: as motions of each face in its own plane."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.rig import Mounted
from vlcrender.core.planar_shapes import Disc
from vlcrender.rendering.led_coverage import intersections_with_plane
from vlcrender.rendering.led_radiance import face_of_led
from vlcrender.rendering.uncertainty import intrinsics_displacements_px
from vlcrender.scene.leds import Leds

Array = NDArray[np.float64]

FACE_NUMBERS = 6
"""Numbers of a linear motion of an LED's face: `FaceMotions`."""
FACE_STEP = 1e-6
"""Step of the differences of these motions, m or radian: 0.01 px of 15 000 px; they are right to some 1e-9."""
OWN = 6
"""Errors of an LED's own: x, y, z, size, and two tilts of its face."""


@dataclass(frozen=True)
class FaceMotions:
    """How unknowns move and deform the images of k LEDs, told as motions of each face in its own plane.

    Each is (k, 6, unknowns), the FACE_NUMBERS of the linear motion d(x, y) = (t_x, t_y) + E (x, y): t_x, t_y, m; then
    E_xx, E_yx, E_xy, E_yy.
    """

    pose: Array
    """By the pose of `main`: x, y, z, m; tilt_x, tilt_y, yaw, radians."""
    lens: Array
    """By the unknowns of the lens, in the units of INTRINSICS."""
    own: Array
    """By what is the LED's own: x, y, z, m; the logarithm of its radius or side; tilts about x and y, radians."""


def face_motions(mounted: Mounted, main: Pose, leds: Leds, indices: NDArray[np.int64]) -> FaceMotions:
    """The motions of the faces of some LEDs; those of a disc without its turn in its plane, which no image shows.

    A point of the face whose image moves to another pixel position moves in the face's plane to the point that the
    unmoved camera sees there. The linear motion is that of the centre and of four points of the rim.
    """
    posed = mounted.posed(main)
    faces = [face_of_led(leds, int(i)) for i in indices]
    discs = np.array([isinstance(face.shape, Disc) for face in faces])
    halves = np.array(
        [
            [face.shape.radius_m] * 2 if isinstance(face.shape, Disc) else [side / 2 for side in face.shape.size_m]
            for face in faces
        ]
    )
    centers_m = np.stack([face.center_m for face in faces])
    plane = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]) * halves[:, None, :]  # (k, 5, 2)
    points = np.concatenate([plane, np.zeros((len(faces), 5, 1))], axis=2) + centers_m[:, None, :]
    pixels = posed.project(points)

    def motion(plus_px: Array, minus_px: Array, step: float) -> Array:
        """(k, 6), from the pixel positions (k, 5, 2) of the points at a step to either side."""
        (x1, y1), (x0, y0) = (
            intersections_with_plane(posed, centers_m.T[:, :, None], px[..., 0], px[..., 1])
            for px in (plus_px, minus_px)
        )
        d = np.stack([x1 - x0, y1 - y0], axis=-1) / (2 * step)
        by_x, by_y = (d[:, 1] - d[:, 2]) / (2 * halves[:, :1]), (d[:, 3] - d[:, 4]) / (2 * halves[:, 1:])
        shear = (by_x[:, 1] + by_y[:, 0]) / 2
        by_x[:, 1] = np.where(discs, shear, by_x[:, 1])
        by_y[:, 0] = np.where(discs, shear, by_y[:, 0])
        return np.concatenate([d[:, 0], by_x, by_y], axis=1)

    def by_pose(unknown: int) -> Array:
        plus, minus = (mounted.posed(moved(main, unknown, sign * FACE_STEP)).project(points) for sign in (1, -1))
        return motion(plus, minus, FACE_STEP)

    def by_lens(displaced: Array) -> Array:
        step = FACE_STEP * mounted.camera.focal_px / max(float(np.abs(displaced).max()), 1.0)
        return motion(pixels + step * displaced, pixels - step * displaced, step)

    def by_points(change: Array) -> Array:
        return motion(posed.project(points + FACE_STEP * change), posed.project(points - FACE_STEP * change), FACE_STEP)

    displacements = np.moveaxis(intrinsics_displacements_px(mounted.camera, pixels[..., 0], pixels[..., 1]), 1, -1)
    lifts = [np.stack([0 * lift, 0 * lift, lift], axis=-1) for lift in (plane[..., 1], -plane[..., 0])]
    bare = np.array([leds.diffusers[int(i)] is None for i in indices], dtype=np.float64)[:, None]
    growth = np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 1.0], (len(faces), 1))
    shifts = [by_points(np.broadcast_to(axis, points.shape)) for axis in np.eye(3)]
    return FaceMotions(
        pose=np.stack([by_pose(unknown) for unknown in range(6)], axis=2),
        lens=np.stack([by_lens(displaced) for displaced in displacements], axis=2),
        own=np.stack([*shifts, bare * growth, *(bare * by_points(lift) for lift in lifts)], axis=2),
    )


def moved(pose: Pose, unknown: int, by: float) -> Pose:
    """The pose with one of x, y, z (m), tilt_x, tilt_y, yaw (rad) changed."""
    x, y, z = pose.position_m
    numbers = [x, y, z, pose.tilt_x_deg, pose.tilt_y_deg, pose.yaw_deg]
    numbers[unknown] += by if unknown < 3 else float(np.degrees(by))
    return Pose((numbers[0], numbers[1], numbers[2]), *numbers[3:])
