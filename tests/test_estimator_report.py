"""The page's parts: marks that tell many variants apart, curves that end where the answers do, the bound in sight."""

import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from html_text import texts
from test_estimator_score import LEDS, LEDS_M, TRUTH, failed, ok, truths

from estimator.evaluate.score import Scores, VariantScore, score_variant
from estimator.evaluate.score_table import (
    ERROR_HEADERS,
    ERROR_NOTE,
    LOST_HEADERS,
    LOST_NOTE,
    error_cells,
    interval_text,
)
from estimator.report.figures import Decades, device_plot, distribution_plot, error_plot
from estimator.report.report import page
from estimator.report.svg import COLOURS, DASHES, MARKS, mark, style_of_variants

BOUND = (1e-6, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 2e-6)


def scored(
    errors_m: Sequence[float | None], name: str = "x", bound_m2: tuple[float, ...] | None = None
) -> VariantScore:
    x, y, z = TRUTH
    rows = [failed(k, "a: b") if e is None else ok(k, (x + e, y, z)) for k, e in enumerate(errors_m)]
    return score_variant(name, rows, truths(len(rows), bound_m2), LEDS_M)


def scores_of(variants: Sequence[VariantScore]) -> Scores:
    return Scores(dataset="set", room_m=(4.0, 5.0, 3.5), led_map=tuple(LEDS.values()), variants=tuple(variants))


def test_28_variants_have_marks_and_curves_of_their_own() -> None:
    count = len(COLOURS) * len(MARKS)
    style = style_of_variants(count)
    looks = set()
    for index in range(count):
        (colour,) = re.findall(rf"svg \.v{index} {{ stroke: (#\w+);", style)
        (dash,) = re.findall(rf"svg \.curve\.v{index} {{ stroke-dasharray: ([^;]+);", style)
        shape = re.sub(rf"v{index}\b", "", mark(0, 0, 1, index))
        looks.add((colour, dash, shape))
        assert (colour, shape) not in [(c, s) for c, d, s in looks if d != dash]
    assert len(looks) == count
    assert len(DASHES) == len(MARKS)


def curve_ends(svg: str) -> list[float]:
    """Shares at which the curves end, from the height of their last step between the first rules (0 and 100 %)."""
    rules = [float(y) for y in re.findall(r'<line class="rule" x1="72\.0" y1="([\d.]+)"', svg)]
    bottom, top = max(rules), min(rules)
    ends = []
    for path in re.findall(r'<path class="curve v\d+" d="M72 \d+([^"]*)"', svg):
        steps = [float(y) for y in re.findall(r"V([\d.]+)", path)]
        ends.append((bottom - steps[-1]) / (bottom - top) if steps else 0.0)
    return ends


def test_a_curve_ends_at_the_success_rate() -> None:
    """To a tenth of a pixel of 300."""
    variants = [scored([0.1] * 4), scored([0.1, None, None, 0.2]), scored([None] * 4)]
    assert curve_ends(distribution_plot(variants)) == pytest.approx([1.0, 0.5, 0.0], abs=1e-3)


def test_the_bound_is_in_both_plots_where_there_is_one() -> None:
    without, with_bound = scored([0.1, None]), scored([0.1, None], bound_m2=BOUND)
    assert "bound" not in error_plot([without]) + distribution_plot([without])
    # A ledge also for the frame that failed: the bound is the frame's.
    (ledges,) = re.findall(r'<path class="bound" d="([^"]*)"', error_plot([with_bound]))
    assert ledges.count("h") == 2
    assert distribution_plot([with_bound]).count('<line class="bound"') == 1


def test_the_axis_holds_errors_and_bounds_and_no_more_labels_than_fit() -> None:
    assert Decades.of([scored([0.03, 0.5])]) == Decades(-2, 0)
    assert Decades.of([scored([0.03, 0.5], bound_m2=BOUND)]) == Decades(-3, 0)
    assert Decades.of([scored([0.0, None])]) == Decades(-6, -5)
    assert Decades.of([scored([None])]) == Decades(-3, 0)
    assert Decades.of([]) == Decades(-3, 0)
    assert len(Decades(-6, 100).labelled_m()) <= 13


