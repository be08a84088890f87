"""Errors by hand, failures counted, nothing dropped."""

import json
import os
from pathlib import Path

import pytest
from estimator_synthetic import small_dataset

from estimator.dataset import Led
from estimator.errors import InputError
from estimator.estimates import EstimateRow, LedRange, write_estimates
from estimator.score import Scores, length_text, read_or_score, score_dataset, score_variant

LEDS = {10: Led(id=10, position_m=(1.0, 2.0, 3.5), radius_m=0.01, shape="disc")}
TRUTH = (1.0, 2.0, 0.5)


def ok(frame: int, position: tuple[float, float, float], *ranges_m: float, time_s: float = 0.1) -> EstimateRow:
    ranges = tuple(LedRange(led=10, range_m=range_m) for range_m in ranges_m)
    return EstimateRow(frame=frame, status="ok", reason="", position_m=position, ranges=ranges, time_s=time_s)


def failed(frame: int, reason: str, *ranges_m: float) -> EstimateRow:
    ranges = tuple(LedRange(led=10, range_m=range_m) for range_m in ranges_m)
    return EstimateRow(frame=frame, status="failed", reason=reason, position_m=None, ranges=ranges, time_s=0.9)


def test_errors_of_a_frame_by_hand() -> None:
    """(0.03, 0.04, -0.12) off: 0.05 m horizontal, 0.12 m too low, 0.13 m in all; the LED is 3 m above the camera."""
    score = score_variant("x", [ok(0, (1.03, 2.04, 0.38), 3.02)], [TRUTH], LEDS)
    (row,) = score.rows
    assert row.horizontal_error_m == pytest.approx(0.05)
    assert row.vertical_error_m == pytest.approx(-0.12)
    assert row.error_3d_m == pytest.approx(0.13)
    assert row.range_errors[0].error_m == pytest.approx(0.02)
    assert score.vertical is not None
    assert score.vertical.median_m == pytest.approx(0.12)


def test_a_summary_by_hand() -> None:
    """Vertical errors 1, 2, 3, 6 m: median 2.5, mean 3, RMSE sqrt(50 / 4), p95 = 3 + 0.85 x 3, max 6; time 0.2 s."""
    heights = [1.0, -2.0, 3.0, 6.0]
    rows = [
        ok(i, (1.0, 2.0, 0.5 + h), time_s=t) for i, (h, t) in enumerate(zip(heights, (0.1, 0.2, 0.2, 5), strict=True))
    ]
    score = score_variant("x", rows, [TRUTH] * 4, LEDS)
    summary = score.error_3d
    assert summary is not None
    assert summary.median_m == pytest.approx(2.5)
    assert summary.mean_m == pytest.approx(3)
    assert summary.rmse_m == pytest.approx(12.5**0.5)
    assert summary.p95_m == pytest.approx(5.55)
    assert summary.max_m == pytest.approx(6)
    assert score.horizontal is not None
    assert score.horizontal.max_m == pytest.approx(0)
    assert score.median_time_s == pytest.approx(0.2)
    assert score.median_range_error_m is None


def test_failures_are_counted_by_reason_and_stay_in_the_rows() -> None:
    rows = [failed(0, "a: x", 4.0), ok(1, TRUTH, 3.1), failed(2, "b: y", 3.5), failed(3, "a: x")]
    score = score_variant("x", rows, [TRUTH] * 4, LEDS)
    assert (score.frames, score.ok, score.failed) == (4, 1, 3)
    assert score.failures == {"a: x": 2, "b: y": 1}
    assert [row.reason for row in score.rows] == ["a: x", "", "b: y", "a: x"]
    assert score.error_3d is not None
    assert score.error_3d.max_m == 0
    # Ranges of failed frames count: errors 1.0, 0.1 and 0.5 m.
    assert score.ranges == 3
    assert score.median_range_error_m == pytest.approx(0.5)


def test_without_a_success_there_is_no_summary() -> None:
    score = score_variant("x", [failed(0, "a: x")], [TRUTH], LEDS)
    assert (score.error_3d, score.horizontal, score.vertical, score.median_time_s) == (None, None, None, None)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = small_dataset(tmp_path_factory.mktemp("scored"))
    write_estimates(folder, "one", [ok(0, TRUTH, 3.0), failed(1, "a: <b>"), ok(2, TRUTH)])
    return folder


def test_scores_json_is_plain_json_and_comes_back(dataset: Path) -> None:
    scores = score_dataset(dataset)
    text = (dataset / "scores.json").read_text()

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    content = json.loads(text, parse_constant=refuse)
    assert content["variants"][0]["rows"][0]["true_m"] == pytest.approx([3.5, 3.6, 0.5])
    assert Scores.model_validate_json(text) == scores


def test_every_estimates_file_is_scored_also_of_other_programs(dataset: Path) -> None:
    assert [score.variant for score in score_dataset(dataset).variants] == ["one"]
    write_estimates(dataset, "one-b", [failed(frame, "x: y") for frame in range(3)])
    assert [score.variant for score in score_dataset(dataset).variants] == ["one", "one-b"]
    (dataset / "estimates/one-b.parquet").unlink()


def test_scores_are_made_again_only_where_estimates_are_newer_or_other(dataset: Path) -> None:
    first = score_dataset(dataset)
    truth = (dataset / "truth.parquet").read_bytes()
    (dataset / "truth.parquet").unlink()
    assert read_or_score(dataset) == first
    write_estimates(dataset, "two", [ok(frame, TRUTH) for frame in range(3)])
    (dataset / "truth.parquet").write_bytes(truth)
    assert len(read_or_score(dataset).variants) == 2
    (dataset / "estimates/two.parquet").unlink()
    assert len(read_or_score(dataset).variants) == 1
    later = (dataset / "scores.json").stat().st_mtime + 10
    write_estimates(dataset, "one", [ok(0, TRUTH), ok(1, TRUTH), ok(2, TRUTH)])
    os.utime(dataset / "estimates/one.parquet", (later, later))
    assert read_or_score(dataset).variants[0].ok == 3


def test_what_cannot_be_scored_is_named(tmp_path: Path) -> None:
    folder = small_dataset(tmp_path)
    with pytest.raises(InputError, match="no estimates to score"):
        score_dataset(folder)
    write_estimates(folder, "short", [ok(0, TRUTH)])
    with pytest.raises(InputError, match=r"short.parquet: 1 rows, needed one for each of the 3 frames"):
        score_dataset(folder)
    stranger = ok(0, TRUTH, 3.0).model_copy(update={"ranges": (LedRange(led=99, range_m=1.0),)})
    write_estimates(folder, "short", [stranger, ok(1, TRUTH), ok(2, TRUTH)])
    with pytest.raises(InputError, match="a range to LED 99"):
        score_dataset(folder)
    write_estimates(folder, "short", [ok(0, TRUTH), ok(1, TRUTH), ok(2, TRUTH)])
    (folder / "truth.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(InputError, match=r"truth.parquet: not a readable Parquet file"):
        score_dataset(folder)
    (folder / "truth.parquet").unlink()
    with pytest.raises(InputError, match=r"truth.parquet: no such file"):
        score_dataset(folder)


def test_lengths_for_people() -> None:
    lengths = [None, 0.0, 1.234e-5, 0.0123456, 0.5, 12.345, 4.2e7]
    assert [length_text(length) for length in lengths] == [
        "–",
        "0 µm",
        "12.3 µm",
        "12.3 mm",
        "500 mm",
        "12.3 m",
        "4.2e+07 m",
    ]
