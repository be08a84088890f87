"""The lens's blur of each LED: what it makes of a point at the LED's depth."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera import Camera, Pose, transform
from vlcrender.led_image import leds_that_may_be_seen
from vlcrender.lens import blur_kernel
from vlcrender.scene import Leds

BLUR_MARGIN_PX = 500
"""How far beside the sensor LEDs may be whose blur reaches it."""
DEPTH_STEP = 0.005
"""Depths that differ by less than this part share a kernel: 0.2 px of a defocus disc of 35."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LedBlur:
    """`kernels`: by LED's index, (n, n) as `lens.blur` takes them; None where a point stays one."""

    kernels: tuple[Array | None, ...]

    @property
    def spread_px(self) -> int:
        """How far light is blurred at most."""
        return max(map(radius_px, self.kernels), default=0)

    @property
    def typical(self) -> Array | None:
        """The kernel of median size: the room behind is blurred as at the LEDs' usual depth."""
        made = sorted((k for k in self.kernels if k is not None), key=lambda k: k.shape[0])
        return made[len(made) // 2] if made else None


def led_blur(leds: Leds, camera: Camera, pose: Pose) -> LedBlur:
    """The blur at a pose. One kernel for all depths that differ by less than DEPTH_STEP."""
    kernels: list[Array | None] = [None] * len(leds)
    if camera.focus_distance_m is None and camera.psf == "none":
        return LedBlur(tuple(kernels))
    towards_m = leds.centers_m - np.array(pose.position_m)
    # A fish-eye has no plane of focus: its depth is the distance.
    fish_eye = camera.projection == "equidistant"
    depths = np.linalg.norm(towards_m, axis=1) if fish_eye else transform(pose.rotation[2:], towards_m)[:, 0]
    near = np.maximum(depths, 0.05)
    made: dict[float, Array | None] = {}
    for i in leds_that_may_be_seen(camera, pose, leds.centers_m, leds.reaches_m, BLUR_MARGIN_PX):
        depth = float(np.exp(np.round(np.log(near[i]) / DEPTH_STEP) * DEPTH_STEP))
        if depth not in made:
            made[depth] = blur_kernel(camera, depth)
        kernels[i] = made[depth]
    return LedBlur(tuple(kernels))


def radius_px(kernel: Array | None) -> int:
    """How far a kernel spreads light."""
    return 0 if kernel is None else kernel.shape[0] // 2
