"""Cells of score tables: rounding, units, infinite and missing values."""

from test_estimator_score import LEDS_M, TRUTH, failed, ok, truths

from estimator.evaluate.comparison import compare
from estimator.evaluate.score import VariantScore, score_variant
from estimator.evaluate.score_table import (
    ERROR_HEADERS,
    GROUP_HEADERS,
    LIMIT_HEADERS,
    LOST_HEADERS,
    PAIR_HEADERS,
    error_cells,
    group_cells,
    has_groups,
    interval_text,
    length_text,
    limit_cells,
    lost_cells,
    pair_cells,
    share_text,
)
from estimator.evaluate.statistics import Interval


def test_lengths_as_text() -> None:
    lengths = [None, 0.0, 1.234e-5, 0.0123456, 0.5, 0.9999, 12.345, 4.2e7]
    assert [length_text(length) for length in lengths] == [
        "–",
        "0 µm",
        "12.3 µm",
        "12.3 mm",
        "500 mm",
        "1 m",
        "12.3 m",
        "4.2e+07 m",
    ]


def test_intervals_as_text() -> None:
    assert interval_text(None) == "–"
    assert interval_text(Interval(low_m=0.0123, high_m=0.5)) == "12.3 to 500 mm"
    assert interval_text(Interval(low_m=0.5, high_m=1.5)) == "500 mm to 1.5 m"
    assert interval_text(Interval(low_m=-2e-6, high_m=1e-6)) == "-2 to 1 µm"


def test_shares_as_text_never_round_up_to_100() -> None:
    assert [share_text(*counts) for counts in ((0, 3), (1, 3), (3, 3), (9999, 10000), (0, 0))] == [
        "0 %",
        "33.3 %",
        "100 %",
        "99.9 %",
        "–",
    ]


def test_failed_frames_are_infinite_in_the_columns_of_all() -> None:
    rows = [ok(0, TRUTH), failed(1, "a: b"), failed(2, "a: b")]
    cells = dict(zip(ERROR_HEADERS, error_cells(score_variant("x", rows, truths(3), LEDS_M)), strict=True))
    assert (cells["ok"], cells["failed"], cells["success rate"]) == ("1", "2", "33.3 %")
    assert (cells["median of all"], cells["p95 of all"], cells["median"]) == ("∞", "∞", "0 µm")
    none = dict(zip(ERROR_HEADERS, error_cells(score_variant("x", [], [], LEDS_M)), strict=True))
    assert (none["success rate"], none["median of all"], none["time"]) == ("–", "–", "–")


def test_a_covariance_that_is_too_small_is_said_to_be() -> None:
    """Off by ten standard deviations on one frame of one: 100, where 99 % of consistent ones are below 12.8."""
    x, y, z = TRUTH
    sure = ok(0, (x + 0.1, y, z)).model_copy(update={"covariance_m2": (1e-4, 0, 0, 0, 1e-4, 0, 0, 0, 1e-4)})
    modest = ok(0, (x + 1e-4, y, z)).model_copy(update={"covariance_m2": sure.covariance_m2, "ambiguous": True})
    cells = [
        dict(zip(LIMIT_HEADERS, limit_cells(score_variant("x", [row], truths(1), LEDS_M)), strict=True))
        for row in (sure, modest)
    ]
    assert [c["NEES"] for c in cells] == ["100 (overconfident)", "0.0001 (conservative)"]
    assert [c["ambiguous"] for c in cells] == ["0", "1 (100 %)"]
    assert cells[0]["efficiency"] == "–"


