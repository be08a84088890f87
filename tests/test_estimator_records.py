"""Rows of Parquet files: which row is refused, and what a row of many LEDs costs."""

import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from estimator.errors import InputError
from estimator.io.records import ROWS_AT_ONCE
from estimator.io.truth import COLUMNS, read_truth

LEDS = 30


def written(path: Path, rows: int, bad: int | None = None) -> Path:
    """A truth of poses level at one place, each with LEDS LEDs; the tilt of row `bad` is 400 deg."""
    leds = [{"led": i, "u_px": 10.5 * i, "v_px": 7.25 * i, "visible_fraction": 1.0, "bits": None} for i in range(LEDS)]
    row = {
        **{"position_m": [1.0, 2.0, 0.5], "bound_m2": None, "bound_exact_m2": None, "map": 0, "leds": leds},
        **{"R_cam_world": np.eye(3).ravel().tolist(), "tilt_x_deg": 0.0, "tilt_y_deg": 0.0, "yaw_deg": 0.0},
    }
    records = [{"frame": i, **row, **({"tilt_x_deg": 400.0} if i == bad else {})} for i in range(rows)]
    pq.write_table(pa.Table.from_pylist(records, pa.schema(list(COLUMNS.items()))), path)
    return path


@pytest.mark.parametrize("bad", [0, ROWS_AT_ONCE - 1, ROWS_AT_ONCE, 2 * ROWS_AT_ONCE + 3])
def test_a_row_that_is_refused_is_named_by_its_number(tmp_path: Path, bad: int) -> None:
    path = written(tmp_path / "truth.parquet", 2 * ROWS_AT_ONCE + 5, bad)
    with pytest.raises(InputError, match=rf"truth.parquet: row {bad}\.tilt_x_deg: .*\(got 400\.0\)"):
        read_truth(path, 2 * ROWS_AT_ONCE + 5)


def test_an_led_of_a_row_costs_three_hundred_bytes_at_most(tmp_path: Path) -> None:
    """Five references and the object, 56 bytes, and up to five numbers of 32: 216. As a validated model with a set of
    its fields it would cost 1100. The row itself, with a set of its fields, has 3000 at most.
    """
    rows = 4 * ROWS_AT_ONCE
    path = written(tmp_path / "truth.parquet", rows)
    read_truth(path, rows)
    tracemalloc.start()
    truth = read_truth(path, rows)
    size, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size < len(truth) * (300 * LEDS + 3000)
    # Some rows are read at a time, as dictionaries: a fourth of the table here.
    assert peak < 1.8 * size
