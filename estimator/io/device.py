"""Device knowledge: camera, sensor, accelerometer, LED map, and a frame with all of them (datasets/FORMAT.md)."""

import json
import math
from abc import abstractmethod
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, Strict, ValidationError, field_validator, model_validator

from estimator.errors import InputError
from estimator.io.downlink import Downlink, downlink_problem, spots_problem
from estimator.io.records import (
    INT64_MAX,
    LedId,
    NotNegative,
    NotNegativeTriple,
    Number,
    Positive,
    Row,
    Triple,
    first_problem,
)
from estimator.io.shared import SharedResults
from estimator.io.shutter import GLOBAL, Gyroscope, Shutter

Floats = NDArray[np.float64]
T = TypeVar("T")

MAX_SENSOR_AREAS = 16
"""Upper limit of the pixels in all regions of a frame, in sensor areas; regions may extend beyond the sensor."""
# Pixels within this many standard deviations of the full well count as possibly full.
FULL_SIGMA = 4.0
DeviceNumber = Annotated[int, Field(ge=0, le=INT64_MAX)]
# Within 1000 km of the origin: any range to an LED, even a wrong one, can then be written.
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]


def normalized(pixels: Floats, K: Floats) -> Floats:
    """Normalized image coordinates (n, 2), `K^-1 [u, v, 1]`, in units of the image distance, of pixels (n, 2)."""
    return np.asarray((np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T)[:, :2])


def to_pixels(image: Floats, K: Floats) -> Floats:
    """Pixels (n, 2), `K [x, y, 1]`, of normalized image coordinates (n, 2): the inverse of `normalized`."""
    return np.asarray(image @ K[:2, :2].T + K[:2, 2])


class Distortion(Row):
    """Brown-Conrady coefficients in OpenCV's convention, for normalized image coordinates.

    Other keys are refused: without a coefficient of the calibration, undistorted pixels would be wrong.
    """

    k1: Number
    k2: Number
    k3: Number
    p1: Number
    p2: Number

    @model_validator(mode="before")
    @classmethod
    def _no_other_coefficients(cls, entry: Any) -> Any:
        if isinstance(entry, Mapping) and (unknown := [key for key in entry if key not in cls.model_fields]):
            raise ValueError(f"unknown key {unknown[0]!r}; allowed: {', '.join(cls.model_fields)}")
        return entry


IntrinsicName = Literal["focal", "aspect", "cx_px", "cy_px", "k1", "p1", "p2"]
INTRINSICS: tuple[IntrinsicName, ...] = ("focal", "aspect", "cx_px", "cy_px", "k1", "p1", "p2")
"""Names of the errors of a camera's intrinsics, in the order of all arrays of them.

True from stated: fx (1 + focal) (1 + aspect / 2), fy (1 + focal) (1 - aspect / 2), cx + cx_px, cy + cy_px, and the
coefficients of distortion plus k1, p1, p2. `focal` and `aspect` are relative, cx_px and cy_px in pixels.
"""


class CameraUncertainty(Row):
    """Standard deviations of the stated intrinsics and mounting of a camera; keys as in dataset.json.

    The errors are independent and normal. Those of `device_sigma` are the same in every frame of a device, those of
    `shot_sigma` new in every frame. `offset_sigma_m` and `rotation_sigma_deg` are those of the mounting on the rig,
    along and about each axis.
    """

    parameters: tuple[IntrinsicName, ...]
    device_sigma: tuple[NotNegative, ...]
    shot_sigma: tuple[NotNegative, ...]
    offset_sigma_m: NotNegative
    rotation_sigma_deg: NotNegative

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        if len(set(self.parameters)) != len(self.parameters):
            raise ValueError("parameters have to be unique")
        if not len(self.parameters) == len(self.device_sigma) == len(self.shot_sigma):
            raise ValueError("device_sigma and shot_sigma need one number for each of parameters")
        return self

    def device_sigmas(self) -> Floats:
        """Standard deviations (7,) of the errors of a device, in the order of INTRINSICS; 0 where there is no entry."""
        return self._in_order(self.device_sigma)

    def shot_sigmas(self) -> Floats:
        """Standard deviations (7,) of the errors of a frame, in the order of INTRINSICS; 0 where there is no entry."""
        return self._in_order(self.shot_sigma)

    def _in_order(self, sigmas: tuple[float, ...]) -> Floats:
        stated: dict[str, float] = dict(zip(self.parameters, sigmas, strict=True))
        return np.array([stated.get(name, 0.0) for name in INTRINSICS])


