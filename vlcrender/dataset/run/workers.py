"""Processes that make frames: this one, a pool of its own, or the workers of a dask scheduler. Same bytes for any."""

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from vlcrender.core.backend import dr
from vlcrender.dataset.format.files import first_line
from vlcrender.dataset.format.rows import FrameRecord
from vlcrender.dataset.run.frame_job import Job, made_frames, make_frames
from vlcrender.errors import InputError

log = logging.getLogger(__name__)

Task = Sequence[tuple[Job, int]]
"""Frames that one process makes, one after another, since they share views or files."""
TASKS_ON_CLUSTER = 1000
"""Tasks that a scheduler knows at a time: more than the threads of a cluster, and memory does not grow with the set."""
DESERTED_S = 5.0
"""Time between two looks at whether a scheduler has workers."""
Done = tuple[Job, FrameRecord]
"""A frame that is made, with its dataset's job."""


def done_frames(
    tasks: Iterator[Task], count: int, workers: int, scheduler: str | None, directory: Path
) -> Generator[Done, None, None]:
    """Make the frames of all tasks; their records in any order, each with its dataset's job.

    tasks: taken one by one, shortly before they start. count: the number of tasks. Raises InputError where a worker
    dies, which names the `directory`, or a scheduler does not answer.
    """
    if scheduler is not None:
        yield from _on_cluster(tasks, scheduler)
    elif workers == 1 or count <= 1:
        for task in tasks:
            yield from zip((job for job, _ in task), made_frames(task), strict=True)
    else:
        yield from _in_processes(tasks, min(workers, count), directory)


def _in_processes(tasks: Iterator[Task], workers: int, directory: Path) -> Iterator[Done]:
    # spawn: a forked child of a process that ran kernels is left with one thread
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _start_worker, (workers,))
    pending: dict[Future[list[FrameRecord]], Task] = {}
    try:
        while True:
            with _interrupts_deferred():  # submit() starts children
                while len(pending) < 2 * workers and (task := next(tasks, None)) is not None:
                    pending[pool.submit(make_frames, task)] = task
            if not pending:
                return
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                task = pending.pop(future)
                yield from zip((job for job, _ in task), future.result(), strict=True)
    except BrokenProcessPool:
        raise InputError(
            f"{directory}: a worker process died (out of memory?); run the same command again, "
            "with fewer --workers, to resume"
        ) from None
    except BaseException:
        # Frames in the making would not be recorded: end their workers now, and do not wait for them.
        with _interrupts_deferred():
            for process in list((pool._processes or {}).values()):
                process.kill()
            pool.shutdown(cancel_futures=True)
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Deliver an interrupt (SIGINT) after this block; child processes started in it never receive one.

    Children inherit the blocked signal, so that only the parent handles an interrupt and no child prints a traceback.
    The handler is needed beside the mask: a mask holds for this thread alone, another thread may receive the signal,
    and Python then runs the handler in the main thread, in the middle of starting a child.
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


def _start_worker(workers: int) -> None:
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    _share_cores(workers)


def _share_cores(workers: int) -> None:
    """Limit Dr.Jit in this process to its share of the cores: its idle threads spin and slow down other processes."""
    dr.set_thread_count(max(1, (os.cpu_count() or 1) // workers))


def _exit_with_parent() -> None:
    """Exit when the parent process dies."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _on_cluster(tasks: Iterator[Task], address: str) -> Iterator[Done]:
    try:
        from dask.distributed import Client, KilledWorker, as_completed
        from distributed.client import FutureCancelledError
    except ImportError:
        raise InputError(f"--scheduler {address}: needs dask.distributed: pip install 'vlcrender[cluster]'") from None
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {address}: no answer from a scheduler: {error}") from None
    with client, _telling_when_deserted(client, address):
        finished, of_future = as_completed(), dict[Any, Task]()

        def submit(count: int) -> None:
            for task in islice(tasks, count):
                future = client.submit(make_frames, task, pure=False)
                of_future[future] = task
                finished.add(future)

        submit(TASKS_ON_CLUSTER)
        for future in finished:
            task = of_future.pop(future)
            try:
                records = future.result()
            except KilledWorker as error:
                raise InputError(
                    f"--scheduler {address}: each worker that took frame {task[0][1]} died (out of memory?): "
                    f"{first_line(str(error))}; run the same command again to resume"
                ) from None
            except FutureCancelledError as error:
                died = " ".join(str(error).split())
                raise InputError(f"--scheduler {address}: {died}; run the same command again to resume") from None
            for (job, _), record in zip(task, records, strict=True):
                if not (Path(job.directory) / record.device.file).is_file():
                    raise InputError(f"--scheduler {address}: its workers do not see the folder {job.directory}")
                yield job, record
            submit(1)


@contextmanager
def _telling_when_deserted(client: Any, address: str) -> Iterator[None]:
    """Warn within this block where a scheduler has no worker: a run waits for one, however long that takes."""
    ended = threading.Event()

    def look() -> None:
        told = False
        while not ended.wait(DESERTED_S):
            deserted = not client.scheduler_info()["workers"]
            if deserted and not told:
                log.warning("--scheduler %s: has no worker; the run goes on when one joins", address)
            told = deserted

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
