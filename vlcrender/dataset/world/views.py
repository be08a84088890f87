"""Views and their exposures: what frames of a dataset, and cells of a sweep, share of a frame before its noise."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import Mounted
from vlcrender.camera.roi import LedRegions, RegionImage
from vlcrender.dataset.format.rows import Flat9, flat9
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.dataset.world.bound_uncertainty import uncertainty_of
from vlcrender.dataset.world.true_world import tilt_sigmas_deg
from vlcrender.modulation.exposure import LineGains, MeanWave
from vlcrender.modulation.wave import Wave
from vlcrender.rendering.bayer import MosaicRenderer
from vlcrender.rendering.crlb import FrameSlopes
from vlcrender.rendering.expected_image import ExpectedImage, Gain, Gains
from vlcrender.rendering.renderer import Renderer
from vlcrender.sensor.signal_chain import AddedDn, variance_e2


@dataclass(frozen=True, eq=False)
class View:
    """What a true camera sees from a pose: shared by all frames there of a camera with the same errors."""

    renderer: Renderer | MosaicRenderer
    regions: LedRegions | None
    mounted: Mounted
    """The true camera."""
    main: Pose
    """Pose of the camera `main` in the middle of its frame."""
    middle: Pose
    """Pose of the camera `main` in the middle of this camera's frame."""
    image: ExpectedImage
    room: MeanWave
    """Light of all LEDs of the room."""

    @property
    def posed(self) -> PosedCamera:
        """The camera in the middle of its frame."""
        return self.mounted.posed(self.middle)

    @cached_property
    def slopes(self) -> FrameSlopes | None:
        """Slopes of the LEDs' images in steady light, exposed for 1 s, without the variance of an exposure."""
        at = self.mounted.posed(self.main)
        return FrameSlopes.rendered(
            self.mounted,
            self.main,
            partial(self.renderer.led_slopes, regions=self.regions),
            1.0,
            [],
            float(np.median(np.linalg.norm(self.renderer.scene.leds.centers_m - at.position_m, axis=1))),
            self.regions is not None and self.regions.overscan,
            halo_of=self.renderer.halo_of(self.mounted.camera),
        )


@dataclass(frozen=True, eq=False)
class ExposedView:
    """A view and its latest exposure.

    A view does not know its exposures, nor a frame its exposure: the memory of images in a circle of references
    would be free only when Python looks for circles, some 15 full frames later.
    """

    view: View
    _latest: dict[str, "Exposure"] = field(default_factory=dict)

    def exposure(self, recipe: Recipe, files_key: str) -> "Exposure":
        """The exposure by a recipe; the latest one is kept for recipes with the same `files_key`."""
        exposure = self._latest.get(files_key)
        if exposure is None:
            exposure = Exposure(self.view, recipe, recipe.time_s(self.view.image))
            self._latest.clear()
            self._latest[files_key] = exposure
        return exposure


@dataclass(frozen=True, eq=False)
class Exposure:
    """Exposures of a view by a recipe, and by all whose frames have the same files."""

    view: View
    recipe: Recipe
    exposure_s: float

    def frame(self, waves: Mapping[int, Wave], start_s: float) -> "NoiselessFrame":
        """The frame that starts at `start_s`; computed once where all light is steady."""
        return self._frame(waves, start_s) if waves else self._steady

    @cached_property
    def _steady(self) -> "NoiselessFrame":
        return self._frame({}, 0.0)

    def _frame(self, waves: Mapping[int, Wave], start_s: float) -> "NoiselessFrame":
        return NoiselessFrame(self.view, self.recipe, self.exposure_s, waves, start_s)


@dataclass(frozen=True, eq=False)
class NoiselessFrame:
    """A frame of a view by the recipe of its exposure, before its noise."""

    view: View
    recipe: Recipe
    exposure_s: float
    waves: Mapping[int, Wave]
    start_s: float
    _bounds: dict[tuple[float, float], tuple[Flat9 | None, Flat9 | None]] = field(default_factory=dict)

    @cached_property
    def _gains(self) -> tuple[Gains | None, Gain]:
        """Gains of the LEDs and of the room's light."""
        if not self.waves:
            return None, 1.0
        starts_s = self.start_s + self.view.mounted.camera.line_starts_s()
        return LineGains(self.waves, starts_s, self.exposure_s), self.view.room.mean(starts_s, self.exposure_s)

    @cached_property
    def expected(self) -> list[RegionImage]:
        """Electrons of each region."""
        gains, room_gain = self._gains
        return [
            RegionImage(part.roi, part.expected_electrons(self.exposure_s, gains, room_gain))
            for part in self.view.image.parts
        ]

    @cached_property
    def added_dn(self) -> float | None:
        """Standard deviation of the noise that is added, digital numbers; None where none is."""
        noise = self.recipe.added_noise
        return None if noise is None else self.recipe.added_noise_dn(self.expected)

    def added(self, key: str) -> AddedDn | None:
        """The noise that is added, by the random numbers that `key` names."""
        return None if self.added_dn is None else AddedDn(self.added_dn, key)

    def bounds_m2(self, recipe: Recipe) -> tuple[Flat9 | None, Flat9 | None]:
        """Cramér-Rao bounds of the frame's position, row by row: hybrid, and exact; the same without [belief].

        recipe: one with the same files, whose accelerometer counts. The bound takes gains of LEDs as known. None where
        the recipe does not ask for bounds, or where the frame does not determine a position.
        """
        if not recipe.bound or self._slopes is None:
            return None, None
        tilts_deg = tilt_sigmas_deg(recipe, self.view.main)
        if tilts_deg not in self._bounds:
            self._bounds[tilts_deg] = self._bounds_with(recipe, self._slopes, tilts_deg)
        return self._bounds[tilts_deg]

    @cached_property
    def _slopes(self) -> FrameSlopes | None:
        """Slopes of the LEDs' images with the variance of the frame's pixels."""
        recipe, slopes, exposure_s = self.recipe, self.view.slopes, self.exposure_s
        if slopes is None:
            return None
        added_dn = self.added_dn or 0.0
        variance = [
            RegionImage(roi, variance_e2(recipe.sensor, mean, exposure_s, added_dn)) for roi, mean in self.expected
        ]
        return replace(slopes, exposure_s=exposure_s).exposed(variance, self._gains[0])

    def _bounds_with(
        self, recipe: Recipe, slopes: FrameSlopes, tilts_deg: tuple[float, float]
    ) -> tuple[Flat9 | None, Flat9 | None]:
        view = self.view
        exact = slopes.exact_bound_m2(tilts_deg)
        hybrid = exact
        if recipe.belief is not None:
            uncertainty = uncertainty_of(recipe, view.renderer.scene, view.mounted)
            hybrid = slopes.hybrid_bound_m2(tilts_deg, view.renderer.scene.leds, uncertainty)
        return None if hybrid is None else flat9(hybrid), None if exact is None else flat9(exact)
