"""Off-axis blur and lateral colour: closed forms of width and place, regions, refusals."""

import numpy as np
import pytest
from conftest import ROOT
from scipy.special import ndtr
from test_path_traced import scene_of

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.psf import DISC_OF_GAUSSIAN, off_axis_sigma_px, split_for, split_kernel
from vlcrender.camera.roi import LedRegions, Roi
from vlcrender.config.toml_model import check
from vlcrender.core.planar_shapes import Rectangle
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.errors import InputError
from vlcrender.rendering.bayer import MosaicRenderer, colour_of_pixels
from vlcrender.rendering.led_blur import LedKernel
from vlcrender.rendering.led_coverage import LedFace, coverage_of_led
from vlcrender.rendering.led_edges import edges_of_led
from vlcrender.rendering.path_traced import reference_cd_m2
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene

SMALL = {"width_px": 400, "height_px": 300, "pixel_pitch_um": 20.0, "focal_length_mm": 8.0}
"""The corner is 250 px from the axis; 1 m at 2 m is 200 px."""
POSE = Pose((1.5, 1.5, 0.5))
PLACES = {1: (1.5, 1.5), 2: (2.1, 1.5), 3: (0.8, 0.95)}
"""LED number 2 is imaged 120 px from the axis, number 3 at 178 px."""


def camera_of(**changes: object) -> Camera:
    return check({**SMALL, **changes}, Camera, "camera")


@pytest.fixture(scope="module")
def scene() -> Scene:
    leds = [
        {"id": n, "position_m": [x, y, 2.5], "radius_m": 0.02, "luminance_cd_m2": 8000.0}
        for n, (x, y) in PLACES.items()
    ]
    dark = {"size_m": [3.0, 3.0, 2.5], "reflectance": {"floor": 0.0, "ceiling": 0.0, "walls": 0.0}}
    ambient = {"illuminance_lux": 0.0, "spectrum": "LED-B3"}
    return scene_of(led=leds, room=dark, ambient=ambient, bake={"texel_m": 0.5, "paths": 16})


def moments(light: np.ndarray, row: int, column: int) -> tuple[np.ndarray, np.ndarray]:
    """Centroid (u, v) and the variances along u and v, px^2."""
    u, v = column + np.arange(light.shape[1]) + 0.5, row + np.arange(light.shape[0]) + 0.5
    weights = light / light.sum()
    centroid = np.array([weights.sum(axis=0) @ u, weights.sum(axis=1) @ v])
    return centroid, np.array(
        [weights.sum(axis=0) @ (u - centroid[0]) ** 2, weights.sum(axis=1) @ (v - centroid[1]) ** 2]
    )


@pytest.mark.parametrize("corner_um", [100.0, 250.0])
def test_the_blur_widens_images_with_the_square_of_the_distance_from_the_axis(scene: Scene, corner_um: float) -> None:
    """Variances of independent blurs add up: s^2 = (s_corner (r / r_corner)^2)^2; the light and its place stay."""
    sharp, wide = (
        {p.led_id: p for p in Renderer(scene).led_patches(PosedCamera(camera_of(**changes), POSE))}
        for changes in ({}, {"off_axis_sigma_um": corner_um})
    )
    for n, (x, y) in PLACES.items():
        share = np.hypot(x - 1.5, y - 1.5) * 200 / 250
        sigma = corner_um / 20.0 * share**2
        (at, before), (now, after) = (moments(p.electrons_per_s, p.row, p.column) for p in (sharp[n], wide[n]))
        # kernels are shared within 0.5 % of their width: 0.25 % of sigma, 0.5 % of the variance. Without the tail
        # beyond 4.5 sigma: 4e-4. Light in the 25 edge pixels of the sharp disc counts at their centres: each is off by
        # some 0.1 px at 4 px from the disc's centre, of 50 pixels: sqrt(25) * 2 * 4 * 0.1 / 50 = 0.08 px^2
        assert after - before == pytest.approx(np.full(2, sigma**2), abs=6e-3 * sigma**2 + 0.08)
        assert now == pytest.approx(at, abs=0.01)  # the same pixels: sqrt(25) * 0.1 / 50
        assert wide[n].electrons_per_s.sum() == pytest.approx(sharp[n].electrons_per_s.sum(), rel=1e-9)