@pytest.mark.parametrize(("frames", "step"), [(1, 1), (12, 1), (13, 2), (200, 20), (601, 100)])
def test_frames_are_numbered_in_round_steps(frames: int, step: int) -> None:
    svg = error_plot([scored([None] * frames)])
    numbers = [int(n) for n in re.findall(r'text-anchor="middle">(\d+)</text>', svg)]
    assert numbers == list(range(0, frames, step))


def test_odd_scores_make_a_page_too(tmp_path: Path) -> None:
    """No variant, no frame, all frames failed, one exact frame, a huge error."""
    for variants in (
        [],
        [scored([])],
        [scored([None])],
        [scored([0.0])],
        [scored([1e99, None]), scored([0.1, 0.1], "y")],
    ):
        html = page([(tmp_path, scores_of(variants))])
        assert "nan" not in html
        assert html.count("<table>") == html.count("</table>")


def test_the_page_pairs_each_variant_with_the_best_and_says_which(tmp_path: Path) -> None:
    variants = [scored([0.2, 0.3], "far"), scored([0.1, None], "half"), scored([0.1, 0.1], "near:by=all")]
    html = page([(tmp_path, scores_of(variants))])
    assert "Frame by frame against near:by=all" in html
    (table,) = re.findall(r"Frame by frame.*?<tbody>(.*?)</tbody>", html, flags=re.DOTALL)
    assert table.count("<tr>") == 2
    assert "near:" not in table


def test_the_table_of_bounds_is_left_out_if_it_is_empty(tmp_path: Path) -> None:
    title = "Cramér-Rao bound and covariance consistency"
    assert title not in page([(tmp_path, scores_of([scored([0.1, 0.2])]))])
    assert title in page([(tmp_path, scores_of([scored([0.1, 0.2], bound_m2=BOUND)]))])


def test_the_text_of_a_page_by_hand(tmp_path: Path) -> None:
    """One frame 100 mm off and one failed, in order: title, scores, failures, the two plots, floor plan."""
    found = texts(page([(tmp_path, scores_of([scored([0.1, None])]))]))
    cells = ["1", "1", "50 %", "100 mm", "∞", *["100 mm"] * 6, "0 µm", "–", "100 ms"]
    row = ["x", *cells]
    curves = ["x", "0 %", "25 %", "50 %", "75 %", "95 %", "100 %", "100 mm", "1 m", "3D error, share of all frames"]
    tips = ["frame 0: 100 mm", "frame 1: a: b"]
    assert found == [
        "Positioning report: set",
        "Positioning report",
        "No frame is dropped: failed frames are counted beside the errors of the others, and count as infinite errors "
        "in the columns “of all”.",
        *("set", "2 frames · 1 LEDs · room 4 × 5 × 3.5 m", "Scores", "variant", *ERROR_HEADERS, *row, ERROR_NOTE),
        *("Failed frames by good LEDs", "variant", *LOST_HEADERS, "x", "1 of 2", *["–"] * 4, LOST_NOTE),
        *("Failures", "variant", "frames", "reason", "x", "1", "a: b"),
        *("3D error of each frame", "Crosses: failed frames.", "x", "100 mm", "1 m", "0", "1", "frame", "failed"),
        *(f"x, {tip}" for tip in tips),
        *("Distribution of the 3D error", "A curve ends, on the right, at the variant's success rate.", *curves),
        "Floor plans",
        "Yellow: LEDs. Rings: true positions. Marks: estimates, joined to the truth. Crosses: failed frames.",
        *tips,
        "x",
    ]


def test_names_and_reasons_are_text_and_never_markup(tmp_path: Path) -> None:
    """Names of datasets, variants and previews, and reasons, come from files: `<`, `&` and quotes are text."""
    hostile = """<script>"a"&'b'"""
    variants = [
        score_variant(name, [failed(0, hostile), ok(1, TRUTH)], truths(2), LEDS_M)
        for name in (hostile, f"{hostile}:c,d")
    ]
    (tmp_path / "previews").mkdir()
    (tmp_path / "previews/000'<i>.png").write_bytes(b"PNG")
    html = page([(tmp_path, scores_of(variants).model_copy(update={"dataset": hostile}))])
    assert "<script" not in html
    assert "<i>" not in html
    assert """alt="000&#39;&lt;i&gt;" src="data:image/png;base64,UE5H">""" in html
    found = texts(html)
    assert f"Positioning report: {hostile}" in found
    # The set's name once; the first variant's in three tables, two legends and a caption; the reason of either.
    assert found.count(hostile) == 1 + 6 + 2
    assert f"Frame by frame against {hostile}" in found
    assert "frame 000'<i>" in found
    assert ":<wbr>c,<wbr>d</td>" in html  # lines may break before options


