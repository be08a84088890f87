"""Recipes: every setting of a dataset. TOML in, checked model and scene out."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.rig import MAIN, Mounted, RigCamera, mounted_cameras
from vlcrender.camera.roi import LedRegions
from vlcrender.camera.shutter import RollingShutter
from vlcrender.config.packaged import find_file
from vlcrender.config.presets import with_presets
from vlcrender.config.toml_model import Settings, check, read_toml
from vlcrender.dataset.auto_exposure import Metering, NoiseLevelMetering
from vlcrender.dataset.belief import Belief
from vlcrender.dataset.file_settings import FileSettings
from vlcrender.dataset.light_checks import check_light
from vlcrender.dataset.motion import Motion
from vlcrender.dataset.pose_sampling import AimedPoses, Poses
from vlcrender.dataset.timeline import Burst, start_of_burst_s
from vlcrender.errors import InputError
from vlcrender.rendering.expected_image import ExpectedImage
from vlcrender.scene.loader import Scene, load_scene
from vlcrender.sensor.accelerometer import Accelerometer, TiltError
from vlcrender.sensor.gyroscope import Gyroscope
from vlcrender.sensor.isp import Processed
from vlcrender.sensor.radiometry import WAVELENGTHS_NM, detectors
from vlcrender.sensor.sensor import Sensor

ScaleMode = Literal["binned", "same-photons"]
MIN_SCALED_MARGIN_PX = 6.0
"""Smallest margin of a scaled recipe's regions, px: a background of some pixels on each side of an LED image, whose
edge the pixel raster widens by up to one pixel. A recipe's own margin stays where it is smaller."""


