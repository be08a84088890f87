"""What the pixels of a region see: where their rays go, and how much light of it reaches them.

Images of LEDs behind diffusers overlap, many at a pixel: this is computed once for all of them.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.rendering.led_coverage import met_by_rays

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SeenPixels:
    """What the pixels of a region see, told for parts of it; found when it is asked for first."""

    posed: PosedCamera
    roi: Roi
    _rays: dict[tuple[float, float], tuple[Array, Array, Array]] = field(default_factory=dict)

    def on_plane(self, roi: Roi, center_m: Array, du: float = 0.0, dv: float = 0.0) -> tuple[Array, Array]:
        """`intersections_with_plane` at (du, dv) from the centres of the pixels of a part of the region."""
        if (du, dv) not in self._rays:
            u, v = self.roi.centers_px()
            self._rays[du, dv] = self.posed.ray_world(u + du, v + dv)
        x, y, z = (along[self.roi.slices(roi)] for along in self._rays[du, dv])
        return met_by_rays(self.posed, center_m, x, y, z)

    def weight(self, roi: Roi) -> Array:
        """Relative illumination of the pixels of a part of the region."""
        return self._weight[self.roi.slices(roi)]

    @cached_property
    def _weight(self) -> Array:
        u, v = self.roi.centers_px()
        weight = np.empty(self.roi.shape)
        for band in self.roi.bands():
            weight[band] = relative_illumination(self.posed.camera, u, v[band])
        return weight


@dataclass(eq=False)
class LatestPixels:
    """What a camera sees in the region that was asked for last."""

    posed: PosedCamera
    _latest: SeenPixels | None = None

    def around(self, roi: Roi) -> SeenPixels:
        """What it sees in a region, or in a larger one."""
        if self._latest is None or not self._latest.roi.contains(roi):
            self._latest = SeenPixels(self.posed, roi)
        return self._latest
