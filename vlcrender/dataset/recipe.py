"""A recipe: all that a dataset is made from. TOML in, checked model and scene out."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.rig import MAIN, Mounted, RigCamera, mounted_cameras
from vlcrender.camera.roi import LedRegions
from vlcrender.config.packaged import find_file
from vlcrender.config.presets import with_presets
from vlcrender.config.toml_model import Settings, check, read_toml
from vlcrender.dataset.auto_exposure import Metering, NoiseLevelMetering
from vlcrender.dataset.motion import Motion
from vlcrender.dataset.pose_sampling import AimedPoses, Poses
from vlcrender.errors import InputError
from vlcrender.rendering.expected_image import ExpectedImage
from vlcrender.scene.loader import Scene, load_scene
from vlcrender.sensor.accelerometer import Accelerometer, TiltError
from vlcrender.sensor.isp import Processed
from vlcrender.sensor.radiometry import WAVELENGTHS_NM, detectors
from vlcrender.sensor.sensor import Sensor

ScaleMode = Literal["binned", "same-photons"]


class Recipe(Settings):
    """A recipe file."""

    format: Literal["vlcrender-recipe"]
    version: Literal[1]
    name: Annotated[str, Field(min_length=1, max_length=100)]
    description: str = ""
    scene: str
    """Path of the scene file, from the recipe's folder, or the name of a scene that comes with the package."""
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    exposure_s: Annotated[float, Field(gt=0, le=100)] | None = None
    exposure: Metering | None = None
    """In place of `exposure_s`: how each frame's is chosen."""
    repeats: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    """Shots of each pose, one after another; they differ by noise alone."""
    expected: bool = False
    """Whether the noise-free images are written too."""
    processed: Processed | None = None
    """Whether pictures as a phone makes them are written too, and how."""
    bound: bool = False
    """Whether each frame's Cramér-Rao bound is computed: some seconds for a full frame of many LEDs."""
    camera: Camera = Camera()
    sensor: Sensor = Sensor()
    accelerometer: Accelerometer = TiltError()
    poses: Poses
    regions: LedRegions | None = None
    """What is read out of the sensor; all of it where not given."""
    motion: Motion | None = None
    rig: tuple[RigCamera, ...] = ()
    """Cameras beside `main`, which is the one under `camera` and the one that `poses` are for."""

    @model_validator(mode="after")
    def _one_way_to_expose(self) -> Self:
        if (self.exposure_s is None) == (self.exposure is None):
            raise ValueError("exposure_s: has to be given, or the table exposure in its place, and not both")
        if self.exposure is not None and self.motion is not None:
            raise ValueError("exposure: cannot be chosen with motion, whose blur needs the time first; give exposure_s")
        return self

    @model_validator(mode="after")
    def _sensor_is_not_blind(self) -> Self:
        if not any(detector.quantum_efficiency(WAVELENGTHS_NM).any() for detector in detectors(self.sensor)):
            raise ValueError("sensor.quantum_efficiency: is 0 from 380 to 780 nm, where all the light is")
        return self

    @model_validator(mode="after")
    def _processed_is_of_full_frames(self) -> Self:
        if self.processed is not None and self.regions is not None:
            raise ValueError("processed: is made of full frames; leave windows out, or it")
        return self

    @model_validator(mode="after")
    def _camera_names_differ(self) -> Self:
        names = [MAIN, *(entry.name for entry in self.rig)]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(
                    f"rig: {name!r} is the name of more than one camera (the one under camera is {MAIN!r})"
                )
        return self

    @model_validator(mode="after")
    def _bounds_are_of_noisy_cameras_at_rest(self) -> Self:
        if self.bound and self.motion is not None:
            raise ValueError("bound = true: is for cameras at rest; leave out [motion]")
        if self.bound and self.sensor.noise == "none":
            raise ValueError('bound = true: without noise there is none; sensor.noise must not be "none"')
        return self

    @model_validator(mode="after")
    def _overscan_needs_a_lens_that_goes_on(self) -> Self:
        bent = [c.name for c in self.cameras if c.camera.distortion is not None]
        if self.regions is not None and self.regions.overscan and bent:
            raise ValueError(
                f"regions.overscan = true: camera {bent[0]!r} has a distortion, which says nothing of what lies far "
                "beyond the sensor; leave one of them out"
            )
        return self

    @property
    def cameras(self) -> tuple[Mounted, ...]:
        """All cameras, `main` first."""
        return mounted_cameras(self.camera, self.rig)

    @property
    def frame_count(self) -> int:
        """One frame for each camera, pose and repeat."""
        return self.poses.count * self.repeats * len(self.cameras)

    def time_s(self, view: ExpectedImage) -> float:
        """Exposure time of a view, seconds."""
        if self.exposure is not None:
            return self.exposure.time_s(view, self.sensor.saturation_e)
        assert self.exposure_s is not None  # _one_way_to_expose
        return self.exposure_s

    def place_of_frame(self, frame: int) -> tuple[int, int, int]:
        """Pose, shot and camera of a frame, each counted from 0; frames of one shot, then of one pose, are together."""
        shot, which = divmod(frame, len(self.cameras))
        return shot // self.repeats, shot, which


