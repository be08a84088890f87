"""The dataset on disk, as datasets/FORMAT.md says: its files, tables and entries."""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import OpenEXR
import pyarrow as pa
import pyarrow.parquet as pq
from matplotlib.image import imsave
from numpy.typing import NDArray

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.rig import Mounted
from vlcrender.camera.roi import Roi
from vlcrender.config.toml_model import Settings, check
from vlcrender.errors import InputError
from vlcrender.scene.leds import Leds

FRAMES, EXPECTED, PREVIEWS, PROCESSED = "frames", "expected", "previews", "processed"
"""Folders with a file of each frame; the last three where asked for."""
PREVIEW_PX = 800
Shown = tuple[Roi, NDArray[np.uint32] | NDArray[np.float32]]
"""A window and its pixels (rows, columns)."""
SPOT = pa.struct([("led", pa.int64()), ("u_px", pa.float64()), ("v_px", pa.float64())])
FRAMES_SCHEMA = pa.schema(
    [
        ("frame", pa.int64()),
        ("shot", pa.int64()),
        ("pose", pa.int64()),
        ("file", pa.string()),
        ("sha256", pa.string()),
        ("camera", pa.string()),
        ("exposure_s", pa.float64()),
        ("capturable", pa.bool_()),
        ("accelerometer_m_s2", pa.list_(pa.float64(), 3)),
        ("spots", pa.list_(SPOT)),
    ]
)
TRUTH_SCHEMA = pa.schema(
    [
        ("frame", pa.int64()),
        ("shot", pa.int64()),
        ("position_m", pa.list_(pa.float64(), 3)),
        ("R_cam_world", pa.list_(pa.float64(), 9)),
        ("tilt_x_deg", pa.float64()),
        ("tilt_y_deg", pa.float64()),
        ("yaw_deg", pa.float64()),
        ("leds", pa.list_(pa.struct([*SPOT, ("visible_fraction", pa.float64())]))),
        ("bound_m2", pa.list_(pa.float64(), 9)),
    ]
)
MAY_BE_EMPTY = {"bound_m2"}
"""Columns that have empty cells where a recipe does not ask for them."""


Row3 = tuple[float, float, float]
Matrix = tuple[Row3, Row3, Row3]


class CameraEntry(Settings):
    """A camera in dataset.json."""

    width_px: int
    height_px: int
    K: Matrix
    pixel_pitch_um: float
    focal_length_mm: float
    image_distance_mm: float
    f_number: float
    projection: Literal["perspective", "equidistant"]
    distortion: Distortion | None
    focus_distance_m: float | Literal["infinity"] | None
    psf: Literal["none", "diffraction", "measured"]
    psf_wavelength_nm: float
    psf_kernel: tuple[tuple[float, ...], ...] | None
    R_cam_rig: Matrix
    offset_m: tuple[float, float, float]


class SensorEntry(Settings):
    """The sensor in dataset.json: what acted on the frames, at the ISO and temperature they were taken at."""

    bits: int
    gain_e_per_dn: float
    full_well_e: float
    black_level_dn: int
    noise: str
    prnu: float
    dark_current_e_s: float
    dsnu_e: float
    read_noise_e: float
    adc_noise_dn: float
    row_offset_e: float
    column_offset_e: float
    mosaic: str


class AccelerometerEntry(Settings):
    """The accelerometer in dataset.json."""

    kind: Literal["tilt-error", "imu"]
    error_deg: float


class LedMapEntry(Settings):
    """What one LED sends of itself."""

    id: int
    position_m: tuple[float, float, float]
    radius_m: float
    shape: Literal["disc", "square"]


class DatasetFile(Settings):
    """dataset.json."""

    format: Literal["vlcrender-dataset"]
    version: Literal[3]
    name: str
    frame_count: int
    cameras: dict[str, CameraEntry]
    sensor: SensorEntry
    accelerometer: AccelerometerEntry
    led_map: tuple[LedMapEntry, ...]
    room_m: tuple[float, float, float]
    provenance: dict[str, Any]


def camera_entry(mounted: Mounted) -> CameraEntry:
    """A camera as dataset.json tells of it."""
    arrays = {"K": mounted.camera.matrix, "R_cam_rig": mounted.rotation, "offset_m": mounted.offset_m}
    own = {"image_distance_mm": mounted.camera.image_distance_mm, **{key: a.tolist() for key, a in arrays.items()}}
    shared = mounted.camera.model_dump(include=set(CameraEntry.model_fields) - set(own))
    return CameraEntry.model_validate({**shared, **own})


