"""All diffuse surfaces of a room as one triangle mesh whose corners are where its light is computed.

A surface is cut along the edges of its holes and then into texels. Corners are shared within a surface and never
between surfaces, so that light may jump at an edge. Where a corner's light is computed it is moved a little into its
own surface: at the very edge of a wall a ray would leave the room.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vlcrender.scene.surfaces import Surface

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

INWARD = 0.02
"""How far towards the middle of the texels around it a corner's light is computed, of that distance."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with what each corner needs to be lit.

    vertices_m, probes_m (where the light is computed) and normals: (corners, 3); albedo: (corners,), of a texture its
    mean around each;
    faces: (triangles, 3); owners: (triangles,), the number of the surface each belongs to.
    """

    vertices_m: Array
    probes_m: Array
    normals: Array
    albedo: Array
    faces: Indices
    owners: Indices

    def areas_m2(self) -> Array:
        """Area that each corner stands for: a third of the triangles around it, (corners,)."""
        a, b, c = (self.vertices_m[self.faces[:, i]] for i in range(3))
        triangle = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        areas = np.bincount(self.faces.ravel(), np.repeat(triangle / 3, 3), minlength=len(self.vertices_m))
        return areas.astype(np.float64)


def mesh_of_surfaces(surfaces: tuple[Surface, ...], texel_m: float) -> Mesh:
    """Cut every surface into texels of at most `texel_m`; owners are the surfaces' numbers."""
    return join([_mesh_of_surface(surface, texel_m, number) for number, surface in enumerate(surfaces)])


def join(meshes: list[Mesh]) -> Mesh:
    """Put meshes into one; owners are kept."""
    offsets = np.cumsum([0] + [len(mesh.vertices_m) for mesh in meshes[:-1]])
    return Mesh(
        vertices_m=np.concatenate([mesh.vertices_m for mesh in meshes]),
        probes_m=np.concatenate([mesh.probes_m for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        albedo=np.concatenate([mesh.albedo for mesh in meshes]),
        faces=np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
        owners=np.concatenate([mesh.owners for mesh in meshes]),
    )


def probes_inward(vertices_m: Array, faces: Indices, centers_m: Array) -> Array:
    """Corners moved towards the mean of the centres (triangles, 3) of the faces around them."""
    count = np.bincount(faces.ravel(), minlength=len(vertices_m))
    middle = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(centers_m[:, i], 3), minlength=len(vertices_m)) / np.maximum(count, 1)
            for i in range(3)
        ],
        axis=1,
    )
    probes: Array = vertices_m + INWARD * (middle - vertices_m)
    return probes


def _mesh_of_surface(surface: Surface, texel_m: float, number: int) -> Mesh:
    holes = np.array(surface.holes).reshape(-1, 4)
    a = _cuts(holes[:, [0, 2]].ravel(), float(np.linalg.norm(surface.edge_u_m)), texel_m)
    b = _cuts(holes[:, [1, 3]].ravel(), float(np.linalg.norm(surface.edge_v_m)), texel_m)
    i, j = (index.ravel() for index in np.meshgrid(np.arange(len(a) - 1), np.arange(len(b) - 1), indexing="ij"))
    middle_a, middle_b = (a[i] + a[i + 1]) / 2, (b[j] + b[j + 1]) / 2
    kept = np.ones(len(i), dtype=bool)
    for a0, b0, a1, b1 in holes:
        kept &= ~((middle_a > a0) & (middle_a < a1) & (middle_b > b0) & (middle_b < b1))
    i, j = i[kept], j[kept]
    corner = i * len(b) + j
    quads = np.stack([corner, corner + len(b), corner + len(b) + 1, corner + 1], axis=1)
    used, faces = np.unique(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), return_inverse=True)
    faces = faces.reshape(-1, 3)
    position = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)[used]
    vertices = surface.corner_m + position[:, :1] * surface.edge_u_m + position[:, 1:] * surface.edge_v_m
    middles = np.tile(np.stack([middle_a[kept], middle_b[kept]], axis=1), (2, 1))
    centers = surface.corner_m + middles[:, :1] * surface.edge_u_m + middles[:, 1:] * surface.edge_v_m
    normal = np.cross(surface.edge_u_m, surface.edge_v_m)
    return Mesh(
        vertices_m=vertices,
        probes_m=probes_inward(vertices, faces, centers),
        normals=np.tile(normal / np.linalg.norm(normal), (len(vertices), 1)),
        albedo=_albedo(surface, a, b)[used],
        faces=faces,
        owners=np.full(len(faces), number),
    )


def _albedo(surface: Surface, a: Array, b: Array) -> Array:
    """Of each corner of the grid a x b: the texture's mean half way to its neighbours, so that the light balances."""
    count = len(a) * len(b)
    if surface.texture is None:
        return np.full(count, surface.reflectance)
    low, high = (
        np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(count, 2)
        for sides in zip(_half_way(a), _half_way(b), strict=True)
    )
    edges = np.stack([surface.edge_u_m, surface.edge_v_m])
    return surface.texture.means(surface.corner_m + low @ edges, surface.corner_m + high @ edges)


def _half_way(at: Array) -> tuple[Array, Array]:
    """From where to where each of some sorted places reaches: half way to the next one."""
    middle = (at[:-1] + at[1:]) / 2
    return np.append(at[:1], middle), np.append(middle, at[-1:])


def _cuts(at: Array, length_m: float, texel_m: float) -> Array:
    """Sorted places in [0, 1] with every hole's edge and no step longer than a texel."""
    fixed = np.unique(np.round(np.concatenate([[0.0, 1.0], np.clip(at, 0.0, 1.0)]), 12))
    steps = [
        np.linspace(low, high, max(1, int(np.ceil((high - low) * length_m / texel_m - 1e-9))), endpoint=False)
        for low, high in pairwise(fixed)
    ]
    return np.concatenate([*steps, [1.0]])
