"""Ray casting from the camera: luminance of the baked room, and of its mirror image in glazing.

The room is one mesh through which Mitsuba casts rays. Luminance at a hit is interpolated between the vertices of the
triangle. A ray that hits glazing is reflected once and traced on; reflections of glazing in glazing are left out.

On a textured surface the interpolated illuminance is multiplied by the texture's mean over the pixel's footprint on the
surface. The footprint is a parallelogram, taken as PIECES x PIECES axis-parallel rectangles of the same centres and
variances, each looked up in a summed-area table (F. Crow, Summed-area tables for texture mapping, SIGGRAPH 1984). The
mean is exact for a footprint with sides along the image's, of any size; nothing aliases. Within a pixel of the image,
reflectance is linear between pixel centres: squares blurred by one pixel, which widens the rectangles.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.backend import dr, mi
from vlcrender.light.lightmap import Lightmap
from vlcrender.scene.fresnel import glazing_reflectance
from vlcrender.scene.mesh import Mesh
from vlcrender.scene.surfaces import Glazing, Surface

Array = NDArray[np.float64]

PIECES = 2
"""Rectangles along each side of a footprint."""
MAX_FOOTPRINT_PX = 1e6
"""Limit of a footprint's extent in pixels of the image, far beyond one tile: the mean over a tile is exact."""
MIN_COSINE = 1e-9
"""Limit of a scaled cosine between ray and surface, against division by zero at grazing incidence."""


@dataclass(frozen=True)
class Hit:
    """Results of rays: Dr.Jit arrays with one entry per ray."""

    value: Any
    """Interpolated value (see `Room.values`), or a pair of them, with reflections in glazing and textures."""
    surface: Any
    """Number of the surface hit: surfaces, then furniture, then glazing, then `Room.nothing`."""
    distance_m: Any
    """Distance to the surface."""
    path_m: Any
    """Length of the path to the point that is imaged: by way of glazing, or `distance_m` without."""


