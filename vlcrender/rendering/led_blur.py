"""The lens's blur of each LED: what it makes of a point at the LED's depth.

Where it is narrow, pixels that the LED's edge crosses are split (`led_edges`), and the blur knows what becomes of the
light of each part.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose, transform
from vlcrender.camera.lens import SplitKernel, blur, blur_kernel, split_for, split_kernel
from vlcrender.camera.roi import Roi
from vlcrender.rendering.led_coverage import leds_that_may_be_seen
from vlcrender.rendering.led_edges import LedEdges
from vlcrender.scene.leds import Leds

BLUR_MARGIN_PX = 500
"""How far beside the sensor LEDs may be whose blur reaches it."""
DEPTH_STEP = 0.005
"""Depths that differ by less than this part share a kernel: 0.2 px of a defocus disc of 35."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LedBlur:
    """`kernels`: by LED's index, (m, m) as `lens.blur` takes them; None where a point stays one.

    `splits`: by LED's index, kernels for the parts of split pixels, None where they need not be: then `kernels` has
    their mean. `typical`: for the room behind, which is blurred as at the LEDs' usual depth.
    """

    kernels: tuple[Array | None, ...]
    splits: tuple[SplitKernel | None, ...]
    typical: Array | None

    @property
    def spread_px(self) -> int:
        """How far light is blurred at most."""
        return max(map(radius_px, self.kernels), default=0)

    def split(self, i: int) -> int:
        """Into how many parts across the edge pixels of an LED have to be split."""
        kernel = self.splits[i]
        return 1 if kernel is None else kernel.split

    def blurred(self, i: int, light: Array, roi: Roi, edges: Sequence[LedEdges], worth: float) -> Array:
        """The light of LED `i` in a window after the lens, in the window grown by the radius of its kernel.

        edges: of its images at one or more poses; worth: what 1 of their excess is in terms of `light`.
        """
        spread = blur(light, self.kernels[i])
        kernel = self.splits[i]
        if kernel is None:
            return spread
        n, m = kernel.split, kernel.parts.shape[-1]
        parts = kernel.parts.reshape(n * n, m * m)
        for at in edges:
            excess = worth / n**2 * at.excess.reshape(-1, n * n)
            for row, column, of_pixel in zip(at.rows - roi.row, at.columns - roi.column, excess, strict=True):
                # not `@`: the last bits of a matrix product may depend on threads and processor
                spread[row : row + m, column : column + m] += np.einsum("p,pq->q", of_pixel, parts).reshape(m, m)
        positive: Array = np.maximum(spread, 0.0)
        return positive


def led_blur(leds: Leds, camera: Camera, pose: Pose) -> LedBlur:
    """The blur at a pose. Where it is wide, one kernel for all depths that differ by less than DEPTH_STEP."""
    kernels: list[Array | None] = [None] * len(leds)
    splits: list[SplitKernel | None] = [None] * len(leds)
    if camera.focus_distance_m is None and camera.psf == "none":
        return LedBlur(tuple(kernels), tuple(splits), None)
    towards_m = leds.centers_m - np.array(pose.position_m)
    # A fish-eye has no plane of focus: its depth is the distance.
    fish_eye = camera.projection == "equidistant"
    depths = np.linalg.norm(towards_m, axis=1) if fish_eye else transform(pose.rotation[2:], towards_m)[:, 0]
    near = np.maximum(depths, 0.05)
    depth_m: dict[int, float] = {}
    made: dict[float, tuple[Array | None, SplitKernel | None]] = {}
    for i in leds_that_may_be_seen(camera, pose, leds.centers_m, leds.reaches_m, BLUR_MARGIN_PX).tolist():
        depth = float(np.exp(np.round(np.log(near[i]) / DEPTH_STEP) * DEPTH_STEP))
        if split_for(camera, depth) > 1:
            # A disc may be narrower than what a step of depth changes; without a focus depth is nothing to it.
            depth = float(near[i]) if camera.focus_distance_m is not None else 1.0
        if depth not in made:
            split = split_kernel(camera, depth)
            made[depth] = (blur_kernel(camera, depth) if split is None else split.whole), split
        kernels[i], splits[i] = made[depth]
        depth_m[i] = depth
    blurred = sorted((i for i in depth_m if kernels[i] is not None), key=lambda i: radius_px(kernels[i]))
    typical = blur_kernel(camera, depth_m[blurred[len(blurred) // 2]]) if blurred else None
    return LedBlur(tuple(kernels), tuple(splits), typical)


def radius_px(kernel: Array | None) -> int:
    """How far a kernel spreads light."""
    return 0 if kernel is None else kernel.shape[0] // 2
