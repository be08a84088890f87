"""Polygon rasterization: share of each pixel inside outlines, and its derivatives as the outlines move; exact.

By Green's theorem the area of a pixel that a closed outline covers is a sum over the pieces of the outline in the pixel
and to the left of it in its row. Each edge is cut where it crosses a line between pixels. A piece (du, dv) in a
pixel takes from it dv times the share of the pixel to its right, and dv from all pixels further right. If the piece
moves with velocity (a, b), the covered area of the pixel grows by a dv - b du, exactly.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
T = TypeVar("T", bound=np.generic)
Box = tuple[slice, slice]
"""Rows and columns of a region."""

# Shorter than a pixel, so that an edge crosses at most one line between rows and one between columns.
MAX_EDGE_PX = 0.75


@dataclass(frozen=True, eq=False)
class RoiStack:
    """Stack of n regions of interest, stored one after another in one flat array of cells, each row by row.

    Region k has heights[k] by widths[k] pixels; its first pixel is (rows[k], columns[k]). Each row has one additional
    cell, which collects what lies right of the region and belongs to no pixel: with it every row sums to zero.
    """

    rows: Ints
    columns: Ints
    heights: Ints
    widths: Ints

    def padded(self, by_px: int) -> "RoiStack":
        """The regions with a margin on all sides."""
        return RoiStack(self.rows - by_px, self.columns - by_px, self.heights + 2 * by_px, self.widths + 2 * by_px)

    def subdivided(self, factors: Ints) -> "RoiStack":
        """The regions in pixels finer by a factor for each region, (n,)."""
        return RoiStack(self.rows * factors, self.columns * factors, self.heights * factors, self.widths * factors)

    def cells(self) -> int:
        """Number of cells."""
        return int(self.starts[-1])

    def roi(self, cells: NDArray[T], k: int) -> NDArray[T]:
        """View of region k in a flat array of cells, (rows, columns)."""
        start, height, width = int(self.starts[k]), int(self.heights[k]), int(self.widths[k])
        return cells[start : start + height * (width + 1)].reshape(height, width + 1)[:, :width]

    @cached_property
    def starts(self) -> Ints:
        """First cell of each region, (n + 1,); the last entry is the number of cells."""
        return np.concatenate([[0], np.cumsum(self.heights * (self.widths + 1))])

    def cell(self, roi: Ints, row: Ints, column: Ints) -> Ints:
        """Cells of sensor pixels (row, column) in the given regions, elementwise."""
        return np.asarray(
            self.starts[roi] + (row - self.rows[roi]) * (self.widths[roi] + 1) + column - self.columns[roi]
        )

    def pixels(self, roi: Ints, cell: Ints) -> tuple[Ints, Ints]:
        """Sensor pixels (row, column) of cells in the given regions, elementwise."""
        row, column = np.divmod(cell - self.starts[roi], self.widths[roi] + 1)
        return row + self.rows[roi], column + self.columns[roi]

    def meeting(self, others: "RoiStack") -> tuple[Ints, Ints]:
        """Pairs of a region of this stack and one of another that share pixels, by their numbers, (pairs,) each."""
        shared = np.ones((len(self.rows), len(others.rows)), dtype=bool)
        for first, size, other_first, other_size in (
            (self.rows, self.heights, others.rows, others.heights),
            (self.columns, self.widths, others.columns, others.widths),
        ):
            shared &= (first[:, None] < other_first + other_size) & (first[:, None] + size[:, None] > other_first)
        own, other = np.nonzero(shared)
        return own, other

    def intersections(self, own: Ints, others: "RoiStack", other: Ints) -> list[tuple[Box, Box]]:
        """The pixels that regions of this stack share with those of another, pair by pair, as slices of each."""
        ends = []
        for first, size, other_first, other_size in (
            (self.rows[own], self.heights[own], others.rows[other], others.heights[other]),
            (self.columns[own], self.widths[own], others.columns[other], others.widths[other]),
        ):
            low, high = np.maximum(first, other_first), np.minimum(first + size, other_first + other_size)
            ends += [low - first, high - first, low - other_first, high - other_first]
        return [
            ((slice(top, bottom), slice(left, right)), (slice(its_top, its_bottom), slice(its_left, its_right)))
            for top, bottom, its_top, its_bottom, left, right, its_left, its_right in np.transpose(ends).tolist()
        ]


@dataclass(frozen=True, eq=False)
class Outlines:
    """Closed polygons: `points` (n, 2) in pixels, all outlines one after another, and `roi` (n,) each point's region.

    `following` (n,) is the index of the next point of the same outline. No edge may be longer than MAX_EDGE_PX; each
    outline runs in the sense from u to v.
    """

    points: Floats
    following: Ints
    roi: Ints


@dataclass(frozen=True, eq=False)
class EdgePieces:
    """Edges cut at the lines between pixels: m pieces inside their regions, in the order of the edges.

    `edge` (m,) is the number of a piece's first point, `cell` (m,) the cell that it is in, `length` (m,) its share of
    the edge.
    """

    edge: Ints
    cell: Ints
    length: Floats


def cover(rois: RoiStack, outlines: Outlines, light: Floats | None = None) -> tuple[Floats, EdgePieces]:
    """Covered share of each cell, (cells,), and the pieces of the outlines.

    `light` (cells,), if given, is that of a cell wholly covered: the share is times that.
    """
    edges = outlines.points, outlines.following, outlines.roi
    regions = rois.rows, rois.columns, rois.heights, rois.widths, rois.starts
    covered, edge, cell, length = _cover(*edges, *regions, np.ones(rois.cells()) if light is None else light)
    return covered, EdgePieces(edge, cell, length)


@compiled
def _cover(
    points: Floats,
    following: Ints,
    roi: Ints,
    rows: Ints,
    columns: Ints,
    heights: Ints,
    widths: Ints,
    starts: Ints,
    light: Floats,
) -> tuple[Floats, Ints, Ints, Floats]:
    """Covered share (cells,) times the light, and the arrays of `EdgePieces`."""
    covered, count = np.zeros(starts[-1] + 1), 0
    most = 3 * len(points)
    edges, cells, lengths = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64), np.empty(most)
    for i in range(len(points)):
        k, following_i = roi[i], following[i]
        u, v = points[i, 0], points[i, 1]
        du, dv = points[following_i, 0] - u, points[following_i, 1] - v
        at_column, at_row = _crossing(u, u + du, du), _crossing(v, v + dv, dv)
        cuts = (0.0, min(at_column, at_row), max(at_column, at_row), 1.0)
        top, bottom, left, right = rows[k], rows[k] + heights[k], columns[k], columns[k] + widths[k]
        for piece in range(3):
            length, halfway = cuts[piece + 1] - cuts[piece], (cuts[piece] + cuts[piece + 1]) / 2
            at_u, at_v = u + du * halfway, v + dv * halfway
            if not (length > 0 and top <= at_v < bottom):
                continue
            # A piece left of a region covers its first pixel, one right of it the additional cell, over the full width.
            within = left <= at_u < right
            column = math.floor(at_u) if within else left if at_u < left else right
            to_the_right = column + 1 - at_u if within else 1.0
            cell = starts[k] + (math.floor(at_v) - top) * (widths[k] + 1) + column - left
            rise = dv * length
            covered[cell] -= rise * to_the_right
            covered[cell + 1] -= rise * (1 - to_the_right)
            if within:
                edges[count], cells[count], lengths[count] = i, cell, length
                count += 1
    total = 0.0
    for cell in range(len(light)):
        total += covered[cell]
        covered[cell] = total * light[cell]
    return covered[:-1], edges[:count], cells[:count], lengths[:count]


@compiled
def _crossing(first: float, last: float, step: float) -> float:
    """Where along an edge a coordinate crosses a whole number, 0 to 1; 1 where it crosses none."""
    low, high = np.floor(first), np.floor(last)
    return (max(low, high) - first) / step if low != high else 1.0


@dataclass(frozen=True, eq=False)
class RimSlopes:
    """Derivatives of the light that outlines cover in the m cells that they pass through, `slopes` (m, p).

    `cells` (m,) are these cells, `roi` (m,) their regions.
    """

    cells: Ints
    roi: Ints
    slopes: Floats


def rim_slopes(outlines: Outlines, pieces: EdgePieces, swept: Floats, light: Floats, place: Ints) -> RimSlopes:
    """Derivatives by p parameters, with each of which the edge from a point of the outlines sweeps `swept` (n, p).

    An edge (du, dv) whose middle moves with velocity (a, b) sweeps a dv - b du, pixels squared. The derivatives are of
    the share times the `light` (cells,) of a cell. `place` (cells,) is memory of -1 for each cell of the stack, and is
    so again afterwards.
    """
    cells, first, slopes = _rim_slopes(swept, pieces.edge, pieces.cell, pieces.length, light, place)
    return RimSlopes(cells, outlines.roi[first], slopes)


@compiled
def _rim_slopes(
    swept: Floats, edge: Ints, cell: Ints, length: Floats, light: Floats, place: Ints
) -> tuple[Ints, Ints, Floats]:
    """Cells (m,), the first edge in each, (m,), and derivatives (m, p)."""
    parameters, count = swept.shape[1], 0
    for piece in range(len(cell)):
        if place[cell[piece]] < 0:
            place[cell[piece]] = count
            count += 1
    cells, first = np.empty(count, dtype=np.int64), np.full(count, -1)
    slopes = np.zeros((count, parameters))
    for piece in range(len(cell)):
        number, i = place[cell[piece]], edge[piece]
        if first[number] < 0:
            cells[number], first[number] = cell[piece], i
        share = length[piece] * light[cell[piece]]
        for parameter in range(parameters):
            slopes[number, parameter] += swept[i, parameter] * share
    for number in range(count):
        place[cells[number]] = -1
    return cells, first, slopes
