"""Brown-Conrady lens distortion: there, its slope, back, and whether there is a way back.

Every function but the last two serves NumPy and Dr.Jit arrays alike: it has + - * / alone, and no branches.
Source: OpenCV, Camera Calibration and 3D Reconstruction, with three radial and two tangential coefficients.
"""

from functools import cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vlcrender.config.toml_model import Settings

Coefficient = Annotated[float, Field(ge=-100, le=100)]

NEWTON_STEPS = 6
"""To undo a distortion. Newton's method doubles the digits a step; a lens for which 6 do not do is refused: only one
that all but folds needs more."""


class Distortion(Settings):
    """Brown-Conrady distortion in OpenCV's convention, of coordinates x_cam / z_cam and y_cam / z_cam."""

    k1: Coefficient = 0.0
    k2: Coefficient = 0.0
    k3: Coefficient = 0.0
    p1: Coefficient = 0.0
    p2: Coefficient = 0.0


def distort(distortion: Distortion, x: Any, y: Any) -> tuple[Any, Any]:
    """Distorted (x, y) of x_cam / z_cam, y_cam / z_cam.

    x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), and the same for y with p1 and p2 exchanged.
    """
    x_d, y_d, *_ = distort_with_slope(distortion, x, y)
    return x_d, y_d


def distort_with_slope(distortion: Distortion, x: Any, y: Any) -> tuple[Any, Any, Any, Any, Any]:
    """x_d and y_d of `distort`, and dx_d/dx, dx_d/dy (the same as dy_d/dx), dy_d/dy."""
    d = distortion
    r2 = x * x + y * y
    scale = 1 + r2 * (d.k1 + r2 * (d.k2 + r2 * d.k3)) + (2 * d.p1) * y + (2 * d.p2) * x
    slope = 2 * d.k1 + r2 * (4 * d.k2 + r2 * (6 * d.k3))
    x_slope, y_slope = slope * x, slope * y
    return (
        x * scale + d.p2 * r2,
        y * scale + d.p1 * r2,
        scale + x * (x_slope + 4 * d.p2),
        x * (y_slope + 2 * d.p1) + (2 * d.p2) * y,
        scale + y * (y_slope + 4 * d.p1),
    )


def undistort(distortion: Distortion, x_d: Any, y_d: Any) -> tuple[Any, Any]:
    """Undo `distort` by NEWTON_STEPS steps of Newton's method, as many for every pixel."""
    x, y = x_d, y_d
    for _ in range(NEWTON_STEPS):
        x_now, y_now, xx, xy, yy = distort_with_slope(distortion, x, y)
        off_x, off_y = x_now - x_d, y_now - y_d
        shrink = 1 / (xx * yy - xy * xy)
        x = x - (yy * off_x - xy * off_y) * shrink
        y = y - (xx * off_y - xy * off_x) * shrink
    return x, y


@cache
def fold_radius2(distortion: Distortion) -> float:
    """Square of the undistorted radius at which the distorted one stops growing; infinity where it never does."""
    # d/dr of r (1 + k1 r^2 + k2 r^4 + k3 r^6), as a polynomial in r^2
    roots = np.roots([7 * distortion.k3, 5 * distortion.k2, 3 * distortion.k1, 1.0])
    turns = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(turns.min(initial=np.inf))


def folds(distortion: Distortion, x_d: NDArray[np.float64], y_d: NDArray[np.float64]) -> bool:
    """Whether a distorted position has no undistorted one, or one that is not found, or that is not the only one."""
    with np.errstate(all="ignore"):
        x, y = undistort(distortion, x_d, y_d)
        x_again, y_again, xx, xy, yy = distort_with_slope(distortion, x, y)
        sane = (np.hypot(x_again - x_d, y_again - y_d) < 1e-12) & (xx * yy - xy * xy > 0)
        sane &= x * x + y * y < fold_radius2(distortion)
    return not sane.all()
