"""Model of dataset.json, as datasets/FORMAT.md has it. The writer builds it, the verifier reads it back."""

from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from vlcrender.camera.rig import Mounted
from vlcrender.config.toml_model import Settings
from vlcrender.dataset.format.camera_entries import CameraEntry, CameraUncertainty, SensorEntry
from vlcrender.dataset.format.downlink_entry import DownlinkEntry, downlink_problem
from vlcrender.dataset.format.frame_numbers import Summary
from vlcrender.dataset.format.rows import triple
from vlcrender.dataset.format.values import (
    Coordinate,
    Count,
    LedSize,
    NotNegative,
    Positive,
    Sigma,
    Sigmas3,
    TiltSigma,
    Triple,
    repeated,
)
from vlcrender.dataset.format.withheld_entry import Withheld
from vlcrender.dataset.recipe.belief import CAMERA_PARAMETERS, EXACT_CAMERA, CameraSigmas, Sigmas
from vlcrender.dataset.recipe.file_settings import FilesEntry
from vlcrender.scene.as_built import Luminaires
from vlcrender.scene.leds import Leds
from vlcrender.sensor.accelerometer import Imu, TiltError
from vlcrender.sensor.gyroscope import Gyroscope

FORMAT_VERSION: Final = 4
"""`version` of dataset.json."""
DATA_VERSION = 6
"""`data_version` of the provenance: raised whenever the same recipe gives other bits."""

Seven = tuple[Sigma, Sigma, Sigma, Sigma, Sigma, Sigma, Sigma]
"""One number for each of belief.CAMERA_PARAMETERS."""


def _seven(numbers: NDArray[np.float64]) -> Seven:
    a, b, c, d, e, f, g = numbers.tolist()
    return a, b, c, d, e, f, g


class AccelerometerEntry(Settings):
    """The accelerometer in dataset.json."""

    kind: Literal["tilt-error", "imu"]
    error_deg: TiltSigma
    device_error_deg: TiltSigma | None
    shot_error_deg: TiltSigma | None


class GyroscopeEntry(Settings):
    """The gyroscope in dataset.json: standard deviations about each axis."""

    noise_rad_s: NotNegative
    bias_rad_s: NotNegative


class DiscEntry(Settings):
    """A round LED in dataset.json: the data that it broadcasts about itself."""

    id: Count
    position_m: tuple[Coordinate, Coordinate, Coordinate]
    shape: Literal["disc"]
    radius_m: LedSize
    luminaire: Count | None
    sigma_m: Sigmas3 | None
    radius_sigma_m: NotNegative | None
    gradient_sigma: NotNegative | None


class SquareEntry(Settings):
    """A square LED in dataset.json, sides along x and y: the data that it broadcasts about itself."""

    id: Count
    position_m: tuple[Coordinate, Coordinate, Coordinate]
    shape: Literal["square"]
    side_m: LedSize
    luminaire: Count | None
    sigma_m: Sigmas3 | None
    side_sigma_m: NotNegative | None
    gradient_sigma: NotNegative | None


LedMapEntry = Annotated[DiscEntry | SquareEntry, Field(discriminator="shape")]


class LuminaireEntry(Settings):
    """A luminaire in dataset.json: a panel, or a single LED."""

    id: Count
    position_m: Triple
    sigma_m: Sigmas3
    sigma_rotation_deg: Sigmas3


class MapDatumEntry(Settings):
    """Standard deviations of the map as a whole in dataset.json."""

    sigma_m: Sigmas3
    scale_sigma_ppm: NotNegative


class NamesEntry(Settings):
    """Names of the presets that the recipe names; None for a table without one."""

    camera: str | None = None
    sensor: str | None = None
    accelerometer: str | None = None
    belief: str | None = None


class DatasetFile(Settings):
    """dataset.json. Keys of its outermost object that FORMAT.md does not know are ignored."""

    model_config = ConfigDict(extra="ignore")

    format: Literal["vlcrender-dataset"]
    version: Literal[4]
    name: str
    frame_count: Count
    cameras: dict[str, CameraEntry]
    sensor: SensorEntry
    accelerometer: AccelerometerEntry
    gyroscope: GyroscopeEntry | None
    led_map: tuple[LedMapEntry, ...] | None
    """None where devices know of LEDs only what the LEDs send."""
    luminaires: tuple[LuminaireEntry, ...]
    map_datum: MapDatumEntry | None
    downlink: DownlinkEntry | None
    room_m: tuple[Positive, Positive, Positive]
    files: FilesEntry = FilesEntry()
    """Where not given, as the default: sets made before it was stated."""
    summary: Summary | None = None
    """None in sets made before it was stated."""
    licence: str | None = None
    """SPDX licence expression of the recipe; None where not stated."""
    names: NamesEntry = NamesEntry()
    """Where not given, no presets: sets made before they were stated."""
    withheld: Withheld | None = None
    """None where the set has its truth."""
    provenance: dict[str, Any]
    manifest_sha256: str | None = None
    """SHA-256 of manifest.json; None in a set that was made before there were manifests."""
    seal: str | None = None
    """SHA-256 of this file's content without the seal, see manifest.py."""

    @model_validator(mode="after")
    def _identities_agree(self) -> Self:
        ids = {led.id for led in self.led_map or ()}
        luminaires = {entry.id for entry in self.luminaires}
        if (one := repeated(led.id for led in self.led_map or ())) is not None:
            raise ValueError(f"led_map: id {one} occurs twice")
        if (one := repeated(entry.id for entry in self.luminaires)) is not None:
            raise ValueError(f"luminaires: id {one} occurs twice")
        for led in self.led_map or ():
            if luminaires and led.luminaire is not None and led.luminaire not in luminaires:
                raise ValueError(f"LED {led.id} names luminaire {led.luminaire}, which is not in luminaires")
        if problem := downlink_problem(self.downlink, None if self.led_map is None else ids):
            raise ValueError(problem)
        return self


