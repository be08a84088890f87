"""Tables of a metric by settings: what is counted in which row, by hand; sweeps, bins, groups, and bad input."""

import csv
import io
import json
from dataclasses import replace
from math import inf, isnan
from pathlib import Path

import numpy as np
import pytest
from conftest import copy_of, run
from estimator_sets import normal_errors, write_set, write_sweep
from estimator_synthetic import View

import estimator as est
from estimator.evaluate.frame_columns import read_frame_columns
from estimator.evaluate.table import Key, Table, TableRow, table
from estimator.evaluate.table_text import table_csv, table_json, table_text
from estimator.io.estimates import read_estimates, write_estimates
from estimator.io.sweep import read_sweep

A = [0.01, 0.02, 0.04, None]
B = [0.1, 0.2, 0.3, 0.4]


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("plain") / "set", {"a": A, "b": B})


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sigmas times two lenses, of two frames each."""
    cells = [
        ({"sigma": sigma, "lens": lens}, {"a": [sigma + 0.01 * (lens == "wide"), 2 * sigma], "b": [None, sigma]})
        for sigma in (0.5, 2.0)
        for lens in ("tele", "wide")
    ]
    return write_sweep(tmp_path_factory.mktemp("swept") / "sweep", cells)


def rows(found: Table) -> dict[tuple[object, ...], TableRow]:
    return {(*(key.value for key in row.keys), *row.group): row for row in found.rows}


def values(found: Table) -> dict[tuple[object, ...], list[float]]:
    return {place: [one.value for one in row.statistics] for place, row in rows(found).items()}


def test_statistics_of_a_plain_set_by_variant(plain: Path) -> None:
    """Of a, 10, 20 and 40 mm are answered and one frame failed: p75 is interpolated at rank 1.5 of 0 to 2, 30 mm.

    Of all four, the median is the second, and the 95th percentile is the failed one.
    """
    found = table(plain, statistics=["mean", "median", "p75", "of_all", "success_rate"])
    assert found.statistics == ("mean", "median", "p75", "median_of_all", "p95_of_all", "success_rate")
    assert values(found)["a",] == pytest.approx([0.07 / 3, 0.02, 0.03, 0.02, inf, 0.75])
    assert values(found)["b",] == pytest.approx([0.25, 0.25, 0.325, 0.2, 0.4, 1.0])
    row = rows(found)["a",]
    assert (row.frames, row.answered, row.failures) == (4, 3, {"detect: no spot": 1})


def test_the_interval_of_an_rmse_is_that_of_the_mean_square(plain: Path) -> None:
    """10, 20 and 40 mm have the mean square 7 cm2; Student's quantile with 2 degrees of freedom is 4.3027."""
    squares = np.array([1.0, 4.0, 16.0])
    half = 4.30265 * squares.std(ddof=1) / np.sqrt(3)
    one = rows(table(plain, statistics=["rmse"]))["a",].statistics[0]
    assert (one.value, one.low) == (pytest.approx(0.07**0.5 / 10), 0.0)
    assert one.high == pytest.approx(0.01 * (7 + half) ** 0.5, rel=1e-5)


def test_the_scores_agree_with_the_table(plain: Path, tmp_path: Path) -> None:
    """`of_all` means what it means in scores.json, and so does an interpolated percentile."""
    scores = est.score(copy_of(plain, tmp_path))
    found = values(table(plain, statistics=["mean", "median", "p95", "of_all", "rmse"]))
    for one in scores.variants:
        assert one.of_all is not None
        assert one.error_3d is not None
        of_all = [inf if size is None else size for size in (one.of_all.median_m, one.of_all.p95_m)]
        expected = [one.error_3d.mean_m, one.error_3d.median_m, one.error_3d.p95_m, *of_all, one.error_3d.rmse_m]
        assert found[one.variant,] == pytest.approx(expected)


def test_swept_names_are_keys(swept: Path) -> None:
    found = table(swept, x=["sigma"], by=["variant", "lens"])
    assert values(found) == {
        (0.5, "a", "tele"): [pytest.approx(0.75)],
        (0.5, "a", "wide"): [pytest.approx(0.755)],
        (0.5, "b", "tele"): [0.5],
        (0.5, "b", "wide"): [0.5],
        (2.0, "a", "tele"): [3.0],
        (2.0, "a", "wide"): [pytest.approx(3.005)],
        (2.0, "b", "tele"): [2.0],
        (2.0, "b", "wide"): [2.0],
    }
    two = table(swept, x=["lens", "sigma"], by=[], variants=["b"], statistics=["success_rate"])
    assert [[key.value for key in row.keys] for row in two.rows] == [
        *(["tele", 0.5], ["tele", 2.0], ["wide", 0.5], ["wide", 2.0])
    ]
    assert [row.statistics[0].value for row in two.rows] == [0.5] * 4


