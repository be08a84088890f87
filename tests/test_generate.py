"""Generation: resumable, the same bits for any number of workers, and no file lost."""

import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import OpenEXR
import psutil
import pyarrow.parquet as pq
import pytest
from conftest import HANG_S, ROOT, SMALL, small_plan, started, wait_until

from vlcrender.dataset.format.manifest import read_manifest
from vlcrender.dataset.format.rows import FrameRecord
from vlcrender.dataset.format.schema import DATA_VERSION
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run.generate import generate
from vlcrender.dataset.run.progress import Progress, ProgressCallback
from vlcrender.dataset.run.unfinished import _line
from vlcrender.dataset.run.workers import Done, Task
from vlcrender.dataset.verify.verify import verify
from vlcrender.errors import InputError

RECIPE = ROOT / "datasets/quickstart.toml"


def digests(directory: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(directory.glob("frames/*.exr"))}


@pytest.fixture(scope="module")
def made(rendered_set: Path) -> Path:
    return rendered_set


def test_a_dataset_is_complete_and_intact(made: Path) -> None:
    assert verify(made) == []
    assert not (made / "plan.json").exists()
    assert not list(made.rglob("*.partial"))


def test_the_same_recipe_gives_the_same_bytes(made: Path, tmp_path: Path) -> None:
    generate(small_plan("expected=true"), tmp_path / "again")
    assert digests(tmp_path / "again") == digests(made)
    assert len(digests(made)) == 3


@pytest.mark.slow
def test_two_workers_give_the_same_bytes_as_one(made: Path, tmp_path: Path) -> None:
    generate(small_plan("expected=true"), tmp_path / "pool", workers=2)
    assert digests(tmp_path / "pool") == digests(made)
    for table in ("frames.parquet", "truth.parquet"):
        assert pq.read_table(tmp_path / "pool" / table).equals(pq.read_table(made / table))


@pytest.mark.slow
def test_one_thread_gives_the_same_bytes_as_all(made: Path, tmp_path: Path) -> None:
    """In a process of its own with every library held to one thread."""
    code = (
        "from pathlib import Path; from conftest import small_plan; from vlcrender.core.backend import dr; "
        "from vlcrender.dataset.run.generate import generate; dr.set_thread_count(1); "
        f"generate(small_plan('expected=true'), Path({str(tmp_path / 'one')!r}))"
    )
    single = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, env={**os.environ, **single}, check=True)
    assert digests(tmp_path / "one") == digests(made)


@pytest.mark.slow
def test_a_longer_set_with_other_noise_shares_no_frame(made: Path, tmp_path: Path) -> None:
    generate(small_plan("seed=2017"), tmp_path / "other")
    assert not set(digests(tmp_path / "other").values()) & set(digests(made).values())


class Crash(Exception):
    pass


def frame_counts(counts: list[float]) -> ProgressCallback:
    """A callback that collects the numbers of finished frames."""
    return lambda report: counts.append(report.done) if report.stage == "frames" else None


