"""What a command's process has of its own: standard streams and interrupts."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

INTERRUPTED = 130
"""Exit code after Ctrl-C."""


def prepare_streams() -> None:
    """Print a question mark for a character that stdout or stderr does not have; open a stream that is closed.

    A file opened later would get the number of a closed stream, and what a library prints.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r+", encoding="utf-8"))  # noqa: SIM115 open until the process ends
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


def progress_console() -> "Console":
    """A console on stderr that falls silent where its reader has gone (`2>&1 | head`): the work goes on."""
    from rich.console import Console

    class Quiet(Console):
        def on_broken_pipe(self) -> None:
            self.quiet = True

    return Quiet(stderr=True)


@contextmanager
def ending_at_second_interrupt() -> Iterator[None]:
    """Raise KeyboardInterrupt at the first interrupt (SIGINT); at the second, end this process and its workers at once.

    Without effect beside the main thread, and where SIGINT is ignored or has a handler of its own.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, _first)
    try:
        yield
    finally:
        # After an interrupt the process is ending: a second one must not break its last lines.
        interrupted = signal.getsignal(signal.SIGINT) is _second
        signal.signal(signal.SIGINT, signal.SIG_IGN if interrupted else signal.default_int_handler)


def _first(number: int, frame: FrameType | None) -> None:
    signal.signal(signal.SIGINT, _second)
    signal.default_int_handler(number, frame)


def _second(number: int, frame: FrameType | None) -> None:
    with suppress(Exception):
        for process in multiprocessing.active_children():
            process.kill()
    os._exit(INTERRUPTED)
