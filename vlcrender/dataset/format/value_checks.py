"""Checks of a dataset's values that join several of them, by their numbers in the section Checks of FORMAT.md."""

from collections.abc import Sequence
from itertools import pairwise

from vlcrender.dataset.format.camera_entries import CameraEntry, SensorEntry
from vlcrender.dataset.format.exr import ExrPart
from vlcrender.dataset.format.rows import FrameRow, TruthRow
from vlcrender.dataset.format.schema import DatasetFile
from vlcrender.dataset.format.values import MAX_ANGLE_DEG, MAX_VISIBLE, is_covariance, is_rotation, repeated

MAX_SENSOR_AREAS = 16
"""Check 14: upper limit of the pixels in all regions of a frame, in sensor areas."""


def row_problems(frames: Sequence[FrameRow], dataset: DatasetFile) -> list[str]:
    """Contradictions of the rows of frames.parquet with each other and dataset.json (checks 10 and 11), a line each."""
    ids = None if dataset.led_map is None else {led.id for led in dataset.led_map}
    problems = [f"frames.parquet: frame {row.frame}: {problem}" for row in frames for problem in _spots(row, ids)]
    if frames and (frames[0].shot, frames[0].burst) != (0, 0):
        problems.append("frames.parquet: frame 0: shots and bursts are numbered 0, 1, 2, ... in order")
    for before, row in pairwise(frames):
        where, same = f"frames.parquet: frame {row.frame}", row.burst == before.burst
        if row.shot - before.shot not in (0, 1) or row.burst - before.burst not in (0, 1):
            problems.append(f"{where}: shot {row.shot}, burst {row.burst}: are numbered 0, 1, 2, ... in order")
        if row.shot == before.shot and not same:
            problems.append(f"{where}: burst {row.burst}, but its shot {row.shot} is of burst {before.burst}")
        if same and row.device != before.device:
            problems.append(f"{where}: device {row.device}, but its burst is of device {before.device}")
        if same and row.shot != before.shot and not row.start_s > before.start_s:
            problems.append(f"{where}: start_s = {row.start_s}: is not after the shot before in its burst")
    return problems


def _spots(row: FrameRow, ids: set[int] | None) -> list[str]:
    """Decoded identities that are there twice or not in the map; `ids` is None where no map is told."""
    problems = []
    if (led := repeated(spot.led for spot in row.spots)) is not None:
        problems.append(f"spots: LED {led} is decoded twice")
    unknown = {spot.led for spot in row.spots} - (ids or set())
    if unknown:
        problems.append(f"spots: LED {min(unknown)} is not in led_map")
    return problems


def truth_problem(row: TruthRow) -> str | None:
    """What is wrong with the values of a row of truth.parquet (check 12), None if nothing."""
    where = f"truth.parquet: frame {row.frame}"
    if not is_rotation(row.R_cam_world):
        return f"{where}: R_cam_world is not a rotation"
    for name in ("tilt_x_deg", "tilt_y_deg", "yaw_deg"):
        if not abs(angle := getattr(row, name)) <= MAX_ANGLE_DEG:
            return f"{where}: {name} = {angle}: exceeds {MAX_ANGLE_DEG:g} deg"
    for led in row.leds:
        if not 0 <= led.visible_fraction <= MAX_VISIBLE:
            return f"{where}: LED {led.led}: visible_fraction = {led.visible_fraction}: has to be from 0 to 1"
    for name in ("bound_m2", "bound_exact_m2"):
        bound = getattr(row, name)
        if bound is not None and not is_covariance(bound):
            return f"{where}: {name} is not a symmetric, positive definite matrix"
    return None


def image_problem(parts: Sequence[ExrPart], camera: CameraEntry, sensor: SensorEntry) -> str | None:
    """What is wrong with the size and numbers of a frame's regions (check 14), None if nothing."""
    pixels = sum(part.roi.pixels for part in parts)
    if pixels > MAX_SENSOR_AREAS * camera.width_px * camera.height_px:
        return f"{pixels} pixels, more than {MAX_SENSOR_AREAS} times the sensor's"
    largest = max(part.largest for part in parts)
    if largest > 2**sensor.bits - 1:
        return f"digital number {largest:.0f}: {sensor.bits} bits end at {2**sensor.bits - 1}"
    return None
