"""The functions of the Python API; `vlcrender` has them all. The command line calls the same ones.

Modules that need Mitsuba, SciPy or Parquet are imported inside the functions that use them, so that a mistake in a
recipe is refused before Mitsuba is loaded.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import LedRegions, RegionImage, Roi
from vlcrender.config.overrides import Overrides, assignments
from vlcrender.config.packaged import find_file
from vlcrender.errors import InputError
from vlcrender.rendering.expected_image import ExpectedImage, Gain, Gains, Image
from vlcrender.scene.loader import Scene
from vlcrender.sensor.sensor import Sensor

if TYPE_CHECKING:
    from vlcrender.dataset.format.downlink_entry import Demodulation
    from vlcrender.dataset.format.rows import SpotRow
    from vlcrender.dataset.recipe.plan import Plan
    from vlcrender.dataset.run.progress import ProgressCallback
    from vlcrender.dataset.world.error_budget import ErrorBudget
    from vlcrender.rendering.bayer import MosaicRenderer
    from vlcrender.rendering.renderer import Renderer
    from vlcrender.sensor.accelerometer import Imu, TiltError

ScaleMode = Literal["binned", "same-photons"]
MAX_RENDERERS = 4
"""Renderers that are kept, one for each scene and spectral response; the one used longest ago is dropped first."""
MAX_EXPOSURE_S = 100.0
MAX_START_S = 1e7
"""Latest start of a frame: the phase of a wave of 1 ms is then known to 1e-6 periods."""
MAX_SEED = 2**128


@dataclass(frozen=True)
class ExpectedFrame(ExpectedImage):
    """The expected image of one camera at rest, with the truth beside it.

    `parts` are what is read out: the whole sensor, or regions that share no pixel. Rates are in electrons a second.
    """

    scene: Scene
    camera: Camera
    pose: Pose
    sensor: Sensor
    """Its quantum efficiency, mosaic and crosstalk are in the image; nothing else of it is."""
    regions: LedRegions | None = None

    @property
    def electrons_per_s(self) -> Image:
        """Mean photoelectrons a second of a full frame, (height, width), float32."""
        return self.expected_electrons(1.0)

    @property
    def R_cam_world(self) -> NDArray[np.float64]:
        """Rotation matrix (3, 3): `p_cam = R_cam_world @ (p_world - position_m)`."""
        return self.pose.rotation

    @property
    def truth(self) -> dict[str, Any]:
        """The pose and every LED that lights a pixel, in the words of truth.parquet (datasets/FORMAT.md).

        Clocks and phases of waves belong to a frame: they are not part of it.
        """
        return {
            "position_m": list(self.pose.position_m),
            "R_cam_world": self.pose.rotation.ravel().tolist(),
            "tilt_x_deg": self.pose.tilt_x_deg,
            "tilt_y_deg": self.pose.tilt_y_deg,
            "yaw_deg": self.pose.yaw_deg,
            "leds": [
                {
                    "led": patch.led_id,
                    "u_px": patch.center_px[0],
                    "v_px": patch.center_px[1],
                    "visible_fraction": patch.visible_fraction,
                }
                for patch in sorted(self.patches, key=lambda patch: patch.led_id)
            ],
        }


@dataclass(frozen=True)
class RawRegion:
    """Digital numbers of one region of interest: `image_dn` (rows, columns), uint32."""

    roi: Roi
    image_dn: NDArray[np.uint32]


@dataclass(frozen=True)
class RawFrame:
    """One exposure: what a device reads out and knows. The truth is in the `ExpectedFrame` it was made from."""

    scene: Scene
    camera: Camera
    sensor: Sensor
    accelerometer: "TiltError | Imu"
    exposure_s: float
    parts: tuple[RawRegion, ...]
    """The whole sensor, or the regions that were read out, by first row, then column."""
    accelerometer_m_s2: NDArray[np.float64]
    """Reading (3,) of the accelerometer at rest, in camera axes."""
    spots: "tuple[SpotRow, ...]"
    """Decoded identities: `led`, and a rough pixel `u_px`, `v_px`; none with `demodulation` "pixels"."""
    start_s: float = 0.0
    """Start of the exposure of the first line that is read, by the clock of the waves of the LEDs."""
    demodulation: "Demodulation" = "given"
    """Whether identities are given, or a receiver has to read them from the pixels."""

    @property
    def image_dn(self) -> NDArray[np.uint32]:
        """Digital numbers of a full frame, (height, width). Raises InputError if regions alone were read out."""
        if len(self.parts) != 1 or self.parts[0].roi != Roi.of_sensor(self.camera):
            raise InputError(f"image_dn: the frame has {len(self.parts)} regions; read image_dn of each of its parts")
        return self.parts[0].image_dn

    def record(self) -> dict[str, Any]:
        """The frame in the words of datasets/FORMAT.md, for `estimator.frame`; nothing of the truth is in it.

        Keys: `camera`, `sensor`, `accelerometer`, `led_map` and `downlink` as in dataset.json, `exposure_s`, `start_s`,
        `accelerometer_m_s2` and `spots` as in frames.parquet, and `parts`: `row`, `column` and `image_dn` of each
        region.
        """
        from vlcrender.camera.rig import mounted_cameras
        from vlcrender.dataset.format.camera_entries import SensorEntry
        from vlcrender.dataset.format.downlink_entry import downlink_entry
        from vlcrender.dataset.format.schema import accelerometer_entry, camera_entry, led_map

        (mounted,) = mounted_cameras(self.camera, ())
        downlink = downlink_entry(self.scene.leds, self.demodulation)
        return {
            "camera": camera_entry(mounted).model_dump(mode="json"),
            "sensor": SensorEntry(**self.sensor.acting()).model_dump(mode="json"),
            "accelerometer": accelerometer_entry(self.accelerometer).model_dump(mode="json"),
            "led_map": [entry.model_dump(mode="json") for entry in led_map(self.scene.leds)],
            "downlink": None if downlink is None else downlink.model_dump(mode="json"),
            "exposure_s": self.exposure_s,
            "start_s": self.start_s,
            "accelerometer_m_s2": self.accelerometer_m_s2.tolist(),
            "spots": [spot.model_dump() for spot in self.spots],
            "parts": [
                {"row": part.roi.row, "column": part.roi.column, "image_dn": part.image_dn} for part in self.parts
            ],
        }


def load_scene(name_or_path: str | Path) -> Scene:
    """Read and check a scene: the name of one that comes with the package, such as "office", or a TOML file.

    A file of this path wins over a name. Raises InputError naming file, key and value.
    """
    from vlcrender.scene.loader import load_scene as load

    return load(find_file("scene", name_or_path))


def load_recipe(
    name_or_path: str | Path,
    overrides: Overrides | None = None,
    *,
    scale: int = 1,
    scale_mode: ScaleMode = "binned",
) -> "Plan":
    """Read and check a recipe: the name of one that comes with the package, such as "quickstart", or a TOML file.

    Returns a `Plan`: the recipe, with `overrides` and presets put in, and its scene. Of a recipe with [[sweep]] these
    are of the first cell, and `cells` has all: `len(plan.cells)`, `plan.cells.plan(number)`. `overrides` maps dotted
    keys to values, `{"poses.count": 20, "scene.ambient.illuminance_lux": 800}`, or lists `key=value` texts as after
    `--set`. With `scale` N, N x N pixels are binned into one; `scale_mode` says whether larger pixels keep all photons
    ("binned") or the exposure is shortened ("same-photons"). Raises InputError naming file, key and value.
    """
    from vlcrender.dataset.recipe.plan import load_plan

    return load_plan(find_file("recipe", name_or_path), assignments(overrides), scale, scale_mode)


def render(
    scene: Scene,
    camera: Camera,
    pose: Pose,
    *,
    sensor: Sensor | None = None,
    regions: LedRegions | None = None,
) -> ExpectedFrame:
    """Render the expected image: mean photoelectrons a second of every pixel, without noise, and the truth.

    Where LEDs transmit, this is the mean over time: `expose` adds their waves.
    Of the `sensor`, by default `Sensor()`, quantum efficiency, mosaic and crosstalk count. With `regions` the regions
    around the LEDs are rendered alone. The scene's light is computed once and kept in the cache folder; renderers are
    kept for each scene object and spectral response. Raises InputError if the camera is not inside the room, or if
    overscan is asked of a camera with distortion.
    """
    sensor = sensor or Sensor()
    if regions is not None and regions.overscan and camera.distortion is not None:
        raise InputError("regions.overscan = true: a camera with distortion is not defined far beyond its sensor")
    modulated = any(transmitter.modulated for transmitter in scene.leds.transmitters)
    image = _renderer(scene, sensor).expected_image(PosedCamera(camera, pose), regions, room_apart=modulated)
    return ExpectedFrame(image.parts, scene, camera, pose, sensor, regions)


def expose(
    mean: ExpectedFrame,
    sensor: Sensor,
    exposure_s: float,
    seed: int,
    accelerometer: "TiltError | Imu | None" = None,
    *,
    frame: int = 0,
    start_s: float = 0.0,
    demodulation: "Demodulation" = "given",
) -> RawFrame:
    """Expose an expected image: noise, saturation and quantization of a sensor, as digital numbers.

    Noise depends on `seed`, `frame` and the pixel: the result has the bits of frame number `frame` of a dataset with
    this seed, one camera and no repeats. Where LEDs of the scene transmit, the exposure of the first line starts
    `start_s` after the start of their waves (`start_s` of that frame in frames.parquet); clocks and phases follow from
    `seed`. With `demodulation` "pixels" no identities are given. `accelerometer` is `TiltError()` by default, with
    0.1 deg of error. If the quantum efficiency, mosaic or crosstalk of `sensor` differs from those that `mean` was
    rendered with, the view is rendered again with the sensor's. Raises InputError for a time, a seed or a demodulation
    that is not allowed.
    """
    from vlcrender.core.random_keys import random_key, stream
    from vlcrender.dataset.world.downlink import decoded_spots
    from vlcrender.sensor.accelerometer import TiltError
    from vlcrender.sensor.signal_chain import expose_regions

    exposure_s = float(exposure_s)
    if not (isfinite(exposure_s) and 0 < exposure_s <= MAX_EXPOSURE_S):
        raise InputError(f"exposure_s = {exposure_s:g}: has to be above 0 and at most {MAX_EXPOSURE_S:g}")
    start_s = float(start_s)
    if not (isfinite(start_s) and 0 <= start_s <= MAX_START_S):
        raise InputError(f"start_s = {start_s:g}: has to be from 0 to {MAX_START_S:g}")
    if demodulation not in ("given", "pixels"):
        raise InputError(f'demodulation = "{demodulation}": has to be "given" or "pixels"')
    for name, number in (("seed", seed), ("frame", frame)):
        if not 0 <= int(number) < MAX_SEED:
            raise InputError(f"{name} = {number}: has to be an integer from 0 to 2**128 - 1")
    if sensor.spectral_response != mean.sensor.spectral_response:
        mean = render(mean.scene, mean.camera, mean.pose, sensor=sensor, regions=mean.regions)
    device = accelerometer or TiltError()
    noise = random_key(int(seed), int(frame), "shot-noise")
    gains, room_gain = _gains(mean, exposure_s, int(seed), start_s)
    expected = [RegionImage(part.roi, part.expected_electrons(exposure_s, gains, room_gain)) for part in mean.parts]
    parts = tuple(RawRegion(*part) for part in expose_regions(sensor, expected, noise, exposure_s=exposure_s))
    spots: tuple[SpotRow, ...] = ()
    if demodulation == "given":
        spots = decoded_spots(mean.parts, mean.camera.width_px, stream(int(seed), int(frame), "demodulator"))
    return RawFrame(
        mean.scene,
        mean.camera,
        sensor,
        device,
        exposure_s,
        parts,
        device.reading_m_s2(mean.pose, stream(int(seed), int(frame), "accelerometer")),
        spots,
        start_s,
        demodulation,
    )


def _gains(mean: ExpectedFrame, exposure_s: float, seed: int, start_s: float) -> tuple[Gains | None, Gain]:
    """Gains of the LEDs and of the room's light in an exposure, for each line; None and 1 where all light is steady."""
    from vlcrender.modulation.exposure import LineGains, MeanWave
    from vlcrender.modulation.transmission import led_waves

    leds = mean.scene.leds
    waves = led_waves(leds.transmitters, seed)
    if not waves:
        return None, 1.0
    starts_s = start_s + mean.camera.line_starts_s()
    room = MeanWave.of(waves, dict(zip(leds.ids.tolist(), leds.fluxes_lm.tolist(), strict=True)))
    return LineGains(waves, starts_s, exposure_s), room.mean(starts_s, exposure_s)


