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
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from estimator.camera.intrinsics import CAMERA_PARAMETERS, intrinsic_slopes_px
from estimator.camera.motion import MOTION_PARAMETERS
from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.camera.projection import ProjectedPoints, project, projection_of, relative_illumination
from estimator.camera.rolling_projection import project_rolling
from estimator.compiled import compiled
from estimator.io.camera import Camera
from estimator.io.led_map import Led
from estimator.pixels.polygon_raster import MAX_EDGE_PX, EdgePieces, Outlines, RimSlopes, RoiStack, cover, rim_slopes
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
# a polynomial. Over a region of 0.5 rad, cos^4 is then exact to 1e-6 of the light (tested), and so it is by half as
# many nodes where all regions are smaller.
FALL_OFF_NODES = 10
FEW_FALL_OFF_NODES, SMALL_RAD = 5, 0.1


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
    rims_m = state.rims_m(rims_of(leds, COARSE_POINTS)) + centres_m[:, None]
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


def rims_of(leds: Sequence[Led], points: int) -> Floats:
    """Polygons of n faces, (n, points, 3), each as by `rim`."""
    half_widths_m = np.array([led.half_width_m for led in leds])
    return np.asarray(half_widths_m[:, None, None] * np.array([_unit_rim(led.shape, points) for led in leds]))


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
    steps = np.ones(len(rois.rows), dtype=np.int64) if factors is None else factors
    largest_px = float((np.maximum(rois.heights, rois.widths) / steps).max())
    count = FEW_FALL_OFF_NODES if largest_px * camera.pixel_angle_rad < SMALL_RAD else FALL_OFF_NODES
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    low = np.stack([rois.columns, rois.rows], axis=1) / steps[:, None]
    size = np.stack([rois.widths, rois.heights], axis=1) / steps[:, None]
    at = low[:, None] + size[:, None] * (1 + nodes[:, None]) / 2  # (n, nodes, 2)
    shape = (len(low), count, count)
    u, v = np.broadcast_to(at[:, None, :, 0], shape), np.broadcast_to(at[:, :, None, 1], shape)
    values = relative_illumination(np.column_stack([u.ravel(), v.ravel()]), camera).reshape(shape)
    values = np.nan_to_num(values / relative_illumination(centres_px, camera)[:, None, None])
    return _interpolated(np.ascontiguousarray(values), nodes, rois.heights, rois.widths, rois.starts)


@compiled
def _interpolated(values: Floats, nodes: Floats, heights: Ints, widths: Ints, starts: Ints) -> Floats:
    """Polynomials in the pixels of n regions, (cells,), 0 beyond their ends, with `values` (n, q, q) at q x q nodes.

    The `nodes` (q,) are Chebyshev's of the first kind on (-1, 1), the extent of each region.
    """
    cells, count = np.zeros(starts[-1]), len(nodes)
    for k in range(len(heights)):
        of_columns, of_rows = _lagrange(widths[k], nodes), _lagrange(heights[k], nodes)
        for row in range(heights[k]):
            first = starts[k] + row * (widths[k] + 1)
            line = cells[first : first + widths[k]]
            for q in range(count):
                weight, polynomial = 0.0, of_columns[q]
                for p in range(count):
                    weight += of_rows[p, row] * values[k, p, q]
                for i in range(len(line)):
                    line[i] += weight * polynomial[i]
    return cells


@compiled
def _lagrange(pixels: int, nodes: Floats) -> Floats:
    """Lagrange's polynomials of Chebyshev nodes (q,) at the centres of pixels along a line, (q, pixels)."""
    weights = np.empty((len(nodes), pixels))
    for pixel in range(pixels):
        at, total, on_node = (2 * pixel + 1) / pixels - 1, 0.0, -1
        for k in range(len(nodes)):
            if abs(at - nodes[k]) < 1e-14:
                on_node = k
        for k in range(len(nodes)):
            # Barycentric weights of Chebyshev's first-kind nodes: alternating sines of the nodes' angles.
            weight = np.sqrt(1 - nodes[k] * nodes[k]) * (1 - 2 * (k % 2)) / (at - nodes[k])
            weights[k, pixel] = weight if on_node < 0 else 1.0 if k == on_node else 0.0
            total += weights[k, pixel]
        for k in range(len(nodes)):
            weights[k, pixel] /= total
    return weights


