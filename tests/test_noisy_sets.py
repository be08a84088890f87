"""Datasets of the full chain: reproducible bits, and tables that state the parameters in effect."""

import hashlib
import json
from pathlib import Path

import numpy as np
import OpenEXR
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL

from vlcrender.dataset.recipe.plan import Plan, load_plan
from vlcrender.dataset.run.frame_job import Job, make_frame
from vlcrender.dataset.run.generate import generate
from vlcrender.dataset.run.progress import Progress
from vlcrender.dataset.verify.verify import verify

LEFT = "rig=[{ name = 'left', offset_m = [-0.1, 0.0, 0.0], tilt_x_deg = 0.0, tilt_y_deg = 1.0 }]"
NOISY = (
    *("sensor.preset=phone-1.55um", "sensor.iso=200", "sensor.serial=12", "sensor.dsnu_e=30", "sensor.prnu=0.05"),
    *("camera.pixel_pitch_um=12.0", "poses.count=2", "repeats=2", "expected=true", "processed={}"),
    *("sensor.dark_current_e_s=1e6", LEFT),
)
FRAMES = 2 * 2 * 2


def noisy_plan(*assignments: str) -> Plan:
    return load_plan(ROOT / "datasets/quickstart.toml", [*SMALL, *NOISY, *assignments])


def digests(directory: Path) -> dict[str, str]:
    kinds = ("frames/*.exr", "processed/*.jpg")
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for kind in kinds for p in sorted(directory.glob(kind))}


def pixels(path: Path) -> np.ndarray:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        image: np.ndarray = file.channels()["Y"].pixels.astype(float)
    return image


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("noisy") / "set"
    generate(noisy_plan(), directory)
    return directory


def test_it_is_complete_and_intact(made: Path) -> None:
    assert verify(made) == []
    assert len(digests(made)) == 2 * FRAMES


def test_shots_of_a_pose_stay_together(made: Path) -> None:
    rows = pq.read_table(made / "frames.parquet").to_pylist()
    truth = pq.read_table(made / "truth.parquet").to_pylist()
    assert [row["frame"] for row in rows] == list(range(FRAMES))
    assert [row["shot"] for row in rows] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert [row["pose"] for row in rows] == [0, 0, 0, 0, 1, 1, 1, 1]
    assert [row["camera"] for row in rows] == ["main", "left"] * 4
    places = [(row["position_m"], row["R_cam_world"]) for row in truth]
    assert places[0] == places[2] != places[4]
    assert places[1] == places[3] != places[0]
    readings = [row["accelerometer_m_s2"] for row in rows]
    assert readings[0] != readings[2], "the accelerometer has a new error in each shot"


def test_frames_of_one_pose_differ_in_noise_alone(made: Path) -> None:
    """PRNU, DSNU and offsets cancel in the difference; both draws and both read noises remain."""
    expected = pixels(made / "expected/000000.exr")
    assert np.array_equal(expected, pixels(made / "expected/000002.exr"))
    told = json.loads((made / "dataset.json").read_text())["sensor"]
    first, second = (pixels(made / f"frames/{frame:06d}.exr") for frame in (0, 2))
    difference = (first - second) * told["gain_e_per_dn"]
    calm = np.abs(expected - np.median(expected)) < 5 * np.sqrt(np.median(expected))  # the ceiling, which clips nowhere
    dark_e = told["dark_current_e_s"] * 1.6e-6
    noise = told["read_noise_e"] ** 2 + (told["adc_noise_dn"] ** 2 + 1 / 12) * told["gain_e_per_dn"] ** 2
    variance = 2 * (expected[calm].mean() + dark_e + noise)
    n = int(calm.sum())
    assert n > 50_000
    # Var(s^2) = 2 v^2 / n of nearly normal numbers; DSNU of 30 e leaves the draws as they are.
    assert abs(difference[calm].var(ddof=1) - variance) < 5 * np.sqrt(2 / n) * variance
    assert abs(np.corrcoef(first[calm], second[calm])[0, 1]) > 0.8, "they do share the patterns"


def test_the_dataset_states_the_sensor_parameters_in_effect(made: Path) -> None:
    """At ISO 200 of base 100 half the electrons make a number; dark current at the frames' temperature."""
    told = json.loads((made / "dataset.json").read_text())["sensor"]
    assert told["gain_e_per_dn"] == pytest.approx(2.128 / 2)
    assert told["noise"] == "full"
    assert (told["dsnu_e"], told["prnu"], told["read_noise_e"]) == (30.0, 0.05, 1.49)
    assert told["dark_current_e_s"] == 1e6
    quiet = noisy_plan("sensor.noise=shot").recipe.sensor.acting()
    assert not any(quiet[key] for key in quiet if key.endswith("_e") and key != "full_well_e")
    warm = noisy_plan("sensor.temperature_c=48").recipe.sensor.acting()
    assert warm["dark_current_e_s"] == pytest.approx(4e6)


def test_one_frame_alone_has_the_same_bytes(made: Path, tmp_path: Path) -> None:
    """So have those of any number of workers, each of which makes frames by themselves."""
    plan = noisy_plan()
    for name in ("frames", "expected", "previews", "processed"):
        (tmp_path / name).mkdir()
    job = Job(
        plan.recipe.model_dump_json(), plan.scene.settings.model_dump_json(), str(plan.scene.folder), str(tmp_path)
    )
    make_frame(job, 5)
    assert len(digests(tmp_path)) == 2
    assert digests(tmp_path).items() <= digests(made).items()


class Crash(Exception):
    pass


@pytest.mark.slow
def test_a_resumed_run_has_the_same_bytes(made: Path, tmp_path: Path) -> None:
    def stop(report: Progress) -> None:
        if (report.stage, report.done) == ("frames", 3):
            raise Crash

    with pytest.raises(Crash):
        generate(noisy_plan(), tmp_path / "set", progress=stop)
    generate(noisy_plan(), tmp_path / "set")
    assert digests(tmp_path / "set") == digests(made)
    assert verify(tmp_path / "set") == []


@pytest.mark.slow
@pytest.mark.parametrize("change", ["seed=2017", "sensor.serial=13"])
def test_another_seed_or_individual_shares_no_frame(change: str, made: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    generate(noisy_plan(change), other)
    assert not set(digests(other).values()) & set(digests(made).values())
    if change.startswith("sensor"):
        assert np.array_equal(pixels(other / "expected/000000.exr"), pixels(made / "expected/000000.exr"))