class Camera(Row):
    """Camera of a device: intrinsics, lens, and mounting on the rig; keys as in dataset.json.

    `K` maps normalized image coordinates to continuous pixels with pixel centres at +0.5. `uncertainty` is None where
    the device does not state how well it knows its camera; deviations of 0 state that the camera is exact.
    """

    width_px: int = Field(ge=1, le=65536)
    height_px: int = Field(ge=1, le=65536)
    K: tuple[Triple, Triple, Triple]
    pixel_pitch_um: Positive
    focal_length_mm: Positive
    image_distance_mm: Positive
    f_number: Positive
    projection: Literal["perspective", "equidistant"]
    distortion: Distortion | None
    focus_distance_m: Positive | Literal["infinity"] | None
    psf: Literal["none", "diffraction", "measured"]
    psf_wavelength_nm: Positive
    psf_kernel: tuple[tuple[Number, ...], ...] | None
    R_cam_rig: tuple[Triple, Triple, Triple]
    offset_m: Triple
    uncertainty: CameraUncertainty | None = None
    shutter: Shutter = GLOBAL

    @field_validator("K")
    @classmethod
    def _upper_triangular(cls, k: tuple[Triple, Triple, Triple]) -> tuple[Triple, Triple, Triple]:
        if k[0][0] <= 0 or k[1][1] <= 0 or k[1][0] != 0 or k[2] != (0.0, 0.0, 1.0):
            raise ValueError("K has to be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0")
        return k

    @model_validator(mode="after")
    def _no_distortion_of_a_fish_eye(self) -> Self:
        if self.projection == "equidistant" and self.distortion is not None:
            raise ValueError('distortion has to be null with projection "equidistant"')
        if self.projection == "equidistant" and self.uncertainty is not None:
            of_distortion = [INTRINSICS.index(name) for name in ("k1", "p1", "p2")]
            if (self.uncertainty.device_sigmas() + self.uncertainty.shot_sigmas())[of_distortion].any():
                raise ValueError('sigmas of k1, p1 and p2 have to be 0 with projection "equidistant"')
        return self

    @property
    def states_no_errors(self) -> bool:
        """Whether the device states no error of the intrinsics: that they are exact, or nothing of them."""
        stated = self.uncertainty
        return stated is None or not any((*stated.device_sigma, *stated.shot_sigma))

    def matrix(self) -> Floats:
        """`K` as a (3, 3) array, pixels."""
        return np.array(self.K, dtype=np.float64)

    def normalized(self, pixels: Floats) -> Floats:
        """Normalized image coordinates (n, 2) of this camera's pixels (n, 2)."""
        return normalized(pixels, self.matrix())

    def to_pixels(self, image: Floats) -> Floats:
        """This camera's pixels (n, 2) of normalized image coordinates (n, 2)."""
        return to_pixels(image, self.matrix())

    @property
    def pixel_angle_rad(self) -> float:
        """Angle of one pixel on the optical axis, 1 / fx, radians."""
        return 1 / self.K[0][0]

    @property
    def line_count(self) -> int:
        """Lines that the shutter reads: rows of the sensor, or columns."""
        return self.shutter.line_count(self.width_px, self.height_px)

    def line_of(self, u_px: Floats, v_px: Floats) -> Floats:
        """Continuous line coordinates, in readout order, of pixels (u, v) of any shape: line i is from i to i + 1."""
        return self.shutter.line_of(u_px, v_px, self.width_px, self.height_px)

    def times_s(self, u_px: Floats, v_px: Floats) -> Floats:
        """Middle of the exposure of pixels (u, v) of any shape, relative to the frame's middle line, seconds."""
        return (self.line_of(u_px, v_px) - self.line_count / 2) * self.shutter.row_time_s

    def R_cam_rig_array(self) -> Floats:
        """`R_cam_rig` as a (3, 3) array."""
        return np.array(self.R_cam_rig, dtype=np.float64)