@dataclass(frozen=True, eq=False)
class RenderedLeds:
    """LED images under one pose: `light` (cells,) in each cell of a region stack.

    The light of a pixel inside an LED image is the lens's fall-off there, 1 at the LED image's centre. `parameters`
    (p,) are those that derivatives are by.
    """

    light: Floats
    parameters: Ints
    _model: "LedImageModel"
    _camera: Camera
    _rims: ProjectedPoints
    _offsets_m: Floats
    _outlines: Outlines
    _pieces: EdgePieces

    def by(self, parameters: Ints) -> "RenderedLeds":
        """The same images, with derivatives by other parameters."""
        return replace(self, parameters=parameters)

    def slopes(self, cells: Ints) -> Floats:
        """Derivatives of the light in n cells by the p parameters, (n, p)."""
        place, of_places = self.places_of_slopes(cells)
        slopes = np.zeros((len(cells), len(self.parameters)))
        slopes[place >= 0] = of_places[place[place >= 0]]
        return slopes

    def places_of_slopes(self, cells: Ints) -> tuple[Ints, Floats]:
        """Derivatives (m, p), and the place (n,) of each of n cells among them, -1 for a cell that has none."""
        sharp, blur = self._sharp_slopes, self._model.slope_blur
        if blur is None:
            place = self._model.place
            place[sharp.cells] = np.arange(len(sharp.cells))
            places = place[cells]
            place[sharp.cells] = -1
            return places, sharp.slopes
        lens = self._model.lens
        coarsening = (lens.factors // lens.slope_factors)[sharp.roi]
        row, column = self._model.fine.pixels(sharp.roi, sharp.cells)
        at = blur.fine.cell(sharp.roi, row // coarsening, column // coarsening)
        slopes = np.empty((len(cells), len(self.parameters)))
        for parameter, slope in enumerate(sharp.slopes.T):
            image = np.bincount(at, slope / coarsening**2, blur.fine.cells())
            slopes[:, parameter] = blur(np.asarray(image, dtype=np.float64))[cells]
        return np.arange(len(cells)), slopes

    @cached_property
    def _sharp_slopes(self) -> RimSlopes:
        """Derivatives of the images without blur, on pixels subdivided by the lens's factors."""
        model, rims, wanted = self._model, self._rims, self.parameters
        intrinsic = motion = np.empty((len(rims.pixels), 2, 0))
        found = [POSE_ALONE, np.array([SIZE_PARAMETER])]
        if ((wanted >= POSE_PARAMETERS) & (wanted < SIZE_PARAMETER)).any():
            intrinsic = intrinsic_slopes_px(rims.p_cam, self._camera.normalized(rims.pixels), self._camera)
            found.insert(1, np.arange(POSE_PARAMETERS, SIZE_PARAMETER))
        tilts = bool(np.isin(TILT_PARAMETERS, wanted).any())
        if tilts:
            found.append(np.array(TILT_PARAMETERS))
        if (wanted >= LOCAL_PARAMETERS).any() and rims.motion_slopes is not None:
            motion = rims.motion_slopes
            found.append(MOTION_COLUMNS)
        outlines, factors = self._outlines, model.lens.factors[self._outlines.roi]
        edges = outlines.points, outlines.following, factors
        swept = _swept(*edges, rims.slopes, self._offsets_m, intrinsic, motion, tilts)
        slopes = rim_slopes(outlines, self._pieces, swept, model.fine_fall_off, model.place)
        every = np.concatenate(found)
        if np.array_equal(every, wanted):
            return slopes
        # Profile parameters have none.
        columns = np.zeros((len(slopes.slopes), len(wanted)))
        has = np.isin(wanted, every)
        columns[:, has] = slopes.slopes[:, np.searchsorted(every, wanted[has])]
        return replace(slopes, slopes=columns)


class LedImageModel:
    """Image model of LEDs, for states near the one that their footprints were computed for.

    `rois` holds a region of interest for each LED, in pixels of the sensor; `fall_off` (cells,) the lens's fall-off in
    them, 1 at the LED images' centres. `lens` is the blur; on the subdivided pixels `fine` that it needs the fall-off
    is `fine_fall_off`, and derivatives are blurred by `slope_blur`. `place` is memory of -1 for each of the fine cells.
    """

    def __init__(
        self, leds: Sequence[Led], footprints: LedFootprints, camera: Camera, lens: LensBlur, rois: RoiStack
    ) -> None:
        """Prepare to render LEDs that are all imaged completely; `lens` is for their depths."""
        self.rois = rois
        self.fall_off = fall_off(rois, footprints.centre, camera)
        self._camera = camera
        self.lens = lens
        self._blur = self.slope_blur = None
        self.fine, self.fine_fall_off = rois, self.fall_off
        if lens.kernels:
            first = np.floor(footprints.low).astype(np.int64) - SHARP_MARGIN_PX
            size = np.ceil(footprints.high).astype(np.int64) + SHARP_MARGIN_PX - first
            sharp = RoiStack(first[:, 1], first[:, 0], size[:, 1], size[:, 0])
            self._blur = RegionBlur(sharp, rois, lens.kernels, lens.factors)
            self.slope_blur = RegionBlur(sharp, rois, lens.slope_kernels, lens.slope_factors)
            self.fine = self._blur.fine
            self.fine_fall_off = fall_off(self.fine, footprints.centre, camera, lens.factors)
        self.place = np.full(self.fine.cells(), -1)
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
        centres_m = self._centres_m + state.shifts_m
        offsets_m, points_m = _rim_points(self._rims_m, self._led, centres_m, state.sizes, state.tilts)
        rims = state.project(points_m)
        outlines = Outlines(rims.pixels * self.lens.factors[self._led, None], self._following, self._led)
        covered, pieces = cover(self.fine, outlines, self.fine_fall_off)
        light = covered if self._blur is None else self._blur(covered)
        return RenderedLeds(light, parameters, self, state.camera, rims, offsets_m, outlines, pieces)


@compiled
def _rim_points(level_m: Floats, led: Ints, centres_m: Floats, sizes: Floats, tilts: Floats) -> tuple[Floats, Floats]:
    """Points of rims from their LEDs' centres, and in the world, both (m, 3), from those of level faces by the map.

    Point i is of LED led[i] of n, whose centres (n, 3), sizes (n,) and tilts (n, 2) are those of an `ImageState`.
    """
    offsets_m, points_m = np.empty_like(level_m), np.empty_like(level_m)
    for i in range(len(level_m)):
        k = led[i]
        for axis in range(3):
            offsets_m[i, axis] = level_m[i, axis] * sizes[k]
        offsets_m[i, 2] += offsets_m[i, 0] * tilts[k, 0] + offsets_m[i, 1] * tilts[k, 1]
        for axis in range(3):
            points_m[i, axis] = centres_m[k, axis] + offsets_m[i, axis]
    return offsets_m, points_m


@compiled
def _swept(
    points: Floats,
    following: Ints,
    factors: Ints,
    pose: Floats,
    offsets_m: Floats,
    intrinsic: Floats,
    motion: Floats,
    with_tilts: bool,
) -> Floats:
    """Areas (n, p) that edges of outlines sweep as they move with each of p parameters, as `rim_slopes` takes them.

    The parameters are those of the pose, then where they are wanted of the intrinsics, the size, the two tilts where
    they are wanted, and the motion. Of the n `points` (n, 2) of the outlines, in pixels finer by `factors` (n,), the
    derivatives in pixels of the sensor are `pose` (n, 2, 6), `intrinsic` (n, 2, 7) or (n, 2, 0), and `motion` (n, 2, 6)
    or (n, 2, 0). `offsets_m` (n, 3) are the points from their LEDs' centres.
    """
    of_pose, of_camera, of_motion = pose.shape[2], intrinsic.shape[2], motion.shape[2]
    size = of_pose + of_camera
    last = size + 1 + (2 if with_tilts else 0)
    swept = np.empty((len(points), last + of_motion))
    for i in range(len(points)):
        j, row = following[i], swept[i]
        # Half the edge, since the velocity at its middle is half the sum of both ends': over so short an edge it is
        # constant.
        half = factors[i] / 2
        du, dv = (points[j, 0] - points[i, 0]) * half, (points[j, 1] - points[i, 1]) * half
        for q in range(of_pose):
            row[q] = (pose[i, 0, q] + pose[j, 0, q]) * dv - (pose[i, 1, q] + pose[j, 1, q]) * du
        for q in range(of_camera):
            of_u, of_v = intrinsic[i, 0, q] + intrinsic[j, 0, q], intrinsic[i, 1, q] + intrinsic[j, 1, q]
            row[of_pose + q] = of_u * dv - of_v * du
        # A point of the face moves its image as much as the camera moves it by the opposite way.
        row[size] = 0.0
        for axis in range(3):
            of_u = pose[i, 0, axis] * offsets_m[i, axis] + pose[j, 0, axis] * offsets_m[j, axis]
            of_v = pose[i, 1, axis] * offsets_m[i, axis] + pose[j, 1, axis] * offsets_m[j, axis]
            row[size] += of_v * du - of_u * dv
        for axis in range(2 if with_tilts else 0):
            of_u = pose[i, 0, 2] * offsets_m[i, axis] + pose[j, 0, 2] * offsets_m[j, axis]
            of_v = pose[i, 1, 2] * offsets_m[i, axis] + pose[j, 1, 2] * offsets_m[j, axis]
            row[size + 1 + axis] = of_v * du - of_u * dv
        for q in range(of_motion):
            row[last + q] = (motion[i, 0, q] + motion[j, 0, q]) * dv - (motion[i, 1, q] + motion[j, 1, q]) * du
    return swept
