"""Exports of images, tables and trajectories, read back by each ecosystem's own reader."""

import json
import tarfile
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pandas as pd
import pyarrow.parquet as pq
import pytest
import webdataset
from conftest import copy_of, small_plan
from evo.tools import file_interface
from export_reading import MAX_ERROR_PX, exported, true_frames
from numpy.typing import NDArray
from PIL import Image
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

import vlcrender as vr
from vlcrender.export.conventions import yaml_number
from vlcrender.export.source import Source

Pixels = NDArray[np.uint32]


def sensor_image(folder: Path, frame: int, shape: tuple[int, int]) -> tuple[Pixels, NDArray[np.bool_]]:
    """Digital numbers of a frame on the whole sensor, and which pixels were read, by OpenEXR."""
    image, is_read = np.zeros(shape, np.uint32), np.zeros(shape, np.bool_)
    with OpenEXR.File(str(folder / f"frames/{frame:06d}.exr"), separate_channels=True) as file:
        for part in file.parts:
            (left, top), (right, bottom) = part.header["dataWindow"]
            place = slice(top, bottom + 1), slice(left, right + 1)
            image[place], is_read[place] = part.channels["Y"].pixels, True
    return image, is_read


def test_png16_holds_the_digital_numbers(rendered_set: Path, tmp_path: Path) -> None:
    """Read by Pillow and by OpenCV; a full frame has no mask."""
    out = exported(rendered_set, "png16", tmp_path)
    for frame in range(3):
        dn, _ = sensor_image(rendered_set, frame, (300, 400))
        path = out / f"images/{frame:06d}.png"
        with Image.open(path) as image:
            np.testing.assert_array_equal(np.asarray(image), dn)
        by_opencv = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert by_opencv is not None
        assert by_opencv.dtype == np.uint16
        np.testing.assert_array_equal(by_opencv, dn)
        assert dn.max() > 255, "8 bits would not do"
    assert not (out / "masks").exists()
    assert json.loads((out / "export.json").read_text())["image_scale"] == 1


def test_png16_of_regions_is_0_elsewhere_and_has_masks(rig_set: Path, tmp_path: Path) -> None:
    out = exported(rig_set, "png16", tmp_path)
    for frame, shape in enumerate([(300, 400), (240, 320)] * 2):
        dn, is_read = sensor_image(rig_set, frame, shape)
        with Image.open(out / f"images/{frame:06d}.png") as image, Image.open(out / f"masks/{frame:06d}.png") as mask:
            np.testing.assert_array_equal(np.asarray(image), dn)
            np.testing.assert_array_equal(np.asarray(mask), np.where(is_read, 255, 0))
        assert 0 < is_read.mean() < 1


def test_frames_of_a_shard_have_their_own_parts(tmp_path: Path) -> None:
    regions = 'regions={ kind = "leds", margin_px = 2 }'
    assert vr.generate(small_plan("poses.count=2", regions, "files.frames_per_file=2"), tmp_path / "set")
    out = exported(tmp_path / "set", "png16", tmp_path)
    with OpenEXR.File(str(tmp_path / "set/frames/shard-000000.exr"), separate_channels=True) as file:
        for frame in range(2):
            dn = np.zeros((300, 400), np.uint32)
            for part in file.parts:
                if part.name().startswith(f"frame {frame} "):
                    (left, top), (right, bottom) = part.header["dataWindow"]
                    dn[top : bottom + 1, left : right + 1] = part.channels["Y"].pixels
            assert dn.any()
            with Image.open(out / f"images/{frame:06d}.png") as image:
                np.testing.assert_array_equal(np.asarray(image), dn)


def test_pictures_of_8_bits_are_scaled_by_what_export_json_states(rendered_set: Path, tmp_path: Path) -> None:
    out = exported(rendered_set, "nerfstudio", tmp_path)
    scale = json.loads((out / "export.json").read_text())["image_scale"]
    dn, _ = sensor_image(rendered_set, 0, (300, 400))
    with Image.open(out / "images/000000.png") as image:
        pixels = np.asarray(image).astype(np.float64)
    assert np.abs(pixels - dn * scale).max() <= 0.5
    assert scale == 255 / 4095


