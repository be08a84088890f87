"""Images of the LEDs at one pose, before the lens blurs them.

Each LED has a region with its exact pixel coverage (`led_coverage`), less the occluded share of each pixel
(`occlusion`), and its luminance in each pixel. The image of an LED behind a diffuser is the part of the diffuser that
it lights.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import LedRegions, Roi
from vlcrender.core.backend import dr, exact_math
from vlcrender.core.planar_shapes import Disc, Rectangle
from vlcrender.rendering.diffuser_light import light_of_diffuser
from vlcrender.rendering.led_blur import LedBlur
from vlcrender.rendering.led_coverage import (
    LedCoverage,
    LedFace,
    coverage_of_led,
    intersections_with_plane,
    outline_roi,
)
from vlcrender.rendering.led_edges import LedEdges, edges_of_led
from vlcrender.rendering.occlusion import LitRegion, Occlusion
from vlcrender.rendering.seen_pixels import SeenPixels
from vlcrender.scene.diffuser import Diffuser
from vlcrender.scene.leds import Leds

OVERSCAN_DEG = 75.0
"""Angle off the optical axis, across or down, up to which regions may extend beyond the sensor."""
GAUSS_PX = 0.5 / np.sqrt(3.0)
"""Nodes of Gauss and Legendre's rule of two points, from the pixel's centre."""
MAX_UNIFORM_SHARE = 0.02
"""A pixel on a diffuser no wider than this share of the LED's distance behind it has its luminance at the centre, with
an error of 2 (m + 3) * 0.02^2 / 24: 3e-4 for a Lambertian order m of 5."""
GRID_POINTS = 17
"""Points across and down a region at which the width of a pixel on a diffuser is computed."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LedImage:
    """Image of one LED at one pose, before blur.

    `clear` is the share of what the face covers of a pixel that nothing occludes. `edges`, for narrow blurs, are the
    parts of edge pixels times weight and luminance; the occluded share of a pixel is the same in all its parts. Arrays
    of pixels are made when they are asked for: those of diffusers are as large as the sensor, and many.
    """

    leds: Leds
    index: int
    posed: PosedCamera
    face: LedCoverage
    clear: Array | float
    visible_fraction: float
    imaged_fraction: float
    edges: LedEdges | None
    seen: SeenPixels | None = None
    """What its pixels see, where that is known."""

    @property
    def roi(self) -> Roi:
        """The pixels of the image."""
        return self.face.roi

    @property
    def coverage(self) -> Array:
        """Share of each pixel that the LED covers and nothing occludes."""
        return self.face.coverage if isinstance(self.clear, float) else self.face.coverage * self.clear

    @property
    def weight(self) -> Array:
        """Relative illumination of each pixel."""
        seen = self.seen or SeenPixels(self.posed, self.roi)
        return seen.weight(self.roi)

    @property
    def beam(self) -> Array | float:
        """Luminance in each pixel over that along the normal, by direction."""
        diffuse = self.leds.diffusers[self.index] is not None
        return 1.0 if diffuse else luminance_pattern(self.leds, self.index, self.posed, self.roi)

    @property
    def full(self) -> Array:
        """Light of a pixel that the face covers whole, over that of the LED's luminance and its profile."""
        full: Array = self.clear * self.weight * self.beam
        return full

    def on_plane(self, origin_m: Array, du: float = 0.0, dv: float = 0.0) -> tuple[Array, Array]:
        """The points of the LED's plane that pixels see at (du, dv) from their centres, m from a point of it."""
        if self.seen is not None:
            return self.seen.on_plane(self.roi, origin_m, du, dv)
        u, v = self.roi.centers_px()
        return intersections_with_plane(self.posed, origin_m, u + du, v + dv)

    def within(self, roi: Roi, seen: SeenPixels) -> "LedImage":
        """The part of the image in a region, whose pixels are among those of `seen`."""
        return replace(
            self,
            seen=seen,
            face=self.face.within(roi),
            clear=self.clear if isinstance(self.clear, float) else self.clear[self.roi.slices(roi)],
            edges=self.edges and self.edges.within(roi),
        )

    def light(self, unit: float, precision: type[np.floating] = np.float64) -> NDArray[np.floating]:
        """Light of each pixel, (rows, columns): `unit` in one that the LED fills at its mean luminance on the axis."""
        if self.leds.diffusers[self.index] is not None:
            return next(light_of_diffusers([self], [unit], precision))
        coverage, weight, profile = self.coverage, self.weight, self.face.profile
        pattern = _pattern(self.leds, self.index, self.posed, self.roi)
        u, v = self.roi.centers_px()
        light = np.empty(self.roi.shape, dtype=precision)
        for band in self.roi.bands():
            luminance = 1.0 if pattern is None else pattern(u, v[band])
            luminance = luminance * (profile if isinstance(profile, float) else profile[band])
            light[band] = unit * coverage[band] * weight[band] * luminance
        return light


