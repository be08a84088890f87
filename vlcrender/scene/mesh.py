"""All diffuse surfaces of a room as one triangle mesh, at whose vertices illuminance is computed.

A surface is cut along the edges of its holes and then into texels. Where another surface or a solid stands on it, its
illuminance changes over centimetres: texels are finest there and grow with the distance (`_cuts`). Triangles of one
surface share vertices, those of different surfaces do not, so that illuminance may jump at an edge. Illuminance of a
vertex is computed at its probe, a point slightly inside the surface: a ray from the very edge of a wall would leave the
room.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vlcrender.scene.surfaces import Surface

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CONTACT_TEXELS = 0.12
"""Size of the texels at a contact of two surfaces, as a fraction of the largest texel."""
NEAR_TEXELS = 0.25
"""Size of the texels below and beside a piece of furniture on a surface, as a fraction of the largest texel."""
GROWTH = 0.5
"""Growth of the texels' size, in metres per metre of distance from a contact."""
LED_DISTANCES = 0.25
"""Largest height of a wall's texels, as a fraction of the distance to the nearest LED."""
MAX_LED_HEIGHTS = 8
"""Largest number of heights of LEDs that the texels of a wall follow; the nearest count."""
NO_LEDS = np.empty((0, 3))
PROBE_INSET = 0.02
"""Distance of a probe from its vertex, as a fraction of half a texel, or of the distance of a triangle's centre."""


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


def mesh_of_surfaces(
    surfaces: tuple[Surface, ...], texel_m: float, furniture: Sequence[Mesh] = (), leds_m: Array = NO_LEDS
) -> Mesh:
    """Surfaces cut into texels of at most `texel_m`; owners are the surfaces' numbers.

    Texels are finer at contacts with other surfaces and with `furniture`, which is not in the mesh, and those of walls
    are lower near LEDs, centred at `leds_m` (n, 3).
    """
    return join(
        [_mesh_of_surface(surface, texel_m, number, furniture, leds_m) for number, surface in enumerate(surfaces)]
    )


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


def _mesh_of_surface(surface: Surface, texel_m: float, number: int, furniture: Sequence[Mesh], leds_m: Array) -> Mesh:
    holes = np.array(surface.holes).reshape(-1, 4)
    solids = np.array(surface.solids).reshape(-1, 4)
    near = np.array(_near(surface, texel_m, furniture) if surface.enclosed else []).reshape(-1, 4)
    a, b = (
        _cuts(
            holes[:, axis].ravel(),
            _Contacts(_intervals(solids, axis), near[:, axis], surface.enclosed, _leds_beside(surface, edge_m, leds_m)),
            float(np.linalg.norm(edge_m)),
            texel_m,
        )
        for axis, edge_m in (([0, 2], surface.edge_u_m), ([1, 3], surface.edge_v_m))
    )
    middle_a, middle_b = (a[:-1] + a[1:]) / 2, (b[:-1] + b[1:]) / 2
    kept = np.ones((len(middle_a), len(middle_b)), dtype=bool)
    for a0, b0, a1, b1 in holes:
        along_a = slice(np.searchsorted(middle_a, a0, "right"), np.searchsorted(middle_a, a1, "left"))
        kept[along_a, np.searchsorted(middle_b, b0, "right") : np.searchsorted(middle_b, b1, "left")] = False
    i, j = np.nonzero(kept)
    vertex = i * len(b) + j
    quads = np.stack([vertex, vertex + len(b), vertex + len(b) + 1, vertex + 1], axis=1)
    used, faces = np.unique(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), return_inverse=True)
    faces = faces.reshape(-1, 3)
    position = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)[used]
    vertices = surface.corner_m + position[:, :1] * surface.edge_u_m + position[:, 1:] * surface.edge_v_m
    at_probe = position + PROBE_INSET * _inset(a, b, i, j)[used]
    probes = surface.corner_m + at_probe[:, :1] * surface.edge_u_m + at_probe[:, 1:] * surface.edge_v_m
    normal = np.cross(surface.edge_u_m, surface.edge_v_m)
    return Mesh(
        vertices_m=vertices,
        probes_m=probes,
        normals=np.tile(normal / np.linalg.norm(normal), (len(vertices), 1)),
        albedo=_albedo(surface, a, b)[used],
        faces=faces,
        owners=np.full(len(faces), number),
    )


def _intervals(rectangles: Array, axis: list[int]) -> Array:
    """Intervals of rectangles (n, 4) along an axis, each once, (k, 2): panels of a column have the same."""
    return np.array(sorted(set(map(tuple, rectangles[:, axis].tolist())))).reshape(-1, 2)


def _inset(a: Array, b: Array, i: Indices, j: Indices) -> Array:
    """Ways (len(a) * len(b), 2) from the vertices of a grid into its texels (i, j), half a texel along each axis.

    0 along an axis with as many texels on one side of the vertex as on the other. At the corner of a hole the way
    leads away from the hole, whatever the sizes of the texels around.
    """
    balance = np.zeros((len(a), len(b), 2))
    for step_i in (0, 1):
        for step_j in (0, 1):
            np.add.at(balance, (i + step_i, j + step_j), np.array([1 - 2 * step_i, 1 - 2 * step_j]))
    ways: Array = np.sign(balance)
    for axis, cuts in enumerate((a, b)):
        half = np.diff(cuts) / 2
        smaller = np.minimum(np.append(half[:1], half), np.append(half, half[-1:]))
        ways[..., axis] *= smaller[:, None] if axis == 0 else smaller[None, :]
    return ways.reshape(-1, 2)


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


