"""Veiling glare: the halo against closed forms and brute force, in full frames and in regions."""

import numpy as np
import pytest
from conftest import ROOT
from scipy import integrate, signal
from test_path_traced import scene_of

from vlcrender.camera.glare import Glare
from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import mounted_cameras
from vlcrender.camera.roi import LedRegions, RegionImage, Roi, led_regions
from vlcrender.config.toml_model import check
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.errors import InputError
from vlcrender.rendering.bayer import MosaicRenderer, colour_of_pixels
from vlcrender.rendering.crlb import position_bound_m2
from vlcrender.rendering.halo import HaloGrid
from vlcrender.rendering.path_traced import reference_cd_m2
from vlcrender.rendering.renderer import Renderer
from vlcrender.sensor.radiometry import Silicon
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import variance_e2

COARSE = {"texel_m": 0.5, "paths": 16}
DARK = {
    "ambient": {"illuminance_lux": 0.0, "spectrum": "LED-B3"},
    "room": {"size_m": [3.0, 3.0, 2.5], "reflectance": {"floor": 0.0, "ceiling": 0.0, "walls": 0.0}},
    "bake": COARSE,
}
LED = {"id": 1, "position_m": [1.5, 1.5, 2.5], "luminance_cd_m2": 8000.0, "radius_m": 0.1}
LEDS = [LED, {**LED, "id": 2, "position_m": [1.05, 1.25, 2.5], "radius_m": 0.02}]
SMALL = {"width_px": 200, "height_px": 150, "pixel_pitch_um": 40.0, "focal_length_mm": 8.0}
"""From 2 m away a disc of 0.1 m radius has 10 px of radius."""
BELOW = Pose((1.5, 1.5, 0.5))
PLACES = ([1.38, 1.4, 2.5], [1.62, 1.42, 2.5], [1.5, 1.62, 2.4])
GLARE = {"share": 0.05, "radius_um": 640.0}
"""16 px."""


def camera_of(glare: dict | None = None, **changes: object) -> Camera:
    return check({**SMALL, **changes, **({"glare": glare} if glare else {})}, Camera, "camera")


def image_of(renderer: Renderer, camera: Camera, gains: dict | None = None) -> np.ndarray:
    return renderer.expected_image(PosedCamera(camera, BELOW)).expected_electrons(1.0, gains).astype(np.float64)


@pytest.mark.parametrize("exponent", [1.1, 1.5, 3.0])
def test_the_spread_function_holds_all_light_and_half_of_it_within_its_half_radius(exponent: float) -> None:
    """Within R: 1 - (1 + (R / r_0)^2)^(1 - k)."""
    glare = Glare(share=0.1, radius_um=80.0, exponent=exponent)

    def within(radius_px: float) -> float:
        found, _ = integrate.quad(
            lambda r: 2 * np.pi * r * float(glare.spread_per_px2(np.array(r), 4.0)), 0, radius_px, limit=500
        )
        return found

    for radius_px in (5.0, 20.0, 400.0):
        # the quadrature's own tolerance is 1.5e-8
        assert within(radius_px) == pytest.approx(1 - (1 + (radius_px / 20) ** 2) ** (1 - exponent), abs=1e-6)


@pytest.mark.parametrize("exponent", [1.2, 1.5, 3.0])
def test_the_halo_of_leds_is_the_convolution_of_their_images(exponent: float) -> None:
    """Against the spread function at every pixel of the sensor, with nodes 2 px apart."""
    glare = {**GLARE, "exponent": exponent}
    renderer = Renderer(scene_of(led=LEDS, **DARK))
    sharp = image_of(renderer, camera_of())
    found = image_of(renderer, camera_of(glare)) - 0.95 * sharp
    r = np.hypot(np.arange(-149, 150)[:, None], np.arange(-199, 200))
    kernel = Glare(**glare).spread_per_px2(r, 40.0)
    expected = 0.05 * signal.fftconvolve(kernel, sharp, mode="valid")
    # 0.5 % of a point's halo at its largest: the grid's error; float32 of the image, 1e-7
    assert np.abs(found - expected).max() < 0.005 * expected.max() + 3e-7 * sharp.max()
    assert expected.max() > 0.003 * sharp.max()
    # the light: the error has no bias
    assert found.sum() == pytest.approx(expected.sum(), rel=1e-3)


