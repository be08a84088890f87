"""How much of each pixel lies inside outlines, and how that changes as they move: exact for polygons.

By Green's theorem the area that a closed outline covers of a pixel is a sum over the outline's pieces inside the pixel
and to the left of it in its row. Each edge is cut where it crosses a line between pixels; a piece that climbs by dv in
a pixel adds dv times the share of the pixel to its right, and dv itself to all pixels further right. An outline whose
piece (du, dv) moves with velocity (a, b) gains b du - a dv of the pixel, exactly.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Shorter than a pixel, so that an edge crosses at most one line between rows and one between columns.
MAX_EDGE_PX = 0.75


@dataclass(frozen=True, eq=False)
class Canvas:
    """Windows of pixels, n of them, kept one after another in one flat array, each row by row.

    Window k holds pixels from (rows[k], columns[k]) on, heights[k] by widths[k] of them. Each row has one cell more,
    which takes what is right of the window and belongs to no pixel: with it every row adds up to nothing.
    """

    rows: Ints
    columns: Ints
    heights: Ints
    widths: Ints

    def padded(self, by_px: int) -> "Canvas":
        """Each window with a margin on all sides."""
        return Canvas(self.rows - by_px, self.columns - by_px, self.heights + 2 * by_px, self.widths + 2 * by_px)

    def finer(self, times: Ints) -> "Canvas":
        """The same windows in pixels so many times finer, window by window (n,)."""
        return Canvas(self.rows * times, self.columns * times, self.heights * times, self.widths * times)

    def cells(self) -> int:
        """How many cells there are."""
        return int((self.heights * (self.widths + 1)).sum())

    def roi(self, cells: Floats, k: int) -> Floats:
        """Window k of a flat array of cells, (rows, columns): a view of it."""
        start, height, width = int(self.starts()[k]), int(self.heights[k]), int(self.widths[k])
        return cells[start : start + height * (width + 1)].reshape(height, width + 1)[:, :width]

    def starts(self) -> Ints:
        """The first cell of each window, (n + 1,); the last is the number of cells."""
        return np.concatenate([[0], np.cumsum(self.heights * (self.widths + 1))])

    def cell(self, roi: Ints, row: Ints, column: Ints) -> Ints:
        """The cells of pixels of the sensor that lie in the given windows, elementwise."""
        return np.asarray(
            self.starts()[roi] + (row - self.rows[roi]) * (self.widths[roi] + 1) + column - self.columns[roi]
        )


@dataclass(frozen=True, eq=False)
class Outlines:
    """Closed polygons: `points` (n, 2) in pixels, all outlines one after another, `window` (n,) each point's window.

    `following` (n,) is the index of the next point of the same outline, and `slopes` (n, 2, p) say how the points move
    with p parameters. No edge may be LONGEST_EDGE_PX long; each goes round in the sense of u towards v.
    """

    points: Floats
    following: Ints
    roi: Ints
    slopes: Floats


@dataclass(frozen=True, eq=False)
class Pieces:
    """Edges cut at the lines between pixels, m pieces inside their windows: where each is, (m,), on the sensor.

    `slopes` (m, p) is what the pixel gains as the piece moves.
    """

    roi: Ints
    row: Ints
    column: Ints
    slopes: Floats


def cover(canvas: Canvas, outlines: Outlines) -> tuple[Floats, Pieces]:
    """Share of each cell of the canvas that is covered, (cells,), and its slopes, piece by piece."""
    start, end = outlines.points, outlines.points[outlines.following]
    step = end - start
    # Where along each edge a line between columns and one between rows is crossed; at its end where there is none.
    line = np.maximum(np.floor(start), np.floor(end))
    crosses = np.floor(start) != np.floor(end)
    at = np.divide(line - start, step, out=np.ones_like(start), where=crosses)
    at.sort(axis=1)
    cuts = np.column_stack([np.zeros(len(at)), at, np.ones(len(at))])
    edge, part = np.nonzero(cuts[:, 1:] > cuts[:, :-1])
    first, last = cuts[edge, part][:, None], cuts[edge, part + 1][:, None]
    middle, length = (first + last) / 2, last - first
    dv = step[edge, 1] * length[:, 0]
    u, v = (start[edge] + step[edge] * middle).T

    roi = outlines.roi[edge]
    row, column = np.floor(v).astype(np.int64), np.floor(u).astype(np.int64)
    inside = (row >= canvas.rows[roi]) & (row < canvas.rows[roi] + canvas.heights[roi])
    edge, roi, row, column, u, dv = (values[inside] for values in (edge, roi, row, column, u, dv))
    left, right = canvas.columns[roi], canvas.columns[roi] + canvas.widths[roi]
    within = (column >= left) & (column < right)
    # What is left of a window covers its first pixel, what is right of it the cell beyond, from side to side.
    to_the_right = np.where(within, column + 1 - u, 1.0)
    cell = canvas.cell(roi, row, np.clip(column, left, right))
    cells = canvas.cells()
    climbed = np.bincount(cell, -dv * to_the_right, cells + 1)
    climbed += np.bincount(cell + 1, -dv * (1 - to_the_right), cells + 1)
    covered: Floats = np.cumsum(climbed[:-1], dtype=np.float64)

    # What moves each edge, at its middle: over so short a way it hardly changes.
    velocity = (outlines.slopes + outlines.slopes[outlines.following]) / 2
    gained = velocity[:, 0] * step[:, 1:] - velocity[:, 1] * step[:, :1]
    slopes = gained[edge[within]] * length[inside][within]
    return covered, Pieces(roi[within], row[within], column[within], slopes)
