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
from vlcrender.config.toml_model import Settings
from vlcrender.scene.leds import Leds

FORMAT_VERSION: Final = 4
"""`version` of dataset.json."""
DATA_VERSION = 1
"""`data_version` of the provenance: raised whenever the same recipe gives other bits."""

Triple = tuple[float, float, float]
Matrix = tuple[Triple, Triple, Triple]
Flat9 = tuple[float, float, float, float, float, float, float, float, float]
"""A 3 x 3 matrix, row by row."""


def flat9(matrix: NDArray[np.float64]) -> Flat9:
    """A 3 x 3 matrix, row by row."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix.tolist()
    return xx, xy, xz, yx, yy, yz, zx, zy, zz


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
    pose: int
    file: str
    """Path below the dataset, with `/`."""
    sha256: str
    """Digest of that file, 64 hex digits."""
    camera: str
    exposure_s: float
    capturable: bool
    """Whether every region of the frame lies on the sensor."""
    accelerometer_m_s2: Triple
    """Reading at mid-exposure in the axes of this frame's camera."""
    spots: tuple[SpotRow, ...]


class LedTruth(Settings):
    """The true image of one LED that lights at least one pixel of a frame."""

    led: int
    """LED id."""
    u_px: float
    """Image of the LED's centre, exact."""
    v_px: float
    visible_fraction: float
    """Share of the LED's image that falls on the sensor."""


class TruthRow(Settings):
    """A row of truth.parquet: the pose of one frame and what follows from it."""

    frame: int
    shot: int
    position_m: Triple
    """Projection centre of this frame's camera, world."""
    R_cam_world: Flat9
    tilt_x_deg: float
    tilt_y_deg: float
    yaw_deg: float
    leds: tuple[LedTruth, ...]
    bound_m2: Flat9 | None
    """Cramér-Rao bound of the position."""


class FrameRecord(Settings):
    """One finished frame: its row in both tables. A line of journal.jsonl."""

    device: FrameRow
    truth: TruthRow

    @property
    def frame(self) -> int:
        """Number of the frame."""
        return self.device.frame


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
    R_cam_rig: Matrix
    offset_m: Triple


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


class DiscEntry(Settings):
    """A round LED in dataset.json: the data that it broadcasts about itself."""

    id: int
    position_m: Triple
    shape: Literal["disc"]
    radius_m: float


class SquareEntry(Settings):
    """A square LED in dataset.json, sides along x and y: the data that it broadcasts about itself."""

    id: int
    position_m: Triple
    shape: Literal["square"]
    side_m: float


LedMapEntry = Annotated[DiscEntry | SquareEntry, Field(discriminator="shape")]


class DatasetFile(Settings):
    """dataset.json."""

    format: Literal["vlcrender-dataset"]
    version: Literal[4]
    name: str
    frame_count: int
    cameras: dict[str, CameraEntry]
    sensor: SensorEntry
    accelerometer: AccelerometerEntry
    led_map: tuple[LedMapEntry, ...]
    room_m: Triple
    provenance: dict[str, Any]


def camera_entry(mounted: Mounted) -> CameraEntry:
    """The entry of a camera on a rig."""
    arrays = {"K": mounted.camera.matrix, "R_cam_rig": mounted.rotation, "offset_m": mounted.offset_m}
    own = {"image_distance_mm": mounted.camera.image_distance_mm, **{key: a.tolist() for key, a in arrays.items()}}
    shared = mounted.camera.model_dump(include=set(CameraEntry.model_fields) - set(own))
    return CameraEntry.model_validate({**shared, **own})


def led_map(leds: Leds) -> tuple[DiscEntry | SquareEntry, ...]:
    """The entries of all LEDs, in the order of the scene."""
    entries: list[DiscEntry | SquareEntry] = []
    for led, center, half_width, square in zip(leds.ids, leds.centers_m, leds.half_widths_m, leds.squares, strict=True):
        x, y, z = map(float, center)
        if square:
            entries.append(SquareEntry(id=int(led), position_m=(x, y, z), shape="square", side_m=2 * float(half_width)))
        else:
            entries.append(DiscEntry(id=int(led), position_m=(x, y, z), shape="disc", radius_m=float(half_width)))
    return tuple(entries)
