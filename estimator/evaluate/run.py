"""Run of variants over a dataset or all datasets of a sweep, which writes their estimates."""

import logging
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from itertools import chain, groupby
from pathlib import Path

from estimator.errors import InputError
from estimator.evaluate.batch import estimate_frames, steps
from estimator.evaluate.workers import estimate_with_workers
from estimator.io.dataset import Dataset, iter_frames, read_device
from estimator.io.estimates import EstimateRow, estimates_file, estimates_path, frames_sha256
from estimator.io.lock import locked
from estimator.io.results import dataset_folder, make_results_folder
from estimator.io.sweep import dataset_folders
from estimator.methods.registry import Registry, variants
from estimator.methods.variant import Variant

logger = logging.getLogger(__name__)


def run(
    directory: str | Path,
    variants: Sequence[str | Variant] | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
    out: str | Path | None = None,
) -> dict[str, tuple[EstimateRow, ...]]:
    """Estimate every frame of a dataset, and write estimates/VARIANT.parquet for each variant.

    Of a sweep every cell is estimated, all by the same processes, and each has estimates of its own.

    A variant that uses all frames of a device (`self-calibrated`) gets them by the column `device` of the frames. No
    variant gets the truth.

    Parameters
    ----------
    directory
        Folder of the dataset, or of a sweep.
    variants
        Names of variants, or Variant objects; those that run by default if None.
    workers
        Number of processes; the estimates do not depend on it. More than 1 needs variants given by name.
    progress
        Called with (frames done, frames in all) at the start and after every frame. Where a variant uses all frames
        of a device, each frame counts twice: as its image is done, and as the frames of its device are.
    out
        Folder for the estimates where the dataset's own is not to be written: made, or one with results of the same
        dataset. `score` and the other commands take it in place of the dataset.

    Returns
    -------
    dict
        Rows by variant name, one a frame, in order; of a sweep, cell after cell. A frame without a position has
        `status` "failed" and a `reason`.

    Raises
    ------
    InputError
        The dataset cannot be read, the files of all frames are missing, a variant is unknown, another run uses the
        folder, or a worker process died.
    OSError
        The estimates cannot be written.
    """
    rows: dict[str, list[EstimateRow]] = {}

    def keep(name: str, some: Sequence[EstimateRow]) -> None:
        rows.setdefault(name, []).extend(some)

    write_run(directory, keep, variants, workers, progress, out)
    return {name: tuple(of_variant) for name, of_variant in rows.items()}


def write_run(
    directory: str | Path,
    on_rows: Callable[[str, Sequence[EstimateRow]], None],
    variants: Sequence[str | Variant] | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
    out: str | Path | None = None,
) -> None:
    """`run` that keeps no row: `on_rows` is called with each variant's name and no rows, then with some in order."""
    if workers < 1:
        raise InputError(f"workers {workers}: is not 1 or more")
    folder = Path(directory)
    chosen = _chosen(variants)
    for name in chosen:
        estimates_path(folder, name)
    home = folder if out is None or os.path.realpath(out) == os.path.realpath(folder) else Path(out)
    if home != folder:
        dataset_folders(folder)  # refuses a damaged sweep before the folder is made
        make_results_folder(home, dataset_folder(folder))
    with locked(home, "estimator run"):
        _run(folder, home, chosen, workers, progress, on_rows)


def _run(
    folder: Path,
    home: Path,
    chosen: dict[str, Variant],
    workers: int,
    progress: Callable[[int, int], None] | None,
    on_rows: Callable[[str, Sequence[EstimateRow]], None],
) -> None:
    """`write_run`, with the estimates in the folder `home`, which is locked."""
    cells = dataset_folders(folder)
    homes = [home / os.path.relpath(cell, folder) for cell in cells]
    # A cell that cannot be read is refused before the first frame is estimated.
    frames = 0
    digests = []
    for cell, of_cell in zip(cells, homes, strict=True):
        dataset, frame_count = read_device(cell)
        _check_files(dataset, frame_count)
        digests.append(frames_sha256(dataset.folder))
        if of_cell != cell and of_cell != home:
            make_results_folder(of_cell, dataset.folder)
        _check_writable(of_cell)
        frames += frame_count
    done, total = 0, frames * steps(chosen.values())

    def on_frame() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    if progress is not None:
        progress(0, total)
    datasets = ((dataset, iter_frames(dataset, count)) for dataset, count in map(read_device, cells))
    if workers > 1:
        _check_registered(chosen)
        parts = estimate_with_workers(datasets, list(chosen), min(workers, frames), on_frame)
    else:
        parts = (
            (number, rows)
            for number, (dataset, records) in enumerate(datasets)
            for rows in estimate_frames(dataset, records, list(chosen.values()), on_frame)
        )
    for name in chosen:
        on_rows(name, ())
    with closing(parts):
        for number, of_dataset in groupby(parts, lambda part: part[0]):
            files = {name: estimates_file(homes[number], name, digests[number]) for name in chosen}
            with ExitStack() as stack:
                add = {name: stack.enter_context(file) for name, file in files.items()}
                for name, some in chain.from_iterable(rows.items() for _, rows in of_dataset):
                    add[name](some)
                    on_rows(name, some)


def _check_files(dataset: Dataset, frame_count: int) -> None:
    """Refuse a dataset of which no frame has a file: their loss is no failure of a variant. All records are checked."""
    first, found = None, False
    for record in iter_frames(dataset, frame_count):
        first = first or record.file
        found = found or (dataset.folder / record.file).is_file()
    if first is not None and not found:
        raise InputError(
            f"{dataset.folder}: the files of all {frame_count} frames are missing, the first {first}; generate or copy "
            "the dataset again"
        )


def _check_writable(folder: Path) -> None:
    """Refuse a folder that cannot be written before the first frame is estimated."""
    if not all(os.access(path, os.W_OK) for path in (folder, folder / "estimates") if path.exists()):
        raise InputError(f"{folder}: cannot be written; choose another folder for the estimates with --out")


def _chosen(selection: Sequence[str | Variant] | None) -> dict[str, Variant]:
    """Variants by name, each once; those that run by default for None."""
    if selection is None:
        found = variants()
    elif isinstance(selection, str):
        raise InputError(f"variants {selection!r}: needed a sequence of names")
    else:
        registry = Registry.read()
        found = [registry.named(one) if isinstance(one, str) else one for one in selection]
    for variant in found:
        if (why := variant.missing()) is not None:
            if selection is not None:
                raise InputError(f"variant {variant.name}: {why}")
            logger.warning("%s will answer no frame: %s", variant.name, why)
    return {variant.name: variant for variant in found}


def _check_registered(chosen: dict[str, Variant]) -> None:
    """Raise InputError for a Variant that worker processes would not find by its name."""
    registry = Registry.read()
    for name, variant in chosen.items():
        try:
            registered = registry.named(name)
        except InputError:
            registered = None
        if registered != variant:
            raise InputError(f"variant {name}: is not registered under its name, so workers has to be 1")
