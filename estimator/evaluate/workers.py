"""A dataset estimated by several processes: the same answers as by one, only sooner."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import cv2

from estimator.errors import InputError
from estimator.evaluate.batch import Rows, estimate_dataset, estimate_shot, shots
from estimator.io.dataset import Dataset, FrameRecord
from estimator.io.estimates import EstimateRow
from estimator.variants.registry import Registry
from estimator.variants.variant import Variant


def estimate_with_workers(
    dataset: Dataset, names: Sequence[str], workers: int, on_frame: Callable[[], None]
) -> dict[str, tuple[EstimateRow, ...]]:
    """As `estimate_dataset`, for variants given by name, which each of `workers` processes looks up for itself.

    Raises InputError for an unknown name, and where a process dies.
    """
    registry = Registry.read()
    variants = [registry.named(name) for name in names]
    todo = shots(dataset)
    workers = min(workers, len(todo))
    if workers <= 1:
        return estimate_dataset(dataset, variants, on_frame)
    rows: Rows = {variant.name: [] for variant in variants}
    # spawn: a forked child of a process with threads may hang
    pool = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), _start, (dataset, tuple(names), max(1, _cores() // workers))
    )
    try:
        # Children start with the first task. Interrupts are the parent's, which has to live to see them out: they
        # would otherwise each print a traceback. A mask is inherited; one that came meanwhile is delivered after.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            tasks = [pool.submit(_work, records) for records in todo]
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for records, task in zip(todo, tasks, strict=True):
            for name, of_shot in task.result().items():
                rows[name] += of_shot
            for _ in records:
                on_frame()
    except BrokenProcessPool:
        raise InputError("a worker process died (out of memory?); nothing was written; try fewer --workers") from None
    finally:
        pool.shutdown(cancel_futures=True)
    return {name: tuple(of_variant) for name, of_variant in rows.items()}


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_mine: tuple[Dataset, list[Variant]]
"""A worker's own, set as it starts."""


def _start(dataset: Dataset, names: Sequence[str], threads: int) -> None:
    global _mine
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(threads)
    registry = Registry.read()
    _mine = dataset, [registry.named(name) for name in names]


def _end_with_parent() -> None:
    """Where the parent is killed, nobody would ever tell its children to stop."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(records: tuple[FrameRecord, ...]) -> Rows:
    dataset, variants = _mine
    return estimate_shot(dataset, records, variants)
