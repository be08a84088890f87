"""Estimation of datasets by several processes, with the same results as by one."""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path

import cv2

from estimator.errors import InputError
from estimator.evaluate.batch import (
    Observed,
    OfDevice,
    Rows,
    ShotResult,
    bursts,
    estimate_burst,
    estimate_device,
    estimate_frames,
    in_order,
)
from estimator.evaluate.process import prepare_process
from estimator.io.dataset import Dataset, FrameRecord, read_device
from estimator.methods.registry import Registry
from estimator.methods.variant import Variant

BURSTS_AHEAD = 4
"""Bursts that wait for each process, of the next datasets too, so that none is idle at the end of a dataset."""


def estimate_with_workers(
    datasets: Iterable[tuple[Dataset, Iterable[FrameRecord]]],
    names: Sequence[str],
    workers: int,
    on_frame: Callable[[], None],
) -> Generator[tuple[int, Rows], None, None]:
    """Rows as by `estimate_frames` of each dataset and its records, after the dataset's number, from 0 on.

    Variants are given by name. The same `workers` processes estimate all datasets; each looks the variants up itself,
    and reads a dataset from its folder. Raises InputError for an unknown name, and if a process dies.
    """
    registry = Registry.read()
    variants = [registry.named(name) for name in names]
    if workers <= 1:
        for number, (dataset, records) in enumerate(datasets):
            for rows in estimate_frames(dataset, records, variants, on_frame):
                yield number, rows
        return
    # A forked child of a process with threads may hang: spawn.
    pool = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), _start, (tuple(names), max(1, _cores() // workers))
    )
    try:
        tasks = _ahead(_submitted(pool, datasets), BURSTS_AHEAD * workers)
        for (number, folder), of_dataset in groupby(tasks, lambda task: (task.number, task.folder)):
            results = ((task.frames, task.result.result()) for task in of_dataset if task.result is not None)
            for rows in in_order(results, partial(_solved, pool, folder), on_frame):
                yield number, rows
    except BrokenProcessPool:
        raise InputError(
            "a worker process died (out of memory?); the dataset's estimates were not written; try fewer --workers"
        ) from None
    except BaseException:
        # No estimate of the dataset in hand will be written: end the workers now, and do not wait for their frames.
        with _interrupts_deferred():
            for process in list((getattr(pool, "_processes", None) or {}).values()):
                process.kill()
            pool.shutdown(cancel_futures=True)
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@dataclass(frozen=True, eq=False)
class _Task:
    """A burst that waits for a process, or is estimated: its number of frames, and of which dataset it is."""

    number: int
    folder: Path
    frames: int
    result: "Future[ShotResult] | None"
    """None at the end of a dataset."""


def _submitted(pool: ProcessPoolExecutor, datasets: Iterable[tuple[Dataset, Iterable[FrameRecord]]]) -> Iterator[_Task]:
    """Submit the bursts of all datasets, each as it is asked for."""
    for number, (dataset, records) in enumerate(datasets):
        for burst in bursts(dataset, records):
            with _interrupts_deferred():  # submit() starts child processes
                result = pool.submit(_work, dataset.folder, burst)
            yield _Task(number, dataset.folder, len(burst), result)
        yield _Task(number, dataset.folder, 0, None)


def _ahead(tasks: Iterable[_Task], count: int) -> Iterator[_Task]:
    """Tasks in order, of which `count` have been asked for before they are needed."""
    waiting: deque[_Task] = deque()
    for task in tasks:
        waiting.append(task)
        if len(waiting) > count:
            yield waiting.popleft()
    while waiting:
        yield waiting.popleft()


def _solved(pool: ProcessPoolExecutor, folder: Path, found: Sequence[OfDevice]) -> Iterator[Rows]:
    """Rows of each device, when all its frames are observed."""
    solving = [pool.submit(_solve, folder, device) for device in found]
    return (task.result() for task in solving)


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


_worker_variants: list[Variant]
"""Variants of a worker process, set as it starts."""


def _start(names: Sequence[str], threads: int) -> None:
    global _worker_variants
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    cv2.setNumThreads(threads)
    prepare_process()
    registry = Registry.read()
    _worker_variants = [registry.named(name) for name in names]


def _exit_with_parent() -> None:
    """Exit when the parent process dies."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@lru_cache(maxsize=2)
def _dataset(folder: Path) -> Dataset:
    """A dataset, without records, of which a worker estimates several bursts; it may have begun the next one."""
    return read_device(folder)[0]


def _work(folder: Path, records: tuple[FrameRecord, ...]) -> ShotResult:
    return estimate_burst(_dataset(folder), records, _worker_variants)


def _solve(folder: Path, observed: Mapping[str, list[Observed]]) -> Rows:
    return estimate_device(_dataset(folder), observed, _worker_variants)
