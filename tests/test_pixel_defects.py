"""Crosstalk and hot pixels: closed forms of means and distributions, mosaics, regions, binning."""

import numpy as np
import pytest
from test_off_axis import PLACES, POSE, camera_of
from test_path_traced import scene_of

import vlcrender as vr
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import LedRegions, Roi
from vlcrender.emva1288.datasheet import make_datasheet
from vlcrender.errors import InputError
from vlcrender.rendering.bayer import MosaicRenderer
from vlcrender.rendering.crosstalk import shared
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene
from vlcrender.sensor.radiometry import Silicon
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

SENSOR = Roi(0, 0, 300, 400)
SIDE = 1000
N = SIDE * SIDE


@pytest.fixture(scope="module")
def scene() -> Scene:
    leds = [
        {"id": n, "position_m": [x, y, 2.5], "radius_m": 0.02, "luminance_cd_m2": 8000.0}
        for n, (x, y) in PLACES.items()
    ]
    return scene_of(led=leds, bake={"texel_m": 0.5, "paths": 16})


def test_four_neighbours_collect_a_quarter_of_the_share_each() -> None:
    image = np.zeros((5, 7))
    image[2, 3] = 100.0
    expected = np.zeros((5, 7))
    expected[2, 3] = 80.0
    expected[[1, 3, 2, 2], [3, 3, 2, 4]] = 5.0
    assert shared(image, 0.2) == pytest.approx(expected, abs=1e-12)
    even = np.full((4, 4), 7.0)
    assert shared(even, 0.3) == pytest.approx(even, abs=1e-12)
    assert shared(np.full((1, 1), 7.0), 0.3) == pytest.approx(7.0, abs=1e-12)
    # the border of a mosaic: the neighbours of a red pixel are green on all sides
    mosaic = np.tile([[1.0, 2.0], [2.0, 4.0]], (2, 2))
    mixed = shared(mosaic, 0.4)
    assert mixed[0, 0] == pytest.approx(0.6 * 1 + 0.4 * 2)
    assert mixed[3, 3] == pytest.approx(0.6 * 4 + 0.4 * 2)
    assert mixed[0, 1] == pytest.approx(0.6 * 2 + 0.1 * (1 + 1 + 4 + 4))


@pytest.mark.parametrize("mosaic", ["none", "rggb"])
def test_an_image_with_crosstalk_is_the_image_shared_out(scene: Scene, mosaic: str) -> None:
    """Patches, background and halo together; a mosaic is mixed after its filters. Regions have the same pixels."""
    posed = PosedCamera(camera_of(glare={"share": 0.05, "radius_um": 400.0}), POSE)
    depths = (3.0,) if mosaic == "none" else (1.0, 2.0, 3.0)

    def renderer(share: float) -> Renderer | MosaicRenderer:
        if mosaic == "none":
            return Renderer(scene, detector=Silicon(3.0), crosstalk=share)
        return MosaicRenderer(tuple(Renderer(scene, detector=Silicon(d)) for d in depths), mosaic, share)

    plain = renderer(0.0).expected_image(posed).expected_electrons(1.0).astype(np.float64)
    found = renderer(0.1).expected_image(posed).expected_electrons(1.0)
    assert found == pytest.approx(shared(plain, 0.1), rel=1e-5)  # float32
    assert np.abs(found / plain - 1).max() > 0.05
    regions = renderer(0.1).expected_image(posed, LedRegions(kind="leds", margin_px=0.0))
    assert len(regions.parts) == 3
    for part in regions.parts:
        (patch,) = part.patches
        assert part.roi == patch.roi  # the light that neighbours collect is read out
        crop = found[SENSOR.slices(part.roi)][1:-1, 1:-1]
        assert part.expected_electrons(1.0)[1:-1, 1:-1] == pytest.approx(crop, rel=1e-5)
    assert {p.led_id: p.roi for p in renderer(0.1).led_patches(posed)} == {p.led_id: p.roi for p in regions.patches}


def test_shot_noise_after_crosstalk_is_independent_from_pixel_to_pixel() -> None:
    """Electrons that go to a neighbour one by one: variance equals mean, and neighbours do not correlate."""
    mean = shared(np.where(np.indices((SIDE, SIDE)).sum(axis=0) % 2, 150.0, 50.0), 0.2).astype(np.float32)
    assert mean[1:-1, 1:-1] == pytest.approx(np.where(np.indices((SIDE, SIDE)).sum(axis=0) % 2, 130, 70)[1:-1, 1:-1])
    deviation = (expose(Sensor(crosstalk=0.2), mean, "a", exposure_s=1.0) - mean) / np.sqrt(mean)
    assert deviation.var() == pytest.approx(1.0, abs=5 * np.sqrt((2 + 1 / 70) / N))
    for there, here in ((deviation[:, 1:], deviation[:, :-1]), (deviation[1:], deviation[:-1])):
        assert abs((there * here).mean()) < 5 / np.sqrt(N)


def test_the_python_interface_renders_with_the_crosstalk_of_the_sensor(scene: Scene) -> None:
    camera = camera_of()
    plain, mixed = (
        vr.render(scene, camera, POSE, sensor=Sensor(crosstalk=share)).electrons_per_s for share in (0.0, 0.1)
    )
    assert mixed == pytest.approx(shared(plain.astype(np.float64), 0.1), rel=1e-5)
    # an image rendered with another crosstalk is rendered again
    raw = vr.expose(vr.render(scene, camera, POSE), Sensor(noise="none", crosstalk=0.1), 1e-6, 1)
    assert np.array_equal(raw.image_dn, np.minimum(np.rint(mixed * np.float32(1e-6)), 4095))


