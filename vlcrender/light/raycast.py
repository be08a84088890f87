"""What rays from the camera meet: the room's baked light, and its mirror image in window panes.

The room is one mesh through which Mitsuba casts rays; the light at a hit is interpolated between the corners of the
triangle. Where a ray meets a pane it is mirrored once and followed on; what a pane shows in another pane is left out.

On a textured surface illuminance is interpolated, and multiplied by the texture's mean over what the pixel sees of the
surface: a parallelogram, taken as PIECES x PIECES upright rectangles of the same centres and spreads, each looked up in
a table of sums (F. Crow, Summed-area tables for texture mapping, SIGGRAPH 1984). The mean is exact for a pixel whose
sides are along the image's, however large; nothing aliases. Within a pixel of the image reflectance is linear between
the pixels' centres: their squares blurred by one pixel, which widens the rectangles.
"""

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
MAX_SPREAD_PX = 1e6
"""Of a texture seen by one pixel: far beyond one tile, which is all that counts."""
GRAZING = 1e-9


@dataclass(frozen=True)
class Hit:
    """Dr.Jit arrays, one entry a ray: light seen, number of the surface met, and the distance to it in metres.

    `surface` counts surfaces, then furniture, then panes, then nothing. `path_m` is the way to what a pane shows, and
    `distance_m` where the ray meets none.
    """

    value: Any
    surface: Any
    distance_m: Any
    path_m: Any


class Room:
    """The room's mesh in Mitsuba with its panes, ready for rays."""

    def __init__(self, mesh: Mesh, glazings: tuple[Glazing, ...], surfaces: tuple[Surface, ...]) -> None:
        """Put mesh and panes into one Mitsuba mesh. `surfaces` are the mesh's, by owner, for their textures."""
        self.first_glazing = int(mesh.owners.max()) + 1
        self.nothing = self.first_glazing + len(glazings)
        self._panes = glazings
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
        self._corners = [mi.UInt32(all_faces[:, i].astype(np.uint32)) for i in range(3)]
        self._owners = mi.UInt32(np.append(np.concatenate(owners), self.nothing).astype(np.uint32))
        normals = np.zeros((self.nothing + 1, 3))
        indices = np.ones(self.nothing + 1)
        for number, glazing in enumerate(glazings):
            normals[self.first_glazing + number] = glazing.normal
            indices[self.first_glazing + number] = glazing.refractive_index
        self._pane_normal = mi.Vector3f(*normals.T.astype(np.float32))
        self._pane_index = mi.Float(indices.astype(np.float32))
        self._triangles = len(all_faces)
        self.textures = Textures(surfaces, self.nothing + 1) if any(s.texture is not None for s in surfaces) else None
        self._textured = np.zeros(len(mesh.vertices_m), dtype=bool)
        for number, surface in enumerate(surfaces):
            if surface.texture is not None:
                self._textured[mesh.faces[mesh.owners == number]] = True

    def values(self, light: Lightmap, led_rate: float, ambient_rate: float) -> "mi.Float":
        """What corners are worth in `look`: light from LEDs times one factor plus other light times another.

        Of textured surfaces that is what they would be worth if they reflected all.
        """
        corners = len(light.mesh.vertices_m)
        surfaces = led_rate * light.led_cd_m2()[:corners] + ambient_rate * light.ambient_cd_m2()[:corners]
        lux = led_rate * light.led_lux[:corners] + ambient_rate * light.ambient_lux[:corners]
        surfaces = np.where(self._textured, lux / np.pi, surfaces)
        glazings = np.repeat([ambient_rate * glazing.luminance_cd_m2 for glazing in self._panes], 4)
        return mi.Float(np.concatenate([surfaces, glazings]).astype(np.float32))

    def trace(
        self, origin: Any, direction: Any, values: Any, coherent: bool = True, spread: tuple[Any, Any] | None = None
    ) -> Hit:
        """Cast rays (Dr.Jit points and unit directions, world).

        `spread` says by how much the direction changes across and down a pixel; textures need it.
        """
        value, surface, distance = self._meet(origin, direction, values, coherent, mi.Bool(True))
        path = distance
        if self.textures is not None and spread is not None:
            point = dr.fma(direction, distance, origin)
            value *= self.textures.reflectance(surface, point, direction, distance, spread)
        if self._panes:
            on_glazing = (surface >= self.first_glazing) & (surface < self.nothing)
            normal = dr.gather(mi.Vector3f, self._pane_normal, surface)
            cosine = dr.abs(dr.dot(direction, normal))
            onward = _mirrored(direction, normal)
            start = dr.fma(direction, distance, origin) + normal * 1e-5
            second, shown, beyond = self._meet(start, onward, values, False, on_glazing)
            if self.textures is not None and spread is not None:
                turned = _mirrored(spread[0], normal), _mirrored(spread[1], normal)
                point = dr.fma(onward, beyond, start)
                second *= self.textures.reflectance(shown, point, onward, distance + beyond, turned)
            reflectance = glazing_reflectance(cosine, dr.gather(mi.Float, self._pane_index, surface), dr.sqrt)
            value = dr.select(on_glazing, dr.lerp(value, second, reflectance), value)
            path = dr.select(on_glazing, distance + beyond, distance)
        return Hit(value, surface, distance, path)

    def _meet(self, origin: Any, direction: Any, values: Any, coherent: bool, active: Any) -> tuple[Any, Any, Any]:
        hit = self._scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=coherent, active=active)
        valid = hit.is_valid() & active
        triangle = dr.select(valid, hit.prim_index, self._triangles)
        b1, b2 = hit.prim_uv.x, hit.prim_uv.y
        at = [dr.gather(mi.Float, values, dr.gather(mi.UInt32, c, triangle, valid), valid) for c in self._corners]
        value = dr.fma(b2, at[2] - at[0], dr.fma(b1, at[1] - at[0], at[0]))
        return dr.select(valid, value, 0.0), dr.gather(mi.UInt32, self._owners, triangle), dr.select(valid, hit.t, 1e9)


