"""Polygon rasterization: share of each pixel inside outlines, and its derivatives as the outlines move; exact.

By Green's theorem the area of a pixel that a closed outline covers is a sum over the pieces of the outline in the pixel
and to the left of it in its row. Each edge is cut where it crosses a line between pixels. A piece that rises by dv in a
pixel adds dv times the share of the pixel to its right, and dv to all pixels further right. If the piece (du, dv) moves
with velocity (a, b), the covered area of the pixel grows by b du - a dv, exactly.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

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

    def roi(self, cells: Floats, k: int) -> Floats:
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

    def meeting(self, others: "RoiStack", k: int) -> list[int]:
        """Regions of this stack that share pixels with region k of another."""
        top, left = others.rows[k], others.columns[k]
        overlaps = (self.rows < top + others.heights[k]) & (self.rows + self.heights > top)
        overlaps &= (self.columns < left + others.widths[k]) & (self.columns + self.widths > left)
        return list(map(int, np.flatnonzero(overlaps)))

    def intersection(self, k: int, others: "RoiStack", other: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """The pixels that region k shares with one of another stack, as (rows, columns) slices of each."""
        own, its = self._spans(k), others._spans(other)
        shared = [(max(a[0], b[0]), min(a[1], b[1])) for a, b in zip(own, its, strict=True)]
        (rows, columns), (other_rows, other_columns) = (
            [slice(low - span[0], high - span[0]) for span, (low, high) in zip(spans, shared, strict=True)]
            for spans in (own, its)
        )
        return (rows, columns), (other_rows, other_columns)

    def _spans(self, k: int) -> tuple[tuple[int, int], tuple[int, int]]:
        """First row and the row after the last of region k, and its columns."""
        top, left = int(self.rows[k]), int(self.columns[k])
        return (top, top + int(self.heights[k])), (left, left + int(self.widths[k]))


@dataclass(frozen=True, eq=False)
class Outlines:
    """Closed polygons: `points` (n, 2) in pixels, all outlines one after another, and `roi` (n,) each point's region.

    `following` (n,) is the index of the next point of the same outline, and `slopes` (2, p, n) are the derivatives of
    the points' u and v by p parameters. No edge may be longer than MAX_EDGE_PX; each outline runs in the sense from u
    to v.
    """

    points: Floats
    following: Ints
    roi: Ints
    slopes: Floats


@dataclass(frozen=True, eq=False)
class EdgePieces:
    """Edges cut at the lines between pixels: m pieces inside their regions, with the pixel (m,) of each.

    `slopes` (p, m) are the derivatives of the pixel's covered share by p parameters, `shifts` (2, m) those by shifts of
    the outline along u and v.
    """

    roi: Ints
    row: Ints
    column: Ints
    slopes: Floats
    shifts: Floats

    def times(self, factor: Floats) -> "EdgePieces":
        """The pieces with their derivatives multiplied by a factor for each, (m,)."""
        return EdgePieces(self.roi, self.row, self.column, self.slopes * factor, self.shifts * factor)


def cover(rois: RoiStack, outlines: Outlines) -> tuple[Floats, EdgePieces]:
    """Covered share of each cell, (cells,), and its derivatives by pieces."""
    following = outlines.following
    u0, v0 = outlines.points.T
    du, dv = u0[following] - u0, v0[following] - v0
    # Position along each edge where it crosses a line between columns and one between rows; 1 if it crosses none.
    crossings = [_crossing(first, step, following) for first, step in ((u0, du), (v0, dv))]
    one, other = np.minimum(*crossings), np.maximum(*crossings)
    middle, rest = np.flatnonzero(other > one), np.flatnonzero(other < 1)
    edge = np.concatenate([np.arange(len(u0)), middle, rest])
    first = np.concatenate([np.zeros(len(u0)), one[middle], other[rest]])
    last = np.concatenate([one, other[middle], np.ones(len(rest))])
    halfway, length = (first + last) / 2, last - first
    u, v = u0[edge] + du[edge] * halfway, v0[edge] + dv[edge] * halfway
    rise = dv[edge] * length

    roi = outlines.roi[edge]
    row, column = np.floor(v).astype(np.int64), np.floor(u).astype(np.int64)
    inside = (row >= rois.rows[roi]) & (row < (rois.rows + rois.heights)[roi])
    if not inside.all():
        edge, roi, row, column = edge[inside], roi[inside], row[inside], column[inside]
        u, rise, length = u[inside], rise[inside], length[inside]
    left, right = rois.columns[roi], (rois.columns + rois.widths)[roi]
    within = (column >= left) & (column < right)
    # A piece left of a region covers its first pixel, one right of it the additional cell, over the full width.
    to_the_right = np.where(within, column + 1 - u, 1.0)
    cell = rois.cell(roi, row, np.clip(column, left, right))
    increments = np.bincount(cell, -rise * to_the_right, rois.cells() + 1)
    increments += np.bincount(cell + 1, -rise * (1 - to_the_right), rois.cells() + 1)
    covered: Floats = np.cumsum(increments[:-1], dtype=np.float64)

    # Velocity at the middle of each edge: over so short an edge it is constant.
    of_u, of_v = outlines.slopes + np.take(outlines.slopes, following, axis=2)
    slopes = np.take((of_u * dv - of_v * du) / 2, edge, axis=1) * length
    shifts = np.stack([rise, -du[edge] * length])
    if not within.all():
        roi, row, column = roi[within], row[within], column[within]
        slopes, shifts = slopes[:, within], shifts[:, within]
    return covered, EdgePieces(roi, row, column, slopes, shifts)


def _crossing(start: Floats, step: Floats, following: Ints) -> Floats:
    """Where along their edges (n,) coordinates cross a whole number, 0 to 1; 1 for those that cross none."""
    whole = np.floor(start)
    following_whole = whole[following]
    at = np.divide(np.maximum(whole, following_whole) - start, step, out=np.ones_like(start), where=step != 0)
    return np.asarray(np.where(whole != following_whole, at, 1.0))
