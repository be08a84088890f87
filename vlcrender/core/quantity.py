"""Measured values with standard errors, and the propagation of the errors."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Quantity(NamedTuple):
    """A measured value and its standard error."""

    value: float
    error: float

    def over(self, other: "Quantity") -> "Quantity":
        """The ratio to another quantity with an independent error."""
        ratio = self.value / other.value
        return Quantity(ratio, float(np.hypot(self.error, ratio * other.error) / abs(other.value)))

    def times(self, factor: "float | Quantity") -> "Quantity":
        """The product with a number, or with another quantity with an independent error."""
        other = factor if isinstance(factor, Quantity) else Quantity(factor, 0.0)
        error = float(np.hypot(self.error * other.value, self.value * other.error))
        return Quantity(self.value * other.value, error)

    def plus(self, other: "Quantity") -> "Quantity":
        """The sum with another quantity with an independent error."""
        return Quantity(self.value + other.value, float(np.hypot(self.error, other.error)))


def line(x: Sequence[float], y: Sequence[Quantity]) -> tuple[Quantity, Quantity]:
    """Intercept and slope of a line through values with standard errors above 0, by weighted least squares."""
    values, errors = np.array(y).T
    design = np.stack([np.ones(len(x)), np.array(x)], axis=1) / errors[:, None]
    covariance = np.linalg.inv(design.T @ design)
    intercept, slope = covariance @ design.T @ (values / errors)
    intercept_error, slope_error = np.sqrt(covariance.diagonal())
    return Quantity(float(intercept), float(intercept_error)), Quantity(float(slope), float(slope_error))