def generate(
    recipe: "str | Path | Plan",
    out: str | Path,
    *,
    overrides: Overrides | None = None,
    workers: int = 1,
    scale: int = 1,
    scale_mode: ScaleMode = "binned",
    scheduler: str | None = None,
    progress: "ProgressCallback | None" = None,
    withhold_truth: str | Path | None = None,
) -> bool:
    """Generate the dataset of a recipe, or of each cell of its sweep, in the folder `out`; continue an interrupted run.

    `recipe` is a packaged name, the path of a TOML file, or what `load_recipe` returns; `overrides`, `scale` and
    `scale_mode` are those of `load_recipe`. `workers` processes make frames, or the workers of a dask `scheduler` (its
    address); the bits are the same for any number. `progress` is called with `Progress` reports. `withhold_truth` is a
    key file, made if missing: the truth of the test frames is sealed with it, or that of all frames without [split],
    and `release` writes it again. Returns False if the dataset was already complete and intact. Raises InputError for
    bad input, or if `out` holds anything else.
    """
    if workers < 1:
        raise InputError(f"workers = {workers}: has to be 1 or more")
    plan = _plan(recipe, overrides, scale, scale_mode)
    from vlcrender.dataset.run.generate import generate as make  # loads Mitsuba: after the recipe is known to be good

    key_file = None if withhold_truth is None else Path(withhold_truth)
    return make(plan, Path(out), workers, scheduler, progress, key_file)


