"""A mosaic of colour filters on the pixels: each pixel sees the view through its own."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.roi import LedRegions, Roi
from vlcrender.rendering.expected_image import ExpectedImage, ExpectedRegion, LedPatch
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene
from vlcrender.sensor.quantum_efficiency import COLOURS


def colour_of_pixels(mosaic: str, roi: Roi) -> NDArray[np.intp]:
    """Index into COLOURS of each pixel of a window, (rows, columns). `mosaic` as in `sensor.Sensor`, such as "rggb"."""
    tile = np.array([[colour[0] for colour in COLOURS].index(letter) for letter in mosaic]).reshape(2, 2)
    rows = np.arange(roi.row, roi.row + roi.rows) % 2
    columns = np.arange(roi.column, roi.end_column) % 2
    pixels: NDArray[np.intp] = tile[rows[:, None], columns]
    return pixels


@dataclass(frozen=True)
class MosaicRenderer:
    """Renders views through a mosaic: whole ones under each of COLOURS, of which each pixel takes its own.

    So the lens's blur comes before the filters.
    """

    of_colours: tuple[Renderer, ...]
    mosaic: str

    @property
    def scene(self) -> Scene:
        """What is rendered."""
        return self.of_colours[0].scene

    def expected_image(
        self, camera: Camera, pose: Pose, regions: LedRegions | None = None, during: Sequence[Pose] | None = None
    ) -> ExpectedImage:
        """As `Renderer.view`."""
        views = [renderer.expected_image(camera, pose, regions, during) for renderer in self.of_colours]
        return ExpectedImage(tuple(map(self._part, zip(*(view.parts for view in views), strict=True))))

    def led_patches(
        self, camera: Camera, pose: Pose, regions: LedRegions | None = None, blurred_at: Pose | None = None
    ) -> tuple[LedPatch, ...]:
        """As `Renderer.led_patches`."""
        return self._patches([r.led_patches(camera, pose, regions, blurred_at) for r in self.of_colours])

    def _part(self, parts: Sequence[ExpectedRegion]) -> ExpectedRegion:
        roi = parts[0].roi
        return ExpectedRegion(
            roi,
            self._picked([part.background_e_per_s for part in parts], roi),
            self._patches([part.patches for part in parts]),
            tuple(
                replace(r, electrons_per_s=r.electrons_per_s * (colour_of_pixels(self.mosaic, r.roi) == colour))
                for colour, part in enumerate(parts)
                for r in part.reflections
            ),
        )

    def _patches(self, of_colours: Sequence[Sequence[LedPatch]]) -> tuple[LedPatch, ...]:
        return tuple(
            replace(same[0], electrons_per_s=self._picked([p.electrons_per_s for p in same], same[0].roi))
            for same in zip(*of_colours, strict=True)
        )

    def _picked(self, images: Sequence[NDArray[Any]], roi: Roi) -> NDArray[Any]:
        """Of each pixel of a window the image of its colour."""
        colours = colour_of_pixels(self.mosaic, roi)[None]
        picked: NDArray[Any] = np.take_along_axis(np.stack(images), colours, axis=0)[0]
        return picked
