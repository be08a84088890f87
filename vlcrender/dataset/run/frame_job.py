"""One frame of a dataset: render, expose, write its files, and return its rows."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Self

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.rig import Mounted
from vlcrender.camera.roi import Roi
from vlcrender.core.program import program_sha256
from vlcrender.core.random_keys import random_key, stream
from vlcrender.dataset.format.exr import exr_attributes, write_exr
from vlcrender.dataset.format.files import EXPECTED, PREVIEWS, PROCESSED, link_or_copy, whole_file
from vlcrender.dataset.format.frame_files import frame_file, stored, write_frame
from vlcrender.dataset.format.frame_numbers import FrameNumbers
from vlcrender.dataset.format.manifest import entry_of
from vlcrender.dataset.format.preview import write_preview
from vlcrender.dataset.format.rows import (
    FileEntry,
    FrameRecord,
    FrameRow,
    LedTruth,
    SpotRow,
    TruthRow,
    five,
    flat9,
    triple,
)
from vlcrender.dataset.format.shard import Shard
from vlcrender.dataset.recipe.dependence import Seen, keyed_recipe
from vlcrender.dataset.recipe.motion import poses_during
from vlcrender.dataset.recipe.plan import Plan
from vlcrender.dataset.recipe.pose_sampling import ListedPoses, pose_of_frame
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.dataset.world.downlink import decoded_spots
from vlcrender.dataset.world.true_world import (
    built_leds,
    device_of_pose,
    device_sensor,
    gyro_rad_s,
    map_of_device,
    reading_m_s2,
    shots_differ,
    true_camera,
)
from vlcrender.dataset.world.views import ExposedView, View
from vlcrender.errors import InputError
from vlcrender.light.lightmap import bake
from vlcrender.modulation.exposure import MeanWave
from vlcrender.modulation.transmission import led_waves
from vlcrender.modulation.wave import Wave
from vlcrender.rendering.bayer import MosaicRenderer
from vlcrender.rendering.expected_image import LedPatch
from vlcrender.rendering.readout import RollingPoses
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene, build_scene
from vlcrender.scene.scene_files import check_sources
from vlcrender.scene.schema import SceneSettings
from vlcrender.sensor.radiometry import detectors, electron_rate_per_cd_m2
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose_regions

MAX_SCENES = 8
"""Scenes and renderers that a process keeps; the one used longest ago is dropped first."""
MAX_WORLDS = 8
"""Kept maps of a scene, each for recipes with the same views."""
SceneKey = tuple[str, str, tuple[tuple[str, str], ...] | None]
"""What a scene depends on: its JSON, its folder, and the files of that folder with their SHA-256."""


@dataclass(frozen=True)
class Job:
    """Everything a worker needs to make any frame; small, so that it can be sent to other machines."""

    recipe_json: str
    scene_json: str
    scene_folder: str
    directory: str
    sources: tuple[tuple[str, str], ...] | None = None
    """Files of the scene's folder and their SHA-256, see `Scene.sources`; None where they are not checked."""
    program: str | None = None
    """`program_sha256` of the process that planned; None where it is not checked."""

    @property
    def scene_key(self) -> SceneKey:
        """What the scene depends on."""
        return self.scene_json, self.scene_folder, self.sources

    @classmethod
    def of(cls, plan: Plan, directory: Path) -> Self:
        """The job of a plan. In this process its frames use the plan's scene, which is not loaded again."""
        scene, folder = plan.scene.settings.model_dump_json(), str(plan.scene.folder.absolute())
        sources = tuple(plan.scene.sources.items())
        job = cls(plan.recipe.model_dump_json(), scene, folder, str(directory), sources, program_sha256())
        _loaded.pop(job.scene_key, None)
        _loaded[job.scene_key] = plan.scene
        while len(_loaded) > MAX_SCENES:
            del _loaded[next(iter(_loaded))]
        return job


_loaded: dict[SceneKey, Scene] = {}
"""Scenes of the latest jobs that this process made, by what they depend on."""


