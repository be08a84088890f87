"""Verification of a dataset on disk: each file as it was made; rows, images and truth consistent with the recipe."""

from collections.abc import Iterator, Sequence
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from vlcrender.config.toml_model import check
from vlcrender.dataset.format.files import read_dataset_file, read_json_object, read_sweep_file
from vlcrender.dataset.format.frame_files import read_frame_parts
from vlcrender.dataset.format.layout import extra_folders, missing_files
from vlcrender.dataset.format.manifest import seal_of
from vlcrender.dataset.format.rows import DeviceTruthRow, FrameRow, MapTruthRow, TruthRow
from vlcrender.dataset.format.schema import DatasetFile
from vlcrender.dataset.format.tables import Constants, read_table
from vlcrender.dataset.format.value_checks import row_problems as value_problems
from vlcrender.dataset.recipe.file_settings import FileSettings
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.dataset.recipe.sweep import SWEEP_FILE, SweepFile, sweep_columns
from vlcrender.dataset.verify.verify_files import FileCheck
from vlcrender.dataset.verify.verify_images import frame_problems
from vlcrender.dataset.verify.verify_rows import (
    file_problems,
    reading_problems,
    recipe_of,
    row_problems,
    split_problem,
    start_problem,
    time_problems,
)
from vlcrender.dataset.verify.verify_truth import (
    Positions,
    camera_of,
    device_problems,
    is_told,
    offset_in_camera,
    sealed_problems,
    true_camera_of,
    truth_problems,
    wave_problems,
    waves_of,
)
from vlcrender.dataset.world.withheld import withheld_problems
from vlcrender.errors import InputError

R = TypeVar("R", FrameRow, TruthRow)
S = TypeVar("S", DeviceTruthRow, MapTruthRow)


def verify(directory: Path) -> list[str]:
    """Problems of a dataset, or of all cells of a sweep, one line each; empty where it is complete and intact.

    Of a dataset whose truth is withheld, what needs truth, recipe, scene or seed is not checked.

    Raises InputError where there is no readable dataset.json or sweep.json, or where a dataset's camera is impossible.
    """
    if not (directory / SWEEP_FILE).is_file():
        return _problems(directory)
    sweep = read_sweep_file(directory)
    problems = list(_sweep_problems(directory, sweep))
    for cell in sweep.cells:
        folder = directory / cell.folder
        try:
            found = _problems(folder)
            values = read_dataset_file(folder).provenance.get("sweep")
        except InputError as error:
            problems.append(str(error))
            continue
        problems += found
        if values != cell.values:
            problems.append(f"{folder / 'dataset.json'}: its values are {values}; {SWEEP_FILE} has {cell.values}")
    return problems


def _sweep_problems(directory: Path, sweep: SweepFile) -> Iterator[str]:
    """Problems of sweep.json, and of folders that are too many."""
    path = directory / SWEEP_FILE
    if sweep.seal is None:
        yield f"{path}: has no seal: made before there were manifests; --repair adds one"
    elif sweep.seal != seal_of(read_json_object(path)):
        yield f"{path}: seal differs: the file was changed after it was written"
    known = {directory / cell.folder for cell in sweep.cells}
    for folder in sorted((directory / "cells").glob("*")):
        if folder not in known and not folder.name.startswith("."):
            yield f"{folder}: is not in {SWEEP_FILE}"


