"""Pixel coverage of one LED: the exact share of each pixel's area that the image of its face covers.

A pixel's corners are mapped through the camera onto the LED's plane. There the LED is a disc or a rectangle and the
pixel a quadrilateral; the area they share over the area of the quadrilateral is the pixel's coverage. This is the mean
over the pixel's area except for the change of scale within a pixel: 1e-4 for a camera of 15 000 px of focal length,
less than 1e-3 for one of 400 px; more only where a ray of a fish-eye lens is almost parallel to the LED's plane.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import SENSOR_MARGIN
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.core.face_profile import FaceProfile
from vlcrender.core.planar_shapes import BEYOND_HORIZON_M, Disc, Rectangle, corners_of_cells, quadrilateral_area

Array = NDArray[np.float64]

RIM_POINTS = 720
"""Points of a face's outline: their bounding box misses a disc's edge by at most 1e-5 of its radius."""
CELLS_AT_ONCE = 500_000
"""Pixels that are computed together: bounds the memory for an LED as large as the image."""
BLOCK_PX = 16
"""Rows and columns of a block of a large image: those that the face covers whole or not at all have no pixels."""
MIN_BLOCKS = 16
"""Blocks across and down from which on an image is computed in blocks."""


@dataclass(frozen=True)
class LedFace:
    """A luminous horizontal face that faces down: centre (3,), world, m, shape, and luminance profile unless even."""

    center_m: Array
    shape: Disc | Rectangle
    profile: FaceProfile | None = None


@dataclass(frozen=True)
class CoverageBlocks:
    """Coverage of a region in blocks of BLOCK_PX x BLOCK_PX pixels; those at its border extend beyond it.

    Blocks start at multiples of BLOCK_PX, so that images of several LEDs have their blocks in the same rows.
    """

    row: int
    column: int
    """First pixel of the first block."""
    whole: NDArray[np.bool_]
    """(m, n), blocks that the face covers whole."""
    numbers: NDArray[np.int64]
    """(m, n), numbers in `parts` of other blocks of which the face may cover a part; -1 for the rest."""
    parts: Array
    """Coverage of the pixels of those blocks, (k, BLOCK_PX, BLOCK_PX)."""

    def image(self, roi: Roi) -> Array:
        """Coverage of some of the pixels, (rows, columns)."""
        top, left = (roi.row - self.row) // BLOCK_PX, (roi.column - self.column) // BLOCK_PX
        bottom, right = (roi.end_row - self.row - 1) // BLOCK_PX + 1, (roi.end_column - self.column - 1) // BLOCK_PX + 1
        whole, numbers = self.whole[top:bottom, left:right], self.numbers[top:bottom, left:right]
        mixed = numbers >= 0
        pixels = np.zeros((bottom - top, BLOCK_PX, right - left, BLOCK_PX))
        blocks = pixels.swapaxes(1, 2)
        blocks[whole] = 1.0
        blocks[mixed] = self.parts[numbers[mixed]]
        inside = roi.row - self.row - top * BLOCK_PX, roi.column - self.column - left * BLOCK_PX
        outer = Roi(roi.row - inside[0], roi.column - inside[1], pixels.shape[0] * BLOCK_PX, (right - left) * BLOCK_PX)
        image: Array = pixels.reshape(outer.rows, outer.columns)[outer.slices(roi)]
        return image


@dataclass(frozen=True)
class LedCoverage:
    """Coverage of the pixels of a region around one LED image."""

    roi: Roi
    pixels: Array | CoverageBlocks
    """Coverage of each pixel, (rows, columns), or that of a large image in blocks."""
    visible_fraction: float
    """Share of the area of the LED's whole image that is on the sensor."""
    profile: Array | float = 1.0
    """Luminance over the face's mean, averaged over the covered part of each pixel."""

    @property
    def coverage(self) -> Array:
        """Coverage of each pixel, (rows, columns); made anew for an image in blocks."""
        return self.coverage_in(self.roi)

    def coverage_in(self, roi: Roi) -> Array:
        """Coverage of some of the pixels, (rows, columns)."""
        if isinstance(self.pixels, CoverageBlocks):
            return self.pixels.image(roi)
        return self.pixels[self.roi.slices(roi)]


