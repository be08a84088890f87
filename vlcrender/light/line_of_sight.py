"""Lines of sight from a camera to LEDs, by one ray each to points of an LED's face."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.light.direct_light import RAY_OFFSET_M, is_blocked
from vlcrender.light.lightmap import room_mesh
from vlcrender.light.mitsuba_room import mitsuba_scene
from vlcrender.scene.loader import Scene

RIM_POINTS = 16
"""Points on an LED's rim that have to be seen, beside its centre."""
RIM = 0.98
"""Distance of these points from the centre, as a fraction of that of the rim."""


class LinesOfSight:
    """Surfaces of one scene that may hide LEDs from a camera: furniture, frames of panels, panels that hang low."""

    def __init__(self, scene: Scene) -> None:
        """Prepare a scene. Raises InputError for furniture that cannot be used."""
        self._scene = scene
        mesh = room_mesh(scene)
        self._surfaces = mitsuba_scene(mesh, np.zeros(len(mesh.vertices_m)), (), daylight=False)

    def not_hidden(self, posed: PosedCamera, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of some LEDs, by their indices (n,), of which nothing hides the centre or a point of the rim."""
        if not len(indices):
            return indices
        points_m = self._points_m(indices)
        origins_m = np.broadcast_to(posed.position_m, points_m.shape).reshape(-1, 3)
        hidden = is_blocked(self._surfaces, origins_m, points_m.reshape(-1, 3)).reshape(len(indices), -1)
        seen: NDArray[np.int64] = indices[~hidden.any(axis=1)]
        return seen

    def _points_m(self, indices: NDArray[np.int64]) -> NDArray[np.float64]:
        """Centres of LEDs, then points on their rims, just below their faces, (n, RIM_POINTS + 1, 3)."""
        leds = self._scene.leds
        angles = 2 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
        disc = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        square = disc / np.abs(disc).max(axis=1, keepdims=True)
        points = np.repeat(leds.centers_m[indices, None], RIM_POINTS + 1, axis=1) - [0.0, 0.0, RAY_OFFSET_M]
        for row, index in enumerate(indices.tolist()):
            rim = square if leds.squares[index] else disc
            points[row, 1:, :2] += RIM * leds.half_widths_m[index] * rim
        return points


@lru_cache(maxsize=1)
def lines_of_sight(scene: Scene) -> LinesOfSight:
    """The lines of sight of a scene; those of the latest scene are kept."""
    return LinesOfSight(scene)
