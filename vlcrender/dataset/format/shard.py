"""Shards: the region frames of consecutive frames as the parts of one EXR file.

OpenEXR writes the file of each frame, and this module joins them by the file's layout (OpenEXR, File Layout): OpenEXR's
own time to write a file grows with the square of the number of its parts.
"""

import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.dataset.format.exr import ExrPart, exr_bytes
from vlcrender.dataset.format.files import FRAMES, whole_file
from vlcrender.dataset.format.manifest import entry_of
from vlcrender.dataset.format.rows import FileEntry

MAGIC, VERSION = 20000630, 2
SEVERAL_PARTS = 0x1000
"""Bit of the version field of a file of several parts."""


@dataclass(frozen=True)
class _Part:
    """A part of an EXR file: its attributes, and its chunks without the number of the part."""

    attributes: bytes
    chunks: tuple[bytes, ...]


@dataclass(eq=False)
class Shard:
    """The file of some consecutive frames of a dataset; it appears whole, after the last frame, or not at all."""

    directory: Path
    number: int
    _parts: list[_Part] = field(default_factory=list)

    @property
    def file(self) -> str:
        """Path below the dataset, with `/`."""
        return f"{FRAMES}/shard-{self.number:06d}.exr"

    @property
    def part_count(self) -> int:
        """Number of parts so far, which is the number of the next frame's first part."""
        return len(self._parts)

    def add(self, frame: int, images: Sequence[RegionImage], sensor: Roi, attributes: Mapping[str, Any]) -> None:
        """Add the regions of a frame as the parts `frame N region 0`, ..."""
        names = [_name(frame, number) for number in range(len(images))]
        self._parts += _parts_of(exr_bytes(images, sensor, attributes, names))

    def write(self) -> FileEntry:
        """Write the file, durably, and return its digest and size. Raises InputError where it cannot be written."""
        path = self.directory / self.file
        with whole_file(path) as partial:
            partial.write_bytes(_joined(self._parts))
            entry = entry_of(partial)
        return entry


def parts_of_frame(parts: Sequence[ExrPart], frame: int, first: int) -> list[ExrPart]:
    """Parts of a frame among those of its shard; none where number `first` is not the frame's first part."""
    found: list[ExrPart] = []
    while 0 <= first < len(parts) and parts[first].name == _name(frame, len(found)):
        found.append(parts[first])
        first += 1
    return found


def _name(frame: int, region: int) -> str:
    return f"frame {frame} region {region}"


def incomplete(frames: Collection[int], per_file: int, frame_count: int) -> list[int]:
    """Those of some frames whose files, of `per_file` frames each, have other frames too, of `frame_count` in all."""
    found = []
    for number, group in groupby(sorted(frames), key=lambda frame: frame // per_file):
        of_file = list(group)
        if len(of_file) < min(per_file, frame_count - number * per_file):
            found += of_file
    return found


def _parts_of(data: bytes) -> Iterator[_Part]:
    """Parts of a whole EXR file of scan lines."""
    several = bool(struct.unpack_from("<i", data, 4)[0] & SEVERAL_PARTS)
    place = 8
    headers: list[tuple[bytes, int]] = []
    while not headers or (several and data[place]):
        end, chunks = _header(data, place)
        headers.append((data[place:end], chunks))
        place = end + 1  # the null byte after the last attribute
    place += several  # and that after the last header
    for attributes, chunks in headers:
        if not several:
            attributes += b"chunkCount\0int\0" + struct.pack("<ii", 4, chunks)
        offsets = struct.unpack_from(f"<{chunks}Q", data, place)
        place += 8 * chunks
        # Each chunk: in a file of several parts the number of the part; the first line, the size, the pixels.
        starts = [offset + 4 * several for offset in offsets]
        yield _Part(
            attributes, tuple(data[one : one + 8 + struct.unpack_from("<i", data, one + 4)[0]] for one in starts)
        )


LINES_OF_A_CHUNK = {3: 16, 4: 32}
"""By the number of a compression: ZIP, PIZ."""


def _header(data: bytes, place: int) -> tuple[int, int]:
    """End of the attributes of a header that starts at `place`, and its number of chunks."""
    lines, lines_of_a_chunk = 0, 1
    while data[place]:
        name_end = data.index(b"\0", place)
        type_end = data.index(b"\0", name_end + 1)
        (size,) = struct.unpack_from("<i", data, type_end + 1)
        if data[place:name_end] == b"dataWindow":
            _, top, _, bottom = struct.unpack_from("<4i", data, type_end + 5)
            lines = bottom - top + 1
        elif data[place:name_end] == b"compression":
            lines_of_a_chunk = LINES_OF_A_CHUNK[data[type_end + 5]]
        place = type_end + 5 + size
    return place, -(-lines // lines_of_a_chunk)


def _joined(parts: Sequence[_Part]) -> bytes:
    """A whole EXR file of some parts."""
    head = struct.pack("<ii", MAGIC, VERSION | SEVERAL_PARTS)
    head += b"".join(part.attributes + b"\0" for part in parts) + b"\0"
    place = len(head) + 8 * sum(len(part.chunks) for part in parts)
    offsets, body = [], []
    for number, part in enumerate(parts):
        for chunk in part.chunks:
            offsets.append(place)
            body.append(struct.pack("<i", number) + chunk)
            place += 4 + len(chunk)
    return head + struct.pack(f"<{len(offsets)}Q", *offsets) + b"".join(body)
