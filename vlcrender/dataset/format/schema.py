"""Models of everything a dataset states in tables and JSON, as datasets/FORMAT.md has it.

Rows of frames.parquet and truth.parquet, a line of the journal, and dataset.json. The writer builds these models, the
verifier reads them back, and the Arrow schemas of the tables derive from them.
"""

import re
from pathlib import PurePosixPath
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, Self, Union, get_args, get_origin

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, field_validator, model_validator

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.rig import Mounted
from vlcrender.config.toml_model import Settings
from vlcrender.dataset.format.camera_entries import CameraEntry, CameraUncertainty, SensorEntry
from vlcrender.dataset.format.downlink_entry import DownlinkEntry, downlink_problem
from vlcrender.dataset.format.frame_numbers import FrameNumbers, Summary
from vlcrender.dataset.format.values import (
    Coordinate,
    Count,
    LedSize,
    NotNegative,
    Number,
    Positive,
    Sigma,
    Sigmas3,
    TiltSigma,
    Triple,
    repeated,
)
from vlcrender.dataset.format.withheld_entry import Withheld
from vlcrender.dataset.recipe.belief import CAMERA_PARAMETERS, EXACT_CAMERA, CameraSigmas, Sigmas
from vlcrender.dataset.recipe.file_settings import FilesEntry
from vlcrender.scene.as_built import Luminaires
from vlcrender.scene.leds import Leds
from vlcrender.sensor.accelerometer import Imu, TiltError
from vlcrender.sensor.gyroscope import Gyroscope

FORMAT_VERSION: Final = 4
"""`version` of dataset.json."""
DATA_VERSION = 4
"""`data_version` of the provenance: raised whenever the same recipe gives other bits."""

Flat9 = tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]
"""A 3 x 3 matrix, row by row."""
Five = tuple[Number, Number, Number, Number, Number]
"""Distortion: k1, k2, k3, p1, p2."""
Seven = tuple[Sigma, Sigma, Sigma, Sigma, Sigma, Sigma, Sigma]
"""One number for each of belief.CAMERA_PARAMETERS."""


def flat9(matrix: NDArray[np.float64]) -> Flat9:
    """A 3 x 3 matrix, row by row."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix.tolist()
    return xx, xy, xz, yx, yy, yz, zx, zy, zz


def five(distortion: Distortion | None) -> Five | None:
    """The coefficients of a distortion; None without one."""
    if distortion is None:
        return None
    return distortion.k1, distortion.k2, distortion.k3, distortion.p1, distortion.p2


def triple(numbers: NDArray[np.float64]) -> Triple:
    """A vector (3,) as a tuple."""
    x, y, z = numbers.tolist()
    return x, y, z


def _seven(numbers: NDArray[np.float64]) -> Seven:
    a, b, c, d, e, f, g = numbers.tolist()
    return a, b, c, d, e, f, g


class SpotRow(Settings):
    """A decoded identity: one LED and its rough pixel."""

    led: Count
    """LED id."""
    u_px: Number
    v_px: Number


class FrameRow(Settings):
    """A row of frames.parquet: what a device knows about one frame."""

    frame: Count
    shot: Count
    burst: Count
    """Frames of one burst follow each other at the frame rate; equal to `shot` without bursts."""
    start_s: Number
    """Start of the exposure of the first line, on the rig's clock."""
    pose: Count
    device: Count
    """Frames of one device share the errors of a device."""
    file: str
    """Path below the dataset, with `/`."""
    part: Count | None = None
    """Number of the frame's first part in that file where it holds several frames; else None."""
    sha256: str
    """Digest of that file, 64 hex digits."""
    camera: str
    exposure_s: Positive
    capturable: bool
    """Whether every region of the frame lies on the sensor."""
    accelerometer_m_s2: Triple
    """Reading at mid-exposure in the axes of this frame's camera."""
    gyro_rad_s: Triple | None
    """Reading of the gyroscope, mean over the readout, in the axes of this frame's camera; None without one."""
    spots: tuple[SpotRow, ...]
    split: str | None = None
    """Train, validation or test; None where the frame belongs to none, or the recipe has no [split]."""
    time_s: float | None = None
    """Time stamp of the pose in the recipe; None where it has none."""

    @field_validator("sha256")
    @classmethod
    def _is_a_digest(cls, sha256: str) -> str:
        if sha256 and not re.fullmatch("[0-9a-fA-F]{64}", sha256):
            raise ValueError("has to have 64 hex digits")
        return sha256

    @field_validator("file")
    @classmethod
    def _is_inside(cls, file: str) -> str:
        path = PurePosixPath(file)
        if not file or path.is_absolute() or ".." in path.parts or "\\" in file or "\0" in file:
            raise ValueError("has to be a path below the dataset, with /")
        return file


