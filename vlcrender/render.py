"""The expected image of a view: electrons a second in every pixel, without noise.

The room behind comes from `background`. LEDs lie on top, each a window with its exact pixel coverage (`led_image`). An
LED's face hides what is behind it and reflects the room's light: that is part of the background; its own light is a
patch of its own, so that image = background + sum over LEDs of gain * patch, for any exposure and modulation. An LED
seen by way of a window pane is a patch too: the image that the camera's mirror image has of it. At last the lens
spreads each of them by what it does at their depth.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.backend import dr, exact_math, mi
from vlcrender.background import Background, sub_pixels
from vlcrender.camera import Camera, Pose, project, rays_world
from vlcrender.errors import InputError
from vlcrender.irradiance import Light, bake
from vlcrender.led_image import image_of_led, leds_that_may_be_seen
from vlcrender.led_shape import Disc, Rectangle
from vlcrender.lens import blur, blur_kernel, relative_illumination
from vlcrender.photometry import Detector, Silicon, electron_rate_per_cd_m2
from vlcrender.raycast import pane_reflectance
from vlcrender.scene import Pane, Scene
from vlcrender.view import Image, LedPatch, Reflection, View, ViewPart
from vlcrender.windows import LedWindows, Window, led_windows

OVERSCAN_DEG = 75.0
"""How far off the optical axis, across or down, windows may lie that reach beyond the sensor."""
MOST_PIXELS = 16
"""How many times the sensor's pixels windows may hold."""
SAME_PLACE = 1e-4
"""Relative difference of two distances that are the same but for float32."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MirroredPose(Pose):
    """The camera's mirror image in a pane: what it sees directly is what the camera sees by way of the pane."""

    mirror: tuple[tuple[float, ...], ...] = ()

    @property
    def rotation(self) -> Array:
        """R_cam_world after the mirror: it takes the mirrored world to the camera."""
        product: Array = super().rotation @ np.array(self.mirror)
        return product


@dataclass(frozen=True)
class _Lit:
    """An LED's image at one pose: coverage, and what its luminance is worth in each pixel of the window."""

    window: Window
    coverage: Array
    weight: Array
    visible_fraction: float
    imaged_fraction: float


