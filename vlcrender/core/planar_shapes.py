"""Shapes of LED faces in their own plane, and the exact area and moments that each shares with a polygon."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_CIRCLES = 16
"""Circles that are kept for further LEDs, by their number of points."""
BEYOND_HORIZON_M = 1e8
"""Distance beyond every LED, m: of a ray that does not meet the LEDs' plane."""


@lru_cache(maxsize=MAX_CIRCLES)
def _unit_circle(points: int) -> Array:
    angles = np.linspace(0.0, 2 * np.pi, points, endpoint=False)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


@dataclass(frozen=True)
class Disc:
    """A round LED face."""

    radius_m: float

    def rim(self, points: int) -> Array:
        """Points of the rim (points, 2), relative to the centre, evenly spaced."""
        return self.radius_m * _unit_circle(points)

    def nearest_on_rim(self, x: Array, y: Array) -> tuple[Array, Array]:
        """The point of the rim next to each point, from the centre; (0, 0) for the centre itself."""
        scale = self.radius_m / np.maximum(np.hypot(x, y), np.finfo(float).tiny)
        return x * scale, y * scale

    def image_area_px(self, outline: Array) -> float:
        """Area of the image with this rim, `outline` (points, 2): the polygon and the segments beyond its sides."""
        step = 2 * np.pi / len(outline)
        return _polygon_area(outline) * step / float(np.sin(step))

    def whole_and_mixed(self, x: Array, y: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Masks of cells that are inside whole, and of others that may be in part.

        x, y: of the cells' corners, (..., rows + 1, columns + 1).
        """
        distance = np.hypot(x, y)
        farthest = _corner_extreme(distance, np.maximum)
        whole = farthest <= self.radius_m
        span = np.hypot(
            _corner_extreme(x, np.maximum) - _corner_extreme(x, np.minimum),
            _corner_extreme(y, np.maximum) - _corner_extreme(y, np.minimum),
        )
        # A circle that enters a cell between two corners passes one of them within half the side between them.
        near = _corner_extreme(distance, np.minimum) < np.hypot(self.radius_m, span)
        return whole, near & ~whole & (farthest < BEYOND_HORIZON_M)

    def shared_area(self, quads: Array) -> Array:
        """Area that the face shares with each polygon (n, vertices, 2) in its plane, (n,)."""
        return circle_polygon_area(quads, self.radius_m)

    def shared_moments(self, quads: Array) -> Array:
        """Integrals of 1, x, y and x^2 + y^2 over what the face shares with each polygon (n, vertices, 2), (4, n)."""
        return circle_polygon_moments(quads, self.radius_m)


@dataclass(frozen=True)
class Rectangle:
    """A rectangular LED face, `size_m` along x and y of the room, rotated by `yaw_deg` from x towards y."""

    size_m: tuple[float, float]
    yaw_deg: float = 0.0

    def rim(self, points: int) -> Array:
        """Points of the rim (points, 2), relative to the centre, a quarter of them on each side, vertices included."""
        along = np.linspace(-1, 1, points // 4, endpoint=False)
        side = np.stack([along, -np.ones_like(along)], axis=1)
        quarter_turn = np.array([[0, 1], [-1, 0]])
        sides = [side]
        for _ in range(3):
            sides.append(sides[-1] @ quarter_turn)
        return self._rotated(np.concatenate(sides) * np.array(self.size_m) / 2, 1)

    def nearest_on_rim(self, x: Array, y: Array) -> tuple[Array, Array]:
        """The point of the rim next to each point, from the centre."""
        own = self._rotated(np.stack([x, y], axis=-1), -1)
        half = np.array(self.size_m) / 2
        inside = np.clip(own, -half, half)
        to_side = half - np.abs(inside)
        to_x = to_side[..., 0] < to_side[..., 1]
        moved = np.stack([to_x, ~to_x], axis=-1)
        nearest = self._rotated(np.where(moved, np.copysign(half, own), inside), 1)
        return nearest[..., 0], nearest[..., 1]

    def image_area_px(self, outline: Array) -> float:
        """Area of the image, of which `outline` (points, 2) is the rim."""
        return _polygon_area(outline)

    def whole_and_mixed(self, x: Array, y: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Masks of cells that are inside whole, and of others that may be in part.

        x, y: of the cells' corners, (..., rows + 1, columns + 1).
        """
        if self.yaw_deg != 0:
            x, y = np.moveaxis(self._rotated(np.stack([x, y], axis=-1), -1), -1, 0)
        whole = np.ones((*x.shape[:-2], x.shape[-2] - 1, x.shape[-1] - 1), dtype=bool)
        mixed = whole.copy()
        for own, size in zip((x, y), self.size_m, strict=True):
            whole &= ~_corner_extreme((own < -size / 2) | (own > size / 2), np.logical_or)
            for beyond in (own <= -size / 2, own >= size / 2):
                mixed &= ~_corner_extreme(beyond, np.logical_and)
        mixed &= ~whole
        for own in (x, y):  # only a cell with a corner beyond the horizon is as large as that
            if own.size and np.ptp(own) >= BEYOND_HORIZON_M / 2:
                mixed[mixed] = np.ptp(corners_of_cells(own, mixed), axis=-1) < BEYOND_HORIZON_M / 2
        return whole, mixed

    def shared_area(self, quads: Array) -> Array:
        """Area that the face shares with each polygon (n, vertices, 2) in its plane, (n,)."""
        width, depth = self.size_m
        return rectangle_polygon_area(self._rotated(quads, -1), width / 2, depth / 2)

    def shared_moments(self, quads: Array) -> Array:
        """Integrals of 1, x, y and x^2 + y^2 over what the face shares with each polygon (n, vertices, 2), (4, n)."""
        width, depth = self.size_m
        area, x, y, second = rectangle_polygon_moments(self._rotated(quads, -1), width / 2, depth / 2)
        return np.stack([area, *np.moveaxis(self._rotated(np.stack([x, y], axis=-1), 1), -1, 0), second])

    def _rotated(self, points: Array, sense: int) -> Array:
        if self.yaw_deg == 0:
            return points
        c, s = np.cos(np.radians(self.yaw_deg)), sense * np.sin(np.radians(self.yaw_deg))
        x, y = points[..., 0], points[..., 1]
        return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def circle_polygon_area(polygons: Array, radius: float) -> Array:
    """Area that the disc of this radius about the origin shares with each polygon.

    polygons: (n, vertices, 2), any orientation. Returns (n,), >= 0. Sum over the edges of the signed area that the disc
    shares with the triangle of the origin and the edge: a triangle where the edge is inside, a sector where outside.
    """
    p, a, b, q, at_center = _crossings_of_circle(polygons, radius)
    inside = _cross(a, b) / 2
    outside = radius**2 / 2 * (_angle(p, a) + np.where(at_center, 0.0, _angle(b, q)))
    area: Array = np.abs((inside + outside).sum(axis=1))
    return area


def circle_polygon_moments(polygons: Array, radius: float) -> Array:
    """Integrals of 1, x, y and x^2 + y^2 over what the disc of this radius about the origin shares with each polygon.

    polygons: (n, vertices, 2), any orientation. Returns (4, n). The same triangles and sectors as in
    `circle_polygon_area`: a triangle of the origin, a and b has the first moment area (a + b) / 3 and the second
    area (a.a + a.b + b.b) / 6; a sector between unit vectors e and f has radius^3 / 3 (f_y - e_y, e_x - f_x) and
    radius^4 angle / 4.
    """
    p, a, b, q, at_center = _crossings_of_circle(polygons, radius)
    angle = _angle(p, a) + np.where(at_center, 0.0, _angle(b, q))
    turn = _unit(a) - _unit(p) + np.where(at_center[..., None], 0.0, _unit(q) - _unit(b))
    moments = _triangle_moments(a, b)
    moments[0] += radius**2 / 2 * angle
    moments[1] += radius**3 / 3 * turn[..., 1]
    moments[2] -= radius**3 / 3 * turn[..., 0]
    moments[3] += radius**4 / 4 * angle
    return _oriented(moments.sum(axis=-1))


def _crossings_of_circle(polygons: Array, radius: float) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]]:
    """Of each edge from p to q: its vertices, the ends a and b of its part inside the circle about the origin, and
    whether q is the centre to rounding. Where no part is inside, a = b = p.
    """
    p = polygons
    q = np.roll(polygons, -1, axis=1)
    edge = q - p
    length2 = np.maximum(_dot(edge, edge), np.finfo(float).tiny)
    # The edge meets the circle at p + t * edge with t = t_mid -+ half.
    t_mid = -_dot(p, edge) / length2
    closest2 = np.maximum(_dot(p, p) - t_mid**2 * length2, 0.0)
    half = np.sqrt(np.maximum(radius**2 - closest2, 0.0) / length2)
    meets = radius**2 > closest2
    enter = np.where(meets, np.clip(t_mid - half, 0.0, 1.0), 0.0)
    leave = np.where(meets, np.clip(t_mid + half, 0.0, 1.0), 0.0)
    a = p + enter[..., None] * edge
    b = p + leave[..., None] * edge
    # b is q where q is inside, except for rounding, which near the centre may change its direction by any angle.
    at_center = _dot(q, q) < (1e-3 * radius) ** 2
    return p, a, b, q, at_center