def _problems(directory: Path) -> list[str]:
    """`verify` of one dataset."""
    dataset = read_dataset_file(directory)
    cameras = {
        name: camera_of(entry, f"{directory / 'dataset.json'}: camera {name}")
        for name, entry in dataset.cameras.items()
    }
    file_check = FileCheck.of(directory, dataset)
    problems = list(file_check.problems)
    problems += withheld_problems(directory, dataset, file_check.damaged)
    told: Sequence[int] = range(dataset.frame_count)
    if dataset.withheld is not None:
        told = dataset.withheld.frames_with_truth(dataset.frame_count)
    frames = _read_rows(directory / "frames.parquet", FrameRow, range(dataset.frame_count), problems)
    columns = sweep_columns(dataset.provenance.get("sweep") or {})
    truth: list[TruthRow] = []
    if dataset.withheld is None or dataset.withheld.frames != "all":
        truth = _read_rows(directory / "truth.parquet", TruthRow, told, problems, columns)
    of_frame = {row.frame: row for row in truth}
    waves = cache(partial(waves_of, dataset))
    problems += value_problems(frames, dataset)
    problems += _recipe_problems(frames, truth, dataset)
    # Frames of a shard follow each other, each with its expected image.
    parts_of = lru_cache(maxsize=2)(read_frame_parts)
    for row in frames:
        problems += frame_problems(directory, row, of_frame.get(row.frame), dataset, file_check, parts_of)
    recipe = dataset.provenance.get("recipe", {})
    maps: dict[int, Positions] = {}
    if dataset.led_map is not None:
        maps[0] = {led.id: np.array(led.position_m) for led in dataset.led_map}
    devices: list[DeviceTruthRow] | None = None
    if recipe.get("belief") is not None:
        devices = _read_sealed(directory / "truth_devices.parquet", DeviceTruthRow, problems)
    if dataset.withheld is None and (recipe.get("belief") is not None or dataset.led_map is None):
        built = _read_sealed(directory / "truth_map.parquet", MapTruthRow, problems)
        problems += sealed_problems(devices, built, dataset)
        maps = {}
        for led in built:
            maps.setdefault(led.map, {})[led.led] = np.array(led.position_m)  # type: ignore[index]
    files = check(recipe.get("files", {}), FileSettings, "dataset.json: provenance.recipe.files")
    if recipe:
        problems += [problem for row in frames for problem in file_problems(row, files)]
    folders = extra_folders(bool(recipe.get("expected")), recipe.get("processed") is not None, files)
    missing = missing_files(file_check.stems, folders, range(dataset.frame_count), files)
    problems += [f"{directory / name}: is missing" for name in missing.values()]
    problems += time_problems(frames, dataset)
    row_of = {row.frame: row for row in frames}
    for pose in truth:
        frame = row_of.get(pose.frame)
        if frame is not None and dataset.withheld is None:  # the waves follow from the seed, which is withheld too
            problems += wave_problems(pose, frame.start_s, waves(pose.map))
        entry = None if frame is None else dataset.cameras.get(frame.camera)
        if frame is None or entry is None:
            problems += truth_problems(pose, None, maps, np.zeros(3))
            continue
        problems += device_problems(frame, pose, entry, dataset, devices)
        try:
            camera = cameras[frame.camera] if is_told(pose, entry) else true_camera_of(entry, pose)
        except InputError as error:
            problems.append(str(error))
            continue
        offset = offset_in_camera(frame, entry, devices)
        problems += truth_problems(pose, camera, maps, offset)
    return problems


def _recipe_problems(frames: list[FrameRow], truth: list[TruthRow], dataset: DatasetFile) -> list[str]:
    """Contradictions of the tables' rows with the recipe of the provenance; none where it has no recipe."""
    try:
        recipe: Recipe | None = recipe_of(dataset)
    except InputError as error:
        return [str(error)]
    if recipe is None:
        return []
    if dataset.frame_count != recipe.frame_count:
        return [f"dataset.json: frame_count = {dataset.frame_count}: the recipe gives {recipe.frame_count}"]
    of_frame = {row.frame: row for row in truth}
    is_modulated = cache(lambda number: bool(waves_of(dataset, number)))
    problems = []
    for row in frames:
        pose = of_frame.get(row.frame)
        problems += row_problems(row, pose, recipe) + split_problem(row, pose, recipe, dataset.room_m)
        if pose is not None:
            problems += start_problem(row, recipe, is_modulated(pose.map))
    return problems + reading_problems(frames, truth, recipe)


def _read_rows(
    path: Path, model: type[R], numbers: Sequence[int], problems: list[str], constants: Constants | None = None
) -> list[R]:
    """Rows of a table; none, and a line in `problems`, where the table is damaged."""
    try:
        rows = read_table(path, model, constants)
    except InputError as error:
        problems.append(str(error))
        return []
    if [row.frame for row in rows] != list(numbers):
        expected = f"frames 0 to {len(numbers) - 1}" if isinstance(numbers, range) else f"{len(numbers)} frames"
        problems.append(f"{path}: {len(rows)} rows; {expected} in order are expected")
        return []
    return rows


def _read_sealed(path: Path, model: type[S], problems: list[str]) -> list[S]:
    """Rows of a sealed table; none, and a line in `problems`, where it is missing or damaged."""
    try:
        return read_table(path, model)
    except InputError as error:
        problems.append(str(error))
        return []
