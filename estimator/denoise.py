"""Image to image: the noise reduction of Huynh & Yoo 2016, Algorithm 1."""

import cv2
import numpy as np
from numpy.typing import NDArray

NEIGHBOURHOOD_PX = 11
REACH_PX = NEIGHBOURHOOD_PX // 2


def neighbourhood_mean(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Replace each pixel by the mean of the 120 others in the 11 x 11 square around it; (height, width), any unit.

    This is Algorithm 1 with its slips corrected: with mu_S the mean of the differences c - c_k over the neighbours
    (Eq. 14), the adjusted intensity c - mu_S is the mean of the c_k, and c itself cancels. sigma_S takes no part in it.
    Near the image's border the mean is over those neighbours that exist.
    """
    height_px, width_px = image.shape
    # Zeros outside the image add nothing to the sum, and the count leaves them out.
    size = (NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX)
    result = cv2.boxFilter(image, cv2.CV_32F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    result -= image
    rows, columns = _counts(height_px), _counts(width_px)
    for row in range(height_px):
        # A row at a time: the whole image of counts would cost as much memory as the image itself.
        result[row] /= np.maximum(rows[row] * columns - 1, 1)
    return np.asarray(result, dtype=np.float32)


def _counts(length_px: int) -> NDArray[np.float32]:
    """How many pixels of the 11 around each place along a line of `length_px` lie on the line."""
    index = np.arange(length_px)
    first, last = np.maximum(index - REACH_PX, 0), np.minimum(index + REACH_PX, length_px - 1)
    return (last - first + 1).astype(np.float32)
