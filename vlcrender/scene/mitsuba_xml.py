"""Mitsuba XML of furniture: triangle meshes with diffuse reflectances.

Every element, plugin, number and path is checked before it has an effect. Mitsuba parses text without includes and
evaluates reflectances of checked numbers and images; mesh files and images are read by this package alone.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.backend import dr, mi
from vlcrender.errors import InputError
from vlcrender.scene.mesh_file import Triangles, read_mesh
from vlcrender.scene.paths import file_inside
from vlcrender.scene.texture import read_image

Array = NDArray[np.float64]

MAX_BYTES = 16_000_000
"""Largest size of an XML file."""
MAX_DEPTH = 16
"""Largest depth of nested elements."""
ELEMENTS = (
    *("scene", "shape", "bsdf", "texture", "ref", "default", "alias", "string", "float", "integer", "boolean"),
    *("rgb", "spectrum", "transform", "translate", "rotate", "scale", "matrix", "lookat"),
)
ATTRIBUTES = {
    *("version", "type", "id", "as", "name", "value", "x", "y", "z", "angle", "origin", "target", "up"),
}
PLUGINS: dict[str, dict[str, set[str]]] = {
    "scene": {"scene": set()},
    "shape": {
        "ply": {"filename", "to_world", "face_normals", "flip_normals", "flip_tex_coords"},
        "obj": {"filename", "to_world", "face_normals", "flip_normals", "flip_tex_coords"},
        "serialized": {"filename", "to_world", "face_normals", "flip_normals", "shape_index"},
        "cube": {"to_world", "flip_normals"},
        "rectangle": {"to_world", "flip_normals"},
    },
    "bsdf": {"diffuse": {"reflectance"}, "twosided": set()},
    "texture": {
        "bitmap": {"filename", "filter_type", "wrap_mode", "raw", "to_uv"},
        "checkerboard": {"color0", "color1", "to_uv"},
    },
}
"""Plugins and their properties, by kind of object. Normals of triangles are their own: the two flags have no effect."""
TYPES = {str: "string", bool: "boolean", int: "integer"}
IMAGE_MODES = ("L", "I;16", "I", "RGB")


@dataclass(frozen=True)
class XmlShape:
    """A shape of a file: its triangles with `to_world` applied, and their diffuse reflectances, (triangles,)."""

    where: str
    mesh: Triangles
    albedo: Array


def read_xml(path: Path, folder: Path, where: str) -> list[XmlShape]:
    """The shapes of a Mitsuba XML file. Files that it names are looked up in its folder, inside the scene's `folder`.

    Raises InputError, one line that starts with `where` and names element or shape, for anything but meshes (ply, obj,
    serialized, cube, rectangle) with BSDFs diffuse or twosided, for reflectances outside 0 to 1, and for files that are
    missing, outside `folder` or damaged.
    """
    file = _parsed(path, folder, where)
    shapes = [file.shape(node) for node in file.nodes if _kind(node) == "shape"]
    if not shapes:
        raise InputError(f"{where}: holds no shape")
    return shapes


def _parsed(path: Path, folder: Path, where: str) -> "_File":
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{where}: cannot be read: {error.strerror}") from None
    text = _checked_text(content, where)
    config = mi.parser.ParserConfig(str(mi.variant()))
    try:
        state = mi.parser.parse_string(config, text)
        mi.parser.transform_upgrade(config, state)
        mi.parser.transform_resolve_references(config, state)
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{where}: Mitsuba cannot parse it: {_one_line(error)}") from None
    nodes = list(state.nodes)
    lines = {id(node): _line(mi.parser.file_location(state, node)) for node in nodes}  # while `text` is there
    file = _File(path, folder, where, state, nodes, lines)
    for node in file.nodes:
        file.check_plugin(node)
    if _kind(file.nodes[0]) != "scene":
        raise InputError(f"{where}: {file.place(file.nodes[0])}: the outermost element has to be <scene>")
    return file


def _checked_text(content: bytes, where: str) -> str:
    """The text of a file, of allowed elements and attributes alone."""
    if len(content) > MAX_BYTES:
        raise InputError(f"{where}: has {len(content)} bytes; at most {MAX_BYTES} are allowed")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(f"{where}: line {line}: has the byte {content[error.start]:#x}, which is no UTF-8") from None
    parser = expat.ParserCreate("utf-8")
    depth = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        place = f"{where}: line {parser.CurrentLineNumber}"
        if name not in ELEMENTS:
            of = f" type={attributes['type']!r}" if "type" in attributes else ""
            raise InputError(f"{place}: <{name}{of}> is not supported; allowed are {', '.join(ELEMENTS)}")
        wrong = sorted(attributes.keys() - ATTRIBUTES)
        if wrong:
            raise InputError(f"{place}: <{name} {wrong[0]}=...> is not supported; give value")
        if depth > MAX_DEPTH:
            raise InputError(f"{place}: elements are nested deeper than {MAX_DEPTH}")

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1

    def doctype(*_: object) -> None:
        raise InputError(f"{where}: line {parser.CurrentLineNumber}: <!DOCTYPE> is not supported; remove it")

    parser.StartElementHandler, parser.EndElementHandler, parser.StartDoctypeDeclHandler = start, end, doctype
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        raise InputError(f"{where}: line {error.lineno}: is no XML: {expat.ErrorString(error.code)}") from None
    return text


def _line(location: str) -> str:
    found = re.search(r"line \d+", location)
    return found.group() if found else "line unknown"


def _kind(node: Any) -> str:
    """scene, shape, bsdf, texture, or another kind of object."""
    return str(node.type).rpartition(".")[2].lower()


@dataclass(frozen=True)
class _File:
    """A parsed file, its references resolved."""

    path: Path
    folder: Path
    where: str
    state: Any
    """Mitsuba's, which owns the nodes."""
    nodes: Sequence[Any]
    lines: dict[int, str]
    """Line of each node, by its `id`."""

    def place(self, node: Any) -> str:
        """Object and line, for messages."""
        name = node.props.id()
        line = self.lines[id(node)]
        return f"{_kind(node)} {name!r}, {line}" if name else f"{_kind(node)}, {line}"

    def check_plugin(self, node: Any) -> None:
        """Refuse an object of another plugin, and other properties."""
        kind, plugin = _kind(node), node.props.plugin_name()
        allowed = PLUGINS.get(kind, {})
        if plugin not in allowed:
            raise InputError(
                f"{self.where}: {self.place(node)}: type={plugin!r} is not supported; allowed are "
                f"{', '.join(allowed) or ', '.join(PLUGINS)}"
            )
        for key in node.props.keys():  # noqa: SIM118 - no mapping
            reference = isinstance(node.props[key], mi.Properties.ResolvedReference)
            if key not in allowed[plugin] and not (reference and self._nested(node, key)):
                what = f"a nested {_kind(self.nodes[node.props[key].index()])}" if reference else key
                raise InputError(
                    f"{self.where}: {self.place(node)}: {what} is not supported in {plugin}; allowed are "
                    f"{', '.join(sorted(allowed[plugin])) or 'nested objects'}"
                )

    def _nested(self, node: Any, key: str) -> bool:
        """Whether an object may be there: shapes, BSDFs and textures in a scene, a BSDF in a shape or in twosided."""
        inner = _kind(self.nodes[node.props[key].index()])
        if _kind(node) == "scene":
            return inner in ("shape", "bsdf", "texture")
        return inner == "bsdf" and (_kind(node) == "shape" or node.props.plugin_name() == "twosided")

    def _inner(self, node: Any) -> list[Any]:
        values = (node.props[key] for key in node.props.keys())  # noqa: SIM118 - no mapping
        return [self.nodes[v.index()] for v in values if isinstance(v, mi.Properties.ResolvedReference)]

    def file_of(self, node: Any) -> Path:
        """The file that a shape or a bitmap names."""
        name = self._value(node, "filename", str, None)
        return file_inside(self.folder, name, f"{self.where}: {self.place(node)}: file {name!r}", self.path.parent)

    def _value(self, node: Any, key: str, of: type, otherwise: Any) -> Any:
        """A property of a type, or its default; without one it has to be there."""
        value = node.props[key] if key in node.props.keys() else otherwise  # noqa: SIM118 - no mapping
        if type(value) is not of:
            raise InputError(f"{self.where}: {self.place(node)}: {key}: give one {TYPES[of]}")
        return value

    def _matrix(self, node: Any, key: str) -> Array | None:
        if key not in node.props.keys():  # noqa: SIM118 - no mapping
            return None
        matrix = np.array(getattr(node.props[key], "matrix", np.nan), dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or matrix[3].tolist() != [0, 0, 0, 1]:
            raise InputError(f"{self.where}: {self.place(node)}: {key} is no affine transformation of finite numbers")
        return matrix

    def shape(self, node: Any) -> XmlShape:
        """A shape with its transformation and the reflectances of its triangles."""
        where, plugin = f"{self.where}: {self.place(node)}", node.props.plugin_name()
        if plugin in ("cube", "rectangle"):
            mesh = _builtin(plugin)
        else:
            file, number = self.file_of(node), self._value(node, "shape_index", int, 0)
            if file.suffix != f".{plugin}":
                raise InputError(f"{where}: file {file.name!r} is no .{plugin} by its name")
            mesh = read_mesh(file, f"{where}: file {file.name!r}", number)
        if (
            plugin in ("ply", "obj")
            and self._value(node, "flip_tex_coords", bool, plugin == "obj")
            and mesh.uv is not None
        ):
            mesh = replace(mesh, uv=mesh.uv * [1, -1] + [0, 1])
        matrix = self._matrix(node, "to_world")
        if matrix is not None:
            with np.errstate(all="ignore"):  # what is not finite is refused with the room
                mesh = replace(mesh, vertices=mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3])
        return XmlShape(where, mesh, self._albedo(node, mesh, where))

    def _albedo(self, node: Any, mesh: Triangles, where: str) -> Array:
        """Diffuse reflectance in the middle of each triangle, textures included, (triangles,)."""
        bsdfs = self._inner(node)
        if len(bsdfs) > 1:
            raise InputError(f"{where}: has {len(bsdfs)} BSDFs; give one")
        tree = self._bsdf(bsdfs[0]) if bsdfs else {"type": "diffuse"}
        count = len(mesh.faces)
        if not count:
            return np.zeros(0)
        middle = np.full((count, 2), 0.5) if mesh.uv is None else mesh.uv.mean(axis=1)
        if not (np.abs(middle) < 1e6).all():
            raise InputError(f"{where}: has texture coordinates that are not finite or beyond 1e6")
        si = dr.zeros(mi.SurfaceInteraction3f, count)
        si.uv = mi.Point2f(middle.T.astype(np.float32))
        si.wi = mi.Vector3f(0, 0, 1)
        try:
            value = mi.load_dict(tree).eval_diffuse_reflectance(si)
        except RuntimeError as error:
            raise InputError(f"{where}: Mitsuba cannot load its BSDF: {_one_line(error)}") from None
        albedo = np.broadcast_to(np.array(value, dtype=np.float64).reshape(-1), (count,))
        if not ((albedo >= 0) & (albedo <= 1 + 1e-6)).all():
            raise InputError(f"{where}: reflectance is from {albedo.min():g} to {albedo.max():g}; 0 to 1 is allowed")
        return np.minimum(albedo, 1.0)

    def _bsdf(self, node: Any) -> dict[str, Any]:
        if node.props.plugin_name() == "twosided":
            inner = self._inner(node)
            if len(inner) != 1 or inner[0].props.plugin_name() != "diffuse":
                raise InputError(f"{self.where}: {self.place(node)}: twosided has to hold one diffuse BSDF")
            return {"type": "twosided", "inner": self._bsdf(inner[0])}
        return {"type": "diffuse"} | self._reflectances(node, ("reflectance",))

    def _reflectances(self, node: Any, keys: Sequence[str]) -> dict[str, Any]:
        given = [key for key in keys if key in node.props.keys()]  # noqa: SIM118 - no mapping
        return {key: self._reflectance(node, key) for key in given}

    def _reflectance(self, node: Any, key: str) -> dict[str, Any]:
        """A number, a colour or a texture for Mitsuba."""
        value = node.props[key]
        if isinstance(value, mi.Properties.ResolvedReference) and node.props.plugin_name() == "diffuse":
            return self._texture(self.nodes[value.index()])
        if hasattr(value, "is_uniform") and value.is_uniform():  # a spectrum of one number
            value = float(value.values[0])
        numbers = np.array(value).tolist() if isinstance(value, mi.ScalarColor3d) else [value]
        if not all(isinstance(number, float) for number in numbers):
            raise InputError(
                f"{self.where}: {self.place(node)}: {key}: give one number, an rgb, or a texture in diffuse"
            )
        if not all(0 <= number <= 1 for number in numbers):
            shown = ", ".join(f"{number:g}" for number in numbers)
            raise InputError(f"{self.where}: {self.place(node)}: {key} = {shown}: 0 to 1 is allowed")
        if len(numbers) == 3:
            return {"type": "rgb", "value": numbers}
        return {"type": "spectrum", "value": numbers[0]}

    def _texture(self, node: Any) -> dict[str, Any]:
        where, plugin = f"{self.where}: {self.place(node)}", node.props.plugin_name()
        if _kind(node) != "texture":
            raise InputError(f"{where}: is no texture")
        matrix = self._matrix(node, "to_uv")
        tree: dict[str, Any] = {"type": plugin}
        if matrix is not None:
            tree["to_uv"] = mi.ScalarTransform4f(matrix.tolist())
        if plugin == "checkerboard":
            return tree | self._reflectances(node, ("color0", "color1"))
        file = self.file_of(node)
        image = read_image(file, f"{where}: file {file.name!r}", ("PNG", "JPEG"), IMAGE_MODES)
        tree["bitmap"] = mi.Bitmap(image if image.ndim == 3 else image[..., None])
        tree["bitmap"].set_srgb_gamma(True)  # as of a file; without effect where raw
        return tree | {
            "raw": self._value(node, "raw", bool, False),
            "filter_type": self._value(node, "filter_type", str, "bilinear"),
            "wrap_mode": self._value(node, "wrap_mode", str, "repeat"),
        }


def _builtin(plugin: str) -> Triangles:
    """Mitsuba's cube or rectangle, from -1 to 1."""
    shape = mi.load_dict({"type": plugin})
    vertices = np.array(shape.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
    faces = np.array(shape.faces_buffer(), dtype=np.int64).reshape(-1, 3)
    return Triangles(vertices, faces, np.array(shape.vertex_texcoords_buffer(), dtype=np.float64).reshape(-1, 2)[faces])


def _one_line(error: Exception) -> str:
    """An error's text, of a long one the end, which says most."""
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else f"...{text[-197:]}"
