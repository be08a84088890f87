"""Tables of a dataset: their columns are those of FORMAT.md, rows survive the disk bit for bit, damage is named."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import copy_of

from estimator.errors import InputError as ReaderError
from estimator.io.dataset import read_dataset
from vlcrender.dataset.format import tables
from vlcrender.dataset.format.rows import (
    FRAMES_SCHEMA,
    TRUTH_SCHEMA,
    DeviceTruthRow,
    FileEntry,
    FrameRecord,
    FrameRow,
    LedTruth,
    MapTruthRow,
    SpotRow,
    TruthRow,
    arrow_schema,
    flat9,
)
from vlcrender.dataset.format.tables import read_table, write_table
from vlcrender.errors import InputError

SPOT = [("led", pa.int64()), ("u_px", pa.float64()), ("v_px", pa.float64())]
WAVE = [("clock_error", pa.float64()), ("phase", pa.float64()), ("bits", pa.string())]


def test_the_columns_are_those_of_the_format() -> None:
    """FORMAT.md's four tables, written out by hand."""
    expected = {
        "frame": pa.int64(),
        "shot": pa.int64(),
        "burst": pa.int64(),
        "start_s": pa.float64(),
        "pose": pa.int64(),
        "device": pa.int64(),
        "file": pa.string(),
        "part": pa.int64(),
        "sha256": pa.string(),
        "camera": pa.string(),
        "exposure_s": pa.float64(),
        "capturable": pa.bool_(),
        "accelerometer_m_s2": pa.list_(pa.float64(), 3),
        "gyro_rad_s": pa.list_(pa.float64(), 3),
        "spots": pa.list_(pa.struct(SPOT)),
        "split": pa.string(),
        "time_s": pa.float64(),
    }
    assert pa.schema(list(expected.items())).equals(FRAMES_SCHEMA)
    expected = {
        "frame": pa.int64(),
        "shot": pa.int64(),
        "map": pa.int64(),
        "K": pa.list_(pa.float64(), 9),
        "distortion": pa.list_(pa.float64(), 5),
        "position_m": pa.list_(pa.float64(), 3),
        "R_cam_world": pa.list_(pa.float64(), 9),
        "tilt_x_deg": pa.float64(),
        "tilt_y_deg": pa.float64(),
        "yaw_deg": pa.float64(),
        "angular_velocity_rad_s": pa.list_(pa.float64(), 3),
        "linear_velocity_m_s": pa.list_(pa.float64(), 3),
        "leds": pa.list_(pa.struct([*SPOT, ("visible_fraction", pa.float64()), *WAVE])),
        "added_noise_dn": pa.float64(),
        "bound_m2": pa.list_(pa.float64(), 9),
        "bound_exact_m2": pa.list_(pa.float64(), 9),
    }
    assert pa.schema(list(expected.items())).equals(TRUTH_SCHEMA)
    expected = {
        "device": pa.int64(),
        "map": pa.int64(),
        "camera": pa.string(),
        "K": pa.list_(pa.float64(), 9),
        "distortion": pa.list_(pa.float64(), 5),
        "R_cam_rig": pa.list_(pa.float64(), 9),
        "offset_m": pa.list_(pa.float64(), 3),
        "tilt_error_deg": pa.list_(pa.float64(), 2),
    }
    assert pa.schema(list(expected.items())).equals(arrow_schema(DeviceTruthRow))
    expected = {
        "map": pa.int64(),
        "led": pa.int64(),
        "position_m": pa.list_(pa.float64(), 3),
        "size_m": pa.float64(),
        "gradient": pa.list_(pa.float64(), 2),
    }
    assert pa.schema(list(expected.items())).equals(arrow_schema(MapTruthRow))


def record(rng: np.random.Generator, bound: bool) -> FrameRecord:
    """A record of doubles with all 53 bits in use, over many magnitudes."""

    def numbers(count: int) -> list[float]:
        values: list[float] = (rng.standard_normal(count) * 10.0 ** rng.integers(-12, 12, count)).tolist()
        return values

    u, v, share, exposure, *tilts = numbers(7)
    device = {
        "frame": 3,
        "shot": 2,
        "burst": 1,
        "start_s": numbers(1)[0],
        "pose": 1,
        "device": 1,
        "file": "frames/000003.exr",
        "part": 5 if bound else None,
        "sha256": "0" * 64,
        "camera": "main",
        "exposure_s": abs(exposure),
        "capturable": True,
        "accelerometer_m_s2": numbers(3),
        "gyro_rad_s": numbers(3) if bound else None,
        "spots": (SpotRow(led=7, u_px=u, v_px=v),),
    }
    wave: dict[str, Any] = {"clock_error": None, "phase": None, "bits": None}
    if bound:
        wave = {"clock_error": numbers(1)[0], "phase": numbers(1)[0], "bits": "0110"}
    truth = {
        "frame": 3,
        "shot": 2,
        "map": 1,
        "K": numbers(9),
        "distortion": numbers(5) if bound else None,
        "position_m": numbers(3),
        "R_cam_world": numbers(9),
        **dict(zip(("tilt_x_deg", "tilt_y_deg", "yaw_deg"), tilts, strict=True)),
        "angular_velocity_rad_s": numbers(3) if bound else None,
        "linear_velocity_m_s": numbers(3) if bound else None,
        "leds": (LedTruth(led=7, u_px=v, v_px=u, visible_fraction=share, **wave),),
        "bound_m2": numbers(9) if bound else None,
        "bound_exact_m2": numbers(9) if bound else None,
        "added_noise_dn": float(rng.uniform()) if bound else None,
    }
    files = {"frames/000003.exr": FileEntry(sha256="0" * 64, bytes=7)}
    return FrameRecord(device=FrameRow.model_validate(device), truth=TruthRow.model_validate(truth), files=files)


