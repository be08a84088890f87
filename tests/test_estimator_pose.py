"""Pose: the format's rotations and their inverse, steps of the parameters, and the rig's axes."""

import json

import numpy as np
import pytest
from estimator_synthetic import View, description, view_of

from estimator.camera.pose import POSE_PARAMETERS, Pose, rotation, rotation_angles
from estimator.io.camera import Camera

VIEW = view_of((3.5, 3.6, 3.5), 3.0, 25.0, -15.0, 40.0)
TURNED = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def camera(**changes: object) -> Camera:
    made = description(VIEW, 1, np.zeros((1, 3)), 0.01)["cameras"]["main"]  # type: ignore[index]
    return Camera.model_validate_json(json.dumps({**made, **changes}))


@pytest.mark.parametrize(
    "angles_deg", [(0, 0, 0), (33, -47, 0), (-60, 60, 170), (80, 20, -120), (5, 89, 10), (30, -90, 0)]
)
def test_the_rotation_is_the_format_s_and_its_angles_come_back(angles_deg: tuple[float, float, float]) -> None:
    view = View(400, 300, 1500.0, (0, 0, 0), *angles_deg)
    matrix = rotation(*np.radians(angles_deg))
    np.testing.assert_allclose(matrix, view.R_cam_world, atol=1e-15)
    # Near tilt_y = 90 deg rounding of 1e-16 is divided by cos(tilt_y), 1 / 57 at 89 deg.
    np.testing.assert_allclose(np.degrees(rotation_angles(matrix)), angles_deg, atol=1e-11)


@pytest.mark.parametrize("R_cam_rig", [np.eye(3).tolist(), TURNED])
def test_a_step_moves_the_rig_s_parameters(R_cam_rig: list[list[float]]) -> None:
    lens = camera(R_cam_rig=R_cam_rig)
    angles = np.radians([25.0, -15.0, 40.0])
    pose = Pose.of_rig_angles(np.array([1.0, 2.0, 0.5]), angles, lens)
    np.testing.assert_allclose(pose.R_cam_world, np.array(R_cam_rig) @ rotation(*angles), atol=1e-15)
    step = np.arange(1, POSE_PARAMETERS + 1) / 100
    moved = pose.moved(step, lens)
    np.testing.assert_allclose(moved.position_m, [1.01, 2.02, 0.53], atol=1e-15)
    np.testing.assert_allclose(moved.rig_angles(lens), angles + step[3:], atol=1e-14)


def test_points_in_camera_axes_are_the_format_s() -> None:
    """p_cam = R_cam_world (p - position): a level camera has the world's axes."""
    level = Pose(np.array([1.0, 2.0, 0.5]), np.eye(3))
    np.testing.assert_allclose(level.in_camera(np.array([[1.3, 1.8, 3.5]])), [[0.3, -0.2, 3.0]], atol=1e-15)
    # Yaw of 90 deg: x of the camera is y of the world.
    turned = Pose(np.zeros(3), rotation(0.0, 0.0, np.pi / 2))
    np.testing.assert_allclose(turned.in_camera(np.array([[0.0, 1.0, 0.0]])), [[1.0, 0.0, 0.0]], atol=1e-15)
