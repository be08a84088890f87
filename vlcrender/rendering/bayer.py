"""Mosaics of colour filters: each pixel sees the scene through its own filter."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import LedRegions, Roi
from vlcrender.rendering.expected_image import ExpectedImage, ExpectedRegion, Halo, Image, LedPatch
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


def select_colours(images: Sequence[NDArray[Any]], mosaic: str, roi: Roi) -> NDArray[Any]:
    """For each pixel of a region, the image of the pixel's colour. `images`: (rows, columns), for each of COLOURS."""
    colours = colour_of_pixels(mosaic, roi)[None]
    selected: NDArray[Any] = np.take_along_axis(np.stack(images), colours, axis=0)[0]
    return selected


@dataclass(frozen=True)
class MosaicHalo:
    """The halos under each of COLOURS, of which each pixel takes one."""

    of_colours: tuple[Halo, ...]
    mosaic: str

    def electrons_per_s(self, roi: Roi, gains: Mapping[int, float] | None = None) -> Image:
        """As `expected_image.Halo`."""
        return select_colours([halo.electrons_per_s(roi, gains) for halo in self.of_colours], self.mosaic, roi)


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

    def halo_of(self, camera: Camera) -> Callable[[Sequence[LedPatch], Roi], NDArray[np.float64]] | None:
        """As `Renderer.halo_of`, of patches under the mosaic: each colour's light is that of its pixels, times 4 or 2.

        The halo is too wide to tell that from the light that all pixels have under the colour's filter.
        """
        of_colour = self.of_colours[0].halo_of(camera)
        return None if of_colour is None else partial(self._mosaic_halo, of_colour)

    def _mosaic_halo(
        self, of_colour: Callable[[Sequence[LedPatch], Roi], NDArray[np.float64]], patches: Sequence[LedPatch], roi: Roi
    ) -> NDArray[np.float64]:
        colours = colour_of_pixels(self.mosaic, Roi(0, 0, 2, 2))
        halos = []
        for colour in range(len(COLOURS)):
            factor = colours.size / np.count_nonzero(colours == colour)
            light = [
                replace(
                    p, electrons_per_s=p.electrons_per_s * factor * (colour_of_pixels(self.mosaic, p.roi) == colour)
                )
                for p in patches
            ]
            halos.append(of_colour(light, roi))
        return select_colours(halos, self.mosaic, roi)

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
            self._halo([region.halo for region in of_colours]),
        )

    def _halo(self, of_colours: Sequence[Halo | None]) -> MosaicHalo | None:
        halos = tuple(halo for halo in of_colours if halo is not None)
        return MosaicHalo(halos, self.mosaic) if halos else None

    def _patches(self, of_colours: Sequence[Sequence[LedPatch]]) -> tuple[LedPatch, ...]:
        return tuple(
            replace(same[0], electrons_per_s=self._select([p.electrons_per_s for p in same], same[0].roi))
            for same in zip(*of_colours, strict=True)
        )

    def _select(self, images: Sequence[NDArray[Any]], roi: Roi) -> NDArray[Any]:
        """For each pixel of a region, the image of the pixel's colour."""
        return select_colours(images, self.mosaic, roi)
