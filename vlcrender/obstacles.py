"""What hides LEDs from the camera: furniture, frames, and panels that hang lower than an LED."""

import numpy as np
from numpy.typing import NDArray

from vlcrender.backend import dr, exact_math, mi
from vlcrender.background import Background, differs_from_neighbour, sub_pixels
from vlcrender.camera import Camera, Pose, rays_world
from vlcrender.scene import Scene
from vlcrender.windows import Window

SAME_PLACE = 1e-4
"""Relative difference of two distances that are the same but for float32."""
OUTSIDE = 2.0
"""Label of pixels that an LED does not light, where others are 0 and 1."""

Array = NDArray[np.float64]


class Obstacles:
    """What may stand between a camera and the LEDs of one scene, found by rays through its surfaces."""

    def __init__(self, scene: Scene, background: Background) -> None:
        """Prepare a scene, whose surfaces `background` holds."""
        self._background = background
        panels = scene.settings.panels
        undersides_m = [grid.first_center_m[2] for grid in panels]
        self.there_are_some = (
            bool(scene.settings.furniture)
            or any(grid.frame is not None for grid in panels)
            or min(undersides_m, default=np.inf) < scene.leds.centers_m[:, 2].max() * (1 - SAME_PLACE)
        )
        """Whether an LED seen directly may be hidden at all."""

    def clear_share(
        self,
        camera: Camera,
        pose: Pose,
        height_m: float,
        window: Window,
        lit: NDArray[np.bool_],
        mirror: tuple[int, Pose] | None = None,
    ) -> Array:
        """Share of each lit pixel from which nothing hides the plane of an LED at this height, (rows, columns).

        `mirror`: number of the pane that has to be met, and the camera's mirror image in it; None looks directly.
        """
        rows, columns = np.nonzero(lit)
        clear = np.ones(lit.shape)
        with exact_math():
            u, v = (
                mi.Float((columns + window.column + 0.5).astype(np.float32)),
                mi.Float((rows + window.row + 0.5).astype(np.float32)),
            )
            clear[rows, columns] = self._reaches(camera, pose, height_m, mirror, u, v)
            rows, columns = np.nonzero(lit & differs_from_neighbour(np.where(lit, clear, OUTSIDE)))
            if 0 < clear[lit].sum() < lit.sum():  # an edge crosses the LED
                u, v = sub_pixels(rows + window.row, columns + window.column)
                each = self._reaches(camera, pose, height_m, mirror, u, v)
                clear[rows, columns] = each.reshape(len(rows), -1).mean(axis=1)
        return clear

    def _reaches(
        self, camera: Camera, pose: Pose, height_m: float, mirror: tuple[int, Pose] | None, u: "mi.Float", v: "mi.Float"
    ) -> Array:
        """1 where the ray of a pixel position gets to this height, 0 where something is in its way."""
        hit = self._background.look(camera, pose, u, v)
        if mirror is None:
            way_m, seen_from = hit.distance_m, pose
        else:
            pane, seen_from = mirror
            way_m = dr.select(hit.surface == self._background.room.first_pane + pane, hit.path_m, 0.0)
        pixels = np.stack([u.numpy(), v.numpy()], axis=-1).astype(np.float64)
        rays = rays_world(camera, seen_from, pixels)
        to_plane = (height_m - pose.position_m[2]) / rays[:, 2] * np.sqrt((rays**2).sum(axis=1))
        dr.eval(way_m)
        reached: Array = (way_m.numpy() > to_plane * (1 - SAME_PLACE)).astype(np.float64)
        return reached