def test_a_points_halo_is_within_half_a_percent_wherever_the_point_is() -> None:
    grid, glare = HaloGrid.of(camera_of(GLARE), Glare(**GLARE)), Glare(**GLARE)
    assert grid.step_px == 2
    worst = 0.0
    for u, v in ((100.0, 75.0), (101.3, 75.9), (102.0, 77.0), (0.2, 0.4), (199.7, 149.9)):
        halo = grid.values(
            grid.spread(grid.gathered(np.ones((1, 1)), np.array([v]), np.array([u])), glare, 40.0),
            Roi(0, 0, 150, 200),
        )
        at_u, at_v = Roi(0, 0, 150, 200).centers_px()
        expected = 0.05 * glare.spread_per_px2(np.hypot(at_u - u, at_v - v), 40.0)
        worst = max(worst, float(np.abs(halo - expected).max() / expected.max()))
    assert worst < 0.005


def test_the_veiling_glare_index_of_a_black_spot_is_the_share_of_the_halo_within_the_field() -> None:
    """ISO 9358: the light in a small black spot over the light of the bright field around it, which ends at the border
    of the sensor: the spread function's integral over the sensor.
    """
    spot = {**LED, "radius_m": 0.015, "luminance_cd_m2": 1e-3}
    even = {
        "ambient": {"illuminance_lux": 500.0, "spectrum": "LED-B3"},
        "room": {"size_m": [9.0, 9.0, 2.5], "reflectance": {"floor": 0.0, "ceiling": 0.9, "walls": 0.0}},
        "led_reflectance": 0.0,
        "bake": COARSE,
    }
    spot["position_m"] = [4.5, 4.5, 2.5]
    renderer = Renderer(scene_of(led=[spot], **even))
    posed = PosedCamera(camera_of(GLARE), Pose((4.5, 4.5, 0.5)))
    image = renderer.expected_image(posed).expected_electrons(1.0)
    field = renderer.expected_image(PosedCamera(camera_of(), posed.pose)).expected_electrons(1.0)
    u, v = Roi(0, 0, 150, 200).centers_px()
    weights = Glare(**GLARE).spread_per_px2(np.hypot(u - 100.0, v - 75.0), 40.0)
    index = 0.05 * weights.sum()
    # cos^4 of the field, 0.25 rad at the corner: the brightness at r / f, weighted by the halo
    falloff = (weights * (1 + ((u - 100) ** 2 + (v - 75) ** 2) / 200**2) ** -2).sum() / weights.sum()
    found = image[75, 100] / field[60, 100]
    found *= (1 + 15**2 / 200**2) ** -2  # the field where the spot is, from 15 px beside it
    # the black spot's own light is missing from the halo, but not from the grid's rays; 0.5 % of the grid
    assert found == pytest.approx(index * falloff, rel=0.006)
    assert image[75, 100] < 0.05 * field[60, 100]


def test_regions_have_the_halo_of_the_whole_sensor() -> None:
    """Bit for bit: also of LEDs in other regions, of the room, and of reflections that no region shows."""
    glazing = {"wall": "x=0", "corner_m": [0.5, 0.1], "size_m": [2.0, 2.3], "luminance_cd_m2": 50.0}
    renderer = Renderer(scene_of(led=LEDS, glazing=[glazing], bake=COARSE))
    posed = PosedCamera(camera_of(GLARE), Pose((1.2, 1.5, 0.5), tilt_y_deg=-20.0))
    whole = renderer.expected_image(posed)
    regions = renderer.expected_image(posed, LedRegions(kind="leds", margin_px=5.0))
    assert len(regions.parts) == 2
    assert whole.parts[0].halo is not None
    for part in regions.parts:
        assert part.halo is not None
        assert np.array_equal(part.halo.electrons_per_s(part.roi), whole.parts[0].halo.electrons_per_s(part.roi))
        crop = whole.expected_electrons(1.0)[Roi(0, 0, 150, 200).slices(part.roi)]
        assert part.expected_electrons(1.0) == pytest.approx(crop, rel=1e-6)


