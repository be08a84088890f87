"""Lightmap: illuminance in lux at every vertex of the room's mesh, baked once per scene.

Illuminance has three parts. Direct light of the LEDs, and its specular reflection by glazing, is a sum over point
sources (`direct_light`): no noise. Light that surfaces reflected at least once,
and daylight through glazing, are path traced with Mitsuba, through a room whose surfaces emit the light of the LEDs
that they reflect; their Monte Carlo standard error is kept. Ambient light has the same illuminance on every surface and
includes its own reflections by definition.

In a diffuse room luminance does not depend on the direction of view, so that an image costs one ray per pixel. The bake
is kept in a cache under a hash of everything that it depends on.
"""

import hashlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.core.warn_once import warn_once
from vlcrender.light.bake_cache import BakedIlluminance, cache_folder, load, store
from vlcrender.light.direct_light import RAY_OFFSET_M, led_illuminance_lux
from vlcrender.light.mitsuba_room import mitsuba_scene
from vlcrender.scene.loader import Scene
from vlcrender.scene.mesh import Mesh, join, mesh_of_surfaces
from vlcrender.scene.sources import point_sources
from vlcrender.scene.surfaces import Glazing, check_absorptance

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
logger = logging.getLogger(__name__)

CACHE_VERSION = 8
"""Raised with every change of the program that changes bakes of the same scene."""
BATCHES = 8
"""Independent estimates of a path-traced illuminance; their scatter gives the standard error."""
ROULETTE_DEPTH = 4
"""Bounces before Russian roulette begins."""
MAX_RAYS = 4_000_000
"""Largest number of rays traced together, for memory."""


@dataclass(frozen=True)
class Lightmap:
    """Illuminance at n places: the vertices of `mesh`, then the faces of the scene's LEDs."""

    mesh: Mesh
    albedo: Array
    """Diffuse reflectance, (n,)."""
    led_lux: Array
    """Illuminance by light of LEDs, direct and reflected, (n,)."""
    ambient_lux: Array
    """Illuminance by ambient light and daylight, (n,)."""
    sigma_lux: Array
    """Monte Carlo standard error of the whole illuminance, (n,)."""

    def led_cd_m2(self, places: slice = slice(None)) -> Array:
        """Luminance by reflected light of LEDs at all places or some, (n,): albedo * illuminance / pi."""
        return self.albedo[places] * self.led_lux[places] / np.pi

    def ambient_cd_m2(self, places: slice = slice(None)) -> Array:
        """Luminance by reflected ambient light and daylight at all places or some, (n,)."""
        return self.albedo[places] * self.ambient_lux[places] / np.pi


@lru_cache(maxsize=1)
def room_mesh(scene: Scene) -> Mesh:
    """Surfaces and furniture as one mesh; owners are the numbers of surfaces, then those of furniture.

    The mesh of the latest scene is kept. Raises InputError for furniture that cannot be used.
    """
    furniture: list[Mesh] = []
    if scene.settings.furniture:
        from vlcrender.scene.furniture import furniture_meshes  # loads trimesh

        furniture = furniture_meshes(scene, len(scene.surfaces))
    texel_m, leds_m = scene.settings.bake.texel_m, scene.leds.centers_m
    return join([mesh_of_surfaces(scene.surfaces, texel_m, furniture, leds_m), *furniture])


def bake(scene: Scene, cache: Path | None = None, progress: Progress = lambda stage, share: None) -> Lightmap:
    """The lightmap of a scene, from the cache or computed and put there.

    cache: folder of the cache, `cache_folder()` for None. progress: called with (stage, share done) during a
    computation. Raises InputError for furniture that cannot be used, and for a room whose surfaces absorb less than
    MIN_ABSORPTANCE of the light that falls on them; a cache that cannot be written is no error.
    """
    mesh = room_mesh(scene)
    glazing_m2 = sum(glazing.area_m2 for glazing in scene.glazings)
    areas_m2 = mesh.areas_m2()
    absorbing_m2 = float(areas_m2 @ (1 - mesh.albedo)) + glazing_m2
    check_absorptance(absorbing_m2, float(areas_m2.sum()) + glazing_m2, f"scene {scene.name!r}")
    albedo = np.concatenate([mesh.albedo, np.full(len(scene.leds), scene.settings.led_reflectance)])
    folder, key = cache or cache_folder(), _key(scene, mesh)
    baked = load(key, len(albedo), folder)
    if baked is None:
        baked = _compute(scene, mesh, progress)
        store(key, baked, folder)
    _warn_of_dark_furniture(scene, mesh, baked)
    ambient = baked.daylight_lux + scene.settings.ambient.illuminance_lux
    return Lightmap(mesh, albedo, baked.led_lux, ambient, baked.sigma_lux)


def _warn_of_dark_furniture(scene: Scene, mesh: Mesh, baked: BakedIlluminance) -> None:
    """Warn of each piece of furniture that neither light of LEDs nor daylight reaches."""
    lux = baked.led_lux + baked.daylight_lux
    for number, piece in enumerate(scene.settings.furniture):
        vertices = mesh.faces[mesh.owners == len(scene.surfaces) + number]
        if lux[: len(mesh.vertices_m)].any() and not lux[vertices].any():
            warn_once(
                logger,
                f"furniture[{number}].file = {piece.file!r}: no light falls on it; nothing else may enclose it",
            )


