"""Verification of a dataset on disk: every file present and intact, and the truth consistent with the LED map."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera, transform
from vlcrender.camera.roi import Roi
from vlcrender.config.toml_model import check
from vlcrender.dataset.exr import read_exr_parts
from vlcrender.dataset.files import EXPECTED, PREVIEWS, PROCESSED, read_dataset_file, sha256_of
from vlcrender.dataset.schema import (
    CameraEntry,
    DatasetFile,
    DeviceTruthRow,
    FrameRow,
    MapTruthRow,
    TruthRow,
    five,
    flat9,
)
from vlcrender.dataset.tables import read_table
from vlcrender.errors import InputError

R = TypeVar("R", FrameRow, TruthRow)
S = TypeVar("S", DeviceTruthRow, MapTruthRow)
Positions = Mapping[int, NDArray[np.float64]]
"""Centre (3,) of each LED, by id."""


def verify(directory: Path) -> list[str]:
    """Problems of a dataset, one line each; empty where it is complete and intact.

    Raises InputError where there is no readable dataset.json, or where one of its cameras is impossible.
    """
    dataset = read_dataset_file(directory)
    cameras = {
        name: _camera_of(entry, f"{directory / 'dataset.json'}: camera {name}")
        for name, entry in dataset.cameras.items()
    }
    problems: list[str] = []
    frames = _read_rows(directory / "frames.parquet", FrameRow, dataset.frame_count, problems)
    truth = _read_rows(directory / "truth.parquet", TruthRow, dataset.frame_count, problems)
    for row in frames:
        problems += _frame_problems(directory, row, dataset)
    recipe = dataset.provenance.get("recipe", {})
    maps: dict[int, Positions] = {0: {led.id: np.array(led.position_m) for led in dataset.led_map or ()}}
    devices: list[DeviceTruthRow] | None = None
    if recipe.get("belief") is not None:
        devices = _read_sealed(directory / "truth_devices.parquet", DeviceTruthRow, problems)
        built = _read_sealed(directory / "truth_map.parquet", MapTruthRow, problems)
        problems += _sealed_problems(devices, built, dataset)
        maps = {}
        for led in built:
            maps.setdefault(led.map, {})[led.led] = np.array(led.position_m)  # type: ignore[index]
    folders = extra_folders(bool(recipe.get("expected")), recipe.get("processed") is not None)
    missing = missing_files(directory, folders, range(dataset.frame_count))
    problems += [f"{path}: is missing" for path in missing.values()]
    for number, pose in enumerate(truth):
        name = frames[number].camera if frames else None
        entry = dataset.cameras.get(name) if name is not None else None
        if name is None or entry is None:
            problems += _truth_problems(pose, None, maps)
            continue
        problems += _device_problems(frames[number], pose, entry, dataset, devices)
        try:
            camera = cameras[name] if _is_told(pose, entry) else _true_camera_of(entry, pose)
        except InputError as error:
            problems.append(str(error))
            continue
        problems += _truth_problems(pose, camera, maps)
    return problems


def extra_folders(expected: bool, processed: bool) -> list[str]:
    """Folders that hold one file for each frame beside `frames`."""
    return [PREVIEWS, *([EXPECTED] if expected else []), *([PROCESSED] if processed else [])]


def missing_files(directory: Path, folders: Iterable[str], frames: Iterable[int]) -> dict[int, Path]:
    """Frames without a file in one of the folders -> the first file that is missing (path without suffix)."""
    missing: dict[int, Path] = {}
    numbers = list(frames)
    for folder in folders:
        present = {path.stem for path in (directory / folder).glob("*") if path.suffix != ".partial"}
        for frame in numbers:
            if f"{frame:06d}" not in present:
                missing.setdefault(frame, directory / folder / f"{frame:06d}")
    return missing


def _camera_of(entry: CameraEntry, source: str) -> Camera:
    """A camera that images points as the entry says. `source` names it in the InputError for an impossible one."""
    (fx, skew, u), (_, fy, v), _ = entry.K
    shared = entry.model_dump(include={"width_px", "height_px", "pixel_pitch_um", "projection", "distortion"})
    # A lens focused at infinity has its image distance as focal length, and a projection uses nothing else.
    lens = {"focal_length_mm": entry.image_distance_mm, "principal_point_px": (u, v), "skew_px": skew}
    lens |= {"aspect_ratio": fx / fy if fy > 0 else 1.0}
    camera = check({**shared, **lens}, Camera, source)
    if not np.allclose(camera.matrix, entry.K, rtol=1e-12, atol=0):
        raise InputError(
            f"{source}: K is not [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with the mean of fx and fy "
            "image_distance_mm / pitch"
        )
    return camera


def _is_told(row: TruthRow, entry: CameraEntry) -> bool:
    """Whether a frame's true camera is the told one."""
    return (row.K, row.distortion) == (flat9(np.array(entry.K)), five(entry.distortion))


def _true_camera_of(entry: CameraEntry, row: TruthRow) -> Camera:
    """The true camera of a frame. Raises InputError for an impossible one."""
    fx, _, _, _, fy, *_ = row.K
    changes: dict[str, object] = {
        "K": (row.K[:3], row.K[3:6], row.K[6:]),
        "image_distance_mm": (fx + fy) / 2 * entry.pixel_pitch_um / 1000,
        "distortion": None,
    }
    if row.distortion is not None:
        k1, k2, k3, p1, p2 = row.distortion
        changes["distortion"] = Distortion.model_construct(k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)
    return _camera_of(entry.model_copy(update=changes), f"truth.parquet: frame {row.frame}")