def test_a_reflection_has_a_halo() -> None:
    """The LED above is behind the camera's field; its reflection in the glazing lights the sensor."""
    glazing = {"wall": "x=0", "corner_m": [0.5, 0.1], "size_m": [2.0, 2.3], "luminance_cd_m2": 0.0}
    renderer = Renderer(scene_of(led=[LED], glazing=[glazing], **DARK))
    pose = Pose((1.0, 1.5, 1.0), tilt_y_deg=-60.0)
    images = [renderer.expected_image(PosedCamera(camera_of(glare), pose)) for glare in (None, GLARE)]
    (reflection,) = images[0].parts[0].reflections
    assert not images[0].patches
    halo = images[1].parts[0].halo
    assert halo is not None
    light = halo.electrons_per_s(Roi(0, 0, 150, 200))
    row, column = np.unravel_index(light.argmax(), light.shape)
    assert reflection.roi.padded(2).contains(Roi(int(row), int(column), 1, 1))
    # all of the halo's light but what is beyond the sensor
    total = 0.05 * reflection.electrons_per_s.sum()
    assert 0.3 * total < light.sum() < total


def test_gains_of_the_room_by_lines_need_the_part_of_its_halo_that_left_an_led() -> None:
    renderer = Renderer(scene_of(led=[LED], **DARK))
    halo = renderer.expected_image(PosedCamera(camera_of(GLARE), Pose((1.0, 1.5, 1.0)))).parts[0].halo
    assert halo is not None
    with pytest.raises(ValueError, match="room_gain: the part of the halo that left an LED is not known"):
        halo.electrons_per_s(Roi(10, 20, 40, 50), room_gain=np.ones((150, 1)))


def test_the_halo_follows_the_brightness_of_each_led() -> None:
    renderer, camera = Renderer(scene_of(led=LEDS, **DARK)), camera_of(GLARE)
    both, first, second, twice = (image_of(renderer, camera, g) for g in (None, {2: 0.0}, {1: 0.0}, {1: 2.0, 2: 2.0}))
    assert first + second == pytest.approx(both, rel=1e-5)
    assert twice == pytest.approx(2 * both, rel=1e-5)
    assert np.array_equal(image_of(renderer, camera, {1: 1.0}), both)
    # away from all LEDs there is light of each
    assert 0 < second[10, 190] < first[10, 190]


def test_each_pixel_of_a_mosaic_has_the_halo_of_its_colour() -> None:
    scene = scene_of(led=LEDS, **DARK)
    renderers = tuple(Renderer(scene, detector=Silicon(depth)) for depth in (1.0, 2.0, 3.0))
    camera, sensor = camera_of(GLARE), Roi(0, 0, 150, 200)
    mosaic = MosaicRenderer(renderers, "rggb")
    found = mosaic.expected_image(PosedCamera(camera, BELOW)).expected_electrons(1.0)
    colours = colour_of_pixels("rggb", sensor)
    for colour, renderer in enumerate(renderers):
        own = renderer.expected_image(PosedCamera(camera, BELOW)).expected_electrons(1.0)
        assert np.array_equal(found[colours == colour], own[colours == colour])


