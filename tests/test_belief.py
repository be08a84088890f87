"""What a device is told and what is true in sets with [belief]: what errors move, and what they leave alone."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL, copy_of
from numpy.typing import NDArray

import estimator as est
from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera, Pose, transform
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.core.backend import dr
from vlcrender.dataset.format.files import read_dataset_file
from vlcrender.dataset.format.rows import DeviceTruthRow, FrameRow, MapTruthRow, TruthRow
from vlcrender.dataset.format.tables import read_table, write_table
from vlcrender.dataset.recipe.plan import Plan, load_plan
from vlcrender.dataset.run.frame_job import Job, _rendered, make_frame
from vlcrender.dataset.run.generate import generate
from vlcrender.dataset.verify.verify import verify
from vlcrender.dataset.world.true_world import (
    built_leds,
)
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.as_built import luminaires_of
from vlcrender.scene.loader import Scene, build_scene
from vlcrender.scene.schema import Bake, PanelFrame

Array = NDArray[np.float64]

REGIONS = 'regions={ kind = "leds", margin_px = 3 }'
SMALL_CAMERA = {"width_px": 400, "height_px": 300, "pixel_pitch_um": 12.0}
CALIBRATED = ("belief.preset=calibrated", "belief.devices=3", "belief.maps=2")


def plan(*assignments: str) -> Plan:
    """Small frames of LED regions in the office."""
    return load_plan(ROOT / "datasets/quickstart.toml", [*SMALL, REGIONS, *assignments])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven frames of three devices in two maps."""
    directory = tmp_path_factory.mktemp("belief") / "set"
    assert generate(plan("poses.count=7", "expected=true", *CALIBRATED), directory)
    return directory


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same recipe without [belief]."""
    directory = tmp_path_factory.mktemp("exact") / "set"
    assert generate(plan("poses.count=7", "expected=true"), directory)
    return directory


def tree(directory: Path) -> dict[str, object]:
    content: dict[str, object] = json.loads((directory / "dataset.json").read_text())
    return content


# Sets


def test_poses_are_those_of_the_recipe_without_belief_and_images_are_not(made: Path, exact: Path) -> None:
    with_belief, without = (read_table(d / "truth.parquet", TruthRow) for d in (made, exact))
    assert [row.position_m for row in with_belief] == [row.position_m for row in without]
    assert [row.R_cam_world for row in with_belief] == [row.R_cam_world for row in without]
    frames, as_today = (read_table(d / "frames.parquet", FrameRow) for d in (made, exact))
    assert all(a.sha256 != b.sha256 for a, b in zip(frames, as_today, strict=True))
    assert [row.device for row in frames] == [0, 1, 2, 0, 1, 2, 0]
    assert [row.map for row in with_belief] == [0, 1, 0, 0, 1, 0, 0]
    assert {(row.device, truth.map) for row, truth in zip(as_today, without, strict=True)} == {(0, 0)}


def test_a_set_without_belief_states_an_exact_camera_and_nothing_else(exact: Path) -> None:
    content = read_dataset_file(exact)
    stated = content.cameras["main"].uncertainty
    assert stated is not None
    assert stated.parameters == ("focal", "aspect", "cx_px", "cy_px", "k1", "p1", "p2")
    assert stated.device_sigma == stated.shot_sigma == (0.0,) * 7
    assert (stated.offset_sigma_m, stated.rotation_sigma_deg) == (0.0, 0.0)
    assert all(led.sigma_m is None for led in content.led_map or ())
    assert (content.luminaires, content.map_datum) == ((), None)
    assert (content.accelerometer.device_error_deg, content.accelerometer.shot_error_deg) == (None, None)
    assert not (exact / "truth_devices.parquet").exists()
    assert not (exact / "truth_map.parquet").exists()
    (row, *_) = read_table(exact / "truth.parquet", TruthRow)
    assert row.bound_m2 == row.bound_exact_m2
    assert np.array(row.K).reshape(3, 3).tolist() == [list(line) for line in content.cameras["main"].K]


def test_sigmas_of_zero_give_the_bits_of_a_set_without_belief(exact: Path, tmp_path: Path) -> None:
    """[belief] alone: the accelerometer keeps the recipe's error, and everything else is stated as exact."""
    directory = tmp_path / "zero"
    generate(plan("poses.count=7", "belief.devices=3", "belief.maps=2"), directory)
    frames, as_today = (read_table(d / "frames.parquet", FrameRow) for d in (directory, exact))
    for row, today in zip(frames, as_today, strict=True):
        assert row.sha256 == today.sha256
        # The bias of 0 is added to the tilt: its last bit.
        assert np.allclose(row.accelerometer_m_s2, today.accelerometer_m_s2, rtol=0, atol=1e-14)
        assert row.spots == today.spots
    content = read_dataset_file(directory)
    assert content.cameras["main"].uncertainty is not None
    assert set(content.cameras["main"].uncertainty.device_sigma) == {0.0}
    assert content.accelerometer.error_deg == content.accelerometer.shot_error_deg == 0.1


