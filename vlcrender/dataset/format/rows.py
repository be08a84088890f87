"""Rows of the tables of a dataset, and the record of a finished frame, as datasets/FORMAT.md has them.

The writer builds these models, the verifier reads them back, and the Arrow schemas of the tables derive from them.
"""

import re
from pathlib import PurePosixPath
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field, field_validator

from vlcrender.camera.distortion import Distortion
from vlcrender.config.toml_model import Settings
from vlcrender.dataset.format.frame_numbers import FrameNumbers
from vlcrender.dataset.format.values import (
    Count,
    Number,
    Positive,
    Triple,
)

Flat9 = tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]
"""A 3 x 3 matrix, row by row."""
Five = tuple[Number, Number, Number, Number, Number]
"""Distortion: k1, k2, k3, p1, p2."""


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