class Sensor(Row):
    """Sensor of a device; keys as in dataset.json: `dn = round(min(e, full_well_e) / gain_e_per_dn) + black_level_dn`.

    Gain and full well are None where the device does not know them, as of a photograph: electrons are then digital
    numbers. Noise other than shot noise is given by standard deviations, as in a data sheet. `crosstalk` is the share
    of a pixel's electrons that its four neighbours collect, a quarter each.
    """

    bits: int = Field(ge=1, le=32)
    gain_e_per_dn: Positive | None
    full_well_e: Positive | None
    black_level_dn: float = Field(ge=0, le=2**32)
    noise: Literal["shot", "none", "full"]
    crosstalk: float = Field(default=0.0, ge=0, le=1)
    prnu: NotNegative
    dark_current_e_s: NotNegative
    dsnu_e: NotNegative
    read_noise_e: NotNegative
    adc_noise_dn: NotNegative
    row_offset_e: NotNegative
    column_offset_e: NotNegative
    mosaic: str

    @property
    def gain(self) -> float:
        """Electrons a digital number; 1 where the device does not state them."""
        return 1.0 if self.gain_e_per_dn is None else self.gain_e_per_dn

    def _well_dn(self) -> float:
        """Digital number at the full well, infinite where the device does not state it."""
        full_e = np.inf if self.full_well_e is None else self.full_well_e
        return float(np.rint(full_e / self.gain)) + self.black_level_dn

    def saturation_dn(self) -> float:
        """Digital number of a saturated pixel: at the full well, or the ADC's last code if that is lower."""
        return min(2.0**self.bits - 1, self._well_dn())

    def clipping_dn(self) -> float:
        """Lowest digital number that a saturated pixel may have.

        It is FULL_SIGMA standard deviations below the full well, of all noise that is added after clipping. The ADC's
        last code needs no such margin: a pixel that reads less has not reached it.
        """
        added_e = math.hypot(self.read_noise_e, self.row_offset_e, self.column_offset_e)
        spread_dn = math.hypot(added_e / self.gain, self.adc_noise_dn)
        return min(2.0**self.bits - 1, self._well_dn() - FULL_SIGMA * spread_dn)

    def floor_e2(self) -> float:
        """Signal-independent variance of a pixel, electrons squared.

        Offsets of whole rows and columns are left out: subtracting a spot's local background removes most of them.
        """
        added = self.dsnu_e**2 + self.read_noise_e**2 + (self.adc_noise_dn * self.gain) ** 2
        return added + self.rounding_e2()

    def rounding_e2(self) -> float:
        """Variance of the ADC's rounding, electrons squared; 0 where whole electrons are counted."""
        return self.gain**2 / 12 if self.noise == "full" or self.gain != 1 else 0.0


class Luminaire(Row):
    """Luminaire of the map: LEDs whose errors of position are common; keys as in dataset.json.

    Its LEDs are shifted together by an error of standard deviation `sigma_m` along x, y, z, and turned together about
    `position_m`, the mean of their positions, by one of `sigma_rotation_deg` about x, y, z.
    """

    id: LedId
    position_m: Annotated[tuple[Coordinate, Coordinate, Coordinate], Strict(False)]
    sigma_m: NotNegativeTriple
    sigma_rotation_deg: NotNegativeTriple

    def sigmas(self) -> Floats:
        """Standard deviations (6,) of the shift along x, y, z, metres, and of the rotation about them, radians."""
        return np.array([*self.sigma_m, *np.radians(self.sigma_rotation_deg)])


class MapDatum(Row):
    """Standard deviations of the map's origin, along x, y, z, and of its scale about the origin, parts per million."""

    sigma_m: NotNegativeTriple
    scale_sigma_ppm: NotNegative

    def sigmas(self) -> Floats:
        """Standard deviations (4,) of the shift along x, y, z, metres, and of the relative scale."""
        return np.array([*self.sigma_m, 1e-6 * self.scale_sigma_ppm])


