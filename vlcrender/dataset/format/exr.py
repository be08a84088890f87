"""EXR files of frames: regions of a sensor as parts, with the standard attributes of the exposure."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.core.digest import sha256_of
from vlcrender.dataset.format.files import partial_of, replace_durably
from vlcrender.errors import InputError


def write_exr(path: Path, images: Sequence[RegionImage], sensor: Roi, attributes: Mapping[str, Any]) -> str:
    """Write regions of a sensor, one channel (Y), losslessly, and return the file's SHA-256.

    The file appears whole or not at all. Raises InputError where it cannot be written.
    """
    names = [f"region {number}" for number in range(len(images))] if len(images) > 1 else [""]
    partial = partial_of(path)
    try:
        OpenEXR.File(_parts(images, sensor, attributes, names)).write(str(partial))
    except RuntimeError as error:  # OpenEXR raises it for a full disk as well
        partial.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written: {' '.join(str(error).split())}") from None
    digest = sha256_of(partial)
    replace_durably(partial, path)
    return digest


def exr_bytes(images: Sequence[RegionImage], sensor: Roi, attributes: Mapping[str, Any], names: Sequence[str]) -> bytes:
    """The file of `write_exr` with these names of its parts, not written."""
    buffer = io.BytesIO()
    OpenEXR.File(_parts(images, sensor, attributes, names)).write(buffer)
    return buffer.getvalue()


def _parts(
    images: Sequence[RegionImage], sensor: Roi, attributes: Mapping[str, Any], names: Sequence[str]
) -> list[OpenEXR.Part]:
    full = [roi for roi, _ in images] == [sensor]
    header = {
        # With ZIP regions are written in a quarter of the time, and read in less than half; full frames are not.
        "compression": OpenEXR.PIZ_COMPRESSION if full else OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "displayWindow": _box(sensor),
        **attributes,
    }
    return [
        OpenEXR.Part({**header, "dataWindow": _box(roi)}, {"Y": np.ascontiguousarray(image)}, name)
        for name, (roi, image) in zip(names, images, strict=True)
    ]


def _box(roi: Roi) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """First and last pixel, (column, row) each: EXR's Box2i."""
    first = np.array([roi.column, roi.row], dtype=np.int32)
    return first, first + np.array([roi.columns - 1, roi.rows - 1], dtype=np.int32)


@dataclass(frozen=True)
class ExrPart:
    """One part of an EXR file: its name, its region, the whole sensor, its header and its pixels."""

    name: str
    roi: Roi
    sensor: Roi
    attributes: Mapping[str, Any]
    image: NDArray[Any] = field(compare=False)
    """Channel Y, (rows, columns)."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of its pixels."""
        return self.image.dtype

    @property
    def largest(self) -> float:
        """Largest value of its pixels."""
        return float(self.image.max())


def read_exr_parts(path: Path) -> list[ExrPart]:
    """The parts of a frame's file.

    Raises InputError where it cannot be read, or a part has not scan lines with the channel Y alone.
    """
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            count = len(file.parts)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = [_part(part) for part in file.parts]
        if len(parts) != count:  # the decoder drops unreadable parts silently
            raise ValueError(f"{len(parts)} of {count} parts")
        return parts
    except (RuntimeError, KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as an EXR with a channel Y: {error}") from None


def _part(part: OpenEXR.Part) -> ExrPart:
    """Raises ValueError for a part of other than scan lines of Y, one value for each place of the data window."""
    if part.header["type"] != OpenEXR.scanlineimage:
        raise ValueError("not stored as scan lines")
    if list(part.channels) != ["Y"]:
        raise ValueError(f"channels {', '.join(part.channels)}, needed Y alone")
    pixels, roi = part.channels["Y"].pixels, _roi(part.header["dataWindow"])
    if pixels is None or pixels.shape != (roi.rows, roi.columns):
        raise ValueError("Y has not one value for each pixel")
    sensor = _roi(part.header["displayWindow"])
    return ExrPart(part.header.get("name", ""), roi, sensor, dict(part.header), pixels)


def _roi(box: tuple[NDArray[np.int32], NDArray[np.int32]]) -> Roi:
    (column, row), (last_column, last_row) = (end.tolist() for end in box)
    return Roi(row, column, last_row - row + 1, last_column - column + 1)


def exr_attributes(camera: Camera, camera_name: str, exposure_s: float, frame: int) -> dict[str, Any]:
    """Standard EXR attributes of a frame; nothing about the pose."""
    size_mm = np.array([camera.width_px, camera.height_px]) * camera.pixel_pitch_um / 1000
    return {
        "expTime": float(exposure_s),
        "aperture": float(camera.f_number),
        "nominalFocalLength": float(camera.focal_length_mm),
        "sensorPhotositePitch": float(camera.pixel_pitch_um),
        "sensorOverallDimensions": size_mm.astype(np.float32),
        "vlcrender:frame": str(frame),
        "vlcrender:camera": camera_name,
    }
