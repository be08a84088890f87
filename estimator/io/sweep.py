"""Sweeps: folders of datasets that differ in the values of some settings (datasets/FORMAT.md, sweep.json)."""

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

from pydantic import Field, Strict, ValidationError, field_validator

from estimator.errors import InputError
from estimator.io.records import Row, first_problem
from estimator.io.results import dataset_folder

SWEEP = "sweep.json"
"""File that makes a folder a sweep; written last, so that it marks a complete one."""


class _Cell(Row):
    folder: str

    @field_validator("folder")
    @classmethod
    def _inside(cls, folder: str) -> str:
        path = PurePosixPath(folder)
        if not path.parts or path.is_absolute() or ".." in path.parts or "\\" in folder or "\0" in folder:
            raise ValueError("has to be a path below the sweep, with /")
        return folder


class _SweepFile(Row):
    """What a reader needs of sweep.json; the values of a cell stand in its truth.parquet too."""

    format: Literal["vlcrender-sweep"]
    version: Literal[1]
    cells: Annotated[tuple[_Cell, ...], Strict(False), Field(min_length=1)]


@dataclass(frozen=True)
class Sweep:
    """A sweep, or results of one: its folder, and the folders of its cells, each a dataset or results, in order."""

    folder: Path
    cells: tuple[Path, ...]


def read_sweep(path: str | Path) -> Sweep | None:
    """Read sweep.json of a folder, or of its results; None where there is none. Raises InputError if it is damaged."""
    folder = Path(path)
    file = dataset_folder(folder) / SWEEP
    try:
        content = file.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise InputError(f"{file}: {error.strerror or error}") from None
    try:
        found = _SweepFile.model_validate_json(content)
    except ValidationError as error:
        raise InputError(f"{file}: {first_problem(error)}") from None
    return Sweep(folder, tuple(folder / cell.folder for cell in found.cells))


def dataset_folders(path: str | Path) -> tuple[Path, ...]:
    """Folders of the datasets in a folder: the cells of a sweep, or the folder itself. Raises InputError."""
    sweep = read_sweep(path)
    return (Path(path),) if sweep is None else sweep.cells
