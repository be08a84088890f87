"""Atomic writes: the data is on the disk before the file has its name, and a failed write leaves the old file."""

import os
from pathlib import Path

import pytest

from estimator.io.atomic import write_atomically


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the system calls that matter, in order, fsync with the size of the file at that time."""
    made: list[str] = []
    fsync, replace = os.fsync, os.replace

    def watched_fsync(descriptor: int) -> None:
        made.append(f"fsync {os.fstat(descriptor).st_size} bytes")
        fsync(descriptor)

    def watched_replace(source: Path, target: Path) -> None:
        made.append(f"replace {target.name} by {source.name.rpartition('.')[2]}")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", watched_fsync)
    monkeypatch.setattr(os, "replace", watched_replace)
    return made


def test_data_is_synced_before_the_file_has_its_name(tmp_path: Path, calls: list[str]) -> None:
    """All bytes have left Python's buffer when the file is synced: 5 of them would stay in it without a flush."""
    path = tmp_path / "scores.json"
    path.write_bytes(b"old")
    write_atomically(path, b"whole")
    assert calls == ["fsync 5 bytes", "replace scores.json by tmp"]
    assert path.read_bytes() == b"whole"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    """The error names the file that was asked for."""
    path = tmp_path / "scores.json"
    path.write_bytes(b"old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", "/elsewhere")

    monkeypatch.setattr(os, failing, full)
    with pytest.raises(OSError, match="No space left on device") as error:
        write_atomically(path, b"whole")
    assert error.value.filename == str(path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
