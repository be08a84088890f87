"""What a device knows of its sensor, its LEDs and its regions, each by hand."""

import numpy as np
import pytest
from scipy.stats import norm

from estimator.io.camera import Camera
from estimator.io.device import (
    MAX_SENSOR_AREAS,
    Accelerometer,
    DeviceFrame,
    Part,
    depth_problem,
    region_of,
    regions_problem,
)
from estimator.io.led_map import DiscLed, Luminaire, MapDatum, SquareLed
from estimator.io.sensor import Sensor
from estimator.io.shutter import Shutter

SENSOR = Sensor(
    bits=12,
    gain_e_per_dn=2.5,
    full_well_e=9000.0,
    black_level_dn=100.0,
    noise="full",
    prnu=0.01,
    dark_current_e_s=8.0,
    dsnu_e=1.5,
    read_noise_e=3.0,
    adc_noise_dn=1.2,
    row_offset_e=4.0,
    column_offset_e=0.0,
    mosaic="none",
)
CAMERA = Camera(
    width_px=10,
    height_px=8,
    K=((100.0, 0.0, 5.0), (0.0, 100.0, 4.0), (0.0, 0.0, 1.0)),
    pixel_pitch_um=4.0,
    focal_length_mm=0.4,
    image_distance_mm=0.4,
    f_number=2.0,
    projection="perspective",
    distortion=None,
    focus_distance_m=None,
    psf="none",
    psf_wavelength_nm=550.0,
    psf_kernel=None,
    R_cam_rig=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    offset_m=(0.0, 0.0, 0.0),
)
ACCELEROMETER = Accelerometer(kind="tilt-error", error_deg=0.0)


def test_the_floor_of_a_pixel_at_a_gain_of_2_5_by_hand() -> None:
    """DSNU 1.5 e, read noise 3 e, ADC noise 1.2 DN = 3 e, and a uniform step of 2.5 e: 2.25 + 9 + 9 + 2.5^2 / 12."""
    assert SENSOR.floor_e2() == pytest.approx(20.25 + 6.25 / 12, rel=1e-12)


@pytest.mark.parametrize(
    ("noise", "gain_e_per_dn", "floor_e2"),
    [("full", 1.0, 1 / 12), ("shot", 2.5, 6.25 / 12), ("none", 2.5, 6.25 / 12), ("shot", 1.0, 0.0)],
)
def test_rounding_adds_to_the_floor_unless_the_digital_numbers_are_whole_electrons(
    noise: str, gain_e_per_dn: float, floor_e2: float
) -> None:
    """Shot noise at 1 e/DN gives whole electrons, which rounding leaves as they are."""
    silent = {"noise": noise, "gain_e_per_dn": gain_e_per_dn, "dsnu_e": 0.0, "read_noise_e": 0.0, "adc_noise_dn": 0.0}
    assert SENSOR.model_copy(update=silent).floor_e2() == pytest.approx(floor_e2, rel=1e-12)


def test_a_pixel_may_be_full_from_four_standard_deviations_below_the_well_on() -> None:
    """Read noise 3 e and row offset 4 e make 5 e = 2.5 DN at 2 e/DN, with 6 DN of the ADC 6.5 DN; four are 26 DN.

    The well of 4000 e is 2000 DN above the black level of 100. At 10 bits the last code, 1023, comes first.
    """
    sensor = SENSOR.model_copy(update={"gain_e_per_dn": 2.0, "full_well_e": 4000.0, "adc_noise_dn": 6.0})
    assert sensor.saturation_dn() == 2100
    assert sensor.clipping_dn() == pytest.approx(2100 - 4 * 6.5, rel=1e-12)
    assert sensor.model_copy(update={"bits": 10}).clipping_dn() == 1023
    with_columns = sensor.model_copy(update={"row_offset_e": 0.0, "column_offset_e": 4.0})
    assert with_columns.clipping_dn() == sensor.clipping_dn()


