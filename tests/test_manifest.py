"""Manifest and seal: every changed, missing or additional file is found; what can be made again is, bit for bit."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL, copy_of, run, sealed, small_plan, unchanged

import vlcrender as vr
from vlcrender.core.digest import sha256_of
from vlcrender.dataset.format.files import read_json_object
from vlcrender.dataset.format.manifest import MANIFEST, read_manifest, seal_of
from vlcrender.dataset.verify.verify import verify

ASSIGNMENTS = ("expected=true", "processed.format=png")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of three frames with every kind of file, in a folder of its own."""
    folder = tmp_path_factory.mktemp("manifest") / "set"
    assert vr.generate(small_plan(*ASSIGNMENTS), folder)
    with unchanged(folder):
        yield folder  # type: ignore[misc]


@pytest.fixture
def copied(made: Path, tmp_path: Path) -> Path:
    return copy_of(made, tmp_path / "set")


def content(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def change_rows(folder: Path, table: str, change: Callable[[list[dict[str, object]]], object]) -> None:
    """Other rows, with the digests of the changed file: nothing but the values tells."""
    old = pq.read_table(folder / table)
    rows = old.to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows, old.schema), folder / table)
    sealed(folder)


def test_the_manifest_has_every_file_and_the_seal_covers_it(made: Path) -> None:
    """Digests and sizes taken anew; the canonical JSON of FORMAT.md written out."""
    entries = json.loads((made / MANIFEST).read_text())["files"]
    files = {name for name in content(made) if name not in ("dataset.json", MANIFEST)}
    assert set(entries) == files
    assert len(files) == 2 + 3 * 4
    for name, entry in entries.items():
        assert entry == {"sha256": sha256_of(made / name), "bytes": (made / name).stat().st_size}
    tree = read_json_object(made / "dataset.json")
    assert tree["manifest_sha256"] == sha256_of(made / MANIFEST)
    assert tree["seal"] == seal_of(tree)
    # printf '{"a":null,"b":[1.5,"\\u00e9"]}' | sha256sum
    by_hand = "4f88a8a6862b85dbcd4bff8f7eebddca4eedba17dcf8931a9a182a9a381175e1"
    assert seal_of({"b": [1.5, "é"], "seal": "x", "a": None}) == by_hand


@pytest.mark.parametrize(
    "name",
    ["frames.parquet", "truth.parquet", "frames/000001.exr", "expected/000000.exr", "previews/000002.png"]
    + ["processed/000001.png", MANIFEST],
)
def test_a_changed_a_cut_and_a_missing_file_are_found_and_made_again(made: Path, copied: Path, name: str) -> None:
    data = (made / name).read_bytes()
    for change in (data[:-100], bytes([data[0] ^ 1]) + data[1:], None):
        (copied / name).unlink()
        if change is not None:
            (copied / name).write_bytes(change)
        assert any(f"{copied / name}: " in line for line in verify(copied))
    done = vr.repair(copied)
    assert len(done) == 1
    assert done[0].startswith(f"{name}: made again")
    assert content(copied) == content(made)


def test_damage_of_the_manifest_and_of_files_is_repaired_together(made: Path, copied: Path) -> None:
    (copied / MANIFEST).unlink()
    (copied / "expected/000001.exr").write_bytes(b"x")
    assert vr.repair(copied) == [f"{MANIFEST}: made again", "expected/000001.exr: made again"]
    assert content(copied) == content(made)
    assert vr.repair(copied) == []


