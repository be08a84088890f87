"""Mosaics of colour filters: each pixel sees the scene through its own filter."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import LedRegions, Roi
from vlcrender.rendering.expected_image import ExpectedImage, ExpectedRegion, LedPatch
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.leds import Leds
from vlcrender.scene.loader import Scene
from vlcrender.sensor.quantum_efficiency import COLOURS


def colour_of_pixels(mosaic: str, roi: Roi) -> NDArray[np.intp]:
    """Index into COLOURS of each pixel of a region, (rows, columns). `mosaic` as in `sensor.Sensor`, such as "rggb"."""
    tile = np.array([[colour[0] for colour in COLOURS].index(letter) for letter in mosaic]).reshape(2, 2)
    rows = np.arange(roi.row, roi.row + roi.rows) % 2
    columns = np.arange(roi.column, roi.end_column) % 2
    pixels: NDArray[np.intp] = tile[rows[:, None], columns]
    return pixels


@dataclass(frozen=True)
class MosaicRenderer:
    """Renders expected images through a mosaic: a whole image under each of COLOURS, of which each pixel takes one.

    The lens's blur therefore comes before the filters. `of_colours` has one renderer for each of COLOURS.
    """

    of_colours: tuple[Renderer, ...]
    mosaic: str

    @property
    def scene(self) -> Scene:
        """The scene that is rendered."""
        return self.of_colours[0].scene

    def with_leds(self, leds: Leds) -> "MosaicRenderer":
        """As `Renderer.with_leds`."""
        return replace(self, of_colours=tuple(renderer.with_leds(leds) for renderer in self.of_colours))

    def expected_image(
        self, posed: PosedCamera, regions: LedRegions | None = None, during: Sequence[Pose] | None = None
    ) -> ExpectedImage:
        """As `Renderer.expected_image`."""
        images = [renderer.expected_image(posed, regions, during) for renderer in self.of_colours]
        return ExpectedImage(tuple(map(self._region, zip(*(image.parts for image in images), strict=True))))

    def led_patches(
        self, posed: PosedCamera, regions: LedRegions | None = None, blurred_at: Pose | None = None
    ) -> tuple[LedPatch, ...]:
        """As `Renderer.led_patches`."""
        return self._patches([r.led_patches(posed, regions, blurred_at) for r in self.of_colours])

    def _region(self, of_colours: Sequence[ExpectedRegion]) -> ExpectedRegion:
        roi = of_colours[0].roi
        return ExpectedRegion(
            roi,
            self._select([region.background_e_per_s for region in of_colours], roi),
            self._patches([region.patches for region in of_colours]),
            tuple(
                replace(r, electrons_per_s=r.electrons_per_s * (colour_of_pixels(self.mosaic, r.roi) == colour))
                for colour, region in enumerate(of_colours)
                for r in region.reflections
            ),
        )

    def _patches(self, of_colours: Sequence[Sequence[LedPatch]]) -> tuple[LedPatch, ...]:
        return tuple(
            replace(same[0], electrons_per_s=self._select([p.electrons_per_s for p in same], same[0].roi))
            for same in zip(*of_colours, strict=True)
        )

    def _select(self, images: Sequence[NDArray[Any]], roi: Roi) -> NDArray[Any]:
        """For each pixel of a region, the image of the pixel's colour."""
        colours = colour_of_pixels(self.mosaic, roi)[None]
        selected: NDArray[Any] = np.take_along_axis(np.stack(images), colours, axis=0)[0]
        return selected
