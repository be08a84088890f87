"""One frame of a dataset: where its cameras are, what they see, what is written of it."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from vlcrender.camera import Pose
from vlcrender.dataset import exr_attributes, write_exr, write_preview
from vlcrender.downlink import decoded_spots
from vlcrender.exposure import expose
from vlcrender.motion import poses_during
from vlcrender.poses import pose_of_frame
from vlcrender.recipe import Recipe
from vlcrender.render import Renderer
from vlcrender.scene import Scene, build_scene
from vlcrender.scene_settings import SceneSettings
from vlcrender.streams import stream
from vlcrender.windows import Window

FRAMES, EXPECTED, PREVIEWS = "frames", "expected", "previews"

Record = dict[str, Any]
"""One frame's rows: {"frame": n, "device": row of frames.parquet, "truth": row of truth.parquet}."""


@dataclass(frozen=True)
class Job:
    """What a worker needs to make any frame; small, so that it travels."""

    recipe_json: str
    scene_json: str
    scene_folder: str
    directory: str


def make_frame(job: Job, frame: int) -> Record:
    """Render, expose and write one frame; depends on nothing but its arguments."""
    recipe, renderer = _renderer(job.recipe_json, job.scene_json, job.scene_folder)
    directory = Path(job.directory)
    shot, which = divmod(frame, len(recipe.cameras))
    mounted = recipe.cameras[which]
    camera, sensor = mounted.camera, Window.of_sensor(mounted.camera)
    main, during = poses_of_frame(recipe, renderer.scene, frame)
    pose = mounted.pose(main)
    view = renderer.view(camera, pose, recipe.windows, during)
    noise = f"{recipe.seed}/{frame}/shot-noise"
    expected = [(part.window, part.expected_electrons(recipe.exposure_s)) for part in view.parts]
    dn = [
        (
            window,
            expose(recipe.sensor, image, noise, window.row, window.column, recipe.exposure_s, mounted.name),
        )
        for window, image in expected
    ]
    attributes = exr_attributes(camera, mounted.name, recipe.exposure_s, frame)
    file = f"{FRAMES}/{frame:06d}.exr"
    digest = write_exr(directory / file, dn, sensor, attributes)
    if recipe.expected:
        write_exr(directory / EXPECTED / f"{frame:06d}.exr", expected, sensor, attributes)
    write_preview(directory / PREVIEWS / f"{frame:06d}.png", dn, sensor, recipe.sensor.largest_dn)
    # One accelerometer on the rig: its error belongs to the shot.
    reading = mounted.rotation @ recipe.accelerometer.reading_m_s2(main, stream(recipe.seed, shot, "accelerometer"))
    device = {
        "frame": frame,
        "shot": shot,
        "pose": shot,
        "file": file,
        "sha256": digest,
        "camera": mounted.name,
        "exposure_s": recipe.exposure_s,
        "capturable": all(sensor.holds(part.window) for part in view.parts),
        "accelerometer_m_s2": reading.tolist(),
        "spots": decoded_spots(view.parts, camera.width_px, stream(recipe.seed, frame, "demodulator")),
    }
    truth = {
        "frame": frame,
        "shot": shot,
        "position_m": list(pose.position_m),
        "R_cam_world": pose.rotation.ravel().tolist(),
        "tilt_x_deg": pose.tilt_x_deg,
        "tilt_y_deg": pose.tilt_y_deg,
        "yaw_deg": pose.yaw_deg,
        "leds": [
            {"led": p.led_id, "u_px": p.center_px[0], "v_px": p.center_px[1], "visible_fraction": p.visible_fraction}
            for p in sorted(view.patches, key=lambda p: p.led_id)
        ],
        "bound_m2": None,
    }
    return {"frame": frame, "device": device, "truth": truth}


def poses_of_frame(recipe: Recipe, scene: Scene, frame: int) -> tuple[Pose, tuple[Pose, ...]]:
    """The pose of the camera `main` at mid-exposure, and those of the frame's own camera during the exposure."""
    shot, which = divmod(frame, len(recipe.cameras))
    main = pose_of_frame(recipe.poses, shot, recipe.seed, recipe.camera, scene)
    return main, poses_during(recipe.motion, recipe.cameras[which], main, recipe.exposure_s, scene)


@cache
def _renderer(recipe_json: str, scene_json: str, scene_folder: str) -> tuple[Recipe, Renderer]:
    """One renderer a process and plan."""
    scene = build_scene(SceneSettings.model_validate_json(scene_json), "scene", Path(scene_folder))
    return Recipe.model_validate_json(recipe_json), Renderer(scene)
