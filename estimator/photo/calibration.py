"""Calibrations: intrinsics of a camera by OpenCV, ROS, Kalibr or NumPy files, as the format's camera.

OpenCV counts pixels from their centres, and the format from the border: the principal point moves by half a pixel. A
calibration for pictures of another size is rescaled. Coefficients that the format's lens cannot hold exactly are
refused.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estimator.errors import InputError
from estimator.io.camera import Camera, CameraUncertainty, Distortion
from estimator.io.shutter import Shutter
from estimator.photo.yaml_subset import YamlError, parse_yaml

Floats = NDArray[np.float64]

# Sides of a picture and of its calibration, scaled alike, may differ by this share: pixels are rounded.
MAX_ASPECT = 0.003
# A pitch, for displays alone: nothing in a picture says it.
ASSUMED_PITCH_UM = 1.2
FILM_WIDTH_MM = 36.0
# Standard deviation of a focal length by EXIF, relative.
EXIF_FOCAL_SIGMA = 0.03
COEFFICIENTS = {
    4: "k1 k2 p1 p2",
    5: "k1 k2 p1 p2 k3",
    8: "k1 k2 p1 p2 k3 k4 k5 k6",
    12: "k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4",
    14: "k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y",
}
MATRIX_KEYS = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k", "mtx", "intrinsic_matrix", "M", "intrinsics")
DISTORTION_KEYS = (
    "distortion_coefficients",
    "Distortion_Coefficients",
    "distortion_coeffs",
    "dist_coeffs",
    "distCoeffs",
    "distortion",
    "dist",
    "D",
    "d",
)
PERSPECTIVE_MODELS = ("plumb_bob", "rational_polynomial", "radtan", "brown_conrady", "pinhole", "perspective", "none")
FISHEYE_MODELS = ("equidistant", "equi", "fisheye", "kannala_brandt4")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Intrinsics: `K` (3, 3), in pixels with pixel centres at +0.5, of pictures of `size_px` (width, height).

    `size_px` is None where the file does not say it. `focal_sigma` is the relative standard deviation of the focal
    length, None where not stated. `source` says in a few words where it is from, `remarks` what was changed.
    """

    K: Floats
    projection: Literal["perspective", "equidistant"]
    distortion: Distortion | None
    size_px: tuple[int, int] | None
    source: str
    focal_sigma: float | None = None
    remarks: tuple[str, ...] = ()

    def for_size(self, width_px: int, height_px: int) -> "Calibration":
        """The calibration for pictures of a size; raises InputError for another shape of picture."""
        if self.size_px is None:
            said = f"{self.source} states no size: taken as {width_px} x {height_px} px"
            return replace(self, size_px=(width_px, height_px), remarks=(*self.remarks, said))
        width, height = self.size_px
        if (width, height) == (width_px, height_px):
            return self
        across, down = width_px / width, height_px / height
        what = f"{self.source}: is of {width} x {height} px, the picture has {width_px} x {height_px}"
        if abs(across / down - 1) > MAX_ASPECT:
            turned = abs(width_px * width / (height_px * height) - 1) <= MAX_ASPECT
            hint = (
                "turned by 90 degrees: try --orientation"
                if turned
                else "of another shape: cropped pictures are not allowed"
            )
            raise InputError(f"{what}, {hint}")
        # The mean keeps square pixels square: sides of pictures are rounded to whole pixels.
        scale = float(np.sqrt(across * down))
        said = f"{what}: rescaled by {scale:.6g}"
        return replace(
            self, K=np.diag([scale, scale, 1.0]) @ self.K, size_px=(width_px, height_px), remarks=(*self.remarks, said)
        )

    def camera(self, shutter: Shutter, f_number: float | None, focal_length_mm: float | None) -> Camera:
        """The camera of the format; `for_size` comes first."""
        if self.size_px is None:
            raise ValueError("the size of the picture is not set")
        width_px, height_px = self.size_px
        focal_px = float(self.K[0, 0] + self.K[1, 1]) / 2
        pitch_um = 1000 * focal_length_mm / focal_px if focal_length_mm else ASSUMED_PITCH_UM
        distance_mm = focal_px * pitch_um / 1000
        (fx, skew, cx), (_, fy, cy), _ = self.K.tolist()
        uncertainty = None
        if self.focal_sigma is not None:
            uncertainty = CameraUncertainty(
                parameters=("focal",),
                device_sigma=(self.focal_sigma,),
                shot_sigma=(0.0,),
                offset_sigma_m=0.0,
                rotation_sigma_deg=0.0,
            )
        return Camera(
            width_px=width_px,
            height_px=height_px,
            K=((fx, skew, cx), (0.0, fy, cy), (0.0, 0.0, 1.0)),
            pixel_pitch_um=pitch_um,
            focal_length_mm=distance_mm,
            image_distance_mm=distance_mm,
            f_number=f_number or 2.0,
            projection=self.projection,
            distortion=self.distortion,
            focus_distance_m=None,
            psf="none",
            psf_wavelength_nm=550.0,
            psf_kernel=None,
            R_cam_rig=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
            offset_m=(0.0, 0.0, 0.0),
            uncertainty=uncertainty,
            shutter=shutter,
        )


