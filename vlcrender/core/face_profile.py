"""Luminance profile over an LED's face: a linear gradient and a radial fall-off about a mean of 1.

The luminance at (x, y) from the centre of a face of half width R (radius of a disc, half the side of a square), over
the face's mean luminance, is

    (1 - (1 - f) (x^2 + y^2) / R^2) / (1 - (1 - f) k) + g_x x / R + g_y y / R

with the gradient (g_x, g_y), the fall-off f, and k, the mean of (x^2 + y^2) / R^2: 1/2 for a disc, 2/3 for a square.
Its mean over the face is 1 for any gradient and fall-off, so that luminance times area stays the LED's intensity.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FaceProfile:
    """level + slope_x x + slope_y y + curvature (x^2 + y^2), with x and y in m from the face's centre, in the room."""

    level: float
    slopes_per_m: tuple[float, float]
    curvature_per_m2: float

    @classmethod
    def of(cls, gradient: tuple[float, float], falloff: float, half_width_m: float, square: bool) -> Self:
        """The profile of the gradient (g_x, g_y) and the fall-off f of a face of this half width and shape."""
        level = 1 / (1 - (1 - falloff) * (2 / 3 if square else 1 / 2))
        slopes = gradient[0] / half_width_m, gradient[1] / half_width_m
        return cls(level, slopes, -level * (1 - falloff) / half_width_m**2)

    def at(self, x_m: Array, y_m: Array) -> Array:
        """The profile at points of the face, elementwise."""
        slope_x, slope_y = self.slopes_per_m
        value: Array = self.level + slope_x * x_m + slope_y * y_m + self.curvature_per_m2 * (x_m**2 + y_m**2)
        return value

    def slopes(self, x_m: Array, y_m: Array) -> tuple[Array, Array]:
        """Slopes of `at` by x and by y, 1/m."""
        slope_x, slope_y = self.slopes_per_m
        return slope_x + 2 * self.curvature_per_m2 * x_m, slope_y + 2 * self.curvature_per_m2 * y_m

    def mean_over(self, quads_m: Array) -> Array:
        """Mean over quadrilaterals (n, 4, 2) that lie on the face whole, (n,).

        The mean of a quadratic over a triangle is the mean of its values at the middles of the three sides.
        """
        a, b, c, d = np.moveaxis(quads_m, 1, 0)
        diagonal = self._at_middle(a, c)
        first = (self._at_middle(a, b) + self._at_middle(b, c) + diagonal) / 3
        second = (self._at_middle(c, d) + self._at_middle(d, a) + diagonal) / 3
        areas = [np.abs((p - a)[:, 0] * (q - a)[:, 1] - (p - a)[:, 1] * (q - a)[:, 0]) for p, q in ((b, c), (c, d))]
        mean: Array = (areas[0] * first + areas[1] * second) / (areas[0] + areas[1])
        return mean

    def mean_of(self, moments: Array, quads_m: Array) -> Array:
        """Mean over the parts of quadrilaterals (n, 4, 2) that a face covers, (n,).

        moments: (4, n), integrals of 1, x, y and x^2 + y^2 over each part (`shared_moments` of the shape). Where a part
        is so small that its moments are rounding, the mean is within the values at the quadrilateral's corners.
        """
        area, x, y, second = moments
        slope_x, slope_y = self.slopes_per_m
        light = self.level * area + slope_x * x + slope_y * y + self.curvature_per_m2 * second
        corners = self.at(quads_m[..., 0], quads_m[..., 1])
        bend = np.abs(self.curvature_per_m2) * (np.ptp(quads_m, axis=1) ** 2).sum(axis=-1)
        low, high = np.maximum(corners.min(axis=1) - bend, 0.0), np.maximum(corners.max(axis=1) + bend, 0.0)
        mean: Array = np.clip(light / np.maximum(area, np.finfo(float).tiny), low, high)
        return mean

    def _at_middle(self, p: Array, q: Array) -> Array:
        middle = (p + q) / 2
        return self.at(middle[:, 0], middle[:, 1])


def lowest_share(gradient: tuple[float, float], falloff: float, square: bool) -> float:
    """Least value of the profile on the face, over its mean; below 0 the profile is impossible.

    On a disc the least value lies on the line along the gradient. On a square the profile is a function of x plus a
    function of y, each with its own least value.
    """
    profile = FaceProfile.of(gradient, falloff, 1.0, square)
    lines = gradient if square else (float(np.hypot(*gradient)),)
    return profile.level + sum(_lowest_on_line(profile.curvature_per_m2, abs(slope)) for slope in lines)


def _lowest_on_line(curvature: float, slope: float) -> float:
    """Least value of curvature t^2 - slope t for t from -1 to 1, with slope >= 0."""
    if 2 * curvature > slope:
        return -(slope**2) / (4 * curvature)
    return curvature - slope
