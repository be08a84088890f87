"""Pixels of frames in each format of `files.format` of dataset.json: digital numbers of 32-bit integers."""

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.errors import InputError
from estimator.io.records import Row

FrameFormat = Literal["exr-uint32", "exr-float32", "png16"]
MAX_EXACT = 2**24
"""Integers below are exact in 32-bit floats."""
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_HEAD_BYTES = 26
"""Signature and IHDR as far as bit depth and colour type."""


class FilesEntry(Row):
    """`files` of dataset.json."""

    format: FrameFormat


class _Files(Row):
    """dataset.json as far as files are concerned."""

    files: FilesEntry = FilesEntry(format="exr-uint32")


def frame_format(dataset_json: bytes) -> FrameFormat:
    """The format of the frames by dataset.json; "exr-uint32" where it is not stated. Raises ValidationError."""
    return _Files.model_validate_json(dataset_json).files.format


def numbers_of_exr(
    pixels: NDArray[np.generic] | None, form: FrameFormat, shape: tuple[int, int], file: str
) -> NDArray[np.uint32]:
    """Digital numbers (rows, columns) of channel Y of a part. Raises InputError that names the file."""
    dtype, kind = (np.float32, "floats") if form == "exr-float32" else (np.uint32, "unsigned integers")
    if pixels is None or pixels.dtype != dtype or pixels.shape != shape:
        raise InputError(f"{file}: channel Y has to hold 32-bit {kind}, one a pixel")
    if dtype is np.uint32:
        return np.asarray(pixels, dtype=np.uint32)
    numbers = np.asarray(pixels, dtype=np.float32)
    # Not `<`: NaN compares false.
    if not bool(((numbers >= 0) & (numbers < MAX_EXACT) & (numbers == np.floor(numbers))).all()):
        raise InputError(f"{file}: channel Y has to hold whole digital numbers from 0 to below 2^24")
    return numbers.astype(np.uint32)


def numbers_of_png(data: bytes, shape: tuple[int, int], file: str) -> NDArray[np.uint32]:
    """Digital numbers (rows, columns) of a grey PNG with 16 bits. Raises InputError that names the file.

    Kind and size are checked before the pixels are decoded.
    """
    head = data[:PNG_HEAD_BYTES]
    if len(head) < PNG_HEAD_BYTES or head[:8] != PNG_SIGNATURE or head[12:16] != b"IHDR":
        raise InputError(f"{file}: not a readable PNG image")
    width, height = int.from_bytes(head[16:20]), int.from_bytes(head[20:24])
    if (head[24], head[25]) != (16, 0):
        raise InputError(f"{file}: needed a grey PNG with 16 bits")
    if (height, width) != shape:
        raise InputError(f"{file}: {width} x {height} pixels, but the camera has {shape[1]} x {shape[0]}")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint16 or image.shape != shape:
        raise InputError(f"{file}: not a readable PNG image")
    return np.asarray(image, dtype=np.uint32)