def test_rows_survive_journal_and_table_bit_for_bit(tmp_path: Path, rng: np.random.Generator) -> None:
    records = [record(rng, bound=bool(number % 2)) for number in range(200)]
    assert [FrameRecord.model_validate_json(line.model_dump_json()) for line in records] == records
    write_table(tmp_path / "frames.parquet", [r.device for r in records], FrameRow)
    write_table(tmp_path / "truth.parquet", [r.truth for r in records], TruthRow)
    assert read_table(tmp_path / "frames.parquet", FrameRow) == [r.device for r in records]
    assert read_table(tmp_path / "truth.parquet", TruthRow) == [r.truth for r in records]


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("position_m", None, "row 0: position_m: is empty"),
        ("tilt_x_deg", float("nan"), "row 0: tilt_x_deg: Input should be a finite number"),
        ("leds", [{"led": None, "u_px": 1.0, "v_px": 1.0, "visible_fraction": 1.0}], "row 0: leds.0.led: is empty"),
    ],
)
def test_an_empty_or_infinite_cell_is_named(
    tmp_path: Path, rng: np.random.Generator, column: str, value: object, words: str
) -> None:
    row = json.loads(record(rng, bound=True).truth.model_dump_json())
    table = pa.Table.from_pylist([{**row, column: value}], schema=TRUTH_SCHEMA)
    pq.write_table(table, tmp_path / "truth.parquet")
    with pytest.raises(InputError, match=words) as refusal:
        read_table(tmp_path / "truth.parquet", TruthRow)
    assert "\n" not in str(refusal.value)


def test_other_columns_are_named(tmp_path: Path) -> None:
    pq.write_table(pa.table({"frame": [0]}), tmp_path / "truth.parquet")
    with pytest.raises(InputError, match=r"columns differ from FORMAT\.md: .*yaw_deg: 0 times, needed once"):
        read_table(tmp_path / "truth.parquet", TruthRow)
    with pytest.raises(InputError, match=r"frames\.parquet: is missing"):
        read_table(tmp_path / "frames.parquet", FrameRow)


def test_a_table_of_other_names_or_types_is_refused_though_it_has_as_many_columns(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """A former version may differ in the name or the type of one column; the order of columns means nothing."""
    path = tmp_path / "truth.parquet"
    write_table(path, [record(rng, bound=True).truth], TruthRow)
    table = pq.read_table(path)
    yaw = table.schema.get_field_index("yaw_deg")
    pq.write_table(table.set_column(yaw, "yaw_deg", table["yaw_deg"].cast(pa.string())), path)
    with pytest.raises(InputError, match=r"columns differ from FORMAT\.md: yaw_deg: string, needed double$"):
        read_table(path, TruthRow)
    pq.write_table(table.rename_columns(["yaw" if name == "yaw_deg" else name for name in table.column_names]), path)
    with pytest.raises(InputError, match=r"columns differ from FORMAT\.md: yaw_deg: 0 times, needed once$"):
        read_table(path, TruthRow)
    pq.write_table(table.select(table.column_names[::-1]), path)
    assert len(read_table(path, TruthRow)) == 1


def test_a_matrix_is_written_row_by_row() -> None:
    assert flat9(np.arange(9.0).reshape(3, 3)) == (0, 1, 2, 3, 4, 5, 6, 7, 8)


def test_a_table_that_cannot_be_written_leaves_the_old_one(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "frames.parquet"
    path.write_bytes(b"old")

    def full(writer: pq.ParquetWriter, _table: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq.ParquetWriter, "write_table", full)
    with pytest.raises(InputError, match=r"frames\.parquet: cannot be written: No space left on device"):
        write_table(path, [record(rng, bound=True).device], FrameRow)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("count", [0, 1, 3, 4])
def test_a_table_of_several_groups_holds_all_rows_in_order(
    count: int, tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "ROWS_AT_ONCE", 2)
    rows = [record(rng, bound=True).truth for _ in range(count)]
    write_table(tmp_path / "truth.parquet", iter(rows), TruthRow)
    assert read_table(tmp_path / "truth.parquet", TruthRow) == rows
    assert pq.ParquetFile(tmp_path / "truth.parquet").num_row_groups == (count + 1) // 2


def test_a_text_that_is_no_utf_8_is_refused_in_one_line(rendered_set: Path, tmp_path: Path) -> None:
    """As a flipped bit makes it: Parquet's own checks do not look at texts."""
    table = pq.read_table(rendered_set / "frames.parquet")
    cameras = pa.array([b"ma\xedn"] * len(table), pa.binary()).view(pa.string())
    path = tmp_path / "frames.parquet"
    pq.write_table(table.set_column(table.schema.names.index("camera"), "camera", cameras), path)
    with pytest.raises(InputError, match=r"frames\.parquet: cannot be read as Parquet: .*utf-8") as refusal:
        read_table(path, FrameRow)
    assert "\n" not in str(refusal.value)
    # The name of a column that may be missing, in the schema: the first of its places.
    flipped = (rendered_set / "frames.parquet").read_bytes().replace(b"split", b"sp\xedit", 1)
    path.write_bytes(flipped)
    with pytest.raises(InputError, match=r"frames\.parquet: c") as refusal:
        read_table(path, FrameRow)
    assert "\n" not in str(refusal.value)
    copy_of(rendered_set, tmp_path / "set")
    (tmp_path / "set/frames.parquet").write_bytes(flipped)
    with pytest.raises(ReaderError, match=r"frames\.parquet"):
        read_dataset(tmp_path / "set")
