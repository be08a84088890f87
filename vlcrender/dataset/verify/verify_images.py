"""Verification of a frame's image: its digest, regions, type and header, and the LEDs of the truth in its pixels."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.roi import Roi
from vlcrender.dataset.format.camera_entries import CameraEntry
from vlcrender.dataset.format.exr import ExrPart
from vlcrender.dataset.format.files import EXPECTED
from vlcrender.dataset.format.frame_files import DTYPES
from vlcrender.dataset.format.rows import FrameRow, TruthRow
from vlcrender.dataset.format.schema import DatasetFile, DiscEntry, SquareEntry
from vlcrender.dataset.format.shard import parts_of_frame
from vlcrender.dataset.format.value_checks import image_problem
from vlcrender.dataset.verify.verify_files import FileCheck
from vlcrender.errors import InputError

MIN_RADIUS_PX = 1.5
"""Radius from which an LED image has a pixel that it covers wholly."""
BRIGHT_SIGMAS = 10.0
"""Noise of the background above which a pixel is bright."""
MIN_BRIGHT_SHARE = 0.5
"""Share of the LEDs' area from which bright pixels count as their images; share of LEDs that have to be bright."""
SAMPLED_PIXELS = 100_000
"""Pixels of a frame of which percentiles are taken."""

Parts = Callable[[Path], list[ExrPart]]


def frame_problems(
    directory: Path, row: FrameRow, truth: TruthRow | None, dataset: DatasetFile, files: FileCheck, parts_of: Parts
) -> list[str]:
    """Problems of a frame's image; at most one line. A file that `files` reports already has none.

    parts_of: reads the parts of an EXR file. Raises nothing: a file that cannot be read is a problem.
    """
    path, table = directory / row.file, directory / "frames.parquet"
    if row.camera not in dataset.cameras:
        return [f"{table}: frame {row.frame}: camera {row.camera!r} is not in dataset.json"]
    if row.file in files.damaged:
        return []
    if not path.is_file():
        return [f"{path}: is missing"]
    if files.digest(row.file) != row.sha256:
        return [f"{path}: SHA-256 differs from frames.parquet: the file or the table was changed"]
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
    dtype = DTYPES[dataset.files.format]
    if not parts or any(part.dtype != dtype or part.sensor != sensor for part in parts):
        return [f"{path}: a part is not {dtype} of a sensor of {camera.height_px, camera.width_px} pixels"]
    if any(a.overlaps(b) for i, a in enumerate(regions) for b in regions[:i]):
        return [f"{path}: regions overlap"]
    if row.capturable != all(sensor.contains(roi) for roi in regions):
        return [f"{path}: capturable is {row.capturable}, which its regions contradict"]
    problem = image_problem(parts, camera, dataset.sensor) or _header_problem(parts, row)
    if problem is not None:
        return [f"{path}: {problem}"]
    if truth is not None and not _leds_are_bright(parts, truth, camera, dataset):
        return [f"{path}: has bright pixels, and not where truth.parquet has the LEDs of frame {row.frame}"]
    return _expected_problems(directory, row, parts, files, parts_of)


def _header_problem(parts: list[ExrPart], row: FrameRow) -> str | None:
    """What the header of a part says otherwise than the frame's row; None where they agree or it says nothing."""
    wanted = {"vlcrender:frame": str(row.frame), "vlcrender:camera": row.camera}
    for part in parts:
        for key, value in wanted.items():
            found = part.attributes.get(key)
            if found is not None and found != value:
                return f"{key} of its header is {found}; frames.parquet has {value}"
        exposure = part.attributes.get("expTime")  # a float of 32 bits in an EXR, text in a PNG
        if exposure is not None and np.float32(exposure) != np.float32(row.exposure_s):
            return f"expTime of its header is {exposure}; frames.parquet has {row.exposure_s}"
    return None


def _expected_problems(
    directory: Path, row: FrameRow, parts: list[ExrPart], files: FileCheck, parts_of: Parts
) -> list[str]:
    """Problems of the noise-free image of a frame; none where there is none, which `missing_files` reports."""
    name = f"{EXPECTED}/{row.frame:06d}.exr"
    path = directory / name
    if name in files.damaged or not path.is_file():
        return []
    try:
        found = parts_of(path)
    except InputError as error:
        return [str(error)]
    if [(part.roi, part.sensor) for part in found] != [(part.roi, part.sensor) for part in parts]:
        return [f"{path}: has other regions than its frame"]
    problem = _header_problem(found, row)
    if problem is not None:
        return [f"{path}: {problem}"]
    if any(part.dtype != np.float32 or not (part.image >= 0).all() or np.isinf(part.image).any() for part in found):
        return [f"{path}: a part is not float32 of finite electrons from 0 on"]
    return []


def _leds_are_bright(parts: list[ExrPart], truth: TruthRow, camera: CameraEntry, dataset: DatasetFile) -> bool:
    """Whether the LEDs of the truth are at bright pixels, where the frame shows that it can tell.

    Asked are steady LEDs of which the map has the size, wholly visible and at least MIN_RADIUS_PX in radius. A frame
    can tell if as many pixels are bright as half of their area: then half of them have a bright pixel at their centre.
    """
    leds = {led.id: led for led in dataset.led_map or ()}
    asked: list[tuple[float, float]] = []
    area_px = 0.0
    for seen in truth.leds:
        led = leds.get(seen.led)
        if led is None or seen.phase is not None or seen.visible_fraction < 1:
            continue
        radius_px = _radius_px(led, truth, camera)
        if radius_px >= MIN_RADIUS_PX:
            asked.append((seen.u_px, seen.v_px))
            area_px += np.pi * radius_px**2
    if not asked:
        return True
    step = max(1, int(np.sqrt(sum(part.image.size for part in parts) / SAMPLED_PIXELS)))
    sampled = np.concatenate([part.image[::step, ::step].ravel() for part in parts])
    low, middle = np.percentile(sampled, [10, 50])
    # A normal distribution has its 10th percentile 1.2816 sigma below its median.
    threshold = middle + BRIGHT_SIGMAS * max((middle - low) / 1.2816, np.sqrt(max(middle, 1.0)), 1.0)
    if sum(int((part.image > threshold).sum()) for part in parts) < MIN_BRIGHT_SHARE * area_px:
        return True
    bright = [bool(near.size) and near.max() > threshold for near in (_near(parts, u, v) for u, v in asked)]
    return bool(sum(bright) >= MIN_BRIGHT_SHARE * len(asked))


def _radius_px(led: DiscEntry | SquareEntry, truth: TruthRow, camera: CameraEntry) -> float:
    """Radius of an LED image, or half the side of a square's, to first order."""
    half_m = led.radius_m if isinstance(led, DiscEntry) else led.side_m / 2
    distance_m = float(np.linalg.norm(np.subtract(led.position_m, truth.position_m)))
    return half_m / distance_m * camera.image_distance_mm * 1000 / camera.pixel_pitch_um


def _near(parts: list[ExrPart], u: float, v: float) -> NDArray[np.generic]:
    """The pixels (3, 3) about a position, or fewer at the border of a region."""
    for part in parts:
        row, column = int(v) - part.roi.row, int(u) - part.roi.column
        if 0 <= row < part.roi.rows and 0 <= column < part.roi.columns:
            return part.image[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    return np.zeros(0)
