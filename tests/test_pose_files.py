"""Poses from CSV and TUM files: positions, attitudes and time stamps of a set, or a refusal with the line."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import run
from input_files import mutated, read_or_refused
from scipy.spatial.transform import Rotation

import estimator as est
from vlcrender.camera.intrinsics import rotation_cam_world
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.recipe.pose_file import read_poses
from vlcrender.errors import InputError

TUM = """# timestamp tx ty tz qx qy qz qw
1700000000.25 1.5 1.0 0.5 0 0 0 1
1700000000.75 1.6 1.0 0.5 0.05 -0.03 0.2 0.977
1700000001.5 1.7 1.1 0.5 0.0 0.0 -0.7071068 0.7071068
"""
CSV = """time_ms,x_cm,y_cm,z_m,tilt_x_deg,tilt_y_rad,yaw_deg
250,150,100,0.5,10,-0.1,30
750,160,100,0.5,0,0,0
"""
SCENE = """format = "vlcrender-scene"
version = 1
name = "mine"
led_spectrum = "LED-B3"
led_reflectance = 0.5
led_map = "leds.csv"
[room]
size_m = [3, 2, 2.6]
reflectance = { floor = 0.2, ceiling = 0.7, walls = 0.5 }
[ambient]
illuminance_lux = 0
spectrum = "LED-B3"
[bake]
texel_m = 1.0
paths = 8
"""
RECIPE = """format = "vlcrender-recipe"
version = 1
name = "mine"
scene = "scene.toml"
seed = 1
exposure_s = 1e-4
[camera]
calibration = "cameras.txt"
pixel_pitch_um = 6.0
[poses]
kind = "file"
file = "{file}"
"""


def made(folder: Path, file: str, text: str) -> Path:
    """A recipe of files alone: calibration, LED map and poses."""
    (folder / "scene.toml").write_text(SCENE)
    (folder / "leds.csv").write_text(
        "id,x_m,y_m,z_m,radius_cm,flux_lm\n1,1,0.7,2.5,5,300\n2,2,0.7,2.5,5,300\n3,1.5,1.3,2.5,5,300\n"
    )
    (folder / "cameras.txt").write_text("1 OPENCV 96 72 60 61 48.5 36 -0.01 0 0 0\n")
    (folder / file).write_text(text)
    path = folder / "recipe.toml"
    path.write_text(RECIPE.format(file=file))
    return path


def test_a_quaternion_turns_camera_axes_into_world_axes(tmp_path: Path) -> None:
    """SciPy's own rotation is the reference; the file's digits leave some 1e-3 of the length, which does not count."""
    (tmp_path / "a.tum").write_text(TUM)
    entries = read_poses(tmp_path / "a.tum")
    for entry, line in zip(entries, TUM.splitlines()[1:], strict=True):
        time_s, x, y, z, *quaternion = map(float, line.split())
        assert (entry["time_s"], entry["position_m"]) == (time_s, [x, y, z])
        turned = rotation_cam_world(entry["tilt_x_deg"], entry["tilt_y_deg"], entry["yaw_deg"])
        assert pytest.approx(Rotation.from_quat(quaternion).as_matrix(), abs=1e-12) == turned.T
    # A level camera that looks up has the world's axes.
    assert [entries[0][name] for name in ("tilt_x_deg", "tilt_y_deg", "yaw_deg")] == pytest.approx([0, 0, 0])


def test_a_csv_has_tilts_or_quaternions_in_any_unit(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(CSV)
    first, second = read_poses(tmp_path / "a.csv")
    assert first["position_m"] == pytest.approx([1.5, 1.0, 0.5])
    assert (first["time_s"], second["time_s"]) == (0.25, 0.75)
    assert (first["tilt_x_deg"], first["yaw_deg"]) == (10, 30)
    assert first["tilt_y_deg"] == pytest.approx(np.degrees(-0.1))
    (tmp_path / "b.tum").write_text(TUM)
    named = "t_s,tx,ty,tz,qx,qy,qz,qw\n" + TUM.partition("\n")[2].replace(" ", ",")
    (tmp_path / "b.csv").write_text(named)
    assert read_poses(tmp_path / "b.csv", "m") == read_poses(tmp_path / "b.tum")
    (tmp_path / "c.json").write_text(json.dumps({"units": "cm", "poses": [{"x": 150, "y": 100, "z": 50}]}))
    (pose,) = read_poses(tmp_path / "c.json")
    assert pose["position_m"] == pytest.approx([1.5, 1.0, 0.5])
    assert "time_s" not in pose


HEAD = "time_s,x_m,y_m,z_m,qx,qy,qz,qw\n1,1,1,0.5,0,0,0,1\n"
REFUSALS = {
    "order.tum": (
        TUM + TUM.splitlines()[2] + "\n",
        "line 5: time stamp 1700000000.75 s does not exceed the one before",
    ),
    "short.tum": (TUM + "1 2 3\n", "line 5: 3 numbers; a TUM line has timestamp tx ty tz qx qy qz qw"),
    "word.tum": (TUM + "1 2 3 x 0 0 0 1\n", "line 5: z: 'x' is not a finite number"),
    "long.tum": (TUM + "1700000002 2 1 1 0 0 0 2\n", "line 5: the quaternion has the length 2; it has to be 1"),
    "side.tum": (TUM + "1700000002 2 1 1 0.7071068 0 0 0.7071068\n", "line 5: tilt_x is .*90 deg; at most 85"),
    "part.csv": (HEAD.replace(",qw", ",tilt_x_deg"), "line 2: the attitude is all of qx, qy, qz, qw, or tilt_x"),
    "stamp.csv": (HEAD + ",1,1,0.5,0,0,0,1\n", "line 3: every pose has a time stamp, or none has"),
    "unit.csv": (HEAD.replace("time_s", "time"), "line 2: column 'time' has no unit: name it time_s or time_ms"),
    "place.csv": (HEAD + "2,,1,0.5,0,0,0,1\n", "line 3: no x; each pose has x, y and z"),
    "none.tum": ("# nothing\n", "0 poses; 1 to 10000 are allowed"),
    "many.tum": ("\n".join(f"{n} 1 1 1 0 0 0 1" for n in range(10001)), "10001 poses; 1 to 10000 are allowed"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_wrong_poses_are_refused_with_the_line(tmp_path: Path, name: str) -> None:
    text, message = REFUSALS[name]
    with pytest.raises(InputError, match=message) as refused:
        load_plan(made(tmp_path, name, text))
    assert str(refused.value).startswith(f"{tmp_path}/recipe.toml: poses.file: {tmp_path}/{name}: ")


@pytest.mark.parametrize(
    ("name", "text"), [("a.tum", TUM), ("a.csv", CSV), ("a.json", '[{"x_m": 1, "y_m": 1, "z_cm": 3}]')]
)
def test_damaged_poses_are_read_or_refused(tmp_path: Path, name: str, text: str) -> None:
    rng, path, refused = np.random.default_rng(16), tmp_path / name, 0
    for _ in range(150):
        path.write_bytes(mutated(text.encode(), rng))
        entries = read_or_refused(path, lambda: read_poses(path))
        refused += entries is None
        for entry in entries or ():
            assert np.isfinite(entry["position_m"]).all()
    assert 0 < refused < 150


@pytest.mark.slow
def test_a_set_of_files_has_their_camera_leds_poses_and_time_stamps(tmp_path: Path) -> None:
    """Rendered, verified, read by the estimator; and a changed file is another set."""
    recipe, out = made(tmp_path, "a.tum", TUM), tmp_path / "set"
    assert run("vlcrender", "generate", str(recipe), "--out", str(out), "--workers", "1").returncode == 0
    assert run("vlcrender", "verify", str(out)).returncode == 0
    frames = pq.read_table(out / "frames.parquet").to_pylist()
    truth = pq.read_table(out / "truth.parquet").to_pylist()
    assert [row["time_s"] for row in frames] == [1700000000.25, 1700000000.75, 1700000001.5]
    assert [row["position_m"] for row in truth] == [[1.5, 1.0, 0.5], [1.6, 1.0, 0.5], [1.7, 1.1, 0.5]]
    camera = json.loads((out / "dataset.json").read_text())["cameras"]["main"]
    # COLMAP's pixels are the format's.
    assert np.array(camera["K"]) == pytest.approx(np.array([[60, 0, 48.5], [0, 61, 36], [0, 0, 1]]))
    assert camera["distortion"] == {"k1": -0.01, "k2": 0, "k3": 0, "p1": 0, "p2": 0}
    assert len(est.read_dataset(out).frames) == 3
    for name in ("cameras.txt", "leds.csv", "a.tum"):
        text = (tmp_path / name).read_text()
        (tmp_path / name).write_text(text.replace("5", "4"))
        again = run("vlcrender", "generate", str(recipe), "--out", str(out), "--workers", "1")
        assert again.returncode == 2, name
        (tmp_path / name).write_text(text)
    assert run("vlcrender", "generate", str(recipe), "--out", str(out), "--workers", "1").returncode == 0


def test_a_set_without_time_stamps_has_none(rendered_set: Path) -> None:
    assert set(pq.read_table(rendered_set / "frames.parquet")["time_s"].to_pylist()) == {None}
