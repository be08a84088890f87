"""A withheld truth: nothing in the set gives it away, its key opens it, and the released set is the ordinary one."""

import json
import re
import stat
import struct
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL, copy_of, run, small_plan, unchanged
from PIL import Image

import estimator as est
import vlcrender as vr
from estimator.evaluate.submission import score_bundles, submit
from estimator.io.estimates import EstimateRow, write_estimates
from vlcrender.dataset.format.manifest import read_manifest, seal_dataset
from vlcrender.dataset.run.progress import FRAMES_STAGE, Progress
from vlcrender.errors import InputError
from vlcrender.report.contents import Contents
from vlcrender.report.page import page

REGIONS = ("regions.kind=leds", "files.previews=1")
SPLIT = ("split.block_m=0.5", "split.train=0.5", "split.validation=0.0", "split.test=0.5", "poses.count=6")


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def key(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("keys") / "key"


@pytest.fixture(scope="module")
def withheld(key: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Three full frames, all withheld."""
    folder = tmp_path_factory.mktemp("withheld") / "set"
    assert vr.generate(small_plan(), folder, withhold_truth=key)
    with unchanged(folder):
        yield folder


@pytest.fixture(scope="module")
def released(withheld: Path, key: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = copy_of(withheld, tmp_path_factory.mktemp("released") / "set")
    vr.release(folder, key)
    with unchanged(folder):
        yield folder


@pytest.fixture(scope="module")
def split_key(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A key whose seed puts frames on both sides of the split: by chance, all six would be on one once in 32 keys."""
    path = tmp_path_factory.mktemp("keys") / "split"
    path.write_text(f"vlcrender-truth-key-1 {'01' * 32}\n")
    return path


@pytest.fixture(scope="module")
def partly(split_key: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Six frames of LED regions, of which the test frames are withheld."""
    folder = tmp_path_factory.mktemp("partly") / "set"
    assert vr.generate(small_plan(*REGIONS, *SPLIT), folder, withhold_truth=split_key)
    with unchanged(folder):
        yield folder


def numbers_in(value: Any) -> Iterator[float]:
    """All numbers of a tree."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from numbers_in(item)
    elif isinstance(value, float):
        yield value


def secrets_of(released: Path, frames: list[int] | None = None) -> list[float]:
    """Numbers that only the truth has: positions, rotations, tilts and LED images of some frames, or of all."""
    rows = pq.read_table(released / "truth.parquet").to_pylist()
    chosen = [row for row in rows if frames is None or row["frame"] in frames]
    names = ("position_m", "R_cam_world", "tilt_x_deg", "tilt_y_deg", "yaw_deg", "leds")
    found = {number for row in chosen for name in names for number in numbers_in(row[name])}
    return sorted(number for number in found if abs(number) > 1e-3 and number not in (1.0, -1.0))


def revealed(folder: Path, secrets: list[float], seed: int) -> list[str]:
    """Where a folder has one of the numbers as text or double, in any byte or table, or the seed."""
    texts = {text.encode() for n in secrets for text in (repr(n), f"{n:.6f}", f"{n:.9g}") if len(text) >= 7}
    bits = {pack for n in secrets for pack in (struct.pack("<d", n), struct.pack(">d", n))}
    bits |= {seed.to_bytes(16, "little"), seed.to_bytes(16, "big"), str(seed).encode(), f"{seed:x}".encode()}
    places = []
    for name, data in content(folder).items():
        places += [f"{name}: {needle!r}" for needle in texts | bits if needle in data]
        if name.endswith(".parquet"):
            # Pages of tables are packed: their values count, not their bytes.
            there = set(numbers_in(pq.read_table(folder / name).to_pylist()))
            places += [f"{name}: {number}" for number in there & set(secrets)]
    return places


def seed_of(released: Path) -> int:
    return int(json.loads((released / "dataset.json").read_text())["provenance"]["recipe"]["seed"])


def test_no_byte_of_the_set_tells_the_truth(withheld: Path, released: Path) -> None:
    secrets, seed = secrets_of(released), seed_of(released)
    assert len(secrets) > 100
    assert seed > 2**100  # 128 bits: smaller once in 2**28 keys
    assert revealed(withheld, secrets, seed) == []
    # The search finds what is there.
    found = " ".join(revealed(released, secrets, seed))
    assert "truth.parquet: " in found
    assert "dataset.json: " in found


def test_what_the_set_states_is_known_key_by_key(withheld: Path) -> None:
    """A new key of the provenance is sealed until it is listed."""
    stated = json.loads((withheld / "dataset.json").read_text())
    assert set(stated["provenance"]) == {"recipe", "program_sha256", "data_version", "versions", "commitment"}
    assert set(stated["provenance"]["recipe"]) == {"expected", "processed", "files", "burst"}
    assert set(content(withheld)) - {
        f"{folder}/00000{i}.{end}" for folder, end in (("frames", "exr"), ("previews", "png")) for i in range(3)
    } == {"dataset.json", "frames.parquet", "manifest.json", "truth.sealed"}
    assert set(read_manifest(withheld)) == set(content(withheld)) - {"dataset.json", "manifest.json"}
    assert stated["withheld"]["frames"] == "all"
    assert len({path.stat().st_mtime_ns for path in withheld.rglob("*")}) == 1


def test_the_public_recipe_makes_another_truth(withheld: Path, released: Path, rendered_set: Path, key: Path) -> None:
    """rendered_set is of the same recipe without a key."""
    truths = [pq.read_table(folder / "truth.parquet").to_pydict() for folder in (released, rendered_set)]
    apart = np.abs(np.subtract(*(truth["position_m"] for truth in truths)))
    assert (apart.max(axis=1) > 0.01).all()
    names = [f"frames/00000{i}.exr" for i in range(3)]
    assert all((withheld / name).read_bytes() != (rendered_set / name).read_bytes() for name in names)


def test_the_released_set_is_that_of_the_true_seed(released: Path, tmp_path: Path) -> None:
    recipe = json.loads((released / "dataset.json").read_text())["provenance"]["recipe"]
    plan = small_plan(f"seed={recipe['seed']}", f"sensor.serial={recipe['sensor']['serial']}")
    assert vr.generate(plan, tmp_path / "plain")
    assert content(tmp_path / "plain") == content(released)
    assert vr.verify(released) == []


@pytest.mark.slow
def test_an_interrupted_run_goes_on_with_its_key_alone(
    withheld: Path, released: Path, key: Path, tmp_path: Path
) -> None:
    def stop(progress: Progress) -> None:
        if progress.stage == FRAMES_STAGE and progress.done == 2:
            raise KeyboardInterrupt

    folder = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        vr.generate(small_plan(), folder, withhold_truth=key, progress=stop)
    assert (folder / "journal.jsonl").stat().st_size > 1000
    assert revealed(folder, secrets_of(released), seed_of(released)) == []
    assert b"position" not in (folder / "journal.jsonl").read_bytes()
    for other in (None, tmp_path / "other"):
        if other is not None:
            other.write_text(f"vlcrender-truth-key-1 {'0' * 64}\n")
        with pytest.raises(InputError, match="an unfinished dataset of another"):
            vr.generate(small_plan(), folder, withhold_truth=other)
    with pytest.raises(InputError, match=r"is missing, and .* is not empty; give the key file of that run"):
        vr.generate(small_plan(), folder, withhold_truth=tmp_path / "lost")
    # A line that a crash damaged is made again.
    lines = (folder / "journal.jsonl").read_bytes().splitlines(keepends=True)
    (folder / "journal.jsonl").write_bytes(lines[0][:100] + b"f" + lines[0][101:] + lines[1][:50])
    assert vr.generate(small_plan(), folder, withhold_truth=key)
    assert content(folder) == content(withheld)
    assert not vr.generate(small_plan(), folder, withhold_truth=key)


@pytest.mark.parametrize(
    ("assignments", "problem"),
    [
        (("expected=true",), "expected = true"),
        (("poses={kind='grid', columns=2, rows=2, height_m=0.5}",), 'poses.kind = "grid"'),
        (("poses={kind='list', pose=[{position_m=[3.0, 3.0, 1.0]}]}",), 'poses.kind = "list"'),
        (
            ("poses={kind='tilt-grid', tilt_x_deg=[0, 9, 2], tilt_y_deg=[0, 9, 2], height_m=[0.5, 1.0]}",),
            'poses.kind = "tilt-grid"',
        ),
        (("regions.kind=leds", "regions.overscan=true"), "regions.overscan = true"),
        (("sweep=[{key='sensor.bits', values=[10, 12]}]",), r"remove \[\[sweep\]\]"),
        ((*SPLIT, "belief.preset=calibrated"), r"\[split\] with \[belief\]"),
        (("split.train=0.9", "split.test=0.0"), "split.test = 0"),
    ],
)
def test_recipes_that_give_the_truth_away_are_refused(
    assignments: tuple[str, ...], problem: str, tmp_path: Path
) -> None:
    overrides = [one for one in (*SMALL, *assignments) if "poses={" not in " ".join(assignments) or "poses." not in one]
    plan = vr.load_recipe("quickstart", overrides)
    with pytest.raises(InputError, match=f"--withhold-truth: .*{problem}"):
        vr.generate(plan, tmp_path / "set", withhold_truth=tmp_path / "key")
    assert list(tmp_path.iterdir()) == []


def test_a_key_file_is_private_and_never_replaced(key: Path, withheld: Path, tmp_path: Path) -> None:
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert re.fullmatch("vlcrender-truth-key-1 [0-9a-f]{64}\n", key.read_text())
    for text in ("", "secret\n", f"vlcrender-truth-key-2 {'0' * 64}\n", f"vlcrender-truth-key-1 {'0' * 63}\n"):
        other = tmp_path / "key"
        other.write_text(text)
        with pytest.raises(InputError, match="is no key file"):
            vr.generate(small_plan(), tmp_path / "set", withhold_truth=other)
        assert other.read_text() == text
    with pytest.raises(InputError, match="within the dataset, which is to be published"):
        vr.generate(small_plan(), tmp_path / "set", withhold_truth=tmp_path / "set" / "key")
    assert not (tmp_path / "set").exists()


def test_verify_says_what_it_does_not_check_and_finds_damage(withheld: Path, tmp_path: Path) -> None:
    finished = run("vlcrender", "verify", str(withheld))
    assert (finished.returncode, finished.stderr) == (0, "")
    assert "3 frames, all there and intact (not checked: the withheld truth of 3 frames)" in finished.stdout
    folder = copy_of(withheld, tmp_path / "set")
    sealed = bytearray((folder / "truth.sealed").read_bytes())
    sealed[len(sealed) // 2] ^= 1
    (folder / "truth.sealed").write_bytes(sealed)
    (folder / "truth_map.parquet").write_bytes(b"")
    problems = "\n".join(vr.verify(folder))
    assert problems.count("truth.sealed: SHA-256 differs from manifest.json") == problems.count("truth.sealed") == 1
    assert "truth_map.parquet: is there, but withheld" in problems
    # One who makes a new manifest has still another truth than dataset.json commits to.
    (folder / "truth_map.parquet").unlink()
    seal_dataset(folder)
    assert vr.verify(folder) == [
        f"{folder / 'truth.sealed'}: SHA-256 differs from dataset.json: the file was changed or truncated"
    ]
    (folder / "truth.sealed").unlink()
    assert "truth.sealed: is missing" in "\n".join(vr.verify(folder))


def test_verify_checks_rows_and_images_without_the_truth(withheld: Path, partly: Path, tmp_path: Path) -> None:
    """What is wrong is found behind a new manifest: rows against images, each other and the told rows of the truth."""
    folder = copy_of(withheld, tmp_path / "set")
    with changed_table(folder / "frames.parquet") as rows:
        rows[1]["file"], rows[2]["exposure_s"] = "frames/000009.exr", rows[2]["exposure_s"] * 1.5
    (folder / "frames/000001.exr").rename(folder / "frames/000009.exr")
    seal_dataset(folder)
    problems = "\n".join(vr.verify(folder))
    assert "frame 1: file is 'frames/000009.exr'; the recipe gives 'frames/000001.exr'" in problems
    assert "expTime of its header" in problems
    folder = copy_of(partly, tmp_path / "partly")
    with changed_table(folder / "truth.parquet") as rows:
        rows[0]["position_m"][0] += 0.001
    seal_dataset(folder)
    (problem,) = vr.verify(folder)
    assert "is not where the pose puts it" in problem


@contextmanager
def changed_table(path: Path) -> Iterator[list[dict[str, Any]]]:
    """The rows of a table, which are written at the end as they then are."""
    table = pq.read_table(path)
    rows = table.to_pylist()
    yield rows
    pq.write_table(pa.Table.from_pylist(rows, table.schema), path)


def test_repair_makes_nothing_of_a_withheld_set_but_its_manifest(withheld: Path, tmp_path: Path) -> None:
    folder = copy_of(withheld, tmp_path / "set")
    (folder / "manifest.json").unlink()
    assert vr.repair(folder) == ["manifest.json: made again of the files as they are"]
    assert content(folder) == content(withheld)
    assert vr.repair(folder) == []
    (folder / "frames/000001.exr").unlink()
    with pytest.raises(InputError, match="its truth is withheld, and with it recipe and seed: nothing can be made"):
        vr.repair(folder)


def test_the_summary_has_two_digits_until_the_release(withheld: Path, released: Path) -> None:
    """The median of three frames is one frame's background without noise; so is the brightest pixel."""
    told, whole = (json.loads((folder / "dataset.json").read_text())["summary"] for folder in (withheld, released))
    for key in ("brightest_e", "background_e", "saturated_share"):
        assert told[key] == float(f"{whole[key]:.2g}")
    assert told["background_e"] != whole["background_e"]
    assert told["leds"] == whole["leds"]


def test_a_release_that_was_killed_is_made_again(withheld: Path, released: Path, key: Path, tmp_path: Path) -> None:
    folder = copy_of(withheld, tmp_path / "set")
    for name in ("truth.parquet", "manifest.json"):  # written before dataset.json
        (folder / name).write_bytes((released / name).read_bytes())
    vr.release(folder, key)
    assert content(folder) == content(released)


def test_release_needs_the_key(withheld: Path, released: Path, key: Path, tmp_path: Path) -> None:
    folder, other = copy_of(withheld, tmp_path / "set"), tmp_path / "other"
    other.write_text(f"vlcrender-truth-key-1 {'0' * 64}\n")
    before = content(folder)
    for wrong, problem in ((other, "is not the key of"), (tmp_path / "none", "cannot be read")):
        finished = run("vlcrender", "release", str(folder), str(wrong))
        assert finished.returncode == 2
        assert problem in finished.stderr
        assert content(folder) == before
    with pytest.raises(InputError, match="its truth is not withheld"):
        vr.release(released, key)


def test_the_key_alone_opens_the_truth_as_the_docs_say(
    withheld: Path, released: Path, key: Path, tmp_path: Path
) -> None:
    """The program in docs/benchmark.md, run as it is printed."""
    (program,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/benchmark.md").read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "mine.key").write_bytes(key.read_bytes())
    (tmp_path / "truth.sealed").write_bytes((withheld / "truth.sealed").read_bytes())
    with chdir(tmp_path):
        exec(program, {})
    assert (tmp_path / "truth/truth.parquet").read_bytes() == (released / "truth.parquet").read_bytes()


def test_training_rows_are_there_and_test_rows_are_not(partly: Path, split_key: Path, tmp_path: Path) -> None:
    splits = pq.read_table(partly / "frames.parquet")["split"].to_pylist()
    test = [frame for frame, split in enumerate(splits) if split == "test"]
    assert 0 < len(test) < 6
    assert json.loads((partly / "dataset.json").read_text())["withheld"]["frames"] == test
    told = pq.read_table(partly / "truth.parquet")["frame"].to_pylist()
    assert told == [frame for frame, split in enumerate(splits) if split == "train"]
    assert vr.verify(partly) == []
    folder = copy_of(partly, tmp_path / "set")
    vr.release(folder, split_key)
    assert vr.verify(folder) == []
    assert revealed(partly, secrets_of(folder, test), seed_of(folder)) == []
    # A split that the seed decides tells nothing new; its truth has the positions that it was made of.
    truth = pq.read_table(folder / "truth.parquet").to_pydict()
    recipe = vr.load_recipe("quickstart", [*SMALL, *REGIONS, *SPLIT, f"seed={seed_of(folder)}"]).recipe
    assert recipe.split is not None
    assert splits == [recipe.split.name_at(p, np.array([7.0, 7.0]), recipe.seed) for p in truth["position_m"]]


def estimated(folder: Path, released: Path, error_m: float) -> Path:
    """A set with estimates that are off along x by error_m, twice it in frame 1 and so on; the first frame failed."""
    truth = pq.read_table(released / "truth.parquet")["position_m"].to_pylist()
    rows = [EstimateRow(frame=0, status="failed", reason="test: none", position_m=None, ranges=(), time_s=0.0)]
    for frame, (x, y, z) in list(enumerate(truth))[1:]:
        at = (x + error_m * frame, y, z)
        rows.append(EstimateRow(frame=frame, status="ok", reason="", position_m=at, ranges=(), time_s=0.0))
    write_estimates(folder, "mine", rows)
    return folder


def test_the_organiser_scores_what_the_released_truth_scores(
    withheld: Path, released: Path, key: Path, tmp_path: Path
) -> None:
    """The estimator opens the truth by FORMAT.md alone, and judges as it does once the truth is out."""
    sealed = estimated(copy_of(withheld, tmp_path / "sealed"), released, 0.01)
    with pytest.raises(est.InputError, match="truth is withheld; score bundles"):
        est.score(sealed)
    bundle = tmp_path / "mine.zip"
    submit(sealed, bundle, "mine")
    with pytest.raises(est.InputError, match="the truth of its test frames is withheld; give its key file"):
        score_bundles([bundle], sealed)
    other = tmp_path / "other"
    other.write_text(f"vlcrender-truth-key-1 {'0' * 64}\n")
    with pytest.raises(est.InputError, match="is not the key of"):
        score_bundles([bundle], sealed, other)
    (entry,) = score_bundles([bundle], sealed, key)
    plain = estimated(copy_of(released, tmp_path / "plain"), released, 0.01)
    assert entry.score == est.score(plain).variants[0]
    errors_m = [row.error_3d_m for row in entry.score.rows]
    assert errors_m[0] is None
    assert errors_m[1:] == pytest.approx([0.01, 0.02], abs=1e-12)  # positions of metres have steps of 1e-15 m
    assert score_bundles([bundle], released) == [entry]


def test_entrants_score_training_frames_without_a_key(partly: Path, split_key: Path, tmp_path: Path) -> None:
    folder = copy_of(partly, tmp_path / "released")
    vr.release(folder, split_key)
    sealed = estimated(copy_of(partly, tmp_path / "sealed"), folder, 0.01)
    bundle = tmp_path / "mine.zip"
    submit(sealed, bundle, "mine")
    splits = [record.split for record in est.read_dataset(sealed).frames]
    for split, key_file in (("train", None), ("test", split_key)):
        (entry,) = score_bundles([bundle], sealed, key_file, split)  # type: ignore[arg-type]
        assert [row.frame for row in entry.score.rows] == [n for n, own in enumerate(splits) if own == split]
    with pytest.raises(est.InputError, match="has no validation frame"):
        score_bundles([bundle], sealed, None, "validation")


def test_the_page_of_a_set_shows_the_poses_of_the_frames_that_have_them(partly: Path, tmp_path: Path) -> None:
    """Rows of the truth belong to their frames, whatever is withheld between them."""
    folder = copy_of(partly, tmp_path / "set")
    (folder / "previews").mkdir(exist_ok=True)
    for frame in range(6):
        Image.new("L", (8, 6)).save(folder / f"previews/{frame:06d}.png")
    rows = {row.frame: row for row in Contents.read(folder).truth}
    html = page(folder)
    assert 0 < len(rows) < 6
    for frame in range(6):
        assert (f"frame {frame} ·" in html) == (frame in rows)
    for frame, row in rows.items():
        tilt_deg = np.degrees(np.arccos(row.R_cam_world[8]))
        assert f"frame {frame} · {len(row.leds)} LEDs · {tilt_deg:.0f}°" in html
    assert f"6 frames, of which {len(rows)} have their truth here" in html