def test_a_pair_is_counted_over_all_frames_and_compared_over_those_of_both() -> None:
    """A is nearer in two of the three frames of both: 66.6 %, whatever the two frames are where one failed."""
    x, y, z = TRUTH

    def scored(name: str, *errors_m: float | None) -> VariantScore:
        rows = [failed(k, "a: b") if e is None else ok(k, (x + e, y, z)) for k, e in enumerate(errors_m)]
        return score_variant(name, rows, truths(len(rows)), LEDS_M)

    a, b = scored("a", 0.01, 0.01, 0.04, 0.1, None), scored("b", 0.02, 0.04, 0.01, None, 0.1)
    cells = dict(zip(PAIR_HEADERS, pair_cells(compare(a, b)), strict=True))
    assert (cells["both"], cells["only A"], cells["only B"], cells["neither"]) == ("3", "1", "1", "0")
    assert (cells["A nearer"], cells["median A − B"]) == ("66.6 %", "-10 mm")
    alone = dict(zip(PAIR_HEADERS, pair_cells(compare(scored("a", None), scored("b", 0.1))), strict=True))
    assert list(alone.values()) == ["0", "0", "1", "0", "–", "–", "–", "–"]


def test_errors_and_bounds_stand_in_the_columns_of_their_names() -> None:
    """One frame: (3, 4, -12) cm off, 13 cm in all, 2 cm of range; a bound of 6.5 cm, half of the error; 0.1 s."""
    x, y, z = TRUTH
    bound_m2 = (0.065**2 / 3, 0.0, 0.0, 0.0, 0.065**2 / 3, 0.0, 0.0, 0.0, 0.065**2 / 3)
    score = score_variant("x", [ok(0, (x + 0.03, y + 0.04, z - 0.12), 3.02)], truths(1, bound_m2), LEDS_M)
    cells = dict(zip(ERROR_HEADERS, error_cells(score), strict=True))
    expected = dict.fromkeys(("median of all", "p95 of all", "median", "RMSE", "mean", "p95", "max"), "130 mm")
    expected |= {"horizontal": "50 mm", "vertical": "120 mm", "range": "20 mm", "time": "100 ms", "95 % interval": "–"}
    assert cells == {"ok": "1", "failed": "0", "success rate": "100 %", **expected}
    limits = dict(zip(LIMIT_HEADERS, limit_cells(score), strict=True))
    assert (limits["frames with a bound"], limits["bound"], limits["RMSE there"]) == ("1", "65 mm", "130 mm")
    assert (limits["efficiency"], limits["NEES"], limits["of"], limits["ambiguous"]) == ("0.5", "–", "0", "0")


def test_cells_by_device_and_map() -> None:
    """Devices 0 and 1 in maps 0 and 1, off by 3 and 4 mm with a sigma of 1 mm: NEES 9 and 16, 12.5 by map."""
    x, y, z = TRUTH
    sure = {"covariance_m2": (1e-6, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 1e-6)}
    rows = [ok(0, (x + 3e-3, y, z)).model_copy(update=sure), ok(1, (x + 4e-3, y, z)).model_copy(update=sure)]
    truth = [one.model_copy(update={"map": one.frame}) for one in truths(2)]
    score = score_variant("x", rows, truth, LEDS_M, devices=[0, 1])
    assert has_groups(score)
    cells = dict(zip(GROUP_HEADERS, group_cells(score), strict=True))
    assert (cells["devices"], cells["maps"], cells["RMSE by device"]) == ("2", "2", "3 to 4 mm")
    assert (cells["NEES by device"], cells["NEES by map"]) == ("9 to 16", "12.5")
    alone = score_variant("x", rows[:1], truth[:1], LEDS_M)
    assert not has_groups(alone)
    assert group_cells(alone)[4:] == ("–", "–")
    lost = score_variant("x", [failed(0, "a: b"), failed(1, "a: b")], truth, LEDS_M, devices=[0, 1])
    assert group_cells(lost)[2:4] == ("–", "–")


def test_failed_frames_by_good_leds_as_cells() -> None:
    """One frame of two without any good LED failed; no frame has more."""
    cells = lost_cells(score_variant("x", [ok(0, TRUTH), failed(1, "a: b")], truths(2), LEDS_M))
    assert dict(zip(LOST_HEADERS, cells, strict=True)) == {
        "no good LED": "1 of 2",
        **dict.fromkeys(("1", "2", "3", "4 or more"), "–"),
    }
