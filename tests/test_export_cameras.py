"""Exports with cameras: each ecosystem's own reader images the LED centres where our projection does."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import yaml
from conftest import copy_of, small_plan, unchanged
from export_reading import MAX_ERROR_PX, TrueFrame, exported, true_frames
from numpy.typing import NDArray
from PIL import Image

import vlcrender as vr
from vlcrender.export.source import Source

Array = NDArray[np.float64]
FISHEYE = 'camera.projection="equidistant"', "camera.focal_length_mm=3.0", "poses.count=1"
"""57 deg off the axis in the corners."""


@pytest.fixture(scope="module")
def wide_set(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """One shot: `main` is a fish-eye, `other` has a distortion with k3."""
    distortion = "{ k1 = -0.05, k2 = 0.01, k3 = 0.3, p1 = 1e-5, p2 = -2e-4 }"
    camera = f"{{ width_px = 320, height_px = 240, pixel_pitch_um = 12.0, distortion = {distortion} }}"
    other = f'[{{ name = "other", offset_m = [0.1, 0.0, 0.0], camera = {camera} }}]'
    folder = tmp_path_factory.mktemp("wide") / "set"
    assert vr.generate(small_plan(*FISHEYE, f"rig={other}"), folder)
    with unchanged(folder):
        yield folder


@pytest.fixture(scope="module")
def belief_set(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two devices in two maps: true cameras and LEDs differ from the told ones."""
    belief = ("belief.preset=calibrated", "belief.devices=2", "belief.maps=2")
    folder = tmp_path_factory.mktemp("belief") / "set"
    assert vr.generate(small_plan(*FISHEYE, "poses.count=2", *belief), folder)
    with unchanged(folder):
        yield folder


def worst_px(found: Array, frame: TrueFrame) -> float:
    """Largest distance from our own projection; NaN counts as infinite."""
    return float(np.nan_to_num(np.abs(found - frame.pixels), nan=np.inf).max())


def by_opencv(points_cam: Array, matrix: Array, coefficients: Sequence[float], fisheye: bool) -> Array:
    """Pixel positions (n, 2) of points in camera axes by OpenCV's own projection, pixel centres at integers."""
    zero, points = np.zeros(3), points_cam.reshape(-1, 1, 3)
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    pixels, _ = project(points, zero, zero, matrix, np.array(coefficients, dtype=np.float64))
    result: Array = np.asarray(pixels).reshape(-1, 2)
    return result


def in_camera(frame: TrueFrame) -> Array:
    """LED centres (n, 3) in the axes of the frame's camera."""
    result: Array = (frame.world_m - frame.position_m) @ frame.R_cam_world.T
    return result


