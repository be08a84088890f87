"""docs/paper.md and docs/paper.html: claims with their verdicts, then each item, from what docs/paper/ keeps."""

import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from paper_figures import BARE, BARE_CENTROID, CENTROID, PAPER, REDUCED, REDUCED_CENTROID
from paper_items import ITEMS, Item
from paper_sets import BOUND, PAGE, ROOT, key_text

from estimator.evaluate.table_text import value_text

NAMES = {
    PAPER: "paper: reduction, brightest pixel",
    BARE: "no reduction, brightest pixel",
    REDUCED: "paper: reduction, brightest pixel",
    CENTROID: "reduction, centroid",
    REDUCED_CENTROID: "reduction, centroid",
    BARE_CENTROID: "no reduction, centroid",
}
"""Short names of the variants of the paper's stages, for the heads of tables."""

KEYS = {
    "radius_m": "radius",
    "level_db": "noise, dB",
    "width_px": "width, px",
    "border_px": "distance from the border, px",
    "error_deg": "accelerometer error, °",
    "illuminance_lux": "ambient light, lux",
    "luminance_cd_m2": "luminance, cd/m²",
    "tilt_deg": "tilt, °",
    "tilt_x_deg": "tilt x, °",
    "tilt_y_deg": "tilt y, °",
    "yaw_deg": "yaw, °",
}
"""Heads of the columns of keys; lengths in metres have their unit in each cell."""


@dataclass(frozen=True)
class Claim:
    """A claim of the paper as a figure of an item, and when it holds.

    The ratio is the figure over `paper`. The claim holds where the ratio is at most (or at least) `holds`, and in part
    where it is at most (at least) `in_part`. The thresholds were set before the sets were measured.
    """

    item: str
    text: str
    figure: str
    paper: float
    unit: str
    holds: float
    in_part: float
    at_least: bool = False

    def verdict(self, ratio: float) -> str:
        """Verdict of a ratio."""
        if math.isnan(ratio):
            return "no answer"
        sign = -1 if self.at_least else 1
        if sign * ratio <= sign * self.holds:
            return "holds"
        return "in part" if sign * ratio <= sign * self.in_part else "does not hold"


CLAIMS = (
    Claim(
        "fig5",
        "An LED's image is bell-shaped: pixels near the peak, of those above half of it",
        "flat",
        0.074,
        "%",
        2,
        4,
    ),
    Claim(
        "fig6",
        "The error falls with the resolution: 200 over 4000 px, photon noise",
        "fall",
        1,
        "",
        2,
        1.2,
        True,
    ),
    Claim("fig6_peak", "The same, noise relative to the peak", "fall", 1, "", 2, 1.2, True),
    Claim(
        "fig6",
        "Little changes beyond 2000 x 1500: error at 2000 over 4000 px, photon noise",
        "rest",
        1,
        "",
        1.25,
        2,
    ),
    Claim("fig6_peak", "The same, noise relative to the peak", "rest", 1, "", 1.25, 2),
    Claim("table1", "All 350 x 350 poses see the four LEDs", "seen_x", 1, "%", 0.95, 0.5, True),
    Claim("table1", "The method is accurate to 10 cm", "paper", 0.1, "m", 1, 2),
    Claim("table2", "2 deg of error in the accelerometer cost 0.456 um, level", "level", 4.56e-7, "m", 10, 1000),
    Claim("table2", "The same, tilted", "tilted", 4.56e-7, "m", 10, 1000),
    Claim("fig7", "The error is below 0.1 m at all tilts, exact accelerometer", "worst", 0.1, "m", 1, 2),
    Claim("fig7", "The same, 0.5 deg of error", "worst_half", 0.1, "m", 1, 2),
    Claim(
        "fig8",
        "120 neighbours tell a pixel's noise: their variance over Skellam's, in an LED",
        "centre",
        1,
        "",
        0.9,
        0.7,
        True,
    ),
    *(
        claim
        for reading, words in (
            ("photon", "photon noise"),
            ("peak", "relative to the peak"),
            ("variance", "relative to the variance"),
        )
        for size, width in (("fits", "11 px"), ("wide", "43 px"))
        for claim in (
            Claim(
                "fig9",
                f"Without reduction noise raises the error: 0 over -9 dB, {words}, {width}",
                f"{reading}_{size}_bare_growth",
                1,
                "",
                3,
                1.5,
                True,
            ),
            Claim(
                "fig9",
                f"With reduction the error is stable: 0 over -9 dB, {words}, {width}",
                f"{reading}_{size}_paper_growth",
                1,
                "",
                1.5,
                3,
            ),
            Claim(
                "fig9",
                f"Reduction helps at 0 dB: without over with, {words}, {width}",
                f"{reading}_{size}_gain",
                1,
                "",
                2,
                1.2,
                True,
            ),
        )
    ),
    *(
        claim
        for of, level in (("table3", "ideal"), ("table3_calibrated", "calibrated"))
        for claim in (
            Claim(of, f"Proposed method, 10 cm; {level}", "paper", 0.1, "m", 1, 2),
            Claim(of, f"Yoshino, 7 cm; {level}", "yoshino", 0.07, "m", 1, 2),
            Claim(of, f"Nakazawa, 10 cm; {level}", "nakazawa", 0.1, "m", 1, 2),
            Claim(of, f"Rahman, 15 cm; {level}", "rahman", 0.15, "m", 1, 2),
            Claim(of, f"Kim, 85 cm; {level}", "kim", 0.85, "m", 1, 2),
            Claim(
                of,
                f"The proposed method keeps its accuracy in noise: -9 over -35 dB; {level}",
                "paper_growth",
                1,
                "",
                1.5,
                3,
            ),
            Claim(
                of,
                f"Others lose theirs: Yoshino, -9 over -35 dB; {level}",
                "yoshino_growth",
                1,
                "",
                3,
                1.5,
                True,
            ),
        )
    ),
    Claim(
        "luminance",
        "The error changes little with the luminance: largest over smallest",
        "paper_spread",
        1,
        "",
        1.25,
        2,
    ),
    Claim("ambient", "LEDs stand out: frames answered", "rate", 1, "%", 0.99, 0.9, True),
    Claim(
        "ambient", "Ambient light does not affect the accuracy: largest over smallest", "paper_spread", 1, "", 1.25, 2
    ),
)


