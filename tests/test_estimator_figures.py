"""Figures of the errors: where marks, crosses, curves and the bound stand on their axes."""

import math
import re
import xml.etree.ElementTree as Tree

import pytest
from test_estimator_report import BOUND, scored

from estimator.report.figures import BOTTOM, HEIGHT, LANE, LEFT, RIGHT, TOP, WIDTH, distribution_plot, error_plot

INNER = WIDTH - LEFT - RIGHT


def marks(tree: Tree.Element, index: int) -> list[tuple[float, float, str]]:
    """Centres and titles of a variant's marks that have a title; the first variants' marks are discs."""
    found = [element for element in tree.iter("circle") if element.get("class") == f"mark v{index}" and len(element)]
    return [(float(e.get("cx", "")), float(e.get("cy", "")), str(e[0].text)) for e in found]


def crosses(tree: Tree.Element, index: int) -> list[tuple[float, float, str]]:
    found = [element for element in tree.iter("path") if element.get("class") == f"v{index}"]
    places = [re.match(r"M([\d.]+) ([\d.]+)l6 6", element.get("d", "")) for element in found]
    return [(float(p[1]) + 3, float(p[2]) + 3, str(e[0].text)) for p, e in zip(places, found, strict=True) if p]


def labels(tree: Tree.Element) -> dict[str, tuple[float, float]]:
    return {str(e.text): (float(e.get("x", "")), float(e.get("y", ""))) for e in tree.iter("text")}


def test_an_error_ten_times_as_large_stands_a_decade_higher() -> None:
    """Errors of 2, 20 and 200 mm, on an axis of three decades from 1 mm: log10(2) of a decade above its marks."""
    tree = Tree.fromstring(error_plot([scored([0.002, 0.02, 0.2])]))
    decade, places = HEIGHT / 3, marks(tree, 0)
    expected = [TOP + HEIGHT - decade * (k + math.log10(2)) for k in range(3)]
    assert [y for _, y, _ in places] == pytest.approx(expected, abs=0.05)  # tenths are drawn
    assert [x for x, _, _ in places] == pytest.approx([LEFT + INNER * share / 6 for share in (1, 3, 5)], abs=0.05)
    assert [title for *_, title in places] == ["x, frame 0: 2 mm", "x, frame 1: 20 mm", "x, frame 2: 200 mm"]
    # The text's middle is 4 pixels above its foot.
    heights = [labels(tree)[name][1] - 4 for name in ("1 mm", "10 mm", "100 mm", "1 m")]
    assert heights == pytest.approx([TOP + HEIGHT - decade * k for k in range(4)], abs=0.05)


def test_failed_frames_are_crosses_in_a_lane_of_their_variant_below_the_axis() -> None:
    tree = Tree.fromstring(error_plot([scored([0.1, None, None], "first"), scored([None, 0.1, 0.1], "second")]))
    lanes = [TOP + HEIGHT + 14 + LANE * 0.5, TOP + HEIGHT + 14 + LANE * 1.5]
    frame_x = [LEFT + INNER * share / 6 for share in (1, 3, 5)]
    assert crosses(tree, 0) == [
        (pytest.approx(frame_x[k], abs=0.05), pytest.approx(lanes[0], abs=0.05), f"first, frame {k}: a: b")
        for k in (1, 2)
    ]
    assert crosses(tree, 1) == [
        (pytest.approx(frame_x[0], abs=0.05), pytest.approx(lanes[1], abs=0.05), "second, frame 0: a: b")
    ]
    assert tree.get("viewBox") == f"0 0 {WIDTH} {TOP + HEIGHT + 14 + 2 * LANE + BOTTOM}"
    assert labels(tree)["frame"] == (LEFT + INNER / 2, TOP + HEIGHT + 14 + 2 * LANE + 34)  # in the middle, below all


def test_the_bound_of_a_frame_is_a_line_at_its_height() -> None:
    """BOUND's trace is 4e-6 m^2, its root 2 mm: log10(2) of the decade from 1 to 10 mm. Errors are 5 mm."""
    svg = error_plot([scored([0.005] * 4, bound_m2=BOUND)])
    (path,) = re.findall(r'<path class="bound" d="([^"]*)"', svg)
    ledges = [tuple(map(float, ledge)) for ledge in re.findall(r"M([\d.]+) ([\d.]+)h([\d.]+)", path)]
    assert len(ledges) == 4
    for k, (x, y, width) in enumerate(ledges):
        assert y == pytest.approx(TOP + HEIGHT * (1 - math.log10(2)), abs=0.05)
        assert x + width / 2 == pytest.approx(LEFT + INNER * (k + 0.5) / 4, abs=0.1)


