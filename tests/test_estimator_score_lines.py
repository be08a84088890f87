"""Scores on a terminal of any width, in texts of other formats, and as limits of a regression test."""

import csv
import io
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import copy_of

import estimator
from estimator.cli import main
from estimator.errors import InputError
from estimator.evaluate.score import Scores
from estimator.evaluate.threshold import Threshold
from estimator.io.estimates import EstimateRow, write_estimates
from estimator.report.score_lines import (
    Column,
    columns_of,
    folded,
    score_latex,
    score_lines,
    score_markdown,
    spread_lines,
    unit_named,
)

ABOUT = "3 frames, 7 x 7 x 3.5 m, 400 x 300 px, accelerometer 0 deg"


@pytest.fixture(scope="module")
def scores(scored_set: Path) -> Scores:
    return Scores.model_validate_json((scored_set / "scores.json").read_bytes())


@pytest.mark.parametrize("width", [40, 80, 120, 200])
@pytest.mark.parametrize("spread", [False, True])
def test_no_line_is_wider_than_the_terminal_and_no_figure_is_cut(scores: Scores, width: int, spread: bool) -> None:
    lines = score_lines(scores, ABOUT, width, spread=spread)
    assert max(map(len, lines)) <= width
    assert not any("…" in line for line in lines)
    for one in scores.variants:
        if one.ok or one.entry.inapplicable is None:
            row = next(line for line in lines if line.startswith(one.variant + " "))
            # The median is in every table: a whole figure, as the widest table has it.
            (wide,) = (line for line in score_lines(scores, ABOUT, 500) if line.startswith(one.variant + " "))
            assert row.split()[1] == wide.split()[1]


def test_variants_stand_in_the_order_of_their_medians_and_failures_count_as_infinite(scores: Scores) -> None:
    lines = score_lines(scores, ABOUT, 80)
    medians_m = {one.variant: one.of_all.median_m for one in scores.variants if one.of_all is not None}
    start = next(i for i, line in enumerate(lines) if line.startswith("---"))
    end = next(i for i, line in enumerate(lines) if line.startswith("---") and i > start)
    names = [line.split()[0] for line in lines[start + 1 : end]]
    sizes = [float("inf") if medians_m[name] is None else medians_m[name] for name in names]
    assert len(names) >= 8
    assert sizes == sorted(sizes)


def test_variants_that_do_not_apply_stand_below_the_table(scores: Scores) -> None:
    lines = score_lines(scores, ABOUT, 80)
    assert "not for this set  kim, rahman2011: needs two cameras" in lines
    assert not any(line.startswith(("kim ", "rahman2011 ")) for line in lines)


def test_a_wider_terminal_has_more_columns_and_a_narrow_one_the_most_important(scores: Scores) -> None:
    tables = {width: score_lines(scores, ABOUT, width) for width in (40, 80, 200)}
    headers = {
        width: set(re.split(r"\s{2,}", next(line for line in lines if line.startswith("variant"))))
        for width, lines in tables.items()
    }
    assert headers[40] < headers[80] < headers[200]
    assert "median" in headers[40]
    assert {"95 %", "max", "answered"} <= headers[80]


def test_decimal_points_stand_under_each_other() -> None:
    column = Column("median", 0, ["2.04", "13.3", "34 600", "out", "3.05+", ""])
    assert column.aligned() == [
        "    median",
        "     2.04 ",
        "    13.3  ",
        "34 600    ",
        "   out    ",
        "     3.05+",
        "          ",
    ]


def test_a_column_without_a_value_is_left_out(scores: Scores) -> None:
    names = [column.name for column in columns_of(scores.variants, "mm", 10.0)]
    without = [one.model_copy(update={"nees": None, "ratio_to_bound": None}) for one in scores.variants]
    assert "NEES" in names
    assert "NEES" not in [column.name for column in columns_of(without, "mm", 10.0)]


