"""Calibration files of cameras: OpenCV, ROS, Kalibr and COLMAP, as keys of a recipe's [camera].

A calibration states K in pixels and a distortion. OpenCV, ROS and Kalibr count pixels from the centre of the first one,
recipes and COLMAP from the image's corner: K moves by half a pixel for the former. A lens that a recipe cannot hold
exactly is refused with the coefficient.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from vlcrender.config.columns import read_text
from vlcrender.config.toml_model import override
from vlcrender.errors import InputError

MATRIX_KEYS = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k", "mtx", "intrinsic_matrix", "M", "intrinsics")
DISTORTION_KEYS = (
    *("distortion_coefficients", "Distortion_Coefficients", "distortion_coeffs", "dist_coeffs", "distCoeffs"),
    *("distortion", "dist", "D", "d"),
)
WIDTH_KEYS = ("image_width", "image_Width", "width")
HEIGHT_KEYS = ("image_height", "image_Height", "height")
SIZE_KEYS = ("resolution", "image_size", "imageSize", "img_size", "size")
FISHEYE_KEYS = ("fisheye", "fisheye_model")
PERSPECTIVE_MODELS = ("plumb_bob", "rational_polynomial", "radtan", "brown_conrady", "pinhole", "perspective", "none")
FISHEYE_MODELS = ("equidistant", "equi", "fisheye", "kannala_brandt4")
COEFFICIENTS = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y"]
"""OpenCV's coefficients in their order."""
COUNTS = (0, 4, 5, 8, 12, 14)
HELD = ("k1", "k2", "k3", "p1", "p2")
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
}
"""Parameters of COLMAP's camera models, in their order (COLMAP, src/colmap/sensor/models.h)."""
MAX_NUMBERS = 100
MAX_YAML = 1_000_000
"""Letters of a YAML file, which is read slowly."""
MAX_DEPTH = 20
GEOMETRY = (
    *("width_px", "height_px", "focal_length_mm", "principal_point_px"),
    *("aspect_ratio", "skew_px", "projection", "distortion"),
)
"""Keys of [camera] that a calibration states."""

ProjectionName = Literal["perspective", "equidistant"]


@dataclass(frozen=True)
class Calibration:
    """A camera's intrinsics, with pixel centres at +0.5."""

    fx: float
    fy: float
    skew: float
    cx: float
    cy: float
    size_px: tuple[int, int] | None
    """Width and height of the images; None where the file does not say it."""
    projection: ProjectionName
    distortion: Mapping[str, float] | None
    """k1, k2, k3, p1, p2; None where all are 0."""

    def camera_keys(self, pixel_pitch_um: float, focus_distance_m: float | None) -> dict[str, Any]:
        """Keys of [camera] that follow: the K of a camera with them is this one.

        The mean of fx and fy is the image distance; a lens focused at a distance has a shorter focal length.
        """
        distance_mm = (self.fx + self.fy) / 2 * pixel_pitch_um / 1000
        focus_mm = np.inf if focus_distance_m is None else focus_distance_m * 1000
        keys: dict[str, Any] = {
            "focal_length_mm": distance_mm / (1 + distance_mm / focus_mm),
            "principal_point_px": [self.cx, self.cy],
            "aspect_ratio": self.fx / self.fy,
            "skew_px": self.skew,
            "projection": self.projection,
        }
        if self.distortion is not None:
            keys["distortion"] = dict(self.distortion)
        if self.size_px is not None:
            keys["width_px"], keys["height_px"] = self.size_px
        return keys


def read_calibration(path: Path, name: str | None = None) -> Calibration:
    """Read a calibration.

    path: OpenCV's YAML (FileStorage), ROS's camera_info, Kalibr's camchain, `.npz` with a camera matrix and
    coefficients, or COLMAP's cameras.txt. name: the camera of a Kalibr or COLMAP file of several, such as "cam1".

    Raises InputError that starts with the path where the file is missing, is no calibration, or has a lens that a
    recipe cannot hold exactly.
    """
    suffix = path.suffix.lower()
    if suffix == ".txt":
        return _of_colmap(path, name)
    entries = _npz(path) if suffix == ".npz" else _yaml(path)
    cameras = {
        key: value
        for key, value in entries.items()
        if key.startswith("cam") and isinstance(value, Mapping) and "intrinsics" in value
    }
    if not cameras and name is not None:
        raise InputError(f"{path}: is of one camera without a name; remove calibration_camera")
    return _of_entries(cameras[_chosen(path, cameras, name)] if cameras else entries, str(path))


