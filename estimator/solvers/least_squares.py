"""Nonlinear least squares of few parameters: Gauss-Newton, damped where a step does not lower the sum.

The damping is Levenberg and Marquardt's. SciPy's solvers take several times as long for a handful of parameters.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Function = Callable[[Floats], Floats]

# Damping, as a share of the information's diagonal, after a step that does not lower the sum, and its factor from one
# step to the next.
MIN_DAMPING = 1e-3
DAMPING_RATIO = 10.0
# A step this small relative to the parameters is the last: convergence is quadratic, so the next would be its square,
# or rounding.
STEP_TOLERANCE = 1e-10


def least_squares_minimum(
    residuals: Function, x0: Floats, jacobian: Function, tolerance: float, max_steps: int
) -> tuple[Floats, Floats, float]:
    """Local minimum of the sum of squares of residuals (m,) from parameters x0 (k,); `jacobian` gives (m, k).

    Returns the parameters there, the residuals and their sum of squares.

    The search ends where the sum changes by less than a share `tolerance`, as found and as the derivatives promise, or
    with a step shorter than STEP_TOLERANCE. Residuals that are not finite count as a sum that is not lower. Raises
    ValueError if those at x0 are not finite, and LinAlgError if they determine no step.
    """
    x, at, slopes, damping = x0, residuals(x0), jacobian(x0), 0.0
    cost = float(at @ at)
    if not (np.isfinite(cost) and np.isfinite(slopes).all()):
        raise ValueError("residuals are not finite")
    for _ in range(max_steps):
        information, gradient = slopes.T @ slopes, slopes.T @ at
        held = damping * information.diagonal()
        information.flat[:: len(x) + 1] += held
        step = -np.linalg.solve(information, gradient)
        short = bool(step @ step <= STEP_TOLERANCE**2 * (x @ x))
        promised = float(step @ (held * step) - step @ gradient)
        there = residuals(x + step)
        new_cost = float(there @ there)
        if new_cost < cost:
            small = short or max(cost - new_cost, promised) <= tolerance * cost
            x, at, cost = x + step, there, new_cost
            if small:
                break
            damping = damping / DAMPING_RATIO if damping > MIN_DAMPING else 0.0
            slopes = jacobian(x)
        elif short or promised <= tolerance * cost:
            break
        else:
            damping = max(DAMPING_RATIO * damping, MIN_DAMPING)
    return x, at, cost