class Led(Row):
    """LED of the map: identity, and centre of its horizontal face, world metres. See `DiscLed`, `SquareLed`.

    `luminaire` is the id of its luminaire, None for none. Standard deviations are None where the device does not state
    them: `sigma_m` of the position within the luminaire along x, y, z; `gradient_sigma` of gx and of gy, where the
    luminance is L (1 + gx x / r + gy y / r) over a face of half width r.
    """

    id: LedId
    position_m: Annotated[tuple[Coordinate, Coordinate, Coordinate], Strict(False)]
    shape: str
    luminaire: LedId | None = None
    sigma_m: NotNegativeTriple | None = None
    gradient_sigma: NotNegative | None = None

    @property
    def has_size(self) -> bool:
        """Whether the map says how large the LED is."""
        return True

    @property
    @abstractmethod
    def half_width_m(self) -> float:
        """Radius of a disc, half the side of a square, metres; NaN where the map does not say it."""

    @property
    @abstractmethod
    def size_sigma_m(self) -> float | None:
        """Standard deviation of the half width, metres; None where the device does not state it."""

    @property
    @abstractmethod
    def mean_square_extent_m2(self) -> float:
        """Mean of x^2 over the face, x measured from the centre along any direction of the face, m^2.

        0, that of a point, where the map does not say the size.
        """

    @property
    def states_errors(self) -> bool:
        """Whether the device states a standard deviation of the position, the size or the gradient."""
        return not (self.sigma_m is None and self.size_sigma_m is None and self.gradient_sigma is None)

    @property
    def shift_by_gradient_m(self) -> float:
        """Shift s^2 / r of the centre of the light by a gradient of 1, with the mean square extent s^2, metres."""
        return self.mean_square_extent_m2 / self.half_width_m if self.has_size else 0.0

    def sigmas(self) -> Floats:
        """Standard deviations (6,) of the position along x, y, z and of the half width, metres, and of gx and gy.

        What the device does not state counts as exact: 0.
        """
        gradient = self.gradient_sigma or 0.0
        return np.array([*(self.sigma_m or (0.0, 0.0, 0.0)), self.size_sigma_m or 0.0, gradient, gradient])

    def light_sigmas_m(self) -> Floats:
        """Standard deviations (3,) of the centre of the light within the luminaire along x, y, z, metres.

        They hold those of the position and of the shift by a gradient.
        """
        sigmas = self.sigmas()
        return np.hypot(sigmas[:3], [*(sigmas[4:] * self.shift_by_gradient_m), 0.0])


class DiscLed(Led):
    """Disc of radius `radius_m`, of standard deviation `radius_sigma_m`; None where the map does not say the radius."""

    shape: Literal["disc"] = "disc"
    radius_m: Positive | None
    radius_sigma_m: NotNegative | None = None

    @model_validator(mode="before")
    @classmethod
    def _has_no_side(cls, entry: Any) -> Any:
        return _without_key(entry, "side_m", "a disc has radius_m, not side_m")

    @property
    def size_sigma_m(self) -> float | None:
        """Standard deviation of the half width, metres."""
        return self.radius_sigma_m

    @property
    def has_size(self) -> bool:
        """Whether the radius is known."""
        return self.radius_m is not None

    @property
    def half_width_m(self) -> float:
        """The radius, metres; NaN where it is not known."""
        return np.nan if self.radius_m is None else self.radius_m

    @property
    def mean_square_extent_m2(self) -> float:
        """A quarter of the radius squared, m^2; 0 where it is not known."""
        return 0.0 if self.radius_m is None else self.radius_m**2 / 4