class LedTruth(Settings):
    """The true image of one LED that lights at least one pixel of a frame."""

    led: Count
    """LED id."""
    u_px: Number
    """Image of the LED's centre, exact, at the time of its own line."""
    v_px: Number
    visible_fraction: Number
    """Share of the LED's image that falls on the sensor."""
    clock_error: Number | None
    """Relative error of the frequency of the LED's clock; None for a steady LED."""
    phase: Number | None
    """Phase of the LED's wave at the frame's `start_s`, periods, in [0, 1); None for a steady LED."""
    bits: str | None
    """Chips of one period of the LED's wave, "1" lit; None for a steady LED and for waves that send nothing."""


class TruthRow(Settings):
    """A row of truth.parquet: the pose of one frame and what follows from it."""

    frame: Count
    shot: Count
    map: Count
    """The map of the LEDs that the frame shows."""
    K: Flat9
    """True intrinsics of this frame."""
    distortion: Five | None
    """True distortion of this frame."""
    position_m: Triple
    """Projection centre of this frame's camera, world."""
    R_cam_world: Flat9
    tilt_x_deg: Number
    tilt_y_deg: Number
    yaw_deg: Number
    angular_velocity_rad_s: Triple | None
    """About the axes of this frame's camera, right-handed; None at rest."""
    linear_velocity_m_s: Triple | None
    """Velocity of the projection centre, world axes; None at rest."""
    leds: tuple[LedTruth, ...]
    added_noise_dn: Number | None
    """Standard deviation of the noise that `[added_noise]` adds before rounding, digital numbers; None without."""
    bound_m2: Flat9 | None
    """Cramér-Rao bound of the position; hybrid with a belief."""
    bound_exact_m2: Flat9 | None
    """Cramér-Rao bound of the position for a device that is told the truth."""


class DeviceTruthRow(Settings):
    """A row of truth_devices.parquet: the true camera and accelerometer of one device."""

    device: Count
    map: Count
    camera: str
    K: Flat9
    """True intrinsics without the errors of a shot."""
    distortion: Five | None
    R_cam_rig: Flat9
    offset_m: Triple
    tilt_error_deg: tuple[float, float] | None
    """Constant errors of the accelerometer on tilt_x and tilt_y; None for an IMU."""


class MapTruthRow(Settings):
    """A row of truth_map.parquet: one LED of one map as built."""

    map: Count
    led: Count
    position_m: Triple
    size_m: Positive
    """Radius of a disc, side of a square."""
    gradient: tuple[float, float]
    """Relative change of luminance from the centre to the rim along x and y."""


class FileEntry(Settings):
    """A file of a dataset in manifest.json."""

    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    bytes: Annotated[int, Field(ge=0)]


class FrameRecord(Settings):
    """One finished frame: its row in both tables, and its files. In a line of journal.jsonl."""

    device: FrameRow
    truth: TruthRow
    numbers: FrameNumbers | None = None
    """For the summary of the set; None where they are not known."""
    files: dict[str, FileEntry]
    """Every file that was made of the frame, by its path below the dataset; a shard is a file of each of its frames."""

    @property
    def frame(self) -> int:
        """Number of the frame."""
        return self.device.frame

    def with_file(self, entry: FileEntry) -> "FrameRecord":
        """The record with the digest of the file of its pixels."""
        device = self.device.model_copy(update={"sha256": entry.sha256})
        return self.model_copy(update={"device": device, "files": {device.file: entry, **self.files}})


_SCALARS = {int: pa.int64(), float: pa.float64(), str: pa.string(), bool: pa.bool_()}


def arrow_schema(row: type[Settings]) -> pa.Schema:
    """The Arrow schema of a table whose rows are this model.

    Numbers have 64 bits, a tuple of fixed length is a fixed-size list, a tuple of any length a list, a model a struct.
    Raises TypeError for a field of any other type.
    """
    return pa.schema([(name, _arrow_type(field.annotation)) for name, field in row.model_fields.items()])


