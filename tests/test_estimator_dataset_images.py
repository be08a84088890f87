"""Images of a dataset: files, regions, and the frames of the other cameras of a shot."""

import hashlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from estimator_synthetic import write_exr
from test_estimator_dataset import change_json, change_rows

from estimator.errors import InputError
from estimator.io.dataset import read_dataset, read_frame


@pytest.fixture(scope="module")
def good(synthetic_set: Path) -> Path:
    return synthetic_set


@pytest.fixture
def folder(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "copy"))


def refused_frame(folder: Path, **changes: Any) -> str:
    dataset = read_dataset(folder)
    record = dataset.frames[0].model_copy(update=changes)
    with pytest.raises(InputError) as caught:
        read_frame(dataset, record)
    assert "frames/000000.exr" in str(caught.value)
    return str(caught.value)


def rehash(folder: Path) -> dict[str, str]:
    return {"sha256": hashlib.sha256((folder / "frames/000000.exr").read_bytes()).hexdigest()}


def test_a_missing_truncated_or_changed_image_is_refused(folder: Path) -> None:
    path = folder / "frames/000000.exr"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    assert "damaged" in refused_frame(folder)
    refused_frame(folder, **rehash(folder))
    flipped = bytearray(content)
    flipped[-100] ^= 1
    path.write_bytes(flipped)
    assert "damaged" in refused_frame(folder)
    path.write_bytes(b"no image")
    assert "not a readable EXR" in refused_frame(folder, **rehash(folder))
    path.unlink()
    assert "No such file" in refused_frame(folder)


def test_an_image_of_another_size_kind_or_range_is_refused(folder: Path) -> None:
    path = folder / "frames/000000.exr"
    write_exr(path, np.zeros((300, 399), np.uint32))
    assert "399 x 300 pixels, but the camera has 400 x 300" in refused_frame(folder, **rehash(folder))
    write_exr(path, np.zeros((300, 400), np.float32))  # type: ignore[arg-type]
    assert "unsigned integers" in refused_frame(folder, **rehash(folder))
    write_exr(path, np.full((300, 400), 65536, np.uint32))
    assert "16 bits end at 65535" in refused_frame(folder, **rehash(folder))
    header = {"type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Z": np.zeros((300, 400), np.uint32)}) as file:
        file.write(str(path))
    assert "needed Y alone" in refused_frame(folder, **rehash(folder))
    roi = (np.array([0, 0], np.int32), np.array([499, 299], np.int32))
    with OpenEXR.File({**header, "displayWindow": roi}, {"Y": np.zeros((300, 400), np.uint32)}) as file:
        file.write(str(path))
    assert "displayWindow" in refused_frame(folder, **rehash(folder))


def write_parts(path: Path, boxes: list[tuple[int, int, int, int]]) -> None:
    """Parts of (row, column, rows, columns) on a display of 400 x 300."""
    display = (np.array([0, 0], np.int32), np.array([399, 299], np.int32))
    parts = []
    for number, (row, column, rows, columns) in enumerate(boxes):
        data = (np.array([column, row], np.int32), np.array([column + columns - 1, row + rows - 1], np.int32))
        header = {"type": OpenEXR.scanlineimage, "displayWindow": display, "dataWindow": data}
        image = np.full((rows, columns), number + 1, np.uint32)
        parts.append(OpenEXR.Part(header, {"Y": image}, name=f"region {number}"))
    OpenEXR.File(parts).write(str(path))


def test_regions_are_read_with_their_positions(folder: Path) -> None:
    write_parts(folder / "frames/000000.exr", [(10, 20, 30, 40), (100, 0, 5, 6), (200, 380, 100, 20)])
    dataset = read_dataset(folder)
    frame = read_frame(dataset, dataset.frames[0].model_copy(update=rehash(folder)))
    assert [(part.row, part.column, *part.image_dn.shape) for part in frame.parts] == [
        (10, 20, 30, 40),
        (100, 0, 5, 6),
        (200, 380, 100, 20),
    ]
    assert [part.image_dn.max() for part in frame.parts] == [1, 2, 3]


def test_regions_that_overlap_or_lie_beyond_the_sensor_are_refused(folder: Path) -> None:
    path = folder / "frames/000000.exr"
    write_parts(path, [(10, 20, 30, 40), (39, 59, 5, 5)])
    assert "overlaps another" in refused_frame(folder, **rehash(folder))
    write_parts(path, [(-1, 20, 30, 40)])
    assert "beyond the sensor" in refused_frame(folder, **rehash(folder))
    dataset = read_dataset(folder)
    beyond = dataset.frames[0].model_copy(update={**rehash(folder), "capturable": False})
    assert read_frame(dataset, beyond).parts[0].row == -1
    write_parts(path, [(0, -1000, 1, 17), (5, 0, 1400, 1400)])
    assert "16 times the sensor" in refused_frame(folder, **rehash(folder), capturable=False)


def test_a_frame_is_read_with_those_of_the_rig_s_other_cameras(folder: Path) -> None:
    change_json(folder, lambda c: c["cameras"].update(right=c["cameras"]["main"]))
    records = pq.read_table(folder / "frames.parquet")
    rows = records.to_pylist()
    rows[1].update(shot=0, burst=0, camera="right")
    rows[2].update(shot=1, burst=1)
    pq.write_table(pa.Table.from_pylist(rows, records.schema), folder / "frames.parquet")
    dataset = read_dataset(folder)
    first, second = (read_frame(dataset, number) for number in (0, 1))
    (other,) = first.other_cameras
    assert np.array_equal(other.parts[0].image_dn, second.parts[0].image_dn)
    assert other.other_cameras == ()
    assert read_frame(dataset, 2).other_cameras == ()
    assert read_frame(dataset, 0, with_other_cameras=False).other_cameras == ()


def test_each_frame_of_a_shot_has_all_the_others_and_itself_not(folder: Path) -> None:
    """Three cameras of a rig, with focal lengths that tell them apart, in the first and only shot."""
    focal_px = {"main": 1500.0, "left": 1501.0, "right": 1502.0}

    def mounted(content: dict[str, Any]) -> None:
        main = content["cameras"]["main"]
        content["cameras"] = {
            name: {
                **main,
                "K": [[f, 0.0, 200.0], [0.0, f, 150.0], [0.0, 0.0, 1.0]],
                "image_distance_mm": f * main["pixel_pitch_um"] / 1000,
            }
            for name, f in focal_px.items()
        }

    change_json(folder, mounted)
    change_rows(
        folder, lambda rows: [row.update(shot=0, burst=0, camera=n) for row, n in zip(rows, focal_px, strict=True)]
    )
    dataset = read_dataset(folder)
    for number, own in enumerate(focal_px.values()):
        frame = read_frame(dataset, number)
        assert frame.camera.K[0][0] == own
        assert [other.camera.K[0][0] for other in frame.other_cameras] == [f for f in focal_px.values() if f != own]


def test_a_digest_in_capital_letters_is_the_same_digest(folder: Path) -> None:
    before = read_frame(read_dataset(folder), 0).parts[0].image_dn
    change_rows(folder, lambda rows: [row.update(sha256=row["sha256"].upper()) for row in rows])
    assert np.array_equal(read_frame(read_dataset(folder), 0).parts[0].image_dn, before)
