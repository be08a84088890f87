"""Files that scores are made of, by their digests: these decide whether scores are current, file times never."""

from collections.abc import Sequence
from pathlib import Path

from estimator.io.estimates import sha256_of
from estimator.io.results import dataset_folder

SOURCES = ("dataset.json", "frames.parquet", "truth.parquet", "truth_map.parquet")
"""Files of a dataset that scores are made of, beside estimates; of a missing one there is no digest."""


def sources_of(folder: Path, estimates: Sequence[Path]) -> dict[str, str]:
    """SHA-256 of the files that are there of those that scores are made of, by path."""
    paths = {name: dataset_folder(folder) / name for name in SOURCES}
    paths |= {f"estimates/{path.name}": path for path in estimates}
    return {name: sha256_of(path) for name, path in paths.items() if path.exists()}