def simple_calibration(
    focal_px: float, size_px: tuple[int, int], source: str, sigma: float | None = None
) -> Calibration:
    """A pinhole with the principal point in the middle of the picture."""
    width_px, height_px = size_px
    K = np.array([[focal_px, 0.0, width_px / 2], [0.0, focal_px, height_px / 2], [0.0, 0.0, 1.0]])
    return Calibration(K, "perspective", None, size_px, source, sigma)


def calibration_of_film(focal_length_35mm: float, size_px: tuple[int, int]) -> Calibration:
    """A pinhole by EXIF's focal length for film of 36 mm x 24 mm; pictures of 4:3 are compared by their diagonal."""
    width_px, height_px = max(size_px), min(size_px)
    film_diagonal = float(np.hypot(FILM_WIDTH_MM, 24.0))
    focal_px = focal_length_35mm * float(np.hypot(width_px, height_px)) / film_diagonal
    return simple_calibration(focal_px, size_px, f"EXIF's {focal_length_35mm:g} mm (35 mm film)", EXIF_FOCAL_SIGMA)


def read_calibration(path: Path) -> Calibration:
    """Read a calibration.

    Parameters
    ----------
    path
        OpenCV's YAML (FileStorage), ROS's camera_info, Kalibr's camchain (its first camera), or a NumPy .npz with a
        camera matrix and coefficients. 4, 5, 8, 12 or 14 coefficients of OpenCV, or 4 of its fish-eye.

    Raises
    ------
    InputError
        The file is missing or no calibration, or its lens cannot be held exactly; the message names the coefficient.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    entries = _npz(path) if path.suffix.lower() == ".npz" else _yaml(path)
    first = next(
        (
            value
            for key, value in sorted(entries.items())
            if key.startswith("cam") and isinstance(value, Mapping) and "intrinsics" in value
        ),
        None,
    )
    source = path.name
    if first is not None:
        entries = dict(first)
    return _calibration(entries, source)


def _npz(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {key: archive[key].tolist() for key in archive.files}
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise InputError(
            f"{path}: not a readable .npz file ({str(error).splitlines()[0] if str(error) else 'damaged'})"
        ) from None


def _yaml(path: Path) -> dict[str, Any]:
    try:
        parsed = parse_yaml(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, YamlError) as error:
        raise InputError(f"{path}: not a readable YAML file ({error})") from None
    if not isinstance(parsed, dict):
        raise InputError(f"{path}: not a calibration: no keys")
    return parsed


def _calibration(entries: Mapping[str, Any], source: str) -> Calibration:
    matrix_key, matrix = _first(entries, MATRIX_KEYS)
    if matrix is None:
        raise InputError(f"{source}: no camera matrix; needed one of the keys {', '.join(MATRIX_KEYS)}")
    K = _camera_matrix(source, matrix_key, _values(source, matrix_key, matrix))
    distortion_key, given = _first(entries, DISTORTION_KEYS)
    coefficients = [] if given is None else _values(source, distortion_key, given)
    camera_model = str(entries.get("camera_model", "pinhole")).lower()
    model = str(entries.get("distortion_model", "fisheye" if entries.get("fisheye") else "none")).lower() or "none"
    if camera_model not in ("pinhole", *FISHEYE_MODELS):
        raise InputError(f"{source}: camera_model {camera_model!r} cannot be held; allowed: pinhole")
    if model not in (*PERSPECTIVE_MODELS, *FISHEYE_MODELS):
        allowed = ", ".join((*PERSPECTIVE_MODELS, *FISHEYE_MODELS))
        raise InputError(f"{source}: distortion_model {model!r} is unknown; allowed: {allowed}")
    fisheye = model in FISHEYE_MODELS or camera_model in FISHEYE_MODELS
    size = _size(source, entries)
    # OpenCV's pixel centres are at whole numbers.
    K = K + np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    if fisheye:
        if any(coefficients):
            told = ", ".join(f"k{k} = {value:g}" for k, value in enumerate(coefficients, 1) if value)
            raise InputError(
                f"{source}: fish-eye with {told}: the format's fish-eye is equidistant, all of k1 to k4 have to be 0"
            )
        return Calibration(K, "equidistant", None, size, source)
    return Calibration(K, "perspective", brown_conrady(source, coefficients), size, source)


def brown_conrady(source: str, coefficients: Sequence[float]) -> Distortion | None:
    """Distortion by OpenCV's coefficients, None for none; raises InputError for those that it cannot hold."""
    count = len(coefficients)
    if count and count not in COEFFICIENTS:
        raise InputError(f"{source}: {count} coefficients of distortion; allowed: {', '.join(map(str, COEFFICIENTS))}")
    named = dict(zip(COEFFICIENTS.get(count, "").split(), coefficients, strict=True))
    beyond = [f"{name} = {value:g}" for name, value in named.items() if value and name not in Distortion.model_fields]
    if beyond:
        raise InputError(
            f"{source}: {', '.join(beyond)}: the format's lens has k1, k2, k3, p1, p2 alone; "
            "calibrate with five coefficients"
        )
    if not any(named.values()):
        return None
    return Distortion(**{name: float(named.get(name, 0.0)) for name in Distortion.model_fields})


