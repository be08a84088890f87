"""Ellipse of an LED image: a robust, weighted fit to the edges of its lines."""

import numpy as np
from numpy.typing import NDArray

from estimator.spots.line_edges import MAX_T, MIN_LINES, LineEdges
from estimator.spots.outlines import OUTLIER_SIGMA, EdgeEllipse, OutlineFit

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_ROUNDS = 8
GAUSS_NEWTON_STEPS = 12


def fit_ellipse(measured: LineEdges) -> OutlineFit | None:
    """Robust, weighted fit of an ellipse to edges."""
    start = _start_ellipse(measured)
    if start is None:
        return None
    at, kept, edges = start, np.ones((2, len(measured.lines)), dtype=bool), measured
    for _ in range(MAX_ROUNDS):
        edges = measured.unblurred(at)
        within = np.abs((edges.lines + 0.5 - at.y0) / at.half_extent) <= MAX_T
        used = kept & within
        if used.sum() < 2 * MIN_LINES or not used.any(axis=0).sum() >= MIN_LINES:
            return None
        solved = _gauss_newton(edges, at, used)
        if solved is None:
            return None
        at, information, residuals = solved
        within = np.abs((edges.lines + 0.5 - at.y0) / at.half_extent) <= MAX_T
        white = residuals / np.sqrt(edges.variance)
        spread = max(1.0, 1.4826 * float(np.median(np.abs(white[:, within]))) if within.any() else 1.0)
        new = np.abs(white) <= OUTLIER_SIGMA * spread
        if (new == kept).all():
            break
        kept = new
    used = kept & within
    if used.sum() < 2 * MIN_LINES:
        return None
    chi2 = float((white[used] ** 2).sum()) / max(used.sum() - 5, 1)
    try:
        covariance = np.linalg.inv(information)[:2, :2] * max(chi2, 1.0)
    except np.linalg.LinAlgError:
        return None
    outliers = 1 - used.sum() / max(2 * within.sum(), 1)
    rms = float(np.sqrt((residuals[used] ** 2).mean()))
    # Lines near the ends count as outliers of the other outline would.
    cost = float(np.minimum(white**2, OUTLIER_SIGMA**2).sum() + 5 * np.log(white.size)) / len(edges.lines)
    return OutlineFit(at, covariance, cost, rms, outliers)


def _start_ellipse(edges: LineEdges) -> EdgeEllipse | None:
    """Ellipse by linear least squares: the squared chord is quadratic in y, the middle linear."""
    y = edges.lines + 0.5
    centre, scale = y.mean(), max(float(np.ptp(y)) / 2, 1.0)
    t = (y - centre) / scale
    chord2, middle = (edges.right - edges.left) ** 2, (edges.left + edges.right) / 2
    kept = np.ones(len(y), dtype=bool)
    for _ in range(3):
        weight = kept / np.sqrt(edges.variance * chord2)
        design = np.stack([np.ones_like(t), t, t**2], axis=1)
        c0, c1, c2 = np.linalg.lstsq(design * weight[:, None], chord2 * weight, rcond=None)[0]
        off = np.abs(chord2 - design @ (c0, c1, c2)) * weight
        scatter = 1.4826 * float(np.median(off[kept]))
        kept = off <= max(OUTLIER_SIGMA * scatter, 1e-9)
        if kept.sum() < MIN_LINES:
            return None
    if c2 >= 0:
        return None
    top = -c1 / (2 * c2)
    peak2 = c0 - c1**2 / (4 * c2)
    if peak2 <= 0:
        return None
    line = np.polyfit(t[kept], middle[kept], 1, w=1 / np.sqrt(edges.variance[kept]))
    half_extent = scale * float(np.sqrt(-peak2 / c2))
    return EdgeEllipse(
        float(np.polyval(line, top)),
        float(centre + scale * top),
        float(line[0] / scale),
        float(np.sqrt(peak2)) / 2,
        half_extent,
    )


def _gauss_newton(edges: LineEdges, start: EdgeEllipse, used: Mask) -> tuple[EdgeEllipse, Floats, Floats] | None:
    """Least squares from a start: the ellipse, its information (5, 5), and residuals (2, n) of left and right edges."""
    at, weight = start, used / np.sqrt(edges.variance)
    measured = np.stack([edges.left, edges.right])
    information = np.eye(5)
    for _ in range(GAUSS_NEWTON_STEPS):
        residuals = measured - np.stack(at.edges(edges.lines))
        of_middle, of_half = at.slopes(edges.lines)
        design = np.stack([of_middle - of_half, of_middle + of_half]) * weight[:, :, None]
        flat = design.reshape(-1, 5)
        information = flat.T @ flat
        try:
            step = np.linalg.solve(information, flat.T @ (residuals * weight).ravel())
        except np.linalg.LinAlgError:
            return None
        # An extent must not shrink below the lines that are used, nor run away.
        limit = 0.3 * at.half_extent
        step *= min(1.0, limit / max(np.abs(step[[0, 1, 3, 4]]).max(), 1e-12))
        new = EdgeEllipse(*(np.array([at.x0, at.y0, at.slope, at.half_chord, at.half_extent]) + step).tolist())
        if not (new.half_chord > 0 and new.half_extent > 0 and np.isfinite(step).all()):
            return None
        at = new
        if np.abs(step[[0, 1, 3, 4]]).max() < 1e-5:
            break
    residuals = measured - np.stack(at.edges(edges.lines))
    return at, information, residuals
