"""What a device does not know: standard deviations of the truth about a recipe's values.

A recipe says what a device is told. Where it has `[belief]`, cameras, LEDs and accelerometers are drawn about it: see
"Told and true" in datasets/FORMAT.md for the meaning of each error. `Belief` holds the standard deviations as a recipe
gives them, `Sigmas` the same in the units of the format.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.rig import MAIN, Mounted
from vlcrender.config.presets import preset
from vlcrender.config.toml_model import Settings, check, key_error
from vlcrender.sensor.accelerometer import Imu, TiltError

Array = NDArray[np.float64]

CAMERA_PARAMETERS: Final = ("focal", "aspect", "cx_px", "cy_px", "k1", "p1", "p2")
"""Errors of a camera's projection, in the order of `CameraSigmas`; datasets/FORMAT.md has their meaning."""

Percent = Annotated[float, Field(ge=0, le=10)]
Micrometres = Annotated[float, Field(ge=0, le=1000)]
Millimetres = Annotated[float, Field(ge=0, le=1000)]
Degrees = Annotated[float, Field(ge=0, le=10)]
Factor = Annotated[float, Field(gt=0, le=1000)]
MillimetreTriple = tuple[Millimetres, Millimetres, Millimetres]


class _Stated(Settings):
    """A table of standard deviations, with a factor between the stated and the true ones."""

    stated_factor: Factor | None = None
    """Stated over true standard deviation for this table; `belief.stated_factor` where not given."""


class CameraBelief(_Stated):
    """Errors of a camera that stay with its device: one standard deviation each.

    Lengths are on the sensor, so that `--scale` leaves them alone.
    """

    focal_percent: Percent = 0.0
    """Relative error of the focal length, percent."""
    aspect_percent: Percent = 0.0
    """Relative error of fx / fy, percent."""
    principal_point_um: Micrometres = 0.0
    """Error of the principal point along u and along v, each, um on the sensor."""
    radial_corner_um: Micrometres = 0.0
    """Displacement of the image by the error of k1 at a corner of the sensor, um."""
    decentering_corner_um: Micrometres = 0.0
    """Displacement of the image by the error of p1, and of p2, at a corner of the sensor: 3 p r^2 f_i, um."""


class ShotBelief(_Stated):
    """Errors of a camera that are new in each frame, about the values of its device: one standard deviation each."""

    focal_percent: Percent = 0.0
    """Relative error of the focal length, by focusing, percent."""
    principal_point_um: Micrometres = 0.0
    """Error of the principal point along u and along v, each, by optical image stabilisation, um on the sensor."""


class LuminaireBelief(_Stated):
    """Errors of the pose of each luminaire: a panel, or a single LED. One standard deviation each."""

    position_mm: MillimetreTriple = (0.0, 0.0, 0.0)
    """Error of the position along x, y and z, mm."""
    yaw_deg: Degrees = 0.0
    """Rotation about the vertical through the luminaire's centre, degrees."""
    tilt_deg: Degrees = 0.0
    """Rotation about x, and about y, through the luminaire's centre, degrees."""


class LedBelief(_Stated):
    """Errors of each LED within its luminaire: one standard deviation each."""

    position_mm: MillimetreTriple = (0.0, 0.0, 0.0)
    """Error of the position along x, y and z, mm."""
    radius_percent: Percent = 0.0
    """Relative error of a disc's radius or a square's side, percent."""
    gradient_percent: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Change of luminance from the centre of the face to its rim, along x and along y, each, percent."""


class AccelerometerBelief(_Stated):
    """Errors of an accelerometer of the kind "tilt-error" on each tilt; they replace `accelerometer.error_deg`.

    An accelerometer of the kind "imu" has its own errors, which this table does not change.
    """

    device_error_deg: Degrees = 0.0
    """Standard deviation of the errors that stay with a device, degrees."""
    shot_error_deg: Degrees = 0.0
    """Standard deviation of the errors that are new in each shot, degrees."""


class DatumBelief(_Stated):
    """Errors of the map as a whole: one standard deviation each. No image shows them."""

    position_mm: MillimetreTriple = (0.0, 0.0, 0.0)
    """Displacement of all LEDs together along x, y and z, mm."""
    scale_ppm: Annotated[float, Field(ge=0, le=1e5)] = 0.0
    """Relative error of all lengths from the world's origin, parts in a million."""


