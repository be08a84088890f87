"""LED images in parts: each part is that of the whole, and bounds by tiles are those of all pixels at once."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from test_diffuser import panelled
from test_hybrid_bound import TILTS_DEG
from test_led_slopes import CAMERA, COARSE, POSE
from test_path_traced import scene_of

from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import mounted_cameras
from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.rendering import crlb, triangles
from vlcrender.rendering.bayer import MosaicRenderer
from vlcrender.rendering.crlb import FrameSlopes
from vlcrender.rendering.face_motions import moved
from vlcrender.rendering.led_coverage import CoverageBlocks, coverage_of_led
from vlcrender.rendering.led_radiance import face_of_led
from vlcrender.rendering.moving_led import MovingLed
from vlcrender.rendering.renderer import Renderer
from vlcrender.rendering.uncertainty import Uncertainty
from vlcrender.scene.leds import Leds
from vlcrender.sensor.radiometry import Silicon
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import variance_e2

STEP = 1e-6
PARTS = [Roi(100, 150, 90, 130), Roi(131, 17, 1, 200), Roi(20, 20, 260, 33)]
LENSES = {"sharp": {}, "defocus": {"focus_distance_m": 1.2}, "diffraction": {"psf": "diffraction", "f_number": 16.0}}


def leds_of(renderer: Renderer | MosaicRenderer, camera: Camera) -> tuple[MovingLed, ...]:
    """The LEDs at POSE, and their changes by x and by the first tilt."""
    posed = PosedCamera(camera, POSE)
    changes = [(posed.at(moved(POSE, i, STEP)), posed.at(moved(POSE, i, -STEP))) for i in (0, 3)]
    return renderer.led_slopes(posed, changes)


def assert_parts_are_of_the_whole(renderer: Renderer | MosaicRenderer, camera: Camera) -> None:
    """Of two LEDs, to rounding: Fourier transforms of blurs are right to some 1e-15 of the largest number."""
    whole = [led.within(Roi(0, 0, 300, 400)) for led in leds_of(renderer, camera)[:2]]
    for part in PARTS:
        for led, of_led in zip(leds_of(renderer, camera), whole, strict=False):
            scale = np.abs(of_led).max(axis=(1, 2))
            assert (scale > 0).all()
            error = np.abs(led.within(part) - of_led[:, part.row : part.end_row, part.column : part.end_column])
            assert (error.max(axis=(1, 2)) < 1e-13 * scale).all()


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
@pytest.mark.parametrize("diffuser", [False, True], ids=["bare", "diffuser"])
def test_a_part_of_an_image_is_that_of_the_whole(lens: dict[str, float], diffuser: bool) -> None:
    renderer = Renderer(panelled(diffuser=diffuser, frame=False, bake=COARSE))
    assert_parts_are_of_the_whole(renderer, Camera(**CAMERA, **lens))


@pytest.mark.parametrize("mosaic", [False, True], ids=["grey", "mosaic"])
def test_crosstalk_and_mosaic_of_a_part_are_those_of_the_whole(mosaic: bool) -> None:
    scene = panelled(diffuser=True, frame=False, bake=COARSE)
    renderer: Renderer | MosaicRenderer = Renderer(scene, crosstalk=0.1)
    if mosaic:
        renderer = MosaicRenderer(tuple(Renderer(scene, None, Silicon()) for _ in range(3)), "rggb", 0.1)
    assert_parts_are_of_the_whole(renderer, Camera(**CAMERA))


def test_an_led_is_dark_beyond_its_image_and_has_the_gain_of_each_line() -> None:
    led = leds_of(Renderer(panelled(diffuser=False, frame=False, bake=COARSE)), Camera(**CAMERA))[0]
    lines = np.linspace(0.5, 1.5, 300)[:, None]
    around = led.roi.padded(7)
    wide = led.times(lines).within(around)
    np.testing.assert_array_equal(wide[:, 7:-7, 7:-7], led.within(led.roi) * lines[led.roi.row : led.roi.end_row])
    wide[:, 7:-7, 7:-7] = 0
    assert not wide.any()
    assert led.within(Roi(290, 390, 10, 10)).shape == (3, 10, 10)


def test_an_led_held_in_memory_is_the_same() -> None:
    led = leds_of(Renderer(panelled(diffuser=True, frame=False, bake=COARSE)), Camera(**CAMERA))[0]
    held = led.held()
    assert (held.led_id, held.roi) == (led.led_id, led.roi)
    for part in PARTS:
        np.testing.assert_array_equal(held.within(part), led.within(part))


def test_coverage_of_a_part_of_a_large_image() -> None:
    """An image in blocks of 16 pixels, at places that no block begins or ends at."""
    leds = panelled(diffuser=True, frame=False, bake=COARSE).leds
    fine = Camera(**{**CAMERA, "width_px": 800, "height_px": 600, "pixel_pitch_um": 4.0})
    image = coverage_of_led(PosedCamera(fine, POSE), face_of_led(leds, 0))
    assert image is not None
    assert isinstance(image.pixels, CoverageBlocks)
    whole, roi = image.coverage, image.roi
    for row, column, rows, columns in ((0, 0, *roi.shape), (5, 3, 40, 70), (16, 32, 16, 16), (roi.rows - 1, 7, 1, 99)):
        part = image.within(Roi(roi.row + row, roi.column + column, rows, columns))
        np.testing.assert_array_equal(part.coverage, whole[row : row + rows, column : column + columns])


def bare_led(led_id: int, x_m: float, y_m: float = 1.5) -> dict[str, object]:
    return {"id": led_id, "position_m": [x_m, y_m, 2.2], "luminance_cd_m2": 8000.0, "radius_m": 0.01}


@pytest.fixture(params=["diffuser", "bare"])
def overlapping(request: pytest.FixtureRequest) -> tuple[FrameSlopes, Leds]:
    """Six LEDs behind one diffuser, whose images overlap, and a bare one before it; or seven bare ones, whose margins
    do.
    """
    if request.param == "diffuser":
        scene = panelled(diffuser=True, frame=False, led=[bare_led(20, 1.42)], bake=COARSE)
    else:
        scene = scene_of(
            led=[bare_led(number, 1.27 + 0.025 * number, 1.3 + 0.03 * (number % 3)) for number in range(7)], bake=COARSE
        )
    renderer = Renderer(scene)
    mounted, exposure_s = mounted_cameras(Camera(**CAMERA), ())[0], 1e-4
    expected = renderer.expected_image(mounted.posed(POSE)).expected_electrons(exposure_s)
    variance = [RegionImage(Roi(0, 0, 300, 400), variance_e2(Sensor(full_well_e=1e6), expected, exposure_s))]
    slopes = FrameSlopes.rendered(mounted, POSE, renderer.led_slopes, exposure_s, variance, 2.0)
    assert slopes is not None
    assert len(slopes.seen) == 7
    return slopes, renderer.scene.leds


def test_tiles_tell_what_all_pixels_tell(
    overlapping: tuple[FrameSlopes, Leds], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exact and hybrid bound and the spots' covariances, in small tiles and at once.

    To rounding, 2^-52, times the condition of the information, 3e4 of diffusers and 2.2e6 of bare LEDs, twice.
    """
    slopes, leds = overlapping
    uncertainty = replace(
        Uncertainty.none(7),
        intrinsics=np.array([1e-3, 1e-4, 0.5, 0.6, 2e-3, 3e-4, 2e-4]),
        led_positions_m=np.full((7, 3), 1e-3),
        led_sizes=np.full(7, 0.01),
        led_gradients=np.full(7, 0.05),
        led_faces_rad=np.full(7, 0.01),
    )

    def told() -> list[NDArray[np.float64]]:
        alone = replace(slopes)  # without what it has computed
        exact, hybrid = alone.exact_bound_m2(TILTS_DEG), alone.hybrid_bound_m2(TILTS_DEG, leds, uncertainty)
        assert exact is not None
        assert hybrid is not None
        assert np.trace(hybrid) > 1.1 * np.trace(exact)
        spots = alone.spot_covariances_px2(leds)
        assert len(spots) == 7
        return [exact, hybrid, *(spots[i] for i in sorted(spots))]

    monkeypatch.setattr(crlb, "PIXELS_AT_ONCE", 400 * 300)
    at_once = told()
    monkeypatch.setattr(crlb, "PIXELS_AT_ONCE", 0)
    for size_px, count in ((64, 3), (150, 32)):
        monkeypatch.setattr(triangles, "TILE_PX", size_px)
        monkeypatch.setattr(triangles, "TRIANGLES_AT_ONCE", count)
        for by_tiles, whole in zip(told(), at_once, strict=True):
            np.testing.assert_allclose(by_tiles, whole, rtol=0, atol=1e-9 * np.trace(whole))
