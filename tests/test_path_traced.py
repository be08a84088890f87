"""`Renderer` against Mitsuba's path integrator with furniture and with glazings that light the room."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.config.toml_model import check
from vlcrender.errors import InputError
from vlcrender.rendering import path_traced
from vlcrender.rendering.path_traced import reference_cd_m2
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene, build_scene
from vlcrender.scene.schema import SceneSettings
from vlcrender.sensor.radiometry import Silicon, electron_rate_per_cd_m2

SMALL_VIEW = {"width_px": 120, "height_px": 90, "pixel_pitch_um": 100.0}
ROOM: dict[str, object] = {
    "format": "vlcrender-scene",
    "version": 1,
    "name": "test",
    "led_spectrum": "LED-B3",
    "led_reflectance": 0.5,
    "room": {"size_m": [3.0, 3.0, 2.5], "reflectance": {"floor": 0.3, "ceiling": 0.8, "walls": 0.5}},
    "ambient": {"illuminance_lux": 100.0, "spectrum": "LED-B3"},
    "bake": {"texel_m": 0.1, "paths": 1024},
}
BOX = """\
v -0.2 -0.25 0\nv 0.2 -0.25 0\nv 0.2 0.25 0\nv -0.2 0.25 0
v -0.2 -0.25 0.1\nv 0.2 -0.25 0.1\nv 0.2 0.25 0.1\nv -0.2 0.25 0.1
f 1 3 2\nf 1 4 3\nf 5 6 7\nf 5 7 8
f 1 2 6\nf 1 6 5\nf 2 3 7\nf 2 7 6\nf 3 4 8\nf 3 8 7\nf 4 1 5\nf 4 5 8
"""
"""A closed box, 0.4 x 0.5 x 0.1 m; vertices counter-clockwise as seen from outside."""


def scene_of(folder: Path = Path(), **changes: object) -> Scene:
    return build_scene(check({**ROOM, **changes}, SceneSettings, "test"), "test", folder)


def both_ways(scene: Scene, camera: Camera, pose: Pose, samples: int) -> tuple[np.ndarray, ...]:
    """In cd/m2, (rows, columns) each: `Renderer`, the reference, its variance; and the pixels that LEDs light."""
    reference, variance = reference_cd_m2(scene, PosedCamera(camera, pose), samples)
    rate = electron_rate_per_cd_m2(camera, "LED-B3", Silicon())
    u, v = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    mean = Renderer(scene).expected_image(PosedCamera(camera, pose))
    ours = mean.expected_electrons(1.0) / rate / relative_illumination(camera, u, v)
    lit = np.zeros(ours.shape, dtype=bool)
    for patch in (*mean.patches, *mean.parts[0].reflections):
        lit[mean.parts[0].roi.slices(patch.roi)] |= patch.electrons_per_s > 0
    return ours, reference, variance, lit


def blocks(*images: np.ndarray) -> list[np.ndarray]:
    """Means of 10 x 10 pixels, (blocks,) an image."""
    return [image.reshape(9, 10, 12, 10).mean(axis=(1, 3)).ravel() for image in images]


@pytest.mark.slow
def test_furniture_occludes_leds_and_is_lit_as_in_the_reference(tmp_path: Path) -> None:
    (tmp_path / "box.obj").write_text(BOX)
    piece = {"file": "box.obj", "position_m": [1.6, 1.4, 1.6], "yaw_deg": 20.0, "reflectance": 0.6}
    places = [(x, y) for y in (1.0, 1.5, 2.0) for x in (1.0, 1.5, 2.0)]
    leds = [
        {"id": i, "position_m": [x, y, 2.5], "radius_m": 0.03, "luminance_cd_m2": 8000.0}
        for i, (x, y) in enumerate(places)
    ]
    scene = scene_of(tmp_path, led=leds, furniture=[piece])
    samples = 128
    ours, reference, variance, lit = both_ways(
        scene, Camera(**SMALL_VIEW), Pose((1.5, 1.5, 0.4), 4.0, -6.0, 30.0), samples
    )
    few = {"texel_m": 0.5, "paths": 8}  # whatever the light of the room
    alone = (
        Renderer(scene_of(led=leds, bake=few))
        .expected_image(PosedCamera(Camera(**SMALL_VIEW), Pose((1.5, 1.5, 0.4), 4.0, -6.0, 30.0)))
        .patches
    )
    # the box occludes one LED at least in part: otherwise nothing is tested
    assert lit.sum() < sum((patch.electrons_per_s > 0).sum() for patch in alone) - 10

    # LEDs: a pixel's share p of luminance L, sampled n times, has variance p (1 - p) L^2 / n <= |ours| L / n. Edges of
    # the box against LEDs are 8 x 8 rays, 1.3 % of the step; 1 cd/m2 is for the lightmap.
    bound = np.maximum(variance, ours * 8000 / samples) + 1.0 + (0.013 * 8000 * (ours < 7000)) ** 2
    z = (ours - reference)[lit] / np.sqrt(bound[lit])
    assert np.abs(z).max() < 6

    # The room and the box, in blocks: noise of the reference (Student's t, 7 degrees of freedom); noise of the lightmap
    # and interpolation 0.5 %: vertices 0.1 m apart below LEDs 0.8 m away, second order (0.1 / 0.8)^2 / 8 = 0.2 %
    kept = blocks(lit.astype(float))[0] == 0
    mine, theirs, spread = (b[kept] for b in blocks(ours, reference, variance))
    assert kept.sum() > 40
    z = (mine - theirs) / np.sqrt(spread / 100 + (0.005 * theirs) ** 2)
    assert np.abs(z).max() < 7.9
    assert abs((mine - theirs).mean()) < 5 * np.sqrt(spread.mean() / 100 / len(mine)) + 0.005 * theirs.mean()


@pytest.mark.slow
def test_light_reflected_by_a_glazing_agrees_with_the_reference() -> None:
    """A glazing of index 3 reflects 40 % and more of the light of an LED half a metre before it onto the floor."""
    led = {"id": 1, "position_m": [0.5, 1.5, 2.5], "radius_m": 0.15, "luminance_cd_m2": 8000.0}
    glazing = {
        "wall": "x=0",
        "corner_m": [0.6, 0.2],
        "size_m": [1.5, 2.2],
        "luminance_cd_m2": 0.0,
        "refractive_index": 3.0,
    }
    dark = {"size_m": [3.0, 3.0, 2.5], "reflectance": {"floor": 0.3, "ceiling": 0.1, "walls": 0.1}}
    scene = scene_of(led=[led], glazing=[glazing], room=dark, ambient={"illuminance_lux": 0.0, "spectrum": "LED-B3"})
    ours, reference, variance, lit = both_ways(scene, Camera(**SMALL_VIEW), Pose((1.0, 1.5, 2.2), 180.0), 64)
    assert not lit.any()
    # The mean over all pixels: the reference's noise, the point source's (r / d)^2 = 0.4 %, and 0.5 % as above. Not
    # block by block: the glazing's border casts a penumbra as wide as the LED, which a point source does not have.
    allowed = 5 * np.sqrt(variance.mean() / variance.size) + 0.009 * reference.mean()
    assert abs((ours - reference).mean()) < allowed
    # the reflected light exceeds the tolerance
    few = {"texel_m": 0.1, "paths": 64}  # one bounce in a dark room
    without = Renderer(scene_of(led=[led], room=dark, ambient=scene.settings.ambient.model_dump(), bake=few))
    plain = without.background_cd_m2(PosedCamera(Camera(**SMALL_VIEW), Pose((1.0, 1.5, 2.2), 180.0)))
    assert ours.mean() - plain.mean() > 3 * allowed


def test_leds_that_are_not_lambertian_are_refused() -> None:
    led = {"id": 1, "position_m": [0.5, 1.5, 2.5], "radius_m": 0.1, "luminance_cd_m2": 8000.0, "half_power_deg": 40.0}
    with pytest.raises(InputError, match="half_power_deg"):
        reference_cd_m2(scene_of(led=[led]), PosedCamera(Camera(**SMALL_VIEW), Pose((1.0, 1.0, 1.0))), 8)


@pytest.mark.parametrize("focus_m", [2.0, "infinity"])
def test_rays_of_a_pixel_meet_in_the_plane_of_focus(focus_m: float | str) -> None:
    """From all over the pupil they meet where the pixel is projected to: within the pixel, and 1e-3 px of single
    precision. The pupil of f/2 and 18 mm has a radius of 4.5 mm, of which the widest of 3000 rays is within 1 %.
    """
    camera = Camera(width_px=20, height_px=15, pixel_pitch_um=240.0, f_number=2.0, focus_distance_m=focus_m)
    posed = PosedCamera(camera, Pose((1.0, 2.0, 0.5), tilt_x_deg=10.0, tilt_y_deg=-5.0, yaw_deg=30.0))
    rays: list[Any] = []

    class Noted:
        def sample(self, scene: object, sampler: object, ray: Any) -> tuple[Any, None, None]:
            rays.extend((np.array(ray.o).T, np.array(ray.d).T))
            return ray.o.x * 0.0, None, None

    path_traced._by_rays(None, Noted(), posed, 10, 1)
    origin, direction = rays
    off = (origin - posed.position_m) @ posed.rotation.T
    along = direction @ posed.rotation.T
    assert np.abs(off[:, 2]).max() < 1e-6
    radius = np.hypot(off[:, 0], off[:, 1]).max()
    assert 0.99 * 4.5e-3 < radius < 4.5e-3 * (1 + 1e-4)
    met = along if focus_m == "infinity" else off + along * (2.0 / along[:, 2:])
    u, v = camera.project(*met.T)
    pixel = np.arange(20 * 15).repeat(10)
    assert np.abs(u - (pixel % 20 + 0.5)).max() < 0.501
    assert np.abs(v - (pixel // 20 + 0.5)).max() < 0.501
