"""Reads a dataset as a device would: its frames and what it knows of itself, never the truth (datasets/FORMAT.md)."""

import hashlib
import io
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal, Self

import numpy as np
import OpenEXR
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field, Strict, ValidationError, field_validator, model_validator

from estimator.errors import InputError
from estimator.io.records import NotNegative, Number, Positive, Row, Triple, first_line, first_problem, read_rows

INT64_MAX = 2**63 - 1
MAX_PIXELS = 16
"""How many times the sensor's pixels the windows of a frame may hold, which may reach beyond it."""
FULL_SIGMA = 4.0
LedId = Annotated[int, Field(ge=0, le=INT64_MAX)]
# Within 1000 km of the origin: then no range, even a wrong one, is too large to be written down.
Place = Annotated[float, Field(ge=-1e6, le=1e6)]

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
}


class Distortion(Row):
    """Brown-Conrady coefficients, as OpenCV has them, for a position on the sensor in units of the image distance."""

    k1: Number
    k2: Number
    k3: Number
    p1: Number
    p2: Number


class Camera(Row):
    """Intrinsics; `K` maps what the lens makes of a direction to continuous pixels with pixel centres at +0.5."""

    width_px: int = Field(ge=1, le=65536)
    height_px: int = Field(ge=1, le=65536)
    K: tuple[Triple, Triple, Triple]
    pixel_pitch_um: Positive
    focal_length_mm: Positive
    image_distance_mm: Positive
    f_number: Positive
    projection: Literal["perspective", "equidistant"]
    distortion: Distortion | None
    focus_distance_m: Positive | Literal["infinity"] | None
    psf: Literal["none", "diffraction", "measured"]
    psf_wavelength_nm: Positive
    psf_kernel: tuple[tuple[Number, ...], ...] | None
    R_cam_rig: tuple[Triple, Triple, Triple]
    offset_m: Triple

    @field_validator("K")
    @classmethod
    def _upper_triangular(cls, k: tuple[Triple, Triple, Triple]) -> tuple[Triple, Triple, Triple]:
        if k[0][0] <= 0 or k[1][1] <= 0 or k[1][0] != 0 or k[2] != (0.0, 0.0, 1.0):
            raise ValueError("K has to be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0")
        return k

    @model_validator(mode="after")
    def _fish_eyes_have_no_distortion(self) -> Self:
        if self.projection == "equidistant" and self.distortion is not None:
            raise ValueError('distortion has to be null with projection "equidistant"')
        return self

    def matrix(self) -> NDArray[np.float64]:
        """`K` as a (3, 3) array, pixels."""
        return np.array(self.K, dtype=np.float64)


class Sensor(Row):
    """How electrons became digital numbers: `dn = round(min(e, full_well_e) / gain_e_per_dn) + black_level_dn`.

    What is not shot noise is given by standard deviations, as the sensor's data sheet has them.
    """

    bits: int = Field(ge=1, le=32)
    gain_e_per_dn: Positive
    full_well_e: Positive
    black_level_dn: float = Field(ge=0, le=2**32)
    noise: Literal["shot", "none", "full"]
    prnu: NotNegative
    dark_current_e_s: NotNegative
    dsnu_e: NotNegative
    read_noise_e: NotNegative
    adc_noise_dn: NotNegative
    row_offset_e: NotNegative
    column_offset_e: NotNegative
    mosaic: str

    def largest_dn(self) -> float:
        """The digital number of a pixel that holds all it can: the full well's, or the converter's last."""
        return min(2.0**self.bits - 1, float(np.rint(self.full_well_e / self.gain_e_per_dn)) + self.black_level_dn)

    def full_dn(self) -> float:
        """From here on a pixel may be full: what is read out of a full one has the noise of reading it.

        Four standard deviations below the full well, of all that is added after it is clipped. The converter's last
        number needs no such room: a pixel that reads less has not reached it.
        """
        added_e = float(np.hypot(self.read_noise_e, np.hypot(self.row_offset_e, self.column_offset_e)))
        spread_dn = float(np.hypot(added_e / self.gain_e_per_dn, self.adc_noise_dn))
        well_dn = float(np.rint(self.full_well_e / self.gain_e_per_dn)) + self.black_level_dn
        return min(2.0**self.bits - 1, well_dn - FULL_SIGMA * spread_dn)

    def floor_e2(self) -> float:
        """Variance of a pixel, electrons squared, that does not grow with its light.

        Offsets of whole rows and columns are left out: a spot's background takes most of them away.
        """
        rounding = self.gain_e_per_dn**2 / 12 if self.noise == "full" or self.gain_e_per_dn != 1 else 0.0
        return self.dsnu_e**2 + self.read_noise_e**2 + (self.adc_noise_dn * self.gain_e_per_dn) ** 2 + rounding


class Led(Row):
    """What an LED sends of itself: identity, centre in the world, and its radius or half side, metres."""

    id: LedId
    position_m: Annotated[tuple[Place, Place, Place], Strict(False)]
    radius_m: Positive
    shape: Literal["disc", "square"]


