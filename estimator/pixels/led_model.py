"""Image model of LEDs under a pose: share of each pixel's light that is an LED's, and its derivatives by the pose.

An LED is modelled by its true face, a horizontal disc or square, so that the model has no eccentricity. Its rim is
projected point by point with the camera's own lens, including distortion and fish-eyes. The share of each pixel inside
is exact for the polygon (`polygon_raster`); then the lens blurs it (`psf`).

Error of the polygon: a chord of length L deviates from a rim with radius of curvature r by at most L^2 / 8r. The
polygon is enlarged to the disc's area, so that the mean deviation is zero, and two or more chords a pixel average the
rest. At L = 0.5 px and r = 50 px the error of a pixel is 1e-4 of the LED's light (tested), while the noise of its few
thousand electrons is 1e-2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.camera.projection import project, projection_of
from estimator.io.device import Camera, Led
from estimator.pixels.polygon_raster import MAX_EDGE_PX, EdgePieces, Outlines, RoiStack, cover
from estimator.pixels.psf import LensBlur

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Points of a rim for its first projection, which determines its size; and the minimum, for LEDs of a few pixels.
COARSE_POINTS = 32
MIN_POINTS = 128
# Margin on the number of points: edges must stay within MAX_EDGE_PX while the pose is searched.
EDGE_MARGIN = 1.25


@dataclass(frozen=True, eq=False)
class LedFootprints:
    """Location of the images of n LEDs, without blur; NaN for LEDs not imaged completely, or seen from above.

    `low`, `high` and `centre` (n, 2) are the bounding box of the image and its centre, pixels (u, v). `max_edge_px`
    (n,) is the longest edge of a rim of COARSE_POINTS points. `illumination_slope` (n, 2) is the derivative by u and v
    of the irradiance by a surface of uniform luminance, relative to that at the centre, per pixel. `defocus_depth_m`
    (n,) is the depth that determines the defocus.
    """

    low: Floats
    high: Floats
    centre: Floats
    max_edge_px: Floats
    illumination_slope: Floats
    defocus_depth_m: Floats

    def of(self, chosen: NDArray[np.bool_] | Ints) -> "LedFootprints":
        """The footprints of the chosen LEDs."""
        return LedFootprints(*(values[chosen] for values in vars(self).values()))


def led_footprints(leds: Sequence[Led], pose: Pose, camera: Camera) -> LedFootprints:
    """Footprints of LEDs under a pose."""
    centres_m = np.array([led.position_m for led in leds])
    rims_m = np.stack([rim(led, COARSE_POINTS) for led in leds]) + centres_m[:, None]
    projected = project(rims_m.reshape(-1, 3), pose, camera)
    pixels = projected.pixels.reshape(len(leds), COARSE_POINTS, 2)
    from_above = centres_m[:, 2] <= pose.position_m[2]
    pixels[from_above] = np.nan
    centre = pixels.mean(axis=1)
    offsets = pixels - centre[:, None]
    illumination = projected.relative_illumination.reshape(len(leds), COARSE_POINTS)
    # Linear fit over the rim; the curvature over an LED of 0.01 rad is 1e-4 of the light, and symmetric.
    with np.errstate(all="ignore"):
        normal_matrix = np.einsum("nip,niq->npq", offsets, offsets)
        right = np.einsum("nip,ni->np", offsets, illumination / illumination.mean(axis=1, keepdims=True) - 1)
        whole = np.isfinite(normal_matrix).all(axis=(1, 2)) & (np.linalg.det(normal_matrix) > 0)
    slope = np.full((len(leds), 2), np.nan)
    slope[whole] = np.linalg.solve(normal_matrix[whole], right[whole][:, :, None])[:, :, 0]
    edges = np.linalg.norm(pixels - np.roll(pixels, -1, axis=1), axis=2).max(axis=1)
    centres_cam = projected.p_cam.reshape(len(leds), COARSE_POINTS, 3).mean(axis=1)
    depth_m = projection_of(camera).defocus_depth_m(centres_cam)
    return LedFootprints(pixels.min(axis=1), pixels.max(axis=1), centre, edges, slope, depth_m)


def rim(led: Led, points: int) -> Floats:
    """Polygon of the face's area, (points, 3) metres relative to its centre, in the sense from x to y.

    `points` is a multiple of 4.
    """
    if led.shape == "disc":
        step = 2 * np.pi / points
        angles = step * np.arange(points)
        radius_m = led.half_width_m * np.sqrt(step / np.sin(step))
        return np.asarray(radius_m * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]))
    along = np.arange(points // 4) / (points // 4) * 2 - 1
    side = led.half_width_m * np.column_stack([np.ones_like(along), along, 0 * along])
    quarter_turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # of row vectors, from x to y
    sides = [side]
    for _ in range(3):
        sides.append(sides[-1] @ quarter_turn)
    return np.concatenate(sides)


@dataclass(frozen=True, eq=False)
class RenderedLeds:
    """LED images under one pose: `share` (cells,) of an LED's full light in each cell of a region stack."""

    share: Floats
    _rois: RoiStack
    _pieces: EdgePieces
    _lens: LensBlur

    def slopes(self, cells: Ints) -> Floats:
        """Derivatives of the share in n cells by the pose, (n, 6)."""
        pieces, lens = self._pieces, self._lens
        if not lens.kernels:
            index = np.full(self._rois.cells(), len(cells))
            index[cells] = np.arange(len(cells))
            at = index[self._rois.cell(pieces.roi, pieces.row, pieces.column)]
            sums = [np.bincount(at, slope, len(cells) + 1)[:-1] for slope in pieces.slopes.T]
            return np.stack(sums, axis=1)
        fine = self._rois.padded(lens.radius_px).subdivided(lens.slope_factors)
        coarsening = (lens.factors // lens.slope_factors)[pieces.roi]
        at = fine.cell(pieces.roi, pieces.row // coarsening, pieces.column // coarsening)
        slopes = np.empty((len(cells), POSE_PARAMETERS))
        for parameter, slope in enumerate(pieces.slopes.T):
            sharp: Floats = np.asarray(np.bincount(at, slope / coarsening**2, fine.cells()), dtype=np.float64)
            slopes[:, parameter] = _blurred(sharp, fine, self._rois, lens, lens.slope_kernels)[cells]
        return slopes


class LedImageModel:
    """Image model of LEDs, for poses near the one that their footprints were computed for.

    `rois` holds a region of interest for each LED, in pixels of the sensor.
    """

    def __init__(
        self, leds: Sequence[Led], footprints: LedFootprints, camera: Camera, lens: LensBlur, rois: RoiStack
    ) -> None:
        """Prepare to render LEDs that are all imaged completely; `lens` is for their depths."""
        self.rois = rois
        self._camera = camera
        self._lens = lens
        needed = np.maximum(MIN_POINTS, EDGE_MARGIN * footprints.max_edge_px * COARSE_POINTS / MAX_EDGE_PX)
        counts = 4 * np.ceil(needed * lens.factors / 4).astype(np.int64)
        last = np.cumsum(counts)
        self._following = np.arange(1, last[-1] + 1)
        self._following[last - 1] = last - counts
        self._led = np.repeat(np.arange(len(leds)), counts)
        self._rims_m = np.concatenate(
            [rim(led, n) + np.array(led.position_m) for led, n in zip(leds, counts.tolist(), strict=True)]
        )

    def render(self, pose: Pose) -> RenderedLeds:
        """Images of all LEDs under a pose, each alone in its region."""
        lens, factors = self._lens, self._lens.factors[self._led, None]
        rims = project(self._rims_m, pose, self._camera)
        fine = self.rois.padded(lens.radius_px).subdivided(lens.factors)
        outlines = Outlines(rims.pixels * factors, self._following, self._led, rims.slopes * factors[:, None])
        covered, pieces = cover(fine, outlines)
        share = _blurred(covered, fine, self.rois, lens, lens.kernels) if lens.kernels else covered
        return RenderedLeds(share, self.rois, pieces, lens)


def _blurred(image: Floats, fine: RoiStack, rois: RoiStack, lens: LensBlur, kernels: Sequence[Floats]) -> Floats:
    """Image of padded, subdivided regions, convolved with the kernels and averaged to the pixels of `rois`."""
    blurred = np.zeros(rois.cells())
    for k, kernel in enumerate(kernels):
        convolved = _convolved(fine.roi(image, k), kernel)
        rows, columns = (int(size[k]) + 2 * lens.radius_px for size in (rois.heights, rois.widths))
        blocks = convolved.reshape(rows, convolved.shape[0] // rows, columns, convolved.shape[1] // columns)
        inner = slice(lens.radius_px, -lens.radius_px)
        rois.roi(blurred, k)[:] = blocks.mean(axis=(1, 3))[inner, inner]
    return blurred


def _convolved(image: Floats, kernel: Floats) -> Floats:
    """Convolution with zeros beyond the image."""
    # OpenCV correlates: flip the kernel.
    flipped = np.ascontiguousarray(kernel[::-1, ::-1], dtype=np.float32)
    single = np.ascontiguousarray(image, dtype=np.float32)  # accurate to a millionth of the light, in half the time
    return np.asarray(cv2.filter2D(single, -1, flipped, borderType=cv2.BORDER_CONSTANT), dtype=np.float64)
