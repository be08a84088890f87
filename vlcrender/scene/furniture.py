"""Furniture: PLY and OBJ meshes, and Mitsuba XML made of meshes, as part of a room's mesh.

Bodies end up with every triangle's vertices counter-clockwise as seen from outside, which is the side that is lit. A
body that is inside out is turned, with a warning: furniture is opaque, so that its outside is the only side that can be
meant, and files of both senses are common. An open body, such as a box without its bottom, counts as closed by a fan of
triangles over its opening; a body that is flat, or nearly so, has no inside and is left as it is. A closed mesh whose
neighbouring triangles disagree is refused: which of them are wrong is not known before all are compared, and every
modeller has the command for it.
"""

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from vlcrender.core.backend import dr, mi
from vlcrender.core.warn_once import warn_once
from vlcrender.errors import InputError
from vlcrender.scene.loader import Scene
from vlcrender.scene.mesh import Mesh, join, probes_inward
from vlcrender.scene.schema import Furniture

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
logger = logging.getLogger(__name__)

MAX_TRIANGLES = 2_000_000
"""Triangles of one shape, after its subdivision to texels."""
ROOM_TOLERANCE_M = 1e-6
"""Rounding allowance of furniture that stands on a floor or at a wall."""
MAX_SUBDIVISIONS = 64
"""Each subdivision halves the long edges of triangles: 64 go from any length to any texel."""
MIN_HOLLOW = 0.005
"""Volume over area^1.5 from which an open body has an inside; 0.06 for an open cube, 0.04 for a tray 1 x 1 x 0.05."""
OBJ_ZERO_INDEX = re.compile(rb"^[ \t]*f[ \t](?:[^\r\n]*[ \t])?0+(?=[/ \t\r\n]|$)", re.MULTILINE)
"""A face of an OBJ file with vertex 0; vertices count from 1, and trimesh takes 0 for the last one."""


@dataclass(frozen=True)
class _Shape:
    """Triangles of a file: vertices (n, 3) in its units, faces (k, 3), albedo (k,). `where` names file and shape."""

    where: str
    vertices: Array
    faces: Indices
    albedo: Array


def furniture_meshes(scene: Scene, first_owner: int) -> list[Mesh]:
    """One mesh per piece of furniture, subdivided to texels; owners count from `first_owner`.

    Raises InputError, one line that names file and shape, for a file that holds no mesh, for a mesh that is empty, not
    finite, outside the room, too large or of mixed winding, and for a face index out of range.
    """
    meshes = []
    for number, piece in enumerate(scene.settings.furniture):
        where = f"furniture[{number}].file = {piece.file!r}"
        path = scene.folder / piece.file
        shapes = _xml_shapes(path, where) if path.suffix == ".xml" else [_file_shape(path, piece.reflectance, where)]
        meshes.append(join([_room_mesh(shape, piece, first_owner + number, scene) for shape in shapes]))
    return meshes


def _file_shape(path: Path, reflectance: float, where: str) -> _Shape:
    vertices, faces = _read_mesh(path, where)
    return _Shape(where, vertices, faces, np.full(len(faces), reflectance))


def _read_mesh(path: Path, where: str) -> tuple[Array, Indices]:
    """Vertices (n, 3) and faces (k, 3) of a PLY or OBJ file, polygons cut into triangles, indices checked."""
    kind = path.suffix[1:]
    options: dict[str, Any] = {"skip_materials": True, "group_material": False} if kind == "obj" else {}
    if kind == "obj" and OBJ_ZERO_INDEX.search(path.read_bytes()):
        raise InputError(f"{where}: has a face index 0; vertices of an OBJ file count from 1")
    try:
        with path.open("rb") as file, np.errstate(all="ignore"):
            mesh = trimesh.load_mesh(file, file_type=kind, process=False, **options)
        vertices = np.array(mesh.vertices, dtype=np.float64).reshape(len(mesh.vertices), 3)
        faces = np.array(mesh.faces, dtype=np.int64).reshape(len(mesh.faces), 3)
    except IndexError as error:
        raise InputError(f"{where}: has a face index out of range: {_one_line(error)}") from None
    except Exception as error:  # whatever its parser trips over, the file is no mesh
        raise InputError(f"{where}: is no {kind.upper()} mesh that can be read: {_one_line(error)}") from None
    _check_indices(faces, len(vertices), where)
    return vertices, faces


def _check_indices(faces: Indices, count: int, where: str) -> None:
    wrong = faces[(faces < 0) | (faces >= count)]
    if wrong.size:
        raise InputError(f"{where}: has a face index {wrong[0]}, out of range for {count} vertices")


