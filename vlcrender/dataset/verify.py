"""Whether a dataset on disk is all there and intact, and its truth agrees with itself."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vlcrender.camera.intrinsics import Camera, transform
from vlcrender.camera.roi import Roi
from vlcrender.config.toml_model import check
from vlcrender.dataset.files import (
    EXPECTED,
    FRAMES_SCHEMA,
    MAY_BE_EMPTY,
    PREVIEWS,
    PROCESSED,
    TRUTH_SCHEMA,
    CameraEntry,
    DatasetFile,
    read_dataset_file,
    read_exr_parts,
    sha256_of,
)
from vlcrender.errors import InputError


def problems_of(directory: Path) -> list[str]:
    """All that is missing or damaged in a dataset, a line each; empty where all is there and intact.

    Raises InputError where there is no readable dataset.json, or a camera in it cannot be.
    """
    dataset = read_dataset_file(directory)
    cameras = {
        name: _camera_of(entry, f"{directory / 'dataset.json'}: camera {name}")
        for name, entry in dataset.cameras.items()
    }
    found: list[str] = []
    frames = _read_rows(directory / "frames.parquet", FRAMES_SCHEMA, dataset.frame_count, found)
    truth = _read_rows(directory / "truth.parquet", TRUTH_SCHEMA, dataset.frame_count, found)
    for row in frames:
        found += _problems_of_frame(directory, row, dataset)
    recipe = dataset.provenance.get("recipe", {})
    folders = folders_of(bool(recipe.get("expected")), recipe.get("processed") is not None)
    found += [f"{path}: is missing" for path in missing_files(directory, folders, range(dataset.frame_count)).values()]
    for row in truth:
        camera = cameras.get(frames[row["frame"]]["camera"]) if frames else None
        found += _problems_of_truth(row, camera, dataset)
    return found


def folders_of(expected: bool, processed: bool) -> list[str]:
    """Folders that hold a file of each frame beside `frames`."""
    return [PREVIEWS, *([EXPECTED] if expected else []), *([PROCESSED] if processed else [])]


def missing_files(directory: Path, folders: Iterable[str], frames: Iterable[int]) -> dict[int, Path]:
    """Frames that lack a file in one of the folders, each with the first that it lacks (less its ending)."""
    missing: dict[int, Path] = {}
    numbers = list(frames)
    for folder in folders:
        there = {path.stem for path in (directory / folder).glob("*") if path.suffix != ".partial"}
        for frame in numbers:
            if f"{frame:06d}" not in there:
                missing.setdefault(frame, directory / folder / f"{frame:06d}")
    return missing


def _camera_of(entry: CameraEntry, source: str) -> Camera:
    """A camera that images points as the entry says. `source` names it in the InputError for one that cannot be."""
    (_, skew, u), (_, _, v), _ = entry.K
    shared = entry.model_dump(include={"width_px", "height_px", "pixel_pitch_um", "projection", "distortion"})
    # Focused at infinity, a lens has its focal length for image distance, which is all that a projection takes.
    lens = {"focal_length_mm": entry.image_distance_mm, "principal_point_px": (u, v), "skew_px": skew}
    camera = check({**shared, **lens}, Camera, source)
    if not np.allclose(camera.matrix, entry.K, rtol=1e-12, atol=0):
        raise InputError(
            f"{source}: K is not [[f, skew, cx], [0, f, cy], [0, 0, 1]] with f = image_distance_mm / pitch"
        )
    return camera


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
    nulls = [name for name in table.column_names if table[name].null_count and name not in MAY_BE_EMPTY]
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
    sensor = Roi(0, 0, camera.height_px, camera.width_px)
    try:
        parts = read_exr_parts(path)
    except InputError as error:
        return [str(error)]
    regions = [part.roi for part in parts]
    if not parts or any(part.dtype != np.uint32 or part.sensor != sensor for part in parts):
        return [f"{path}: is not uint32 of a sensor of {camera.height_px, camera.width_px} pixels in every part"]
    if any(a.overlaps(b) for i, a in enumerate(regions) for b in regions[:i]):
        return [f"{path}: has windows that overlap"]
    if row["capturable"] != all(sensor.contains(roi) for roi in regions):
        return [f"{path}: capturable is {row['capturable']}, but its windows say otherwise"]
    return []


def _problems_of_truth(row: Mapping[str, Any], camera: Camera | None, dataset: DatasetFile) -> list[str]:
    where = f"truth.parquet: frame {row['frame']}"
    rotation = np.array(row["R_cam_world"]).reshape(3, 3)
    if not (np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) and np.linalg.det(rotation) > 0):
        return [f"{where}: R_cam_world is not a rotation"]
    if camera is None:
        return []
    positions = {led.id: np.array(led.position_m) for led in dataset.led_map}
    for led in row["leds"]:
        if led["led"] not in positions:
            return [f"{where}: LED {led['led']} is not in the LED map"]
        u, v = camera.image_of_points(transform(rotation, positions[led["led"]] - np.array(row["position_m"])))
        # Not `>`: what the lens does not image has no pixel, and NaN is not above anything.
        if not np.hypot(u - led["u_px"], v - led["v_px"]) <= 1e-6:
            return [f"{where}: LED {led['led']} is not where the pose puts it"]
    return []
