"""Floor plan: places by hand, in pixels of the picture."""

import xml.etree.ElementTree as Tree

import pytest
from test_estimator_score import LEDS, LEDS_M, TRUTH, failed, ok, truths

from estimator.evaluate.score import VariantScore, score_variant
from estimator.report.floor_plan import BORDER, WIDTH, estimates_outside, floor_plan

ROOM_M = (4.0, 5.0, 3.5)
PX_PER_M = (460 - 2 * 12) / 4.0
"""109: the picture is 460 pixels wide with a border of 12, so 569 high with a room 5 m deep."""


def scored(*positions: tuple[float, float, float] | None) -> VariantScore:
    rows = [failed(k, "a: <b>") if p is None else ok(k, p) for k, p in enumerate(positions)]
    return score_variant("x", rows, truths(len(rows)), LEDS_M)


def plan(variant: VariantScore, room_m: tuple[float, float, float] = ROOM_M) -> Tree.Element:
    return Tree.fromstring(floor_plan(room_m, [led.position_m for led in LEDS.values()], variant, 3))


def numbers(element: Tree.Element, *keys: str) -> tuple[float, ...]:
    return tuple(float(element.get(key, "nan")) for key in keys)


def of_class(tree: Tree.Element, tag: str, name: str) -> list[Tree.Element]:
    return [element for element in tree.iter(tag) if element.get("class") == name]


def test_the_walls_and_the_scale_are_those_of_the_room() -> None:
    assert (WIDTH, BORDER) == (460, 12)
    tree = plan(scored())
    assert tree.get("viewBox") == "0 0 460 569"
    walls, _ = tree.iter("rect")
    assert numbers(walls, "x", "y", "width", "height") == (12, 12, 436, 545)
    wide = plan(scored(), (8.0, 2.0, 3.0))
    assert wide.get("viewBox") == "0 0 460 133"
    assert numbers(next(wide.iter("rect")), "width", "height") == (436, 109)


def test_x_is_right_and_y_is_up() -> None:
    """The LED and the truth at (1, 2) m: 121 px from the left, 2 m above the lower wall at 557 px; tenths are drawn."""
    (led,) = of_class(plan(scored()), "rect", "led")
    assert numbers(led, "x", "y", "width", "height") == (119, 337, 4, 4)
    tree = plan(scored((3.0, 2.5, 0.5)))
    (truth,) = of_class(tree, "circle", "truth")
    assert numbers(truth, "cx", "cy") == (121, 339)
    (estimate,) = of_class(tree, "circle", "mark v3")
    assert numbers(estimate, "cx", "cy") == (12 + 3 * PX_PER_M, pytest.approx(557 - 2.5 * PX_PER_M, abs=0.05))
    assert [title.text for title in tree.iter("title")] == ["frame 0: 2.06 m"]
    (joined,) = of_class(tree, "line", "v3")
    assert numbers(joined, "x1", "y1", "x2", "y2") == (*numbers(truth, "cx", "cy"), *numbers(estimate, "cx", "cy"))


def test_a_failed_frame_is_a_cross_at_its_true_position() -> None:
    """6 pixels wide and high around (121, 339), with the reason under the pointer."""
    tree = plan(scored(None))
    (cross,) = of_class(tree, "path", "v3")
    assert cross.get("d") == "M118.0 336.0l6 6m0 -6l-6 6"
    assert cross[0].text == "frame 0: a: <b>"
    assert not of_class(tree, "circle", "truth") + of_class(tree, "line", "v3")


@pytest.mark.parametrize("far_m", [1e30, -1e30])
def test_huge_outliers_end_where_viewers_can_still_draw(far_m: float) -> None:
    """At 10 000 pixels, 20 times the picture: beyond its edge, and within the single precision of browsers."""
    (joined,) = of_class(plan(scored((far_m, far_m, 0.0))), "line", "v3")
    sign = 1 if far_m > 0 else -1
    assert numbers(joined, "x2", "y2") == (sign * 1e4, -sign * 1e4)


def test_estimates_behind_one_wall_are_outside_and_those_on_it_are_not() -> None:
    inside = [TRUTH, (0.0, 0.0, 0.0), (4.0, 5.0, -9.0)]
    outside = [(-0.01, 1.0, 0.0), (1.0, -0.01, 0.0), (4.01, 1.0, 0.0), (1.0, 5.01, 0.0)]
    assert estimates_outside(ROOM_M, scored(*inside, None)) == 0
    assert estimates_outside(ROOM_M, scored(*inside, *outside, None)) == 4
