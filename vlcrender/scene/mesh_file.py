"""PLY, OBJ and Mitsuba's serialized meshes, as vertices and triangles.

PLY as G. Turk's description of 1994 has it: ASCII, or binary of either byte order. OBJ as Wavefront's: polygons; no
curves, no materials. Readers are strict: a count, an index or a number that does not fit is refused with its place. No
other reader sees the files. Texts of comments and names may be in any encoding.
"""

import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from vlcrender.errors import InputError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MAX_BYTES = 1 << 30
"""Largest size of a mesh file, also after decompression."""
MAX_HEADER_BYTES = 1 << 16
"""Largest size of the header of a PLY file."""
PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
PLY_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
OBJ_IGNORED = {"vn", "g", "o", "s", "usemtl", "mtllib", "l", "p"}
"""Keywords of OBJ files without a meaning here: normals, groups, materials, lines and points."""
NO_NUMBER = re.compile(rb"[^0-9eE+\-.\sinfatyINFATY]")
SERIALIZED_PARTS = ((0x0001, 3), (0x0002, 2), (0x0008, 3))
"""Flags and numbers a vertex of normals, texture coordinates and colours in serialized meshes, in order."""


@dataclass(frozen=True)
class Triangles:
    """Vertices (n, 3) in the file's units and triangles (k, 3) of their indices."""

    vertices: Array
    faces: Indices
    uv: Array | None = None
    """Texture coordinates of each triangle's vertices, (k, 3, 2); None in a file without."""


def read_mesh(path: Path, where: str, shape_index: int = 0) -> Triangles:
    """The mesh of a .ply, .obj or .serialized file; `shape_index` counts the meshes of the last kind.

    Polygons are cut into triangles. Raises InputError, one line that starts with `where`, for a file that cannot be
    read, and for counts, numbers, face indices or keywords that do not fit, with their place in the file.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{where}: has {path.stat().st_size} bytes; at most {MAX_BYTES} are allowed")
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{where}: cannot be read: {error.strerror}") from None
    if path.suffix == ".serialized":
        return _read_serialized(content, shape_index, where)
    return _read_ply(content, where) if path.suffix == ".ply" else _read_obj(content, where)


def _refuse(where: str, place: str, what: str) -> NoReturn:
    raise InputError(f"{where}: {place}: {what}")


def _triangulated(
    vertices: Array, uv: Array | None, corners: Indices, lengths: Indices, where: str, what: str = "face"
) -> Triangles:
    """Polygons cut into fans of triangles: triangles first, then quadrilaterals, then others.

    corners: the vertex at each corner of all polygons; uv: texture coordinates of these corners; lengths: number of
    corners of each polygon.
    """
    wrong = np.flatnonzero((corners < 0) | (corners >= len(vertices)))
    ends = np.cumsum(lengths)
    if len(wrong):
        number = int(np.searchsorted(ends, wrong[0], side="right"))
        index = corners[wrong[0]]
        _refuse(where, f"{what} {number}", f"has a face index {index}, out of range for {len(vertices)} vertices")
    starts = ends - lengths
    parts = [starts[lengths == 3, None] + [0, 1, 2]]
    quads = starts[lengths == 4, None]
    parts += [quads + [0, 1, 2], quads + [2, 3, 0]]
    for start, length in zip(starts[lengths > 4].tolist(), lengths[lengths > 4].tolist(), strict=True):
        later = np.arange(start + 1, start + length - 1)
        parts.append(np.stack([np.full(len(later), start), later, later + 1], axis=1))
    chosen = np.concatenate(parts).astype(np.int64)
    return Triangles(vertices, corners[chosen], None if uv is None else uv[chosen])


@dataclass(frozen=True)
class _Property:
    name: str
    type: str
    """Its NumPy type; of a list, that of its items."""
    counted_by: str = ""
    """NumPy type of a list's length; empty for a single number."""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


@dataclass(frozen=True)
class _Column:
    """Values of one property: one an item, or with `lengths` lists, one after the other."""

    values: NDArray[np.generic]
    lengths: Indices | None = None


