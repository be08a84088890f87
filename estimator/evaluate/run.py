"""Run of variants over a dataset or all datasets of a sweep, which writes their estimates."""

import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from estimator.errors import InputError
from estimator.evaluate.batch import estimate_dataset, steps
from estimator.evaluate.workers import estimate_with_workers
from estimator.io.dataset import read_dataset
from estimator.io.estimates import EstimateRow, estimates_path, write_estimates
from estimator.io.sweep import dataset_folders
from estimator.methods.registry import Registry, variants
from estimator.methods.variant import Variant

logger = logging.getLogger(__name__)


def run(
    directory: str | Path,
    variants: Sequence[str | Variant] | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
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

    Returns
    -------
    dict
        Rows by variant name, one a frame, in order; of a sweep, cell after cell. A frame without a position has
        `status` "failed" and a `reason`.

    Raises
    ------
    InputError
        The dataset cannot be read, a variant is unknown, or a worker process died.
    OSError
        The estimates cannot be written.
    """
    if workers < 1:
        raise InputError(f"workers {workers}: is not 1 or more")
    folder = Path(directory)
    chosen = _chosen(variants)
    for name in chosen:
        estimates_path(folder, name)
    cells = dataset_folders(folder)
    # A cell that cannot be read is refused before the first frame is estimated. Not all are in memory at a time.
    frames = 0
    for cell in cells:
        dataset = read_dataset(cell)
        frames += len(dataset.frames)
    done, total = 0, frames * steps(chosen.values())

    def on_frame() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    if progress is not None:
        progress(0, total)
    datasets = [dataset] if len(cells) == 1 else map(read_dataset, cells)
    of_cells: Iterator[dict[str, tuple[EstimateRow, ...]]]
    if workers == 1:
        of_cells = (estimate_dataset(dataset, list(chosen.values()), on_frame) for dataset in datasets)
    else:
        _check_registered(chosen)
        of_cells = estimate_with_workers(datasets, list(chosen), min(workers, frames), on_frame)
    rows: dict[str, list[EstimateRow]] = {name: [] for name in chosen}
    for cell, of_cell in zip(cells, of_cells, strict=True):
        for name, of_variant in of_cell.items():
            path = write_estimates(cell, name, of_variant)
            failed = sum(row.status == "failed" for row in of_variant)
            logger.info("%s: %d of %d frames failed, estimates in %s", name, failed, len(of_variant), path)
            rows[name] += of_variant
    return {name: tuple(of_variant) for name, of_variant in rows.items()}


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
