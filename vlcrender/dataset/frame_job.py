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
from vlcrender.dataset.bound_uncertainty import uncertainty_of
from vlcrender.dataset.downlink import decoded_spots
from vlcrender.dataset.exr import exr_attributes, write_exr
from vlcrender.dataset.files import EXPECTED, FRAMES, PREVIEWS, PROCESSED
from vlcrender.dataset.motion import poses_during
from vlcrender.dataset.pose_sampling import pose_of_frame
from vlcrender.dataset.preview import write_preview
from vlcrender.dataset.recipe import Recipe
from vlcrender.dataset.schema import Flat9, FrameRecord, FrameRow, LedTruth, TruthRow, five, flat9, triple
from vlcrender.dataset.true_world import (
    built_leds,
    device_of_pose,
    device_sensor,
    gyro_rad_s,
    map_of_device,
    reading_m_s2,
    shots_differ,
    tilt_sigmas_deg,
    true_camera,
)
from vlcrender.light.lightmap import bake
from vlcrender.rendering.bayer import MosaicRenderer
from vlcrender.rendering.crlb import FrameSlopes
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
    device = device_of_pose(recipe, pose_number)
    told = recipe.cameras[which]
    camera, sensor = told.camera, Roi.of_sensor(told.camera)
    mean = _noise_free_frame(job, pose_number, which, frame if shots_differ(recipe) else None)
    main, pose, view, exposure_s, expected = mean.main, mean.pose, mean.view, mean.exposure_s, mean.expected
    noise = random_key(recipe.seed, frame, "shot-noise")
    of_device = device_sensor(recipe, device)
    dn = [
        RegionImage(roi, expose(of_device, image, noise, roi.row, roi.column, exposure_s=exposure_s, camera=told.name))
        for roi, image in expected
    ]
    attributes = exr_attributes(camera, told.name, exposure_s, frame)  # of the told camera: a reader sees them
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
    # The rig has one accelerometer: its error belongs to the shot. The device turns its reading by the told mounting.
    reading = told.rotation @ reading_m_s2(recipe, device, shot, main)
    gyro = None
    if recipe.gyroscope is not None:
        gyro = triple(told.rotation @ gyro_rad_s(recipe, recipe.gyroscope, device, shot))
    known = FrameRow(
        frame=frame,
        shot=shot,
        burst=shot // recipe.burst_frames,
        start_s=recipe.start_s(shot, modulated=False),
        pose=pose_number,
        device=device,
        file=file,
        sha256=digest,
        camera=told.name,
        exposure_s=exposure_s,
        capturable=all(sensor.contains(part.roi) for part in view.parts),
        accelerometer_m_s2=reading.tolist(),
        gyro_rad_s=gyro,
        spots=decoded_spots(view.parts, camera.width_px, stream(recipe.seed, frame, "demodulator")),
    )
    truth = TruthRow(
        frame=frame,
        shot=shot,
        map=map_of_device(recipe, device),
        K=flat9(mean.camera.matrix),
        distortion=five(mean.camera.distortion),
        position_m=pose.position_m,
        R_cam_world=flat9(pose.rotation),
        tilt_x_deg=pose.tilt_x_deg,
        tilt_y_deg=pose.tilt_y_deg,
        yaw_deg=pose.yaw_deg,
        angular_velocity_rad_s=None,
        linear_velocity_m_s=None,
        leds=tuple(
            LedTruth(
                led=p.led_id,
                u_px=p.center_px[0],
                v_px=p.center_px[1],
                visible_fraction=p.visible_fraction,
                clock_error=None,
                phase=None,
                bits=None,
            )
            for p in sorted(view.patches, key=lambda p: p.led_id)
        ),
        bound_m2=mean.bound_m2,
        bound_exact_m2=mean.bound_exact_m2,
    )
    return FrameRecord(device=known, truth=truth)


