"""Verification of a dataset on disk: every file present and intact, and the truth consistent with the LED map."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera, transform
from vlcrender.camera.roi import Roi
from vlcrender.config.toml_model import check
from vlcrender.dataset.exr import ExrPart, read_exr_parts
from vlcrender.dataset.file_settings import FileSettings
from vlcrender.dataset.files import EXPECTED, PREVIEWS, PROCESSED, read_dataset_file, read_sweep_file, sha256_of
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
from vlcrender.dataset.shard import parts_of_frame
from vlcrender.dataset.sweep import SWEEP_FILE, sweep_columns
from vlcrender.dataset.tables import Constants, read_table
from vlcrender.dataset.withheld import withheld_problems
from vlcrender.errors import InputError
from vlcrender.modulation.transmission import Transmitter, led_waves
from vlcrender.modulation.wave import Wave
from vlcrender.scene.leds import transmitters_of
from vlcrender.scene.schema import SceneSettings

R = TypeVar("R", FrameRow, TruthRow)
S = TypeVar("S", DeviceTruthRow, MapTruthRow)
Array = NDArray[np.float64]
Positions = Mapping[int, Array]
"""Centre (3,) of each LED, by id."""
MAX_TIME_ERROR_S = 1e-9
"""Rounding of start times: a double of 10^6 s has steps of 1e-10 s."""
MAX_PHASE_ERROR = 1e-6
"""Rounding of phases, periods: waves of 10 kHz after 10^5 s."""
LINE_ROUNDS = 200
"""Largest number of steps to an image at its own line's time; each divides the error by 2 at least."""


def verify(directory: Path) -> list[str]:
    """Problems of a dataset, or of all cells of a sweep, one line each; empty where it is complete and intact.

    Raises InputError where there is no readable dataset.json or sweep.json, or where a dataset's camera is impossible.
    """
    if not (directory / SWEEP_FILE).is_file():
        return _problems(directory)
    problems = []
    for cell in read_sweep_file(directory).cells:
        folder = directory / cell.folder
        try:
            found = _problems(folder)
            values = read_dataset_file(folder).provenance.get("sweep")
        except InputError as error:
            problems.append(str(error))
            continue
        problems += found
        if values != cell.values:
            problems.append(f"{folder / 'dataset.json'}: its values are {values}; {SWEEP_FILE} has {cell.values}")
    return problems


def _problems(directory: Path) -> list[str]:
    """`verify` of one dataset."""
    dataset = read_dataset_file(directory)
    cameras = {
        name: _camera_of(entry, f"{directory / 'dataset.json'}: camera {name}")
        for name, entry in dataset.cameras.items()
    }
    problems: list[str] = []
    frames = _read_rows(directory / "frames.parquet", FrameRow, range(dataset.frame_count), problems)
    columns = sweep_columns(dataset.provenance.get("sweep") or {})
    problems += withheld_problems(directory, dataset)
    told: Sequence[int] = range(dataset.frame_count)
    if dataset.withheld is not None:
        told = dataset.withheld.frames_with_truth(dataset.frame_count)
    truth: list[TruthRow] = []
    if dataset.withheld is None or dataset.withheld.frames != "all":
        truth = _read_rows(directory / "truth.parquet", TruthRow, told, problems, columns)
    digest, parts_of = cache(sha256_of), lru_cache(maxsize=1)(read_exr_parts)  # frames of a shard follow each other
    for row in frames:
        problems += _frame_problems(directory, row, dataset, digest, parts_of)
    recipe = dataset.provenance.get("recipe", {})
    maps: dict[int, Positions] = {}
    if dataset.led_map is not None:
        maps[0] = {led.id: np.array(led.position_m) for led in dataset.led_map}
    devices: list[DeviceTruthRow] | None = None
    if recipe.get("belief") is not None:
        devices = _read_sealed(directory / "truth_devices.parquet", DeviceTruthRow, problems)
    if dataset.withheld is None and (recipe.get("belief") is not None or dataset.led_map is None):
        built = _read_sealed(directory / "truth_map.parquet", MapTruthRow, problems)
        problems += _sealed_problems(devices, built, dataset)
        maps = {}
        for led in built:
            maps.setdefault(led.map, {})[led.led] = np.array(led.position_m)  # type: ignore[index]
    files = check(recipe.get("files", {}), FileSettings, "dataset.json: provenance.recipe.files")
    folders = extra_folders(bool(recipe.get("expected")), recipe.get("processed") is not None, files)
    missing = missing_files(directory, folders, range(dataset.frame_count), files)
    problems += [f"{path}: is missing" for path in missing.values()]
    problems += _time_problems(frames, dataset)
    waves = cache(partial(_waves_of, dataset))
    for pose in truth:
        number = pose.frame
        if frames and dataset.withheld is None:  # the waves follow from the seed, which is withheld too
            problems += _wave_problems(pose, frames[number].start_s, waves(pose.map))
        name = frames[number].camera if frames else None
        entry = dataset.cameras.get(name) if name is not None else None
        if name is None or entry is None:
            problems += _truth_problems(pose, None, maps, np.zeros(3))
            continue
        problems += _device_problems(frames[number], pose, entry, dataset, devices)
        try:
            camera = cameras[name] if _is_told(pose, entry) else _true_camera_of(entry, pose)
        except InputError as error:
            problems.append(str(error))
            continue
        offset = _offset_in_camera(frames[number], entry, devices)
        problems += _truth_problems(pose, camera, maps, offset)
    return problems


