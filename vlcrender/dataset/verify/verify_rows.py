"""Verification of the tables' rows against the recipe of the provenance: numbering, times, readings and identities."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from pydantic import ValidationError

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.rig import MAIN
from vlcrender.dataset.format.files import FRAMES
from vlcrender.dataset.format.rows import FrameRow, TruthRow
from vlcrender.dataset.format.schema import DatasetFile
from vlcrender.dataset.recipe.file_settings import FileSettings
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.dataset.world.downlink import ROUGH_PX
from vlcrender.dataset.world.true_world import device_of_pose, gyro_rad_s, map_of_device, reading_m_s2
from vlcrender.errors import InputError

MAX_TIME_ERROR_S = 1e-9
"""Rounding of start times: a double of 10^6 s has steps of 1e-10 s."""
MAX_READING_ERROR = 1e-9
"""Rounding of readings, m/s2 and rad/s: a pose has been through a rotation matrix."""
MAX_SPOT_SIGMAS = 8.0
"""A decoded pixel is further off than this once in 10^15 times."""


def recipe_of(dataset: DatasetFile) -> Recipe | None:
    """The recipe of the provenance; None where it is withheld or not there. Raises InputError where it is no recipe."""
    tree = dataset.provenance.get("recipe")
    if tree is None or dataset.withheld is not None:
        return None
    try:
        return Recipe.model_validate({**tree, "seed": int(tree["seed"])})
    except (ValidationError, ValueError, KeyError, TypeError) as error:
        text = " ".join(str(error).split())[:200]
        raise InputError(f"dataset.json: provenance.recipe: is no recipe: {text}") from None


def row_problems(row: FrameRow, truth: TruthRow | None, recipe: Recipe) -> list[str]:
    """Contradictions of a row of frames.parquet, and of truth.parquet's row of the frame, with the recipe."""
    where = f"frames.parquet: frame {row.frame}"
    number = recipe.first_shot * len(recipe.cameras) + row.frame
    pose, shot, which = recipe.place_of_frame(number)
    device, shots = device_of_pose(recipe, pose), shot - recipe.first_shot
    wanted: dict[str, Any] = {
        "shot": shots,
        "burst": shots // recipe.burst_frames,
        "pose": pose - recipe.pose_numbers.start,
        "device": device,
        "camera": recipe.cameras[which].name,
    }
    found = [(key, getattr(row, key), value) for key, value in wanted.items()]
    problems = [f"{where}: {key} is {own!r}; the recipe gives {value!r}" for key, own, value in found if own != value]
    lowest_s, highest_s = (0.0, recipe.max_exposure_s) if recipe.metering is not None else (recipe.max_exposure_s,) * 2
    if not (lowest_s * (1 - 1e-9) <= row.exposure_s <= highest_s * (1 + 1e-9) and row.exposure_s > 0):
        problems.append(f"{where}: exposure_s = {row.exposure_s}: the recipe gives {lowest_s} to {highest_s}")
    if truth is not None:
        problems += _truth_row_problems(truth, shots, map_of_device(recipe, device), recipe)
        problems += _spot_problems(row, truth, recipe, which)
    return problems


def file_problems(row: FrameRow, files: FileSettings) -> list[str]:
    """Contradictions of a frame's file and part with [files] of the recipe."""
    where, per_file = f"frames.parquet: frame {row.frame}", files.frames_per_file
    stem = f"{row.frame:06d}" if per_file == 1 else f"shard-{row.frame // per_file:06d}"
    wanted = f"{FRAMES}/{stem}{PurePosixPath(row.file).suffix}"
    problems = [] if row.file == wanted else [f"{where}: file is {row.file!r}; the recipe gives {wanted!r}"]
    if (row.part is None) != (per_file == 1):
        problems.append(f"{where}: part is {row.part}, and files hold {per_file} frames")
    return problems


def split_problem(row: FrameRow, truth: TruthRow | None, recipe: Recipe, room_m: Sequence[float]) -> list[str]:
    """A line where a frame is in another split than its place gives; of frames whose truth has the pose's own place."""
    wanted = None
    if recipe.split is not None:
        if truth is None or recipe.motion is not None or recipe.belief is not None or row.camera != MAIN:
            return []
        wanted = recipe.split.name_at(truth.position_m, np.array(room_m), recipe.seed)
    if row.split == wanted:
        return []
    return [f"frames.parquet: frame {row.frame}: split is {row.split!r}; place and seed give {wanted!r}"]


def start_problem(row: FrameRow, recipe: Recipe, is_modulated: bool) -> list[str]:
    """A line where a frame does not start when the seed says; is_modulated: whether LEDs of its scene are."""
    wanted_s = recipe.start_s(recipe.first_shot + row.shot, is_modulated)
    if abs(row.start_s - wanted_s) <= MAX_TIME_ERROR_S:
        return []
    return [f"frames.parquet: frame {row.frame}: start_s = {row.start_s}: the recipe and seed give {wanted_s}"]


