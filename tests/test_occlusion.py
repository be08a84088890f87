"""Occlusion of LEDs: shares of single pixels, and LEDs that nothing hides."""

from pathlib import Path

import numpy as np
import pytest
from test_raycast import LAMP, room

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.light.lightmap import Lightmap, room_mesh
from vlcrender.rendering.background import Background
from vlcrender.rendering.led_coverage import coverage_of_led
from vlcrender.rendering.led_radiance import face_of_led
from vlcrender.rendering.occlusion import LitRegion, Occlusion
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene

CAMERA = Camera(width_px=400, height_px=300, pixel_pitch_um=12.0)
POSED = PosedCamera(CAMERA, Pose((3.0, 3.5, 0.5)))
"""Straight below the LED, 3 m from its plane: 500 px a metre."""


def occlusion_of(scene: Scene) -> Occlusion:
    """Occlusion of a scene whose light is not baked."""
    mesh = room_mesh(scene)
    dark = np.zeros(len(mesh.vertices_m) + len(scene.leds))
    return Occlusion(scene, Background(scene, Lightmap(mesh, dark, dark, dark, dark)))


def board(folder: Path, edge_x: float, z: float) -> dict[str, object]:
    """A board from edge_x to x = 4, seen from below."""
    vertices = [(edge_x, 3.0), (4.0, 3.0), (4.0, 4.0), (edge_x, 4.0)]
    (folder / "board.obj").write_text("".join(f"v {x} {y} 0\n" for x, y in vertices) + "f 1 3 2\nf 1 4 3\n")
    return {"file": "board.obj", "position_m": [0.0, 0.0, z]}


@pytest.mark.parametrize("edge_m", [0.0, 0.0005, 0.0012, -0.0131])
def test_a_pixel_at_an_edge_is_clear_by_its_area_before_the_edge(tmp_path: Path, edge_m: float) -> None:
    """The edge of a board 2.99 m up is a line of the image at a known column: 8 rays across a pixel are off by 1/16."""
    scene = room(tmp_path, furniture=[board(tmp_path, 3.0 + edge_m, 3.49)])
    image = coverage_of_led(POSED, face_of_led(scene.leds, 0))
    assert image is not None
    (share,) = occlusion_of(scene).clear_shares(POSED, [LitRegion(3.5, image.roi, image.coverage > 0)])
    assert not isinstance(share, float)
    edge_px = CAMERA.width_px / 2 + edge_m * CAMERA.focal_px / 2.99
    clear = np.clip(edge_px - np.arange(image.roi.column, image.roi.end_column), 0.0, 1.0)
    lit = image.coverage > 0
    # beside the float32 of a ray, 1e-7 of 400 px
    assert np.abs(share - clear)[lit].max() <= 1 / 16 + 1e-3


def test_visible_and_imaged_fractions_are_less_what_is_occluded(tmp_path: Path) -> None:
    renderer = Renderer(room(tmp_path, furniture=[board(tmp_path, 3.0, 3.49)]))
    (patch,) = renderer.expected_image(POSED).patches
    # half a disc of 15 px of radius, and the edge to 1/16 px
    assert patch.visible_fraction == pytest.approx(0.5, abs=1 / 16 / 15)
    assert patch.imaged_fraction == patch.visible_fraction


def test_a_board_above_the_led_or_beside_it_hides_nothing(tmp_path: Path) -> None:
    """An LED below its board is in full view, and so is one whose pixels the board does not cover."""
    low = {**LAMP, "position_m": [3.0, 3.5, 3.4]}
    above, beside = board(tmp_path, 2.5, 3.41), board(tmp_path, 3.5, 3.0)
    for piece in (above, beside):
        scene = room(tmp_path, led=[low], furniture=[piece])
        image = coverage_of_led(POSED, face_of_led(scene.leds, 0))
        assert image is not None
        assert occlusion_of(scene).clear_shares(POSED, [LitRegion(3.4, image.roi, image.coverage > 0)]) == [1.0]


def test_each_led_is_occluded_at_its_own_height(tmp_path: Path) -> None:
    """Two LEDs beside each other, one above a board that covers both and one below it."""
    leds = [{**LAMP, "position_m": [2.9, 3.5, 3.5]}, {**LAMP, "id": 2, "position_m": [3.1, 3.5, 3.0]}]
    scene = room(tmp_path, led=leds, furniture=[board(tmp_path, 2.5, 3.2)])
    images = [coverage_of_led(POSED, face_of_led(scene.leds, i)) for i in range(2)]
    lit = [
        LitRegion(float(height_m), image.roi, image.coverage > 0)
        for height_m, image in zip(scene.leds.centers_m[:, 2], images, strict=True)
        if image is not None
    ]
    hidden, clear = occlusion_of(scene).clear_shares(POSED, lit)
    assert isinstance(hidden, np.ndarray)
    assert not hidden[lit[0].lit].any()
    assert clear == 1.0


@pytest.mark.parametrize("tilt_deg", [0.0, 40.0, 80.0])
def test_a_ceiling_does_not_hide_the_leds_on_it(tmp_path: Path, tilt_deg: float) -> None:
    """Rays meet the ceiling in the LED's own plane, at any slope."""
    scene = room(tmp_path, furniture=[board(tmp_path, 3.9, 1.0)])
    back_m = 2.5 * np.tan(np.radians(tilt_deg))
    posed = PosedCamera(CAMERA, Pose((max(3.0 - back_m, 0.1), 3.5, 1.0), tilt_y_deg=tilt_deg))
    towards = np.degrees(np.arctan2(3.0 - posed.pose.position_m[0], 2.5))
    posed = posed.at(Pose(posed.pose.position_m, tilt_y_deg=float(towards)))
    image = coverage_of_led(posed, face_of_led(scene.leds, 0))
    assert image is not None
    assert occlusion_of(scene).clear_shares(posed, [LitRegion(3.5, image.roi, image.coverage > 0)]) == [1.0]