def _leds_beside(surface: Surface, edge_m: Array, leds_m: Array) -> Array:
    """Distance from a wall and height over its lowest point of each LED, (n, 2); none along edges of other directions.

    Of LEDs at one height, which is rounded to millimetres, the nearest alone; at most MAX_LED_HEIGHTS of them.
    """
    if not surface.enclosed or edge_m[:2].any() or not len(leds_m):
        return np.empty((0, 2))
    normal = np.cross(surface.edge_u_m, surface.edge_v_m)
    from_corner = leds_m - surface.corner_m
    beside = np.stack([from_corner @ normal / np.linalg.norm(normal), from_corner[:, 2].round(3)], axis=1)
    beside = beside[np.argsort(beside[:, 0])]
    _, nearest = np.unique(beside[:, 1], return_index=True)
    return beside[np.sort(nearest)[:MAX_LED_HEIGHTS]]


def _near(surface: Surface, texel_m: float, furniture: Sequence[Mesh]) -> list[Array]:
    """(a0, b0, a1, b1) around the parts of each piece of furniture that are less than a texel from a surface."""
    normal = np.cross(surface.edge_u_m, surface.edge_v_m)
    normal = normal / np.linalg.norm(normal)
    edges = np.stack([surface.edge_u_m / (surface.edge_u_m**2).sum(), surface.edge_v_m / (surface.edge_v_m**2).sum()])
    rectangles = []
    for mesh in furniture:
        from_corner = mesh.vertices_m - surface.corner_m
        at = from_corner[np.abs(from_corner @ normal) < texel_m] @ edges.T
        if len(at):
            rectangles.append(np.concatenate([at.min(axis=0), at.max(axis=0)]))
    return rectangles


@dataclass(frozen=True)
class _Contacts:
    """What stands on or near a surface, along one of its sides; positions along the side are 0 to 1."""

    solids: Array
    """Intervals on which solids stand, (n, 2), each once."""
    near: Array
    """Intervals near furniture, (n, 2)."""
    enclosed: bool
    """Whether other surfaces stand at both ends."""
    leds: Array
    """LEDs beside a wall, (n, 2), by `_leds_beside`."""

    def steps_m(self, at: Array, length_m: float, texel_m: float) -> Array:
        """Step between neighbouring vertices at some positions (n,) along the side, (n,)."""
        contact, growth = CONTACT_TEXELS * texel_m, GROWTH * length_m
        steps = np.full(len(at), texel_m)
        if self.enclosed:
            steps = np.minimum(steps, contact + growth * np.minimum(at, 1.0 - at))
        for low, high in self.solids:
            outside = (at < low) | (at > high)
            beside = contact + growth * np.maximum(low - at, at - high)
            steps = np.where(outside, np.minimum(steps, beside), steps)
        for low, high in self.near:
            distance = np.maximum(np.maximum(low - at, at - high), 0.0)
            steps = np.minimum(steps, NEAR_TEXELS * texel_m + growth * distance)
        for distance_m, height_m in self.leds:
            below_m = height_m - at * length_m  # LEDs face down
            limit = np.maximum(LED_DISTANCES * np.hypot(distance_m, below_m), contact)
            steps = np.where(below_m > 0, np.minimum(steps, limit), steps)
        return steps


def _cuts(given: Array, contacts: _Contacts, length_m: float, texel_m: float) -> Array:
    """Sorted positions in [0, 1] along one side of a surface that include the given ones.

    The step is at most `texel_m`. At a contact it is CONTACT_TEXELS of it, near furniture NEAR_TEXELS, and it grows by
    GROWTH with the distance. On a wall it is at most LED_DISTANCES of the distance from the nearest LED, and there is a
    position at the height of each, above which it lights nothing.
    """
    heights = contacts.leds[:, 1] / length_m
    fixed = np.unique(np.round(np.concatenate([[0.0, 1.0], np.clip([*given, *heights], 0.0, 1.0)]), 12))
    parts = []
    for low, high in pairwise(fixed):
        samples = int(np.ceil(16 * (high - low) * length_m / (CONTACT_TEXELS * texel_m)))
        edges = np.linspace(low, high, samples + 1)
        steps = contacts.steps_m((edges[:-1] + edges[1:]) / 2, length_m, texel_m)
        if (steps == texel_m).all():
            cells = max(1, int(np.ceil((high - low) * length_m / texel_m - 1e-9)))
            parts.append(np.linspace(low, high, cells, endpoint=False))
            continue
        texels = np.append(0.0, np.cumsum(np.diff(edges) * length_m / steps))  # number of texels up to each edge
        cells = max(1, int(np.ceil(texels[-1] - 1e-9)))
        cuts = np.interp(np.arange(cells) * texels[-1] / cells, texels, edges)
        parts.append(np.round(cuts, 12))  # the same on every machine
    return np.concatenate([*parts, [1.0]])