def test_errors_beyond_the_room_are_out_and_the_unit_is_one_s_choice(scores: Scores) -> None:
    (one,) = (one for one in scores.variants if one.variant == "pnp")
    assert one.of_all is not None
    assert one.of_all.median_m is not None
    (cell,) = columns_of([one], "mm", 10.0)[0].cells
    assert float(cell.replace(" ", "")) == pytest.approx(one.of_all.median_m * 1e3, rel=5e-3)
    assert columns_of([one], "mm", one.of_all.median_m / 2)[0].cells == ["out"]
    assert unit_named("um") == "µm"
    with pytest.raises(InputError, match="--unit furlong: needed one of um, mm, m"):
        unit_named("furlong")


def test_names_longer_than_half_the_terminal_stand_above_their_figures(scores: Scores) -> None:
    long = "huynh2016:denoise=anscombe,spot=brightest,level=printed,ranges=printed"
    renamed = scores.model_copy(
        update={"variants": tuple(v.model_copy(update={"variant": long}) for v in scores.variants[:1])}
    )
    lines = score_lines(renamed, ABOUT, 80)
    at = lines.index(long)
    assert re.match(r" +\S", lines[at + 1])
    assert max(map(len, score_lines(renamed, ABOUT, 40))) <= 40


def test_a_text_is_folded_between_words_and_within_one_that_is_too_long() -> None:
    assert folded("one two three", 8) == ["one two", "  three"]
    assert folded("x" * 20, 8)[0] == "x" * 8
    assert all(len(line) <= 8 for line in folded("x" * 20, 8))


def test_the_spread_counts_each_error_once(scores: Scores) -> None:
    """One error a variant: a single full bar, in the bin of its logarithm; with the first decade marked by a point."""
    (one,) = (one for one in scores.variants if one.variant == "pnp")
    row = replace(one.rows[0], error_3d_m=2e-3)
    lines = spread_lines([one.model_copy(update={"rows": (row,)})], 10.0, 80)
    # log10(2) x 8 bins a decade = 2.4: the third bin after the point at 1 mm.
    assert lines == ["spread 1 mm", "pnp    . █"]


@pytest.mark.slow
def test_a_pipe_gets_80_columns_and_a_terminal_without_a_micro_sign_plain_text(
    scored_set: Path, tmp_path: Path
) -> None:
    folder = copy_of(scored_set, tmp_path)
    code = "import sys; from estimator.cli import main; sys.exit(main())"
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    environment.pop("COLUMNS", None)
    command = [sys.executable, "-c", code, "score", str(folder), "--plot"]
    finished = subprocess.run(command, env=environment, capture_output=True, check=True)
    text = finished.stdout.decode("ascii")
    assert "?" not in text
    assert 60 < max(map(len, text.splitlines())) <= 80


