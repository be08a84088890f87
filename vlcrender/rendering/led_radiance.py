"""The light of LEDs in a view's pixels at one pose, before the lens blurs it.

Each LED has a window with its exact pixel coverage (`led_image`), less what hides it (`obstacles`). Of an LED behind a
diffuser it is what it lights of the sheet.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose, ray_world
from vlcrender.camera.lens import relative_illumination
from vlcrender.camera.roi import LedRegions, Roi
from vlcrender.core.planar_shapes import Disc, Rectangle
from vlcrender.rendering.led_blur import LedBlur
from vlcrender.rendering.led_coverage import coverage_of_led, leds_that_may_be_seen, places_on_plane
from vlcrender.rendering.led_edges import LedEdges, edges_of_led
from vlcrender.rendering.occlusion import Occlusion
from vlcrender.scene.leds import Leds

OVERSCAN_DEG = 75.0
"""How far off the optical axis, across or down, windows may lie that reach beyond the sensor."""
GAUSS_PX = 0.5 / np.sqrt(3.0)
FINE = 0.02
"""Of a pixel that sees less the middle is the mean, to 2 (m + 3) * 0.02^2 / 24: 3e-4 for an order m of 5."""
GRID_POINTS = 17
"""Across a window and down, where it is asked how much a pixel sees."""
PIXELS_AT_ONCE = 50_000

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LedImage:
    """An LED's image at one pose: coverage, and what a luminance is worth in each pixel of the window.

    `pattern` is the luminance in each pixel over the LED's own along its normal. `edges` is there where a narrow blur
    needs parts of pixels, times weight and pattern; what hides a pixel in part hides its parts alike.
    """

    roi: Roi
    coverage: Array
    weight: Array
    pattern: Array | float
    visible_fraction: float
    imaged_fraction: float
    edges: LedEdges | None


def led_images(
    leds: Leds, occlusion: Occlusion, camera: Camera, pose: Pose, regions: LedRegions | None, blurs: LedBlur
) -> dict[int, LedImage]:
    """By index, each LED that lights a pixel of the view, or by its blur may."""
    overscan = regions is not None and regions.overscan
    reach = _overscan_px(camera) if overscan else blurs.spread_px
    images = []
    for i in leds_that_may_be_seen(camera, pose, leds.centers_m, leds.reaches_m, reach).tolist():
        image = coverage_of_led(camera, pose, *face_of_led(leds, i), reach)
        if image is None:
            continue
        roi = Roi(image.row, image.column, *image.coverage.shape)
        if overscan and not Roi.of_sensor(camera).padded(reach - 1).contains(roi):
            continue  # an LED cut by the widest overscan is left out
        images.append((i, roi, image))
    clear: Sequence[Array | float] = [1.0] * len(images)
    if occlusion.there_are_some:
        asked = [(float(leds.centers_m[i, 2]), roi, image.coverage > 0) for i, roi, image in images]
        clear = occlusion.clear_shares(camera, pose, asked)
    lights = {}
    for (i, roi, image), share in zip(images, clear, strict=True):
        coverage, seen = image.coverage, 1.0
        split = blurs.split(i)
        edges = edges_of_led(camera, pose, *face_of_led(leds, i), image, split) if split > 1 else None
        if not isinstance(share, float):
            coverage = image.coverage * share
            seen = float(coverage.sum() / image.coverage.sum())
            edges = edges and edges.times(share, roi)
        if seen > 0:
            imaged = 1.0 if overscan else image.visible_fraction
            weight = _in_bands(roi, partial(relative_illumination, camera))
            pattern = luminance_pattern(leds, i, camera, pose, roi)
            edges = edges and edges.times(weight * pattern, roi)
            lights[i] = LedImage(roi, coverage, weight, pattern, seen * image.visible_fraction, seen * imaged, edges)
    return lights


def face_of_led(leds: Leds, i: int) -> tuple[Array, Disc | Rectangle]:
    """Centre (3,) and shape of what is seen to shine: the LED's face, or what it lights of a sheet."""
    diffuser, radius = leds.diffusers[i], float(leds.half_widths_m[i])
    if diffuser is not None:
        x0, y0, x1, y1 = diffuser.lit_m
        center: Array = np.array([(x0 + x1) / 2, (y0 + y1) / 2, leds.centers_m[i, 2]])
        return center, Rectangle((x1 - x0, y1 - y0))
    return leds.centers_m[i], Rectangle((2 * radius, 2 * radius)) if leds.squares[i] else Disc(radius)


def luminance_pattern(leds: Leds, i: int, camera: Camera, pose: Pose, roi: Roi) -> Array | float:
    """Luminance over that of the bare LED along its normal, in each pixel of the window.

    Of a bare LED cos^(m - 1); of a sheet the mean over the pixel, of 2 x 2 places (Gauss and Legendre) where a
    pixel sees more than a part FINE of the LED's distance behind it.
    """
    diffuser, order = leds.diffusers[i], float(leds.orders[i])
    if diffuser is not None:
        at = partial(places_on_plane, camera, pose, np.array([0.0, 0.0, leds.centers_m[i, 2]]))
        if _widest_step_m(roi, at) < FINE * diffuser.distance_m:
            return _in_bands(roi, lambda u, v: diffuser.luminance(*at(u, v)))
        nodes = list(itertools.product((-GAUSS_PX, GAUSS_PX), repeat=2))

        def mean(u: Array, v: Array) -> Array:
            total: Array = sum((diffuser.luminance(*at(u + a, v + b)) for a, b in nodes), np.zeros(()))
            return total / len(nodes)

        return _in_bands(roi, mean)
    if abs(order - 1.0) < 1e-12:
        return 1.0
    x, y, z = ray_world(camera, pose, *roi.centers_px())
    cosine = np.maximum(z / np.sqrt(x * x + y * y + z * z), 0.0)
    pattern: Array = cosine ** (order - 1.0)
    return pattern


def _widest_step_m(roi: Roi, at: Callable[[Array, Array], tuple[Array, Array]]) -> float:
    """How far the place on a plane, along x or y, moves at most over a pixel: on a grid, since it changes slowly."""
    u = np.linspace(roi.column + 0.5, roi.end_column - 0.5, GRID_POINTS)[None, :]
    v = np.linspace(roi.row + 0.5, roi.end_row - 0.5, GRID_POINTS)[:, None]
    sides = (at(u - 0.5, v), at(u + 0.5, v)), (at(u, v - 0.5), at(u, v + 0.5))
    return max(float(np.abs(b - a).max()) for before, after in sides for a, b in zip(before, after, strict=True))


def _in_bands(roi: Roi, of: Callable[[Array, Array], Array]) -> Array:
    """A function of the pixel centres u (1, columns) and v (rows, 1), (rows, columns).

    In bands of rows, whose temporary arrays stay in the processor's cache.
    """
    u, v = roi.centers_px()
    image = np.empty((roi.rows, roi.columns))
    rows = max(1, PIXELS_AT_ONCE // roi.columns)
    for start in range(0, roi.rows, rows):
        band = slice(start, start + rows)
        image[band] = of(u, v[band])
    return image


def _overscan_px(camera: Camera) -> int:
    """How far beyond the sensor windows may lie."""
    return int(np.ceil(np.tan(np.radians(OVERSCAN_DEG)) * camera.focal_px))
