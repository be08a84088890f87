"""A view as parts: background plus one patch of light an LED, so that any exposure is their sum."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.roi import Roi

Image = NDArray[np.float32]


@dataclass(frozen=True)
class LedPatch:
    """One LED's own light. `electrons_per_s` (rows, columns) starts at pixel (row, column) of the sensor."""

    led_id: int
    center_px: tuple[float, float]
    """Image of the LED's centre (u, v); may lie outside the sensor."""
    row: int
    column: int
    electrons_per_s: NDArray[np.floating]
    visible_fraction: float
    """Share of the LED's image that falls on the sensor and that nothing hides."""
    imaged_fraction: float
    """Share of the LED's image that is in the view: more where windows reach beyond the sensor."""

    @property
    def roi(self) -> Roi:
        """The pixels of the patch."""
        return Roi(self.row, self.column, *self.electrons_per_s.shape)


@dataclass(frozen=True)
class SpecularReflection:
    """An LED's light by way of a window pane: a false image of it, which flickers with the LED."""

    led_id: int
    row: int
    column: int
    electrons_per_s: Image

    @property
    def roi(self) -> Roi:
        """The pixels of the reflection."""
        return Roi(self.row, self.column, *self.electrons_per_s.shape)


@dataclass(frozen=True)
class ExpectedRegion:
    """The view in one window: `background_e_per_s` (rows, columns), and a patch for each LED that lights a pixel."""

    roi: Roi
    background_e_per_s: Image
    patches: tuple[LedPatch, ...]
    reflections: tuple[SpecularReflection, ...] = ()

    def expected_electrons(self, exposure_s: float, gains: Mapping[int, float] | None = None) -> Image:
        """Mean electrons of an exposure, (rows, columns). `gains`: by LED id, 1 where not given."""
        image = self.background_e_per_s * np.float32(exposure_s)
        lights: list[LedPatch | SpecularReflection] = [*self.patches, *self.reflections]
        for patch in lights:
            gain = 1.0 if gains is None else gains.get(patch.led_id, 1.0)
            image[self.roi.slices(patch.roi)] += patch.electrons_per_s * np.float32(gain * exposure_s)
        return image


@dataclass(frozen=True)
class ExpectedImage:
    """A camera's view of a scene: parts that share no pixel. A full frame is one part."""

    parts: tuple[ExpectedRegion, ...]

    @property
    def patches(self) -> tuple[LedPatch, ...]:
        """The LEDs' own light, all parts' together."""
        return tuple(patch for part in self.parts for patch in part.patches)

    def expected_electrons(self, exposure_s: float, gains: Mapping[int, float] | None = None) -> Image:
        """Mean electrons of an exposure of a full frame, (height, width); of windows each part has its own."""
        (whole,) = self.parts
        return whole.expected_electrons(exposure_s, gains)
