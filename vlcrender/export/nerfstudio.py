"""Nerfstudio: images and transforms.json, camera-to-world matrices with OpenGL axes, intrinsics of each frame.

Source: Nerfstudio documentation, Data conventions; its undistortion subtracts half a pixel for OpenCV, so that pixel
centres are at +0.5 as ours. k3 is the coefficient of r^6. Its loader reads images as 8 bits.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlcrender.errors import InputError
from vlcrender.export.conventions import opengl_camera_to_world
from vlcrender.export.png16 import write_8bit
from vlcrender.export.source import Source


def write(source: Source, out: Path) -> Mapping[str, Any]:
    """Write images/, masks/ where only regions were read out, and transforms.json."""
    source.check_one_pose_a_frame()
    projections = {entry.projection for entry in source.dataset.cameras.values()}
    if len(projections) > 1:
        raise InputError(
            f"{source.to}: the rig has perspective and equidistant cameras; transforms.json has one camera_model"
        )
    fisheye = projections == {"equidistant"}
    frames = []
    for row, truth in source.posed_frames:
        camera = source.true_camera(row, truth).without_skew(source.to).within_half_space(source.to)
        k1, k2, k3, p1, p2 = camera.brown
        tangential = {} if fisheye else {"p1": p1, "p2": p2}
        pose = opengl_camera_to_world(np.reshape(truth.R_cam_world, (3, 3)), np.array(truth.position_m))
        frames.append(
            {
                "file_path": f"images/{row.frame:06d}.png",
                "transform_matrix": pose.tolist(),
                "w": camera.width_px,
                "h": camera.height_px,
                "fl_x": camera.fx,
                "fl_y": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "k1": k1,
                "k2": k2,
                "k3": k3,
                "k4": 0.0,
                **tangential,
            }
        )
    stated = write_8bit(source, out)
    for frame in frames:
        mask = f"masks/{Path(str(frame['file_path'])).name}"
        if (out / mask).is_file():
            frame["mask_path"] = mask
    model = "OPENCV_FISHEYE" if fisheye else "OPENCV"
    tree = {"camera_model": model, "frames": frames}
    (out / "transforms.json").write_text(json.dumps(tree, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return {**stated, "pixel_centres": "+0.5"}