def with_calibrations(
    tree: Mapping[str, Any], own: Mapping[str, Any], assignments: Iterable[str], folder: Path, source: str
) -> dict[str, Any]:
    """A recipe's tree with the keys of `calibration = "FILE"` in [camera], and in cameras of a rig, in its place.

    tree: with presets and assignments. own: the recipe file's own tree. folder: where relative paths start. A
    calibration replaces keys of presets; assignments override it. Raises InputError that starts with `source`, also
    where the recipe file itself has a key of GEOMETRY beside a calibration that states it.
    """
    result = dict(tree)
    if isinstance(camera := result.get("camera"), Mapping) and "calibration" in camera:
        result["camera"] = _calibrated(camera, own.get("camera"), folder, f"{source}: camera")
    if isinstance(rig := result.get("rig"), list):
        result["rig"] = list(rig)
        for number, entry in enumerate(rig):
            camera = entry.get("camera") if isinstance(entry, Mapping) else None
            if isinstance(camera, Mapping) and "calibration" in camera:
                made = _calibrated(camera, None, folder, f"{source}: rig[{number}].camera")
                result["rig"][number] = {**entry, "camera": made}
    return override(result, [text for text in assignments if OF_GEOMETRY.search(text.partition("=")[0])])


OF_GEOMETRY = re.compile(rf"(^|\.)\s*camera\s*\.\s*({'|'.join(GEOMETRY)})\b")


def _calibrated(camera: Mapping[str, Any], own: Any, folder: Path, where: str) -> dict[str, Any]:
    """A [camera] with the keys of its calibration. `own`: the recipe file's own [camera], if there is one."""
    name, which, pitch_um = (camera.get(key) for key in ("calibration", "calibration_camera", "pixel_pitch_um"))
    which = str(which) if isinstance(which, int) else which  # --set calibration_camera=1
    if not isinstance(name, str) or not isinstance(which, str | None):
        raise InputError(f"{where}.calibration: has to be the path of a file, and calibration_camera a text")
    try:
        found = read_calibration(folder / name, which)
    except InputError as error:
        raise InputError(f"{where}.calibration: {error}") from None
    if isinstance(pitch_um, bool) or not isinstance(pitch_um, int | float) or not pitch_um > 0:
        raise InputError(
            f"{where}.calibration = {name!r}: is in pixels; give pixel_pitch_um, the side of a pixel, beside it"
        )
    focus_m = camera.get("focus_distance_m")
    keys = found.camera_keys(pitch_um, focus_m if isinstance(focus_m, int | float) and focus_m > 0 else None)
    if found.size_px is None and not {"width_px", "height_px"} <= set(camera):
        raise InputError(f"{where}.calibration = {name!r}: states no size; give width_px and height_px beside it")
    stated = set(GEOMETRY) - ({"width_px", "height_px"} - set(keys))
    if isinstance(own, Mapping) and "calibration" in own and (twice := sorted(stated & set(own))):
        raise InputError(f"{where}.{twice[0]}: the calibration {name!r} states it; remove either")
    return {
        **{key: value for key, value in camera.items() if key not in (*stated, "calibration", "calibration_camera")},
        **keys,
    }


def _chosen(path: Path, cameras: Iterable[str], name: str | None) -> str:
    names = list(cameras)
    if name is None and len(names) == 1:
        return names[0]
    if name not in names:
        said = "has several cameras" if name is None else f"has no camera {name!r}"
        raise InputError(f"{path}: {said}; calibration_camera may be {', '.join(names[:20])}")
    return name


