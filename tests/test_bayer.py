"""Mosaics: pixels agree with a sensor under one filter, and the two spectra are weighted separately."""

import numpy as np
import pytest
from scipy import constants

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import LedRegions, Roi
from vlcrender.rendering.bayer import MosaicRenderer, colour_of_pixels
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene
from vlcrender.sensor.quantum_efficiency import COLOURS, QuantumEfficiency
from vlcrender.sensor.radiometry import WAVELENGTHS_NM, Silicon, Tabulated, detectors, electron_rate_per_cd_m2
from vlcrender.sensor.sensor import Sensor

QE = QuantumEfficiency(
    wavelengths_nm=(400.0, 450.0, 500.0, 550.0, 600.0, 650.0, 700.0),
    red=(0.02, 0.03, 0.03, 0.10, 0.50, 0.45, 0.20),
    green=(0.05, 0.15, 0.50, 0.60, 0.20, 0.05, 0.03),
    blue=(0.30, 0.55, 0.30, 0.05, 0.02, 0.01, 0.00),
)
POSE = Pose((3.15, 3.1, 0.6), 6.0, -8.0, 20.0)


@pytest.mark.parametrize(
    ("mosaic", "tile"),
    [("rggb", [[0, 1], [1, 2]]), ("bggr", [[2, 1], [1, 0]]), ("grbg", [[1, 0], [2, 1]]), ("gbrg", [[1, 2], [0, 1]])],
)
def test_colours_of_pixels(mosaic: str, tile: list[list[int]]) -> None:
    whole = colour_of_pixels(mosaic, Roi(0, 0, 6, 8))
    assert whole[:2, :2].tolist() == tile
    assert np.array_equal(whole[2:, 2:], whole[:-2, :-2])
    assert np.array_equal(colour_of_pixels(mosaic, Roi(3, 1, 2, 5)), whole[3:5, 1:6])
    assert np.array_equal(colour_of_pixels(mosaic, Roi(-3, -5, 9, 13))[3:, 5:], whole), "beyond the sensor too"


@pytest.mark.slow
@pytest.mark.parametrize("regions", [None, LedRegions(kind="leds")], ids=["full", "regions"])
def test_each_pixel_agrees_with_a_sensor_of_its_colour(office: Scene, regions: LedRegions | None) -> None:
    """Through a defocused lens: blur comes before the filters."""
    camera = Camera(width_px=160, height_px=120, pixel_pitch_um=30.0, focus_distance_m=0.6)
    of_colours = tuple(Renderer(office, None, Tabulated(QE, colour)) for colour in COLOURS)
    through_mosaic = MosaicRenderer(of_colours, "grbg").expected_image(PosedCamera(camera, POSE), regions)
    of_colour = [renderer.expected_image(PosedCamera(camera, POSE), regions) for renderer in of_colours]
    for number, part in enumerate(through_mosaic.parts):
        image = part.expected_electrons(1e-6)
        colours = colour_of_pixels("grbg", part.roi)
        for colour in range(3):
            expected = of_colour[colour].parts[number].expected_electrons(1e-6)
            assert np.array_equal(image[colours == colour], expected[colours == colour])
        assert [p.led_id for p in part.patches] == [p.led_id for p in of_colour[0].parts[number].patches]


def test_led_patches_are_the_patches_of_the_expected_image(office: Scene) -> None:
    camera = Camera(width_px=160, height_px=120, pixel_pitch_um=30.0)
    renderer = MosaicRenderer(tuple(Renderer(office, None, Tabulated(QE, colour)) for colour in COLOURS), "rggb")
    through_mosaic, of_colour = (
        renderer.expected_image(PosedCamera(camera, POSE)).patches,
        renderer.led_patches(PosedCamera(camera, POSE)),
    )
    assert len(through_mosaic) == len(of_colour) > 0
    for a, b in zip(through_mosaic, of_colour, strict=True):
        assert np.allclose(a.electrons_per_s, b.electrons_per_s, rtol=1e-6)


def test_red_and_blue_rates_follow_the_spectrum() -> None:
    """A warm and a cold white at one luminance: red has the greater rate of the first, blue of the second."""
    rates = {
        spectrum: [electron_rate_per_cd_m2(Camera(), spectrum, Tabulated(QE, colour)) for colour in COLOURS]
        for spectrum in ("LED-B1", "LED-B5")  # 2733 K and 6598 K
    }
    warm, cold = np.array(rates["LED-B1"]), np.array(rates["LED-B5"])
    assert warm[0] > 1.2 * cold[0]
    assert cold[2] > 2 * warm[2]


def test_a_table_of_the_silicon_curve_gives_the_rate_of_silicon() -> None:
    values = Silicon().quantum_efficiency(WAVELENGTHS_NM)
    table = QuantumEfficiency(wavelengths_nm=tuple(WAVELENGTHS_NM), values=tuple(values))
    (detector,) = detectors(Sensor(quantum_efficiency=table))
    assert electron_rate_per_cd_m2(Camera(), "LED-B3", detector) == pytest.approx(
        electron_rate_per_cd_m2(Camera(), "LED-B3", Silicon()), rel=1e-12
    )


def test_rate_of_a_narrow_filter_by_hand() -> None:
    """QE 1 from 550 to 560 nm: rate = pi/4 / N^2 * A * tau * integral of L_lambda lambda / (h c), by hand as a sum."""
    line = QuantumEfficiency(wavelengths_nm=(549.999, 550.0, 560.0, 560.001), values=(0.0, 1.0, 1.0, 0.0))
    from vlcrender.sensor.radiometry import relative_spectrum, spectral_radiance

    radiance = spectral_radiance(1.0, relative_spectrum("LED-B3"))
    inside = (WAVELENGTHS_NM >= 550) & (WAVELENGTHS_NM <= 560)
    photons = radiance * WAVELENGTHS_NM * 1e-9 / (constants.h * constants.c)
    expected = np.pi / 4 / 2.2**2 * 1.2e-6**2 * 0.9 * photons[inside].sum()
    assert electron_rate_per_cd_m2(Camera(), "LED-B3", Tabulated(line)) == pytest.approx(expected, rel=1e-9)
    assert (line.at(np.array([400.0, 555.0, 700.0])) == [0, 1, 0]).all()


def test_silicon_has_one_detector_and_a_mosaic_three() -> None:
    assert detectors(Sensor()) == (Silicon(),)
    mosaic = Sensor(mosaic="rggb", quantum_efficiency=QE)
    assert [detector.colour for detector in detectors(mosaic)] == list(COLOURS)
