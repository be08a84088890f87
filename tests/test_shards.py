"""Shards: several region frames in a file, with the pixels, estimates and scores of a file for each frame; previews."""

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import OpenEXR
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL, copy_of, sealed

import estimator as est
import vlcrender as vr
from estimator.io import dataset as reader
from estimator.io.shard import frame_of_shard
from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.dataset.format.rows import FrameRecord
from vlcrender.dataset.format.shard import Shard, incomplete
from vlcrender.dataset.run import frame_job
from vlcrender.dataset.run.generate import _tasks
from vlcrender.dataset.run.unfinished import Unfinished
from vlcrender.dataset.verify.verify import verify

REGIONS = 'regions={ kind = "leds", margin_px = 2 }'


def plan(*assignments: str) -> vr.Plan:
    """Six small frames of LED regions, half of which see one LED or a few."""
    return vr.load_recipe(ROOT / "datasets/quickstart.toml", [*SMALL, "poses.count=6", REGIONS, *assignments])


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file for each frame."""
    folder = tmp_path_factory.mktemp("single") / "set"
    assert vr.generate(plan(), folder)
    return folder


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of four and two frames, and two previews."""
    folder = tmp_path_factory.mktemp("shards") / "set"
    assert vr.generate(plan("files.frames_per_file=4", "files.previews=2"), folder)
    return folder


def rows_of(folder: Path) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = pq.read_table(folder / "frames.parquet").to_pylist()
    return rows


def change_rows(folder: Path, change: Callable[[list[dict[str, object]]], object]) -> None:
    table = pq.read_table(folder / "frames.parquet")
    rows = table.to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows, table.schema), folder / "frames.parquet")


