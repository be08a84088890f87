"""Expected images of a scene: electrons a second in every pixel, without noise.

The room behind the LEDs comes from `background`. LEDs lie on top, each a region with its exact pixel coverage
(`led_radiance`). The face of an LED hides the room behind it and reflects the room's light: both are part of the
background. Its own light is a patch, so that image = background + sum over LEDs of gain * patch, for any exposure and
modulation. The patch of an LED behind a diffuser is the light on the diffuser, which itself is a surface of the room.
The specular reflection of an LED in a glazing is a patch too (`specular_reflection`). At last the lens blurs each patch
by the kernel of its depth (`led_blur`), and scatters a share of all light into a halo (`halo`).
"""

import copy
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.psf import blur
from vlcrender.camera.roi import LedRegions, Roi, led_regions
from vlcrender.core.backend import dr
from vlcrender.errors import InputError
from vlcrender.light.lightmap import Lightmap, bake
from vlcrender.rendering.background import Background, BackgroundRegion
from vlcrender.rendering.crosstalk import REACH_PX, shared_patch, with_crosstalk
from vlcrender.rendering.electron_rates import ElectronRates
from vlcrender.rendering.expected_image import ExpectedImage, ExpectedRegion, Image, LedPatch, SpecularReflection
from vlcrender.rendering.halo import GlareHalo, glare_halo, halo_of_sources
from vlcrender.rendering.led_blur import LedBlur, led_blur
from vlcrender.rendering.led_radiance import LedImage, led_images
from vlcrender.rendering.occlusion import Occlusion
from vlcrender.rendering.specular_reflection import blurred, specular_reflections
from vlcrender.scene.leds import Leds
from vlcrender.scene.loader import Scene
from vlcrender.sensor.radiometry import Detector, Silicon

MAX_SENSORS = 16
"""All regions of a frame together hold at most this many times the sensor's pixels."""

OVERSCAN_WITH_GLARE = "regions.overscan = true: glare is computed on the sensor only; remove overscan or camera.glare"

Array = NDArray[np.float64]
LedImages = Mapping[int, LedImage]
"""Images of the LEDs at one pose, by the LED's index."""


@dataclass(frozen=True)
class LedView:
    """The LEDs as a camera sees them at one or more poses, and the pixels that each lights, by its index."""

    posed: PosedCamera
    poses: tuple[PosedCamera, ...]
    blurs: LedBlur
    images: tuple[LedImages, ...]
    patch_rois: Mapping[int, Roi]


def read_out(views: Sequence[LedView], regions: LedRegions | None, reach_px: int = 0) -> tuple[Roi, ...]:
    """The regions that are read out of a sensor: all of it, or regions around the LEDs of one or more views.

    reach_px: pixels around its image that an LED lights by crosstalk.
    """
    camera = views[0].posed.camera
    if regions is None:
        return (Roi.of_sensor(camera),)
    rois = dict(views[0].patch_rois)
    for view in views[1:]:
        for i, roi in view.patch_rois.items():
            rois[i] = rois[i].union(roi) if i in rois else roi
    if reach_px:
        sensor = Roi.of_sensor(camera)
        lit = {i: roi.padded(reach_px) for i, roi in rois.items()}
        rois = {i: lit[i].intersection(sensor) if sensor.contains(roi) else lit[i] for i, roi in rois.items()}
    return led_regions(rois.values(), camera, regions)