def led_map(leds: Leds) -> tuple[LedMapEntry, ...]:
    """The LEDs as dataset.json tells of them."""
    return tuple(
        LedMapEntry(
            id=int(i),
            position_m=(float(c[0]), float(c[1]), float(c[2])),
            radius_m=float(r),
            shape="square" if square else "disc",
        )
        for i, c, r, square in zip(leds.ids, leds.centers_m, leds.half_widths_m, leds.squares, strict=True)
    )


def write_exr(path: Path, images: Sequence[Shown], sensor: Roi, attributes: Mapping[str, Any]) -> str:
    """Write windows of a sensor, one channel (Y), losslessly and return the file's SHA-256.

    The file appears whole or not at all. Raises InputError where it cannot be written.
    """
    header = {
        "compression": OpenEXR.PIZ_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "displayWindow": _box(sensor),
        **attributes,
    }
    names = [f"window {number}" for number in range(len(images))] if len(images) > 1 else [""]
    parts = [
        OpenEXR.Part({**header, "dataWindow": _box(roi)}, {"Y": np.ascontiguousarray(image)}, name)
        for name, (roi, image) in zip(names, images, strict=True)
    ]
    partial = path.with_suffix(".partial")
    try:
        OpenEXR.File(parts).write(str(partial))
    except RuntimeError as error:  # OpenEXR's word for a full disk as well
        partial.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written: {' '.join(str(error).split())}") from None
    digest = sha256_of(partial)
    os.replace(partial, path)
    return digest


def _box(roi: Roi) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """First and last pixel, (column, row) each, as EXR has it."""
    first = np.array([roi.column, roi.row], dtype=np.int32)
    return first, first + np.array([roi.columns - 1, roi.rows - 1], dtype=np.int32)


@dataclass(frozen=True)
class ExrPart:
    """What one part of an EXR file holds: its window, the sensor's, and the type of its pixels."""

    roi: Roi
    sensor: Roi
    dtype: np.dtype[Any]


def read_exr_parts(path: Path) -> list[ExrPart]:
    """The parts of a frame's file. Raises InputError where it cannot be read or lacks the channel Y."""
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return [
                ExrPart(
                    _roi(part.header["dataWindow"]),
                    _roi(part.header["displayWindow"]),
                    part.channels["Y"].pixels.dtype,
                )
                for part in file.parts
            ]
    except (RuntimeError, KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as an EXR with a channel Y: {error}") from None


def _roi(box: tuple[NDArray[np.int32], NDArray[np.int32]]) -> Roi:
    (column, row), (last_column, last_row) = (corner.tolist() for corner in box)
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


def write_preview(path: Path, images: Sequence[Shown], sensor: Roi, white_dn: int, black_dn: int = 0) -> None:
    """Write a small grey picture: block means above the black level, gamma 2.2.

    It shows the sensor and all windows; what was not read out is black.
    """
    whole = sensor
    for roi, _ in images:
        whole = whole.union(roi)
    block = max(1, -(-max(whole.columns, whole.rows) // PREVIEW_PX))
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


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], schema: pa.Schema) -> None:
    """Write a Parquet table; it appears whole or not at all. Raises InputError where it cannot be written."""
    with _whole(path) as partial:
        pq.write_table(pa.Table.from_pylist(list(rows), schema=schema), partial)


def write_json(path: Path, tree: Mapping[str, Any]) -> None:
    """Write JSON; it appears whole or not at all. Raises InputError where it cannot be written."""
    with _whole(path) as partial:
        partial.write_text(json.dumps(tree, indent=1, allow_nan=False) + "\n", encoding="utf-8")


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """Where to write a file that is then put in its place, or is gone where it could not be written."""
    partial = path.with_suffix(".partial")
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written: {error.strerror or first_line(str(error))}") from None


def first_line(text: str) -> str:
    """The first line of a library's many."""
    return (text.splitlines() or [""])[0]


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, 64 hex digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_dataset_file(directory: Path) -> DatasetFile:
    """Read and check dataset.json. Raises InputError."""
    path = directory / "dataset.json"
    if not path.is_file():
        state = "is unfinished; run the same generate again" if (directory / "plan.json").is_file() else "is none"
        raise InputError(f"{directory}: is not a complete dataset (dataset.json is missing: it {state})")
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError, OSError) as error:
        raise InputError(f"{path}: cannot be read as JSON: {error}") from None
    return check(tree, DatasetFile, str(path)) if isinstance(tree, dict) else _refuse(f"{path}: is not a JSON object")


def _refuse(message: str) -> Any:
    raise InputError(message)
