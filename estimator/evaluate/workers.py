"""Estimation of a dataset by several processes, with the same results as by one."""

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
from estimator.methods.registry import Registry
from estimator.methods.variant import Variant


def estimate_with_workers(
    dataset: Dataset, names: Sequence[str], workers: int, on_frame: Callable[[], None]
) -> dict[str, tuple[EstimateRow, ...]]:
    """Rows as by `estimate_dataset`, for variants given by name; each of `workers` processes looks them up itself.

    Raises InputError for an unknown name, and if a process dies.
    """
    registry = Registry.read()
    variants = [registry.named(name) for name in names]
    todo = shots(dataset)
    workers = min(workers, len(todo))
    if workers <= 1:
        return estimate_dataset(dataset, variants, on_frame)
    rows: Rows = {variant.name: [] for variant in variants}
    # A forked child of a process with threads may hang: spawn.
    pool = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), _start, (dataset, tuple(names), max(1, _cores() // workers))
    )
    try:
        # Child processes start with the first task. They inherit the mask, so that an interrupt reaches the parent
        # alone and the children print no traceback. An interrupt in between is delivered after unmasking.
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


_worker_state: tuple[Dataset, list[Variant]]
"""Dataset and variants of a worker process, set as it starts."""


def _start(dataset: Dataset, names: Sequence[str], threads: int) -> None:
    global _worker_state
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    cv2.setNumThreads(threads)
    registry = Registry.read()
    _worker_state = dataset, [registry.named(name) for name in names]


def _exit_with_parent() -> None:
    """Exit when the parent process dies."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(records: tuple[FrameRecord, ...]) -> Rows:
    dataset, variants = _worker_state
    return estimate_shot(dataset, records, variants)