def light_of_part(image: LedImage, diffuser: Diffuser, unit: float) -> Array:
    """`LedImage.light` of a part of an LED's image behind a diffuser: a kernel's launch takes longer."""
    height_m = float(image.leds.centers_m[image.index, 2])
    foot_m = np.array([0.0, 0.0, height_m])
    nodes = _pixel_nodes(image.posed, image.roi, height_m, diffuser)
    total: Array = sum((diffuser.at(*image.on_plane(foot_m, du, dv)) for du, dv in nodes), np.zeros(()))
    light: Array = unit * image.coverage * image.weight * (total / len(nodes))
    return light


def light_of_diffusers(
    images: Sequence[LedImage], units: Sequence[float], precision: type[np.floating]
) -> Iterator[NDArray[np.floating]]:
    """`LedImage.light` of LEDs behind diffusers; all kernels run together."""
    of_whole = []
    for image, unit in zip(images, units, strict=True):
        diffuser, height_m = image.leds.diffusers[image.index], float(image.leds.centers_m[image.index, 2])
        assert diffuser is not None
        nodes = _pixel_nodes(image.posed, image.roi, height_m, diffuser)
        of_whole.append(light_of_diffuser(image.posed, diffuser, height_m, nodes, unit, precision, image.roi))
    with exact_math():
        dr.eval(of_whole)
    for image, light in zip(images, of_whole, strict=True):
        pixels: NDArray[np.floating] = light.numpy().reshape(image.roi.shape)
        image.face.reduce(pixels)
        if not isinstance(image.clear, float):
            pixels *= image.clear
        yield pixels


def led_images(
    leds: Leds,
    occlusion: Occlusion,
    posed: PosedCamera,
    regions: LedRegions | None,
    blurs: LedBlur,
    within: Roi | None = None,
    at_rest: bool = True,
) -> dict[int, LedImage]:
    """By index, the image of each LED that lights a pixel of the regions or, by its blur, may light one.

    within: LEDs whose image is outside this region are left out. at_rest: whether these are the only images of the
    view, so that what the pixels of a bare LED see is held for all that asks for it.
    """
    camera = posed.camera
    overscan = regions is not None and regions.overscan
    margin_px = _overscan_px(camera) if overscan else blurs.radius_px
    imaged = []
    for i in leds.spheres.candidates(posed, margin_px, within).tolist():
        if within is not None:
            outline = outline_roi(posed, face_of_led(leds, i))
            if outline is None or not outline.overlaps(within):
                continue
        image = coverage_of_led(posed, face_of_led(leds, i), margin_px)
        if image is None:
            continue
        if overscan and not Roi.of_sensor(camera).padded(margin_px - 1).contains(image.roi):
            continue  # an LED cut by the border of the overscan is left out
        imaged.append((i, image))
    clear: Sequence[Array | float] = [1.0] * len(imaged)
    if occlusion.possible:
        lit = [LitRegion(float(occlusion.heights_m[i]), image.roi, image.coverage > 0) for i, image in imaged]
        clear = occlusion.clear_shares(posed, lit)
    images = {}
    for (i, image), share in zip(imaged, clear, strict=True):
        clear_fraction = 1.0
        split = blurs.kernel(i).split
        edges = edges_of_led(posed, face_of_led(leds, i), image, split) if split > 1 else None
        if not isinstance(share, float):
            clear_fraction = float((image.coverage * share).sum() / image.coverage.sum())
            edges = edges and edges.times(share, image.roi)
        if clear_fraction > 0:
            seen = SeenPixels(posed, image.roi)
            if edges is not None:
                pattern = luminance_pattern(leds, i, posed, image.roi)
                edges = edges.times(seen.weight(image.roi) * pattern, image.roi)
            images[i] = LedImage(
                leds=leds,
                index=i,
                posed=posed,
                face=image,
                clear=share,
                visible_fraction=clear_fraction * image.visible_fraction,
                imaged_fraction=clear_fraction * (1.0 if overscan else image.visible_fraction),
                edges=edges,
                seen=seen if at_rest and leds.diffusers[i] is None else None,
            )
    return images