def test_evo_reads_the_trajectories(rig_set: Path, tmp_path: Path) -> None:
    """evo's poses are those of the camera in the world: its inverse images the LEDs' directions as ours does."""
    out = exported(rig_set, "tum", tmp_path)
    frames = true_frames(rig_set)
    for name in ("main", "left"):
        trajectory = file_interface.read_tum_trajectory_file(str(out / f"{name}.txt"))
        own = [frame for frame in frames if frame.camera == name]
        np.testing.assert_array_equal(trajectory.timestamps, [0.0, 1.0])  # without a clock: numbers of the shots
        valid, details = trajectory.check()
        assert valid, details
        for pose, frame in zip(trajectory.poses_se3, own, strict=True):
            # A unit quaternion and its matrix round to some 1e-16 each.
            np.testing.assert_allclose(pose[:3, :3], frame.R_cam_world.T, rtol=0, atol=1e-14)
            np.testing.assert_array_equal(pose[:3, 3], frame.position_m)


def test_times_of_a_trajectory_are_those_of_the_middle_of_frames(tmp_path: Path) -> None:
    burst = ("burst={ frames = 2, frame_rate_hz = 30.0 }", 'regions={ kind = "leds", margin_px = 2 }')
    shutter = 'camera.shutter={ kind = "rolling", row_time_us = 20.0 }'
    assert vr.generate(small_plan("poses.count=1", *burst, shutter), tmp_path / "set")
    trajectory = file_interface.read_tum_trajectory_file(str(exported(tmp_path / "set", "tum", tmp_path) / "main.txt"))
    starts = pq.read_table(tmp_path / "set/frames.parquet").column("start_s").to_numpy()
    # 299 rows of 20 us to the last one, whose middle is 0.8 us later; times are written to 1 ns.
    np.testing.assert_allclose(trajectory.timestamps - starts, 149.5 * 20e-6 + 0.8e-6, rtol=0, atol=1e-9)


def test_pandas_reads_the_csv_tables(rig_set: Path, tmp_path: Path) -> None:
    """Numbers are the doubles of the Parquet tables, and image the LEDs where our projection does."""
    out = exported(rig_set, "csv", tmp_path)
    truth, leds, points, cameras = (
        pd.read_csv(out / f"{name}.csv") for name in ("truth", "truth_leds", "true_leds", "cameras")
    )
    for frame in true_frames(rig_set):
        row = truth.iloc[frame.frame]
        assert row[["position_m_x", "position_m_y", "position_m_z"]].tolist() == frame.position_m.tolist()
        rotation = row[[f"R_cam_world_{i}{j}" for i in range(3) for j in range(3)]].to_numpy(float).reshape(3, 3)
        np.testing.assert_array_equal(rotation, frame.R_cam_world)
        own = leds[leds.frame == frame.frame]
        assert own.led.tolist() == frame.led
        world = points.set_index("led").loc[own.led, ["position_m_x", "position_m_y", "position_m_z"]].to_numpy()
        matrix = row[[f"K_{i}{j}" for i in range(3) for j in range(3)]].to_numpy(float).reshape(3, 3)
        k1, k2, k3, p1, p2 = (
            0.0 if np.isnan(row[f"distortion_{name}"]) else row[f"distortion_{name}"]
            for name in ("k1", "k2", "k3", "p1", "p2")
        )
        turn, move = cv2.Rodrigues(rotation)[0], -rotation @ frame.position_m
        pixels, _ = cv2.projectPoints(world, turn, move, matrix, np.array([k1, k2, p1, p2, k3]))
        assert np.abs(pixels.reshape(-1, 2) - own[["u_px", "v_px"]].to_numpy()).max() < MAX_ERROR_PX
    frames = pd.read_csv(out / "frames.csv")
    parquet = pq.read_table(rig_set / "frames.parquet").to_pylist()
    assert frames.accelerometer_m_s2_z.tolist() == [row["accelerometer_m_s2"][2] for row in parquet]
    assert cameras.camera.tolist() == ["main", "left"]
    spots = pd.read_csv(out / "spots.csv")
    assert spots.u_px.tolist() == [spot["u_px"] for row in parquet for spot in row["spots"]]


def test_webdataset_decodes_images_and_truth(rig_set: Path, tmp_path: Path) -> None:
    out = exported(rig_set, "webdataset", tmp_path)
    samples = list(webdataset.WebDataset(str(out / "frames-000000.tar"), shardshuffle=False).decode())
    truth = pq.read_table(rig_set / "truth.parquet").to_pylist()
    assert [sample["__key__"] for sample in samples] == [f"{frame:06d}" for frame in range(4)]
    for frame, sample in enumerate(samples):
        dn, is_read = sensor_image(rig_set, frame, sample["npz"]["image"].shape)
        np.testing.assert_array_equal(sample["npz"]["image"], dn)
        np.testing.assert_array_equal(sample["npz"]["is_read"], is_read)
        assert sample["truth.json"]["position_m"] == truth[frame]["position_m"]
        assert sample["json"]["camera"] == ("main", "left")[frame % 2]
    assert "provenance" not in json.loads((out / "description.json").read_text())