def _mirrored(vector: Any, normal: Any) -> Any:
    return vector - 2 * dr.dot(vector, normal) * normal


class Textures:
    """The textures of a room's surfaces on Dr.Jit's side."""

    def __init__(self, surfaces: tuple[Surface, ...], owners: int) -> None:
        """Tables of sums, one an image, of 2 x 2 tiles: a rectangle of up to one tile never crosses their border."""
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
                tables.append(np.pad(sums, 1).ravel())  # on the far sides only for what rounding puts there
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
        """Mean over a pixel's part of a surface, 1 where there is no texture. `path_m`: from the lens to the point."""
        columns, rows = (dr.gather(mi.Float, count, owner) for count in (self._columns, self._rows))
        textured = columns > 0
        origin, across, down, normal = (
            dr.gather(mi.Vector3f, vectors, owner, textured)
            for vectors in (self._origin, self._across, self._down, self._normal)
        )
        facing = dr.dot(direction, normal)
        facing = dr.select(dr.abs(facing) > GRAZING, facing, GRAZING)
        sides = [path_m * (side - direction * (dr.dot(side, normal) / facing)) for side in spread]
        ux, uy, vx, vy = (
            dr.clip(dr.dot(side, axis), -MAX_SPREAD_PX, MAX_SPREAD_PX) for side in sides for axis in (across, down)
        )
        x, y = dr.dot(point - origin, across), dr.dot(point - origin, down)
        # a piece's spread, and that of the blur by one pixel of the image
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
        """Integral over a rectangle, in the image's pixels. Double precision: small differences of large sums."""
        at_x = [_whole_and_rest(mi.Float64(edge)) for edge in (left, mi.Float64(left) + mi.Float64(width))]
        at_y = [_whole_and_rest(mi.Float64(edge)) for edge in (top, mi.Float64(top) + mi.Float64(height))]
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


def _whole_and_rest(place: Any) -> tuple[Any, Any]:
    whole = dr.floor(place)
    return mi.UInt32(whole), place - whole
