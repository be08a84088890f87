"""A panel's diffuser: what one LED makes of the translucent sheet before it.

The model: an LED small against its distance d behind the sheet, of intensity I cos^m(theta), lights the sheet at an
offset r from its foot by E = I cos^(m+3)(theta) / d^2, with tan(theta) = r / d. The sheet lets a share T through and
spreads it evenly (an ideal Lambertian diffuser): its luminance, the same from everywhere, is T E / pi. Left out are
light that the panel's inside reflects, which in a real one evens the sheet out, what the sheet takes of light that
comes at a slant, and the LED's own size: near the foot E is less by about (radius / d)^2.

Light is followed to where it falls below DIM_SHARE of that at the foot, and to the border of the opening.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DIM_SHARE = 1e-3
"""What is darker than this part of the foot is left out: 3 % of the light of an LED of order 1, less of narrower."""
MIN_DISTANCE_RADII = 3.0
"""An LED is at least this many of its radii behind the sheet: at the foot E is then too large by 11 % at the most."""
NODES = 32
"""Of the quadrature along each side of a quadrant."""


@dataclass(frozen=True)
class Diffuser:
    """The part of a diffuser that one LED lights, a rectangle. Places are the room's (x, y)."""

    foot_m: tuple[float, float]
    """Straight below the LED."""
    distance_m: float
    transmittance: float
    area_m2: float
    """Of the LED's face."""
    order: float
    opening_m: tuple[float, float, float, float]
    """(x0, y0, x1, y1) of the whole sheet."""

    @property
    def reach_m(self) -> float:
        """How far from the foot light is followed, along x and along y."""
        cosine = DIM_SHARE ** (1 / (self.order + 3))
        return self.distance_m * float(np.sqrt(1 / cosine**2 - 1))

    @property
    def lit_m(self) -> tuple[float, float, float, float]:
        """(x0, y0, x1, y1) of the part that is lit."""
        (x, y), reach, (x0, y0, x1, y1) = self.foot_m, self.reach_m, self.opening_m
        return max(x0, x - reach), max(y0, y - reach), min(x1, x + reach), min(y1, y + reach)

    def luminance(self, x_m: Array, y_m: Array) -> Array:
        """Of the sheet at (x, y), for an LED whose own luminance is 1: T A cos^(m+3)(theta) / (pi d^2)."""
        tan2 = ((x_m - self.foot_m[0]) ** 2 + (y_m - self.foot_m[1]) ** 2) / self.distance_m**2
        at_foot = self.transmittance * self.area_m2 / (np.pi * self.distance_m**2)
        luminance: Array = at_foot * (1 + tan2) ** (-(self.order + 3) / 2)
        return luminance

    def quadrants(self) -> tuple[Array, Array]:
        """Centroid (x, y) of the light and luminance times area, of each of four parts about the foot: (4, 2), (4,).

        Integrated by Gauss and Legendre's rule after x = d sinh(s), which levels the integrand.
        """
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        x0, y0, x1, y1 = self.lit_m
        centers, totals = np.tile(self.foot_m, (4, 1)), np.zeros(4)
        for number, (side_x, side_y) in enumerate(((x0, y0), (x1, y0), (x1, y1), (x0, y1))):
            places, steps = [], []
            for side, foot in ((side_x, self.foot_m[0]), (side_y, self.foot_m[1])):
                end = np.arcsinh((side - foot) / self.distance_m)
                s = end * (nodes + 1) / 2
                places.append(foot + self.distance_m * np.sinh(s))
                steps.append(np.abs(end) / 2 * weights * self.distance_m * np.cosh(s))
            x, y = np.meshgrid(*places)
            light = self.luminance(x, y) * np.outer(steps[1], steps[0])
            totals[number] = light.sum()
            if totals[number] > 0:  # a foot on the border has quadrants without extent
                centers[number] = (light * x).sum() / totals[number], (light * y).sum() / totals[number]
        return centers, totals
