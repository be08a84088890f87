"""A dask cluster makes the same bytes as one process."""

import logging
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import ROOT, SMALL
from distributed import LocalCluster

from vlcrender.core.digest import sha256_of
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run import workers
from vlcrender.dataset.run.frame_job import Job
from vlcrender.dataset.run.generate import generate
from vlcrender.dataset.run.progress import Progress
from vlcrender.dataset.verify.verify import verify
from vlcrender.errors import InputError


def digests(directory: Path) -> dict[str, str]:
    return {path.name: sha256_of(path) for path in sorted((directory / "frames").iterdir())}


def files_of(directory: Path) -> dict[str, str]:
    return {str(p.relative_to(directory)): sha256_of(p) for p in sorted(directory.rglob("*")) if p.is_file()}


@pytest.mark.slow
def test_the_threads_of_a_cluster_make_the_same_bytes(tmp_path: Path) -> None:
    """Worker threads: kernel settings are per thread in Dr.Jit. Worker processes are tested without dask."""
    plan = load_plan(ROOT / "datasets/quickstart.toml", [*SMALL, "poses.count=4"])
    generate(plan, tmp_path / "alone")
    with LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None, protocol="tcp"
    ) as cluster:
        generate(plan, tmp_path / "cluster", scheduler=cluster.scheduler_address)
    assert digests(tmp_path / "cluster") == digests(tmp_path / "alone")


def test_a_missing_scheduler_is_one_line(tmp_path: Path) -> None:
    plan = load_plan(ROOT / "datasets/quickstart.toml", [*SMALL, "poses.count=1"])
    with pytest.raises(InputError, match=r"^--scheduler nonsense://x: no answer from a scheduler: "):
        generate(plan, tmp_path / "set", scheduler="nonsense://x")


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_no_frame(tmp_path: Path) -> None:
    """Of two worker processes one is killed after the first frame: its tasks go to another, and the set is the same.

    The cluster restarts a worker that dies; a task is lost only if three workers die with it.
    """
    plan = load_plan(ROOT / "datasets/quickstart.toml", [*SMALL, "poses.count=6", "expected=true"])
    generate(plan, tmp_path / "alone")
    killed: list[int] = []
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:

        def kill_one(progress: Progress) -> None:
            if progress.stage == "frames" and not killed:
                killed.append(next(iter(cluster.workers.values())).pid)
                os.kill(killed[0], signal.SIGKILL)

        generate(plan, tmp_path / "cluster", scheduler=cluster.scheduler_address, progress=kill_one)
    assert killed
    assert files_of(tmp_path / "cluster") == files_of(tmp_path / "alone")
    assert verify(tmp_path / "cluster") == []


def test_a_cluster_is_given_no_more_tasks_than_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tasks are submitted as others finish: memory does not grow with the set. Threads of this process make them."""
    waiting: list[int] = []

    def tasks(count: int) -> Iterator[workers.Task]:
        for number in range(count):
            waiting.append(number)
            yield [(Job("", "", "", str(tmp_path)), number)]

    def made(task: workers.Task) -> list[object]:
        return [SimpleNamespace(device=SimpleNamespace(file="frame")) for _ in task]

    (tmp_path / "frame").touch()

    monkeypatch.setattr(workers, "TASKS_ON_CLUSTER", 3)
    monkeypatch.setattr(workers, "make_frames", made)
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp"
    ) as cluster:
        done = 0
        for _ in workers.done_frames(tasks(10), 10, 1, cluster.scheduler_address, tmp_path):
            done += 1
            assert len(waiting) <= done + 2
    assert (done, len(waiting)) == (10, 10)


def test_a_run_without_a_worker_says_that_it_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The only worker of a scheduler joins once the run has said so: it makes the frames, and nothing is said again."""
    (tmp_path / "frame").touch()
    monkeypatch.setattr(workers, "DESERTED_S", 0.1)
    monkeypatch.setattr(workers, "make_frames", lambda _: [SimpleNamespace(device=SimpleNamespace(file="frame"))])
    tasks: list[workers.Task] = [[(Job("", "", "", str(tmp_path)), number)] for number in range(2)]
    with LocalCluster(
        n_workers=0, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp"
    ) as cluster:
        address = cluster.scheduler_address

        def join_when_told(record: logging.LogRecord) -> bool:
            if record.name == workers.__name__:
                threading.Thread(target=cluster.scale, args=(1,)).start()
            return True

        caplog.handler.addFilter(join_when_told)
        otherwise = threading.Timer(20, cluster.scale, (1,))
        otherwise.start()
        assert len(list(workers.done_frames(iter(tasks), 2, 1, address, tmp_path))) == 2
        otherwise.cancel()
    told = [record.getMessage() for record in caplog.records if record.name == workers.__name__]
    assert told == [f"--scheduler {address}: has no worker; the run goes on when one joins"]