def _read_ply(content: bytes, where: str) -> Triangles:
    end = re.search(rb"^end_header[ \t]*\r?\n", content[:MAX_HEADER_BYTES], re.MULTILINE)
    if not re.match(rb"ply[ \t]*\r?\n", content) or end is None:
        _refuse(where, "header", 'is no PLY header: give "ply" on the first line, and "end_header"')
    order, elements = _ply_header(content[: end.start()].decode("latin-1").splitlines(), where)
    body = content[end.end() :]
    read = _ply_text if order == "" else _ply_binary
    columns = read(body, elements, order, where)
    if not {"x", "y", "z"} <= columns.get("vertex", {}).keys():
        _refuse(where, "header", "has no element vertex with the properties x, y and z")
    vertex = columns["vertex"]
    if any(column.lengths is not None for column in vertex.values()):
        _refuse(where, "element vertex", "has a list; only numbers are allowed")
    vertices = np.stack([vertex[name].values.astype(np.float64) for name in "xyz"], axis=1)
    face = columns.get("face", {})
    column = face.get("vertex_indices", face.get("vertex_index"))
    if column is None or column.lengths is None:
        _refuse(where, "header", "has no element face with a list vertex_indices")
    short = np.flatnonzero(column.lengths < 3)
    if len(short):
        _refuse(where, f"face {short[0]}", f"has {column.lengths[short[0]]} vertices; at least 3 are needed")
    corners = column.values.astype(np.int64)
    uv = None
    for u, v in (("u", "v"), ("s", "t")):
        if u in vertex and v in vertex and ((corners >= 0) & (corners < len(vertices))).all():
            uv = np.stack([vertex[name].values.astype(np.float64) for name in (u, v)], axis=1)[corners]
    return _triangulated(vertices, uv, corners, column.lengths, where)


def _ply_header(lines: list[str], where: str) -> tuple[str, list[_Element]]:
    """Byte order of the data, empty for text, and the elements that follow."""
    order: str | None = None
    elements: list[_Element] = []
    for number, line in enumerate(lines[1:], 2):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in PLY_FORMATS and order is None:
                order = PLY_FORMATS[name]
            case ["element", name, count] if re.fullmatch(r"\d{1,12}", count) and name not in [
                e.name for e in elements
            ]:
                elements.append(_Element(name, int(count), []))
            case ["property", of, name] if of in PLY_TYPES and elements:
                elements[-1].properties.append(_Property(name, PLY_TYPES[of]))
            case ["property", "list", by, of, name] if (
                PLY_TYPES.get(by, "f")[0] != "f" and of in PLY_TYPES and elements
            ):
                elements[-1].properties.append(_Property(name, PLY_TYPES[of], PLY_TYPES[by]))
            case _:
                _refuse(where, f"line {number}", f"{line[:80]!r} is no line of a PLY header")
    if order is None:
        _refuse(where, "header", f"has no line format; allowed are {', '.join(PLY_FORMATS)}, version 1.0")
    for element in elements:
        names = [p.name for p in element.properties]
        if not names or len(set(names)) < len(names):
            _refuse(where, "header", f"element {element.name} has no property, or one twice")
        if any(p.type[0] == "f" and p.name.startswith("vertex_ind") for p in element.properties):
            _refuse(where, "header", "vertex_indices are no integers")
    return order, elements


def _ply_text(body: bytes, elements: list[_Element], order: str, where: str) -> dict[str, dict[str, _Column]]:
    """The columns of each element of an ASCII file, a line an item."""
    bad = NO_NUMBER.search(body)
    if bad is not None:
        _refuse(where, f"data line {body.count(10, 0, bad.start()) + 1}", f"has the byte {bad.group()!r}, no number's")
    lines = [line for line in body.decode("ascii").splitlines() if not line.isspace() and line]
    stated = sum(element.count for element in elements)
    if len(lines) != stated:
        _refuse(where, "data", f"has {len(lines)} lines; the header states {stated}")
    columns: dict[str, dict[str, _Column]] = {}
    first = 0
    for element in elements:
        values: list[list[float]] = [[] for _ in element.properties]
        lengths: list[list[int]] = [[] for _ in element.properties]
        for number, line in enumerate(lines[first : first + element.count]):
            try:
                _text_item(line.split(), element, values, lengths)
            except (ValueError, OverflowError, IndexError):
                _refuse(
                    where, f"{element.name} {number}", f"{line.strip()[:80]!r} does not fit the header's properties"
                )
        first += element.count
        columns[element.name] = {
            p.name: _Column(_numbers(v, p), np.array(n, dtype=np.int64) if p.counted_by else None)
            for p, v, n in zip(element.properties, values, lengths, strict=True)
        }
    return columns


def _numbers(values: list[float], of: _Property) -> NDArray[np.generic]:
    """Numbers in the precision that the header states; integers in 64 bits, their range is checked as indices."""
    with np.errstate(over="ignore"):  # beyond single precision is infinite, and refused
        return np.array(values).astype(of.type) if of.type[0] == "f" else np.array(values, dtype=np.int64)


