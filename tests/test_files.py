"""Files of a dataset appear whole or not at all, also after a power cut; the journal holds every reported frame."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, SMALL

from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.dataset.format.exr import write_exr
from vlcrender.dataset.format.files import whole_file, write_json
from vlcrender.dataset.format.rows import FrameRecord, FrameRow
from vlcrender.dataset.format.tables import write_table
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run.generate import generate
from vlcrender.dataset.run.progress import Progress
from vlcrender.errors import InputError

ROI = Roi(0, 0, 2, 3)
WRITERS = {
    "dataset.json": lambda path: write_json(path, {"name": "x"}),
    "frames.parquet": lambda path: write_table(path, [], FrameRow),
    "000000.exr": lambda path: write_exr(path, [RegionImage(ROI, np.zeros((2, 3), dtype=np.uint32))], ROI, {}),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_is_on_the_disk_before_it_gets_its_name(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole content, then fsync, then the atomic rename: in another order a power cut can leave a part of the file."""
    events: list[tuple[str, int]] = []
    sync, replace = os.fsync, os.replace

    def fsync(descriptor: int) -> None:
        events.append(("fsync", os.fstat(descriptor).st_size))
        sync(descriptor)

    def watched(source: Path, target: Path) -> None:
        assert Path(target) == tmp_path / name
        assert Path(source).parent == tmp_path, "a rename is atomic within a folder"
        events.append(("replace", Path(source).stat().st_size))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", watched)
    WRITERS[name](tmp_path / name)
    size = (tmp_path / name).stat().st_size
    folder = ("fsync", tmp_path.stat().st_size)  # so that the new name is on the disk too
    assert events == [("fsync", size), ("replace", size), folder]
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "dataset.json"
    write_json(path, {"name": "old"})

    def write_half() -> None:
        with whole_file(path) as partial:
            partial.write_text("half")
            raise OSError(28, "disk full")

    with pytest.raises(InputError, match=r"dataset\.json: cannot be written: disk full"):
        write_half()
    assert json.loads(path.read_text()) == {"name": "old"}
    assert list(tmp_path.iterdir()) == [path]


def test_the_journal_holds_each_frame_that_is_reported_as_done(tmp_path: Path) -> None:
    """As another process reads it: a run that is killed right after a report loses none of the reported frames."""
    plan = load_plan(
        ROOT / "datasets/quickstart.toml",
        [*SMALL, "scene=../scenes/table1.toml", "poses.min_leds=1", "poses.count=1", "repeats=3"],
    )
    seen: list[list[int]] = []

    def read_journal(report: Progress) -> None:
        if report.stage == "frames":
            lines = (tmp_path / "set/journal.jsonl").read_text().splitlines()
            seen.append([FrameRecord.model_validate(json.loads(line)["record"]).frame for line in lines])

    generate(plan, tmp_path / "set", progress=read_journal)
    assert seen == [[0], [0, 1], [0, 1, 2]]
