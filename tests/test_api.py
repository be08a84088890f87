"""The Python API: ten lines make a frame, its bits are those of a dataset, and importing it loads nothing heavy."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL

import vlcrender as vr
from vlcrender.config.packaged import packaged_names
from vlcrender.dataset.recipe.plan import load_plan

POSE = vr.Pose((3.15, 3.10, 0.60), tilt_x_deg=6, tilt_y_deg=-8)
HEAVY = ("mitsuba", "drjit", "cv2", "matplotlib", "scipy", "colour", "OpenEXR", "pyarrow")


def loaded_after(code: str) -> list[str]:
    """Which heavy packages a fresh interpreter has loaded after some code."""
    ask = f"import sys; print([name for name in {HEAVY!r} if name in sys.modules])"
    run = subprocess.run([sys.executable, "-c", f"{code}\n{ask}"], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    names: list[str] = json.loads(run.stdout.splitlines()[-1].replace("'", '"'))
    return names


@pytest.fixture(scope="module")
def mean(office: vr.Scene, small_camera: vr.Camera) -> vr.ExpectedFrame:
    return vr.render(office, small_camera, POSE)


def test_importing_and_help_load_no_heavy_package() -> None:
    """Ours is the ratio of CPU times to `import numpy`, at most 8; it follows from what is loaded."""
    assert loaded_after("import vlcrender") == []
    assert loaded_after("import vlcrender; dir(vlcrender); vlcrender.__version__") == []
    call = "from vlcrender.cli import main\nimport sys\nsys.argv = ['vlcrender', '--help']"
    assert loaded_after(f"{call}\ntry:\n    main()\nexcept SystemExit:\n    pass") == []


@pytest.mark.slow
def test_a_scene_is_loaded_without_mitsuba() -> None:
    assert loaded_after("import vlcrender as vr; vr.load_scene('office'); vr.Sensor.preset('phone-1.2um')") == []
    assert "mitsuba" not in loaded_after("import vlcrender as vr; vr.load_recipe('quickstart')")
    assert "mitsuba" in loaded_after("import vlcrender.rendering.renderer")  # the check can fail


def test_every_public_name_resolves_and_is_documented() -> None:
    assert set(vr.__all__) <= set(dir(vr))
    for name in vr.__all__:
        value = getattr(vr, name)
        assert name == "__version__" or value.__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = vr.nothing


def test_the_ten_lines_of_the_readme() -> None:
    """A frame of a packaged scene: brightest where the map's LEDs are, and dark but for shot noise elsewhere."""
    scene = vr.load_scene("office")
    camera = vr.Camera(width_px=1000, height_px=750, pixel_pitch_um=4.8)
    mean = vr.render(scene, camera, POSE)
    raw = vr.expose(mean, vr.Sensor.preset("phone-1.2um"), exposure_s=160e-6, seed=1)
    assert raw.image_dn.shape == (750, 1000)
    assert raw.image_dn.dtype == np.uint32
    whole = [led for led in mean.truth["leds"] if led["visible_fraction"] == 1]
    assert len(whole) >= 4
    background = np.median(raw.image_dn)
    for led in whole:
        assert raw.image_dn[int(led["v_px"]), int(led["u_px"])] > 2 * background


def test_truth_is_the_projection_of_the_map(mean: vr.ExpectedFrame, office: vr.Scene) -> None:
    """By the equations of FORMAT.md, K [R (p - c)] with K from the record; rounding is 1e-12 of some 1000 px."""
    record = vr.expose(mean, vr.Sensor(), 160e-6, 1).record()
    K, R = np.array(record["camera"]["K"]), np.array(mean.truth["R_cam_world"]).reshape(3, 3)
    assert np.array_equal(R, mean.R_cam_world)
    places = {entry["id"]: np.array(entry["position_m"]) for entry in record["led_map"]}
    assert len(places) == len(office.leds)
    for led in mean.truth["leds"]:
        x, y, z = K @ R @ (places[led["led"]] - mean.truth["position_m"])
        assert (x / z, y / z) == pytest.approx((led["u_px"], led["v_px"]), abs=1e-9)


