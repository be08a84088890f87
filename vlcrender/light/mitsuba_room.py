"""A room as a Mitsuba scene: its mesh, its glazing, and the luminance that surfaces emit."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.backend import mi
from vlcrender.scene.mesh import Mesh
from vlcrender.scene.surfaces import Glazing

BEHIND_M = 1e-3
"""Distance of the scene outside behind its glazing in metres, and the share by which it is larger than the glazing."""
GLAZING_FACES = np.array([[0, 1, 2], [0, 2, 3]])

Array = NDArray[np.float64]


def mitsuba_scene(mesh: Mesh, glow_cd_m2: Array, glazings: tuple[Glazing, ...], daylight: bool) -> Any:
    """Mesh and glazing as a Mitsuba scene.

    Each shape has an attribute `vertex_glow`, the luminance that it emits in cd/m2: `glow_cd_m2` (vertices,) of the
    mesh, and with `daylight` the luminance of the scene outside behind each glazing.
    """
    shapes = {"room": room_shape(mesh, glow_cd_m2)}
    for i, glazing in enumerate(glazings):
        shapes[f"glazing{i}"] = glazing_shape(glazing)
        if daylight:
            shapes[f"outside{i}"] = outside_shape(glazing)
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


def room_shape(mesh: Mesh, glow_cd_m2: Array) -> "mi.Mesh":
    """The room's mesh as a diffuse Mitsuba shape, with albedo and emitted luminance at its vertices."""
    albedo = {"type": "mesh_attribute", "name": "vertex_albedo"}
    bsdf: dict[str, object] = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": albedo}}
    shape = _shape("room", mesh.vertices_m, mesh.faces, bsdf, glow_cd_m2)
    shape.add_attribute("vertex_albedo", 1, mesh.albedo.astype(np.float32).tolist())
    return shape


def glazing_shape(glazing: Glazing) -> "mi.Mesh":
    """Glazing as a Mitsuba shape of thin glass."""
    return _shape(glazing.name, glazing.corners_m, GLAZING_FACES, glazing_bsdf(glazing), np.zeros(4))


def outside_shape(glazing: Glazing) -> "mi.Mesh":
    """The scene outside of glazing as a Mitsuba shape: black, emitting the glazing's luminance, just behind it."""
    middle = glazing.corners_m.mean(axis=0)
    corners = middle + (1 + BEHIND_M) * (glazing.corners_m - middle) - BEHIND_M * glazing.normal
    black = {"type": "diffuse", "reflectance": 0.0}
    return _shape(f"outside {glazing.name}", corners, GLAZING_FACES, black, np.full(4, glazing.luminance_cd_m2))


def glazing_bsdf(glazing: Glazing) -> dict[str, object]:
    """Mitsuba's BSDF of thin glass: Fresnel reflection at both faces, transmission of the rest."""
    return {"type": "thindielectric", "int_ior": glazing.refractive_index, "ext_ior": 1.0}


def _shape(
    name: str, vertices_m: Array, faces: NDArray[np.int64], bsdf: Mapping[str, object], glow_cd_m2: Array
) -> "mi.Mesh":
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(dict(bsdf))
    shape = mi.Mesh(name, len(vertices_m), len(faces), props=properties)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = vertices_m.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    shape.add_attribute("vertex_glow", 1, glow_cd_m2.astype(np.float32).tolist())
    return shape
