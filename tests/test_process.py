"""A command's process: interrupts end its workers, and its output may be closed or without UTF-8.

What a process has of its own is tested on the functions of both packages, in this process where that is possible.
"""

import io
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import ModuleType

import psutil
import pytest
from conftest import HANG_S, ROOT, SMALL, copy_of, small_plan, started, wait_until

import estimator.cli
import estimator.io.process
import vlcrender.cli
import vlcrender.core.process
from vlcrender.dataset.run.generate import generate
from vlcrender.dataset.run.workers import Task
from vlcrender.dataset.verify.verify import verify

PROCESS = {"vlcrender": vlcrender.core.process, "estimator": estimator.io.process}


@pytest.fixture(params=PROCESS)
def process(request: pytest.FixtureRequest) -> Iterator[ModuleType]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield PROCESS[request.param]
    signal.signal(signal.SIGINT, before)


class Ended(BaseException):
    """In place of the end of this process."""


def test_the_second_interrupt_ends_the_process_and_its_workers(
    process: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second one comes while the first is cleaned up; a third one, when the command has ended, has no effect."""
    killed: list[str] = []

    class Worker:
        def kill(self) -> None:
            killed.append("worker")

    def leave(code: int) -> None:
        raise Ended(code)

    monkeypatch.setattr(process.multiprocessing, "active_children", lambda: [Worker(), Worker()])
    monkeypatch.setattr(process.os, "_exit", leave)

    def command() -> None:
        with process.ending_at_second_interrupt():
            try:
                signal.raise_signal(signal.SIGINT)
            finally:
                assert killed == []
                signal.raise_signal(signal.SIGINT)

    with pytest.raises(Ended, match="130"):
        command()
    assert killed == ["worker", "worker"]
    signal.raise_signal(signal.SIGINT)


def test_interrupts_are_as_before_where_none_came(process: ModuleType) -> None:
    with process.ending_at_second_interrupt():
        pass
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a background job of a shell
    with process.ending_at_second_interrupt():
        signal.raise_signal(signal.SIGINT)


@pytest.mark.slow
def test_two_quick_interrupts_leave_no_process(tmp_path: Path) -> None:
    """Both go to the whole group, as Ctrl-C does. One worker is stopped: it would not end by itself."""
    sets = [part for assignment in (*SMALL, "poses.count=300") for part in ("--set", assignment)]
    command = ("generate", "quickstart", "--out", str(tmp_path / "set"), "--workers", "2", *sets)
    process = started("vlcrender", *command)
    journal = tmp_path / "set/journal.jsonl"
    try:
        wait_until(lambda: journal.exists() and journal.stat().st_size > 0, process)
        family = psutil.Process(process.pid).children(recursive=True)
        workers = [child for child in family if "spawn_main" in " ".join(child.cmdline())]
        assert len(workers) == 2
        workers[0].suspend()
        for _ in range(2):
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGINT)
        process.communicate(timeout=HANG_S)  # the output ends with the last process that has it
        assert process.returncode == 130
        assert not [child for child in workers if child.is_running() and child.status() != psutil.STATUS_ZOMBIE]
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def test_an_interrupt_ends_workers_before_the_lock_is_released(
    rendered_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An orphan would write into the folder of the next run. No process has to be started for it."""
    order: list[str] = []
    monkeypatch.setattr("vlcrender.dataset.format.lock._remove", lambda *_: order.append("lock"))

    def done_frames(*_: object) -> Iterator[object]:
        try:
            yield from ()
            raise KeyboardInterrupt
        finally:
            order.append("workers")

    monkeypatch.setattr("vlcrender.dataset.run.generate.done_frames", done_frames)
    with pytest.raises(KeyboardInterrupt):
        generate(small_plan(), tmp_path / "set")
    assert order == ["workers", "lock"]


@pytest.mark.slow
def test_a_pipe_that_is_closed_ends_no_work(tmp_path: Path) -> None:
    """`2>&1 | head`: all frames are made, and the exit code says so. A stream that is not there changes no code."""
    code = "import sys; from vlcrender.cli import main; sys.exit(main())"
    sets = [part for assignment in (*SMALL, "poses.count=1") for part in ("--set", assignment)]
    command = [sys.executable, "-c", code, "generate", "quickstart", "--out", str(tmp_path / "set"), *sets]
    reading, writing = os.pipe()
    os.close(reading)
    finished = subprocess.run(command, cwd=ROOT, stdout=writing, stderr=writing, check=False)
    os.close(writing)
    assert finished.returncode == 0
    assert verify(tmp_path / "set") == []
    shell = f'"{sys.executable}" -c "{code}" verify "{tmp_path}/set"'
    (tmp_path / "set/truth.parquet").unlink()
    assert subprocess.run(f"{shell} >&- 2>&-", shell=True, cwd=ROOT, check=False).returncode == 2


def test_a_warning_to_a_closed_pipe_ends_no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    class Closed(io.StringIO):
        def write(self, _: str) -> int:
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stderr", Closed())
    vlcrender.cli._complain("a warning")
    assert estimator.cli._complain("an error", 2) == 2
    for package in PROCESS.values():
        console = package.progress_console()
        console.print("frames")
        assert console.quiet


def test_output_without_utf_8_has_question_marks(
    scored_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also a message with the name of a folder."""
    folder = copy_of(scored_set, tmp_path / "größe")
    commands = {
        "score": ("estimator", "score", str(folder)),
        "compare": ("estimator", "compare", str(folder), "pnp", "ml"),
        "table": ("estimator", "table", str(folder), "--x", "tilt_deg"),
        "report": ("estimator", "report", str(folder), "--out", str(folder / "page.html")),
        "run": ("estimator", "run", str(folder), "--variant", "pnp"),
        "generate": ("vlcrender", "generate", "quickstart", "--out", str(folder)),
        "verify": ("vlcrender", "verify", str(folder)),
    }
    mains = {"estimator": estimator.cli.main, "vlcrender": vlcrender.cli.main}
    for name, (program, *arguments) in commands.items():
        streams = [io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True) for _ in range(2)]
        with monkeypatch.context() as patched:
            patched.setattr(sys, "stdout", streams[0])
            patched.setattr(sys, "stderr", streams[1])
            try:
                code: object = mains[program](arguments)
            except SystemExit as error:
                code = error.code
        out, err = (stream.buffer.getvalue().decode("ascii") for stream in streams)  # type: ignore[attr-defined]
        assert (code or 0) == (0 if program == "estimator" else 2), (name, err)
        assert "gr??e" in out + err or name in ("score", "compare", "table")
        assert "Traceback" not in err
        assert "internal error" not in err
        if name == "compare":
            assert "?m" in out  # a micrometre, without its sign
        elif name == "score":
            assert " um," in out  # told in ASCII


def test_a_cluster_gets_absolute_folders(rendered_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its workers have other working folders. No frame is made; tests/damage/kills.py starts a cluster."""
    folders: list[Path] = []

    def done_frames(tasks: Iterator[Task], *_: object) -> Iterator[object]:
        folders.extend(
            Path(folder) for task in tasks for job, _ in task for folder in (job.directory, job.scene_folder)
        )
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr("vlcrender.dataset.run.generate.done_frames", done_frames)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        generate(small_plan(), Path("set"), scheduler="tcp://nowhere")
    assert {folder.is_absolute() for folder in folders} == {True}
    assert {folder.resolve() for folder in folders} == {tmp_path / "set", ROOT / "scenes"}
