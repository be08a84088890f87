"""Specular reflections of LEDs: beams, regions, blur, motion, several glazings."""

import numpy as np
import pytest
from test_raycast import GLAZING, LAMP, WIDE, room

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.light.lightmap import bake
from vlcrender.rendering.background import Background
from vlcrender.rendering.expected_image import SpecularReflection
from vlcrender.rendering.occlusion import Occlusion
from vlcrender.rendering.renderer import Renderer
from vlcrender.rendering.specular_reflection import blurred, specular_reflections
from vlcrender.scene.loader import Scene

POSED = PosedCamera(WIDE, Pose((2.0, 3.4, 1.0), tilt_y_deg=-60.0))
"""Sees the LED at x = 3 by way of the wall x = 0, as if at x = -3."""
SENSOR = Roi.of_sensor(WIDE)


def reflections_of(scene: Scene, number: int = 0, rois: tuple[Roi, ...] = (SENSOR,)) -> list[SpecularReflection]:
    occlusion = Occlusion(scene, Background(scene, bake(scene)))
    return specular_reflections(scene, occlusion, POSED, number, rois, 1.0)


def light(reflections: list[SpecularReflection]) -> float:
    return sum(float(reflection.electrons_per_s.sum(dtype=float)) for reflection in reflections)


def on_sensor(reflections: list[SpecularReflection]) -> np.ndarray:
    image = np.zeros((SENSOR.rows, SENSOR.columns), dtype=np.float32)
    for reflection in reflections:
        image[SENSOR.slices(reflection.roi)] += reflection.electrons_per_s
    return image


def test_a_reflection_of_a_narrow_beam_is_dimmer_off_the_leds_normal() -> None:
    """L = L_0 cos^(m - 1) at the LED, 2.5 m up and 5 m across by way of the glazing, for a half-power angle of 30 deg.

    Over the LED's face the angle varies by r / d = 0.5 %, to either side of its centre, and the luminance by 4 %; the
    sum over the face by its square, 2e-3 at most.
    """
    narrow, plain = (
        light(reflections_of(room(glazing=[GLAZING], led=[{**LAMP, "half_power_deg": angle}])))
        for angle in (30.0, 60.0)
    )
    order = -np.log(2) / np.log(np.cos(np.radians(30.0)))
    cosine = 2.5 / np.linalg.norm([5.0, 0.1, 2.5])
    assert narrow / plain == pytest.approx(cosine ** (order - 1), rel=2e-3)


def test_a_reflection_across_two_regions_is_given_in_parts() -> None:
    scene = room(glazing=[GLAZING])
    (whole,) = reflections_of(scene)
    column = whole.column + 3
    halves = Roi(0, 0, SENSOR.rows, column), Roi(0, column, SENSOR.rows, SENSOR.columns - column)
    parts = reflections_of(scene, rois=halves)
    assert len(parts) == 2
    assert all(half.contains(part.roi) for half, part in zip(halves, parts, strict=True))
    assert np.array_equal(on_sensor(parts), on_sensor([whole]))
    assert not reflections_of(scene, rois=(Roi(0, 0, 5, 5),))


def test_two_glazings_in_one_wall_reflect_an_led_once() -> None:
    """Their planes are one, so that both have the LED's mirror image in the same place; the ray meets one of them."""
    beside = {**GLAZING, "corner_m": [0.1, 0.5], "size_m": [0.3, 2.5]}
    scene = room(glazing=[beside, GLAZING])
    assert not reflections_of(scene, 0)
    assert np.array_equal(on_sensor(reflections_of(scene, 1)), on_sensor(reflections_of(room(glazing=[GLAZING]))))


def test_a_reflection_is_blurred_by_the_kernel_on_the_sensor() -> None:
    """A point of light in the sensor's corner: the quarter of the kernel on the sensor, in parts for two regions."""
    kernel = np.arange(1.0, 26.0).reshape(5, 5) / 325
    point = SpecularReflection(7, 0, 0, np.full((1, 1), 650.0, dtype=np.float32))
    regions = Roi(0, 0, 10, 1), Roi(0, 1, 10, 20)
    parts = blurred([point], kernel, regions, SENSOR)
    assert [(part.led_id, part.roi) for part in parts] == [(7, Roi(0, 0, 3, 1)), (7, Roi(0, 1, 3, 2))]
    # float32, and rounding of a convolution by FFT
    assert on_sensor(parts)[:3, :3] == pytest.approx(2 * np.arange(1.0, 26.0).reshape(5, 5)[2:, 2:], rel=1e-6)
    beyond = SpecularReflection(7, -4, 0, np.full((1, 1), 650.0, dtype=np.float32))
    assert not blurred([beyond], kernel, regions, SENSOR)


def test_reflections_of_a_camera_that_moves_are_the_mean_over_its_poses() -> None:
    """Two poses that are the same: the light of one. With twice the electrons each pose would count as the whole."""
    renderer = Renderer(room(glazing=[GLAZING], led=[{**LAMP, "radius_m": 0.2}]))
    posed = PosedCamera(Camera(width_px=100, height_px=80, pixel_pitch_um=200.0), POSED.pose)
    still, moving = (
        light(list(renderer.expected_image(posed, during=poses).parts[0].reflections))
        for poses in (None, [posed.pose, posed.pose])
    )
    assert still > 0
    assert moving == pytest.approx(still, rel=1e-6)  # float32
