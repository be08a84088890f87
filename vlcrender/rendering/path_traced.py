"""Reference images by Mitsuba's path integrator: slow, independent of `Renderer` and of the lightmap, to check them.

The room is built from Mitsuba's rectangles and discs, every LED is an area emitter, and paths start at the camera. Two
images add up: the light of LEDs and glazings with all its reflections, and the ambient light, which is defined to
include its own reflections and so is taken at the first surface. Furniture alone is read and subdivided by the same
code as for `Renderer`.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.core.backend import dr, mi
from vlcrender.core.face_profile import FaceProfile
from vlcrender.errors import InputError
from vlcrender.light.mitsuba_room import glazing_bsdf, outside_of, room_shape
from vlcrender.scene.furniture import furniture_meshes
from vlcrender.scene.loader import Scene
from vlcrender.scene.surfaces import TOUCH_M, Surface
from vlcrender.scene.texture import Texture

Array = NDArray[np.float64]

BATCHES = 8
LED_STANDOFF_M = 1e-5
"""Distance of LEDs below the surface that they are mounted on, so that a ray meets the LED first."""
DIFFUSER_PIXELS = 16
"""Pixels of a diffuser's bitmap, linear in between, along a distance equal to that of the LEDs behind it."""
PROFILE_PIXELS = 256
"""Pixels across the bitmap of an LED's luminance profile."""
ROULETTE_DEPTH = 8
"""Bounces before Russian roulette begins, which alone ends paths. Mitsuba's keeps at most 95 % of them at a bounce: the
variance is infinite, and the mean without bias, where reflectances are above sqrt(0.95) = 0.97 all round."""
MAX_GLAZINGS = 4
"""Glazings that a ray may meet before the first diffuse surface."""


class Reference(NamedTuple):
    """A path-traced image, (height, width): mean luminance of each pixel, and the variance of that estimate."""

    cd_m2: Array
    variance: Array


def reference_cd_m2(scene: Scene, posed: PosedCamera, samples_per_pixel: int, seed: int = 0) -> Reference:
    """Luminance averaged over each pixel (and the pupil), without relative illumination and aperture.

    A pinhole is Mitsuba's own perspective sensor; for other lenses rays are drawn here, evenly over the pixel and the
    pupil, and traced by Mitsuba. The variance comes from the scatter of BATCHES images. Raises InputError for a psf,
    off-axis blur or glare, and for bare LEDs that are not Lambertian: Mitsuba's area emitters are Lambertian or emit
    along the normal only.
    """
    camera = posed.camera
    if camera.psf != "none":
        raise InputError(f"camera.psf = {camera.psf!r}: the reference renderer has no diffraction; it has to be 'none'")
    if camera.glare is not None:
        raise InputError("camera.glare: the reference renderer has no glare; remove the table")
    if camera.off_axis_sigma_um > 0:
        raise InputError(f"camera.off_axis_sigma_um = {camera.off_axis_sigma_um:g}: the reference renderer needs 0")
    bare = np.array([diffuser is None for diffuser in scene.leds.diffusers])
    if not np.allclose(scene.leds.orders[bare], 1.0):
        raise InputError("half_power_deg: the reference renderer's LEDs are Lambertian; it has to be 60")
    loaded = mi.load_dict(scene_dict(scene, posed), optimize=False)
    all_light = mi.load_dict({"type": "path", "max_depth": -1, "rr_depth": ROULETTE_DEPTH})
    ambient = _FirstSurface(scene.settings.ambient.illuminance_lux)
    pinhole = camera.lens_projection.keeps_lines_straight and camera.focus_distance_m is None
    render = _by_sensor if pinhole and camera.skew_px == 0 and camera.aspect_ratio == 1 else _by_rays
    each = -(-samples_per_pixel // BATCHES)
    images = []
    for batch in range(BATCHES):
        number = 2 * (seed * BATCHES + batch)
        image = render(loaded, all_light, posed, each, number) + render(loaded, ambient, posed, each, number + 1)
        images.append(image.reshape(camera.height_px, camera.width_px))
    stack = np.stack(images)
    return Reference(stack.mean(axis=0), stack.var(axis=0, ddof=1) / BATCHES)


class _FirstSurface(mi.SamplingIntegrator):
    """Luminance, in an even illuminance, of the first diffuse surface that a ray meets by way of any glazings."""

    def __init__(self, illuminance_lux: float) -> None:
        super().__init__(mi.Properties())
        self._white_cd_m2 = illuminance_lux / np.pi

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
        """Mitsuba's interface: (luminance, whether a surface was met, no further channels)."""
        reflectance, met = _trace(scene, sampler, mi.Ray3f(ray), mi.Bool(active))
        return self._white_cd_m2 * reflectance, met, []


@dr.syntax
def _trace(scene: Any, sampler: Any, ray: Any, active: Any) -> Any:
    met, glazings = mi.Bool(False), mi.UInt32(0)
    reflectance: Any = mi.Float(0.0)
    while active:
        si = scene.ray_intersect(ray, active)
        bsdf = si.bsdf()
        active &= si.is_valid()
        on_glazing = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) & (glazings < MAX_GLAZINGS)
        diffuse = mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si, active & ~on_glazing))[0]
        reflectance = dr.select(active & ~on_glazing, diffuse, reflectance)
        met |= active
        sample, _ = bsdf.sample(
            mi.BSDFContext(), si, sampler.next_1d(on_glazing), sampler.next_2d(on_glazing), on_glazing
        )
        ray = si.spawn_ray(si.to_world(sample.wo))
        glazings += 1
        active &= on_glazing
    return reflectance, met


