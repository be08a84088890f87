"""Sweeps: cells are datasets as their recipes alone make them, views are rendered once, files are shared."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenEXR
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL, run, unchanged
from scipy import stats

import vlcrender as vr
from vlcrender.core.digest import sha256_of
from vlcrender.dataset.format import files
from vlcrender.dataset.recipe.dependence import keyed_recipe
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.recipe.sweep import SweepTable
from vlcrender.dataset.run import frame_job
from vlcrender.dataset.run.progress import Progress
from vlcrender.errors import InputError

QUICKSTART = ROOT / "datasets/quickstart.toml"
REGIONS = (*SMALL, "poses.count=2", "regions.kind=leds", "regions.margin_px=3", "sensor.noise=full")
ERRORS_DEG = (0.1, 0.5)
READ_NOISE_E = (0.0, 3.0)
SWEPT = (
    *(*REGIONS, "bound=true"),
    'sweep=[{ key = "accelerometer.error_deg", values = [0.1, 0.5] }, '
    '{ key = "sensor.read_noise_e", values = [0, 3] }]',
)


class Counts:
    """How often views are rendered and frames exposed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.rendered = self.exposed = 0
        render, expose = frame_job._rendered, frame_job.expose_regions

        def counted_render(*arguments: object) -> object:
            self.rendered += 1
            return render(*arguments)  # type: ignore[arg-type]

        def counted_expose(*arguments: object, **options: object) -> object:
            self.exposed += 1
            return expose(*arguments, **options)  # type: ignore[arg-type]

        monkeypatch.setattr(frame_job, "_rendered", counted_render)
        monkeypatch.setattr(frame_job, "expose_regions", counted_expose)
        frame_job._views_at.cache_clear()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two poses, two accelerometers, two read noises."""
    directory = tmp_path_factory.mktemp("sweep") / "set"
    with pytest.MonkeyPatch.context() as patch:
        counts = Counts(patch)
        assert vr.generate(load_plan(QUICKSTART, SWEPT), directory)
    assert counts.rendered == 2, "one view for each pose"
    assert counts.exposed == 4, "one for each pose and read noise"
    with unchanged(directory):
        yield directory


def copied(made: Path, to: Path) -> Path:
    return Path(shutil.copytree(made, to / "set"))


def pixels(path: Path) -> list[np.ndarray]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return [part.channels["Y"].pixels.copy() for part in file.parts]


def cells_of(*sweeps: str, poses: int = 2) -> list[dict[str, float | str]]:
    plan = load_plan(QUICKSTART, [f"poses.count={poses}", f"sweep=[{', '.join(sweeps)}]"])
    assert plan.cells is not None
    return [dict(cell.values) for cell in plan.cells.sweep]


def test_the_last_sweep_varies_fastest() -> None:
    found = cells_of(
        '{ key = "accelerometer.error_deg", values = [0.1, 0.5] }',
        '{ key = "sensor.iso", grid = [100, 400, 3], name = "speed" }',
    )
    assert found == [{"error_deg": error, "speed": iso} for error in ERRORS_DEG for iso in (100.0, 250.0, 400.0)]


def test_a_grid_has_both_ends_and_keeps_integers() -> None:
    """(0.7 - 0.1) / 3 is no binary fraction: the last value is the end itself. A width has to be an integer."""
    grid = SweepTable(key="x", grid=(0.1, 0.7, 4))
    values = [grid.row(number, 0, None)[0] for number in range(4)]
    assert (values[0], values[-1]) == (0.1, 0.7)
    assert values == pytest.approx(np.linspace(0.1, 0.7, 4).tolist(), rel=1e-15)
    plan = load_plan(QUICKSTART, ['sweep=[{ key = "camera.width_px", grid = [400, 4000, 4] }]'])
    assert plan.cells is not None
    assert [plan.cells.plan(n).recipe.camera.width_px for n in range(4)] == [400, 1600, 2800, 4000]


def test_keys_change_together() -> None:
    sizes = '{ key = ["camera.width_px", "camera.height_px"], values = [[400, 300], [800, 600]] }'
    assert cells_of(sizes) == [{"width_px": 400.0, "height_px": 300.0}, {"width_px": 800.0, "height_px": 600.0}]


def test_values_that_are_not_all_numbers_are_texts() -> None:
    focus = '{ key = "camera.focus_distance_m", values = [2, "infinity"] }'
    assert cells_of(focus, '{ key = "bound", values = [true] }') == [
        {"focus_distance_m": "2", "bound": "true"},
        {"focus_distance_m": "infinity", "bound": "true"},
    ]


def test_uniform_values_belong_to_poses_whatever_else_is_swept() -> None:
    errors = '{ key = "accelerometer.error_deg", uniform = [0.1, 0.9] }'
    alone = [cell["error_deg"] for cell in cells_of(errors, poses=3)]
    other = cells_of('{ key = "sensor.iso", values = [100, 200] }', errors, poses=3)
    assert [(cell["iso"], cell["error_deg"]) for cell in other] == [(iso, e) for iso in (100.0, 200.0) for e in alone]
    seeded = load_plan(QUICKSTART, [f"sweep=[{errors}]", "seed=1"]).cells
    assert seeded is not None
    assert [cell.values["error_deg"] for cell in seeded.sweep][:3] != alone


def test_uniform_values_fill_their_range() -> None:
    """One in 10 000 true samples would fail each."""
    table = SweepTable(key="accelerometer.error_deg", uniform=(2.0, 5.0))
    other = SweepTable(key="accelerometer.bias_m_s2", uniform=(2.0, 5.0))
    drawn = np.array([[t.row(0, 7, pose)[0] for pose in range(2000)] for t in (table, other)], dtype=float)
    for values in drawn:
        assert stats.kstest((values - 2) / 3, "uniform").pvalue > 1e-4
    assert stats.pearsonr(*drawn).pvalue > 1e-4, "each key has a stream of its own"


REFUSALS = {
    "sweep cell 0 (eror_deg = 0.1): unknown key accelerometer.eror_deg; did you mean error_deg?": (
        '{ key = "accelerometer.eror_deg", values = [0.1] }'
    ),
    "sweep cell 1 (f_number = 0.1): camera.f_number = 0.1: input should be greater": (
        '{ key = "camera.f_number", values = [2, 0.1] }'
    ),
    "sweep cell 0 (radius_m = -1.0): ": '{ key = "scene.panels.0.leds.radius_m", values = [-1] }',
    "scene.panels.3.leds.radius_m=1: no item 3: 1 items": '{ key = "scene.panels.3.leds.radius_m", values = [1] }',
    "sweep: sweeps camera.f_number twice": (
        '{ key = "camera.f_number", values = [2] }, { key = "camera . f_number", values = [3], name = "n" }'
    ),
    "sweep: sweeps camera.distortion and camera.distortion.k1": (
        '{ key = "camera.distortion.k1", values = [0.0] }, { key = "camera.distortion", values = [{ k1 = 0.0 }] }'
    ),
    "sweep: camera.f_number and sensor.iso are both named 'x'": (
        '{ key = "camera.f_number", values = [2], name = "x" }, { key = "sensor.iso", values = [100], name = "x" }'
    ),
    "sweep[0].uniform: [2.0, 1.0] of camera.f_number: the lower value comes first": (
        '{ key = "camera.f_number", uniform = [2, 1] }'
    ),
    "sweep: 1000 x 101 = 101000 cells of f_number, iso; at most 100000": (
        '{ key = "camera.f_number", grid = [1, 2, 1000] }, { key = "sensor.iso", grid = [100, 200, 101] }'
    ),
    "sweep[0].key: 'camera.f_number': give exactly one of values, grid and uniform; found none": (
        '{ key = "camera.f_number" }'
    ),
    "found values and grid": '{ key = "camera.f_number", values = [2], grid = [1, 2, 2] }',
    "sweep[0].values: [400] of camera.width_px, camera.height_px: has to be a list of 2": (
        '{ key = ["camera.width_px", "camera.height_px"], values = [[400]] }'
    ),
    "sweep[0].name: gives 2 of 1 names": '{ key = "camera.f_number", values = [2], name = ["a", "b"] }',
    "unknown key sweep[0].step; ": '{ key = "camera.f_number", values = [2], step = 1 }',
    "uniform makes each pose a cell": (
        '{ key = "poses.count", values = [2, 3] }, { key = "accelerometer.error_deg", uniform = [0, 1] }'
    ),
}


@pytest.mark.parametrize("words", REFUSALS)
def test_a_sweep_that_is_wrong_is_refused_in_one_line(words: str) -> None:
    with pytest.raises(InputError) as refusal:
        load_plan(QUICKSTART, [f"sweep=[{REFUSALS[words]}]"])
    message = str(refusal.value)
    assert message.startswith(f"{QUICKSTART} with --set: ")
    assert words in message
    assert "\n" not in message


def test_sweep_json_lists_keys_and_cells(made: Path) -> None:
    tree = json.loads((made / "sweep.json").read_text())
    assert not (made / "plan.json").exists()
    assert (tree["format"], tree["version"], tree["name"]) == ("vlcrender-sweep", 1, "quickstart")
    assert tree["sweep"] == [
        {"name": "error_deg", "key": "accelerometer.error_deg", "kind": "values"},
        {"name": "read_noise_e", "key": "sensor.read_noise_e", "kind": "values"},
    ]
    values = [(error, noise) for error in ERRORS_DEG for noise in READ_NOISE_E]
    assert tree["cells"] == [
        {"folder": f"cells/{n:06d}", "pose": None, "values": {"error_deg": error, "read_noise_e": noise}}
        for n, (error, noise) in enumerate(values)
    ]


def test_a_cell_is_the_dataset_of_its_values(made: Path, tmp_path: Path) -> None:
    """Frames and tables have the bytes, or rows, of the plain set; the truth has the cell's values beside."""
    assert vr.verify(made) == []
    plain = [a for a in SWEPT if not a.startswith("sweep")]
    vr.generate(load_plan(QUICKSTART, [*plain, "accelerometer.error_deg=0.5", "sensor.read_noise_e=3"]), tmp_path / "x")
    cell = made / "cells/000003"
    for number in range(2):
        for name in (f"frames/{number:06d}.exr", f"previews/{number:06d}.png"):
            assert (cell / name).read_bytes() == (tmp_path / "x" / name).read_bytes()
    assert pq.read_table(cell / "frames.parquet").equals(pq.read_table(tmp_path / "x/frames.parquet"))
    truth, alone = (pq.read_table(folder / "truth.parquet") for folder in (cell, tmp_path / "x"))
    assert truth.schema.names == [*alone.schema.names, "sweep_error_deg", "sweep_read_noise_e"]
    assert truth.select(alone.schema.names).equals(alone)
    assert truth["sweep_error_deg"].to_pylist() == [0.5, 0.5]
    assert truth["sweep_read_noise_e"].type == pa.float64()
    told, told_alone = (json.loads((folder / "dataset.json").read_text()) for folder in (cell, tmp_path / "x"))
    assert told["provenance"].pop("sweep") == {"error_deg": 0.5, "read_noise_e": 3.0}
    for key in ("manifest_sha256", "seal"):  # truth.parquet has the cell's values beside
        assert told.pop(key) != told_alone.pop(key)
    assert told["summary"].pop("bytes") > told_alone["summary"].pop("bytes")
    assert told == told_alone


