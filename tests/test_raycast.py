"""Occlusion and specular reflection of LEDs: geometry and Fresnel's equations against hand calculations."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from PIL import Image

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.config.toml_model import check, read_toml
from vlcrender.core.backend import dr, mi
from vlcrender.light.lightmap import Lightmap, room_mesh
from vlcrender.light.mitsuba_room import glazing_bsdf
from vlcrender.light.raycast import Room
from vlcrender.rendering.expected_image import LedPatch
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.fresnel import glazing_reflectance
from vlcrender.scene.loader import Scene, build_scene
from vlcrender.scene.schema import SceneSettings
from vlcrender.sensor.radiometry import Silicon, electron_rate_per_cd_m2

TABLE1 = read_toml(ROOT / "scenes/table1.toml")
LAMP = {"id": 1, "position_m": [3.0, 3.5, 3.5], "radius_m": 0.03, "luminance_cd_m2": 10000.0}
GLAZING = {"wall": "x=0", "corner_m": [0.5, 0.5], "size_m": [6.0, 2.5], "luminance_cd_m2": 0.0}
WIDE = Camera(width_px=1000, height_px=800, pixel_pitch_um=20.0)


def room(folder: Path | None = None, **changes: object) -> Scene:
    tree = {**TABLE1, "led": [LAMP], "bake": {"texel_m": 1.0, "paths": 64}, **changes}
    return build_scene(check(tree, SceneSettings, "test"), "test", folder or ROOT / "scenes")


def patch_of(scene: Scene, pose: Pose) -> LedPatch:
    return Renderer(scene).expected_image(PosedCamera(WIDE, pose)).patches[0]


def test_glazing_reflects_by_fresnels_equations() -> None:
    # straight on: F = (0.52 / 2.52)^2 = 4.258 % at each face, 2 F / (1 + F) = 8.168 %
    assert glazing_reflectance(1.0, 1.52, np.sqrt) == pytest.approx(0.08168, abs=1e-5)
    # grazing: everything; no glass: nothing
    assert glazing_reflectance(1e-9, 1.52, np.sqrt) == pytest.approx(1.0, abs=1e-6)
    assert glazing_reflectance(0.5, 1.0, np.sqrt) == pytest.approx(0.0, abs=1e-12)
    # at Brewster's angle atan(n) all p-light passes: half of 2 F / (1 + F) with F = s^2 = cos^2(2 theta_B)
    brewster = np.arctan(1.52)
    face = np.cos(2 * brewster) ** 2
    assert glazing_reflectance(np.cos(brewster), 1.52, np.sqrt) == pytest.approx(face / (1 + face), rel=1e-9)
    # at 60 deg a face reflects 18.344 % of s-light, 0.153 % of p-light; 2 F / (1 + F) of each: 31.001 % and 0.305 %
    assert 1 - glazing_reflectance(0.5, 1.52, np.sqrt) == pytest.approx(0.84347, abs=1e-5)


@pytest.mark.parametrize("degrees", [0.0, 60.0, 80.0])
def test_glazing_of_the_path_tracers_reflects_by_the_formula(degrees: float) -> None:
    """Shares of rays that are reflected and transmitted by the BSDF of both path tracers, bake and reference."""
    count, cosine = 400_000, float(np.cos(np.radians(degrees)))
    bsdf = glazing_bsdf(1.52)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(float(np.sin(np.radians(degrees))), 0.0, cosine)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, count)
    sample, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
    assert np.all(np.array(weight) == 1)
    assert np.allclose(np.array(sample.wo.x), -si.wi.x.numpy(), rtol=0, atol=1e-7)
    up = sample.wo.z.numpy() > 0
    assert np.allclose(np.abs(sample.wo.z.numpy()), cosine, rtol=0, atol=1e-7)
    assert np.array_equal(up, mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaReflection).numpy())
    share = glazing_reflectance(cosine, 1.52, np.sqrt)
    assert abs(up.mean() - share) < 5 * np.sqrt(share * (1 - share) / count)  # binomial


def test_a_specular_reflection_is_at_the_image_of_the_mirrored_led() -> None:
    """Glazing in the wall x = 0 reflects the LED at x = 3 as one at x = -3, dimmed by its reflectance."""
    renderer = Renderer(room(glazing=[GLAZING]))
    # towards the wall and up: the mirror image is 5 m away across and 2.5 m up
    pose = Pose((2.0, 3.4, 1.0), tilt_y_deg=-60.0)
    view = renderer.expected_image(PosedCamera(WIDE, pose))
    (reflection,) = view.parts[0].reflections
    assert reflection.led_id == 1
    expected = PosedCamera(WIDE, pose).project(np.array([-3.0, 3.5, 3.5]))
    rows, columns = reflection.electrons_per_s.shape
    weight = reflection.electrons_per_s.sum(dtype=float)
    u = (reflection.electrons_per_s.sum(axis=0) * (reflection.column + 0.5 + np.arange(columns))).sum() / weight
    v = (reflection.electrons_per_s.sum(axis=1) * (reflection.row + 0.5 + np.arange(rows))).sum() / weight
    # the ellipse's centre and the falling brightness: f r^2 / d^2 * tan = 900 * 0.03^2 / 5.6^2 * 2 = 0.05 px
    assert np.hypot(u - expected[0], v - expected[1]) < 0.1
    # brightness of a full pixel: L R cos^4 rate, R at the angle whose cosine is 5 / |(5, 0.1, 2.5)|
    peak = np.unravel_index(np.argmax(reflection.electrons_per_s), reflection.electrons_per_s.shape)
    at = np.array([reflection.column + peak[1] + 0.5, reflection.row + peak[0] + 0.5])
    reflectance = glazing_reflectance(5 / np.sqrt(25 + 0.01 + 6.25), 1.52, np.sqrt)
    rate = electron_rate_per_cd_m2(WIDE, "LED-B3", Silicon())
    whole = 10000 * reflectance * rate * float(relative_illumination(WIDE, *at))
    assert reflection.electrons_per_s.max() == pytest.approx(whole, rel=0.01)


def test_no_led_is_reflected_beside_the_glazing() -> None:
    low = {**GLAZING, "corner_m": [0.5, 0.1], "size_m": [6.0, 0.5]}
    renderer = Renderer(room(glazing=[low]))
    view = renderer.expected_image(PosedCamera(WIDE, Pose((2.0, 3.4, 1.0), tilt_y_deg=-60.0)))
    assert not view.parts[0].reflections


def test_a_specular_reflection_is_modulated_with_its_led() -> None:
    part = (
        Renderer(room(glazing=[GLAZING]))
        .expected_image(PosedCamera(WIDE, Pose((2.0, 3.4, 1.0), tilt_y_deg=-60.0)))
        .parts[0]
    )
    assert np.array_equal(part.expected_electrons(1e-3, {1: 0.0}), part.background_e_per_s * np.float32(1e-3))


@pytest.mark.parametrize(("edge_x", "share"), [(2.9, 0.0), (3.0, 0.5), (3.1, 1.0)])
def test_a_board_hides_the_share_of_an_led_that_it_covers(tmp_path: Path, edge_x: float, share: float) -> None:
    """Camera straight below the LED; a board just below it covers x > edge_x."""
    vertices = [(edge_x, 3.0), (edge_x + 1, 3.0), (edge_x + 1, 4.0), (edge_x, 4.0)]
    text = "".join(f"v {x} {y} 0\n" for x, y in vertices) + "f 1 3 2\nf 1 4 3\n"
    (tmp_path / "board.obj").write_text(text)
    piece = {"file": "board.obj", "position_m": [0.0, 0.0, 3.49]}
    camera = Camera(width_px=400, height_px=300, pixel_pitch_um=12.0)
    view = Renderer(room(tmp_path, furniture=[piece])).expected_image(PosedCamera(camera, Pose((3.0, 3.5, 0.5))))
    seen = [patch for patch in view.patches if patch.led_id == 1]
    if share == 0:
        assert not seen
    else:
        # 8 x 8 rays a pixel over an edge 30 px long: 1/16 px of 30 px across; and 1 cm of parallax in 3 m
        assert seen[0].visible_fraction == pytest.approx(share, abs=0.01)


@pytest.mark.parametrize(("edge_x", "share"), [(-0.06, 0.0), (0.0, 0.5), (0.06, 1.0)])
def test_a_board_between_glazing_and_led_hides_its_share_of_the_specular_reflection(
    tmp_path: Path, edge_x: float, share: float
) -> None:
    """A board just below the LED, beside the direct rays, blocks reflected ones: it covers x > 3 + edge_x.

    The reflected ray comes from the wall x = 0, 2.5 m up over 5 m across, and passes 1 cm below the LED's plane 2 cm
    nearer to the wall than where it meets it.
    """
    vertices = [(3.0 + edge_x, 3.0), (4.0, 3.0), (4.0, 4.0), (3.0 + edge_x, 4.0)]
    text = "".join(f"v {x} {y} 0\n" for x, y in vertices) + "f 1 3 2\nf 1 4 3\n"
    (tmp_path / "board.obj").write_text(text)
    piece = {"file": "board.obj", "position_m": [-0.02, 0.0, 3.49]}
    pose = Pose((2.0, 3.4, 1.0), tilt_y_deg=-60.0)
    scenes = room(tmp_path, glazing=[GLAZING], furniture=[piece]), room(glazing=[GLAZING])
    hidden, free = (Renderer(scene).expected_image(PosedCamera(WIDE, pose)).parts[0].reflections for scene in scenes)
    light = sum(r.electrons_per_s.sum(dtype=float) for r in hidden)
    # 64 rays a pixel of an image 9 px wide, and a disc seen under perspective: a few parts of a thousand
    assert light / free[0].electrons_per_s.sum(dtype=float) == pytest.approx(share, abs=0.02)


def test_an_led_of_higher_order_is_dimmer_off_its_normal() -> None:
    """L = L_0 cos^(m - 1): at 30 deg and a half-power angle of 30 deg, m = 4.82, so cos^3.82 = 0.577."""
    pose = Pose((3.0 - 3.0 * np.tan(np.radians(30)), 3.5, 0.5), tilt_y_deg=30.0)
    plain, narrow = (
        patch_of(room(led=[{**LAMP, "half_power_deg": angle}]), pose).electrons_per_s.max() for angle in (60.0, 30.0)
    )
    order = -np.log(2) / np.log(np.cos(np.radians(30)))
    # the brightest pixel is at the LED's near rim: 3.82 tan(30 deg) * 0.03 m cos(30 deg) / 3.46 m = 1.7 % brighter
    assert narrow / plain == pytest.approx(np.cos(np.radians(30)) ** (order - 1), rel=0.02)


def test_a_square_led_has_light_in_proportion_to_its_area() -> None:
    pose = Pose((3.0, 3.5, 0.5))
    side = 2 * LAMP["radius_m"]
    square_led = {key: value for key, value in LAMP.items() if key != "radius_m"} | {"shape": "square", "side_m": side}
    disc, square = (patch_of(room(led=[led]), pose).electrons_per_s.sum(dtype=float) for led in (LAMP, square_led))
    assert square / disc == pytest.approx(4 / np.pi, rel=1e-3)


def test_a_panel_hung_low_hides_an_led_above_it() -> None:
    """A scene without furniture: an LED on the ceiling, a panel 0.5 m below it between LED and camera."""
    leds = {"columns": 1, "rows": 1, "pitch_m": [0.1, 0.1], "radius_m": 0.01, "first_id": 10}
    panel = {
        "columns": 1,
        "rows": 1,
        "first_center_m": [3.0, 3.5, 3.0],
        "pitch_m": [1.0, 1.0],
        "size_m": [0.4, 0.4, 0.05],
    }
    panel |= {"reflectance": 0.7, "leds": {**leds, "luminance_cd_m2": [5000.0, 5000.0]}}
    lamps = [LAMP, {**LAMP, "id": 2, "position_m": [3.6, 3.5, 3.5]}]
    view = Renderer(room(led=lamps, panels=[panel])).expected_image(PosedCamera(WIDE, Pose((3.0, 3.5, 0.5))))
    assert sorted(patch.led_id for patch in view.patches) == [2, 10]


def cast(
    scene: Scene, light: Lightmap, origin: Sequence[float], towards: Sequence[float], **spread: Any
) -> list[float]:
    """Value at rates of 2 for LEDs and 3 for ambient light, surface, distance and length of the path of one ray."""
    rays = Room(light.mesh, scene.glazings, scene.surfaces)
    direction = mi.Vector3f(*(np.array(towards) / np.linalg.norm(towards)).tolist())
    hit = rays.trace(mi.Point3f(*map(float, origin)), direction, [rays.values(light, 2.0, 3.0)], **spread)
    return [float(x.numpy()[0]) for x in (hit.value, hit.surface, hit.distance_m, hit.path_m)]


def lit_evenly(scene: Scene, led_lux: float, ambient_lux: float) -> Lightmap:
    """Every surface with the same illuminance, without a bake."""
    mesh = room_mesh(scene)
    albedo = np.append(mesh.albedo, [0.5] * len(scene.leds))
    led, ambient = (np.full(len(albedo), lux) for lux in (led_lux, ambient_lux))
    return Lightmap(mesh, albedo, led, ambient, np.zeros(len(albedo)))


def test_each_glazing_mixes_the_scene_outside_with_its_own_reflection_of_the_room() -> None:
    """Straight onto glazing of index 3 at 60 cd/m2, second to one of index 1.52; the walls reflect half of their light.

    F = ((3 - 1) / (3 + 1))^2 = 1/4 at each face, 2 F / (1 + F) = 0.4. Light from outside is not the LEDs'.
    """
    second = {**GLAZING, "wall": "x=max", "luminance_cd_m2": 60.0, "refractive_index": 3.0}
    scene = room(glazing=[GLAZING, second])
    light = lit_evenly(scene, 20 * np.pi, 4 * np.pi)
    wall = 0.5 * (2 * 20 + 3 * 4)
    number = len(scene.surfaces)
    value, surface, distance, path = cast(scene, light, (3.0, 3.5, 1.0), (1.0, 0.0, 0.0))
    # the ray reflected goes on to the first glazing, which is dark at night: reflections of reflections are left out
    assert (surface, distance, path) == pytest.approx((number + 1, 4.0, 11.0), rel=1e-5)
    assert value == pytest.approx(0.6 * 3 * 60.0, rel=1e-5)
    # aslant: onto the wall y = 0 after the glazing, 3-4-5
    value, surface, distance, path = cast(scene, light, (4.75, 4.5, 2.9), (3.0, -4.0, 0.0))
    assert (surface, distance, path) == pytest.approx((number + 1, 3.75, 5.625), rel=1e-5)
    share = glazing_reflectance(0.6, 3.0, np.sqrt)
    assert value == pytest.approx((1 - share) * 3 * 60.0 + share * wall, rel=1e-5)
    # a wall without glazing
    value, surface, distance, path = cast(scene, light, (3.0, 3.5, 1.0), (0.0, 1.0, 0.0))
    assert scene.surfaces[int(surface)].name == "wall y=max"
    assert (value, distance, path) == pytest.approx((wall, 3.5, 3.5), rel=1e-5)


def test_a_texture_by_way_of_glazing_is_averaged_over_the_whole_paths_footprint(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """A ray that comes from the mirror image of the camera would see the same: a ray straight to the same point, with
    its spread turned by the mirror and wider by as much as its way is shorter.
    """
    Image.fromarray(rng.integers(0, 256, (16, 16), dtype=np.uint8)).save(tmp_path / "noise.png")
    rooms = {"size_m": [7.0, 7.0, 3.5], "reflectance": {"floor": 0.2, "ceiling": 0.8}}
    walls = {"texture": {"walls": {"file": "noise.png", "tile_m": [1.6, 1.6]}}}
    scene = room(tmp_path, glazing=[GLAZING], room={**rooms, **walls})
    light = lit_evenly(scene, 20 * np.pi, 4 * np.pi)
    # by the wall x = 0, 2 m away, to the wall x = 7 m: 9 m along x; back 3 m from there straight to the same point
    slope = np.array([1.0, 0.35, 0.1])
    slope /= np.linalg.norm(slope)
    start = np.array([2.0, 2.0, 0.8])
    mirror = np.array([-1.0, 1.0, 1.0])
    end = start * mirror + slope * 9.0 / slope[0]
    near = end - slope * 3.0 / slope[0]
    along_u, along_v = np.array([0.004, 0.03, 0.001]), np.array([0.01, -0.004, 0.025])
    by_glazing, straight = (
        cast(scene, light, at, towards, spread=tuple(mi.Vector3f(*side.tolist()) for side in spread))[0]
        for at, towards, spread in (
            (start, slope * mirror, (along_u * mirror, along_v * mirror)),
            (near, slope, (3 * along_u, 3 * along_v)),
        )
    )
    share = glazing_reflectance(slope[0], 1.52, np.sqrt)
    # float32: 1e-7 of 9 m, over 0.1 m a pixel of the image whose values differ by 1
    assert by_glazing == pytest.approx(share * straight, rel=1e-4)