class Renderer:
    """Renders views of one scene."""

    def __init__(self, scene: Scene, light: Light | None = None, detector: Detector | None = None) -> None:
        """Prepare a scene. `light` is its bake, made or taken from the cache where not given; `detector`, silicon."""
        self.scene = scene
        self.detector = detector or Silicon()
        self._light = light or bake(scene)
        self._background = Background(scene, self._light)
        self._shapes = [
            Rectangle((2 * float(r), 2 * float(r))) if square else Disc(float(r))
            for r, square in zip(scene.leds.radii_m, scene.leds.squares, strict=True)
        ]
        undersides_m = [grid.first_center_m[2] for grid in scene.settings.panels]
        # What may stand between camera and LED: furniture, and panels that hang lower than an LED.
        self._may_hide = bool(scene.settings.furniture) or min(undersides_m, default=np.inf) < scene.leds.centers_m[
            :, 2
        ].max() * (1 - SAME_PLACE)

    def view(
        self, camera: Camera, pose: Pose, windows: LedWindows | None = None, during: Sequence[Pose] | None = None
    ) -> View:
        """Render one view, of the whole sensor or of windows alone, which costs the windows alone.

        Of a camera that moves, `during` are poses spread evenly over the exposure, whose mean is the view, and `pose`
        is the one that LEDs' centres are given for. Raises InputError where the camera is not inside the room or the
        windows hold more than MOST_PIXELS times the sensor's.
        """
        places = (pose,) if during is None else tuple(during)
        for place in places:
            check_inside(self.scene, place)
        kernels = self._kernels(camera, pose)
        spread = _spread(kernels)
        images = [dict(self._led_images(camera, place, windows, spread)) for place in places]
        lit = _lit_windows(camera, images, kernels, windows)
        frames = (Window.of_sensor(camera),) if windows is None else led_windows(lit.values(), camera, windows)
        _check_size(frames, camera)
        backgrounds, reflections = self._rooms(camera, places, frames, images, spread, kernels)
        patches = self._patches(camera, pose, images, lit, kernels)
        return View(
            tuple(
                ViewPart(
                    frame,
                    background,
                    tuple(p for p in patches if frame.holds(p.window)),
                    tuple(r for r in reflections if frame.holds(r.window)),
                )
                for frame, background in zip(frames, backgrounds, strict=True)
            )
        )

    def led_patches(
        self, camera: Camera, pose: Pose, windows: LedWindows | None = None, blurred_at: Pose | None = None
    ) -> tuple[LedPatch, ...]:
        """The LEDs' own light alone: the patches of `view` in double precision, without the room behind them.

        Blurred as at the pose `blurred_at` where given: kernels change in steps of depth, which differences would see.
        """
        kernels = self._kernels(camera, blurred_at or pose)
        images = [dict(self._led_images(camera, pose, windows, _spread(kernels)))]
        return self._patches(camera, pose, images, _lit_windows(camera, images, kernels, windows), kernels, np.float64)

    def background_cd_m2(self, camera: Camera, pose: Pose) -> Image:
        """Luminance of the room times relative illumination, mean over each pixel, (height, width); sharp, no LEDs."""
        images, _ = self._background.images(camera, pose, (Window.of_sensor(camera),), (1.0, 1.0))
        return images[0]

    def _rates(self, camera: Camera) -> tuple[float, float]:
        """Electrons a second of 1 cd/m2 on the axis: of light that left an LED, and of all other light."""
        settings = self.scene.settings
        lamp, other = (
            electron_rate_per_cd_m2(camera, spectrum, self.detector)
            for spectrum in (settings.led_spectrum, settings.ambient.spectrum)
        )
        return lamp, other

    def _kernels(self, camera: Camera, pose: Pose) -> dict[int, Array | None]:
        """By LED, what the lens makes of a point at its depth. One for all depths that differ by less than a part."""
        leds = self.scene.leds
        towards_m = leds.centers_m - np.array(pose.position_m)
        # A fish-eye has no plane of focus: its depth is the distance.
        fish_eye = camera.projection == "equidistant"
        depths = np.linalg.norm(towards_m, axis=1) if fish_eye else _along(towards_m, pose.rotation[2])
        candidates = leds_that_may_be_seen(camera, pose, self.scene.leds.centers_m, leds.reaches_m, BLUR_MARGIN_PX)
        if camera.focus_distance_m is None and camera.psf == "none":
            return dict.fromkeys(range(len(depths)))
        near = np.maximum(depths, 0.05)
        kernels: dict[int, Array | None] = dict.fromkeys(range(len(depths)))
        made: dict[float, Array | None] = {}
        for i in candidates:
            depth = float(np.exp(np.round(np.log(near[i]) / DEPTH_STEP) * DEPTH_STEP))
            if depth not in made:
                made[depth] = blur_kernel(camera, depth)
            kernels[int(i)] = made[depth]
        return kernels

    def _rooms(
        self,
        camera: Camera,
        places: Sequence[Pose],
        frames: Sequence[Window],
        images: Sequence[Mapping[int, _Lit]],
        spread: int,
        kernels: Mapping[int, Array | None],
    ) -> tuple[list[Image], list[Reflection]]:
        """The windows without the LEDs' own light, and its reflections: means over the places, blurred."""
        sensor = Window.of_sensor(camera)
        wide = [f.grown(spread).common(sensor) if sensor.holds(f) else f.grown(spread) for f in frames]
        rates = self._rates(camera)
        totals: list[Image] | None = None
        reflections: list[Reflection] = []
        for place, seen in zip(places, images, strict=True):
            backgrounds, surfaces = self._background.images(camera, place, wide, rates)
            self._hide_behind_leds(wide, backgrounds, seen, rates)
            totals = backgrounds if totals is None else [t + b for t, b in zip(totals, backgrounds, strict=True)]
            for number, pane in enumerate(self.scene.panes):
                label = self._background.room.first_pane + number
                shown = [s == label for s in surfaces]
                if any(s.any() for s in shown):
                    reflections += self._reflections(camera, place, pane, wide, shown, rates[0] / len(places))
        assert totals is not None  # there is at least one place
        kernel = _typical(kernels)
        means = []
        for total, window, frame in zip(totals, wide, frames, strict=True):
            mean = total if len(places) == 1 else total / np.float32(len(places))
            means.append(np.ascontiguousarray(blur(mean, kernel, "edge")[window.slices(frame)]))
        blurred = [_blurred(reflection, kernel, sensor) for reflection in reflections]
        return means, [cut for r in blurred if r is not None for cut in _cut(r, frames)]

    def _hide_behind_leds(
        self, frames: Sequence[Window], backgrounds: list[Image], images: Mapping[int, _Lit], rates: tuple[float, float]
    ) -> None:
        """LED faces cover what is behind them and reflect the room's light; changes the backgrounds."""
        corners = len(self._light.mesh.vertices_m)
        faces = rates[0] * self._light.led_cd_m2()[corners:] + rates[1] * self._light.surround_cd_m2()[corners:]
        for i, image in images.items():
            for frame, background in zip(frames, backgrounds, strict=True):
                if frame.overlaps(image.window):
                    both = frame.common(image.window)
                    here, there = frame.slices(both), image.window.slices(both)
                    coverage = image.coverage[there]
                    hidden = background[here] * (1 - coverage)
                    background[here] = hidden + faces[i] * coverage * image.weight[there]

    def _patches(
        self,
        camera: Camera,
        pose: Pose,
        images: Sequence[Mapping[int, _Lit]],
        lit: Mapping[int, Window],
        kernels: Mapping[int, Array | None],
        precision: type[np.floating] = np.float32,
    ) -> tuple[LedPatch, ...]:
        """The LEDs' own light, the mean over the images at several poses."""
        leds = self.scene.leds
        lamp, _ = self._rates(camera)
        center_px, _ = project(camera, pose, leds.centers_m)
        around = _around(images)
        patches = []
        for i, window in lit.items():
            light = np.zeros((around[i].rows, around[i].columns))
            seen = [of_pose[i] for of_pose in images if i in of_pose]
            for image in seen:
                light[around[i].slices(image.window)] += (
                    lamp
                    * leds.luminances_cd_m2[i]
                    * image.coverage
                    * image.weight
                    * self._pattern(camera, pose, i, image)
                )
            spread = blur(light / len(images), kernels[i])[around[i].grown(_radius(kernels[i])).slices(window)]
            patches.append(
                LedPatch(
                    led_id=int(leds.ids[i]),
                    center_px=(float(center_px[i, 0]), float(center_px[i, 1])),
                    row=window.row,
                    column=window.column,
                    electrons_per_s=np.ascontiguousarray(spread, dtype=precision),
                    visible_fraction=sum(image.visible_fraction for image in seen) / len(images),
                    imaged_fraction=sum(image.imaged_fraction for image in seen) / len(images),
                )
            )
        return tuple(patches)

    def _pattern(self, camera: Camera, pose: Pose, i: int, image: _Lit) -> Array | float:
        """Luminance over that along the normal, cos^(m - 1), in each pixel of the window."""
        order = float(self.scene.leds.orders[i])
        if abs(order - 1.0) < 1e-12:
            return 1.0
        rays = rays_world(camera, pose, _centers(image.window))
        cosine = np.maximum(rays[..., 2] / np.sqrt((rays**2).sum(axis=-1)), 0.0)
        pattern: Array = cosine ** (order - 1.0)
        return pattern

    def _led_images(
        self, camera: Camera, pose: Pose, windows: LedWindows | None, spread: int
    ) -> Iterator[tuple[int, _Lit]]:
        """Index and image of each LED that lights a pixel of the view, or by blur may."""
        leds = self.scene.leds
        overscan = windows is not None and windows.overscan
        reach = _overscan_px(camera) if overscan else spread
        for i in leds_that_may_be_seen(camera, pose, leds.centers_m, leds.reaches_m, reach):
            image = image_of_led(camera, pose, leds.centers_m[i], self._shapes[i], reach)
            if image is None:
                continue
            window = Window(image.row, image.column, *image.coverage.shape)
            if overscan and not _inside(window, camera, reach):
                continue  # an LED cut by the widest overscan is left out
            coverage = image.coverage
            seen = 1.0
            if self._may_hide:
                clear = self._clear_share(camera, pose, float(leds.centers_m[i, 2]), window, coverage > 0)
                seen = float((coverage * clear).sum() / coverage.sum())
                coverage = coverage * clear
            if seen > 0:
                imaged = 1.0 if overscan else image.visible_fraction
                weight = relative_illumination(camera, *np.moveaxis(_centers(window), -1, 0))
                yield int(i), _Lit(window, coverage, weight, seen * image.visible_fraction, seen * imaged)

    def _clear_share(
        self, camera: Camera, pose: Pose, height_m: float, window: Window, lit: NDArray[np.bool_]
    ) -> Array:
        """Share of each lit pixel from which nothing hides the plane of an LED at this height, (rows, columns)."""
        rows, columns = np.nonzero(lit)
        clear = np.ones(lit.shape)
        with exact_math():
            u, v = (
                mi.Float((columns + window.column + 0.5).astype(np.float32)),
                mi.Float((rows + window.row + 0.5).astype(np.float32)),
            )
            reached = self._reaches(camera, pose, height_m, u, v)
            clear[rows, columns] = reached
            if 0 < reached.sum() < len(reached):  # an edge crosses the LED
                u, v = sub_pixels(rows + window.row, columns + window.column)
                clear[rows, columns] = self._reaches(camera, pose, height_m, u, v).reshape(len(rows), -1).mean(axis=1)
        return clear

    def _reaches(self, camera: Camera, pose: Pose, height_m: float, u: "mi.Float", v: "mi.Float") -> Array:
        """1 where the ray of a pixel position gets to this height, 0 where something is in its way."""
        hit = self._background.look(camera, pose, u, v)
        pixels = np.stack([u.numpy(), v.numpy()], axis=-1).astype(np.float64)
        rays = rays_world(camera, pose, pixels)
        to_plane = (height_m - pose.position_m[2]) / rays[:, 2] * np.sqrt((rays**2).sum(axis=1))
        dr.eval(hit.distance_m)
        reached: Array = (hit.distance_m.numpy() > to_plane * (1 - SAME_PLACE)).astype(np.float64)
        return reached

    def _reflections(
        self,
        camera: Camera,
        pose: Pose,
        pane: Pane,
        frames: Sequence[Window],
        shown: Sequence[NDArray[np.bool_]],
        lamp: float,
    ) -> list[Reflection]:
        """LEDs in a pane. `shown` says in which pixels of each window the pane is seen."""
        leds = self.scene.leds
        normal = np.cross(pane.edge_u_m, pane.edge_v_m)
        normal = normal / np.linalg.norm(normal)
        mirror = np.eye(3) - 2 * np.outer(normal, normal)
        behind = np.array(pose.position_m) - 2 * float(normal @ (np.array(pose.position_m) - pane.corner_m)) * normal
        mirrored = MirroredPose(
            (float(behind[0]), float(behind[1]), float(behind[2])),
            pose.tilt_x_deg,
            pose.tilt_y_deg,
            pose.yaw_deg,
            tuple(map(tuple, mirror.tolist())),
        )
        found = []
        for i in leds_that_may_be_seen(camera, mirrored, leds.centers_m, leds.reaches_m):
            image = image_of_led(camera, mirrored, leds.centers_m[i], self._shapes[i])
            if image is None:
                continue
            window = Window(image.row, image.column, *image.coverage.shape)
            centers = _centers(window)
            rays = rays_world(camera, mirrored, centers)
            cosine = np.abs(_along(rays, normal)) / np.sqrt((rays**2).sum(axis=-1))
            weight = relative_illumination(camera, centers[..., 0], centers[..., 1])
            weight = weight * pane_reflectance(cosine, pane.refractive_index, np.sqrt)
            lit = _Lit(window, image.coverage, weight, 1.0, 1.0)
            light = (
                lamp * leds.luminances_cd_m2[i] * image.coverage * weight * self._pattern(camera, mirrored, int(i), lit)
            )
            for frame, inside in zip(frames, shown, strict=True):
                if frame.overlaps(window):
                    both = frame.common(window)
                    part = light[window.slices(both)] * inside[frame.slices(both)]
                    if part.any():
                        found.append(Reflection(int(leds.ids[i]), both.row, both.column, part.astype(np.float32)))
        return found