def budget(
    recipe: "str | Path | Plan",
    *,
    overrides: Overrides | None = None,
    poses: int = 40,
    camera: str = "main",
    bound: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> "ErrorBudget":
    """The error budget of a recipe: what each unknown contributes to the position's error of one frame.

    `recipe` and `overrides` as in `generate`. Of the recipe's poses, `poses` evenly spread ones are taken. `camera` is
    the name of a camera of the rig. With `bound` the Cramér-Rao bound of the pixels is computed too, at three times the
    cost. `progress` is called with the numbers of finished and of all poses. Raises InputError for bad input, for a
    recipe with motion or without noise, and if no pose determines a position.
    """
    from vlcrender.dataset.world.error_budget import error_budget

    plan = _plan(recipe, overrides)
    return error_budget(plan, lambda: renderer_of(plan), poses, camera, bound, progress)


def verify(directory: str | Path) -> list[str]:
    """Check that a dataset, or each cell of a sweep, is complete and intact and its truth consistent.

    Returns a line for each problem, or no line. Raises InputError if the folder has no readable dataset.json.
    """
    from vlcrender.dataset.verify.verify import verify as problems_of

    return problems_of(Path(directory))


def release(directory: str | Path, key_file: str | Path) -> None:
    """Write the withheld truth of a dataset again: it then is the dataset of the recipe with the true seed.

    `key_file` is that of `generate(..., withhold_truth=...)`. Raises InputError if the dataset has its truth, the key
    is not its key, or the sealed truth is damaged.
    """
    from vlcrender.dataset.world.withheld import release as write

    write(Path(directory), Path(key_file))


def repair(directory: str | Path, *, scene_folder: str | Path | None = None, workers: int = 1) -> list[str]:
    """Make files of a dataset, or of the cells of a sweep, again where they are missing or damaged.

    They are made of the recipe, scene and seed in dataset.json, and take the place of damaged ones only where their
    digests are those of the manifest: then every bit is as it was. A set that was made before there were manifests gets
    one if `verify` finds nothing else. `scene_folder` is the folder of the scene file, where the scene has textures or
    furniture. Returns a line for each file that was made again or could not be. Raises InputError if dataset.json is
    damaged, which alone says what the set is made of, or if files of the scene are not those of the set.
    """
    from vlcrender.dataset.run.repair import repair as repaired  # loads Mitsuba

    return repaired(Path(directory), None if scene_folder is None else Path(scene_folder), workers)


def export_dataset(directory: str | Path, to: str, out: str | Path) -> int:
    """Export a complete dataset to another tool's format; returns the number of frames.

    `to` is one of png16, csv, tum, opencv-yaml, kalibr, colmap, nerfstudio, bop, webdataset, rosbag2, croissant and
    card (docs/exporting.md). `out` is a new folder, or a new file for croissant and card; it appears whole or not at
    all. Raises InputError for bad input, and names what the format cannot express.
    """
    from vlcrender.export.registry import export_dataset as export

    return export(Path(directory), to, Path(out))


def _plan(
    recipe: "str | Path | Plan", overrides: Overrides | None, scale: int = 1, scale_mode: ScaleMode = "binned"
) -> "Plan":
    """The plan of a recipe's name or path. Raises InputError for overrides or a scale of a plan made already."""
    if isinstance(recipe, str | Path):
        return load_recipe(recipe, overrides, scale=scale, scale_mode=scale_mode)
    if overrides is not None or scale != 1:
        raise InputError("overrides, scale: are for a recipe's name or path; give them to load_recipe")
    return recipe


def renderer_of(plan: "Plan") -> "Renderer | MosaicRenderer":
    """The renderer of a plan's scene for its sensor, made or kept from before."""
    return _renderer(plan.scene, plan.recipe.sensor)


_renderers: "dict[tuple[int, str], Renderer | MosaicRenderer]" = {}
"""By the scene's identity, which stays taken because a renderer holds its scene; used longest ago first."""
_renderers_lock = threading.Lock()


def _renderer(scene: Scene, sensor: Sensor) -> "Renderer | MosaicRenderer":
    """The renderer of a scene and a spectral response, made or kept from before."""
    from vlcrender.light.lightmap import bake
    from vlcrender.rendering.bayer import MosaicRenderer
    from vlcrender.rendering.renderer import Renderer
    from vlcrender.sensor.radiometry import detectors

    key = id(scene), sensor.spectral_response
    with _renderers_lock:
        renderer = _renderers.pop(key, None)
        if renderer is None:
            light = bake(scene)
            if sensor.mosaic == "none":
                renderer = Renderer(scene, light, detectors(sensor)[0], sensor.crosstalk)
            else:
                of_colours = tuple(Renderer(scene, light, detector) for detector in detectors(sensor))
                renderer = MosaicRenderer(of_colours, sensor.mosaic, sensor.crosstalk)
        _renderers[key] = renderer
        while len(_renderers) > MAX_RENDERERS:
            del _renderers[next(iter(_renderers))]
    return renderer