def _npz(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {key: archive[key].tolist() for key in archive.files}
    except Exception as error:  # zip, zlib and NumPy's headers raise exceptions of many kinds
        told = str(error).splitlines()
        raise InputError(f"{path}: is not a readable .npz file: {told[0] if told else 'damaged'}") from None


def _yaml(path: Path) -> dict[str, Any]:
    lines = read_text(path).splitlines()
    if sum(map(len, lines)) > MAX_YAML:
        raise InputError(f"{path}: has more than {MAX_YAML} letters: is no calibration")
    if lines and lines[0].startswith("%YAML"):
        lines[0] = ""  # OpenCV writes "%YAML:1.0", which is not YAML; an empty line keeps the numbers of lines
    text = "\n".join(lines)
    try:
        _check_events(text)
        parsed = yaml.load(text, Loader=yaml.BaseLoader)  # text, lists and mappings alone
    except yaml.MarkedYAMLError as error:
        where = "" if error.problem_mark is None else f"line {error.problem_mark.line + 1}: "
        raise InputError(f"{path}: {where}cannot be read as YAML: {error.problem}") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as YAML: {str(error).splitlines()[0]}") from None
    if not isinstance(parsed, dict):
        raise InputError(f"{path}: is not a calibration: it has no keys")
    return {str(key): value for key, value in parsed.items()}


def _check_events(text: str) -> None:
    """Raise YAMLError for text that would take long to read: aliases, and brackets in brackets."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.BaseLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent) or depth > MAX_DEPTH:
            raise yaml.YAMLError(f"aliases (*), or more than {MAX_DEPTH} brackets in brackets")


def _of_entries(entries: Mapping[str, Any], source: str) -> Calibration:
    key, given = _first(entries, MATRIX_KEYS)
    if given is None:
        raise InputError(f"{source}: has no camera matrix; needed is one of the keys {', '.join(MATRIX_KEYS)}")
    fx, skew, cx, fy, cy = _matrix(_numbers(source, key, given), f"{source}: {key}")
    key, given = _first(entries, DISTORTION_KEYS)
    numbers = [] if given is None else _numbers(source, key, given)
    camera_model = str(entries.get("camera_model", "pinhole")).lower()
    flags = [str(entries[key]).lower() not in ("0", "0.0", "false") for key in FISHEYE_KEYS if key in entries]
    model = str(entries.get("distortion_model") or ("fisheye" if any(flags) else "none")).lower()
    if camera_model not in ("pinhole", *FISHEYE_MODELS):
        raise InputError(f"{source}: camera_model {camera_model!r}: a recipe's lens cannot hold it; allowed: pinhole")
    if model not in (*PERSPECTIVE_MODELS, *FISHEYE_MODELS):
        allowed = ", ".join((*PERSPECTIVE_MODELS, *FISHEYE_MODELS))
        raise InputError(f"{source}: distortion_model {model!r}: a recipe's lens cannot hold it; allowed: {allowed}")
    projection: ProjectionName = "equidistant" if {model, camera_model} & set(FISHEYE_MODELS) else "perspective"
    if projection == "equidistant":
        names = [f"k{number}" for number in range(1, len(numbers) + 1)]
    elif len(numbers) in COUNTS:
        names = COEFFICIENTS[: len(numbers)]
    else:
        raise InputError(f"{source}: {key}: {len(numbers)} coefficients; allowed: {', '.join(map(str, COUNTS))}")
    distortion = _held(projection, dict(zip(names, numbers, strict=True)), source)
    return Calibration(fx, fy, skew, cx + 0.5, cy + 0.5, _size(source, entries), projection, distortion)


def _held(projection: ProjectionName, named: Mapping[str, float], source: str) -> dict[str, float] | None:
    """The coefficients of a recipe's lens. Raises InputError that names those that it has not."""
    held = HELD if projection == "perspective" else ()
    if beyond := ", ".join(f"{name} = {value:g}" for name, value in named.items() if value and name not in held):
        has = "k1, k2, k3, p1, p2 alone: calibrate with five coefficients" if held else "none: it is equidistant"
        lens = "lens" if held else "fish-eye lens"
        raise InputError(f"{source}: {beyond}: of these coefficients a recipe's {lens} has {has}")
    return {name: float(named.get(name, 0.0)) for name in HELD} if any(named.values()) else None


def _of_colmap(path: Path, name: str | None) -> Calibration:
    lines = {}
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        if words and not words[0].startswith("#"):
            lines[words[0]] = (f"{path}: line {number}", words)
    if not lines:
        raise InputError(f"{path}: has no camera; needed are lines of COLMAP's cameras.txt: ID MODEL WIDTH HEIGHT ...")
    where, (_, *words) = lines[_chosen(path, lines, name)]
    if len(words) < 3 or words[0] not in COLMAP_MODELS:
        allowed = ", ".join(COLMAP_MODELS)
        raise InputError(f"{where}: needed is ID MODEL WIDTH HEIGHT PARAMETERS with a model of {allowed}")
    model, parameters = words[0], COLMAP_MODELS[words[0]].split()
    numbers = _numbers(where, model, words[3:])
    if len(numbers) != len(parameters):
        raise InputError(f"{where}: {model} has {len(numbers)} parameters; needed are {', '.join(parameters)}")
    named = dict(zip(parameters, numbers, strict=True))
    fx, fy = (named.pop("f"),) * 2 if "f" in named else (named.pop("fx"), named.pop("fy"))
    cx, cy = named.pop("cx"), named.pop("cy")
    _matrix([fx, 0, cx, 0, fy, cy, 0, 0, 1], f"{where}: {model}")
    projection: ProjectionName = "equidistant" if "FISHEYE" in model else "perspective"
    size_px = _size(where, {"width": words[1], "height": words[2]})
    return Calibration(fx, fy, 0.0, cx, cy, size_px, projection, _held(projection, named, where))


def _first(entries: Mapping[str, Any], keys: Iterable[str]) -> tuple[str, Any]:
    return next(((key, entries[key]) for key in keys if entries.get(key) not in (None, "")), ("", None))


def _numbers(source: str, key: str, given: Any) -> list[float]:
    """Finite numbers of a matrix: a list, lists in a list, or a mapping with them as `data`."""
    if isinstance(given, Mapping):
        given = given.get("data")
    try:
        numbers = [float(item) for item in _flat(given)]
    except (TypeError, ValueError, RecursionError):
        raise InputError(f"{source}: {key}: has to be numbers") from None
    if len(numbers) > MAX_NUMBERS or not np.isfinite(numbers).all():
        raise InputError(f"{source}: {key}: has to be at most {MAX_NUMBERS} finite numbers")
    return numbers


def _flat(given: Any) -> Iterator[Any]:
    if isinstance(given, list):
        for item in given:
            yield from _flat(item)
    else:
        yield given


def _matrix(numbers: list[float], where: str) -> tuple[float, float, float, float, float]:
    """fx, skew, cx, fy and cy of K, row by row, or of Kalibr's four numbers fu, fv, pu, pv."""
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        numbers = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    if len(numbers) == 9:
        fx, skew, cx, yx, fy, cy, *last = numbers
        if fx > 0 and fy > 0 and yx == 0 and last == [0, 0, 1]:
            return fx, skew, cx, fy, cy
    raise InputError(f"{where}: has to be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0")


def _size(source: str, entries: Mapping[str, Any]) -> tuple[int, int] | None:
    (_, width), (_, height) = _first(entries, WIDTH_KEYS), _first(entries, HEIGHT_KEYS)
    key, pair = _first(entries, SIZE_KEYS)
    given = [width, height] if pair is None else pair
    if given == [None, None]:
        return None
    numbers = _numbers(source, key or "size of the images", given)
    if len(numbers) != 2 or not all(number.is_integer() and 1 <= number < 1e6 for number in numbers):
        raise InputError(f"{source}: {key or 'size of the images'}: has to be width and height, whole pixels")
    return int(numbers[0]), int(numbers[1])