def coverage_of_led(posed: PosedCamera, face: LedFace, margin_px: int = 0) -> LedCoverage | None:
    """Image of a face, or None where it covers no pixel.

    The region may extend `margin_px` pixels beyond the sensor (row and column may be negative), since blur brings that
    light onto it; with distortion no farther than SENSOR_MARGIN. A face seen from above is not imaged, nor is one that
    a perspective lens has in part beside or behind it.
    """
    camera = posed.camera
    if posed.pose.position_m[2] >= face.center_m[2]:
        return None
    outline = _outline_px(posed, face)
    if outline is None:
        return None
    size = np.array([camera.width_px, camera.height_px])
    low = np.floor(outline.min(axis=0)).astype(int)
    high = np.ceil(outline.max(axis=0)).astype(int)
    margin = np.full(2, margin_px)
    if not camera.lens_projection.extends_beyond_sensor:
        margin = np.minimum(margin, (SENSOR_MARGIN * size).astype(int))
    first, last = np.maximum(low, -margin), np.minimum(high, size + margin)
    if (last <= first).any():
        return None
    column, row, end_column, end_row = (int(edge) for edge in (*first, *last))
    pixels, profile = _coverage(posed, face, first, last)
    image = LedCoverage(Roi(row, column, end_row - row, end_column - column), pixels, 1.0, profile)
    coverage = image.coverage
    if not coverage.any():
        return None
    if (low < 0).any() or (high > size).any():
        on_sensor = coverage[
            max(0, -row) : max(0, camera.height_px - row), max(0, -column) : max(0, camera.width_px - column)
        ]
        fraction = float(min(on_sensor.sum() / face.shape.image_area_px(outline), 1.0))
        return replace(image, visible_fraction=fraction)
    return image


def outline_roi(posed: PosedCamera, face: LedFace) -> Roi | None:
    """The smallest region that contains the image of a face, on the sensor or not; None as in `coverage_of_led`."""
    if posed.pose.position_m[2] >= face.center_m[2]:
        return None
    outline = _outline_px(posed, face)
    if outline is None:
        return None
    column, row = np.floor(outline.min(axis=0)).astype(int).tolist()
    end_column, end_row = np.ceil(outline.max(axis=0)).astype(int).tolist()
    return Roi(row, column, end_row - row, end_column - column)


def _outline_px(posed: PosedCamera, face: LedFace) -> Array | None:
    """Pixel positions of the face's outline; None where the lens does not image it whole."""
    rim = face.shape.rim(RIM_POINTS)
    radius_m = float(np.hypot(rim[:, 0], rim[:, 1]).max())
    points = np.column_stack([rim, np.zeros(len(rim))]) + face.center_m
    p_cam = posed.camera.lens_projection.into_range(posed.camera_coordinates(points), radius_m)
    if p_cam is None:
        return None
    pixels = posed.camera.image_of_points(p_cam)
    return pixels if np.isfinite(pixels).all() else None


