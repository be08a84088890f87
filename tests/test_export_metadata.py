"""Licence, Croissant metadata and dataset card of a set, and the command line."""

import json
import re
from pathlib import Path

import cv2
import mlcroissant
import numpy as np
import OpenEXR
import pyarrow.parquet as pq
import pycolmap
import pytest
import yaml
from conftest import ROOT, SMALL, copy_of, run
from export_reading import exported

import vlcrender as vr
from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.core.backend import mi
from vlcrender.dataset.format.exr import write_exr
from vlcrender.dataset.format.files import read_dataset_file
from vlcrender.export.card import card
from vlcrender.export.source import Source


def licensed(rendered_set: Path, to: Path, licence: str | None) -> Path:
    """A copy of the set with this licence in dataset.json."""
    folder = copy_of(rendered_set, to)
    tree = json.loads((folder / "dataset.json").read_text())
    (folder / "dataset.json").write_text(json.dumps({**tree, "licence": licence}))
    return folder


def test_a_recipes_licence_is_in_dataset_json_as_spdx_spells_it(tmp_path: Path) -> None:
    plan = vr.load_recipe(
        ROOT / "datasets/quickstart.toml",
        [*SMALL, "poses.count=1", 'regions={ kind = "leds", margin_px = 2 }', "licence=cc-by-4.0"],
    )
    assert vr.generate(plan, tmp_path / "set")
    tree = json.loads((tmp_path / "set/dataset.json").read_text())
    assert (tree["licence"], tree["provenance"]["recipe"]["licence"]) == ("CC-BY-4.0", "CC-BY-4.0")
    assert vr.verify(tmp_path / "set") == []


def test_without_a_licence_the_key_is_null(rendered_set: Path) -> None:
    assert json.loads((rendered_set / "dataset.json").read_text())["licence"] is None


@pytest.mark.parametrize("licence", ["CC-BY", "free", '""'])
def test_an_unknown_licence_is_refused_by_name(licence: str) -> None:
    with pytest.raises(vr.InputError, match=r"licence = .*: must be an SPDX expression") as refusal:
        vr.load_recipe(ROOT / "datasets/quickstart.toml", [f"licence={licence}"])
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("beside", [True, False])
def test_mlcroissant_validates_the_metadata_and_reads_the_tables(
    rendered_set: Path, tmp_path: Path, beside: bool
) -> None:
    """Beside the set or elsewhere; digests are checked as files are read."""
    folder = licensed(rendered_set, tmp_path / "set", "CC-BY-4.0")
    out = (folder if beside else tmp_path) / "croissant.json"
    assert vr.export_dataset(folder, "croissant", out) == 3
    read = mlcroissant.Dataset(jsonld=str(out))
    assert list(read.metadata.issues.errors) == []
    assert read.metadata.license == ["https://spdx.org/licenses/CC-BY-4.0.html"]
    for table in ("frames", "truth"):
        parquet = pq.read_table(folder / f"{table}.parquet").to_pylist()
        records = list(read.records(table))
        assert [record[f"{table}/frame"] for record in records] == [row["frame"] for row in parquet]
        for column in ("accelerometer_m_s2",) if table == "frames" else ("position_m", "R_cam_world", "tilt_x_deg"):
            found = [record[f"{table}/{column}"] for record in records]
            assert [
                list(value) if isinstance(row[column], list) else value
                for value, row in zip(found, parquet, strict=True)
            ] == [row[column] for row in parquet]


def test_mlcroissant_refuses_a_table_that_was_changed(rendered_set: Path, tmp_path: Path) -> None:
    folder = copy_of(rendered_set, tmp_path / "set")
    vr.export_dataset(folder, "croissant", folder / "croissant.json")
    frames = folder / "frames.parquet"
    pq.write_table(pq.read_table(frames).slice(0, 2), frames)
    with pytest.raises(mlcroissant.GenerationError, match=r"Download\(frames\.parquet\)") as refusal:
        list(mlcroissant.Dataset(jsonld=str(folder / "croissant.json")).records("frames"))
    assert "Hash of downloaded file" in str(refusal.value.__cause__)


