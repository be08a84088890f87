"""Previews: small gamma-encoded PNG pictures of frames, for people; no data."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.image import imsave

from vlcrender.camera.roi import RegionImage, Roi

MAX_SIDE_PX = 800
"""Largest width and height of a preview."""


def write_preview(path: Path, images: Sequence[RegionImage], sensor: Roi, white_dn: int, black_dn: int = 0) -> None:
    """Write a small grey picture: block means above the black level, gamma 2.2.

    It shows the sensor and all regions; pixels outside the regions are black.
    """
    whole = sensor
    for roi, _ in images:
        whole = whole.union(roi)
    block = max(1, -(-max(whole.columns, whole.rows) // MAX_SIDE_PX))
    sums = np.zeros((-(-whole.rows // block), -(-whole.columns // block)))
    for roi, image in images:
        row, column = roi.row - whole.row, roi.column - whole.column
        before, after = (
            (row % block, column % block),
            (-(row + roi.rows) % block, -(column + roi.columns) % block),
        )
        padded = np.pad(np.maximum(image, black_dn) - black_dn, tuple(zip(before, after, strict=True)))
        rows, columns = padded.shape[0] // block, padded.shape[1] // block
        here = np.s_[row // block : row // block + rows, column // block : column // block + columns]
        sums[here] += padded.reshape(rows, block, columns, block).sum(axis=(1, 3))
    small = sums[: max(1, whole.rows // block), : max(1, whole.columns // block)] / block**2
    imsave(path, (np.clip(small / (white_dn - black_dn), 0, 1)) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
