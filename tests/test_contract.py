"""The format as a contract: one package writes it, the other reads it, and both agree on its meaning."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL

from estimator.camera.leveling import level, tilt_from_gravity
from estimator.camera.pose import rotation
from estimator.camera.undistort import MAX_FIELD_ANGLE_DEG, pinhole_pixels
from estimator.io.dataset import Camera as DeviceCamera
from estimator.io.dataset import DeviceFrame, read_dataset, read_frame
from estimator.methods.catalogue import VARIANTS
from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import mounted_cameras
from vlcrender.core.random_keys import stream
from vlcrender.dataset.format.schema import camera_entry
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run.generate import generate
from vlcrender.sensor.accelerometer import TiltError


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("contract") / "set"
    plan = load_plan(
        ROOT / "datasets/quickstart.toml",
        [*SMALL, "poses.count=2", "camera.skew_px=3.0", "camera.principal_point_px=[190.0, 160.0]"],
    )
    generate(plan, out)
    return out


def device_frames(directory: Path) -> list[DeviceFrame]:
    dataset = read_dataset(directory)
    return [read_frame(dataset, record) for record in dataset.frames]


def test_the_reader_sees_what_the_writer_wrote(directory: Path) -> None:
    rows = pq.read_table(directory / "frames.parquet").to_pylist()
    tree = json.loads((directory / "dataset.json").read_text())
    assert tree["cameras"]["main"]["K"] == [[1500.0, 3.0, 190.0], [0.0, 1500.0, 160.0], [0.0, 0.0, 1.0]]
    for row, frame in zip(rows, device_frames(directory), strict=True):
        assert frame.camera.matrix().tolist() == tree["cameras"]["main"]["K"]
        assert list(frame.accelerometer_m_s2) == row["accelerometer_m_s2"]
        assert frame.parts[0].image_dn.shape == (300, 400)
        assert [(s.led, s.u_px, s.v_px) for s in frame.spots] == [
            (s["led"], s["u_px"], s["v_px"]) for s in row["spots"]
        ]


def test_the_brightest_pixels_are_at_the_decoded_spots(directory: Path) -> None:
    """Row, column, u and v are the same way round in both packages: the images of LEDs are where the table says."""
    truth = pq.read_table(directory / "truth.parquet").to_pylist()
    for frame, row in zip(device_frames(directory), truth, strict=True):
        whole = [led for led in row["leds"] if led["visible_fraction"] == 1]
        for led in whole:
            image = frame.parts[0].image_dn
            assert image[int(led["v_px"]), int(led["u_px"])] > 10 * np.median(image)


@pytest.mark.parametrize("tilts", [(0.0, 0.0), (30.0, 0.0), (0.0, 45.0), (60.0, 60.0), (-20.0, 35.0)])
def test_a_gravity_reading_levels_the_pixels_that_the_pose_tilted(tilts: tuple[float, float]) -> None:
    """One package projects under a tilt, the other inverts it by gravity: the level view, turned by yaw."""
    camera = Camera()
    pose = Pose((3.0, 3.0, 1.0), *tilts, yaw_deg=25.0)
    axis = pose.rotation[2]
    aim = np.array(pose.position_m) + axis * 2.45 / axis[2]
    leds = aim + np.array([[0, 0, 0], [0.13, 0, 0], [0, 0.13, 0], [-0.13, 0.26, 0]])
    seen = PosedCamera(camera, pose).project(leds)
    reading = TiltError(error_deg=0.0).reading_m_s2(pose, stream(0, 0, "none"))
    leveled = level(seen, camera.matrix, rotation(*tilt_from_gravity(tuple(reading))))
    expected = PosedCamera(camera, Pose(pose.position_m, yaw_deg=25.0)).project(leds)
    # double precision; the horizon is near at 75.5 deg from the zenith: pixels of 1e5, so 1e5 * 1e-15 * amplification
    assert np.abs(leveled - expected).max() < 1e-6


def test_a_hand_computed_point() -> None:
    """Camera at (1, 2, 0.5), level, LED at (1.3, 1.8, 3.5): 0.3/3 * 15000 = 1500 right of and 1000 above the centre."""
    posed, point = PosedCamera(Camera(), Pose((1.0, 2.0, 0.5))), np.array([1.3, 1.8, 3.5])
    pixels, depth = posed.project(point), posed.camera_coordinates(point)[2]
    assert depth == pytest.approx(3.0)
    assert pixels == pytest.approx([3500.0, 500.0])


@pytest.mark.slow
def test_regions_are_read_at_their_place_and_give_the_same_positions(tmp_path: Path) -> None:
    # Moderate tilts, at which LED images do not merge: which merged images are separated depends on single electrons.
    tilts = ["poses.tilt_x_deg=[0, 25]", "poses.tilt_y_deg=[0, 25]", "poses.height_m=[0.9, 1.8]"]
    base = [*SMALL, *tilts, "poses.count=2", "sensor.noise=none", "poses.border_px=20"]
    for name, more in (("full", []), ("regions", ['regions={ kind = "leds", margin_px = 20 }'])):
        generate(load_plan(ROOT / "datasets/quickstart.toml", [*base, *more]), tmp_path / name)
    for whole, cut in zip(device_frames(tmp_path / "full"), device_frames(tmp_path / "regions"), strict=True):
        image = whole.parts[0].image_dn
        assert sum(part.image_dn.size for part in cut.parts) < image.size
        for part in cut.parts:
            rows, columns = part.image_dn.shape
            assert np.array_equal(image[part.row : part.row + rows, part.column : part.column + columns], part.image_dn)
        assert {spot.led for spot in cut.spots} == {spot.led for spot in whole.spots}
        for name in ("huynh2016", "pnp"):
            ours, full = (VARIANTS[name].estimate(frame).position_m for frame in (cut, whole))
            # Only the background's level differs, and with it which pixels are above half level: supports differ by
            # a few pixels of their rim, which are background, known to 1 e: 3 * 1 e * 12 px / 60 000 e = 6e-4 px,
            # 1 um on the ceiling, which the distance over the pattern makes some 50.
            assert np.linalg.norm(ours - full) < 5e-5


@pytest.mark.slow
def test_regions_beyond_the_sensor_give_the_position(tmp_path: Path) -> None:
    """Table 1's four LEDs, up to 6 m beside the axis; noise-free, level, exact gravity: discs have no ellipses' offset.

    Three LEDs stand on one line and span 0.6 m. Rounding and cos^4 leave 0.01 px of 1500, 7e-6 rad; a distance d is
    wrong by 7e-6 d^2 / 0.14 m for the nearest pair, 3 mm at 8 m, and the fourth LED is 0.1 m beside the line of the
    others, which makes across it some 20 times as much of it.
    """
    exact = ["sensor.noise=none", "accelerometer.error_deg=0", "poses.columns=3", "poses.rows=3"]
    generate(load_plan(ROOT / "datasets/table1.toml", [*SMALL[:4], *exact]), tmp_path / "set")
    truth = pq.read_table(tmp_path / "set/truth.parquet").to_pylist()
    for frame, row in zip(device_frames(tmp_path / "set"), truth, strict=True):
        estimate = VARIANTS["huynh2016"].estimate(frame)
        assert np.linalg.norm(estimate.position_m - row["position_m"]) < 0.07
        assert len(frame.spots) == 4


LENSES = [
    Distortion(k1=-0.05),
    Distortion(k1=-1.0, k2=0.4, k3=-3.0, p1=0.02, p2=-0.03),
    Distortion(k1=0.8, p1=-0.05),
    Distortion(p2=0.04),
]


def as_told(camera: Camera) -> DeviceCamera:
    """A camera as the estimator reads it from dataset.json."""
    (mounted,) = mounted_cameras(camera, ())
    return DeviceCamera.model_validate_json(camera_entry(mounted).model_dump_json())


@pytest.mark.parametrize("lens", LENSES)
def test_one_package_inverts_the_distortion_of_the_other(lens: Distortion) -> None:
    bent = Camera(distortion=lens, skew_px=30.0, principal_point_px=(1900.0, 1600.0), focus_distance_m=2.0)
    x, y = np.meshgrid(np.linspace(-0.12, 0.12, 25), np.linspace(-0.09, 0.09, 19))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    straight = bent.model_copy(update={"distortion": None}).image_of_points(rays)
    seen = bent.image_of_points(rays)
    assert np.abs(seen - straight).max() > 1
    assert np.abs(pinhole_pixels(seen, as_told(bent)) - straight).max() < 1e-6


def test_one_package_inverts_the_fish_eye_of_the_other() -> None:
    fish_eye = Camera(projection="equidistant", width_px=800, height_px=600, pixel_pitch_um=60.0, skew_px=2.0)
    theta, around = np.meshgrid(
        np.radians(np.linspace(0, MAX_FIELD_ANGLE_DEG - 0.1, 30)), np.radians(np.arange(0, 360, 15))
    )
    rays = np.stack([np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)], -1).reshape(-1, 3)
    straight = fish_eye.model_copy(update={"projection": "perspective"}).image_of_points(rays)
    found = pinhole_pixels(fish_eye.image_of_points(rays), as_told(fish_eye))
    assert np.abs(found - straight).max() < 1e-6


def median_errors_m(directory: Path) -> dict[str, float]:
    truth = np.array(pq.read_table(directory / "truth.parquet")["position_m"].to_pylist())
    frames = device_frames(directory)
    return {
        name: float(
            np.median(
                [np.linalg.norm(VARIANTS[name].estimate(f).position_m - p) for f, p in zip(frames, truth, strict=True)]
            )
        )
        for name in ("huynh2016", "pnp")
    }


@pytest.mark.slow
def test_a_distorted_set_is_estimated_as_well_as_a_straight_one(tmp_path: Path) -> None:
    """Nearly the same poses through a lens that moves image points at the corners, 250 px off the centre, by 7 px.

    Taking it out stretches an error at the corner by 1 / (1 - 3 |k1| r^2) = 1.09 and moves the centroid of a disc of
    5 px by 4 |k1| r (5 / 1500)^2 / 4 = 2e-6, 0.003 px, below the shot noise of some 0.01 px. What remains is other
    noise of the same size, and medians of five such errors: within 3 times. Left in, the lens costs pixels.
    """
    base = [*SMALL, "poses.count=5", "accelerometer.error_deg=0"]
    bent = ["camera.distortion={ k1 = -1.0, p1 = 0.02, p2 = -0.03 }"]
    for name, more in (("straight", []), ("bent", bent)):
        generate(load_plan(ROOT / "datasets/quickstart.toml", [*base, *more]), tmp_path / name)
    poses = [
        pq.read_table(tmp_path / name / "truth.parquet")["position_m"].to_pylist() for name in ("straight", "bent")
    ]
    # A pose images its target at a pixel drawn at random: the lens turns that into 7 px or less, at 3 m 14 mm.
    assert np.abs(np.subtract(*poses)).max() < 7 / 1500 * 3.0
    assert poses[0] != poses[1]
    straight, found = median_errors_m(tmp_path / "straight"), median_errors_m(tmp_path / "bent")
    path = tmp_path / "bent/dataset.json"
    told = json.loads(path.read_text())
    wrong = []
    for sign in (0, -1):
        lens = {key: sign * value for key, value in told["cameras"]["main"]["distortion"].items()}
        main = {**told["cameras"]["main"], "distortion": lens if sign else None}
        path.write_text(json.dumps({**told, "cameras": {"main": main}}))
        wrong.append(median_errors_m(tmp_path / "bent"))
    for name in straight:
        assert found[name] < 3 * straight[name]
        assert wrong[1][name] > wrong[0][name] > 10 * found[name]


@pytest.mark.slow
def test_a_fish_eye_set_is_estimated(tmp_path: Path) -> None:
    """500 px a radian, dozens of LEDs: 0.02 px over a pattern some 300 px wide, on 3 m, are well below 2 mm."""
    fish_eye = ["camera.projection=equidistant", "camera.pixel_pitch_um=36.0", "exposure_s=1.8e-7"]
    tilts = ["poses.tilt_x_deg=[0, 30]", "poses.tilt_y_deg=[0, 30]", "accelerometer.error_deg=0", "poses.count=3"]
    generate(load_plan(ROOT / "datasets/quickstart.toml", [*SMALL, *fish_eye, *tilts]), tmp_path / "set")
    assert max(median_errors_m(tmp_path / "set").values()) < 2e-3
