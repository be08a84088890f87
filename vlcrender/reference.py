"""The same view by Mitsuba's own sensor and path integrator: slow, independent of `render`, for checking it."""

import numpy as np
from numpy.typing import NDArray

from vlcrender.backend import mi
from vlcrender.camera import Camera, Pose, mitsuba_to_world
from vlcrender.errors import InputError
from vlcrender.irradiance import led_face_luminance_cd_m2, surface_luminance_cd_m2
from vlcrender.scene import Scene

BATCHES = 8
LED_STANDOFF_M = 1e-5
"""LED discs are put this far below what they are mounted on, so that a ray meets the disc first."""


def reference_cd_m2(
    scene: Scene, camera: Camera, pose: Pose, samples_per_pixel: int, seed: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Luminance averaged over each pixel, and the variance of that estimate, both (height, width).

    No lens: no cos^4, no aperture. `samples_per_pixel` is rounded up to a multiple of BATCHES, from whose scatter the
    variance comes. Raises InputError for a camera with skew, which Mitsuba's sensors do not have.
    """
    if camera.skew_px != 0:
        raise InputError(f"camera.skew_px = {camera.skew_px}: the reference renderer has no skew; it has to be 0")
    loaded = mi.load_dict(scene_dict(scene, camera, pose), optimize=False)
    each = -(-samples_per_pixel // BATCHES)
    images = []
    for batch in range(BATCHES):
        film = mi.render(loaded, spp=each, seed=seed * BATCHES + batch)
        images.append(np.asarray(film, dtype=np.float64).reshape(camera.height_px, camera.width_px))
    stack = np.stack(images)
    mean: NDArray[np.float64] = stack.mean(axis=0)
    variance: NDArray[np.float64] = stack.var(axis=0, ddof=1) / BATCHES
    return mean, variance


def sensor_dict(camera: Camera, pose: Pose) -> dict[str, object]:
    """Mitsuba's description of a camera: axes turned, principal point, box pixels in float32."""
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
        "to_world": mi.ScalarTransform4f(mitsuba_to_world(pose).tolist()),
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


def scene_dict(scene: Scene, camera: Camera, pose: Pose) -> dict[str, object]:
    """The scene for Mitsuba with flat surrounding light: every surface and LED shines with its own luminance."""
    tree: dict[str, object] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 1},
        "sensor": sensor_dict(camera, pose),
    }
    for number, (surface, luminance) in enumerate(zip(scene.surfaces, surface_luminance_cd_m2(scene), strict=True)):
        # Mitsuba's rectangle spans [-1, 1]^2.
        frame = np.eye(4)
        frame[:3, 0] = surface.edge_u_m / 2
        frame[:3, 1] = surface.edge_v_m / 2
        normal = np.cross(surface.edge_u_m, surface.edge_v_m)
        frame[:3, 2] = normal / np.linalg.norm(normal)
        frame[:3, 3] = surface.corner_m + (surface.edge_u_m + surface.edge_v_m) / 2
        tree[f"surface{number}"] = _glowing("rectangle", frame, float(luminance))
    leds = scene.leds
    faces = leds.luminances_cd_m2 + led_face_luminance_cd_m2(scene)
    for i in range(len(leds)):
        frame = np.diag([leds.radii_m[i], -leds.radii_m[i], -1.0, 1.0])  # faces down
        frame[:3, 3] = leds.centers_m[i] - [0, 0, LED_STANDOFF_M]
        tree[f"led{i}"] = _glowing("disk", frame, float(faces[i]))
    return tree


def _glowing(shape: str, frame: NDArray[np.float64], luminance_cd_m2: float) -> dict[str, object]:
    return {
        "type": shape,
        "to_world": mi.ScalarTransform4f(frame.tolist()),
        "emitter": {"type": "area", "radiance": luminance_cd_m2},
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
    }