def _truth_row_problems(truth: TruthRow, shot: int, map_number: int, recipe: Recipe) -> list[str]:
    """Contradictions of a row of truth.parquet with the recipe; `shot` and `map_number` of its frame."""
    where = f"truth.parquet: frame {truth.frame}"
    problems = []
    if (truth.shot, truth.map) != (shot, map_number):
        problems.append(f"{where}: shot {truth.shot} and map {truth.map}: the recipe gives {shot} and {map_number}")
    moves = recipe.motion is not None
    if {truth.angular_velocity_rad_s is not None, truth.linear_velocity_m_s is not None} != {moves}:
        problems.append(f"{where}: velocities and [motion] of the recipe: one is null")
    adds = recipe.added_noise is not None and recipe.added_noise.metering is None
    if (truth.added_noise_dn is not None) != adds or (truth.added_noise_dn or 0) < 0:
        problems.append(f"{where}: added_noise_dn = {truth.added_noise_dn}: contradicts [added_noise] of the recipe")
    ids = [led.led for led in truth.leds]
    if ids != sorted(set(ids)):
        problems.append(f"{where}: LEDs are not each once, in the order of their ids")
    # Sums of shares of pixels: rounding may exceed 1.
    if not all(0 <= led.visible_fraction <= 1 + 1e-9 for led in truth.leds):
        problems.append(f"{where}: a visible_fraction is not from 0 to 1")
    for name, bound in (("bound_m2", truth.bound_m2), ("bound_exact_m2", truth.bound_exact_m2)):
        if bound is None:
            continue
        matrix = np.reshape(bound, (3, 3))
        # A sum of products, in another order on both sides of the diagonal.
        is_symmetric = np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-9 * float(np.abs(matrix).max()))
        if not recipe.bound or not is_symmetric or not (np.diag(matrix) > 0).all():
            problems.append(f"{where}: {name} is no covariance, or the recipe has no bound = true")
    return problems


def _spot_problems(row: FrameRow, truth: TruthRow, recipe: Recipe, which: int) -> list[str]:
    """Decoded identities that no LED of the truth explains, or that are missing; of identities that are given."""
    if recipe.demodulation != "given":
        return []
    where = f"frames.parquet: frame {row.frame}"
    leds = {led.led: led for led in truth.leds}
    limit_px = MAX_SPOT_SIGMAS * ROUGH_PX * recipe.cameras[which].camera.width_px / 4000
    for spot in row.spots:
        led = leds.get(spot.led)
        if led is None or not max(abs(spot.u_px - led.u_px), abs(spot.v_px - led.v_px)) <= limit_px:
            return [f"{where}: spot of LED {spot.led}: truth.parquet has no such LED within {limit_px:g} px"]
    missing = {led.led for led in truth.leds if led.visible_fraction >= 1} - {spot.led for spot in row.spots}
    if missing and recipe.regions is None:
        return [f"{where}: has no spot of LED {min(missing)}, which is whole in the frame"]
    return []


def reading_problems(frames: Sequence[FrameRow], truth: Sequence[TruthRow], recipe: Recipe) -> list[str]:
    """Rows of frames.parquet whose accelerometer or gyroscope does not read what seed and truth give.

    Frames of whose shot the truth has no row of the camera `main` are left out.
    """
    poses = {row.frame: Pose(row.position_m, row.tilt_x_deg, row.tilt_y_deg, row.yaw_deg) for row in truth}
    problems = []
    for row in frames:
        shot = recipe.first_shot + row.shot
        number = recipe.first_shot * len(recipe.cameras) + row.frame
        pose_number, _, which = recipe.place_of_frame(number)
        device, told = device_of_pose(recipe, pose_number), recipe.cameras[which]
        main = poses.get(row.frame - which)
        if main is not None:
            wanted = told.rotation @ reading_m_s2(recipe, device, shot, main)
            if not np.abs(np.subtract(row.accelerometer_m_s2, wanted)).max() <= MAX_READING_ERROR:
                problems.append(f"frames.parquet: frame {row.frame}: accelerometer_m_s2 is not that of pose and seed")
        if recipe.gyroscope is not None and row.gyro_rad_s is not None:
            wanted = told.rotation @ gyro_rad_s(recipe, recipe.gyroscope, device, shot)
            if not np.abs(np.subtract(row.gyro_rad_s, wanted)).max() <= MAX_READING_ERROR:
                problems.append(f"frames.parquet: frame {row.frame}: gyro_rad_s is not that of motion and seed")
    return problems


def time_problems(frames: Sequence[FrameRow], dataset: DatasetFile) -> list[str]:
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