HOT = {"noise": "full", "bits": 14, "gain_e_per_dn": 8.0, "full_well_e": 4e6}


def dark_frame(sensor: Sensor, exposure_s: float, key: str = "a", camera: str = "main") -> np.ndarray:
    image = expose(sensor, np.zeros((SIDE, SIDE), dtype=np.float32), key, exposure_s=exposure_s, camera=camera)
    return image * sensor.gain_at_iso_e_per_dn


def test_hot_pixels_are_as_many_as_told_with_an_exponential_dark_current() -> None:
    share, mean = 0.01, 20000.0
    frame = dark_frame(Sensor(**HOT, hot_pixel_share=share, hot_pixel_e_s=mean), 1.0)
    # a current below half a digital number does not show: 4 e of 20 000 e
    hot = frame[frame > 0]
    assert abs(len(hot) - share * N * np.exp(-4 / mean)) < 5 * np.sqrt(share * N)
    # an exponential number has its mean for its standard deviation: sqrt(n) of the sum; the ADC clips at 131 000 e
    limit = 16383 * 8.0
    expected = mean * (1 - np.exp(-limit / mean))
    assert abs(hot.mean() - expected) < 5 * mean / np.sqrt(len(hot))
    for level in (0.5, 1.0, 2.0, 4.0):
        beyond = np.exp(-level)
        found = (hot > level * mean).mean()
        assert abs(found - beyond) < 5 * np.sqrt(beyond / len(hot)) + 4 / mean


def test_hot_pixels_belong_to_the_sensor_and_grow_with_time_and_temperature() -> None:
    sensor = Sensor(**HOT, hot_pixel_share=0.001, hot_pixel_e_s=20000.0)
    first = dark_frame(sensor, 1.0) > 400
    assert np.array_equal(first, dark_frame(sensor, 1.0) > 400)
    # another frame: the same pixels but for shot noise of the few near the limit (sqrt(400) / 20 000 of them)
    assert (first != (dark_frame(sensor, 1.0, "b") > 400)).sum() < 10
    for other in (sensor.model_copy(update={"serial": 5}), sensor):
        camera = "main" if other is not sensor else "left"
        both = first & (dark_frame(other, 1.0, camera=camera) > 400)
        assert both.sum() < 15  # by chance 0.001^2 of a million
    assert sensor.hot_electrons(2.0) == 40000.0
    assert sensor.model_copy(update={"temperature_c": 31.0}).hot_electrons(1.0) == pytest.approx(40000.0)
    # a region has the hot pixels of the whole frame
    part = expose(sensor, np.zeros((50, 60), dtype=np.float32), "a", 100, 200, exposure_s=1.0) * 8.0
    assert np.array_equal(part, dark_frame(sensor, 1.0)[100:150, 200:260])


def test_hot_pixels_saturate_at_the_full_well() -> None:
    sensor = Sensor(noise="full", full_well_e=1000.0, hot_pixel_share=0.01, hot_pixel_e_s=1e6)
    frame = dark_frame(sensor, 1.0)
    assert frame.max() == 1000
    # exp(-1000 / 1e6) of them
    assert (frame == 1000).sum() == pytest.approx(0.01 * N, abs=5 * np.sqrt(0.01 * N) + 1e-3 * 0.01 * N)


@pytest.mark.parametrize("noise", ["shot", "none"])
def test_hot_pixels_need_the_whole_chain(noise: str) -> None:
    sensor = Sensor(noise=noise, hot_pixel_share=0.1, hot_pixel_e_s=1e6)
    assert dark_frame(sensor, 1.0).max() == 0


def test_no_hot_pixels_keep_every_bit() -> None:
    light = np.full((100, 100), 50.0, dtype=np.float32)
    plain = Sensor(noise="full", prnu=0.02, dark_current_e_s=100.0, dsnu_e=1.0, read_noise_e=2.0)
    none = plain.model_copy(update={"hot_pixel_share": 0.0, "hot_pixel_e_s": 1e6})
    few = plain.model_copy(update={"hot_pixel_share": 0.01, "hot_pixel_e_s": 1e6})
    images = [expose(sensor, light, "a", exposure_s=0.1) for sensor in (plain, none, few)]
    assert np.array_equal(images[0], images[1])
    assert 50 < (images[0] != images[2]).sum() < 150  # of 10 000, one in a hundred


def test_binning_keeps_the_light_that_crosses_a_border_and_the_hot_pixels() -> None:
    sensor = Sensor(crosstalk=0.2, hot_pixel_share=0.001).binned(4)
    # of 16 pixels 4 lie along each side, each loses 0.2 / 4 across it: 4 sides * 4 * 0.05 / 16
    assert sensor.crosstalk == pytest.approx(0.05)
    assert sensor.hot_pixel_share == pytest.approx(1 - 0.999**16, rel=1e-12)
    assert sensor.hot_pixel_e_s == 5000.0


def test_a_data_sheet_is_of_pixels_without_defects() -> None:
    with pytest.raises(InputError, match=r"sensor\.hot_pixel_share = 0\.001: .* set it to 0"):
        make_datasheet("hot", Sensor(noise="full", hot_pixel_share=0.001))