class Renderer:
    """Renders expected images of one scene on one detector."""

    def __init__(
        self,
        scene: Scene,
        light: Lightmap | None = None,
        detector: Detector | None = None,
        crosstalk: float = 0.0,
    ) -> None:
        """Prepare a scene.

        light: baked light of the scene, made or taken from the cache where not given; detector: silicon by default;
        crosstalk: share of a pixel's electrons that its neighbours collect.
        """
        self._crosstalk = crosstalk
        self.scene = scene
        self.detector = detector or Silicon()
        self._light = light or bake(scene)
        self._background = Background(scene, self._light)
        self._occlusion = Occlusion(scene, self._background)

    def with_leds(self, leds: Leds) -> "Renderer":
        """A renderer of the same room in whose images the LEDs are `leds`, the scene's LEDs as built.

        The room's light and all occluders remain the scene's. `leds` has as many LEDs, in the same order.
        """
        renderer = copy.copy(self)
        renderer.scene = replace(self.scene, leds=leds)
        # Where LEDs are as built, cameras are as made: each device, or frame, has its own.
        renderer._background = self._background.with_varying_cameras()
        renderer._occlusion = self._occlusion.with_varying_cameras()
        return renderer

    def expected_image(
        self, posed: PosedCamera, regions: LedRegions | None = None, during: Sequence[Pose] | None = None
    ) -> ExpectedImage:
        """Render the whole sensor, or regions of it only, at a cost in proportion to their pixels.

        during: for a moving camera, poses spread evenly over the exposure. The image is the mean over them, and the
        centres of the LEDs are given for `posed`. Raises InputError where the camera is not inside the room, or where
        the regions hold more than MAX_SENSORS times the sensor's pixels, and for a lens with glare with overscan.
        """
        view = self.view(posed, regions, during)
        rois = read_out((view,), regions, REACH_PX if self._crosstalk else 0)
        image = self.image_of(view, rois)
        return with_crosstalk(image, self._crosstalk, Roi.of_sensor(posed.camera)) if self._crosstalk else image

    def view(
        self, posed: PosedCamera, regions: LedRegions | None = None, during: Sequence[Pose] | None = None
    ) -> "LedView":
        """The LEDs of a view before their light is computed, and the pixels that they light.

        Arguments and exceptions of `expected_image`.
        """
        if posed.camera.glare is not None and regions is not None and regions.overscan:
            raise InputError(OVERSCAN_WITH_GLARE)
        if posed.camera.lateral_colour_um is not None:
            raise InputError("camera.lateral_colour_um: needs a sensor with a mosaic; remove it, or choose a mosaic")
        poses = [posed] if during is None else [posed.at(pose) for pose in during]
        for each in poses:
            check_inside(self.scene, each.pose)
        blurs = led_blur(self.scene.leds, posed)
        images = [led_images(self.scene.leds, self._occlusion, each, regions, blurs) for each in poses]
        return LedView(posed, tuple(poses), blurs, tuple(images), _patch_rois(posed.camera, images, blurs, regions))

    def image_of(self, view: "LedView", rois: Sequence[Roi]) -> ExpectedImage:
        """The expected image of a view before crosstalk, in the regions of `read_out`."""
        posed = view.posed
        _check_size(rois, posed.camera)
        backgrounds, reflections = self._rooms(view.poses, rois, view.images, view.blurs)
        patches = self._patches(posed, view.images, view.patch_rois, view.blurs)
        halo = self._halo(posed, patches)
        return ExpectedImage(
            tuple(
                ExpectedRegion(
                    roi,
                    background,
                    tuple(p for p in patches if roi.contains(p.roi)),
                    tuple(r for r in reflections if roi.contains(r.roi)),
                    halo,
                )
                for roi, background in zip(rois, backgrounds, strict=True)
            )
        )

    def led_patches(
        self, posed: PosedCamera, regions: LedRegions | None = None, blurred_at: Pose | None = None
    ) -> tuple[LedPatch, ...]:
        """The patches of `expected_image` alone, in double precision.

        blurred_at: pose whose blur is applied, `posed` itself where not given. Kernels change in steps of depth, which
        differences between images at two poses must not contain.
        """
        leds = self.scene.leds
        blurs = led_blur(leds, posed if blurred_at is None else posed.at(blurred_at))
        images = [led_images(leds, self._occlusion, posed, regions, blurs)]
        patch_rois = _patch_rois(posed.camera, images, blurs, regions)
        patches = self._patches(posed, images, patch_rois, blurs, np.float64)
        if not self._crosstalk:
            return patches
        return tuple(shared_patch(patch, self._crosstalk, Roi.of_sensor(posed.camera)) for patch in patches)

    def halo_of(self, camera: Camera) -> Callable[[Sequence[LedPatch], Roi], Array] | None:
        """The function from patches of `led_patches` to their halo in a region of the sensor, electrons a second.

        None for a lens without glare.
        """
        return None if camera.glare is None else partial(halo_of_sources, camera, camera.glare)

    def background_cd_m2(self, posed: PosedCamera) -> Image:
        """Luminance of the room times relative illumination, mean over each pixel, (height, width); sharp, no LEDs."""
        (region,) = self._background.regions(posed, (Roi.of_sensor(posed.camera),), ElectronRates(1.0, 1.0))
        return region.image

    def _rates(self, camera: Camera) -> ElectronRates:
        return ElectronRates.of(self.scene, camera, self.detector)

    def _halo(self, posed: PosedCamera, patches: Sequence[LedPatch]) -> GlareHalo | None:
        """The halo of all that the sensor sees, regions or not; of room and reflections as at mid-exposure."""
        if posed.camera.glare is None:
            return None
        rates, sensor = self._rates(posed.camera), Roi.of_sensor(posed.camera)
        reflections = [
            reflection
            for number in range(len(self.scene.glazings))
            for reflection in specular_reflections(self.scene, self._occlusion, posed, number, [sensor], rates.led)
        ]
        return glare_halo(posed, self._background, rates, [*patches, *reflections])

    def _rooms(
        self, poses: Sequence[PosedCamera], rois: Sequence[Roi], images: Sequence[LedImages], blurs: LedBlur
    ) -> tuple[list[Image], list[SpecularReflection]]:
        """The background of each region, and all specular reflections: means over the poses, blurred."""
        camera = poses[0].camera
        sensor = Roi.of_sensor(camera)
        padded = [roi.padded(blurs.radius_px) for roi in rois]
        wide = [p.intersection(sensor) if sensor.contains(roi) else p for roi, p in zip(rois, padded, strict=True)]
        rates = self._rates(camera)
        totals: list[Image] | None = None
        reflections: list[SpecularReflection] = []
        for posed, of_pose in zip(poses, images, strict=True):
            rooms = self._background.regions(posed, wide, rates)
            self._cover_with_faces(rooms, of_pose, rates)
            if totals is None:
                totals = [room.image for room in rooms]
            else:
                totals = [total + room.image for total, room in zip(totals, rooms, strict=True)]
            for number in range(len(self.scene.glazings)):
                label = self._background.room.first_glazing + number
                if any((room.surfaces == label).any() for room in rooms):
                    led_rate = rates.led / len(poses)
                    reflections += specular_reflections(self.scene, self._occlusion, posed, number, wide, led_rate)
        assert totals is not None  # there is at least one pose
        means = []
        for total, outer, roi in zip(totals, wide, rois, strict=True):
            mean = total if len(poses) == 1 else total / np.float32(len(poses))
            means.append(np.ascontiguousarray(blur(mean, blurs.typical, "edge")[outer.slices(roi)]))
        return means, blurred(reflections, blurs.typical, rois, sensor)

    def _cover_with_faces(self, rooms: Sequence[BackgroundRegion], images: LedImages, rates: ElectronRates) -> None:
        """Put the LEDs' faces, which reflect the room's light, before the room; changes its images."""
        vertices = len(self._light.mesh.vertices_m)  # the lightmap has the faces after the mesh
        faces = rates.led * self._light.led_cd_m2()[vertices:] + rates.ambient * self._light.ambient_cd_m2()[vertices:]
        for i, led in images.items():
            if self.scene.leds.diffusers[i] is not None:
                continue  # a diffuser is one of the room's surfaces
            for room in rooms:
                if room.roi.overlaps(led.roi):
                    both = room.roi.intersection(led.roi)
                    here, there = room.roi.slices(both), led.roi.slices(both)
                    coverage = led.coverage[there]
                    uncovered = room.image[here] * (1 - coverage)
                    room.image[here] = uncovered + faces[i] * coverage * led.weight[there]

    def _patches(
        self,
        posed: PosedCamera,
        images: Sequence[LedImages],
        patch_rois: Mapping[int, Roi],
        blurs: LedBlur,
        precision: type[np.floating] = np.float32,
    ) -> tuple[LedPatch, ...]:
        """Patches of the LEDs: means over the images at several poses, blurred."""
        leds = self.scene.leds
        led_rate = self._rates(posed.camera).led
        center_px = posed.project(leds.centers_m)
        unions = _unions(images)
        patches = []
        for i, roi in patch_rois.items():
            union, kernel = unions[i], blurs.kernels[i]
            light = np.zeros((union.rows, union.columns))
            of_led = [of_pose[i] for of_pose in images if i in of_pose]
            for image in of_led:
                light[union.slices(image.roi)] += (
                    led_rate * leds.luminances_cd_m2[i] * image.coverage * image.weight * image.pattern
                )
            edges = [image.edges for image in of_led if image.edges is not None]
            light_per_excess = led_rate * float(leds.luminances_cd_m2[i]) / len(images)
            patch = kernel.blurred(light / len(images), union, edges, light_per_excess)
            patch = patch[union.padded(kernel.radius_px).slices(roi)]
            patches.append(
                LedPatch(
                    led_id=int(leds.ids[i]),
                    center_px=(float(center_px[i, 0]), float(center_px[i, 1])),
                    row=roi.row,
                    column=roi.column,
                    electrons_per_s=np.ascontiguousarray(patch, dtype=precision),
                    visible_fraction=sum(image.visible_fraction for image in of_led) / len(images),
                    imaged_fraction=sum(image.imaged_fraction for image in of_led) / len(images),
                )
            )
        return tuple(patches)


