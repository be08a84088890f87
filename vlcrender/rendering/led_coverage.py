"""Pixel coverage of one LED: the exact share of each pixel's area that the image of its face covers.

A pixel's corners are mapped through the camera onto the LED's plane. There the LED is a disc or a rectangle and the
pixel a quadrilateral; the area they share over the area of the quadrilateral is the pixel's coverage, but for the
change of scale within the pixel: where the plane's area in a pixel changes by a relative g from one pixel to the next,
an image edge through the middle of a pixel leaves an error of g / 8. g is up to 6e-4 for a camera of 15 000 px of focal
length and 0.016 for one of 600 px. From MIN_SCALE_CHANGE on it counts, to first order.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import SENSOR_MARGIN
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.core.face_profile import FaceProfile
from vlcrender.core.planar_shapes import (
    BEYOND_HORIZON_M,
    Disc,
    Rectangle,
    corners_of_cells,
    quadrilateral_area,
    quadrilateral_centroid,
)

Array = NDArray[np.float64]

RIM_POINTS = 720
"""Points of a face's outline: their bounding box misses a disc's edge by at most 1e-5 of its radius."""
CELLS_AT_ONCE = 500_000
"""Pixels that are computed together: bounds the memory for an LED as large as the image."""
BLOCK_PX = 16
"""Rows and columns of a block of a large image: those that the face covers whole or not at all have no pixels."""
MIN_SCALE_CHANGE = 1e-3
"""Change of scale from which on it counts: below, a pixel's share of light is off by 1.3e-4 at most."""
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
    """Coverage of a region in blocks of BLOCK_PX x BLOCK_PX pixels from its first; the last may extend beyond it."""

    whole: NDArray[np.bool_]
    """(m, n), blocks that the face covers whole."""
    mixed: NDArray[np.bool_]
    """(m, n), other blocks of which the face may cover a part."""
    parts: Array
    """Coverage of the pixels of those, (k, BLOCK_PX, BLOCK_PX)."""

    def area_px(self, roi: Roi) -> float:
        """Sum of the coverage of the region's pixels; `parts` have none beyond it."""
        rows, columns = (
            np.minimum(BLOCK_PX, size - BLOCK_PX * np.arange(count))
            for size, count in zip(roi.shape, self.whole.shape, strict=True)
        )
        return float((rows[:, None] * columns * self.whole).sum() + self.parts.sum())

    def within(self, inner: Roi, roi: Roi) -> Array:
        """Coverage of a part of the region, (rows, columns)."""
        (top, bottom), (left, right) = (
            (inside.start // BLOCK_PX, -(-inside.stop // BLOCK_PX)) for inside in roi.slices(inner)
        )
        number = np.cumsum(self.mixed).reshape(self.mixed.shape) - 1
        blocks = np.zeros((bottom - top, right - left, BLOCK_PX, BLOCK_PX))
        blocks[self.whole[top:bottom, left:right]] = 1.0
        mixed = self.mixed[top:bottom, left:right]
        blocks[mixed] = self.parts[number[top:bottom, left:right][mixed]]
        pixels = blocks.swapaxes(1, 2).reshape((bottom - top) * BLOCK_PX, (right - left) * BLOCK_PX)
        rows, columns = roi.slices(inner)
        return pixels[
            rows.start - top * BLOCK_PX : rows.stop - top * BLOCK_PX,
            columns.start - left * BLOCK_PX : columns.stop - left * BLOCK_PX,
        ]

    def reduce(self, light: NDArray[Any]) -> None:
        """Multiply the light of pixels covered whole, (rows, columns), by their coverage."""
        for number, lit in enumerate(self.whole | self.mixed):
            row_of_blocks = light[number * BLOCK_PX : (number + 1) * BLOCK_PX]
            for start, end in _runs(~lit):
                row_of_blocks[:, start * BLOCK_PX : end * BLOCK_PX] = 0
        first_row, first_column = np.nonzero(self.mixed)
        rows, columns = np.broadcast_arrays(
            (first_row * BLOCK_PX)[:, None, None] + np.arange(BLOCK_PX)[:, None],
            (first_column * BLOCK_PX)[:, None, None] + np.arange(BLOCK_PX),
        )
        inside = (rows < light.shape[0]) & (columns < light.shape[1])
        light[rows[inside], columns[inside]] *= self.parts[inside]


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
        if isinstance(self.pixels, np.ndarray):
            return self.pixels
        coverage = np.ones(self.roi.shape)
        self.reduce(coverage)
        return coverage

    def within(self, roi: Roi) -> "LedCoverage":
        """The coverage of a part of the region, pixel by pixel."""
        inside, profile = self.roi.slices(roi), self.profile
        pixels = self.pixels
        return replace(
            self,
            roi=roi,
            pixels=pixels.within(roi, self.roi) if isinstance(pixels, CoverageBlocks) else pixels[inside],
            profile=profile if isinstance(profile, float) else profile[inside],
        )

    @property
    def area_px(self) -> float:
        """Sum of the coverage of all pixels."""
        if isinstance(self.pixels, CoverageBlocks):
            return self.pixels.area_px(self.roi)
        return float(self.pixels.sum())

    def reduce(self, light: NDArray[Any]) -> None:
        """Multiply the light of pixels covered whole, (rows, columns), by their coverage."""
        if isinstance(self.pixels, CoverageBlocks):
            self.pixels.reduce(light)
        else:
            light *= self.pixels


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
    if image.area_px == 0:
        return None
    if (low < 0).any() or (high > size).any():
        sensor = Roi.of_sensor(camera)
        on_sensor_px = image.area_px
        if not sensor.contains(image.roi):
            both = image.roi.intersection(sensor) if sensor.overlaps(image.roi) else Roi(row, column, 0, 0)
            on_sensor_px = float(image.coverage[image.roi.slices(both)].sum())
        fraction = min(on_sensor_px / face.shape.image_area_px(outline), 1.0)
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
    change = _scale_change(posed, face)
    if face.profile is None and min(columns, rows) > MIN_BLOCKS * BLOCK_PX:
        blocks = _coverage_in_blocks(posed, face, first, last, change)
        if blocks is not None:
            return blocks, 1.0
    band = max(1, CELLS_AT_ONCE // int(columns))
    parts = []
    for start in range(0, int(rows), band):
        v = np.arange(first[1] + start, first[1] + min(start + band, int(rows)) + 1, dtype=float)
        u = np.arange(first[0], last[0] + 1, dtype=float)
        parts.append(_coverage_of_band(posed, face, u, v, change))
    if len(parts) == 1:
        return parts[0]
    profile = 1.0 if face.profile is None else np.concatenate([np.asarray(profile) for _, profile in parts])
    return np.concatenate([coverage for coverage, _ in parts]), profile


def _scale_change(posed: PosedCamera, face: LedFace) -> Array | None:
    """Relative change, by a pixel along u and along v, of the area in the face's plane that a pixel at its centre has,
    (2,); None below MIN_SCALE_CHANGE and at the horizon.
    """
    if posed.camera.lens_projection.keeps_lines_straight:
        # The area is proportional to the depth cubed, and 1 / depth is linear in the pixels.
        depth_m = float(posed.rotation[2] @ (face.center_m - posed.position_m))
        height_m = float(face.center_m[2] - posed.position_m[2])
        by_pixel = np.array(posed.camera.inverse_matrix())[:2, :2]
        change = -3 * depth_m / height_m * (posed.rotation[:2, 2] @ by_pixel)
    else:
        u, v = posed.project(face.center_m)
        around = np.array([-1.0, 0.0, 1.0])
        x, y = intersections_with_plane(posed, face.center_m, u + around[None, :], v + around[:, None])
        if max(np.abs(x).max(), np.abs(y).max()) >= BEYOND_HORIZON_M:
            return None
        areas = quadrilateral_area(_quads(x, y, np.ones((2, 2), dtype=bool))).reshape(2, 2)
        (left, right), (top, bottom) = areas.sum(axis=0), areas.sum(axis=1)
        change = np.log([right / left, bottom / top])
    return change if np.hypot(*change) >= MIN_SCALE_CHANGE else None


def _coverage_of_band(
    posed: PosedCamera, face: LedFace, u: Array, v: Array, change: Array | None = None
) -> tuple[Array, Array | float]:
    x, y = intersections_with_plane(posed, face.center_m, u[None, :], v[:, None])
    whole, mixed = face.shape.whole_and_mixed(x, y)
    quads = _quads(x, y, mixed)
    coverage = _coverage_of_cells(face, whole, mixed, quads, change)
    if face.profile is None:
        return coverage, 1.0
    profile = np.ones(coverage.shape)
    profile[mixed] = face.profile.mean_of(face.shape.shared_moments(quads), quads)
    profile[whole] = face.profile.mean_over(_quads(x, y, whole))
    return coverage, profile


def _coverage_in_blocks(
    posed: PosedCamera, face: LedFace, first: Array, last: Array, change: Array | None
) -> CoverageBlocks | None:
    """Coverage of the pixels from `first` to before `last`, both (column, row).

    Where images of straight lines are straight, a block is a quadrilateral in the face's plane, as a pixel is: it is
    inside the face, which is convex, if its corners are. None for other lenses, and where a block meets the horizon.
    """
    if not posed.camera.lens_projection.keeps_lines_straight:
        return None
    u, v = (np.arange(start, end + BLOCK_PX, BLOCK_PX, dtype=float) for start, end in zip(first, last, strict=True))
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
    beyond = v[row, None] + corners[:-1] >= last[1], u[column, None] + corners[:-1] >= last[0]
    for pixels in (whole_pixels, mixed_pixels):
        pixels[beyond[0][:, :, None] | beyond[1][:, None, :]] = False
    parts = _coverage_of_cells(face, whole_pixels, mixed_pixels, _quads(x, y, mixed_pixels), change)
    return CoverageBlocks(whole, mixed, parts)


def _coverage_of_cells(
    face: LedFace, whole: NDArray[np.bool_], mixed: NDArray[np.bool_], quads: Array, change: Array | None
) -> Array:
    """Coverage of cells: masks of `whole_and_mixed`, and the quadrilaterals of mixed cells in the face's plane.

    `change` is that of scale, by which an area of the plane fills less of its pixel the farther it is along it.
    """
    coverage = whole.astype(float)
    if change is None:
        shares = face.shape.shared_area(quads) / quadrilateral_area(quads)
    else:
        area, x, y, _ = face.shape.shared_moments(quads)
        part = np.stack([x, y], axis=1) / np.maximum(area, np.finfo(float).tiny)[:, None]
        # A part whose moments are rounding is anywhere in its cell.
        part = np.clip(part, quads.min(axis=1), quads.max(axis=1))
        offsets_px = _in_pixels(part - quadrilateral_centroid(quads), quads)
        shares = area / quadrilateral_area(quads) * np.exp(-offsets_px @ change)
    coverage[mixed] = np.clip(shares, 0.0, 1.0)
    return coverage


def _in_pixels(offsets: Array, quads: Array) -> Array:
    """Offsets (n, 2) in the face's plane as pixels along u and v, in the cell (n, 4, 2) of each."""
    a, b, c, d = np.moveaxis(quads, 1, 0)
    along_u, along_v = b - a + c - d, d - a + c - b  # of two pixels each
    both = along_u[:, 0] * along_v[:, 1] - along_u[:, 1] * along_v[:, 0]
    u = offsets[:, 0] * along_v[:, 1] - offsets[:, 1] * along_v[:, 0]
    v = along_u[:, 0] * offsets[:, 1] - along_u[:, 1] * offsets[:, 0]
    pixels: Array = 2 * np.stack([u, v], axis=1) / both[:, None]
    return pixels


def _runs(chosen: NDArray[np.bool_]) -> list[list[int]]:
    """First number of each run of chosen ones, and the number after its last."""
    edges = np.flatnonzero(np.diff(chosen, prepend=False, append=False))
    runs: list[list[int]] = edges.reshape(-1, 2).tolist()
    return runs


def _quads(x: Array, y: Array, cells: NDArray[np.bool_]) -> Array:
    """Corners (n, 4, 2) of the cells that a mask (..., rows, columns) selects; x, y: (..., rows + 1, columns + 1)."""
    return np.stack([corners_of_cells(x, cells), corners_of_cells(y, cells)], axis=-1)


def intersections_with_plane(posed: PosedCamera, center_m: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Where the rays of pixel positions u and v, which broadcast, meet an LED's plane: (x, y) in m from its centre.

    center_m: (3,), world. Rays that do not go up meet the plane beyond BEYOND_HORIZON_M.
    """
    return met_by_rays(posed, center_m, *posed.ray_world(u, v))


def met_by_rays(posed: PosedCamera, center_m: Array, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
    """`intersections_with_plane` of rays from a camera, in directions (x, y, z) of the world."""
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
