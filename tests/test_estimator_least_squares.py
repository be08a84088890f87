"""Nonlinear least squares: the minimum of a curved valley, of exact data, and what is refused."""

import numpy as np
import pytest
from numpy.typing import NDArray

from estimator.solvers.least_squares import least_squares_minimum

Floats = NDArray[np.float64]


def valley(x: Floats) -> Floats:
    """Residuals of Rosenbrock's valley, without rest at (1, 1)."""
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def valley_slopes(x: Floats) -> Floats:
    return np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])


def test_a_curved_valley_is_followed_to_its_end() -> None:
    """From (-1.2, 1) a step without damping raises the sum from 24 to 1411. At the end rounding is all that is left."""
    x, residuals, cost = least_squares_minimum(valley, np.array([-1.2, 1.0]), valley_slopes, 1e-8, 100)
    np.testing.assert_allclose(x, [1.0, 1.0], atol=1e-9)
    assert cost == pytest.approx(float((residuals**2).sum()))


def test_a_minimum_with_a_rest_ends_by_the_tolerance() -> None:
    """Three numbers about one parameter: the sum of squares about their mean, 2, to rounding."""
    calls = []

    def residuals(x: Floats) -> Floats:
        calls.append(x)
        return x[0] - np.array([1.0, 2.0, 3.0])

    x, _, cost = least_squares_minimum(residuals, np.array([50.0]), lambda _: np.ones((3, 1)), 1e-8, 100)
    assert (x[0], cost) == pytest.approx((2.0, 2.0))
    assert (
        len(calls) == 3
    )  # at the start, after the step that a linear problem needs, and after one that changes nothing


def test_residuals_that_are_not_finite_at_the_start_are_refused() -> None:
    with pytest.raises(ValueError, match="not finite"):
        least_squares_minimum(lambda x: x * np.nan, np.ones(2), lambda _: np.eye(2), 1e-8, 100)
