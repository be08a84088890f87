"""Outlines of LED images by the edges of their lines, ellipse and parallelogram, and what a fit of one finds."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

OUTLIER_SIGMA = 4.5


class Outline(Protocol):
    """Outline of an LED image: x across the lines and y along the readout axis, of the sensor, pixels."""

    @property
    def centre(self) -> Floats:
        """Centre (x, y), (2,)."""

    @property
    def moments(self) -> Floats:
        """Second moments (2, 2) of the uniform area, px^2."""

    @property
    def extent(self) -> Floats:
        """Half extents (2,) of the upright box."""

    def edges(self, lines: Floats) -> tuple[Floats, Floats]:
        """Mean x of the two edges in lines (n,), each from y = line to line + 1; equal beyond the outline's ends."""

    def contour(self) -> Floats:
        """Points (n, 2) on the outline, in order."""


@dataclass(frozen=True)
class EdgeEllipse:
    """Ellipse with the edges `x0 + slope (y - y0) -+ half_chord sqrt(1 - ((y - y0) / half_extent)^2)`."""

    x0: float
    y0: float
    slope: float
    half_chord: float
    half_extent: float

    @property
    def centre(self) -> Floats:
        """See `Outline`."""
        return np.array([self.x0, self.y0])

    @property
    def moments(self) -> Floats:
        """See `Outline`: a quarter of the conjugate semi-diameters' squares."""
        a, b, s = self.half_chord, self.half_extent, self.slope
        return np.array([[a**2 + (s * b) ** 2, s * b**2], [s * b**2, b**2]]) / 4

    @property
    def extent(self) -> Floats:
        """See `Outline`."""
        return 2 * np.sqrt(np.diag(self.moments))

    def edges(self, lines: Floats) -> tuple[Floats, Floats]:
        """See `Outline.edges`."""
        middle = self.x0 + self.slope * (lines + 0.5 - self.y0)
        half = self.half_chord * self.half_extent * np.diff(_segment(self._t(lines)), axis=0)[0]
        return middle - half, middle + half

    def _t(self, lines: Floats) -> Floats:
        """Lower and upper end of each line, (2, n), in units of the half extent."""
        return np.clip((np.stack([lines, lines + 1]) - self.y0) / self.half_extent, -1.0, 1.0)

    def slopes(self, lines: Floats) -> tuple[Floats, Floats]:
        """Derivatives (n, 5) of the middle and of half the chord by x0, y0, slope, half_chord, half_extent."""
        t = self._t(lines)
        g, root = _segment(t), np.sqrt(1 - t**2)
        area, ends = np.diff(g, axis=0)[0], np.diff(t * root, axis=0)[0]
        of_middle, of_half = np.zeros((len(lines), 5)), np.zeros((len(lines), 5))
        of_middle[:, 0], of_middle[:, 1], of_middle[:, 2] = 1.0, -self.slope, lines + 0.5 - self.y0
        of_half[:, 1] = -self.half_chord * np.diff(root, axis=0)[0]
        of_half[:, 3] = self.half_extent * area
        of_half[:, 4] = self.half_chord * (area - ends)
        return of_middle, of_half

    def contour(self) -> Floats:
        """See `Outline.contour`."""
        angle = np.linspace(0, 2 * np.pi, 73)
        y = self.half_extent * np.sin(angle)
        return np.column_stack([self.x0 + self.slope * y + self.half_chord * np.cos(angle), self.y0 + y])


@dataclass(frozen=True)
class EdgeParallelogram:
    """Parallelogram between two pairs of parallel sides, `|a_i (x - x0) + b_i (y - y0)| <= 1` for i = 1, 2.

    `sides` are ((a_1, b_1), (a_2, b_2)).
    """

    x0: float
    y0: float
    sides: tuple[tuple[float, float], tuple[float, float]]

    @property
    def centre(self) -> Floats:
        """See `Outline`."""
        return np.array([self.x0, self.y0])

    @property
    def _half_sides(self) -> Floats:
        """Vectors from the centre to the middles of two sides, as columns."""
        return np.asarray(np.linalg.inv(np.array(self.sides)))

    @property
    def moments(self) -> Floats:
        """See `Outline`: a third of the half sides' squares."""
        return np.asarray(self._half_sides @ self._half_sides.T / 3)

    @property
    def extent(self) -> Floats:
        """See `Outline`."""
        return np.asarray(np.abs(self._half_sides).sum(axis=1))

    def edges(self, lines: Floats) -> tuple[Floats, Floats]:
        """See `Outline.edges`; the mean of five points across each line."""
        y = lines[:, None] + (np.arange(5) + 0.5) / 5 - self.y0
        low, high = np.full(y.shape, -np.inf), np.full(y.shape, np.inf)
        beyond = np.zeros(y.shape, dtype=bool)
        for a, b in self.sides:
            if abs(a) < 1e-9:
                beyond |= np.abs(b * y) > 1
                continue
            low, high = np.maximum(low, -b / a * y - 1 / abs(a)), np.minimum(high, -b / a * y + 1 / abs(a))
        beyond |= low > high
        middle = (low + high) / 2
        low, high = np.where(beyond, middle, low), np.where(beyond, middle, high)
        return self.x0 + low.mean(axis=1), self.x0 + high.mean(axis=1)

    def contour(self) -> Floats:
        """See `Outline.contour`."""
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]], dtype=np.float64)
        return np.asarray(self.centre + corners @ self._half_sides.T)


def _segment(t: Floats) -> Floats:
    """Integral of sqrt(1 - t^2) from 0 to t."""
    return np.asarray((t * np.sqrt(1 - t**2) + np.arcsin(t)) / 2)


def moved_outline(outline: Outline, x: float, y: float) -> Outline:
    """The outline, moved by x and y."""
    if isinstance(outline, EdgeEllipse | EdgeParallelogram):
        return replace(outline, x0=outline.x0 + x, y0=outline.y0 + y)
    raise TypeError(f"{type(outline).__name__} is no outline")


@dataclass(frozen=True, eq=False)
class OutlineFit:
    """An outline in box coordinates, the covariance (2, 2) of its centre, and how well it explains the edges."""

    outline: Outline
    covariance: Floats
    cost: float
    residual_px: float
    outliers: float
