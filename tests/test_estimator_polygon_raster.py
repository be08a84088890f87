"""The area of pixels inside outlines: against integrals of circles, and its slopes against differences."""

import numpy as np
import pytest
from numpy.typing import NDArray

from estimator.pixels.polygon_raster import MAX_EDGE_PX, Outlines, RoiStack, cover, rim_slopes

Floats = NDArray[np.float64]


def roi(row: int, column: int, height: int, width: int) -> RoiStack:
    return RoiStack(np.array([row]), np.array([column]), np.array([height]), np.array([width]))


def circle(u: float, v: float, radius: float) -> Floats:
    """A polygon of the circle's area."""
    points = int(np.ceil(2 * np.pi * radius / MAX_EDGE_PX))
    step = 2 * np.pi / points
    angles = step * np.arange(points)
    return np.array([u, v]) + radius * np.sqrt(step / np.sin(step)) * np.column_stack([np.cos(angles), np.sin(angles)])


def outlines(points: Floats) -> Outlines:
    count = len(points)
    return Outlines(points, np.roll(np.arange(count), -1), np.zeros(count, dtype=np.int64))


def covered(rois: RoiStack, points: Floats) -> Floats:
    return rois.roi(cover(rois, outlines(points))[0], 0)


def circle_in_pixels(u: float, v: float, radius: float, size: int) -> Floats:
    """Each pixel's share of a circle: chords of 4000 lines a pixel, clipped to the pixel, midpoint rule."""
    lines = 4000
    y = (np.arange(size * lines) + 0.5) / lines - v
    half = np.sqrt(np.maximum(radius**2 - y**2, 0.0))
    left = np.arange(size)[None, :]
    chords = np.clip(np.minimum(u + half[:, None], left + 1) - np.maximum(u - half[:, None], left), 0.0, None)
    chords[half == 0] = 0.0
    return chords.reshape(size, lines, size).mean(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [3.0, 12.5, 30.0])
def test_a_circle_covers_what_its_chords_say(radius: float) -> None:
    """A chord of length L leaves the circle by L^2 / 8r at the most, L^2 / 12r on average, which the polygon's greater
    size makes up for: what is left is within L^2 / 12r, 0.016 px at r = 3. The midpoint rule over 4000 lines errs by
    some 1e-5, where a chord begins.
    """
    u, v, size = radius + 3.37, radius + 2.81, int(2 * radius) + 7
    found = covered(roi(0, 0, size, size), circle(u, v, radius))
    assert abs(found.sum() - np.pi * radius**2) < 1e-9
    assert np.abs(found - circle_in_pixels(u, v, radius, size)).max() < MAX_EDGE_PX**2 / (12 * radius) + 2e-5


def test_a_region_holds_its_part_of_the_whole() -> None:
    points = circle(20.4, 18.8, 12.5)
    whole = covered(roi(0, 0, 40, 40), points)
    for row, column, height, width in ((12, 15, 9, 30), (0, 0, 12, 12), (25, 25, 3, 3), (15, 30, 4, 8)):
        part = covered(roi(row, column, height, width), points)
        expected = np.zeros((height, width))
        seen = whole[row : row + height, column : column + width]
        expected[: seen.shape[0], : seen.shape[1]] = seen
        np.testing.assert_allclose(part, expected, atol=1e-12)


def test_regions_do_not_affect_each_other() -> None:
    """The second outline lies beyond its region's right border, the first within its own."""
    first, second = circle(10.3, 10.1, 5.0), circle(42.6, 9.0, 6.0)
    rois = RoiStack(np.array([0, 2]), np.array([2, 30]), np.array([20, 15]), np.array([15, 12]))
    points = np.concatenate([first, second])
    following = np.concatenate([np.roll(np.arange(len(p)), -1) + s for p, s in ((first, 0), (second, len(first)))])
    belongs = np.repeat([0, 1], [len(first), len(second)])
    both, _ = cover(rois, Outlines(points, following, belongs))
    np.testing.assert_allclose(rois.roi(both, 0), covered(roi(0, 2, 20, 15), first), atol=1e-12)
    np.testing.assert_allclose(rois.roi(both, 1), covered(roi(2, 30, 15, 12), second), atol=1e-12)


def test_vertices_on_the_lines_between_pixels_keep_the_area() -> None:
    along = np.arange(0, 4, 0.5)
    square = np.concatenate(
        [
            np.column_stack([2 + along, 0 * along + 3]),
            np.column_stack([0 * along + 6, 3 + along]),
            np.column_stack([6 - along, 0 * along + 7]),
            np.column_stack([0 * along + 2, 7 - along]),
        ]
    )
    expected = np.zeros((10, 10))
    expected[3:7, 2:6] = 1
    np.testing.assert_allclose(covered(roi(0, 0, 10, 10), square), expected, atol=1e-12)


def test_slopes_are_what_moving_the_outline_gives() -> None:
    """Central differences over 1e-4 px of a quadratic: exact but for rounding, save where a point crosses a line."""
    points = circle(13.37, 12.81, 8.0)
    padded = points - np.array([13.37, 12.81])
    moves = np.stack([np.tile([1.0, 0.0], (len(points), 1)), np.tile([0.0, 1.0], (len(points), 1)), padded], axis=2)
    rois = roi(0, 0, 26, 26)
    outline = outlines(points)
    place = np.full(rois.cells(), -1)
    middle, edge = (moves + moves[outline.following]) / 2, points[outline.following] - points
    swept = middle[:, 0] * edge[:, 1:] - middle[:, 1] * edge[:, :1]
    rim = rim_slopes(outline, cover(rois, outline)[1], swept, np.ones(rois.cells()), place)
    assert (place == -1).all()
    for parameter in range(3):
        found = np.zeros(rois.cells())
        found[rim.cells] = rim.slopes[:, parameter]
        step = 1e-5 * moves[:, :, parameter]
        ahead, behind = (cover(rois, outlines(points + sign * step))[0] for sign in (1, -1))
        # Growing, an edge's ends move by 1 % of a pixel differently: within an edge the middle stands for it.
        np.testing.assert_allclose(found, (ahead - behind) / 2e-5, atol=0.02 if parameter == 2 else 1e-4)


def test_pixels_that_two_regions_share_are_the_same_pixels_in_each() -> None:
    first = np.zeros(1, dtype=np.int64)
    ((of_first, of_second),) = roi(2, 10, 6, 8).intersections(first, roi(5, 7, 9, 5), first)
    assert of_first == (np.s_[3:6], np.s_[0:2])
    assert of_second == (np.s_[0:3], np.s_[3:5])
