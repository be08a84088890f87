"""Expected images of a scene: electrons a second in every pixel, without noise.

The room behind the LEDs comes from `background`. LEDs lie on top, each a region with its exact pixel coverage
(`led_radiance`). The face of an LED hides the room behind it and reflects the room's light: both are part of the
background. Its own light is a patch, so that image = background + sum over LEDs of gain * patch, for any exposure and
modulation. The patch of an LED behind a diffuser is the light on the diffuser, which itself is a surface of the room.
The specular reflection of an LED in a glazing is a patch too (`specular_reflection`). At last the lens blurs each patch
by the kernel of its depth (`led_blur`), and scatters a share of all light into a halo (`halo`).
"""

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.psf import blur
from vlcrender.camera.roi import LedRegions, Roi
from vlcrender.errors import InputError
from vlcrender.light.lightmap import Lightmap, bake
from vlcrender.rendering.background import Background, BackgroundRegion
from vlcrender.rendering.crosstalk import REACH_PX, shared_patch, with_crosstalk
from vlcrender.rendering.electron_rates import ElectronRates
from vlcrender.rendering.expected_image import ExpectedImage, ExpectedRegion, Image, LedPatch, SpecularReflection
from vlcrender.rendering.halo import GlareHalo, SourceOfLight, glare_halo, halo_of_sources
from vlcrender.rendering.led_blur import LedBlur, led_blur
from vlcrender.rendering.led_radiance import LedImage, led_images, light_of_diffusers
from vlcrender.rendering.led_slopes import Cameras, led_motions
from vlcrender.rendering.led_view import During, LedBand, LedView, cut, patch_rois, read_out, union_of
from vlcrender.rendering.moving_led import MovingLed
from vlcrender.rendering.occlusion import Occlusion
from vlcrender.rendering.readout import Knot, LinePoses, RollingPoses, image_at_own_line
from vlcrender.rendering.seen_pixels import LatestPixels
from vlcrender.rendering.specular_reflection import blurred, specular_reflections
from vlcrender.scene.leds import Leds
from vlcrender.scene.loader import Scene
from vlcrender.sensor.radiometry import Detector, Silicon

MAX_SENSORS = 16
"""All regions of a frame together hold at most this many times the sensor's pixels."""

OVERSCAN_WITH_GLARE = "regions.overscan = true: glare is computed on the sensor only; remove overscan or camera.glare"

