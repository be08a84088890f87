"""One frame of a dataset: render, expose, write its files, and return its rows."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path
from typing import Self

import numpy as np

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
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
from vlcrender.dataset.recipe import Plan, Recipe
from vlcrender.dataset.schema import Flat9, FrameRecord, FrameRow, LedTruth, SpotRow, TruthRow, five, flat9, triple
from vlcrender.dataset.shard import Shard
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
from vlcrender.modulation.exposure import LineGains, MeanWave
from vlcrender.modulation.transmission import led_waves
from vlcrender.modulation.wave import Wave
from vlcrender.rendering.bayer import MosaicRenderer
from vlcrender.rendering.crlb import FrameSlopes
from vlcrender.rendering.expected_image import ExpectedImage, Gain, Gains, LedPatch
from vlcrender.rendering.readout import RollingPoses
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene, build_scene
from vlcrender.scene.schema import SceneSettings
from vlcrender.sensor.radiometry import detectors, electron_rate_per_cd_m2
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose_regions, variance_e2


@dataclass(frozen=True)
class Job:
    """Everything a worker needs to make any frame; small, so that it can be sent to other machines."""

    recipe_json: str
    scene_json: str
    scene_folder: str
    directory: str

    @classmethod
    def of(cls, plan: Plan, directory: Path) -> Self:
        """The job of a plan. In this process its frames use the plan's scene, which is not loaded again."""
        scene, folder = plan.scene.settings.model_dump_json(), str(plan.scene.folder)
        _loaded.clear()
        _loaded[scene, folder] = plan.scene
        return cls(plan.recipe.model_dump_json(), scene, folder, str(directory))


_loaded: dict[tuple[str, str], Scene] = {}
"""The scene of the latest job that this process made, by its JSON and folder."""


def make_frames(job: Job, frames: Sequence[int]) -> list[FrameRecord]:
    """`made_frames` of several frames, made."""
    return list(made_frames(job, frames))


