"""[files] format: the same digital numbers in each format, read alike by both packages."""

from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, copy_of, small_plan

import estimator as est
import vlcrender as vr
from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.dataset.format.frame_files import read_frame_parts, write_frame
from vlcrender.dataset.recipe.file_settings import FileSettings

REGIONS = ('regions.kind="leds"', "regions.margin_px=6.0", "poses.count=2")
ATTRIBUTES = {
    "expTime": 1e-3,
    "aperture": 2.0,
    "nominalFocalLength": 18.0,
    "sensorPhotositePitch": 1.2,
    "vlcrender:frame": "0",
    "vlcrender:camera": "main",
}


def frames(folder: Path) -> list[est.DeviceFrame]:
    dataset = est.read_dataset(folder)
    return [est.read_frame(dataset, record) for record in dataset.frames]


def assert_same_pixels(one: Path, other: Path) -> None:
    for a, b in zip(frames(one), frames(other), strict=True):
        assert [(part.row, part.column) for part in a.parts] == [(part.row, part.column) for part in b.parts]
        for mine, theirs in zip(a.parts, b.parts, strict=True):
            assert mine.image_dn.dtype == theirs.image_dn.dtype == np.uint32
            np.testing.assert_array_equal(mine.image_dn, theirs.image_dn)


@pytest.mark.parametrize(("form", "suffix"), [("exr-float32", ".exr"), ("png16", ".png")])
def test_full_frames_have_the_same_numbers(rendered_set: Path, tmp_path: Path, form: str, suffix: str) -> None:
    assert vr.generate(small_plan("expected=true", f'files.format="{form}"'), tmp_path / "set")
    assert vr.verify(tmp_path / "set") == []
    assert {path.suffix for path in (tmp_path / "set/frames").iterdir()} == {suffix}
    assert_same_pixels(tmp_path / "set", rendered_set)


def test_shards_of_floats_have_the_numbers_of_single_files(tmp_path: Path) -> None:
    assert vr.generate(small_plan(*REGIONS), tmp_path / "ints")
    floats = small_plan(*REGIONS, 'files.format="exr-float32"', "files.frames_per_file=2")
    assert vr.generate(floats, tmp_path / "floats")
    assert vr.verify(tmp_path / "floats") == []
    assert_same_pixels(tmp_path / "floats", tmp_path / "ints")


@pytest.mark.parametrize(("form", "bits"), [("exr-float32", 24), ("png16", 16), ("exr-uint32", 32)])
def test_the_largest_number_of_a_format_is_exact(tmp_path: Path, form: str, bits: int) -> None:
    largest = np.array([[0, 1, 2**bits - 1], [2**bits - 2, 2**bits // 2 + 1, 7]], dtype=np.uint32)
    roi = Roi(0, 0, 2, 3)
    path = tmp_path / ("f.png" if form == "png16" else "f.exr")
    write_frame(path, [RegionImage(roi, largest)], roi, ATTRIBUTES, form)  # type: ignore[arg-type]
    (part,) = read_frame_parts(path)
    assert part.image.astype(np.uint64).tolist() == largest.tolist()
    assert (part.roi, part.sensor) == (roi, roi)
    assert part.attributes["vlcrender:frame"] == "0"


@pytest.mark.parametrize(
    ("assignments", "message"),
    [
        (('files.format="png16"', *REGIONS), r'"png16": holds full frames alone; remove \[regions\]'),
        (('files.format="tiff"',), r"files.format"),
    ],
)
def test_what_a_format_cannot_hold_is_refused_by_name(assignments: tuple[str, ...], message: str) -> None:
    with pytest.raises(vr.InputError, match=message):
        small_plan(*assignments)


@pytest.mark.parametrize(("form", "bits"), [("exr-float32", 24), ("png16", 16), ("exr-uint32", 32)])
def test_more_bits_than_a_format_has_are_refused(form: str, bits: int) -> None:
    """No sensor of a recipe has as many today."""
    files = FileSettings(format=form)  # type: ignore[arg-type]
    assert files.problem(bits, has_regions=False) is None
    assert f'"{form}": holds numbers of {bits} bits' in str(files.problem(bits + 1, has_regions=False))


@pytest.mark.parametrize("form", ["png16", "exr-float32"])
def test_another_stated_format_is_refused_by_both(rendered_set: Path, tmp_path: Path, form: str) -> None:
    """The files hold 32-bit integers; dataset.json says otherwise."""
    folder = copy_of(rendered_set, tmp_path / "set")
    description = folder / "dataset.json"
    text = description.read_text()
    assert text.count('"exr-uint32"') == 2  # stated, and in the recipe of the provenance
    description.write_text(text.replace('"exr-uint32"', f'"{form}"'))
    assert vr.verify(folder)
    with pytest.raises(est.InputError, match=r"000000.exr: "):
        frames(folder)


def test_a_set_that_states_no_format_has_integers(rendered_set: Path, tmp_path: Path) -> None:
    folder = copy_of(rendered_set, tmp_path / "set")
    description = folder / "dataset.json"
    before = description.read_text()
    after = before.replace(' "files": {\n  "format": "exr-uint32"\n },\n', "")
    assert after != before
    description.write_text(after)
    assert_same_pixels(folder, rendered_set)


def test_numbers_that_are_no_counts_are_refused(tmp_path: Path) -> None:
    from estimator.io.frame_files import numbers_of_exr

    for bad in (0.5, -1.0, float("nan"), float("inf"), 2.0**24):
        with pytest.raises(est.InputError, match="whole digital numbers"):
            numbers_of_exr(np.array([[bad]], dtype=np.float32), "exr-float32", (1, 1), "f.exr")


def test_the_recipes_of_the_package_keep_the_default_format() -> None:
    assert vr.load_recipe(ROOT / "datasets/quickstart.toml").recipe.files.format == "exr-uint32"
