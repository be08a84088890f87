"""BOP (6D object pose): a scene for each camera, LEDs as objects, millimetres, rotations row by row.

Source: bop_toolkit, Format of BOP datasets. Camera axes are OpenCV's; pixel centres are at integers, as in the
toolkit's conversion of depth images. Images have no distortion and no depth. A model has the axes of the world.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlcrender.errors import InputError
from vlcrender.export.conventions import Array, text, translation
from vlcrender.export.png16 import write_png
from vlcrender.export.source import LedPoint, Source

CIRCLE_VERTICES = 64
MM = 1000.0


def write(source: Source, out: Path) -> Mapping[str, Any]:
    """Write models/, camera*.json and test/SCENE/{gray, scene_camera.json, scene_gt.json, scene_gt_leds.json}."""
    source.check_one_pose_a_frame()
    objects: dict[tuple[str, float], int] = {}
    names = list(source.dataset.cameras)
    for scene, name in enumerate(names):
        folder = out / "test" / f"{scene:06d}"
        (folder / "gray").mkdir(parents=True)
        cameras: dict[str, Any] = {}
        poses: dict[str, Any] = {}
        leds: dict[str, Any] = {}
        for row, truth in source.posed_frames:
            if row.camera != name:
                continue
            camera = source.true_camera(row, truth).pinhole(source.to).with_integer_centres()
            rotation, position_m = np.reshape(truth.R_cam_world, (3, 3)), np.array(truth.position_m)
            key = str(row.frame)
            cameras[key] = {
                "cam_K": [number for line in camera.matrix for number in line],
                "depth_scale": 1.0,
                "cam_R_w2c": list(truth.R_cam_world),
                "cam_t_w2c": (MM * translation(rotation, position_m)).tolist(),
            }
            points = [source.led(truth, led.led) for led in truth.leds]
            poses[key] = [
                {
                    "cam_R_m2c": list(truth.R_cam_world),
                    "cam_t_m2c": (MM * (rotation @ (point.position_m - position_m))).tolist(),
                    "obj_id": objects.setdefault(_kind(point, source.to), len(objects) + 1),
                }
                for point in points
            ]
            leds[key] = [point.led for point in points]
            write_png(folder / "gray" / f"{row.frame:06d}.png", source.image_8bit(row)[0], None, None)
        for file, tree in (("scene_camera", cameras), ("scene_gt", poses), ("scene_gt_leds", leds)):
            _write_json(folder / f"{file}.json", tree)
        told = source.told_camera(name).with_integer_centres()
        entry = {"fx": told.fx, "fy": told.fy, "cx": told.cx, "cy": told.cy, "depth_scale": 1.0}
        size = {"width": told.width_px, "height": told.height_px}
        _write_json(out / ("camera.json" if len(names) == 1 else f"camera_{name}.json"), {**entry, **size})
    (out / "models").mkdir()
    infos = {}
    for (shape, size_m), number in objects.items():
        vertices = _outline_mm(shape, size_m)
        _write_ply(out / "models" / f"obj_{number:06d}.ply", vertices)
        infos[str(number)] = _info(shape, vertices)
    _write_json(out / "models" / "models_info.json", infos)
    return {
        "image_bits": 8,
        "image_scale": source.scale_8bit,
        "pixels_not_read": 0,
        "pixel_centres": "integer",
        "scenes": names,
    }


def _kind(point: LedPoint, to: str) -> tuple[str, float]:
    if point.shape is None:
        raise InputError(
            f"{to}: the set does not state the shape of LED {point.led} (map = sent): no model can be made"
        )
    return point.shape, point.size_m


def _outline_mm(shape: str, size_m: float) -> Array:
    """Rim (n, 3) of a face about its centre, from above against the clock, mm."""
    if shape == "square":
        half = MM * size_m / 2
        return np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    angle = 2 * np.pi * np.arange(CIRCLE_VERTICES) / CIRCLE_VERTICES
    return MM * size_m * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)


def _write_ply(path: Path, vertices: Array) -> None:
    """A flat face that looks down, as a fan of triangles, with normals."""
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    head += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    head += [f"element face {len(vertices) - 2}", "property list uchar int vertex_indices", "end_header"]
    points = [f"{text(vertex)} 0 0 -1" for vertex in vertices]
    faces = [f"3 0 {number + 1} {number}" for number in range(1, len(vertices) - 1)]
    path.write_text("\n".join([*head, *points, *faces]) + "\n", encoding="utf-8")


def _info(shape: str, vertices: Array) -> dict[str, Any]:
    low, size = vertices.min(axis=0), np.ptp(vertices, axis=0)
    between = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1)
    info: dict[str, Any] = {"diameter": float(between.max())}
    info |= {f"min_{axis}": float(low[i]) for i, axis in enumerate("xyz")}
    info |= {f"size_{axis}": float(size[i]) for i, axis in enumerate("xyz")}
    if shape == "disc":
        return {**info, "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]}
    quarters = ((0, -1, 1, 0), (-1, 0, 0, -1), (0, 1, -1, 0))
    turns = [[a, b, 0, 0, c, d, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1] for a, b, c, d in quarters]
    return {**info, "symmetries_discrete": turns}


def _write_json(path: Path, tree: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(tree, indent=1, allow_nan=False) + "\n", encoding="utf-8")
