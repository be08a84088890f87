"""Repair of a dataset: what is missing or damaged is made again of the recipe, scene and seed in dataset.json.

The manifest is the judge: a file takes the place of a damaged one only if it has the digest that the file had.
"""

import shutil
from collections.abc import Collection, Iterable
from pathlib import Path

from vlcrender.config.toml_model import check
from vlcrender.dataset.format.files import FRAMES, read_dataset_file, read_json_object, read_sweep_file, replace_durably
from vlcrender.dataset.format.layout import extra_folders
from vlcrender.dataset.format.lock import locked
from vlcrender.dataset.format.manifest import (
    DATASET_FILE,
    MANIFEST,
    Entries,
    entry_of,
    frames_per_file,
    manifest_of_files,
    read_manifest,
    seal_dataset,
    write_sealed,
)
from vlcrender.dataset.format.rows import FrameRecord
from vlcrender.dataset.format.schema import DATA_VERSION, DatasetFile
from vlcrender.dataset.recipe.plan import Plan
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.dataset.recipe.sweep import SWEEP_FILE
from vlcrender.dataset.run.frame_job import Job
from vlcrender.dataset.run.unfinished import write_tables
from vlcrender.dataset.run.workers import done_frames
from vlcrender.dataset.verify.verify import verify
from vlcrender.dataset.verify.verify_files import FileCheck
from vlcrender.dataset.verify.verify_rows import recipe_of
from vlcrender.errors import InputError
from vlcrender.scene.loader import build_scene
from vlcrender.scene.schema import SceneSettings

WORK = ".repair"
"""Folder in a dataset's folder for files that are made again; removed at the end."""
OF_ALL_FRAMES = ("frames.parquet", "truth.parquet")
"""Tables with a row for each frame."""


def repair(directory: Path, scene_folder: Path | None = None, workers: int = 1) -> list[str]:
    """Make again what is missing or damaged in a dataset, or in all cells of a sweep; a line for each file.

    scene_folder: folder of the scene file, needed where the scene has textures or furniture. Raises InputError where
    dataset.json is missing or damaged, where the files of the scene are others, and where another data_version made it;
    of a cell this is a line. Also raises it where the folder is in use.
    """
    with locked(directory, "vlcrender verify --repair"):
        return _repair(directory, scene_folder, workers)


def _repair(directory: Path, scene_folder: Path | None, workers: int) -> list[str]:
    """`repair` in a folder that is locked."""
    if not (directory / SWEEP_FILE).is_file():
        return _repaired(directory, scene_folder, workers)
    done = []
    for cell in read_sweep_file(directory).cells:
        try:
            done += [f"{cell.folder}: {line}" for line in _repaired(directory / cell.folder, scene_folder, workers)]
        except InputError as error:
            done.append(f"{cell.folder}: not repaired: {error}")
    tree = read_json_object(directory / SWEEP_FILE)
    if "seal" not in tree and len(verify(directory)) == 1:  # that the seal is missing
        write_sealed(directory / SWEEP_FILE, tree)
        done.append(f"{SWEEP_FILE}: seal added")
    return done


def _repaired(directory: Path, scene_folder: Path | None, workers: int) -> list[str]:
    """`repair` of one dataset."""
    dataset = read_dataset_file(directory)
    files = FileCheck.of(directory, dataset)
    if dataset.manifest_sha256 is None:
        if set(verify(directory)) - set(files.problems):
            return []
        seal_dataset(directory)
        return [f"{MANIFEST}: added, with the seal of {DATASET_FILE}"]
    if not files.is_sealed:
        raise InputError(
            f"{directory / DATASET_FILE}: seal differs: the file that says what the set is made of was changed; "
            "restore it from a copy, or generate the set again in another folder"
        )
    if files.entries is not None and not files.damaged:
        return []
    work = directory / WORK
    if work.exists():
        shutil.rmtree(work)
    work.mkdir()
    try:
        if files.entries is None and _is_manifest_of(directory, work, dataset):
            return [f"{MANIFEST}: made again of the files as they are"]
        plan = _plan_of(dataset, directory, scene_folder)
        return _made_again(plan, directory, work, files, dataset, workers)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _is_manifest_of(directory: Path, work: Path, dataset: DatasetFile) -> bool:
    """Whether the manifest of the files as they are is the one that dataset.json names; it is then put in its place."""
    per_file = frames_per_file(dataset.model_dump(include={"provenance"}))
    if manifest_of_files(directory, per_file, work) != dataset.manifest_sha256:
        return False
    replace_durably(work / MANIFEST, directory / MANIFEST)
    return True


