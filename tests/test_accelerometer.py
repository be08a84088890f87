"""Accelerometers: each error term alone against its formula, over devices and over shots."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Pose, rotation_cam_world
from vlcrender.config.toml_model import check, override, read_toml
from vlcrender.core.random_keys import stream
from vlcrender.dataset.format.files import read_dataset_file
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.dataset.run.generate import generate
from vlcrender.errors import InputError
from vlcrender.sensor.accelerometer import STANDARD_GRAVITY_M_S2 as G
from vlcrender.sensor.accelerometer import Imu, TiltError

QUICKSTART = ROOT / "datasets/quickstart.toml"
HERE = (3.0, 3.0, 1.0)
LEVEL, OVER = Pose(HERE), Pose(HERE, tilt_x_deg=180.0)
TILTED = Pose(HERE, tilt_x_deg=40.0, tilt_y_deg=-25.0, yaw_deg=70.0)
FINE: dict[str, Any] = {"kind": "imu", "range_g": 2.0, "bits": 24}
STEP = 2 * 2.0 * G / 2**24
"""Of a FINE device: 2.3e-6 m/s2, so that rounding hides nothing else."""
DEVICES = 1500
FIVE_SIGMA = 5 / np.sqrt(2 * DEVICES)
"""Of the standard deviation of as many normal numbers, relative: it has a standard error of 1 / sqrt(2 n)."""


def read(device: Imu, pose: Pose = LEVEL, shot: int = 0) -> NDArray[np.float64]:
    return device.reading_m_s2(pose, stream(7, shot, "accelerometer"))


def errors_of_devices(pose: Pose, **settings: Any) -> NDArray[np.float64]:
    """Readings minus gravity, (DEVICES, 3), of devices with the same settings."""
    truth = pose.rotation @ [0.0, 0.0, G]
    return np.array([read(Imu(**FINE, **settings, serial=serial), pose) for serial in range(DEVICES)]) - truth


def test_the_tilt_error_model_is_reproducible_bit_for_bit() -> None:
    """Two normal angles of the stream, on the tilts: bit for bit, and for recipes that name no kind."""
    recipe = check(read_toml(QUICKSTART), Recipe, "quickstart")
    assert recipe.accelerometer == TiltError(error_deg=0.1)
    for shot in range(5):
        reading = recipe.accelerometer.reading_m_s2(TILTED, stream(recipe.seed, shot, "accelerometer"))
        x, y = 0.1 * stream(recipe.seed, shot, "accelerometer").standard_normal(2)
        assert np.array_equal(reading, rotation_cam_world(40.0 + x, -25.0 + y, 0.0) @ [0.0, 0.0, G])


@pytest.mark.parametrize("pose", [LEVEL, OVER, TILTED])
def test_a_part_without_errors_reads_gravity_to_half_a_step(pose: Pose) -> None:
    assert np.abs(read(Imu(**FINE), pose) - pose.rotation @ [0.0, 0.0, G]).max() <= 0.5 * STEP + 1e-14


TERMS: dict[str, tuple[dict[str, float], tuple[float, float, float]]] = {
    "bias": ({"bias_m_s2": 0.2}, (0.2, 0.2, 0.2)),
    "bias drift": ({"bias_drift_m_s2_per_k": 0.01, "temperature_c": 45.0}, (0.2, 0.2, 0.2)),
    "no drift at 25 deg C": ({"bias_drift_m_s2_per_k": 0.01}, (0.0, 0.0, 0.0)),
    "scale": ({"scale_percent": 1.0}, (0.0, 0.0, 0.01 * G)),
    "cross-axis": ({"cross_axis_percent": 1.0}, (0.01 * G, 0.01 * G, 0.0)),
    "noise": ({"noise_density_ug_rthz": 200.0, "bandwidth_hz": 400.0}, (200e-6 * G * np.sqrt(200 * np.pi),) * 3),
}


@pytest.mark.slow
@pytest.mark.parametrize("term", TERMS)
def test_each_term_alone_spreads_the_readings_of_level_devices_as_its_formula(term: str) -> None:
    """Gravity is along z: cross-axis affects x and y alone, scale z alone. Means are 0 within 5 standard errors."""
    settings, expected = TERMS[term]
    found = errors_of_devices(LEVEL, **settings)
    if term == "noise":  # of the shot, not of the device
        device = Imu(**FINE, **settings)
        found = np.array([read(device, shot=shot) for shot in range(DEVICES)]) - [0.0, 0.0, G]
    # a step's rounding adds a variance of STEP^2 / 12 at most; where it is all there is, it is less than a step
    for axis in range(3):
        spread = float(found[:, axis].std(ddof=1))
        assert abs(spread - expected[axis]) < FIVE_SIGMA * expected[axis] + STEP
        assert abs(found[:, axis].mean()) < 5 * expected[axis] / np.sqrt(DEVICES) + STEP


def test_misalignment_turns_the_reading_and_leaves_its_length() -> None:
    """A rotation vector of s on each axis turns up, z, by (s_y, -s_x): to first order, so s is small; z has no part."""
    found = errors_of_devices(LEVEL, misalignment_deg=0.2)
    for axis in (0, 1):
        assert found[:, axis].std(ddof=1) == pytest.approx(np.radians(0.2) * G, rel=FIVE_SIGMA)
    lengths = np.linalg.norm(found + [0.0, 0.0, G], axis=1)
    assert np.abs(lengths - G).max() < np.sqrt(3) / 2 * STEP
    turned = [read(Imu(**FINE, misalignment_deg=0.2, serial=s), TILTED) for s in range(3)]
    for serial, reading in enumerate(turned):  # the same rotation in another pose
        level = read(Imu(**FINE, misalignment_deg=0.2, serial=serial))
        angle = np.arccos(level @ [0, 0, 1] / np.linalg.norm(level))
        other = np.arccos(reading @ (TILTED.rotation @ [0, 0, 1]) / np.linalg.norm(reading))
        assert 0 < angle < np.radians(1.5)
        assert 0 < other < np.radians(1.5)


def test_scale_and_offset_separate_in_opposite_poses() -> None:
    """Half the sum of a level and an overturned reading is the offset, half their difference the sensitivity."""
    device = Imu(**FINE, bias_m_s2=0.2, scale_percent=1.0, cross_axis_percent=1.0, serial=3)
    up, down = read(device), read(device, OVER)
    offset = read(device.model_copy(update={"scale_percent": 0.0, "cross_axis_percent": 0.0})) - [0.0, 0.0, G]
    column = read(device.model_copy(update={"bias_m_s2": 0.0}))
    # four roundings of half a step each at most, halved
    assert np.abs((up + down) / 2 - offset).max() < STEP
    assert np.abs((up - down) / 2 - column).max() < STEP
    assert np.abs(offset).min() > 100 * STEP
    assert np.abs(column - [0.0, 0.0, G]).min() > 100 * STEP


def test_shots_share_the_device_and_not_the_noise() -> None:
    noisy = Imu(**FINE, bias_m_s2=0.2, noise_density_ug_rthz=100.0, serial=1)
    quiet = noisy.model_copy(update={"noise_density_ug_rthz": 0.0})
    readings = np.array([read(noisy, shot=shot) for shot in range(400)])
    assert len(np.unique(readings, axis=0)) == 400
    # 400 shots: their mean is the device's own reading within 5 standard errors
    assert np.abs(readings.mean(axis=0) - read(quiet)).max() < 5 * noisy.noise_m_s2 / np.sqrt(400) + STEP
    assert np.array_equal(read(quiet, shot=0), read(quiet, shot=1))
    other = read(quiet.model_copy(update={"serial": 2}))
    # the same offset on an axis within ten steps has a chance of 3e-5 an axis
    assert np.abs(other - read(quiet)).min() > 10 * STEP


def test_averaging_takes_noise_down_by_the_root_of_the_samples() -> None:
    one = Imu(**FINE, noise_density_ug_rthz=200.0)
    many = one.model_copy(update={"samples": 16})
    found = np.array([read(many, shot=shot) for shot in range(DEVICES)])
    assert found.std(axis=0, ddof=1) == pytest.approx(one.noise_m_s2 / 4, rel=FIVE_SIGMA)


def test_readings_are_whole_steps_and_saturate() -> None:
    coarse = Imu(kind="imu", range_g=2.0, bits=8)
    step = 4 * G / 256
    for tilt in np.linspace(0, 180, 37):
        pose = Pose(HERE, tilt_x_deg=float(tilt), tilt_y_deg=13.0)
        reading = read(coarse, pose)
        assert np.abs(reading / step - np.rint(reading / step)).max() < 1e-9
        assert np.abs(reading - pose.rotation @ [0, 0, G]).max() <= step / 2 + 1e-12
    # two's complement: the largest number is a step below the range, the smallest is the range itself
    narrow = Imu(kind="imu", range_g=1.0, bits=8, bias_m_s2=1.0)
    readings = np.array([read(narrow.model_copy(update={"serial": s}), p)[2] for s in range(20) for p in (LEVEL, OVER)])
    assert readings.max() == pytest.approx(G * 127 / 128, abs=1e-12)
    assert readings.min() == pytest.approx(-G, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bmi270", "lsm6dso", "icm42688p"])
def test_the_stated_error_is_the_scatter_of_tilts_over_devices(name: str) -> None:
    """Presets of real parts, each shot another device: both tilts spread by error_deg.

    The standard error is FIVE_SIGMA / 5; terms of second order (the length of the reading: 1 +- 0.02 from offset and
    scale) change a variance by their square, 4e-4, and so the spread by 2e-4.
    """
    plan = load_plan(QUICKSTART, [f"accelerometer.preset={name}", "accelerometer.temperature_c=35"])
    device = plan.recipe.accelerometer
    assert isinstance(device, Imu)
    assert 0.5 < device.error_deg < 2.0  # what Huynh & Yoo 2016, 3.3.2, call commercial: up to 2 deg
    tilts = []
    for serial in range(DEVICES):
        x, y, z = read(device.model_copy(update={"serial": serial}), shot=serial)
        tilts.append(np.degrees([np.arctan2(y, z), -np.arctan2(x, np.hypot(y, z))]))
    spread = np.std(tilts, axis=0, ddof=1)
    assert spread == pytest.approx(device.error_deg, rel=FIVE_SIGMA + 2e-4)


def test_tilt_x_of_a_tilted_device_has_the_larger_error() -> None:
    """Offset and misalignment, the same either way, at tilt_y = -60 deg: twice as much on tilt_x.

    Second order is (0.3 deg tan(60 deg))^2 = 8e-5 of a spread, far below its standard error, FIVE_SIGMA / 5.
    """
    pose = Pose(HERE, tilt_x_deg=40.0, tilt_y_deg=-60.0)
    device = Imu(**FINE, bias_m_s2=0.03, misalignment_deg=0.25)
    errors = []
    for serial in range(DEVICES):
        x, y, z = read(device.model_copy(update={"serial": serial}), pose, serial)
        errors.append(np.degrees([np.arctan2(y, z), -np.arctan2(x, np.hypot(y, z))]) - [40.0, -60.0])
    spread = np.std(errors, axis=0, ddof=1)
    assert spread == pytest.approx(np.array(device.tilt_errors_deg(pose)), rel=FIVE_SIGMA + 1e-3)
    assert device.tilt_errors_deg(LEVEL) == pytest.approx((device.error_deg, device.error_deg))
    assert TiltError(error_deg=0.3).tilt_errors_deg(pose) == (0.3, 0.3)


def test_every_term_is_in_the_stated_error() -> None:
    """In quadrature, each as an angle; the scale has no part in it at level."""
    settings: dict[str, float] = {
        "bias_m_s2": np.radians(3) * G,
        "cross_axis_percent": 100 * np.radians(4),
        "misalignment_deg": 12.0,
        "scale_percent": 5.0,
    }
    assert Imu(**FINE, **settings).error_deg == pytest.approx(13, rel=1e-6)
    rounding = Imu(kind="imu", range_g=2.0, bits=8)
    assert rounding.error_deg == pytest.approx(np.degrees(4 / 256 / np.sqrt(12)))
    drifting = Imu(**FINE, bias_drift_m_s2_per_k=0.01, temperature_c=5.0)
    assert drifting.error_deg == pytest.approx(np.degrees(0.2 / G), rel=1e-6)
    noisy = Imu(**FINE, noise_density_ug_rthz=100.0, bandwidth_hz=200.0, samples=4)
    assert noisy.error_deg == pytest.approx(np.degrees(1e-4 * np.sqrt(100 * np.pi) / 2), rel=1e-6)


REFUSED = {
    "accelerometer.error_deg=-1": ["accelerometer.error_deg = -1", "0"],
    'accelerometer={ kind = "gyroscope" }': ["accelerometer", "gyroscope", "tilt-error", "imu"],
    'accelerometer={ kind = "imu", bias_m_s2 = -0.1 }': ["accelerometer.bias_m_s2 = -0.1"],
    'accelerometer={ kind = "imu", bias_mg = 20 }': ["accelerometer.bias_mg", "did you mean bias_m_s2"],
    'accelerometer={ kind = "imu", scale_percent = nan }': ["accelerometer.scale_percent = NaN"],
    'accelerometer={ kind = "imu", bits = 9.5 }': ["accelerometer.bits = 9.5"],
    'accelerometer={ kind = "imu", bits = 4 }': ["accelerometer.bits = 4", "8"],
    'accelerometer={ kind = "imu", range_g = 0.5 }': ["accelerometer.range_g = 0.5", "1"],
    'accelerometer={ kind = "imu", bandwidth_hz = 0 }': ["accelerometer.bandwidth_hz = 0"],
    'accelerometer={ kind = "imu", samples = 0 }': ["accelerometer.samples = 0"],
    'accelerometer={ kind = "imu", serial = -1 }': ["accelerometer.serial = -1"],
    'accelerometer={ kind = "imu", error_deg = 0.1 }': ["unknown key accelerometer.error_deg", "misalignment_deg"],
    "accelerometer.bias_m_s2=0.1": ["unknown key accelerometer.bias_m_s2; allowed: error_deg, kind"],
    "accelerometer=3": ["accelerometer = 3"],
}


@pytest.mark.parametrize("assignment", REFUSED)
def test_bad_values_are_refused_by_name(assignment: str) -> None:
    with pytest.raises(InputError) as refusal:
        check(override(read_toml(QUICKSTART), [assignment]), Recipe, "recipe")
    for mention in REFUSED[assignment]:
        assert mention in str(refusal.value)


@pytest.mark.slow
def test_a_part_in_a_dataset(tmp_path: Path) -> None:
    """The reading with its errors goes to the device's table, the pose without them to the truth's."""
    part = [f"accelerometer.{key}" for key in ("preset=bmi270", "serial=4", "noise_density_ug_rthz=0")]
    plan = load_plan(QUICKSTART, [*SMALL, "poses.count=2", "sensor.noise=none", *part])
    generate(plan, tmp_path / "set")
    frames, truth = (pq.read_table(tmp_path / f"set/{name}.parquet").to_pylist() for name in ("frames", "truth"))
    for device, row in zip(frames, truth, strict=True):
        pose = Pose(tuple(row["position_m"]), row["tilt_x_deg"], row["tilt_y_deg"], row["yaw_deg"])
        assert np.allclose(np.reshape(row["R_cam_world"], (3, 3)), pose.rotation, atol=1e-12)
        alone = plan.recipe.accelerometer.reading_m_s2(pose, stream(0, 0, "any: there is no noise"))
        assert device["accelerometer_m_s2"] == pytest.approx(alone)
        assert np.abs(np.subtract(device["accelerometer_m_s2"], pose.rotation @ [0, 0, G])).max() > 0.01
    assert read_dataset_file(tmp_path / "set").accelerometer.error_deg == plan.recipe.accelerometer.error_deg


def test_an_offset_is_the_device_s_own_normal_numbers_times_its_size() -> None:
    """Of the device's stream, with their sign: another release reads the same accelerations. Rounded to half a step."""
    numbers = stream(3, 0, "imu bias").standard_normal(3)
    reading = read(Imu(**FINE, bias_m_s2=0.2, serial=3))
    assert np.abs(reading - [0.0, 0.0, G] - 0.2 * numbers).max() <= 0.5 * STEP + 1e-14
