"""Brown-Conrady lens distortion: the mapping, its Jacobian, its inverse, and the range in which the inverse exists.

Source: OpenCV, Camera Calibration and 3D Reconstruction, with three radial and two tangential coefficients.
"""

from functools import cache
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vlcrender.config.toml_model import Settings

Coefficient = Annotated[float, Field(ge=-100, le=100)]

NEWTON_STEPS = 6
"""Steps of Newton's method, each of which doubles the correct digits. A lens that needs more is refused: only one close
to folding the image does."""


class Distorted(NamedTuple):
    """A distorted position and the Jacobian of the distortion there, numbers or arrays."""

    x: Any
    y: Any
    dx_dx: Any
    dx_dy: Any
    """Equal to dy_dx."""
    dy_dy: Any

    @property
    def determinant(self) -> Any:
        """Area of an element after the distortion over its area before."""
        return self.dx_dx * self.dy_dy - self.dx_dy * self.dx_dy


class Distortion(Settings):
    """Brown-Conrady distortion in OpenCV's convention, of x = x_cam / z_cam and y = y_cam / z_cam.

    x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), and y_d with x and y, p1 and p2 exchanged.
    `distort` and `undistort` take NumPy and Dr.Jit arrays alike: they use + - * / only, without branches.
    """

    k1: Coefficient = 0.0
    """Radial coefficient of r^2; negative is a barrel."""
    k2: Coefficient = 0.0
    """Radial coefficient of r^4."""
    k3: Coefficient = 0.0
    """Radial coefficient of r^6."""
    p1: Coefficient = 0.0
    """First tangential coefficient."""
    p2: Coefficient = 0.0
    """Second tangential coefficient."""

    def distort(self, x: Any, y: Any) -> Distorted:
        """Distort positions (x, y), elementwise."""
        r2 = x * x + y * y
        scale = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3)) + (2 * self.p1) * y + (2 * self.p2) * x
        slope = 2 * self.k1 + r2 * (4 * self.k2 + r2 * (6 * self.k3))
        x_slope, y_slope = slope * x, slope * y
        return Distorted(
            x * scale + self.p2 * r2,
            y * scale + self.p1 * r2,
            scale + x * (x_slope + 4 * self.p2),
            x * (y_slope + 2 * self.p1) + (2 * self.p2) * y,
            scale + y * (y_slope + 4 * self.p1),
        )

    def undistort(self, x_d: Any, y_d: Any) -> tuple[Any, Any]:
        """Positions whose distorted ones are (x_d, y_d), elementwise, by NEWTON_STEPS steps of Newton's method."""
        x, y = x_d, y_d
        for _ in range(NEWTON_STEPS):
            now = self.distort(x, y)
            error_x, error_y = now.x - x_d, now.y - y_d
            inverse = 1 / now.determinant
            x = x - (now.dy_dy * error_x - now.dx_dy * error_y) * inverse
            y = y - (now.dx_dx * error_y - now.dx_dy * error_x) * inverse
        return x, y

    @property
    def fold_radius2(self) -> float:
        """Square of the radius r at which the distorted radius stops growing; infinity where it never does."""
        return _fold_radius2(self)

    def folds(self, x_d: NDArray[np.float64], y_d: NDArray[np.float64]) -> bool:
        """Whether any of the distorted positions has no inverse, more than one, or one that Newton's method misses."""
        with np.errstate(all="ignore"):
            x, y = self.undistort(x_d, y_d)
            again = self.distort(x, y)
            invertible = (np.hypot(again.x - x_d, again.y - y_d) < 1e-12) & (again.determinant > 0)
            invertible &= x * x + y * y < self.fold_radius2
        return not invertible.all()


@cache
def _fold_radius2(distortion: Distortion) -> float:
    # d/dr of r (1 + k1 r^2 + k2 r^4 + k3 r^6), as a polynomial in r^2
    roots = np.roots([7 * distortion.k3, 5 * distortion.k2, 3 * distortion.k1, 1.0])
    turns = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(turns.min(initial=np.inf))