def test_tables_for_other_programs_have_every_column(
    scored_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], scores: Scores
) -> None:
    folder = copy_of(scored_set, tmp_path)
    assert main(["score", str(folder), "--csv"]) == 0
    rows = {row["variant"]: row for row in csv.DictReader(io.StringIO(capsys.readouterr().out))}
    for one in scores.variants:
        if one.error_3d is not None:
            assert float(rows[one.variant]["error_3d_median_m"]) == one.error_3d.median_m
    assert main(["score", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["dataset"] == scores.dataset
    markdown, latex = score_markdown(scores), score_latex(scores)
    bodies = [line for line in markdown.splitlines() if line.startswith("|")]
    assert len({line.replace("\\|", "").count("|") for line in bodies}) == 1
    assert latex.count(r"\\") == len(bodies) - 1
    assert latex.count("&") == (len(bodies) - 1) * (len(re.findall(r"---", bodies[1])) - 1) + scores.dataset.count("&")
    assert main(["score", str(folder), "--quiet"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ml:median", "needed VARIANT:STATISTIC=LIMIT"),
        ("ml:mean=1mm", "statistics: median, p95, max, rmse, failures"),
        ("ml:median=1", "a length needs one of the units"),
        ("ml:median=1 furlong", "a length needs one of the units"),
        ("ml:median=-1mm", "needed VARIANT:STATISTIC=LIMIT"),
        ("ml:failures=2mm", "failures are a number of frames, or a share with %"),
        ("other:median=1mm", "no estimates of other; there are: "),
    ],
)
def test_a_limit_that_says_nothing_is_refused(scores: Scores, text: str, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        Threshold.of(text).exceeded_by(scores)


def test_a_limit_is_exceeded_by_more_and_kept_by_as_much(scores: Scores) -> None:
    (one,) = (one for one in scores.variants if one.variant == "pnp")
    assert one.error_3d is not None
    largest_mm = one.error_3d.max_m * 1e3
    assert Threshold.of(f"pnp:max={largest_mm * (1 + 1e-9):.15f}mm").exceeded_by(scores) is None
    told = Threshold.of(f"pnp:max={largest_mm * (1 - 1e-9):.15f}mm").exceeded_by(scores)
    assert told is not None
    assert told.startswith(f"pnp: max {largest_mm:.4g} mm exceeds")
    assert Threshold.of("kim:median=100m").exceeded_by(scores) == "kim: median inf exceeds 1e+05 mm"
    assert Threshold.of("kim:failures=2").exceeded_by(scores) == "kim: failures 3 exceeds 2"
    assert Threshold.of("kim:failures=3").exceeded_by(scores) is None
    assert Threshold.of("kim:failures=99%").exceeded_by(scores) == "kim: failures 100 % exceeds 99 %"


def test_a_variant_with_options_has_limits_too() -> None:
    limit = Threshold.of("huynh2016:denoise=none:p95=2 cm")
    assert (limit.variant, limit.statistic, limit.limit) == ("huynh2016:denoise=none", "p95", 0.02)


def test_score_ends_with_1_above_a_limit(scored_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = copy_of(scored_set, tmp_path)
    assert main(["score", str(folder), "--quiet", "--fail-above", "pnp:median=1m"]) == 0
    assert main(["score", str(folder), "--quiet", "--fail-above", "pnp:median=1m", "--fail-above", "pnp:max=1um"]) == 1
    found = capsys.readouterr()
    assert found.out == ""
    assert re.fullmatch(r"estimator: pnp: max \S+ mm exceeds 0.001 mm\n", found.err)


def test_run_ends_with_1_where_a_named_variant_answers_no_frame(
    synthetic_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = copy_of(synthetic_set, tmp_path)
    assert main(["run", str(folder), "--variant", "kim", "--variant", "pnp"]) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("estimator: kim answered no frame: ")
    # Of all variants some never apply: that is no error.
    assert main(["run", str(folder)]) == 0


def test_a_variant_whose_package_is_missing_says_so_before_it_runs(
    synthetic_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("estimator.methods.variant.find_spec", lambda name: None)
    folder = copy_of(synthetic_set, tmp_path)
    assert main(["run", str(folder), "--variant", "up2p"]) == 2
    told = "estimator: variant up2p: poselib is not installed (pip install vlcrender[poselib])\n"
    assert capsys.readouterr().err == told
    assert not (folder / "estimates").exists()


def test_the_median_of_a_variant_without_an_answer_is_infinite(
    synthetic_set: Path, tmp_path: Path, scores: Scores
) -> None:
    folder = copy_of(synthetic_set, tmp_path)
    rows = [EstimateRow.model_validate({**row}) for row in _failed_rows(3)]
    write_estimates(folder, "broken", rows)
    lines = score_lines(estimator.score(folder), ABOUT, 80)
    (row,) = (line for line in lines if line.startswith("broken"))
    assert row.split()[1] == "inf"
    assert row.endswith("0/3")


def _failed_rows(count: int) -> list[dict[str, object]]:
    return [
        {
            "frame": frame,
            "status": "failed",
            "reason": "test: broken",
            "position_m": None,
            "covariance_m2": None,
            "ambiguous": False,
            "ranges": (),
            "identities": None,
            "spots": None,
            "time_s": 0.1,
        }
        for frame in range(count)
    ]
