"""Files of frames in each format of `[files]`: digital numbers of regions in, the same numbers out."""

import hashlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Picture
from PIL.PngImagePlugin import PngInfo

from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.dataset.format.exr import ExrPart, read_exr_parts, write_exr
from vlcrender.dataset.format.files import FRAMES, whole_file
from vlcrender.dataset.recipe.file_settings import FrameFormat
from vlcrender.errors import InputError

DTYPES: Mapping[str, np.dtype[Any]] = {
    "exr-uint32": np.dtype(np.uint32),
    "exr-float32": np.dtype(np.float32),
    "png16": np.dtype(np.uint16),
}
"""Type of the pixels on disk, by format."""
ATTRIBUTES = (
    "expTime",
    "aperture",
    "nominalFocalLength",
    "sensorPhotositePitch",
    "vlcrender:frame",
    "vlcrender:camera",
)
"""Attributes of an EXR that a PNG has too, as `tEXt`."""
PNG_LEVEL = 1
"""Level of zlib: noise compresses no better with more."""


def frame_file(frame: int, form: FrameFormat) -> str:
    """Path of a frame's file below the dataset, with `/`."""
    return f"{FRAMES}/{frame:06d}{'.png' if form == 'png16' else '.exr'}"


def stored(images: Sequence[RegionImage], form: FrameFormat) -> list[RegionImage]:
    """Digital numbers of regions as the format has them. The numbers stay the same: `FileSettings.problem`."""
    return [RegionImage(roi, image.astype(DTYPES[form], copy=False)) for roi, image in images]


def write_frame(
    path: Path, images: Sequence[RegionImage], sensor: Roi, attributes: Mapping[str, Any], form: FrameFormat
) -> str:
    """Write digital numbers (uint32) of regions, losslessly, and return the file's SHA-256.

    A PNG takes one region, the whole sensor. The file appears whole or not at all. Raises InputError where it cannot be
    written.
    """
    images = stored(images, form)
    if form != "png16":
        return write_exr(path, images, sensor, attributes)
    ((_, image),) = images
    data = _png(image, attributes)
    with whole_file(path) as partial:
        partial.write_bytes(data)
    return hashlib.sha256(data).hexdigest()


def _png(image: NDArray[Any], attributes: Mapping[str, Any]) -> bytes:
    info = PngInfo()
    for name in ATTRIBUTES:
        info.add_text(name, str(attributes[name]))
    buffer = io.BytesIO()
    Picture.fromarray(image).save(buffer, "PNG", pnginfo=info, compress_level=PNG_LEVEL)
    return buffer.getvalue()


def read_frame_parts(path: Path) -> list[ExrPart]:
    """The parts of a frame's file, EXR or PNG. Raises InputError where it cannot be read."""
    if path.suffix != ".png":
        return read_exr_parts(path)
    try:
        with Picture.open(path, formats=["PNG"]) as picture:
            picture.load()
            image, text = np.asarray(picture), {str(name): value for name, value in picture.info.items()}
    except (OSError, ValueError, SyntaxError, Picture.DecompressionBombError) as error:
        raise InputError(f"{path}: cannot be read as a PNG: {error}") from None
    if image.ndim != 2:
        raise InputError(f"{path}: is no grey PNG")
    sensor = Roi(0, 0, *image.shape)
    return [ExrPart("", sensor, sensor, text, image)]
