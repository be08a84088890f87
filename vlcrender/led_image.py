"""The image of one LED: how much of each pixel its disc covers, exactly.

A pixel's corners are mapped through the camera onto the LED's plane. There the LED is a circle and the pixel a
quadrilateral; the area they share over the area of the quadrilateral is the pixel's coverage. For a pinhole this is
the pixel-area average but for the change of scale within one pixel, a relative 1e-4 of a mixed pixel's value.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera import Camera, Pose, project, rays_world

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LedImage:
    """A window of the sensor around one LED. `coverage` (rows, columns) starts at pixel (row, column)."""

    row: int
    column: int
    coverage: Array
    visible_fraction: float
    """Share of the LED's whole image, by area, that falls on the sensor."""


def circle_polygon_area(polygons: Array, radius: float) -> Array:
    """Area common to the disc of this radius about the origin and each polygon.

    polygons: (n, corners, 2), any orientation. Returns (n,), >= 0. Sum over the edges of the signed area that the disc
    shares with the triangle of the origin and that edge: straight where the edge is inside, a sector where outside.
    """
    p = polygons
    q = np.roll(polygons, -1, axis=1)
    edge = q - p
    length2 = np.maximum((edge**2).sum(-1), np.finfo(float).tiny)
    # The edge meets the circle at p + t * edge with t = t_mid -+ half.
    t_mid = -(p * edge).sum(-1) / length2
    closest2 = np.maximum((p**2).sum(-1) - t_mid**2 * length2, 0.0)
    half = np.sqrt(np.maximum(radius**2 - closest2, 0.0) / length2)
    meets = radius**2 > closest2
    enter = np.where(meets, np.clip(t_mid - half, 0.0, 1.0), 0.0)
    leave = np.where(meets, np.clip(t_mid + half, 0.0, 1.0), 0.0)
    a = p + enter[..., None] * edge
    b = p + leave[..., None] * edge
    inside = _cross(a, b) / 2
    outside = radius**2 / 2 * (_angle(p, a) + _angle(b, q))
    area: Array = np.abs((inside + outside).sum(axis=1))
    return area


def _cross(a: Array, b: Array) -> Array:
    product: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


def _angle(a: Array, b: Array) -> Array:
    angle: Array = np.arctan2(_cross(a, b), (a * b).sum(-1))
    return angle


def image_of_disc(camera: Camera, pose: Pose, center_m: Array, radius_m: float) -> LedImage | None:
    """Image of a horizontal disc that faces down, or None where no pixel sees it.

    center_m: (3,), world. A disc that reaches behind the camera, or that the camera looks down on, is not seen.
    """
    outline = _outline_px(camera, pose, center_m, radius_m)
    if outline is None:
        return None
    low = np.floor(outline.min(axis=0)).astype(int)
    high = np.ceil(outline.max(axis=0)).astype(int)
    size = np.array([camera.width_px, camera.height_px])
    first, last = np.maximum(low, 0), np.minimum(high, size)
    if (last <= first).any():
        return None
    coverage = _coverage(camera, pose, center_m, radius_m, first, last)
    if not coverage.any():
        return None
    on_sensor = coverage.sum()
    cut = (low < 0).any() or (high > size).any()
    fraction = float(min(on_sensor / _ellipse_area_px(outline), 1.0)) if cut else 1.0
    return LedImage(int(first[1]), int(first[0]), coverage, fraction)


def _outline_px(camera: Camera, pose: Pose, center_m: Array, radius_m: float) -> Array | None:
    if pose.position_m[2] >= center_m[2]:
        return None
    angles = np.linspace(0.0, 2 * np.pi, 720, endpoint=False)
    rim = center_m + radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    pixels, depth = project(camera, pose, rim)
    # A rim point at less than a radius' depth is beside or behind the lens, never on a sensor of less than 180 deg.
    return pixels if (depth > 1e-3 * radius_m).all() else None


def _ellipse_area_px(outline: Array) -> float:
    """Area of the polygon through the outline, corrected for the arcs it cuts off."""
    u, v = outline.T
    polygon = abs(float(np.dot(u, np.roll(v, -1)) - np.dot(v, np.roll(u, -1)))) / 2
    step = 2 * np.pi / len(outline)
    return polygon * step / float(np.sin(step))


def _coverage(camera: Camera, pose: Pose, center_m: Array, radius_m: float, first: Array, last: Array) -> Array:
    u = np.arange(first[0], last[0] + 1, dtype=float)
    v = np.arange(first[1], last[1] + 1, dtype=float)
    corners = np.stack(np.meshgrid(u, v), axis=-1)
    rays = rays_world(camera, pose, corners)
    above = rays[..., 2] > 1e-9
    reach = np.where(above, (center_m[2] - pose.position_m[2]) / np.where(above, rays[..., 2], 1.0), np.inf)
    with np.errstate(invalid="ignore"):
        on_plane = rays[..., :2] * reach[..., None] + (np.array(pose.position_m[:2]) - center_m[:2])
    on_plane = np.where(above[..., None], on_plane, 1e9)  # beyond the horizon: far from every LED
    distance = np.hypot(on_plane[..., 0], on_plane[..., 1])
    quads = np.stack([on_plane[:-1, :-1], on_plane[:-1, 1:], on_plane[1:, 1:], on_plane[1:, :-1]], axis=2)
    farthest = _corner_extreme(distance, np.maximum)
    nearest = _corner_extreme(distance, np.minimum)
    span = np.hypot(*(quads.max(axis=2) - quads.min(axis=2)).transpose(2, 0, 1))
    coverage = (farthest <= radius_m).astype(float)
    mixed = (farthest > radius_m) & (nearest < radius_m + span) & (farthest < 1e8)
    shared = circle_polygon_area(quads[mixed], radius_m)
    coverage[mixed] = np.clip(shared / _area(quads[mixed]), 0.0, 1.0)
    return coverage


def _corner_extreme(values: Array, of: np.ufunc) -> Array:
    extreme: Array = of(of(values[:-1, :-1], values[:-1, 1:]), of(values[1:, :-1], values[1:, 1:]))
    return extreme


def _area(quads: Array) -> Array:
    area: Array = np.abs(_cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])) / 2
    return area