def test_electrons_follow_the_exposure_time(mean: vr.ExpectedFrame) -> None:
    """Light adds up: twice the time, twice the electrons, but for float32's 6e-8 a sum and a product."""
    assert isinstance(mean, vr.ExpectedImage)
    assert mean.electrons_per_s.shape == (300, 400)
    np.testing.assert_allclose(mean.expected_electrons(2e-6), 2 * mean.expected_electrons(1e-6), rtol=3e-7)


@pytest.mark.slow
@pytest.mark.parametrize("regions", [False, True])
@pytest.mark.parametrize("preset", [None, "phone-1.2um"])
def test_a_frame_has_the_bits_of_a_data_set(preset: str | None, regions: bool, tmp_path: Path) -> None:
    overrides = [*SMALL, "poses.count=1", "accelerometer.error_deg=0.3"]
    overrides += [f"sensor.preset={preset}", "camera.pixel_pitch_um=12.0"] if preset else []
    overrides += ["regions.kind=leds", "regions.margin_px=3"] if regions else []
    assert_frame_of_a_dataset(vr.load_recipe("quickstart", overrides), tmp_path)


@pytest.mark.slow
def test_a_frame_of_codes_has_the_bits_of_a_data_set(tmp_path: Path) -> None:
    overrides = [*SMALL, "poses.count=1", "bound=false", "camera.pixel_pitch_um=12.0", "camera.shutter.row_time_us=20"]
    assert_frame_of_a_dataset(vr.load_recipe("downlink_codes", overrides), tmp_path)


def assert_frame_of_a_dataset(plan: "vr.Plan", tmp_path: Path) -> None:
    """The first frame of a plan's dataset is that of the API, as device and as truth."""
    assert vr.generate(plan, tmp_path / "set")
    assert vr.verify(tmp_path / "set") == []
    device = pq.read_table(tmp_path / "set/frames.parquet").to_pylist()[0]
    truth = pq.read_table(tmp_path / "set/truth.parquet").to_pylist()[0]
    tilts = (truth["tilt_x_deg"], truth["tilt_y_deg"], truth["yaw_deg"])
    recipe = plan.recipe
    mean = vr.render(plan.scene, recipe.camera, vr.Pose(tuple(truth["position_m"]), *tilts), regions=recipe.regions)
    timing = {"start_s": device["start_s"], "demodulation": recipe.demodulation}
    raw = vr.expose(mean, recipe.sensor, recipe.exposure_s or 0.0, recipe.seed, recipe.accelerometer, **timing)
    record = raw.record()
    with OpenEXR.File(str(tmp_path / "set" / device["file"]), separate_channels=True) as file:
        assert len(file.parts) == len(raw.parts)
        for part, own in zip(file.parts, record["parts"], strict=True):
            column, row = part.header["dataWindow"][0].tolist()
            assert (row, column) == (own["row"], own["column"])
            assert np.array_equal(part.channels["Y"].pixels, own["image_dn"])
    assert record["accelerometer_m_s2"] == device["accelerometer_m_s2"]
    assert record["spots"] == device["spots"]
    assert record["exposure_s"] == device["exposure_s"]
    dataset = json.loads((tmp_path / "set/dataset.json").read_text())
    assert json.loads(json.dumps(record["camera"])) == dataset["cameras"]["main"]
    for key in ("sensor", "accelerometer", "led_map", "downlink"):
        assert json.loads(json.dumps(record[key])) == dataset[key], key
    assert record["start_s"] == device["start_s"]
    waves = ("clock_error", "phase", "bits")  # of the seed and the start, which a view has not
    leds = [{key: value for key, value in led.items() if key not in waves} for led in truth["leds"]]
    assert {**{key: truth[key] for key in mean.truth}, "leds": leds} == mean.truth