def test_shards_of_webdataset_are_the_same_bytes_each_time(rig_set: Path, tmp_path: Path) -> None:
    one, two = (exported(rig_set, "webdataset", tmp_path, name) / "frames-000000.tar" for name in ("one", "two"))
    assert one.read_bytes() == two.read_bytes()
    with tarfile.open(one) as tar:
        assert {(member.mtime, member.uid, member.uname) for member in tar} == {(0, 0, "")}


def test_a_full_shard_is_followed_by_another(rig_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vlcrender.export.webdataset.FRAMES_PER_SHARD", 3)
    out = exported(rig_set, "webdataset", tmp_path)
    keys = [
        [sample["__key__"] for sample in webdataset.WebDataset(str(path), shardshuffle=False)]
        for path in sorted(out.glob("*.tar"))
    ]
    assert keys == [["000000", "000001", "000002"], ["000003"]]


def test_rosbags_reads_images_cameras_and_poses(rig_set: Path, tmp_path: Path) -> None:
    """camera_info, /tf_static and true poses image the LEDs where our projection does."""
    out = exported(rig_set, "rosbag2", tmp_path)
    messages: dict[str, list[object]] = {}
    with AnyReader([out / "bag"]) as bag:
        for connection, stamp_ns, raw in bag.messages():
            message = bag.deserialize(raw, connection.msgtype)
            messages.setdefault(connection.topic, []).append(message)
            if connection.topic != "/tf_static":
                stamp = message.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == stamp_ns
                assert stamp_ns > 0
    topics = {f"/{camera}/{topic}" for camera in ("main", "left") for topic in ("image_raw", "camera_info", "imu")}
    assert set(messages) == topics | {"/tf_static", "/main/true_pose", "/left/true_pose"}
    frames = true_frames(rig_set)
    parquet = pq.read_table(rig_set / "frames.parquet").to_pylist()
    for number, frame in enumerate(frames):
        image, info, imu, pose = (
            messages[f"/{frame.camera}/{topic}"][number // 2]
            for topic in ("image_raw", "camera_info", "imu", "true_pose")
        )
        dn, _ = sensor_image(rig_set, number, (image.height, image.width))
        assert (image.encoding, image.is_bigendian, image.step) == ("mono16", 0, 2 * image.width)
        np.testing.assert_array_equal(image.data.view("<u2").reshape(image.height, image.width), dn)
        where, turned = pose.pose.position, pose.pose.orientation
        world_cam = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w]).as_matrix()
        points = (frame.world_m - [where.x, where.y, where.z]) @ world_cam
        zero = np.zeros(3)
        pixels, _ = cv2.projectPoints(points, zero, zero, info.k.reshape(3, 3), info.d)
        assert np.abs(pixels.reshape(-1, 2) + 0.5 - frame.pixels).max() < MAX_ERROR_PX
        assert info.distortion_model == "plumb_bob"
        force = imu.linear_acceleration
        assert [force.x, force.y, force.z] == parquet[number]["accelerometer_m_s2"]
        assert imu.angular_velocity_covariance[0] == -1, "no gyroscope"
        assert imu.header.frame_id == image.header.frame_id == f"{frame.camera}_optical_frame"
    (transform,) = messages["/tf_static"][0].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("main_optical_frame", "left_optical_frame")
    moved = transform.transform.translation
    main, left = frames[:2]
    # Metres in a room of 7 m, once through a quaternion: rounding is below 1e-14.
    mounted = main.position_m + main.R_cam_world.T @ [moved.x, moved.y, moved.z]
    np.testing.assert_allclose(mounted, left.position_m, rtol=0, atol=1e-13)
    turn = transform.transform.rotation
    main_left = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    np.testing.assert_allclose(main.R_cam_world.T @ main_left, left.R_cam_world.T, rtol=0, atol=1e-14)


def test_rolling_shutters_on_moving_rigs_have_no_single_pose(tmp_path: Path) -> None:
    shutter = 'camera.shutter={ kind = "rolling", row_time_us = 20.0 }'
    motion = "motion={ angular_velocity_deg_s = [0.0, 0.0, 10.0], linear_velocity_m_s = [0.1, 0.0, 0.0] }"
    regions = 'regions={ kind = "leds", margin_px = 2 }'
    assert vr.generate(small_plan("poses.count=1", shutter, motion, regions), tmp_path / "set")
    for to in ("colmap", "nerfstudio", "bop"):
        with pytest.raises(vr.InputError, match=f"{to}: camera main has a rolling shutter and moves"):
            vr.export_dataset(tmp_path / "set", to, tmp_path / to)
    exported(tmp_path / "set", "tum", tmp_path)


