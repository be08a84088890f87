"""Slopes of LED images by the motion of their rims, against central differences of exact images."""

from typing import Any

import numpy as np
import pytest
from test_diffuser import panelled
from test_path_traced import scene_of

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import LedRegions
from vlcrender.light.lightmap import bake
from vlcrender.rendering.bayer import MosaicRenderer
from vlcrender.rendering.face_motions import moved
from vlcrender.rendering.led_coverage import coverage_of_led
from vlcrender.rendering.led_radiance import LedImage, face_of_led
from vlcrender.rendering.led_slopes import led_motions
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene
from vlcrender.sensor.radiometry import Silicon

POSE = Pose((1.43, 1.54, 0.5), 6.0, -4.0, 10.0)
CAMERA = {"width_px": 400, "height_px": 300, "pixel_pitch_um": 8.0, "focal_length_mm": 12.0}
"""1500 px of focal length: 2 m away a disc of 0.04 m has a radius of 30 px."""
LED = {"id": 1, "position_m": [1.5, 1.5, 2.5], "luminance_cd_m2": 8000.0, "radius_m": 0.04}
SQUARE = {**{k: v for k, v in LED.items() if k != "radius_m"}, "shape": "square", "side_m": 0.07}
STEP_PX = 1e-4
COARSE = {"texel_m": 0.5, "paths": 16}


def agree(
    renderer: Renderer | MosaicRenderer,
    camera: Camera,
    regions: LedRegions | None = None,
    tolerance: float = 2 / 1500,
) -> None:
    """Compare the norms of slopes by all six unknowns of the pose.

    Exact coverage neglects the change of scale within a pixel, 1 / 1500 of itself, twice in a difference. The
    displacement between nodes of the rim is right to 4e-5, and the polygon to less. A corner of a pixel that the rim
    passes within the step would show; of some 200 edge pixels 4 * 200 * 2e-4 = 0.2 are expected.
    """
    posed = PosedCamera(camera, POSE)
    angle = STEP_PX / 1500
    steps = [2.0 * angle] * 3 + [angle] * 3
    changes = [(posed.at(moved(POSE, i, step)), posed.at(moved(POSE, i, -step))) for i, step in enumerate(steps)]
    leds = renderer.led_slopes(posed, changes, regions)
    assert len(leds) >= 1
    for number, cameras in enumerate(changes):
        after, before = ({p.led_id: p for p in renderer.led_patches(each, regions, POSE)} for each in cameras)
        for led in leds:
            one, other, slope = after[led.led_id], before[led.led_id], led.within(led.roi)[1 + number]
            assert one.roi == other.roi == led.roi
            difference = one.electrons_per_s - other.electrons_per_s
            assert np.linalg.norm(difference) > 0
            assert np.linalg.norm(slope - difference) < tolerance * np.linalg.norm(difference)


@pytest.mark.parametrize(
    "led",
    [
        LED,
        SQUARE,
        {**LED, "face_gradient": [0.3, -0.2], "face_falloff": 0.7},
        {**SQUARE, "face_gradient": [0.2, 0.3]},
        {**LED, "half_power_deg": 8.0},
        {**LED, "half_power_deg": 8.0, "face_gradient": [0.3, -0.2]},
        {**LED, "position_m": [1.53, 1.49, 2.5]},
    ],
    ids=["disc", "square", "uneven disc", "uneven square", "beam", "uneven beam", "cut by the border"],
)
def test_slopes_of_one_led(led: dict[str, Any]) -> None:
    agree(Renderer(scene_of(led=[led], bake=COARSE)), Camera(**CAMERA))


@pytest.mark.parametrize(
    "lens",
    [
        {"focus_distance_m": 1.0},
        {"focus_distance_m": 1.9},
        {"psf": "diffraction", "f_number": 16.0},
        {"distortion": {"k1": -0.2, "p1": 0.01}},
        {"projection": "equidistant"},
    ],
    ids=["wide blur", "narrow blur", "diffraction", "distortion", "fish-eye"],
)
def test_slopes_through_a_lens(lens: dict[str, Any]) -> None:
    led = {**LED, "face_gradient": [0.1, 0.0]}
    agree(Renderer(scene_of(led=[led], bake=COARSE)), Camera(**CAMERA, **lens), LedRegions(kind="leds"))


@pytest.mark.parametrize("split", [2, 4])
def test_a_part_changes_as_its_quarters_together(split: int) -> None:
    """Light of parts is their mean over the part: that of 2 x 2 quarters. To the rounding of sums of positions of 1e3
    px, 2^-52 of them, over displacements of STEP_PX in pieces of 0.1 px.
    """
    leds, posed = scene_of(led=[LED]).leds, PosedCamera(Camera(**CAMERA), POSE)
    face = coverage_of_led(posed, face_of_led(leds, 0))
    assert face is not None
    images = {0: LedImage(leds, 0, posed, face, 1.0, 1.0, 1.0, None)}
    step_m = 2.0 * STEP_PX / 1500
    changes = [(posed.at(moved(POSE, 0, step_m)), posed.at(moved(POSE, 0, -step_m)))]
    (_, once), (_, twice) = (next(led_motions(leds, posed, changes, images, {0: n})) for n in (split, 2 * split))
    coarse, fine = (next(motion.slopes(images[0])).edges for motion in (once, twice))
    assert coarse is not None
    assert fine is not None
    np.testing.assert_array_equal([coarse.rows, coarse.columns], [fine.rows, fine.columns])
    quarters = fine.excess.reshape(-1, split, 2, split, 2).mean(axis=(2, 4))
    assert np.abs(coarse.excess).max() > 0.1 * STEP_PX
    np.testing.assert_allclose(coarse.excess, quarters, rtol=0, atol=1e-6 * STEP_PX)


def test_slopes_of_diffusers() -> None:
    """Six LEDs behind one diffuser, whose images overlap.

    At the diffuser's border the image has the luminance of the pixel's centre, the slope that of the border: half a
    pixel, 1.3 mm / 2 of 30 mm, times (m + 3) / 2, the largest slope of luminance: 4 %.
    """
    scene = panelled(diffuser=True, frame=False, bake=COARSE)
    agree(Renderer(scene), Camera(**CAMERA), tolerance=0.04)


def test_slopes_behind_a_mosaic_with_crosstalk() -> None:
    scene: Scene = scene_of(led=[LED], bake=COARSE)
    light = bake(scene)
    renderer = MosaicRenderer(tuple(Renderer(scene, light, Silicon()) for _ in range(3)), "rggb", 0.1)
    agree(renderer, Camera(**CAMERA, lateral_colour_um=(1.0, 2.0)))