def _arrow_type(annotation: Any) -> pa.DataType:
    if annotation in _SCALARS:
        return _SCALARS[annotation]
    if isinstance(annotation, type) and issubclass(annotation, Settings):
        return pa.struct(list(arrow_schema(annotation)))
    arguments = get_args(annotation)
    if get_origin(annotation) is Annotated:
        return _arrow_type(arguments[0])
    if get_origin(annotation) in (Union, UnionType):
        (present,) = (argument for argument in arguments if argument is not NoneType)
        return _arrow_type(present)
    if get_origin(annotation) is tuple:
        item = _arrow_type(arguments[0])
        return pa.list_(item) if arguments[1:] == (Ellipsis,) else pa.list_(item, len(arguments))
    raise TypeError(f"{annotation}: has no Arrow type here")


FRAMES_SCHEMA = arrow_schema(FrameRow)
TRUTH_SCHEMA = arrow_schema(TruthRow)


class AccelerometerEntry(Settings):
    """The accelerometer in dataset.json."""

    kind: Literal["tilt-error", "imu"]
    error_deg: TiltSigma
    device_error_deg: TiltSigma | None
    shot_error_deg: TiltSigma | None


class GyroscopeEntry(Settings):
    """The gyroscope in dataset.json: standard deviations about each axis."""

    noise_rad_s: NotNegative
    bias_rad_s: NotNegative


class DiscEntry(Settings):
    """A round LED in dataset.json: the data that it broadcasts about itself."""

    id: Count
    position_m: tuple[Coordinate, Coordinate, Coordinate]
    shape: Literal["disc"]
    radius_m: LedSize
    luminaire: Count | None
    sigma_m: Sigmas3 | None
    radius_sigma_m: NotNegative | None
    gradient_sigma: NotNegative | None


class SquareEntry(Settings):
    """A square LED in dataset.json, sides along x and y: the data that it broadcasts about itself."""

    id: Count
    position_m: tuple[Coordinate, Coordinate, Coordinate]
    shape: Literal["square"]
    side_m: LedSize
    luminaire: Count | None
    sigma_m: Sigmas3 | None
    side_sigma_m: NotNegative | None
    gradient_sigma: NotNegative | None


LedMapEntry = Annotated[DiscEntry | SquareEntry, Field(discriminator="shape")]


class LuminaireEntry(Settings):
    """A luminaire in dataset.json: a panel, or a single LED."""

    id: Count
    position_m: Triple
    sigma_m: Sigmas3
    sigma_rotation_deg: Sigmas3


class MapDatumEntry(Settings):
    """Standard deviations of the map as a whole in dataset.json."""

    sigma_m: Sigmas3
    scale_sigma_ppm: NotNegative


class NamesEntry(Settings):
    """Names of the presets that the recipe names; None for a table without one."""

    camera: str | None = None
    sensor: str | None = None
    accelerometer: str | None = None
    belief: str | None = None


class DatasetFile(Settings):
    """dataset.json. Keys of its outermost object that FORMAT.md does not know are ignored."""

    model_config = ConfigDict(extra="ignore")

    format: Literal["vlcrender-dataset"]
    version: Literal[4]
    name: str
    frame_count: Count
    cameras: dict[str, CameraEntry]
    sensor: SensorEntry
    accelerometer: AccelerometerEntry
    gyroscope: GyroscopeEntry | None
    led_map: tuple[LedMapEntry, ...] | None
    """None where devices know of LEDs only what the LEDs send."""
    luminaires: tuple[LuminaireEntry, ...]
    map_datum: MapDatumEntry | None
    downlink: DownlinkEntry | None
    room_m: tuple[Positive, Positive, Positive]
    files: FilesEntry = FilesEntry()
    """Where not given, as the default: sets made before it was stated."""
    summary: Summary | None = None
    """None in sets made before it was stated."""
    licence: str | None = None
    """SPDX licence expression of the recipe; None where not stated."""
    names: NamesEntry = NamesEntry()
    """Where not given, no presets: sets made before they were stated."""
    withheld: Withheld | None = None
    """None where the set has its truth."""
    provenance: dict[str, Any]
    manifest_sha256: str | None = None
    """SHA-256 of manifest.json; None in a set that was made before there were manifests."""
    seal: str | None = None
    """SHA-256 of this file's content without the seal, see manifest.py."""

    @model_validator(mode="after")
    def _identities_agree(self) -> Self:
        ids = {led.id for led in self.led_map or ()}
        luminaires = {entry.id for entry in self.luminaires}
        if (one := repeated(led.id for led in self.led_map or ())) is not None:
            raise ValueError(f"led_map: id {one} occurs twice")
        if (one := repeated(entry.id for entry in self.luminaires)) is not None:
            raise ValueError(f"luminaires: id {one} occurs twice")
        for led in self.led_map or ():
            if luminaires and led.luminaire is not None and led.luminaire not in luminaires:
                raise ValueError(f"LED {led.id} names luminaire {led.luminaire}, which is not in luminaires")
        if problem := downlink_problem(self.downlink, None if self.led_map is None else ids):
            raise ValueError(problem)
        return self