def test_the_true_camera_and_leds_image_where_the_truth_says(made: Path) -> None:
    """Projected here by hand: K, Brown-Conrady and the as-built LEDs of the sealed tables."""
    built = {
        (row.map, row.led): np.array(row.position_m) for row in read_table(made / "truth_map.parquet", MapTruthRow)
    }
    leds = 0
    for row in read_table(made / "truth.parquet", TruthRow):
        assert row.distortion is not None
        k1, k2, k3, p1, p2 = row.distortion
        assert k2 == k3 == 0 != k1
        for led in row.leds:
            p = np.reshape(row.R_cam_world, (3, 3)) @ (built[row.map, led.led] - row.position_m)
            x, y = p[:2] / p[2]
            r2 = x * x + y * y
            xd = x * (1 + k1 * r2) + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            yd = y * (1 + k1 * r2) + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
            u, v, _ = np.reshape(row.K, (3, 3)) @ [xd, yd, 1.0]
            assert np.hypot(u - led.u_px, v - led.v_px) < 1e-8
            leds += 1
    assert leds > 20


def parts_of(path: Path) -> list[tuple[int, int, Array]]:
    """First column, first row and pixels of each part of an image file."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return [
            (*map(int, part.header["dataWindow"][0]), np.array(part.channels["Y"].pixels, dtype=float))
            for part in file.parts
        ]


def test_images_show_the_leds_where_the_truth_says(made: Path) -> None:
    """Centroid of the noise-free image of an LED on its own, less its background, against the truth of its centre.

    Seen at up to 60 deg on both axes, the image of a disc of 20 mm is up to 8 px wide; its centroid is off the image of
    the centre by less than 0.1 px (perspective), its gradient moves it by up to 5 sigma = 0.25 / 4 of its radius: 0.25
    px. Told LEDs are off by more in the mean, since 3 mm are over 1 px.
    """
    errors, told_errors = [], []
    content = read_dataset_file(made)
    told_map = {led.id: np.array(led.position_m) for led in content.led_map}
    told_camera = plan().recipe.camera
    for row in read_table(made / "truth.parquet", TruthRow):
        for column, row_, light in parts_of(made / f"expected/{row.frame:06d}.exr"):
            height, width = light.shape
            inside = [led for led in row.leds if 0 <= led.u_px - column < width and 0 <= led.v_px - row_ < height]
            if len(inside) != 1 or inside[0].visible_fraction < 1:
                continue
            light = light - np.median(np.concatenate([light[0], light[-1], light[:, 0], light[:, -1]]))
            rows, columns = np.indices(light.shape)
            u = (light * (columns + column + 0.5)).sum() / light.sum()
            v = (light * (rows + row_ + 0.5)).sum() / light.sum()
            errors.append(np.hypot(u - inside[0].u_px, v - inside[0].v_px))
            p = transform(np.reshape(row.R_cam_world, (3, 3)), told_map[inside[0].led] - np.array(row.position_m))
            told_errors.append(np.hypot(*(np.array([u, v]) - told_camera.image_of_points(p))))
    assert len(errors) > 10
    assert max(errors) < 0.35
    assert np.median(told_errors) > 5 * np.median(errors)


def test_a_led_raised_into_its_panel_is_not_hidden_by_it() -> None:
    """All LEDs 38 mm above the undersides of their panels, whose frames make the renderer look for occluders.

    The frames are 2 mm deep and 20 mm from the LEDs: at tilts of at most 10 deg they hide none.
    """
    raised = plan(
        *("belief.datum.position_mm=[0, 0, 30]", "belief.devices=1", "belief.maps=1", "seed=1"),
        *("poses.count=3", "poses.tilt_x_deg=[0, 10]", "poses.tilt_y_deg=[0, 10]"),
    )
    settings = raised.scene.settings
    rim = PanelFrame(width_m=0.01, depth_m=0.002, reflectance=0.5)
    panels = (settings.panels[0].model_copy(update={"frame": rim}),)
    coarse = Bake(texel_m=3.0, paths=8)
    framed = build_scene(settings.model_copy(update={"panels": panels, "bake": coarse}), "framed")
    heights = built_leds(raised.recipe, framed, 0).centers_m[:, 2] - framed.leds.centers_m[:, 2]
    assert (heights > 0.03).all(), "the draw of this seed is upwards"
    job = Job(raised.recipe.model_dump_json(), framed.settings.model_dump_json(), str(framed.folder), "/nowhere")
    seen = 0
    for pose in range(3):
        for patch in _rendered(job, pose, 0, 0, None).image.patches:
            u, v = patch.center_px
            if 10 < u < 390 and 10 < v < 290:
                assert patch.visible_fraction == 1.0
                seen += 1
    assert seen > 10


def test_a_stated_factor_changes_what_is_stated_and_nothing_else(made: Path, tmp_path: Path) -> None:
    directory = tmp_path / "factor"
    factors = ("belief.stated_factor=3", "belief.leds.stated_factor=0.5")
    generate(plan("poses.count=7", "expected=true", *CALIBRATED, *factors), directory)
    for name in ("frames", "truth", "truth_devices", "truth_map"):
        assert pq.read_table(directory / f"{name}.parquet").equals(pq.read_table(made / f"{name}.parquet"))
    stated, as_true = read_dataset_file(directory), read_dataset_file(made)
    camera, true_camera_ = stated.cameras["main"].uncertainty, as_true.cameras["main"].uncertainty
    assert camera is not None
    assert true_camera_ is not None
    assert np.allclose(camera.device_sigma, 3 * np.array(true_camera_.device_sigma), rtol=1e-12, atol=0)
    assert np.allclose(camera.shot_sigma, 3 * np.array(true_camera_.shot_sigma), rtol=1e-12, atol=0)
    assert stated.accelerometer.error_deg == pytest.approx(3 * as_true.accelerometer.error_deg)
    assert np.allclose(stated.luminaires[5].sigma_m, 0.009)
    assert stated.luminaires[5].position_m == as_true.luminaires[5].position_m
    led, true_led = stated.led_map[30], as_true.led_map[30]
    assert led.position_m == true_led.position_m
    assert led.sigma_m == pytest.approx((1.5e-4,) * 3)
    assert led.gradient_sigma == pytest.approx(0.025)
    assert led.shape == true_led.shape == "disc"
    assert led.radius_sigma_m == pytest.approx(0.01 * 0.01)
    assert true_led.radius_sigma_m == pytest.approx(0.02 * 0.01)


def test_the_device_is_told_the_recipe(made: Path, exact: Path) -> None:
    """Told values, and attributes of the images, are those of a set without [belief]."""
    told, recipe = tree(made), tree(exact)

    def without_sigmas(node: object) -> object:
        if isinstance(node, dict):
            stated = ("uncertainty", "luminaire", "luminaires", "map_datum", "provenance", "accelerometer")
            stated += ("manifest_sha256", "seal", "names", "summary")
            return {k: without_sigmas(v) for k, v in node.items() if k not in stated and "sigma" not in k}
        return [without_sigmas(item) for item in node] if isinstance(node, list) else node

    assert without_sigmas(told) == without_sigmas(recipe)

    def attributes(directory: Path) -> dict[str, object]:
        with OpenEXR.File(str(directory / "frames/000000.exr"), separate_channels=True) as file:
            return {k: v for k, v in file.parts[0].header.items() if "indow" not in k and k not in ("channels", "name")}

    assert repr(attributes(made)) == repr(attributes(exact))


def test_luminaires_are_the_panels(made: Path) -> None:
    content = read_dataset_file(made)
    assert [entry.id for entry in content.luminaires] == list(range(49))
    assert [led.luminaire for led in content.led_map] == [led.id // 25 for led in content.led_map]
    assert content.luminaires[0].position_m == pytest.approx((0.5, 0.5, 3.45))
    single = load_plan(ROOT / "datasets/table1.toml", []).scene
    of = luminaires_of(single.settings, single.leds)
    assert sorted(of.of_led.tolist()) == list(range(len(single.leds)))


def test_the_estimator_reads_the_set_and_its_sigmas(made: Path) -> None:
    dataset = est.read_dataset(made)
    frame = est.read_frame(dataset, 1)
    assert frame.device == 1
    assert frame.camera.uncertainty is not None
    assert frame.camera.uncertainty.device_sigmas()[0] == pytest.approx(1e-3)
    assert frame.luminaires[0].sigma_m == pytest.approx((3e-3,) * 3)


def test_one_frame_alone_has_the_same_rows(made: Path, tmp_path: Path) -> None:
    """So have those of any number of workers and of a run that goes on: each makes frames by themselves."""
    for name in ("frames", "expected", "previews"):
        (tmp_path / name).mkdir()
    record = make_frame(Job.of(plan("poses.count=7", "expected=true", *CALIBRATED), tmp_path), 5)
    assert record.device == read_table(made / "frames.parquet", FrameRow)[5]
    assert record.truth == read_table(made / "truth.parquet", TruthRow)[5]
    assert (tmp_path / record.device.file).read_bytes() == (made / record.device.file).read_bytes()


def test_repeats_of_a_pose_have_errors_of_their_own(tmp_path: Path) -> None:
    generate(plan("poses.count=2", "repeats=2", *CALIBRATED), tmp_path / "set")
    rows = read_table(tmp_path / "set/truth.parquet", TruthRow)
    assert rows[0].position_m == rows[1].position_m
    assert rows[0].K != rows[1].K
    assert rows[0].map == rows[1].map == 0
    assert rows[2].map == rows[3].map == 1
    assert verify(tmp_path / "set") == []


def test_a_rig_is_mounted_otherwise_than_told(tmp_path: Path) -> None:
    rig = 'rig=[{ name = "right", offset_m = [0.1, 0.0, 0.0], yaw_deg = 30.0 }]'
    generate(plan("poses.count=2", rig, *CALIBRATED), tmp_path / "set")
    assert verify(tmp_path / "set") == []
    rows = read_table(tmp_path / "set/truth_devices.parquet", DeviceTruthRow)
    assert [(row.device, row.camera) for row in rows[:3]] == [(0, "main"), (0, "right"), (1, "main")]
    assert rows[0].offset_m == (0.0, 0.0, 0.0)
    shifts = np.array([row.offset_m for row in rows[1::2]]) - [0.1, 0.0, 0.0]
    assert (shifts != 0).all()
    assert np.abs(shifts).max() < 5 * 0.2e-3
    main, right = read_table(tmp_path / "set/truth.parquet", TruthRow)[:2]
    world_from_rig = np.reshape(main.R_cam_world, (3, 3)).T
    assert np.allclose(
        np.array(right.position_m) - np.array(main.position_m), world_from_rig @ rows[1].offset_m, atol=1e-12
    )
    relative = np.reshape(right.R_cam_world, (3, 3)) @ world_from_rig
    assert np.allclose(relative, np.reshape(rows[1].R_cam_rig, (3, 3)), atol=1e-9)
    told = read_dataset_file(tmp_path / "set").cameras["right"]
    assert told.offset_m == (0.1, 0.0, 0.0)
    # rotations of 0.05 deg about each axis: 5 sigma
    turn = relative @ np.array(told.R_cam_rig).T
    angle_deg = np.degrees(np.arccos((np.trace(turn) - 1) / 2))
    assert 0 < angle_deg < 5 * 0.05 * np.sqrt(3)
    # the device turns its reading by the told mounting: both frames state one error
    frames = read_table(tmp_path / "set/frames.parquet", FrameRow)[:2]
    assert np.allclose(
        np.array(told.R_cam_rig) @ frames[0].accelerometer_m_s2, frames[1].accelerometer_m_s2, atol=1e-12
    )


def test_an_aspect_ratio_leaves_the_light_of_an_led() -> None:
    """The image of an LED, wider than high by a fifth, has the light of an image of equal scales.

    fx fy is f^2 (1 - (0.2 / 2.2)^2), 0.8 % less, and each pixel sees as much more. Coverage takes the scale as constant
    in a pixel: 1e-4.
    """
    light = []
    for ratio in (1.0, 1.2):
        settings = plan(
            "poses={ kind = 'grid', columns = 1, rows = 1, height_m = 1.0 }", f"camera.aspect_ratio={ratio}"
        )
        job = Job(
            *(settings.recipe.model_dump_json(), settings.scene.settings.model_dump_json()),
            *(str(settings.scene.folder), "/nowhere"),
        )
        patches = _rendered(job, 0, 0, 0, None).image.patches
        light.append({p.led_id: float(p.electrons_per_s.sum()) for p in patches if p.visible_fraction == 1})
    common = light[0].keys() & light[1].keys()
    assert len(common) > 5
    for led in common:
        assert light[1][led] == pytest.approx(light[0][led], rel=2e-4)


# Damage


def change_device(directory: Path, **entries: object) -> None:
    rows = read_table(directory / "truth_devices.parquet", DeviceTruthRow)
    rows[0] = DeviceTruthRow.model_validate({**rows[0].model_dump(), **entries})
    write_table(directory / "truth_devices.parquet", rows, DeviceTruthRow)


def change_frame_of_truth(directory: Path, **entries: object) -> None:
    rows = read_table(directory / "truth.parquet", TruthRow)
    rows[0] = TruthRow.model_validate({**rows[0].model_dump(), **entries})
    write_table(directory / "truth.parquet", rows, TruthRow)


def move_led(directory: Path) -> None:
    (first, *_) = read_table(directory / "truth.parquet", TruthRow)
    rows = read_table(directory / "truth_map.parquet", MapTruthRow)
    rows = [
        row.model_copy(update={"position_m": (row.position_m[0] + 1e-4, *row.position_m[1:])})
        if (row.map, row.led) == (0, first.leds[0].led)
        else row
        for row in rows
    ]
    write_table(directory / "truth_map.parquet", rows, MapTruthRow)


DAMAGE: dict[str, tuple[Callable[[Path], None], str]] = {
    "no devices": (lambda d: (d / "truth_devices.parquet").unlink(), "truth_devices.parquet: is missing"),
    "no map": (lambda d: (d / "truth_map.parquet").unlink(), "truth_map.parquet: is missing"),
    "another map of a device": (lambda d: change_device(d, map=1), "map 0: device 0 works in map 1"),
    "a device missing": (lambda d: change_device(d, device=1), "has not one row for each device and camera"),
    "another K": (
        lambda d: change_frame_of_truth(d, K=(1e3, 0.0, 200.0, 0.0, 1e3, 150.0, 0.0, 0.0, 1.0)),
        "is not where the pose puts it",
    ),
    "another LED": (move_led, "is not where the pose puts it"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_of_the_sealed_tables_is_named(made: Path, tmp_path: Path, name: str) -> None:
    change, words = DAMAGE[name]
    directory = copy_of(made, tmp_path / "set")
    assert verify(directory) == []
    change(directory)
    assert any(words in problem for problem in verify(directory))
    assert not any("\n" in problem for problem in verify(directory))


def test_a_journal_line_is_a_whole_frame(tmp_path: Path) -> None:
    """A frame made alone has the rows of the frame in its set."""
    of = plan("poses.count=7", *CALIBRATED)
    (tmp_path / "frames").mkdir()
    (tmp_path / "previews").mkdir()
    job = Job(of.recipe.model_dump_json(), of.scene.settings.model_dump_json(), str(of.scene.folder), str(tmp_path))
    record = make_frame(job, 5)
    assert (record.device.device, record.truth.map) == (2, 0)
    assert make_frame(job, 5) == record


# Kernels


def test_a_camera_as_data_gives_the_same_image_with_one_kernel_for_all_cameras(office: Scene) -> None:
    """Bit for bit, with a distortion; a second camera launches the kernels of the first."""
    plain = Renderer(office)
    varying = plain.with_leds(office.leds)
    pose = Pose((3.4, 3.6, 1.0), 12.0, -7.0, 20.0)
    cameras = [
        Camera(**SMALL_CAMERA, principal_point_px=(195.3, 151.1), distortion=Distortion(k1=k1, p1=3e-4, p2=-2e-4))
        for k1 in (0.02, 0.03)
    ]
    for camera in cameras:
        posed = PosedCamera(camera, pose)
        expected, image = (r.expected_image(posed).expected_electrons(1e-4) for r in (plain, varying))
        assert np.array_equal(expected, image)

    def kernels(renderer: Renderer, camera: Camera) -> set[str]:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            renderer.expected_image(PosedCamera(camera, pose))
            return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}

    assert kernels(varying, cameras[0]) == kernels(varying, cameras[1])
    assert kernels(plain, cameras[0]) != kernels(plain, cameras[1]), "the history tells kernels apart"