def _text_item(words: Sequence[str], element: _Element, values: list[list[float]], lengths: list[list[int]]) -> None:
    """Append one item's numbers. Raises ValueError, OverflowError or IndexError where they do not fit."""
    at = 0
    for i, of in enumerate(element.properties):
        count = 1
        if of.counted_by:
            count = int(words[at])
            at += 1
            if not 0 <= count <= len(words) - at:
                raise ValueError(count)
            lengths[i].append(count)
        numbers = [float(words[at + k]) if of.type[0] == "f" else int(words[at + k]) for k in range(count)]
        if of.type[0] != "f" and any(abs(number) >= 2**63 for number in numbers):
            raise OverflowError
        values[i] += numbers
        at += count
    if at != len(words):
        raise ValueError(at)


def _ply_binary(body: bytes, elements: list[_Element], order: str, where: str) -> dict[str, dict[str, _Column]]:
    """The columns of each element of a binary file."""
    columns: dict[str, dict[str, _Column]] = {}
    at = 0
    for element in elements:
        sizes = [np.dtype(p.counted_by or p.type).itemsize for p in element.properties]
        if element.count * sum(sizes) > len(body) - at:
            _refuse(where, f"element {element.name}", f"is cut short: the header states {element.count} of them")
        columns[element.name], at = _binary_element(body, at, element, order, where)
    if at != len(body):
        _refuse(where, "data", f"has {len(body) - at} bytes more than the header states")
    return columns


def _binary_element(
    body: bytes, start: int, element: _Element, order: str, where: str
) -> tuple[dict[str, _Column], int]:
    """The columns of one element that starts at a byte, and the byte after it."""
    if not element.count:
        empty = {p.name: _Column(np.zeros(0), np.zeros(0, int) if p.counted_by else None) for p in element.properties}
        return empty, start
    columns: dict[str, _Column] = {}
    lengths = _item_lengths(body, start, element, order)
    if lengths is not None:  # all items are alike: one table
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        for i, of in enumerate(element.properties):
            fields += [(f"n{i}", order + of.counted_by)] if of.counted_by else []
            fields += [(f"v{i}", order + of.type, (lengths[i],))]
        table = np.dtype(fields)
        end = start + element.count * table.itemsize
        if end <= len(body):
            items = np.frombuffer(body, table, element.count, start)
            counted = [i for i, p in enumerate(element.properties) if p.counted_by]
            if all((items[f"n{i}"] == lengths[i]).all() for i in counted):
                for i, of in enumerate(element.properties):
                    n = np.full(element.count, lengths[i]) if of.counted_by else None
                    columns[of.name] = _Column(items[f"v{i}"].ravel(), n)
                return columns, end
    values: list[list[float]] = [[] for _ in element.properties]
    counts: list[list[int]] = [[] for _ in element.properties]
    at = start
    for number in range(element.count):
        try:
            at = _binary_item(body, at, element, order, values, counts)
        except struct.error:
            _refuse(where, f"{element.name} {number}", "is cut short, or has a list longer than the file")
    for i, of in enumerate(element.properties):
        n = np.array(counts[i], dtype=np.int64) if of.counted_by else None
        columns[of.name] = _Column(_numbers(values[i], of), n)
    return columns, at


def _item_lengths(body: bytes, at: int, element: _Element, order: str) -> list[int] | None:
    """Numbers of each property of the first item; None where it does not fit into the file."""
    counts: list[list[int]] = [[] for _ in element.properties]
    try:
        _binary_item(body, at, element, order, [[] for _ in element.properties], counts)
    except struct.error:
        return None
    return [n[0] if n else 1 for n in counts]


def _binary_item(
    body: bytes, at: int, element: _Element, order: str, values: list[list[float]], counts: list[list[int]]
) -> int:
    """Append one item's numbers; the byte after it. Raises struct.error where the file ends before."""
    for i, of in enumerate(element.properties):
        count = 1
        if of.counted_by:
            (count,) = struct.unpack_from(order + CODES[of.counted_by], body, at)
            at += np.dtype(of.counted_by).itemsize
            counts[i].append(count)
        size = np.dtype(of.type).itemsize * count
        if not 0 <= size <= len(body) - at:
            raise struct.error
        values[i] += struct.unpack_from(f"{order}{count}{CODES[of.type]}", body, at)
        at += size
    return at


CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
"""The names of NumPy's types in `struct`."""