def _xml_shapes(path: Path, where: str) -> list[_Shape]:
    """The shapes of a Mitsuba scene file with their transformations, albedo by their BSDFs."""
    try:
        _check_mesh_files(path, where)
        shapes = [_xml_shape(shape, where) for shape in mi.load_file(str(path), optimize=False).shapes()]
    except (RuntimeError, UnicodeDecodeError) as error:
        raise InputError(f"{where}: Mitsuba cannot load it: {_one_line(error)}") from None
    if not shapes:
        raise InputError(f"{where}: holds no shape")
    return shapes


def _xml_shape(shape: "mi.Mesh", where: str) -> _Shape:
    of_shape = f"{where}: shape {shape.id()!r}"
    if not shape.is_mesh():
        raise InputError(f"{of_shape} is no mesh; allowed are ply, obj, serialized, cube and rectangle")
    if shape.is_emitter():
        raise InputError(f"{of_shape} is an emitter; light comes from LEDs, glazing and ambient alone")
    vertices, faces = _mesh_arrays(shape)
    return _Shape(of_shape, vertices, faces, _albedo(shape, faces))


def _check_mesh_files(path: Path, where: str) -> None:
    """Refuse face indices out of range in mesh files that a Mitsuba scene names: they end Mitsuba's process."""
    state = mi.parser.parse_file(mi.parser.ParserConfig(str(mi.variant())), str(path))
    resolver: Any = mi.FileResolver(mi.file_resolver())  # type: ignore[operator]  # a copy
    resolver.prepend(str(path.parent))
    for node in state.nodes:
        kind = node.props.plugin_name()
        if node.type != mi.ObjectType.Shape or kind not in ("ply", "obj", "serialized"):
            continue
        name = str(node.props.get("filename"))
        file = Path(str(resolver.resolve(name)))
        of_shape = f"{where}: shape {node.props.id() or name!r}"
        if not file.is_file():
            raise InputError(f"{of_shape}: there is no file {name!r}")
        if kind != "serialized":
            _read_mesh(file, of_shape)
            continue
        number = int(node.props.get("shape_index", 0))
        # Face normals keep Mitsuba from following the indices.
        tree = {"type": kind, "filename": str(file), "shape_index": number, "face_normals": True}
        vertices, faces = _mesh_arrays(mi.load_dict(tree))
        _check_indices(faces, len(vertices), of_shape)


