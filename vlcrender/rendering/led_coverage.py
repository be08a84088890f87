"""The image of one LED: how much of each pixel its face covers, exactly.

A pixel's corners are mapped through the camera onto the LED's plane. There the LED is a disc or a rectangle and the
pixel a quadrilateral; the area they share over the area of the quadrilateral is the pixel's coverage. This is the
pixel-area average but for the change of scale within one pixel: 1e-4 for a camera of 15 000 px of focal length, less
than 1e-3 for one of 400; more only where a pixel of a fish-eye lens looks along the LED's plane.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.distortion import fold_radius2
from vlcrender.camera.intrinsics import (
    BEYOND_SENSOR,
    Camera,
    Pose,
    image_of_points,
    pixel_on_sensor,
    ray_of_sensor,
    ray_world,
    transform,
)
from vlcrender.core.planar_shapes import BEYOND_HORIZON_M, Disc, Rectangle, quadrilateral_area

Array = NDArray[np.float64]

RIM_POINTS = 720
"""Of a face's outline: the window around them misses a disc's edge by at most 1e-5 of its radius."""
CELLS_AT_ONCE = 500_000
"""Pixels of a window handled together: bounds the memory that an LED as large as the image takes."""


@dataclass(frozen=True)
class LedCoverage:
    """A window of the sensor around one LED. `coverage` (rows, columns) starts at pixel (row, column)."""

    row: int
    column: int
    coverage: Array
    visible_fraction: float
    """Share of the LED's whole image, by area, that falls on the sensor."""


def coverage_of_led(
    camera: Camera, pose: Pose, center_m: Array, shape: Disc | Rectangle, margin_px: int = 0
) -> LedCoverage | None:
    """Image of a horizontal face that faces down, or None where no pixel sees it.

    center_m: (3,), world. The window may reach `margin_px` pixels beyond the sensor (row and column may be negative),
    since blur brings that light onto it; with distortion no farther than BEYOND_SENSOR. A face that a perspective lens
    has beside or behind it, in part, or that the camera looks down on, is not seen.
    """
    if pose.position_m[2] >= center_m[2]:
        return None
    outline = _outline_px(camera, pose, center_m, shape.rim(RIM_POINTS))
    if outline is None:
        return None
    size = np.array([camera.width_px, camera.height_px])
    low = np.floor(outline.min(axis=0)).astype(int)
    high = np.ceil(outline.max(axis=0)).astype(int)
    margin = np.full(2, margin_px)
    if camera.distortion is not None:
        margin = np.minimum(margin, (BEYOND_SENSOR * size).astype(int))
    first, last = np.maximum(low, -margin), np.minimum(high, size + margin)
    if (last <= first).any():
        return None
    coverage = _coverage(camera, pose, center_m, shape, first, last)
    if not coverage.any():
        return None
    column, row = (int(edge) for edge in first)
    fraction = 1.0
    if (low < 0).any() or (high > size).any():
        on_sensor = coverage[
            max(0, -row) : max(0, camera.height_px - row), max(0, -column) : max(0, camera.width_px - column)
        ]
        fraction = float(min(on_sensor.sum() / shape.image_area_px(outline), 1.0))
    return LedCoverage(row, column, coverage, fraction)


def leds_that_may_be_seen(
    camera: Camera, pose: Pose, centers_m: Array, reaches_m: Array, margin_px: float = 0.0
) -> NDArray[np.int64]:
    """Indices of LEDs that may light a pixel of the sensor or up to `margin_px` beside it: never too few.

    centers_m: (n, 3), world; reaches_m: (n,), from a centre to its face's farthest point. Held against the sphere of
    that radius: perspective, the four planes through the projection centre that hold all the sensor sees; equidistant,
    the cone.
    """
    p_cam = transform(pose.rotation, centers_m - np.array(pose.position_m))
    x, y, z = p_cam[:, 0], p_cam[:, 1], p_cam[:, 2]
    above = centers_m[:, 2] > pose.position_m[2]
    if camera.projection == "equidistant":
        distance = np.sqrt(x * x + y * y + z * z)
        with np.errstate(divide="ignore", invalid="ignore"):
            half_angle = np.arcsin(np.minimum(reaches_m / distance, 1.0))
        theta = np.arctan2(np.hypot(x, y), z)
        found: NDArray[np.int64] = np.flatnonzero(above & (theta - half_angle <= _widest_angle(camera, margin_px)))
        return found
    left, right, top, bottom = _widest_slopes(camera, margin_px)
    seen = above & (z > -reaches_m)
    for across, low, high in ((x, left, right), (y, top, bottom)):
        seen &= across - low * z >= -reaches_m * np.sqrt(1 + low * low)
        seen &= across - high * z <= reaches_m * np.sqrt(1 + high * high)
    found = np.flatnonzero(seen)
    return found


