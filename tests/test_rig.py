"""Rigs: poses of the cameras, frames of one shot, and the accelerometer reading of each camera."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL
from hypothesis import given
from hypothesis import strategies as st

from estimator.evaluate.batch import estimate_dataset
from estimator.io.dataset import read_dataset
from estimator.methods.catalogue import VARIANTS
from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.rig import pose_of
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run.generate import generate
from vlcrender.dataset.verify.verify import verify

angles = st.floats(-179, 179)


@given(angles, st.floats(-90, 90), angles)
def test_pose_of_inverts_rotation(tilt_x: float, tilt_y: float, yaw: float) -> None:
    rotation = Pose((1, 2, 3), tilt_x, tilt_y, yaw).rotation
    again = pose_of(np.array([1.0, 2.0, 3.0]), rotation)
    assert again.position_m == (1, 2, 3)
    # near gimbal lock the angles lose 1e-16 / GIMBAL_LOCK, the rotation does not
    assert np.abs(again.rotation - rotation).max() < 1e-8


RIG = (
    'rig=[{ name = "right", offset_m = [0.1, 0.0, 0.0] }, '
    '{ name = "aside", offset_m = [0.0, 0.02, 0.01], yaw_deg = 90 }]'
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("rig") / "set"
    tilts = ["poses.tilt_x_deg=[0, 20]", "poses.tilt_y_deg=[0, 20]", "poses.min_leds=12", "accelerometer.error_deg=1"]
    generate(load_plan(ROOT / "datasets/quickstart.toml", [*SMALL, *tilts, "poses.count=2", RIG]), directory)
    return directory


def test_a_shot_is_a_row_for_each_camera(made: Path) -> None:
    assert verify(made) == []
    for table in ("frames.parquet", "truth.parquet"):
        rows = pq.read_table(made / table).to_pylist()
        assert [(row["frame"], row["shot"]) for row in rows] == [(i, i // 3) for i in range(6)]
    frames = pq.read_table(made / "frames.parquet").to_pylist()
    assert [row["camera"] for row in frames] == ["main", "right", "aside"] * 2


def test_truth_agrees_with_the_mounting(made: Path) -> None:
    """p_cam = R_cam_rig (p_rig - offset), by FORMAT.md alone."""
    cameras = json.loads((made / "dataset.json").read_text())["cameras"]
    frames = pq.read_table(made / "frames.parquet").to_pylist()
    truth = pq.read_table(made / "truth.parquet").to_pylist()
    point = np.array([3.0, 3.0, 3.4])
    for device, row in zip(frames, truth, strict=True):
        main = truth[3 * row["shot"]]
        in_rig = np.array(main["R_cam_world"]).reshape(3, 3) @ (point - main["position_m"])
        mounting = cameras[device["camera"]]
        in_camera = np.array(mounting["R_cam_rig"]) @ (in_rig - mounting["offset_m"])
        expected = np.array(row["R_cam_world"]).reshape(3, 3) @ (point - row["position_m"])
        assert in_camera == pytest.approx(expected, abs=1e-9)


def test_the_second_camera_has_the_disparity(made: Path) -> None:
    """f b / z: a camera 0.1 m to the right has each LED further left by 1500 px * 0.1 m / depth."""
    truth = pq.read_table(made / "truth.parquet").to_pylist()
    leds = {led["id"]: led["position_m"] for led in json.loads((made / "dataset.json").read_text())["led_map"]}
    for main, right in ((truth[0], truth[1]), (truth[3], truth[4])):
        there = {led["led"]: led for led in right["leds"]}
        shared = [(led, there[led["led"]]) for led in main["leds"] if led["led"] in there]
        assert shared
        for one, other in shared:
            depth = np.array(main["R_cam_world"]).reshape(3, 3)[2] @ np.subtract(leds[one["led"]], main["position_m"])
            assert one["u_px"] - other["u_px"] == pytest.approx(1500 * 0.1 / depth)
            assert one["v_px"] == pytest.approx(other["v_px"])


def test_a_shot_has_one_reading_in_the_axes_of_each_camera(made: Path) -> None:
    cameras = json.loads((made / "dataset.json").read_text())["cameras"]
    frames = pq.read_table(made / "frames.parquet").to_pylist()
    for row in frames:
        main = frames[3 * row["shot"]]["accelerometer_m_s2"]
        turned = np.array(cameras[row["camera"]]["R_cam_rig"]) @ main
        assert row["accelerometer_m_s2"] == pytest.approx(turned, abs=1e-12)


def test_each_frame_is_estimated_by_itself(made: Path) -> None:
    """PnP, which gravity cannot mislead: each camera estimates its own position, 0.02 px of 1500 px: millimetres."""
    rows = estimate_dataset(read_dataset(made), [VARIANTS["pnp"]], on_frame=lambda: None)["pnp"]
    truth = pq.read_table(made / "truth.parquet").to_pylist()
    found = [(row.position_m, true["position_m"]) for row, true in zip(rows, truth, strict=True) if row.position_m]
    assert len(found) >= 4
    assert max(np.linalg.norm(np.subtract(a, b)) for a, b in found) < 0.02


@pytest.mark.parametrize("tilt_y", [90.0, -90.0])
def test_pose_of_a_camera_in_gimbal_lock_has_its_rotation(tilt_y: float, rng: np.random.Generator) -> None:
    """Turned back and forth, so that the numbers that are 0 in gimbal lock hold the rounding of products, 1e-16."""
    for tilt_x, yaw, *turn in rng.uniform(-170, 170, (20, 5)):
        mount = Pose((0, 0, 0), *turn).rotation
        rotation = mount @ (mount.T @ Pose((0, 0, 0), tilt_x, tilt_y, yaw).rotation)
        # as above: angles near gimbal lock lose 1e-16 / GIMBAL_LOCK at most
        assert np.abs(pose_of(np.zeros(3), rotation).rotation - rotation).max() < 1e-7
