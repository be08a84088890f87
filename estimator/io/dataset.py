"""Reader of a dataset as a device sees it: frames and device knowledge, never the truth (datasets/FORMAT.md)."""

import hashlib
import io
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, Self

import numpy as np
import OpenEXR
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field, Strict, ValidationError, field_validator, model_validator

from estimator.errors import InputError
from estimator.io.camera import Camera
from estimator.io.device import (
    Accelerometer,
    DecodedSpot,
    DeviceFrame,
    Part,
    decoding_problem,
    depth_problem,
    gravity_problem,
    gyro_problem,
    regions_problem,
)
from estimator.io.downlink import Downlink, downlink_problem, spots_problem
from estimator.io.frame_files import FrameFormat, frame_format, numbers_of_exr, numbers_of_png
from estimator.io.led_map import AnyLed, DeviceNumber, Luminaire, MapDatum, leds_by_id, luminaires_by_id
from estimator.io.records import (
    INT64_MAX,
    FrameRow,
    Number,
    Positive,
    Row,
    Triple,
    first_line,
    first_problem,
    iter_rows,
    missing_key,
    row_count,
)
from estimator.io.results import dataset_folder
from estimator.io.sensor import Sensor
from estimator.io.shard import frame_of_shard
from estimator.io.shutter import Gyroscope
from estimator.io.sweep import read_sweep

FORMAT_VERSION = 4
SPOT_TYPE = pa.struct([("led", pa.int64()), ("u_px", pa.float64()), ("v_px", pa.float64())])
FRAME_COLUMNS = {
    "frame": pa.int64(),
    "shot": pa.int64(),
    "pose": pa.int64(),
    "file": pa.string(),
    "sha256": pa.string(),
    "camera": pa.string(),
    "exposure_s": pa.float64(),
    "capturable": pa.bool_(),
    "accelerometer_m_s2": pa.list_(pa.float64()),
    "spots": pa.list_(SPOT_TYPE),
    "device": pa.int64(),
    "burst": pa.int64(),
    "start_s": pa.float64(),
    "gyro_rad_s": pa.list_(pa.float64()),
}
OPTIONAL_FRAME_COLUMNS = {"part": pa.int64(), "split": pa.string()}
"""`part` is null in a set whose files hold one frame each, `split` in a set without a split; sets without are such."""


class FrameRecord(FrameRow):
    """Row of frames.parquet; the columns are in datasets/FORMAT.md."""

    shot: int = Field(ge=0)
    pose: int = Field(ge=0)
    file: str
    sha256: str = Field(pattern="^[0-9a-fA-F]{64}$")
    camera: str
    exposure_s: Positive
    capturable: bool
    accelerometer_m_s2: Triple | None
    spots: Annotated[tuple[DecodedSpot, ...], Strict(False)]
    device: DeviceNumber
    burst: int = Field(ge=0, le=INT64_MAX)
    start_s: Number
    gyro_rad_s: Triple | None
    part: int | None = Field(default=None, ge=0)
    split: Literal["train", "validation", "test"] | None = None

    @field_validator("file")
    @classmethod
    def _inside(cls, file: str) -> str:
        path = PurePosixPath(file)
        if not file or path.is_absolute() or ".." in path.parts or "\\" in file or "\0" in file:
            raise ValueError("has to be a path below the dataset, with /")
        return file


class _Format(Row):
    """Name and version of dataset.json, checked before all else."""

    format: Literal["vlcrender-dataset"]
    version: int


class _Description(Row):
    """dataset.json without `provenance`, whose seed would give the truth away.

    No key may be missing, also where `estimator.frame` has a default.
    """

    name: str
    frame_count: int = Field(ge=0, le=INT64_MAX)
    cameras: dict[str, Camera]
    sensor: Sensor
    accelerometer: Accelerometer | None
    led_map: tuple[AnyLed, ...] | None
    room_m: tuple[Positive, Positive, Positive] | None
    luminaires: tuple[Luminaire, ...]
    map_datum: MapDatum | None
    gyroscope: Gyroscope | None
    downlink: Downlink | None

    @field_validator("led_map")
    @classmethod
    def _unique(cls, leds: tuple[AnyLed, ...] | None) -> tuple[AnyLed, ...] | None:
        leds_by_id(leds or ())
        return leds

    @model_validator(mode="after")
    def _parts_agree(self) -> Self:
        luminaires_by_id(self.luminaires, self.led_map or ())
        known = None if self.led_map is None else {led.id for led in self.led_map}
        if problem := downlink_problem(self.downlink, known):
            raise ValueError(problem)
        return self