@pytest.mark.slow
def test_the_information_of_an_led_includes_its_halo() -> None:
    """An LED's brightness is unknown: its halo tells of it, and of the range with it. Slopes by brute force."""
    strong = {**GLARE, "share": 0.3}
    leds = [{**LED, "id": n, "position_m": p, "radius_m": 0.04} for n, p in enumerate(PLACES)]
    renderer, camera = Renderer(scene_of(led=leds, bake=COARSE)), camera_of(strong)
    pose, sensor = Pose((1.5, 1.5, 0.5), 3.0, -2.0, 10.0), Roi(0, 0, 150, 200)
    (mounted,) = mounted_cameras(camera, ())
    mean = renderer.expected_image(PosedCamera(camera, pose)).expected_electrons(1e-6)
    variance = [RegionImage(sensor, variance_e2(Sensor(full_well_e=4e6), mean, 1e-6))]
    known, unknown = (
        position_bound_m2(mounted, pose, renderer.led_slopes, 1e-6, variance, 2.0, (0.0, 0.0), halo_of=halo_of)
        for halo_of in (renderer.halo_of(camera), None)
    )
    assert known is not None
    assert unknown is not None
    assert (np.diag(known) < np.diag(unknown)).all()

    # The same from whole images with gains: slopes by pose and brightness, and one level, in the box of all three.
    def electrons(at: Pose, gains: dict | None = None) -> np.ndarray:
        led_light = renderer.led_patches(PosedCamera(camera, at))
        image = np.zeros((150, 200))
        halo = np.zeros((150, 200))
        u, v = sensor.centers_px()
        for patch in led_light:
            gain = 1.0 if gains is None else gains.get(patch.led_id, 0.0)
            image[sensor.slices(patch.roi)] += gain * patch.electrons_per_s
            rows, columns = np.nonzero(patch.electrons_per_s > 0)
            for row, column in zip(rows, columns, strict=True):
                light = gain * patch.electrons_per_s[row, column] / 0.7
                r = np.hypot(u - (patch.column + column + 0.5), v - (patch.row + row + 0.5))
                halo += 0.3 * light * Glare(**strong).spread_per_px2(r, 40.0)
        return (image + halo) * 1e-6

    step = 1e-6
    slopes = []
    for unknown_index in (0, 1, 2, 5):
        numbers = [[*pose.position_m, pose.tilt_x_deg, pose.tilt_y_deg, pose.yaw_deg] for _ in range(2)]
        for sign, changed in zip((1, -1), numbers, strict=True):
            changed[unknown_index] += sign * step
        ends = [electrons(Pose((x, y, z), a, b, c)) for x, y, z, a, b, c in numbers]
        slopes.append((ends[0] - ends[1]) / (2 * step))
    slopes += [electrons(pose, {n: 1.0}) for n in range(3)]
    slopes.append(np.ones((150, 200)))
    (box,) = led_regions(
        (p.roi for p in renderer.led_patches(PosedCamera(camera, pose))),
        camera,
        LedRegions(kind="leds", margin_px=10.0),
    )
    inside = np.stack([s[sensor.slices(box)].ravel() for s in slopes]) / np.sqrt(
        variance[0].image[sensor.slices(box)].ravel()
    )
    expected = np.linalg.inv(inside @ inside.T)[:3, :3]
    # 0.5 % of the grid in the halo, which holds 2 % of the information; steps of 1e-6 m are 1e-4 px
    assert np.diag(known) == pytest.approx(np.diag(expected), rel=1e-3)
    assert np.abs(np.diag(unknown) / np.diag(expected) - 1).max() > 1e-2


def test_a_mosaics_halo_for_the_bound_is_that_of_its_image() -> None:
    scene = scene_of(led=LEDS, **DARK)
    camera, sensor = camera_of(GLARE), Roi(0, 0, 150, 200)
    mosaic = MosaicRenderer(tuple(Renderer(scene, detector=Silicon(depth)) for depth in (1.0, 2.0, 3.0)), "rggb")
    halo = mosaic.expected_image(PosedCamera(camera, BELOW)).parts[0].halo
    halo_of = mosaic.halo_of(camera)
    assert halo is not None
    assert halo_of is not None
    found = halo_of(mosaic.led_patches(PosedCamera(camera, BELOW)), sensor)
    # a disc of 300 pixels, of which a colour takes every fourth: its light differs by its share of the edge pixels
    assert found == pytest.approx(halo.electrons_per_s(sensor), rel=0.05)
    assert mosaic.halo_of(camera_of()) is None


@pytest.mark.parametrize(
    ("glare", "message"),
    [
        ({"share": 0.05, "radius_um": 100.0}, r"glare.radius_um = 100: must be at least 240, which is 6 pixels"),
        ({"share": 0.0}, r"glare.share = 0"),
        ({"share": 0.6}, r"glare.share = 0.6"),
        ({"share": 0.1, "exponent": 1.0}, r"glare.exponent = 1"),
        ({"radius_um": 300.0}, r"key glare.share is missing"),
    ],
)
def test_impossible_glare_is_refused(glare: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        camera_of(glare)


def test_glare_is_refused_with_overscan_and_by_the_reference() -> None:
    scene = scene_of(led=LEDS, **DARK)
    posed = PosedCamera(camera_of(GLARE), BELOW)
    with pytest.raises(InputError, match=r"remove overscan or camera\.glare"):
        Renderer(scene).expected_image(posed, LedRegions(kind="leds", overscan=True))
    with pytest.raises(InputError, match=r"camera\.glare: the reference renderer has no glare"):
        reference_cd_m2(scene, posed, 8)


def test_a_recipe_keeps_its_halo_when_scaled(tmp_path) -> None:

    plan = load_plan(ROOT / "datasets/quickstart.toml", ["camera.glare.share=0.05"], 4)
    assert plan.recipe.camera.glare == Glare(share=0.05)
    with pytest.raises(InputError, match=r"camera 'main' has glare"):
        load_plan(ROOT / "datasets/office200.toml", ["camera.glare.share=0.05", "regions.overscan=true"])