@lru_cache(maxsize=64)
def _widest_angle(camera: Camera, margin_px: float) -> float:
    """The field angle of the pixel position farthest from the axis, radians."""
    return float(np.hypot(*pixel_on_sensor(camera, *_border_px(camera, margin_px))).max())


@lru_cache(maxsize=64)
def _widest_slopes(camera: Camera, margin_px: float) -> tuple[float, float, float, float]:
    """Least and greatest x / z, least and greatest y / z of what a perspective lens sees."""
    x, y, _ = ray_of_sensor(camera, *pixel_on_sensor(camera, *_border_px(camera, margin_px)))
    # Where the border bends, its extreme lies between two of 64 points a side: off by a 1 / (8 * 64^2) of its bend.
    slack = 0.0 if camera.distortion is None else 1e-3 * float(np.hypot(np.ptp(x), np.ptp(y)))
    return float(x.min()) - slack, float(x.max()) + slack, float(y.min()) - slack, float(y.max()) + slack


def _border_px(camera: Camera, margin_px: float) -> tuple[Array, Array]:
    """Pixel positions (u, v) all along the border of the sensor and its margin."""
    t = np.linspace(0.0, 1.0, 65)
    u = -margin_px + t * (camera.width_px + 2 * margin_px)
    v = -margin_px + t * (camera.height_px + 2 * margin_px)
    u_border = np.concatenate([u, u, np.full(65, u[0]), np.full(65, u[-1])])
    return u_border, np.concatenate([np.full(65, v[0]), np.full(65, v[-1]), v, v])


def _outline_px(camera: Camera, pose: Pose, center_m: Array, offsets: Array) -> Array | None:
    """Pixels of points of the LED's plane, given relative to its centre; None where the lens does not image them."""
    reach = float(np.hypot(offsets[:, 0], offsets[:, 1]).max())
    points = np.column_stack([offsets, np.zeros(len(offsets))]) + center_m
    p_cam = transform(pose.rotation, points - np.array(pose.position_m))
    if camera.projection == "perspective":
        # A point at less than a thousandth of that depth is beside or behind the lens, never on a sensor.
        if not (p_cam[:, 2] > 1e-3 * reach).all():
            return None
        if camera.distortion is not None:
            # Points beyond the fold are drawn in to it, which is beyond the sensor still.
            limit = 0.999 * np.sqrt(fold_radius2(camera.distortion)) * p_cam[:, 2]
            radius = np.hypot(p_cam[:, 0], p_cam[:, 1])
            p_cam[:, :2] *= np.minimum(1.0, limit / np.maximum(radius, np.finfo(float).tiny))[:, None]
    pixels = image_of_points(camera, p_cam)
    return pixels if np.isfinite(pixels).all() else None


def _coverage(camera: Camera, pose: Pose, center_m: Array, shape: Disc | Rectangle, first: Array, last: Array) -> Array:
    """Coverage of the pixels from `first` to before `last`, both (column, row), in bands of rows."""
    columns, rows = last - first
    band = max(1, CELLS_AT_ONCE // int(columns))
    parts = []
    for start in range(0, int(rows), band):
        v = np.arange(first[1] + start, first[1] + min(start + band, int(rows)) + 1, dtype=float)
        u = np.arange(first[0], last[0] + 1, dtype=float)
        parts.append(_coverage_of_band(camera, pose, center_m, shape, u, v))
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _coverage_of_band(
    camera: Camera, pose: Pose, center_m: Array, shape: Disc | Rectangle, u: Array, v: Array
) -> Array:
    x, y = places_on_plane(camera, pose, center_m, u[None, :], v[:, None])
    whole, mixed = shape.whole_and_mixed(x, y)
    coverage = whole.astype(float)
    row, column = np.nonzero(mixed)
    rows = np.stack([row, row, row + 1, row + 1], axis=1)
    columns = np.stack([column, column + 1, column + 1, column], axis=1)
    quads = np.stack([x[rows, columns], y[rows, columns]], axis=-1)
    coverage[row, column] = np.clip(shape.shared_area(quads) / quadrilateral_area(quads), 0.0, 1.0)
    return coverage


def places_on_plane(camera: Camera, pose: Pose, center_m: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Where rays of pixel positions u and v, which broadcast, meet an LED's plane: (x, y) in metres from its centre.

    center_m: (3,), world. Rays that do not go up meet it beyond BEYOND_HORIZON_M.
    """
    x, y, z = ray_world(camera, pose, u, v)
    above = z > 1e-9
    everywhere = bool(above.all())
    height = center_m[2] - pose.position_m[2]
    reach = height / (z if everywhere else np.where(above, z, 1.0))
    on_x = x * reach + (pose.position_m[0] - center_m[0])
    on_y = y * reach + (pose.position_m[1] - center_m[1])
    if everywhere:
        return on_x, on_y
    return np.where(above, on_x, 10 * BEYOND_HORIZON_M), np.where(above, on_y, 10 * BEYOND_HORIZON_M)