def test_the_sigma_at_places_of_the_field() -> None:
    camera = camera_of(off_axis_sigma_um=40.0, principal_point_px=(100.0, 150.0))
    corner = np.hypot(300.0, 150.0)
    image = np.array([[100.0, 150.0], [250.0, 225.0], [400.0, 0.0], [900.0, 0.0], [np.nan, np.nan]])
    found = off_axis_sigma_px(camera, image)
    assert found == pytest.approx([0.0, 2.0 * 0.25, 2.0, 2.0, 2.0], abs=1e-12)
    assert camera.corner_radius_px == pytest.approx(corner)


@pytest.mark.parametrize("sigma_px", [0.05, 0.2, 0.5, 1.0, 3.0])
@pytest.mark.parametrize("yaw_deg", [0.0, 20.0])
def test_a_straight_edge_is_blurred_to_a_normal_distribution(sigma_px: float, yaw_deg: float) -> None:
    """Squared errors below 5 % of the shot noise's variance at 4 000 e beside 24, as of all blurs (psf.split_for)."""
    camera = camera_of()
    posed = PosedCamera(camera, POSE)
    face = LedFace(np.array([1.5013, 1.4971, 2.5]), Rectangle((0.3, 0.3), yaw_deg))
    image = coverage_of_led(posed, face)
    assert image is not None
    parts = split_kernel(camera, 2.0, sigma_px)
    assert parts is not None
    edges = edges_of_led(posed, face, image, parts.split)
    kernel = LedKernel(parts.whole, parts)
    blurred = kernel.blurred(image.coverage, image.roi, [edges], 1.0)
    roi = image.roi.padded(kernel.radius_px)
    u, v = roi.centers_px()
    n = 16
    offsets = (np.arange(n) + 0.5) / n - 0.5
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    du, dv = u - (200 + 0.0013 * 200), v - (150 - 0.0029 * 200)
    expected = np.zeros(blurred.shape)
    for a in offsets:  # the mean over the pixel of the product of two normal steps
        for b in offsets:
            along, across = c * (du + a) + s * (dv + b), c * (dv + b) - s * (du + a)
            expected += (ndtr((along + 30) / sigma_px) - ndtr((along - 30) / sigma_px)) * (
                ndtr((across + 30) / sigma_px) - ndtr((across - 30) / sigma_px)
            )
    expected /= n * n
    error = 4000 * (blurred - expected)
    # the truth is a grid of 16 x 16 points: a kink of width sigma is off by 1 / (24 n^2 sigma) at most, 3e-3 at 0.05
    allowed = 0.05 * (4000 * expected + 24) + (4000 / (24 * n**2 * sigma_px) * 0.4 * (sigma_px < 0.1)) ** 2
    assert (error**2 / allowed).max() < 1


def test_narrow_blurs_are_split_like_discs_of_their_height() -> None:
    camera = camera_of()
    assert split_for(camera, 2.0, 1e-3) == 1
    assert split_for(camera, 2.0, 0.3) == split_for(
        camera_of(focus_distance_m="infinity", f_number=8.0 / (DISC_OF_GAUSSIAN * 0.3 * 0.04 / 8.0 * 1000)), 2.0
    )


def mosaic_of(scene: Scene) -> MosaicRenderer:
    renderer = Renderer(scene)
    return MosaicRenderer((renderer, renderer, renderer), "rggb")


def test_red_and_blue_images_are_enlarged_about_the_axis(scene: Scene) -> None:
    """At r from the axis the centroid moves outwards by shift r / r_corner; the light stays."""
    camera = camera_of(lateral_colour_um=(50.0, -30.0))
    for colour, shift_px in enumerate((2.5, 0.0, -1.5)):
        plain, moved = (
            {p.led_id: p for p in Renderer(scene).led_patches(PosedCamera(c, POSE))}
            for c in (camera_of(), camera.for_colour(colour))
        )
        for n, (x, y) in PLACES.items():
            (at, _), (now, _) = (moments(p.electrons_per_s, p.row, p.column) for p in (plain[n], moved[n]))
            outwards = np.array([x - 1.5, y - 1.5]) * 200 / 250 * shift_px
            assert np.subtract(moved[n].center_px, plain[n].center_px) == pytest.approx(outwards, abs=1e-9)
            assert now - at == pytest.approx(outwards, abs=0.01)  # edge pixels, as above
            # as much light: the image is larger and each pixel gets less, to the change of cos^4 from pixel to pixel
            assert moved[n].electrons_per_s.sum() == pytest.approx(plain[n].electrons_per_s.sum(), rel=1e-4)


