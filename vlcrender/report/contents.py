"""Contents of a dataset as its page needs them: tables, previews, and errors of what devices are told."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vlcrender.dataset.format.files import read_dataset_file
from vlcrender.dataset.format.rows import DeviceTruthRow, FrameRow, MapTruthRow, TruthRow
from vlcrender.dataset.format.schema import DatasetFile
from vlcrender.dataset.format.tables import read_table
from vlcrender.dataset.recipe.sweep import SWEEP_FILE, sweep_columns
from vlcrender.errors import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Contents:
    """A dataset: dataset.json, its rows, and the SHA-256 of frames.parquet. Without a truth its rows are empty."""

    directory: Path
    dataset: DatasetFile
    frames: list[FrameRow]
    truth: list[TruthRow]
    devices: list[DeviceTruthRow]
    built: list[MapTruthRow]
    digest: str

    @classmethod
    def read(cls, directory: Path) -> "Contents":
        """Read a dataset. Raises InputError where it is no complete one, or a table is damaged."""
        if (directory / SWEEP_FILE).is_file():
            raise InputError(f"{directory}: is a sweep; give one of its cells, such as {directory / 'cells/000000'}")
        dataset = read_dataset_file(directory)
        columns = sweep_columns(dataset.provenance.get("sweep") or {})
        truth, devices, built = (directory / f"{name}.parquet" for name in ("truth", "truth_devices", "truth_map"))
        return cls(
            directory=directory,
            dataset=dataset,
            frames=read_table(directory / "frames.parquet", FrameRow),
            truth=read_table(truth, TruthRow, columns) if truth.is_file() else [],
            devices=read_table(devices, DeviceTruthRow) if devices.is_file() else [],
            built=read_table(built, MapTruthRow) if built.is_file() else [],
            digest=hashlib.sha256((directory / "frames.parquet").read_bytes()).hexdigest(),
        )

    def positions_m(self) -> Floats:
        """True positions (n, 3) of the frames' cameras."""
        return np.array([row.position_m for row in self.truth]).reshape(-1, 3)

    def axes(self) -> Floats:
        """Directions (n, 3) of the true optical axes, world."""
        return np.array([row.R_cam_world[6:] for row in self.truth]).reshape(-1, 3)

    def leds_m(self) -> Floats:
        """Told positions (n, 3) of the LEDs; empty where no map is given."""
        return np.array([led.position_m for led in self.dataset.led_map or ()]).reshape(-1, 3)

    def gravity_errors_deg(self) -> Floats:
        """Angles between readings of the accelerometer and the true vertical, degrees; none without readings."""
        frames, found = {frame.frame: frame for frame in self.frames}, []
        for row in self.truth:  # where some is withheld, not of every frame
            frame = frames.get(row.frame)
            if frame is not None and frame.accelerometer_m_s2 is not None:
                reading, up = np.array(frame.accelerometer_m_s2), np.array(row.R_cam_world).reshape(3, 3)[:, 2]
                found.append(np.degrees(np.arctan2(np.linalg.norm(np.cross(reading, up)), reading @ up)))
        return np.array(found)

    def bounds_m(self) -> Floats:
        """Roots of the traces of the Cramer-Rao bounds, metres, of the frames that have one."""
        return np.array([np.sqrt(sum(row.bound_m2[::4])) for row in self.truth if row.bound_m2 is not None])

    def distances_m(self) -> Floats:
        """Mean distance to the LEDs in view, by the told map, of each frame that has one."""
        told = {led.id: np.array(led.position_m) for led in self.dataset.led_map or ()}
        means = []
        for row in self.truth:
            seen = [told[led.led] for led in row.leds if led.visible_fraction > 0 and led.led in told]
            if seen:
                means.append(float(np.linalg.norm(np.array(seen) - row.position_m, axis=1).mean()))
        return np.array(means)

    def told_and_true(self) -> list[tuple[str, str, str]]:
        """Differences of the true camera and map from the told ones: what, root mean square, largest; none without."""
        found: list[tuple[str, Floats, str]] = []
        if self.devices:
            told = [np.array(self.dataset.cameras[row.camera].K) for row in self.devices]
            true = [np.reshape(row.K, (3, 3)) for row in self.devices]
            focal = [100 * (b[0, 0] + b[1, 1]) / (a[0, 0] + a[1, 1]) - 100 for a, b in zip(told, true, strict=True)]
            centre = [b[:2, 2] - a[:2, 2] for a, b in zip(told, true, strict=True)]
            found += [("focal length", np.array(focal), "%"), ("image centre, u and v", np.array(centre).ravel(), "px")]
            tilts = [error for row in self.devices if row.tilt_error_deg is not None for error in row.tilt_error_deg]
            found.append(("accelerometer, part that stays with a device", np.array(tilts), "°"))
        told_m = {led.id: np.array(led.position_m) for led in self.dataset.led_map or ()}
        off_m = [np.array(row.position_m) - told_m[row.led] for row in self.built if row.led in told_m]
        if off_m:
            off = np.array(off_m)
            found += [("LEDs, x and y", 1e3 * off[:, :2].ravel(), "mm"), ("LEDs, height", 1e3 * off[:, 2], "mm")]
        return [
            (name, f"{np.sqrt(np.mean(values**2)):.3g} {unit}", f"{np.abs(values).max():.3g} {unit}")
            for name, values, unit in found
            if len(values)
        ]
