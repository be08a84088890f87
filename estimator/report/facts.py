"""What was photographed, in words, for people: out of dataset.json with its provenance, which no estimator reads."""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from estimator.evaluate.entry import MadeBy
from estimator.evaluate.score import Scores
from estimator.report.numbers import THIN, brief, length

DIGEST_DIGITS = 12
LENS_BLUR = {"none": "no blur", "diffraction": "blurred by diffraction", "measured": "with a measured blur"}


def read_description(folder: Path) -> dict[str, Any] | None:
    """dataset.json as it is; None where it is missing or no JSON object."""
    try:
        found = json.loads((folder / "dataset.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def facts(folder: Path, scores: Scores) -> list[tuple[str, str]]:
    """Pairs of a heading and what is to say under it; what the files do not state is left out."""
    description = read_description(folder)
    found = [("Room", _room(scores, description or {})), ("LEDs", _leds(scores)), ("Poses", _poses(scores))]
    if description is not None:
        for heading, part in (
            ("Camera", _camera),
            ("Lens", _lens),
            ("Sensor", _sensor),
            ("Exposure", _exposure),
            ("Accelerometer", _accelerometer),
            ("What the device is told", _told),
            ("Made with", _made_with),
        ):
            try:
                found.append((heading, part(description, scores)))
            except (KeyError, TypeError, ValueError, AttributeError, IndexError):
                continue  # another program's set may leave out what only people read
    found.append(("Recipe, seed, digest", ", ".join(filter(None, (_recipe(description or {}), _digest_named(folder))))))
    found.append(("Scored with", _scored_with(scores.made_by)))
    return [(heading, text) for heading, text in found if text]


def digest(folder: Path) -> str:
    """First digits of the SHA-256 of frames.parquet; empty where it cannot be read."""
    try:
        return hashlib.sha256((folder / "frames.parquet").read_bytes()).hexdigest()[:DIGEST_DIGITS]
    except OSError:
        return ""


def span(values: Sequence[float], unit: str = "") -> str:
    """Range of some numbers, `4 to 16`; one number where they agree."""
    low, high = brief(min(values)), brief(max(values))
    return f"{low}{unit}" if low == high else f"{low} to {high}{unit}"


def _grouped(count: int) -> str:
    return f"{count:,}".replace(",", THIN)


def _room(scores: Scores, description: Mapping[str, Any]) -> str:
    size = "of unknown size" if scores.room_m is None else " × ".join(f"{side:g}" for side in scores.room_m) + " m"
    scene = (description.get("provenance") or {}).get("scene") or {}
    name, lux = scene.get("name"), (scene.get("ambient") or {}).get("illuminance_lux")
    parts = [name, size, f"ambient light of {lux:g} lux" if isinstance(lux, (int, float)) else None]
    return ", ".join(str(part) for part in parts if part)


def _leds(scores: Scores) -> str:
    leds = scores.led_map
    if not leds:
        return "no map: packets tell"
    luminaires = {led.luminaire for led in leds if led.luminaire is not None}
    kinds = []
    for shape, name in (("disc", "discs"), ("square", "squares")):
        sides = [_side_m(led) for led in leds if led.shape == shape]
        known = [1e3 * side for side in sides if side is not None]
        if sides:
            kinds.append(f"{name} of {span(known)} mm" if known else name)
    count = f"{_grouped(len(leds))} LEDs" + (f" in {len(luminaires)} luminaires" if len(luminaires) > 1 else "")
    return f"{count}, {' and '.join(kinds)}"


def _side_m(led: Any) -> float | None:
    if led.shape == "square":
        return float(led.side_m) if led.side_m is not None else None
    return None if led.radius_m is None else 2 * float(led.radius_m)


def _poses(scores: Scores) -> str:
    rows = scores.variants[0].rows if scores.variants else ()
    if not rows:
        return "no frame"
    devices = len({row.device for row in rows})
    parts = [
        f"{_grouped(len(rows))} frames" + (f" of {devices} devices" if devices > 1 else ""),
        f"height {span([row.true_m[2] for row in rows])} m",
        f"optical axis {span([row.tilt_deg for row in rows])}° off the vertical",
        f"{span([row.leds for row in rows])} LEDs in view",
    ]
    return ", ".join(parts)


def _cameras(description: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    return list(description["cameras"].items())


def _camera(description: Mapping[str, Any], scores: Scores) -> str:
    cameras = _cameras(description)
    preset = _preset(description, "camera")
    texts = [f"{one['width_px']} × {one['height_px']} pixels of {one['pixel_pitch_um']:g} µm" for _, one in cameras]
    regions = _recipe_of(description).get("regions")
    text = texts[0] if len(set(texts)) == 1 else "; ".join(texts)
    if len(cameras) > 1:
        text = f"{len(cameras)} cameras: {text}"
    return text + (", read out around the LEDs alone" if regions else "") + preset


def _lens(description: Mapping[str, Any], scores: Scores) -> str:
    return "; ".join(dict.fromkeys(_one_lens(one) for _, one in _cameras(description)))


def _one_lens(one: Mapping[str, Any]) -> str:
    fish_eye = one["projection"] == "equidistant"
    angles = [
        _angle_deg(one[side], one["K"][axis][axis], fish_eye) for axis, side in enumerate(("width_px", "height_px"))
    ]
    blur = LENS_BLUR.get(one["psf"], str(one["psf"]))
    bent = "fish-eye" if fish_eye else "no distortion" if one["distortion"] is None else "distorted"
    focus = one["focus_distance_m"]
    sharp = (
        "in focus everywhere" if focus is None else f"focused at {focus if isinstance(focus, str) else f'{focus:g} m'}"
    )
    view = f"{angles[0]:.1f}° × {angles[1]:.1f}°"
    return f"{one['focal_length_mm']:g} mm, f/{one['f_number']:g}, {view}, {bent}, {blur}, {sharp}"


def _angle_deg(side_px: float, focal_px: float, fish_eye: bool) -> float:
    half = side_px / 2 / focal_px
    return math.degrees(2 * (half if fish_eye else math.atan(half)))


def _sensor(description: Mapping[str, Any], scores: Scores) -> str:
    one = description["sensor"]
    parts = [f"{one['bits']} bit"]
    if one["gain_e_per_dn"] is not None:
        parts += [f"{brief(one['gain_e_per_dn'])} e⁻/DN", f"full well {brief(one['full_well_e'])} e⁻"]
    if one["noise"] == "full":
        parts += [f"read noise {brief(one['read_noise_e'])} e⁻", f"uneven response {brief(100 * one['prnu'])} %"]
    else:
        parts.append({"none": "no noise", "shot": "shot noise alone"}.get(one["noise"], str(one["noise"])))
    rolling = any(camera["shutter"]["kind"] == "rolling" for _, camera in _cameras(description))
    return ", ".join(parts) + (", rolling shutter" if rolling else "") + _preset(description, "sensor")


def _preset(description: Mapping[str, Any], table: str) -> str:
    name = (description.get("names") or {}).get(table)
    return f" (preset {name})" if name else ""


def _exposure(description: Mapping[str, Any], scores: Scores) -> str:
    times_s = [one.exposure_s for one in scores.frames]
    if not times_s:
        return ""
    unit, unit_s = ("ms", 1e-3) if min(times_s) >= 1e-3 else ("µs", 1e-6)
    return span([time_s / unit_s for time_s in times_s], f" {unit}")


def _accelerometer(description: Mapping[str, Any], scores: Scores) -> str:
    one = description["accelerometer"]
    if one is None:
        return "none"
    errors_deg = [error for frame in scores.frames if (error := frame.gravity_error_deg) is not None]
    mean = f"; here {brief(sum(errors_deg) / len(errors_deg))}° off on average" if errors_deg else ""
    return f"{one['error_deg']:.3g}° (1 σ) on each tilt{mean}{_preset(description, 'accelerometer')}"


def _told(description: Mapping[str, Any], scores: Scores) -> str:
    """How far camera and map that the device is told may be from the truth, as the set states it."""
    stated = [one.get("uncertainty") for _, one in _cameras(description)]
    datum, luminaires = description["map_datum"], description["luminaires"]
    preset = _preset(description, "belief")
    known = [one for one in stated if one is not None]
    if len(known) < len(stated):
        return "camera and map without a statement of their errors"
    sigmas = {name: sigma for one in known for name, sigma in zip(one["parameters"], _rms(one), strict=True)}
    if not any(sigmas.values()) and datum is None and not luminaires:
        return "camera, lens and LED map exactly as rendered; not the brightness of the LEDs"
    parts = [f"focal length to {brief(100 * sigmas['focal'])} %, image centre to {brief(sigmas['cx_px'])} px"]
    if luminaires:
        parts.append(f"luminaires to {length(max(max(one['sigma_m']) for one in luminaires))}")
    within = [max(led.sigma_m) for led in scores.led_map if led.sigma_m is not None]
    if within:
        parts.append(f"LEDs within them to {length(max(within))}")
    if datum is not None and (any(datum["sigma_m"]) or datum["scale_sigma_ppm"]):
        parts.append(f"map as a whole to {length(max(datum['sigma_m']))} and {brief(datum['scale_sigma_ppm'])} ppm")
    return "1 σ: " + "; ".join(parts) + preset


def _rms(uncertainty: Mapping[str, Any]) -> list[float]:
    pairs = zip(uncertainty["device_sigma"], uncertainty["shot_sigma"], strict=True)
    return [math.hypot(device, shot) for device, shot in pairs]


def _recipe_of(description: Mapping[str, Any]) -> Mapping[str, Any]:
    found = (description.get("provenance") or {}).get("recipe")
    return found if isinstance(found, dict) else {}


def _recipe(description: Mapping[str, Any]) -> str:
    recipe = _recipe_of(description)
    return f"{recipe.get('name')}, seed {recipe['seed']}" if "seed" in recipe else ""


def _digest_named(folder: Path) -> str:
    found = digest(folder)
    return f"frames.parquet {found}" if found else ""


def _made_with(description: Mapping[str, Any], scores: Scores) -> str:
    versions = description["provenance"].get("versions") or {}
    names = {"vlcrender": "vlcrender", "mitsuba": "Mitsuba", "drjit": "Dr.Jit"}
    return ", ".join(f"{title} {versions[name]}" for name, title in names.items() if name in versions)


def _scored_with(made_by: MadeBy | None) -> str:
    if made_by is None:
        return ""
    titles = {"numpy": "NumPy", "scipy": "SciPy", "opencv-python-headless": "OpenCV"}
    packages = ", ".join(f"{titles.get(name, name)} {number}" for name, number in made_by.packages.items())
    return f"estimator {made_by.estimator}, Python {made_by.python}, {packages}, {made_by.machine}"