@pytest.mark.parametrize(
    ("licence", "keys"),
    [
        ("CC-BY-4.0", {"license": "cc-by-4.0"}),
        ("ODbL-1.0", {"license": "odbl"}),
        ("CERN-OHL-P-2.0", {"license": "other", "license_name": "CERN-OHL-P-2.0"}),
        (None, {}),
    ],
)
def test_the_front_matter_of_the_card_is_what_hugging_face_reads(
    rendered_set: Path, tmp_path: Path, licence: str | None, keys: dict[str, str]
) -> None:
    folder = licensed(rendered_set, tmp_path / "set", licence)
    vr.export_dataset(folder, "card", tmp_path / "README.md")
    _, head, body = (tmp_path / "README.md").read_text().split("---\n", 2)
    matter = yaml.safe_load(head)
    assert {key: value for key, value in matter.items() if key.startswith("license")} == keys
    assert matter["size_categories"] == ["n<1K"]
    assert [config["data_files"] for config in matter["configs"]] == ["frames.parquet", "truth.parquet"]
    assert f"| licence | {licence or 'not stated'} |" in body
    assert "| frames | 3 |" in body
    assert "camera and map exactly" in body


def test_the_card_says_that_the_truth_is_not_there(rendered_set: Path, tmp_path: Path) -> None:
    folder = copy_of(rendered_set, tmp_path / "set")
    (folder / "truth.parquet").unlink()
    text = card(Source.open(folder, "card", False))
    assert "withheld or missing" in text
    assert "config_name: truth" not in text


def test_the_command_line_exports(rendered_set: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    finished = run("vlcrender", "export", str(rendered_set), "--to", "tum", "--out", str(out))
    assert (finished.returncode, finished.stdout) == (0, f"{out}: tum of 3 frames\n")
    again = run("vlcrender", "export", str(rendered_set), "--to", "tum", "--out", str(out))
    assert again.returncode == 2
    assert "exists; nothing was changed" in again.stderr
    card_as_text = run("vlcrender", "export", str(rendered_set), "--to", "card", "--out", str(tmp_path / "card.txt"))
    assert "has to be a file that ends in .md" in card_as_text.stderr


def test_export_json_says_what_was_exported(rendered_set: Path, tmp_path: Path) -> None:
    stated = json.loads((exported(rendered_set, "png16", tmp_path) / "export.json").read_text())
    assert (stated["format"], stated["dataset"], stated["frames"]) == ("png16", "quickstart", 3)
    assert stated["licence"] is None
    assert read_dataset_file(rendered_set).licence is None


def test_cells_of_a_sweep_are_exported_one_by_one(tmp_path: Path) -> None:
    (tmp_path / "sweep.json").write_text("{}")
    with pytest.raises(vr.InputError, match="is a sweep; export its cells one by one"):
        vr.export_dataset(tmp_path, "tum", tmp_path.parent / "never")


def test_the_loaders_of_the_docs_run(rendered_set: Path, tmp_path: Path) -> None:
    """The blocks for NumPy and WebDataset of docs/exporting.md; that for PyTorch needs torch."""
    exported(rendered_set, "webdataset", tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/exporting.md").read_text(), re.DOTALL)
    by_numpy, by_torch, by_webdataset = blocks
    assert "torch" in by_torch
    names: dict[str, object] = {}
    exec(by_numpy.replace("out/quickstart", str(rendered_set)), names)
    pixels = eval("image(frames[2])", names)
    exec(by_webdataset.replace("out/quickstart-wds", str(tmp_path / "out")), names)
    np.testing.assert_array_equal(names["pixels"], pixels)
    assert names["true"]["position_m"] == eval("truth[2]['position_m']", names)  # type: ignore[index]


def test_readers_read_a_frame_as_the_table_of_format_md_says(tmp_path: Path) -> None:
    """Of those that are installed here: OpenEXR and Mitsuba right, pycolmap 0 everywhere, OpenCV's wheel not at all."""
    numbers = np.arange(64 * 48, dtype=np.uint32).reshape(48, 64)
    path, sensor = tmp_path / "frame.exr", Roi(0, 0, 48, 64)
    write_exr(path, [RegionImage(sensor, numbers)], sensor, {})
    with OpenEXR.File(str(path), separate_channels=True) as file:
        np.testing.assert_array_equal(file.parts[0].channels["Y"].pixels, numbers)
    np.testing.assert_array_equal(np.array(mi.Bitmap(str(path))).reshape(48, 64), numbers)
    assert not pycolmap.Bitmap.read(str(path), as_rgb=False).to_array().any()
    assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is None
