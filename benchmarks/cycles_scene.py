"""Render a scene of `cycles.py` with Cycles: PYTHON benchmarks/cycles_scene.py SCENE.json IMAGE.exr SAMPLES BOUNCES

Run by `cycles.py` with the Python that has `bpy`, which needs another NumPy than vlcrender. Prints the CPU time of the
render in seconds. The image holds luminances: emission is in cd/m2, and colours are grey.
"""

import json
import sys
import time
from pathlib import Path

import bpy
import numpy as np

RIM_POINTS = 32


def material(name: str, reflectance: float, lit: bool) -> "bpy.types.Material":
    """A Lambertian surface; `lit`: its front also emits the luminance that a face's attribute holds."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    output, diffuse = tree.nodes.new("ShaderNodeOutputMaterial"), tree.nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (reflectance, reflectance, reflectance, 1.0)
    surface = diffuse.outputs[0]
    if lit:
        side, light, luminance, front, both = (
            tree.nodes.new(kind)
            for kind in (
                *("ShaderNodeNewGeometry", "ShaderNodeEmission", "ShaderNodeAttribute"),
                *("ShaderNodeMath", "ShaderNodeAddShader"),
            )
        )
        luminance.attribute_name = "luminance"
        front.operation = "MULTIPLY_ADD"  # luminance * (-back) + luminance
        negative = tree.nodes.new("ShaderNodeMath")
        negative.operation = "MULTIPLY"
        negative.inputs[1].default_value = -1.0
        tree.links.new(side.outputs["Backfacing"], negative.inputs[0])
        tree.links.new(luminance.outputs["Fac"], front.inputs[0])
        tree.links.new(negative.outputs[0], front.inputs[1])
        tree.links.new(luminance.outputs["Fac"], front.inputs[2])
        tree.links.new(front.outputs[0], light.inputs["Strength"])
        tree.links.new(diffuse.outputs[0], both.inputs[0])
        tree.links.new(light.outputs[0], both.inputs[1])
        surface = both.outputs[0]
    tree.links.new(surface, output.inputs["Surface"])
    return made


def add_mesh(name: str, vertices: list, faces: list, of: "bpy.types.Material") -> "bpy.types.Mesh":
    """A mesh in the scene."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices, [], faces)
    mesh.materials.append(of)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, mesh))
    return mesh


def add_room(surfaces: list[dict]) -> None:
    """Rectangles by corner and edges."""
    for number, surface in enumerate(surfaces):
        corner, u, v = (np.array(surface[key]) for key in ("corner_m", "edge_u_m", "edge_v_m"))
        corners = [corner, corner + u, corner + u + v, corner + v]
        add_mesh(
            f"surface{number}",
            [tuple(one) for one in corners],
            [(0, 1, 2, 3)],
            material(f"surface{number}", surface["reflectance"], lit=False),
        )


def add_leds(leds: list[dict], reflectance: float) -> None:
    """Discs that face down, as polygons of the same area."""
    angle = -2 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS  # clockwise from above: the normal points down
    same_area = np.sqrt(2 * np.pi / RIM_POINTS / np.sin(2 * np.pi / RIM_POINTS))
    vertices, faces = [], []
    for led in leds:
        x, y, z = led["center_m"]
        radius = led["radius_m"] * same_area
        faces.append(tuple(range(len(vertices), len(vertices) + RIM_POINTS)))
        vertices += [(x + radius * c, y + radius * s, z) for c, s in zip(np.cos(angle), np.sin(angle), strict=True)]
    mesh = add_mesh("leds", vertices, faces, material("led", reflectance, lit=True))
    luminance = mesh.attributes.new("luminance", "FLOAT", "FACE")
    luminance.data.foreach_set("value", [led["luminance_cd_m2"] for led in leds])


def add_camera(camera: dict) -> None:
    """A pinhole, by Blender's axes: x right, y up, z backwards."""
    made = bpy.data.cameras.new("camera")
    made.sensor_fit, made.sensor_width, made.lens = "HORIZONTAL", camera["sensor_width_mm"], camera["focal_mm"]
    made.clip_start = 1e-3
    placed = bpy.data.objects.new("camera", made)
    placed.matrix_world = np.array(camera["to_world"]).T.tolist()
    scene = bpy.context.scene
    scene.collection.objects.link(placed)
    scene.camera = placed
    scene.render.resolution_x, scene.render.resolution_y = camera["width_px"], camera["height_px"]
    scene.render.resolution_percentage = 100


def main() -> None:
    """Build, render, and print the CPU time."""
    described, image, samples, bounces = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    asked = json.loads(described.read_text(encoding="utf-8"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    add_room(asked["surfaces"])
    add_leds(asked["leds"], asked["led_reflectance"])
    add_camera(asked["camera"])
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = "CPU", samples, False, False
    cycles.max_bounces = cycles.diffuse_bounces = bounces
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.pixel_filter_type, cycles.blur_glossy = "BOX", 0.0
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.view_settings.view_transform = "Raw"
    scene.render.filepath = image
    start_s = time.process_time()
    bpy.ops.render.render(write_still=True)
    print(f"CPU time {time.process_time() - start_s:.3f}", flush=True)


if __name__ == "__main__":
    main()
