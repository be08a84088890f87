"""Terms of second order in the error of a position that LEDs and a direction determine together.

Few LEDs fix the camera's distance from them to less than a millimetre and leave its direction open to centimetres where
its motion is not known. The possible positions lie on an arc, which derivatives take for a straight line. With a turn a
of the camera, R = exp(-[a]x) R0, and the LEDs' centre c at t = t0 + b in camera axes, the position is

    c - R^T t = c - R0^T (t0 + b + a x (t0 + b) + a x (a x t0) / 2 + ..).

Its mean square error by normal a and b has, beside that of the terms of first order, that of those of second order.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.camera.projection import rotation_slopes
from estimator.io.camera import Camera

Floats = NDArray[np.float64]


def of_pose_vector(x: Floats, covariance: Floats) -> Floats:
    """Mean square (3, 3), m^2, of the terms of second order, by the covariance (k, k) of the parameters x (k,).

    The first six are a rotation vector and the LEDs' centre in camera axes (`estimator.solvers.observations`).
    """
    R_cam_world, by_vector = (np.asarray(one) for one in cv2.Rodrigues(x[:3]))
    to_local = np.eye(POSE_PARAMETERS)
    to_local[:3, :3] = _turns(by_vector.reshape(3, 3, 3), R_cam_world)
    local = to_local @ covariance[:POSE_PARAMETERS, :POSE_PARAMETERS] @ to_local.T
    return _mean_square(R_cam_world, x[3:POSE_PARAMETERS], local)


def of_pose(pose: Pose, camera: Camera, centre_m: Floats, covariance: Floats) -> Floats:
    """The same by the covariance (k, k) of parameters whose first six are the POSE_PARAMETERS, and the LEDs' centre."""
    t = pose.R_cam_world @ (centre_m - pose.position_m)
    turns = _turns(np.array(rotation_slopes(pose, camera)), pose.R_cam_world)
    to_local = np.zeros((POSE_PARAMETERS, POSE_PARAMETERS))
    to_local[:3, 3:] = turns
    to_local[3:, :3] = -pose.R_cam_world
    to_local[3:, 3:] = np.cross(t, turns.T).T
    local = to_local @ covariance[:POSE_PARAMETERS, :POSE_PARAMETERS] @ to_local.T
    return _mean_square(pose.R_cam_world, t, local)


def _turns(slopes: Floats, R_cam_world: Floats) -> Floats:
    """Turns a (3, 3), a column a parameter, of the derivatives (3, 3, 3) of R = exp(-[a]x) R0 by three parameters."""
    skew = -slopes @ R_cam_world.T
    return np.array([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]])


def _mean_square(R_cam_world: Floats, t: Floats, local: Floats) -> Floats:
    """Mean square (3, 3) by the covariance (6, 6) of (a, b), see the module."""
    hessians = np.zeros((3, POSE_PARAMETERS, POSE_PARAMETERS))
    for i, axis in enumerate(np.eye(3)):
        # Component i of a x (a x t) / 2 = (a (a . t) - t a^2) / 2, and of a x b = a^T L b, L[j, k] = epsilon_ijk.
        hessians[i, :3, :3] = (np.outer(axis, t) + np.outer(t, axis)) / 2 - t[i] * np.eye(3)
        hessians[i, :3, 3:] = np.cross(np.eye(3), axis)
        hessians[i, 3:, :3] = hessians[i, :3, 3:].T
    scaled = hessians @ local
    traces = np.trace(scaled, axis1=1, axis2=2)
    second = (np.outer(traces, traces) + 2 * np.einsum("iab,jba->ij", scaled, scaled)) / 4
    return np.asarray(R_cam_world.T @ second @ R_cam_world)