def _read_obj(content: bytes, where: str) -> Triangles:
    vertices: list[list[float]] = []
    textures: list[list[float]] = []
    corners: list[int] = []
    of_texture: list[int] = []
    lengths: list[int] = []
    for number, words in _obj_lines(content):
        try:
            if words[0] == "v" and 4 <= len(words) <= 8:
                vertices.append([float(word) for word in words[1:4]])
            elif words[0] == "vt" and 2 <= len(words) <= 4:
                textures.append([float(word) for word in (*words[1:3], "0")[:2]])
            elif words[0] == "f" and len(words) >= 4:
                for word in words[1:]:
                    vertex, texture, *_ = (*word.split("/"), "")
                    corners.append(_obj_index(vertex, len(vertices), number, where))
                    of_texture.append(_obj_index(texture, len(textures), number, where) if texture else -1)
                lengths.append(len(words) - 1)
            elif words[0] not in OBJ_IGNORED:
                raise ValueError
        except InputError:
            raise
        except ValueError:
            line = " ".join(words)[:80]
            allowed = "allowed are v, vt, f with numbers that fit, " + ", ".join(sorted(OBJ_IGNORED))
            _refuse(where, f"line {number}", f"{line!r}: is no line of an OBJ mesh; {allowed}")
    uv = None
    if of_texture and min(of_texture) >= 0:
        if max(of_texture) >= len(textures):
            _refuse(where, "faces", f"have a texture index {max(of_texture) + 1}; there are {len(textures)} vt")
        uv = np.array(textures)[of_texture]
    if corners and max(corners) >= len(vertices):
        _refuse(where, "faces", f"have a face index {max(corners) + 1}, out of range for {len(vertices)} vertices")
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    return _triangulated(points, uv, np.array(corners, dtype=np.int64), np.array(lengths, dtype=np.int64), where)


def _obj_lines(content: bytes) -> Iterator[tuple[int, list[str]]]:
    """The number and the words of each line with words; comments left out, continued lines joined."""
    words: list[str] = []
    for number, line in enumerate(content.decode("latin-1").split("\n"), 1):
        text = line.partition("#")[0].rstrip()
        words += text.removesuffix("\\").split()
        if words and not text.endswith("\\"):
            yield number, words
            words = []
    if words:
        yield number, words


def _obj_index(word: str, count: int, line: int, where: str) -> int:
    """An index of a face, counted from 0; negative words count back from the latest vertex."""
    index = int(word)
    if index == 0:
        _refuse(where, f"line {line}", "has a face index 0; vertices of an OBJ file count from 1")
    if index < -count or index >= 2**31:
        _refuse(where, f"line {line}", f"has a face index {index}, out of range for {count} vertices")
    return index - 1 if index > 0 else count + index


def _read_serialized(content: bytes, shape_index: int, where: str) -> Triangles:
    """A mesh of Mitsuba's binary format: compressed meshes, their places in the file, and the number of meshes."""
    place = f"mesh {shape_index}"
    try:
        magic, version = struct.unpack_from("<HH", content)
        (count,) = struct.unpack_from("<I", content, len(content) - 4)
        if magic != 0x041C or version not in (3, 4):
            _refuse(where, "header", "is no serialized mesh of version 3 or 4")
        if not 0 <= shape_index < count:
            _refuse(where, "shape_index", f"is {shape_index}; the file states {count} meshes, counted from 0")
        size = 8 if version == 4 else 4
        (at,) = struct.unpack_from(
            "<Q" if size == 8 else "<I", content, len(content) - 4 - size * (count - shape_index)
        )
        inflate = zlib.decompressobj()
        data = inflate.decompress(content[at + 4 :], MAX_BYTES)
        (flags,) = struct.unpack_from("<I", data)
        at = data.index(b"\0", 4) + 1 if version == 4 else 4
        n, k = struct.unpack_from("<QQ", data, at)
        number = "<f8" if flags & 0x2000 else "<f4"
        index = "<u8" if n > 0xFFFFFFFF else "<u4"
        widths = [3, *(width for flag, width in SERIALIZED_PARTS if flags & flag)]
        needed = n * sum(widths) * np.dtype(number).itemsize + 3 * k * np.dtype(index).itemsize
        if not inflate.eof or needed != len(data) - at - 16:
            _refuse(
                where, place, f"has {len(data) - at - 16} bytes for {n} vertices and {k} faces: {needed} are needed"
            )
    except (struct.error, zlib.error, ValueError) as error:
        if isinstance(error, InputError):
            raise
        _refuse(where, place, f"is no serialized mesh that can be read: {error}")
    numbers = np.frombuffer(data, number, n * sum(widths), at + 16).astype(np.float64)
    corners = np.frombuffer(data, index, 3 * k, len(data) - 3 * k * np.dtype(index).itemsize).astype(np.int64)
    vertices = numbers[: 3 * n].reshape(n, 3)
    uv = None
    if flags & 0x0002:
        first = 3 * n + (3 * n if flags & 0x0001 else 0)
        at_vertex = numbers[first : first + 2 * n].reshape(n, 2)
        uv = at_vertex[np.clip(corners, 0, max(n - 1, 0))] if n else None
    return _triangulated(vertices, uv, corners, np.full(k, 3), where)
