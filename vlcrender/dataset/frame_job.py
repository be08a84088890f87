"""One frame of a dataset: where its cameras are, what they see, what is written of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.rig import Mounted
from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.core.random_keys import random_key, stream
from vlcrender.dataset.downlink import decoded_spots
from vlcrender.dataset.files import EXPECTED, FRAMES, PREVIEWS, PROCESSED, exr_attributes, write_exr, write_preview
from vlcrender.dataset.motion import poses_during
from vlcrender.dataset.pose_sampling import pose_of_frame
from vlcrender.dataset.recipe import Recipe
from vlcrender.light.lightmap import bake
from vlcrender.rendering.bayer import MosaicRenderer
from vlcrender.rendering.crlb import position_bound_m2
from vlcrender.rendering.expected_image import ExpectedImage
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene, build_scene
from vlcrender.scene.schema import SceneSettings
from vlcrender.sensor.radiometry import detectors, electron_rate_per_cd_m2
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose, variance_e2

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
    pose_number, shot, which = recipe.place_of_frame(frame)
    mounted = recipe.cameras[which]
    camera, sensor = mounted.camera, Roi.of_sensor(mounted.camera)
    seen = _seen(job, pose_number, which)
    main, pose, view, exposure_s, expected = seen.main, seen.pose, seen.view, seen.exposure_s, seen.expected
    noise = random_key(recipe.seed, frame, "shot-noise")
    dn = [
        RegionImage(roi, expose(recipe.sensor, image, noise, roi.row, roi.column, exposure_s, mounted.name))
        for roi, image in expected
    ]
    attributes = exr_attributes(camera, mounted.name, exposure_s, frame)
    file = f"{FRAMES}/{frame:06d}.exr"
    digest = write_exr(directory / file, dn, sensor, attributes)
    if recipe.expected:
        write_exr(directory / EXPECTED / f"{frame:06d}.exr", expected, sensor, attributes)
    preview = directory / PREVIEWS / f"{frame:06d}.png"
    write_preview(preview, dn, sensor, recipe.sensor.largest_dn, recipe.sensor.black_level_dn)
    if recipe.processed is not None:
        picture = recipe.processed.develop(dn[0][1], recipe.sensor, _balance(camera, recipe.sensor, renderer.scene))
        recipe.processed.write(directory / PROCESSED / f"{frame:06d}{recipe.processed.suffix}", picture)
    # One accelerometer on the rig: its error belongs to the shot.
    reading = mounted.rotation @ recipe.accelerometer.reading_m_s2(main, stream(recipe.seed, shot, "accelerometer"))
    device = {
        "frame": frame,
        "shot": shot,
        "pose": pose_number,
        "file": file,
        "sha256": digest,
        "camera": mounted.name,
        "exposure_s": exposure_s,
        "capturable": all(sensor.contains(part.roi) for part in view.parts),
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
        "bound_m2": seen.bound_m2,
    }
    return {"frame": frame, "device": device, "truth": truth}


@dataclass(frozen=True)
class _Seen:
    """What all repeats of a pose share: all but noise."""

    main: Pose
    pose: Pose
    view: ExpectedImage
    exposure_s: float
    expected: list[RegionImage]
    bound_m2: list[float] | None


@lru_cache(maxsize=1)
def _seen(job: Job, pose_number: int, which: int) -> _Seen:
    """What a camera of the rig sees at a pose; kept for the next repeat."""
    recipe, renderer = _renderer(job.recipe_json, job.scene_json, job.scene_folder)
    mounted = recipe.cameras[which]
    main, during = poses_of(recipe, renderer.scene, pose_number, which)
    posed = mounted.posed(main)
    view = renderer.expected_image(posed, recipe.regions, during)
    exposure_s = recipe.time_s(view)
    expected = [RegionImage(part.roi, part.expected_electrons(exposure_s)) for part in view.parts]
    bound = _bound_m2(recipe, renderer, mounted, main, exposure_s, expected)
    return _Seen(main, posed.pose, view, exposure_s, expected, bound)


def _bound_m2(
    recipe: Recipe,
    renderer: Renderer | MosaicRenderer,
    mounted: Mounted,
    main: Pose,
    exposure_s: float,
    expected: Sequence[RegionImage],
) -> list[float] | None:
    """The frame's Cramér-Rao bound, row by row; None where it is not asked for or nothing is determined."""
    if not recipe.bound:
        return None
    at = mounted.posed(main)
    bound = position_bound_m2(
        mounted,
        main,
        lambda posed: renderer.led_patches(posed, recipe.regions, at.pose),
        exposure_s,
        [RegionImage(roi, variance_e2(recipe.sensor, image, exposure_s)) for roi, image in expected],
        float(np.median(np.linalg.norm(renderer.scene.leds.centers_m - at.position_m, axis=1))),
        recipe.accelerometer.tilt_errors_deg(main),
        recipe.regions is not None and recipe.regions.overscan,
    )
    return None if bound is None else bound.ravel().tolist()


def poses_of(recipe: Recipe, scene: Scene, pose_number: int, which: int) -> tuple[Pose, tuple[Pose, ...]]:
    """The pose of the camera `main` at mid-exposure, and those of the camera number `which` during the exposure."""
    main = pose_of_frame(recipe.poses, pose_number, recipe.seed, recipe.camera, scene)
    # Without a time there is no motion, and the other way round: the recipe sees to it.
    return main, poses_during(recipe.motion, recipe.cameras[which], main, recipe.exposure_s or 0.0, scene)


def _balance(camera: Camera, sensor: Sensor, scene: Scene) -> tuple[float, float, float]:
    """What makes the LEDs' light white: multipliers of red, green and blue, at least 1 so that white stays white."""
    rates = [electron_rate_per_cd_m2(camera, scene.settings.led_spectrum, d) for d in detectors(sensor)]
    red, green, blue = (max(rates) / rate if rate > 0 else 1.0 for rate in (rates if len(rates) == 3 else rates * 3))
    return red, green, blue


@cache
def _renderer(recipe_json: str, scene_json: str, scene_folder: str) -> tuple[Recipe, Renderer | MosaicRenderer]:
    """One renderer a process and plan."""
    scene = build_scene(SceneSettings.model_validate_json(scene_json), "scene", Path(scene_folder))
    recipe, light = Recipe.model_validate_json(recipe_json), bake(scene)
    of_colours = tuple(Renderer(scene, light, detector) for detector in detectors(recipe.sensor))
    mosaic = recipe.sensor.mosaic
    return recipe, of_colours[0] if mosaic == "none" else MosaicRenderer(of_colours, mosaic)
