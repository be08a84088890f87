"""The image of LEDs under a pose: how much of each pixel's light is theirs, and how that changes with the pose.

An LED is its true face, a horizontal disc or square, so that a perspective disc's centroid is no issue. Its rim is
imaged point by point by the camera's own lens, which takes distortion and fish-eyes alike; the share of each pixel
inside is exact for the polygon (`coverage`); then the lens blurs it (`blur`).

What the polygon costs: a chord of length L leaves a rim of radius of curvature r by L^2 / 8r at the most. The polygon
is drawn larger so that it has the disc's area: what is left of that has no mean, and two chords or more a pixel average
it. At L = 0.5 px and r = 50 px a pixel is off by 1e-4 of the LED's light (tested), where the noise of its some thousand
electrons is 1e-2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.projection import POSE_PARAMETERS, TiltedPose, project
from estimator.io.dataset import Camera, Led
from estimator.pixels.polygon_raster import MAX_EDGE_PX, Canvas, Outlines, Pieces, cover
from estimator.pixels.psf import LensBlur

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# A rim's points in the first place, to see how large it is; and the fewest, for LEDs of a few pixels.
COARSE_POINTS = 32
MIN_POINTS = 128
# Edges have to stay within LONGEST_EDGE_PX while the pose is looked for, and points further off are further apart.
SPARE = 1.25


@dataclass(frozen=True, eq=False)
class Views:
    """Where n LEDs' images are, blur left out; NaN for those that the lens does not image whole, or from above.

    `low`, `high` and `centre` (n, 2) are the box of the image and its middle, pixels (u, v); `longest_edge_px` (n,) of
    the rim in COARSE_POINTS points; `dimming` (n, 2) how the light of a face of one luminance changes with u and v,
    as a share of that at the centre a pixel; `depth_m` (n,) what defocus goes by, along the axis or, of a fish-eye,
    the distance.
    """

    low: Floats
    high: Floats
    centre: Floats
    longest_edge_px: Floats
    dimming: Floats
    depth_m: Floats

    def of(self, chosen: NDArray[np.bool_] | Ints) -> "Views":
        """Those of some LEDs."""
        return Views(*(values[chosen] for values in vars(self).values()))


def views(leds: Sequence[Led], pose: TiltedPose, camera: Camera) -> Views:
    """Where the lens images LEDs."""
    centres_m = np.array([led.position_m for led in leds])
    rims_m = np.stack([rim(led, COARSE_POINTS) for led in leds]) + centres_m[:, None]
    projected = project(rims_m.reshape(-1, 3), pose, camera)
    pixels = projected.pixels.reshape(len(leds), COARSE_POINTS, 2)
    hidden = centres_m[:, 2] <= pose.position_m[2]
    pixels[hidden] = np.nan
    centre = pixels.mean(axis=1)
    offsets = pixels - centre[:, None]
    light = projected.light.reshape(len(leds), COARSE_POINTS)
    # A linear fit over the rim; its curvature over an LED of 0.01 rad is 1e-4 of the light, and even.
    with np.errstate(all="ignore"):
        lever = np.einsum("nip,niq->npq", offsets, offsets)
        pull = np.einsum("nip,ni->np", offsets, light / light.mean(axis=1, keepdims=True) - 1)
        whole = np.isfinite(lever).all(axis=(1, 2)) & (np.linalg.det(lever) > 0)
    dimming = np.full((len(leds), 2), np.nan)
    dimming[whole] = np.linalg.solve(lever[whole], pull[whole][:, :, None])[:, :, 0]
    edges = np.linalg.norm(pixels - np.roll(pixels, -1, axis=1), axis=2).max(axis=1)
    p_cam = projected.p_cam.reshape(len(leds), COARSE_POINTS, 3).mean(axis=1)
    depth = p_cam[:, 2] if camera.projection == "perspective" else np.linalg.norm(p_cam, axis=1)
    return Views(pixels.min(axis=1), pixels.max(axis=1), centre, edges, dimming, depth)


def rim(led: Led, points: int) -> Floats:
    """A polygon of the face's area, (points, 3) metres from its centre, from x towards y; `points` is 4, 8, 12, ..."""
    if led.shape == "disc":
        step = 2 * np.pi / points
        angles = step * np.arange(points)
        radius_m = led.radius_m * np.sqrt(step / np.sin(step))
        return np.asarray(radius_m * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]))
    along = np.arange(points // 4) / (points // 4) * 2 - 1
    side = led.radius_m * np.column_stack([np.ones_like(along), along, 0 * along])
    quarter_turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # of rows, from x towards y
    sides = [side]
    for _ in range(3):
        sides.append(sides[-1] @ quarter_turn)
    return np.concatenate(sides)


@dataclass(frozen=True, eq=False)
class Drawing:
    """LEDs' images under one pose: `share` (cells,) of an LED's full light in each cell of the canvas, and slopes."""

    share: Floats
    _canvas: Canvas
    _pieces: Pieces
    _lens: LensBlur

    def slopes(self, cells: Ints) -> Floats:
        """How the share in n cells changes with the pose, (n, 6)."""
        pieces, lens = self._pieces, self._lens
        if not lens.kernels:
            index = np.full(self._canvas.cells(), len(cells))
            index[cells] = np.arange(len(cells))
            at = index[self._canvas.cell(pieces.roi, pieces.row, pieces.column)]
            gained = [np.bincount(at, slope, len(cells) + 1)[:-1] for slope in pieces.slopes.T]
            return np.stack(gained, axis=1)
        fine = self._canvas.padded(lens.reach_px).finer(lens.slope_finer)
        coarser = (lens.finer // lens.slope_finer)[pieces.roi]
        at = fine.cell(pieces.roi, pieces.row // coarser, pieces.column // coarser)
        slopes = np.empty((len(cells), POSE_PARAMETERS))
        for parameter, slope in enumerate(pieces.slopes.T):
            sharp: Floats = np.asarray(np.bincount(at, slope / coarser**2, fine.cells()), dtype=np.float64)
            slopes[:, parameter] = _blurred(sharp, fine, self._canvas, lens, lens.slope_kernels)[cells]
        return slopes


class LedImages:
    """LEDs that can be drawn under poses near the one they were looked at from.

    `canvas` holds a window for each LED, in pixels of the sensor.
    """

    def __init__(self, leds: Sequence[Led], seen: Views, camera: Camera, lens: LensBlur, canvas: Canvas) -> None:
        """Prepare to draw LEDs that are all imaged; `lens` is for their depths."""
        self.canvas = canvas
        self._camera = camera
        self._lens = lens
        wanted = np.maximum(MIN_POINTS, SPARE * seen.longest_edge_px * COARSE_POINTS / MAX_EDGE_PX)
        counts = 4 * np.ceil(wanted * lens.finer / 4).astype(np.int64)
        last = np.cumsum(counts)
        self._following = np.arange(1, last[-1] + 1)
        self._following[last - 1] = last - counts
        self._led = np.repeat(np.arange(len(leds)), counts)
        self._rims_m = np.concatenate(
            [rim(led, n) + np.array(led.position_m) for led, n in zip(leds, counts.tolist(), strict=True)]
        )

    def draw(self, pose: TiltedPose) -> Drawing:
        """All LEDs under a pose, each alone in its window."""
        lens, scale = self._lens, self._lens.finer[self._led, None]
        rims = project(self._rims_m, pose, self._camera)
        fine = self.canvas.padded(lens.reach_px).finer(lens.finer)
        outlines = Outlines(rims.pixels * scale, self._following, self._led, rims.slopes * scale[:, None])
        covered, pieces = cover(fine, outlines)
        share = _blurred(covered, fine, self.canvas, lens, lens.kernels) if lens.kernels else covered
        return Drawing(share, self.canvas, pieces, lens)


def _blurred(image: Floats, fine: Canvas, canvas: Canvas, lens: LensBlur, kernels: Sequence[Floats]) -> Floats:
    """An image of the canvas's windows with a margin, on finer pixels, to one after the lens, on the canvas."""
    blurred = np.zeros(canvas.cells())
    for k, kernel in enumerate(kernels):
        after = _filtered(fine.roi(image, k), kernel)
        rows, columns = (int(size[k]) + 2 * lens.reach_px for size in (canvas.heights, canvas.widths))
        whole = after.reshape(rows, after.shape[0] // rows, columns, after.shape[1] // columns).mean(axis=(1, 3))
        inner = slice(lens.reach_px, -lens.reach_px)
        canvas.roi(blurred, k)[:] = whole[inner, inner]
    return blurred


def _filtered(image: Floats, kernel: Floats) -> Floats:
    """Convolution, nothing beyond the image."""
    # OpenCV correlates: the kernel is turned round.
    turned = np.ascontiguousarray(kernel[::-1, ::-1], dtype=np.float32)
    single = np.ascontiguousarray(image, dtype=np.float32)  # to a millionth of the light, in half the time
    return np.asarray(cv2.filter2D(single, -1, turned, borderType=cv2.BORDER_CONSTANT), dtype=np.float64)
