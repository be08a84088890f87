"""HTML page of a dataset alone: one file without a script; page.html and page.css beside this module make it."""

import base64
import hashlib
import io
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image

from vlcrender.errors import InputError
from vlcrender.report.contents import Contents
from vlcrender.report.facts import facts, sentence
from vlcrender.report.plots import directions, floor_plan, histogram

MAX_PREVIEWS = 24
PREVIEW_PX = 320
QUALITY = 60

TEMPLATES = Environment(
    loader=PackageLoader("vlcrender.report", "."),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)


@dataclass(frozen=True)
class Preview:
    """A small picture of a frame: WebP in base 64, and what is to say below it."""

    webp: str
    frame: int
    text: str


def page(directory: Path) -> str:
    """The HTML text of the page of a dataset. Raises InputError where the folder holds no complete one."""
    contents = Contents.read(directory)
    style = files("vlcrender.report").joinpath("page.css").read_text(encoding="utf-8")
    axes, positions_m = contents.axes(), contents.positions_m()
    count = len(contents.frames)
    return TEMPLATES.get_template("page.html").render(
        name=contents.dataset.name,
        sentence=sentence(contents),
        facts=facts(contents),
        plan=floor_plan(contents.dataset.room_m, contents.leds_m(), positions_m, axes),
        directions=directions(axes) if len(axes) else "",
        histograms=[(name, plot) for name, values in _measures(contents) if (plot := histogram(name, values))],
        told=contents.told_and_true(),
        devices=len({row.device for row in contents.devices}),
        previews=_previews(contents),
        count=count,
        digest=contents.digest,
        style=Markup(style),
        policy=f"default-src 'none'; style-src '{_digest(style)}'; img-src data:; base-uri 'none'; form-action 'none'",
    )


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def _measures(contents: Contents) -> list[tuple[str, NDArray[np.float64]]]:
    """What frames differ in, by name."""
    if not contents.truth:
        return [("exposure, ms", 1e3 * np.array([row.exposure_s for row in contents.frames]))]
    whole = [sum(led.visible_fraction >= 1 - 1e-6 for led in row.leds) for row in contents.truth]
    bounds_m = contents.bounds_m()
    fine = len(bounds_m) > 0 and bool(np.median(bounds_m) < 1e-3)
    named = [
        ("tilt of the optical axis, °", np.degrees(np.arccos(np.clip(contents.axes()[:, 2], -1, 1)))),
        ("height of the camera, m", contents.positions_m()[:, 2]),
        ("LEDs whole in view", np.array(whole, dtype=np.float64)),
        ("mean distance to the LEDs in view, m", contents.distances_m()),
        ("exposure, ms", 1e3 * np.array([row.exposure_s for row in contents.frames])),
        ("accelerometer off by, °", contents.gravity_errors_deg()),
        ("Cramér-Rao bound, µm", 1e6 * bounds_m) if fine else ("Cramér-Rao bound, mm", 1e3 * bounds_m),
    ]
    # A unit stays with the word before it.
    return [(name.replace(", ", ",\N{NO-BREAK SPACE}"), values) for name, values in named]


def _previews(contents: Contents) -> list[Preview]:
    """Up to MAX_PREVIEWS previews, evenly selected."""
    paths = sorted((contents.directory / "previews").glob("*.png"))
    count = min(len(paths), MAX_PREVIEWS)
    return [_preview(paths[index * len(paths) // count], contents) for index in range(count)]


def _preview(path: Path, contents: Contents) -> Preview:
    try:
        with Image.open(path) as image:
            small = image.convert("L")
            small.thumbnail((PREVIEW_PX, PREVIEW_PX))
        frame = int(path.stem)
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(f"{path}: is no preview ({type(error).__name__})") from None
    encoded = io.BytesIO()
    small.save(encoded, "WEBP", quality=QUALITY)
    text = f"frame {frame}"
    if (row := next((row for row in contents.truth if row.frame == frame), None)) is not None:
        text += f" · {len(row.leds)} LEDs · {np.degrees(np.arccos(np.clip(row.R_cam_world[8], -1, 1))):.0f}°"
    return Preview(base64.b64encode(encoded.getvalue()).decode(), frame, text)
