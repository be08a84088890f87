"""Furniture: PLY and OBJ meshes, and Mitsuba XML made of meshes, as part of a room's mesh."""

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.backend import dr, mi
from vlcrender.errors import InputError
from vlcrender.scene.loader import Scene
from vlcrender.scene.mesh import Mesh, join, probes_inward
from vlcrender.scene.schema import Furniture

Array = NDArray[np.float64]
MAX_TRIANGLES = 2_000_000


def furniture_meshes(scene: Scene, first_owner: int) -> list[Mesh]:
    """One mesh a piece, cut into texels; owners go on from `first_owner`.

    Raises InputError where a file is no mesh, is empty, or stands outside the room.
    """
    meshes = []
    for number, piece in enumerate(scene.settings.furniture):
        where = f"furniture[{number}].file = {piece.file!r}"
        parts = [_mesh(shape, piece, first_owner + number, scene, where) for shape in _shapes(scene, piece, where)]
        meshes.append(join(parts))
    return meshes


def _shapes(scene: Scene, piece: Furniture, where: str) -> "list[mi.Mesh]":
    path = scene.folder / piece.file
    try:
        if path.suffix == ".xml":
            shapes = list(mi.load_file(str(path), optimize=False).shapes())
        else:
            bsdf = {"type": "diffuse", "reflectance": piece.reflectance}
            shapes = [mi.load_dict({"type": path.suffix[1:], "filename": str(path), "bsdf": bsdf})]
    except RuntimeError as error:
        raise InputError(f"{where}: Mitsuba cannot load it: {' '.join(str(error).split())[:200]}") from None
    if not shapes:
        raise InputError(f"{where}: holds no shape")
    for shape in shapes:
        if not shape.is_mesh():
            raise InputError(f"{where}: shape {shape.id()!r} is no mesh; ply, obj, serialized, cube and rectangle are")
        if shape.is_emitter():
            raise InputError(f"{where}: shape {shape.id()!r} is an emitter; light comes from LEDs, windows and ambient")
    return shapes


def _mesh(shape: "mi.Mesh", piece: Furniture, owner: int, scene: Scene, where: str) -> Mesh:
    parameters = mi.traverse(shape)
    vertices = np.array(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    faces = np.array(parameters["faces"], dtype=np.int64).reshape(-1, 3)
    yaw = np.radians(piece.yaw_deg)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    vertices = piece.scale * vertices @ turn.T + np.array(piece.position_m)
    if not len(faces) or not np.isfinite(vertices).all():
        raise InputError(f"{where}: has no triangle, or corners that are not finite")
    if (vertices < -1e-6).any() or (vertices > scene.room_m + 1e-6).any():
        low, high = vertices.min(axis=0).round(3).tolist(), vertices.max(axis=0).round(3).tolist()
        raise InputError(f"{where}: reaches from {low} to {high} m, outside the room of {scene.room_m.tolist()} m")
    albedo = _albedo(shape, faces)
    corners, albedo = _subdivide(vertices[faces], albedo, scene.settings.bake.texel_m, where)
    return _unshared(corners, albedo, owner)


def _albedo(shape: "mi.Mesh", faces: NDArray[np.int64]) -> Array:
    """Diffuse reflectance in the middle of each triangle, textures included, (triangles,)."""
    count = len(faces)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    uv = np.array(mi.traverse(shape)["vertex_texcoords"], dtype=np.float64).reshape(-1, 2)
    middle = uv[faces].mean(axis=1) if len(uv) else np.full((count, 2), 0.5)
    si.uv = mi.Point2f(middle.T.astype(np.float32))
    si.wi = mi.Vector3f(0, 0, 1)
    value = shape.bsdf().eval_diffuse_reflectance(si)
    return np.broadcast_to(np.array(value, dtype=np.float64).reshape(-1), (count,)).copy()


def _subdivide(corners: Array, albedo: Array, texel_m: float, where: str) -> tuple[Array, Array]:
    """Halve the longest edge of triangles (n, 3, 3) until none is longer than a texel."""
    done: list[tuple[Array, Array]] = []
    while len(corners):
        edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        long = edges.max(axis=1) > texel_m * (1 + 1e-9)
        done.append((corners[~long], albedo[~long]))
        if sum(len(part) for part, _ in done) + 2 * long.sum() > MAX_TRIANGLES:
            raise InputError(f"{where}: makes more than {MAX_TRIANGLES} triangles at bake.texel_m = {texel_m}")
        corners, albedo, longest = corners[long], albedo[long], edges[long].argmax(axis=1)
        rows = np.arange(len(corners))
        a, b, c = (corners[rows, (longest + i) % 3] for i in range(3))
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        albedo = np.concatenate([albedo, albedo])
    return np.concatenate([part for part, _ in done]), np.concatenate([part for _, part in done])


def _unshared(corners: Array, albedo: Array, owner: int) -> Mesh:
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    solid = lengths[:, 0] > 0
    corners, albedo, normals = corners[solid], albedo[solid], (normals / np.where(lengths > 0, lengths, 1))[solid]
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    vertices = corners.reshape(-1, 3)
    return Mesh(
        vertices_m=vertices,
        probes_m=probes_inward(vertices, faces, corners.mean(axis=1)),
        normals=np.repeat(normals, 3, axis=0),
        albedo=np.repeat(albedo, 3),
        faces=faces,
        owners=np.full(len(faces), owner),
    )