class Recipe(Settings):
    """A recipe file."""

    format: Literal["vlcrender-recipe"]
    """Marks the file as a recipe."""
    version: Literal[1]
    """Version of the recipe format."""
    name: Annotated[str, Field(min_length=1, max_length=100)]
    """Name of the dataset."""
    description: str = ""
    """One line about the dataset."""
    scene: str
    """Path of the scene file, relative to the recipe's folder, or the name of a packaged scene."""
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    """Seed of every random number of the dataset."""
    exposure_s: Annotated[float, Field(gt=0, le=100)] | None = None
    """Exposure time of every frame, seconds. Give either this or `exposure`."""
    exposure: Metering | None = None
    """Automatic exposure: how the exposure time of each frame is chosen."""
    repeats: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    """Shots, or bursts of shots, of each pose, one after another; they differ in noise, and in the phase of waves."""
    burst: Burst | None = None
    """Shots in quick succession in place of each single shot; single shots where not given."""
    demodulation: Literal["given", "pixels"] = "given"
    """Who tells which LED image is which: identities are given, or estimators have to decode them from the pixels."""
    map: Literal["given", "sent"] = "given"
    """Whether devices are given a map of the LEDs, or know of LEDs only what the LEDs send about themselves."""
    expected: bool = False
    """Whether the noise-free images are written too."""
    processed: Processed | None = None
    """Settings of processed pictures, as a phone makes them; none are written where not given."""
    files: FileSettings = FileSettings()
    """How many frames have previews, and how many share a file."""
    bound: bool = False
    """Whether each frame's Cramér-Rao bound is computed: some seconds for a full frame of many LEDs."""
    camera: Camera = Camera()
    """The camera `main`, for which `poses` are given."""
    sensor: Sensor = Sensor()
    """The sensor of every camera."""
    accelerometer: Accelerometer = TiltError()
    """The accelerometer of the rig."""
    gyroscope: Gyroscope | None = None
    """The gyroscope of the rig; none where not given."""
    poses: Poses
    """Poses of the camera `main`."""
    regions: LedRegions | None = None
    """Regions of interest that are read out; the whole sensor where not given."""
    motion: Motion | None = None
    """Motion of the rig during each frame, and from frame to frame of a burst; at rest where not given."""
    rig: tuple[RigCamera, ...] = ()
    """Further cameras, mounted beside `main` and exposed at the same time."""
    belief: Belief | None = None
    """What the device does not know; where not given, the device knows all exactly and no uncertainty is stated."""

    @model_validator(mode="after")
    def _one_way_to_expose(self) -> Self:
        if (self.exposure_s is None) == (self.exposure is None):
            raise ValueError("exposure_s: give exactly one of exposure_s or [exposure]")
        if self.exposure is not None and self.motion is not None:
            raise ValueError("exposure: [motion] needs a fixed time; replace [exposure] by exposure_s")
        return self

    @model_validator(mode="after")
    def _sensor_is_not_blind(self) -> Self:
        if not any(detector.quantum_efficiency(WAVELENGTHS_NM).any() for detector in detectors(self.sensor)):
            raise ValueError("sensor.quantum_efficiency: is 0 from 380 to 780 nm, the range of all light sources")
        return self

    @model_validator(mode="after")
    def _processed_is_of_full_frames(self) -> Self:
        if self.processed is not None and self.regions is not None:
            raise ValueError("processed: [processed] needs full frames: remove [regions] or [processed]")
        return self

    @model_validator(mode="after")
    def _shards_are_of_regions(self) -> Self:
        if self.files.frames_per_file > 1 and self.regions is None:
            raise ValueError(
                f"files.frames_per_file = {self.files.frames_per_file}: files of several frames hold regions; add "
                "[regions] or remove frames_per_file"
            )
        return self

    @model_validator(mode="after")
    def _camera_names_differ(self) -> Self:
        names = [MAIN, *(entry.name for entry in self.rig)]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"rig: {name!r} names more than one camera (the camera under [camera] is {MAIN!r})")
        return self

    @model_validator(mode="after")
    def _bounds_are_of_noisy_cameras_at_rest(self) -> Self:
        if self.bound and self.motion is not None:
            raise ValueError("bound = true: needs a camera at rest; remove [motion]")
        if self.bound and self.sensor.noise == "none":
            raise ValueError('bound = true: needs noise; sensor.noise must not be "none"')
        return self

    @model_validator(mode="after")
    def _overscan_needs_a_lens_that_goes_on(self) -> Self:
        bent = [c.name for c in self.cameras if not c.camera.lens_projection.extends_beyond_sensor]
        if self.regions is not None and self.regions.overscan and bent:
            raise ValueError(
                f"regions.overscan = true: camera {bent[0]!r} has a distortion, undefined far beyond the sensor; "
                "remove overscan or the distortion"
            )
        return self

    @model_validator(mode="after")
    def _overscan_needs_a_lens_without_distortion_errors(self) -> Self:
        if self.belief is None or self.regions is None or not self.regions.overscan:
            return self
        table = self.belief.camera
        perspective = any(c.camera.projection == "perspective" for c in self.cameras)
        if perspective and (table.radial_corner_um or table.decentering_corner_um):
            raise ValueError(
                "regions.overscan = true: [belief.camera] gives lenses a distortion, undefined far beyond the sensor; "
                "remove overscan, or set belief.camera.radial_corner_um and decentering_corner_um to 0"
            )
        return self

    @model_validator(mode="after")
    def _lateral_colour_needs_a_mosaic(self) -> Self:
        coloured = [c.name for c in self.cameras if c.camera.lateral_colour_um is not None]
        if coloured and self.sensor.mosaic == "none":
            raise ValueError(
                f"lateral_colour_um: camera {coloured[0]!r} has it, and the sensor has no mosaic; remove it, or choose "
                "sensor.mosaic"
            )
        return self

    @model_validator(mode="after")
    def _overscan_needs_a_lens_without_glare(self) -> Self:
        glaring = [c.name for c in self.cameras if c.camera.glare is not None]
        if self.regions is not None and self.regions.overscan and glaring:
            raise ValueError(
                f"regions.overscan = true: camera {glaring[0]!r} has glare, which is computed on the sensor only; "
                "remove overscan or [camera.glare]"
            )
        return self

    @model_validator(mode="after")
    def _overscan_needs_a_global_shutter(self) -> Self:
        rolling = [c.name for c in self.cameras if c.camera.shutter.kind == "rolling"]
        if self.regions is not None and self.regions.overscan and rolling:
            raise ValueError(
                f"regions.overscan = true: camera {rolling[0]!r} has a rolling shutter, which has no lines beyond the "
                "sensor; remove overscan or [camera.shutter]"
            )
        return self

    @model_validator(mode="after")
    def _frames_of_a_burst_do_not_overlap(self) -> Self:
        if self.burst is None:
            return self
        longest_s = max(self._readout_s(c.camera) for c in self.cameras) + self._max_exposure_s
        if 1 / self.burst.frame_rate_hz < longest_s:
            raise ValueError(
                f"burst.frame_rate_hz = {self.burst.frame_rate_hz:g}: a frame takes {longest_s * 1000:.4g} ms from the "
                f"first line to the last; at most {1 / longest_s:.4g} Hz are possible"
            )
        return self

    @model_validator(mode="after")
    def _a_sent_map_is_read_from_pixels(self) -> Self:
        if self.map == "sent" and self.demodulation == "given":
            raise ValueError('map = "sent": the map comes out of the light; set demodulation = "pixels"')
        return self

    @property
    def _max_exposure_s(self) -> float:
        if self.exposure is not None:
            return self.exposure.max_s
        assert self.exposure_s is not None  # _one_way_to_expose
        return self.exposure_s

    @staticmethod
    def _readout_s(camera: Camera) -> float:
        """Time from the start of the first line's exposure to that of the last, s."""
        return float(camera.line_starts_s().max())

    @property
    def cameras(self) -> tuple[Mounted, ...]:
        """All cameras, `main` first."""
        return mounted_cameras(self.camera, self.rig)

    @property
    def frame_count(self) -> int:
        """Number of frames: one for each pose, repeat, shot of a burst and camera."""
        return self.poses.count * self.repeats * self.burst_frames * len(self.cameras)

    @property
    def burst_frames(self) -> int:
        """Shots in each burst; 1 without bursts."""
        return 1 if self.burst is None else self.burst.frames

    def time_s(self, view: ExpectedImage) -> float:
        """Exposure time of an expected image, seconds."""
        if self.exposure is not None:
            return self.exposure.time_s(view, self.sensor.saturation_e)
        assert self.exposure_s is not None  # _one_way_to_expose
        return self.exposure_s

    def place_of_frame(self, frame: int) -> tuple[int, int, int]:
        """Pose, shot and camera of a frame, each counted from 0. The camera varies fastest, the pose slowest."""
        shot, which = divmod(frame, len(self.cameras))
        return shot // (self.repeats * self.burst_frames), shot, which

    def start_s(self, shot: int, modulated: bool) -> float:
        """Start of a shot on the rig's clock, s.

        modulated: whether LEDs of the scene are. 0 where no frame depends on time: nothing is modulated, shutters are
        global, and there are no bursts.
        """
        rolling = any(c.camera.shutter.kind == "rolling" for c in self.cameras)
        if not (modulated or rolling or self.burst):
            return 0.0
        burst, number = divmod(shot, self.burst_frames)
        lasts_s = max(self._readout_s(c.camera) for c in self.cameras)
        if self.burst is None:
            return start_of_burst_s(self.seed, burst, lasts_s)
        lasts_s += self.burst.offset_s(self.burst.frames - 1)
        return start_of_burst_s(self.seed, burst, lasts_s) + self.burst.offset_s(number)