def _by_sensor(scene: Any, integrator: Any, posed: PosedCamera, samples: int, seed: int) -> Array:
    return np.asarray(mi.render(scene, integrator=integrator, spp=samples, seed=seed), dtype=np.float64)


def _by_rays(scene: Any, integrator: Any, posed: PosedCamera, samples: int, seed: int) -> Array:
    """Thin lens: rays from points of the pupil to where the ray through its centre meets the plane of focus."""
    camera = posed.camera
    count = camera.width_px * camera.height_px
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count * samples)
    pixel = dr.arange(mi.UInt32, count * samples) // samples
    row = pixel // camera.width_px
    within = sampler.next_2d()
    u, v = mi.Float(pixel - row * camera.width_px) + within.x, mi.Float(row) + within.y
    x, y, z = camera.unproject(u, v, dr)
    pupil_m = 0.0 if camera.focus_distance_m is None else camera.aperture_mm / 2000
    off = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d()) * pupil_m
    if isinstance(camera.focus_distance_m, float):
        x, y, z = x - off.x / camera.focus_distance_m, y - off.y / camera.focus_distance_m, z
    to_world = posed.rotation.T.tolist()
    direction = mi.Vector3f(*(r[0] * x + r[1] * y + r[2] * z for r in to_world))
    origin = mi.Point3f(
        *(p + r[0] * off.x + r[1] * off.y for p, r in zip(posed.pose.position_m, to_world, strict=True))
    )
    luminance, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(origin, dr.normalize(direction)))
    mean: Array = np.array(luminance, dtype=np.float64).reshape(count, samples).mean(axis=1)
    return mean


