"""One run at a time in a folder: the lock of both packages, which share the protocol of FORMAT.md and no code."""

import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import ModuleType

import pytest
from conftest import ROOT, SMALL, copy_of, run, small_plan

import estimator.io.lock
import vlcrender.dataset.format.lock
from estimator.errors import InputError as EstimatorError
from vlcrender.dataset.run.generate import generate
from vlcrender.errors import InputError as RendererError

Locked = Callable[[Path, str], AbstractContextManager[None]]
REFUSED = (EstimatorError, RendererError)
LOCKS = {"vlcrender": vlcrender.dataset.format.lock, "estimator": estimator.io.lock}
FILE = ".vlcrender.lock"


@pytest.fixture(params=LOCKS)
def locked(request: pytest.FixtureRequest) -> Locked:
    chosen: Locked = LOCKS[request.param].locked
    return chosen


@contextmanager
def held_by_a_process(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that holds the lock of a folder until it is killed."""
    code = (
        "import sys, time; from pathlib import Path; from vlcrender.dataset.format.lock import locked\n"
        "with locked(Path(sys.argv[1]), 'vlcrender generate'):\n"
        "    print('held', flush=True); time.sleep(600)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def test_the_second_is_refused_by_the_name_of_the_first(locked: Locked, tmp_path: Path) -> None:
    """Of either package against either, threads of one process included; then the folder is free, and clean."""
    with LOCKS["vlcrender"].locked(tmp_path, "vlcrender generate"):
        holder = json.loads((tmp_path / FILE).read_text())
        assert (holder["pid"], holder["command"]) == (os.getpid(), "vlcrender generate")
        with pytest.raises(REFUSED) as refusal, locked(tmp_path, "other"):
            pass
        words = (f"{tmp_path}: in use by `vlcrender generate`, process {os.getpid()} on ", holder["since"])
        assert all(word in str(refusal.value) for word in words)
        assert json.loads((tmp_path / FILE).read_text()) == holder
    with locked(tmp_path, "other"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_lock_ends_with_a_process_that_is_killed(locked: Locked, tmp_path: Path) -> None:
    """No clean-up runs: the file stays and means nothing."""
    with held_by_a_process(tmp_path) as process:
        with pytest.raises(REFUSED, match=f"process {process.pid} on "), locked(tmp_path, "other"):
            pass
        process.kill()
        process.wait()
        assert json.loads((tmp_path / FILE).read_text())["pid"] == process.pid
        with locked(tmp_path, "other"):
            assert json.loads((tmp_path / FILE).read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


def test_a_read_of_the_file_does_not_lose_the_lock(locked: Locked, tmp_path: Path) -> None:
    """`lockf` would: a process loses its lock when it closes any descriptor of the file."""
    with locked(tmp_path, "one"):
        (tmp_path / FILE).read_bytes()
        code = "import fcntl, sys; fcntl.flock(open(sys.argv[1]), fcntl.LOCK_EX + fcntl.LOCK_NB)"
        tried = subprocess.run(
            [sys.executable, "-c", code, tmp_path / FILE], capture_output=True, text=True, check=False
        )
        assert "BlockingIOError" in tried.stderr


def test_a_forked_child_neither_loses_nor_removes_the_lock(locked: Locked, tmp_path: Path) -> None:
    holder = locked(tmp_path, "parent")
    holder.__enter__()
    child = os.fork()
    if child == 0:
        holder.__exit__(None, None, None)  # as an exception in the child would
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    with pytest.raises(REFUSED, match="in use by `parent`"), locked(tmp_path, "other"):
        pass
    holder.__exit__(None, None, None)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_its_holder_removes_is_opened_again(
    locked: Locked, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last holder ends between our open and our lock: ours would be on a file that no path leads to."""
    flock = fcntl.flock
    removed: list[Path] = []

    def late(descriptor: int, operation: int) -> None:
        if not removed:
            removed.append(tmp_path / FILE)
            (tmp_path / FILE).unlink()
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    with locked(tmp_path, "one"):
        assert removed
        assert json.loads((tmp_path / FILE).read_text())["command"] == "one"
        with pytest.raises(REFUSED, match="in use"), locked(tmp_path, "other"):
            pass


@pytest.mark.parametrize("package", LOCKS)
@pytest.mark.parametrize("error", [errno.EROFS, errno.EACCES])
def test_a_folder_that_cannot_be_written_needs_no_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, error: int
) -> None:
    monkeypatch.setattr(LOCKS[package].os, "open", _failing(error))
    with LOCKS[package].locked(tmp_path, "one"):
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("package", LOCKS)
def test_a_file_system_without_locks_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, package: str
) -> None:
    monkeypatch.setattr(LOCKS[package].fcntl, "flock", _failing(errno.ENOLCK))
    with LOCKS[package].locked(tmp_path, "one"):
        assert "has no locks (No locks available): start no second run" in caplog.text


