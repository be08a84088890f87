"""Expected images as parts, a background, a patch of light for each LED and a halo: any exposure is their sum."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.roi import Roi

Image = NDArray[np.float32]


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

    @property
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

    def electrons_per_s(self, roi: Roi, gains: Mapping[int, float] | None = None) -> Image:
        """The scattered light in a region, (rows, columns). `gains`: of LEDs by id; 1 where not given."""


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

    def expected_electrons(self, exposure_s: float, gains: Mapping[int, float] | None = None) -> Image:
        """Mean electrons of an exposure, (rows, columns). `gains`: of LEDs by id; 1 where not given."""
        image = self.background_e_per_s * np.float32(exposure_s)
        lights: list[LedPatch | SpecularReflection] = [*self.patches, *self.reflections]
        for light in lights:
            gain = 1.0 if gains is None else gains.get(light.led_id, 1.0)
            image[self.roi.slices(light.roi)] += light.electrons_per_s * np.float32(gain * exposure_s)
        if self.halo is not None:
            image += self.halo.electrons_per_s(self.roi, gains) * np.float32(exposure_s)
        return image


@dataclass(frozen=True)
class ExpectedImage:
    """Expected image of a frame: regions that share no pixel. A full frame is one region."""

    parts: tuple[ExpectedRegion, ...]

    @property
    def patches(self) -> tuple[LedPatch, ...]:
        """The patches of all regions."""
        return tuple(patch for part in self.parts for patch in part.patches)

    def expected_electrons(self, exposure_s: float, gains: Mapping[int, float] | None = None) -> Image:
        """Mean electrons of an exposure of a full frame, (height, width); of several regions see each of `parts`."""
        (whole,) = self.parts
        return whole.expected_electrons(exposure_s, gains)
