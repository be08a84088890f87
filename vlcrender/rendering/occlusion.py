"""Occlusion of LEDs by furniture, by frames of panels, and by panels that hang lower than an LED."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi, merged
from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.rendering.background import Background, differs_from_neighbour, sub_pixels
from vlcrender.rendering.camera_data import CameraData
from vlcrender.scene.loader import Scene
from vlcrender.scene.visibility import can_occlude_leds

DISTANCE_TOLERANCE = 1e-4
"""Relative difference below which two distances, computed in float32, count as equal."""
OUTSIDE = np.uint8(2)
"""Label of pixels that an LED does not light; lit ones have 0 (occluded) or 1 (clear)."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LitRegion:
    """The pixels that one LED lights: its height, m, a region, and which of its pixels are lit (rows, columns)."""

    height_m: float
    roi: Roi
    lit: NDArray[np.bool_]


@dataclass(frozen=True)
class Mirror:
    """A glazing that rays are reflected by: its number in the scene, and the camera's mirror image in it."""

    glazing: int
    pose: Pose


class Occlusion:
    """Surfaces of one scene between a camera and the LEDs, found by casting rays."""

    def __init__(self, scene: Scene, background: Background) -> None:
        """Prepare a scene; `background` holds its surfaces."""
        self._background = background
        self.heights_m = scene.leds.centers_m[:, 2]
        """Height of each LED's face, m, (n,): the plane that a ray has to reach. LEDs as built count as reached at the
        height of the scene's, because the scene's panels, which they would enter, are not moved."""
        self.possible = can_occlude_leds(scene)
        """Whether anything in the scene can occlude an LED that is seen directly."""

    def with_varying_cameras(self) -> "Occlusion":
        """The same surfaces for views of which each has a camera of its own."""
        occlusion = copy.copy(self)
        occlusion._background = self._background.with_varying_cameras()
        return occlusion

    def clear_shares(
        self, posed: PosedCamera, images: Sequence[LitRegion], mirror: Mirror | None = None
    ) -> list[Array | float]:
        """Share of each lit pixel from which the LED's plane is seen, (rows, columns); 1.0 for an LED in full view.

        mirror: the glazing by way of which the LEDs are seen; None for LEDs seen directly.
        """
        shares: list[Array | float] = [1.0] * len(images)
        for height_m in dict.fromkeys(image.height_m for image in images):
            level = {n: image for n, image in enumerate(images) if image.height_m == height_m}
            # LEDs behind one diffuser light the same pixels: each pixel's ray is cast once.
            for union in merged(image.roi for image in level.values()):
                inside = {n: image for n, image in level.items() if union.contains(image.roi)}
                lit = np.zeros((union.rows, union.columns), dtype=bool)
                for image in inside.values():
                    lit[union.slices(image.roi)] |= image.lit
                rows, columns = np.nonzero(lit)
                with exact_math():
                    u, v = (
                        mi.Float((index + first + 0.5).astype(np.float32))
                        for index, first in ((columns, union.column), (rows, union.row))
                    )
                    clear = np.ones(lit.shape, dtype=bool)
                    clear[rows, columns] = self._reach_height(posed, height_m, mirror, u, v)
                    for n, image in inside.items():
                        centers_clear = clear[union.slices(image.roi)]
                        if not centers_clear[image.lit].all():
                            shares[n] = self._pixel_shares(posed, image, mirror, centers_clear)
        return shares

    def _pixel_shares(
        self, posed: PosedCamera, image: LitRegion, mirror: Mirror | None, centers_clear: NDArray[np.bool_]
    ) -> Array:
        """The clear share of each pixel: of its centre, or of a grid of rays in pixels that an edge may cross."""
        share = centers_clear.astype(np.float64)
        if centers_clear[image.lit].any():  # an edge crosses the LED
            labels = np.where(image.lit, centers_clear, OUTSIDE)
            rows, columns = np.nonzero(image.lit & differs_from_neighbour(labels))
            u, v = sub_pixels(rows + image.roi.row, columns + image.roi.column)
            clear = self._reach_height(posed, image.height_m, mirror, u, v)
            share[rows, columns] = clear.reshape(len(rows), -1).mean(axis=1)
        return share

    def _reach_height(
        self, posed: PosedCamera, height_m: float, mirror: Mirror | None, u: "mi.Float", v: "mi.Float"
    ) -> NDArray[np.bool_]:
        """Whether the rays of pixel positions reach this height without meeting a surface."""
        hit = self._background.trace(posed, u, v)
        if mirror is None:
            path_m, rotation = hit.distance_m, posed.rotation
        else:
            rotation = mirror.pose.rotation
            path_m = dr.select(hit.surface == self._background.room.first_glazing + mirror.glazing, hit.path_m, 0.0)
        # Double precision, and numbers as data: as literals each pose would compile a kernel of its own.
        vary = self._background.cameras_vary
        camera = CameraData.of(posed.camera, mi.Float64) if vary else posed.camera
        x, y, z = camera.unproject(mi.Float64(u), mi.Float64(v), dr)
        up = [dr.opaque(mi.Float64, number) for number in rotation[:, 2].tolist()]
        slope = (up[0] * x + up[1] * y + up[2] * z) / dr.sqrt(x * x + y * y + z * z)
        rise_m = dr.opaque(mi.Float64, height_m - posed.pose.position_m[2])
        reached = mi.Float64(path_m) > rise_m / slope * (1 - DISTANCE_TOLERANCE)
        dr.eval(reached)
        clear: NDArray[np.bool_] = reached.numpy().astype(bool)
        return clear
