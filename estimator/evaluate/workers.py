"""Estimation of datasets by several processes, with the same results as by one."""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

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
from estimator.io.dataset import Dataset, FrameRecord, read_dataset
from estimator.io.estimates import EstimateRow
from estimator.methods.registry import Registry
from estimator.methods.variant import Variant

BURSTS_AHEAD = 4
"""Bursts of the next datasets that wait for each process, so that none is idle at the end of a dataset."""


def estimate_with_workers(
    datasets: Iterable[Dataset], names: Sequence[str], workers: int, on_frame: Callable[[], None]
) -> Iterator[dict[str, tuple[EstimateRow, ...]]]:
    """Rows of each dataset as by `estimate_dataset`, for variants given by name.

    The same `workers` processes estimate all datasets; each looks the variants up itself, and reads a dataset from its
    folder. Raises InputError for an unknown name, and if a process dies.
    """
    registry = Registry.read()
    variants = [registry.named(name) for name in names]
    if workers <= 1:
        for dataset in datasets:
            yield estimate_dataset(dataset, variants, on_frame)
        return
    # A forked child of a process with threads may hang: spawn.
    pool = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), _start, (tuple(names), max(1, _cores() // workers))
    )
    begun: deque[_Begun] = deque()
    try:
        for dataset in datasets:
            begun.append(_Begun.of(pool, dataset))
            while sum(len(one.tasks) for one in begun) - len(begun[0].tasks) >= BURSTS_AHEAD * workers:
                yield begun.popleft().finished(pool, variants, on_frame)
        while begun:
            yield begun.popleft().finished(pool, variants, on_frame)
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
class _Begun:
    """A dataset whose bursts wait for processes, or are estimated."""

    dataset: Dataset
    tasks: tuple[tuple[tuple[FrameRecord, ...], "Future[ShotResult]"], ...]

    @classmethod
    def of(cls, pool: ProcessPoolExecutor, dataset: Dataset) -> "_Begun":
        """Submit the bursts of a dataset."""
        with _interrupts_deferred():  # submit() starts child processes
            tasks = [(records, pool.submit(_work, dataset.folder, records)) for records in bursts(dataset)]
        return cls(dataset, tuple(tasks))

    def finished(
        self, pool: ProcessPoolExecutor, variants: Sequence[Variant], on_frame: Callable[[], None]
    ) -> dict[str, tuple[EstimateRow, ...]]:
        """Rows of the dataset, when all its bursts and then its devices are estimated."""
        results = []
        for records, task in self.tasks:
            results.append(task.result())
            for _ in records:
                on_frame()
        of_devices = devices(results)
        solving = [pool.submit(_solve, self.dataset.folder, device) for device in of_devices]
        solved = []
        for device, solution in zip(of_devices, solving, strict=True):
            solved.append(solution.result())
            for _ in next(iter(device.values())):
                on_frame()
        return in_order(self.dataset, variants, [*(result.rows for result in results), *solved])


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
    """A dataset of which a worker process estimates several bursts; it may have begun the next one."""
    return read_dataset(folder)


def _work(folder: Path, records: tuple[FrameRecord, ...]) -> ShotResult:
    return estimate_burst(_dataset(folder), records, _worker_variants)


def _solve(folder: Path, observed: Mapping[str, list[Observed]]) -> Rows:
    return estimate_device(_dataset(folder), observed, _worker_variants)
