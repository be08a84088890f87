"""Expected images as parts, a background, a patch of light for each LED and a halo: any exposure is their sum.

The light of LEDs may change with time: a gain is light over its mean. It is a number, or one for each line of a sensor
with a rolling shutter.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.roi import Roi

Image = NDArray[np.float32]
Gain = float | NDArray[np.float64]
"""Light over its mean in time: a number, or an array that broadcasts over all pixels of the sensor, (height, 1) for a
gain of each row, (1, width) for one of each column, or (1, 1)."""
Gains = Mapping[int, Gain]
"""Gains of LEDs by id."""


def gain_in(gain: Gain, roi: Roi) -> Gain:
    """A gain in a region of the sensor, in an array that broadcasts over the region's pixels."""
    if not isinstance(gain, np.ndarray):
        return gain
    rows = slice(roi.row, roi.end_row) if gain.shape[0] > 1 else slice(None)
    return gain[rows, roi.column : roi.end_column] if gain.shape[1] > 1 else gain[rows]


@dataclass(frozen=True)
class LedPatch:
    """The light of one LED itself. `electrons_per_s` (rows, columns) starts at pixel (row, column) of the sensor."""

    led_id: int
    center_px: tuple[float, float]
    """Image (u, v) of the LED's centre; may lie outside the sensor."""
    row: int
    column: int
    electrons_per_s: NDArray[np.floating]
    visible_fraction: float
    """Share of the LED's image that is on the sensor and not occluded."""
    imaged_fraction: float
    """Share of the LED's image that is in the regions and not occluded: more where regions extend beyond the sensor."""

    @cached_property
    def roi(self) -> Roi:
        """The pixels of the patch."""
        return Roi(self.row, self.column, *self.electrons_per_s.shape)


@dataclass(frozen=True)
class SpecularReflection:
    """The light of one LED by way of a glazing; it flickers with the LED. Fields as in `LedPatch`."""

    led_id: int
    row: int
    column: int
    electrons_per_s: Image

    @property
    def roi(self) -> Roi:
        """The pixels of the reflection."""
        return Roi(self.row, self.column, *self.electrons_per_s.shape)


class Halo(Protocol):
    """Light that the lens scatters all over the sensor (veiling glare)."""

    def electrons_per_s(self, roi: Roi, gains: Gains | None = None, room_gain: Gain = 1.0) -> Image:
        """The scattered light in a region, (rows, columns). `gains`: of LEDs by id; 1 where not given. `room_gain`: of
        the light of LEDs that the room reflects.
        """


@dataclass(frozen=True)
class ExpectedRegion:
    """Expected image of a region: `background_e_per_s` (rows, columns), a patch of each LED that lights a pixel, and
    the halo of a lens with glare.
    """

    roi: Roi
    background_e_per_s: Image
    patches: tuple[LedPatch, ...]
    reflections: tuple[SpecularReflection, ...] = ()
    halo: Halo | None = None

    led_background_e_per_s: Image | None = None
    """Part of `background_e_per_s` that left an LED; None where it was not asked for."""

    def expected_electrons(self, exposure_s: float, gains: Gains | None = None, room_gain: Gain = 1.0) -> Image:
        """Mean electrons of an exposure, (rows, columns). `gains`: of LEDs by id; 1 where not given.

        room_gain: of the light of LEDs that the room reflects. Raises ValueError for one other than 1 where that part
        of the background is not known.
        """
        from vlcrender.core.backend import empty_image  # loads Mitsuba, which a scene alone does not need

        image = np.multiply(self.background_e_per_s, np.float32(exposure_s), out=empty_image(self.roi.shape))
        lights: list[LedPatch | SpecularReflection] = [*self.patches, *self.reflections]
        for light in lights:
            gain = 1.0 if gains is None else gain_in(gains.get(light.led_id, 1.0), light.roi)
            factor = np.broadcast_to(_float32(gain * exposure_s), light.roi.shape)
            pixels = image[self.roi.slices(light.roi)]
            for band in light.roi.bands():
                pixels[band] += light.electrons_per_s[band] * factor[band]
        if isinstance(room_gain, np.ndarray) or room_gain != 1:
            if self.led_background_e_per_s is None:
                raise ValueError("room_gain: the part of the background that left an LED is not known")
            image += self.led_background_e_per_s * _float32((gain_in(room_gain, self.roi) - 1.0) * exposure_s)
            np.maximum(image, 0, out=image)  # rounding, where LEDs are dark and nothing else gives light
        if self.halo is not None:
            image += self.halo.electrons_per_s(self.roi, gains, room_gain) * np.float32(exposure_s)
        return image


def _float32(number: Gain) -> NDArray[np.float32] | np.float32:
    return number.astype(np.float32) if isinstance(number, np.ndarray) else np.float32(number)


@dataclass(frozen=True)
class ExpectedImage:
    """Expected image of a frame: regions that share no pixel. A full frame is one region."""

    parts: tuple[ExpectedRegion, ...]

    @property
    def patches(self) -> tuple[LedPatch, ...]:
        """The patches of all regions."""
        return tuple(patch for part in self.parts for patch in part.patches)

    def expected_electrons(self, exposure_s: float, gains: Gains | None = None, room_gain: Gain = 1.0) -> Image:
        """Mean electrons of an exposure of a full frame, (height, width); of several regions see each of `parts`."""
        (whole,) = self.parts
        return whole.expected_electrons(exposure_s, gains, room_gain)
