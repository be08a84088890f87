"""LEDs in view of a pose, and the share of poses with enough LEDs in view."""

import numpy as np
import pytest
from test_raycast import room

from vlcrender.camera.intrinsics import Camera, Pose, rotation_cam_world
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.scene.loader import Scene
from vlcrender.scene.visibility import TILTED_POSES, leds_in_view, level_visibility, tilted_visibility

CAMERA = Camera(width_px=400, height_px=300, pixel_pitch_um=12.0)
"""1500 px of focal length: 600 px a metre 2.5 m up."""


def leds_at(*positions: tuple[float, float, float], radius_m: float = 0.02, **changes: object) -> Scene:
    entries = [
        {"id": i, "position_m": list(position), "radius_m": radius_m, "luminance_cd_m2": 5000.0}
        for i, position in enumerate(positions)
    ]
    return room(led=entries, **changes)


@pytest.mark.parametrize("yaw_deg", [0.0, 5.0, 7.5, 90.0])
@pytest.mark.parametrize("margin_px", [0.0, 8.0])
def test_an_led_is_in_view_with_its_whole_rim_inside_the_margin(yaw_deg: float, margin_px: float) -> None:
    """A disc of 12 px of radius moves to each border; its circle is taken as a polygon 0.9 % larger."""
    scene = leds_at((3.0, 3.5, 3.5))
    right, down, _ = rotation_cam_world(0.0, 0.0, yaw_deg)

    def seen(towards: np.ndarray, half_px: float, inside_px: float) -> bool:
        """Whether the LED is in view with its centre this far inside the border `half_px` from the middle."""
        x, y, z = np.array([3.0, 3.5, 1.0]) - towards * (half_px - inside_px) / 600
        return leds_in_view(PosedCamera(CAMERA, Pose((x, y, z), yaw_deg=yaw_deg)), scene, margin_px).tolist() == [0]

    for towards, half_px in ((right, 200.0), (-right, 200.0), (down, 150.0), (-down, 150.0)):
        assert not seen(towards, half_px, margin_px + 12 * 0.999)
        assert seen(towards, half_px, margin_px + 12 * 1.009)


def test_an_led_below_the_camera_is_not_in_view() -> None:
    """LEDs face down: a camera above one that looks down images the place of its dark back."""
    scene = leds_at((3.0, 3.5, 1.0), (3.0, 3.5, 3.5))
    assert leds_in_view(PosedCamera(CAMERA, Pose((3.0, 3.5, 2.5), tilt_x_deg=180.0)), scene).tolist() == []
    assert leds_in_view(PosedCamera(CAMERA, Pose((3.0, 3.5, 2.5))), scene).tolist() == [1]


def test_level_visibility_counts_leds_above_the_camera_only() -> None:
    """Four LEDs 2.5 m above the camera, and four below it, which a level camera never sees: counted by hand."""
    above = [(3.0 + 0.1 * i, 3.5, 3.5) for i in range(4)]
    below = [(5.0, 3.0 + 0.1 * i, 0.5) for i in range(4)]
    result = level_visibility(CAMERA, leds_at(*above, *below), 1.0, 0.0)
    at = (np.arange(350) + 0.5) * 0.02
    x, y = ((np.array(above)[:, i] - at[:, None]) * 600 for i in (0, 1))
    seen = (np.abs(x) <= 200)[:, None] & (np.abs(y) <= 150)[None]
    assert result.poses == 350**2
    assert result.seen == (seen.sum(axis=2) >= 4).sum() > 0
    assert result.share == result.seen / 350**2


@pytest.mark.parametrize("height_m", [1.0, 3.2])
def test_tilted_visibility_is_the_share_of_random_poses(rng: np.random.Generator, height_m: float) -> None:
    """Against other random poses, in a room whose LEDs are all in one part: 5 sigma of both samples.

    Far below the LEDs the share depends on where tilted cameras look, close to them on how far they are tilted.
    """
    size = {"size_m": [4.0, 8.0, 3.5], "reflectance": {"floor": 0.2, "ceiling": 0.8, "walls": 0.5}}
    grid = [(0.5 + 0.5 * i, 5.0 + 0.5 * j, 3.5) for i in range(7) for j in range(6)]
    scene = leds_at(*grid, room=size)
    camera = Camera(width_px=400, height_px=300, pixel_pitch_um=60.0)
    count, seen = 2000, 0
    for x, y, *angles in rng.uniform([0, 0, 0, 0, -180], [4, 8, 60, 60, 180], (count, 5)):
        p = (np.array(grid) - [x, y, height_m]) @ rotation_cam_world(*angles).T
        u, v = p[:, :2].T / np.maximum(p[:, 2], 1e-9) * 300
        seen += ((p[:, 2] > 0) & (np.abs(u) <= 200) & (np.abs(v) <= 150)).sum() >= 4
    share = seen / count
    result = tilted_visibility(camera, scene, height_m)
    assert result.poses == TILTED_POSES
    assert 0.1 < share < 0.9
    assert abs(result.share - share) < 5 * np.sqrt(share * (1 - share) * (1 / count + 1 / TILTED_POSES))


def test_tilted_poses_have_every_yaw_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Yaws are even from -180 to 180 deg: within 1 % of a half turn from both ends, as 5000 draws are but for a chance
    of exp(-25), and their mean is 0 within 4 of its standard errors.
    """
    yaws = []

    def noted(position: tuple[float, float, float], *angles: float) -> Pose:
        yaws.append(angles[2])
        return Pose(position, *angles)

    monkeypatch.setattr("vlcrender.scene.visibility.Pose", noted)
    tilted_visibility(CAMERA, leds_at((3.0, 3.5, 3.5)), 0.0)
    assert len(yaws) == TILTED_POSES
    assert -180 <= min(yaws) < -178.2
    assert 178.2 < max(yaws) <= 180
    assert abs(np.mean(yaws)) < 4 * 360 / np.sqrt(12 * TILTED_POSES)