def sensor_dict(posed: PosedCamera) -> dict[str, object]:
    """Mitsuba's description of a camera: axes turned, principal point, box pixels in float32."""
    camera = posed.camera
    u, v = camera.center_px
    return {
        "type": "perspective",
        "fov": camera.view_angles_deg()[0],
        "fov_axis": "x",
        "near_clip": 1e-3,
        "far_clip": 1e4,
        # Fractions of the image; positive moves the image left and up.
        "principal_point_offset_x": -(u / camera.width_px - 0.5),
        "principal_point_offset_y": -(v / camera.height_px - 0.5),
        "to_world": mi.ScalarTransform4f(posed.mitsuba_to_world().tolist()),
        "film": {
            "type": "hdrfilm",
            "width": camera.width_px,
            "height": camera.height_px,
            "pixel_format": "luminance",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent"},
    }


def scene_dict(scene: Scene, posed: PosedCamera) -> dict[str, object]:
    """The scene for Mitsuba: LEDs and the outdoors behind glazings emit; a glazing reflects and transmits."""
    tree: dict[str, object] = {"type": "scene", "sensor": sensor_dict(posed)}
    number = 0
    for surface in scene.surfaces:
        for corner, edge_u, edge_v in _without_holes(surface):
            bsdf = _diffuse(surface.reflectance)
            if surface.texture is not None:
                bsdf["reflectance"] = _bitmap(surface.texture, corner, edge_u, edge_v)
            part = _shape("rectangle", _frame(corner, edge_u, edge_v), bsdf, 0.0)
            glow = _diffuser_cd_m2(scene, surface)
            if glow is not None:
                part["emitter"] = {"type": "area", "radiance": _glow(glow)}
            tree[f"surface{number}"] = part
            number += 1
    for i, mesh in enumerate(furniture_meshes(scene, 0)):
        tree[f"furniture{i}"] = room_shape(mesh, np.zeros(len(mesh.vertices_m)))
    for i, glazing in enumerate(scene.glazings):
        frame, behind = (_frame(one.corner_m, one.edge_u_m, one.edge_v_m) for one in (glazing, outside_of(glazing)))
        tree[f"glazing{i}"] = _shape("rectangle", frame, glazing_bsdf(glazing.refractive_index), 0.0)
        tree[f"outside{i}"] = _shape("rectangle", behind, _diffuse(0.0), glazing.luminance_cd_m2)
    leds, face = scene.leds, scene.settings.led_reflectance
    for i in range(len(leds)):
        if leds.diffusers[i] is not None:
            continue  # its diffuser emits
        radius = leds.half_widths_m[i]
        frame = np.diag([radius, -radius, -1.0, 1.0])  # faces down
        frame[:3, 3] = leds.centers_m[i] - [0, 0, LED_STANDOFF_M]
        shape = "rectangle" if leds.squares[i] else "disk"
        part = _shape(shape, frame, _diffuse(face), leds.luminances_cd_m2[i])
        profile = leds.profile(i)
        if profile is not None:
            glow = leds.luminances_cd_m2[i] * _profile_image(profile, radius, shape)
            part["emitter"] = {"type": "area", "radiance": _glow(mi.Bitmap(glow[:, :, None].astype(np.float32)))}
        tree[f"led{i}"] = part
    return tree


def _without_holes(surface: Surface) -> list[tuple[Array, Array, Array]]:
    """Corner and edges of rectangles that make up a surface: strips along v, cut at the holes."""
    corner, edge_u, edge_v, holes = surface.corner_m, surface.edge_u_m, surface.edge_v_m, surface.holes
    cuts = np.unique([0.0, 1.0, *(cut for a0, _, a1, _ in holes for cut in (a0, a1))])
    parts = []
    for low, high in pairwise(cuts):
        if high - low < 1e-12:
            continue
        across = sorted((b0, b1) for a0, b0, a1, b1 in holes if a0 < (low + high) / 2 < a1)
        start = 0.0
        for b0, b1 in [*across, (1.0, 1.0)]:
            if b0 - start > 1e-12:
                parts.append((corner + low * edge_u + start * edge_v, (high - low) * edge_u, (b0 - start) * edge_v))
            start = b1
    return parts


def _frame(corner: Array, edge_u: Array, edge_v: Array) -> Array:
    """`to_world` of Mitsuba's rectangle, which spans [-1, 1]^2."""
    frame = np.eye(4)
    frame[:3, 0] = edge_u / 2
    frame[:3, 1] = edge_v / 2
    normal = np.cross(edge_u, edge_v)
    frame[:3, 2] = normal / np.linalg.norm(normal)
    frame[:3, 3] = corner + (edge_u + edge_v) / 2
    return frame


def _diffuser_cd_m2(scene: Scene, surface: Surface) -> "mi.Bitmap | None":
    """Luminance of a panel's diffuser, rows along edge_v and columns along edge_u; None for other surfaces."""
    low = surface.corner_m
    high = low + surface.edge_u_m + surface.edge_v_m
    lit = [
        (diffuser, scene.leds.luminances_cd_m2[i])
        for i, diffuser in enumerate(scene.leds.diffusers)
        if diffuser is not None
        and abs(low[2] - scene.leds.centers_m[i, 2]) + abs(high[2] - low[2]) < TOUCH_M
        and np.allclose(diffuser.opening_m, [*low[:2], *high[:2]], rtol=0, atol=TOUCH_M)
    ]
    if not lit:
        return None
    step_m = min(diffuser.distance_m for diffuser, _ in lit) / DIFFUSER_PIXELS
    columns, rows = (int(np.ceil(np.linalg.norm(edge) / step_m)) for edge in (surface.edge_u_m, surface.edge_v_m))
    b, a = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    at = low + a[..., None] * surface.edge_u_m + b[..., None] * surface.edge_v_m
    total = np.zeros((rows, columns))
    for diffuser, luminance in lit:
        x0, y0, x1, y1 = diffuser.lit_m
        within = (at[..., 0] >= x0) & (at[..., 0] <= x1) & (at[..., 1] >= y0) & (at[..., 1] <= y1)
        total += luminance * within * diffuser.at(at[..., 0], at[..., 1])
    return mi.Bitmap(total[:, :, None].astype(np.float32))


def _profile_image(profile: FaceProfile, half_width_m: float, shape: str) -> Array:
    """The profile at PROFILE_PIXELS^2 texture positions of a face that faces down, whose y axis is turned over.

    Mitsuba's rectangle has (u, v) along x and y; its disc has u along the radius and v along the angle.
    """
    at = (np.arange(PROFILE_PIXELS) + 0.5) / PROFILE_PIXELS
    if shape == "rectangle":
        x, y = np.meshgrid(2 * at - 1, 2 * at - 1)
    else:
        radius, turns = np.meshgrid(at, at)
        x, y = radius * np.cos(2 * np.pi * turns), radius * np.sin(2 * np.pi * turns)
    return profile.at(half_width_m * x, -half_width_m * y)


def _glow(bitmap: "mi.Bitmap") -> dict[str, object]:
    """Radiance of an emitter, linear between the bitmap's pixels."""
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}


def _bitmap(texture: Texture, corner: Array, edge_u: Array, edge_v: Array) -> dict[str, object]:
    """A texture on Mitsuba's rectangle, whose (u, v) run along its edges; (0, 0) to (1, 1) is the image."""
    size = np.array(texture.reflectances.shape[::-1])
    start, along_u, along_v = (texture.at_px(corner + edge) / size for edge in (np.zeros(3), edge_u, edge_v))
    to_uv = np.eye(3)
    to_uv[:2] = np.stack([along_u - start, along_v - start, start], axis=1)
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(texture.reflectances[:, :, None].astype(np.float32)),
        "raw": True,
        "to_uv": mi.ScalarTransform3f(to_uv.tolist()),
    }


def _diffuse(reflectance: float) -> dict[str, object]:
    return {"type": "diffuse", "reflectance": reflectance}


def _shape(shape: str, frame: Array, bsdf: dict[str, object] | mi.BSDF, luminance_cd_m2: float) -> dict[str, Any]:
    tree = {"type": shape, "to_world": mi.ScalarTransform4f(frame.tolist()), "bsdf": bsdf}
    if luminance_cd_m2 > 0:
        tree["emitter"] = {"type": "area", "radiance": float(luminance_cd_m2)}
    return tree
