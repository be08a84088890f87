"""What was photographed, in words, by dataset.json and its provenance."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from vlcrender.report.contents import Contents

LENS_BLUR = {"none": "no blur", "diffraction": "blurred by diffraction", "measured": "with a measured blur"}
NOISE = {"none": "no noise", "shot": "shot noise alone"}


def facts(contents: Contents) -> list[tuple[str, str]]:
    """Pairs of a heading and what is to say under it."""
    dataset, recipe = contents.dataset, contents.dataset.provenance.get("recipe") or {}
    found = [
        ("Room", _room(contents)),
        ("LEDs", _leds(contents)),
        ("Poses", _poses(contents, recipe)),
        ("Camera", "; ".join(_cameras(contents, recipe))),
        ("Lens", "; ".join(dict.fromkeys(map(_lens, dataset.cameras.values())))),
        ("Sensor", _sensor(contents)),
        ("Exposure", _exposure(contents)),
        ("Accelerometer", _accelerometer(contents)),
        ("What the device is told", _told(contents)),
        ("Recipe, seed", f"{recipe.get('name', dataset.name)}, seed {recipe.get('seed', 'unknown')}"),
        ("Made with", _made_with(dataset.provenance.get("versions") or {})),
        ("Digest of frames.parquet", contents.digest[:12]),
    ]
    return [(heading, text) for heading, text in found if text]


def sentence(contents: Contents) -> str:
    """The set in one or two sentences."""
    count = len(contents.frames)
    if not contents.truth:
        return f"{count} frames. The truth is not in the folder: poses are not shown."
    places = len(np.unique(np.round(contents.positions_m(), 6), axis=0))
    leds = [len(row.leds) for row in contents.truth]
    tilt = np.degrees(np.arccos(np.clip(contents.axes()[:, 2], -1, 1))).max()
    told = f"{count} frames" if len(leds) == count else f"{count} frames, of which {len(leds)} have their truth here,"
    return (
        f"{told} from {places} {'place' if places == 1 else 'places'} in the scene "
        f"{_scene(contents).get('name', 'unknown')}. Half of them show {int(np.median(leds))} LEDs or more, the barest "
        f"{min(leds)}; tilts of the optical axis reach {tilt:.0f}°."
    )


def span(values: Iterable[float], unit: str = "") -> str:
    """Range of some numbers to three digits: `4 to 16`; one number where they agree."""
    some = list(values)
    low, high = f"{min(some):.3g}", f"{max(some):.3g}"
    return f"{low}{unit}" if low == high else f"{low} to {high}{unit}"


def _scene(contents: Contents) -> Mapping[str, Any]:
    return contents.dataset.provenance.get("scene") or {}


def _preset(contents: Contents, table: str) -> str:
    name = getattr(contents.dataset.names, table)
    return f" (preset {name})" if name else ""


def _room(contents: Contents) -> str:
    size = " × ".join(f"{side:g}" for side in contents.dataset.room_m)
    scene = _scene(contents)
    lux = (scene.get("ambient") or {}).get("illuminance_lux")
    return ", ".join(
        part for part in (scene.get("name"), f"{size} m", f"ambient light of {lux:g} lux" if lux else "") if part
    )


def _grouped(number: float) -> str:
    """A whole number with narrow spaces between groups of three digits."""
    return f"{number:,.0f}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def _leds(contents: Contents) -> str:
    leds = contents.dataset.led_map
    if leds is None:
        return "no map is given: packets tell"
    sizes: dict[str, list[float]] = {}
    for led in leds:
        entry = led.model_dump()
        side_m = entry["side_m"] if entry["shape"] == "square" else 2 * entry["radius_m"]
        sizes.setdefault("squares" if entry["shape"] == "square" else "discs", []).append(1e3 * side_m)
    panels = sum(int(one.get("columns", 1)) * int(one.get("rows", 1)) for one in _scene(contents).get("panels") or ())
    inside = f" in {panels} panels" if panels else ""
    return f"{_grouped(len(leds))} LEDs{inside}, " + " and ".join(
        f"{name} of {span(some)} mm" for name, some in sizes.items()
    )


def _poses(contents: Contents, recipe: Mapping[str, Any]) -> str:
    parts = [f"{_grouped(len(contents.frames))} frames"]
    devices = len({row.device for row in contents.frames})
    if devices > 1:
        parts[0] += f" of {devices} devices"
    if contents.truth:
        tilts = np.degrees(np.arccos(np.clip(contents.axes()[:, 2], -1, 1)))
        parts += [f"height {span(contents.positions_m()[:, 2])} m", f"optical axis {span(tilts)}° off the vertical"]
    kind = (recipe.get("poses") or {}).get("kind")
    return ", ".join([*parts, f"drawn as “{kind}”"] if kind else parts)


def _cameras(contents: Contents, recipe: Mapping[str, Any]) -> Sequence[str]:
    several = len(contents.dataset.cameras) > 1
    regions = ", read out around the LEDs alone" if recipe.get("regions") else ""
    return [
        f"{f'{name}: ' if several else ''}{one.width_px} × {one.height_px} pixels of {one.pixel_pitch_um:g} µm{regions}"
        + (_preset(contents, "camera") if name == "main" else "")
        for name, one in contents.dataset.cameras.items()
    ]


def _lens(one: Any) -> str:
    fish_eye = one.projection == "equidistant"
    halves = [one.width_px / 2 / one.K[0][0], one.height_px / 2 / one.K[1][1]]
    across, down = np.degrees(2 * np.array(halves if fish_eye else np.arctan(halves)))
    bent = "fish-eye" if fish_eye else "no distortion" if one.distortion is None else "distorted"
    focus = one.focus_distance_m
    far = focus if isinstance(focus, str) or focus is None else f"{focus:g} m"
    sharp = "in focus everywhere" if focus is None else f"focused at {far}"
    view = f"{across:.1f}° × {down:.1f}°"
    return f"{one.focal_length_mm:g} mm, f/{one.f_number:g}, {view}, {bent}, {LENS_BLUR[one.psf]}, {sharp}"


def _sensor(contents: Contents) -> str:
    one = contents.dataset.sensor
    parts = [f"{one.bits} bit", f"{one.gain_e_per_dn:.3g} e⁻/DN", f"full well {_grouped(one.full_well_e)} e⁻"]
    noise = NOISE.get(one.noise, f"read noise {one.read_noise_e:.3g} e⁻, uneven response {100 * one.prnu:.3g} %")
    rolling = any(camera.shutter.kind == "rolling" for camera in contents.dataset.cameras.values())
    return ", ".join([*parts, noise, *(["rolling shutter"] if rolling else [])]) + _preset(contents, "sensor")


def _exposure(contents: Contents) -> str:
    times_s = [row.exposure_s for row in contents.frames]
    if not times_s:
        return ""
    unit, unit_s = ("ms", 1e-3) if min(times_s) >= 1e-3 else ("µs", 1e-6)
    return span((time_s / unit_s for time_s in times_s), f" {unit}")


def _accelerometer(contents: Contents) -> str:
    error_deg = contents.dataset.accelerometer.error_deg
    found = contents.gravity_errors_deg()
    here = f"; here {found.mean():.3g}° off on average" if len(found) else ""
    return f"{error_deg:.3g}° (1 σ) on each tilt{here}{_preset(contents, 'accelerometer')}"


def _told(contents: Contents) -> str:
    if contents.dataset.provenance.get("recipe", {}).get("belief") is None:
        return "camera, lens and LED map exactly as rendered; not the brightness of the LEDs"
    sigmas = contents.dataset.cameras["main"].uncertainty
    if sigmas is None:
        return "camera and map without a statement of their errors"
    sums = np.hypot(sigmas.device_sigma, sigmas.shot_sigma)
    parts = [f"focal length to {100 * sums[0]:.3g} %", f"image centre to {sums[2]:.3g} px"]
    if contents.dataset.luminaires:
        largest_m = max(max(one.sigma_m) for one in contents.dataset.luminaires)
        parts.append(f"luminaires to {1e3 * largest_m:.3g} mm")
    return "1 σ: " + "; ".join(parts) + _preset(contents, "belief")


def _made_with(versions: Mapping[str, str]) -> str:
    names = {"vlcrender": "vlcrender", "mitsuba": "Mitsuba", "drjit": "Dr.Jit"}
    return ", ".join(f"{title} {versions[name]}" for name, title in names.items() if name in versions)
