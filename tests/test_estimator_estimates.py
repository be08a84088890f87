"""Estimates on disk: rows come back as written, and those of other frames are refused."""

import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from estimator.errors import InputError
from estimator.io.device import Identity
from estimator.io.estimates import EstimateRow, LedRange, estimates_path, read_estimates, write_estimates


@pytest.fixture(scope="module")
def good(synthetic_set: Path) -> Path:
    return synthetic_set


@pytest.fixture
def folder(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "copy"))


ROWS = (
    EstimateRow(frame=0, status="ok", reason="", position_m=(1.0, 2.0, 0.5), ranges=(), time_s=0.1),
    EstimateRow(
        frame=1,
        status="failed",
        reason="position: why",
        position_m=None,
        ranges=(LedRange(led=10, range_m=3.5),),
        time_s=0.2,
        identities=(
            Identity(led=10, u_px=1.5, v_px=2.5, correlation=0.99, bits="01-1", position_m=(1.0, 2.0, 3.5)),
            Identity(led=None, u_px=7.0, v_px=8.0, correlation=0.5),
        ),
    ),
)


def test_estimates_come_back_as_written_in_the_formats_types(folder: Path) -> None:
    path = write_estimates(folder, "some", ROWS)
    assert path == estimates_path(folder, "some") == folder / "estimates/some.parquet"
    assert read_estimates(path, 2) == ROWS
    types = {field.name: str(field.type) for field in pq.read_schema(path)}
    assert types == {
        "frame": "int64",
        "status": "string",
        "reason": "string",
        "position_m": "list<element: double>",
        "covariance_m2": "list<element: double>",
        "ambiguous": "bool",
        "ranges": "list<element: struct<led: int64, range_m: double>>",
        "time_s": "double",
        "identities": "list<element: struct<led: int64, u_px: double, v_px: double, correlation: double, "
        "bits: string, position_m: list<element: double>>>",
        "spots": "list<element: struct<led: int64, u_px: double, v_px: double, snr: double>>",
    }
    assert [entry.name for entry in path.parent.iterdir()] == ["some.parquet"]


def test_estimates_for_other_frames_are_refused(folder: Path) -> None:
    path = write_estimates(folder, "some", ROWS)
    with pytest.raises(InputError, match="2 rows, needed one for each of the 3 frames"):
        read_estimates(path, 3)


def test_a_failed_row_has_a_reason_and_no_position() -> None:
    good = ROWS[0].model_dump()
    for change in ({"status": "failed"}, {"reason": "x: y"}, {"position_m": None}, {"status": "unsure"}):
        with pytest.raises(ValueError, match="1 validation error"):
            EstimateRow(**{**good, **change})


def test_estimates_in_another_order_are_refused(folder: Path) -> None:
    """As many rows as frames: a row counts for the frame that it names, not for its place."""
    rows = [ROWS[0].model_copy(update={"frame": frame}) for frame in (0, 2, 1)]
    path = write_estimates(folder, "shuffled", rows)
    with pytest.raises(InputError, match=r"shuffled\.parquet: 3 rows, needed one for each of the 3 frames, in order"):
        read_estimates(path, 3)