Array = NDArray[np.float64]


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
        self._latest: tuple[tuple[PosedCamera, LedRegions | None], LedView] | None = None  # for `led_slopes`
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
        renderer._latest = None
        renderer.scene = replace(self.scene, leds=leds)
        # Where LEDs are as built, cameras are as made: each device, or frame, has its own.
        renderer._background = self._background.with_varying_cameras()
        renderer._occlusion = self._occlusion.with_varying_cameras()
        return renderer

    def expected_image(
        self,
        posed: PosedCamera,
        regions: LedRegions | None = None,
        during: During | None = None,
        room_apart: bool = False,
    ) -> ExpectedImage:
        """Render the whole sensor, or regions of it only, at a cost in proportion to their pixels.

        during: for a moving camera, poses spread evenly over the exposure, over which the image is the mean. The
        centres of the LEDs are given for `posed`, or with RollingPoses for each LED's own line. room_apart: whether the
        background's part that left an LED is wanted too. Raises InputError where the camera is not inside the room, or
        where the regions hold more than MAX_SENSORS times the sensor's pixels, and for a lens with glare with overscan.
        """
        view = self.view(posed, regions, during)
        rois = read_out((view,), regions, REACH_PX if self._crosstalk else 0)
        image = self.image_of(view, rois, room_apart)
        return with_crosstalk(image, self._crosstalk, Roi.of_sensor(posed.camera)) if self._crosstalk else image

    def view(self, posed: PosedCamera, regions: LedRegions | None = None, during: During | None = None) -> "LedView":
        """The LEDs of a view before their light is computed, and the pixels that they light.

        Arguments and exceptions of `expected_image`.
        """
        if posed.camera.glare is not None and regions is not None and regions.overscan:
            raise InputError(OVERSCAN_WITH_GLARE)
        if posed.camera.lateral_colour_um is not None:
            raise InputError("camera.lateral_colour_um: needs a sensor with a mosaic; remove it, or choose a mosaic")
        self._latest = None  # one view at a time is in memory
        blurs = led_blur(self.scene.leds, posed)
        rolling = during if isinstance(during, RollingPoses) else None
        if isinstance(during, RollingPoses):
            bands = tuple(self._band(posed, knot.poses, regions, blurs, knot) for knot in during.knots)
        else:
            bands = (self._band(posed, [posed.pose] if during is None else during, regions, blurs),)
        view = LedView(posed, bands, blurs, patch_rois(posed.camera, bands, blurs, regions), rolling)
        if rolling is None and bands[0].poses == (posed,):
            self._latest = ((posed, regions), view)
        return view

    def _band(
        self,
        posed: PosedCamera,
        poses: Sequence[Pose],
        regions: LedRegions | None,
        blurs: LedBlur,
        knot: Knot | None = None,
    ) -> LedBand:
        cameras = tuple(posed if pose is posed.pose else posed.at(pose) for pose in poses)
        for each in cameras:
            check_inside(self.scene, each.pose)
        within = None if knot is None else knot.lines.padded(blurs.radius_px)
        at_rest = knot is None and len(cameras) == 1
        images = [
            led_images(self.scene.leds, self._occlusion, each, regions, blurs, within, at_rest) for each in cameras
        ]
        return LedBand(cameras, tuple(images), knot)

    def image_of(self, view: "LedView", rois: Sequence[Roi], room_apart: bool = False) -> ExpectedImage:
        """The expected image of a view before crosstalk, in the regions of `read_out`.

        room_apart: as in `expected_image`.
        """
        _check_size(rois, view.posed.camera)
        rates = self._rates(view.posed.camera)
        parts = (rates, replace(rates, ambient=0.0)) if room_apart else (rates,)
        rooms, reflections = self._rooms(view, rois, parts)
        patches = self._patches(view)
        halo = self._halo(view.posed, patches, room_apart)
        return ExpectedImage(
            tuple(
                ExpectedRegion(
                    roi,
                    room[0],
                    tuple(p for p in patches if roi.contains(p.roi)),
                    tuple(r for r in reflections if roi.contains(r.roi)),
                    halo,
                    room[1] if room_apart else None,
                )
                for roi, room in zip(rois, rooms, strict=True)
            )
        )

    def led_patches(
        self, posed: PosedCamera, regions: LedRegions | None = None, blurred_at: Pose | None = None
    ) -> tuple[LedPatch, ...]:
        """The patches of `expected_image` alone, in double precision.

        blurred_at: pose whose blur is applied, `posed` itself where not given. Kernels change in steps of depth, which
        differences between images at two poses must not contain.
        """
        return self._with_crosstalk(self._patches(self._still(posed, regions, blurred_at), np.float64), posed)

    def led_slopes(
        self, posed: PosedCamera, changes: Sequence[Cameras], regions: LedRegions | None = None
    ) -> tuple[MovingLed, ...]:
        """The LEDs of `led_patches`, and how their light changes with each small change of the camera, to first order.

        changes: cameras (after, before). The lens's blur and what is occluded count as constant.
        """
        view, leds = self._still(posed, regions), self.scene.leds
        images = {i: view.bands[0].images[0][i] for i in view.patch_rois}
        splits = {i: view.blurs.kernel(i).split for i in images}
        seen, latest = [], LatestPixels(posed)
        for i, motion in led_motions(leds, posed, changes, images, splits):
            rate = self._rates(posed.camera).led * float(leds.luminances_cd_m2[i])
            led = MovingLed.of_image(images[i], motion, view.blurs.kernel(i), rate, view.patch_rois[i], latest)
            sensor = Roi.of_sensor(posed.camera)
            seen.append(led.with_crosstalk(self._crosstalk, sensor) if self._crosstalk else led)
        return tuple(seen)

    def _still(self, posed: PosedCamera, regions: LedRegions | None, blurred_at: Pose | None = None) -> "LedView":
        """The view of a camera at rest."""
        latest = self._latest
        if blurred_at is None and latest is not None and latest[0] == (posed, regions):
            return latest[1]
        leds = self.scene.leds
        blurs = led_blur(leds, posed if blurred_at is None else posed.at(blurred_at))
        bands = (LedBand((posed,), (led_images(leds, self._occlusion, posed, regions, blurs),)),)
        return LedView(posed, bands, blurs, patch_rois(posed.camera, bands, blurs, regions))

    def _with_crosstalk(self, patches: Iterable[LedPatch], posed: PosedCamera) -> tuple[LedPatch, ...]:
        if not self._crosstalk:
            return tuple(patches)
        return tuple(shared_patch(patch, self._crosstalk, Roi.of_sensor(posed.camera)) for patch in patches)

    def halo_of(self, camera: Camera) -> Callable[[Sequence[SourceOfLight], Roi], Array] | None:
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

    def _halo(self, posed: PosedCamera, patches: Sequence[LedPatch], room_apart: bool) -> GlareHalo | None:
        """The halo of all that the sensor sees, regions or not; of room and reflections as at mid-exposure."""
        if posed.camera.glare is None:
            return None
        rates, sensor = self._rates(posed.camera), Roi.of_sensor(posed.camera)
        reflections = [
            reflection
            for number in range(len(self.scene.glazings))
            for reflection in specular_reflections(self.scene, self._occlusion, posed, number, [sensor], rates.led)
        ]
        return glare_halo(posed, self._background, rates, [*patches, *reflections], room_apart)

    def _rooms(
        self, view: LedView, rois: Sequence[Roi], rates: Sequence[ElectronRates]
    ) -> tuple[list[list[Image]], list[SpecularReflection]]:
        """Backgrounds of each region, one for each of the rates, and all specular reflections: means over the poses,
        blurred.
        """
        blurs, camera = view.blurs, view.posed.camera
        sensor = Roi.of_sensor(camera)
        padded = [roi.padded(blurs.radius_px) for roi in rois]
        wide = [p.intersection(sensor) if sensor.contains(roi) else p for roi, p in zip(rois, padded, strict=True)]
        poses = view.bands[0].poses
        rolling = () if view.rolling is None else view.rolling.steps
        during = rolling or tuple(LinePoses.of(each.pose) for each in poses)
        reach_px = self._background.reach_px(view.posed, during)
        steps = len(during)
        totals: list[tuple[Image, ...]] | None = None
        reflections: list[SpecularReflection] = []
        for group in [range(steps)] if reach_px is not None else [range(step, step + 1) for step in range(steps)]:
            if len(group) > 1:
                rooms = self._background.regions(view.posed, wide, *rates, during=during, reach_px=reach_px or 0)
            else:
                first = group.start
                rooms = self._background.regions(poses[first], wide, *rates, during=rolling[first : first + 1])
            self._cover_with_faces(rooms, view.bands, group, rates)
            if totals is None:
                totals = [room.images for room in rooms]
            else:
                for of_room, room in zip(totals, rooms, strict=True):
                    for total, image in zip(of_room, room.images, strict=True):
                        total += image
            for number in range(len(self.scene.glazings)):
                label = self._background.room.first_glazing + number
                if any((room.surfaces == label).any() for room in rooms):
                    for step in group:
                        reflections += self._reflections(view, step, number, wide, rois, rates[0].led / steps)
        assert totals is not None  # there is at least one pose

        def mean(total: Image, outer: Roi, roi: Roi) -> Image:
            sharp = total if reach_px is not None else total / np.float32(steps)
            return np.ascontiguousarray(blur(sharp, blurs.typical, "edge")[outer.slices(roi)])

        means = [
            [mean(total, outer, roi) for total in of_room]
            for of_room, outer, roi in zip(totals, wide, rois, strict=True)
        ]
        return means, reflections

    def _reflections(
        self, view: LedView, step: int, number: int, wide: Sequence[Roi], rois: Sequence[Roi], led_rate: float
    ) -> list[SpecularReflection]:
        """Reflections in a glazing at one pose of each band, blurred, in the regions `rois`; `wide`: before blur."""
        sensor, found = Roi.of_sensor(view.posed.camera), []
        for band in view.bands:
            within = wide
            if band.knot is not None:
                lines = band.knot.lines.padded(view.blurs.radius_px)
                within = [roi.intersection(lines) for roi in wide if roi.overlaps(lines)]
            sharp = specular_reflections(self.scene, self._occlusion, band.poses[step], number, within, led_rate)
            for part in blurred(sharp, view.blurs.typical, rois, sensor):
                shared = band.share(part.roi)
                if band.knot is None:
                    found.append(part)
                elif shared is not None:
                    inside, share = shared
                    light = part.electrons_per_s[part.roi.slices(inside)] * share
                    found.append(SpecularReflection(part.led_id, inside.row, inside.column, light.astype(np.float32)))
        return found

    def _cover_with_faces(
        self, rooms: Sequence[BackgroundRegion], bands: Sequence[LedBand], steps: range, rates: Sequence[ElectronRates]
    ) -> None:
        """Put the LEDs' faces, which reflect the room's light, before the room; changes its images.

        steps: the numbers of the poses of each band, over which the faces' images are means.
        """
        places = slice(len(self._light.mesh.vertices_m), None)  # the lightmap has the faces after the mesh
        by_leds, other = self._light.led_cd_m2(places), self._light.ambient_cd_m2(places)
        faces = [one.led * by_leds + one.ambient * other for one in rates]
        several = len(bands) > 1
        sharp = [tuple(image.copy() if several else image for image in room.images) for room in rooms]
        for band in bands:
            for i in sorted({i for step in steps for i in band.images[step]}):
                if self.scene.leds.diffusers[i] is not None:
                    continue  # a diffuser is one of the room's surfaces
                of_led = [band.images[step][i] for step in steps if i in band.images[step]]
                led_roi = union_of(of_led)
                covered, lights = np.zeros(led_roi.shape), [np.zeros(led_roi.shape) for _ in faces]
                for led in of_led:
                    inside, coverage = led_roi.slices(led.roi), led.coverage
                    covered[inside] += coverage
                    for light, face in zip(lights, faces, strict=True):
                        light[inside] += face[i] * coverage * led.weight
                for room, before in zip(rooms, sharp, strict=True):
                    shared = band.share(led_roi)
                    if shared is not None and room.roi.overlaps(shared[0]):
                        both = room.roi.intersection(shared[0])
                        here, there = room.roi.slices(both), led_roi.slices(both)
                        share = covered[there] / len(steps)
                        for image, sharp_image, light in zip(room.images, before, lights, strict=True):
                            of_face = light[there] / len(steps)
                            if band.knot is None:
                                image[here] = image[here] * (1 - share) + of_face
                            else:
                                image[here] += band.knot.weights_in(both) * (of_face - share * sharp_image[here])

    def _patches(self, view: LedView, precision: type[np.floating] = np.float32) -> tuple[LedPatch, ...]:
        """Patches of the LEDs: means over the images at several poses, blurred."""
        leds, posed = self.scene.leds, view.posed
        led_rate = self._rates(posed.camera).led
        centers_px = posed.project(leds.centers_m[list(view.patch_rois)]).tolist()
        of_diffusers = self._light_of_diffusers(view, led_rate, precision)
        patches = []
        for (i, roi), (u, v) in zip(view.patch_rois.items(), centers_px, strict=True):
            light: NDArray[np.floating] | None = np.zeros((roi.rows, roi.columns)) if view.rolling else None
            shares: list[tuple[float, float, float]] = []
            for band in view.bands:
                of_led = [of_pose[i] for of_pose in band.images if i in of_pose]
                shared = band.share(roi)
                if not of_led or shared is None:
                    continue
                here = roi if light is None else shared[0]
                of_band = of_diffusers.pop(i, None)
                if of_band is None:
                    of_band = self._light_of(view, i, of_led, len(band.poses), here, led_rate, precision)
                visible, imaged = (
                    sum(getattr(image, name) for image in of_led) / len(band.poses)
                    for name in ("visible_fraction", "imaged_fraction")
                )
                if light is None:
                    light = of_band
                    shares.append((1.0, visible, imaged))
                else:
                    of_band *= shared[1]
                    light[roi.slices(shared[0])] += of_band
                    shares.append((float(of_band.sum()), visible, imaged))
            assert light is not None  # an LED without an image has no patch
            total = sum(share for share, _, _ in shares) or 1.0
            if view.rolling is not None:
                u, v = image_at_own_line(posed, view.rolling.pose_at, leds.centers_m[i])
            patches.append(
                LedPatch(
                    led_id=int(leds.ids[i]),
                    center_px=(u, v),
                    row=roi.row,
                    column=roi.column,
                    electrons_per_s=np.ascontiguousarray(light, dtype=precision),
                    visible_fraction=sum(share * visible for share, visible, _ in shares) / total,
                    imaged_fraction=sum(share * imaged for share, _, imaged in shares) / total,
                )
            )
        return tuple(patches)

    def _light_of_diffusers(
        self, view: LedView, led_rate: float, precision: type[np.floating]
    ) -> dict[int, NDArray[np.floating]]:
        """`_light_of` of the LEDs behind diffusers that are at rest and not blurred, whose kernels run together."""
        images, leds = view.bands[0].images[0], self.scene.leds
        at_rest = view.rolling is None and len(view.bands[0].poses) == 1
        behind = [
            i
            for i, roi in view.patch_rois.items()
            if at_rest and leds.diffusers[i] is not None and view.blurs.kernel(i).whole is None and images[i].roi == roi
        ]
        units = [led_rate * float(leds.luminances_cd_m2[i]) for i in behind]
        return dict(zip(behind, light_of_diffusers([images[i] for i in behind], units, precision), strict=True))

    def _light_of(
        self,
        view: LedView,
        i: int,
        of_led: Sequence[LedImage],
        poses: int,
        roi: Roi,
        led_rate: float,
        precision: type[np.floating],
    ) -> NDArray[np.floating]:
        """Light of LED number i in a region: the mean over its images at this number of poses, blurred."""
        luminance, kernel = self.scene.leds.luminances_cd_m2[i], view.blurs.kernel(i)
        union = union_of(of_led)
        if poses == 1 and kernel.whole is None and union == roi:
            return of_led[0].light(led_rate * luminance, precision)
        light = np.zeros((union.rows, union.columns))
        for image in of_led:
            light[union.slices(image.roi)] += image.light(led_rate * luminance)
        edges = [image.edges for image in of_led if image.edges is not None]
        light_per_excess = led_rate * float(luminance) / poses
        result = kernel.blurred(light / poses, union, edges, light_per_excess)
        return cut(result, union.padded(kernel.radius_px), roi)


def _check_size(rois: Sequence[Roi], camera: Camera) -> None:
    """Raise InputError where regions hold too many pixels."""
    pixels, allowed = sum(roi.pixels for roi in rois), MAX_SENSORS * Roi.of_sensor(camera).pixels
    if pixels > allowed:
        raise InputError(
            f"regions: overscan makes LED regions of {pixels} pixels; at most {allowed}, {MAX_SENSORS} times the "
            "sensor's, are allowed: lower margin_px, or remove overscan"
        )


def check_inside(scene: Scene, pose: Pose) -> None:
    """Raise InputError where the camera is not inside the room."""
    if not all(0 < p < limit for p, limit in zip(pose.position_m, scene.room_m, strict=True)):
        raise InputError(
            f"camera position {list(pose.position_m)} m is not inside the room of {scene.room_m.tolist()} m"
        )