def test_one_full_pixel_in_30_000_passes_as_measured(rng: np.random.Generator) -> None:
    """Why FULL_SIGMA is 4: of a million full pixels, 1e6 Q(4) = 32 read less than the limit.

    With 3 it would be 1350, so that a saturated LED image of 1000 pixels has one whose electrons are wrong; with 5, a
    sensor would lose one more standard deviation of its range for one pixel in three million. Here 5 e are 10 DN and
    with 24 DN of the ADC 26 DN; digital numbers are whole, so the limit lies half a DN lower, at 4.02 standard
    deviations: 29 pixels, give or take four times the root of that.
    """
    sensor = SENSOR.model_copy(update={"bits": 16, "gain_e_per_dn": 0.5, "adc_noise_dn": 24.0})
    full_e = sensor.full_well_e + rng.normal(0, 5.0, 1_000_000)
    image_dn = np.rint(full_e / 0.5 + rng.normal(0, 24.0, full_e.size)).astype(np.uint32).reshape(1000, 1000) + 100
    assert sensor.saturation_dn() - sensor.clipping_dn() == pytest.approx(104, abs=1e-9)
    frame = DeviceFrame((), CAMERA, sensor, (0.0, 0.0, 9.8), ACCELEROMETER, 1e-3, (), {})
    missed = int((~frame.clipped(Part(0, 0, image_dn.astype(np.uint32)))).sum())
    expected = 1e6 * norm.sf(104.5 / 26)
    assert abs(missed - expected) < 4 * np.sqrt(expected)


