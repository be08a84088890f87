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
from estimator.evaluate.batch import (
    Observed,
    Rows,
    ShotResult,
    bursts,
    devices,
    estimate_burst,
    estimate_dataset,
    estimate_device,
    in_order,
)
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
    todo = bursts(dataset)
    workers = min(workers, len(todo))
    if workers <= 1:
        return estimate_dataset(dataset, variants, on_frame)
    # A forked child of a process with threads may hang: spawn.
    pool = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), _start, (dataset, tuple(names), max(1, _cores() // workers))
    )
    try:
        with _interrupts_deferred():  # submit() starts child processes
            tasks = [pool.submit(_work, records) for records in todo]
        results = []
        for records, task in zip(todo, tasks, strict=True):
            results.append(task.result())
            for _ in records:
                on_frame()
        of_devices = devices(results)
        solving = [pool.submit(_solve, device) for device in of_devices]
        solved = []
        for device, solution in zip(of_devices, solving, strict=True):
            solved.append(solution.result())
            for _ in next(iter(device.values())):
                on_frame()
    except BrokenProcessPool:
        raise InputError("a worker process died (out of memory?); nothing was written; try fewer --workers") from None
    finally:
        pool.shutdown(cancel_futures=True)
    return in_order(dataset, variants, [*(result.rows for result in results), *solved])


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


def _work(records: tuple[FrameRecord, ...]) -> ShotResult:
    dataset, variants = _worker_state
    return estimate_burst(dataset, records, variants)


def _solve(observed: dict[str, list[Observed]]) -> Rows:
    dataset, variants = _worker_state
    return estimate_device(dataset, observed, variants)
