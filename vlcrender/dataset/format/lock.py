"""Lock of a folder: one run at a time writes to a dataset or sweep (datasets/FORMAT.md, Lock).

`flock` on a small file. The kernel releases it when the process ends, also by `kill -9`, so that no lock is ever stale
and none has to be judged by a process number, which means nothing on another machine. On NFS Linux turns it into a lock
of the server, as `lockf`. `lockf` itself would be lost as soon as anything in this process opens the file and closes
it, a copy of the folder for one, and does not exclude threads. A file that is a lock by being there, the only way
without the kernel, survives its process. The holder's name in the file is for the message alone.
"""

import errno
import fcntl
import json
import logging
import os
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from pathlib import Path

from vlcrender.errors import InputError

log = logging.getLogger(__name__)

LOCK = ".vlcrender.lock"
"""File of a folder that a run holds; no part of the dataset."""
ATTEMPTS = 1000
"""Largest number of times that a lock's file is opened again because its last holder has removed it."""
LOOKS, LOOK_S = 20, 0.01
"""Times that a holder's name is looked for, and the seconds between."""


@contextmanager
def locked(directory: Path, command: str) -> Iterator[None]:
    """Hold the lock of a dataset's or sweep's folder, which is made, and removed at the end where it is empty.

    A cell's sweep is locked with it, shared with the runs of other cells. command: the holder's name in messages.
    Without a lock where the folder cannot be written, and with a warning where its file system has none. Raises
    InputError at once where another run holds the lock, or where `directory` is no folder.
    """
    with ExitStack() as stack:
        resolved = Path(os.path.realpath(directory))
        sweep = resolved.parent.parent
        if resolved.parent.name == "cells" and any((sweep / name).exists() for name in ("sweep.json", "plan.json")):
            stack.enter_context(_held(sweep, fcntl.LOCK_SH, command))
        stack.enter_context(_held(directory, fcntl.LOCK_EX, command))
        yield


@contextmanager
def _held(directory: Path, kind: int, command: str) -> Iterator[None]:
    made = [folder for folder in (directory, *directory.parents) if not folder.exists()]
    path, process, descriptor = directory / LOCK, os.getpid(), None
    try:
        descriptor = _acquired(path, kind, command)
        yield
    finally:
        if descriptor is not None:
            if os.getpid() == process:  # a forked child leaves its parent's lock alone
                _remove(path, descriptor)
            os.close(descriptor)
        for folder in made:
            try:
                folder.rmdir()
            except OSError:
                break


def _acquired(path: Path, kind: int, command: str) -> int | None:
    """Descriptor of the lock's file; None where there can be no lock."""
    missing: OSError | None = None
    for _ in range(ATTEMPTS):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = _opened(path)
        except FileExistsError:
            raise InputError(f"{path.parent}: not a folder; nothing was changed; choose another --out") from None
        except FileNotFoundError as error:
            missing = error
            continue  # a run that was refused has removed the folder that it had made
        if descriptor is None:
            return None
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
            if _is_at(descriptor, path):
                _write_holder(descriptor, command)
                return descriptor
        except BlockingIOError:
            os.close(descriptor)
            raise InputError(f"{path.parent}: in use by {_holder(path)}; nothing was changed") from None
        except OSError as error:
            if error.errno != errno.ESTALE:
                os.close(descriptor)
                log.warning("%s: has no locks (%s): start no second run in it", path.parent, error.strerror)
                return None
        os.close(descriptor)
    if missing is not None:
        raise InputError(f"{path.parent}: cannot be made: {missing.strerror}; choose another --out")
    raise InputError(f"{path}: cannot be locked: other runs replace the file all the time")


def _opened(path: Path) -> int | None:
    """Descriptor of the lock's file, which is made; None where the folder cannot be written."""
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise
    with suppress(OSError):
        return os.open(path, os.O_RDONLY)  # of a run by another user
    return None


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file is still the one with this path: its last holder may have removed it."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def _write_holder(descriptor: int, command: str) -> None:
    holder = {
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "command": command,
        "since": datetime.now().astimezone().isoformat(timespec="seconds"),
    }
    with suppress(OSError):  # such as a full disk: the lock holds all the same
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, (json.dumps(holder) + "\n").encode(), 0)


def _holder(path: Path) -> str:
    """Who holds a lock, for a message. The holder writes its name just after it has the lock."""
    for _ in range(LOOKS):
        try:
            tree = json.loads(path.read_text(encoding="utf-8"))
            return f"`{tree['command']}`, process {tree['pid']} on {tree['host']} since {tree['since']}"
        except (OSError, ValueError, KeyError, TypeError):
            time.sleep(LOOK_S)
    return "another run"


def _remove(path: Path, descriptor: int) -> None:
    """Remove the file of a lock that no other run holds. Only a holder that excludes all others removes it."""
    with suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if _is_at(descriptor, path):
            path.unlink()