@dataclass(frozen=True)
class _NoiseFreeFrame:
    """A camera's frame at a pose without its noise: shared by all repeats of the pose with the same true camera."""

    main: Pose
    pose: Pose
    camera: Camera
    """The true camera."""
    view: ExpectedImage
    exposure_s: float
    expected: list[RegionImage]
    bound_m2: Flat9 | None
    bound_exact_m2: Flat9 | None


@lru_cache(maxsize=1)
def _noise_free_frame(job: Job, pose_number: int, which: int, frame: int | None) -> _NoiseFreeFrame:
    """Render camera number `which` of the rig at a pose; kept for the next repeat.

    frame: whose errors of a shot the camera has; None where no shot has errors of its own.
    """
    recipe, of_scene = _renderer(job.recipe_json, job.scene_json, job.scene_folder)
    device = device_of_pose(recipe, pose_number)
    renderer = _renderer_of_map(job.recipe_json, job.scene_json, job.scene_folder, map_of_device(recipe, device))
    mounted = true_camera(recipe, which, device, frame)
    main, during = poses_of(recipe, of_scene.scene, pose_number, mounted)
    posed = mounted.posed(main)
    view = renderer.expected_image(posed, recipe.regions, during)
    exposure_s = recipe.time_s(view)
    expected = [RegionImage(part.roi, part.expected_electrons(exposure_s)) for part in view.parts]
    hybrid, exact = _bounds_m2(recipe, renderer, mounted, main, exposure_s, expected)
    return _NoiseFreeFrame(main, posed.pose, mounted.camera, view, exposure_s, expected, hybrid, exact)


def _bounds_m2(
    recipe: Recipe,
    renderer: Renderer | MosaicRenderer,
    mounted: Mounted,
    main: Pose,
    exposure_s: float,
    expected: Sequence[RegionImage],
) -> tuple[Flat9 | None, Flat9 | None]:
    """Cramér-Rao bounds of the frame's position, row by row: hybrid, and exact; the same without [belief].

    None where the recipe does not ask for them, or where the frame does not determine a position.
    """
    if not recipe.bound:
        return None, None
    at = mounted.posed(main)
    slopes = FrameSlopes.rendered(
        mounted,
        main,
        lambda posed: renderer.led_patches(posed, recipe.regions, at.pose),
        exposure_s,
        [RegionImage(roi, variance_e2(recipe.sensor, image, exposure_s)) for roi, image in expected],
        float(np.median(np.linalg.norm(renderer.scene.leds.centers_m - at.position_m, axis=1))),
        recipe.regions is not None and recipe.regions.overscan,
        halo_of=renderer.halo_of(mounted.camera),
    )
    if slopes is None:
        return None, None
    tilts_deg = tilt_sigmas_deg(recipe, main)
    exact = slopes.exact_bound_m2(tilts_deg)
    hybrid = exact
    if recipe.belief is not None:
        uncertainty = uncertainty_of(recipe, renderer.scene, mounted)
        hybrid = slopes.hybrid_bound_m2(tilts_deg, renderer.scene.leds, uncertainty)
    return None if hybrid is None else flat9(hybrid), None if exact is None else flat9(exact)


def poses_of(recipe: Recipe, scene: Scene, pose_number: int, mounted: Mounted) -> tuple[Pose, tuple[Pose, ...]]:
    """Pose of the camera `main` at mid-exposure, and the poses of a camera during the exposure.

    scene: the recipe's scene. Poses are chosen for the told camera and LEDs, so that they are the same with [belief].
    """
    main = pose_of_frame(recipe.poses, pose_number, recipe.seed, recipe.camera, scene)
    # A recipe with motion has an exposure time: Recipe checks it.
    return main, poses_during(recipe.motion, mounted, main, recipe.exposure_s or 0.0, scene)


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


@cache
def _renderer_of_map(
    recipe_json: str, scene_json: str, scene_folder: str, map_number: int
) -> Renderer | MosaicRenderer:
    """The renderer of a map's LEDs as built; the scene's own without [belief]."""
    recipe, renderer = _renderer(recipe_json, scene_json, scene_folder)
    return renderer if recipe.belief is None else renderer.with_leds(built_leds(recipe, renderer.scene, map_number))
