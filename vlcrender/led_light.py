"""The light of LEDs in a view's pixels at one pose, before the lens blurs it.

Each LED has a window with its exact pixel coverage (`led_image`), less what hides it (`obstacles`). Of an LED behind a
diffuser it is what it lights of the sheet.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera import Camera, Pose, rays_world
from vlcrender.led_blur import LedBlur
from vlcrender.led_edges import LedEdges, edges_of_led
from vlcrender.led_image import image_of_led, leds_that_may_be_seen
from vlcrender.led_shape import Disc, Rectangle
from vlcrender.lens import relative_illumination
from vlcrender.obstacles import Obstacles
from vlcrender.scene import Leds
from vlcrender.windows import LedWindows, Window

OVERSCAN_DEG = 75.0
"""How far off the optical axis, across or down, windows may lie that reach beyond the sensor."""
GAUSS_PX = 0.5 / np.sqrt(3.0)
FINE = 0.02
"""Of a pixel that sees less the middle is the mean, to 2 (m + 3) * 0.02^2 / 24: 3e-4 for an order m of 5."""

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
    lights = {}
    for i in leds_that_may_be_seen(camera, pose, leds.centers_m, leds.reaches_m, reach).tolist():
        face = face_of_led(leds, i)
        image = image_of_led(camera, pose, *face, reach)
        if image is None:
            continue
        window = Window(image.row, image.column, *image.coverage.shape)
        if overscan and not Window.of_sensor(camera).grown(reach - 1).holds(window):
            continue  # an LED cut by the widest overscan is left out
        coverage = image.coverage
        split = blurs.split(i)
        edges = edges_of_led(camera, pose, *face, image, split) if split > 1 else None
        seen = 1.0
        if obstacles.there_are_some:
            clear = obstacles.clear_share(camera, pose, float(leds.centers_m[i, 2]), window, coverage > 0)
            seen = float((coverage * clear).sum() / coverage.sum())
            coverage = coverage * clear
            edges = edges and edges.times(clear, window)
        if seen > 0:
            imaged = 1.0 if overscan else image.visible_fraction
            weight = relative_illumination(camera, *np.moveaxis(window.centers_px(), -1, 0))
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
        height = float(leds.centers_m[i, 2] - pose.position_m[2])

        def at(off: tuple[float, float]) -> tuple[Array, Array]:
            rays = rays_world(camera, pose, window.centers_px() + np.array(off))
            reach = height / np.maximum(rays[..., 2], 1e-9)
            return pose.position_m[0] + reach * rays[..., 0], pose.position_m[1] + reach * rays[..., 1]

        middle = at((0.0, 0.0))
        steps = [np.abs(np.diff(place, axis=axis)).max(initial=0.0) for place in middle for axis in (0, 1)]
        if max(steps) < FINE * sheet.distance_m and min(window.rows, window.columns) > 1:
            return sheet.luminance(*middle)
        nodes = list(itertools.product((-GAUSS_PX, GAUSS_PX), repeat=2))
        mean: Array = sum((sheet.luminance(*at(off)) for off in nodes), np.zeros(middle[0].shape)) / len(nodes)
        return mean
    if abs(order - 1.0) < 1e-12:
        return 1.0
    rays = rays_world(camera, pose, window.centers_px())
    cosine = np.maximum(rays[..., 2] / np.sqrt((rays**2).sum(axis=-1)), 0.0)
    pattern: Array = cosine ** (order - 1.0)
    return pattern


def _overscan_px(camera: Camera) -> int:
    """How far beyond the sensor windows may lie."""
    return int(np.ceil(np.tan(np.radians(OVERSCAN_DEG)) * camera.focal_px))