def test_a_cell_is_a_set_of_its_own(swept: Path) -> None:
    found = table(swept / "cells/000003", x=["sigma"], by=["variant"])
    assert values(found) == {(2.0, "a"): [pytest.approx(3.005)], (2.0, "b"): [2.0]}


def test_cells_of_one_pose_are_one_sample(tmp_path: Path) -> None:
    """Errors that differ by pose alone, in eight cells: the interval is that of the six poses, not of 48 frames."""
    errors = normal_errors(6)
    sweep = write_sweep(tmp_path / "sweep", [({"sigma": float(cell)}, {"a": errors}) for cell in range(8)])
    alone = table(sweep, x=["sigma"], statistics=["mean"]).rows[0].statistics[0]
    pooled = table(sweep, statistics=["mean"]).rows[0].statistics[0]
    assert (pooled.low, pooled.high) == pytest.approx((alone.low, alone.high))
    assert not isnan(pooled.low)


def test_cells_of_different_poses_are_different_samples(tmp_path: Path) -> None:
    """Where each pose is a cell of its own, all have pose 0, at places of their own."""
    sweep = write_sweep(tmp_path / "sweep", [({"sigma": float(cell)}, {"a": [0.0]}) for cell in range(6)])
    errors = [0.01, 0.02, 0.03, 0.05, 0.06, 0.07]
    for cell, error in enumerate(errors):
        view = View(400, 300, 1500.0, (1.0 + cell, 3.0, 0.5))
        write_set(sweep / f"cells/{cell:06d}", {"a": [error]}, {"sigma": float(cell)}, [view])
    one = table(sweep, statistics=["median"]).rows[0].statistics[0]
    assert (one.low, one.value, one.high) == pytest.approx((0.01, 0.04, 0.07))  # six frames: the first and the last


def test_frames_of_a_device_are_one_sample(tmp_path: Path) -> None:
    errors = [0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08]
    plain = write_set(tmp_path / "plain", {"a": errors})
    devices = write_set(tmp_path / "devices", {"a": errors}, devices=[0, 0, 0, 0, 1, 1, 1, 1])
    repeats = write_set(tmp_path / "repeats", {"a": errors}, poses=[0, 0, 1, 1, 2, 2, 3, 3])

    def half(folder: Path) -> float:
        one = table(folder, statistics=["mean"]).rows[0].statistics[0]
        return one.high - one.value

    # Standard errors of the mean, mm: sqrt(600 / 8); of the pairs' sums -60, -20, 20, 60; of the devices' -80 and 80.
    errors_mm = [600**0.5 / 8**0.5, (4 / 3 * 8000) ** 0.5 / 8, (2 * 12800) ** 0.5 / 8]
    student = [2.36462, 3.18245, 12.7062]  # with 7, 3 and 1 degrees of freedom
    found = [half(folder) for folder in (plain, repeats, devices)]
    assert found == pytest.approx([1e-3 * t * mm for t, mm in zip(student, errors_mm, strict=True)], rel=1e-5)


def test_columns_of_truth_and_scores_are_keys_and_metrics(tmp_path: Path) -> None:
    """LEDs at x = 2.8 and 3.2 m, 3 m up; the camera at 3.1 m sees both, that at 4 m the first alone."""
    views = [
        View(400, 300, 1500.0, (3.1, 3.0, 0.5)),
        View(400, 300, 1500.0, (4.0, 3.0, 0.5), 30.0, 0.0),
    ]
    folder = write_set(tmp_path / "set", {"a": [0.01, 0.03]}, views=views)
    columns = read_frame_columns([folder]).columns
    assert columns["leds"].tolist() == [2.0, 1.0]
    assert columns["tilt_deg"].tolist() == pytest.approx([0.0, 30.0])
    assert columns["tilt_x_deg"].tolist() == pytest.approx([0.0, 30.0])
    assert columns["distance_m"].tolist() == pytest.approx(
        [(np.hypot(0.3, 3.0) + np.hypot(0.1, 3.0)) / 2, np.hypot(1.2, 3.0)]
    )
    assert columns["x_m"].tolist() == [3.1, 4.0]
    assert values(table(folder, x=["leds"])) == {(1.0, "a"): [pytest.approx(0.03)], (2.0, "a"): [pytest.approx(0.01)]}
    assert values(table(folder, metric="capturable", statistics=["mean"])) == {("a",): [0.5]}
    assert values(table(folder, metric="vertical_error_m")) == {("a",): [0.0]}


def test_cameras_are_groups(tmp_path: Path) -> None:
    folder = write_set(tmp_path / "set", {"a": A}, cameras=["main", "left", "main", "left"])
    assert values(table(folder, by=["camera"], statistics=["p95_of_all"])) == {
        ("left",): [inf],
        ("main",): [pytest.approx(0.04)],
    }