def made_frames(job: Job, frames: Sequence[int]) -> Iterator[FrameRecord]:
    """`make_frame` of several frames, one after another. Where a file holds several, `frames` are those of one file."""
    recipe, _ = _renderer(job.recipe_json, job.scene_json, job.scene_folder)
    per_file = recipe.files.frames_per_file
    if per_file == 1:
        yield from (make_frame(job, frame) for frame in frames)
        return
    shard = Shard(Path(job.directory), frames[0] // per_file)
    records = [make_frame(job, frame, shard=shard) for frame in frames]
    digest = shard.write()
    yield from (record.with_digest(digest) for record in records)


def make_frame(job: Job, frame: int, shard: Shard | None = None) -> FrameRecord:
    """Render, expose and write one frame, and return its rows; depends on nothing but its arguments.

    A view that the frame before had too, such as that of a burst, is not rendered again.
    shard: to which the frame is added, in place of a file of its own; the record then has no digest yet.
    """
    recipe, renderer = _renderer(job.recipe_json, job.scene_json, job.scene_folder)
    directory = Path(job.directory)
    pose_number, shot, which = recipe.place_of_frame(frame)
    device = device_of_pose(recipe, pose_number)
    map_number = map_of_device(recipe, device)
    told = recipe.cameras[which]
    camera, sensor = told.camera, Roi.of_sensor(told.camera)
    number = 0 if recipe.motion is None else shot % recipe.burst_frames
    views = _views_at(job, pose_number, number, frame if shots_differ(recipe) else None)
    if which not in views:
        views[which] = _rendered(job, pose_number, number, which, frame if shots_differ(recipe) else None)
    view = views[which]
    image, pose, exposure_s = view.image, view.posed.pose, view.exposure_s
    waves = _waves(job, map_number)
    start_s = recipe.start_s(shot, bool(waves))
    exposed = view.exposed(waves, start_s)
    noise = random_key(recipe.seed, frame, "shot-noise")
    of_device = device_sensor(recipe, device)
    dn = expose_regions(of_device, exposed.expected, noise, exposure_s=exposure_s, camera=told.name)
    attributes = exr_attributes(camera, told.name, exposure_s, frame)  # of the told camera: a reader sees them
    part = None
    if shard is None:
        file = f"{FRAMES}/{frame:06d}.exr"
        digest = write_exr(directory / file, dn, sensor, attributes)
    else:
        file, digest = shard.file, ""
        part = shard.part_count
        shard.add(frame, dn, sensor, attributes)
    if recipe.expected:
        write_exr(directory / EXPECTED / f"{frame:06d}.exr", exposed.expected, sensor, attributes)
    if recipe.files.has_preview(frame):
        preview = directory / PREVIEWS / f"{frame:06d}.png"
        write_preview(preview, dn, sensor, recipe.sensor.largest_dn, recipe.sensor.black_level_dn)
    if recipe.processed is not None:
        picture = recipe.processed.develop(
            dn[0][1], recipe.sensor, _white_balance(camera, recipe.sensor, renderer.scene)
        )
        recipe.processed.write(directory / PROCESSED / f"{frame:06d}{recipe.processed.suffix}", picture)
    # The rig has one accelerometer: its error belongs to the shot. The device turns its reading by the told mounting.
    reading = told.rotation @ reading_m_s2(recipe, device, shot, view.main)
    gyro = None
    if recipe.gyroscope is not None:
        gyro = triple(told.rotation @ gyro_rad_s(recipe, recipe.gyroscope, device, shot))
    spots: tuple[SpotRow, ...] = ()
    if recipe.demodulation == "given":
        spots = decoded_spots(image.parts, camera.width_px, stream(recipe.seed, frame, "demodulator"))
    known = FrameRow(
        frame=frame,
        shot=shot,
        burst=shot // recipe.burst_frames,
        start_s=start_s,
        pose=pose_number,
        device=device,
        file=file,
        part=part,
        sha256=digest,
        camera=told.name,
        exposure_s=exposure_s,
        capturable=all(sensor.contains(part.roi) for part in image.parts),
        accelerometer_m_s2=reading.tolist(),
        gyro_rad_s=gyro,
        spots=spots,
    )
    angular = linear = None
    if recipe.motion is not None:
        angular, linear = map(triple, recipe.motion.velocities_of(view.mounted, view.middle))
    truth = TruthRow(
        frame=frame,
        shot=shot,
        map=map_number,
        K=flat9(view.mounted.camera.matrix),
        distortion=five(view.mounted.camera.distortion),
        position_m=pose.position_m,
        R_cam_world=flat9(pose.rotation),
        tilt_x_deg=pose.tilt_x_deg,
        tilt_y_deg=pose.tilt_y_deg,
        yaw_deg=pose.yaw_deg,
        angular_velocity_rad_s=angular,
        linear_velocity_m_s=linear,
        leds=tuple(
            _led_truth(patch, waves.get(patch.led_id), start_s)
            for patch in sorted(image.patches, key=lambda patch: patch.led_id)
        ),
        bound_m2=exposed.bound_m2,
        bound_exact_m2=exposed.bound_exact_m2,
    )
    return FrameRecord(device=known, truth=truth)


def _led_truth(patch: LedPatch, wave: Wave | None, start_s: float) -> LedTruth:
    return LedTruth(
        led=patch.led_id,
        u_px=patch.center_px[0],
        v_px=patch.center_px[1],
        visible_fraction=patch.visible_fraction,
        clock_error=None if wave is None else wave.clock_error,
        phase=None if wave is None else float(wave.phase(start_s)),
        bits=None if wave is None else wave.bits,
    )


@dataclass(frozen=True)
class _Exposed:
    """A frame without its noise."""

    expected: list[RegionImage]
    bound_m2: Flat9 | None
    bound_exact_m2: Flat9 | None


@dataclass(frozen=True, eq=False)
class _View:
    """What a true camera sees from a pose: shared by all frames there of a camera with the same errors."""

    recipe: Recipe
    renderer: Renderer | MosaicRenderer
    mounted: Mounted
    """The true camera."""
    main: Pose
    """Pose of the camera `main` in the middle of its frame."""
    middle: Pose
    """Pose of the camera `main` in the middle of this camera's frame."""
    image: ExpectedImage
    exposure_s: float
    room: MeanWave
    """Light of all LEDs of the room."""

    @property
    def posed(self) -> PosedCamera:
        """The camera in the middle of its frame."""
        return self.mounted.posed(self.middle)

    def exposed(self, waves: Mapping[int, Wave], start_s: float) -> _Exposed:
        """The exposure of a frame that starts at `start_s`; computed once where all light is steady."""
        return self._with_gains(waves, start_s) if waves else self._steady

    @cached_property
    def _steady(self) -> _Exposed:
        return self._with_gains({}, 0.0)

    def _with_gains(self, waves: Mapping[int, Wave], start_s: float) -> _Exposed:
        gains: Gains | None = None
        room_gain: Gain = 1.0
        if waves:
            starts_s = start_s + self.mounted.camera.line_starts_s()
            gains = LineGains(waves, starts_s, self.exposure_s)
            room_gain = self.room.mean(starts_s, self.exposure_s)
        expected = [
            RegionImage(part.roi, part.expected_electrons(self.exposure_s, gains, room_gain))
            for part in self.image.parts
        ]
        return _Exposed(expected, *self._bounds_m2(expected, gains))

    def _bounds_m2(self, expected: Sequence[RegionImage], gains: Gains | None) -> tuple[Flat9 | None, Flat9 | None]:
        """Cramér-Rao bounds of the frame's position, row by row: hybrid, and exact; the same without [belief].

        gains: of the LEDs by id, which the bound takes as known; 1 where not given. None where the recipe does not ask
        for them, or where the frame does not determine a position.
        """
        recipe = self.recipe
        if not recipe.bound or self._slopes is None:
            return None, None
        variance = [RegionImage(roi, variance_e2(recipe.sensor, mean, self.exposure_s)) for roi, mean in expected]
        slopes = self._slopes.exposed(variance, gains)
        tilts_deg = tilt_sigmas_deg(recipe, self.main)
        exact = slopes.exact_bound_m2(tilts_deg)
        hybrid = exact
        if recipe.belief is not None:
            uncertainty = uncertainty_of(recipe, self.renderer.scene, self.mounted)
            hybrid = slopes.hybrid_bound_m2(tilts_deg, self.renderer.scene.leds, uncertainty)
        return None if hybrid is None else flat9(hybrid), None if exact is None else flat9(exact)

    @cached_property
    def _slopes(self) -> FrameSlopes | None:
        """Slopes of the LEDs' images in steady light, without the variance of an exposure."""
        recipe, renderer, mounted, main = self.recipe, self.renderer, self.mounted, self.main
        at = mounted.posed(main)
        return FrameSlopes.rendered(
            mounted,
            main,
            partial(renderer.led_slopes, regions=recipe.regions),
            self.exposure_s,
            [],
            float(np.median(np.linalg.norm(renderer.scene.leds.centers_m - at.position_m, axis=1))),
            recipe.regions is not None and recipe.regions.overscan,
            halo_of=renderer.halo_of(mounted.camera),
        )


@lru_cache(maxsize=1)
def _views_at(job: Job, pose_number: int, number: int, frame: int | None) -> dict[int, _View]:
    """Views of the cameras of a rig at a place, by the camera's number; kept until frames at another place are made."""
    return {}


def _rendered(job: Job, pose_number: int, number: int, which: int, frame: int | None) -> _View:
    """Render camera number `which` of the rig at a pose, in shot `number` of a burst.

    frame: whose errors of a shot the camera has; None where no shot has errors of its own.
    """
    recipe, of_scene = _renderer(job.recipe_json, job.scene_json, job.scene_folder)
    device = device_of_pose(recipe, pose_number)
    map_number = map_of_device(recipe, device)
    renderer = _renderer_of_map(job.recipe_json, job.scene_json, job.scene_folder, map_number)
    mounted = true_camera(recipe, which, device, frame)
    main, middle, during = poses_of(recipe, of_scene.scene, pose_number, mounted, number)
    waves, leds = _waves(job, map_number), of_scene.scene.leds
    image = renderer.expected_image(mounted.posed(middle), recipe.regions, during, room_apart=bool(waves))
    room = MeanWave.of(waves, dict(zip(leds.ids.tolist(), leds.fluxes_lm.tolist(), strict=True)))
    return _View(recipe, renderer, mounted, main, middle, image, recipe.time_s(image), room)


@cache
def _waves(job: Job, map_number: int) -> dict[int, Wave]:
    """The wave of each LED of a map that is not steady, by its id."""
    recipe, renderer = _renderer(job.recipe_json, job.scene_json, job.scene_folder)
    return led_waves(renderer.scene.leds.transmitters, recipe.seed, map_number)


def poses_of(
    recipe: Recipe, scene: Scene, pose_number: int, mounted: Mounted, number: int = 0
) -> tuple[Pose, Pose, tuple[Pose, ...] | RollingPoses]:
    """Poses of a frame of a camera, in shot `number` of a burst: the rig moves on from shot to shot.

    Poses of the camera `main` in the middle of its own frame and in the middle of the camera's, and the poses of the
    camera during its frame. scene: the recipe's scene. Poses are chosen for the told camera and LEDs, so that they are
    the same with [belief].
    """
    main = pose_of_frame(recipe.poses, pose_number, recipe.seed, recipe.camera, scene)
    middle, exposure_s = main, recipe.exposure_s or 0.0  # a recipe with motion has an exposure time: Recipe checks it
    if recipe.motion is not None:
        if recipe.burst is not None and number:
            middle = main = recipe.motion.pose_at(main, recipe.burst.offset_s(number))
        later_s = mounted.camera.middle_s(exposure_s) - recipe.camera.middle_s(exposure_s)
        if later_s:
            middle = recipe.motion.pose_at(main, later_s)
    return main, middle, poses_during(recipe.motion, mounted, middle, exposure_s, scene)


def _white_balance(camera: Camera, sensor: Sensor, scene: Scene) -> tuple[float, float, float]:
    """Multipliers of red, green and blue that turn the LEDs' light white; at least 1, so that saturated stays white."""
    rates = [electron_rate_per_cd_m2(camera, scene.settings.led_spectrum, d) for d in detectors(sensor)]
    red, green, blue = (max(rates) / rate if rate > 0 else 1.0 for rate in (rates if len(rates) == 3 else rates * 3))
    return red, green, blue


@cache
def _renderer(recipe_json: str, scene_json: str, scene_folder: str) -> tuple[Recipe, Renderer | MosaicRenderer]:
    """The recipe and its renderer; one for each process and plan."""
    scene = _loaded.get((scene_json, scene_folder))
    if scene is None:
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