def extra_folders(expected: bool, processed: bool, files: FileSettings) -> list[str]:
    """Folders that hold one file a frame beside `frames`."""
    wanted = ((PREVIEWS, files.has_preview(0)), (EXPECTED, expected), (PROCESSED, processed))
    return [folder for folder, is_wanted in wanted if is_wanted]


def missing_files(
    directory: Path, folders: Iterable[str], frames: Iterable[int], files: FileSettings
) -> dict[int, Path]:
    """Frames without a file in one of the folders -> the first file that is missing (path without suffix)."""
    missing: dict[int, Path] = {}
    numbers = list(frames)
    for folder in folders:
        present = {path.stem for path in (directory / folder).glob("*") if path.suffix != ".partial"}
        for frame in numbers:
            if f"{frame:06d}" not in present and (folder != PREVIEWS or files.has_preview(frame)):
                missing.setdefault(frame, directory / folder / f"{frame:06d}")
    return missing


def _camera_of(entry: CameraEntry, source: str) -> Camera:
    """A camera that images points as the entry says. `source` names it in the InputError for an impossible one."""
    (fx, skew, u), (_, fy, v), _ = entry.K
    shared = entry.model_dump(
        include={"width_px", "height_px", "pixel_pitch_um", "projection", "distortion", "shutter"}
    )
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


def _read_rows(
    path: Path, model: type[R], numbers: Sequence[int], problems: list[str], constants: Constants | None = None
) -> list[R]:
    """Rows of a table; none, and a line in `problems`, where the table is damaged."""
    try:
        rows = read_table(path, model, constants)
    except InputError as error:
        problems.append(str(error))
        return []
    if [row.frame for row in rows] != list(numbers):
        expected = f"frames 0 to {len(numbers) - 1}" if isinstance(numbers, range) else f"{len(numbers)} frames"
        problems.append(f"{path}: {len(rows)} rows; {expected} in order are expected")
        return []
    return rows


def _frame_problems(
    directory: Path,
    row: FrameRow,
    dataset: DatasetFile,
    digest: Callable[[Path], str],
    parts_of: Callable[[Path], list[ExrPart]],
) -> list[str]:
    path = directory / row.file
    if row.camera not in dataset.cameras:
        return [f"{directory / 'frames.parquet'}: frame {row.frame}: camera {row.camera!r} is not in dataset.json"]
    if not path.is_file():
        return [f"{path}: is missing"]
    if digest(path) != row.sha256:
        return [f"{path}: SHA-256 differs from frames.parquet: the file was changed or truncated"]
    camera = dataset.cameras[row.camera]
    sensor = Roi(0, 0, camera.height_px, camera.width_px)
    try:
        parts = parts_of(path)
    except InputError as error:
        return [str(error)]
    if row.part is not None:
        parts = parts_of_frame(parts, row.frame, row.part)
        if not parts:
            return [f"{path}: part {row.part} is not the first one of frame {row.frame}"]
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
    devices: Sequence[DeviceTruthRow] | None, built: Sequence[MapTruthRow], dataset: DatasetFile
) -> list[str]:
    """Rows of the sealed tables that are missing, repeated or out of order. A table without rows has a line already."""
    belief = dataset.provenance["recipe"].get("belief") or {"devices": 0, "maps": 1}
    problems = []
    expected = [(device, camera) for device in range(belief["devices"]) for camera in dataset.cameras]
    if devices and [(row.device, row.camera) for row in devices] != expected:
        problems.append("truth_devices.parquet: has not one row for each device and camera, in order")
    ids = sorted(led for transmitter in _transmitters_of(dataset) for led in transmitter.led_ids)
    leds = [(number, led) for number in range(belief["maps"]) for led in ids]
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


