"""Nonuniformity: variances of the fixed patterns of rows, columns and pixels (EMVA 1288, section 8)."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.quantity import Quantity

UNSEEN_DN2 = 0.011 / 3**0.5
"""Standard error of a variance that rounding hides, DN^2.

If none of half a million numbers changes by rounding, their standard deviation is below 0.105 DN: 4.77 standard
deviations are half a DN. The variance is then uniform from 0 to 0.011 DN^2, hence the root of 3.
"""


@dataclass(frozen=True)
class Patterns:
    """Variances of a fixed pattern, DN^2, separated into rows, columns and pixels, with standard errors."""

    mean_dn: float
    row: Quantity
    column: Quantity
    pixel: Quantity
    noise_dn2: float
    """Temporal noise left in a pixel of the mean of all frames; the variances exclude it."""
    shape: tuple[int, int]

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.shape[0] * self.shape[1]

    @property
    def mean_error(self) -> float:
        """Standard error of the pattern's mean over a finite number of rows, columns and pixels."""
        parts = zip((self.row, self.column, self.pixel), (*self.shape, self.pixels), strict=True)
        return float(np.sqrt(sum(max(part.value, 0.0) / number for part, number in parts)))

    @property
    def total(self) -> Quantity:
        """s^2_y = s^2_row + s^2_column + s^2_pixel."""
        return self.row.plus(self.column).plus(self.pixel)


def patterns(frames: Iterable[NDArray[np.uint32]]) -> Patterns:
    """The patterns of two or more identical exposures, each (rows, columns).

    In the mean of L frames, deviations of pixels from the means of their row and column have the variance
    s^2_pixel + sigma^2 / L, means of rows s^2_row + (s^2_pixel + sigma^2 / L) / columns, and means of columns likewise.
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
    # Bound of the rounding error in the variance of the pixels' means, where noise does not dither the numbers. The
    # temporal variance of the numbers includes 1/12 of rounding.
    before_rounding = max(noise * count - 1 / 12, 0.0)
    undithered = float(np.exp(-4 * np.pi**2 * before_rounding)) / (2 * np.pi**2) if pixels.value else UNSEEN_DN2
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
    """Variance of normal deviations with this number of degrees of freedom."""
    variance = float(np.sum(deviations**2)) / freedom
    return Quantity(variance, variance * (2 / freedom) ** 0.5)


def response_variance(dark: Patterns, bright: Patterns) -> Quantity:
    """PRNU1288^2 = (s^2_bright - s^2_dark) / (mu_bright - mu_dark)^2.

    The dark pattern B^2 is in both means. In a finite sample it correlates with the response pattern A^2, and both
    correlate with the noise N1^2 and N0^2 of the two means: the difference has the variance
    (2 A^4 + 4 A^2 B^2 + 4 (A^2 + B^2) N1^2 + 2 N1^4 + 4 B^2 N0^2 + 2 N0^4) / n.
    """
    difference = bright.total.value - dark.total.value
    a2, b2, n1, n0 = max(difference, 0.0), max(dark.total.value, 0.0), bright.noise_dn2, dark.noise_dn2
    sampling = 2 * a2**2 + 4 * a2 * b2 + 4 * (a2 + b2) * n1 + 2 * n1**2 + 4 * b2 * n0 + 2 * n0**2
    signal2 = (bright.mean_dn - dark.mean_dn) ** 2
    return Quantity(difference / signal2, float((sampling / bright.pixels) ** 0.5) / signal2)