def _mesh_arrays(shape: "mi.Mesh") -> tuple[Array, Indices]:
    vertices = np.array(shape.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
    return vertices, np.array(shape.faces_buffer(), dtype=np.int64).reshape(-1, 3)


def _albedo(shape: "mi.Mesh", faces: Indices) -> Array:
    """Diffuse reflectance in the middle of each triangle, textures included, (triangles,)."""
    count = len(faces)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    uv = np.array(shape.vertex_texcoords_buffer(), dtype=np.float64).reshape(-1, 2)
    middle = uv[faces].mean(axis=1) if len(uv) else np.full((count, 2), 0.5)
    si.uv = mi.Point2f(middle.T.astype(np.float32))
    si.wi = mi.Vector3f(0, 0, 1)
    value = shape.bsdf().eval_diffuse_reflectance(si)
    return np.broadcast_to(np.array(value, dtype=np.float64).reshape(-1), (count,)).copy()


def _room_mesh(shape: _Shape, piece: Furniture, owner: int, scene: Scene) -> Mesh:
    """A shape put into the room, checked, oriented and subdivided."""
    if not len(shape.faces):
        raise InputError(f"{shape.where}: has no triangle")
    if not np.isfinite(shape.vertices).all():
        raise InputError(f"{shape.where}: has vertices that are not finite")
    yaw = np.radians(piece.yaw_deg)
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    vertices = piece.scale * shape.vertices @ rotation.T + np.array(piece.position_m)
    used = vertices[np.unique(shape.faces)]
    if (used < -ROOM_TOLERANCE_M).any() or (used > scene.room_m + ROOM_TOLERANCE_M).any():
        low, high = used.min(axis=0).round(3).tolist(), used.max(axis=0).round(3).tolist()
        raise InputError(f"{shape.where}: is from {low} to {high} m, outside the room of {scene.room_m.tolist()} m")
    mesh = trimesh.Trimesh(vertices, shape.faces, process=False)
    mesh.merge_vertices()
    a, b, c = mesh.faces.T
    distinct = (a != b) & (b != c) & (c != a)
    mesh.update_faces(distinct)
    albedo = shape.albedo[distinct]
    _face_outwards(mesh, shape.where)
    flat = mesh.area_faces > 0
    faces = np.array(mesh.faces)[flat]
    if not len(faces):
        raise InputError(f"{shape.where}: has no triangle with an area")
    triangles, origin = _subdivided(np.array(mesh.vertices), faces, scene.settings.bake.texel_m, shape.where)
    return _unshared(triangles, albedo[flat][origin], owner)


def _face_outwards(mesh: trimesh.Trimesh, where: str) -> None:
    """Turn bodies of a mesh that are inside out, in place, with a warning; warn of meshes not closed.

    Raises InputError for a closed mesh whose neighbouring triangles run their common edge the same way.
    """
    if mesh.is_watertight and not mesh.is_winding_consistent:
        raise InputError(
            f"{where}: is closed, but its triangles face outwards and inwards; recalculate its normals outwards"
        )
    before = np.array(mesh.faces)
    trimesh.repair.fix_inversion(mesh, multibody=True)
    if not _has_boundary(mesh.faces) and mesh.volume < 0:  # bodies that share edges, which trimesh leaves alone
        mesh.invert()
    inwards = _open_and_inside_out(mesh)
    mesh.faces = np.where(inwards[:, None], mesh.faces[:, ::-1], mesh.faces)
    turned = int((before != np.array(mesh.faces)).any(axis=1).sum())
    if turned:
        warn_once(logger, f"{where}: is inside out; {turned} of {len(before)} triangles were turned to face outwards")
    if _has_boundary(mesh.faces):
        warn_once(
            logger, f"{where}: is not closed; seen from behind, a triangle shows the light that falls on its front"
        )


def _open_and_inside_out(mesh: trimesh.Trimesh) -> NDArray[np.bool_]:
    """Which triangles (k,) belong to open bodies that face inwards: their volume, closed by fans, is negative."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    inwards = np.zeros(len(faces), dtype=bool)
    for body in trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(faces))):
        edges = np.concatenate([faces[body][:, [0, 1]], faces[body][:, [1, 2]], faces[body][:, [2, 0]]])
        _, which, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
        boundary = edges[count[which.ravel()] == 1]
        one_way = len(np.unique(edges, axis=0)) == len(edges)  # neighbours run their common edge in opposite directions
        if not len(boundary) or not one_way:
            continue
        # a fan from the middle of the boundary adds no volume about this middle
        corners = vertices[faces[body]] - vertices[np.unique(boundary)].mean(axis=0)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        volume = float((corners[:, 0] * normals).sum()) / 6
        area = float(np.linalg.norm(normals, axis=1).sum()) / 2
        inwards[body] = volume < -MIN_HOLLOW * area**1.5
    return inwards


def _has_boundary(faces: Indices) -> bool:
    """Whether some edge is not run as often one way as the other by the triangles (k, 3) at it."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = edges[:, 0] < edges[:, 1]
    _, edge = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    return bool(np.bincount(edge.ravel(), np.where(forward, 1, -1)).any())


def _subdivided(vertices: Array, faces: Indices, texel_m: float, where: str) -> tuple[Array, Indices]:
    """Triangles (k, 3, 3) with no edge longer than a texel, and the number of the face each comes from, (k,)."""
    triangles = vertices[faces]
    edges = np.sort(np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2), axis=1)
    halvings = np.ceil(np.log2(np.maximum(edges / texel_m, 1.0)))
    expected = (2 ** (halvings[:, 0] + halvings[:, 2])).sum()  # parts of the shortest and of the longest edge
    if expected > MAX_TRIANGLES:
        raise InputError(
            f"{where}: makes some {expected:.2g} triangles at bake.texel_m = {texel_m}; at most {MAX_TRIANGLES} are "
            "allowed"
        )
    fine, fine_faces, origin = trimesh.remesh.subdivide_to_size(  # type: ignore[no-untyped-call]
        vertices, faces, texel_m * (1 + 1e-9), max_iter=MAX_SUBDIVISIONS, return_index=True
    )
    return np.asarray(fine[fine_faces], dtype=np.float64), np.asarray(origin, dtype=np.int64)


def _unshared(triangles: Array, albedo: Array, owner: int) -> Mesh:
    """A mesh of triangles (k, 3, 3) that share no vertex, so that each has its own normal and light."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    solid = lengths[:, 0] > 0
    triangles, albedo, normals = triangles[solid], albedo[solid], normals[solid] / lengths[solid]
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    vertices = triangles.reshape(-1, 3)
    return Mesh(
        vertices_m=vertices,
        probes_m=probes_inward(vertices, faces, triangles.mean(axis=1)),
        normals=np.repeat(normals, 3, axis=0),
        albedo=np.repeat(albedo, 3),
        faces=faces,
        owners=np.full(len(faces), owner),
    )


def _one_line(error: Exception) -> str:
    """An error's text, of a long one the end, which says most."""
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else f"...{text[-197:]}"
