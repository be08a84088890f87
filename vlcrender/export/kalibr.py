"""Kalibr's camchain.yaml: the rig as its devices are told, pixel centres at integers as in OpenCV.

Source: Kalibr wiki, yaml formats and supported models. `radtan` has k1, k2, p1, p2; `equidistant` with zeros is our
fish-eye. T_cn_cnm1 maps points from the camera before.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlcrender.export.conventions import Array, translation, yaml_list
from vlcrender.export.source import Source


def write(source: Source, out: Path) -> Mapping[str, Any]:
    """Write camchain.yaml."""
    lines, before = [], np.eye(4)
    for number, (name, entry) in enumerate(source.dataset.cameras.items()):
        camera = source.told_camera(name).without_skew(source.to).without_k3(source.to).within_half_space(source.to)
        camera = camera.with_integer_centres()
        k1, k2, _, p1, p2 = camera.brown
        if camera.is_fisheye:
            model, coefficients = "equidistant", [0.0] * 4
        elif camera.distortion is None:
            model, coefficients = "none", []
        else:
            model, coefficients = "radtan", [k1, k2, p1, p2]
        cam_rig = _matrix(np.array(entry.R_cam_rig), np.array(entry.offset_m))
        lines += [
            f"cam{number}:",
            "  camera_model: pinhole",
            f"  intrinsics: {yaml_list([camera.fx, camera.fy, camera.cx, camera.cy])}",
            f"  distortion_model: {model}",
            f"  distortion_coeffs: {yaml_list(coefficients)}",
            f"  resolution: [{camera.width_px}, {camera.height_px}]",
            f"  rostopic: /{name}/image_raw",
        ]
        if number:
            lines.append("  T_cn_cnm1:")
            lines += [f"  - {yaml_list(row)}" for row in (cam_rig @ np.linalg.inv(before)).tolist()]
        before = cam_rig
    (out / "camchain.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return {"pixel_centres": "integer", "cameras": list(source.dataset.cameras)}


def _matrix(rotation: Array, offset_m: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation(rotation, offset_m)
    return matrix