@dataclass(frozen=True)
class Plan:
    """A checked recipe with its scene."""

    recipe: Recipe
    scene: Scene


def load_plan(path: Path, assignments: Iterable[str] = (), scale: int = 1, scale_mode: ScaleMode = "binned") -> Plan:
    """Read a recipe, put in presets and `key=value` assignments, apply `scaled`, and read its scene.

    Raises InputError naming file, key and value.
    """
    assignments = list(assignments)
    source = f"{path} with --set" if assignments else str(path)
    tree = read_toml(path)
    keys = {assignment.partition("=")[0].partition(".")[0].strip() for assignment in assignments}
    for way, other in (("exposure", "exposure_s"), ("exposure_s", "exposure")):
        if way in keys and other not in keys:
            tree.pop(other, None)  # one way to expose that is assigned replaces the recipe's other
    recipe = check(with_presets(tree, assignments, source), Recipe, source)
    try:
        scene_path = find_file("scene", recipe.scene, path.parent)
    except InputError as error:
        raise InputError(f"{source}: scene = {error}") from None
    if not scene_path.is_file():
        raise InputError(f"{source}: scene = {recipe.scene!r}: no such file from the recipe's folder")
    return Plan(scaled(recipe, scale, scale_mode), load_scene(scene_path))


def scaled(recipe: Recipe, by: int, mode: ScaleMode) -> Recipe:
    """The same recipe with `by` x `by` pixels made one, and all that is given in pixels divided by `by`.

    "binned" keeps all photons: full well and gain grow with the pixels' area, so that digital numbers keep their range
    (`Sensor.binned`).
    "same-photons" shortens the exposure by the pixels' area instead: as many photons in a pixel as before.
    Raises InputError where `by` does not divide a sensor or the result is no recipe.
    """
    if by == 1:
        return recipe
    if by < 1:
        raise InputError(f"--scale {by}: is not 1 or more")
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
        changes["regions"] = recipe.regions.model_copy(update={"margin_px": recipe.regions.margin_px / by})
    if mode == "same-photons":
        if recipe.exposure_s is not None:
            changes["exposure_s"] = recipe.exposure_s / by**2
        else:  # what is metered are electrons in a pixel
            changes["exposure"] = recipe.exposure and recipe.exposure.model_copy(
                update={"longest_s": recipe.exposure.max_s / by**2}
            )
    else:
        changes["sensor"] = recipe.sensor.binned(by)
        if isinstance(
            recipe.exposure, NoiseLevelMetering
        ):  # of more electrons; a share of a full well scales by itself
            level_db = recipe.exposure.level_db - 10 * math.log10(by**2)
            changes["exposure"] = recipe.exposure.model_copy(update={"level_db": level_db})
    return check(recipe.model_copy(update=changes).model_dump(mode="json"), Recipe, f"--scale {by}")


def _scaled_camera(camera: Camera, by: int) -> Camera:
    """u' = u / by and v' = v / by: focal length, principal point and skew in pixels shrink alike."""
    if camera.width_px % by or camera.height_px % by:
        raise InputError(f"--scale {by}: does not divide the camera's {camera.width_px} x {camera.height_px} pixels")
    if camera.psf_kernel is not None:
        raise InputError(f"--scale {by}: camera.psf_kernel is measured in pixels of the full camera; leave out one")
    point = camera.principal_point_px
    return camera.model_copy(
        update={
            "width_px": camera.width_px // by,
            "height_px": camera.height_px // by,
            "pixel_pitch_um": camera.pixel_pitch_um * by,
            "principal_point_px": point and (point[0] / by, point[1] / by),
            "skew_px": camera.skew_px / by,
        }
    )
