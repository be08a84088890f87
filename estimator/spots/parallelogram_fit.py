"""Parallelogram of a square LED image: a robust, weighted fit to the edges of its lines."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from estimator.spots.line_edges import MIN_LINES, LineEdges
from estimator.spots.outlines import OUTLIER_SIGMA, EdgeParallelogram, OutlineFit

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

SQUARE_STARTS_DEG = (10.0, 25.0, 40.0, 50.0, 65.0, 80.0)
SQUARE_ROUNDS = 4


def fit_parallelogram(edges: LineEdges, stripe_px: float) -> OutlineFit | None:
    """Robust, weighted fit of a parallelogram to edges, and to the first and last lit line.

    The true ends lie beyond the first and last lit line by at most a dark stripe: their mean has a variance of at most
    stripe_px^2 / 24. That alone says where a square with sides across the lines is.
    """
    ends = _Ends(edges.lines.min(), edges.lines.max() + 1, max(stripe_px, 1.0))
    models: list[_ParallelogramModel] = [_UprightModel(edges, ends), *_TurnedModel.starts(edges, ends)]
    found = [one for one in (model.fit() for model in models) if one is not None]
    return min(found, key=lambda one: one.cost, default=None)


@dataclass(frozen=True)
class _Ends:
    """First lit line, end of the last one, and the longest dark stripe, lines."""

    first: float
    last: float
    stripe_px: float

    @property
    def middle(self) -> float:
        return (self.first + self.last) / 2

    @property
    def sigma(self) -> float:
        return self.stripe_px / float(np.sqrt(24))


@dataclass(frozen=True, eq=False)
class _ParallelogramModel(ABC):
    """Parameters of a parallelogram, of which the first two are its centre (x, y), and how to fit them."""

    edges: LineEdges
    ends: _Ends
    start: Floats

    @abstractmethod
    def outline(self, p: Floats) -> EdgeParallelogram:
        """The parallelogram of some parameters."""

    def residuals(self, p: Floats) -> Floats:
        """Whitened residuals (2n + 1,): of the left edges, of the right edges, and of the middle of the ends."""
        measured = np.stack([self.edges.left, self.edges.right])
        off = (np.stack(self.outline(p).edges(self.edges.lines)) - measured) / np.sqrt(self.edges.variance)
        return np.concatenate([off.ravel(), [(p[1] - self.ends.middle) / self.ends.sigma]])

    def _kept_residuals(self, p: Floats, kept: Mask) -> Floats:
        return self.residuals(p)[kept]

    def fit(self) -> OutlineFit | None:
        """The fit from the start; None where there is none."""
        at, kept = self.start, np.ones(2 * len(self.edges.lines) + 1, dtype=bool)
        white = self.residuals(at)
        try:
            for _ in range(SQUARE_ROUNDS):
                solved = least_squares(self._kept_residuals, at, method="lm", x_scale="jac", max_nfev=200, args=(kept,))
                at, white = solved.x, self.residuals(solved.x)
                spread = max(1.0, 1.4826 * float(np.median(np.abs(white[:-1]))))
                new = np.append(np.abs(white[:-1]) <= OUTLIER_SIGMA * spread, True)
                if (new == kept).all():
                    break
                kept = new
            slopes = np.asarray(solved.jac, dtype=np.float64)
            inverse = np.linalg.inv(slopes.T @ slopes)
        except (ValueError, np.linalg.LinAlgError):
            return None
        scale = max(float((white[kept] ** 2).sum()) / max(int(kept.sum()) - len(at), 1), 1.0)
        off = white[:-1] * np.tile(np.sqrt(self.edges.variance), 2)
        rms = float(np.sqrt((off[kept[:-1]] ** 2).mean()))
        cost = float(np.minimum(white[:-1] ** 2, OUTLIER_SIGMA**2).sum() + white[-1] ** 2)
        # Parameters that explain nothing must not win: the Bayesian information criterion.
        cost += len(at) * float(np.log(len(white)))
        count = len(self.edges.lines)
        covariance = np.asarray(inverse[:2, :2] * scale, dtype=np.float64)
        return OutlineFit(self.outline(at), covariance, cost / count, rms, 1 - float(kept[:-1].mean()))


@dataclass(frozen=True, eq=False)
class _UprightModel(_ParallelogramModel):
    """Two sides across the lines; (x, y), the slope of the other two, and half their distance along x."""

    start: Floats = field(default_factory=lambda: np.zeros(4))

    def __post_init__(self) -> None:
        middle = (self.edges.left + self.edges.right) / 2
        slope, x = np.polyfit(self.edges.lines + 0.5 - self.ends.middle, middle, 1)
        half = float(np.median(self.edges.right - self.edges.left)) / 2
        object.__setattr__(self, "start", np.array([x, self.ends.middle, slope, half]))

    def outline(self, p: Floats) -> EdgeParallelogram:
        a = 1 / max(abs(p[3]), 1e-6)
        # The lit lines all lie between the two sides across: the edges do not depend on these.
        extent = (self.ends.last - self.ends.first) / 2 + self.ends.stripe_px
        return EdgeParallelogram(p[0], p[1], ((a, -a * p[2]), (0.0, 1 / extent)))


@dataclass(frozen=True, eq=False)
class _TurnedModel(_ParallelogramModel):
    """Two pairs of sides that lines cross; (x, y) and the coefficients of `EdgeParallelogram.sides`."""

    @classmethod
    def starts(cls, edges: LineEdges, ends: _Ends) -> "list[_ParallelogramModel]":
        """The two of SQUARE_STARTS_DEG that fit the edges best as they are."""
        x = float(np.average((edges.left + edges.right) / 2, weights=edges.level))
        models = []
        for degrees in SQUARE_STARTS_DEG:
            c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
            a, b = np.array([c, s]) * 2 * (c + s) / (ends.last - ends.first)
            models.append(cls(edges, ends, np.array([x, ends.middle, a, b, -b, a])))
        return sorted(models, key=lambda one: float(np.abs(one.residuals(one.start)).sum()))[:2]  # type: ignore[return-value]

    def outline(self, p: Floats) -> EdgeParallelogram:
        return EdgeParallelogram(p[0], p[1], ((p[2], p[3]), (p[4], p[5])))

    def fit(self) -> OutlineFit | None:
        """The fit; None also where a pair of sides bounds a few lines at the ends alone, which says little of it."""
        found = super().fit()
        if found is None or not isinstance(found.outline, EdgeParallelogram):
            return None
        y = self.edges.lines + 0.5 - found.outline.y0
        (a1, b1), (a2, b2) = found.outline.sides
        if min(abs(a1), abs(a2)) < 1e-9:
            return None
        low = np.stack([-b1 / a1 * y - 1 / abs(a1), -b2 / a2 * y - 1 / abs(a2)])
        high = np.stack([-b1 / a1 * y + 1 / abs(a1), -b2 / a2 * y + 1 / abs(a2)])
        bounded = [(low.argmax(axis=0) == k).sum() + (high.argmin(axis=0) == k).sum() for k in (0, 1)]
        return found if min(bounded) >= MIN_LINES else None