VERDICT, FULL_VERDICT = 6, 8
"""Columns of the verdicts in a claim's row."""


class Figure(float):
    """A number in a sentence: the format `m` is a length, `%` a share with one digit, `.3%` with three."""

    def __format__(self, spec: str) -> str:
        """The number in a format; `m` and `%` are this class's own."""
        if spec == "m":
            return value_text("_m", float(self))
        return f"{100 * self:{spec[:-1] or '.1'}f} %" if spec.endswith("%") else format(float(self), spec)


def kept(name: str) -> dict[str, Any] | None:
    """What docs/paper/ keeps of an item, or of `full/ITEM` at the paper's size; None where it was not run."""
    path = PAGE / f"{name}.json"
    return json.loads(path.read_text()) if path.is_file() else None


def claim_row(claim: Claim, figures: Mapping[str, float] | None, full: Mapping[str, float] | None) -> list[str]:
    """Cells of a claim: item, text, paper, ours, ratio, threshold, verdict; ours and verdict at the paper's size."""
    sign = ">=" if claim.at_least else "<="
    threshold = f"{sign} {claim.holds:g} ({claim.in_part:g})"
    ours, ratio, verdict = _judged(claim, figures)
    of_full, _, full_verdict = ("", "", "") if full is None else _judged(claim, full)
    paper = _number(claim.paper, claim.unit)
    return [claim.item, claim.text, paper, ours, ratio, threshold, verdict, of_full, full_verdict]


def _judged(claim: Claim, figures: Mapping[str, float] | None) -> tuple[str, str, str]:
    """Ours, its ratio to the paper's, and the verdict."""
    if figures is None:
        return "", "", "not run"
    value = figures.get(claim.figure)
    ours = math.nan if value is None else value
    ratio = ours / claim.paper
    return _number(ours, claim.unit), _ratio(ratio), claim.verdict(ratio)


def _ratio(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3g}" if value < 1e4 else f"{value:.1e}"


def _number(value: float, unit: str) -> str:
    if math.isnan(value):
        return "–"
    return f"{Figure(value):{unit}}" if unit else f"{value:.3g}"


def view_table(view: Mapping[str, Any]) -> dict[str, Any]:
    """A kept table with a row for each key and a column for each group: mean, interval, failed frames."""
    groups = list(dict.fromkeys(row["group"] for row in view["rows"]))
    by_key: dict[tuple[Any, ...], dict[str, Mapping[str, Any]]] = {}
    for row in view["rows"]:
        by_key.setdefault(tuple(row["x"]), {})[row["group"]] = row
    along = len(by_key) >= len(groups)
    lines, columns = (list(by_key), groups) if along else (groups, list(by_key))
    cells = []
    for line in lines:
        of_line = [by_key[line].get(one) if along else by_key[one].get(line) for one in columns]
        first = list(map(_key, view["x"], line)) if along else [NAMES.get(line, line)]
        cells.append([*first, *(_statistic(view, row) for row in of_line)])
    heads = [NAMES.get(one, one) if along else ", ".join(map(_key, view["x"], one)) for one in columns]
    keys = [KEYS.get(name, name) for name in view["x"]]
    frames = sorted({row["frames"] for row in view["rows"]})
    return {
        "head": [*(keys if along else [f"variant; {'; '.join(keys)}"]), *heads],
        "rows": cells,
        "frames": " to ".join(str(one) for one in dict.fromkeys((frames[0], frames[-1]))),
        "failures": failures(view),
    }


