"""The expected image of a view: electrons a second in every pixel, without noise.

The room behind comes from `background`. LEDs lie on top, each a window with its exact pixel coverage (`led_light`). An
LED's face hides what is behind it and reflects the room's light: that is part of the background; its own light is a
patch of its own, so that image = background + sum over LEDs of gain * patch, for any exposure and modulation. Of an LED
behind a diffuser the patch is what it lights of the sheet, which is a surface of the room like others. An LED seen by
way of a window pane is a patch too (`false_image`). At last the lens spreads each of them by what it does at their
depth.
"""

import os
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose, project
from vlcrender.camera.lens import blur
from vlcrender.camera.roi import LedRegions, Roi, led_regions
from vlcrender.core.backend import dr
from vlcrender.errors import InputError
from vlcrender.light.lightmap import Lightmap, bake
from vlcrender.rendering.background import Background
from vlcrender.rendering.expected_image import ExpectedImage, ExpectedRegion, Image, LedPatch, SpecularReflection
from vlcrender.rendering.led_blur import LedBlur, led_blur, radius_px
from vlcrender.rendering.led_radiance import LedImage, led_images
from vlcrender.rendering.occlusion import Occlusion
from vlcrender.rendering.specular_reflection import blurred, specular_reflections
from vlcrender.scene.loader import Scene
from vlcrender.sensor.radiometry import Detector, Silicon, electron_rate_per_cd_m2

MAX_PIXELS = 16
"""How many times the sensor's pixels windows may hold."""

Array = NDArray[np.float64]


class Renderer:
    """Renders views of one scene."""

    def __init__(self, scene: Scene, light: Lightmap | None = None, detector: Detector | None = None) -> None:
        """Prepare a scene. `light` is its bake, made or taken from the cache where not given; `detector`, silicon."""
        self.scene = scene
        self.detector = detector or Silicon()
        self._light = light or bake(scene)
        self._background = Background(scene, self._light)
        self._obstacles = Occlusion(scene, self._background)

    def expected_image(
        self, camera: Camera, pose: Pose, regions: LedRegions | None = None, during: Sequence[Pose] | None = None
    ) -> ExpectedImage:
        """Render one view, of the whole sensor or of windows alone, which costs the windows alone.

        Of a camera that moves, `during` are poses spread evenly over the exposure, whose mean is the view, and `pose`
        is the one that LEDs' centres are given for. Raises InputError where the camera is not inside the room or the
        windows hold more than MOST_PIXELS times the sensor's.
        """
        places = (pose,) if during is None else tuple(during)
        for place in places:
            check_inside(self.scene, place)
        leds, blurs = self.scene.leds, led_blur(self.scene.leds, camera, pose)
        lights = [led_images(leds, self._obstacles, camera, place, regions, blurs) for place in places]
        lit = _lit_regions(camera, lights, blurs, regions)
        frames = (Roi.of_sensor(camera),) if regions is None else led_regions(lit.values(), camera, regions)
        _check_size(frames, camera)
        backgrounds, reflections = self._rooms(camera, places, frames, lights, blurs)
        patches = self._patches(camera, pose, lights, lit, blurs)
        return ExpectedImage(
            tuple(
                ExpectedRegion(
                    frame,
                    background,
                    tuple(p for p in patches if frame.contains(p.roi)),
                    tuple(r for r in reflections if frame.contains(r.roi)),
                )
                for frame, background in zip(frames, backgrounds, strict=True)
            )
        )

    def led_patches(
        self, camera: Camera, pose: Pose, regions: LedRegions | None = None, blurred_at: Pose | None = None
    ) -> tuple[LedPatch, ...]:
        """The LEDs' own light alone: the patches of `view` in double precision, without the room behind them.

        Blurred as at the pose `blurred_at` where given: kernels change in steps of depth, which differences would see.
        """
        leds, blurs = self.scene.leds, led_blur(self.scene.leds, camera, blurred_at or pose)
        lights = [led_images(leds, self._obstacles, camera, pose, regions, blurs)]
        return self._patches(camera, pose, lights, _lit_regions(camera, lights, blurs, regions), blurs, np.float64)

    def background_cd_m2(self, camera: Camera, pose: Pose) -> Image:
        """Luminance of the room times relative illumination, mean over each pixel, (height, width); sharp, no LEDs."""
        images, _ = self._background.images(camera, pose, (Roi.of_sensor(camera),), (1.0, 1.0))
        return images[0]

    def _rates(self, camera: Camera) -> tuple[float, float]:
        """Electrons a second of 1 cd/m2 on the axis: of light that left an LED, and of all other light."""
        settings = self.scene.settings
        lamp, other = (
            electron_rate_per_cd_m2(camera, spectrum, self.detector)
            for spectrum in (settings.led_spectrum, settings.ambient.spectrum)
        )
        return lamp, other

    def _rooms(
        self,
        camera: Camera,
        places: Sequence[Pose],
        frames: Sequence[Roi],
        lights: Sequence[Mapping[int, LedImage]],
        blurs: LedBlur,
    ) -> tuple[list[Image], list[SpecularReflection]]:
        """The windows without the LEDs' own light, and its reflections: means over the places, blurred."""
        sensor = Roi.of_sensor(camera)
        padded = [frame.padded(blurs.spread_px) for frame in frames]
        wide = [w.intersection(sensor) if sensor.contains(f) else w for f, w in zip(frames, padded, strict=True)]
        rates = self._rates(camera)
        totals: list[Image] | None = None
        reflections: list[SpecularReflection] = []
        for place, seen in zip(places, lights, strict=True):
            backgrounds, surfaces = self._background.images(camera, place, wide, rates)
            self._hide_behind_leds(wide, backgrounds, seen, rates)
            totals = backgrounds if totals is None else [t + b for t, b in zip(totals, backgrounds, strict=True)]
            for number in range(len(self.scene.glazings)):
                label = self._background.room.first_glazing + number
                if any((s == label).any() for s in surfaces):
                    lamp = rates[0] / len(places)
                    reflections += specular_reflections(self.scene, self._obstacles, camera, place, number, wide, lamp)
        assert totals is not None  # there is at least one place
        means = []
        for total, roi, frame in zip(totals, wide, frames, strict=True):
            mean = total if len(places) == 1 else total / np.float32(len(places))
            means.append(np.ascontiguousarray(blur(mean, blurs.typical, "edge")[roi.slices(frame)]))
        return means, blurred(reflections, blurs.typical, frames, sensor)

    def _hide_behind_leds(
        self,
        frames: Sequence[Roi],
        backgrounds: list[Image],
        lights: Mapping[int, LedImage],
        rates: tuple[float, float],
    ) -> None:
        """LED faces cover what is behind them and reflect the room's light; changes the backgrounds."""
        corners = len(self._light.mesh.vertices_m)
        faces = rates[0] * self._light.led_cd_m2()[corners:] + rates[1] * self._light.ambient_cd_m2()[corners:]
        for i, light in lights.items():
            if self.scene.leds.diffusers[i] is not None:
                continue  # a diffuser is one of the room's surfaces
            for frame, background in zip(frames, backgrounds, strict=True):
                if frame.overlaps(light.roi):
                    both = frame.intersection(light.roi)
                    here, there = frame.slices(both), light.roi.slices(both)
                    coverage = light.coverage[there]
                    hidden = background[here] * (1 - coverage)
                    background[here] = hidden + faces[i] * coverage * light.weight[there]

    def _patches(
        self,
        camera: Camera,
        pose: Pose,
        lights: Sequence[Mapping[int, LedImage]],
        lit: Mapping[int, Roi],
        blurs: LedBlur,
        precision: type[np.floating] = np.float32,
    ) -> tuple[LedPatch, ...]:
        """The LEDs' own light, the mean over the images at several poses."""
        leds = self.scene.leds
        lamp, _ = self._rates(camera)
        center_px, _ = project(camera, pose, leds.centers_m)
        around = _around(lights)
        patches = []
        for i, roi in lit.items():
            light = np.zeros((around[i].rows, around[i].columns))
            seen = [of_pose[i] for of_pose in lights if i in of_pose]
            for image in seen:
                light[around[i].slices(image.roi)] += (
                    lamp * leds.luminances_cd_m2[i] * image.coverage * image.weight * image.pattern
                )
            edges = [image.edges for image in seen if image.edges is not None]
            worth = lamp * float(leds.luminances_cd_m2[i]) / len(lights)
            spread = blurs.blurred(i, light / len(lights), around[i], edges, worth)
            spread = spread[around[i].padded(radius_px(blurs.kernels[i])).slices(roi)]
            patches.append(
                LedPatch(
                    led_id=int(leds.ids[i]),
                    center_px=(float(center_px[i, 0]), float(center_px[i, 1])),
                    row=roi.row,
                    column=roi.column,
                    electrons_per_s=np.ascontiguousarray(spread, dtype=precision),
                    visible_fraction=sum(image.visible_fraction for image in seen) / len(lights),
                    imaged_fraction=sum(image.imaged_fraction for image in seen) / len(lights),
                )
            )
        return tuple(patches)


