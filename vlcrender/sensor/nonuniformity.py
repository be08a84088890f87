"""Fixed patterns of a camera: what its exposures have in common, by rows, columns and pixels (EMVA 1288, section 8)."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.quantity import Quantity

UNSEEN_DN2 = 0.011 / 3**0.5
"""Where none of half a million numbers moves by rounding, their deviation is below 0.105 DN: 4.77 of it make half a DN.

Its square, which may be anything from 0 on: over the root of 3.
"""


@dataclass(frozen=True)
class Patterns:
    """Variances of a pattern, DN^2, that of each row, column and pixel alone, with standard errors."""

    mean_dn: float
    row: Quantity
    column: Quantity
    pixel: Quantity
    noise_dn2: float
    """What temporal noise has left in a pixel of the mean of all frames; the others are without it."""
    shape: tuple[int, int]

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.shape[0] * self.shape[1]

    @property
    def mean_error(self) -> float:
        """By how much the patterns' own mean is off 0: it is one of so many rows, columns and pixels."""
        parts = zip((self.row, self.column, self.pixel), (*self.shape, self.pixels), strict=True)
        return float(np.sqrt(sum(max(part.value, 0.0) / number for part, number in parts)))

    @property
    def total(self) -> Quantity:
        """s^2_y = s^2_row + s^2_column + s^2_pixel."""
        return self.row.plus(self.column).plus(self.pixel)


def patterns(frames: Iterable[NDArray[np.uint32]]) -> Patterns:
    """The patterns of exposures alike, two or more, each (rows, columns).

    Of the mean of L frames: what pixels differ by beyond their row's and column's means has the variance
    s^2_pixel + sigma^2 / L, rows' means s^2_row + (s^2_pixel + sigma^2 / L) / columns, columns' means alike.
    """
    count = 0
    total = squares = np.zeros((1, 1))
    for frame in frames:
        image = frame.astype(np.float64)
        count, total, squares = count + 1, total + image, squares + image**2
    mean = total / count
    noise = float(np.mean((squares - count * mean**2) / (count - 1))) / count
    rows, columns = mean.shape
    everything = mean.mean()
    by_row, by_column = mean.mean(axis=1, keepdims=True), mean.mean(axis=0, keepdims=True)
    of_rows, of_columns = _variance(by_row - everything, rows - 1), _variance(by_column - everything, columns - 1)
    pixels = _variance(mean - by_row - by_column + everything, (rows - 1) * (columns - 1))
    # Where noise does not spread a pixel's numbers, up to this is left of rounding in the variance of pixels' means.
    undithered = float(np.exp(-4 * np.pi**2 * noise * count)) / (2 * np.pi**2) if pixels.value else UNSEEN_DN2
    unseen = Quantity(0.0, 0.0 if pixels.value else UNSEEN_DN2)
    return Patterns(
        mean_dn=float(everything),
        row=of_rows.plus(pixels.times(-1 / columns)).plus(unseen),
        column=of_columns.plus(pixels.times(-1 / rows)).plus(unseen),
        pixel=pixels.plus(Quantity(-noise, undithered)),
        noise_dn2=noise,
        shape=(rows, columns),
    )


def _variance(deviations: NDArray[np.float64], freedom: int) -> Quantity:
    """Of normal deviations with so many degrees of freedom."""
    variance = float(np.sum(deviations**2)) / freedom
    return Quantity(variance, variance * (2 / freedom) ** 0.5)


def response_variance(dark: Patterns, bright: Patterns) -> Quantity:
    """PRNU1288^2 = (s^2_bright - s^2_dark) / (mu_bright - mu_dark)^2.

    The dark pattern B^2 is in both, but by chance not quite independent of the response's A^2, nor the noise N1^2 and
    N0^2 of the two means of either: the difference has the variance
    (2 A^4 + 4 A^2 B^2 + 4 (A^2 + B^2) N1^2 + 2 N1^4 + 4 B^2 N0^2 + 2 N0^4) / n.
    """
    difference = bright.total.value - dark.total.value
    a2, b2, n1, n0 = max(difference, 0.0), max(dark.total.value, 0.0), bright.noise_dn2, dark.noise_dn2
    sampling = 2 * a2**2 + 4 * a2 * b2 + 4 * (a2 + b2) * n1 + 2 * n1**2 + 4 * b2 * n0 + 2 * n0**2
    signal2 = (bright.mean_dn - dark.mean_dn) ** 2
    return Quantity(difference / signal2, float((sampling / bright.pixels) ** 0.5) / signal2)