def _made_again(
    plan: Plan, directory: Path, work: Path, files: FileCheck, dataset: DatasetFile, workers: int
) -> list[str]:
    """Make damaged files in the folder `work`, and replace those that have the digests of the manifest."""
    damaged: Collection[str] = files.damaged
    frames = _frames_of(damaged, plan.recipe) if files.entries is not None else range(plan.recipe.frame_count)
    folders = extra_folders(plan.recipe.expected, plan.recipe.processed is not None, plan.recipe.files)
    for name in (FRAMES, *folders):
        (work / name).mkdir()
    records = _records(plan, work, frames, workers)
    write_tables(plan, work, lambda: records)
    entries = files.entries
    if entries is None:
        if manifest_of_files(work, plan.recipe.files.frames_per_file, work) != dataset.manifest_sha256:
            return [f"{MANIFEST}: this program and its libraries make another one; nothing was changed"]
        entries = read_manifest(work)
        damaged = [name for name in entries if not _is_same(directory / name, name, entries)]
        replace_durably(work / MANIFEST, directory / MANIFEST)
    done = [] if files.entries is not None else [f"{MANIFEST}: made again"]
    for name in sorted(damaged):
        if not _is_same(work / name, name, entries):
            done.append(f"{name}: this program and its libraries make another one; it was left as it is")
            continue
        (directory / name).parent.mkdir(exist_ok=True)
        replace_durably(work / name, directory / name)
        done.append(f"{name}: made again")
    return done


def _is_same(path: Path, name: str, entries: Entries) -> bool:
    """Whether a file has the digest of the manifest."""
    return path.is_file() and entry_of(path) == entries[name]


def _frames_of(damaged: Iterable[str], recipe: Recipe) -> list[int]:
    """The frames that have to be made for some files: all of a shard; all of the set for a table of all frames."""
    per_file, numbers = recipe.files.frames_per_file, set()
    for name in damaged:
        stem = Path(name).stem
        if name in OF_ALL_FRAMES:
            return list(range(recipe.frame_count))
        if stem.removeprefix("shard-").isdecimal():
            number = int(stem.removeprefix("shard-"))
            first = number * per_file if stem.startswith("shard-") else number // per_file * per_file
            numbers |= set(range(first, min(first + per_file, recipe.frame_count)))
    return sorted(numbers)


def _records(plan: Plan, work: Path, frames: Iterable[int], workers: int) -> list[FrameRecord]:
    """Make some frames in the folder `work`; their records, in order."""
    job, of_file = Job.of(plan, work), dict[int, list[tuple[Job, int]]]()
    for frame in frames:
        of_file.setdefault(frame // plan.recipe.files.frames_per_file, []).append((job, frame))
    made = done_frames(iter(list(of_file.values())), len(of_file), workers, None, work)
    return sorted((record for _, record in made), key=lambda record: record.frame)


def _plan_of(dataset: DatasetFile, directory: Path, scene_folder: Path | None) -> Plan:
    """The plan of a dataset's provenance. Raises InputError where it has none that this program can follow."""
    path, provenance = directory / DATASET_FILE, dataset.provenance
    if dataset.withheld is not None:
        raise InputError(
            f"{directory}: its truth is withheld, and with it recipe and seed: nothing can be made again; take damaged "
            "files from a copy, or generate the set in another folder with its key file"
        )
    recipe, sources = recipe_of(dataset), provenance.get("sources") or {}
    if recipe is None or "scene" not in provenance:
        raise InputError(f"{path}: provenance has no recipe and scene to make files of")
    if provenance.get("data_version") != DATA_VERSION:
        found = provenance.get("data_version")
        raise InputError(f"{path}: data_version = {found}: this program makes the bits of data_version {DATA_VERSION}")
    if sources and scene_folder is None:
        raise InputError(f"{directory}: is made of {', '.join(sources)}: give the scene's folder with --scene-folder")
    scene = build_scene(check(provenance["scene"], SceneSettings, str(path)), str(path), scene_folder or Path())
    for name in sorted({*sources, *scene.sources}):
        if sources.get(name) != scene.sources.get(name):
            raise InputError(f"{scene.folder / name}: is not the file that {directory} is made of: SHA-256 differs")
    return Plan(recipe, scene, provenance.get("sweep") or {})