class DecodedSpot(Row):
    """A demodulator's word that this LED is near this pixel; rough, it says which spot and not where."""

    led: LedId
    u_px: Number
    v_px: Number


class FrameRecord(Row):
    """A row of frames.parquet."""

    frame: int = Field(ge=0)
    shot: int = Field(ge=0)
    pose: int = Field(ge=0)
    file: str
    sha256: str = Field(pattern="^[0-9a-fA-F]{64}$")
    camera: str
    exposure_s: Positive
    capturable: bool
    accelerometer_m_s2: Triple
    spots: Annotated[tuple[DecodedSpot, ...], Strict(False)]

    @field_validator("file")
    @classmethod
    def _inside(cls, file: str) -> str:
        path = PurePosixPath(file)
        if not file or path.is_absolute() or ".." in path.parts or "\\" in file or "\0" in file:
            raise ValueError("has to be a path below the dataset, with /")
        return file


class Accelerometer(Row):
    """What a device knows of its accelerometer's error: of each tilt, or of gravity's direction either way."""

    kind: Literal["tilt-error", "imu"]
    error_deg: NotNegative


class _Description(Row):
    """dataset.json without `provenance`: with the seed in it, the truth could be computed."""

    format: Literal["vlcrender-dataset"]
    version: Literal[3]
    name: str
    frame_count: int = Field(ge=0, le=INT64_MAX)
    cameras: dict[str, Camera]
    sensor: Sensor
    accelerometer: Accelerometer
    led_map: tuple[Led, ...]
    room_m: tuple[Positive, Positive, Positive]

    @field_validator("led_map")
    @classmethod
    def _unique(cls, leds: tuple[Led, ...]) -> tuple[Led, ...]:
        if len({led.id for led in leds}) != len(leds):
            raise ValueError("LED ids have to be unique")
        return leds


@dataclass(frozen=True)
class Dataset:
    """A dataset's device knowledge; `frames` are the records, the images are read one at a time by `read_frame`."""

    folder: Path
    name: str
    cameras: dict[str, Camera]
    sensor: Sensor
    accelerometer: Accelerometer
    leds: dict[int, Led]
    room_m: tuple[float, float, float]
    frames: tuple[FrameRecord, ...]


@dataclass(frozen=True, eq=False)
class Part:
    """A window of the sensor: `image_dn` (rows, columns), row 0 on top, from pixel (row, column) of the sensor on."""

    row: int
    column: int
    image_dn: NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class DeviceFrame:
    """What was read out, which is one part for a full frame, and all the device knows while taking it."""

    parts: tuple[Part, ...]
    camera: Camera
    sensor: Sensor
    accelerometer_m_s2: tuple[float, float, float]
    accelerometer: Accelerometer
    exposure_s: float
    spots: tuple[DecodedSpot, ...]
    leds: dict[int, Led]
    other_cameras: "tuple[DeviceFrame, ...]" = ()
    """What the rig's other cameras took at the same time; theirs are left empty."""

    def electrons(self, part: Part) -> NDArray[np.float32]:
        """A part in electrons above the black level, (rows, columns)."""
        image = part.image_dn.astype(np.float32)
        if self.sensor.black_level_dn != 0:
            image -= np.float32(self.sensor.black_level_dn)
        if self.sensor.gain_e_per_dn != 1:
            image *= np.float32(self.sensor.gain_e_per_dn)
        return image

    def clipped(self, part: Part) -> NDArray[np.bool_]:
        """Where a pixel of a part is full, or may be, and its electrons are unknown, (rows, columns)."""
        # An integer: beside a float the whole image would be made one.
        return part.image_dn >= int(np.ceil(self.sensor.full_dn()))


def read_dataset(folder: Path) -> Dataset:
    """Read dataset.json and frames.parquet; raises InputError naming the file and key where they break the format."""
    path = folder / "dataset.json"
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    try:
        description = _Description.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{folder}: not a dataset (it has no dataset.json)") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    except ValidationError as error:
        raise InputError(f"{path}: {first_problem(error)}") from None
    dataset = Dataset(
        folder=folder,
        name=description.name,
        cameras=description.cameras,
        sensor=description.sensor,
        accelerometer=description.accelerometer,
        leds={led.id: led for led in description.led_map},
        room_m=description.room_m,
        frames=read_rows(folder / "frames.parquet", FRAME_COLUMNS, FrameRecord),
    )
    _check_frames(folder / "frames.parquet", dataset, description.frame_count)
    return dataset