@dataclass(frozen=True)
class Files:
    """The files of a frame: their dataset, what its row says of the file with its pixels, the entries of all, and the
    numbers of its summary."""

    directory: Path
    file: str
    part: int | None
    entries: Mapping[str, FileEntry]
    numbers: FrameNumbers | None


def make_frames(frames: Sequence[tuple[Job, int]]) -> list[FrameRecord]:
    """`made_frames` of several frames, made."""
    return list(made_frames(frames))


def made_frames(frames: Iterable[tuple[Job, int]]) -> Iterator[FrameRecord]:
    """`make_frame` of frames of one dataset, or of several cells of a sweep, one after another.

    A frame with the same files as one before it, in another cell, is not exposed again: its files are that one's. Where
    a file holds several frames, all of them are among `frames`.
    """
    made: dict[tuple[SceneKey, str, int], Files] = {}
    for (job, _), of_file in groupby(frames, key=_file_of):
        if job.program not in (None, program_sha256()):
            raise InputError(
                f"{job.directory}: a worker runs another program than the one that started it: vlcrender or a library "
                "was changed; nothing is mixed; start all again with one program"
            )
        files_key = keyed_recipe(job.recipe_json).files_key
        twins = {n: made.get((job.scene_key, files_key, n)) for _, n in of_file}
        for record in _made_file(job, twins):
            row = record.device
            files = Files(Path(job.directory), row.file, row.part, record.files, record.numbers)
            made.setdefault((job.scene_key, files_key, record.frame), files)
            yield record


def _file_of(job_and_frame: tuple[Job, int]) -> tuple[Job, int]:
    """The dataset of a frame, and the number of its file."""
    job, frame = job_and_frame
    return job, frame // keyed_recipe(job.recipe_json).recipe.files.frames_per_file