def _failing(number: int) -> Callable[..., object]:
    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    return fail


def test_cells_are_used_at_once_and_never_beside_their_sweep(locked: Locked, tmp_path: Path) -> None:
    cells = [tmp_path / f"cells/{number:06d}" for number in range(2)]
    for cell in cells:
        cell.mkdir(parents=True)
    (tmp_path / "sweep.json").write_text("{}")
    with locked(cells[0], "one"), locked(cells[1], "two"):
        for folder in (cells[0], tmp_path):
            with pytest.raises(REFUSED, match="in use"), locked(folder, "other"):
                pass
    with locked(tmp_path, "sweep"), pytest.raises(REFUSED, match="in use by `sweep`"), locked(cells[0], "other"):
        pass
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["000000", "000001", "cells", "sweep.json"]


def test_a_folder_of_a_refused_run_is_not_left_behind(tmp_path: Path) -> None:
    with vlcrender.dataset.format.lock.locked(tmp_path / "a/b", "one"):
        assert (tmp_path / "a/b" / FILE).exists()
    assert list(tmp_path.iterdir()) == []


def test_each_command_is_refused_while_another_uses_the_folder(scored_set: Path, tmp_path: Path) -> None:
    folder = copy_of(scored_set, tmp_path)
    before = sorted(path for path in folder.rglob("*"))
    small = [part for assignment in SMALL for part in ("--set", assignment)]
    with held_by_a_process(folder):
        commands = [
            ("estimator", "run", str(folder), "--variant", "pnp"),
            ("estimator", "score", str(folder)),
            ("vlcrender", "generate", "quickstart", "--out", str(folder), *small),
        ]
        for program, *arguments in commands:
            refused = run(program, *arguments)
            assert (refused.returncode, refused.stdout) == (2, "")
            assert refused.stderr.startswith(f"{program}: {folder}: in use by `vlcrender generate`, process ")
            assert refused.stderr.count("\n") == 1
        assert run("estimator", "report", str(folder), "--out", str(tmp_path / "page.html")).returncode == 0
    (tmp_path / "page.html").unlink()
    (folder / FILE).unlink()
    assert sorted(path for path in folder.rglob("*")) == before


def test_generate_holds_the_lock_until_it_ends(tmp_path: Path) -> None:
    """And not beyond: after an interrupt the same run goes on."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it

    def interrupt(_: object) -> None:
        with pytest.raises(RendererError, match="in use by `vlcrender generate`"):
            generate(small_plan(), tmp_path / "set")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(small_plan(), tmp_path / "set", progress=interrupt)
    assert not (tmp_path / "set" / FILE).exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("of", LOCKS.values(), ids=LOCKS)
def test_a_holder_that_has_not_written_its_name_yet_is_named(of: ModuleType, tmp_path: Path) -> None:
    """It does so just after it has the lock: a run that is refused meanwhile looks again."""
    path = tmp_path / FILE
    path.write_text("")
    text = json.dumps({"command": "x", "pid": 1, "host": "h", "since": "t"})
    timer = threading.Timer(0.05, lambda: path.write_text(text))
    timer.start()
    try:
        assert of._holder(path) == "`x`, process 1 on h since t"
    finally:
        timer.join()
    path.write_text("{")
    assert of._holder(path) == "another run"