BLUR_MARGIN_PX = 500
"""How far beside the sensor LEDs may be whose blur reaches it."""
DEPTH_STEP = 0.005
"""Depths that differ by less than this part share a kernel: 0.2 px of a defocus disc of 35."""


def _along(vectors: Array, direction: Array) -> Array:
    """Dot products of vectors (..., 3) with one direction; written out as `camera.transform` is."""
    product: Array = vectors[..., 0] * direction[0] + vectors[..., 1] * direction[1] + vectors[..., 2] * direction[2]
    return product


def _centers(window: Window) -> Array:
    """(u, v) of a window's pixel centres, (rows, columns, 2)."""
    u = np.arange(window.column, window.end_column) + 0.5
    v = np.arange(window.row, window.end_row) + 0.5
    return np.stack(np.meshgrid(u, v), axis=-1)


def _around(images: Sequence[Mapping[int, _Lit]]) -> dict[int, Window]:
    """Around all that each LED lights, by the LED's index."""
    lit: dict[int, Window] = {}
    for of_pose in images:
        for i, image in of_pose.items():
            lit[i] = lit[i].around(image.window) if i in lit else image.window
    return dict(sorted(lit.items()))


def _lit_windows(
    camera: Camera,
    images: Sequence[Mapping[int, _Lit]],
    kernels: Mapping[int, Array | None],
    windows: LedWindows | None,
) -> dict[int, Window]:
    """The pixels of the view that each LED lights, blur included, by the LED's index."""
    lit = {i: window.grown(_radius(kernels[i])) for i, window in _around(images).items()}
    if windows is not None and windows.overscan:
        return lit
    sensor = Window.of_sensor(camera)
    return {i: window.common(sensor) for i, window in lit.items() if sensor.overlaps(window)}