@dataclass(frozen=True)
class Plan:
    """A resolved recipe with its scene."""

    recipe: Recipe
    scene: Scene


def load_plan(path: Path, assignments: Iterable[str] = (), scale: int = 1, scale_mode: ScaleMode = "binned") -> Plan:
    """Read a recipe, insert presets and `key=value` assignments, apply `scaled`, and read the scene.

    Raises InputError that names file, key and value.
    """
    assignments = list(assignments)
    source = f"{path} with --set" if assignments else str(path)
    tree = read_toml(path)
    keys = {assignment.partition("=")[0].partition(".")[0].strip() for assignment in assignments}
    for way, other in (("exposure", "exposure_s"), ("exposure_s", "exposure")):
        if way in keys and other not in keys:
            tree.pop(other, None)  # the assigned way to expose replaces the recipe's
    recipe = check(with_presets(tree, assignments, source), Recipe, source)
    try:
        scene_path = find_file("scene", recipe.scene, path.parent)
    except InputError as error:
        raise InputError(f"{source}: scene = {error}") from None
    if not scene_path.is_file():
        raise InputError(f"{source}: scene = {recipe.scene!r}: no such file, relative to the recipe's folder")
    plan = Plan(scaled(recipe, scale, scale_mode), load_scene(scene_path))
    check_light(plan.recipe, plan.scene, source, scale)
    return plan


