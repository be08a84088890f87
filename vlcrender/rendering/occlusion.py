"""What hides LEDs from the camera: furniture, frames, and panels that hang lower than an LED."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose, ray_of_pixel
from vlcrender.camera.roi import Roi, merged
from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.rendering.background import Background, differs_from_neighbour, sub_pixels
from vlcrender.scene.loader import Scene

SAME_PLACE = 1e-4
"""Relative difference of two distances that are the same but for float32."""
OUTSIDE = np.uint8(2)
"""Label of pixels that an LED does not light, where others are 0 and 1."""

Array = NDArray[np.float64]


class Occlusion:
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

    def clear_shares(
        self,
        camera: Camera,
        pose: Pose,
        images: Sequence[tuple[float, Roi, NDArray[np.bool_]]],
        mirror: tuple[int, Pose] | None = None,
    ) -> list[Array | float]:
        """Share of each lit pixel from which nothing hides the plane of an LED, (rows, columns); 1.0 where nowhere.

        images: of each LED its height (m), its window and the pixels lit. mirror: number of the pane that has to be
        met, and the camera's mirror image in it; None looks directly.
        """
        shares: list[Array | float] = [1.0] * len(images)
        for height_m in dict.fromkeys(height for height, _, _ in images):
            same = [(n, roi, lit) for n, (height, roi, lit) in enumerate(images) if height == height_m]
            # LEDs behind one diffuser light the same pixels: each pixel's ray is cast once.
            for around in merged(roi for _, roi, _ in same):
                inside = [(n, roi, lit) for n, roi, lit in same if around.contains(roi)]
                asked = np.zeros((around.rows, around.columns), dtype=bool)
                for _, roi, lit in inside:
                    asked[around.slices(roi)] |= lit
                rows, columns = np.nonzero(asked)
                with exact_math():
                    u, v = (
                        mi.Float((index + first + 0.5).astype(np.float32))
                        for index, first in ((columns, around.column), (rows, around.row))
                    )
                    clear = np.ones(asked.shape, dtype=bool)
                    clear[rows, columns] = self._reaches(camera, pose, height_m, mirror, u, v)
                    for n, roi, lit in inside:
                        here = clear[around.slices(roi)]
                        if not here[lit].all():
                            shares[n] = self._finer(camera, pose, height_m, mirror, roi, lit, here)
        return shares

    def _finer(
        self,
        camera: Camera,
        pose: Pose,
        height_m: float,
        mirror: tuple[int, Pose] | None,
        roi: Roi,
        lit: NDArray[np.bool_],
        clear: NDArray[np.bool_],
    ) -> Array:
        """The share of each pixel, by many rays where an edge may cross it. `clear`: whether its centre is."""
        share = clear.astype(np.float64)
        if clear[lit].any():  # an edge crosses the LED
            labels = np.where(lit, clear, OUTSIDE)
            rows, columns = np.nonzero(lit & differs_from_neighbour(labels))
            u, v = sub_pixels(rows + roi.row, columns + roi.column)
            each = self._reaches(camera, pose, height_m, mirror, u, v)
            share[rows, columns] = each.reshape(len(rows), -1).mean(axis=1)
        return share

    def _reaches(
        self, camera: Camera, pose: Pose, height_m: float, mirror: tuple[int, Pose] | None, u: "mi.Float", v: "mi.Float"
    ) -> NDArray[np.bool_]:
        """Whether the ray of a pixel position gets to this height, with nothing in its way."""
        hit = self._background.trace(camera, pose, u, v)
        if mirror is None:
            way_m, seen_from = hit.distance_m, pose
        else:
            glazing, seen_from = mirror
            way_m = dr.select(hit.surface == self._background.room.first_glazing + glazing, hit.path_m, 0.0)
        # Double precision, and numbers as data: as literals each pose would compile a kernel of its own.
        x, y, z = ray_of_pixel(camera, mi.Float64(u), mi.Float64(v), dr)
        up = [dr.opaque(mi.Float64, number) for number in seen_from.rotation[:, 2].tolist()]
        slope = (up[0] * x + up[1] * y + up[2] * z) / dr.sqrt(x * x + y * y + z * z)
        rise_m = dr.opaque(mi.Float64, height_m - pose.position_m[2])
        reached = mi.Float64(way_m) > rise_m / slope * (1 - SAME_PLACE)
        dr.eval(reached)
        clear: NDArray[np.bool_] = reached.numpy().astype(bool)
        return clear