def _check_frames(path: Path, dataset: Dataset, frame_count: int) -> None:
    """Refuse records that disagree with dataset.json or with each other."""
    if len(dataset.frames) != frame_count:
        raise InputError(f"{path}: {len(dataset.frames)} rows, but dataset.json says frame_count {frame_count}")
    shot = -1
    for index, record in enumerate(dataset.frames):
        if record.frame != index:
            raise InputError(f"{path}: row {index} holds frame {record.frame}; frames have to be 0, 1, 2, ... in order")
        if record.shot not in (max(shot, 0), shot + 1):
            raise InputError(f"{path}: frame {index}: shot {record.shot}; shots have to be 0, 1, 2, ... in order")
        shot = record.shot
        if record.camera not in dataset.cameras:
            known = ", ".join(dataset.cameras) or "none"
            raise InputError(f"{path}: frame {index}: unknown camera {record.camera!r}; cameras: {known}")
        decoded = [spot.led for spot in record.spots]
        if len(set(decoded)) != len(decoded):
            raise InputError(f"{path}: frame {index}: an LED is decoded twice in spots")
        if unknown := set(decoded) - dataset.leds.keys():
            raise InputError(f"{path}: frame {index}: spots name LED {min(unknown)}, which is not in led_map")


def read_frame(dataset: Dataset, record: FrameRecord) -> DeviceFrame:
    """Read one frame's image; raises InputError where the file is missing, damaged, or not the image it should be."""
    camera = dataset.cameras[record.camera]
    parts = _read_exr(dataset.folder, record, camera)
    ceiling = 2**dataset.sensor.bits - 1
    largest = max(part.image_dn.max() for part in parts)
    if largest > ceiling:
        raise InputError(f"{record.file}: digital number {largest}, but {dataset.sensor.bits} bits end at {ceiling}")
    return DeviceFrame(
        parts,
        camera,
        dataset.sensor,
        record.accelerometer_m_s2,
        dataset.accelerometer,
        record.exposure_s,
        record.spots,
        dataset.leds,
    )


def _read_exr(folder: Path, record: FrameRecord, camera: Camera) -> tuple[Part, ...]:
    try:
        data = (folder / record.file).read_bytes()
    except OSError as error:
        raise InputError(f"{record.file}: {error.strerror or error}") from None
    # The decoder takes most flipped bits for pixels, without a word: only the hash tells.
    if hashlib.sha256(data).hexdigest() != record.sha256.lower():
        raise InputError(f"{record.file}: damaged or changed (its sha256 is not the one in frames.parquet)")
    try:
        with OpenEXR.File(io.BytesIO(data), header_only=True) as file:
            boxes = _check_headers(record, [part.header for part in file.parts], camera)
        # In a file of several parts the channels would otherwise be merged by their names.
        with OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
            images = [part.channels["Y"].pixels for part in file.parts]
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{record.file}: not a readable EXR image ({first_line(error)})") from None
    if len(images) != len(boxes):  # a part whose pixels cannot be read is left out without a word
        raise InputError(f"{record.file}: not a readable EXR image ({len(images)} of {len(boxes)} parts)")
    parts = []
    for box, image in zip(boxes, images, strict=True):
        rows, columns = (box[1] - box[0] + 1)[::-1].tolist()
        if image is None or image.dtype != np.uint32 or image.shape != (rows, columns):
            raise InputError(f"{record.file}: channel Y has to hold 32-bit unsigned integers, one a pixel")
        parts.append(Part(int(box[0, 1]), int(box[0, 0]), np.asarray(image, dtype=np.uint32)))
    return tuple(parts)


def _check_headers(record: FrameRecord, headers: list[dict[str, object]], camera: Camera) -> list[NDArray[np.int64]]:
    """Refuse an image of the wrong kind or size before memory is set aside; else its windows, [first, last] (u, v)."""
    sensor = np.array([[0, 0], [camera.width_px - 1, camera.height_px - 1]], dtype=np.int64)
    boxes: list[NDArray[np.int64]] = []
    for header in headers:
        if header["type"] != OpenEXR.scanlineimage:
            raise InputError(f"{record.file}: not stored as scan lines")
        channels = [channel.name for channel in header["channels"]]  # type: ignore[attr-defined]
        if channels != ["Y"]:
            raise InputError(f"{record.file}: channels {', '.join(channels)}, needed Y alone")
        shown = np.array(header["displayWindow"], dtype=np.int64)
        if not np.array_equal(shown, sensor):
            width_px, height_px = (shown[1] - shown[0] + 1).tolist()
            raise InputError(
                f"{record.file}: displayWindow {shown.tolist()}, {width_px} x {height_px} pixels, "
                f"but the camera has {camera.width_px} x {camera.height_px}"
            )
        box = np.array(header["dataWindow"], dtype=np.int64)
        if record.capturable and ((box[0] < sensor[0]) | (box[1] > sensor[1])).any():
            raise InputError(f"{record.file}: dataWindow {box.tolist()} reaches beyond the sensor, but is capturable")
        if boxes and ((box[0] <= np.array(boxes)[:, 1]) & (np.array(boxes)[:, 0] <= box[1])).all(axis=1).any():
            raise InputError(f"{record.file}: dataWindow {box.tolist()} overlaps another part's")
        boxes.append(box)
    pixels = sum(int((box[1] - box[0] + 1).prod()) for box in boxes)
    if pixels > MAX_PIXELS * camera.width_px * camera.height_px:
        raise InputError(f"{record.file}: {pixels} pixels, more than {MAX_PIXELS} times the sensor's")
    return boxes
