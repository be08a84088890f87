"""Files of a dataset: folder names, digests, JSON written whole or not at all, and dataset.json."""

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

from vlcrender.config.toml_model import S, check
from vlcrender.dataset.format.schema import FORMAT_VERSION, DatasetFile
from vlcrender.dataset.recipe.sweep import SWEEP_FILE, SWEEP_FORMAT, SWEEP_VERSION, SweepFile
from vlcrender.errors import InputError

FRAMES, EXPECTED, PREVIEWS, PROCESSED = "frames", "expected", "previews", "processed"
"""Folders with one file for each frame; `expected` and `processed` only where the recipe asks for them."""


def write_json(path: Path, tree: Mapping[str, Any]) -> None:
    """Write JSON; it appears whole or not at all. Raises InputError where it cannot be written."""
    with whole_file(path) as partial:
        partial.write_text(json.dumps(tree, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def partial_of(path: Path) -> Path:
    """Where a file is written before it has its name: a worker of a run that was killed may be writing it as well."""
    return path.with_name(f"{path.stem}.{uuid4().hex[:12]}.partial")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path to write to; the file then replaces `path`, or is removed where writing failed. Raises InputError."""
    partial = partial_of(path)
    try:
        yield partial
        replace_durably(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written: {error.strerror or first_line(str(error))}") from None


def replace_durably(partial: Path, path: Path) -> None:
    """Rename a finished file once its content is on the disk: after a power cut, `path` is the old file or the new.

    The new name is on the disk too when this returns.
    """
    with partial.open("r+b") as file:
        os.fsync(file.fileno())
    os.replace(partial, path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Bring the names of a folder's files to the disk, where its file system can."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def link_or_copy(source: Path, path: Path) -> None:
    """Make `path` the file `source`, or a copy of it where the file system cannot link; it appears whole or not at all.

    Raises InputError where it cannot be written.
    """
    with whole_file(path) as partial:
        partial.unlink(missing_ok=True)
        try:
            os.link(source, partial)
        except OSError:
            shutil.copyfile(source, partial)
    partial.unlink(missing_ok=True)  # a rename of one name of a file to another leaves both


def first_line(text: str) -> str:
    """The first line of a text, such as a library's error message."""
    return (text.splitlines() or [""])[0]


def read_dataset_file(directory: Path) -> DatasetFile:
    """Read and check dataset.json, but not its seal. Raises InputError."""
    path = directory / "dataset.json"
    if not path.is_file():
        unfinished = (directory / "plan.json").is_file()
        advice = (
            "the dataset is unfinished; run the same generate again" if unfinished else "the folder holds no dataset"
        )
        raise InputError(f"{directory}: is not a complete dataset: dataset.json is missing: {advice}")
    return _read_json(path, DatasetFile, "vlcrender-dataset", FORMAT_VERSION)


def read_sweep_file(directory: Path) -> SweepFile:
    """Read and check sweep.json. Raises InputError."""
    return _read_json(directory / SWEEP_FILE, SweepFile, SWEEP_FORMAT, SWEEP_VERSION)


def _read_json(path: Path, model: type[S], form: str, version: int) -> S:
    """The model of a JSON file with this `format` and `version`."""
    tree = read_json_object(path)
    if tree.get("format") != form:
        raise InputError(f"{path}: format = {json.dumps(tree.get('format'))}: has to be {form}")
    if tree.get("version") != version:
        found = json.dumps(tree.get("version"))
        raise InputError(f"{path}: version = {found}: this program reads version {version}; generate the dataset again")
    return check(tree, model, str(path))


def read_json_object(path: Path) -> dict[str, Any]:
    """The tree of a JSON file. Raises InputError where it cannot be read or is no object."""
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError, OSError) as error:
        raise InputError(f"{path}: cannot be read as JSON: {first_line(str(error))}") from None
    if not isinstance(tree, dict):
        raise InputError(f"{path}: is not a JSON object")
    return tree
