"""Elements of SVG: their places, and texts that are never markup."""

import math
import xml.etree.ElementTree as Tree

import pytest

from estimator.report.svg import COLOURS, MARKS, cross, line, mark, picture, text

HOSTILE = """<a href="x">&'"""


def test_texts_are_never_markup() -> None:
    parts = [mark(1, 2, 3, index, HOSTILE) for index in range(len(COLOURS) * len(MARKS))]
    parts += [cross(1, 2, 0, HOSTILE), text(1, 2, HOSTILE, "end")]
    tree = Tree.fromstring(picture(10, 20, HOSTILE, parts))
    assert tree.get("aria-label") == HOSTILE
    assert [element.text for element in tree.iter("title")] == [HOSTILE] * (len(parts) - 1)
    assert [element.text for element in tree.iter("text")] == [HOSTILE]
    assert not list(tree.iter("a"))


def test_elements_stand_at_their_places() -> None:
    body = [line(1, 2, 3, 4, "rule"), text(5, 6, "five", "middle"), mark(7, 8, 9, 0), cross(10, 11, 2, "t")]
    tree = Tree.fromstring(picture(100.4, 50, "label", body))
    assert tree.attrib == {"viewBox": "0 0 100 50", "role": "img", "aria-label": "label"}
    drawn = [(element.tag, dict(element.attrib)) for element in tree]
    assert drawn == [
        ("line", {"class": "rule", "x1": "1.0", "y1": "2.0", "x2": "3.0", "y2": "4.0"}),
        ("text", {"x": "5.0", "y": "6.0", "text-anchor": "middle"}),
        ("circle", {"class": "mark v0", "cx": "7.0", "cy": "8.0", "r": "9"}),
        ("path", {"class": "v2", "d": "M7.0 8.0l6 6m0 -6l-6 6"}),
    ]
    assert not list(tree[2])  # no empty tooltip


@pytest.mark.parametrize("shape", range(1, len(MARKS)))
def test_marks_look_as_large_as_the_disc(shape: int) -> None:
    """Their areas are those of the disc to a fifth, as the eye takes them, and they stand around their point.

    The shoelace formula gives the area of the vertices. A triangle's centroid lies above the middle of its height, so
    the point is the middle of the mark's width alone.
    """
    vertices = MARKS[shape]
    pairs = list(zip(vertices, (*vertices[1:], vertices[0]), strict=True))
    area = abs(sum(a * d - b * c for (a, b), (c, d) in pairs)) / 2
    assert area == pytest.approx(math.pi, rel=0.2)
    assert sum(x for x, _ in vertices) == pytest.approx(0)
    drawn = Tree.fromstring(mark(100, 50, 10, len(COLOURS) * shape)).get("d", "")
    places = [tuple(map(float, place.split())) for place in drawn.removeprefix("M").removesuffix("z").split("L")]
    expected = [(100 + 10 * x, 50 + 10 * y) for x, y in vertices]
    assert places == [pytest.approx(place) for place in expected]