def test_noise_is_of_the_seed_and_the_frame(mean: vr.ExpectedFrame) -> None:
    first, again, other, next_frame = (
        vr.expose(mean, vr.Sensor(), 160e-6, seed, frame=frame).image_dn
        for seed, frame in ((1, 0), (1, 0), (2, 0), (1, 1))
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(first, next_frame)


def test_a_sensor_of_another_spectral_response_is_rendered_again(mean: vr.ExpectedFrame) -> None:
    """Half the quantum efficiency, without noise: half the digital numbers, to the rounding of 1/2 DN."""
    base = {"noise": "none", "gain_e_per_dn": 0.1, "bits": 14, "full_well_e": 1e6}
    whole, half = (
        vr.Sensor.model_validate(
            {**base, "quantum_efficiency": {"wavelengths_nm": [300.0, 1000.0], "values": [value, value]}}
        )
        for value in (0.6, 0.3)
    )
    bright = vr.expose(mean, whole, 1e-7, 1).image_dn.astype(float)
    dim = vr.expose(mean, half, 1e-7, 1).image_dn.astype(float)
    assert bright.max() > 100
    assert bright.max() < whole.largest_dn
    assert np.abs(bright - 2 * dim).max() <= 1.5  # 0.5 of one, and twice 0.5 of the other
    again = vr.render(mean.scene, mean.camera, mean.pose, sensor=half)
    assert np.array_equal(vr.expose(again, half, 1e-7, 1).image_dn, dim)


def test_regions_alone_have_no_full_image(office: vr.Scene, small_camera: vr.Camera) -> None:
    mean = vr.render(office, small_camera, POSE, regions=vr.LedRegions(kind="leds", margin_px=2))
    raw = vr.expose(mean, vr.Sensor(), 160e-6, 1)
    assert len(raw.parts) > 1
    with pytest.raises(vr.InputError, match=rf"{len(raw.parts)} regions"):
        _ = raw.image_dn


def test_waves_are_of_the_seed_and_the_start(mean: vr.ExpectedFrame, small_camera: vr.Camera) -> None:
    """The image of LEDs that transmit depends on seed and start; that of steady ones on neither."""
    sensor = vr.Sensor(noise="none", gain_e_per_dn=20.0, bits=14, full_well_e=1e6)
    rolling = vr.Camera.model_validate(
        {**small_camera.model_dump(), "shutter": {"kind": "rolling", "row_time_us": 20.0}}
    )
    coded = vr.render(vr.load_scene("office_codes"), rolling, POSE)
    first, again, late, other = (
        vr.expose(coded, sensor, 40e-6, seed, start_s=start_s).image_dn
        for seed, start_s in ((1, 0.0), (1, 0.0), (1, 1e-4), (2, 0.0))
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, late)
    assert not np.array_equal(first, other)
    assert vr.expose(coded, sensor, 40e-6, 1, demodulation="pixels").spots == ()
    steady = [vr.expose(mean, sensor, 40e-6, 1, start_s=start_s).image_dn for start_s in (0.0, 1e-4)]
    assert np.array_equal(*steady)


def test_mistakes_are_refused_in_one_line(mean: vr.ExpectedFrame, office: vr.Scene, tmp_path: Path) -> None:
    calls = {
        "offic: is neither a file nor one of the scenes there are: .*office": lambda: vr.load_scene("offic"),
        "quick: is neither a file nor one of the recipes there are: .*quickstart": lambda: vr.load_recipe("quick"),
        "no.toml": lambda: vr.load_scene(tmp_path / "no.toml"),
        "camera.f_number": lambda: vr.load_recipe("quickstart", {"camera.f_number": "fast"}),
        "exposure_s = nan": lambda: vr.expose(mean, vr.Sensor(), float("nan"), 1),
        "start_s = -1: has to be from 0": lambda: vr.expose(mean, vr.Sensor(), 1e-4, 1, start_s=-1.0),
        'demodulation = "guess"': lambda: vr.expose(mean, vr.Sensor(), 1e-4, 1, demodulation="guess"),
        "seed = -1": lambda: vr.expose(mean, vr.Sensor(), 1e-4, -1),
        "not inside the room": lambda: vr.render(office, mean.camera, vr.Pose((9.0, 1.0, 1.0))),
        'preset = "phone"': lambda: vr.Sensor.preset("phone"),
        "workers = 0": lambda: vr.generate("quickstart", tmp_path / "x", workers=0),
        "give them to load_recipe": lambda: vr.generate(vr.load_recipe("quickstart"), tmp_path / "x", scale=2),
        "overrides: poses = <": lambda: vr.load_recipe("quickstart", {"poses": object()}),
        "overrides = 'a=1'": lambda: vr.load_recipe("quickstart", "a=1"),
    }
    for message, call in calls.items():
        with pytest.raises(vr.InputError, match=message) as refusal:
            call()
        assert "\n" not in str(refusal.value)
    assert not (tmp_path / "x").exists()


def test_overrides_are_those_of_the_command_line() -> None:
    mapping = {
        "poses.count": 20,
        "camera.f_number": np.float64(2.8),
        "sensor.noise": "none",
        "expected": True,
        "poses.height_m": (0.1, 1.0),
        "regions": {"kind": "leds", "margin_px": 3},
    }
    texts = [
        *("poses.count=20", "camera.f_number=2.8", "sensor.noise=none", "expected=true", "poses.height_m=[0.1, 1.0]"),
        'regions={kind = "leds", margin_px = 3}',
    ]
    recipe = ROOT / "datasets/quickstart.toml"
    assert vr.load_recipe("quickstart", mapping).recipe == load_plan(recipe, texts).recipe
    assert vr.load_recipe(str(recipe), texts).recipe == load_plan(recipe, texts).recipe


def test_a_file_wins_over_a_packaged_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert {"office", "table1", "meeting_room", "lamps"} <= set(packaged_names("scene"))
    text = (ROOT / "scenes/office.toml").read_text().replace('name = "office"', 'name = "mine"')
    (tmp_path / "office").write_text(text)
    assert vr.load_scene("office").name == "office"
    monkeypatch.chdir(tmp_path)
    assert vr.load_scene("office").name == "mine"
    (tmp_path / "office").unlink()
    (tmp_path / "office").mkdir()  # a folder is no file
    assert vr.load_scene("office").name == "office"


def test_a_packaged_scene_may_stand_in_a_recipe(tmp_path: Path) -> None:
    text = (ROOT / "datasets/quickstart.toml").read_text()
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("../scenes/office.toml", "table1"))
    assert vr.load_recipe(path).scene.name == "table1"
    path.write_text(text.replace("../scenes/office.toml", "table2"))
    with pytest.raises(vr.InputError, match=r"mine.toml: scene = table2: is neither a file nor one of the scenes"):
        vr.load_recipe(path)


def test_progress_ends_at_every_frame(tmp_path: Path) -> None:
    seen: list[vr.Progress] = []
    overrides = [*SMALL, "poses.count=2"]
    vr.generate("quickstart", tmp_path / "set", overrides=overrides, progress=seen.append)
    frames = [(one.done, one.total) for one in seen if one.stage == "frames"]
    assert frames == [(1, 2), (2, 2)]


def test_a_scene_is_rendered_by_the_same_renderer(office: vr.Scene) -> None:
    from vlcrender import api

    first = api._renderer(office, vr.Sensor())
    assert api._renderer(office, vr.Sensor(read_noise_e=2.0)) is first
    table = {"wavelengths_nm": [300.0, 1000.0], "values": [0.5, 0.5]}
    other = vr.Sensor.model_validate({"quantum_efficiency": table})
    assert api._renderer(office, other) is not first
    assert len(api._renderers) <= api.MAX_RENDERERS