def _unions(images: Sequence[LedImages]) -> dict[int, Roi]:
    """By the LED's index, the region that contains its images at all poses, before blur."""
    unions: dict[int, Roi] = {}
    for of_pose in images:
        for i, image in of_pose.items():
            unions[i] = unions[i].union(image.roi) if i in unions else image.roi
    return dict(sorted(unions.items()))


def _patch_rois(
    camera: Camera, images: Sequence[LedImages], blurs: LedBlur, regions: LedRegions | None
) -> dict[int, Roi]:
    """By the LED's index, the pixels that it lights, blur included; on the sensor only, unless with overscan."""
    rois = {i: roi.padded(blurs.kernels[i].radius_px) for i, roi in _unions(images).items()}
    if regions is not None and regions.overscan:
        return rois
    sensor = Roi.of_sensor(camera)
    return {i: roi.intersection(sensor) for i, roi in rois.items() if sensor.overlaps(roi)}


def _check_size(rois: Sequence[Roi], camera: Camera) -> None:
    """Raise InputError where regions hold too many pixels."""
    pixels, allowed = sum(roi.pixels for roi in rois), MAX_SENSORS * Roi.of_sensor(camera).pixels
    if pixels > allowed:
        raise InputError(
            f"regions: overscan makes LED regions of {pixels} pixels; at most {allowed}, {MAX_SENSORS} times the "
            "sensor's, are allowed: lower margin_px, or remove overscan"
        )


def share_cores(workers: int) -> None:
    """Limit Dr.Jit in this process to its share of the cores: its idle threads spin and slow down other processes."""
    dr.set_thread_count(max(1, (os.cpu_count() or 1) // workers))


def check_inside(scene: Scene, pose: Pose) -> None:
    """Raise InputError where the camera is not inside the room."""
    if not all(0 < p < limit for p, limit in zip(pose.position_m, scene.room_m, strict=True)):
        raise InputError(
            f"camera position {list(pose.position_m)} m is not inside the room of {scene.room_m.tolist()} m"
        )
