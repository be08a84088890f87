"""Verification: each kind of damage that leaves every file readable is found and named."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, SMALL, sealed

from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.core.digest import sha256_of
from vlcrender.dataset.format.exr import write_exr
from vlcrender.dataset.format.rows import FrameRow, TruthRow, flat9
from vlcrender.dataset.format.tables import read_table, write_table
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run.generate import generate
from vlcrender.dataset.verify.verify import verify

SENSOR = Roi(0, 0, 300, 400)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One frame of two regions, one around each LED."""
    directory = tmp_path_factory.mktemp("regions") / "set"
    here = "poses={ kind = 'list', pose = [{ position_m = [0.6, 1.5, 0.05], yaw_deg = 90 }] }"
    assigned = ["scene=../scenes/table1.toml", "regions={ kind = 'leds', margin_px = 3 }", here]
    assert generate(load_plan(ROOT / "datasets/quickstart.toml", [*SMALL[:4], *assigned]), directory)
    return directory


@pytest.fixture
def copied(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "set"))


def change_frame(directory: Path, **entries: object) -> None:
    """Other values in the row of the frame; the digest is that of its file."""
    (row,) = read_table(directory / "frames.parquet", FrameRow)
    tree = {**row.model_dump(), "sha256": sha256_of(directory / row.file), **entries}
    write_table(directory / "frames.parquet", [FrameRow.model_validate(tree)], FrameRow)
    sealed(directory)


def change_truth(directory: Path, change: Callable[[TruthRow], dict[str, object]]) -> None:
    (row,) = read_table(directory / "truth.parquet", TruthRow)
    write_table(directory / "truth.parquet", [TruthRow.model_validate({**row.model_dump(), **change(row)})], TruthRow)
    sealed(directory)


def write_regions(directory: Path, *rois: Roi, kind: type = np.uint32, sensor: Roi = SENSOR) -> None:
    images = [RegionImage(roi, np.zeros((roi.rows, roi.columns), dtype=kind)) for roi in rois]
    write_exr(directory / "frames/000000.exr", images, sensor, {})
    change_frame(directory)


def only_problem(directory: Path) -> str:
    (problem,) = verify(directory)
    assert "\n" not in problem
    return problem


def test_the_set_is_intact_before_it_is_damaged(copied: Path) -> None:
    assert verify(copied) == []


def test_regions_that_share_pixels_are_found(copied: Path) -> None:
    """Side by side they are fine; one pixel shared, in whatever order, is not."""
    write_regions(copied, Roi(10, 10, 5, 5), Roi(10, 15, 5, 5), Roi(200, 10, 5, 5))
    assert verify(copied) == []
    for second in (Roi(14, 14, 5, 5), Roi(6, 6, 5, 5)):
        write_regions(copied, Roi(100, 100, 5, 5), Roi(10, 10, 5, 5), second)
        assert only_problem(copied).endswith("frames/000000.exr: regions overlap")


def test_a_region_beyond_the_sensor_contradicts_a_capturable_frame(copied: Path) -> None:
    write_regions(copied, Roi(10, 10, 5, 5), Roi(298, 10, 5, 5))
    assert "capturable is True, which its regions contradict" in only_problem(copied)
    change_frame(copied, capturable=False)
    assert verify(copied) == []
    write_regions(copied, Roi(10, 10, 5, 5))
    assert "capturable is False, which its regions contradict" in only_problem(copied)


@pytest.mark.parametrize("wrong", [{"kind": np.float32}, {"sensor": Roi(0, 0, 300, 401)}])
def test_pixels_of_another_type_or_sensor_are_found(copied: Path, wrong: dict[str, object]) -> None:
    write_regions(copied, Roi(10, 10, 5, 5), **wrong)  # type: ignore[arg-type]
    assert "a part is not uint32 of a sensor of (300, 400) pixels" in only_problem(copied)


@pytest.mark.parametrize(
    "wrong",
    [np.diag([1.0, 1.0, -1.0]), np.diag([1.0, 1.0, 1.0001]), np.array([[1.0, 1e-6, 0], [0, 1, 0], [0, 0, 1]])],
    ids=["mirrored", "longer", "skewed"],
)
def test_a_matrix_that_is_no_rotation_is_found_in_a_frame_without_leds(copied: Path, wrong: np.ndarray) -> None:
    """Without LEDs nothing else in the truth depends on the matrix."""
    change_frame(copied, spots=())
    change_truth(copied, lambda row: {"leds": ()})
    assert verify(copied) == []
    change_truth(copied, lambda row: {"R_cam_world": flat9(wrong @ np.array(row.R_cam_world).reshape(3, 3))})
    assert only_problem(copied) == "truth.parquet: frame 0: R_cam_world is not a rotation"


def test_unknown_leds_and_cameras_are_found(copied: Path) -> None:
    change_frame(copied, spots=())
    change_truth(copied, lambda row: {"leds": tuple({**led.model_dump(), "led": 99} for led in row.leds[:1])})
    assert only_problem(copied) == "truth.parquet: frame 0: LED 99 is not in the LED map"
    change_frame(copied, camera="left")
    assert any(line.endswith("frame 0: camera 'left' is not in dataset.json") for line in verify(copied))


def test_an_led_a_hundred_thousandth_of_a_pixel_off_is_found(copied: Path) -> None:
    for off_px, problems in ((1e-7, 0), (1e-5, 1)):
        change_truth(
            copied, lambda row, d=off_px: {"leds": tuple({**e.model_dump(), "u_px": e.u_px + d} for e in row.leds)}
        )
        assert len(verify(copied)) == problems