class SquareLed(Led):
    """Square of side `side_m`, of standard deviation `side_sigma_m`; its sides are along x and y of the world."""

    shape: Literal["square"] = "square"
    side_m: Positive
    side_sigma_m: NotNegative | None = None

    @model_validator(mode="before")
    @classmethod
    def _has_no_radius(cls, entry: Any) -> Any:
        return _without_key(entry, "radius_m", "a square has side_m (the whole side), not radius_m")

    @property
    def size_sigma_m(self) -> float | None:
        """Standard deviation of the half width, metres."""
        return None if self.side_sigma_m is None else self.side_sigma_m / 2

    @property
    def half_width_m(self) -> float:
        """Half the side, metres."""
        return self.side_m / 2

    @property
    def mean_square_extent_m2(self) -> float:
        """A twelfth of the side squared, m^2."""
        return self.side_m**2 / 12


def _without_key(entry: Any, key: str, message: str) -> Any:
    if isinstance(entry, Mapping) and key in entry:
        raise ValueError(message)
    return entry


AnyLed = Annotated[DiscLed | SquareLed, Field(discriminator="shape")]
"""An entry of `led_map`, told apart by `shape`."""


def leds_by_id(leds: Iterable[AnyLed]) -> dict[int, AnyLed]:
    """LEDs by id; raises ValueError for an id that occurs twice."""
    entries = list(leds)
    mapped = {led.id: led for led in entries}
    if len(mapped) != len(entries):
        raise ValueError("LED ids have to be unique")
    return mapped


def luminaires_by_id(luminaires: Iterable[Luminaire], leds: Iterable[Led]) -> dict[int, Luminaire]:
    """Luminaires by id; raises ValueError for an id that occurs twice, and for one that an LED names and is missing.

    Without any luminaires, which states nothing of them, LEDs may still say which of them belong together.
    """
    entries = list(luminaires)
    mapped = {luminaire.id: luminaire for luminaire in entries}
    if len(mapped) != len(entries):
        raise ValueError("luminaire ids have to be unique")
    for led in leds:
        if mapped and led.luminaire is not None and led.luminaire not in mapped:
            raise ValueError(f"LED {led.id} names luminaire {led.luminaire}, which is not in luminaires")
    return mapped


class DecodedSpot(Row):
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


class Identity(Row):
    """What a receiver decoded of an LED image: the LED, None if none was accepted, and the image's centre.

    `correlation` is that of the image's lines with the decoded wave, `bits` the chips of one period as the lines show
    them ("-" where not seen), and `position_m` the LED's, where a packet told it and the map is null.
    """

    led: LedId | None
    u_px: Number
    v_px: Number
    correlation: float = Field(ge=-1.001, le=1.001)
    bits: str | None = None
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


class Accelerometer(Row):
    """Error of the accelerometer as the device knows it, degrees, one standard deviation.

    Of kind "tilt-error" it is the error of each tilt; of kind "imu" the error of the direction of gravity, along each
    of two perpendicular axes. `device_error_deg` is the part of it that is the same in every frame of a device, and
    `shot_error_deg` the part that is new in every frame; None where the device does not state them.
    """

    kind: Literal["tilt-error", "imu"]
    error_deg: NotNegative
    device_error_deg: NotNegative | None = None
    shot_error_deg: NotNegative | None = None


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


def regions_problem(regions: Sequence[NDArray[np.int64]], camera: Camera) -> str | None:
    """What is wrong with a frame's regions of interest, None if nothing: two overlap, or they hold too many pixels."""
    for index, region in enumerate(regions[1:], start=1):
        before = np.array(regions[:index])
        if ((region[0] <= before[:, 1]) & (before[:, 0] <= region[1])).all(axis=1).any():
            return f"region {region.tolist()} overlaps another"
    pixels = sum(int((region[1] - region[0] + 1).prod()) for region in regions)
    if pixels > MAX_SENSOR_AREAS * camera.width_px * camera.height_px:
        return f"{pixels} pixels, more than {MAX_SENSOR_AREAS} times the sensor's"
    return None


def depth_problem(parts: Sequence[Part], sensor: Sensor) -> str | None:
    """What is wrong with a frame's digital numbers, None if nothing: one exceeds the sensor's bits."""
    max_dn, limit = max(int(part.image_dn.max()) for part in parts), 2**sensor.bits - 1
    return f"digital number {max_dn}, but {sensor.bits} bits end at {limit}" if max_dn > limit else None
