"""Poses from files: CSV with named columns, or TUM trajectories, as the poses of a list."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from vlcrender.camera.rig import pose_of
from vlcrender.config.columns import ANGLE, LENGTH, TIME, Column, Row, read_columns, read_text
from vlcrender.config.toml_model import Settings, check
from vlcrender.errors import InputError

COLUMNS = {
    "time": Column(("timestamp", "t"), TIME),
    "x": Column(("tx",), LENGTH),
    "y": Column(("ty",), LENGTH),
    "z": Column(("tz", "height"), LENGTH),
    "tilt_x": Column((), ANGLE),
    "tilt_y": Column((), ANGLE),
    "yaw": Column((), ANGLE),
    **{name: Column() for name in ("qx", "qy", "qz", "qw")},
}
"""Columns of a CSV file, without their units."""
TUM = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
MAX_POSES = 10_000
MAX_TILT_DEG = 85.0
MAX_NORM_ERROR = 1e-2
"""Difference of a quaternion's length from 1, above which it is refused. Files have four digits or more."""


class PoseFile(Settings):
    """Poses of a file, with time stamps."""

    kind: Literal["file"]
    """How the poses are given."""
    file: str
    """Path from the recipe's folder: `.csv`, `.json`, or a TUM trajectory `.tum` or `.txt`. Attitudes are tilts and
    yaw, or the unit quaternion of the rotation from the camera (x right, y down, z forward) to the world."""
    units: Literal["m", "cm", "mm", "in", "ft"] | None = None
    """Unit of positions whose columns name none; metres for a TUM trajectory where not given."""


class _Table(Settings):
    """The key `poses` of a recipe with kind "file", checked by itself."""

    poses: PoseFile


def with_pose_file(tree: Mapping[str, Any], folder: Path, source: str) -> dict[str, Any]:
    """A recipe's tree with the poses of a file as the poses of a list.

    folder: where relative paths start. Raises InputError that names line and column.
    """
    result = dict(tree)
    poses = result.get("poses")
    if not isinstance(poses, Mapping) or poses.get("kind") != "file":
        return result
    settings = check({"poses": poses}, _Table, source).poses
    try:
        entries = read_poses(folder / settings.file, settings.units)
    except InputError as error:
        raise InputError(f"{source}: poses.file: {error}") from None
    result["poses"] = {"kind": "list", "pose": entries}
    return result


def read_poses(path: Path, units: str | None = None) -> list[dict[str, Any]]:
    """The poses of a file in its order, as entries of a list. Raises InputError that names line and column."""
    is_tum = path.suffix.lower() in (".tum", ".txt")
    rows = _tum(path, LENGTH[units or "m"]) if is_tum else read_columns(path, COLUMNS, units, "poses")
    if not 1 <= len(rows) <= MAX_POSES:
        raise InputError(f"{path}: {len(rows)} poses; 1 to {MAX_POSES} are allowed")
    timed = "time" in rows[0].cells
    entries, before = [], -math.inf
    for row in rows:
        if ("time" in row.cells) != timed:
            raise InputError(f"{row.where}: every pose has a time stamp, or none has")
        time_s = row.number("time")
        if time_s is not None and not time_s > before:
            raise InputError(f"{row.where}: time stamp {time_s!r} s does not exceed the one before, {before!r} s")
        before = before if time_s is None else time_s
        entries.append({**_pose(row), **({} if time_s is None else {"time_s": time_s})})
    return entries


def _tum(path: Path, factor: float) -> list[Row]:
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words, where = line.split(), f"{path}: line {number}"
        if not words or words[0].startswith("#"):
            continue
        if len(words) != len(TUM):
            raise InputError(f"{where}: {len(words)} numbers; a TUM line has timestamp tx ty tz qx qy qz qw")
        numbers = {}
        for name, word in zip(TUM, words, strict=True):
            try:
                numbers[name] = float(word)
            except ValueError:
                numbers[name] = math.nan
            if not math.isfinite(numbers[name]):
                raise InputError(f"{where}: {name}: {word[:40]!r} is not a finite number")
        rows.append(Row(where, {name: value * (factor if name in "xyz" else 1) for name, value in numbers.items()}))
    return rows


def _pose(row: Row) -> dict[str, Any]:
    """The entry of a row: position and tilts."""
    if missing := [axis for axis in "xyz" if axis not in row.cells]:
        raise InputError(f"{row.where}: no {missing[0]}; each pose has x, y and z")
    place = [row.number(axis) for axis in "xyz"]
    given = [name for name in ("qx", "qy", "qz", "qw") if name in row.cells]
    tilts = {name: row.number(name) or 0.0 for name in ("tilt_x", "tilt_y", "yaw")}
    if given:
        if len(given) < 4 or set(tilts) & set(row.cells):
            raise InputError(f"{row.where}: the attitude is all of qx, qy, qz, qw, or tilt_x, tilt_y, yaw")
        tilts = _tilts_deg(row, [float(row.cells[name]) for name in given])
    for name in ("tilt_x", "tilt_y"):
        if abs(tilts[name]) > MAX_TILT_DEG:
            raise InputError(f"{row.where}: {name} is {tilts[name]:.4g} deg; at most {MAX_TILT_DEG:g} to either side")
    if abs(tilts["yaw"]) > 360:
        raise InputError(f"{row.where}: yaw is {tilts['yaw']:.4g} deg; at most 360 to either side")
    return {"position_m": place, **{f"{name}_deg": value for name, value in tilts.items()}}


def _tilts_deg(row: Row, quaternion: Sequence[float]) -> dict[str, float]:
    """Tilts and yaw of a quaternion (x, y, z, w), which turns camera axes into world axes."""
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) <= MAX_NORM_ERROR:
        raise InputError(f"{row.where}: the quaternion has the length {length:.4g}; it has to be 1")
    pose = pose_of(np.zeros(3), Rotation.from_quat(quaternion).as_matrix().T)
    return {"tilt_x": pose.tilt_x_deg, "tilt_y": pose.tilt_y_deg, "yaw": pose.yaw_deg}
