"""Projection of a camera that moves while its lines are exposed one after another.

A point is seen at the time of the line that its image is on, and the image moves with the time: with U(t) the image of
a point by the pose at the time t, and s(U) the time of the pixel U, the image is the solution of U = U(s(U)). By a
parameter p it changes by (I + U' s' / (1 - s' U')) dU/dp, where U' is the velocity of the image, pixels a second, and
s' the time of a line along its direction.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.camera.motion import MOTION_PARAMETERS, seen_in_motion
from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.camera.projection import (
    ProjectedPoints,
    project,
    projection_of,
    rotation_slopes,
)
from estimator.io.camera import Camera

Floats = NDArray[np.float64]

# Newton's steps from the image at mid-readout, some 100 px off: the first leaves what the image's velocity changes by
# over that way, a hundredth of the 5 px that it moves in 100 lines; the second nothing.
STEPS = 2


def project_rolling(points_m: Floats, pose: Pose, camera: Camera, velocity: Floats) -> ProjectedPoints:
    """Images of world points (n, 3) by a rolling shutter, with their derivatives by pose and velocity (6,).

    The pose is that at mid-readout; see `estimator.camera.motion` for the velocity.
    """
    projection, to_pixels = projection_of(camera), camera.matrix()[:2, :2]
    # Seconds a pixel along u and v.
    origin = camera.times_s(np.zeros(1), np.zeros(1))
    by_pixel = np.concatenate(
        [camera.times_s(np.ones(1), np.zeros(1)) - origin, camera.times_s(np.zeros(1), np.ones(1)) - origin]
    )
    times_s = np.nan_to_num(camera.times_s(*project(points_m, pose, camera).pixels.T))
    for _ in range(STEPS):
        seen = seen_in_motion(points_m, pose, velocity, times_s)
        image, jacobian = projection.project(seen.p_cam)
        rate_px = np.einsum("nij,nj->ni", to_pixels @ jacobian, seen.rate)
        off_s = camera.times_s(*camera.to_pixels(image).T) - times_s
        times_s = times_s + np.nan_to_num(off_s / (1 - rate_px @ by_pixel))
    seen = seen_in_motion(points_m, pose, velocity, times_s)
    image, jacobian = projection.project(seen.p_cam)
    of_lens = to_pixels @ jacobian
    rate_px = np.einsum("nij,nj->ni", of_lens, seen.rate)
    with np.errstate(invalid="ignore"):
        follow = np.eye(2) + rate_px[:, :, None] * by_pixel / (1 - rate_px @ by_pixel)[:, None, None]
    of_lens = follow @ of_lens
    slopes = np.empty((len(points_m), 2, POSE_PARAMETERS + MOTION_PARAMETERS))
    slopes[:, :, :3] = of_lens @ seen.turned @ -pose.R_cam_world
    for column, rotation_slope in enumerate(rotation_slopes(pose, camera), start=3):
        moved = np.einsum("nij,nj->ni", seen.turned, seen.offset_m @ rotation_slope.T)
        slopes[:, :, column] = (of_lens * moved[:, None]).sum(axis=2)
    slopes[:, :, POSE_PARAMETERS:] = of_lens @ seen.by_motion
    return ProjectedPoints(
        camera.to_pixels(image),
        slopes[:, :, :POSE_PARAMETERS],
        seen.p_cam,
        slopes[:, :, POSE_PARAMETERS:],
    )
