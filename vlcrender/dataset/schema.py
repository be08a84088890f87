"""Models of everything a dataset states in tables and JSON, as datasets/FORMAT.md has it.

Rows of frames.parquet and truth.parquet, a line of the journal, and dataset.json. The writer builds these models, the
verifier reads them back, and the Arrow schemas of the tables derive from them.
"""

from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.rig import Mounted
from vlcrender.camera.shutter import Shutter
from vlcrender.config.toml_model import Settings
from vlcrender.dataset.belief import CAMERA_PARAMETERS, EXACT_CAMERA, CameraSigmas, Sigmas
from vlcrender.dataset.downlink_entry import DownlinkEntry
from vlcrender.scene.as_built import Luminaires
from vlcrender.scene.leds import Leds
from vlcrender.sensor.accelerometer import Imu, TiltError
from vlcrender.sensor.gyroscope import Gyroscope

FORMAT_VERSION: Final = 4
"""`version` of dataset.json."""
DATA_VERSION = 4
"""`data_version` of the provenance: raised whenever the same recipe gives other bits."""

Triple = tuple[float, float, float]
Matrix = tuple[Triple, Triple, Triple]
Flat9 = tuple[float, float, float, float, float, float, float, float, float]
"""A 3 x 3 matrix, row by row."""
Five = tuple[float, float, float, float, float]
"""Distortion: k1, k2, k3, p1, p2."""
Seven = tuple[float, float, float, float, float, float, float]
"""One number for each of belief.CAMERA_PARAMETERS."""


def flat9(matrix: NDArray[np.float64]) -> Flat9:
    """A 3 x 3 matrix, row by row."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix.tolist()
    return xx, xy, xz, yx, yy, yz, zx, zy, zz


def five(distortion: Distortion | None) -> Five | None:
    """The coefficients of a distortion; None without one."""
    if distortion is None:
        return None
    return distortion.k1, distortion.k2, distortion.k3, distortion.p1, distortion.p2


def triple(numbers: NDArray[np.float64]) -> Triple:
    """A vector (3,) as a tuple."""
    x, y, z = numbers.tolist()
    return x, y, z


def _seven(numbers: NDArray[np.float64]) -> Seven:
    a, b, c, d, e, f, g = numbers.tolist()
    return a, b, c, d, e, f, g


class SpotRow(Settings):
    """A decoded identity: one LED and its rough pixel."""

    led: int
    """LED id."""
    u_px: float
    v_px: float


class FrameRow(Settings):
    """A row of frames.parquet: what a device knows about one frame."""

    frame: int
    shot: int
    burst: int
    """Frames of one burst follow each other at the frame rate; equal to `shot` without bursts."""
    start_s: float
    """Start of the exposure of the first line, on the rig's clock."""
    pose: int
    device: int
    """Frames of one device share the errors of a device."""
    file: str
    """Path below the dataset, with `/`."""
    part: int | None
    """Number of the frame's first part in that file where it holds several frames; else None."""
    sha256: str
    """Digest of that file, 64 hex digits."""
    camera: str
    exposure_s: float
    capturable: bool
    """Whether every region of the frame lies on the sensor."""
    accelerometer_m_s2: Triple
    """Reading at mid-exposure in the axes of this frame's camera."""
    gyro_rad_s: Triple | None
    """Reading of the gyroscope, mean over the readout, in the axes of this frame's camera; None without one."""
    spots: tuple[SpotRow, ...]
    time_s: float | None = None
    """Time stamp of the pose in the recipe; None where it has none."""


class LedTruth(Settings):
    """The true image of one LED that lights at least one pixel of a frame."""

    led: int
    """LED id."""
    u_px: float
    """Image of the LED's centre, exact, at the time of its own line."""
    v_px: float
    visible_fraction: float
    """Share of the LED's image that falls on the sensor."""
    clock_error: float | None
    """Relative error of the frequency of the LED's clock; None for a steady LED."""
    phase: float | None
    """Phase of the LED's wave at the frame's `start_s`, periods, in [0, 1); None for a steady LED."""
    bits: str | None
    """Chips of one period of the LED's wave, "1" lit; None for a steady LED and for waves that send nothing."""


class TruthRow(Settings):
    """A row of truth.parquet: the pose of one frame and what follows from it."""

    frame: int
    shot: int
    map: int
    """The map of the LEDs that the frame shows."""
    K: Flat9
    """True intrinsics of this frame."""
    distortion: Five | None
    """True distortion of this frame."""
    position_m: Triple
    """Projection centre of this frame's camera, world."""
    R_cam_world: Flat9
    tilt_x_deg: float
    tilt_y_deg: float
    yaw_deg: float
    angular_velocity_rad_s: Triple | None
    """About the axes of this frame's camera, right-handed; None at rest."""
    linear_velocity_m_s: Triple | None
    """Velocity of the projection centre, world axes; None at rest."""
    leds: tuple[LedTruth, ...]
    added_noise_dn: float | None
    """Standard deviation of the noise that `[added_noise]` adds before rounding, digital numbers; None without."""
    bound_m2: Flat9 | None
    """Cramér-Rao bound of the position; hybrid with a belief."""
    bound_exact_m2: Flat9 | None
    """Cramér-Rao bound of the position for a device that is told the truth."""


class DeviceTruthRow(Settings):
    """A row of truth_devices.parquet: the true camera and accelerometer of one device."""

    device: int
    map: int
    camera: str
    K: Flat9
    """True intrinsics without the errors of a shot."""
    distortion: Five | None
    R_cam_rig: Flat9
    offset_m: Triple
    tilt_error_deg: tuple[float, float] | None
    """Constant errors of the accelerometer on tilt_x and tilt_y; None for an IMU."""


