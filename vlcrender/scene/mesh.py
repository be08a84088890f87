"""All diffuse surfaces of a room as one triangle mesh, at whose vertices illuminance is computed.

A surface is cut along the edges of its holes and then into texels. Triangles of one surface share vertices, those of
different surfaces do not, so that illuminance may jump at an edge. Illuminance of a vertex is computed at its probe, a
point slightly inside the surface: a ray from the very edge of a wall would leave the room.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vlcrender.scene.surfaces import Surface

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

PROBE_INSET = 0.02
"""Distance of a probe from its vertex, as a fraction of that to the mean centre of the triangles at the vertex."""


@dataclass(frozen=True)
class Mesh:
    """n vertices with the data that their illumination needs, and k triangles."""

    vertices_m: Array
    """Positions, (n, 3), world."""
    probes_m: Array
    """Points at which the vertices' illuminance is computed, (n, 3), world."""
    normals: Array
    """Unit normals, (n, 3), towards the lit side."""
    albedo: Array
    """Diffuse reflectance, (n,); of a texture, the mean around each vertex."""
    faces: Indices
    """Vertices of each triangle, (k, 3)."""
    owners: Indices
    """Number of the surface or piece of furniture that each triangle belongs to, (k,)."""

    def areas_m2(self) -> Array:
        """Area of each vertex, (n,): a third of the area of the triangles at it."""
        a, b, c = (self.vertices_m[self.faces[:, i]] for i in range(3))
        triangle = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        areas = np.bincount(self.faces.ravel(), np.repeat(triangle / 3, 3), minlength=len(self.vertices_m))
        return areas.astype(np.float64)


def mesh_of_surfaces(surfaces: tuple[Surface, ...], texel_m: float) -> Mesh:
    """Surfaces cut into texels of at most `texel_m`; owners are the surfaces' numbers."""
    return join([_mesh_of_surface(surface, texel_m, number) for number, surface in enumerate(surfaces)])


def join(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one; owners are kept."""
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
    """Vertices (n, 3) moved by PROBE_INSET towards the mean of the centres (k, 3) of the triangles at them."""
    count = np.bincount(faces.ravel(), minlength=len(vertices_m))
    middle = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(centers_m[:, i], 3), minlength=len(vertices_m)) / np.maximum(count, 1)
            for i in range(3)
        ],
        axis=1,
    )
    probes: Array = vertices_m + PROBE_INSET * (middle - vertices_m)
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
    vertex = i * len(b) + j
    quads = np.stack([vertex, vertex + len(b), vertex + len(b) + 1, vertex + 1], axis=1)
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
    """Reflectance of each vertex of the grid a x b: the texture's mean half way to its neighbours.

    These cells tile the surface, so that their means conserve energy.
    """
    count = len(a) * len(b)
    if surface.texture is None:
        return np.full(count, surface.reflectance)
    low, high = (
        np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(count, 2)
        for sides in zip(_half_way(a), _half_way(b), strict=True)
    )
    edges = np.stack([surface.edge_u_m, surface.edge_v_m])
    return surface.texture.means(surface.corner_m + low @ edges, surface.corner_m + high @ edges)


def _half_way(positions: Array) -> tuple[Array, Array]:
    """Lower and upper limits half way between sorted positions; the first and the last position at the ends."""
    middle = (positions[:-1] + positions[1:]) / 2
    return np.append(positions[:1], middle), np.append(middle, positions[-1:])


def _cuts(hole_edges: Array, length_m: float, texel_m: float) -> Array:
    """Sorted positions in [0, 1] that include every hole's edge, with no step longer than a texel."""
    fixed = np.unique(np.round(np.concatenate([[0.0, 1.0], np.clip(hole_edges, 0.0, 1.0)]), 12))
    steps = [
        np.linspace(low, high, max(1, int(np.ceil((high - low) * length_m / texel_m - 1e-9))), endpoint=False)
        for low, high in pairwise(fixed)
    ]
    return np.concatenate([*steps, [1.0]])