@pytest.mark.parametrize("which", ["rendered_set", "rig_set", "wide_set", "belief_set"])
def test_pycolmap_reads_the_model_and_projects_leds_to_the_same_pixels(
    which: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    folder = request.getfixturevalue(which)
    out = exported(folder, "colmap", tmp_path)
    model = pycolmap.Reconstruction(out / "sparse/0")
    frames = true_frames(folder)
    assert model.num_images() == len(frames)
    stride = int(json.loads((out / "export.json").read_text())["point3d_id"].split("*")[1].split("+")[0])
    for frame in frames:
        image = model.images[frame.frame + 1]
        camera = model.cameras[image.camera_id]
        points = [model.points3D[point.point3D_id] for point in image.points2D]
        assert [divmod(point.point3D_id, stride) for point in image.points2D] == [(frame.map, n) for n in frame.led]
        np.testing.assert_array_equal([point.xyz for point in points], frame.world_m)
        np.testing.assert_array_equal([point.xy for point in image.points2D], frame.pixels)
        projected = [camera.img_from_cam(image.cam_from_world() * point.xyz) for point in points]
        assert worst_px(np.array(projected), frame) < MAX_ERROR_PX
        bitmap = pycolmap.Bitmap.read(str(out / "images" / image.name), as_rgb=False)
        assert (bitmap.width, bitmap.height) == (camera.width, camera.height)


def test_colmap_names_the_model_that_has_the_coefficients(wide_set: Path, rig_set: Path, tmp_path: Path) -> None:
    models = {}
    for folder in (wide_set, rig_set):
        out = exported(folder, "colmap", tmp_path, folder.parent.name)
        models[folder] = [line.split()[1] for line in (out / "sparse/0/cameras.txt").read_text().splitlines()]
    assert models == {wide_set: ["OPENCV_FISHEYE", "FULL_OPENCV"], rig_set: ["PINHOLE", "OPENCV"]}


@pytest.mark.parametrize("which", ["rig_set", "belief_set"])
def test_transforms_json_projects_leds_to_the_same_pixels(
    which: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """Camera-to-world with y up and z backward; OpenCV projects after half a pixel, as nerfstudio undistorts."""
    folder = request.getfixturevalue(which)
    out = exported(folder, "nerfstudio", tmp_path)
    tree = json.loads((out / "transforms.json").read_text())
    fisheye = tree["camera_model"] == "OPENCV_FISHEYE"
    assert fisheye == (which == "belief_set")
    for entry, frame in zip(tree["frames"], true_frames(folder), strict=True):
        world_opengl = np.linalg.inv(entry["transform_matrix"])
        points = frame.world_m @ world_opengl[:3, :3].T + world_opengl[:3, 3]
        assert (points[:, 2] < 0).all(), "LEDs lie before the camera, which looks along -z"
        matrix = np.array([[entry["fl_x"], 0, entry["cx"] - 0.5], [0, entry["fl_y"], entry["cy"] - 0.5], [0, 0, 1]])
        keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
        pixels = by_opencv(points * [1, -1, -1], matrix, [entry[key] for key in keys], fisheye)
        assert worst_px(pixels + 0.5, frame) < MAX_ERROR_PX
        with Image.open(out / entry["file_path"]) as image:
            assert (image.mode, image.size) == ("L", (entry["w"], entry["h"]))
        assert ("mask_path" in entry) == (which == "rig_set")


def test_bop_projects_the_origins_of_models_to_the_same_pixels(rendered_set: Path, tmp_path: Path) -> None:
    """Millimetres, rotations row by row, pixel centres at integers."""
    out = exported(rendered_set, "bop", tmp_path)
    scene = out / "test/000000"
    cameras, poses, leds = (
        json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt", "gt_leds")
    )
    info = json.loads((out / "models/models_info.json").read_text())
    for frame in true_frames(rendered_set):
        camera, key = cameras[str(frame.frame)], str(frame.frame)
        matrix = np.reshape(camera["cam_K"], (3, 3))
        turned, moved = np.reshape(camera["cam_R_w2c"], (3, 3)), np.array(camera["cam_t_w2c"])
        model = np.array([pose["cam_t_m2c"] for pose in poses[key]])
        # Of a point 10 m away the last bit is 2e-12 mm.
        np.testing.assert_allclose(model, 1000 * frame.world_m @ turned.T + moved, rtol=0, atol=1e-9)
        homogeneous = model @ matrix.T
        assert worst_px(homogeneous[:, :2] / homogeneous[:, 2:] + 0.5, frame) < MAX_ERROR_PX
        assert leds[key] == frame.led
        assert {tuple(pose["cam_R_m2c"]) for pose in poses[key]} == {tuple(camera["cam_R_w2c"])}
        assert {pose["obj_id"] for pose in poses[key]} == {1}
        assert (scene / f"gray/{frame.frame:06d}.png").is_file()
    # The scene's LEDs are discs of 10 mm; 64 vertices have opposite ones on the circle.
    assert info["1"]["diameter"] == pytest.approx(20.0, rel=1e-12)
    assert info["1"]["symmetries_continuous"] == [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]
    assert json.loads((out / "camera.json").read_text())["cx"] == matrix[0, 2]


@pytest.mark.parametrize("which", ["rig_set", "wide_set"])
def test_opencv_reads_the_calibration_and_projects_leds_to_the_same_pixels(
    which: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """The pose of `main` and the mounting of each camera give the pose of the others."""
    folder = request.getfixturevalue(which)
    out = exported(folder, "opencv-yaml", tmp_path)
    frames = true_frames(folder)
    for main in (frame for frame in frames if frame.camera == "main"):
        rig = in_camera(main)
        for frame in frames[main.frame : main.frame + 2]:
            file = cv2.FileStorage(str(out / f"{frame.camera}.yaml"), cv2.FILE_STORAGE_READ)
            matrix, coefficients, rotation, moved = (
                file.getNode(key).mat()
                for key in ("camera_matrix", "distortion_coefficients", "R_cam_rig", "t_cam_rig")
            )
            fisheye = file.getNode("camera_model").string() == "fisheye"
            assert fisheye == (which == "wide_set" and frame.camera == "main")
            if frame is not main:
                rig = (frame.world_m - main.position_m) @ main.R_cam_world.T
            points = rig @ rotation.T + moved.T
            assert worst_px(by_opencv(points, matrix, coefficients.ravel(), fisheye) + 0.5, frame) < MAX_ERROR_PX


def test_camchain_projects_leds_to_the_same_pixels(rig_set: Path, tmp_path: Path) -> None:
    """A YAML 1.1 loader reads every number as one, and T_cn_cnm1 takes points of cam0 to cam1."""
    out = exported(rig_set, "kalibr", tmp_path)
    chain = yaml.safe_load((out / "camchain.yaml").read_text())
    assert [chain[cam]["distortion_model"] for cam in ("cam0", "cam1")] == ["none", "radtan"]
    assert chain["cam1"]["distortion_coeffs"] == [-0.05, 0.01, 1e-5, -2e-4]
    frames = true_frames(rig_set)
    for main, left in zip(frames[::2], frames[1::2], strict=True):
        for cam, frame in (("cam0", main), ("cam1", left)):
            entry = chain[cam]
            step = np.array(entry.get("T_cn_cnm1", np.eye(4)))
            points = (frame.world_m - main.position_m) @ main.R_cam_world.T @ step[:3, :3].T + step[:3, 3]
            fx, fy, cx, cy = entry["intrinsics"]
            matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
            coefficients: list[Any] = entry["distortion_coeffs"] or [0.0] * 4
            assert worst_px(by_opencv(points, matrix, coefficients, False) + 0.5, frame) < MAX_ERROR_PX


def test_a_fisheye_is_kalibrs_equidistant(belief_set: Path, tmp_path: Path) -> None:
    chain = yaml.safe_load((exported(belief_set, "kalibr", tmp_path) / "camchain.yaml").read_text())
    assert (chain["cam0"]["distortion_model"], chain["cam0"]["distortion_coeffs"]) == ("equidistant", [0.0] * 4)


@pytest.mark.parametrize(
    ("which", "to", "message"),
    [
        ("wide_set", "kalibr", "kalibr: camera other has the distortion k3 = 0.3"),
        ("wide_set", "nerfstudio", "nerfstudio: the rig has perspective and equidistant cameras"),
        ("wide_set", "bop", "bop: camera main is a fish-eye"),
        ("rig_set", "bop", "bop: camera left has a distortion"),
    ],
)
def test_a_lens_that_the_target_cannot_express_is_refused_by_name(
    which: str, to: str, message: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    with pytest.raises(vr.InputError, match=message) as refusal:
        vr.export_dataset(request.getfixturevalue(which), to, tmp_path / "out")
    assert "\n" not in str(refusal.value)
    assert list(tmp_path.iterdir()) == []


def test_the_distortion_of_a_frame_is_the_true_one(rig_set: Path) -> None:
    source = Source.open(rig_set, "colmap", True)
    row, truth = source.frames[1], source.truth[1]
    other = truth.model_copy(update={"distortion": (0.1, 0.2, 0.3, 0.4, 0.5)})
    assert source.told_camera("left").brown == source.true_camera(row, truth).brown == (-0.05, 0.01, 0.0, 1e-5, -2e-4)
    assert source.true_camera(row, other).brown == (0.1, 0.2, 0.3, 0.4, 0.5)


def test_transforms_json_has_k3(wide_set: Path, rig_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = Source.open(wide_set, "nerfstudio", True)
    with_k3 = source.true_camera(source.frames[1], source.truth[1])
    monkeypatch.setattr(Source, "true_camera", lambda *_: with_k3)
    tree = json.loads((exported(rig_set, "nerfstudio", tmp_path) / "transforms.json").read_text())
    keys = ("k1", "k2", "k3", "k4", "p1", "p2")
    assert [tree["frames"][0][key] for key in keys] == [-0.05, 0.01, 0.3, 0.0, 1e-5, -2e-4]


@pytest.mark.parametrize("to", ["opencv-yaml", "kalibr", "rosbag2"])
def test_skew_and_a_fisheye_of_90_deg_are_refused_by_name(
    to: str, rig_set: Path, belief_set: Path, tmp_path: Path
) -> None:
    """The corner of the fish-eye is 250 px off the axis: at 159 px a radian it is at 90.1 deg."""
    for folder, place, number, message in (
        (rig_set, (0, 1), 0.5, "camera main has a skew of 0.5 px"),
        (belief_set, (0, 0), 159.0, "the sensor of camera main extends to"),
    ):
        copy = copy_of(folder, tmp_path / folder.parent.name)
        tree = json.loads((copy / "dataset.json").read_text())
        matrix = tree["cameras"]["main"]["K"]
        matrix[place[0]][place[1]] = number
        if number > 1:
            matrix[1][1] = number
        (copy / "dataset.json").write_text(json.dumps(tree))
        with pytest.raises(vr.InputError, match=f"^{to}: {message}"):
            vr.export_dataset(copy, to, tmp_path / "out")
    matrix[0][0] = matrix[1][1] = 160.0  # 89.5 deg
    (copy / "dataset.json").write_text(json.dumps(tree))
    exported(copy, to, tmp_path)
