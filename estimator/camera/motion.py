"""Motion of a camera while the lines of its sensor are exposed one after another (rolling shutter).

Velocities are constant while a frame is read out. A camera that turns by w, in its own axes, and moves by v, in world
axes, sees at the time t after the middle of the readout

    p_cam(t) = exp(-t [w]x) R_cam_world (p_world - position - t v),

where position and R_cam_world are those at t = 0. A velocity is one vector (6,): w, rad/s, then v, m/s.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.camera.pose import Pose

Floats = NDArray[np.float64]

MOTION_PARAMETERS = 6
"""Angular velocity about the camera's x, y, z, rad/s, then velocity along the world's x, y, z, m/s."""


@dataclass(frozen=True, eq=False)
class MovingPoints:
    """n points in the axes of a moving camera, each at a time of its own.

    `p_cam` (n, 3) are metres; `turned` (n, 3, 3) the rotations exp(-t [w]x) from the camera's axes at t = 0 to those at
    the point's time; `offset_m` (n, 3) the points less the camera's position at their times, world axes. `by_motion`
    (n, 3, 6) are the derivatives of `p_cam` by the velocity, `rate` (n, 3) those by the time, m/s.
    """

    p_cam: Floats
    turned: Floats
    offset_m: Floats
    by_motion: Floats
    rate: Floats


def seen_in_motion(points_m: Floats, pose: Pose, velocity: Floats, times_s: Floats) -> MovingPoints:
    """World points (n, 3) as a camera of a pose at t = 0 and a velocity (6,) sees them at times (n,)."""
    angles = -times_s[:, None] * velocity[:3]
    turned = np.asarray(Rotation.from_rotvec(angles).as_matrix())
    offset_m = points_m - pose.position_m - times_s[:, None] * velocity[3:]
    p_cam = np.einsum("nij,nj->ni", turned, offset_m @ pose.R_cam_world.T)
    # exp([a]x) p changes by -[p]x (1 + [a]x / 2 + ..) da: the next term is a^2 / 6, 5e-6 at 20 deg/s and 15 ms.
    left = np.eye(3) + cross_matrices(angles) / 2
    by_turn = times_s[:, None, None] * (cross_matrices(p_cam) @ left)
    moved = turned @ pose.R_cam_world
    by_shift = -times_s[:, None, None] * moved
    rate = -np.cross(velocity[:3], p_cam) - moved @ velocity[3:]
    return MovingPoints(p_cam, turned, offset_m, np.concatenate([by_turn, by_shift], axis=2), rate)


def turned_back(image: Floats, velocity: Floats, times_s: Floats) -> Floats:
    """Normalized pinhole coordinates (n, 2) at times (n,), with the camera's turns since t = 0 undone."""
    rays = np.column_stack([image, np.ones(len(image))])
    rays = Rotation.from_rotvec(times_s[:, None] * velocity[:3]).apply(rays)
    return np.asarray(rays[:, :2] / rays[:, 2:])


def cross_matrices(vectors: Floats) -> Floats:
    """Matrices [v]x, (n, 3, 3), of vectors (n, 3): [v]x p = v x p."""
    x, y, z = vectors.T
    o = np.zeros_like(x)
    return np.array([[o, -z, y], [z, o, -x], [-y, x, o]]).transpose(2, 0, 1)
