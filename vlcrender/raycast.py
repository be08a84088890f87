"""What rays from the camera meet: the room's baked light, and its mirror image in window panes.

The room is one mesh through which Mitsuba casts rays; the light at a hit is interpolated between the corners of the
triangle. Where a ray meets a pane it is mirrored once and followed on; what a pane shows in another pane is left out.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.backend import dr, mi
from vlcrender.geometry import Mesh
from vlcrender.glass import pane_reflectance
from vlcrender.irradiance import Light
from vlcrender.scene import Pane

Array = NDArray[np.float64]


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

    def __init__(self, mesh: Mesh, panes: tuple[Pane, ...]) -> None:
        """Put mesh and panes into one Mitsuba mesh."""
        self.first_pane = int(mesh.owners.max()) + 1
        self.nothing = self.first_pane + len(panes)
        self._panes = panes
        vertices, faces, owners = [mesh.vertices_m], [mesh.faces], [mesh.owners]
        for number, pane in enumerate(panes):
            first = len(mesh.vertices_m) + 4 * number
            vertices.append(pane.corners_m)
            faces.append(np.array([[0, 1, 2], [0, 2, 3]]) + first)
            owners.append(np.full(2, self.first_pane + number))
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
        for number, pane in enumerate(panes):
            normals[self.first_pane + number] = pane.normal
            indices[self.first_pane + number] = pane.refractive_index
        self._pane_normal = mi.Vector3f(*normals.T.astype(np.float32))
        self._pane_index = mi.Float(indices.astype(np.float32))
        self._triangles = len(all_faces)

    def values(self, light: Light, led_rate: float, surround_rate: float) -> "mi.Float":
        """What corners are worth in `look`: light from LEDs times one factor plus other light times another."""
        corners = len(light.mesh.vertices_m)
        surfaces = led_rate * light.led_cd_m2()[:corners] + surround_rate * light.surround_cd_m2()[:corners]
        panes = np.repeat([surround_rate * pane.luminance_cd_m2 for pane in self._panes], 4)
        return mi.Float(np.concatenate([surfaces, panes]).astype(np.float32))

    def look(self, origin: Any, direction: Any, values: Any, coherent: bool = True) -> Hit:
        """Cast rays (Dr.Jit points and unit directions, world)."""
        value, surface, distance = self._meet(origin, direction, values, coherent, mi.Bool(True))
        path = distance
        if self._panes:
            on_pane = (surface >= self.first_pane) & (surface < self.nothing)
            normal = dr.gather(mi.Vector3f, self._pane_normal, surface)
            cosine = dr.abs(dr.dot(direction, normal))
            onward = direction - 2 * dr.dot(direction, normal) * normal
            start = dr.fma(direction, distance, origin) + normal * 1e-5
            second, _, beyond = self._meet(start, onward, values, False, on_pane)
            reflectance = pane_reflectance(cosine, dr.gather(mi.Float, self._pane_index, surface), dr.sqrt)
            value = dr.select(on_pane, dr.lerp(value, second, reflectance), value)
            path = dr.select(on_pane, distance + beyond, distance)
        return Hit(value, surface, distance, path)

    def _meet(self, origin: Any, direction: Any, values: Any, coherent: bool, active: Any) -> tuple[Any, Any, Any]:
        hit = self._scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=coherent, active=active)
        valid = hit.is_valid() & active
        triangle = dr.select(valid, hit.prim_index, self._triangles)
        b1, b2 = hit.prim_uv.x, hit.prim_uv.y
        at = [dr.gather(mi.Float, values, dr.gather(mi.UInt32, c, triangle, valid), valid) for c in self._corners]
        value = dr.fma(b2, at[2] - at[0], dr.fma(b1, at[1] - at[0], at[0]))
        return dr.select(valid, value, 0.0), dr.gather(mi.UInt32, self._owners, triangle), dr.select(valid, hit.t, 1e9)