def test_the_interval_stands_below_its_value(tmp_path: Path) -> None:
    """Of 20 errors, both median and RMSE have an interval; the cell holds the value and the interval in small type."""
    variant = scored([0.01 * k for k in range(1, 21)])
    html = page([(tmp_path, scores_of([variant]))])
    cells = dict(zip(ERROR_HEADERS, error_cells(variant), strict=True))
    assert f"<td>{cells['median']}<small>{interval_text(variant.median_interval)}</small></td>" in html
    assert f"<td>{cells['RMSE']}<small>{interval_text(variant.rmse_interval)}</small></td>" in html
    assert '<td class="failed">' not in html


def test_estimates_outside_are_counted_and_previews_limited(tmp_path: Path) -> None:
    """Of 25 previews 12 are shown, every second. A caption counts the estimates beyond the walls of 4 m x 5 m."""
    (tmp_path / "previews").mkdir()
    for k in range(25):
        (tmp_path / f"previews/{k:06}.png").write_bytes(b"PNG")
    found = texts(page([(tmp_path, scores_of([scored([0.1, 3.1, -1.1, None])]))]))
    assert "x · 2 estimates outside the walls" in found
    assert "12 of 25" in found
    assert [text for text in found if text.startswith("frame 0000")] == [f"frame {k:06}" for k in range(0, 24, 2)]


def test_failures_stand_out_and_zero_failures_do_not(tmp_path: Path) -> None:
    """One mark: the cell of the variant that failed once, and neither the header nor the other's 0."""
    html = page([(tmp_path, scores_of([scored([0.1, None]), scored([0.1, 0.1], "y")]))])
    assert re.findall(r'<t[dh] class="failed">([^<]*)</t[dh]>', html) == ["1"]


def of_devices(errors_m: Sequence[float | None], devices: Sequence[int], name: str = "x") -> VariantScore:
    """Frames of devices, each in the map of its parity; the covariance is that of 1 mm along each axis."""
    x, y, z = TRUTH
    sure = {"covariance_m2": (1e-6, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 1e-6)}
    rows = [
        failed(k, "a: b") if e is None else ok(k, (x + e, y, z)).model_copy(update=sure) for k, e in enumerate(errors_m)
    ]
    truth = [
        one.model_copy(update={"map": device % 2})
        for one, device in zip(truths(len(rows), BOUND), devices, strict=True)
    ]
    return score_variant(name, rows, truth, LEDS_M, devices)


def test_devices_are_shown_by_map_with_their_rmse_and_nees() -> None:
    """Devices 0 and 2 of map 0 stand before device 1 of map 1; a device without an estimate has no mark."""
    variant = of_devices([1e-3, 2e-3, None, 3e-3], [0, 1, 2, 2])
    svg = device_plot([variant], nees=False)
    places = re.findall(r'cx="([\d.]+)"[^>]*><title>x, device (\d), map \d: ([^<]*)<', svg)
    assert [(device, size) for _, device, size in sorted(places, key=lambda one: float(one[0]))] == [
        ("0", "1 mm"),
        ("2", "3 mm"),
        ("1", "2 mm"),
    ]
    assert re.findall(r"device (\d), map \d: ([^<]*)<", device_plot([variant], nees=True)) == [
        ("0", "1"),
        ("1", "4"),
        ("2", "9"),
    ]
    assert device_plot([of_devices([None], [0])], nees=True).count("<title>") == 0


def test_the_page_shows_devices_levels_and_failures_where_there_are_some() -> None:
    several = scores_of([of_devices([1e-3, 2e-3, None, 3e-3], [0, 1, 2, 2])])
    one = scores_of([scored([0.1, 0.2])])
    html = page([(Path("a"), several)])
    for title in ("By device and map", "Failed frames by good LEDs"):
        assert title in html
        assert title not in page([(Path("a"), one)])
    assert html.count("device 2, map 0") == 2
    assert "Error against level" not in html
    assert "Error against level" in page([(Path("a"), several), (Path("b"), several)])
    assert "Error against level" not in page([(Path("a"), several), (Path("b"), one)])
