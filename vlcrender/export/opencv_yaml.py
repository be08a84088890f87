"""Calibrations for cv::FileStorage: one YAML file a camera, as devices are told, pixel centres at integers.

Source: OpenCV, Camera Calibration and 3D Reconstruction, and Fisheye camera model. cv::projectPoints takes no skew.
`fisheye` has D = 0: OpenCV's theta_d is theta, our equidistant projection.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vlcrender.export.conventions import translation, yaml_number
from vlcrender.export.source import Source


def write(source: Source, out: Path) -> Mapping[str, Any]:
    """Write CAMERA.yaml for each camera."""
    for name, entry in source.dataset.cameras.items():
        camera = source.told_camera(name).without_skew(source.to).within_half_space(source.to).with_integer_centres()
        k1, k2, k3, p1, p2 = camera.brown
        rotation = np.array(entry.R_cam_rig)
        model, coefficients = ("fisheye", [0.0] * 4) if camera.is_fisheye else ("pinhole", [k1, k2, p1, p2, k3])
        file = "\n".join(
            (
                "%YAML:1.0",
                "---",
                f"image_width: {camera.width_px}",
                f"image_height: {camera.height_px}",
                f"camera_name: {name}",
                f"camera_model: {model}",
                _matrix("camera_matrix", camera.matrix),
                _matrix("distortion_coefficients", [coefficients]),
                _matrix("R_cam_rig", rotation.tolist()),
                _matrix("t_cam_rig", [[number] for number in translation(rotation, np.array(entry.offset_m))]),
                "",
            )
        )
        (out / f"{name}.yaml").write_text(file, encoding="utf-8")
    return {"pixel_centres": "integer"}


def _matrix(key: str, rows: Sequence[Sequence[float]]) -> str:
    data = ", ".join(yaml_number(number) for row in rows for number in row)
    return f"{key}: !!opencv-matrix\n   rows: {len(rows)}\n   cols: {len(rows[0])}\n   dt: d\n   data: [ {data} ]"
