"""Mosaics of colour filters: each pixel sees the scene through its own filter."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import LedRegions, Roi
from vlcrender.rendering.crosstalk import REACH_PX, shared_patch, with_crosstalk
from vlcrender.rendering.expected_image import ExpectedImage, ExpectedRegion, Gain, Gains, Halo, Image, LedPatch
from vlcrender.rendering.halo import LightOfLed, SourceOfLight
from vlcrender.rendering.led_slopes import Cameras
from vlcrender.rendering.led_view import During, read_out
from vlcrender.rendering.moving_led import MovingLed
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


def _padded(patch: LedPatch | None, roi: Roi, dtype: Any) -> NDArray[Any]:
    """A patch's light in a region that contains it, (rows, columns); dark without a patch."""
    if patch is not None and patch.roi == roi:
        return patch.electrons_per_s
    light = np.zeros((roi.rows, roi.columns), dtype=dtype)
    if patch is not None:
        light[roi.slices(patch.roi)] = patch.electrons_per_s
    return light


def select_colours(images: Sequence[NDArray[Any]], mosaic: str, roi: Roi) -> NDArray[Any]:
    """For each pixel of a region, that of the pixel's colour. `images`: (..., rows, columns), for each of COLOURS."""
    stacked = np.stack(images)
    colours = np.expand_dims(colour_of_pixels(mosaic, roi), tuple(range(stacked.ndim - 2)))
    selected: NDArray[Any] = np.take_along_axis(stacked, colours, axis=0)[0]
    return selected


@dataclass(frozen=True)
class MosaicHalo:
    """The halos under each of COLOURS, of which each pixel takes one."""

    of_colours: tuple[Halo, ...]
    mosaic: str

    def electrons_per_s(self, roi: Roi, gains: Gains | None = None, room_gain: Gain = 1.0) -> Image:
        """As `expected_image.Halo`."""
        halos = [halo.electrons_per_s(roi, gains, room_gain) for halo in self.of_colours]
        return select_colours(halos, self.mosaic, roi)


