"""Atomic file writes: a reader sees the old file or the new one, never a part."""

import os
from pathlib import Path


def write_atomically(path: Path, *data: bytes) -> None:
    """Write `data`, one after another, to `path` through a temporary file in the same folder.

    The temporary file is removed in any case. Raises OSError, which names `path`.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.writelines(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        # Name the requested file, not the temporary one.
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        temporary.unlink(missing_ok=True)
