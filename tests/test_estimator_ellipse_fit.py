"""The ellipse of an LED image's edges: what its cost counts, and edges that no ellipse has."""

import numpy as np
import pytest

from estimator.spots.ellipse_fit import _start_ellipse, fit_ellipse
from estimator.spots.line_edges import LineEdges
from estimator.spots.outlines import OUTLIER_SIGMA, EdgeEllipse

SIGMA_PX = 0.05


def edges_of(left: list[float], right: list[float]) -> LineEdges:
    """Edges of lines 0, 1, ... with errors of SIGMA_PX and no blur."""
    count = len(left)
    return LineEdges(
        np.arange(float(count)), np.array(left), np.array(right), np.full(count, SIGMA_PX**2), np.ones(count), 0.0
    )


def test_the_cost_is_the_mean_square_of_the_edges_in_sigmas_with_outliers_limited() -> None:
    """Five parameters cost 5 ln(n) as by the Bayesian information criterion, n edges. An edge that is 40 sigma off
    counts as one at the limit; of 47 others one in 3000 would be beyond it.
    """
    rng = np.random.default_rng(4)
    left, right = EdgeEllipse(30.0, 12.0, 0.2, 15.0, 13.0).edges(np.arange(24.0))
    left, right = left + SIGMA_PX * rng.normal(size=24), right + SIGMA_PX * rng.normal(size=24)
    left[9] -= 40 * SIGMA_PX
    found = fit_ellipse(edges_of(left.tolist(), right.tolist()))
    assert found is not None
    off = np.concatenate(found.outline.edges(np.arange(24.0))) - np.concatenate([left, right])
    square = (off / SIGMA_PX) ** 2
    assert np.flatnonzero(square > OUTLIER_SIGMA**2).tolist() == [9]
    expected = square[np.arange(48) != 9].sum() + OUTLIER_SIGMA**2 + 5 * np.log(48)
    assert found.cost == pytest.approx(expected / 24, rel=1e-9)


def test_edges_of_a_band_are_no_ellipse() -> None:
    """Seven lines of a slanted band, a little narrower at one end: the ellipse that fits them best is some 280 lines
    long, and all lines are so near to its end that blur displaces their edges.
    """
    left, right = [16.0, 17.0, 15.0, 11.0, 12.0, 9.0, 12.0], [36.0, 30.0, 30.0, 25.0, 27.0, 25.0, 22.0]
    assert fit_ellipse(edges_of(left, right)) is None


def test_the_start_weighs_squared_chords_by_their_errors() -> None:
    """A squared chord c^2 errs by 2 c times its chord's error: in c^2 = c0 + c1 y + c2 y^2 its weight is 1 / (c sigma),
    here with errors that differ tenfold from line to line. Both solve the same equations: rounding alone differs.
    """
    rng = np.random.default_rng(6)
    lines, sigma_px = np.arange(26.0), np.where(np.arange(26) % 3 == 0, 0.5, 0.05)
    left, right = EdgeEllipse(30.0, 12.0, 0.0, 15.0, 16.0).edges(lines)
    left, right = left + sigma_px * rng.uniform(-1, 1, 26), right + sigma_px * rng.uniform(-1, 1, 26)
    found = _start_ellipse(LineEdges(lines, left, right, sigma_px**2, np.ones(26), 0.0))
    c2, c1, c0 = np.polyfit(lines + 0.5, (right - left) ** 2, 2, w=1 / (sigma_px * (right - left)))
    assert found is not None
    y0, chord2 = -c1 / (2 * c2), c0 - c1**2 / (4 * c2)
    expected = y0, np.sqrt(chord2) / 2, np.sqrt(-chord2 / c2)
    assert (found.y0, found.half_chord, found.half_extent) == pytest.approx(expected, rel=1e-9)
