"""Pictures: JPEG, PNG, TIFF and DNG files as linear light, and what their EXIF data say.

Pixels are taken as the file stores them: the readout axis and the calibration belong to the sensor, so that an EXIF
orientation is not applied unless asked for. A colour picture becomes grey.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from estimator.errors import InputError
from estimator.io.records import first_line

Pixels = NDArray[np.float32]
Mask = NDArray[np.bool_]
Tone = Literal["srgb", "linear", "gamma"]
Orientation = Literal["stored", "upright"]

RAW_SUFFIXES = (".dng", ".nef", ".cr2", ".arw", ".raf", ".orf", ".rw2")
GAMMA = 2.2
# A JPEG encoder moves a saturated pixel by a few codes.
CLIPPED_OF_8_BITS = 252 / 255
CLIPPED = 0.995
MAX_PIXELS = 400_000_000
# Which axes EXIF's orientations reverse, down and right, after the transposition of those from 5 on.
REVERSED = {1: (0, 0), 2: (0, 1), 3: (1, 1), 4: (1, 0), 5: (0, 0), 6: (0, 1), 7: (1, 1), 8: (1, 0)}


@dataclass(frozen=True)
class Exif:
    """What a picture's metadata say; None for what they do not."""

    exposure_s: float | None = None
    f_number: float | None = None
    focal_length_mm: float | None = None
    focal_length_35mm: float | None = None
    iso: float | None = None
    orientation: int | None = None
    camera: str | None = None


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture in grey: `linear` (rows, columns), light from 0 to 1, and `clipped` (rows, columns).

    `bits` are those of a stored pixel.
    """

    path: Path
    linear: Pixels
    clipped: Mask
    bits: int
    exif: Exif

    @property
    def width_px(self) -> int:
        """Columns."""
        return int(self.linear.shape[1])

    @property
    def height_px(self) -> int:
        """Rows."""
        return int(self.linear.shape[0])

    @cached_property
    def coded(self) -> Pixels:
        """The picture with sRGB's tone curve, 0 to 255: dim and bright parts of a lamp have contrasts alike."""
        coded = np.power(np.maximum(self.linear, 0), np.float32(1 / 2.4))
        coded *= np.float32(1.055)
        coded -= np.float32(0.055)
        low = self.linear <= 0.0031308
        coded[low] = np.float32(12.92) * self.linear[low]
        coded *= np.float32(255)
        return coded


def read_picture(path: Path, tone: Tone = "srgb", orientation: Orientation = "stored") -> Picture:
    """Read a picture.

    Parameters
    ----------
    path
        A JPEG, PNG, TIFF (8 or 16 bits) or DNG file. DNG needs the package rawpy (`pip install vlcrender[photo]`).
    tone
        The curve by which the file stores light: "srgb", "linear", or "gamma" (2.2). DNG files are linear.
    orientation
        "stored" as the file has the pixels, "upright" as EXIF says that they have to be turned.

    Raises
    ------
    InputError
        The file is missing, no picture, or of a kind that cannot be read.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    exif = _exif(path)
    if path.suffix.lower() in RAW_SUFFIXES:
        values, bits, curve = _developed(path), 16, _CURVES["linear"]
    else:
        try:
            flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
            decoded = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
        except cv2.error:  # an empty file, or one that says it has too many pixels
            decoded = None
        if decoded is None:
            raise InputError(f"{path}: not a readable picture; allowed: JPEG, PNG, TIFF, DNG")
        if decoded.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{path}: pixels are {decoded.dtype}, needed integers of 8 or 16 bits")
        values, bits, curve = decoded, 8 * decoded.dtype.itemsize, _CURVES[tone]
    if values.shape[0] * values.shape[1] > MAX_PIXELS:
        raise InputError(f"{path}: {values.shape[1]} x {values.shape[0]} pixels, at most {MAX_PIXELS} are allowed")
    # Curves by table: a picture has far more pixels than codes.
    light = curve(np.linspace(0, 1, 2**bits, dtype=np.float32))
    share = np.float32(2**bits - 1)
    limit = (CLIPPED_OF_8_BITS if bits == 8 else CLIPPED) * share
    if values.ndim == 3 and values.shape[2] == 2:
        values = values[:, :, 0]
    if values.ndim == 3:
        values = values[:, :, :3]  # without alpha
        clipped = (values >= limit).any(axis=2)
        # Luminance of linear sRGB, in OpenCV's order of blue, green, red.
        linear = cv2.transform(light[values], np.array([[0.0722, 0.7152, 0.2126]], dtype=np.float32))
    else:
        clipped, linear = values >= limit, light[values]
    if orientation == "upright":
        linear, clipped = _upright(linear, exif.orientation), _upright(np.asarray(clipped), exif.orientation)
    return Picture(path, np.ascontiguousarray(linear, dtype=np.float32), np.ascontiguousarray(clipped), bits, exif)


def _srgb(values: Pixels) -> Pixels:
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(np.float32)


_CURVES: dict[Tone, Callable[[Pixels], Pixels]] = {
    "srgb": _srgb,
    "linear": lambda values: values.astype(np.float32),
    "gamma": lambda values: (values**GAMMA).astype(np.float32),
}


def _upright(values: NDArray[Any], orientation: int | None) -> NDArray[Any]:
    """The pixels as EXIF's orientation says that they are meant to be seen."""
    if orientation is None:
        return values
    down, right = REVERSED[orientation]
    turned = values.T if orientation >= 5 else values
    return turned[:: -1 if down else 1, :: -1 if right else 1]


def _developed(path: Path) -> NDArray[np.uint16]:
    """Linear light of a raw file, 16 bits, the colours as the camera has them, in OpenCV's order; not turned."""
    try:
        import rawpy
    except ImportError:
        raise InputError(f"{path}: raw files need the package rawpy (pip install vlcrender[photo])") from None
    try:
        with rawpy.imread(str(path)) as raw:
            developed = raw.postprocess(gamma=(1, 1), no_auto_bright=True, output_bps=16, user_flip=0)
    except rawpy.LibRawError as error:
        raise InputError(f"{path}: not a readable raw file ({first_line(error)})") from None
    return np.asarray(developed[:, :, ::-1], dtype=np.uint16)


def _exif(path: Path) -> Exif:
    """Metadata of a picture; what is missing or damaged is None."""
    try:
        with Image.open(path) as image:
            tags = image.getexif()
            details = tags.get_ifd(ExifTags.IFD.Exif)
    except (OSError, ValueError, SyntaxError, KeyError, TypeError, Image.DecompressionBombError):
        return Exif()
    base = ExifTags.Base
    orientation = _number(tags, base.Orientation)
    name = " ".join(str(tags[tag]).strip("\0 ") for tag in (base.Make, base.Model) if tags.get(tag))
    return Exif(
        exposure_s=_number(details, base.ExposureTime),
        f_number=_number(details, base.FNumber),
        focal_length_mm=_number(details, base.FocalLength),
        focal_length_35mm=_number(details, base.FocalLengthIn35mmFilm),
        iso=_number(details, base.ISOSpeedRatings),
        orientation=int(orientation) if orientation in REVERSED else None,
        camera=name or None,
    )


def _number(tags: Mapping[int, object], tag: int) -> float | None:
    value = tags.get(tag)
    try:
        number = float(value[0] if isinstance(value, tuple) else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, IndexError):
        return None
    return number if 0 < number < 1e6 else None