def test_frames_that_differ_in_the_accelerometer_alone_are_one_file(made: Path) -> None:
    for noise in range(2):
        first, second = (made / f"cells/{cell:06d}" for cell in (noise, noise + 2))
        for name in ("frames/000001.exr", "previews/000001.png"):
            assert os.path.samefile(first / name, second / name)
        readings = [pq.read_table(c / "frames.parquet")["accelerometer_m_s2"].to_pylist() for c in (first, second)]
        assert readings[0] != readings[1]
        bounds = [pq.read_table(c / "truth.parquet")["bound_m2"].to_pylist() for c in (first, second)]
        assert bounds[0] != bounds[1], "each accelerometer counts in its own bound"
    assert not os.path.samefile(made / "cells/000000/frames/000000.exr", made / "cells/000001/frames/000000.exr")


def test_files_are_copied_where_the_file_system_does_not_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*paths: object) -> None:
        raise OSError(95, "not supported")

    (tmp_path / "a").write_bytes(b"frame")
    files.link_or_copy(tmp_path / "a", tmp_path / "linked")
    files.link_or_copy(tmp_path / "a", tmp_path / "linked")  # again, as after an interruption
    monkeypatch.setattr(os, "link", refused)
    files.link_or_copy(tmp_path / "a", tmp_path / "copied")
    assert os.path.samefile(tmp_path / "a", tmp_path / "linked")
    assert not os.path.samefile(tmp_path / "a", tmp_path / "copied")
    assert (tmp_path / "copied").read_bytes() == b"frame"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "copied", "linked"]


