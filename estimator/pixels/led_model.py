"""Image model of LEDs under a pose: an LED's light in each pixel, and its derivatives by the pose.

An LED is modelled by its true face, a horizontal disc or square, so that the model has no eccentricity. Its rim is
projected point by point with the camera's own lens, including distortion and fish-eyes. The share of each pixel inside
is exact for the polygon (`polygon_raster`). The lens dims it towards the image's border, in each pixel by the fall-off
at its centre (`relative_illumination`), and blurs it (`psf`).

Error of the polygon: a chord of length L deviates from a rim with radius of curvature r by at most L^2 / 8r. The
polygon is enlarged to the disc's area, so that the mean deviation is zero, and two or more chords a pixel average the
rest. At L = 0.5 px and r = 50 px the error of a pixel is 1e-4 of the LED's light (tested), while the noise of its few
thousand electrons is 1e-2.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from estimator.camera.intrinsics import CAMERA_PARAMETERS, intrinsic_slopes_px
from estimator.camera.motion import MOTION_PARAMETERS
from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.camera.projection import ProjectedPoints, project, projection_of, relative_illumination
from estimator.camera.rolling_projection import project_rolling
from estimator.io.camera import Camera
from estimator.io.led_map import Led
from estimator.pixels.polygon_raster import MAX_EDGE_PX, EdgePieces, Outlines, RoiStack, cover
from estimator.pixels.psf import LensBlur
from estimator.pixels.region_blur import RegionBlur

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Points of a rim for its first projection, which determines its size; and the minimum, for LEDs of a few pixels.
COARSE_POINTS = 32
MIN_POINTS = 128
# Margin on the number of points: edges must stay within MAX_EDGE_PX while the pose is searched.
EDGE_MARGIN = 1.25
# Before the blur an LED image stays within this of its footprint, pixels, until its pixels are gathered anew: it may
# have moved by a pixel, and a step is as long at most.
SHARP_MARGIN_PX = 4
# Chebyshev nodes across and down a region at which the lens's fall-off is computed; it is interpolated between them by
# a polynomial. Over a region of 0.5 rad, cos^4 is then exact to 1e-6 of the light (tested).
FALL_OFF_NODES = 10


FACE_PARAMETERS = 3
"""Parameters of a face: the relative error of its size, then its two tilts, see `ImageState`."""
IMAGE_PARAMETERS = POSE_PARAMETERS + CAMERA_PARAMETERS + FACE_PARAMETERS
"""Parameters of LED images: the pose's, the intrinsics', then those of the LED's own face."""
PRINCIPAL_POINT = (POSE_PARAMETERS + 2, POSE_PARAMETERS + 3)
SIZE_PARAMETER = IMAGE_PARAMETERS - FACE_PARAMETERS
TILT_PARAMETERS = (SIZE_PARAMETER + 1, SIZE_PARAMETER + 2)
PROFILE_PARAMETERS = 3
"""Coefficients of an LED's luminance over its face: of a, b and a^2 + b^2 - 1/2, see `LedPixels`."""
LOCAL_PARAMETERS = IMAGE_PARAMETERS + PROFILE_PARAMETERS
"""Parameters that the readings of one LED depend on. Those of the camera's motion, if any, follow them."""
MOTION_COLUMNS = LOCAL_PARAMETERS + np.arange(MOTION_PARAMETERS)


@dataclass(frozen=True, eq=False)
class ImageState:
    """What determines the images of n LEDs: a pose, a camera, and how the LEDs differ from the map.

    `shifts_m` (n, 3) is added to the LEDs' positions, world metres; `sizes` (n,) multiplies their sizes. `tilts` (n, 2)
    are tangents: at (x, y) from its centre a face is tilts[:, 0] x + tilts[:, 1] y higher than a level one. `velocity`
    (6,) is that of a camera with a rolling shutter (`estimator.camera.motion`), whose pose is that at mid-readout; None
    for a global shutter.
    """

    pose: Pose
    camera: Camera
    shifts_m: Floats
    sizes: Floats
    tilts: Floats
    velocity: Floats | None = None

    @staticmethod
    def as_told(pose: Pose, camera: Camera, leds: int) -> "ImageState":
        """LEDs as in the map."""
        return ImageState(pose, camera, np.zeros((leds, 3)), np.ones(leds), np.zeros((leds, 2)))

    def same_as(self, other: "ImageState") -> bool:
        """Whether two states of the same LEDs give the same images."""
        if self.pose is not other.pose or self.camera != other.camera:
            return False
        arrays = "shifts_m", "sizes", "tilts", "velocity"
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in arrays)

    def of(self, chosen: NDArray[np.bool_] | Ints) -> "ImageState":
        """The state of the chosen LEDs."""
        of_leds = self.shifts_m[chosen], self.sizes[chosen], self.tilts[chosen]
        return ImageState(self.pose, self.camera, *of_leds, self.velocity)

    def project(self, points_m: Floats) -> ProjectedPoints:
        """Images of world points (n, 3), and their derivatives."""
        if self.velocity is None:
            return project(points_m, self.pose, self.camera)
        return project_rolling(points_m, self.pose, self.camera, self.velocity)

    def rims_m(self, level_m: Floats) -> Floats:
        """Points of the faces relative to their centres, (n, k, 3), from those of level faces by the map."""
        rims_m = level_m * self.sizes[:, None, None]
        rims_m[:, :, 2] += np.einsum("nki,ni->nk", rims_m[:, :, :2], self.tilts)
        return rims_m


