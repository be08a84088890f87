"""Worker processes give the same rows as one process."""

import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path

import cv2
import pytest
from conftest import copy_of

from estimator.errors import InputError
from estimator.evaluate import workers
from estimator.evaluate.batch import Observed, Rows, ShotResult, estimate_dataset
from estimator.evaluate.workers import _interrupts_deferred, estimate_with_workers
from estimator.io.dataset import FrameRecord, read_dataset
from estimator.io.estimates import EstimateRow
from estimator.methods.catalogue import VARIANTS
from vlcrender.dataset.run.workers import _interrupts_deferred as _interrupts_of_generate_deferred


@pytest.fixture(scope="module")
def folder(synthetic_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = copy_of(synthetic_set, tmp_path_factory.mktemp("workers"))
    (folder / "frames/000001.exr").unlink()  # one frame that cannot be read
    return folder


def without_times(rows: dict[str, tuple[EstimateRow, ...]]) -> dict[str, list[str]]:
    """To the last bit: a float's text in JSON reads back as the same float."""
    return {name: [row.model_dump_json(exclude={"time_s"}) for row in of_variant] for name, of_variant in rows.items()}


@pytest.mark.parametrize("workers", [1, *(pytest.param(several, marks=pytest.mark.slow) for several in (2, 7))])
def test_any_number_of_workers_gives_the_same_answers_in_order(folder: Path, workers: int) -> None:
    dataset = read_dataset(folder)
    alone = estimate_dataset(dataset, list(VARIANTS.values()), on_frame=lambda: None)
    done: list[None] = []
    of = [(dataset, dataset.frames), (dataset, ()), (dataset, dataset.frames)]
    shared: list[dict[str, tuple[EstimateRow, ...]]] = [dict.fromkeys(VARIANTS, ()) for _ in of]
    numbers = []
    for number, rows in estimate_with_workers(of, list(VARIANTS), workers, on_frame=lambda: done.append(None)):
        numbers.append(number)
        for name, some in rows.items():
            shared[number][name] += tuple(some)
    assert numbers == sorted(numbers)
    assert set(numbers) == {0, 1, 2}
    assert without_times(shared[0]) == without_times(shared[2]) == without_times(alone)
    assert not any(shared[1].values())
    assert [row.frame for row in shared[0]["pnp"]] == [0, 1, 2]
    assert len(done) == 2 * 2 * 3  # a variant of all frames of a device is among them


def test_frames_of_a_device_are_solved_in_order_and_counted(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers are threads here, and their work is to hand over numbers: what is held is how results are collected."""
    solved: list[list[int]] = []

    def work(_: Path, records: tuple[FrameRecord, ...]) -> ShotResult:
        return ShotResult({}, {"all": [Observed(one.frame, one.device, None, 0.0) for one in records]})

    def solve(_: Path, observed: dict[str, list[Observed]]) -> Rows:
        solved.append([one.frame for one in observed["all"]])
        return {}

    monkeypatch.setattr(workers, "ProcessPoolExecutor", lambda count, *_: ThreadPoolExecutor(count))
    monkeypatch.setattr(workers, "_work", work)
    monkeypatch.setattr(workers, "_solve", solve)
    done: list[None] = []
    dataset = read_dataset(folder)
    parts = list(estimate_with_workers([(dataset, dataset.frames)], [], 2, on_frame=lambda: done.append(None)))
    assert not any(rows for _, rows in parts)
    assert solved == [[0, 1, 2]]
    assert len(done) == 2 * 3


def test_an_unknown_name_is_refused_before_a_process_starts(folder: Path) -> None:
    with pytest.raises(InputError, match="variant best: unknown"):
        next(estimate_with_workers([(read_dataset(folder), ())], ["best"], 2, on_frame=lambda: None))


@pytest.mark.parametrize(
    "deferred", [_interrupts_deferred, _interrupts_of_generate_deferred], ids=["estimator", "vlcrender"]
)
def test_an_interrupt_that_another_thread_receives_is_raised_after_the_block(
    deferred: Callable[[], AbstractContextManager[None]],
) -> None:
    """A mask alone does not hold it: Python handles signals in the main thread, whichever thread received them."""
    begun, finished = threading.Event(), threading.Event()
    receiver = threading.Thread(target=lambda: begun.wait() and signal.raise_signal(signal.SIGINT))
    receiver.start()

    def block() -> None:
        with deferred():
            begun.set()
            receiver.join()
            finished.set()

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            block()
        assert finished.is_set()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_worker_exits_when_its_parent_dies(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Started in this process with a parent of our own: the worker goes on while it lives, and then exits with 1."""
    dies, exited, codes = threading.Event(), threading.Event(), []

    class Parent:
        def join(self) -> None:
            dies.wait()

    def leave(code: int) -> None:
        codes.append((code, dies.is_set()))
        exited.set()

    monkeypatch.setattr(workers.multiprocessing, "parent_process", Parent)
    monkeypatch.setattr(workers.os, "_exit", leave)
    monkeypatch.setattr(workers, "_worker_variants", None, raising=False)
    threads = cv2.getNumThreads()
    try:
        workers._start(["pnp"], 1)
        assert cv2.getNumThreads() == 1
        assert not exited.wait(0.05)
    finally:
        cv2.setNumThreads(threads)
        dies.set()
        exited.wait(10)  # before the real _exit is back
    assert codes == [(1, True)]