class Room:
    """The room's mesh and glazing in Mitsuba, ready for rays."""

    def __init__(self, mesh: Mesh, glazings: tuple[Glazing, ...], surfaces: tuple[Surface, ...]) -> None:
        """Put mesh and glazing into one Mitsuba mesh. `surfaces`, by owner, have the textures."""
        self.first_glazing = int(mesh.owners.max()) + 1
        self.nothing = self.first_glazing + len(glazings)
        self._glazings = glazings
        vertices, faces, owners = [mesh.vertices_m], [mesh.faces], [mesh.owners]
        for number, glazing in enumerate(glazings):
            first = len(mesh.vertices_m) + 4 * number
            vertices.append(glazing.corners_m)
            faces.append(np.array([[0, 1, 2], [0, 2, 3]]) + first)
            owners.append(np.full(2, self.first_glazing + number))
        all_faces = np.concatenate(faces)
        shape = mi.Mesh("room", sum(map(len, vertices)), len(all_faces))
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = np.concatenate(vertices).astype(np.float32).ravel()
        parameters["faces"] = all_faces.astype(np.uint32).ravel()
        parameters.update()
        self._scene = mi.load_dict({"type": "scene", "room": shape}, optimize=False)
        self._faces, self._owners = all_faces, np.append(np.concatenate(owners), self.nothing)
        normals = np.zeros((self.nothing + 1, 3))
        indices = np.ones(self.nothing + 1)
        for number, glazing in enumerate(glazings):
            normals[self.first_glazing + number] = glazing.normal
            indices[self.first_glazing + number] = glazing.refractive_index
        self._glazing_normal = mi.Vector3f(*normals.T.astype(np.float32))
        self._refractive_index = mi.Float(indices.astype(np.float32))
        self._triangles = len(all_faces)
        self.textures = Textures(surfaces, self.nothing + 1) if any(s.texture is not None for s in surfaces) else None
        self._textured = np.zeros(len(mesh.vertices_m), dtype=bool)
        for number, surface in enumerate(surfaces):
            if surface.texture is not None:
                self._textured[mesh.faces[mesh.owners == number]] = True

    def values(self, light: Lightmap, led_rate: float, ambient_rate: float) -> "mi.Float":
        """Values for `trace`: luminance by LEDs times one rate plus other luminance times another.

        Four numbers for each triangle, which lie together in memory: the value of its first vertex, the differences of
        the others from that, and the surface's number; and four for no triangle. Vertices of textured surfaces have the
        value of a reflectance of 1.
        """
        count = len(light.mesh.vertices_m)
        surfaces = led_rate * light.led_cd_m2()[:count] + ambient_rate * light.ambient_cd_m2()[:count]
        lux = led_rate * light.led_lux[:count] + ambient_rate * light.ambient_lux[:count]
        surfaces = np.where(self._textured, lux / np.pi, surfaces)
        glazings = np.repeat([ambient_rate * glazing.luminance_cd_m2 for glazing in self._glazings], 4)
        values = np.concatenate([surfaces, glazings]).astype(np.float32)
        table = np.zeros((self._triangles + 1, 4), dtype=np.float32)
        first, second, third = (values[vertices] for vertices in self._faces.T)
        table[:-1, 0], table[:-1, 1], table[:-1, 2] = first, second - first, third - first
        table[:, 3] = self._owners
        return mi.Float(table.ravel())

    def trace(
        self,
        origin: Any,
        direction: Any,
        values: Sequence[Any],
        coherent: bool = True,
        spread: tuple[Any, Any] | None = None,
    ) -> Hit:
        """Trace rays from Dr.Jit points along unit directions, world.

        values: one or two of those made by `values`; the hits' values are then numbers or pairs. spread: change of the
        direction over one pixel, along rows and along columns; textures need it.
        """
        value, surface, distance = self._intersect(origin, direction, values, coherent, mi.Bool(True))
        path = distance
        if self.textures is not None and spread is not None:
            point = dr.fma(direction, distance, origin)
            value *= self.textures.reflectance(surface, point, direction, distance, spread)
        if self._glazings:
            on_glazing = (surface >= self.first_glazing) & (surface < self.nothing)
            normal = dr.gather(mi.Vector3f, self._glazing_normal, surface)
            cosine = dr.abs(dr.dot(direction, normal))
            onward = _mirrored(direction, normal)
            start = dr.fma(direction, distance, origin) + normal * 1e-5
            reflected, reflected_surface, beyond = self._intersect(start, onward, values, False, on_glazing)
            if self.textures is not None and spread is not None:
                turned = _mirrored(spread[0], normal), _mirrored(spread[1], normal)
                point = dr.fma(onward, beyond, start)
                reflected *= self.textures.reflectance(reflected_surface, point, onward, distance + beyond, turned)
            reflectance = glazing_reflectance(cosine, dr.gather(mi.Float, self._refractive_index, surface), dr.sqrt)
            value = dr.select(on_glazing, dr.lerp(value, reflected, reflectance), value)
            path = dr.select(on_glazing, distance + beyond, distance)
        return Hit(value, surface, distance, path)

    def _intersect(
        self, origin: Any, direction: Any, values: Sequence[Any], coherent: bool, active: Any
    ) -> tuple[Any, Any, Any]:
        """Value, surface number and distance of the first hit of each ray."""
        hit = self._scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=coherent, active=active)
        valid = hit.is_valid() & active
        triangle = dr.select(valid, hit.prim_index, self._triangles)
        b1, b2 = hit.prim_uv.x, hit.prim_uv.y
        corners = [dr.gather(mi.Vector4f, table, triangle) for table in values]
        light = [dr.fma(b2, along_2, dr.fma(b1, along_1, first)) for first, along_1, along_2, _ in corners]
        value, owner = light[0] if len(light) == 1 else mi.Vector2f(*light), corners[0][3]
        return dr.select(valid, value, 0.0), mi.UInt32(owner), dr.select(valid, hit.t, 1e9)


def _mirrored(vector: Any, normal: Any) -> Any:
    return vector - 2 * dr.dot(vector, normal) * normal


