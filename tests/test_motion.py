"""Cameras that move during the exposure: streaks of the right length and direction, with all their light."""

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import mounted_cameras
from vlcrender.dataset.recipe.motion import Motion, poses_during
from vlcrender.errors import InputError
from vlcrender.rendering.readout import LinePoses
from vlcrender.rendering.renderer import LedPatch, Renderer
from vlcrender.scene.loader import Scene

EXPOSURE_S = 0.01
POSE = Pose((0.3, 1.9, 0.5))
"""Under LED 2 of Table 1, 3 m below it."""
LED_2 = np.array([0.3, 1.9, 3.5])


def patch(scene: Scene, camera: Camera, motion: Motion | None) -> LedPatch:
    (mounted,) = mounted_cameras(camera, ())
    during = poses_during(motion, mounted, POSE, EXPOSURE_S, scene)
    return next(
        p for p in Renderer(scene).expected_image(PosedCamera(camera, POSE), None, during).patches if p.led_id == 2
    )


def moments(light: LedPatch) -> tuple[np.ndarray, np.ndarray]:
    """Centroid (u, v) and covariance (2, 2) of an LED's light."""
    rows, columns = np.indices(light.electrons_per_s.shape)
    pixels = np.stack([columns + light.column + 0.5, rows + light.row + 0.5]).reshape(2, -1)
    weights = light.electrons_per_s.astype(float).ravel()
    return pixels @ weights / weights.sum(), np.cov(pixels, aweights=weights, bias=True)