class RigBelief(_Stated):
    """Errors of the mounting of each camera beside `main`: one standard deviation each."""

    offset_mm: Millimetres = 0.0
    """Error of the projection centre along each axis of the rig, mm."""
    rotation_deg: Degrees = 0.0
    """Rotation about each axis of the camera, degrees."""


@dataclass(frozen=True)
class CameraSigmas:
    """Standard deviations of a camera's errors, in the order and units of CAMERA_PARAMETERS."""

    device: Array
    """Of the errors that stay with a device, (7,)."""
    shot: Array
    """Of the errors that are new in each frame, (7,)."""
    offset_m: float
    """Of its projection centre on the rig, along each axis, m; 0 for `main`."""
    rotation_deg: float
    """Of its rotation on the rig, about each axis, degrees; 0 for `main`."""


EXACT_CAMERA: Final = CameraSigmas(np.zeros(len(CAMERA_PARAMETERS)), np.zeros(len(CAMERA_PARAMETERS)), 0.0, 0.0)
"""A camera without errors, as a recipe without [belief] has it."""


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations of all errors, in the units of datasets/FORMAT.md. Zero: no error."""

    cameras: dict[str, CameraSigmas]
    """By the camera's name."""
    luminaire_m: Array
    """Displacement of a luminaire, (3,), m."""
    luminaire_rotation_deg: Array
    """Rotation of a luminaire about x, y and z, (3,), degrees."""
    led_m: Array
    """Displacement of an LED within its luminaire, (3,), m."""
    led_size: float
    """Relative error of an LED's radius or side."""
    led_gradient: float
    """gx, and gy, of an LED."""
    accelerometer_device_deg: float
    """Error on each tilt that stays with a device, degrees."""
    accelerometer_shot_deg: float
    """Error on each tilt that is new in each shot, degrees."""
    datum_m: Array
    """Displacement of the map, (3,), m."""
    datum_scale_ppm: float
    """Scale of the map about the world's origin."""


