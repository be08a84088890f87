"""Scores: errors by hand, failures counted, no frame dropped."""

import gc
import json
import os
from collections import Counter
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import copy_of

from estimator.errors import InputError
from estimator.evaluate.frame_score import FrameScore
from estimator.evaluate.score import Scores, score, score_variant
from estimator.evaluate.scores_file import read_or_score
from estimator.io.dataset import FrameRecord
from estimator.io.device import DecodedSpot
from estimator.io.estimates import EstimateRow, FoundSpot, LedRange, write_estimates
from estimator.io.led_map import DiscLed
from estimator.io.truth import TrueLed, TruthRow, read_truth

LEDS = {10: DiscLed(id=10, position_m=(1.0, 2.0, 3.5), radius_m=0.01)}
LEDS_M = {led.id: led.position_m for led in LEDS.values()}
TRUTH = (1.0, 2.0, 0.5)


def truths(count: int, bound_m2: tuple[float, ...] | None = None) -> list[TruthRow]:
    return [
        TruthRow(
            frame=frame,
            position_m=TRUTH,
            bound_m2=bound_m2,
            bound_exact_m2=bound_m2,
            map=0,
            R_cam_world=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
            tilt_x_deg=0.0,
            tilt_y_deg=0.0,
            yaw_deg=0.0,
            leds=(),
        )
        for frame in range(count)
    ]


def ok(frame: int, position: tuple[float, float, float], *ranges_m: float, time_s: float = 0.1) -> EstimateRow:
    ranges = tuple(LedRange(led=10, range_m=range_m) for range_m in ranges_m)
    return EstimateRow(frame=frame, status="ok", reason="", position_m=position, ranges=ranges, time_s=time_s)


def failed(frame: int, reason: str, *ranges_m: float) -> EstimateRow:
    ranges = tuple(LedRange(led=10, range_m=range_m) for range_m in ranges_m)
    return EstimateRow(frame=frame, status="failed", reason=reason, position_m=None, ranges=ranges, time_s=0.9)


def test_errors_of_a_frame_by_hand() -> None:
    """(0.03, 0.04, -0.12) off: 0.05 m horizontal, 0.12 m too low, 0.13 m in all; the LED is 3 m above the camera."""
    score = score_variant("x", [ok(0, (1.03, 2.04, 0.38), 3.02)], truths(1), LEDS_M)
    (row,) = score.rows
    assert row.horizontal_error_m == pytest.approx(0.05)
    assert row.vertical_error_m == pytest.approx(-0.12)
    assert row.error_3d_m == pytest.approx(0.13)
    assert row.range_errors[0].error_m == pytest.approx(0.02)
    assert score.vertical is not None
    assert score.vertical.median_m == pytest.approx(0.12)


def test_frames_of_no_stated_device_are_of_device_0() -> None:
    """As in the format, where the first device has the number 0: groups by device are then of one."""
    frames = score_variant("x", [ok(0, TRUTH), ok(1, TRUTH)], truths(2), LEDS_M)
    assert [row.device for row in frames.rows] == [0, 0]
    of_two = score_variant("x", [ok(0, TRUTH), ok(1, TRUTH)], truths(2), LEDS_M, [0, 1])
    assert [row.device for row in of_two.rows] == [0, 1]


def test_a_summary_by_hand() -> None:
    """Vertical errors 1, 2, 3, 6 m: median 2.5, mean 3, RMSE sqrt(50 / 4), p95 = 3 + 0.85 x 3, max 6; time 0.2 s."""
    heights = [1.0, -2.0, 3.0, 6.0]
    rows = [
        ok(i, (1.0, 2.0, 0.5 + h), time_s=t) for i, (h, t) in enumerate(zip(heights, (0.1, 0.2, 0.2, 5), strict=True))
    ]
    score = score_variant("x", rows, truths(4), LEDS_M)
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
    assert score.range_error is None