def camera_entry(mounted: Mounted, sigmas: CameraSigmas | None = None) -> CameraEntry:
    """The entry of a camera on a rig, with the standard deviations that its device is told: 0 without `sigmas`."""
    arrays = {"K": mounted.camera.matrix, "R_cam_rig": mounted.rotation, "offset_m": mounted.offset_m}
    own = {"image_distance_mm": mounted.camera.image_distance_mm, **{key: a.tolist() for key, a in arrays.items()}}
    shared = mounted.camera.model_dump(include=set(CameraEntry.model_fields) - set(own))
    told = EXACT_CAMERA if sigmas is None else sigmas
    uncertainty = CameraUncertainty(
        parameters=CAMERA_PARAMETERS,
        device_sigma=_seven(told.device),
        shot_sigma=_seven(told.shot),
        offset_sigma_m=told.offset_m,
        rotation_sigma_deg=told.rotation_deg,
    )
    return CameraEntry.model_validate({**shared, **own, "uncertainty": uncertainty})


def accelerometer_entry(accelerometer: TiltError | Imu, sigmas: Sigmas | None = None) -> AccelerometerEntry:
    """The entry of an accelerometer, with the standard deviations that its device is told."""
    kind, error_deg = accelerometer.kind, accelerometer.error_deg
    if sigmas is None:
        return AccelerometerEntry(kind=kind, error_deg=error_deg, device_error_deg=None, shot_error_deg=None)
    device_deg, shot_deg = sigmas.accelerometer_device_deg, sigmas.accelerometer_shot_deg
    return AccelerometerEntry(
        kind=kind,
        error_deg=float(np.hypot(device_deg, shot_deg)),
        device_error_deg=device_deg,
        shot_error_deg=shot_deg,
    )


def gyroscope_entry(gyroscope: Gyroscope | None) -> GyroscopeEntry | None:
    """The entry of a gyroscope."""
    if gyroscope is None:
        return None
    return GyroscopeEntry(noise_rad_s=gyroscope.noise_rad_s, bias_rad_s=gyroscope.bias_rad_s)


def led_map(
    leds: Leds, luminaires: Luminaires | None = None, sigmas: Sigmas | None = None
) -> tuple[DiscEntry | SquareEntry, ...]:
    """The entries of all LEDs, in the order of the scene, with the standard deviations that devices are told."""
    entries: list[DiscEntry | SquareEntry] = []
    for i, (led, center, square) in enumerate(zip(leds.ids, leds.centers_m, leds.squares, strict=True)):
        size_m = float(leds.half_widths_m[i]) * (2 if square else 1)
        size_sigma_m = None if sigmas is None else sigmas.led_size * size_m
        shared: dict[str, Any] = {
            "id": int(led),
            "position_m": triple(center),
            "luminaire": None if luminaires is None else int(luminaires.of_led[i]),
            "sigma_m": None if sigmas is None else triple(sigmas.led_m),
            "gradient_sigma": None if sigmas is None else sigmas.led_gradient,
        }
        if square:
            entries.append(SquareEntry(**shared, shape="square", side_m=size_m, side_sigma_m=size_sigma_m))
        else:
            entries.append(DiscEntry(**shared, shape="disc", radius_m=size_m, radius_sigma_m=size_sigma_m))
    return tuple(entries)


def luminaire_entries(luminaires: Luminaires, sigmas: Sigmas) -> tuple[LuminaireEntry, ...]:
    """The entries of all luminaires, with the standard deviations that devices are told."""
    return tuple(
        LuminaireEntry(
            id=number,
            position_m=triple(center),
            sigma_m=triple(sigmas.luminaire_m),
            sigma_rotation_deg=triple(sigmas.luminaire_rotation_deg),
        )
        for number, center in enumerate(luminaires.centers_m)
    )


def map_datum_entry(sigmas: Sigmas) -> MapDatumEntry:
    """The standard deviations of the map as a whole that devices are told."""
    return MapDatumEntry(sigma_m=triple(sigmas.datum_m), scale_sigma_ppm=sigmas.datum_scale_ppm)
