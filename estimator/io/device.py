"""Device knowledge: accelerometer, decoded identities, a frame with all that a device knows (datasets/FORMAT.md)."""

import json
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, Strict, ValidationError

from estimator.errors import InputError
from estimator.io.camera import Camera
from estimator.io.downlink import Downlink, downlink_problem, spots_problem
from estimator.io.led_map import (
    AnyLed,
    DeviceNumber,
    Led,
    Luminaire,
    MapDatum,
    leds_by_id,
    luminaires_by_id,
)
from estimator.io.records import (
    INT64_MAX,
    Entry,
    LedId,
    Number,
    Positive,
    Row,
    Triple,
    first_problem,
    small_row,
)
from estimator.io.sensor import Sensor
from estimator.io.shared import SharedResults
from estimator.io.shutter import Gyroscope

Floats = NDArray[np.float64]
T = TypeVar("T")
MAX_SENSOR_AREAS = 16
"""Upper limit of the pixels in all regions of a frame, in sensor areas; regions may extend beyond the sensor."""


@small_row
class DecodedSpot:
    """Decoded identity: the LED that a demodulator reports near this pixel. The pixel is rough, not a centroid."""

    led: LedId
    u_px: Number
    v_px: Number


def decoding_problem(spots: Sequence[DecodedSpot], leds: Mapping[int, Led]) -> str | None:
    """What is wrong with a frame's decoded identities, None if nothing: an LED decoded twice, or not in `led_map`."""
    decoded = [spot.led for spot in spots]
    if len(set(decoded)) != len(decoded):
        return "an LED is decoded twice in spots"
    if unknown := set(decoded) - leds.keys():
        return f"spots name LED {min(unknown)}, which is not in led_map"
    return None


@small_row
class Identity:
    """What a receiver decoded of an LED image: the LED, None if none was accepted, and the image's centre.

    `correlation` is that of the image's lines with the decoded wave, `bits` the chips of one period as the lines show
    them ("-" where not seen), and `position_m` the LED's, where a packet told it and the map is null.
    """

    led: LedId | None
    u_px: Number
    v_px: Number
    correlation: Annotated[float, Field(ge=-1.001, le=1.001), Strict()]
    bits: Annotated[str, Strict()] | None = None
    position_m: Triple | None = None


def gyro_problem(reading_rad_s: Sequence[float] | None, gyroscope: Gyroscope | None) -> str | None:
    """What is wrong with a frame's reading of the gyroscope, None if nothing: a reading without a gyroscope."""
    return "gyro_rad_s is given, but gyroscope is null" if reading_rad_s is not None and gyroscope is None else None


def gravity_problem(reading_m_s2: Sequence[float] | None, accelerometer: "Accelerometer | None") -> str | None:
    """What is wrong with a frame's reading of the accelerometer, None if nothing: one of the two without the other."""
    if reading_m_s2 is not None and accelerometer is None:
        return "accelerometer_m_s2 is given, but accelerometer is null"
    if reading_m_s2 is None and accelerometer is not None:
        return "accelerometer_m_s2 is null, but accelerometer is given"
    return None


TiltSigma = Annotated[float, Field(ge=0, le=180)]
"""Degrees."""


class Accelerometer(Entry):
    """Error of the accelerometer as the device knows it, degrees, one standard deviation.

    Of kind "tilt-error" it is the error of each tilt; of kind "imu" the error of the direction of gravity, along each
    of two perpendicular axes. `device_error_deg` is the part of it that is the same in every frame of a device, and
    `shot_error_deg` the part that is new in every frame; None where the device does not state them.
    """

    kind: Literal["tilt-error", "imu"]
    error_deg: TiltSigma
    device_error_deg: TiltSigma | None = None
    shot_error_deg: TiltSigma | None = None


@dataclass(frozen=True, eq=False)
class Part:
    """Region of interest that was read out: `image_dn` (rows, columns) uint32, digital numbers, row 0 at the top.

    Its first pixel is pixel (row, column) of the sensor.
    """

    row: int
    column: int
    image_dn: NDArray[np.uint32]


class LineGains(Protocol):
    """Gain of an LED at each line of the sensor: the mean of its wave, of mean 1, over the line's exposure."""

    def __call__(self, lines: Floats) -> Floats:
        """Gains (n,) at lines (n,), counted in readout order from 0 on; between two whole lines too."""
        ...


