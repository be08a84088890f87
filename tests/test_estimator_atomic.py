"""Atomic writes of the estimator: the whole content is on the disk before the file gets its name."""

import errno
import os
from pathlib import Path

import pytest

from estimator.io.atomic import write_atomically


@pytest.mark.parametrize("size", [12, 100_000])  # less and more than a buffer
def test_the_content_is_on_the_disk_before_the_rename(
    size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """fsync sees all bytes, buffers flushed; the rename comes after it, within the folder."""
    path, data = tmp_path / "scores.json", b"x" * size
    events: list[tuple[str, int]] = []
    sync, replace = os.fsync, os.replace

    def fsync(descriptor: int) -> None:
        events.append(("fsync", os.fstat(descriptor).st_size))
        sync(descriptor)

    def watched(source: Path, target: Path) -> None:
        assert (Path(source).parent, Path(target)) == (tmp_path, path)
        events.append(("replace", Path(source).stat().st_size))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", watched)
    write_atomically(path, data)
    assert events == [("fsync", len(data)), ("replace", len(data))]
    assert path.read_bytes() == data
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_that_fails_leaves_the_old_file_and_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scores.json"
    write_atomically(path, b"old")

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device") as failure:
        write_atomically(path, b"new")
    assert failure.value.filename == str(path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