def _key(name: str, value: float | str) -> str:
    return value_text(name, value) if name.endswith("_m") and not isinstance(value, str) else key_text(value)


def _statistic(view: Mapping[str, Any], row: Mapping[str, Any] | None) -> str:
    if row is None:
        return ""
    value, low, high = row[view["shown"]]
    failed = 0 if row["group"] == BOUND else row["frames"] - row["answered"]
    more = f"; {failed} failed" if failed else ""
    if value is None:
        return more.removeprefix("; ") or "–"
    ends = "" if low is None else f" ({value_text('_m', low)} to {'∞' if high is None else value_text('_m', high)})"
    return f"{value_text('_m', value)}{ends}{more}"


def failures(view: Mapping[str, Any]) -> list[str]:
    """Failed frames of a table: each reason, the most frequent first, with the frames of each variant."""
    counts: dict[str, dict[str, int]] = {}
    for row in view["rows"]:
        for reason, count in {} if row["group"] == BOUND else row["failures"].items():
            of_reason, name = counts.setdefault(reason, {}), NAMES.get(row["group"], row["group"])
            of_reason[name] = of_reason.get(name, 0) + count
    return [
        f"{reason}: {', '.join(f'{name} {count}' for name, count in of_reason.items())}"
        for reason, of_reason in sorted(counts.items(), key=lambda one: -sum(one[1].values()))
    ]


def sentence(item: Item, figures: Mapping[str, float | None]) -> str:
    """The finding of an item with its figures."""
    return (
        item.text["finding"]
        .strip()
        .format_map({key: Figure(math.nan if one is None else one) for key, one in figures.items()})
    )


def section(item: Item) -> dict[str, Any]:
    """What the templates show of an item."""
    record = kept(item.name)
    base = {"name": item.name, "title": item.text["title"], "paper": item.text["paper"], "run": record is not None}
    if record is None:
        return base
    inside, means = (sum(view["seeds"][index] for view in record["views"]) for index in (0, 1))
    return base | {
        "finding": sentence(item, record["figures"]),
        "views": [view | view_table(view) for view in record["views"]],
        "grids": record["grids"],
        "sets": record["sets"],
        "command": record["command"],
        "commit": record["commit"],
        "seeds": record["seeds"],
        "inside": f"{inside} of {means}" if means else "",
        "cpu_s": sum(one["generate_s"] + one["estimate_s"] for one in record["sets"]),
        "frames": sum(one["frames"] for one in record["sets"]),
        "full": full_size(item),
    }


def full_size(item: Item) -> dict[str, Any] | None:
    """What the templates show of an item at the paper's size; None where it was not run."""
    record = kept(f"full/{item.name}")
    if record is None:
        return None
    frames = sum(one["frames"] for one in record["sets"])
    views = [{"title": view["title"], "stem": f"full/{item.name}-{view['name']}"} for view in record["views"]]
    return {"command": record["command"], "commit": record["commit"], "frames": frames, "views": views}


def pages() -> dict[str, str]:
    """Texts of docs/paper.md and docs/paper.html by name."""
    figures, full = (
        {name: (record := kept(folder + name)) and record["figures"] for name in ITEMS} for folder in ("", "full/")
    )
    claims = [claim_row(claim, figures[claim.item], full[claim.item]) for claim in CLAIMS]
    sections = [section(item) for item in ITEMS.values()]
    verdicts = [row[VERDICT] for row in claims]
    full_verdicts = [row[FULL_VERDICT] for row in claims]
    differ = [one for one, other in zip(full_verdicts, verdicts, strict=True) if one and one != other]
    context = {
        "claims": claims,
        "counts": _counts(verdicts),
        "full_counts": _counts(full_verdicts) | {"differ": len(differ)},
        "open": next(one for one in sections if one["name"] == "open"),
        "sections": [one for one in sections if one["name"] != "open"],
        "not_run": [one["title"] for one in sections if not one["run"]],
        "prose": tomllib.loads((PAGE / "templates" / "text.toml").read_text())["page"],
        "cpu_min": sum(one["cpu_s"] for one in sections if one["run"]) / 60,
    }
    texts = {}
    for name in ("paper.md", "paper.html"):
        environment = Environment(
            loader=FileSystemLoader(PAGE / "templates"),
            autoescape=name.endswith(".html"),
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
            keep_trailing_newline=True,
        )
        environment.filters["row"] = markdown_row
        texts[name] = environment.get_template(name).render(context)
    return texts


def _counts(verdicts: Sequence[str]) -> dict[str, int]:
    """How many claims have each verdict."""
    return {one: verdicts.count(one) for one in ("holds", "in part", "does not hold", "no answer", "not run")}


def markdown_row(cells: Sequence[object]) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(str(cell).replace('|', '/') for cell in cells)} |"


def write_pages() -> None:
    """Write docs/paper.md and docs/paper.html."""
    for name, text in pages().items():
        (ROOT / "docs" / name).write_text(text, encoding="utf-8")