class Textures:
    """The textures of a room's surfaces as Dr.Jit arrays."""

    def __init__(self, surfaces: tuple[Surface, ...], owners: int) -> None:
        """Make one summed-area table per image, of 2 x 2 tiles: rectangles of up to one tile never cross its border."""
        tables: list[Array] = []
        starts: dict[int, int] = {}
        offsets, columns, rows = (np.zeros(owners) for _ in range(3))
        origin, across, down, normal = (np.zeros((owners, 3)) for _ in range(4))
        for owner, surface in enumerate(surfaces):
            texture = surface.texture
            if texture is None:
                continue
            image = texture.reflectances
            if id(image) not in starts:
                starts[id(image)] = sum(map(len, tables))
                sums = np.tile(image, (2, 2)).cumsum(axis=0).cumsum(axis=1)
                tables.append(np.pad(sums, 1).ravel())  # the far sides are for indices that rounding puts there
            offsets[owner] = starts[id(image)]
            rows[owner], columns[owner] = image.shape
            origin[owner] = texture.origin_m
            across[owner] = texture.across_m / (texture.across_m**2).sum() * image.shape[1]
            down[owner] = texture.down_m / (texture.down_m**2).sum() * image.shape[0]
            normal[owner] = np.cross(across[owner], down[owner])
        self._sums = mi.Float64(np.concatenate(tables))
        self._start = mi.UInt32(offsets.astype(np.uint32))
        self._columns, self._rows = (mi.Float(count.astype(np.float32)) for count in (columns, rows))
        self._origin, self._across, self._down, self._normal = (
            mi.Vector3f(*vectors.T.astype(np.float32)) for vectors in (origin, across, down, normal)
        )

    def reflectance(self, owner: Any, point: Any, direction: Any, path_m: Any, spread: tuple[Any, Any]) -> Any:
        """Mean reflectance over a pixel's footprint, 1 without a texture. path_m: length from the lens to the point."""
        columns, rows = (dr.gather(mi.Float, count, owner) for count in (self._columns, self._rows))
        textured = columns > 0
        origin, across, down, normal = (
            dr.gather(mi.Vector3f, vectors, owner, textured)
            for vectors in (self._origin, self._across, self._down, self._normal)
        )
        facing = dr.dot(direction, normal)
        facing = dr.select(dr.abs(facing) > MIN_COSINE, facing, MIN_COSINE)
        sides = [path_m * (side - direction * (dr.dot(side, normal) / facing)) for side in spread]
        ux, uy, vx, vy = (
            dr.clip(dr.dot(side, axis), -MAX_FOOTPRINT_PX, MAX_FOOTPRINT_PX)
            for side in sides
            for axis in (across, down)
        )
        x, y = dr.dot(point - origin, across), dr.dot(point - origin, down)
        # variance of a piece of the footprint plus that of the blur by one pixel of the image
        width = dr.minimum(dr.sqrt((ux * ux + vx * vx) / PIECES**2 + 1), columns)
        height = dr.minimum(dr.sqrt((uy * uy + vy * vy) / PIECES**2 + 1), rows)
        total = mi.Float(0.0)
        steps = [(i + 0.5) / PIECES - 0.5 for i in range(PIECES)]
        start, stride = dr.gather(mi.UInt32, self._start, owner, textured), 2 * mi.UInt32(columns) + 2
        for i in steps:
            for j in steps:
                left, top = x + i * ux + j * vx - width / 2, y + i * uy + j * vy - height / 2
                left, top = left - columns * dr.floor(left / columns), top - rows * dr.floor(top / rows)
                total += self._sum(start, stride, left, top, width, height, textured)
        return dr.select(textured, total / (PIECES**2 * width * height), 1.0)

    def _sum(self, start: Any, stride: Any, left: Any, top: Any, width: Any, height: Any, active: Any) -> Any:
        """Integral over rectangles, in pixels. Double precision, for small differences of large sums."""
        at_x = [_floor_and_fraction(mi.Float64(edge)) for edge in (left, mi.Float64(left) + mi.Float64(width))]
        at_y = [_floor_and_fraction(mi.Float64(edge)) for edge in (top, mi.Float64(top) + mi.Float64(height))]
        edges = []
        for row, below in at_y:
            first = start + row * stride
            edge = []
            for column, beyond in at_x:
                index = first + column
                a, b, c, d = (
                    dr.gather(mi.Float64, self._sums, place, active)
                    for place in (index, index + 1, index + stride, index + stride + 1)
                )
                edge.append(dr.lerp(dr.lerp(a, b, beyond), dr.lerp(c, d, beyond), below))
            edges.append(edge[1] - edge[0])
        return mi.Float(edges[1] - edges[0])


def _floor_and_fraction(place: Any) -> tuple[Any, Any]:
    whole = dr.floor(place)
    return mi.UInt32(whole), place - whole
