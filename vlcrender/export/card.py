"""A dataset card: README.md with the metadata that Hugging Face reads, and what a user has to know of the set."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlcrender.dataset.format.files import whole_file
from vlcrender.export.source import Source

HUB_LICENCES = (
    "apache-2.0 mit bsd-2-clause bsd-3-clause cc0-1.0 cc-by-2.0 cc-by-2.5 cc-by-3.0 cc-by-4.0 cc-by-sa-3.0 "
    "cc-by-sa-4.0 cc-by-nc-2.0 cc-by-nc-3.0 cc-by-nc-4.0 cc-by-nd-4.0 cc-by-nc-nd-3.0 cc-by-nc-nd-4.0 "
    "cc-by-nc-sa-2.0 cc-by-nc-sa-3.0 cc-by-nc-sa-4.0 cdla-sharing-1.0 cdla-permissive-1.0 cdla-permissive-2.0 "
    "odbl pddl unlicense wtfpl gpl-3.0 lgpl-3.0 agpl-3.0 mpl-2.0 isc zlib"
)
"""Identifiers of Hugging Face's `license`; any other licence is `other` with a name."""
HUB_NAMES = {"odbl-1.0": "odbl", "pddl-1.0": "pddl"}
SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))


def write(source: Source, out: Path) -> Mapping[str, Any]:
    """Write the card to the file `out`."""
    with whole_file(out) as partial:
        partial.write_text(card(source), encoding="utf-8")
    return {}


def card(source: Source) -> str:
    """The card: front matter in YAML, then Markdown."""
    dataset = source.dataset
    recipe = dataset.provenance.get("recipe", {})
    description = recipe.get("description") or "Rendered images of ceiling LEDs."
    size = next((name for limit, name in SIZES if dataset.frame_count < limit), "n>1M")
    head = ["---", f"pretty_name: {json.dumps(dataset.name)}", *_licence_lines(dataset.licence)]
    head += ["size_categories:", f"- {json.dumps(size)}", "tags:"]
    head += [f"- {tag}" for tag in ("visible-light-positioning", "synthetic", "camera", "vlcrender")]
    head += ["configs:", "- config_name: frames", "  data_files: frames.parquet"]
    if source.has_truth:
        head += ["- config_name: truth", "  data_files: truth.parquet"]
    head.append("---")
    leds = "sent by the LEDs" if dataset.led_map is None else f"{len(dataset.led_map)} LEDs"
    x, y, z = dataset.room_m
    truth = (
        "`truth.parquet` holds the true pose of each frame."
        if source.has_truth
        else "The truth of some or all frames is withheld or missing."
    )
    regions = " Only regions of interest are read out." if recipe.get("regions") else ""
    belief = (
        " Cameras and map that a device is told differ from the true ones (`[belief]`)."
        if recipe.get("belief")
        else " A device is told camera and map exactly: errors of real calibrations are not in this set."
    )
    versions = ", ".join(f"{name} {number}" for name, number in dataset.provenance.get("versions", {}).items())
    body = [
        "",
        f"# {dataset.name}",
        "",
        description,
        "",
        "Images of ceiling LEDs as a camera sees them, rendered by vlcrender, with ground truth for positioning.",
        "",
        "| | |",
        "| --- | --- |",
        f"| frames | {dataset.frame_count} |",
        f"| room | {x:g} x {y:g} x {z:g} m |",
        f"| map | {leds} |",
        *(_camera_line(name, entry) for name, entry in dataset.cameras.items()),
        f"| sensor | {dataset.sensor.bits} bits, noise `{dataset.sensor.noise}`, mosaic `{dataset.sensor.mosaic}` |",
        f"| licence | {dataset.licence or 'not stated'} |",
        f"| made by | {versions} |",
        "",
        "## Files",
        "`dataset.json` describes cameras, sensor and LED map; `frames.parquet` has a row for each frame with what a "
        f"device knows; `frames/` holds the raw images. {truth} The format is vlcrender's datasets/FORMAT.md, version "
        f"{dataset.version}.",
        "",
        "## What to know",
        "- Estimators must not read `truth*.parquet`, nor `provenance` in `dataset.json`: its seed gives the truth.",
        "- Pixel positions are continuous with pixel centres at +0.5; OpenCV has them at integers: subtract 0.5.",
        f"- All images are simulated.{regions}{belief}",
        "",
        "## Check and load",
        "```",
        "vlcrender verify .",
        "```",
        "```python",
        'import pandas as pd; frames = pd.read_parquet("frames.parquet")',
        "```",
        "",
    ]
    return "\n".join([*head, *body])


def _camera_line(name: str, entry: Any) -> str:
    lens = entry.projection if entry.distortion is None else f"{entry.projection}, distorted"
    return (
        f"| camera {name} | {entry.width_px} x {entry.height_px} px of {entry.pixel_pitch_um:g} um, "
        f"{entry.focal_length_mm:g} mm f/{entry.f_number:g}, {lens}, {entry.shutter.kind} shutter |"
    )


def _licence_lines(licence: str | None) -> list[str]:
    """The keys `license` and, for those that Hugging Face does not list, `license_name`; none where not stated."""
    if licence is None:
        return []
    name = HUB_NAMES.get(licence.lower(), licence.lower())
    if name in HUB_LICENCES.split():
        return [f"license: {name}"]
    return ["license: other", f"license_name: {json.dumps(licence)}"]