def scaled(recipe: Recipe, by: int, mode: ScaleMode) -> Recipe:
    """The recipe with `by` x `by` pixels binned into one, and every length in pixels divided by `by`.

    A binned line takes `by` times the row time of a rolling shutter: a readout takes as long as before.

    The margin of regions does not fall below MIN_SCALED_MARGIN_PX: an LED image of any size needs some pixels of
    background around it.
    "binned" keeps all photons: full well and gain grow with the pixels' area, so that digital numbers keep their range
    (`Sensor.binned`). "same-photons" divides the exposure time by the pixels' area: as many photons a pixel as before.
    Raises InputError where `by` does not divide the size of a sensor or the result is not a valid recipe.
    """
    if by == 1:
        return recipe
    if by < 1:
        raise InputError(f"--scale {by}: must be 1 or more")
    changes: dict[str, object] = {
        "camera": _scaled_camera(recipe.camera, by),
        "rig": tuple(
            entry.model_copy(update={"camera": entry.camera and _scaled_camera(entry.camera, by)})
            for entry in recipe.rig
        ),
    }
    if isinstance(recipe.poses, AimedPoses):
        changes["poses"] = recipe.poses.model_copy(update={"border_px": recipe.poses.border_px / by})
    if recipe.regions is not None:
        margin_px = recipe.regions.margin_px
        least_px = min(margin_px, MIN_SCALED_MARGIN_PX)
        changes["regions"] = recipe.regions.model_copy(update={"margin_px": max(margin_px / by, least_px)})
    if mode == "same-photons":
        if recipe.exposure_s is not None:
            changes["exposure_s"] = recipe.exposure_s / by**2
        else:  # metering counts the electrons of a pixel, so the longest time alone needs scaling
            changes["exposure"] = recipe.exposure and recipe.exposure.model_copy(
                update={"max_s": recipe.exposure.max_s / by**2}
            )
    else:
        changes["sensor"] = recipe.sensor.binned(by)
        # A pixel holds more electrons: a noise level falls; a share of saturation stays.
        if isinstance(recipe.exposure, NoiseLevelMetering):
            level_db = recipe.exposure.level_db - 10 * math.log10(by**2)
            changes["exposure"] = recipe.exposure.model_copy(update={"level_db": level_db})
    return check(recipe.model_copy(update=changes).model_dump(mode="json"), Recipe, f"--scale {by}")


def _scaled_camera(camera: Camera, by: int) -> Camera:
    """The camera with u' = u / by, v' = v / by: its focal length, principal point and skew in pixels shrink alike.

    `by` lines are read as one.
    """
    if camera.width_px % by or camera.height_px % by:
        raise InputError(f"--scale {by}: does not divide the camera's {camera.width_px} x {camera.height_px} pixels")
    if camera.psf_kernel is not None:
        raise InputError(
            f"--scale {by}: camera.psf_kernel is given in pixels of the full camera; remove --scale or psf_kernel"
        )
    point, shutter = camera.principal_point_px, camera.shutter
    if isinstance(shutter, RollingShutter):
        shutter = shutter.model_copy(update={"row_time_us": shutter.row_time_us * by})
    return camera.model_copy(
        update={
            "shutter": shutter,
            "width_px": camera.width_px // by,
            "height_px": camera.height_px // by,
            "pixel_pitch_um": camera.pixel_pitch_um * by,
            "principal_point_px": point and (point[0] / by, point[1] / by),
            "skew_px": camera.skew_px / by,
        }
    )