def test_keys_are_binned(plain: Path) -> None:
    """Positions 3, 4, 5 and 6 m: a bin holds its lower edge, the last one both, and frames outside are left out."""
    by_edges = table(plain, x=["x_m"], bins={"x_m": [3.0, 5.0, 5.5]}, variants=["b"], by=[])
    assert [(row.keys[0], row.frames) for row in by_edges.rows] == [
        (Key(4.0, 3.0, 5.0), 2),
        (Key(5.25, 5.0, 5.5), 1),
    ]
    by_number = table(plain, x=["x_m"], bins={"x_m": 3}, variants=["b"], by=[])
    assert [(row.keys[0], row.frames) for row in by_number.rows] == [
        *((Key(3.5, 3.0, 4.0), 1), (Key(4.5, 4.0, 5.0), 1), (Key(5.5, 5.0, 6.0), 2))
    ]


def test_many_numbers_are_binned_unasked(tmp_path: Path) -> None:
    many = write_set(tmp_path / "many", {"a": normal_errors(25)})
    few = write_set(tmp_path / "few", {"a": normal_errors(24)})
    assert [len(table(folder, x=["x_m"]).rows) for folder in (many, few)] == [10, 24]


def test_several_sets_are_told_apart(plain: Path, swept: Path, tmp_path: Path) -> None:
    found = table([plain, swept], variants=["b"])
    assert found.by == ("set", "variant")
    assert values(found) == {("set", "b"): [pytest.approx(0.25)], ("sweep", "b"): [1.25]}
    assert table([plain, swept], x=["set"], variants=["b"]).by == ("variant",)
    with pytest.raises(est.InputError, match="key sigma: no such column"):
        table(plain, x=["sigma"])
    assert [row.frames for row in table([plain, swept], x=["sigma"], variants=["b"]).rows] == [4, 4]
    again = copy_of(plain, tmp_path / "other/set")
    names = {row.group[0] for row in table([plain, again], variants=["b"]).rows}
    assert names == {str(plain), str(again)}
    with pytest.raises(est.InputError, match="a folder is given twice"):
        table([plain, plain])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--x", "sigmas"], "key sigmas: no such column; there are: "),
        (["--metric", "error"], "metric error: no such column; there are: "),
        (["--metric", "camera"], "metric camera: holds texts, needed numbers"),
        (["--by", "variant,lens"], "column lens: no such column"),
        (["--stat", "average"], "statistic average: unknown; allowed: mean, rmse, median, pN such as p75"),
        (["--stat", "p0"], "statistic p0: unknown"),
        (["--stat", "p100"], "statistic p100: unknown"),
        (["--by", ""], "keys: needed one key, or one column for groups"),
        (["--x", "leds", "--by", "leds"], "keys leds, leds: one is given twice"),
        (["--x", "camera", "--bins", "3"], "bins of camera: it holds texts, needed numbers"),
        (["--x", "x_m", "--bins", "0"], "bins of x_m: 0, needed 1 to 1000, or edges"),
        (["--x", "x_m", "--bins", "3,2"], "bins of x_m: needed two or more edges, rising"),
        (["--x", "x_m", "--bins", "a"], "--bins a: needed a number of bins, or edges such as 0,10,20"),
        (["--bins", "leds=3"], "bins of leds: is not one of the keys: there are none"),
        (["--x", "bound_m"], "key bound_m: no frame has a value of it"),
        (["--variant", "c"], "none of variant c; there are: a, b"),
    ],
)
def test_bad_input_is_one_line(plain: Path, arguments: list[str], message: str) -> None:
    finished = run("estimator", "table", str(plain), *arguments)
    assert finished.returncode == 2
    assert message in finished.stderr
    assert finished.stderr.count("\n") == 1


def test_the_printed_table_has_no_boxes_and_a_line_a_row(swept: Path) -> None:
    arguments = ["--x", "sigma", "--by", "lens,variant", "--stat", "median,of_all,success_rate"]
    finished = run("estimator", "table", str(swept), *arguments)
    lines = finished.stdout.splitlines()
    assert lines[0].split()[:4] == ["sigma", "lens", "variant", "frames"]
    assert len(lines) == 1 + 8 + 1
    assert lines[1].split() == [
        *("0.5", "tele", "a", "2", "2", "750", "mm", "0", "µm", "to", "∞", "500", "mm", "0", "µm", "to", "∞"),
        *("1", "m", "500", "mm", "to", "∞", "100", "%", "15.8", "%", "to", "100.0", "%"),
    ]
    assert lines[2].endswith("1 x detect: no spot")
    assert not set(finished.stdout) & set("│┃─━╇┡")


