"""Blur of each LED by the lens: the kernel of a point at the LED's depth.

Where the blur is narrow, pixels that the LED's edge crosses are split (`led_edges`), and each part has its own kernel.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.psf import (
    SplitKernel,
    blur_kernel,
    kernel_radius_px,
    off_axis_sigma_px,
    split_for,
    split_kernel,
    spread,
)
from vlcrender.camera.roi import Roi
from vlcrender.rendering.led_edges import LedEdges
from vlcrender.scene.leds import Leds

BLUR_MARGIN_PX = 500
"""Distance from the sensor within which an LED's blur is computed, since it may light the sensor."""
DEPTH_STEP = 0.005
"""Depths within this relative step share a kernel: 0.2 px of a defocus disc of 35 px. So do off-axis blurs."""
EDGE_PIXELS_AT_ONCE = 500
"""Edge pixels whose light is spread together: what they light takes a few megabytes at most."""
MIN_DEPTH_M = 0.05
MIN_SIGMA_PX = 1e-3
"""An off-axis blur narrower than this moves less light than one part of 64 across a pixel shows."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LedKernel:
    """Kernels of one LED: of a whole pixel (m, m), None for no blur; and of the parts of split pixels, if any."""

    whole: Array | None = None
    parts: SplitKernel | None = None

    @property
    def split(self) -> int:
        """Number of parts across an edge pixel; 1 means no split."""
        return 1 if self.parts is None else self.parts.split

    @property
    def radius_px(self) -> int:
        """Radius of the blur."""
        return kernel_radius_px(self.whole)

    def blurred(self, light: Array, roi: Roi, edges: Sequence[LedEdges], light_per_excess: float) -> Array:
        """The LED's light in a region after the lens, in the region padded by `radius_px`.

        edges: of the LED's images at one or more poses; light_per_excess: light of an excess of 1, in units of `light`.
        """
        positive: Array = np.maximum(self.spread(light, roi, edges, light_per_excess), 0.0)
        return positive

    def spread(self, light: Array, roi: Roi, edges: Sequence[LedEdges], light_per_excess: float) -> Array:
        """`blurred` of numbers of either sign, such as changes of light."""
        result = spread(light, self.whole)
        if self.parts is None:
            return result
        # The excess of a pixel's parts adds up to 0, so that what the kernels have in common adds nothing.
        n, m = self.parts.split, self.parts.deviations.shape[-1]
        kernels, first = self.parts.deviations.reshape(n * n, m * m), self.radius_px - m // 2
        for edge in edges:
            excess = light_per_excess / n**2 * edge.excess.reshape(-1, n * n)
            rows, columns = (edge.rows - roi.row + first).tolist(), (edge.columns - roi.column + first).tolist()
            for begin in range(0, len(rows), EDGE_PIXELS_AT_ONCE):
                some = slice(begin, begin + EDGE_PIXELS_AT_ONCE)
                # not `@`: the last bits of a matrix product may depend on threads and processor
                light_of = np.einsum("ep,pq->eq", excess[some], kernels).reshape(-1, m, m)
                for row, column, added in zip(rows[some], columns[some], light_of, strict=True):
                    result[row : row + m, column : column + m] += added
        return result


SHARP = LedKernel()
"""Kernel of an LED that is not blurred, or that is too far from the sensor to light it."""


@dataclass(frozen=True)
class LedBlur:
    """Blur at one pose. `near`: kernels of LEDs near the sensor, by index; `typical`: of the room behind the LEDs."""

    near: Mapping[int, LedKernel]
    typical: Array | None

    def kernel(self, i: int) -> LedKernel:
        """Kernel of LED number i."""
        return self.near.get(i, SHARP)

    @cached_property
    def radius_px(self) -> int:
        """Greatest radius of the kernels."""
        return max((kernel.radius_px for kernel in self.near.values()), default=0)


def led_blur(leds: Leds, posed: PosedCamera) -> LedBlur:
    """The blur at a pose. LEDs whose depths differ by less than DEPTH_STEP share a kernel where the blur is wide.

    The room behind is blurred as at the median depth, and place in the field, of the LEDs that are blurred.
    """
    camera = posed.camera
    if camera.focus_distance_m is None and camera.psf == "none" and camera.off_axis_sigma_um == 0:
        return LedBlur({}, None)
    near = leds.spheres.candidates(posed, BLUR_MARGIN_PX)
    depths_m = np.maximum(posed.focus_depths_m(leds.centers_m[near]), MIN_DEPTH_M)
    sigmas_px = np.zeros(len(near))
    if camera.off_axis_sigma_um > 0:
        sigmas_px = off_axis_sigma_px(camera, posed.project(leds.centers_m[near]))
        sigmas_px = np.exp(np.round(np.log(np.maximum(sigmas_px, MIN_SIGMA_PX)) / DEPTH_STEP) * DEPTH_STEP)
    kernels: dict[int, LedKernel] = {}
    point: dict[int, tuple[float, float]] = {}
    by_point: dict[tuple[float, float], LedKernel] = {}
    for i, depth_m, sigma_px in zip(near.tolist(), depths_m.tolist(), sigmas_px.tolist(), strict=True):
        depth = float(np.exp(np.round(np.log(depth_m) / DEPTH_STEP) * DEPTH_STEP))
        if split_for(camera, depth, sigma_px) > 1:
            # A narrow disc may change more within a step than it is wide. Without a focus depth has no effect.
            depth = depth_m if camera.focus_distance_m is not None else 1.0
        point[i] = depth, sigma_px
        if point[i] not in by_point:
            parts = split_kernel(camera, depth, sigma_px)
            whole = blur_kernel(camera, depth, sigma_px) if parts is None else parts.whole
            by_point[point[i]] = LedKernel(whole, parts)
        kernels[i] = by_point[point[i]]
    blurred = sorted((i for i in point if kernels[i].whole is not None), key=lambda i: kernels[i].radius_px)
    typical = blur_kernel(camera, *point[blurred[len(blurred) // 2]]) if blurred else None
    return LedBlur(kernels, typical)
