"""The light of one LED and its changes with small changes of the camera, in any part of the LED's image.

A diffuser's image may fill the sensor, for each of many LEDs: its pixels are computed where they are asked for. Those
of a bare LED are held.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.roi import Roi
from vlcrender.rendering.crosstalk import REACH_PX, of_padded, reached
from vlcrender.rendering.expected_image import Gain, gain_in
from vlcrender.rendering.led_blur import SHARP, LedKernel
from vlcrender.rendering.led_radiance import LedImage, light_of_part
from vlcrender.rendering.led_slopes import LedMotion
from vlcrender.rendering.led_view import cut
from vlcrender.rendering.seen_pixels import LatestPixels
from vlcrender.scene.diffuser import Diffuser

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MovingLed:
    """One LED as a camera sees it, electrons a second, and how that changes."""

    led_id: int
    roi: Roi
    """The pixels that it lights."""
    visible_fraction: float
    """As in `LedPatch`."""
    changes: int
    """Number of changes of the camera."""
    pixels: Callable[[Roi], Array]
    """From a region within `roi` to the light of its pixels, and each change of it, (1 + changes, rows, columns)."""

    @classmethod
    def of_image(
        cls, image: LedImage, motion: LedMotion, kernel: LedKernel, rate: float, roi: Roi, latest: LatestPixels
    ) -> "MovingLed":
        """An LED by its image before the lens blurs it.

        rate: electrons a second of full light; roi: the pixels that it lights; latest: of the image's camera.
        """
        diffuser = image.leds.diffusers[image.index]
        if diffuser is None:
            held = _blurred(image, image.light(rate), motion, kernel, rate, roi)
            pixels = partial(_part, held, roi)
        else:
            pixels = partial(_part_of_diffuser, image, diffuser, motion, kernel, rate, latest)
        led_id = int(image.leds.ids[image.index])
        return cls(led_id, roi, image.visible_fraction, len(motion.swept), pixels)

    def within(self, roi: Roi) -> Array:
        """Light of a region's pixels, and each change of it, (1 + changes, rows, columns); dark beyond `roi`."""
        if self.roi.contains(roi):
            return self.pixels(roi)
        light = np.zeros((1 + self.changes, *roi.shape))
        if self.roi.overlaps(roi):
            inside = self.roi.intersection(roi)
            light[:, *roi.slices(inside)] = self.pixels(inside)
        return light

    def held(self) -> "MovingLed":
        """The LED with all its pixels in memory."""
        return replace(self, pixels=partial(_part, self.pixels(self.roi), self.roi))

    def times(self, gain: Gain) -> "MovingLed":
        """The LED with a gain of its light, which belongs to the lines of the sensor: it does not move."""
        return replace(self, pixels=lambda roi: self.pixels(roi) * gain_in(gain, roi))

    def with_crosstalk(self, share: float, sensor: Roi) -> "MovingLed":
        """The LED after crosstalk; light that leaves the sensor is lost."""
        return replace(
            self,
            roi=reached(self.roi, sensor),
            pixels=lambda roi: of_padded(self.within(roi.padded(REACH_PX)), share),
        )


def _part(held: Array, of: Roi, roi: Roi) -> Array:
    """A part of the pixels (..., rows, columns) of a region."""
    part: Array = held[..., *of.slices(roi)]
    return part


def _part_of_diffuser(
    image: LedImage,
    diffuser: Diffuser,
    motion: LedMotion,
    kernel: LedKernel,
    rate: float,
    latest: LatestPixels,
    roi: Roi,
) -> Array:
    """`MovingLed.pixels` of an LED behind a diffuser."""
    reach = roi.padded(kernel.radius_px)
    inside = image.roi.intersection(reach)
    part = image.within(inside, latest.around(inside))
    return _blurred(part, light_of_part(part, diffuser, rate), motion, kernel, rate, roi)


def _blurred(
    image: LedImage, sharp: NDArray[np.floating], motion: LedMotion, kernel: LedKernel, rate: float, roi: Roi
) -> Array:
    """An image's light and its changes in a region after the lens, (1 + changes, rows, columns).

    sharp: its light before.
    """
    spread_to = image.roi.padded(kernel.radius_px)
    pixels = np.empty((1 + len(motion.swept), *roi.shape))
    if kernel is SHARP and image.roi == roi:
        pixels[0] = sharp
        for change, slope in zip(pixels[1:], motion.slopes(image), strict=True):
            np.multiply(slope.change, rate, out=change)
        return pixels
    edges = [] if image.edges is None else [image.edges]
    pixels[0] = cut(kernel.blurred(sharp.astype(np.float64, copy=False), image.roi, edges, rate), spread_to, roi)
    for change, slope in zip(pixels[1:], motion.slopes(image), strict=True):
        edges = [] if slope.edges is None else [slope.edges]
        change[:] = cut(kernel.spread(rate * slope.change, image.roi, edges, rate), spread_to, roi)
    return pixels