def camera_entry(mounted: Mounted, sigmas: CameraSigmas | None = None) -> CameraEntry:
    """The entry of a camera on a rig, with the standard deviations that its device is told: 0 without `sigmas`."""
    arrays = {"K": mounted.camera.matrix, "R_cam_rig": mounted.rotation, "offset_m": mounted.offset_m}
    own = {"image_distance_mm": mounted.camera.image_distance_mm, **{key: a.tolist() for key, a in arrays.items()}}
    shared = mounted.camera.model_dump(include=set(CameraEntry.model_fields) - set(own))
    told = EXACT_CAMERA if sigmas is None else sigmas
    uncertainty = CameraUncertainty(
        parameters=CAMERA_PARAMETERS,
        device_sigma=_seven(told.device),
        shot_sigma=_seven(told.shot),
        offset_sigma_m=told.offset_m,
        rotation_sigma_deg=told.rotation_deg,
    )
    return CameraEntry.model_validate({**shared, **own, "uncertainty": uncertainty})


def accelerometer_entry(accelerometer: TiltError | Imu, sigmas: Sigmas | None = None) -> AccelerometerEntry:
    """The entry of an accelerometer, with the standard deviations that its device is told."""
    kind, error_deg = accelerometer.kind, accelerometer.error_deg
    if sigmas is None:
        return AccelerometerEntry(kind=kind, error_deg=error_deg, device_error_deg=None, shot_error_deg=None)
    device_deg, shot_deg = sigmas.accelerometer_device_deg, sigmas.accelerometer_shot_deg
    return AccelerometerEntry(
        kind=kind,
        error_deg=float(np.hypot(device_deg, shot_deg)),
        device_error_deg=device_deg,
        shot_error_deg=shot_deg,
    )


def gyroscope_entry(gyroscope: Gyroscope | None) -> GyroscopeEntry | None:
    """The entry of a gyroscope."""
    if gyroscope is None:
        return None
    return GyroscopeEntry(noise_rad_s=gyroscope.noise_rad_s, bias_rad_s=gyroscope.bias_rad_s)


def led_map(
    leds: Leds, luminaires: Luminaires | None = None, sigmas: Sigmas | None = None
) -> tuple[DiscEntry | SquareEntry, ...]:
    """The entries of all LEDs, in the order of the scene, with the standard deviations that devices are told."""
    entries: list[DiscEntry | SquareEntry] = []
    for i, (led, center, square) in enumerate(zip(leds.ids, leds.centers_m, leds.squares, strict=True)):
        size_m = float(leds.half_widths_m[i]) * (2 if square else 1)
        size_sigma_m = None if sigmas is None else sigmas.led_size * size_m
        shared: dict[str, Any] = {
            "id": int(led),
            "position_m": triple(center),
            "luminaire": None if luminaires is None else int(luminaires.of_led[i]),
            "sigma_m": None if sigmas is None else triple(sigmas.led_m),
            "gradient_sigma": None if sigmas is None else sigmas.led_gradient,
        }
        if square:
            entries.append(SquareEntry(**shared, shape="square", side_m=size_m, side_sigma_m=size_sigma_m))
        else:
            entries.append(DiscEntry(**shared, shape="disc", radius_m=size_m, radius_sigma_m=size_sigma_m))
    return tuple(entries)


def luminaire_entries(luminaires: Luminaires, sigmas: Sigmas) -> tuple[LuminaireEntry, ...]:
    """The entries of all luminaires, with the standard deviations that devices are told."""
    return tuple(
        LuminaireEntry(
            id=number,
            position_m=triple(center),
            sigma_m=triple(sigmas.luminaire_m),
            sigma_rotation_deg=triple(sigmas.luminaire_rotation_deg),
        )
        for number, center in enumerate(luminaires.centers_m)
    )


def map_datum_entry(sigmas: Sigmas) -> MapDatumEntry:
    """The standard deviations of the map as a whole that devices are told."""
    return MapDatumEntry(sigma_m=triple(sigmas.datum_m), scale_sigma_ppm=sigmas.datum_scale_ppm)
