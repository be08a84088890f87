"""The dataset on disk, as datasets/FORMAT.md says: writing it, and verifying that all is there and intact."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import OpenEXR
import pyarrow as pa
import pyarrow.parquet as pq
from matplotlib.image import imsave
from numpy.typing import NDArray

from vlcrender.camera import Camera
from vlcrender.errors import InputError
from vlcrender.scene import Leds
from vlcrender.settings import Settings, check

PREVIEW_WIDTH_PX = 800
SPOT = pa.struct([("led", pa.int64()), ("u_px", pa.float64()), ("v_px", pa.float64())])
FRAMES_SCHEMA = pa.schema(
    [
        ("frame", pa.int64()),
        ("file", pa.string()),
        ("sha256", pa.string()),
        ("camera", pa.string()),
        ("exposure_s", pa.float64()),
        ("accelerometer_m_s2", pa.list_(pa.float64(), 3)),
        ("spots", pa.list_(SPOT)),
    ]
)
TRUTH_SCHEMA = pa.schema(
    [
        ("frame", pa.int64()),
        ("position_m", pa.list_(pa.float64(), 3)),
        ("R_cam_world", pa.list_(pa.float64(), 9)),
        ("tilt_x_deg", pa.float64()),
        ("tilt_y_deg", pa.float64()),
        ("yaw_deg", pa.float64()),
        ("leds", pa.list_(pa.struct([*SPOT, ("visible_fraction", pa.float64())]))),
    ]
)


class CameraEntry(Settings):
    """A camera in dataset.json."""

    width_px: int
    height_px: int
    K: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    pixel_pitch_um: float
    focal_length_mm: float
    f_number: float


class SensorEntry(Settings):
    """The sensor in dataset.json."""

    bits: int
    gain_e_per_dn: float
    full_well_e: float
    black_level_dn: int
    noise: str


class AccelerometerEntry(Settings):
    """The accelerometer in dataset.json."""

    error_deg: float


class LedMapEntry(Settings):
    """What one LED sends of itself."""

    id: int
    position_m: tuple[float, float, float]
    radius_m: float


class DatasetFile(Settings):
    """dataset.json."""

    format: Literal["vlcrender-dataset"]
    version: Literal[1]
    name: str
    frame_count: int
    cameras: dict[str, CameraEntry]
    sensor: SensorEntry
    accelerometer: AccelerometerEntry
    led_map: tuple[LedMapEntry, ...]
    room_m: tuple[float, float, float]
    provenance: dict[str, Any]


def camera_entry(camera: Camera) -> CameraEntry:
    """A camera as dataset.json tells of it."""
    rows = [tuple(map(float, row)) for row in camera.matrix]
    return CameraEntry.model_validate({"K": rows, **camera.model_dump(include=set(CameraEntry.model_fields) - {"K"})})


def led_map(leds: Leds) -> tuple[LedMapEntry, ...]:
    """The LEDs as dataset.json tells of them."""
    return tuple(
        LedMapEntry(id=int(i), position_m=(float(c[0]), float(c[1]), float(c[2])), radius_m=float(r))
        for i, c, r in zip(leds.ids, leds.centers_m, leds.radii_m, strict=True)
    )


def write_exr(path: Path, image: NDArray[np.uint32] | NDArray[np.float32], attributes: Mapping[str, Any]) -> str:
    """Write a one-channel (Y) image losslessly and return the file's SHA-256.

    The file appears whole or not at all. Raises InputError where it cannot be written.
    """
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    partial = path.with_suffix(".partial")
    try:
        OpenEXR.File(header, {"Y": np.ascontiguousarray(image)}).write(str(partial))
    except RuntimeError as error:  # OpenEXR's word for a full disk as well
        partial.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written: {' '.join(str(error).split())}") from None
    digest = sha256_of(partial)
    os.replace(partial, path)
    return digest


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


def write_preview(path: Path, image: NDArray[np.uint32], largest_dn: int) -> None:
    """Write a small grey picture: block means, gamma 2.2, white at the converter's largest number."""
    block = max(1, -(-image.shape[1] // PREVIEW_WIDTH_PX))
    rows, columns = (size // block * block for size in image.shape)
    small = image[:rows, :columns].reshape(rows // block, block, columns // block, block).mean(axis=(1, 3))
    imsave(path, (np.clip(small / largest_dn, 0, 1)) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], schema: pa.Schema) -> None:
    """Write a Parquet table; it appears whole or not at all."""
    partial = path.with_suffix(".partial")
    pq.write_table(pa.Table.from_pylist(list(rows), schema=schema), partial)
    os.replace(partial, path)


def write_json(path: Path, tree: Mapping[str, Any]) -> None:
    """Write JSON; it appears whole or not at all."""
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(tree, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(partial, path)


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


def problems_of(directory: Path) -> list[str]:
    """All that is missing or damaged in a dataset, a line each; empty where all is there and intact.

    Raises InputError where there is no readable dataset.json.
    """
    dataset = read_dataset_file(directory)
    found: list[str] = []
    frames = _read_rows(directory / "frames.parquet", FRAMES_SCHEMA, dataset.frame_count, found)
    truth = _read_rows(directory / "truth.parquet", TRUTH_SCHEMA, dataset.frame_count, found)
    for row in frames:
        found += _problems_of_frame(directory, row, dataset)
    for row in truth:
        found += _problems_of_truth(row, frames[row["frame"]] if frames else None, dataset)
    return found


def _read_rows(path: Path, schema: pa.Schema, count: int, found: list[str]) -> list[dict[str, Any]]:
    if not path.is_file():
        found.append(f"{path}: is missing")
        return []
    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError, ValueError) as error:
        found.append(f"{path}: cannot be read as Parquet: {str(error).splitlines()[0]}")
        return []
    if not table.schema.equals(schema):
        expected, got = set(map(str, schema)), set(map(str, table.schema))
        found.append(f"{path}: columns differ from FORMAT.md: {', '.join(sorted(expected ^ got)) or 'their order'}")
        return []
    rows: list[dict[str, Any]] = table.to_pylist()
    if [row["frame"] for row in rows] != list(range(count)):
        found.append(f"{path}: {len(rows)} rows; frames 0 to {count - 1} in order are expected")
        return []
    nulls = [name for name in table.column_names if table[name].null_count]
    if nulls:
        found.append(f"{path}: column {nulls[0]} has empty cells")
        return []
    return rows


def _problems_of_frame(directory: Path, row: Mapping[str, Any], dataset: DatasetFile) -> list[str]:
    path = directory / row["file"]
    if row["camera"] not in dataset.cameras:
        return [
            f"{directory / 'frames.parquet'}: frame {row['frame']}: camera {row['camera']!r} is not in dataset.json"
        ]
    if not path.is_file():
        return [f"{path}: is missing"]
    if sha256_of(path) != row["sha256"]:
        return [f"{path}: its SHA-256 is not the one in frames.parquet: the file was changed or cut short"]
    camera = dataset.cameras[row["camera"]]
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            pixels = file.channels()["Y"].pixels
    except (RuntimeError, KeyError, ValueError, TypeError) as error:
        return [f"{path}: cannot be read as an EXR with a channel Y: {error}"]
    if pixels.shape != (camera.height_px, camera.width_px) or pixels.dtype != np.uint32:
        return [f"{path}: is {pixels.dtype} {pixels.shape}; uint32 {camera.height_px, camera.width_px} is expected"]
    return []


def _problems_of_truth(row: Mapping[str, Any], frame: Mapping[str, Any] | None, dataset: DatasetFile) -> list[str]:
    where = f"truth.parquet: frame {row['frame']}"
    rotation = np.array(row["R_cam_world"]).reshape(3, 3)
    if not (np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) and np.linalg.det(rotation) > 0):
        return [f"{where}: R_cam_world is not a rotation"]
    if frame is None or frame["camera"] not in dataset.cameras:
        return []
    matrix = np.array(dataset.cameras[frame["camera"]].K)
    positions = {led.id: np.array(led.position_m) for led in dataset.led_map}
    for led in row["leds"]:
        if led["led"] not in positions:
            return [f"{where}: LED {led['led']} is not in the LED map"]
        u, v, w = matrix @ rotation @ (positions[led["led"]] - np.array(row["position_m"]))
        if np.hypot(u / w - led["u_px"], v / w - led["v_px"]) > 1e-6:
            return [f"{where}: LED {led['led']} is not where the pose puts it"]
    return []