def test_the_curve_steps_at_each_error_by_one_share_of_all_frames() -> None:
    """Errors of 2, 20 and 200 mm and a failed frame, on three decades: steps of a quarter, and none for the failed."""
    svg = distribution_plot([scored([0.2, 0.002, None, 0.02])])
    (path,) = re.findall(r'<path class="curve v0" d="([^"]*)"', svg)
    start = re.match(r"M(\d+) (\d+)H", path)
    assert start is not None
    assert (float(start[1]), float(start[2])) == (LEFT, TOP + HEIGHT)
    steps = [tuple(map(float, step)) for step in re.findall(r"H([\d.]+)V([\d.]+)", path)]
    assert [x for x, _ in steps] == pytest.approx([LEFT + INNER * (k + math.log10(2)) / 3 for k in range(3)], abs=0.05)
    assert [y for _, y in steps] == [TOP + HEIGHT * share / 4 for share in (3, 2, 1)]
    assert path.endswith(f"H{WIDTH - RIGHT}")
    (end,) = [e for e in Tree.fromstring(svg).iter("circle") if e.get("class") == "mark v0"]
    assert (float(end.get("cx", "")), float(end.get("cy", ""))) == (WIDTH - RIGHT, TOP + HEIGHT / 4)


def test_the_line_of_the_bound_is_the_root_mean_square_of_the_frames_that_have_one() -> None:
    """Bounds of 1.1 and 7 mm: the root of (1.21 + 49) / 2 is 5.01 mm, their mean is 4.05."""
    variant = scored([0.005, 0.005, None])
    rows = [row.model_copy(update={"bound_m": b}) for row, b in zip(variant.rows, (0.0011, 0.007, None), strict=True)]
    svg = distribution_plot([variant.model_copy(update={"rows": tuple(rows)})])
    ((x, top, foot),) = re.findall(r'<line class="bound" x1="([\d.]+)" y1="([\d.]+)" x2="[\d.]+" y2="([\d.]+)"', svg)
    assert float(x) == pytest.approx(LEFT + INNER * math.log10((50.21 / 2) ** 0.5), abs=0.05)
    assert (float(top), float(foot)) == (TOP, TOP + HEIGHT)


def test_rules_are_level_or_upright_and_stand_at_their_labels() -> None:
    """Of the distribution: shares from left to right, decades from foot to top. Of the errors: decades and lanes."""
    tree = Tree.fromstring(distribution_plot([scored([0.002, 0.2])]))
    rules = [[float(e.get(key, "")) for key in ("x1", "y1", "x2", "y2")] for e in tree.iter("line")]
    shares = [[LEFT, TOP + HEIGHT * (1 - share), WIDTH - RIGHT] for share in (0, 0.25, 0.5, 0.75, 0.95, 1)]
    decades = [[LEFT + INNER * k / 3, TOP, TOP + HEIGHT] for k in range(4)]
    expected = [[x1, y, x2, y] for x1, y, x2 in shares] + [[x, y1, x, y2] for x, y1, y2 in decades]
    assert rules == [pytest.approx(rule, abs=0.05) for rule in expected]
    places = labels(tree)
    for percent, (_, y, _) in zip((0, 25, 50, 75, 95, 100), shares, strict=True):
        assert places[f"{percent} %"] == (pytest.approx(LEFT - 8), pytest.approx(y + 4, abs=0.05))
    for name, (x, *_) in zip(("1 mm", "10 mm", "100 mm", "1 m"), decades, strict=True):
        assert places[name] == (pytest.approx(x, abs=0.05), TOP + HEIGHT + 16)
    tree = Tree.fromstring(error_plot([scored([0.002, 0.2])]))
    rules = [[float(e.get(key, "")) for key in ("x1", "y1", "x2", "y2")] for e in tree.iter("line")]
    heights = [*(TOP + HEIGHT * (1 - k / 3) for k in range(4)), TOP + HEIGHT + 14 + LANE / 2]
    assert rules == [pytest.approx([LEFT, y, WIDTH - RIGHT, y], abs=0.05) for y in heights]
