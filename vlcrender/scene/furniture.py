"""Furniture: PLY and OBJ meshes, and Mitsuba XML made of meshes, as part of a room's mesh.

Bodies of a closed mesh end up with every triangle's vertices counter-clockwise as seen from outside, which is the side
that is lit. A body that is inside out is turned, with a warning: furniture is opaque, so that its outside is the only
side that can be meant, and files of both senses are common. A closed mesh whose neighbouring triangles disagree is
refused: which of them are wrong is not known before all are compared, and every modeller has the command for it.

A mesh that is not closed, such as a table top of one quadrilateral or a box without its bottom, is a thin opaque sheet:
each side has light of its own. A second layer of triangles, turned, is SHEET_M behind the first.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from vlcrender.core.warn_once import warn_once
from vlcrender.errors import InputError
from vlcrender.scene.loader import Scene
from vlcrender.scene.mesh import Mesh, join, probes_inward
from vlcrender.scene.mesh_file import read_mesh
from vlcrender.scene.paths import file_inside
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
SHEET_M = 1e-4
"""Distance of the two sides of a mesh that is not closed, in rooms of up to 100 m. It grows with larger rooms, whose
coordinates round more in single precision."""


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
        path = file_inside(scene.folder, piece.file, where)
        shapes = _xml_shapes(path, scene.folder, where) if path.suffix == ".xml" else [_file_shape(path, piece, where)]
        meshes.append(join([_room_mesh(shape, piece, first_owner + number, scene) for shape in shapes]))
    return meshes


def _file_shape(path: Path, piece: Furniture, where: str) -> _Shape:
    mesh = read_mesh(path, where)
    return _Shape(where, mesh.vertices, mesh.faces, np.full(len(mesh.faces), piece.reflectance))


def _xml_shapes(path: Path, folder: Path, where: str) -> list[_Shape]:
    from vlcrender.scene.mitsuba_xml import read_xml  # loads Mitsuba

    shapes = read_xml(path, folder, where)
    return [_Shape(shape.where, shape.mesh.vertices, shape.mesh.faces, shape.albedo) for shape in shapes]


def _room_mesh(shape: _Shape, piece: Furniture, owner: int, scene: Scene) -> Mesh:
    """A shape put into the room, checked, oriented and subdivided."""
    if not len(shape.faces):
        raise InputError(f"{shape.where}: has no triangle")
    if not np.isfinite(shape.vertices).all():
        raise InputError(f"{shape.where}: has vertices that are not finite")
    yaw = np.radians(piece.yaw_deg)
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    with np.errstate(all="ignore"):
        vertices = piece.scale * shape.vertices @ rotation.T + np.array(piece.position_m)
    used = vertices[np.unique(shape.faces)]
    if (
        not np.isfinite(used).all()
        or (used < -ROOM_TOLERANCE_M).any()
        or (used > scene.room_m + ROOM_TOLERANCE_M).any()
    ):
        low, high = used.min(axis=0).round(3).tolist(), used.max(axis=0).round(3).tolist()
        raise InputError(f"{shape.where}: is from {low} to {high} m, outside the room of {scene.room_m.tolist()} m")
    mesh = trimesh.Trimesh(vertices, shape.faces, process=False)
    mesh.merge_vertices()
    a, b, c = mesh.faces.T
    distinct = (a != b) & (b != c) & (c != a)
    mesh.update_faces(distinct)
    albedo = shape.albedo[distinct]
    closed = _face_outwards(mesh, shape.where)
    solid = mesh.area_faces > 0
    faces = np.array(mesh.faces)[solid]
    if not len(faces):
        raise InputError(f"{shape.where}: has no triangle with an area")
    triangles, origin = _subdivided(np.array(mesh.vertices), faces, scene.settings.bake.texel_m, shape.where)
    front = _unshared(triangles, albedo[solid][origin], owner)
    if closed:
        return front
    sheet_m = SHEET_M * max(1.0, float(scene.room_m.max()) / 100)
    behind = (front.vertices_m - sheet_m * front.normals).reshape(-1, 3, 3)[:, ::-1]
    return join([front, _unshared(behind, front.albedo[front.faces[:, 0]], owner)])


def _face_outwards(mesh: trimesh.Trimesh, where: str) -> bool:
    """Turn bodies of a mesh that are inside out, in place, with a warning; whether the mesh is closed.

    Raises InputError for a closed mesh whose neighbouring triangles run their common edge the same way.
    """
    if mesh.is_watertight and not mesh.is_winding_consistent:
        raise InputError(
            f"{where}: is closed, but its triangles face outwards and inwards; recalculate its normals outwards"
        )
    if _has_boundary(mesh.faces):
        return False
    before = np.array(mesh.faces)
    trimesh.repair.fix_inversion(mesh, multibody=True)
    if mesh.volume < 0:  # bodies that share edges, which trimesh leaves alone
        mesh.invert()
    turned = int((before != np.array(mesh.faces)).any(axis=1).sum())
    if turned:
        warn_once(logger, f"{where}: is inside out; {turned} of {len(before)} triangles were turned to face outwards")
    return True


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