@dataclass(frozen=True)
class Dataset:
    """Device knowledge of a dataset, and its frame records; `read_frame` reads the images, a frame at a time.

    `cameras` are by name, `leds` and `luminaires` by id; `room_m` is the room's extent along x, y and z, metres, None
    where it is not known. `leds` is empty where the map is null: a receiver then makes it of the packets that the LEDs
    send.
    """

    folder: Path
    name: str
    cameras: dict[str, Camera]
    sensor: Sensor
    accelerometer: Accelerometer | None
    leds: dict[int, AnyLed]
    room_m: tuple[float, float, float] | None
    frames: tuple[FrameRecord, ...]
    luminaires: dict[int, Luminaire]
    map_datum: MapDatum | None
    gyroscope: Gyroscope | None = None
    downlink: Downlink | None = None
    frame_format: FrameFormat = "exr-uint32"


def read_dataset(path: str | Path) -> Dataset:
    """Read dataset.json and frames.parquet.

    Parameters
    ----------
    path
        Folder of the dataset, or of its results (datasets/FORMAT.md).

    Returns
    -------
    Dataset
        What the device knows, and the frame records. No image is read.

    Raises
    ------
    InputError
        A file is missing, damaged, or of another version of the format; the message names the file and the key.
    """
    dataset, frame_count = read_device(path)
    return replace(dataset, frames=tuple(iter_frames(dataset, frame_count)))


def read_device(path: str | Path) -> tuple[Dataset, int]:
    """Read dataset.json: what the device knows, without frame records, and the number of frames.

    Raises InputError as `read_dataset`.
    """
    folder = dataset_folder(path)
    description_path = folder / "dataset.json"
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    try:
        content = description_path.read_bytes()
    except FileNotFoundError:
        if (sweep := read_sweep(folder)) is not None:
            raise InputError(f"{folder}: a sweep; needed one dataset, such as {sweep.cells[0]}") from None
        raise InputError(f"{folder}: not a dataset (it has no dataset.json)") from None
    except OSError as error:
        raise InputError(f"{description_path}: {error.strerror or error}") from None
    try:
        version = _Format.model_validate_json(content).version
        if version != FORMAT_VERSION:
            raise InputError(f"{description_path}: version {version} of the format, needed {FORMAT_VERSION}")
        description, form = _Description.model_validate_json(content), frame_format(content)
        if missing := missing_key(description):
            raise InputError(f"{description_path}: {missing}: Field required")
    except ValidationError as error:
        raise InputError(f"{description_path}: {first_problem(error)}") from None
    dataset = Dataset(
        folder=folder,
        name=description.name,
        cameras=description.cameras,
        sensor=description.sensor,
        accelerometer=description.accelerometer,
        leds=leds_by_id(description.led_map or ()),
        room_m=description.room_m,
        frames=(),
        luminaires=luminaires_by_id(description.luminaires, description.led_map or ()),
        map_datum=description.map_datum,
        gyroscope=description.gyroscope,
        downlink=description.downlink,
        frame_format=form,
    )
    return dataset, description.frame_count


def iter_frames(dataset: Dataset, frame_count: int) -> Iterator[FrameRecord]:
    """Frame records of a dataset, of which some are in memory at a time; `dataset.frames` is not used.

    Raises InputError as `read_dataset`, also for a record that disagrees with dataset.json or with the one before.
    """
    path = dataset.folder / "frames.parquet"
    if (rows := row_count(path)) != frame_count:
        raise InputError(f"{path}: {rows} rows, but dataset.json says frame_count {frame_count}")
    before = None
    for index, record in enumerate(iter_rows(path, FRAME_COLUMNS, FrameRecord, OPTIONAL_FRAME_COLUMNS)):
        if record.frame != index:
            raise InputError(f"{path}: row {index} holds frame {record.frame}; frames have to be 0, 1, 2, ... in order")
        if problem := _problem(dataset, before, record):
            raise InputError(f"{path}: frame {index}: {problem}")
        yield record
        before = record


