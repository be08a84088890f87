"""Luminance profiles over LED faces: closed forms, brute force, and every path by which an LED is imaged."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal
from test_path_traced import both_ways, scene_of

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.psf import blur_kernel, defocus_diameter_px
from vlcrender.camera.rig import mounted_cameras
from vlcrender.camera.roi import LedRegions, RegionImage
from vlcrender.core.face_profile import FaceProfile, lowest_share
from vlcrender.core.planar_shapes import Disc, Rectangle, circle_polygon_moments, rectangle_polygon_moments
from vlcrender.errors import InputError
from vlcrender.light.lightmap import bake
from vlcrender.rendering.bayer import MosaicRenderer
from vlcrender.rendering.crlb import position_bound_m2
from vlcrender.rendering.led_coverage import LedFace, coverage_of_led
from vlcrender.rendering.led_edges import edges_of_led
from vlcrender.rendering.renderer import Renderer
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import variance_e2

DARK = {
    "ambient": {"illuminance_lux": 0.0, "spectrum": "LED-B3"},
    "room": {"size_m": [3.0, 3.0, 2.5], "reflectance": {"floor": 0.0, "ceiling": 0.0, "walls": 0.0}},
}
LED = {"id": 1, "position_m": [1.5, 1.5, 2.5], "luminance_cd_m2": 8000.0}
DISC = {**LED, "radius_m": 0.1}
SQUARE = {**LED, "shape": "square", "side_m": 0.2}
CAMERA = Camera(width_px=200, height_px=150, pixel_pitch_um=40.0, focal_length_mm=8.0)
"""A disc of 0.1 m radius has 10 px of radius from 2 m away."""
BELOW = Pose((1.5, 1.5, 0.5))


def light_of(led: dict, pose: Pose = BELOW, camera: Camera = CAMERA, **changes: object) -> np.ndarray:
    """Electrons a second of the LED alone, (height, width)."""
    scene = scene_of(led=[led], **{**DARK, **changes})
    (patch,) = Renderer(scene).led_patches(PosedCamera(camera, pose))
    image = np.zeros((camera.height_px, camera.width_px))
    image[patch.row : patch.roi.end_row, patch.column : patch.roi.end_column] = patch.electrons_per_s
    return image


def centroid(image: np.ndarray) -> np.ndarray:
    rows, columns = image.shape
    return np.array([image.sum(axis=0) @ (np.arange(columns) + 0.5), image.sum(axis=1) @ (np.arange(rows) + 0.5)]) / (
        image.sum()
    )


@pytest.mark.parametrize("square", [False, True])
@pytest.mark.parametrize(("gradient", "falloff"), [((0.3, -0.2), 1.0), ((0.0, 0.0), 0.6), ((-0.1, 0.2), 1.7)])
def test_the_mean_over_the_face_is_one(square: bool, gradient: tuple[float, float], falloff: float) -> None:
    profile = FaceProfile.of(gradient, falloff, 0.02, square)
    shape = Rectangle((0.04, 0.04)) if square else Disc(0.02)
    whole = np.array([[[-1.0, -1], [1, -1], [1, 1], [-1, 1]]])
    area, x, y, second = shape.shared_moments(whole)[:, 0]
    light = profile.level * area + np.dot(profile.slopes_per_m, (x, y)) + profile.curvature_per_m2 * second
    assert light / area == pytest.approx(1.0, abs=1e-12)  # rounding
    # the keys' own words: rim over centre, and the rise from centre to border
    rim = profile.at(np.array([0.02, -0.02]), np.zeros(2))
    assert rim.mean() / profile.level == pytest.approx(falloff, abs=1e-12)
    assert (rim[0] - rim[1]) / 2 == pytest.approx(gradient[0], abs=1e-12)


def test_moments_of_simple_shapes() -> None:
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    first = 1.5**3 / 3  # of a quarter disc of radius 1.5: R^3 / 3
    cases = [
        (circle_polygon_moments(square[None] * 5, 1.5), [np.pi * 2.25, 0, 0, np.pi * 1.5**4 / 2]),  # the whole disc
        (circle_polygon_moments(square[None] + 1, 0.5 * 3), [0, 0, 0, 0]),  # set below
        (circle_polygon_moments(square[None] + [3, 0], 10.0), [4, 12, 0, 4 * (9 + 2 / 3)]),  # the square is inside
        (circle_polygon_moments(square[None, ::-1] + [3, 0], 10.0), [4, 12, 0, 4 * (9 + 2 / 3)]),  # clockwise
        (circle_polygon_moments(square[None] + [9, 0], 1.0), [0, 0, 0, 0]),  # apart
        (rectangle_polygon_moments(square[None] + [1, 1], 0.5, 1.0), [0.5, 0.125, 0.25, 0.5 / 3 * 1.25]),
    ]
    quarter = np.pi * 2.25 / 4
    cases[1] = (circle_polygon_moments(square[None] * 2 + 2, 1.5), [quarter, first, first, np.pi * 1.5**4 / 8])
    for found, expected in cases:
        assert found[:, 0] == pytest.approx(expected, abs=1e-12)


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.1, 2), st.floats(0, np.pi), st.booleans())
def test_moments_of_parts_add_up(x: float, y: float, radius: float, angle: float, round_: bool) -> None:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    quad = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) @ turn.T + [x, y]
    middle = quad.mean(axis=0)
    parts = [
        np.array([quad[i], (quad[i] + quad[(i + 1) % 4]) / 2, middle, (quad[i] + quad[i - 1]) / 2]) for i in range(4)
    ]
    shape = Disc(radius) if round_ else Rectangle((2 * radius, radius), 25.0)
    total = shape.shared_moments(np.array(parts)).sum(axis=1)
    # sums of a few numbers below 100 in double precision
    assert total == pytest.approx(shape.shared_moments(quad[None])[:, 0], abs=1e-9)
    assert total[0] == pytest.approx(float(shape.shared_area(quad[None])[0]), abs=1e-9)


@pytest.mark.parametrize("lens", [{}, {"projection": "equidistant"}], ids=["pinhole", "fish-eye"])
@pytest.mark.parametrize("shape", [Disc(0.1), Rectangle((0.2, 0.2))], ids=["disc", "square"])
def test_each_pixel_has_the_mean_over_its_covered_part(shape: Disc | Rectangle, lens: dict) -> None:
    """Against a grid of rays in each pixel, on a face whose luminance falls from 1.9 to 0.1 of its mean."""
    camera = Camera(width_px=60, height_px=60, pixel_pitch_um=200.0, focal_length_mm=8.0, **lens)
    profile = FaceProfile.of((0.5, -0.2), 0.7, 0.1, isinstance(shape, Rectangle))
    posed, center = PosedCamera(camera, Pose((1.5, 1.5, 0.5), 6.0, -8.0, 30.0)), np.array([1.6, 1.4, 2.5])
    image = coverage_of_led(posed, LedFace(center, shape, profile))
    even = coverage_of_led(posed, LedFace(center, shape))
    assert image is not None
    assert even is not None
    assert np.array_equal(image.coverage, even.coverage)
    n = 100
    at = [start + (np.arange(size * n) + 0.5) / n for start, size in
          ((image.roi.column, image.roi.columns), (image.roi.row, image.roi.rows))]  # fmt: skip
    rays = posed.rays_world(np.stack(np.meshgrid(*at), axis=-1))
    x, y = np.moveaxis((rays[..., :2] / rays[..., 2:] * 2.0 + [1.5, 1.5]) - center[:2], -1, 0)
    inside = np.hypot(x, y) <= 0.1 if isinstance(shape, Disc) else np.maximum(abs(x), abs(y)) <= 0.1
    light = (profile.at(x, y) * inside).reshape(image.roi.rows, n, image.roi.columns, n).mean(axis=(1, 3))
    error = image.coverage * image.profile - light
    # edge pixels: the grid's error of 0.3 / n^1.5 rms, at worst half a grid line, times a luminance of up to 1.9; and
    # the change of scale within a pixel (focal length of 40 px): 1e-3 of the profile's change in a pixel, 0.5 / 2.5
    edge = (image.coverage > 0) & (image.coverage < 1)
    assert edge.sum() > 10
    assert np.abs(error[edge]).max() < 1.9 * 0.5 / n + 1e-3
    assert np.sqrt((error[edge] ** 2).mean()) < 1.9 * 3 * 0.3 / n**1.5 + 1e-3
    assert np.abs(error[image.coverage == 1]).max() < 1e-3
    # the profile is more than that
    assert np.abs(image.coverage - light).max() > 0.3


@pytest.mark.slow
@pytest.mark.parametrize(("led", "share"), [(DISC, 1 / 4), (SQUARE, 1 / 3)], ids=["disc", "square"])
def test_the_centroid_moves_towards_the_bright_side_and_the_light_stays(led: dict, share: float) -> None:
    """The centroid of 1 + g x / R is g R <x^2> / R^2: a quarter of g R on a disc, a third on a square.

    +x of the room is right in the image of a level camera and +y is down. Relative illumination falls off by
    2 (R / h)^2 = 0.5 % from centre to rim, even in x: the centroid's shift changes by less than that.
    """
    even = light_of(led)
    tilted = light_of({**led, "face_gradient": [0.2, -0.1]})
    assert tilted.sum() == pytest.approx(even.sum(), rel=1e-9)
    radius_px = 0.1 / 2.0 * CAMERA.focal_px
    assert centroid(tilted) - centroid(even) == pytest.approx(np.array([0.2, -0.1]) * share * radius_px, rel=5e-3)
    dome = light_of({**led, "face_falloff": 0.6})
    # the profile's mean is 1; its product with the fall-off of 0.5 % differs by the product of both
    assert dome.sum() == pytest.approx(even.sum(), rel=0.5e-2 * 0.25)
    level = 1 / (1 - 0.4 * (1 / 2 if led is DISC else 2 / 3))
    middle = np.s_[74:76, 99:101]
    assert dome[middle] / even[middle] == pytest.approx(np.full((2, 2), level), rel=0.4 * 0.1**2)  # 0.1 radii across


def test_blur_motion_and_a_mosaic_keep_the_profile() -> None:
    led = {**DISC, "face_gradient": [0.3, 0.0], "face_falloff": 0.8}
    posed = PosedCamera(CAMERA, BELOW)
    for focus in (1.99, 1.0):  # discs of 0.1 px, on parts of pixels, and of 9 px
        blurred = PosedCamera(CAMERA.model_copy(update={"focus_distance_m": focus, "f_number": 4.0}), BELOW)
        tilted, even = (Renderer(scene_of(led=[one], **DARK)).led_patches(blurred)[0] for one in (led, DISC))
        assert tilted.electrons_per_s.sum() == pytest.approx(even.electrons_per_s.sum(), rel=2e-3)
        moved = (centroid(tilted.electrons_per_s) - centroid(even.electrons_per_s))[0]
        # as above
        assert moved == pytest.approx(0.3 / 4 * 0.05 * blurred.camera.focal_px, rel=5e-3)
    scene = scene_of(led=[led], **DARK)
    renderer = Renderer(scene)
    still = renderer.expected_image(posed).expected_electrons(1.0)
    moving = renderer.expected_image(posed, during=[BELOW, BELOW]).expected_electrons(1.0)
    assert moving == pytest.approx(still, rel=1e-6)  # float32
    mosaic = MosaicRenderer((renderer, renderer, renderer), "rggb")
    assert np.array_equal(mosaic.expected_image(posed).expected_electrons(1.0), still)


def test_a_narrow_blur_distributes_the_profile_within_edge_pixels() -> None:
    """The parts of edge pixels are the pixels of a camera with pixels of 1/8 the side."""
    profile, shape = FaceProfile.of((0.5, -0.2), 0.7, 0.2, False), Disc(0.2)
    face = LedFace(np.array([1.3, 0.9, 2.5]), shape, profile)
    coarse, fine = (
        PosedCamera(
            Camera(width_px=64 * n, height_px=48 * n, pixel_pitch_um=40.0 / n, focal_length_mm=3.0),
            Pose((1.0, 1.0, 0.5), 6, -8, 30),
        )
        for n in (1, 8)
    )
    image, finer = coverage_of_led(coarse, face), coverage_of_led(fine, face)
    assert image is not None
    assert finer is not None
    edges = edges_of_led(coarse, face, image, 8)
    drawn = np.zeros((48 * 8, 64 * 8))
    drawn[finer.roi.row : finer.roi.end_row, finer.roi.column : finer.roi.end_column] = finer.coverage * finer.profile
    parts = drawn.reshape(48, 8, 64, 8).swapaxes(1, 2)[edges.rows, edges.columns]
    # a part that the edge crosses has the profile at its centre, up to half a part from the covered share's centroid:
    # 0.5 / 8 px of the 7.5 px radius, times a slope of at most 0.54 + 2 * 0.353
    error = np.abs(edges.excess - (parts - parts.mean(axis=(1, 2), keepdims=True)))
    assert error.max() < 0.5 * np.sqrt(2) / 8 / 7.5 * 1.25
    assert np.abs(edges.excess).max() > 0.5


def test_a_narrow_blur_of_a_small_face_is_as_exact_as_of_an_even_one() -> None:
    """A face of 2.2 px radius, a defocus disc of 1 px, against pixels of 1/16 the side blurred and binned.

    As along an even edge (psf.split_for), the squared error is below 5 % of the shot noise's variance at 4 000
    electrons beside 24.
    """
    n, focus = 16, 0.5
    camera = CAMERA.model_copy(update={"focus_distance_m": focus, "f_number": 3.2})
    disc_px = float(defocus_diameter_px(camera, 2.0))
    assert 0.5 < disc_px < 1.5
    led = {**DISC, "position_m": [1.5013, 1.497, 2.5], "radius_m": 0.022, "face_gradient": [0.3, 0.15]}
    finer = Camera(
        width_px=200 * n,
        height_px=150 * n,
        pixel_pitch_um=40.0 / n,
        focal_length_mm=camera.image_distance_mm,
        f_number=camera.working_f_number,
    )
    sharp = light_of(led, camera=finer)
    kernel = blur_kernel(
        finer.model_copy(update={"focal_length_mm": 8.0, "f_number": 3.2, "focus_distance_m": focus}), 2.0
    )
    assert kernel is not None
    expected = signal.fftconvolve(sharp, kernel, mode="same").reshape(150, n, 200, n).sum(axis=(1, 3))
    scale = 4000 / expected.max()
    error = (light_of(led, camera=camera) - expected) * scale
    assert (error**2 / (expected * scale + 24)).max() < 0.05


def test_a_reflection_in_a_glazing_shows_the_profile_mirrored() -> None:
    """The glazing in x = 0 mirrors x: a gradient along x brightens the other side of the reflection; y stays."""
    glazing = {"wall": "x=0", "corner_m": [0.5, 0.1], "size_m": [2.0, 2.3], "luminance_cd_m2": 0.0}
    pose = Pose((1.0, 1.5, 1.0), tilt_y_deg=-60.0)
    camera = Camera(width_px=300, height_px=300, pixel_pitch_um=40.0, focal_length_mm=8.0)

    def reflection(**profile: object) -> np.ndarray:
        scene = scene_of(led=[{**DISC, **profile}], glazing=[glazing], **DARK)
        image = Renderer(scene).expected_image(PosedCamera(camera, pose))
        (found,) = image.parts[0].reflections
        drawn = np.zeros((300, 300))
        drawn[found.row : found.roi.end_row, found.column : found.roi.end_column] = found.electrons_per_s
        return drawn

    even = centroid(reflection())
    along_x, along_y = (centroid(reflection(face_gradient=g)) - even for g in ([0.4, 0.0], [0.0, 0.4]))
    # the LED appears at x = -1.5: +x of the room is -x of the mirror image
    mirrored = [PosedCamera(camera, pose).project(np.array(p)) for p in ([-1.5, 1.5, 2.5], [-1.51, 1.5, 2.5])]
    step = mirrored[1] - mirrored[0]
    assert along_x @ step > 0
    # a quarter of the gradient of the radius, 0.01 m; the scale changes by R / d = 4 % across the face
    assert along_x == pytest.approx(step, rel=0.04, abs=0.02)
    upright = PosedCamera(camera, pose).project(np.array([-1.5, 1.51, 2.5])) - mirrored[0]
    assert along_y == pytest.approx(upright, rel=0.04, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("led", [DISC, SQUARE], ids=["disc", "square"])
def test_the_path_traced_reference_shows_the_same_profile(led: dict) -> None:
    scene = scene_of(led=[{**led, "face_gradient": [0.5, -0.2], "face_falloff": 0.85}], **DARK)
    camera = Camera(width_px=120, height_px=90, pixel_pitch_um=100.0)
    samples = 256
    ours, reference, variance, lit = both_ways(scene, camera, Pose((1.45, 1.5, 0.4), 2.0, -3.0, 30.0), samples)
    assert lit.sum() > 100
    # Edges: p (1 - p) L^2 / n as in test_path_traced, with L up to 1.7 times the mean. The profile within a pixel and
    # the bitmap's half pixel at the rim (0.5 / 256 of a slope of 1): 0.4 % of the luminance.
    peak = 1.7 * 8000.0
    edge = (ours < 0.98 * peak) * ours * peak / samples
    inner = np.zeros_like(lit)
    inner[1:-1, 1:-1] = lit[1:-1, 1:-1] & lit[:-2, 1:-1] & lit[2:, 1:-1] & lit[1:-1, :-2] & lit[1:-1, 2:]
    inner[:, 1:-1] &= lit[:, 2:] & lit[:, :-2]
    allowed = np.where(inner, variance, np.maximum(variance, edge)) + (0.004 * 8000) ** 2
    z = (ours - reference)[lit] / np.sqrt(allowed[lit])
    assert np.abs(z).max() < 6
    # an even face would not pass
    even = both_ways(scene_of(led=[led], **DARK), camera, Pose((1.45, 1.5, 0.4), 2.0, -3.0, 30.0), 8)[0]
    assert np.abs(even - reference)[inner].max() > 0.4 * 8000


@pytest.mark.slow
def test_the_bound_does_not_depend_on_the_step_of_its_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    """The images of a profiled LED are as exact as those of an even one: slopes agree for steps 4 times apart."""
    leds = [
        {**DISC, "id": n, "position_m": p, "radius_m": 0.03, "face_gradient": [0.3, 0.1], "face_falloff": 0.7}
        for n, p in enumerate(([1.3, 1.3, 2.5], [1.75, 1.4, 2.5], [1.5, 1.8, 2.3]))
    ]
    leds[0] = {**leds[0], "shape": "square", "side_m": 0.05}
    del leds[0]["radius_m"]
    renderer = Renderer(scene_of(led=leds))
    (mounted,) = mounted_cameras(CAMERA, ())
    pose = Pose((1.5, 1.5, 0.5), 3.0, -2.0, 10.0)
    expected = renderer.expected_image(PosedCamera(CAMERA, pose), LedRegions(kind="leds"))
    mean = [RegionImage(p.roi, p.expected_electrons(1e-6)) for p in expected.parts]
    variance = [RegionImage(roi, variance_e2(Sensor(full_well_e=4e6), image, 1e-6)) for roi, image in mean]
    bounds = []
    for step in (1e-4, 1e-2):
        monkeypatch.setattr("vlcrender.rendering.crlb.STEP_PX", step)
        bounds.append(position_bound_m2(mounted, pose, renderer.led_slopes, 1e-6, variance, 2.0, (0.1, 0.1)))
    # Projections err by 1e-12 px of 1e-4 px; the larger step of 1e-2 px by (1e-2 / focal length)^2 of itself.
    assert bounds[0] == pytest.approx(bounds[1], rel=1e-6)


@pytest.mark.parametrize(
    ("gradient", "falloff", "square", "lowest"),
    [
        ((0.6, -0.8), 1.0, False, 0.0),
        ((0.6, -0.4), 1.0, True, 0.0),
        ((0.0, 0.0), 0.0, False, 0.0),
        ((0.0, 0.0), 0.5, True, 0.0),  # (1 - 2 * 0.5) in the corners
        ((0.0, 0.0), 2.0, False, 1 / 1.5),  # the centre
        ((1.0, 0.0), 2.0, False, (1 - 1.5**2 / 4) / 1.5),  # 1 + t^2 - 1.5 t at t = 0.75
    ],
)
def test_the_darkest_point_of_a_face(
    gradient: tuple[float, float], falloff: float, square: bool, lowest: float
) -> None:
    assert lowest_share(gradient, falloff, square) == pytest.approx(lowest, abs=1e-12)


@pytest.mark.parametrize(
    ("led", "message"),
    [
        ({**DISC, "face_gradient": [0.8, 0.8]}, r"led\[0\].face_gradient: with face_falloff = 1, luminance falls to"),
        ({**SQUARE, "face_falloff": 0.4}, r"falls to -0.333 of its mean .* closer to 1"),
        ({**DISC, "face_falloff": 2.5}, r"face_falloff = 2.5"),
        ({**DISC, "face_gradient": [0.1]}, r"face_gradient"),
    ],
)
def test_impossible_profiles_are_refused(led: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        scene_of(led=[led])


def test_a_profile_behind_a_diffuser_is_refused() -> None:
    panel = {
        "columns": 1,
        "rows": 1,
        "first_center_m": [1.5, 1.5, 2.4],
        "pitch_m": [1.0, 1.0],
        "size_m": [0.6, 0.6, 0.1],
        "reflectance": 0.8,
        "diffuser": {"distance_m": 0.05, "transmittance": 0.6},
        "leds": {
            "columns": 2,
            "rows": 2,
            "pitch_m": [0.2, 0.2],
            "radius_m": 0.01,
            "luminance_cd_m2": [1e6, 1e6],
            "first_id": 0,
            "face_falloff": 0.8,
        },
    }
    with pytest.raises(InputError, match=r"panels\[0\].diffuser: hides the LEDs' faces"):
        scene_of(panels=[panel])
    del panel["diffuser"]
    leds = scene_of(panels=[panel]).leds
    assert leds.face_falloffs.tolist() == [0.8] * 4
    assert leds.face_gradients.tolist() == [[0.0, 0.0]] * 4


@pytest.mark.slow
def test_photometry_does_not_change() -> None:
    """The bake depends on luminance times area alone: a profile leaves its key, and so its light, as they are."""
    even, profiled = (
        bake(scene_of(led=[{**DISC, **profile}]))
        for profile in ({}, {"face_gradient": [0.2, 0.1], "face_falloff": 0.7})
    )
    assert np.array_equal(even.led_cd_m2(), profiled.led_cd_m2())
