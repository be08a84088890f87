"""Crosstalk of pixels: a share of each pixel's electrons is collected by its four neighbours.

Electrons that a pixel's light sets free diffuse, each by itself. A Poisson number of electrons that are shared out at
random is a Poisson number in each pixel, independent of the others: crosstalk changes means alone and leaves no
correlation between pixels. It comes after the colour filters, so that it mixes the colours of a mosaic. Lines of a
rolling shutter are crossed with their own gain: a pixel's neighbours in other lines count as exposed with it.
"""

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.roi import Roi
from vlcrender.rendering.expected_image import (
    ExpectedImage,
    ExpectedRegion,
    Gain,
    Gains,
    Halo,
    Image,
    LedPatch,
    SpecularReflection,
)

Patch = TypeVar("Patch", LedPatch, SpecularReflection)

REACH_PX = 1
"""Distance that light spreads."""


@dataclass(frozen=True)
class CrosstalkHalo:
    """A halo after crosstalk, which shows in a mosaic only."""

    halo: Halo
    share: float

    def electrons_per_s(self, roi: Roi, gains: Gains | None = None, room_gain: Gain = 1.0) -> Image:
        """As `expected_image.Halo`."""
        return shared(self.halo.electrons_per_s(roi, gains, room_gain), self.share)


def shared(image: NDArray[Any], share: float) -> NDArray[Any]:
    """An image (rows, columns) after crosstalk. Beyond its border the image is mirrored about the outermost pixels, so
    that pixels of a mosaic have neighbours of the right colours.
    """
    rows, columns = map(_mirrored, image.shape)
    return of_padded(image[np.ix_(rows, columns)], share)


def _mirrored(size: int) -> NDArray[np.int64]:
    """Indices -1 to `size`, with both ends mirrored about 0 and size - 1, (size + 2,)."""
    if size == 1:
        return np.zeros(3, dtype=np.int64)
    return np.concatenate([[1], np.arange(size), [size - 2]])


def of_padded(wide: NDArray[Any], share: float) -> NDArray[Any]:
    """The pixels of images (..., rows, columns) without their outermost rows and columns, after crosstalk."""
    neighbours = wide[..., :-2, 1:-1] + wide[..., 2:, 1:-1] + wide[..., 1:-1, :-2] + wide[..., 1:-1, 2:]
    mixed: NDArray[Any] = wide.dtype.type(1 - share) * wide[..., 1:-1, 1:-1] + wide.dtype.type(share / 4) * neighbours
    return mixed


def reached(roi: Roi, sensor: Roi) -> Roi:
    """The pixels that the light of a region reaches; light that leaves the sensor is lost."""
    grown = roi.padded(REACH_PX)
    return grown.intersection(sensor) if sensor.contains(roi) else grown


def shared_patch(patch: Patch, share: float, sensor: Roi) -> Patch:
    """A patch after crosstalk, one pixel larger on each side."""
    grown, inside = patch.roi.padded(REACH_PX), reached(patch.roi, sensor)
    light = of_padded(np.pad(patch.electrons_per_s, 2 * REACH_PX), share)
    return replace(
        patch,
        row=inside.row,
        column=inside.column,
        electrons_per_s=np.ascontiguousarray(light[grown.slices(inside)]),
    )


def with_crosstalk(image: ExpectedImage, share: float, sensor: Roi) -> ExpectedImage:
    """An expected image after crosstalk. Its regions have to contain the patches padded by REACH_PX."""
    return ExpectedImage(tuple(_region(part, share, sensor) for part in image.parts))


def _region(part: ExpectedRegion, share: float, sensor: Roi) -> ExpectedRegion:
    return ExpectedRegion(
        part.roi,
        shared(part.background_e_per_s, share),
        tuple(shared_patch(patch, share, sensor) for patch in part.patches),
        tuple(_cut(shared_patch(reflection, share, sensor), part.roi) for reflection in part.reflections),
        None if part.halo is None else CrosstalkHalo(part.halo, share),
        None if part.led_background_e_per_s is None else shared(part.led_background_e_per_s, share),
    )


def _cut(reflection: SpecularReflection, roi: Roi) -> SpecularReflection:
    """The part of a reflection in a region; reflections, unlike LEDs, may be cut by a region's border."""
    inside = reflection.roi.intersection(roi)
    return replace(
        reflection,
        row=inside.row,
        column=inside.column,
        electrons_per_s=np.ascontiguousarray(reflection.electrons_per_s[reflection.roi.slices(inside)]),
    )
