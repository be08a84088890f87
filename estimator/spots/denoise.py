"""Denoisers: Algorithm 1 of Huynh & Yoo 2016, as printed and corrected, and others for comparison.

Every denoiser takes an image (height, width) of electrons above the black level and returns a new one.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compiled

Image = NDArray[np.float32]

NEIGHBOURHOOD_PX = 11
NEIGHBOURHOOD_RADIUS_PX = NEIGHBOURHOOD_PX // 2
NEIGHBOURS = NEIGHBOURHOOD_PX**2 - 1
BILATERAL_PX = 5
# Stabilised noise has a standard deviation of 1: a difference of three is an edge.
BILATERAL_SIGMA = 3.0
BILATERAL_SPACE_PX = 1.5


@dataclass(frozen=True)
class Denoiser:
    """A denoiser and its radius: a pixel of the result depends on a square of 2 `radius_px` + 1 pixels.

    `apply` takes the image and the standard deviation of the signal-independent noise, electrons. `by_means`
    gives the same from the image and its `neighbourhood_mean`, which the denoisers of a frame share; None where the
    result takes more.
    """

    apply: Callable[[Image, float], Image]
    radius_px: int
    by_means: Callable[[Image, Image], Image] | None = None


def neighbourhood_mean(image: Image) -> Image:
    """Replace each pixel by the mean of the 120 others in the 11 x 11 square around it; (height, width), any unit.

    This is Algorithm 1 with its errors corrected: with mu_S the mean of the differences c - c_k over the neighbours
    (Eq. 14), the adjusted intensity c - mu_S is the mean of the c_k, and c itself cancels. sigma_S is not used.
    Near the image's border the mean is over the neighbours inside the image.
    """
    return _neighbour_means(np.ascontiguousarray(image))


def algorithm_1(image: Image) -> Image:
    """Algorithm 1 of Huynh & Yoo 2016, line by line as printed, in electrons; the result is not an image of the scene.

    Line 9: mu_S is the mean of the differences c - c_k over the 120 neighbours. Line 10 assigns SSoID
    instead of adding to it, so that only the last neighbour's (c - c_k)^2 / 120 remains, 5 px further right and down.
    Line 11: sigma_S = mu_S - SSoID. Line 12, by Eq. 13: lambda_1 = (sigma_S^2 + mu_S) / 2.

    Not published, chosen here: mu_S starts from 0 at each pixel ("we execute Algorithm 1 for every pixel"; the printed
    line 3 sets it once for the image), and the adjusted intensity of line 16, which the paper does not define, is
    lambda_1: the mean of the Poisson variable that models the pixel in Eq. 12, hence its value without noise (Eq. 11).
    With c - mu_S in its place the result is `neighbourhood_mean`, and lines 10 to 12 are not needed.
    """
    return adjusted(image, neighbourhood_mean(image))


def adjusted(image: Image, means: Image) -> Image:
    """Lines 9 to 12 of `algorithm_1`, by the `neighbourhood_mean` of the image."""
    return _adjusted(np.ascontiguousarray(image), means)


def box_mean(image: Image) -> Image:
    """Mean of the 11 x 11 square around each pixel, itself included; the image is mirrored at its borders."""
    return np.asarray(cv2.blur(image, (NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX)), dtype=np.float32)


def variance_stabilised(image: Image, read_noise_e: float) -> Image:
    """Stabilise the variance of shot noise, smooth by a bilateral filter, which preserves edges, and invert."""
    even = cv2.bilateralFilter(stabilise(image, read_noise_e), BILATERAL_PX, BILATERAL_SIGMA, BILATERAL_SPACE_PX)
    return unbiased_inverse(np.asarray(even, dtype=np.float32), read_noise_e)


def stabilise(image: Image, read_noise_e: float) -> Image:
    """Generalised Anscombe transform, `2 sqrt(e + 3/8 + sigma^2)`: noise of standard deviation 1 from about 4 e on.

    Starck, Murtagh & Bijaoui, Image Processing and Data Analysis, 1998, at a gain of one electron.
    """
    lifted = image + np.float32(0.375 + read_noise_e**2)
    np.maximum(lifted, 0, out=lifted)
    np.sqrt(lifted, out=lifted)
    lifted *= 2
    return np.asarray(lifted, dtype=np.float32)


def unbiased_inverse(stabilised: Image, read_noise_e: float) -> Image:
    """Electrons whose `stabilise`d values have this mean, to about 0.02 e; the algebraic inverse is up to 0.25 e low.

    The closed form of Maekitalo & Foi, IEEE Trans. Image Processing 20 (2011), with sigma^2 subtracted (their
    paper on the generalised transform, vol. 22, 2013).
    """
    # The lowest mean is that at 0 e, where the closed form is 0.
    mean = np.maximum(stabilised, np.float32(2 * np.sqrt(0.375)))
    inverse = 1 / mean
    result = inverse * np.float32(0.625 * np.sqrt(1.5)) - np.float32(1.375)
    result *= inverse
    result += np.float32(0.25 * np.sqrt(1.5))
    result *= inverse
    mean *= mean
    mean *= np.float32(0.25)
    result += mean
    result -= np.float32(0.125 + read_noise_e**2)
    return np.asarray(result, dtype=np.float32)


DENOISERS: dict[str, Denoiser] = {
    "corrected": Denoiser(
        lambda image, read_noise_e: neighbourhood_mean(image), NEIGHBOURHOOD_RADIUS_PX, lambda image, means: means
    ),
    "literal": Denoiser(lambda image, read_noise_e: algorithm_1(image), NEIGHBOURHOOD_RADIUS_PX, adjusted),
    "box": Denoiser(lambda image, read_noise_e: box_mean(image), NEIGHBOURHOOD_RADIUS_PX),
    "none": Denoiser(lambda image, read_noise_e: image, 0),
    "anscombe": Denoiser(variance_stabilised, BILATERAL_PX // 2),
}


@compiled
def _neighbour_means(image: Image) -> Image:
    """See `neighbourhood_mean`: sums down the columns move with the row, and those along it are of pairs of columns."""
    height, width = image.shape
    result, outside = np.empty((height, width), dtype=np.float32), np.zeros(width, dtype=np.float32)
    # Sums of 11 rows in double precision, with zeros beside the image, which the counts omit.
    columns, pairs = np.zeros(width + NEIGHBOURHOOD_PX - 1), np.empty(width + NEIGHBOURHOOD_PX - 1)
    inner, counts = columns[NEIGHBOURHOOD_RADIUS_PX : NEIGHBOURHOOD_RADIUS_PX + width], np.empty(width, np.float32)
    for column in range(width):
        counts[column] = _count(column, width)
    for row in range(-NEIGHBOURHOOD_RADIUS_PX, height):
        entering, leaving = row + NEIGHBOURHOOD_RADIUS_PX, row - NEIGHBOURHOOD_RADIUS_PX - 1
        below, above = image[entering] if entering < height else outside, image[leaving] if leaving >= 0 else outside
        for column in range(width):
            inner[column] += np.float64(below[column]) - np.float64(above[column])
        if row < 0:
            continue
        rows, own, means = np.float32(_count(row, height)), image[row], result[row]
        for place in range(len(pairs) - 1):
            pairs[place] = columns[place] + columns[place + 1]
        for k in range(width):
            total = pairs[k] + pairs[k + 2] + pairs[k + 4] + pairs[k + 6] + pairs[k + 8] + columns[k + 10]
            others = rows * counts[k] - np.float32(1)
            means[k] = (np.float32(total) - own[k]) / (others if others > 1 else np.float32(1))
    return result


@compiled
def _count(at: int, length_px: int) -> int:
    """Number of the 11 pixels around a place on a line of `length_px` that lie on the line."""
    return min(at + NEIGHBOURHOOD_RADIUS_PX, length_px - 1) - max(at - NEIGHBOURHOOD_RADIUS_PX, 0) + 1


@compiled
def _adjusted(image: Image, means: Image) -> Image:
    """Adjusted intensities of Algorithm 1, by the means of pixels' neighbours."""
    height, width = image.shape
    result, last = np.empty((height, width), dtype=np.float32), np.empty(width, dtype=np.float32)
    for row in range(height):
        line, line_means, line_result = image[row], means[row], result[row]
        # The last neighbour of each pixel; for pixels beyond the image, those at its border.
        below = image[min(row + NEIGHBOURHOOD_RADIUS_PX, height - 1)]
        for column in range(width):
            last[column] = below[min(column + NEIGHBOURHOOD_RADIUS_PX, width - 1)]
        for column in range(width):
            mu, off = line[column] - line_means[column], line[column] - last[column]
            sigma = mu - off * off / np.float32(NEIGHBOURS)
            line_result[column] = (sigma * sigma + mu) / np.float32(2)
    return result
