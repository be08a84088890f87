"""Previews: small gamma-encoded grey PNG pictures of frames, for people; no data."""

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.roi import RegionImage, Roi

MAX_SIDE_PX = 800
"""Largest width and height of a preview."""
BAND_BLOCKS = 8
"""Rows of blocks whose sums are taken together: intermediate ones then stay in the processor's cache."""
GREY_8_BITS = (8, 0, 0, 0, 0)
"""Bits of a PNG pixel, colour type, compression, filter and interlace (ISO/IEC 15948, 11.2.2)."""


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
        light = np.maximum(image, black_dn) - black_dn if black_dn else image
        if any(before + after):
            light = np.pad(light, tuple(zip(before, after, strict=True)))
        of_blocks = _block_sums(light, block)
        rows, columns = of_blocks.shape
        sums[row // block : row // block + rows, column // block : column // block + columns] += of_blocks
    share = sums[: max(1, whole.rows // block), : max(1, whole.columns // block)] / block**2
    share /= white_dn - black_dn
    share = np.clip(share, 0, 1, out=share) ** (1 / 2.2)
    share *= 256
    path.write_bytes(_png(np.minimum(share, 255, out=share).astype(np.uint8)))


def _block_sums(image: NDArray[Any], block: int) -> NDArray[np.uint32]:
    """Sums of blocks of block x block pixels, of which the image holds a whole number: columns of blocks below 2^32."""
    rows, columns = image.shape[0] // block, image.shape[1] // block
    sums = np.empty((rows, columns), dtype=np.uint32)
    for first in range(0, rows, BAND_BLOCKS):
        band = image[first * block : (first + BAND_BLOCKS) * block].reshape(-1, block, image.shape[1])
        of_rows = band.sum(axis=1, dtype=np.uint32)
        np.add.reduce([of_rows[:, start::block] for start in range(block)], out=sums[first : first + BAND_BLOCKS])
    return sums


def _png(grey: NDArray[np.uint8]) -> bytes:
    """An 8-bit grey PNG (rows, columns); runs and Huffman's code alone take a tenth of the time of zlib's search."""
    rows = np.pad(grey, ((0, 0), (1, 0)))  # each row starts with the number of its filter: 0, none
    packer = zlib.compressobj(level=1, strategy=zlib.Z_RLE)
    pixels = packer.compress(rows.tobytes()) + packer.flush()
    head = struct.pack(">II5B", grey.shape[1], grey.shape[0], *GREY_8_BITS)
    chunks = (
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in ((b"IHDR", head), (b"IDAT", pixels), (b"IEND", b""))
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
