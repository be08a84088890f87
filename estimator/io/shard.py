"""Shards: EXR files with the parts of several frames, of which one frame is read without decoding the others.

The parts of a frame are copied, undecoded, into a small file of their own, by the layout of EXR files of several parts
(OpenEXR, File Layout): OpenEXR's Python module decodes whole files only.
"""

import hashlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from estimator.errors import InputError

HEAD_BYTES = 8
"""Magic number, and version with flags."""
SEVERAL_PARTS = 0x1000
"""Flag of a file of several parts."""


@dataclass(frozen=True)
class _Part:
    """Places of a part in its file: its header, with the null byte at the end, and its table of chunk offsets."""

    name: bytes
    start: int
    end: int
    table: int
    chunks: int


@dataclass(frozen=True, eq=False)
class Shard:
    """A file with the parts of several frames, `frame N region 0`, `frame N region 1`, ..., in memory."""

    data: bytes
    parts: tuple[_Part, ...]

    def file_of(self, frame: int, first: int) -> bytes:
        """An EXR file of a frame's parts alone, of which `first` is the first one; raises ValueError if it is not."""
        chosen: list[_Part] = []
        while first < len(self.parts) and self.parts[first].name == f"frame {frame} region {len(chosen)}".encode():
            chosen.append(self.parts[first])
            first += 1
        if not chosen:
            raise ValueError(f"part {first} is not the first one of frame {frame}")
        head = self.data[:HEAD_BYTES] + b"".join(self.data[one.start : one.end] for one in chosen) + b"\0"
        place = len(head) + 8 * sum(one.chunks for one in chosen)
        offsets, body = [], []
        for number, one in enumerate(chosen):
            for offset in struct.unpack_from(f"<{one.chunks}Q", self.data, one.table):
                # Number of the part, first line, size, pixels.
                _, line, size = struct.unpack_from("<3i", self.data, offset)
                if size < 0 or offset + 12 + size > len(self.data):
                    raise ValueError(f"a chunk of {size} bytes at {offset}")
                offsets.append(place)
                body.append(struct.pack("<3i", number, line, size) + self.data[offset + 12 : offset + 12 + size])
                place += 12 + size
        return head + struct.pack(f"<{len(offsets)}Q", *offsets) + b"".join(body)


def frame_of_shard(path: Path, sha256: str, frame: int, first: int) -> bytes:
    """An EXR file of one frame of a shard, whose parts start at number `first`.

    Raises OSError if the shard cannot be read, and InputError if it is damaged or `first` is not the frame's.
    """
    status = path.stat()
    try:
        return _read(path, sha256, status.st_mtime_ns, status.st_size).file_of(frame, first)
    except (ValueError, struct.error, IndexError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"not a readable EXR image ({error})") from None


@lru_cache(maxsize=2)
def _read(path: Path, sha256: str, mtime_ns: int, size: int) -> Shard:
    """A shard of this digest; its frames, which follow each other, are read from memory."""
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != sha256:
        raise InputError("damaged or changed (its sha256 is not the one in frames.parquet)")
    if not struct.unpack_from("<i", data, 4)[0] & SEVERAL_PARTS:
        raise ValueError("one part, needed several")
    return Shard(data, tuple(_parts(data)))


def _parts(data: bytes) -> Iterator[_Part]:
    found: list[tuple[bytes, int, int, int]] = []
    place = HEAD_BYTES
    while data[place]:
        start, name, chunks = place, b"", 0
        while data[place]:
            attribute_end = data.index(b"\0", place)
            type_end = data.index(b"\0", attribute_end + 1)
            (size,) = struct.unpack_from("<i", data, type_end + 1)
            if size < 0:
                raise ValueError(f"an attribute of {size} bytes")
            value = type_end + 5
            if data[place:attribute_end] == b"name":
                name = data[value : value + size]
            elif data[place:attribute_end] == b"chunkCount":
                (chunks,) = struct.unpack_from("<i", data, value)
            place = value + size
        place += 1
        found.append((name, start, place, chunks))
    place += 1
    for name, start, end, chunks in found:
        if not 0 < chunks <= len(data):
            raise ValueError(f"a part of {chunks} chunks")
        yield _Part(name, start, end, place, chunks)
        place += 8 * chunks
