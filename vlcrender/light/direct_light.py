"""Direct light of the LEDs: a sum over point sources of each LED's Lambertian order, with a shadow ray each.

One kernel has a thread for each surface point, which goes through all sources in double precision. Points that no
source can light, such as those of a ceiling above all LEDs, are left out before.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.scene.fresnel import glazing_reflectance
from vlcrender.scene.sources import Sources
from vlcrender.scene.surfaces import Glazing

Array = NDArray[np.float64]

RAY_OFFSET_M = 1e-4
"""Distance of a ray's origin from its surface."""
MAX_PAIRS = 100_000_000
"""Largest number of pairs of a point and a source in one launch, so that progress is reported every few seconds."""


def led_illuminance_lux(
    blockers: Any,
    points_m: Array,
    normals: Array,
    sources: Sources,
    glazings: tuple[Glazing, ...] = (),
    report: Callable[[float], None] = lambda share: None,
) -> Array:
    """Direct illuminance of the LEDs, and that by one specular reflection in glazing, (n,).

    blockers: Mitsuba scene for shadow rays. points_m, normals: surface points (n, 3) with unit normals (n, 3). `report`
    is called with the share done.

    E = sum of I cos^m(theta_source) cos(theta_surface) / d^2 over the sources visible from the point. Glazing adds the
    mirror image of each source, times its Fresnel reflectance, if nothing blocks the way from point to glazing to
    source. Light reflected by glazing more than once is left out.
    """
    total = np.zeros(len(points_m))
    block = max(1, MAX_PAIRS // len(sources))
    ways = (None, *glazings)
    for number, glazing in enumerate(ways):
        lux_of_source = partial(_lux_of_source, blockers, glazing)
        lit = np.flatnonzero(_may_be_lit(points_m, normals, sources, glazing))
        for start in range(0, len(lit), block):
            here = lit[start : start + block]
            with exact_math():
                data = mi.Vector3d(*sources.centers_m.T), mi.Float64(sources.intensities_cd), mi.Float64(sources.orders)
                point, normal = (mi.Vector3d(*vectors[here].T) for vectors in (points_m, normals))
                total[here] += _sum_over_sources(lux_of_source, point, normal, data).numpy()
            report((number + (start + len(here)) / len(lit)) / len(ways))
    return total


def _may_be_lit(points_m: Array, normals: Array, sources: Sources, glazing: Glazing | None) -> NDArray[np.bool_]:
    """Whether points (n, 3) are below a source and face a part of the box around all, (n,); sources face down.

    glazing: the one in which the sources are mirrored.
    """
    centers_m = sources.centers_m if glazing is None else glazing.mirrored(sources.centers_m)
    low, high = centers_m.min(axis=0), centers_m.max(axis=0)
    largest = np.maximum(normals * (low - points_m), normals * (high - points_m)).sum(axis=1)
    lit: NDArray[np.bool_] = (largest > 0) & (points_m[:, 2] < high[2])
    return lit


@dr.syntax
def _sum_over_sources(lux_of_source: Callable[..., Any], point: Any, normal: Any, data: tuple[Any, Any, Any]) -> Any:
    """Illuminance of points by all sources.

    point, normal: Dr.Jit vectors of double precision. data: centres, intensities and orders of the sources.
    """
    centers, intensities, orders = data
    lux, i = mi.Float64(0.0), mi.UInt32(0)
    count = dr.opaque(mi.UInt32, dr.width(orders))  # as data: as a literal each number would compile a kernel
    while i < count:
        center = dr.gather(mi.Vector3d, centers, i)
        intensity, order = dr.gather(mi.Float64, intensities, i), dr.gather(mi.Float64, orders, i)
        lux += lux_of_source(point, normal, center, intensity, order)
        i += 1
    return lux


def _lux_of_source(
    blockers: Any, glazing: Glazing | None, point: Any, normal: Any, center: Any, intensity: Any, order: Any
) -> Any:
    """Illuminance of points by one source each, or by its mirror image in a glazing; 0 where something is between."""
    origin, target = point + RAY_OFFSET_M * normal, center - mi.Vector3d(0.0, 0.0, RAY_OFFSET_M)
    if glazing is None:
        lux = _unshadowed_lux(center - point, normal, intensity, order)
        return dr.select(_blocked(blockers, origin, target, lux > 0), 0.0, lux)
    inwards, corner = (mi.Vector3d(*vector.tolist()) for vector in (glazing.normal, glazing.corner_m))
    way = center - 2 * dr.dot(center - corner, inwards) * inwards - point
    lux = _unshadowed_lux(way, normal, intensity, order)  # mirror images in vertical glazing face down too
    height, slope = dr.dot(point - corner, inwards), -dr.dot(way, inwards)
    lit = (lux > 0) & (slope > 0) & (height > RAY_OFFSET_M)
    on_glazing = point + height / slope * way
    for edge_m in (glazing.edge_u_m, glazing.edge_v_m):
        share = dr.dot(on_glazing - corner, mi.Vector3d(*edge_m.tolist())) / float(edge_m @ edge_m)
        lit &= (share >= 0) & (share <= 1)
    start = on_glazing + RAY_OFFSET_M * inwards
    lit &= ~_blocked(blockers, origin, start, lit)
    lit &= ~_blocked(blockers, start, target, lit)
    return dr.select(lit, lux * glazing_reflectance(slope / dr.norm(way), glazing.refractive_index, dr.sqrt), 0.0)


def _unshadowed_lux(way: Any, normal: Any, intensity: Any, order: Any) -> Any:
    """Illuminance by a source that faces down at the end of a way, without occlusion."""
    distance = dr.maximum(dr.norm(way), 1e-9)  # 0 on an LED's own face
    cos_source, cos_surface = dr.maximum(way.z / distance, 0.0), dr.maximum(dr.dot(way, normal) / distance, 0.0)
    return intensity * dr.power(cos_source, order) * cos_surface / (distance * distance)


def is_blocked(blockers: Any, origins_m: Array, targets_m: Array) -> NDArray[np.bool_]:
    """Whether something lies between origins (n, 3) and targets (n, 3), (n,)."""
    if not len(origins_m):
        return np.zeros(0, dtype=bool)  # Dr.Jit has no empty arrays
    with exact_math():
        hit = _blocked(blockers, mi.Vector3d(*origins_m.T), mi.Vector3d(*targets_m.T), mi.Bool(True))
        dr.eval(hit)
    blocked: NDArray[np.bool_] = hit.numpy().astype(bool)
    return blocked


def _blocked(blockers: Any, origin: Any, target: Any, active: Any) -> Any:
    """Whether something lies between points, where `active`."""
    span = target - origin
    length = dr.norm(span)
    ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(span / length))
    maxt: Any = mi.Float(length)
    ray.maxt = maxt
    return blockers.ray_test(ray, active)
