"""The room's light, baked once: illuminance at every corner of the room's mesh, in lux.

Three parts add up. Light straight from the LEDs, and what a pane mirrors of it, is a sum over all of them, each a small
source of its Lambertian order, with a shadow ray each: no noise. Light that a surface reflected at least once, and
light from windows, is found by tracing paths with Mitsuba through a room whose surfaces glow with what the LEDs make of
them: Monte Carlo, with an error that is kept. The surrounding light (`ambient`) falls on every surface alike and is
defined to hold its own reflections.

In a diffuse room radiance does not depend on the view, so a view then costs one ray a pixel. The result is kept under
a hash of the scene and of all that went into it.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.light.bake_cache import BakedIlluminance, cache_folder, load, store
from vlcrender.light.mitsuba_room import mitsuba_scene
from vlcrender.scene.fresnel import glazing_reflectance
from vlcrender.scene.furniture import furniture_meshes
from vlcrender.scene.loader import Scene
from vlcrender.scene.mesh import Mesh, join, mesh_of_surfaces
from vlcrender.scene.sources import Sources, point_sources
from vlcrender.scene.surfaces import Glazing

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

CACHE_VERSION = 4
BATCHES = 8
MAX_DEPTH = 64
"""Bounces followed; roulette ends nearly all paths long before."""
ROULETTE_DEPTH = 4
RAYS_AT_ONCE = 4_000_000
OFFSET_M = 1e-4
"""Rays start this far off their surface."""


@dataclass(frozen=True)
class Lightmap:
    """Illuminance in lux at the corners of `mesh` and then on the faces of the scene's LEDs, (corners + LEDs,) each.

    `led_lux` is light that left an LED, `ambient_lux` all other; `sigma_lux` is the Monte Carlo standard error of
    their sum. `albedo` is that of the same places.
    """

    mesh: Mesh
    albedo: Array
    led_lux: Array
    ambient_lux: Array
    sigma_lux: Array

    def led_cd_m2(self) -> Array:
        """Luminance of the surfaces by light from LEDs: albedo * illuminance / pi."""
        return self.albedo * self.led_lux / np.pi

    def ambient_cd_m2(self) -> Array:
        """Luminance of the surfaces by all other light."""
        return self.albedo * self.ambient_lux / np.pi


def room_mesh(scene: Scene) -> Mesh:
    """Surfaces and furniture as one mesh; owners are surface numbers, then furniture."""
    rectangles = mesh_of_surfaces(scene.surfaces, scene.settings.bake.texel_m)
    return join([rectangles, *furniture_meshes(scene, len(scene.surfaces))])


def bake(scene: Scene, cache: Path | None = None, progress: Progress = lambda stage, share: None) -> Lightmap:
    """Compute the room's light, or take it from the cache folder (`cache_folder()` where None).

    `progress` is told (stage, share done). Raises InputError for furniture that cannot be used.
    """
    mesh = room_mesh(scene)
    albedo = np.concatenate([mesh.albedo, np.full(len(scene.leds), scene.settings.led_reflectance)])
    folder, key = cache or cache_folder(), _key(scene, mesh)
    baked = load(key, len(albedo), folder)
    if baked is None:
        baked = _compute(scene, mesh, progress)
        store(key, baked, folder)
    ambient = baked.daylight_lux + scene.settings.ambient.illuminance_lux
    return Lightmap(mesh, albedo, baked.led_lux, ambient, baked.sigma_lux)


def led_illuminance_lux(
    blockers: Any, points_m: Array, normals: Array, sources: Sources, glazings: tuple[Glazing, ...] = ()
) -> Array:
    """Illuminance straight from the LEDs, and by way of one pane, on surface points (n, 3) with unit normals, (n,).

    E = sum of I cos^m(theta_source) cos(theta_surface) / d^2 over the sources that the point sees. A pane shows each
    source's mirror image, dimmed by Fresnel's law, where nothing stands between point, pane and source. Light that
    panes mirror more than once is left out.
    """
    total = np.zeros(len(points_m))
    each = max(1, RAYS_AT_ONCE // len(sources))
    for start in range(0, len(points_m), each):
        here = slice(start, start + each)
        origins = points_m[here] + OFFSET_M * normals[here]
        lux = _unshadowed_lux(points_m[here], normals[here], sources, sources.centers_m)
        point, source = np.nonzero(lux > 0)
        seen = ~_blocked(blockers, origins[point], sources.centers_m[source] - [0, 0, OFFSET_M])
        np.add.at(total[here], point, lux[point, source] * seen)
        for glazing in glazings:
            images_m = glazing.mirrored(sources.centers_m)
            lux = _unshadowed_lux(points_m[here], normals[here], sources, images_m)
            towards = images_m[None] - points_m[here, None]
            slope = (towards * glazing.normal).sum(axis=2)
            height = ((points_m[here] - glazing.corner_m) * glazing.normal).sum(axis=1)
            point, source = np.nonzero((lux > 0) & (slope < 0) & (height[:, None] > OFFSET_M))
            share = height[point] / -slope[point, source]
            on_glazing = points_m[here][point] + share[:, None] * towards[point, source]
            within = glazing.contains(on_glazing)
            point, source, on_glazing = point[within], source[within], on_glazing[within]
            before = on_glazing + OFFSET_M * glazing.normal
            seen = ~_blocked(blockers, origins[point], before)
            seen &= ~_blocked(blockers, before, sources.centers_m[source] - [0, 0, OFFSET_M])
            cosine = -slope[point, source] / np.linalg.norm(towards[point, source], axis=1)
            dimmed = lux[point, source] * glazing_reflectance(cosine, glazing.refractive_index, np.sqrt)
            np.add.at(total[here], point, dimmed * seen)
    return total


def _unshadowed_lux(points_m: Array, normals: Array, sources: Sources, centers_m: Array) -> Array:
    """What each source, seen at `centers_m`, sends to each point where nothing is in the way, (points, sources).

    Sources face down, and their mirror images in upright panes do too.
    """
    towards = centers_m[None] - points_m[:, None]
    distance = np.maximum(np.linalg.norm(towards, axis=2), 1e-9)  # an LED's own face
    cos_source = np.maximum(towards[..., 2] / distance, 0.0)
    cos_surface = np.maximum((towards * normals[:, None]).sum(axis=2) / distance, 0.0)
    lux: Array = sources.intensities_cd * cos_source**sources.orders * cos_surface / distance**2
    return lux


def _blocked(blockers: Any, origins_m: Array, targets_m: Array) -> NDArray[np.bool_]:
    if not len(origins_m):
        return np.zeros(0, dtype=bool)  # Dr.Jit has no empty arrays
    span = targets_m - origins_m
    length = np.linalg.norm(span, axis=1, keepdims=True)
    with exact_math():
        ray = mi.Ray3f(_points(origins_m), mi.Vector3f(*(span / length).T.astype(np.float32)))
        maxt: Any = mi.Float(length[:, 0].astype(np.float32))
        ray.maxt = maxt
        hit = blockers.ray_test(ray)
        dr.eval(hit)
    blocked: NDArray[np.bool_] = hit.numpy().astype(bool)
    return blocked


def path_traced_lux(
    glowing: Any, points_m: Array, normals: Array, paths: int, report: Callable[[float], None]
) -> tuple[Array, Array]:
    """Illuminance by everything that glows in a Mitsuba scene, on surface points (n, 3), and its standard error.

    Directions are drawn in proportion to the cosine, so that E = pi * mean of the luminance they see.
    """
    count = len(points_m)
    each = -(-paths // BATCHES)
    block = max(1, RAYS_AT_ONCE // each)
    means = np.zeros((BATCHES, count))
    for batch in range(BATCHES):
        for start in range(0, count, block):
            here = slice(start, min(start + block, count))
            means[batch, here] = _mean_luminance(glowing, points_m[here], normals[here], each, batch * count + start)
        report((batch + 1) / BATCHES)
    lux = np.pi * means.mean(axis=0)
    sigma = np.pi * means.std(axis=0, ddof=1) / np.sqrt(BATCHES)
    return lux, sigma


def _mean_luminance(glowing: Any, points_m: Array, normals: Array, each: int, seed: int) -> Array:
    count = len(points_m)
    with exact_math():
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, count * each)
        number = dr.arange(mi.UInt32, count * each) // each
        normal = dr.gather(mi.Vector3f, mi.Vector3f(*normals.T.astype(np.float32)), number)
        origin = dr.gather(mi.Point3f, _points(points_m + OFFSET_M * normals), number)
        local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        ray = mi.Ray3f(origin, mi.Frame3f(normal).to_world(local))
        luminance = _follow(glowing, sampler, ray)
        dr.eval(luminance)
    sums: Array = np.array(luminance, dtype=np.float64).reshape(count, each).mean(axis=1)
    return sums


@dr.syntax
def _follow(glowing: Any, sampler: Any, ray: Any) -> Any:
    """Luminance along rays: the glow of all that a path meets, weighted by the reflectances before it.

    Paths are drawn by the surfaces' BSDFs alone. Everything glows, so that aiming at sources would gain nothing.
    """
    luminance = mi.Float(0.0)
    weight: Any = mi.Float(1.0)
    depth, active = mi.UInt32(0), mi.Bool(True)
    while active:
        si = glowing.ray_intersect(ray, active)
        active &= si.is_valid()
        luminance += dr.select(active, weight * si.shape.eval_attribute_1("vertex_glow", si, active), 0.0)
        sample, value = si.bsdf().sample(mi.BSDFContext(), si, sampler.next_1d(active), sampler.next_2d(active), active)
        weight *= mi.unpolarized_spectrum(value)[0]
        ray = si.spawn_ray(si.to_world(sample.wo))
        depth += 1
        # Russian roulette once a path is weak; unbiased, since the survivors are weighted up.
        keep = dr.select(depth > ROULETTE_DEPTH, dr.minimum(weight, 0.95), 1.0)
        active &= (sampler.next_1d(active) < keep) & (weight > 0) & (depth < MAX_DEPTH)
        weight /= dr.maximum(keep, 1e-6)
    return luminance


def _points(points_m: Array) -> "mi.Point3f":
    return mi.Point3f(*points_m.T.astype(np.float32))


def _compute(scene: Scene, mesh: Mesh, progress: Progress) -> BakedIlluminance:
    leds = scene.leds
    points = np.concatenate([mesh.probes_m, leds.centers_m])
    normals = np.concatenate([mesh.normals, np.tile([0.0, 0.0, -1.0], (len(leds), 1))])
    dark = np.zeros(len(mesh.vertices_m))
    progress("light from the LEDs", 0.0)
    blockers = mitsuba_scene(mesh, dark, (), panes_glow=False)
    direct = led_illuminance_lux(blockers, points, normals, point_sources(leds), scene.glazings)
    progress("light from the LEDs", 1.0)
    paths = scene.settings.bake.paths
    lit = mitsuba_scene(mesh, mesh.albedo * direct[: len(dark)] / np.pi, scene.glazings, panes_glow=False)
    bounced, sigma = path_traced_lux(lit, points, normals, paths, lambda share: progress("reflected light", share))
    daylight = np.zeros(len(points))
    if any(glazing.luminance_cd_m2 > 0 for glazing in scene.glazings):
        by_day = mitsuba_scene(mesh, dark, scene.glazings, panes_glow=True)
        daylight, more = path_traced_lux(
            by_day, points, normals, paths, lambda share: progress("light from windows", share)
        )
        sigma = np.hypot(sigma, more)
    return BakedIlluminance(direct + bounced, daylight, sigma)


def _key(scene: Scene, mesh: Mesh) -> str:
    """Hash of all that the light depends on: geometry, reflectances, textures, LEDs, windows, number of paths."""
    digest = hashlib.sha256(f"light {CACHE_VERSION} {mi.__version__} {scene.settings.bake.paths}".encode())
    sources = point_sources(scene.leds)
    arrays = [mesh.vertices_m, mesh.probes_m, mesh.normals, mesh.albedo, mesh.faces]
    arrays += [scene.leds.centers_m, sources.centers_m, sources.intensities_cd, sources.orders]
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(repr(list(map(_glazing_key, scene.glazings))).encode())
    for surface in scene.surfaces:
        if surface.texture is not None:
            digest.update(np.ascontiguousarray(surface.texture.reflectances).tobytes())
    return digest.hexdigest()[:32]


def _glazing_key(glazing: Glazing) -> tuple[object, ...]:
    edges = (glazing.corner_m.tolist(), glazing.edge_u_m.tolist(), glazing.edge_v_m.tolist())
    return (*edges, glazing.luminance_cd_m2, glazing.refractive_index)