def face_of_led(leds: Leds, i: int) -> LedFace:
    """The luminous face: the LED's own, or the part of a diffuser that it lights."""
    diffuser, radius = leds.diffusers[i], float(leds.half_widths_m[i])
    if diffuser is not None:
        x0, y0, x1, y1 = diffuser.lit_m
        center: Array = np.array([(x0 + x1) / 2, (y0 + y1) / 2, leds.centers_m[i, 2]])
        return LedFace(center, Rectangle((x1 - x0, y1 - y0)))
    shape = Rectangle((2 * radius, 2 * radius)) if leds.squares[i] else Disc(radius)
    return LedFace(leds.centers_m[i], shape, leds.profile(i))


def luminance_pattern(leds: Leds, i: int, posed: PosedCamera, roi: Roi) -> Array | float:
    """Luminance in each pixel of a region over the mean luminance of the bare LED along its normal.

    Bare LED: cos^(m - 1), as if its face were even (`LedCoverage.profile` is the face's profile). Diffuser: the mean
    over the pixel, of 2 x 2 points (Gauss and Legendre) where the pixel is wider on the diffuser than MAX_UNIFORM_SHARE
    of the LED's distance behind it.
    """
    pattern = _pattern(leds, i, posed, roi)
    return 1.0 if pattern is None else _in_bands(roi, pattern)


def _pattern(leds: Leds, i: int, posed: PosedCamera, roi: Roi) -> Callable[[Array, Array], Array] | None:
    """`luminance_pattern` as a function of pixel centres u and v in the region; None for 1 in all pixels."""
    diffuser, order = leds.diffusers[i], float(leds.orders[i])
    if diffuser is not None:
        height_m = float(leds.centers_m[i, 2])
        on_diffuser = partial(intersections_with_plane, posed, np.array([0.0, 0.0, height_m]))
        nodes = _pixel_nodes(posed, roi, height_m, diffuser)

        def mean(u: Array, v: Array) -> Array:
            total: Array = sum((diffuser.at(*on_diffuser(u + a, v + b)) for a, b in nodes), np.zeros(()))
            return total / len(nodes)

        return mean
    return None if abs(order - 1.0) < 1e-12 else partial(beam, posed, order)


def beam(posed: PosedCamera, order: float, u: Array, v: Array) -> Array:
    """Luminance towards pixel positions over that along the normal, of an LED of this Lambertian order: cos^(m-1)."""
    x, y, z = posed.ray_world(u, v)
    cosine = np.maximum(z / np.sqrt(x * x + y * y + z * z), 0.0)
    luminance: Array = cosine ** (order - 1.0)
    return luminance


def _pixel_nodes(posed: PosedCamera, roi: Roi, height_m: float, diffuser: Diffuser) -> list[tuple[float, float]]:
    """Positions in a pixel, from its centre, whose mean is that over the pixel of a diffuser's luminance."""
    on_plane = partial(intersections_with_plane, posed, np.array([0.0, 0.0, height_m]))
    if _max_pixel_width_m(roi, on_plane) < MAX_UNIFORM_SHARE * diffuser.distance_m:
        return [(0.0, 0.0)]
    return list(itertools.product((-GAUSS_PX, GAUSS_PX), repeat=2))


def _max_pixel_width_m(roi: Roi, on_plane: Callable[[Array, Array], tuple[Array, Array]]) -> float:
    """Greatest extent along x or y of a pixel on a plane, on a grid of the region, since it varies slowly."""
    u = np.linspace(roi.column + 0.5, roi.end_column - 0.5, GRID_POINTS)[None, :]
    v = np.linspace(roi.row + 0.5, roi.end_row - 0.5, GRID_POINTS)[:, None]
    sides = (on_plane(u - 0.5, v), on_plane(u + 0.5, v)), (on_plane(u, v - 0.5), on_plane(u, v + 0.5))
    return max(float(np.abs(b - a).max()) for before, after in sides for a, b in zip(before, after, strict=True))


def _in_bands(roi: Roi, function: Callable[[Array, Array], Array]) -> Array:
    """A function of the pixel centres u (1, columns) and v (rows, 1), (rows, columns), by bands."""
    u, v = roi.centers_px()
    image = np.empty((roi.rows, roi.columns))
    for band in roi.bands():
        image[band] = function(u, v[band])
    return image


def _overscan_px(camera: Camera) -> int:
    """Pixels beyond the sensor up to which regions may extend."""
    return int(np.ceil(np.tan(np.radians(OVERSCAN_DEG)) * camera.focal_px))