def test_an_interrupted_run_resumes(made: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    directory = tmp_path / "set"

    def crash_after_two(report: Progress) -> None:
        if (report.stage, report.done) == ("frames", 2):
            raise Crash

    with pytest.raises(Crash):
        generate(small_plan("expected=true"), directory, progress=crash_after_two)
    assert not (directory / "dataset.json").exists()
    # a crash can leave a truncated journal line, a half-written file, a finished file damaged later
    with (directory / "journal.jsonl").open("a") as journal:
        journal.write('{"frame": 2, "dev')
    (directory / "frames/000002.partial").write_bytes(b"half")
    damaged = directory / "frames/000000.exr"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    kept = (directory / "frames/000001.exr").stat().st_mtime_ns
    counts: list[float] = []
    with caplog.at_level("INFO", "vlcrender"):
        assert generate(small_plan("expected=true"), directory, progress=frame_counts(counts))
    assert "2 frames are damaged or incomplete and are made again" in caplog.text
    assert "resumed with 1 of 3 frames" in caplog.text
    assert counts[0] == 1, "only the intact frame counts as done"
    assert (directory / "frames/000001.exr").stat().st_mtime_ns == kept, "a finished frame is not made twice"
    assert digests(directory) == digests(made)
    assert verify(directory) == []


@pytest.mark.slow
def test_progress_reports_the_light_and_then_each_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VLCRENDER_CACHE", str(tmp_path / "cache"))
    plan = load_plan(ROOT / "datasets/table1.toml", [*SMALL[:4], "poses.columns=2", "poses.rows=1"])
    reports: list[Progress] = []
    generate(plan, tmp_path / "set", progress=reports.append)
    light = [report for report in reports if report.stage != "frames"]
    assert reports[: len(light)] == light
    assert light[0] == Progress("direct light of LEDs", 0.0, 1.0)
    assert all(0 <= report.done <= report.total == 1 for report in light)
    assert reports[len(light) :] == [Progress("frames", 1, 2), Progress("frames", 2, 2)]


def test_a_finished_set_is_left_alone(made: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in made.rglob("*")}
    assert generate(small_plan("expected=true"), made) is False
    assert {p: p.stat().st_mtime_ns for p in made.rglob("*")} == before


@pytest.mark.parametrize("state", ["another recipe", "unfinished other", "foreign files", "a file", "damaged"])
def test_foreign_files_are_never_overwritten(made: Path, tmp_path: Path, state: str) -> None:
    directory = tmp_path / "set"
    plan = small_plan("expected=true")
    if state == "foreign files":
        directory.mkdir()
        (directory / "thesis.txt").write_text("years of work")
    elif state == "a file":
        directory.write_text("years of work")
    elif state == "unfinished other":
        directory.mkdir()
        (directory / "plan.json").write_text('{"provenance": {}}')
    else:
        directory.mkdir()
        for path in made.rglob("*"):
            target = directory / path.relative_to(made)
            target.mkdir(exist_ok=True) if path.is_dir() else target.write_bytes(path.read_bytes())
        if state == "damaged":
            (directory / "frames/000001.exr").write_bytes(b"x")
        else:
            plan = small_plan("expected=true", "seed=1")
    before = {p: p.read_bytes() for p in [directory, *directory.rglob("*")] if p.is_file()}
    with pytest.raises(InputError, match="choose another --out") as refusal:
        generate(plan, directory)
    assert "\n" not in str(refusal.value)
    assert {p: p.read_bytes() for p in [directory, *directory.rglob("*")] if p.is_file()} == before


@pytest.mark.parametrize("file", ["dataset.json", "plan.json"])
def test_a_set_of_another_version_is_left_alone(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str
) -> None:
    """The recipe gives other bits since: a finished set does not count as made, an unfinished one is not resumed."""
    provenance = json.loads((made / "dataset.json").read_text())["provenance"]
    (tmp_path / file).write_text(json.dumps({"provenance": provenance}))
    monkeypatch.setattr("vlcrender.dataset.run.unfinished.DATA_VERSION", DATA_VERSION + 1)
    with pytest.raises(InputError, match="another recipe, scene or version; nothing was changed"):
        generate(small_plan("expected=true"), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [file]


def records_of(directory: Path) -> list[FrameRecord]:
    """The frames of a finished set as its journal had them."""
    tables = [pq.read_table(directory / name).to_pylist() for name in ("frames.parquet", "truth.parquet")]
    entries = read_manifest(directory)
    files = [{n: e.model_dump() for n, e in entries.items() if Path(n).stem == f"{k:06d}"} for k in range(3)]
    rows = [{"device": d, "truth": t, "files": f} for d, t, f in zip(*tables, files, strict=True)]
    return [FrameRecord.model_validate_json(json.dumps(row)) for row in rows]


def test_a_frame_is_in_the_journal_before_it_is_reported(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that is killed then loses no frame that it reported. The frames here are those of another set."""

    def done_frames(tasks: Iterable[Task], *_: object) -> Iterator[Done]:
        yield from zip((job for task in tasks for job, _ in task), records_of(made), strict=True)

    monkeypatch.setattr("vlcrender.dataset.run.generate.done_frames", done_frames)
    lines: list[int] = []

    def count(report: Progress) -> None:
        if report.stage == "frames":
            lines.append((tmp_path / "set/journal.jsonl").read_bytes().count(b"\n"))

    generate(small_plan("expected=true"), tmp_path / "set", progress=count)
    assert lines == [1, 2, 3]


def test_impossible_poses_are_refused_before_the_first_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vlcrender.dataset.recipe.pose_sampling.TRIES", 100)
    plan = load_plan(RECIPE, [*SMALL, "poses.min_leds=500"])
    with pytest.raises(InputError, match=r"frame 0: no position .* 500 LEDs"):
        generate(plan, tmp_path / "never")
    assert not (tmp_path / "never").exists()


def test_the_exr_header_holds_no_pose(made: Path) -> None:
    with OpenEXR.File(str(made / "frames/000000.exr")) as file:
        header = dict(file.header())  # gone once the file is closed
    known = {
        *("channels", "compression", "dataWindow", "displayWindow", "lineOrder", "pixelAspectRatio", "type"),
        *("screenWindowCenter", "screenWindowWidth", "expTime", "aperture", "nominalFocalLength"),
        *("sensorPhotositePitch", "sensorOverallDimensions", "vlcrender:frame", "vlcrender:camera"),
    }
    assert set(header) <= known
    assert header["expTime"] == np.float32(1.6e-6)
    assert header["aperture"] == np.float32(2.2)
    assert header["nominalFocalLength"] == 18.0
    assert header["sensorPhotositePitch"] == 12.0
    assert np.allclose(header["sensorOverallDimensions"], [4.8, 3.6])


def test_frames_are_poisson_draws_of_the_expected_images(made: Path) -> None:
    """At 1 e/DN: z = (dn - expected) / sqrt(expected) has mean 0 and variance 1."""
    dataset = json.loads((made / "dataset.json").read_text())
    assert dataset["sensor"]["gain_e_per_dn"] == 1.0
    for index in range(3):
        with OpenEXR.File(str(made / f"frames/{index:06d}.exr"), separate_channels=True) as file:
            dn = file.channels()["Y"].pixels
        with OpenEXR.File(str(made / f"expected/{index:06d}.exr"), separate_channels=True) as file:
            expected = file.channels()["Y"].pixels.astype(float)
        assert dn.dtype == np.uint32
        # clipping at the largest number, 4095, biases values within 6 sigma of it
        assert expected.max() < 4095 - 6 * np.sqrt(4095)
        z = (dn - expected) / np.sqrt(expected)
        assert abs(z.mean()) < 5 / np.sqrt(z.size)
        # Var(z^2) = 2 + 1/mu for Poisson
        assert abs((z**2).mean() - 1) < 5 * np.sqrt((2 + 1 / expected).mean() / z.size)


def test_every_frame_sees_four_leds_and_its_tilts_fill_the_range(made: Path) -> None:
    truth = pq.read_table(made / "truth.parquet").to_pylist()
    for row in truth:
        assert sum(led["visible_fraction"] == 1 for led in row["leds"]) >= 4
    for axis in ("tilt_x_deg", "tilt_y_deg"):
        strata = sorted(int(row[axis] // 20) for row in truth)  # three frames, 0 to 60 deg
        assert strata == [0, 1, 2]


def test_the_accelerometer_reads_gravity_in_camera_axes(made: Path) -> None:
    frames = pq.read_table(made / "frames.parquet").to_pylist()
    truth = pq.read_table(made / "truth.parquet").to_pylist()
    for device, row in zip(frames, truth, strict=True):
        up = np.array(row["R_cam_world"]).reshape(3, 3)[:, 2]
        reading = np.array(device["accelerometer_m_s2"])
        assert np.linalg.norm(reading) == pytest.approx(9.80665)
        angle = np.degrees(np.arccos(np.clip(reading @ up / 9.80665, -1, 1)))
        # two tilt errors of 0.1 deg: the angle is below their root sum of squares, 5 sigma of each
        assert angle < 5 * 0.1 * np.sqrt(2)
        assert angle > 0


DAMAGES = {
    "frame missing": lambda d: (d / "frames/000001.exr").unlink(),
    "frame cut": lambda d: (d / "frames/000001.exr").write_bytes((d / "frames/000001.exr").read_bytes()[:1000]),
    "frame changed": lambda d: (d / "frames/000001.exr").write_bytes(
        (d / "frames/000001.exr").read_bytes()[:-1] + b"\0\1"
    ),
    "truth missing": lambda d: (d / "truth.parquet").unlink(),
    "truth is not parquet": lambda d: (d / "truth.parquet").write_bytes(b"PAR1 no"),
    "frames short": lambda d: pq.write_table(pq.read_table(d / "frames.parquet").slice(0, 2), d / "frames.parquet"),
    "column gone": lambda d: pq.write_table(
        pq.read_table(d / "frames.parquet").drop_columns(["exposure_s"]), d / "frames.parquet"
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_verify_reports_damage(made: Path, tmp_path: Path, damage: str) -> None:
    directory = tmp_path / "set"
    for path in [made, *made.rglob("*")]:
        target = directory / path.relative_to(made)
        target.mkdir(exist_ok=True) if path.is_dir() else target.write_bytes(path.read_bytes())
    assert verify(directory) == []
    DAMAGES[damage](directory)
    found = verify(directory)
    assert found, damage
    assert all("\n" not in line for line in found)


def test_verify_reports_a_truth_of_another_pose(made: Path, tmp_path: Path) -> None:
    directory = tmp_path / "set"
    for path in [made, *made.rglob("*")]:
        target = directory / path.relative_to(made)
        target.mkdir(exist_ok=True) if path.is_dir() else target.write_bytes(path.read_bytes())
    table = pq.read_table(directory / "truth.parquet")
    rows = table.to_pylist()
    rows[1]["position_m"][0] += 1e-4
    pq.write_table(table.from_pylist(rows, schema=table.schema), directory / "truth.parquet")
    assert any("frame 1" in line and "not where the pose puts it" in line for line in verify(directory))


LENSES = {
    "distorted": ["camera.distortion.k1=-0.05", "camera.focus_distance_m=2.0", "camera.skew_px=3.0"],
    # 300 px a radian: the sensor extends to 48 deg off the axis
    "equidistant": ["camera.projection=equidistant", "camera.pixel_pitch_um=60.0", "exposure_s=6e-8"],
}


@pytest.fixture(scope="module", params=LENSES)
def seen_by_a_lens(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("lens") / "set"
    generate(load_plan(RECIPE, [*SMALL, "poses.count=1", *LENSES[request.param]]), directory)
    return directory


def changed(made: Path, directory: Path, **entry: object) -> Path:
    """A copy with another entry for its camera."""
    shutil.copytree(made, directory)
    tree = json.loads((directory / "dataset.json").read_text())
    tree["cameras"]["main"].update(entry)
    (directory / "dataset.json").write_text(json.dumps(tree))
    return directory


@pytest.mark.slow
def test_verify_projects_through_the_lens(seen_by_a_lens: Path, tmp_path: Path) -> None:
    assert verify(seen_by_a_lens) == []
    another = changed(seen_by_a_lens, tmp_path / "pinhole", projection="perspective", distortion=None)
    told = "K or distortion differs from dataset.json's, but there is no [belief]"
    assert any("not where the pose puts it" in line or told in line for line in verify(another))
    directory = changed(seen_by_a_lens, tmp_path / "moved")
    table = pq.read_table(directory / "truth.parquet")
    for move in ([1e-4, 0.0, 0.0], [0.0, 0.0, 100.0]):  # the second puts the LEDs behind the camera
        rows = table.to_pylist()
        rows[0]["position_m"] = [a + b for a, b in zip(rows[0]["position_m"], move, strict=True)]
        pq.write_table(table.from_pylist(rows, schema=table.schema), directory / "truth.parquet")
        assert any("not where the pose puts it" in line for line in verify(directory))


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"projection": "stereographic"}, "projection"),
        ({"distortion": {"k1": -100}}, "folds the image"),
        ({"image_distance_mm": 17.0}, "image_distance_mm / pitch"),
        ({"width_px": 3}, "width_px = 3"),
    ],
)
def test_an_impossible_camera_is_refused_in_one_line(
    made: Path, tmp_path: Path, entry: dict[str, object], words: str
) -> None:
    with pytest.raises(InputError, match=words) as refusal:
        verify(changed(made, tmp_path / "set", **entry))
    assert "\n" not in str(refusal.value)
    assert "dataset.json" in str(refusal.value)


@pytest.mark.slow
def test_a_dead_worker_is_one_line_and_the_run_resumes(made: Path, tmp_path: Path) -> None:
    def kill_one(report: Progress) -> None:
        if (report.stage, report.done) == ("frames", 1):
            os.kill(multiprocessing.active_children()[0].pid or 0, signal.SIGKILL)

    with pytest.raises(InputError, match="a worker process died"):
        generate(small_plan("expected=true"), tmp_path / "set", workers=2, progress=kill_one)
    counts: list[float] = []
    generate(small_plan("expected=true"), tmp_path / "set", progress=frame_counts(counts))
    assert counts[0] >= 1
    assert digests(tmp_path / "set") == digests(made)


def started_with_workers(directory: Path) -> subprocess.Popen[str]:
    """A command line that makes many frames with two workers."""
    sets = [part for assignment in (*SMALL, "poses.count=300") for part in ("--set", assignment)]
    return started("vlcrender", "generate", str(RECIPE), "--out", str(directory), "--workers", "2", *sets)


@pytest.mark.slow
def test_an_interrupt_while_workers_start_is_one_line(tmp_path: Path) -> None:
    """Ctrl-C goes to the whole group of processes, also to children that are still importing.

    The event is the first child process once the plan is written: from there workers import for seconds, and 300
    frames are to be made.
    """
    process = started_with_workers(tmp_path / "set")
    command, plan = psutil.Process(process.pid), tmp_path / "set/plan.json"
    wait_until(lambda: plan.exists() and bool(command.children()), process)
    os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=HANG_S)
    assert process.returncode == 130
    assert "interrupted" in output
    assert "Traceback" not in output, output


@pytest.mark.slow
def test_workers_exit_with_their_parent(tmp_path: Path) -> None:
    """A kill that cannot be caught. They share its output, which ends with the last of them."""
    process = started_with_workers(tmp_path / "set")
    journal = tmp_path / "set/journal.jsonl"
    wait_until(lambda: journal.exists() and journal.stat().st_size > 0, process)
    process.kill()
    try:
        process.communicate(timeout=HANG_S)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def test_a_lost_preview_or_expected_image_is_found(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made, tmp_path / "set")
    (tmp_path / "set/expected/000001.exr").unlink()
    (tmp_path / "set/previews/000002.png").unlink()
    names = ("expected/000001.exr", "previews/000002.png")
    assert sorted(verify(tmp_path / "set")) == [f"{tmp_path}/set/{name}: is missing" for name in names]


@pytest.mark.slow
def test_a_frame_whose_preview_was_lost_is_made_again(made: Path, tmp_path: Path) -> None:
    """An unfinished run goes on: a journal of all three frames, and one preview gone."""
    generate(small_plan("expected=true"), tmp_path / "set")
    lines = [_line(record, None).decode() for record in records_of(tmp_path / "set")]
    provenance = json.loads((tmp_path / "set/dataset.json").read_text())["provenance"]
    (tmp_path / "set/dataset.json").unlink()
    (tmp_path / "set/plan.json").write_text(json.dumps({"provenance": provenance}))
    (tmp_path / "set/journal.jsonl").write_text("".join(lines))
    (tmp_path / "set/previews/000001.png").unlink()
    done: list[float] = []
    generate(small_plan("expected=true"), tmp_path / "set", progress=frame_counts(done))
    assert done == [2, 3]
    assert verify(tmp_path / "set") == []
    assert digests(tmp_path / "set") == digests(made)