def _made_file(job: Job, twins: Mapping[int, Files | None]) -> Iterator[FrameRecord]:
    """The frames of one file, by number, each with its twin if it has one: then all of a shard have."""
    per_file = keyed_recipe(job.recipe_json).recipe.files.frames_per_file
    if per_file == 1 or all(twins.values()):
        yield from (make_frame(job, frame, twin) for frame, twin in twins.items())
        return
    shard = Shard(Path(job.directory), min(twins) // per_file)
    records = [make_frame(job, frame, shard=shard) for frame in twins]
    entry = shard.write()
    yield from (record.with_file(entry) for record in records)


def make_frame(job: Job, frame: int, twin: Files | None = None, shard: Shard | None = None) -> FrameRecord:
    """Render, expose and write one frame, and return its rows; depends on nothing but its arguments.

    A view that the frame before had too, such as that of a burst or of another cell of a sweep, is not rendered again.
    twin: a frame with the same files, to which this one's are linked. shard: to which the frame is added, in place of a
    file of its own; the record then has no digest yet.
    """
    keyed = keyed_recipe(job.recipe_json)
    recipe, directory = keyed.recipe, Path(job.directory)
    first_shot = recipe.first_shot
    number = first_shot * len(recipe.cameras) + frame  # among the frames of all poses: random numbers depend on it
    pose_number, shot, which = recipe.place_of_frame(number)
    device = device_of_pose(recipe, pose_number)
    map_number = map_of_device(recipe, device)
    told = recipe.cameras[which]
    camera, sensor = told.camera, Roi.of_sensor(told.camera)
    place = pose_number, 0 if recipe.motion is None else shot % recipe.burst_frames
    in_frame = number if shots_differ(recipe) else None
    views = _views_at(job.scene_key, keyed.seen, *place, in_frame)
    if which not in views:
        views[which] = ExposedView(_rendered(job, *place, which, in_frame))
    view = views[which].view
    image, pose = view.image, view.posed.pose
    waves = _world_of(job).waves(map_number)
    start_s = recipe.start_s(shot, bool(waves))
    exposure = views[which].exposure(recipe, keyed.files_key)
    exposed = exposure.frame(waves, start_s)
    file, part = frame_file(frame, recipe.files.format), None
    others: list[str] = []
    if twin is None:
        numbers: FrameNumbers | None = FrameNumbers.of(image, exposed.expected, recipe.sensor, exposure.exposure_s)
        of_device = device_sensor(recipe, device)
        dn = expose_regions(
            of_device,
            exposed.expected,
            random_key(recipe.seed, number, "shot-noise"),
            exposure_s=exposure.exposure_s,
            camera=told.name,
            added=exposed.added(random_key(recipe.seed, number, "added-noise")),
        )
        # Of the told camera: readers see them.
        attributes = exr_attributes(camera, told.name, exposure.exposure_s, frame)
        if shard is None:
            write_frame(directory / file, dn, sensor, attributes, recipe.files.format)
        else:
            file, part = shard.file, shard.part_count
            shard.add(frame, stored(dn, recipe.files.format), sensor, attributes)
        if recipe.expected:
            others.append(f"{EXPECTED}/{frame:06d}.exr")
            write_exr(directory / others[-1], exposed.expected, sensor, attributes)
        if recipe.files.has_preview(frame):
            others.append(f"{PREVIEWS}/{frame:06d}.png")
            with whole_file(directory / others[-1]) as partial:
                write_preview(partial, dn, sensor, recipe.sensor.largest_dn, recipe.sensor.black_level_dn)
        if recipe.processed is not None:
            balance = _white_balance(camera, recipe.sensor, view.renderer.scene)
            picture = recipe.processed.develop(dn[0][1], recipe.sensor, balance)
            others.append(f"{PROCESSED}/{frame:06d}{recipe.processed.suffix}")
            with whole_file(directory / others[-1]) as partial:
                recipe.processed.write(partial, picture)
        of_pixels = [] if shard is not None else [file]
        files = {name: entry_of(directory / name) for name in [*of_pixels, *others]}
    else:
        file, part, files, numbers = twin.file, twin.part, dict(twin.entries), twin.numbers
        for name in files:
            if name != file or not part:  # once a shard
                link_or_copy(twin.directory / name, directory / name)
    # The rig has one accelerometer: its error belongs to the shot. The device turns its reading by the told mounting.
    reading = told.rotation @ reading_m_s2(recipe, device, shot, view.main)
    gyro = None
    if recipe.gyroscope is not None:
        gyro = triple(told.rotation @ gyro_rad_s(recipe, recipe.gyroscope, device, shot))
    spots: tuple[SpotRow, ...] = ()
    if recipe.demodulation == "given":
        spots = decoded_spots(image.parts, camera.width_px, stream(recipe.seed, number, "demodulator"))
    known = FrameRow(
        frame=frame,
        shot=shot - first_shot,
        burst=(shot - first_shot) // recipe.burst_frames,
        start_s=start_s,
        pose=pose_number - recipe.pose_numbers.start,
        device=device,
        file=file,
        part=part,
        sha256="" if shard is not None else files[file].sha256,
        camera=told.name,
        exposure_s=exposure.exposure_s,
        capturable=all(sensor.contains(part.roi) for part in image.parts),
        accelerometer_m_s2=reading.tolist(),
        gyro_rad_s=gyro,
        spots=spots,
        split=_split_of(recipe, view.renderer.scene, pose_number),
        time_s=recipe.poses.pose[pose_number].time_s if isinstance(recipe.poses, ListedPoses) else None,
    )
    angular = linear = None
    if recipe.motion is not None:
        angular, linear = map(triple, recipe.motion.velocities_of(view.mounted, view.middle))
    bound_m2, bound_exact_m2 = exposed.bounds_m2(recipe)
    truth = TruthRow(
        frame=frame,
        shot=shot - first_shot,
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
        added_noise_dn=exposed.added_dn,
        bound_m2=bound_m2,
        bound_exact_m2=bound_exact_m2,
    )
    return FrameRecord(device=known, truth=truth, files=files, numbers=numbers)


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


@lru_cache(maxsize=1)
def _views_at(scene: SceneKey, seen: Seen, pose_number: int, number: int, frame: int | None) -> dict[int, ExposedView]:
    """Views of the cameras of a rig at a place, by the camera's number; kept until frames at another place are made."""
    return {}


def _rendered(job: Job, pose_number: int, number: int, which: int, frame: int | None) -> View:
    """Render camera number `which` of the rig at a pose, in shot `number` of a burst.

    frame: whose errors of a shot the camera has; None where no shot has errors of its own.
    """
    recipe, world = keyed_recipe(job.recipe_json).recipe, _world_of(job)
    device = device_of_pose(recipe, pose_number)
    map_number = map_of_device(recipe, device)
    renderer, scene = world.renderer_of_map(map_number), world.renderer.scene
    mounted = true_camera(recipe, which, device, frame)
    main, middle, during = poses_of(recipe, scene, pose_number, mounted, number)
    waves = world.waves(map_number)
    image = renderer.expected_image(mounted.posed(middle), recipe.regions, during, room_apart=bool(waves))
    room = MeanWave.of(waves, dict(zip(scene.leds.ids.tolist(), scene.leds.fluxes_lm.tolist(), strict=True)))
    return View(renderer, recipe.regions, mounted, main, middle, image, room)


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


def _split_of(recipe: Recipe, scene: Scene, pose_number: int) -> str | None:
    """The split of all frames of a pose, by its place before the rig moves; None without [split]."""
    if recipe.split is None:
        return None
    pose = pose_of_frame(recipe.poses, pose_number, recipe.seed, recipe.camera, scene)
    return recipe.split.name_at(pose.position_m, scene.room_m, recipe.seed)


def _white_balance(camera: Camera, sensor: Sensor, scene: Scene) -> tuple[float, float, float]:
    """Multipliers of red, green and blue that turn the LEDs' light white; at least 1, so that saturated stays white."""
    rates = [electron_rate_per_cd_m2(camera, scene.settings.led_spectrum, d) for d in detectors(sensor)]
    red, green, blue = (max(rates) / rate if rate > 0 else 1.0 for rate in (rates if len(rates) == 3 else rates * 3))
    return red, green, blue


class _World:
    """The renderers and waves of a scene's maps, for a recipe and all with the same views."""

    def __init__(self, recipe: Recipe, renderer: Renderer | MosaicRenderer) -> None:
        """renderer: of the LEDs as told."""
        self.renderer = renderer
        self._recipe = recipe
        self._renderers: dict[int, Renderer | MosaicRenderer] = {}
        self._waves: dict[int, dict[int, Wave]] = {}

    def renderer_of_map(self, number: int) -> Renderer | MosaicRenderer:
        """The renderer of a map's LEDs as built; the scene's own without [belief]."""
        if self._recipe.belief is None:
            return self.renderer
        if number not in self._renderers:
            self._renderers[number] = self.renderer.with_leds(built_leds(self._recipe, self.renderer.scene, number))
        return self._renderers[number]

    def waves(self, number: int) -> dict[int, Wave]:
        """The wave of each LED of a map that is not steady, by its id."""
        if number not in self._waves:
            self._waves[number] = led_waves(self.renderer.scene.leds.transmitters, self._recipe.seed, number)
        return self._waves[number]


def _world_of(job: Job) -> _World:
    return _world(job.scene_key, keyed_recipe(job.recipe_json).seen)


@lru_cache(maxsize=MAX_WORLDS)
def _world(scene: SceneKey, seen: Seen) -> _World:
    return _World(seen.recipe, _renderer(scene, seen.recipe.sensor.spectral_response))


@lru_cache(maxsize=MAX_SCENES)
def _renderer(key: SceneKey, spectral_response: str) -> Renderer | MosaicRenderer:
    """The renderer of a scene on a sensor with this response.

    Raises InputError where a file of the scene has not the content that the key says, before or after it was read.
    """
    scene_json, folder, sources = key
    scene = _loaded.get(key)
    if scene is None:
        scene = build_scene(SceneSettings.model_validate_json(scene_json), "scene", Path(folder))
    sensor, light = Sensor.model_validate_json(spectral_response), bake(scene)
    if sources is not None:
        check_sources(scene.settings, scene.folder, dict(sources))
    if sensor.mosaic == "none":
        return Renderer(scene, light, detectors(sensor)[0], sensor.crosstalk)
    of_colours = tuple(Renderer(scene, light, detector) for detector in detectors(sensor))
    return MosaicRenderer(of_colours, sensor.mosaic, sensor.crosstalk)
