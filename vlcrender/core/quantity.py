"""A measured value with its standard error, and what becomes of the error in ratios and lines."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Quantity(NamedTuple):
    """A value as measured, and its standard error."""

    value: float
    error: float

    def over(self, other: "Quantity") -> "Quantity":
        """The ratio to another quantity, their errors independent."""
        ratio = self.value / other.value
        return Quantity(ratio, float(np.hypot(self.error, ratio * other.error) / abs(other.value)))

    def times(self, factor: "float | Quantity") -> "Quantity":
        """The product with a number, as into another unit, or with another quantity, their errors independent."""
        other = factor if isinstance(factor, Quantity) else Quantity(factor, 0.0)
        error = float(np.hypot(self.error * other.value, self.value * other.error))
        return Quantity(self.value * other.value, error)

    def plus(self, other: "Quantity") -> "Quantity":
        """The sum with another quantity, their errors independent."""
        return Quantity(self.value + other.value, float(np.hypot(self.error, other.error)))


def line(x: Sequence[float], y: Sequence[Quantity]) -> tuple[Quantity, Quantity]:
    """Intercept and slope of a line through values with standard errors above 0, by weighted least squares."""
    values, errors = np.array(y).T
    design = np.stack([np.ones(len(x)), np.array(x)], axis=1) / errors[:, None]
    covariance = np.linalg.inv(design.T @ design)
    intercept, slope = covariance @ design.T @ (values / errors)
    of_intercept, of_slope = np.sqrt(covariance.diagonal())
    return Quantity(float(intercept), float(of_intercept)), Quantity(float(slope), float(of_slope))