def test_a_mosaic_takes_each_pixel_from_its_colours_image(scene: Scene) -> None:
    camera, sensor = camera_of(lateral_colour_um=(50.0, -30.0)), Roi(0, 0, 300, 400)
    found = mosaic_of(scene).expected_image(PosedCamera(camera, POSE))
    image = found.expected_electrons(1.0)
    colours = colour_of_pixels("rggb", sensor)
    for colour in range(3):
        own = Renderer(scene).expected_image(PosedCamera(camera.for_colour(colour), POSE)).expected_electrons(1.0)
        assert np.array_equal(image[colours == colour], own[colours == colour])
    # place and pixels: those of green
    green = {p.led_id: p for p in Renderer(scene).led_patches(PosedCamera(camera_of(), POSE))}
    for patch in found.patches:
        assert patch.center_px == green[patch.led_id].center_px
        assert patch.roi.contains(green[patch.led_id].roi)


def test_regions_contain_the_images_of_all_colours(scene: Scene) -> None:
    camera = camera_of(lateral_colour_um=(50.0, -30.0), off_axis_sigma_um=20.0)
    posed, mosaic = PosedCamera(camera, POSE), mosaic_of(scene)
    whole = mosaic.expected_image(posed).expected_electrons(1.0)
    regions = mosaic.expected_image(posed, LedRegions(kind="leds", margin_px=0.0))
    assert len(regions.parts) == 3
    outside = whole.copy()
    for part in regions.parts:
        inside = Roi(0, 0, 300, 400).slices(part.roi)
        assert part.expected_electrons(1.0) == pytest.approx(whole[inside], rel=1e-6)
        outside[inside] = 0
    assert outside.max() == 0
    patches = {p.led_id: p for p in mosaic.led_patches(posed)}
    assert {p.led_id: p.roi for p in regions.patches} == {n: p.roi for n, p in patches.items()}


def test_an_led_at_the_border_may_be_on_the_sensor_in_one_colour_alone() -> None:
    leds = [{"id": 7, "position_m": [2.5085, 1.5, 2.5], "radius_m": 0.01, "luminance_cd_m2": 8000.0}]
    dark = {"size_m": [3.0, 3.0, 2.5], "reflectance": {"floor": 0.0, "ceiling": 0.0, "walls": 0.0}}
    ambient = {"illuminance_lux": 0.0, "spectrum": "LED-B3"}
    scene = scene_of(led=leds, room=dark, ambient=ambient, bake={"texel_m": 0.5, "paths": 16})
    camera = camera_of(lateral_colour_um=(0.0, -80.0))  # blue 3.2 px inwards there
    (patch,) = mosaic_of(scene).expected_image(PosedCamera(camera, POSE)).patches
    colours = colour_of_pixels("rggb", patch.roi)
    assert patch.electrons_per_s[colours == 2].sum() > 0
    assert patch.electrons_per_s[(colours != 2) & (np.indices(colours.shape)[1] < 2)].sum() == 0


def test_no_lateral_colour_keeps_every_bit(scene: Scene) -> None:
    posed = PosedCamera(camera_of(), POSE)
    zero = PosedCamera(camera_of(lateral_colour_um=(0.0, 0.0), off_axis_sigma_um=0.0), POSE)
    images = [mosaic_of(scene).expected_image(p).expected_electrons(1.0) for p in (posed, zero)]
    assert np.array_equal(*images)


def test_impossible_settings_are_refused(scene: Scene) -> None:
    with pytest.raises(InputError, match=r"lateral_colour_um = \[200.0, 0.0\]: at most 100 to either side"):
        camera_of(lateral_colour_um=(200.0, 0.0))
    with pytest.raises(InputError, match=r"off_axis_sigma_um = -1"):
        camera_of(off_axis_sigma_um=-1.0)
    with pytest.raises(InputError, match="needs a sensor with a mosaic"):
        Renderer(scene).expected_image(PosedCamera(camera_of(lateral_colour_um=(5.0, 0.0)), POSE))
    with pytest.raises(InputError, match=r"lateral_colour_um: camera 'main' has it, and the sensor has no mosaic"):
        load_plan(ROOT / "datasets/quickstart.toml", ["camera.lateral_colour_um=[5.0, 0.0]"])
    with pytest.raises(InputError, match="off_axis_sigma_um = 5: the reference renderer needs 0"):
        reference_cd_m2(scene, PosedCamera(camera_of(off_axis_sigma_um=5.0), POSE), 8)
