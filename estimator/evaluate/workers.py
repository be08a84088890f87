"""Estimation of a dataset by several processes, with the same results as by one."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

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
        with _interrupts_deferred():  # submit() starts child processes
            tasks = [pool.submit(_work, records) for records in todo]
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


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Deliver an interrupt (SIGINT) after this block; child processes started in it never receive one.

    Children inherit the blocked signal: the parent alone handles an interrupt, and no child prints a traceback. The
    handler is needed beside the mask. A mask holds for one thread; where another thread receives the signal, Python
    raises KeyboardInterrupt in the main thread, which may be half way through starting a child.
    """
    received = threading.Event()
    in_main_thread = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, lambda *_: received.set()) if in_main_thread else None
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if handler is not None:
            signal.signal(signal.SIGINT, handler)
    if received.is_set():
        signal.raise_signal(signal.SIGINT)


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