def _time_problems(frames: Sequence[FrameRow], dataset: DatasetFile) -> list[str]:
    """Contradictions of bursts, start times, gyroscope and decoded identities with the recipe."""
    recipe = dataset.provenance.get("recipe", {})
    burst = recipe.get("burst") or {"frames": 1, "frame_rate_hz": 1.0}
    by_pixels = dataset.downlink is not None and dataset.downlink.demodulation == "pixels"
    first_s: dict[int, float] = {}
    problems = []
    for row in frames:
        where = f"frames.parquet: frame {row.frame}"
        if row.burst != row.shot // burst["frames"]:
            problems.append(f"{where}: burst {row.burst}, but a burst has {burst['frames']} shots")
        later_s = row.shot % burst["frames"] / burst["frame_rate_hz"]
        start_s = first_s.setdefault(row.burst, row.start_s - later_s)
        if not abs(row.start_s - start_s - later_s) <= MAX_TIME_ERROR_S:
            problems.append(f"{where}: start_s = {row.start_s}: is not {later_s} s after the start of its burst")
        if (row.gyro_rad_s is None) != (dataset.gyroscope is None):
            problems.append(f"{where}: gyro_rad_s and the gyroscope of dataset.json: one is null")
        if by_pixels and row.spots:
            problems.append(f'{where}: has spots, but demodulation is "pixels"')
    starts_s = [first_s[number] for number in sorted(first_s)]
    if any(starts_s) and any(later <= before for before, later in pairwise(starts_s)):
        problems.append("frames.parquet: bursts do not start one after another")
    return problems


def _waves_of(dataset: DatasetFile, map_number: int) -> dict[int, Wave]:
    """The waves of a map's LEDs, from the scene and the seed."""
    transmitters = _transmitters_of(dataset)
    return led_waves(transmitters, int(dataset.provenance["recipe"]["seed"]), map_number) if transmitters else {}


def _transmitters_of(dataset: DatasetFile) -> tuple[Transmitter, ...]:
    """What LEDs transmit by the scene of the provenance; nothing where there is none."""
    scene = dataset.provenance.get("scene")
    return () if scene is None else transmitters_of(check(scene, SceneSettings, "dataset.json: provenance.scene"))


def _wave_problems(row: TruthRow, start_s: float, waves: Mapping[int, Wave]) -> list[str]:
    """LEDs whose clock error, bits or phase at the start of the frame are not those of their wave."""
    problems = []
    for led in row.leds:
        where = f"truth.parquet: frame {row.frame}: LED {led.led}"
        wave = waves.get(led.led)
        if wave is None:
            if (led.clock_error, led.phase, led.bits) != (None, None, None):
                problems.append(f"{where}: is steady, but clock_error, phase and bits are not null")
        elif led.clock_error is None or led.phase is None:
            problems.append(f"{where}: is modulated, but clock_error or phase is null")
        else:
            off = abs(led.phase - float(wave.phase(start_s)))
            if not min(off, 1 - off) <= MAX_PHASE_ERROR or (led.clock_error, led.bits) != (wave.clock_error, wave.bits):
                problems.append(f"{where}: clock_error, phase or bits are not those of its wave")
    return problems


def _offset_in_camera(frame: FrameRow, entry: CameraEntry, devices: Sequence[DeviceTruthRow] | None) -> Array:
    """From the projection centre of `main` to that of a frame's camera, (3,), in the camera's axes."""
    rotation, offset_m = np.array(entry.R_cam_rig), np.array(entry.offset_m)
    for row in devices or ():
        if (row.device, row.camera) == (frame.device, frame.camera):
            rotation, offset_m = np.array(row.R_cam_rig).reshape(3, 3), np.array(row.offset_m)
    return transform(rotation, offset_m)


def _image_at_own_line(row: TruthRow, camera: Camera, offset_m: Array, point_m: Array) -> Array:
    """Pixel (2,) of a world point at the time of its own line; `offset_m` of `_offset_in_camera`.

    The camera `main` moves along a line, and the rig turns about it.
    """
    rotation, position_m = np.array(row.R_cam_world).reshape(3, 3), np.array(row.position_m)
    turning, moving = (np.array(v or (0.0, 0.0, 0.0)) for v in (row.angular_velocity_rad_s, row.linear_velocity_m_s))
    of_main = moving - transform(rotation.T, np.cross(turning, offset_m))

    def image(time_s: float) -> Array:
        turned = transform(Rotation.from_rotvec(-turning * time_s).as_matrix(), rotation.T).T
        swing = transform(turned.T, offset_m) - transform(rotation.T, offset_m)
        return camera.image_of_points(transform(turned, point_m - (position_m + of_main * time_s + swing)))

    pixel = image(0.0)
    if row.angular_velocity_rad_s is not None:
        for _ in range(LINE_ROUNDS):
            before, pixel = pixel, image(float(camera.times_s(*pixel)))
            if not np.abs(pixel - before).max() > 1e-9:
                break
    return pixel


def _truth_problems(row: TruthRow, camera: Camera | None, maps: Mapping[int, Positions], offset_m: Array) -> list[str]:
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
        u, v = _image_at_own_line(row, camera, offset_m, positions[led.led])
        # Not `>`: a point that the lens does not image has NaN pixels, which compare false.
        if not np.hypot(u - led.u_px, v - led.v_px) <= 1e-6:
            return [f"{where}: LED {led.led} is not where the pose puts it"]
    return []
