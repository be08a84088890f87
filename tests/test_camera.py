"""Axes and signs: each one written down here, so that no two can cancel."""

import numpy as np
import pytest

from vlcrender.camera import Camera, Pose, mitsuba_to_world, project, rays_world, rotation_cam_world

LAMP = np.array([3.0, 4.0, 3.5])


def spot(lamp: np.ndarray = LAMP, camera: Camera | None = None, **pose: float) -> np.ndarray:
    at = (pose.pop("x", 3.0), pose.pop("y", 4.0), pose.pop("z", 0.5))
    pixels, _ = project(camera or Camera(), Pose(at, **pose), lamp)
    return pixels


def test_a_lamp_straight_above_a_level_camera_is_at_the_principal_point() -> None:
    assert spot() == pytest.approx([2000.0, 1500.0])


def test_the_level_pose_is_the_identity_looking_up() -> None:
    assert np.array_equal(Pose((0, 0, 0)).rotation, np.eye(3))


def test_a_lamp_moved_to_plus_x_moves_its_spot_to_plus_u() -> None:
    # f = 18 mm / 1.2 um = 15 000 px; 0.1 m at 3 m depth is 500 px
    assert spot(LAMP + [0.1, 0, 0]) == pytest.approx([2500.0, 1500.0])


def test_a_lamp_moved_to_plus_y_moves_its_spot_to_plus_v() -> None:
    assert spot(LAMP + [0, 0.1, 0]) == pytest.approx([2000.0, 2000.0])


def test_a_camera_moved_to_plus_x_moves_the_spot_to_minus_u() -> None:
    assert spot(x=3.1) == pytest.approx([1500.0, 1500.0])


def test_a_camera_raised_makes_the_image_larger() -> None:
    assert spot(LAMP + [0.1, 0, 0], z=2.0)[0] == pytest.approx(2000 + 15000 * 0.1 / 1.5)


def test_raising_tilt_x_moves_the_spot_to_plus_v() -> None:
    assert spot(tilt_x_deg=1.0) == pytest.approx([2000.0, 1500 + 15000 * np.tan(np.radians(1.0))])


def test_raising_tilt_y_moves_the_spot_to_minus_u() -> None:
    assert spot(tilt_y_deg=1.0) == pytest.approx([2000 - 15000 * np.tan(np.radians(1.0)), 1500.0])


def test_raising_yaw_turns_a_spot_from_plus_u_towards_minus_v() -> None:
    assert spot(LAMP + [0.1, 0, 0], yaw_deg=90.0) == pytest.approx([2000.0, 1000.0])


def test_tilts_compose_as_equation_5_of_the_paper() -> None:
    # Eq. 6 multiplied out by hand at psi = 30, xi = 60, zeta = 0 (see the errata for its two misprints)
    s, c = np.sin(np.radians([30.0, 60.0])), np.cos(np.radians([30.0, 60.0]))
    expected = [[c[1], 0, -s[1]], [s[0] * s[1], c[0], s[0] * c[1]], [c[0] * s[1], -s[0], c[0] * c[1]]]
    assert np.allclose(rotation_cam_world(30, 60, 0), expected, atol=1e-15)


def test_principal_point_and_skew_enter_as_in_k() -> None:
    camera = Camera(principal_point_px=(1990.5, 1510.25), skew_px=30.0)
    # x/z = 0.1/3, y/z = 0.2/3
    u, v = spot(LAMP + [0.1, 0.2, 0], camera)
    assert (u, v) == pytest.approx((1990.5 + 500 + 30 * 0.2 / 3, 1510.25 + 1000))


def test_rays_undo_projection(rng: np.random.Generator) -> None:
    camera = Camera(principal_point_px=(1900.0, 1600.0), skew_px=12.0)
    pose = Pose((3.0, 2.0, 1.0), 35.0, -50.0, 120.0)
    pixels = rng.uniform([0, 0], [4000, 3000], (100, 2))
    points = np.array(pose.position_m) + 2.5 * rays_world(camera, pose, pixels)
    again, depth = project(camera, pose, points)
    # double precision: 1e4 px * 2^-52 * a few operations
    assert np.allclose(again, pixels, atol=1e-9)
    assert np.allclose(depth, 2.5)


def test_what_is_behind_the_camera_has_no_pixel() -> None:
    pixels, depth = project(Camera(), Pose((3.0, 4.0, 0.5)), np.array([3.0, 4.0, 0.1]))
    assert np.isnan(pixels).all()
    assert depth < 0


def test_the_field_of_view_is_15_19_degrees_not_the_printed_24() -> None:
    across, down = Camera().view_angles_deg()
    assert (round(across, 2), round(down, 2)) == (15.19, 11.42)


def test_mitsubas_camera_is_a_proper_rotation_with_x_left_and_y_up() -> None:
    pose = Pose((1.0, 2.0, 0.5), 20.0, 40.0, 60.0)
    matrix = mitsuba_to_world(pose)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    assert np.allclose(matrix[:3, 0], -pose.rotation[0])  # Mitsuba's +x is our image's left
    assert np.allclose(matrix[:3, 1], -pose.rotation[1])  # its +y our image's up
    assert np.allclose(matrix[:3, 2], pose.rotation[2])  # both look along +z