class Belief(Settings):
    """What a device does not know: standard deviations of the truth about the recipe's values.

    Errors are independent and normal with mean 0. A value that is not given is 0. `dataset.json` states the standard
    deviations, times `stated_factor`; see "Told and true" in FORMAT.md.
    """

    devices: Annotated[int, Field(ge=1, le=1_000_000)] = 20
    """Number of devices. Pose p is taken by device p % devices."""
    maps: Annotated[int, Field(ge=1, le=10_000)] = 4
    """Number of as-built maps of the LEDs. Device d works in map d % maps."""
    stated_factor: Factor = 1.0
    """Stated over true standard deviation: 1 for a device that knows how well it knows. Each table may have its own."""
    camera: CameraBelief = CameraBelief()
    """Errors of cameras that stay with a device."""
    shot: ShotBelief = ShotBelief()
    """Errors of cameras that are new in each frame."""
    luminaires: LuminaireBelief = LuminaireBelief()
    """Errors of the pose of each luminaire."""
    leds: LedBelief = LedBelief()
    """Errors of each LED within its luminaire."""
    accelerometer: AccelerometerBelief | None = None
    """Errors of a "tilt-error" accelerometer. Where not given, `accelerometer.error_deg` is new in each shot."""
    datum: DatumBelief = DatumBelief()
    """Errors of the map as a whole."""
    rig: RigBelief = RigBelief()
    """Errors of the mounting of cameras beside `main`."""

    @model_validator(mode="after")
    def _every_map_has_a_device(self) -> Self:
        if self.maps > self.devices:
            raise key_error(
                "maps", f"is {self.maps}; each device works in one map, so at most devices = {self.devices} are allowed"
            )
        return self

    @classmethod
    def preset(cls, name: str) -> Self:
        """The belief of a preset, such as "calibrated". Raises InputError with the names there are."""
        return check(preset("beliefs", name)["belief"], cls, f"belief preset {name}")

    def map_of_device(self, device: int) -> int:
        """The map that a device works in."""
        return device % self.maps

    def device_of_pose(self, pose: int) -> int:
        """The device that takes a pose."""
        return pose % self.devices

    def true_sigmas(self, cameras: Sequence[Mounted], accelerometer: TiltError | Imu) -> Sigmas:
        """Standard deviations of the truth about the told values, for the recipe's cameras and accelerometer."""
        return self._sigmas(cameras, accelerometer, stated=False)

    def stated_sigmas(self, cameras: Sequence[Mounted], accelerometer: TiltError | Imu) -> Sigmas:
        """Standard deviations that the device is told: the true ones times the `stated_factor` of their table."""
        return self._sigmas(cameras, accelerometer, stated=True)

    def _sigmas(self, cameras: Sequence[Mounted], accelerometer: TiltError | Imu, stated: bool) -> Sigmas:
        def factor(table: _Stated | None) -> float:
            own = None if table is None else table.stated_factor
            return 1.0 if not stated else self.stated_factor if own is None else own

        device_deg, shot_deg = _accelerometer_errors_deg(self.accelerometer, accelerometer)
        of_luminaires, of_leds, of_datum = factor(self.luminaires), factor(self.leds), factor(self.datum)
        of_accelerometer = factor(self.accelerometer)
        tilt_deg, yaw_deg = self.luminaires.tilt_deg, self.luminaires.yaw_deg
        return Sigmas(
            cameras={
                mounted.name: CameraSigmas(
                    factor(self.camera) * _device_sigmas(self.camera, mounted.camera),
                    factor(self.shot) * _shot_sigmas(self.shot, mounted.camera),
                    0.0 if mounted.name == MAIN else factor(self.rig) * self.rig.offset_mm / 1e3,
                    0.0 if mounted.name == MAIN else factor(self.rig) * self.rig.rotation_deg,
                )
                for mounted in cameras
            },
            luminaire_m=of_luminaires * np.array(self.luminaires.position_mm) / 1e3,
            luminaire_rotation_deg=of_luminaires * np.array([tilt_deg, tilt_deg, yaw_deg]),
            led_m=of_leds * np.array(self.leds.position_mm) / 1e3,
            led_size=of_leds * self.leds.radius_percent / 100,
            led_gradient=of_leds * self.leds.gradient_percent / 100,
            accelerometer_device_deg=of_accelerometer * device_deg,
            accelerometer_shot_deg=of_accelerometer * shot_deg,
            datum_m=of_datum * np.array(self.datum.position_mm) / 1e3,
            datum_scale_ppm=of_datum * self.datum.scale_ppm,
        )


def _device_sigmas(table: CameraBelief, camera: Camera) -> Array:
    """Standard deviations (7,) of a camera's errors that stay with a device.

    With the corner's radius r in units of the image distance f_i, k1 displaces the image there by k1 r^3 f_i, and p1 or
    p2 by at most 3 p r^2 f_i.
    """
    image_distance_um = camera.image_distance_mm * 1000
    corner_um = camera.pixel_pitch_um * float(np.hypot(camera.width_px, camera.height_px)) / 2
    r = corner_um / image_distance_um
    center_px = table.principal_point_um / camera.pixel_pitch_um
    k1 = p = 0.0
    if camera.projection == "perspective":
        k1 = table.radial_corner_um / (image_distance_um * r**3)
        p = table.decentering_corner_um / (3 * image_distance_um * r**2)
    return np.array([table.focal_percent / 100, table.aspect_percent / 100, center_px, center_px, k1, p, p])


def _shot_sigmas(table: ShotBelief, camera: Camera) -> Array:
    """Standard deviations (7,) of a camera's errors that are new in each frame."""
    center_px = table.principal_point_um / camera.pixel_pitch_um
    return np.array([table.focal_percent / 100, 0.0, center_px, center_px, 0.0, 0.0, 0.0])


def _accelerometer_errors_deg(table: AccelerometerBelief | None, accelerometer: TiltError | Imu) -> tuple[float, float]:
    """Errors on each tilt that stay with a device and that are new in each shot, degrees."""
    if isinstance(accelerometer, Imu):
        return accelerometer.device_error_deg, accelerometer.shot_error_deg
    if table is None:
        return 0.0, accelerometer.error_deg
    return table.device_error_deg, table.shot_error_deg