def _problem(dataset: Dataset, before: FrameRecord | None, record: FrameRecord) -> str | None:
    """Where a record disagrees with dataset.json or with the one before; None if nowhere."""
    if record.shot not in ((0,) if before is None else (before.shot, before.shot + 1)):
        return f"shot {record.shot}; shots have to be 0, 1, 2, ... in order"
    if record.camera not in dataset.cameras:
        return f"unknown camera {record.camera!r}; cameras: {', '.join(dataset.cameras) or 'none'}"
    problem = spots_problem(dataset.downlink, record.spots) or decoding_problem(record.spots, dataset.leds)
    problem = problem or gravity_problem(record.accelerometer_m_s2, dataset.accelerometer)
    problem = problem or gyro_problem(record.gyro_rad_s, dataset.gyroscope)
    if problem is None and record.gyro_rad_s is None and dataset.gyroscope is not None:
        problem = "gyro_rad_s is null, but gyroscope is given"
    return problem or _burst_problem(before, record)


def _burst_problem(before: FrameRecord | None, record: FrameRecord) -> str | None:
    """Where bursts are not runs of shots of one device, each later than the one before; None if nowhere."""
    burst = record.burst
    if burst not in ((0,) if before is None else (before.burst, before.burst + 1)):
        return f"burst {burst}; bursts have to be 0, 1, 2, ... in order"
    if before is None:
        return None
    same = burst == before.burst
    if record.shot == before.shot and not same:
        return f"burst {burst}, but its shot {record.shot} is of burst {before.burst}"
    if same and record.device != before.device:
        return f"device {record.device}, but its burst {burst} is of device {before.device}"
    if same and record.shot != before.shot and record.start_s <= before.start_s:
        return f"start_s {record.start_s}; has to be later than the shot before in its burst"
    return None


def read_frame(dataset: Dataset, frame: FrameRecord | int, *, with_other_cameras: bool = True) -> DeviceFrame:
    """Read a frame's image.

    Parameters
    ----------
    dataset
        The dataset, as `read_dataset` returns it.
    frame
        A record of `dataset.frames`, or its frame number.
    with_other_cameras
        Read the frames of the rig's other cameras of the same shot as well, into `other_cameras`.

    Returns
    -------
    DeviceFrame
        Digital numbers and device knowledge.

    Raises
    ------
    InputError
        There is no such frame, or an image file is missing, damaged, or not the image that the record describes.
    """
    if isinstance(frame, FrameRecord):
        record = frame
    elif 0 <= frame < len(dataset.frames):
        record = dataset.frames[frame]
    else:
        raise InputError(f"{dataset.folder}: no frame {frame}; there are {len(dataset.frames)}, from 0 on")
    camera = dataset.cameras[record.camera]
    parts = _read_parts(dataset.folder, record, camera, dataset.frame_format)
    if problem := depth_problem(parts, dataset.sensor):
        raise InputError(f"{record.file}: {problem}")
    made = DeviceFrame(
        parts,
        camera,
        dataset.sensor,
        record.accelerometer_m_s2,
        dataset.accelerometer,
        record.exposure_s,
        record.spots,
        dataset.leds,
        luminaires=dataset.luminaires,
        map_datum=dataset.map_datum,
        device=record.device,
        burst=record.burst,
        start_s=record.start_s,
        gyro_rad_s=record.gyro_rad_s,
        gyroscope=dataset.gyroscope,
        downlink=dataset.downlink,
    )
    if not with_other_cameras:
        return made
    others = [other for other in _shot(dataset, record) if other.frame != record.frame]
    return replace(made, other_cameras=tuple(read_frame(dataset, other, with_other_cameras=False) for other in others))


def _shot(dataset: Dataset, record: FrameRecord) -> tuple[FrameRecord, ...]:
    """Records of the frames of a record's shot, which are consecutive."""
    first = end = record.frame
    while first > 0 and dataset.frames[first - 1].shot == record.shot:
        first -= 1
    while end < len(dataset.frames) and dataset.frames[end].shot == record.shot:
        end += 1
    return dataset.frames[first:end]