def _read_rows(path: Path, model: type[R], count: int, problems: list[str]) -> list[R]:
    """Rows of a table; none, and a line in `problems`, where the table is damaged."""
    try:
        rows = read_table(path, model)
    except InputError as error:
        problems.append(str(error))
        return []
    if [row.frame for row in rows] != list(range(count)):
        problems.append(f"{path}: {len(rows)} rows; frames 0 to {count - 1} in order are expected")
        return []
    return rows


def _frame_problems(directory: Path, row: FrameRow, dataset: DatasetFile) -> list[str]:
    path = directory / row.file
    if row.camera not in dataset.cameras:
        return [f"{directory / 'frames.parquet'}: frame {row.frame}: camera {row.camera!r} is not in dataset.json"]
    if not path.is_file():
        return [f"{path}: is missing"]
    if sha256_of(path) != row.sha256:
        return [f"{path}: SHA-256 differs from frames.parquet: the file was changed or truncated"]
    camera = dataset.cameras[row.camera]
    sensor = Roi(0, 0, camera.height_px, camera.width_px)
    try:
        parts = read_exr_parts(path)
    except InputError as error:
        return [str(error)]
    regions = [part.roi for part in parts]
    if not parts or any(part.dtype != np.uint32 or part.sensor != sensor for part in parts):
        return [f"{path}: a part is not uint32 of a sensor of {camera.height_px, camera.width_px} pixels"]
    if any(a.overlaps(b) for i, a in enumerate(regions) for b in regions[:i]):
        return [f"{path}: regions overlap"]
    if row.capturable != all(sensor.contains(roi) for roi in regions):
        return [f"{path}: capturable is {row.capturable}, which its regions contradict"]
    return []


def _read_sealed(path: Path, model: type[S], problems: list[str]) -> list[S]:
    """Rows of a sealed table; none, and a line in `problems`, where it is missing or damaged."""
    try:
        return read_table(path, model)
    except InputError as error:
        problems.append(str(error))
        return []


def _sealed_problems(
    devices: Sequence[DeviceTruthRow], built: Sequence[MapTruthRow], dataset: DatasetFile
) -> list[str]:
    """Rows of the sealed tables that are missing, repeated or out of order. A table without rows has a line already."""
    belief = dataset.provenance["recipe"]["belief"]
    problems = []
    expected = [(device, camera) for device in range(belief["devices"]) for camera in dataset.cameras]
    if devices and [(row.device, row.camera) for row in devices] != expected:
        problems.append("truth_devices.parquet: has not one row for each device and camera, in order")
    leds = [(number, led.id) for number in range(belief["maps"]) for led in dataset.led_map or ()]
    if built and [(row.map, row.led) for row in built] != leds:
        problems.append("truth_map.parquet: has not one row for each map and LED, in order")
    return problems


def _device_problems(
    frame: FrameRow,
    truth: TruthRow,
    entry: CameraEntry,
    dataset: DatasetFile,
    devices: Sequence[DeviceTruthRow] | None,
) -> list[str]:
    """Contradictions between a frame's device, map and camera and the told camera or, with [belief], `devices`."""
    where = f"truth.parquet: frame {frame.frame}"
    if devices is None:
        if (frame.device, truth.map) != (0, 0):
            return [f"{where}: device {frame.device} and map {truth.map}: both are 0 without [belief]"]
        if not _is_told(truth, entry):
            return [f"{where}: K or distortion differs from dataset.json's, but there is no [belief]"]
        return []
    if not devices:
        return []
    own = [row for row in devices if (row.device, row.camera) == (frame.device, frame.camera)]
    if not own:
        return [f"{where}: device {frame.device} with camera {frame.camera!r} is not in truth_devices.parquet"]
    if truth.map != own[0].map:
        return [f"{where}: map {truth.map}: device {frame.device} works in map {own[0].map}"]
    shot = dataset.provenance["recipe"]["belief"]["shot"]
    same = (truth.K, truth.distortion) == (own[0].K, own[0].distortion)
    if not same and not (shot["focal_percent"] or shot["principal_point_um"]):
        return [f"{where}: K or distortion differs from its device's, but shots have no errors of their own"]
    return []


def _truth_problems(row: TruthRow, camera: Camera | None, maps: Mapping[int, Positions]) -> list[str]:
    where = f"truth.parquet: frame {row.frame}"
    rotation = np.array(row.R_cam_world).reshape(3, 3)
    if not (np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) and np.linalg.det(rotation) > 0):
        return [f"{where}: R_cam_world is not a rotation"]
    if camera is None or row.map not in maps:
        return []
    positions = maps[row.map]
    for led in row.leds:
        if led.led not in positions:
            return [f"{where}: LED {led.led} is not in the LED map"]
        u, v = camera.image_of_points(transform(rotation, positions[led.led] - np.array(row.position_m)))
        # Not `>`: a point that the lens does not image has NaN pixels, which compare false.
        if not np.hypot(u - led.u_px, v - led.v_px) <= 1e-6:
            return [f"{where}: LED {led.led} is not where the pose puts it"]
    return []
