"""Recipes: every setting of a dataset, as a checked model."""

import math
from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.rig import MAIN, Mounted, RigCamera, mounted_cameras
from vlcrender.camera.roi import LedRegions, RegionImage
from vlcrender.camera.shutter import RollingShutter
from vlcrender.config.toml_model import Settings, check
from vlcrender.dataset.recipe.added_noise import AddedNoise
from vlcrender.dataset.recipe.auto_exposure import Metering, NoiseLevelMetering
from vlcrender.dataset.recipe.belief import Belief
from vlcrender.dataset.recipe.file_settings import FileSettings
from vlcrender.dataset.recipe.licence import Licence
from vlcrender.dataset.recipe.motion import Motion
from vlcrender.dataset.recipe.pose_sampling import Aim, Poses
from vlcrender.dataset.recipe.splits import Split
from vlcrender.dataset.recipe.sweep import SweepTable
from vlcrender.dataset.recipe.timeline import Burst, start_of_burst_s
from vlcrender.errors import InputError
from vlcrender.rendering.expected_image import ExpectedImage
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
    licence: Licence | None = None
    """Licence of the dataset, an SPDX expression such as "CC-BY-4.0"; not stated where not given."""
    scene: str
    """Path of the scene file, relative to the recipe's folder, or the name of a packaged scene."""
    seed: Annotated[int, Field(ge=0, lt=2**128)]
    """Seed of every random number of the dataset."""
    exposure_s: Annotated[float, Field(gt=0, le=100)] | None = None
    """Exposure time of every frame, seconds. Give either this or `exposure`."""
    exposure: Metering | None = None
    """Automatic exposure: how the exposure time of each frame is chosen."""
    added_noise: AddedNoise | None = None
    """A noise level beside the sensor's own noise; none where not given."""
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
    """The format of frames, how many of them have previews, and how many share a file."""
    split: Split | None = None
    """Train, validation and test frames by position; no split where not given."""
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
    pose_range: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] | None = None
    """[first, last]: the poses that are made, of those of `poses`, counted from 0; all where not given. Their frames
    are those of the whole set, and are counted from 0 again."""
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
        if self.metering is not None and self.metering is not self.exposure:
            if self.exposure_s is not None or self.exposure is not None:
                raise ValueError(
                    'added_noise: relative_to = "photon" sets the exposure time; remove exposure_s and [exposure]'
                )
        elif (self.exposure_s is None) == (self.exposure is None):
            raise ValueError("exposure_s: give exactly one of exposure_s or [exposure]")
        if self.metering is not None and self.motion is not None:
            key = "exposure" if self.exposure is not None else "added_noise"
            raise ValueError(f"{key}: [motion] needs a fixed time; replace [{key}] by exposure_s")
        return self

    @model_validator(mode="after")
    def _variance_is_of_full_frames(self) -> Self:
        noise = self.added_noise
        if noise is not None and noise.relative_to == "image-variance" and self.regions is not None:
            raise ValueError(
                'added_noise: relative_to = "image-variance" needs full frames: remove [regions], or choose "peak"'
            )
        return self

    @model_validator(mode="after")
    def _pose_range_is_of_its_poses(self) -> Self:
        if self.pose_range is not None:
            first, last = self.pose_range
            if not first <= last < self.poses.count:
                raise ValueError(
                    f"pose_range = [{first}, {last}]: has to be [first, last] within 0 to {self.poses.count - 1}"
                )
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
    def _files_hold_the_frames(self) -> Self:
        if problem := self.files.problem(self.sensor.bits, self.regions is not None):
            raise ValueError(problem)
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
        longest_s = max(self._readout_s(c.camera) for c in self.cameras) + self.max_exposure_s
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
    def metering(self) -> Metering | None:
        """How exposure times are chosen; None where `exposure_s` is given."""
        by_noise = None if self.added_noise is None else self.added_noise.metering
        return by_noise or self.exposure

    @property
    def max_exposure_s(self) -> float:
        """Longest exposure time of a frame, seconds."""
        if self.metering is not None:
            return self.metering.max_s
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
        return len(self.pose_numbers) * self.repeats * self.burst_frames * len(self.cameras)

    @property
    def pose_numbers(self) -> range:
        """Numbers of the poses that are made."""
        if self.pose_range is None:
            return range(self.poses.count)
        first, last = self.pose_range
        return range(first, last + 1)

    @property
    def first_shot(self) -> int:
        """Number of the first shot, among those of all poses."""
        return self.pose_numbers.start * self.repeats * self.burst_frames

    @property
    def burst_frames(self) -> int:
        """Shots in each burst; 1 without bursts."""
        return 1 if self.burst is None else self.burst.frames

    def time_s(self, view: ExpectedImage) -> float:
        """Exposure time of an expected image, seconds."""
        if self.metering is not None:
            return self.metering.time_s(view, self.sensor.saturation_e)
        assert self.exposure_s is not None  # _one_way_to_expose
        return self.exposure_s

    def added_noise_dn(self, expected_e: Sequence[RegionImage]) -> float | None:
        """Standard deviation of the noise that is added to a frame, digital numbers; None where none is.

        expected_e: its regions, electrons.
        """
        return None if self.added_noise is None else self.added_noise.sigma_dn(self.sensor, expected_e)

    def place_of_frame(self, frame: int) -> tuple[int, int, int]:
        """Pose, shot and camera of a frame, each counted from 0, and the frame from the first one of all poses.

        The camera varies fastest, the pose slowest.
        """
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


class RecipeFile(Recipe):
    """A recipe file: a recipe, or with sweeps one for each cell."""

    sweep: tuple[SweepTable, ...] = ()
    """Sweeps over keys of this file and of the scene file, one `[[sweep]]` each. Their product is made: a dataset for
    each combination of values."""


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
    if isinstance(recipe.poses, Aim):
        changes["poses"] = recipe.poses.model_copy(update={"border_px": recipe.poses.border_px / by})
    if recipe.regions is not None:
        margin_px = recipe.regions.margin_px
        least_px = min(margin_px, MIN_SCALED_MARGIN_PX)
        changes["regions"] = recipe.regions.model_copy(update={"margin_px": max(margin_px / by, least_px)})
    if mode == "same-photons":
        if recipe.exposure_s is not None:
            changes["exposure_s"] = recipe.exposure_s / by**2
        elif recipe.exposure is not None:
            # Metering counts the electrons of a pixel: the longest time alone needs scaling.
            changes["exposure"] = recipe.exposure.model_copy(update={"max_s": recipe.exposure.max_s / by**2})
    else:
        changes["sensor"] = recipe.sensor.binned(by)
        # A pixel holds more electrons, and the mean of more numbers: a noise level falls; a share of saturation stays.
        for key, level in (("exposure", recipe.exposure), ("added_noise", recipe.added_noise)):
            if isinstance(level, NoiseLevelMetering | AddedNoise):
                changes[key] = level.model_copy(update={"level_db": level.level_db - 10 * math.log10(by**2)})
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
