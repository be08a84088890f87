"""The dataset that is exported: description, rows, truth and images, checked as they are read."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.digest import sha256_of
from vlcrender.dataset.format.camera_entries import CameraEntry
from vlcrender.dataset.format.files import read_dataset_file
from vlcrender.dataset.format.frame_files import read_frame_parts
from vlcrender.dataset.format.rows import FrameRow, MapTruthRow, TruthRow, five
from vlcrender.dataset.format.schema import DatasetFile
from vlcrender.dataset.format.shard import parts_of_frame
from vlcrender.dataset.format.tables import read_table
from vlcrender.dataset.recipe.sweep import SWEEP_FILE, sweep_columns
from vlcrender.errors import InputError
from vlcrender.export.conventions import Array, Five, Intrinsics

MAX_PNG_DN = 65535


@dataclass(frozen=True)
class LedPoint:
    """An LED of a map as built."""

    led: int
    position_m: Array
    """Centre (3,), world."""
    shape: str | None
    """"disc" or "square"; None where the set does not state it."""
    size_m: float
    """Radius of a disc, side of a square."""


@dataclass(frozen=True)
class FrameImage:
    """A frame as an image of the whole sensor."""

    dn: NDArray[np.uint32]
    """Digital numbers (height, width); 0 where a pixel was not read out."""
    is_read: NDArray[np.bool_] | None
    """Pixels (height, width) that were read out; None where all were."""


@dataclass(frozen=True)
class Source:
    """A complete dataset. `to` is the name of the format that it is exported to, for messages."""

    directory: Path
    to: str
    dataset: DatasetFile
    frames: list[FrameRow]
    withheld: bool
    """Whether the truth of some frames is sealed."""
    _parts: Any = field(default_factory=lambda: lru_cache(maxsize=1)(read_frame_parts), repr=False)

    @classmethod
    def open(cls, directory: Path, to: str, needs_truth: bool) -> "Source":
        """Read dataset.json and frames.parquet.

        Raises InputError where the folder holds no complete dataset, or where the format needs a truth that is withheld
        or missing.
        """
        if (directory / SWEEP_FILE).is_file():
            raise InputError(f"{directory}: is a sweep; export its cells one by one, such as {directory}/cells/000000")
        withheld = _is_withheld(directory)
        if needs_truth and withheld:
            raise InputError(f"{directory}: its truth is withheld; {to} holds the truth: export png16 or webdataset")
        dataset = read_dataset_file(directory)
        if needs_truth and not (directory / "truth.parquet").is_file():
            raise InputError(f"{directory}: has no truth.parquet; {to} needs it: export png16 or webdataset")
        frames = read_table(directory / "frames.parquet", FrameRow)
        return cls(directory, to, dataset, frames, withheld)

    @property
    def has_truth(self) -> bool:
        """Whether the truth of all frames is there."""
        return not self.withheld and (self.directory / "truth.parquet").is_file()

    @cached_property
    def truth(self) -> list[TruthRow]:
        """Rows of truth.parquet, in the order of `frames`. Raises InputError where they do not match."""
        path = self.directory / "truth.parquet"
        rows = read_table(path, TruthRow, sweep_columns(self.dataset.provenance.get("sweep") or {}))
        if [row.frame for row in rows] != [row.frame for row in self.frames]:
            raise InputError(f"{path}: its frames differ from those of frames.parquet")
        return rows

    @property
    def posed_frames(self) -> Iterator[tuple[FrameRow, TruthRow]]:
        """Rows of both tables, frame by frame."""
        return zip(self.frames, self.truth, strict=True)

    @cached_property
    def maps(self) -> dict[int, dict[int, LedPoint]]:
        """True LEDs by id, of each map."""
        told = {led.id: led for led in self.dataset.led_map or ()}
        path = self.directory / "truth_map.parquet"
        if not path.is_file():
            return {0: {led.id: _point(led) for led in told.values()}}
        maps: dict[int, dict[int, LedPoint]] = {}
        for row in read_table(path, MapTruthRow):
            shape = told[row.led].shape if row.led in told else None
            maps.setdefault(row.map, {})[row.led] = LedPoint(row.led, np.array(row.position_m), shape, row.size_m)
        return maps

    def led(self, row: TruthRow, led: int) -> LedPoint:
        """An LED of the map that a frame shows. Raises InputError for an LED that is not in it."""
        try:
            return self.maps[row.map][led]
        except KeyError:
            raise InputError(f"{self.directory}: frame {row.frame}: LED {led} is not in map {row.map}") from None

    def told_camera(self, name: str) -> Intrinsics:
        """A camera as its device is told."""
        entry = self.camera_entry(name)
        return _intrinsics(name, entry, np.array(entry.K), five(entry.distortion))

    def true_camera(self, frame: FrameRow, truth: TruthRow) -> Intrinsics:
        """The camera that made a frame."""
        matrix = np.reshape(truth.K, (3, 3))
        return _intrinsics(frame.camera, self.camera_entry(frame.camera), matrix, truth.distortion)

    def camera_entry(self, name: str) -> CameraEntry:
        """A camera in dataset.json. Raises InputError for a name that is not there."""
        if name not in self.dataset.cameras:
            raise InputError(f"{self.directory / 'frames.parquet'}: camera {name!r} is not in dataset.json")
        return self.dataset.cameras[name]

    def check_one_pose_a_frame(self) -> None:
        """Raise InputError where lines of a frame have different poses: a rolling shutter on a moving rig."""
        moving = any(row.angular_velocity_rad_s is not None for row in self.truth)
        rolling = [name for name, entry in self.dataset.cameras.items() if entry.shutter.kind == "rolling"]
        if moving and rolling:
            raise InputError(
                f"{self.to}: camera {rolling[0]} has a rolling shutter and moves; {self.to} has one pose a frame: "
                "export tum or csv"
            )

    @cached_property
    def has_clock(self) -> bool:
        """Whether frames have times on the rig's clock; else their shots are 1 s apart, by `time_s`."""
        return any(row.start_s != 0 for row in self.frames)

    def time_s(self, row: FrameRow) -> float:
        """Middle of a frame on the rig's clock, s; the number of its shot where the set has no clock."""
        if not self.has_clock:
            return float(row.shot)
        entry = self.camera_entry(row.camera)
        lines = entry.shutter.line_count(entry.width_px, entry.height_px)
        return row.start_s + (lines - 1) / 2 * entry.shutter.row_time_s + row.exposure_s / 2

    def image(self, row: FrameRow) -> FrameImage:
        """A frame's image.

        Raises InputError for a file that is damaged, and for regions that extend beyond the sensor.
        """
        entry = self.camera_entry(row.camera)
        if not row.capturable:
            raise InputError(
                f"{self.to}: frame {row.frame} has regions beyond the sensor (overscan): no image has them"
            )
        path = self.directory / row.file
        if not path.is_file() or self._digest(path) != row.sha256:
            raise InputError(f"{path}: is missing or damaged: its SHA-256 differs from frames.parquet")
        shape = entry.height_px, entry.width_px
        parts = self._parts(path)
        if row.part is not None:
            parts = parts_of_frame(parts, row.frame, row.part)
        if len(parts) == 1 and parts[0].image.shape == shape:
            return FrameImage(np.rint(parts[0].image).astype(np.uint32), None)
        dn, is_read = np.zeros(shape, np.uint32), np.zeros(shape, np.bool_)
        for part in parts:
            roi = part.roi
            place = slice(roi.row, roi.row + roi.rows), slice(roi.column, roi.column + roi.columns)
            dn[place], is_read[place] = np.rint(part.image), True
        return FrameImage(dn, is_read)

    @cached_property
    def _digest(self) -> Any:
        return lru_cache(maxsize=1)(sha256_of)  # frames of a shard follow each other

    def image_16bit(self, row: FrameRow) -> tuple[NDArray[np.uint16], NDArray[np.bool_] | None]:
        """A frame's digital numbers, unscaled. Raises InputError as `image`, and for numbers above 65535."""
        image = self.image(row)
        if (most := int(image.dn.max())) > MAX_PNG_DN:
            raise InputError(f"{self.to}: frame {row.frame} has the digital number {most}; 16 bits end at {MAX_PNG_DN}")
        return image.dn.astype(np.uint16), image.is_read

    def image_8bit(self, row: FrameRow) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
        """A frame's digital numbers times 255 / (2^bits - 1), rounded: a picture, linear. Raises InputError."""
        image = self.image(row)
        scaled = np.rint(np.minimum(image.dn * self.scale_8bit, 255.0))
        return scaled.astype(np.uint8), image.is_read

    @property
    def scale_8bit(self) -> float:
        """Factor of `image_8bit`."""
        return 255.0 / float(2**self.dataset.sensor.bits - 1)


def _is_withheld(directory: Path) -> bool:
    """Whether dataset.json says that some truth is sealed; False where it cannot be read."""
    try:
        tree = json.loads((directory / "dataset.json").read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError):
        return False
    return isinstance(tree, dict) and tree.get("withheld") is not None


def _intrinsics(name: str, entry: CameraEntry, matrix: Array, distortion: Five | None) -> Intrinsics:
    (fx, skew, cx), (_, fy, cy), _ = matrix.tolist()
    return Intrinsics(name, entry.width_px, entry.height_px, fx, fy, cx, cy, skew, entry.projection, distortion)


def _point(led: Any) -> LedPoint:
    size_m = led.radius_m if led.shape == "disc" else led.side_m
    return LedPoint(led.id, np.array(led.position_m), led.shape, size_m)