def test_failures_are_counted_by_reason_and_stay_in_the_rows() -> None:
    rows = [failed(0, "a: x", 4.0), ok(1, TRUTH, 3.1), failed(2, "b: y", 3.5), failed(3, "a: x")]
    score = score_variant("x", rows, truths(4), LEDS_M)
    assert (score.frames, score.ok, score.failed) == (4, 1, 3)
    assert score.failures == {"a: x": 2, "b: y": 1}
    assert [row.reason for row in score.rows] == ["a: x", "", "b: y", "a: x"]
    assert score.error_3d is not None
    assert score.error_3d.max_m == 0
    # Ranges of failed frames count: errors 1.0, 0.1 and 0.5 m.
    assert score.ranges == 3
    assert score.range_error is not None
    assert score.range_error.median_m == pytest.approx(0.5)


def test_without_a_success_there_is_no_summary() -> None:
    score = score_variant("x", [failed(0, "a: x")], truths(1), LEDS_M)
    assert (score.error_3d, score.horizontal, score.vertical, score.median_time_s) == (None, None, None, None)


def test_the_bound_is_held_against_the_frames_that_have_it_and_succeeded() -> None:
    """Errors 3, 4 and 12 mm; bounds of 6 mm on frames 1 and 3, of which 3 failed: 6 / 4."""
    x, y, z = TRUTH
    rows = [ok(0, (x + 0.003, y, z)), ok(1, (x, y + 0.004, z)), ok(2, (x, y, z + 0.012)), failed(3, "a: x")]
    bound_m2 = (12e-6, 0.0, 0.0, 0.0, 12e-6, 0.0, 0.0, 0.0, 12e-6)
    truth = [row.model_copy(update={"bound_m2": bound_m2 if row.frame % 2 else None}) for row in truths(4)]
    score = score_variant("x", rows, truth, LEDS_M)
    assert score.against_bound is not None
    assert score.against_bound.frames == 1
    assert score.against_bound.efficiency == pytest.approx(1.5)
    assert [row.bound_m for row in score.rows] == [None, pytest.approx(0.006), None, pytest.approx(0.006)]


def test_reported_covariances_and_ambiguity_are_counted() -> None:
    """An error of one and of two standard deviations: 1 and 4, mean 2.5; the third frame reports no covariance."""
    x, y, z = TRUTH
    covariance_m2 = (1e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 1e-4)
    rows = [ok(k, (x + 0.01 * (k + 1), y, z)).model_copy(update={"covariance_m2": covariance_m2}) for k in range(2)]
    rows.append(ok(2, TRUTH).model_copy(update={"ambiguous": True}))
    score = score_variant("x", rows, truths(3), LEDS_M)
    assert score.nees is not None
    assert (score.nees.frames, score.nees.mean) == (2, pytest.approx(2.5))
    assert [row.nees for row in score.rows] == [pytest.approx(1), pytest.approx(4), None]
    assert (score.ambiguous, score.success_rate) == (1, 1.0)


def test_failing_the_worst_frames_lowers_the_success_rate_and_no_error_of_all() -> None:
    """The summary of the ok frames falls to a tenth; those over all frames do not."""
    x, y, z = TRUTH
    rows = [ok(k, (x + (0.01 if k < 15 else 1.0), y, z)) for k in range(20)]
    complete = score_variant("x", rows, truths(20), LEDS_M)
    dropped = score_variant("x", [*rows[:15], *(failed(k, "a: too hard") for k in range(15, 20))], truths(20), LEDS_M)
    assert complete.error_3d is not None
    assert dropped.error_3d is not None
    assert dropped.error_3d.rmse_m < complete.error_3d.rmse_m / 10
    assert (complete.success_rate, dropped.success_rate) == (1.0, 0.75)
    assert complete.of_all is not None
    assert dropped.of_all is not None
    assert dropped.of_all.median_m == pytest.approx(0.01)
    assert (complete.of_all.p95_m, dropped.of_all.p95_m) == (pytest.approx(1.0), None)
    assert dropped.frames == complete.frames == len(dropped.rows)