@dataclass(frozen=True, eq=False)
class DeviceFrame:
    """A frame as the device has it: the regions read out (one for a full frame), and all that the device knows.

    `accelerometer_m_s2` is the reading in the axes of this frame's camera, None without an accelerometer; `spots` are
    decoded identities; `leds` is the LED map by id.
    """

    parts: tuple[Part, ...]
    camera: Camera
    sensor: Sensor
    accelerometer_m_s2: tuple[float, float, float] | None
    accelerometer: Accelerometer | None
    exposure_s: float
    spots: tuple[DecodedSpot, ...]
    leds: Mapping[int, Led]
    other_cameras: "tuple[DeviceFrame, ...]" = ()
    """Frames of the rig's other cameras of the same shot; their own `other_cameras` are empty."""
    luminaires: Mapping[int, Luminaire] = field(default_factory=dict)
    """Luminaires by id; empty where the device does not state how well it knows the map."""
    map_datum: MapDatum | None = None
    """Accuracy of the map's origin and scale; None where the device does not state it."""
    device: int = 0
    """Number of the device in its dataset: frames of one device share the errors of its camera and accelerometer."""
    burst: int = 0
    """Number of the burst: frames of a burst are taken one after another by a device that hardly moves."""
    start_s: float = 0.0
    """Start of the exposure of the first line that is read, seconds on the rig's clock."""
    gyro_rad_s: tuple[float, float, float] | None = None
    """Angular velocity as the gyroscope reads it, camera axes, mean over the readout; None without a reading."""
    gyroscope: Gyroscope | None = None
    """Errors of the gyroscope; None without one."""
    downlink: Downlink | None = None
    """What the LEDs send; None where the device cannot receive."""
    identities: tuple[Identity, ...] | None = None
    """What a receiver decoded; None where it has not been asked."""
    gains: Mapping[int, LineGains] = field(default_factory=dict)
    """Gain of an LED, by id, at each line, as its signal was decoded; see `unknown_gains` for one without an entry."""
    shared: SharedResults | None = None
    """Results that the variants of the frame share; None where each computes its own."""

    @property
    def unknown_gains(self) -> frozenset[int]:
        """LEDs of the map whose light may have other gains at each line, and is without an entry in `gains`.

        All others are steady for the pixels of an image: they do not send, or the shutter is global. Packets do not
        say beforehand which LEDs send them.
        """
        if self.downlink is None or not self.camera.shutter.rolls:
            return frozenset()
        sending = self.leds.keys() if self.downlink.sends_packets else self.downlink.leds
        return frozenset(sending - self.gains.keys())

    def once(self, key: tuple[Hashable, ...], compute: Callable[[], T]) -> T:
        """Result of a computation on the frame's images, once for all variants; raises its EstimationFailure.

        `key` names the computation and holds all that it uses beside `parts`, `camera` and `sensor`.
        """
        if self.shared is None:
            return compute()
        return self.shared.once((self.parts, self.camera, self.sensor, *key), compute)

    def electrons(self, part: Part) -> NDArray[np.float32]:
        """Electrons above the black level of a part, (rows, columns)."""
        image = part.image_dn.astype(np.float32)
        if self.sensor.black_level_dn != 0:
            image -= np.float32(self.sensor.black_level_dn)
        if self.sensor.gain != 1:
            image *= np.float32(self.sensor.gain)
        return image

    def clipped(self, part: Part) -> NDArray[np.bool_]:
        """Pixels of a part, (rows, columns), that are or may be saturated, so that their electrons are unknown."""
        # Compare with an integer: a float would convert the whole image.
        return part.image_dn >= int(np.ceil(self.sensor.clipping_dn()))


class _Record(Row):
    """A frame record without its images."""

    camera: Camera
    sensor: Sensor
    accelerometer: Accelerometer | None
    led_map: tuple[AnyLed, ...] | None
    exposure_s: Positive
    accelerometer_m_s2: Triple | None
    spots: tuple[DecodedSpot, ...]
    luminaires: tuple[Luminaire, ...] = ()
    map_datum: MapDatum | None = None
    device: DeviceNumber = 0
    burst: int = Field(default=0, ge=0, le=INT64_MAX)
    start_s: Number = 0.0
    gyro_rad_s: Triple | None = None
    gyroscope: Gyroscope | None = None
    downlink: Downlink | None = None


class _Origin(Row):
    """First pixel of a part."""

    row: int = Field(ge=-INT64_MAX, le=INT64_MAX)
    column: int = Field(ge=-INT64_MAX, le=INT64_MAX)


