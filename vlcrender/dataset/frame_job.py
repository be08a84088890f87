"""One frame of a dataset: render, expose, write its files, and return its rows."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import numpy as np

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.rig import Mounted
from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.core.random_keys import random_key, stream
from vlcrender.dataset.downlink import decoded_spots
from vlcrender.dataset.exr import exr_attributes, write_exr
from vlcrender.dataset.files import EXPECTED, FRAMES, PREVIEWS, PROCESSED
from vlcrender.dataset.motion import poses_during
from vlcrender.dataset.pose_sampling import pose_of_frame
from vlcrender.dataset.preview import write_preview
from vlcrender.dataset.recipe import Recipe
from vlcrender.dataset.schema import Flat9, FrameRecord, FrameRow, LedTruth, TruthRow, flat9
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


@dataclass(frozen=True)
class Job:
    """Everything a worker needs to make any frame; small, so that it can be sent to other machines."""

    recipe_json: str
    scene_json: str
    scene_folder: str
    directory: str


def make_frame(job: Job, frame: int) -> FrameRecord:
    """Render, expose and write one frame, and return its rows; depends on nothing but its arguments."""
    recipe, renderer = _renderer(job.recipe_json, job.scene_json, job.scene_folder)
    directory = Path(job.directory)
    pose_number, shot, which = recipe.place_of_frame(frame)
    mounted = recipe.cameras[which]
    camera, sensor = mounted.camera, Roi.of_sensor(mounted.camera)
    mean = _noise_free_frame(job, pose_number, which)
    main, pose, view, exposure_s, expected = mean.main, mean.pose, mean.view, mean.exposure_s, mean.expected
    noise = random_key(recipe.seed, frame, "shot-noise")
    dn = [
        RegionImage(
            roi, expose(recipe.sensor, image, noise, roi.row, roi.column, exposure_s=exposure_s, camera=mounted.name)
        )
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
        picture = recipe.processed.develop(
            dn[0][1], recipe.sensor, _white_balance(camera, recipe.sensor, renderer.scene)
        )
        recipe.processed.write(directory / PROCESSED / f"{frame:06d}{recipe.processed.suffix}", picture)
    # The rig has one accelerometer: its error belongs to the shot.
    reading = mounted.rotation @ recipe.accelerometer.reading_m_s2(main, stream(recipe.seed, shot, "accelerometer"))
    device = FrameRow(
        frame=frame,
        shot=shot,
        pose=pose_number,
        file=file,
        sha256=digest,
        camera=mounted.name,
        exposure_s=exposure_s,
        capturable=all(sensor.contains(part.roi) for part in view.parts),
        accelerometer_m_s2=reading.tolist(),
        spots=decoded_spots(view.parts, camera.width_px, stream(recipe.seed, frame, "demodulator")),
    )
    truth = TruthRow(
        frame=frame,
        shot=shot,
        position_m=pose.position_m,
        R_cam_world=flat9(pose.rotation),
        tilt_x_deg=pose.tilt_x_deg,
        tilt_y_deg=pose.tilt_y_deg,
        yaw_deg=pose.yaw_deg,
        leds=tuple(
            LedTruth(led=p.led_id, u_px=p.center_px[0], v_px=p.center_px[1], visible_fraction=p.visible_fraction)
            for p in sorted(view.patches, key=lambda p: p.led_id)
        ),
        bound_m2=mean.bound_m2,
    )
    return FrameRecord(device=device, truth=truth)


@dataclass(frozen=True)
class _NoiseFreeFrame:
    """A camera's frame at a pose without its noise: shared by all repeats of the pose."""

    main: Pose
    pose: Pose
    view: ExpectedImage
    exposure_s: float
    expected: list[RegionImage]
    bound_m2: Flat9 | None


@lru_cache(maxsize=1)
def _noise_free_frame(job: Job, pose_number: int, which: int) -> _NoiseFreeFrame:
    """Render camera number `which` of the rig at a pose; kept for the next repeat."""
    recipe, renderer = _renderer(job.recipe_json, job.scene_json, job.scene_folder)
    mounted = recipe.cameras[which]
    main, during = poses_of(recipe, renderer.scene, pose_number, which)
    posed = mounted.posed(main)
    view = renderer.expected_image(posed, recipe.regions, during)
    exposure_s = recipe.time_s(view)
    expected = [RegionImage(part.roi, part.expected_electrons(exposure_s)) for part in view.parts]
    bound = _bound_m2(recipe, renderer, mounted, main, exposure_s, expected)
    return _NoiseFreeFrame(main, posed.pose, view, exposure_s, expected, bound)


def _bound_m2(
    recipe: Recipe,
    renderer: Renderer | MosaicRenderer,
    mounted: Mounted,
    main: Pose,
    exposure_s: float,
    expected: Sequence[RegionImage],
) -> Flat9 | None:
    """Cramér-Rao bound of the frame's position, row by row.

    None where the recipe does not ask for it, or where the frame does not determine a position.
    """
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
        halo_of=renderer.halo_of(mounted.camera),
    )
    return None if bound is None else flat9(bound)


def poses_of(recipe: Recipe, scene: Scene, pose_number: int, which: int) -> tuple[Pose, tuple[Pose, ...]]:
    """Pose of the camera `main` at mid-exposure, and the poses of camera number `which` during the exposure."""
    main = pose_of_frame(recipe.poses, pose_number, recipe.seed, recipe.camera, scene)
    # A recipe with motion has an exposure time: Recipe checks it.
    return main, poses_during(recipe.motion, recipe.cameras[which], main, recipe.exposure_s or 0.0, scene)


def _white_balance(camera: Camera, sensor: Sensor, scene: Scene) -> tuple[float, float, float]:
    """Multipliers of red, green and blue that turn the LEDs' light white; at least 1, so that saturated stays white."""
    rates = [electron_rate_per_cd_m2(camera, scene.settings.led_spectrum, d) for d in detectors(sensor)]
    red, green, blue = (max(rates) / rate if rate > 0 else 1.0 for rate in (rates if len(rates) == 3 else rates * 3))
    return red, green, blue


@cache
def _renderer(recipe_json: str, scene_json: str, scene_folder: str) -> tuple[Recipe, Renderer | MosaicRenderer]:
    """The recipe and its renderer; one for each process and plan."""
    scene = build_scene(SceneSettings.model_validate_json(scene_json), "scene", Path(scene_folder))
    recipe, light = Recipe.model_validate_json(recipe_json), bake(scene)
    sensor = recipe.sensor
    if sensor.mosaic == "none":
        return recipe, Renderer(scene, light, detectors(sensor)[0], sensor.crosstalk)
    of_colours = tuple(Renderer(scene, light, detector) for detector in detectors(sensor))
    return recipe, MosaicRenderer(of_colours, sensor.mosaic, sensor.crosstalk)