def _first(entries: Mapping[str, Any], keys: Sequence[str]) -> tuple[str, Any]:
    return next(((key, entries[key]) for key in keys if entries.get(key) is not None), ("", None))


def _values(source: str, key: str, given: Any) -> list[float]:
    """Numbers of a matrix: a (nested) list, or a mapping with them as `data`."""
    if isinstance(given, Mapping):
        given = given.get("data")
    try:
        values = np.asarray(given, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise InputError(f"{source}: {key}: needed numbers") from None
    if not np.isfinite(values).all():
        raise InputError(f"{source}: {key}: needed finite numbers")
    return [float(value) for value in values]


def _camera_matrix(source: str, key: str, values: list[float]) -> Floats:
    if len(values) == 4:  # Kalibr: fu, fv, pu, pv
        fx, fy, cx, cy = values
        values = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    K = np.reshape(values, (3, 3)) if len(values) == 9 else np.zeros((3, 3))
    if not (K[0, 0] > 0 and K[1, 1] > 0 and K[1, 0] == 0 and (K[2] == (0, 0, 1)).all()):
        raise InputError(f"{source}: {key}: needed [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0")
    return np.asarray(K, dtype=np.float64)


def _size(source: str, entries: Mapping[str, Any]) -> tuple[int, int] | None:
    if isinstance(entries.get("resolution"), Sequence):
        pair = list(entries["resolution"])
    else:
        width = next((entries[key] for key in ("image_width", "image_Width", "width") if key in entries), None)
        height = next((entries[key] for key in ("image_height", "image_Height", "height") if key in entries), None)
        pair = [width, height]
        for key in ("image_size", "imageSize", "img_size", "size"):
            if width is None and isinstance(entries.get(key), Sequence):
                pair = list(entries[key])
    if pair == [None, None]:
        return None
    if len(pair) != 2 or not all(isinstance(one, int | float) and one >= 1 and one == int(one) for one in pair):
        raise InputError(f"{source}: size of the pictures {pair}: needed width and height, whole pixels")
    return int(pair[0]), int(pair[1])