def frame(record: Mapping[str, Any]) -> DeviceFrame:
    """Make a frame from a mapping in the vocabulary of datasets/FORMAT.md.

    Parameters
    ----------
    record
        `camera`, `sensor`, `accelerometer` and `led_map` as in dataset.json; `exposure_s` (s), `accelerometer_m_s2`
        (x, y, z in camera axes, m/s^2) and `spots` (`{led, u_px, v_px}`) as in frames.parquet; and `parts`, a sequence
        of `{"row": int, "column": int, "image_dn": array}`, where `image_dn` (rows, columns) uint32 holds digital
        numbers and its first pixel is pixel (row, column) of the sensor. NumPy arrays and scalars may stand for lists
        and numbers. What the device does not state may be missing: `luminaires`, `map_datum`, `device` (0), `burst`
        (0), `start_s` (0), `gyro_rad_s`, `gyroscope`, `downlink`, in `camera`, `accelerometer` and `led_map` the keys
        of standard deviations, in `camera` `shutter` (global), and in `sensor` `crosstalk` (0). Other keys are ignored.

    Returns
    -------
    DeviceFrame
        The frame. The images are copied and read-only.

    Raises
    ------
    InputError
        A key is missing or its value not allowed; the message names the key.
    """
    if not isinstance(record, Mapping):
        raise InputError(f"record: is a {type(record).__name__}, needed a mapping")
    try:
        text = json.dumps({key: record[key] for key in _Record.model_fields if key in record}, default=_plain)
        known = _Record.model_validate_json(text)
        leds = leds_by_id(known.led_map or ())
        luminaires = luminaires_by_id(known.luminaires, leds.values())
    except ValidationError as error:
        raise InputError(f"record: {first_problem(error)}") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"record: {error}") from None
    problem = downlink_problem(known.downlink, None if known.led_map is None else leds.keys())
    problem = problem or gyro_problem(known.gyro_rad_s, known.gyroscope)
    problem = problem or gravity_problem(known.accelerometer_m_s2, known.accelerometer)
    if problem := problem or spots_problem(known.downlink, known.spots) or decoding_problem(known.spots, leds):
        raise InputError(f"record: {problem}")
    return DeviceFrame(
        parts=_parts(record, known.camera, known.sensor),
        camera=known.camera,
        sensor=known.sensor,
        accelerometer_m_s2=known.accelerometer_m_s2,
        accelerometer=known.accelerometer,
        exposure_s=known.exposure_s,
        spots=known.spots,
        leds=leds,
        luminaires=luminaires,
        map_datum=known.map_datum,
        device=known.device,
        burst=known.burst,
        start_s=known.start_s,
        gyro_rad_s=known.gyro_rad_s,
        gyroscope=known.gyroscope,
        downlink=known.downlink,
    )


def _plain(value: object) -> object:
    """A NumPy array or scalar as JSON's lists and numbers; raises TypeError for anything else."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"a {type(value).__name__} is not a value of the format")


def _parts(record: Mapping[str, Any], camera: Camera, sensor: Sensor) -> tuple[Part, ...]:
    entries = record.get("parts")
    if not isinstance(entries, Sequence) or not entries:
        raise InputError("record: parts: needed a sequence of at least one {row, column, image_dn}")
    parts = []
    for index, entry in enumerate(entries):
        where = f"record: parts.{index}"
        if not isinstance(entry, Mapping):
            raise InputError(f"{where}: is a {type(entry).__name__}, needed a mapping")
        try:
            origin = _Origin.model_validate_json(
                json.dumps({key: entry[key] for key in ("row", "column") if key in entry}, default=_plain)
            )
        except ValidationError as error:
            raise InputError(f"{where}.{first_problem(error)}") from None
        except (TypeError, ValueError) as error:
            raise InputError(f"{where}: {error}") from None
        image = entry.get("image_dn")
        if not isinstance(image, np.ndarray) or image.dtype != np.uint32 or image.ndim != 2 or image.size == 0:
            raise InputError(f"{where}.image_dn: needed a uint32 array (rows, columns) that is not empty")
        image = image.copy()
        image.setflags(write=False)
        parts.append(Part(origin.row, origin.column, image))
    if problem := regions_problem([region_of(part) for part in parts], camera) or depth_problem(parts, sensor):
        raise InputError(f"record: parts: {problem}")
    return tuple(parts)


def region_of(part: Part) -> NDArray[np.int64]:
    """First and last pixel of a part, [[column, row], [column, row]]."""
    rows, columns = part.image_dn.shape
    return np.array([[part.column, part.row], [part.column + columns - 1, part.row + rows - 1]], dtype=np.int64)


def regions_problem(regions: Sequence[NDArray[np.int64]] | NDArray[np.int64], camera: Camera) -> str | None:
    """What is wrong with a frame's regions of interest, None if nothing: two overlap, or they hold too many pixels."""
    boxes = np.asarray(regions, dtype=np.int64).reshape(-1, 4)
    left, top, right, bottom = boxes.T.copy()
    for n, (first_u, first_v, last_u, last_v) in enumerate(boxes.tolist()):
        across = (left[:n] <= last_u) & (right[:n] >= first_u)
        if (across & (top[:n] <= last_v) & (bottom[:n] >= first_v)).any():
            return f"region {[[first_u, first_v], [last_u, last_v]]} overlaps another"
    sides = (right - left + 1).tolist(), (bottom - top + 1).tolist()
    pixels = sum(columns * rows for columns, rows in zip(*sides, strict=True))
    if pixels > MAX_SENSOR_AREAS * camera.width_px * camera.height_px:
        return f"{pixels} pixels, more than {MAX_SENSOR_AREAS} times the sensor's"
    return None


def depth_problem(parts: Sequence[Part], sensor: Sensor) -> str | None:
    """What is wrong with a frame's digital numbers, None if nothing: one exceeds the sensor's bits."""
    max_dn, limit = max(int(part.image_dn.max()) for part in parts), 2**sensor.bits - 1
    return f"digital number {max_dn}, but {sensor.bits} bits end at {limit}" if max_dn > limit else None
