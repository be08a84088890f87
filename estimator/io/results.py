"""Folder of results: estimates and scores of a dataset or sweep that is elsewhere (datasets/FORMAT.md, Results)."""

import json
import os
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from estimator.errors import InputError
from estimator.io.atomic import write_atomically
from estimator.io.lock import LOCK
from estimator.io.records import Row, first_problem

RESULTS = "results.json"
"""File of a folder of results that names its dataset."""


class _ResultsFile(Row):
    format: Literal["estimator-results"]
    version: Literal[1]
    dataset: str


def dataset_folder(path: str | Path) -> Path:
    """Folder of the dataset, or sweep, of a folder of results; any other folder is its own. Raises InputError."""
    folder = Path(path)
    file = folder / RESULTS
    try:
        found = _ResultsFile.model_validate_json(file.read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        return folder
    except OSError as error:
        raise InputError(f"{file}: {error.strerror or error}") from None
    except ValidationError as error:
        raise InputError(f"{file}: {first_problem(error)}") from None
    if not Path(found.dataset).is_dir():
        raise InputError(f"{file}: dataset {found.dataset!r}: no such folder")
    return Path(found.dataset)


def make_results_folder(folder: Path, dataset: Path) -> None:
    """Make a folder of results of a dataset or sweep, or use the one that is there.

    Raises InputError where the folder holds anything else, and OSError.
    """
    of = os.path.abspath(dataset)
    if (folder / RESULTS).exists():
        if not os.path.samefile(dataset_folder(folder), of):
            raise InputError(f"{folder}: holds results of {dataset_folder(folder)}; choose another --out")
        return
    if folder.exists() and (not folder.is_dir() or any(path.name != LOCK for path in folder.iterdir())):
        raise InputError(f"{folder}: neither empty nor results of {dataset}; choose another --out")
    folder.mkdir(parents=True, exist_ok=True)
    tree = {"format": "estimator-results", "version": 1, "dataset": of}
    write_atomically(folder / RESULTS, json.dumps(tree, indent=1).encode() + b"\n")