@dataclass(frozen=True, eq=False)
class LedFootprints:
    """Location of the images of n LEDs, without blur; NaN for LEDs not imaged completely, or seen from above.

    `low`, `high` and `centre` (n, 2) are the bounding box of the image and its centre, pixels (u, v). `max_edge_px`
    (n,) is the longest edge of a rim of COARSE_POINTS points. `to_face` (n, 2, 2) maps an offset from the centre,
    pixels, to the face's own coordinates along x and y of the world in half widths, to first order. `defocus_depth_m`
    (n,) is the depth that determines the defocus.
    """

    low: Floats
    high: Floats
    centre: Floats
    max_edge_px: Floats
    to_face: Floats
    defocus_depth_m: Floats

    @property
    def whole(self) -> NDArray[np.bool_]:
        """LEDs, (n,), that are imaged completely and from below."""
        return np.asarray(np.isfinite(self.to_face).all(axis=(1, 2)))

    def of(self, chosen: NDArray[np.bool_] | Ints) -> "LedFootprints":
        """The footprints of the chosen LEDs."""
        return LedFootprints(*(values[chosen] for values in vars(self).values()))


def led_footprints(leds: Sequence[Led], state: ImageState) -> LedFootprints:
    """Footprints of LEDs under a state."""
    pose, camera = state.pose, state.camera
    centres_m = np.array([led.position_m for led in leds]) + state.shifts_m
    rims_m = state.rims_m(np.stack([rim(led, COARSE_POINTS) for led in leds])) + centres_m[:, None]
    projected = state.project(rims_m.reshape(-1, 3))
    pixels = projected.pixels.reshape(len(leds), COARSE_POINTS, 2)
    from_above = centres_m[:, 2] <= pose.position_m[2]
    pixels[from_above] = np.nan
    centre = pixels.mean(axis=1)
    half_widths_m = np.array([led.half_width_m for led in leds])
    # Along x and y an LED moves its image as much as the camera moves it by the opposite way.
    across = state.project(centres_m).slopes[:, :, :2] * -half_widths_m[:, None, None]
    with np.errstate(all="ignore"):
        whole = np.isfinite(pixels).all(axis=(1, 2)) & (np.abs(np.linalg.det(across)) > 0)
    to_face = np.full((len(leds), 2, 2), np.nan)
    to_face[whole] = np.linalg.inv(across[whole])
    edges = np.linalg.norm(pixels - np.roll(pixels, -1, axis=1), axis=2).max(axis=1)
    centres_cam = projected.p_cam.reshape(len(leds), COARSE_POINTS, 3).mean(axis=1)
    depth_m = projection_of(camera).defocus_depth_m(centres_cam)
    return LedFootprints(pixels.min(axis=1), pixels.max(axis=1), centre, edges, to_face, depth_m)


POSE_ALONE = np.arange(POSE_PARAMETERS)


def rim(led: Led, points: int) -> Floats:
    """Polygon of the face's area, (points, 3) metres relative to its centre, in the sense from x to y.

    `points` is a multiple of 4.
    """
    return np.asarray(led.half_width_m * _unit_rim(led.shape, points))