def content(path: Path) -> list[tuple[dict[str, object], np.ndarray]]:
    """Header and pixels of each part."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return [(dict(part.header), part.channels["Y"].pixels) for part in file.parts]


def test_frames_per_file_makes_as_many_files(single: Path, shards: Path) -> None:
    assert len(list((single / "frames").iterdir())) == 6
    assert sorted(path.name for path in (shards / "frames").iterdir()) == ["shard-000000.exr", "shard-000001.exr"]
    rows = rows_of(shards)
    assert [row["file"] for row in rows] == ["frames/shard-000000.exr"] * 4 + ["frames/shard-000001.exr"] * 2
    assert [row["part"] for row in rows_of(single)] == [None] * 6
    # Number of the first part: those of the frames before in the file.
    regions = [len(est.read_frame(est.read_dataset(single), frame).parts) for frame in range(6)]
    assert max(regions) > 1
    assert [row["part"] for row in rows] == [*np.cumsum([0, *regions[:3]]).tolist(), 0, regions[4]]


def test_other_programs_read_the_parts_by_frame_and_region(shards: Path, single: Path) -> None:
    """OpenEXR itself reads a shard: names, attributes, windows and pixels of each part."""
    parts = content(shards / "frames/shard-000001.exr")
    expected = [part for frame in (4, 5) for part in content(single / f"frames/{frame:06d}.exr")]
    numbers = [(frame, part) for frame in (4, 5) for part in range(len(content(single / f"frames/{frame:06d}.exr")))]
    assert [header["name"] for header, _ in parts] == [f"frame {frame} region {part}" for frame, part in numbers]
    for (header, image_dn), (alone, expected_dn) in zip(parts, expected, strict=True):
        assert np.array_equal(image_dn, expected_dn)
        for key in set(alone) - {"name", "chunkCount", "channels"}:
            assert np.array_equal(header[key], alone[key]), key


def test_shards_have_the_pixels_estimates_and_scores_of_single_files(
    single: Path, shards: Path, tmp_path: Path
) -> None:
    folders = [copy_of(single, tmp_path / "single"), copy_of(shards, tmp_path / "shards")]
    frames = [est.read_dataset(folder) for folder in folders]
    for frame in range(6):
        ours, theirs = (est.read_frame(dataset, frame).parts for dataset in frames)
        assert [(part.row, part.column) for part in ours] == [(part.row, part.column) for part in theirs]
        assert all(np.array_equal(a.image_dn, b.image_dn) for a, b in zip(ours, theirs, strict=True))
    results = []
    for folder in folders:
        rows = est.run(folder, ["gravity-fit"])["gravity-fit"]
        assert any(row.status == "ok" for row in rows)
        scores = est.score(folder).variants[0]
        left_out = {"time_s", "median_time_s"}
        results.append(
            (
                [row.model_dump(exclude=left_out) for row in rows],
                scores.model_dump(exclude={"median_time_s": True, "rows": {"__all__": {"time_s"}}}),
            )
        )
    assert results[0] == results[1]


def test_a_frame_is_read_without_decoding_the_others(shards: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[int] = []
    whole = OpenEXR.File

    def counted(*arguments: object, **options: object) -> OpenEXR.File:
        file = whole(*arguments, **options)
        decoded.append(len(file.parts))
        return file

    monkeypatch.setattr(reader.OpenEXR, "File", counted)
    frame = est.read_frame(est.read_dataset(shards), 1)
    assert decoded == [len(frame.parts)] * 2  # headers, then pixels


def test_regions_of_any_height_are_parts(tmp_path: Path, rng: np.random.Generator) -> None:
    """Chunks have 32 lines: regions of 1 to 65 lines have one to three. A frame with one region is one part."""
    heights = [[1], [32, 33], [64], [65, 31]]
    (tmp_path / "frames").mkdir()
    shard, sensor = Shard(tmp_path, 7), Roi(0, 0, 300, 400)
    images = [
        [
            RegionImage(Roi(100 * k, 5, rows, 20), rng.poisson(1000, (rows, 20)).astype(np.uint32))
            for k, rows in enumerate(of)
        ]
        for of in heights
    ]
    firsts = []
    for frame, regions in enumerate(images):
        firsts.append(shard.part_count)
        shard.add(20 + frame, regions, sensor, {"expTime": 1e-3})
    assert firsts == [0, 1, 3, 4]
    digest = shard.write().sha256
    found = content(tmp_path / "frames/shard-000007.exr")
    for (_, image_dn), region in zip(found, [region for regions in images for region in regions], strict=True):
        assert np.array_equal(image_dn, region.image)
    for frame, first in enumerate(firsts):
        one = tmp_path / "one.exr"
        one.write_bytes(frame_of_shard(tmp_path / shard.file, digest, 20 + frame, first))
        for (_, image_dn), region in zip(content(one), images[frame], strict=True):
            assert np.array_equal(image_dn, region.image)


@pytest.mark.parametrize(
    ("stop", "lines", "made"),
    [(3, 0, range(6)), (4, 4, (4, 5)), (4, 3, range(6))],
    ids=["in a shard", "between shards", "while its frames are noted"],
)
def test_an_interrupted_run_makes_the_same_shards_and_only_whole_ones_are_kept(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int, lines: int, made: Sequence[int]
) -> None:
    """Interrupted before frame `stop`, with as many lines of the journal left."""
    sharded = plan("files.frames_per_file=4", "files.previews=2")
    make_frame = frame_job.make_frame
    calls: list[int] = []

    def counted(job: frame_job.Job, frame: int, *, shard: Shard) -> FrameRecord:
        if frame == stop and stop not in calls:
            calls.append(frame)
            raise KeyboardInterrupt
        calls.append(frame)
        return make_frame(job, frame, shard=shard)

    monkeypatch.setattr(frame_job, "make_frame", counted)
    with pytest.raises(KeyboardInterrupt):
        vr.generate(sharded, tmp_path / "set")
    assert len(list((tmp_path / "set/frames").iterdir())) == (1 if lines else 0)
    journal = tmp_path / "set/journal.jsonl"
    if lines:
        written = journal.read_text().splitlines(keepends=True)
        assert len(written) == 4
        journal.write_text("".join(written[:lines]))
    calls[:] = [stop]
    assert vr.generate(sharded, tmp_path / "set")
    assert calls[1:] == list(made)
    for name in ("frames/shard-000000.exr", "frames/shard-000001.exr", "frames.parquet", "truth.parquet"):
        assert (tmp_path / "set" / name).read_bytes() == (shards / name).read_bytes()
    assert verify(tmp_path / "set") == []


def test_a_shard_of_which_the_journal_has_some_frames_is_made_anew() -> None:
    """Frames 0 to 3 and 4 and 5 are the files of six frames; 8 is the last one, alone in its file, of nine."""
    assert incomplete([0, 1, 2, 3, 4], 4, 6) == [4]
    assert incomplete([0, 1, 3, 4, 5], 4, 6) == [0, 1, 3]
    assert incomplete([8], 4, 9) == []
    assert incomplete(range(6), 1, 6) == []


def test_the_plan_of_122_500_poses_makes_123_files(tmp_path: Path) -> None:
    large = plan("files.frames_per_file=1000", "poses.count=122_500")
    dataset = Unfinished(lambda: large, frame_job.Job.of(large, tmp_path / "set"), large.frame_count)
    files = list(_tasks([dataset])[0])
    assert len(files) == 123
    assert [len(files[0]), len(files[-1])] == [1000, 500]


TIMES = ("exposure_s", "[1e-6, 2e-6]")


def test_cells_that_differ_in_the_accelerometer_alone_share_shards(tmp_path: Path) -> None:
    errors, times = (f'{{ key = "{k}", values = {v} }}' for k, v in (("accelerometer.error_deg", "[0.1, 0.5]"), TIMES))
    vr.generate(plan("files.frames_per_file=4", f"sweep=[{errors}, {times}]"), tmp_path / "sweep")
    vr.generate(plan("files.frames_per_file=4", "accelerometer.error_deg=0.5", "exposure_s=2e-6"), tmp_path / "plain")
    assert vr.verify(tmp_path / "sweep") == []
    cells = [tmp_path / f"sweep/cells/{number:06d}" for number in range(4)]
    for name in ("frames/shard-000000.exr", "frames/shard-000001.exr"):
        assert (cells[0] / name).samefile(cells[2] / name)
        assert not (cells[0] / name).samefile(cells[1] / name)
        assert (cells[3] / name).read_bytes() == (tmp_path / "plain" / name).read_bytes()
    rows, plain = (pq.read_table(folder / "frames.parquet") for folder in (cells[3], tmp_path / "plain"))
    assert rows.equals(plain)


def test_the_first_frames_have_previews(single: Path, shards: Path, tmp_path: Path) -> None:
    assert len(list((single / "previews").iterdir())) == 6
    assert sorted(path.name for path in (shards / "previews").iterdir()) == ["000000.png", "000001.png"]
    assert (shards / "previews/000001.png").read_bytes() == (single / "previews/000001.png").read_bytes()
    none = tmp_path / "none"
    assert vr.generate(plan("files.previews=0", "poses.count=1"), none)
    assert not (none / "previews").exists()
    assert verify(none) == []
    folder = copy_of(shards, tmp_path / "shards")
    (folder / "previews/000001.png").unlink()
    assert verify(folder) == [f"{folder / 'previews/000001.png'}: is missing"]


def test_verify_finds_a_wrong_part_and_a_changed_shard(shards: Path, tmp_path: Path) -> None:
    folder = copy_of(shards, tmp_path / "set")
    change_rows(folder, lambda rows: rows[2].update(part=rows[1]["part"]))
    sealed(folder)
    (problem,) = verify(folder)
    assert problem.endswith(f"part {rows_of(folder)[2]['part']} is not the first one of frame 2")
    path = folder / "frames/shard-000001.exr"
    path.write_bytes(path.read_bytes()[:-1])
    assert any(f"{path}: SHA-256 differs from manifest.json" in line for line in verify(folder))
    sealed(folder)
    assert sum("SHA-256 differs from frames.parquet" in line for line in verify(folder)) == 2


@pytest.mark.parametrize(("part", "message"), [(1, "part 1 is not the first one of frame 0"), (99999, "part 99999")])
def test_the_estimator_refuses_a_wrong_part(shards: Path, tmp_path: Path, part: int, message: str) -> None:
    folder = copy_of(shards, tmp_path / "set")
    change_rows(folder, lambda rows: rows[0].update(part=part))
    with pytest.raises(est.InputError, match=f"frames/shard-000000.exr: not a readable EXR image .{message}"):
        est.read_frame(est.read_dataset(folder), 0)
    change_rows(folder, lambda rows: rows[0].update(part=None))  # as if it were the file of one frame
    with pytest.raises(est.InputError, match="overlap"):
        est.read_frame(est.read_dataset(folder), 0)


def test_the_estimator_refuses_a_changed_shard(shards: Path, tmp_path: Path) -> None:
    folder = copy_of(shards, tmp_path / "set")
    dataset = est.read_dataset(folder)
    est.read_frame(dataset, 5)
    path = folder / "frames/shard-000001.exr"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(est.InputError, match=r"shard-000001.exr: damaged or changed"):
        est.read_frame(dataset, 5)
    path.unlink()
    with pytest.raises(est.InputError, match=r"shard-000001.exr: No such file"):
        est.read_frame(dataset, 5)


def test_a_set_without_the_column_part_is_read(single: Path, tmp_path: Path) -> None:
    folder = copy_of(single, tmp_path / "set")
    pq.write_table(pq.read_table(folder / "frames.parquet").drop_columns(["part"]), folder / "frames.parquet")
    assert est.read_dataset(folder).frames[0].part is None
    assert est.read_frame(est.read_dataset(folder), 0).parts


def test_bytes_that_are_no_shard_are_refused_in_one_line(shards: Path, tmp_path: Path) -> None:
    """With the digest of each, so that the layout alone is at fault."""
    folder = copy_of(shards, tmp_path / "set")
    path = folder / "frames/shard-000001.exr"
    whole = path.read_bytes()
    for data in (b"", whole[:8], whole[:300], whole[:4] + b"\2\0\0\0" + whole[8:], whole[: len(whole) // 2]):
        path.write_bytes(data)
        digest = hashlib.sha256(data).hexdigest()
        change_rows(folder, lambda rows, digest=digest: [row.update(sha256=digest) for row in rows[4:]])  # type: ignore[misc]
        with pytest.raises(est.InputError, match=r"shard-000001.exr: not a readable EXR image") as refusal:
            est.read_frame(est.read_dataset(folder), 5)
        assert "\n" not in str(refusal.value)


def test_shards_of_full_frames_are_refused() -> None:
    small = [*SMALL, "poses.count=2", "files.frames_per_file=2"]
    with pytest.raises(vr.InputError, match=r"files.frames_per_file = 2: files of several frames hold regions"):
        vr.load_recipe(ROOT / "datasets/quickstart.toml", small)
    with pytest.raises(vr.InputError, match=r"files.previews = -1"):
        vr.load_recipe(ROOT / "datasets/quickstart.toml", [*SMALL, "files.previews=-1"])


def test_provenance_says_how_files_are_laid_out(shards: Path) -> None:
    recipe = json.loads((shards / "dataset.json").read_text())["provenance"]["recipe"]
    assert recipe["files"] == {"format": "exr-uint32", "previews": 2, "frames_per_file": 4}
