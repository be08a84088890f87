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
from vlcrender.camera.roi import LedWindows, Window
from vlcrender.core.planar_shapes import Disc, Rectangle
from vlcrender.rendering.led_blur import LedBlur
from vlcrender.rendering.led_coverage import image_of_led, leds_that_may_be_seen, places_on_plane
from vlcrender.rendering.led_edges import LedEdges, edges_of_led
from vlcrender.rendering.occlusion import Obstacles
from vlcrender.scene.loader import Leds

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
class LedLight:
    """An LED's image at one pose: coverage, and what a luminance is worth in each pixel of the window.

    `pattern` is the luminance in each pixel over the LED's own along its normal. `edges` is there where a narrow blur
    needs parts of pixels, times weight and pattern; what hides a pixel in part hides its parts alike.
    """

    window: Window
    coverage: Array
    weight: Array
    pattern: Array | float
    visible_fraction: float
    imaged_fraction: float
    edges: LedEdges | None


def led_lights(
    leds: Leds, obstacles: Obstacles, camera: Camera, pose: Pose, windows: LedWindows | None, blurs: LedBlur
) -> dict[int, LedLight]:
    """By index, each LED that lights a pixel of the view, or by its blur may."""
    overscan = windows is not None and windows.overscan
    reach = _overscan_px(camera) if overscan else blurs.spread_px
    images = []
    for i in leds_that_may_be_seen(camera, pose, leds.centers_m, leds.reaches_m, reach).tolist():
        image = image_of_led(camera, pose, *face_of_led(leds, i), reach)
        if image is None:
            continue
        window = Window(image.row, image.column, *image.coverage.shape)
        if overscan and not Window.of_sensor(camera).grown(reach - 1).holds(window):
            continue  # an LED cut by the widest overscan is left out
        images.append((i, window, image))
    clear: Sequence[Array | float] = [1.0] * len(images)
    if obstacles.there_are_some:
        asked = [(float(leds.centers_m[i, 2]), window, image.coverage > 0) for i, window, image in images]
        clear = obstacles.clear_shares(camera, pose, asked)
    lights = {}
    for (i, window, image), share in zip(images, clear, strict=True):
        coverage, seen = image.coverage, 1.0
        split = blurs.split(i)
        edges = edges_of_led(camera, pose, *face_of_led(leds, i), image, split) if split > 1 else None
        if not isinstance(share, float):
            coverage = image.coverage * share
            seen = float(coverage.sum() / image.coverage.sum())
            edges = edges and edges.times(share, window)
        if seen > 0:
            imaged = 1.0 if overscan else image.visible_fraction
            weight = _in_bands(window, partial(relative_illumination, camera))
            pattern = luminance_pattern(leds, i, camera, pose, window)
            edges = edges and edges.times(weight * pattern, window)
            lights[i] = LedLight(window, coverage, weight, pattern, seen * image.visible_fraction, seen * imaged, edges)
    return lights


def face_of_led(leds: Leds, i: int) -> tuple[Array, Disc | Rectangle]:
    """Centre (3,) and shape of what is seen to shine: the LED's face, or what it lights of a sheet."""
    sheet, radius = leds.sheets[i], float(leds.radii_m[i])
    if sheet is not None:
        x0, y0, x1, y1 = sheet.lit_m
        center: Array = np.array([(x0 + x1) / 2, (y0 + y1) / 2, leds.centers_m[i, 2]])
        return center, Rectangle((x1 - x0, y1 - y0))
    return leds.centers_m[i], Rectangle((2 * radius, 2 * radius)) if leds.squares[i] else Disc(radius)


def luminance_pattern(leds: Leds, i: int, camera: Camera, pose: Pose, window: Window) -> Array | float:
    """Luminance over that of the bare LED along its normal, in each pixel of the window.

    Of a bare LED cos^(m - 1); of a sheet the mean over the pixel, of 2 x 2 places (Gauss and Legendre) where a
    pixel sees more than a part FINE of the LED's distance behind it.
    """
    sheet, order = leds.sheets[i], float(leds.orders[i])
    if sheet is not None:
        at = partial(places_on_plane, camera, pose, np.array([0.0, 0.0, leds.centers_m[i, 2]]))
        if _widest_step_m(window, at) < FINE * sheet.distance_m:
            return _in_bands(window, lambda u, v: sheet.luminance(*at(u, v)))
        nodes = list(itertools.product((-GAUSS_PX, GAUSS_PX), repeat=2))

        def mean(u: Array, v: Array) -> Array:
            total: Array = sum((sheet.luminance(*at(u + a, v + b)) for a, b in nodes), np.zeros(()))
            return total / len(nodes)

        return _in_bands(window, mean)
    if abs(order - 1.0) < 1e-12:
        return 1.0
    x, y, z = ray_world(camera, pose, *window.centers_px())
    cosine = np.maximum(z / np.sqrt(x * x + y * y + z * z), 0.0)
    pattern: Array = cosine ** (order - 1.0)
    return pattern


def _widest_step_m(window: Window, at: Callable[[Array, Array], tuple[Array, Array]]) -> float:
    """How far the place on a plane, along x or y, moves at most over a pixel: on a grid, since it changes slowly."""
    u = np.linspace(window.column + 0.5, window.end_column - 0.5, GRID_POINTS)[None, :]
    v = np.linspace(window.row + 0.5, window.end_row - 0.5, GRID_POINTS)[:, None]
    sides = (at(u - 0.5, v), at(u + 0.5, v)), (at(u, v - 0.5), at(u, v + 0.5))
    return max(float(np.abs(b - a).max()) for before, after in sides for a, b in zip(before, after, strict=True))


def _in_bands(window: Window, of: Callable[[Array, Array], Array]) -> Array:
    """A function of the pixel centres u (1, columns) and v (rows, 1), (rows, columns).

    In bands of rows, whose temporary arrays stay in the processor's cache.
    """
    u, v = window.centers_px()
    image = np.empty((window.rows, window.columns))
    rows = max(1, PIXELS_AT_ONCE // window.columns)
    for start in range(0, window.rows, rows):
        band = slice(start, start + rows)
        image[band] = of(u, v[band])
    return image


def _overscan_px(camera: Camera) -> int:
    """How far beyond the sensor windows may lie."""
    return int(np.ceil(np.tan(np.radians(OVERSCAN_DEG)) * camera.focal_px))