@dataclass(frozen=True)
class MosaicRenderer:
    """Renders expected images through a mosaic: a whole image under each of COLOURS, of which each pixel takes one.

    The lens's blur therefore comes before the filters, crosstalk after. `of_colours` has one renderer without crosstalk
    for each of COLOURS.
    """

    of_colours: tuple[Renderer, ...]
    mosaic: str
    crosstalk: float = 0.0
    """Share of a pixel's electrons that its neighbours collect."""

    @property
    def scene(self) -> Scene:
        """The scene that is rendered."""
        return self.of_colours[0].scene

    def with_leds(self, leds: Leds) -> "MosaicRenderer":
        """As `Renderer.with_leds`."""
        return replace(self, of_colours=tuple(renderer.with_leds(leds) for renderer in self.of_colours))

    def expected_image(
        self,
        posed: PosedCamera,
        regions: LedRegions | None = None,
        during: During | None = None,
        room_apart: bool = False,
    ) -> ExpectedImage:
        """As `Renderer.expected_image`."""
        views = [
            renderer.view(of_colour, regions, during)
            for renderer, of_colour in zip(self.of_colours, self._of_colours(posed), strict=True)
        ]
        rois = read_out(views, regions, REACH_PX if self.crosstalk else 0)
        images = [
            renderer.image_of(view, rois, room_apart) for renderer, view in zip(self.of_colours, views, strict=True)
        ]
        image = ExpectedImage(tuple(map(self._region, zip(*(image.parts for image in images), strict=True))))
        return with_crosstalk(image, self.crosstalk, Roi.of_sensor(posed.camera)) if self.crosstalk else image

    def led_patches(
        self, posed: PosedCamera, regions: LedRegions | None = None, blurred_at: Pose | None = None
    ) -> tuple[LedPatch, ...]:
        """As `Renderer.led_patches`."""
        patches = self._patches(
            [
                renderer.led_patches(of_colour, regions, blurred_at)
                for renderer, of_colour in zip(self.of_colours, self._of_colours(posed), strict=True)
            ]
        )
        return self._with_crosstalk(patches, posed)

    def led_slopes(
        self, posed: PosedCamera, changes: Sequence[Cameras], regions: LedRegions | None = None
    ) -> tuple[MovingLed, ...]:
        """As `Renderer.led_slopes`."""
        of_cameras = [zip(*map(self._of_colours, cameras), strict=True) for cameras in changes]
        by_id: list[dict[int, MovingLed]] = [
            {led.led_id: led for led in renderer.led_slopes(of_colour, of_changes, regions)}
            for renderer, of_colour, of_changes in zip(
                self.of_colours, self._of_colours(posed), zip(*of_cameras, strict=True), strict=True
            )
        ]
        seen = []
        for led_id in dict.fromkeys(led_id for of_colour in by_id for led_id in of_colour):
            same = [of_colour.get(led_id) for of_colour in by_id]
            found = [led for led in same if led is not None]
            leading = same[COLOURS.index("green")] or found[0]
            roi = reduce(Roi.union, (led.roi for led in found))
            led = replace(leading, roi=roi, pixels=partial(self._select_moving, same, leading.changes))
            sensor = Roi.of_sensor(posed.camera)
            seen.append(led.with_crosstalk(self.crosstalk, sensor) if self.crosstalk else led)
        return tuple(seen)

    def _select_moving(self, of_colours: Sequence[MovingLed | None], changes: int, roi: Roi) -> NDArray[np.float64]:
        """For each pixel of a region, one LED's light of the pixel's colour and its changes."""
        dark = np.zeros((1 + changes, *roi.shape))
        light = [dark if led is None else led.within(roi) for led in of_colours]
        return select_colours(light, self.mosaic, roi)

    def _with_crosstalk(self, patches: tuple[LedPatch, ...], posed: PosedCamera) -> tuple[LedPatch, ...]:
        if not self.crosstalk:
            return patches
        return tuple(shared_patch(patch, self.crosstalk, Roi.of_sensor(posed.camera)) for patch in patches)

    def _of_colours(self, posed: PosedCamera) -> tuple[PosedCamera, ...]:
        """The camera as light of each colour sees it (lateral colour)."""
        return tuple(replace(posed, camera=posed.camera.for_colour(c)) for c in range(len(COLOURS)))

    def halo_of(self, camera: Camera) -> Callable[[Sequence[SourceOfLight], Roi], NDArray[np.float64]] | None:
        """As `Renderer.halo_of`, of light under the mosaic: each colour's light is that of its pixels, times 4 or 2.

        The halo is too wide to tell that from the light that all pixels have under the colour's filter.
        """
        of_colour = self.of_colours[0].halo_of(camera)
        return None if of_colour is None else partial(self._mosaic_halo, of_colour)

    def _mosaic_halo(
        self,
        of_colour: Callable[[Sequence[SourceOfLight], Roi], NDArray[np.float64]],
        sources: Sequence[SourceOfLight],
        roi: Roi,
    ) -> NDArray[np.float64]:
        colours = colour_of_pixels(self.mosaic, Roi(0, 0, 2, 2))
        halos = []
        for colour in range(len(COLOURS)):
            factor = colours.size / np.count_nonzero(colours == colour)
            light = [
                LightOfLed(
                    p.led_id, p.roi, p.electrons_per_s * factor * (colour_of_pixels(self.mosaic, p.roi) == colour)
                )
                for p in sources
            ]
            halos.append(of_colour(light, roi))
        return select_colours(halos, self.mosaic, roi)

    def _region(self, of_colours: Sequence[ExpectedRegion]) -> ExpectedRegion:
        roi = of_colours[0].roi
        parts = [region.led_background_e_per_s for region in of_colours]
        of_leds = [part for part in parts if part is not None]
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
            self._select(of_leds, roi) if of_leds else None,
        )

    def _halo(self, of_colours: Sequence[Halo | None]) -> MosaicHalo | None:
        halos = tuple(halo for halo in of_colours if halo is not None)
        return MosaicHalo(halos, self.mosaic) if halos else None

    def _patches(self, of_colours: Sequence[Sequence[LedPatch]]) -> tuple[LedPatch, ...]:
        """Patches with the pixels of each colour; place and visible share are those of the green image."""
        by_id = [{patch.led_id: patch for patch in patches} for patches in of_colours]
        patches = []
        for led_id in dict.fromkeys(patch.led_id for one in of_colours for patch in one):
            same = [of_colour.get(led_id) for of_colour in by_id]
            found = [patch for patch in same if patch is not None]
            roi = reduce(Roi.union, (patch.roi for patch in found))
            light = [_padded(patch, roi, found[0].electrons_per_s.dtype) for patch in same]
            leading = same[COLOURS.index("green")] or found[0]
            patches.append(replace(leading, row=roi.row, column=roi.column, electrons_per_s=self._select(light, roi)))
        return tuple(patches)

    def _select(self, images: Sequence[NDArray[Any]], roi: Roi) -> NDArray[Any]:
        """For each pixel of a region, the image of the pixel's colour."""
        return select_colours(images, self.mosaic, roi)