def _coverage(
    posed: PosedCamera, face: LedFace, first: Array, last: Array
) -> tuple[Array | CoverageBlocks, Array | float]:
    """Coverage and profile of the pixels from `first` to before `last`, both (column, row), in blocks or bands."""
    columns, rows = last - first
    if face.profile is None and min(columns, rows) > MIN_BLOCKS * BLOCK_PX:
        blocks = _coverage_in_blocks(posed, face, first, last)
        if blocks is not None:
            return blocks, 1.0
    band = max(1, CELLS_AT_ONCE // int(columns))
    parts = []
    for start in range(0, int(rows), band):
        v = np.arange(first[1] + start, first[1] + min(start + band, int(rows)) + 1, dtype=float)
        u = np.arange(first[0], last[0] + 1, dtype=float)
        parts.append(_coverage_of_band(posed, face, u, v))
    if len(parts) == 1:
        return parts[0]
    profile = 1.0 if face.profile is None else np.concatenate([np.asarray(profile) for _, profile in parts])
    return np.concatenate([coverage for coverage, _ in parts]), profile


def _coverage_of_band(posed: PosedCamera, face: LedFace, u: Array, v: Array) -> tuple[Array, Array | float]:
    x, y = intersections_with_plane(posed, face.center_m, u[None, :], v[:, None])
    whole, mixed = face.shape.whole_and_mixed(x, y)
    quads = _quads(x, y, mixed)
    coverage = _coverage_of_cells(face, whole, mixed, quads)
    if face.profile is None:
        return coverage, 1.0
    profile = np.ones(coverage.shape)
    profile[mixed] = face.profile.mean_of(face.shape.shared_moments(quads), quads)
    profile[whole] = face.profile.mean_over(_quads(x, y, whole))
    return coverage, profile


def _coverage_in_blocks(posed: PosedCamera, face: LedFace, first: Array, last: Array) -> CoverageBlocks | None:
    """Coverage of the pixels from `first` to before `last`, both (column, row).

    Where images of straight lines are straight, a block is a quadrilateral in the face's plane, as a pixel is: it is
    inside the face, which is convex, if its corners are. None for other lenses, and where a block meets the horizon.
    """
    if not posed.camera.lens_projection.keeps_lines_straight:
        return None
    u, v = (
        np.arange(start // BLOCK_PX * BLOCK_PX, end + BLOCK_PX, BLOCK_PX, dtype=float)
        for start, end in zip(first, last, strict=True)
    )
    x, y = intersections_with_plane(posed, face.center_m, u[None, :], v[:, None])
    if max(np.abs(x).max(), np.abs(y).max()) >= BEYOND_HORIZON_M:
        return None
    whole, mixed = face.shape.whole_and_mixed(x, y)
    row, column = np.nonzero(mixed)
    corners = np.arange(BLOCK_PX + 1)
    x, y = intersections_with_plane(
        posed, face.center_m, u[column, None, None] + corners[None, :], v[row, None, None] + corners[:, None]
    )
    whole_pixels, mixed_pixels = face.shape.whole_and_mixed(x, y)
    parts = _coverage_of_cells(face, whole_pixels, mixed_pixels, _quads(x, y, mixed_pixels))
    numbers = np.where(mixed, np.cumsum(mixed).reshape(mixed.shape) - 1, -1)
    return CoverageBlocks(int(v[0]), int(u[0]), whole, numbers, parts)


def _coverage_of_cells(face: LedFace, whole: NDArray[np.bool_], mixed: NDArray[np.bool_], quads: Array) -> Array:
    """Coverage of cells: masks of `whole_and_mixed`, and the quadrilaterals of mixed cells in the face's plane."""
    coverage = whole.astype(float)
    coverage[mixed] = np.clip(face.shape.shared_area(quads) / quadrilateral_area(quads), 0.0, 1.0)
    return coverage


def _quads(x: Array, y: Array, cells: NDArray[np.bool_]) -> Array:
    """Corners (n, 4, 2) of the cells that a mask (..., rows, columns) selects; x, y: (..., rows + 1, columns + 1)."""
    return np.stack([corners_of_cells(x, cells), corners_of_cells(y, cells)], axis=-1)


def intersections_with_plane(posed: PosedCamera, center_m: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Where the rays of pixel positions u and v, which broadcast, meet an LED's plane: (x, y) in m from its centre.

    center_m: (3,), world. Rays that do not go up meet the plane beyond BEYOND_HORIZON_M.
    """
    x, y, z = posed.ray_world(u, v)
    position_m = posed.pose.position_m
    upward = z > 1e-9
    all_upward = bool(upward.all())
    height = center_m[2] - position_m[2]
    scale = height / (z if all_upward else np.where(upward, z, 1.0))
    on_x = x * scale + (position_m[0] - center_m[0])
    on_y = y * scale + (position_m[1] - center_m[1])
    if all_upward:
        return on_x, on_y
    return np.where(upward, on_x, 10 * BEYOND_HORIZON_M), np.where(upward, on_y, 10 * BEYOND_HORIZON_M)