STREAKS = {
    # image of an LED: opposite to the motion of the camera, f v t / h = 1500 px * 4 m/s * 10 ms / 3 m = 20 px
    "to +x": (Motion(linear_velocity_m_s=(4.0, 0.0, 0.0)), (-20.0, 0.0)),
    "to +y": (Motion(linear_velocity_m_s=(0.0, -4.0, 0.0)), (0.0, 20.0)),
    # f w t = 1500 px * 50 deg/s * 10 ms = 13.09 px: turned about y (down) the axis goes to the right, the image left
    "about y": (Motion(angular_velocity_deg_s=(0.0, 50.0, 0.0)), (-13.09, 0.0)),
    # about x (right) the axis goes from z to -y, up in the image, and the LED's image down
    "about x": (Motion(angular_velocity_deg_s=(50.0, 0.0, 0.0)), (0.0, 13.09)),
    "along a diagonal": (Motion(linear_velocity_m_s=(3.0, 2.0, 0.0)), (-15.0, -10.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", STREAKS)
def test_a_streak_is_as_long_as_the_displacement(table1: Scene, small_camera: Camera, name: str) -> None:
    motion, displacement_px = STREAKS[name]
    still, moved = (patch(table1, small_camera, m) for m in (None, motion))
    # A streak of length L is the image at rest convolved with a line: its covariance grows by d d^T / 12, with N
    # midpoints by (1 - 1/N^2) of it, 4e-4 for steps of half a pixel on 20 px. The size of the image at rest changes
    # with the square of the displacement over the distance, 1e-4 of its 5 px^2.
    (center, spread), (center_still, spread_still) = moments(moved), moments(still)
    expected = np.outer(displacement_px, displacement_px) / 12
    assert np.allclose(spread - spread_still, expected, atol=2e-3 * np.trace(expected))
    assert np.allclose(center, center_still, atol=0.01)
    # cos^4 and the magnification change over the way: (10 px / 1500 px)^2 * 2 = 1e-4
    assert moved.electrons_per_s.sum(dtype=float) == pytest.approx(still.electrons_per_s.sum(dtype=float), rel=3e-4)
    assert moved.visible_fraction == 1.0


@pytest.mark.parametrize("name", STREAKS)
def test_a_later_pose_is_further_along_the_streak(small_camera: Camera, name: str) -> None:
    """The sign of the displacement, which a streak does not show."""
    motion, displacement_px = STREAKS[name]
    later = PosedCamera(small_camera, motion.pose_at(POSE, EXPOSURE_S)).project(LED_2)
    now = PosedCamera(small_camera, POSE).project(LED_2)
    assert later - now == pytest.approx(displacement_px, abs=0.02)  # tan(w t) is longer than w t by (0.0087)^2 / 3


def test_turning_about_the_axis_turns_the_image_back(small_camera: Camera) -> None:
    later = Motion(angular_velocity_deg_s=(0.0, 0.0, 10.0)).pose_at(POSE, 1.0)
    led = LED_2 + [0.2, 0.0, 0.0]  # 100 px right of the centre; x (right) turns to y (down), the image turns up
    angle = np.radians(10)
    expected = [200 + 100 * np.cos(angle), 150 - 100 * np.sin(angle)]
    assert PosedCamera(small_camera, later).project(led) == pytest.approx(expected, abs=1e-9)


def test_steps_are_at_most_half_a_pixel(table1: Scene, small_camera: Camera) -> None:
    (mounted,) = mounted_cameras(small_camera, ())
    during = poses_during(STREAKS["to +x"][0], mounted, POSE, EXPOSURE_S, table1)
    pixels = np.array([PosedCamera(small_camera, pose).project(LED_2) for pose in during])
    assert np.abs(np.diff(pixels[:, 0])).max() <= 0.5 + 1e-9
    assert len(during) < 60
    assert pixels.mean(axis=0) == pytest.approx(PosedCamera(small_camera, POSE).project(LED_2))


def test_motion_at_rest_gives_the_same_bits(table1: Scene, small_camera: Camera) -> None:
    assert poses_during(Motion(), mounted_cameras(small_camera, ())[0], POSE, EXPOSURE_S, table1) == (POSE,)
    renderer = Renderer(table1)
    one = renderer.expected_image(PosedCamera(small_camera, POSE)).expected_electrons(1e-4)
    assert (
        renderer.expected_image(PosedCamera(small_camera, POSE), None, (POSE,)).expected_electrons(1e-4).tobytes()
        == one.tobytes()
    )


def test_too_long_a_motion_is_refused(table1: Scene) -> None:
    (mounted,) = mounted_cameras(Camera(), ())
    with pytest.raises(InputError, match=r"motion: moves the image by .* px .* at most 1000 px"):
        poses_during(Motion(linear_velocity_m_s=(50.0, 0.0, 0.0)), mounted, POSE, EXPOSURE_S, table1)


def test_a_turn_that_leaves_nothing_in_view_is_refused(table1: Scene, small_camera: Camera) -> None:
    """60 deg during the exposure: no point within 25 deg of the axis before it is there after it."""
    (mounted,) = mounted_cameras(small_camera, ())
    with pytest.raises(InputError, match=r"motion: moves the image by .* at most 1000 px"):
        poses_during(Motion(angular_velocity_deg_s=(0.0, 60 / EXPOSURE_S, 0.0)), mounted, POSE, EXPOSURE_S, table1)


def test_the_room_in_a_short_motion_is_the_mean_over_its_poses(office: Scene, small_camera: Camera) -> None:
    """Within surfaces one ray replaces the mean; where surfaces meet, each of 64 rays has one of the poses.

    Both the mean of 64 rays at each pose and that of 64 rays in all err by about 1.3 % of the step at an edge (RMS over
    edges' places, EDGE_GRID); five times that is allowed to the worst pixel. Elsewhere light is interpolated between
    vertices: its slope changes by a few per cent within a texel, some 10 px here, a quarter of which an image moves by.
    """
    motion = Motion(angular_velocity_deg_s=(9.0, 5.0, 0.0))
    (mounted,) = mounted_cameras(small_camera, ())
    middle = Pose((3.15, 3.1, 0.6), 6.0, -8.0, 20.0)
    renderer, posed = Renderer(office), mounted.posed(middle)
    pixel = 1 / small_camera.focal_px
    during = poses_during(motion, mounted, middle, 3.4 * pixel / np.radians(9.0), office)
    assert isinstance(during, tuple)
    assert len(during) > 2
    assert renderer._background.reach_px(posed, [LinePoses.of(pose) for pose in during]) == 2
    ours = renderer.expected_image(posed, during=during).parts[0].background_e_per_s
    each = [renderer.expected_image(posed.at(pose)).parts[0].background_e_per_s for pose in during]
    mean, low, high = np.mean(each, axis=0), np.min(each, axis=0), np.max(each, axis=0)
    step = maximum_filter(high, 5) - minimum_filter(low, 5)
    assert (np.abs(ours - mean) <= 5 * 0.013 * step + 2e-4 * mean).all()
    assert ours.sum(dtype=float) == pytest.approx(mean.sum(dtype=float), rel=2e-4)
    assert np.abs(each[0] - mean).max() > 0.1 * mean.max()  # the motion shows