@lru_cache(maxsize=256)
def _unit_rim(shape: str, points: int) -> Floats:
    """Polygon of the area of a face of half width 1, (points, 3)."""
    if shape == "disc":
        step = 2 * np.pi / points
        angles = step * np.arange(points)
        return np.asarray(np.sqrt(step / np.sin(step)) * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]))
    along = np.arange(points // 4) / (points // 4) * 2 - 1
    side = np.column_stack([np.ones_like(along), along, 0 * along])
    quarter_turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # of row vectors, from x to y
    sides = [side]
    for _ in range(3):
        sides.append(sides[-1] @ quarter_turn)
    return np.concatenate(sides)


def fall_off(rois: RoiStack, centres_px: Floats, camera: Camera, factors: Ints | None = None) -> Floats:
    """Fall-off (cells,) of the lens's light in the pixels of n regions, 1 at the LED images' centres (n, 2).

    `factors` (n,) are the pixels of the regions per pixel of the sensor along each axis, 1 if None. A pixel outside the
    lens's valid range gets no light.
    """
    k = np.arange(FALL_OFF_NODES)
    nodes = np.cos(np.pi * (k + 0.5) / FALL_OFF_NODES)
    steps = np.ones(len(rois.rows), dtype=np.int64) if factors is None else factors
    low = np.stack([rois.columns, rois.rows], axis=1) / steps[:, None]
    size = np.stack([rois.widths, rois.heights], axis=1) / steps[:, None]
    at = low[:, None] + size[:, None] * (1 + nodes[:, None]) / 2  # (n, nodes, 2)
    shape = (len(low), FALL_OFF_NODES, FALL_OFF_NODES)
    u, v = np.broadcast_to(at[:, None, :, 0], shape), np.broadcast_to(at[:, :, None, 1], shape)
    values = relative_illumination(np.column_stack([u.ravel(), v.ravel()]), camera).reshape(shape)
    values = np.nan_to_num(values / relative_illumination(centres_px, camera)[:, None, None])
    cells = np.zeros(rois.cells())
    for roi, value in enumerate(values):
        columns, rows = (_interpolation(int(size)) for size in (rois.widths[roi], rois.heights[roi]))
        rois.roi(cells, roi)[:] = rows @ value @ columns.T
    return cells


@lru_cache(maxsize=512)
def _interpolation(pixels: int) -> Floats:
    """Lagrange's polynomials of the FALL_OFF_NODES at the centres of pixels along a line, (pixels, nodes)."""
    k = np.arange(FALL_OFF_NODES)
    # Barycentric weights of Chebyshev's first-kind nodes.
    barycentric = (-1.0) ** k * np.sin(np.pi * (k + 0.5) / FALL_OFF_NODES)
    offset = ((2 * np.arange(pixels) + 1) / pixels - 1)[:, None] - np.cos(np.pi * (k + 0.5) / FALL_OFF_NODES)
    on_node = np.abs(offset) < 1e-14
    weights = barycentric / np.where(on_node, 1.0, offset)
    weights = np.where(on_node.any(axis=1, keepdims=True), on_node, weights)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class RenderedLeds:
    """LED images under one pose: `light` (cells,) in each cell of a region stack.

    The light of a pixel inside an LED image is the lens's fall-off there, 1 at the LED image's centre. `parameters`
    (p,) are those that derivatives are by.
    """

    light: Floats
    parameters: Ints
    _rois: RoiStack
    _pieces: EdgePieces
    _lens: LensBlur
    _slope_blur: RegionBlur | None

    def by_shift_and_size(self) -> "RenderedLeds":
        """The same images, with derivatives by the principal point, which shifts them, and by the size alone."""
        pieces = self._pieces
        shifts = pieces.shifts * self._lens.factors[pieces.roi]
        of_size = pieces.slopes[self.parameters == SIZE_PARAMETER]
        return replace(
            self,
            parameters=np.array([*PRINCIPAL_POINT, SIZE_PARAMETER]),
            _pieces=replace(pieces, slopes=np.concatenate([shifts, of_size])),
        )

    def slopes(self, cells: Ints) -> Floats:
        """Derivatives of the light in n cells by the p parameters of the model, (n, p)."""
        pieces, lens, blur = self._pieces, self._lens, self._slope_blur
        if blur is None:
            index = np.full(self._rois.cells(), len(cells))
            index[cells] = np.arange(len(cells))
            at = index[self._rois.cell(pieces.roi, pieces.row, pieces.column)]
            sums = np.empty((len(pieces.slopes), len(cells)))
            for parameter, slope in enumerate(pieces.slopes):
                sums[parameter] = np.bincount(at, slope, len(cells) + 1)[:-1]
            return sums.T
        coarsening = (lens.factors // lens.slope_factors)[pieces.roi]
        at = blur.fine.cell(pieces.roi, pieces.row // coarsening, pieces.column // coarsening)
        slopes = np.empty((len(cells), len(pieces.slopes)))
        for parameter, slope in enumerate(pieces.slopes):
            sharp = np.bincount(at, slope / coarsening**2, blur.fine.cells())
            slopes[:, parameter] = blur(np.asarray(sharp, dtype=np.float64))[cells]
        return slopes


class LedImageModel:
    """Image model of LEDs, for states near the one that their footprints were computed for.

    `rois` holds a region of interest for each LED, in pixels of the sensor; `fall_off` (cells,) the lens's fall-off in
    them, 1 at the LED images' centres.
    """

    def __init__(
        self, leds: Sequence[Led], footprints: LedFootprints, camera: Camera, lens: LensBlur, rois: RoiStack
    ) -> None:
        """Prepare to render LEDs that are all imaged completely; `lens` is for their depths."""
        self.rois = rois
        self.fall_off = fall_off(rois, footprints.centre, camera)
        self._camera = camera
        self._lens = lens
        self._blur = self._slope_blur = None
        self._fine, self._fine_fall_off = rois, self.fall_off
        if lens.kernels:
            first = np.floor(footprints.low).astype(np.int64) - SHARP_MARGIN_PX
            size = np.ceil(footprints.high).astype(np.int64) + SHARP_MARGIN_PX - first
            sharp = RoiStack(first[:, 1], first[:, 0], size[:, 1], size[:, 0])
            self._blur = RegionBlur(sharp, rois, lens.kernels, lens.factors)
            self._slope_blur = RegionBlur(sharp, rois, lens.slope_kernels, lens.slope_factors)
            self._fine = self._blur.fine
            self._fine_fall_off = fall_off(self._fine, footprints.centre, camera, lens.factors)
        needed = np.maximum(MIN_POINTS, EDGE_MARGIN * footprints.max_edge_px * COARSE_POINTS / MAX_EDGE_PX)
        counts = 4 * np.ceil(needed * lens.factors / 4).astype(np.int64)
        last = np.cumsum(counts)
        self._following = np.arange(1, last[-1] + 1)
        self._following[last - 1] = last - counts
        self._led = np.repeat(np.arange(len(leds)), counts)
        self._rims_m = np.concatenate([rim(led, n) for led, n in zip(leds, counts.tolist(), strict=True)])
        self._centres_m = np.array([led.position_m for led in leds])

    def render(self, state: ImageState, parameters: Ints = POSE_ALONE) -> RenderedLeds:
        """Images of all LEDs under a state, each alone in its region.

        `parameters` are those of the IMAGE_PARAMETERS and MOTION_COLUMNS that derivatives are by.
        """
        lens, factors = self._lens, self._lens.factors[self._led]
        offsets_m = state.of(self._led).rims_m(self._rims_m[:, None])[:, 0]
        rims = state.project((self._centres_m + state.shifts_m)[self._led] + offsets_m)
        slopes = _slopes(rims, offsets_m, state.camera, parameters)
        outlines = Outlines(rims.pixels * factors[:, None], self._following, self._led, slopes * factors)
        covered, pieces = cover(self._fine, outlines)
        light = covered * self._fine_fall_off
        pieces = pieces.times(self._fine_fall_off[self._fine.cell(pieces.roi, pieces.row, pieces.column)])
        if self._blur is not None:
            light = self._blur(light)
        return RenderedLeds(light, parameters, self.rois, pieces, lens, self._slope_blur)


def _slopes(rims: ProjectedPoints, offsets_m: Floats, camera: Camera, parameters: Ints) -> Floats:
    """Derivatives (2, p, n) of points of rims by parameters (p,); `offsets_m` (n, 3) are from their LEDs' centres."""
    # A point of the face moves its image as much as the camera moves it by the opposite way.
    by_size = -np.einsum("nij,nj->ni", rims.slopes[:, :, :3], offsets_m)[:, :, None]
    blocks = {0: rims.slopes, SIZE_PARAMETER: by_size}
    if (parameters > SIZE_PARAMETER).any():
        blocks[SIZE_PARAMETER + 1] = -rims.slopes[:, :, 2:3] * offsets_m[:, None, :2]
    if ((parameters >= POSE_PARAMETERS) & (parameters < SIZE_PARAMETER)).any():
        blocks[POSE_PARAMETERS] = intrinsic_slopes_px(rims.p_cam, camera.normalized(rims.pixels), camera)
    if rims.motion_slopes is not None:
        blocks[LOCAL_PARAMETERS] = rims.motion_slopes
    slopes = np.zeros((2, len(parameters), len(offsets_m)))
    for first, block in blocks.items():
        for column, parameter in enumerate(parameters.tolist()):
            if first <= parameter < first + block.shape[2]:
                slopes[:, column] = block[:, :, parameter - first].T
    return slopes