@pytest.mark.parametrize("to", ["csv", "tum", "colmap", "nerfstudio", "bop"])
def test_a_truth_that_is_withheld_or_missing_is_refused_by_name(rig_set: Path, tmp_path: Path, to: str) -> None:
    folder = copy_of(rig_set, tmp_path / "set")
    (folder / "truth.parquet").unlink()
    with pytest.raises(vr.InputError, match=f"has no truth.parquet; {to} needs it"):
        vr.export_dataset(folder, to, tmp_path / "out")
    tree = json.loads((folder / "dataset.json").read_text())
    tree["withheld"] = {"sha256": "0" * 64, "frames": "all"}
    (folder / "dataset.json").write_text(json.dumps(tree))
    with pytest.raises(vr.InputError, match=f"its truth is withheld; {to} holds the truth"):
        vr.export_dataset(folder, to, tmp_path / "out")


@pytest.mark.parametrize("to", ["webdataset", "rosbag2"])
def test_without_truth_the_other_content_is_exported(rig_set: Path, tmp_path: Path, to: str) -> None:
    """The bytes of no coordinate of any true position are in a file."""
    folder = copy_of(rig_set, tmp_path / "set")
    (folder / "truth.parquet").unlink()
    out = exported(folder, to, tmp_path)
    assert json.loads((out / "export.json").read_text())["truth"] is False
    content = b"".join(path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file())
    for frame in true_frames(rig_set):
        for number in frame.position_m:
            assert np.float64(number).tobytes() not in content
            assert repr(float(number)).encode() not in content


def test_a_damaged_frame_ends_the_export_and_leaves_nothing(rig_set: Path, tmp_path: Path) -> None:
    folder = copy_of(rig_set, tmp_path / "set")
    path = folder / "frames/000002.exr"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(vr.InputError, match=r"000002\.exr: is missing or damaged"):
        vr.export_dataset(folder, "png16", tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_numbers_beyond_16_bits_are_refused(rig_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Source.image

    def brighter(source: Source, row: object) -> object:
        image = whole(source, row)  # type: ignore[arg-type]
        image.dn[0, 0] = 65536
        return image

    monkeypatch.setattr(Source, "image", brighter)
    with pytest.raises(vr.InputError, match="png16: frame 0 has the digital number 65536; 16 bits end at 65535"):
        vr.export_dataset(rig_set, "png16", tmp_path / "out")


def test_an_out_that_is_no_new_folder_is_refused(rig_set: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").touch()
    for out, message in (
        (tmp_path / "full", "exists; nothing was changed"),
        (tmp_path / "none/out", "there is no folder"),
        (rig_set / "out", "lies in the dataset"),
    ):
        with pytest.raises(vr.InputError, match=message):
            vr.export_dataset(rig_set, "tum", out)
    with pytest.raises(vr.InputError, match="--to xml: has to be one of png16, csv, tum"):
        vr.export_dataset(rig_set, "xml", tmp_path / "out")
    (tmp_path / "empty").mkdir()
    assert vr.export_dataset(rig_set, "tum", tmp_path / "empty") == 4


@pytest.mark.parametrize("number", [1e-5, -2e-20, 1e22, 0.1, -3.0, 1.5e-7])
def test_a_yaml_number_is_one_for_yaml_1_1(number: float) -> None:
    """PyYAML takes 1e-05 for text."""
    yaml = pytest.importorskip("yaml")
    assert yaml.safe_load(f"[{yaml_number(number)}]") == [number]


def test_a_mosaic_has_its_name_in_a_bag(rig_set: Path, tmp_path: Path) -> None:
    folder = copy_of(rig_set, tmp_path / "set")
    tree = json.loads((folder / "dataset.json").read_text())
    tree["sensor"]["mosaic"] = "rggb"
    (folder / "dataset.json").write_text(json.dumps(tree))
    with AnyReader([exported(folder, "rosbag2", tmp_path) / "bag"]) as bag:
        connections = [one for one in bag.connections if one.topic == "/main/image_raw"]
        (_, _, raw), *_ = bag.messages(connections)
        assert bag.deserialize(raw, connections[0].msgtype).encoding == "bayer_rggb16"


def test_regions_beyond_the_sensor_have_no_image(rig_set: Path) -> None:
    source = Source.open(rig_set, "png16", False)
    row = source.frames[0].model_copy(update={"capturable": False})
    with pytest.raises(vr.InputError, match="png16: frame 0 has regions beyond the sensor"):
        source.image(row)