@pytest.mark.parametrize("black_level_dn", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("gain_e_per_dn", [1.0, 2.0])
def test_electrons_are_counted_from_the_black_level(black_level_dn: float, gain_e_per_dn: float) -> None:
    """Also from a level of 1 DN and at 1 e/DN, where a step may be skipped only if it changes nothing."""
    sensor = SENSOR.model_copy(update={"black_level_dn": black_level_dn, "gain_e_per_dn": gain_e_per_dn})
    frame = DeviceFrame((), CAMERA, sensor, (0.0, 0.0, 9.8), ACCELEROMETER, 1e-3, (), {})
    image_dn = np.array([[0, 1, 7, 4095]], dtype=np.uint32)
    np.testing.assert_array_equal(
        frame.electrons(Part(0, 0, image_dn)), gain_e_per_dn * (image_dn.astype(float) - black_level_dn)
    )


def test_mean_square_extents_by_integration() -> None:
    """Of a disc of radius r r^2 / 4, of a square of side a a^2 / 12, on midpoints of equal areas.

    n midpoints of a side leave out 1 / n^2 of the square's value; the disc's are exact, its rings being equal in area.
    """
    n = 1000
    middle = (np.arange(n) + 0.5) / n
    square = SquareLed(id=1, position_m=(0.0, 0.0, 3.0), side_m=0.06)
    x = (middle - 0.5) * square.side_m
    assert square.mean_square_extent_m2 == pytest.approx(np.mean(x**2), rel=2 / n**2)
    assert square.half_width_m == pytest.approx(x.max(), rel=2 / n)
    disc = DiscLed(id=2, position_m=(0.0, 0.0, 3.0), radius_m=0.05)
    ring_m = disc.radius_m * np.sqrt(middle)
    x = ring_m[:, None] * np.cos(2 * np.pi * middle)
    assert disc.mean_square_extent_m2 == pytest.approx(np.mean(x**2), rel=1e-9)


def region(column: int, row: int, columns: int, rows: int) -> np.ndarray:
    return np.array([[column, row], [column + columns - 1, row + rows - 1]], dtype=np.int64)


def test_regions_may_touch_and_not_share_a_pixel() -> None:
    first = region(0, 0, 4, 4)
    for neighbour in (region(4, 0, 4, 4), region(0, 4, 4, 4), region(4, 4, 1, 1), region(-2, -2, 2, 9)):
        assert regions_problem([first, neighbour], CAMERA) is None
    for sharing in (region(3, 3, 4, 4), region(3, 0, 1, 1), region(-2, -2, 3, 3), region(1, 1, 2, 2)):
        assert "overlaps" in str(regions_problem([first, sharing], CAMERA))
        assert "overlaps" in str(regions_problem([sharing, region(20, 20, 1, 1), first], CAMERA))


def test_the_regions_of_a_frame_hold_at_most_16_sensors() -> None:
    """The sensor has 80 pixels: 1280 are allowed, in a single row as well, and not one more."""
    limit = MAX_SENSOR_AREAS * 80
    assert limit == 1280
    assert regions_problem([region(0, 0, 1280, 1)], CAMERA) is None
    assert regions_problem([region(0, 0, 1279, 1), region(0, 1, 1, 1)], CAMERA) is None
    for regions in ([region(0, 0, 1281, 1)], [region(0, 0, 1280, 1), region(0, 1, 1, 1)]):
        assert "1281 pixels" in str(regions_problem(regions, CAMERA))


def test_the_last_code_of_the_adc_is_a_digital_number() -> None:
    last = Part(0, 0, np.array([[0, 4095]], dtype=np.uint32))
    beyond = Part(0, 2, np.array([[0, 4096]], dtype=np.uint32))
    assert depth_problem([last], SENSOR) is None
    assert depth_problem([last, beyond], SENSOR) == "digital number 4096, but 12 bits end at 4095"


def test_the_region_of_a_part_is_its_first_and_last_pixel() -> None:
    """3 rows of 5 columns from row 10 and column -2 on: columns -2 to 2, rows 10 to 12."""
    assert region_of(Part(10, -2, np.zeros((3, 5), dtype=np.uint32))).tolist() == [[-2, 10], [2, 12]]


def test_ids_of_leds_have_63_bits() -> None:
    """As int64 columns hold them."""
    assert DiscLed(id=2**63 - 1, position_m=(0.0, 0.0, 3.0), radius_m=0.05).id == 2**63 - 1
    for beyond in (2**63, -1):
        with pytest.raises(ValueError, match="Input should be"):
            DiscLed(id=beyond, position_m=(0.0, 0.0, 3.0), radius_m=0.05)


def test_a_gradient_over_the_face_moves_the_centre_of_its_light() -> None:
    """L (1 + g x / a) over a disc of radius a has its centroid at g a / 4, over a square of half side a at g a / 3.

    10 % of 20 mm are 0.5 and 0.667 mm; with 0.3 mm of the position, sqrt(0.3^2 + 0.5^2) = 0.583 mm.
    """
    entry = {"id": 1, "position_m": (0.0, 0.0, 3.0), "gradient_sigma": 0.1}
    disc = DiscLed(**entry, radius_m=0.02, sigma_m=(3e-4, 3e-4, 1e-4))
    assert disc.light_sigmas_m() == pytest.approx([np.hypot(3e-4, 5e-4), np.hypot(3e-4, 5e-4), 1e-4])
    assert SquareLed(**entry, side_m=0.04).light_sigmas_m() == pytest.approx([2e-3 / 3, 2e-3 / 3, 0.0])
    assert DiscLed(id=1, position_m=(0.0, 0.0, 3.0), radius_m=0.02).light_sigmas_m().tolist() == [0.0, 0.0, 0.0]


def test_sigmas_are_in_metres_radians_and_parts() -> None:
    """Each number by itself; what is not stated is 0. The half width of a square is half its side."""
    place = {"id": 1, "position_m": (0.0, 0.0, 3.0)}
    square = SquareLed(**place, side_m=0.04, side_sigma_m=2e-3, sigma_m=(1e-3, 2e-3, 3e-3), gradient_sigma=0.1)
    assert square.sigmas().tolist() == [1e-3, 2e-3, 3e-3, 1e-3, 0.1, 0.1]
    assert DiscLed(**place, radius_m=0.02, radius_sigma_m=2e-3).sigmas().tolist() == [0, 0, 0, 2e-3, 0, 0]
    luminaire = Luminaire(**place, sigma_m=(1e-3, 2e-3, 3e-3), sigma_rotation_deg=(18.0, 36.0, 90.0))
    assert luminaire.sigmas() == pytest.approx([1e-3, 2e-3, 3e-3, np.pi / 10, np.pi / 5, np.pi / 2])
    datum = MapDatum(sigma_m=(1e-3, 2e-3, 3e-3), scale_sigma_ppm=20.0)
    assert datum.sigmas() == pytest.approx([1e-3, 2e-3, 3e-3, 2e-5])


@pytest.mark.parametrize(
    ("direction", "line", "time_us"),
    [("down", 6.5, 25.0), ("up", 1.5, -25.0), ("right", 2.25, -27.5), ("left", 7.75, 27.5)],
)
def test_the_line_and_the_time_of_a_pixel_by_hand(direction: str, line: float, time_us: float) -> None:
    """Pixel (2.25, 6.5) of a sensor of 10 columns and 8 rows, 10 us a line: relative to the middle, line 4 or 5."""
    shutter = Shutter.model_validate({"kind": "rolling", "row_time_us": 10.0, "direction": direction})
    camera = CAMERA.model_copy(update={"shutter": shutter})
    u_px, v_px = np.array([2.25]), np.array([6.5])
    assert camera.line_of(u_px, v_px) == pytest.approx([line])
    assert camera.times_s(u_px, v_px) == pytest.approx([time_us * 1e-6])
    assert CAMERA.times_s(u_px, v_px) == [0.0]
