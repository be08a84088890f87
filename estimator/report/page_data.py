"""What the page's scripts draw, as compact JSON: frames, errors, LEDs, cameras, spots and pictures of one set."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from estimator.camera.projection import projection_of
from estimator.errors import InputError
from estimator.evaluate.known import estimate_paths
from estimator.evaluate.score import Scores, VariantScore
from estimator.io.camera import Camera
from estimator.io.dataset import Dataset
from estimator.io.estimates import EstimateRow, read_estimates
from estimator.io.results import dataset_folder
from estimator.report.answer import kind_of, unit_of
from estimator.report.looks import SHAPES, look_class
from estimator.report.pictures import frames_first, pictures

MAX_SHOWN = 6
"""Variants that the pictures show at first; of more, the best of each family."""
SPOTS_BYTES = 600_000
"""Characters of the spots of all frames; the frames that a reader asks for last have none beyond it."""
DIGITS = 5


def page_data(
    folder: Path, scores: Scores, variants: Sequence[VariantScore], dataset: Dataset | None
) -> dict[str, Any]:
    """Data of one set. Lengths are metres. Without `dataset`, whose files are gone, there are no cameras and spots."""
    rows = variants[0].rows if variants else ()
    reasons = sorted({kind_of(row.reason) for one in variants for row in one.rows if row.status == "failed"})
    first = frames_first(variants, len(rows))
    found = pictures(dataset_folder(folder), first)
    poses = scores.frames if len(scores.frames) == len(rows) else ()
    return {
        "name": scores.dataset,
        "room": scores.room_m,
        "unit": unit_of(variants),
        "shapes": {name: [[_short(a), _short(b)] for a, b in shape] for name, shape in SHAPES.items()},
        "leds": [[led.id, *led.position_m, led.shape == "square", _size(led)] for led in scores.led_map],
        "cameras": {} if dataset is None else {name: _camera(one) for name, one in dataset.cameras.items()},
        "frames": {
            "true": [list(map(_short, row.true_m)) for row in rows],
            "tilt": [_short(row.tilt_deg) for row in rows],
            "distance": [_short(row.distance_m) for row in rows],
            "leds": [row.leds for row in rows],
            "found": [row.spots_found for row in rows],
            "snr": [_short(row.snr) for row in rows],
            "bound": [_short(row.bound_m) for row in rows],
            "device": [row.device for row in rows],
            "camera": [one.camera for one in poses],
            "exposure": [_short(one.exposure_s) for one in poses],
            "gravity": [_short(one.gravity_error_deg) for one in poses],
            "R": [[round(value, 7) for value in one.R_cam_world] for one in poses],
        },
        "variants": [_variant(one, reasons, shown) for one, shown in zip(variants, _shown(variants), strict=True)],
        "reasons": reasons,
        "bound": None if scores.bound_quantiles_m is None else list(map(_short, scores.bound_quantiles_m)),
        "pictures": {frame: text for frame, (text, _) in found.items()},
        "aspects": {frame: round(aspect, 4) for frame, (_, aspect) in found.items()},
        "spots": {} if dataset is None else _spots(folder, scores, dataset, first),
    }


def script_json(data: Mapping[str, Any]) -> Markup:
    """JSON that can stand in a script element: no text of it ends the element or starts a comment."""
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


def _short(value: float | None) -> float | None:
    """A number to DIGITS digits."""
    return None if value is None else float(f"{value:.{DIGITS}g}")


def _size(led: Any) -> float | None:
    """Radius of a disc or half the side of a square, metres; None where the map does not say it."""
    size_m = led.side_m / 2 if led.shape == "square" else led.radius_m
    return None if size_m is None else float(size_m)


def _camera(camera: Camera) -> dict[str, Any]:
    lens = {} if camera.distortion is None else camera.distortion.model_dump()
    known = [lens.pop(key, 0.0) for key in ("k1", "k2", "k3", "p1", "p2")]
    return {
        "size": [camera.width_px, camera.height_px],
        "K": camera.matrix().tolist(),
        "fisheye": camera.projection == "equidistant",
        "lens": known if any(known) else None,
        # Outlines are drawn for lenses that the page's script can compute.
        "outlines": camera.projection in ("perspective", "equidistant") and not any(lens.values()),
    }


def _variant(one: VariantScore, reasons: Sequence[str], shown: bool) -> dict[str, Any]:
    look = one.entry.look
    errors: list[list[float | None] | int] = []
    for row in one.rows:
        if row.estimate_m is None:
            errors.append(reasons.index(kind_of(row.reason)))
        else:
            errors.append([_short(a - b) for a, b in zip(row.estimate_m, row.true_m, strict=True)])
    return {
        "name": one.variant,
        "look": look_class(look),
        "mark": look.mark,
        "hollow": look.hollow,
        "shown": shown,
        "errors": errors,
        "ms": [float(f"{row.time_s * 1e3:.3g}") for row in one.rows],
    }


def _shown(variants: Sequence[VariantScore]) -> list[bool]:
    """Whether a variant is shown at first: up to MAX_SHOWN all, of more the first of each family in their order."""
    families: set[str] = set()
    shown = []
    for one in variants:
        shown.append(len(variants) <= MAX_SHOWN or (one.ok > 0 and one.entry.look.family not in families))
        if one.ok:
            families.add(one.entry.look.family)
    return shown


def _spots(folder: Path, scores: Scores, dataset: Dataset, frames: Sequence[int]) -> dict[int, list[int]]:
    """Spots of each frame: index of the LED, and offset (u, v) from the image of its centre, thousandths of a pixel.

    The image is that by the camera and map of the device at the true pose.
    """
    rows = _rows_with_spots(folder, dataset)
    if not rows or len(scores.frames) != len(rows):
        return {}
    index = {led.id: place for place, led in enumerate(scores.led_map)}
    leds_m = np.array([led.position_m for led in scores.led_map])
    true = scores.variants[0].rows if scores.variants else ()
    spots: dict[int, list[int]] = {}
    budget = SPOTS_BYTES
    for frame in frames:
        known = [spot for spot in rows[frame].spots or () if spot.led in index]
        flat: list[int] = []
        if known:
            camera, places = dataset.cameras[scores.frames[frame].camera], [index[spot.led] for spot in known]
            turn = np.reshape(scores.frames[frame].R_cam_world, (3, 3))
            image, _ = projection_of(camera).project((leds_m[places] - true[frame].true_m) @ turn.T)
            off_px = np.array([(spot.u_px, spot.v_px) for spot in known]) - camera.to_pixels(image)
            for place, (du_px, dv_px) in zip(places, off_px, strict=True):
                if np.isfinite(du_px + dv_px):
                    flat += [place, round(1000 * du_px), round(1000 * dv_px)]
        budget -= len(str(flat))
        if budget < 0:
            break
        spots[frame] = flat
    return spots


def _rows_with_spots(folder: Path, dataset: Dataset) -> Sequence[EstimateRow]:
    """Rows of the first file of estimates that states spots; none without such a file."""
    for path in estimate_paths(folder):
        try:
            rows = read_estimates(path, len(dataset.frames))
        except InputError:
            continue  # scores.json does not depend on this file's state any more
        if any(row.spots is not None for row in rows):
            return rows
    return ()
