"""COLMAP: images and a sparse text model, with LEDs as 3D points and the images of their centres as 2D points.

Source: COLMAP documentation, Output Format and Camera Models. Camera axes and pixel positions are ours: pixel centres
at +0.5. Poses map world to camera; quaternions start with the scalar.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlcrender.export.conventions import Intrinsics, quaternion_wxyz, text, translation
from vlcrender.export.png16 import write_8bit
from vlcrender.export.source import Source


def write(source: Source, out: Path) -> Mapping[str, Any]:
    """Write images/, masks/ where only regions were read out, and sparse/0/{cameras,images,points3D}.txt."""
    source.check_one_pose_a_frame()
    cameras: dict[Intrinsics, int] = {}
    stride = 1 + max((led for leds in source.maps.values() for led in leds), default=0)
    images: list[str] = []
    tracks: dict[int, tuple[np.ndarray[Any, np.dtype[np.float64]], list[int]]] = {}
    for row, truth in source.posed_frames:
        camera = cameras.setdefault(source.true_camera(row, truth), len(cameras) + 1)
        rotation = np.reshape(truth.R_cam_world, (3, 3))
        pose = [*quaternion_wxyz(rotation), *translation(rotation, np.array(truth.position_m))]
        points = []
        for number, led in enumerate(truth.leds):
            point = truth.map * stride + led.led
            points.append(f"{text([led.u_px, led.v_px])} {point}")
            position_m = source.led(truth, led.led).position_m
            tracks.setdefault(point, (position_m, []))[1].extend((row.frame + 1, number))
        images += [f"{row.frame + 1} {text(pose)} {camera} {row.frame:06d}.png", " ".join(points)]
    models = [f"{number} {_model(camera, source.to)}" for camera, number in cameras.items()]
    folder = out / "sparse" / "0"
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("\n".join(models) + "\n", encoding="utf-8")
    (folder / "images.txt").write_text("\n".join(images) + "\n", encoding="utf-8")
    lines = [
        f"{point} {text(position_m)} 255 255 255 0 {' '.join(map(str, track))}"
        for point, (position_m, track) in sorted(tracks.items())
    ]
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return {
        **write_8bit(source, out, ".png.png"),
        "pixel_centres": "+0.5",
        "image_id": "frame + 1",
        "point3d_id": f"map * {stride} + led",
    }


def _model(camera: Intrinsics, to: str) -> str:
    """Model, size and parameters of a camera."""
    camera.without_skew(to).within_half_space(to)
    k1, k2, k3, p1, p2 = camera.brown
    name, parameters = "PINHOLE", [camera.fx, camera.fy, camera.cx, camera.cy]
    if camera.is_fisheye:
        name, parameters = "OPENCV_FISHEYE", [*parameters, 0.0, 0.0, 0.0, 0.0]
    elif k3:
        name, parameters = "FULL_OPENCV", [*parameters, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    elif camera.distortion is not None:
        name, parameters = "OPENCV", [*parameters, k1, k2, p1, p2]
    return f"{name} {camera.width_px} {camera.height_px} {text(parameters)}"