def test_a_file_of_other_bits_is_not_put_in_place(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that makes other frames leaves the damaged one: a mixed set is worse than a missing frame."""
    monkeypatch.setattr("vlcrender.dataset.run.frame_job.random_key", lambda *_: (1, 2))
    (copied / "frames/000001.exr").write_bytes(b"x")
    (line,) = vr.repair(copied)
    assert line == "frames/000001.exr: this program and its libraries make another one; it was left as it is"
    assert (copied / "frames/000001.exr").read_bytes() == b"x"


def test_files_too_many_are_found_and_hidden_ones_and_those_of_the_estimator_are_not(copied: Path) -> None:
    for name in (".DS_Store", ".vlcrender.lock", "estimates/pnp.parquet", "scores.json", "report.html"):
        (copied / name).parent.mkdir(exist_ok=True)
        (copied / name).write_bytes(b"x")
    assert verify(copied) == []
    (copied / "frames/000003.exr").write_bytes(b"x")
    (copied / "notes.txt").write_bytes(b"x")
    assert verify(copied) == [f"{copied / name}: is not in {MANIFEST}" for name in ("frames/000003.exr", "notes.txt")]


def test_a_changed_value_of_dataset_json_breaks_the_seal(copied: Path) -> None:
    tree = read_json_object(copied / "dataset.json")
    tree["led_map"][3]["position_m"][0] += 1e-9
    (copied / "dataset.json").write_text(json.dumps(tree))
    assert f"{copied / 'dataset.json'}: seal differs: the file was changed after it was written" in verify(copied)
    with pytest.raises(vr.InputError, match="seal differs"):
        vr.repair(copied)


def test_other_spaces_and_order_of_keys_keep_the_seal(copied: Path) -> None:
    tree = read_json_object(copied / "dataset.json")
    (copied / "dataset.json").write_text(json.dumps(dict(reversed(tree.items())), indent=7))
    assert verify(copied) == []


def test_a_set_before_manifests_is_named_and_gets_one_if_nothing_else_is_wrong(made: Path, copied: Path) -> None:
    def without_manifest(folder: Path) -> None:
        tree = read_json_object(folder / "dataset.json")
        (folder / MANIFEST).unlink(missing_ok=True)
        kept = {key: value for key, value in tree.items() if key not in ("manifest_sha256", "seal")}
        (folder / "dataset.json").write_text(json.dumps(kept))

    without_manifest(copied)
    (problem,) = verify(copied)
    assert "made before there were manifests" in problem
    damaged = copy_of(copied, copied.parent / "damaged")
    (damaged / "expected/000000.exr").write_bytes((made / "expected/000000.exr").read_bytes()[:100])
    assert any("expected/000000.exr: cannot be read" in line for line in verify(damaged))
    assert vr.repair(damaged) == []
    assert len(vr.repair(copied)) == 1
    assert content(copied)[MANIFEST] == content(made)[MANIFEST]
    assert read_json_object(copied / "dataset.json") == read_json_object(made / "dataset.json")


def swap(rows: list[dict[str, object]], keys: tuple[str, ...]) -> None:
    for key in keys:
        rows[0][key], rows[1][key] = rows[1][key], rows[0][key]


POSE = ("position_m", "R_cam_world", "tilt_x_deg", "tilt_y_deg", "yaw_deg", "leds")
WRONG_VALUES: dict[str, tuple[str, Callable[[list[dict[str, object]]], object], str]] = {
    "exposure": ("frames.parquet", lambda r: r[1].update(exposure_s=1.6e-5), "frame 1: exposure_s = 1.6e-05"),
    "accelerometer": (
        "frames.parquet",
        lambda r: r[0].update(accelerometer_m_s2=[0.0, 0.0, 9.8]),
        "frame 0: accelerometer_m_s2 is not that of pose and seed",
    ),
    "no spots": ("frames.parquet", lambda r: r[2].update(spots=[]), "frame 2: has no spot of LED"),
    "shot": ("frames.parquet", lambda r: r[2].update(shot=1), "frame 2: shot is 1; the recipe gives 2"),
    "pose": ("frames.parquet", lambda r: r[1].update(pose=0), "frame 1: pose is 0; the recipe gives 1"),
    "device": ("frames.parquet", lambda r: r[1].update(device=3), "frame 1: device is 3; the recipe gives 0"),
    "start": (
        "frames.parquet",
        lambda r: r[0].update(start_s=1.0),
        "frame 0: start_s = 1.0: the recipe and seed give 0.0",
    ),
    "file": (
        "frames.parquet",
        lambda r: swap(r, ("file", "sha256")),
        "frame 0: file is 'frames/000001.exr'; the recipe gives 'frames/000000.exr'",
    ),
    "tilt": ("truth.parquet", lambda r: r[1].update(tilt_x_deg=1.0), "frame 1: R_cam_world is not that of tilt_x_deg"),
    "swapped truth": ("truth.parquet", lambda r: swap(r, POSE), "not where truth.parquet has the LEDs of frame 1"),
    "visible": (
        "truth.parquet",
        lambda r: r[0]["leds"][0].update(visible_fraction=1.5),  # type: ignore[index]
        "frame 0: a visible_fraction is not from 0 to 1",
    ),
    "bound": ("truth.parquet", lambda r: r[0].update(bound_m2=[1.0] * 9), "bound_m2 is no covariance, or the recipe"),
    "velocity": ("truth.parquet", lambda r: r[0].update(linear_velocity_m_s=[0.0] * 3), "velocities and [motion]"),
}


@pytest.mark.parametrize("case", WRONG_VALUES)
def test_a_wrong_value_is_found_although_every_digest_is_right(copied: Path, case: str) -> None:
    table, change, words = WRONG_VALUES[case]
    change_rows(copied, table, change)
    found = verify(copied)
    assert any(words in line for line in found), found


def test_frames_with_their_files_exchanged_are_found_by_their_headers(copied: Path) -> None:
    """Row and file agree in all digests; the header of each file has the number of the other frame."""
    one, other = copied / "frames/000000.exr", copied / "frames/000001.exr"
    data = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(data)
    change_rows(copied, "frames.parquet", lambda rows: swap(rows, ("sha256",)))
    assert any("vlcrender:frame of its header is 1; frames.parquet has 0" in line for line in verify(copied))


def test_a_run_that_was_killed_after_its_last_file_is_complete(copied: Path) -> None:
    """plan.json and journal.jsonl are removed after dataset.json is there: what is left of them is no damage."""
    for name in ("plan.json", "journal.jsonl"):
        (copied / name).write_text("{}")
    assert verify(copied) == []
    assert vr.generate(small_plan(*ASSIGNMENTS), copied) is False
    assert not (copied / "plan.json").exists()
    assert not (copied / "journal.jsonl").exists()


def test_verify_repair_on_the_command_line(made: Path, copied: Path) -> None:
    (copied / "previews/000000.png").unlink()
    assert run("vlcrender", "verify", str(copied)).returncode == 2
    finished = run("vlcrender", "verify", str(copied), "--repair")
    assert finished.returncode == 0, finished.stderr
    assert "previews/000000.png: made again" in finished.stdout
    assert "all there and intact" in finished.stdout


def test_a_sweep_has_a_seal_and_its_cells_are_repaired(tmp_path: Path) -> None:
    sweep = 'sweep=[{ key = "exposure_s", values = [1e-6, 2e-6] }]'
    plan = vr.load_recipe(
        ROOT / "datasets/quickstart.toml", [*SMALL[:3], "poses.border_px=4.0", "poses.count=1", sweep]
    )
    folder = tmp_path / "sweep"
    vr.generate(plan, folder)
    assert verify(folder) == []
    before = content(folder)
    (folder / "cells/000001/frames/000000.exr").write_bytes(b"x")
    shutil.copytree(folder / "cells/000000", folder / "cells/000002")
    found = verify(folder)
    assert [line.rpartition(": ")[0] for line in found] == [
        str(folder / "cells/000002"),
        str(folder / "cells/000001/frames/000000.exr: SHA-256 differs from manifest.json"),
    ]
    shutil.rmtree(folder / "cells/000002")
    assert vr.repair(folder) == ["cells/000001: frames/000000.exr: made again"]
    assert content(folder) == before
    (folder / "cells/000000/dataset.json").unlink()
    (folder / "cells/000001/frames.parquet").unlink()
    lines = vr.repair(folder)
    assert lines[0].startswith("cells/000000: not repaired: ")
    assert lines[1:] == ["cells/000001: frames.parquet: made again"]
    (folder / "cells/000000/dataset.json").write_bytes(before["cells/000000/dataset.json"])
    assert verify(folder) == []
    tree = read_json_object(folder / "sweep.json")
    tree["name"] = "another"
    (folder / "sweep.json").write_text(json.dumps(tree))
    assert verify(folder) == [f"{folder / 'sweep.json'}: seal differs: the file was changed after it was written"]


def test_entries_are_of_the_frames_as_they_were_made(made: Path) -> None:
    """Of the journal, not of the files at the end: damage between both is found."""
    rows = pq.read_table(made / "frames.parquet").to_pylist()
    entries = read_manifest(made)
    assert [entries[row["file"]].sha256 for row in rows] == [row["sha256"] for row in rows]
    assert np.all([entry.bytes > 0 for entry in entries.values()])
