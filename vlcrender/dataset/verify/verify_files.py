"""Verification of a dataset's files: the seal, the manifest, each file's digest, and files that are too many."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from vlcrender.core.digest import sha256_of
from vlcrender.dataset.format.files import read_json_object
from vlcrender.dataset.format.manifest import (
    DATASET_FILE,
    MANIFEST,
    Entries,
    files_of_set,
    read_manifest,
    seal_of,
)
from vlcrender.dataset.format.schema import DatasetFile
from vlcrender.errors import InputError


@dataclass(frozen=True)
class FileCheck:
    """What the seal and the manifest say of a dataset's files."""

    directory: Path
    entries: Entries | None
    """The manifest; None where the set has none, or it is not the one that dataset.json names."""
    problems: list[str]
    """A line for each problem."""
    damaged: frozenset[str] = frozenset()
    """Files of the manifest that are missing or have another content, by their paths below the dataset."""
    is_sealed: bool = True
    """Whether dataset.json has the seal of its content."""
    _digests: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, directory: Path, dataset: DatasetFile) -> Self:
        """Check the seal, the manifest and every file that it lists."""
        path = directory / DATASET_FILE
        if dataset.manifest_sha256 is None and dataset.seal is None:
            problem = f"{path}: has no manifest_sha256: made before there were manifests; --repair checks and adds one"
            return cls(directory, None, [problem])
        is_sealed = dataset.seal == seal_of(read_json_object(path))
        problems = [] if is_sealed else [f"{path}: seal differs: the file was changed after it was written"]
        entries, more = _sealed_manifest(directory, dataset)
        if entries is None:
            return cls(directory, None, problems + more, is_sealed=is_sealed)
        check = cls(directory, entries, problems, is_sealed=is_sealed)
        found = {name: check._problem(name) for name in entries}
        problems += [line for line in found.values() if line is not None]
        problems += [
            f"{directory / name}: is not in {MANIFEST}" for name in files_of_set(directory) if name not in entries
        ]
        damaged = frozenset(name for name, line in found.items() if line is not None)
        return cls(directory, entries, problems, damaged, is_sealed, check._digests)

    def digest(self, name: str) -> str:
        """SHA-256 of a file as it is; it is read once."""
        if name not in self._digests:
            self._digests[name] = sha256_of(self.directory / name)
        return self._digests[name]

    def stems(self, folder: str) -> set[str]:
        """Names without suffix of the files of a folder: those of the manifest, or without one those that are there."""
        if self.entries is None:
            return {path.stem for path in (self.directory / folder).glob("*") if path.suffix != ".partial"}
        return {Path(name).stem for name in self.entries if name.startswith(f"{folder}/")}

    def _problem(self, name: str) -> str | None:
        """What is wrong with a file of the manifest; None where it is intact."""
        path, entries = self.directory / name, self.entries or {}
        if not _is_below(name):
            return f"{self.directory / MANIFEST}: {name!r} is no path below the dataset"
        if not path.is_file():
            return f"{path}: is missing"
        if path.stat().st_size == entries[name].bytes and self.digest(name) == entries[name].sha256:
            return None
        return f"{path}: SHA-256 differs from {MANIFEST}: the file was changed or truncated"


def _is_below(name: str) -> bool:
    """Whether a path stays below the dataset."""
    return not (Path(name).is_absolute() or ".." in Path(name).parts or "\\" in name)


def _sealed_manifest(directory: Path, dataset: DatasetFile) -> tuple[Entries | None, list[str]]:
    """The manifest that dataset.json names; else None, and the line of the problem."""
    path = directory / MANIFEST
    if not path.is_file():
        return None, [f"{path}: is missing"]
    if sha256_of(path) != dataset.manifest_sha256:
        return None, [f"{path}: SHA-256 differs from {DATASET_FILE}'s manifest_sha256: one of both was changed"]
    try:
        return read_manifest(directory), []
    except InputError as error:
        return None, [str(error)]