def path_traced_lux(
    glowing: Any, points_m: Array, normals: Array, paths: int, report: Callable[[float], None]
) -> tuple[Array, Array]:
    """Illuminance of surface points (n, 3) by a Mitsuba scene of emitting surfaces, and its standard error, (n,) each.

    Directions are drawn in proportion to the cosine, so that E = pi * mean luminance along them. `report` is called
    with the share done.
    """
    count = len(points_m)
    paths_per_batch = -(-paths // BATCHES)
    block = max(1, MAX_RAYS // paths_per_batch)
    means = np.zeros((BATCHES, count))
    for batch in range(BATCHES):
        for start in range(0, count, block):
            here = slice(start, min(start + block, count))
            means[batch, here] = _mean_luminance(
                glowing, points_m[here], normals[here], paths_per_batch, batch * count + start
            )
        report((batch + 1) / BATCHES)
    lux = np.pi * means.mean(axis=0)
    sigma = np.pi * means.std(axis=0, ddof=1) / np.sqrt(BATCHES)
    return lux, sigma


def _mean_luminance(glowing: Any, points_m: Array, normals: Array, paths: int, seed: int) -> Array:
    """Mean luminance along cosine-distributed directions from points (n, 3), (n,)."""
    count = len(points_m)
    with exact_math():
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, count * paths)
        number = dr.arange(mi.UInt32, count * paths) // paths
        normal = dr.gather(mi.Vector3f, mi.Vector3f(*normals.T.astype(np.float32)), number)
        origin = dr.gather(mi.Point3f, _points(points_m + RAY_OFFSET_M * normals), number)
        local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        ray = mi.Ray3f(origin, mi.Frame3f(normal).to_world(local))
        luminance = _path_luminance(glowing, sampler, ray)
        dr.eval(luminance)
    sums: Array = np.array(luminance, dtype=np.float64).reshape(count, paths).mean(axis=1)
    return sums


@dr.syntax
def _path_luminance(glowing: Any, sampler: Any, ray: Any) -> Any:
    """Luminance along rays: emission of all surfaces on a path, weighted by the reflectances before each.

    Paths are drawn by the surfaces' BSDFs alone: all surfaces emit, so that sampling of emitters would gain nothing.
    Russian roulette alone ends them. It is unbiased: a surviving path is divided by its probability, which is its
    weight, so that its weight is 1 again. With a smaller probability, such as 0.95, the weights would grow along a path
    and the variance would be infinite in rooms of reflectance above sqrt(0.95).
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
        keep = dr.select(depth > ROULETTE_DEPTH, dr.minimum(weight, 1.0), 1.0)
        active &= sampler.next_1d(active) < keep
        weight = dr.select(active, weight / keep, 0.0)
    return luminance


def _points(points_m: Array) -> "mi.Point3f":
    return mi.Point3f(*points_m.T.astype(np.float32))


def _compute(scene: Scene, mesh: Mesh, progress: Progress) -> BakedIlluminance:
    leds = scene.leds
    points = np.concatenate([mesh.probes_m, leds.centers_m])
    normals = np.concatenate([mesh.normals, np.tile([0.0, 0.0, -1.0], (len(leds), 1))])
    direct = _direct_lux(scene, mesh, points, normals, progress)
    vertices = direct[: len(mesh.probes_m)]
    return _with_bounces(scene, mesh, vertices, points, normals, direct, scene.settings.bake.paths, progress)


def illuminance_at(
    scene: Scene,
    mesh: Mesh,
    points_m: Array,
    normals: Array,
    paths: int,
    progress: Progress = lambda stage, share: None,
) -> BakedIlluminance:
    """Illuminance at surface points (n, 3) with unit normals (n, 3), not interpolated.

    mesh: `room_mesh(scene)`. paths: light paths traced from each point. A bake has the mesh's probes as its points;
    other points tell what its interpolation leaves out.
    """
    vertices = _direct_lux(scene, mesh, mesh.probes_m, mesh.normals, progress)
    direct = _direct_lux(scene, mesh, points_m, normals, progress)
    return _with_bounces(scene, mesh, vertices, points_m, normals, direct, paths, progress)


def _direct_lux(scene: Scene, mesh: Mesh, points_m: Array, normals: Array, progress: Progress) -> Array:
    """Direct illuminance of the LEDs at surface points (n, 3) with unit normals (n, 3), (n,)."""
    stage = "direct light of LEDs"
    progress(stage, 0.0)
    blockers = mitsuba_scene(mesh, np.zeros(len(mesh.vertices_m)), (), daylight=False)
    sources = point_sources(scene.leds)
    direct = led_illuminance_lux(
        blockers, points_m, normals, sources, scene.glazings, lambda share: progress(stage, share)
    )
    progress(stage, 1.0)
    return direct


def _with_bounces(
    scene: Scene,
    mesh: Mesh,
    vertices_lux: Array,
    points_m: Array,
    normals: Array,
    direct_lux: Array,
    paths: int,
    progress: Progress,
) -> BakedIlluminance:
    """Illuminance at points (n, 3) of direct illuminance `direct_lux` (n,), in a room whose vertices have another."""
    lit = mitsuba_scene(mesh, mesh.albedo * vertices_lux / np.pi, scene.glazings, daylight=False)
    bounced, sigma = path_traced_lux(
        lit, points_m, normals, paths, lambda share: progress("reflected light of LEDs", share)
    )
    daylight = np.zeros(len(points_m))
    if any(glazing.luminance_cd_m2 > 0 for glazing in scene.glazings):
        outside = mitsuba_scene(mesh, np.zeros(len(mesh.vertices_m)), scene.glazings, daylight=True)
        daylight, more = path_traced_lux(
            outside, points_m, normals, paths, lambda share: progress("daylight through glazing", share)
        )
        sigma = np.hypot(sigma, more)
    return BakedIlluminance(direct_lux + bounced, daylight, sigma)


def _key(scene: Scene, mesh: Mesh) -> str:
    """Hash of everything that a bake depends on: geometry, reflectances, textures, LEDs, glazing, number of paths."""
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