class MapTruthRow(Settings):
    """A row of truth_map.parquet: one LED of one map as built."""

    map: int
    led: int
    position_m: Triple
    size_m: float
    """Radius of a disc, side of a square."""
    gradient: tuple[float, float]
    """Relative change of luminance from the centre to the rim along x and y."""


class FrameRecord(Settings):
    """One finished frame: its row in both tables. A line of journal.jsonl."""

    device: FrameRow
    truth: TruthRow

    @property
    def frame(self) -> int:
        """Number of the frame."""
        return self.device.frame

    def with_digest(self, sha256: str) -> "FrameRecord":
        """The record with the digest of its file."""
        return self.model_copy(update={"device": self.device.model_copy(update={"sha256": sha256})})


_SCALARS = {int: pa.int64(), float: pa.float64(), str: pa.string(), bool: pa.bool_()}


def arrow_schema(row: type[Settings]) -> pa.Schema:
    """The Arrow schema of a table whose rows are this model.

    Numbers have 64 bits, a tuple of fixed length is a fixed-size list, a tuple of any length a list, a model a struct.
    Raises TypeError for a field of any other type.
    """
    return pa.schema([(name, _arrow_type(field.annotation)) for name, field in row.model_fields.items()])


def _arrow_type(annotation: Any) -> pa.DataType:
    if annotation in _SCALARS:
        return _SCALARS[annotation]
    if isinstance(annotation, type) and issubclass(annotation, Settings):
        return pa.struct(list(arrow_schema(annotation)))
    arguments = get_args(annotation)
    if get_origin(annotation) in (Union, UnionType):
        (present,) = (argument for argument in arguments if argument is not NoneType)
        return _arrow_type(present)
    if get_origin(annotation) is tuple:
        item = _arrow_type(arguments[0])
        return pa.list_(item) if arguments[1:] == (Ellipsis,) else pa.list_(item, len(arguments))
    raise TypeError(f"{annotation}: has no Arrow type here")


FRAMES_SCHEMA = arrow_schema(FrameRow)
TRUTH_SCHEMA = arrow_schema(TruthRow)


class CameraUncertainty(Settings):
    """Standard deviations of a camera's errors, as dataset.json states them."""

    parameters: tuple[str, ...]
    device_sigma: Seven
    shot_sigma: Seven
    offset_sigma_m: float
    rotation_sigma_deg: float


class CameraEntry(Settings):
    """A camera in dataset.json."""

    width_px: int
    height_px: int
    K: Matrix
    pixel_pitch_um: float
    focal_length_mm: float
    image_distance_mm: float
    f_number: float
    projection: Literal["perspective", "equidistant"]
    distortion: Distortion | None
    focus_distance_m: float | Literal["infinity"] | None
    psf: Literal["none", "diffraction", "measured"]
    psf_wavelength_nm: float
    psf_kernel: tuple[tuple[float, ...], ...] | None
    shutter: Shutter
    R_cam_rig: Matrix
    offset_m: Triple
    uncertainty: CameraUncertainty | None


class SensorEntry(Settings):
    """The sensor in dataset.json: parameters in effect at the ISO, temperature and noise mode of the frames."""

    bits: int
    gain_e_per_dn: float
    full_well_e: float
    black_level_dn: int
    noise: str
    crosstalk: float
    hot_pixel_share: float
    hot_pixel_e_s: float
    prnu: float
    dark_current_e_s: float
    dsnu_e: float
    read_noise_e: float
    adc_noise_dn: float
    row_offset_e: float
    column_offset_e: float
    mosaic: str


class AccelerometerEntry(Settings):
    """The accelerometer in dataset.json."""

    kind: Literal["tilt-error", "imu"]
    error_deg: float
    device_error_deg: float | None
    shot_error_deg: float | None


class GyroscopeEntry(Settings):
    """The gyroscope in dataset.json: standard deviations about each axis."""

    noise_rad_s: float
    bias_rad_s: float


class DiscEntry(Settings):
    """A round LED in dataset.json: the data that it broadcasts about itself."""

    id: int
    position_m: Triple
    shape: Literal["disc"]
    radius_m: float
    luminaire: int | None
    sigma_m: Triple | None
    radius_sigma_m: float | None
    gradient_sigma: float | None


class SquareEntry(Settings):
    """A square LED in dataset.json, sides along x and y: the data that it broadcasts about itself."""

    id: int
    position_m: Triple
    shape: Literal["square"]
    side_m: float
    luminaire: int | None
    sigma_m: Triple | None
    side_sigma_m: float | None
    gradient_sigma: float | None


LedMapEntry = Annotated[DiscEntry | SquareEntry, Field(discriminator="shape")]


class LuminaireEntry(Settings):
    """A luminaire in dataset.json: a panel, or a single LED."""

    id: int
    position_m: Triple
    sigma_m: Triple
    sigma_rotation_deg: Triple


class MapDatumEntry(Settings):
    """Standard deviations of the map as a whole in dataset.json."""

    sigma_m: Triple
    scale_sigma_ppm: float


class DatasetFile(Settings):
    """dataset.json."""

    format: Literal["vlcrender-dataset"]
    version: Literal[4]
    name: str
    frame_count: int
    cameras: dict[str, CameraEntry]
    sensor: SensorEntry
    accelerometer: AccelerometerEntry
    gyroscope: GyroscopeEntry | None
    led_map: tuple[LedMapEntry, ...] | None
    """None where devices know of LEDs only what the LEDs send."""
    luminaires: tuple[LuminaireEntry, ...]
    map_datum: MapDatumEntry | None
    downlink: DownlinkEntry | None
    room_m: Triple
    provenance: dict[str, Any]


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