def _read_parts(folder: Path, record: FrameRecord, camera: Camera, form: FrameFormat) -> tuple[Part, ...]:
    data = _file_of(folder, record)
    if form == "png16":
        return (Part(0, 0, numbers_of_png(data, (camera.height_px, camera.width_px), record.file)),)
    try:
        with OpenEXR.File(io.BytesIO(data), header_only=True) as file:
            boxes = _check_headers(record, [part.header for part in file.parts], camera)
        # Without separate_channels, the channels of several parts would be merged by name.
        with OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
            images = [part.channels["Y"].pixels for part in file.parts]
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{record.file}: not a readable EXR image ({first_line(error)})") from None
    if len(images) != len(boxes):  # the decoder drops unreadable parts silently
        raise InputError(f"{record.file}: not a readable EXR image ({len(images)} of {len(boxes)} parts)")
    parts = []
    for (left, top, right, bottom), image in zip(boxes.reshape(-1, 4).tolist(), images, strict=True):
        numbers = numbers_of_exr(image, form, (bottom - top + 1, right - left + 1), record.file)
        parts.append(Part(top, left, numbers))
    return tuple(parts)


def _file_of(folder: Path, record: FrameRecord) -> bytes:
    """An intact EXR file of a frame alone. The decoder accepts most flipped bits as pixels; the hash detects them."""
    path, sha256 = folder / record.file, record.sha256.lower()
    try:
        if record.part is not None:
            return frame_of_shard(path, sha256, record.frame, record.part)
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{record.file}: {error.strerror or error}") from None
    except InputError as error:
        raise InputError(f"{record.file}: {error}") from None
    if hashlib.sha256(data).hexdigest() != sha256:
        raise InputError(f"{record.file}: damaged or changed (its sha256 is not the one in frames.parquet)")
    return data


def _check_headers(record: FrameRecord, headers: list[dict[str, Any]], camera: Camera) -> NDArray[np.int64]:
    """Refuse an image of the wrong kind or size before its pixels are decoded.

    Returns the regions of interest (n, 2, 2) of the parts, [first, last] pixel (u, v) of each.
    """
    sensor = np.array([[0, 0], [camera.width_px - 1, camera.height_px - 1]], dtype=np.int64)
    for header in headers:
        if header["type"] != OpenEXR.scanlineimage:
            raise InputError(f"{record.file}: not stored as scan lines")
        channels = [channel.name for channel in header["channels"]]
        if channels != ["Y"]:
            raise InputError(f"{record.file}: channels {', '.join(channels)}, needed Y alone")
    displays, boxes = (
        np.array([header[name] for header in headers], dtype=np.int64) for name in ("displayWindow", "dataWindow")
    )
    if len(other := displays[(displays != sensor).any(axis=(1, 2))]):
        width_px, height_px = (other[0, 1] - other[0, 0] + 1).tolist()
        raise InputError(
            f"{record.file}: displayWindow {other[0].tolist()}, {width_px} x {height_px} pixels, "
            f"but the camera has {camera.width_px} x {camera.height_px}"
        )
    beyond = ((boxes[:, 0] < sensor[0]) | (boxes[:, 1] > sensor[1])).any(axis=1)
    if record.capturable and beyond.any():
        box = boxes[beyond][0].tolist()
        raise InputError(f"{record.file}: dataWindow {box} extends beyond the sensor, but is capturable")
    if not record.capturable and not beyond.any():
        raise InputError(f"{record.file}: every dataWindow lies on the sensor, but capturable is false")
    if problem := regions_problem(boxes, camera):
        raise InputError(f"{record.file}: {problem}")
    return boxes


def write_image(path: Path, image_dn: NDArray[np.uint32], exposure_s: float) -> str:
    """Write a full frame's digital numbers (rows, columns) as frames/*.exr; returns the file's sha256."""
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage, "expTime": exposure_s}
    with OpenEXR.File(header, {"Y": np.ascontiguousarray(image_dn)}) as file:
        file.write(str(path))
    return hashlib.sha256(path.read_bytes()).hexdigest()