@pytest.fixture(scope="module")
def dataset(synthetic_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = copy_of(synthetic_set, tmp_path_factory.mktemp("scored"))
    write_estimates(folder, "one", [ok(0, TRUTH, 3.0), failed(1, "a: <b>"), ok(2, TRUTH)])
    return folder


def test_scores_keep_no_record_of_a_frame(scored_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As scores.json is written, records of truth, frames and estimates of one frame are left at most, of three."""
    folder, alive = copy_of(scored_set, tmp_path), Counter[type]()

    def count(*_: object) -> None:
        alive.update(type(one) for one in gc.get_objects())

    monkeypatch.setattr("estimator.evaluate.score.write_atomically", count)
    gc.collect()
    before = Counter(type(one) for one in gc.get_objects())
    scores = score(folder)
    truth = read_truth(folder / "truth.parquet", 3)
    variants = len(scores.variants)
    of_frame = {TruthRow: 1, FrameRecord: 1, EstimateRow: variants}
    leds = len(truth[-1].leds)
    of_frame |= {TrueLed: leds, DecodedSpot: leds, FoundSpot: variants * leds}
    assert alive[FrameScore] - before[FrameScore] == 3 * variants  # the count sees small records
    assert [kind.__name__ for kind, most in of_frame.items() if alive[kind] - before[kind] > most] == []


def test_scores_json_is_plain_json_and_comes_back(dataset: Path) -> None:
    scores = score(dataset)
    text = (dataset / "scores.json").read_text()

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    content = json.loads(text, parse_constant=refuse)
    assert content["variants"][0]["rows"][0]["true_m"] == pytest.approx([3.5, 3.6, 0.5])
    assert Scores.model_validate_json(text) == scores


def test_every_estimates_file_is_scored_also_of_other_programs(dataset: Path) -> None:
    assert [score.variant for score in score(dataset).variants] == ["one"]
    write_estimates(dataset, "one-b", [failed(frame, "x: y") for frame in range(3)])
    assert [score.variant for score in score(dataset).variants] == ["one", "one-b"]
    (dataset / "estimates/one-b.parquet").unlink()


def test_scores_are_made_again_only_where_a_file_has_other_bytes(dataset: Path) -> None:
    first = score(dataset)
    truth = (dataset / "truth.parquet").read_bytes()
    (dataset / "truth.parquet").unlink()
    assert read_or_score(dataset) == first
    write_estimates(dataset, "two", [ok(frame, TRUTH) for frame in range(3)])
    (dataset / "truth.parquet").write_bytes(truth)
    assert len(read_or_score(dataset).variants) == 2
    (dataset / "estimates/two.parquet").unlink()
    assert len(read_or_score(dataset).variants) == 1
    write_estimates(dataset, "one", [ok(0, TRUTH), ok(1, TRUTH), ok(2, TRUTH)])
    os.utime(dataset / "estimates/one.parquet", (0, 0))  # as a copy that keeps times
    assert read_or_score(dataset).variants[0].ok == 3
    written = (dataset / "scores.json").stat().st_mtime_ns
    later = written / 1e9 + 10
    for path in (dataset / "estimates/one.parquet", dataset / "truth.parquet"):
        os.utime(path, (later, later))
    read_or_score(dataset)
    assert (dataset / "scores.json").stat().st_mtime_ns == written


def test_scores_are_made_again_where_the_truth_is_another(synthetic_set: Path, tmp_path: Path) -> None:
    """As when a dataset is made again, with bounds."""
    folder = copy_of(synthetic_set, tmp_path)
    write_estimates(folder, "one", [ok(frame, TRUTH) for frame in range(3)])
    assert score(folder).variants[0].rows[0].bound_m is None
    table = pq.read_table(folder / "truth.parquet")
    bounds = pa.array([[1e-6, 0, 0, 0, 1e-6, 0, 0, 0, 2e-6]] * 3, table.schema.field("bound_m2").type)
    index = table.schema.get_field_index("bound_m2")
    pq.write_table(table.set_column(index, "bound_m2", bounds), folder / "truth.parquet")
    os.utime(folder / "truth.parquet", (0, 0))
    assert read_or_score(folder).variants[0].rows[0].bound_m == pytest.approx(2e-3)


def test_what_cannot_be_scored_is_named(synthetic_set: Path, tmp_path: Path) -> None:
    folder = copy_of(synthetic_set, tmp_path)
    with pytest.raises(InputError, match="no estimates to score"):
        score(folder)
    write_estimates(folder, "short", [ok(0, TRUTH)])
    with pytest.raises(InputError, match=r"short.parquet: 1 rows, needed one for each of the 3 frames"):
        score(folder)
    stranger = ok(0, TRUTH, 3.0).model_copy(update={"ranges": (LedRange(led=99, range_m=1.0),)})
    write_estimates(folder, "short", [stranger, ok(1, TRUTH), ok(2, TRUTH)])
    with pytest.raises(InputError, match="a range to LED 99"):
        score(folder)
    write_estimates(folder, "short", [ok(0, TRUTH), ok(1, TRUTH), ok(2, TRUTH)])
    (folder / "truth.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(InputError, match=r"truth.parquet: not a readable Parquet file"):
        score(folder)
    (folder / "truth.parquet").unlink()
    with pytest.raises(InputError, match=r"truth.parquet: no such file"):
        score(folder)


def test_truth_in_another_order_is_refused(synthetic_set: Path, tmp_path: Path) -> None:
    """As many rows as frames, the second and third exchanged: every error of theirs would be wrong."""
    folder = copy_of(synthetic_set, tmp_path)
    write_estimates(folder, "one", [ok(frame, TRUTH) for frame in range(3)])
    table = pq.read_table(folder / "truth.parquet")
    pq.write_table(table.take([0, 2, 1]), folder / "truth.parquet")
    with pytest.raises(InputError, match=r"truth\.parquet: 3 rows, needed one for each of the 3 frames, in order"):
        score(folder)


def test_the_efficiency_is_of_the_frames_that_have_a_bound() -> None:
    """Errors of 1 m without a bound stand before one of 12 mm with a bound of 6 mm: efficiency 1/2."""
    x, y, z = TRUTH
    rows = [ok(0, (x + 1, y, z)), failed(1, "a: x"), ok(2, (x, y, z + 0.012))]
    bound_m2 = (12e-6, 0.0, 0.0, 0.0, 12e-6, 0.0, 0.0, 0.0, 12e-6)
    truth = [row.model_copy(update={"bound_m2": bound_m2 if row.frame == 2 else None}) for row in truths(3)]
    found = score_variant("x", rows, truth, LEDS_M).against_bound
    assert found is not None
    assert (found.frames, found.rmse_m, found.efficiency) == (1, pytest.approx(0.012), pytest.approx(0.5))


def test_a_variant_that_gives_up_early_does_not_look_fast() -> None:
    """Times are of the frames that succeeded: 0.1, 0.3 and 0.5 s; failed ones took 0.9 s here and could take none."""
    rows = [*(ok(k, TRUTH, time_s=t) for k, t in enumerate((0.5, 0.1, 0.3))), *(failed(k, "a: x") for k in (3, 4, 5))]
    assert score_variant("x", rows, truths(6), LEDS_M).median_time_s == pytest.approx(0.3)


def test_a_range_that_is_too_long_has_a_positive_error() -> None:
    (row,) = score_variant("x", [ok(0, TRUTH, 3.02, 2.99)], truths(1), LEDS_M).rows
    assert [error.error_m for error in row.range_errors] == pytest.approx([0.02, -0.01])


def test_the_bound_of_a_frame_is_the_root_of_its_trace() -> None:
    """Variances of 4, 9 and 36 mm^2: 7 mm; the covariances do not count."""
    bound_m2 = (4e-6, 1e-6, 2e-6, 1e-6, 9e-6, 3e-6, 2e-6, 3e-6, 36e-6)
    (row,) = score_variant("x", [ok(0, TRUTH)], truths(1, bound_m2), LEDS_M).rows
    assert row.bound_m == pytest.approx(0.007)


def test_scores_by_device_map_and_good_leds_by_hand() -> None:
    """Devices 3 and 5 are in map 1, device 4 in map 0. Errors 3 and 4 mm of device 3: RMSE sqrt(12.5) mm, NEES 12.5."""
    x, y, z = TRUTH
    sure = {"covariance_m2": (1e-6, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 1e-6)}
    rows = [
        ok(0, (x + 3e-3, y, z)).model_copy(update=sure),
        ok(1, (x, y + 1e-3, z)),
        ok(2, (x, y, z + 4e-3)).model_copy(update=sure),
        failed(3, "a: b"),
        failed(4, "a: b"),
    ]
    shares = ([1.0] * 5, [1.0, 1.0, 0.4], [1.0] * 4, [1.0, 1.0, 0.999], [1.0, 1.0, 1.0, 1 - 1e-9])
    truth = [
        one.model_copy(
            update={
                "map": of_map,
                "leds": tuple(
                    TrueLed(led=k, u_px=0.0, v_px=0.0, bits=None, visible_fraction=share)
                    for k, share in enumerate(of_frame)
                ),
            }
        )
        for one, of_map, of_frame in zip(truths(5), (1, 0, 1, 1, 0), shares, strict=True)
    ]
    score = score_variant("x", rows, truth, LEDS_M, devices=[3, 4, 3, 5, 4])
    table = [(d.device, d.map, d.frames, d.failed, d.rmse_m, d.nees) for d in score.by_device]
    rmse = pytest.approx(12.5**0.5 * 1e-3)
    assert table == [
        (3, 1, 2, 0, rmse, pytest.approx(12.5)),
        (4, 0, 2, 1, pytest.approx(1e-3), None),
        (5, 1, 1, 1, None, None),
    ]
    by_map = [(m.map, m.devices, m.frames, m.failed, m.rmse_m, m.nees) for m in score.by_map]
    assert by_map == [(0, 1, 2, 1, pytest.approx(1e-3), None), (1, 2, 3, 1, rmse, pytest.approx(12.5))]
    assert [(g.good_leds, g.frames, g.failed) for g in score.by_good_leds] == [
        (0, 0, 0),
        (1, 0, 0),
        (2, 2, 1),
        (3, 0, 0),
        (4, 3, 1),
    ]
    assert [(row.device, row.map, row.good_leds) for row in score.rows][:2] == [(3, 1, 5), (4, 0, 2)]


def test_one_of_several_devices_has_no_interval() -> None:
    """Its frames share errors, and nothing tells how devices differ. One device in all has independent frames."""
    sure = {"covariance_m2": (1e-6, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 1e-6)}
    rows = [*(ok(k, TRUTH).model_copy(update=sure) for k in range(3)), failed(3, "a: b")]
    several = score_variant("x", rows, truths(4), LEDS_M, devices=[0, 0, 0, 1])
    assert (several.median_interval, several.rmse_interval, several.nees) == (None, None, None)
    assert several.by_device[0].nees == 0.0
    alone = score_variant("x", rows, truths(4), LEDS_M, devices=[0, 0, 0, 0])
    assert alone.median_interval is not None
    assert alone.nees is not None


def test_both_bounds_are_compared_where_they_differ() -> None:
    """Error 4 mm, bounds of 2 mm and, for a device that knows all, 1 mm: efficiencies 0.5 and 0.25."""
    x, y, z = TRUTH
    bound = (4e-6 / 3, 0.0, 0.0, 0.0, 4e-6 / 3, 0.0, 0.0, 0.0, 4e-6 / 3)
    exact = tuple(value / 4 for value in bound)
    rows = [ok(0, (x + 4e-3, y, z))]
    (truth,) = truths(1, bound)
    both = score_variant("x", rows, [truth.model_copy(update={"bound_exact_m2": exact})], LEDS_M)
    assert both.against_bound is not None
    assert both.against_exact_bound is not None
    assert both.against_bound.efficiency == pytest.approx(0.5)
    assert both.against_exact_bound.efficiency == pytest.approx(0.25)
    alone = score_variant("x", rows, [truth], LEDS_M)
    assert alone.against_exact_bound is None
    assert alone.against_bound == both.against_bound


def test_the_devices_and_maps_of_a_set_are_scored(synthetic_set: Path, tmp_path: Path) -> None:
    """The column `device` of the frames and `map` of the truth."""
    folder = copy_of(synthetic_set, tmp_path / "set")
    for name, column, values in (("frames", "device", [0, 1, 0]), ("truth", "map", [2, 3, 2])):
        table = pq.read_table(folder / f"{name}.parquet")
        table = table.drop_columns([column])
        pq.write_table(table.append_column(column, pa.array(values, pa.int64())), folder / f"{name}.parquet")
    write_estimates(folder, "x", [ok(k, TRUTH) for k in range(3)])
    (variant,) = score(folder).variants
    assert [(one.device, one.map, one.frames) for one in variant.by_device] == [(0, 2, 2), (1, 3, 1)]
    assert sum(one.frames for one in variant.by_good_leds if one.good_leds == 4) == 3
