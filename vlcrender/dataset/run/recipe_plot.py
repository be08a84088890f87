"""Picture of a recipe: its poses on the floor plan, and one of its frames with the identities of the LEDs."""

import tempfile
from pathlib import Path

import numpy as np

from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import RegionImage
from vlcrender.dataset.format.exr import read_exr_parts
from vlcrender.dataset.format.files import FRAMES
from vlcrender.dataset.recipe.file_settings import FileSettings
from vlcrender.dataset.recipe.plan import Plan
from vlcrender.dataset.recipe.pose_sampling import pose_of_frame
from vlcrender.dataset.run.frame_job import Job, make_frame
from vlcrender.rendering.scene_plot import draw_view

MAX_POSES = 400
"""Poses that the plan shows: the first ones."""


def draw_frame(plan: Plan, frame: int, path: Path) -> str:
    """Write a PNG with the poses of a recipe and one frame as `generate` makes it; returns what it shows, as text.

    Of a sweep the frames are those of its first cell.
    """
    recipe, scene = plan.recipe, plan.scene
    plain = recipe.model_copy(
        update={"files": FileSettings(previews=0), "expected": False, "processed": None, "bound": False}
    )
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / FRAMES).mkdir()
        record = make_frame(Job.of(Plan(plain, scene), Path(folder)), frame)
        images = [(part.roi, part.image) for part in read_exr_parts(Path(folder) / record.device.file)]
    row, truth, sensor = record.device, record.truth, recipe.sensor
    white = sensor.largest_dn - sensor.black_level_dn
    regions = [
        RegionImage(roi, (np.maximum(dn, sensor.black_level_dn) - sensor.black_level_dn) / white) for roi, dn in images
    ]
    numbers = recipe.pose_numbers[:MAX_POSES]
    poses = [pose_of_frame(recipe.poses, number, recipe.seed, recipe.camera, scene) for number in numbers]
    told = next(one for one in recipe.cameras if one.name == row.camera)
    pose = pose_of_frame(recipe.poses, recipe.pose_numbers[row.pose], recipe.seed, recipe.camera, scene)
    posed: PosedCamera = told.posed(pose)
    x, y, z = truth.position_m
    title = (
        f"{recipe.name}, frame {frame}: {row.camera} at ({x:.2f}, {y:.2f}, {z:.2f}) m, tilted "
        f"{truth.tilt_x_deg:.1f} and {truth.tilt_y_deg:.1f} deg,\nyaw {truth.yaw_deg:.1f} deg, "
        f"{row.exposure_s * 1e6:.4g} us; white is saturated; gamma 2.2"
    )
    places = {led.led: (led.u_px, led.v_px) for led in truth.leds}
    positions_m = np.array([one.position_m for one in poses])
    draw_view(scene, posed, regions, places, title, path, positions_m)
    parts = "1 region" if len(regions) == 1 else f"{len(regions)} regions"
    return f"frame {frame} of {recipe.frame_count}: {len(truth.leds)} LEDs light {parts}"