def _around(lights: Sequence[Mapping[int, LedImage]]) -> dict[int, Roi]:
    """Around all that each LED lights, by the LED's index."""
    lit: dict[int, Roi] = {}
    for of_pose in lights:
        for i, light in of_pose.items():
            lit[i] = lit[i].union(light.roi) if i in lit else light.roi
    return dict(sorted(lit.items()))


def _lit_regions(
    camera: Camera, lights: Sequence[Mapping[int, LedImage]], blurs: LedBlur, regions: LedRegions | None
) -> dict[int, Roi]:
    """The pixels of the view that each LED lights, blur included, by the LED's index."""
    lit = {i: roi.padded(radius_px(blurs.kernels[i])) for i, roi in _around(lights).items()}
    if regions is not None and regions.overscan:
        return lit
    sensor = Roi.of_sensor(camera)
    return {i: roi.intersection(sensor) for i, roi in lit.items() if sensor.overlaps(roi)}


def _check_size(frames: Sequence[Roi], camera: Camera) -> None:
    """Raise InputError where windows hold too many pixels."""
    pixels, most = sum(frame.pixels for frame in frames), MAX_PIXELS * Roi.of_sensor(camera).pixels
    if pixels > most:
        raise InputError(
            f"windows: overscan makes {pixels} pixels of LED windows; at most {most}, {MAX_PIXELS} times the "
            "sensor's, are allowed: lower margin_px, or leave overscan out"
        )


def share_cores(workers: int) -> None:
    """Keep Dr.Jit in this process to its share of the cores: its idle threads wait busily, and take from others."""
    dr.set_thread_count(max(1, (os.cpu_count() or 1) // workers))


def check_inside(scene: Scene, pose: Pose) -> None:
    """Raise InputError where the camera is not inside the room."""
    if not all(0 < p < limit for p, limit in zip(pose.position_m, scene.room_m, strict=True)):
        raise InputError(
            f"camera position {list(pose.position_m)} m is not inside the room of {scene.room_m.tolist()} m"
        )
