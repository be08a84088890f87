"""Panel diffusers: the luminance of a diffuser lit by one LED behind it.

Model: an LED of intensity I cos^m(theta), small against its distance d behind the diffuser, illuminates the diffuser at
an offset r from the LED's foot with E = I cos^(m+3)(theta) / d^2, tan(theta) = r / d. The diffuser transmits a share T
of the light and scatters it evenly (an ideal Lambertian diffuser): its luminance is T E / pi in every direction. The
model leaves out reflections inside the panel, which make a real diffuser more even; the lower transmittance of oblique
light; and the LED's own size, which lowers E near the foot by about (radius / d)^2.

The lit part ends at MIN_RELATIVE_LUMINANCE of the luminance at the foot, and at the border of the panel's opening.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MIN_RELATIVE_LUMINANCE = 1e-3
"""Luminance at the end of the lit part over that at the foot. Beyond is 3 % of the light of an LED of order 1, less of
a narrower one."""
MIN_DISTANCE_RADII = 3.0
"""Smallest distance of an LED from its diffuser, in LED radii: E at the foot is then too large by at most 11 %."""
QUADRATURE_NODES = 32
"""Nodes of the quadrature along each side of a quadrant."""


@cache
def _quadrature() -> tuple[Array, Array]:
    """Nodes and weights of Gauss and Legendre's rule: they take longer than all that a quadrant does with them."""
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE_NODES)
    return nodes, weights


@dataclass(frozen=True)
class Diffuser:
    """The part of a diffuser that one LED lights, a rectangle. Positions are the room's (x, y)."""

    foot_m: tuple[float, float]
    """The LED's foot: the point of the diffuser straight below it."""
    distance_m: float
    """Distance of the LED behind the diffuser."""
    transmittance: float
    """Share of the light that the diffuser transmits."""
    area_m2: float
    """Area of the LED's face."""
    order: float
    """Lambertian order of the LED."""
    opening_m: tuple[float, float, float, float]
    """(x0, y0, x1, y1) of the whole diffuser."""

    @property
    def lit_radius_m(self) -> float:
        """Distance from the foot at which luminance falls to MIN_RELATIVE_LUMINANCE."""
        cosine = MIN_RELATIVE_LUMINANCE ** (1 / (self.order + 3))
        return self.distance_m * float(np.sqrt(1 / cosine**2 - 1))

    @property
    def lit_m(self) -> tuple[float, float, float, float]:
        """(x0, y0, x1, y1) of the lit part: a square about the foot, cut at the border of the opening."""
        (x, y), radius, (x0, y0, x1, y1) = self.foot_m, self.lit_radius_m, self.opening_m
        return max(x0, x - radius), max(y0, y - radius), min(x1, x + radius), min(y1, y + radius)

    def as_built(self, x_m: float, y_m: float, size: float) -> "Diffuser":
        """LED and diffuser moved together along x and y, the LED's radius or side multiplied by `size`."""
        (x, y), (x0, y0, x1, y1) = self.foot_m, self.opening_m
        return replace(
            self,
            foot_m=(x + x_m, y + y_m),
            opening_m=(x0 + x_m, y0 + y_m, x1 + x_m, y1 + y_m),
            area_m2=self.area_m2 * size**2,
        )

    def at(self, x_m: Any, y_m: Any) -> Any:
        """Luminance of the diffuser at (x, y) over that of the LED: T A cos^(m+3)(theta) / (pi d^2); elementwise.

        Arrays are NumPy's or Dr.Jit's, in the latter case with the diffuser's numbers as data.
        """
        x, y, d = x_m - self.foot_m[0], y_m - self.foot_m[1], self.distance_m
        square_m2 = x * x + y * y + d * d
        # T A d^(m+1) / pi over the distance from the LED to the power m + 3
        scale = self.transmittance * self.area_m2 * d ** (self.order + 1) / float(np.pi)
        if abs(self.order - 1) < 1e-12:  # a square takes a tenth of the time of a power
            return scale / (square_m2 * square_m2)
        return scale * square_m2 ** (-(self.order + 3) / 2)

    def slopes(self, x_m: Array, y_m: Array) -> tuple[Array, Array]:
        """Slopes of `at` by x and by y, 1/m."""
        x, y = x_m - self.foot_m[0], y_m - self.foot_m[1]
        by_square = -(self.order + 3) * self.at(x_m, y_m) / (self.distance_m**2 + x * x + y * y)
        return by_square * x, by_square * y

    def quadrants(self) -> tuple[Array, Array]:
        """Centroids (x, y) of light, (4, 2), and luminance times area, (4,), of the four quadrants about the foot.

        Luminance is relative to the LED's. Gauss-Legendre quadrature in s with x = d sinh(s), which flattens the
        integrand.
        """
        nodes, weights = _quadrature()
        x0, y0, x1, y1 = self.lit_m
        centers, totals = np.tile(self.foot_m, (4, 1)), np.zeros(4)
        for number, (side_x, side_y) in enumerate(((x0, y0), (x1, y0), (x1, y1), (x0, y1))):
            positions, steps = [], []
            for side, foot in ((side_x, self.foot_m[0]), (side_y, self.foot_m[1])):
                end = np.arcsinh((side - foot) / self.distance_m)
                s = end * (nodes + 1) / 2
                positions.append(foot + self.distance_m * np.sinh(s))
                steps.append(np.abs(end) / 2 * weights * self.distance_m * np.cosh(s))
            x, y = np.meshgrid(*positions)
            light = self.at(x, y) * np.outer(steps[1], steps[0])
            totals[number] = light.sum()
            if totals[number] > 0:  # a foot on the border has quadrants without area
                centers[number] = (light * x).sum() / totals[number], (light * y).sum() / totals[number]
        return centers, totals