def _spread(kernels: Mapping[int, Array | None]) -> int:
    """How far light is blurred at most, pixels."""
    return max(map(_radius, kernels.values()), default=0)


def _radius(kernel: Array | None) -> int:
    return 0 if kernel is None else kernel.shape[0] // 2


def _typical(kernels: Mapping[int, Array | None]) -> Array | None:
    """The kernel of median size: the room behind is blurred as at the LEDs' usual depth."""
    made = sorted((k for k in kernels.values() if k is not None), key=lambda k: k.shape[0])
    return made[len(made) // 2] if made else None


def _blurred(reflection: Reflection, kernel: Array | None, sensor: Window) -> Reflection | None:
    window = reflection.window.grown(_radius(kernel))
    if not sensor.overlaps(window):
        return None
    both = sensor.common(window)
    light = blur(reflection.electrons_per_s, kernel)[window.slices(both)]
    return Reflection(reflection.led_id, both.row, both.column, light)


def _cut(reflection: Reflection, frames: Sequence[Window]) -> Iterator[Reflection]:
    """The parts of a reflection in each of the windows."""
    for frame in frames:
        if frame.overlaps(reflection.window):
            both = frame.common(reflection.window)
            light = reflection.electrons_per_s[reflection.window.slices(both)]
            yield Reflection(reflection.led_id, both.row, both.column, light)


def _check_size(frames: Sequence[Window], camera: Camera) -> None:
    """Raise InputError where windows hold too many pixels."""
    pixels, most = sum(frame.pixels for frame in frames), MOST_PIXELS * Window.of_sensor(camera).pixels
    if pixels > most:
        raise InputError(
            f"windows: overscan makes {pixels} pixels of LED windows; at most {most}, {MOST_PIXELS} times the "
            "sensor's, are allowed: lower margin_px, or leave overscan out"
        )


def _overscan_px(camera: Camera) -> int:
    """How far beyond the sensor windows may lie."""
    return int(np.ceil(np.tan(np.radians(OVERSCAN_DEG)) * camera.focal_px))


def _inside(window: Window, camera: Camera, reach: int) -> bool:
    return Window.of_sensor(camera).grown(reach - 1).holds(window)


def share_cores(workers: int) -> None:
    """Keep Dr.Jit in this process to its share of the cores: its idle threads wait busily, and take from others."""
    dr.set_thread_count(max(1, (os.cpu_count() or 1) // workers))


def check_inside(scene: Scene, pose: Pose) -> None:
    """Raise InputError where the camera is not inside the room."""
    if not all(0 < p < limit for p, limit in zip(pose.position_m, scene.room_m, strict=True)):
        raise InputError(
            f"camera position {list(pose.position_m)} m is not inside the room of {scene.room_m.tolist()} m"
        )