def test_csv_holds_the_table_in_full(swept: Path, tmp_path: Path) -> None:
    out = tmp_path / "table.csv"
    arguments = ["--x", "sigma", "--stat", "median,p95_of_all", "--csv", str(out), "--variant", "b", "--bins", "2"]
    assert run("estimator", "table", str(swept), *arguments).returncode == 0
    first, second = csv.DictReader(io.StringIO(out.read_text()))
    assert (first["sigma"], first["sigma_low"], first["sigma_high"]) == ("0.875", "0.5", "1.25")
    assert (second["variant"], second["frames"], second["answered"]) == ("b", "4", "2")
    assert (second["error_3d_m_median"], second["error_3d_m_p95_of_all"]) == ("2.0", "inf")
    assert second["failures"] == "2 x detect: no spot"


def test_json_has_null_where_a_value_is_infinite(plain: Path) -> None:
    found = json.loads(table_json(table(plain, statistics=["of_all"])))
    assert (found["format"], found["metric"], found["by"]) == ("estimator-table", "error_3d_m", ["variant"])
    first = found["rows"][0]
    assert (first["variant"], first["error_3d_m_p95_of_all"]) == ("a", None)
    assert first["failures"] == {"detect: no spot": 1}


def test_json_with_a_number_that_json_has_not_is_refused() -> None:
    """ "NaN" in a file would be read by Python alone. A statistic that there is not is null; a setting is a number."""
    made = Table("error_3d_m", ("sigma",), (), (), (TableRow((Key(float("nan")),), (), 1, 1, (), {}),))
    with pytest.raises(ValueError, match="JSON"):
        table_json(made)


def test_reasons_are_counted_whatever_their_numbers(plain: Path, tmp_path: Path) -> None:
    """Three frames fail alike but for their numbers; a line shows two reasons, the CSV all."""
    folder = copy_of(plain, tmp_path / "set")
    reasons = ["identify: 3 of 12", "identify: 0.5 of 7", "identify: 10 of 1", "position: a"]
    rows = read_estimates(folder / "estimates/b.parquet", 4)
    failed = [
        row.model_copy(update={"status": "failed", "position_m": None, "reason": reason})
        for row, reason in zip(rows, reasons, strict=True)
    ]
    write_estimates(folder, "b", failed)
    found = table(folder, variants=["b"])
    assert found.rows[0].failures == {"identify: N of N": 3, "position: a": 1}
    many = replace(found.rows[0], failures={"a: x": 5, "b: x": 4, "c: x": 3, "d: x": 2})
    both = replace(found, rows=(many,))
    assert table_text(both).endswith("5 x a: x; 4 x b: x; 5 x other")
    assert "3 x c: x; 2 x d: x" in table_csv(both)


def test_pandas_gets_the_records(plain: Path) -> None:
    frame = table(plain, statistics=["mean"]).to_pandas()
    assert list(frame.columns) == [
        *("variant", "frames", "answered", "error_3d_m_mean", "error_3d_m_mean_low", "error_3d_m_mean_high"),
        "failures",
    ]
    assert frame["frames"].tolist() == [4, 4]


def test_the_text_and_csv_of_an_empty_table() -> None:
    empty = Table("error_3d_m", ("x_m",), ("variant",), ("mean",), ())
    assert table_text(empty).split() == ["x_m", "variant", "frames", "answered", "mean", "95", "%", "failures"]
    assert table_csv(empty) == "\n"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "sweep"}, "sweep.json: format: Input should be 'vlcrender-sweep'"),
        ({"version": 2}, "sweep.json: version: Input should be 1"),
        ({"cells": []}, "sweep.json: cells: "),
        ({"cells": [{"folder": "../a"}]}, "sweep.json: cells.0.folder: Value error, has to be a path below the sweep"),
        ({"cells": [{"folder": "/a"}]}, "has to be a path below the sweep"),
        ({"cells": [{"folder": "cells/9"}]}, "cells/9: no such folder"),
    ],
)
def test_a_damaged_sweep_is_one_line(swept: Path, tmp_path: Path, change: dict[str, object], message: str) -> None:
    folder = copy_of(swept, tmp_path)
    content = json.loads((folder / "sweep.json").read_text())
    (folder / "sweep.json").write_text(json.dumps(content | change))
    for command in ("run", "score", "table"):
        finished = run("estimator", command, str(folder))
        assert (finished.returncode, finished.stderr.count("\n")) == (2, 1)
        assert message in finished.stderr


def test_commands_for_one_set_refuse_a_sweep_by_name(swept: Path, tmp_path: Path) -> None:
    sweep = read_sweep(swept)
    assert sweep is not None
    for arguments in (["report", "--out", str(tmp_path / "a.html")], ["compare", "a", "b"]):
        finished = run("estimator", arguments[0], str(swept), *arguments[1:])
        assert finished.returncode == 2
        assert f"{swept}: a sweep; needed one dataset, such as {sweep.cells[0]}" in finished.stderr