def rectangle_polygon_area(polygons: Array, half_x: float, half_y: float) -> Array:
    """Area that the rectangle |x| <= half_x, |y| <= half_y shares with each polygon.

    polygons: (n, vertices, 2), any orientation. Returns (n,), >= 0. Every point is moved to the rectangle's nearest
    point: points inside stay, points outside collapse onto the rectangle's sides and enclose no area. The moved polygon
    has additional vertices where an edge crosses the line of a side. The result is continuous where edges coincide.
    """
    x, y = _moved_into_rectangle(polygons, half_x, half_y)
    doubled = x * np.roll(y, -1, axis=0) - y * np.roll(x, -1, axis=0)
    area: Array = np.abs(np.ascontiguousarray(doubled.T).sum(axis=1)) / 2
    return area


def rectangle_polygon_moments(polygons: Array, half_x: float, half_y: float) -> Array:
    """Integrals of 1, x, y and x^2 + y^2 over what the rectangle shares with each polygon, (4, n).

    Arguments as of `rectangle_polygon_area`.
    """
    moved = np.ascontiguousarray(_moved_into_rectangle(polygons, half_x, half_y).T)
    return _oriented(_triangle_moments(moved, np.roll(moved, -1, axis=1)).sum(axis=-1))


def _moved_into_rectangle(polygons: Array, half_x: float, half_y: float) -> Array:
    """Moved polygons (n, vertices, 2) of `rectangle_polygon_area`, (2, 5 vertices, n): NumPy is slow on short axes."""
    limits = np.array([half_x, half_y])[:, None, None]
    p = np.ascontiguousarray(polygons.T)
    edge = np.roll(p, -1, axis=1) - p
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        crossings = np.concatenate([(-limits - p) / edge, (limits - p) / edge])
    # an edge parallel to a side does not cross it
    a, b, c, d = np.clip(np.nan_to_num(crossings, copy=False, nan=0.0, posinf=0.0, neginf=0.0), 0.0, 1.0)
    a, b, c, d = np.minimum(a, b), np.maximum(a, b), np.minimum(c, d), np.maximum(c, d)
    b, c, first, last = np.maximum(a, c), np.minimum(b, d), np.minimum(a, c), np.maximum(b, d)
    t = np.stack([np.zeros_like(a), first, np.minimum(b, c), np.maximum(b, c), last], axis=1)
    moved = p[:, :, None] + t * edge[:, :, None]
    np.clip(moved, -limits[..., None], limits[..., None], out=moved)
    corners: Array = moved.reshape(2, 5 * p.shape[1], len(polygons))
    return corners


