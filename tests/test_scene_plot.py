"""Picture of a scene: which pose it takes, and what its camera sees of the ceiling."""

import numpy as np
from test_raycast import room
from test_visibility import CAMERA, leds_at

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.rendering.scene_plot import footprint_m, outlines_m, show_pose


def test_the_footprint_is_the_rectangle_of_the_image_on_the_ceiling() -> None:
    """By hand: 400 x 300 pixels of 1/1500 rad each cover 0.667 x 0.5 m of a plane 2.5 m above a level camera."""
    posed = PosedCamera(CAMERA, Pose((3.0, 4.0, 0.5)))
    corners = footprint_m(posed, 3.0)
    np.testing.assert_allclose(corners.mean(axis=0), [3.0, 4.0], rtol=1e-12)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
    np.testing.assert_allclose(sorted(sides), [0.5, 0.5, 2 / 3, 2 / 3], rtol=1e-12)


def test_the_corners_of_the_footprint_are_imaged_on_the_corners_of_the_sensor() -> None:
    """Also of a tilted camera; in the order of a walk around the image, so that the outline does not cross itself."""
    posed = PosedCamera(CAMERA, Pose((3.0, 4.0, 0.5), tilt_x_deg=20.0, tilt_y_deg=-10.0, yaw_deg=30.0))
    corners = footprint_m(posed, 3.0)
    pixels = posed.project(np.column_stack([corners, np.full(4, 3.0)]))
    np.testing.assert_allclose(pixels, [[0, 0], [400, 0], [400, 300], [0, 300]], atol=1e-9)


def test_the_picture_is_taken_where_most_leds_are_in_view() -> None:
    """One LED in the middle of the room, three together beside it: the camera goes under the three."""
    scene = leds_at((3.0, 3.5, 3.0), (4.5, 3.5, 3.0), (4.6, 3.5, 3.0), (4.55, 3.6, 3.0))
    x_m, y_m, _ = show_pose(scene, CAMERA).position_m
    assert abs(x_m - 4.55) < 0.06
    assert abs(y_m - 3.55) < 0.06


def test_squares_are_drawn_as_squares_and_discs_as_discs() -> None:
    """Sides along x and y, as the LEDs hang; an LED that would be too small to see is drawn larger."""
    entry = {"id": 0, "position_m": [1.0, 1.0, 3.0], "radius_m": 0.05, "luminance_cd_m2": 5000.0}
    other = {"id": 1, "position_m": [2.0, 2.0, 3.0], "side_m": 0.2, "shape": "square", "luminance_cd_m2": 5000.0}
    leds = room(led=[entry, other]).leds
    disc, square = outlines_m(leds, 0.0)
    np.testing.assert_allclose(np.linalg.norm(disc - [1.0, 1.0], axis=1), 0.05, rtol=1e-12)
    np.testing.assert_allclose(square, [[1.9, 1.9], [2.1, 1.9], [2.1, 2.1], [1.9, 2.1]], rtol=1e-12)
    dot, _ = outlines_m(leds, 1.0)
    np.testing.assert_allclose(np.linalg.norm(dot - [1.0, 1.0], axis=1), 0.5, rtol=1e-12)