def test_a_finished_sweep_is_left_alone(made: Path) -> None:
    assert vr.generate(load_plan(QUICKSTART, SWEPT), made) is False
    with pytest.raises(InputError, match="holds a sweep of another recipe"):
        vr.generate(load_plan(QUICKSTART, [*SWEPT, "seed=1"]), made)
    with pytest.raises(InputError, match="neither empty nor a dataset"):
        vr.generate(load_plan(QUICKSTART, REGIONS), made)


class Crash(Exception):
    pass


def test_an_interrupted_sweep_resumes(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames are made pose by pose over all cells: after six of eight, pose 1 has frames in cells 0 and 1."""

    def crash(report: Progress) -> None:
        if (report.stage, report.done) == ("frames", 6):
            raise Crash

    plan, directory = load_plan(QUICKSTART, SWEPT), tmp_path / "set"
    with pytest.raises(Crash):
        vr.generate(plan, directory, progress=crash)
    assert not (directory / "sweep.json").exists()
    assert [(directory / f"cells/{n:06d}/dataset.json").exists() for n in range(4)] == [True, False, False, False]
    with pytest.raises(InputError, match="an unfinished sweep of another recipe"):
        vr.generate(load_plan(QUICKSTART, [*SWEPT, "seed=1"]), directory)
    reports: list[float] = []
    counts = Counts(monkeypatch)
    assert vr.generate(plan, directory, progress=lambda r: reports.append(r.done) if r.stage == "frames" else None)
    assert reports == [6, 7, 8]
    assert counts.rendered == 1
    for path in made.rglob("*.exr"):
        assert sha256_of(directory / path.relative_to(made)) == sha256_of(path)
    assert (directory / "sweep.json").read_bytes() == (made / "sweep.json").read_bytes()
    assert vr.verify(directory) == []


@pytest.mark.slow
def test_two_workers_make_the_same_bytes(made: Path, tmp_path: Path) -> None:
    vr.generate(load_plan(QUICKSTART, SWEPT), tmp_path / "set", workers=2)
    for path in [path for path in made.rglob("*") if path.is_file()]:
        assert (tmp_path / "set" / path.relative_to(made)).read_bytes() == path.read_bytes(), path


def test_verify_finds_damage_in_any_cell(made: Path, tmp_path: Path) -> None:
    directory = copied(made, tmp_path)
    (directory / "cells/000002/frames/000001.exr").unlink()
    table = pq.read_table(directory / "cells/000003/truth.parquet")
    changed = table.set_column(table.num_columns - 1, "sweep_read_noise_e", pa.array([3.0, 4.0]))
    pq.write_table(changed, directory / "cells/000003/truth.parquet")
    (directory / "cells/000000/dataset.json").unlink()
    tree = json.loads((directory / "sweep.json").read_text())
    tree["cells"][1]["values"]["error_deg"] = 0.2
    (directory / "sweep.json").write_text(json.dumps(tree))
    found = "\n".join(vr.verify(directory))
    assert "cells/000002/frames/000001.exr: is missing" in found
    assert "cells/000003/truth.parquet: row 1: sweep_read_noise_e is 4.0; the dataset's is 3.0" in found
    assert "cells/000000: is not a complete dataset" in found
    assert "cells/000001/dataset.json: its values are" in found


def test_the_command_line_makes_and_verifies_cells(made: Path, tmp_path: Path) -> None:
    """`--set` acts on the swept recipe, also on a sweep's own values."""
    recipe = tmp_path / "swept.toml"
    text = QUICKSTART.read_text().replace("../scenes", str(ROOT / "scenes"))
    recipe.write_text(text + '\n[[sweep]]\nkey = "accelerometer.error_deg"\nvalues = [0.1, 0.5, 1.0]\n')
    sets = [word for a in (*REGIONS, "poses.count=1", "sweep.0.values=[0.2, 0.3]") for word in ("--set", a)]
    finished = run("vlcrender", "generate", str(recipe), "--out", str(tmp_path / "set"), *sets)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout == f"{tmp_path / 'set'}: 2 cells, 2 frames\n"
    assert "2 cells, all there and intact" in run("vlcrender", "verify", str(tmp_path / "set")).stdout
    (tmp_path / "set/cells/000001/frames/000000.exr").unlink()
    assert run("vlcrender", "verify", str(tmp_path / "set")).returncode == 2
    assert "sweep=[]" in run("vlcrender", "budget", str(recipe)).stderr


def test_a_uniform_cell_is_one_pose_of_the_whole_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pose, pixels and reading are those of the frame in a plain set with this value."""
    uniform = 'sweep=[{ key = "accelerometer.error_deg", uniform = [0.1, 0.9] }, { key = "bound", values = [false] }]'
    counts = Counts(monkeypatch)
    vr.generate(load_plan(QUICKSTART, [*REGIONS, uniform]), tmp_path / "set")
    assert counts.rendered == 2
    cell = json.loads((tmp_path / "set/sweep.json").read_text())["cells"][1]
    assert cell["pose"] == 1
    value = cell["values"]["error_deg"]
    vr.generate(load_plan(QUICKSTART, [*REGIONS, f"accelerometer.error_deg={value!r}"]), tmp_path / "plain")
    frame, truth = (pq.read_table(tmp_path / "set/cells/000001" / f"{n}.parquet") for n in ("frames", "truth"))
    known, true = (pq.read_table(tmp_path / "plain" / f"{n}.parquet").slice(1) for n in ("frames", "truth"))
    for name in ("accelerometer_m_s2", "spots", "exposure_s"):
        assert frame[name].to_pylist() == known[name].to_pylist()
    for name in ("position_m", "R_cam_world", "leds"):
        assert truth[name].to_pylist() == true[name].to_pylist()
    for name in ("frame", "shot", "burst", "pose"):
        assert frame[name].to_pylist() == [0]
    paths = (tmp_path / "set/cells/000001/frames/000000.exr", tmp_path / "plain/frames/000001.exr")
    for own, plain in zip(*map(pixels, paths), strict=True):
        assert np.array_equal(own, plain)
    assert vr.verify(tmp_path / "set") == []


def test_keys_of_the_scene_are_swept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice the ambient light, on one camera pose: all else, and the LEDs' own light, stays."""
    counts = Counts(monkeypatch)
    sweep = 'sweep=[{ key = "scene.ambient.illuminance_lux", values = [200, 400], name = "lux" }]'
    plan = load_plan(QUICKSTART, [*SMALL, "poses.count=1", "expected=true", "scene=../scenes/table1.toml", sweep])
    vr.generate(plan, tmp_path / "set")
    assert counts.rendered == 2
    dim, bright = (pixels(tmp_path / f"set/cells/{n:06d}/expected/000000.exr")[0] for n in range(2))
    tables = [pq.read_table(tmp_path / f"set/cells/{n:06d}/truth.parquet") for n in range(2)]
    assert [table["sweep_lux"].to_pylist() for table in tables] == [[200.0], [400.0]]
    assert tables[0]["position_m"].equals(tables[1]["position_m"])
    assert (bright > dim).all()
    with pytest.raises(InputError, match="twice"):
        load_plan(QUICKSTART, ['sweep=[{ key = "scene", values = ["office"] }, { key = "scene", values = ["hall"] }]'])


CALIBRATED = ("belief.preset=calibrated",)
MOVING = ("motion.linear_velocity_m_s=[0.1, 0, 0]", "exposure_s=1e-6")
SHARED_BY = {
    "accelerometer.error_deg=0.7": ("views and files", ()),
    "gyroscope={ noise_deg_s = 1.0, bias_deg_s = 1.0 }": ("views and files", ()),
    "bound=true": ("views and files", ()),
    "belief.accelerometer={ device_error_deg = 0.1, shot_error_deg = 0.1 }": ("views and files", CALIBRATED),
    "belief.stated_factor=2.0": ("views and files", CALIBRATED),
    "exposure_s=2e-6": ("views", ()),
    "sensor.read_noise_e=1.0": ("views", ()),
    "sensor.gain_e_per_dn=2.0": ("views", ()),
    "added_noise={ level_db = -9, relative_to = 'peak' }": ("views", ()),
    "expected=true": ("views", ()),
    "files.previews=0": ("views", ()),
    "sensor.crosstalk=0.1": ("nothing", ()),
    "camera.f_number=4.0": ("nothing", ()),
    "seed=1": ("nothing", ()),
    "poses.count=9": ("nothing", ()),
    "belief.camera.focal_percent=0.5": ("nothing", CALIBRATED),
    "motion.linear_velocity_m_s=[0.2, 0, 0]": ("nothing", MOVING),
    "exposure_s=3e-6": ("nothing", MOVING),
}
"""An assignment: what recipes with and without it share, and what both have."""


@pytest.mark.parametrize("assignment", SHARED_BY)
def test_recipes_share_what_does_not_depend_on_their_difference(assignment: str) -> None:
    shared, both = SHARED_BY[assignment]
    one, other = (
        keyed_recipe(load_plan(QUICKSTART, [*both, *own]).recipe.model_dump_json()) for own in ((), (assignment,))
    )
    assert one.recipe != other.recipe
    assert (one.seen == other.seen) == shared.startswith("views")
    assert (one.files_key == other.files_key) == shared.endswith("files")


def test_an_impossible_pose_of_a_cell_is_named(tmp_path: Path) -> None:
    here = "poses={ kind = 'list', pose = [{ position_m = [3.0, 3.0, 1.0] }] }"
    sweep = 'sweep=[{ key = "poses.pose.0.position_m.2", values = [1.0, 9.0] }]'
    plan = load_plan(QUICKSTART, [*SMALL[:4], here, sweep])
    refused = r"--set: sweep cell 1 \(2 = 9.0\): poses: pose 0: camera position .* is not inside the room"
    with pytest.raises(InputError, match=refused):
        vr.generate(plan, tmp_path / "never")
    assert not (tmp_path / "never").exists()
