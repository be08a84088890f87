"""manifest.json, which has the digest and size of every file of a dataset, and the seal of dataset.json and sweep.json.

The seal is the SHA-256 of a JSON file's content without its key `seal`, written with sorted keys, without spaces and in
ASCII. dataset.json has the digest of manifest.json, so that its seal covers every file.
"""

import hashlib
import json
import os
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from vlcrender.config.toml_model import Settings
from vlcrender.core.digest import sha256_of
from vlcrender.dataset.format.files import read_json_object, whole_file, write_json
from vlcrender.dataset.format.rows import FileEntry
from vlcrender.errors import InputError

MANIFEST = "manifest.json"
"""File of a dataset with the digest and size of every other file."""
DATASET_FILE, JOURNAL, PLAN = "dataset.json", "journal.jsonl", "plan.json"
"""The last file of a dataset. Files of an unfinished one: a line for each frame that is done; what it is made of."""
NO_PART = (DATASET_FILE, MANIFEST, PLAN, JOURNAL, "scores.json", "report.html", "croissant.json", "README.md")
"""Files in a dataset's folder that its manifest does not list."""
ESTIMATES = "estimates"
"""Folder in a dataset's folder that `estimator` writes."""

Entries = Mapping[str, FileEntry]
"""Files by their path below the dataset, with `/`."""


class ManifestFile(Settings):
    """manifest.json."""

    files: dict[str, FileEntry]


def entry_of(path: Path) -> FileEntry:
    """Digest and size of a file as it is."""
    return FileEntry(sha256=sha256_of(path), bytes=path.stat().st_size)


def seal_of(tree: Mapping[str, Any]) -> str:
    """The seal of the tree of a JSON file: SHA-256 of its canonical JSON without the key `seal`, 64 hex digits."""
    content = {key: value for key, value in tree.items() if key != "seal"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def write_sealed(path: Path, tree: Mapping[str, Any]) -> None:
    """Write JSON with its seal; it appears whole or not at all. Raises InputError where it cannot be written."""
    content = json.loads(json.dumps(tree, allow_nan=False))
    write_json(path, {**content, "seal": seal_of(content)})


def write_manifest(directory: Path, entries: Iterable[tuple[str, FileEntry]]) -> str:
    """Write manifest.json, entry by entry, and return its SHA-256. Raises InputError where it cannot be written."""
    with whole_file(directory / MANIFEST) as partial:
        with partial.open("w", encoding="utf-8") as file:
            separator = '{"files": {\n'
            for name, entry in entries:
                file.write(f"{separator}{json.dumps(name)}: {json.dumps(entry.model_dump())}")
                separator = ",\n"
            file.write("\n}}\n")
        digest = sha256_of(partial)
    return digest


def read_manifest(directory: Path) -> dict[str, FileEntry]:
    """The entries of manifest.json. Raises InputError where it is missing or damaged."""
    path = directory / MANIFEST
    try:
        return ManifestFile.model_validate(read_json_object(path)).files
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        raise InputError(f"{path}: {'.'.join(map(str, problem['loc']))}: {problem['msg']}") from None


def files_of_set(directory: Path) -> list[str]:
    """Paths of all files in a dataset's folder that its manifest has to list, sorted.

    These are all but NO_PART, what `estimator` writes, and files and folders whose name starts with a full stop.
    """
    found = []
    for folder, folders, names in os.walk(directory):
        below = Path(folder).relative_to(directory)
        folders[:] = [name for name in folders if not name.startswith(".") and (below / name) != Path(ESTIMATES)]
        found += [(below / name).as_posix() for name in names if not name.startswith(".")]
    return sorted(set(found) - set(NO_PART))


def manifest_of_files(directory: Path, per_file: int, to: Path, without: Collection[str] = ()) -> str:
    """Write manifest.json of the files of `directory` as they are to the folder `to`; return its SHA-256.

    The order is that of every manifest. per_file: frames in each file. without: files that are left out.
    """

    def place(name: str) -> tuple[int, str]:
        """Tables first, then files by the number of their first frame."""
        folder, _, stem = name.rpartition(".")[0].rpartition("/")
        of_shard = stem.startswith("shard-")
        number = stem.removeprefix("shard-")
        if not folder or not number.isdecimal():
            return -1, name
        return int(number) * (per_file if of_shard else 1), name

    names = sorted(set(files_of_set(directory)) - set(without), key=place)
    return write_manifest(to, ((name, entry_of(directory / name)) for name in names))


def frames_per_file(tree: Mapping[str, Any]) -> int:
    """Frames in each file of the set of a dataset.json; 1 where its provenance does not say."""
    files = tree.get("provenance", {}).get("recipe", {}).get("files", {})
    return int(files.get("frames_per_file", 1))


def seal_dataset(directory: Path) -> None:
    """Write manifest.json of the files as they are, and dataset.json with its digest and a seal.

    Raises InputError where dataset.json cannot be read, or a file cannot be written.
    """
    tree = read_json_object(directory / DATASET_FILE)
    digest = manifest_of_files(directory, frames_per_file(tree), directory)
    write_sealed(directory / DATASET_FILE, {**tree, "manifest_sha256": digest})
