"""A room as a Mitsuba scene: its mesh, its glazing, and the luminance that surfaces emit."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.backend import dr, mi
from vlcrender.scene.fresnel import glazing_reflectance
from vlcrender.scene.mesh import Mesh
from vlcrender.scene.surfaces import Glazing

BEHIND_SHARE = 1e-3
"""Distance of the scene outside behind its glazing, as a share of 1 m and the largest coordinate. Mitsuba lifts a ray
off what it has met by 9e-5 of that length, and what is nearer is not seen."""
GRAZING = 10.0
"""Distances by which the scene outside goes on past the edges of its glazing: rays at 84 deg to the normal meet it."""
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
    return _shape(glazing.name, glazing.corners_m, GLAZING_FACES, glazing_bsdf(glazing.refractive_index), np.zeros(4))


def outside_shape(glazing: Glazing) -> "mi.Mesh":
    """The scene outside of glazing as a Mitsuba shape: black, emitting the glazing's luminance, just behind it."""
    corners_m = outside_of(glazing).corners_m
    black = {"type": "diffuse", "reflectance": 0.0}
    return _shape(f"outside {glazing.name}", corners_m, GLAZING_FACES, black, np.full(4, glazing.luminance_cd_m2))


def outside_of(glazing: Glazing) -> Glazing:
    """The rectangle just behind glazing that stands for the scene outside."""
    behind_m = BEHIND_SHARE * (1 + float(np.abs(glazing.corners_m).max()))
    past_u, past_v = (GRAZING * behind_m * edge / np.linalg.norm(edge) for edge in (glazing.edge_u_m, glazing.edge_v_m))
    return replace(
        glazing,
        corner_m=glazing.corner_m - behind_m * glazing.normal - past_u - past_v,
        edge_u_m=glazing.edge_u_m + 2 * past_u,
        edge_v_m=glazing.edge_v_m + 2 * past_v,
    )


class GlazingBsdf(mi.BSDF):
    """Thin glass of the property `index`: it reflects the share of `glazing_reflectance`, transmits the rest unbent.

    Mitsuba's own "thindielectric" averages the polarisations before it sums the reflections between the faces.
    """

    def __init__(self, props: "mi.Properties") -> None:
        """Mitsuba's interface."""
        super().__init__(props)
        index: Any = props["index"]
        self._index = float(index)
        both = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
        self.m_components = [mi.BSDFFlags.DeltaReflection | both, mi.BSDFFlags.Null | both]
        self.m_flags = self.m_components[0] | self.m_components[1]

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        """Mitsuba's interface: (sample, weight); the weight is 1."""
        share = glazing_reflectance(dr.abs(mi.Frame3f.cos_theta(si.wi)), self._index, dr.sqrt)
        reflected = mi.Bool(active) & (sample1 <= share)
        sample: Any = dr.zeros(mi.BSDFSample3f)
        sample.wo = dr.select(reflected, mi.reflect(si.wi), -si.wi)
        sample.pdf = dr.select(reflected, share, 1 - share)
        sample.eta = mi.Float(1.0)
        sample.sampled_component = dr.select(reflected, mi.UInt32(0), mi.UInt32(1))
        of_reflection, of_transmission = mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.Null
        sample.sampled_type = dr.select(reflected, mi.UInt32(+of_reflection), mi.UInt32(+of_transmission))
        return sample, dr.select(mi.Bool(active), mi.Spectrum(1.0), mi.Spectrum(0.0))

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Mitsuba's interface: 0, since no direction but those of `sample` has light."""
        return mi.Spectrum(0.0)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Mitsuba's interface: 0, see `eval`."""
        return mi.Float(0.0)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Mitsuba's interface: `eval` and `pdf`."""
        return mi.Spectrum(0.0), mi.Float(0.0)


def glazing_bsdf(refractive_index: float) -> GlazingBsdf:
    """Mitsuba's BSDF of thin glass."""
    properties = mi.Properties()
    properties["index"] = refractive_index
    return GlazingBsdf(properties)


def _shape(
    name: str, vertices_m: Array, faces: NDArray[np.int64], bsdf: Mapping[str, object] | mi.BSDF, glow_cd_m2: Array
) -> "mi.Mesh":
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(dict(bsdf)) if isinstance(bsdf, Mapping) else bsdf
    shape = mi.Mesh(name, len(vertices_m), len(faces), props=properties)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = vertices_m.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    shape.add_attribute("vertex_glow", 1, glow_cd_m2.astype(np.float32).tolist())
    return shape