def _triangle_moments(a: Array, b: Array) -> Array:
    """Signed integrals of 1, x, y and x^2 + y^2 over triangles of the origin and the points a, b (..., 2), (4, ...)."""
    area = _cross(a, b) / 2
    second = area / 6 * (_dot(a, a) + _dot(a, b) + _dot(b, b))
    return np.stack([area, *(area / 3 * np.moveaxis(a + b, -1, 0)), second])


def _oriented(moments: Array) -> Array:
    """Signed moments (4, n) with the sign that makes the area positive."""
    oriented: Array = moments * np.where(moments[0] < 0, -1.0, 1.0)
    return oriented


def _unit(points: Array) -> Array:
    unit: Array = points / np.maximum(np.hypot(points[..., 0], points[..., 1]), np.finfo(float).tiny)[..., None]
    return unit


def _cross(a: Array, b: Array) -> Array:
    product: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


def _dot(a: Array, b: Array) -> Array:
    product: Array = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
    return product


def _angle(a: Array, b: Array) -> Array:
    angle: Array = np.arctan2(_cross(a, b), _dot(a, b))
    return angle


def quadrilateral_area(quads: Array) -> Array:
    """Area of convex quadrilaterals (n, 4, 2), (n,)."""
    area: Array = np.abs(_cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])) / 2
    return area


def quadrilateral_centroid(quads: Array) -> Array:
    """Centroid of convex quadrilaterals (n, 4, 2), (n, 2)."""
    a, b, c, d = np.moveaxis(quads, 1, 0)
    first, second = np.abs(_cross(b - a, c - a))[:, None], np.abs(_cross(c - a, d - a))[:, None]
    centroid: Array = (first * (a + b + c) + second * (a + c + d)) / (3 * (first + second))
    return centroid


def _polygon_area(vertices: Array) -> float:
    u, v = vertices.T
    return abs(float(np.dot(u, np.roll(v, -1)) - np.dot(v, np.roll(u, -1)))) / 2


def corners_of_cells(values: Array, cells: NDArray[np.bool_]) -> Array:
    """Values at the four corners, in their order about the cell, of the n cells that a mask selects, (n, 4).

    values: at all corners, (..., rows + 1, columns + 1); cells: (..., rows, columns).
    """
    around = values[..., :-1, :-1], values[..., :-1, 1:], values[..., 1:, 1:], values[..., 1:, :-1]
    return np.stack([of_corner[cells] for of_corner in around], axis=-1)


def _corner_extreme(values: NDArray[Any], reduce: np.ufunc) -> NDArray[Any]:
    """Reduce values at cell corners (..., rows + 1, columns + 1) over each cell's, (..., rows, columns)."""
    extreme: NDArray[Any] = reduce(
        reduce(values[..., :-1, :-1], values[..., :-1, 1:]), reduce(values[..., 1:, :-1], values[..., 1:, 1:])
    )
    return extreme
