"""HTML page of the scores of one or more datasets; it needs no other file and no network.

report.html beside this module is its template.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from estimator.errors import InputError
from estimator.evaluate.comparison import best, compare
from estimator.evaluate.levels import levels_of, variants_of
from estimator.evaluate.score import Scores, VariantScore
from estimator.evaluate.score_table import (
    ERROR_HEADERS,
    ERROR_NOTE,
    GROUP_HEADERS,
    GROUP_NOTE,
    IDENTITY_HEADERS,
    IDENTITY_NOTE,
    LIMIT_HEADERS,
    LIMIT_NOTE,
    LOST_HEADERS,
    LOST_NOTE,
    PAIR_HEADERS,
    PAIR_NOTE,
    error_cells,
    group_cells,
    has_groups,
    identity_cells,
    limit_cells,
    lost_cells,
    pair_cells,
)
from estimator.io.results import dataset_folder
from estimator.report.figures import device_plot, distribution_plot, error_plot, frames_with_bound
from estimator.report.floor_plan import estimates_outside, floor_plan
from estimator.report.levels import level_plot
from estimator.report.svg import key, style_of_variants

# Previews are for an impression; a page of thousands of them would not open.
MAX_PREVIEWS = 12
MAX_LARGE_PLANS = 6

TEMPLATES = Environment(
    loader=PackageLoader("estimator.report", "."),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
TEMPLATES.globals["variant_key"] = lambda index: Markup(key(index))


@dataclass(frozen=True)
class Cell:
    """Cell of a table; an interval stands in small type below the text."""

    text: str
    interval: str = ""
    failed: bool = False


@dataclass(frozen=True)
class Table:
    """Table with a column of variants: the head and the rows, each with the index of its variant, hold the others."""

    head: Sequence[Cell]
    rows: Sequence[tuple[int, Sequence[Cell]]]
    note: str


@dataclass(frozen=True)
class Preview:
    """Preview of a frame, embedded in the page."""

    name: str
    png_base64: str


@dataclass(frozen=True)
class Section:
    """Part of the page for one dataset. Tables that would be empty are None, the plots are SVG elements."""

    name: str
    frames: int
    leds: int
    room: str
    variants: Sequence[VariantScore]
    scores: Table
    limits: Table | None
    groups: Table | None
    identities: Table | None
    lost: Table | None
    pairs: Table | None
    best: str
    failures: Sequence[tuple[int, str, int]]
    """Index of the variant, reason, number of frames."""
    bounded: int
    error_plot: Markup
    distribution_plot: Markup
    device_plots: Sequence[Markup]
    """RMSE and NEES by device; empty for one device."""
    plans: Sequence[tuple[Markup, int]]
    """Floor plan of each variant, and its number of estimates outside the walls."""
    previews: Sequence[Preview]
    preview_count: int


def page(datasets: Sequence[tuple[Path, Scores]]) -> str:
    """The page, for datasets given as folder and scores; of the folders, only previews are read.

    Raises OSError if a preview cannot be read.
    """
    plot, of_levels = _levels(datasets)
    max_variants = max([of_levels, *(len(scores.variants) for _, scores in datasets)])
    return TEMPLATES.get_template("report.html").render(
        sections=[_section(folder, scores) for folder, scores in datasets],
        level_plot=Markup(plot),
        variant_style=Markup(style_of_variants(max_variants)),
        max_large_plans=MAX_LARGE_PLANS,
    )


def _section(folder: Path, scores: Scores) -> Section:
    variants = scores.variants
    room_m = scores.room_m
    leds_m = [led.position_m for led in scores.led_map]
    previews = sorted((dataset_folder(folder) / "previews").glob("*.png"))
    return Section(
        name=scores.dataset,
        frames=variants[0].frames if variants else 0,
        leds=len(leds_m),
        room="unknown" if room_m is None else " × ".join(f"{side:g}" for side in room_m),
        variants=variants,
        scores=_table(ERROR_HEADERS, [(index, error_cells(v)) for index, v in enumerate(variants)], ERROR_NOTE),
        limits=_limit_table(variants),
        groups=_group_table(variants),
        identities=_identity_table(variants),
        lost=_lost_table(variants),
        pairs=_pair_table(variants),
        best=best(variants).variant if variants else "",
        failures=[(i, reason, count) for i, v in enumerate(variants) for reason, count in v.failures.items()],
        bounded=len(frames_with_bound(variants)),
        error_plot=Markup(error_plot(variants)),
        distribution_plot=Markup(distribution_plot(variants)),
        device_plots=[Markup(device_plot(variants, nees)) for nees in (False, True) if any(map(has_groups, variants))],
        plans=[
            (Markup(floor_plan(room_m, leds_m, v, index)), estimates_outside(room_m, v))
            for index, v in enumerate(variants)
            if room_m is not None
        ],
        previews=_selected(previews),
        preview_count=len(previews),
    )


def _limit_table(variants: Sequence[VariantScore]) -> Table | None:
    """Table of bounds and covariances; None if there is none, and no estimate is ambiguous."""
    if not any(variant.against_bound or variant.nees or variant.ambiguous for variant in variants):
        return None
    return _table(LIMIT_HEADERS, [(index, limit_cells(variant)) for index, variant in enumerate(variants)], LIMIT_NOTE)


def _group_table(variants: Sequence[VariantScore]) -> Table | None:
    """Table by device and map; None for one device."""
    if not any(map(has_groups, variants)):
        return None
    return _table(GROUP_HEADERS, [(index, group_cells(variant)) for index, variant in enumerate(variants)], GROUP_NOTE)


def _identity_table(variants: Sequence[VariantScore]) -> Table | None:
    """Table of identities that a receiver decoded; None where they were given."""
    if not any(variant.downlink for variant in variants):
        return None
    cells = [(index, identity_cells(variant)) for index, variant in enumerate(variants)]
    return _table(IDENTITY_HEADERS, cells, IDENTITY_NOTE)


def _lost_table(variants: Sequence[VariantScore]) -> Table | None:
    """Table of failed frames by good LEDs; None if no frame failed."""
    if not any(variant.failed for variant in variants):
        return None
    return _table(LOST_HEADERS, [(index, lost_cells(variant)) for index, variant in enumerate(variants)], LOST_NOTE)


def _levels(datasets: Sequence[tuple[Path, Scores]]) -> tuple[str, int]:
    """Plot of the levels, and its number of variants; empty unless there are several datasets and all have a bound."""
    try:
        levels = levels_of(datasets)
    except InputError:
        return "", 0
    return (level_plot(levels), len(variants_of(levels))) if len(levels) > 1 else ("", 0)


def _pair_table(variants: tuple[VariantScore, ...]) -> Table | None:
    """Table of every variant compared with the best; None for a single variant."""
    if len(variants) < 2:
        return None
    of_best = best(variants)
    rows = [
        (index, pair_cells(compare(variant, of_best)))
        for index, variant in enumerate(variants)
        if variant is not of_best
    ]
    note = (
        f"A: the row's variant. B: {of_best.variant}, with the smallest median error of all frames. It was selected on "
        f"the same frames, which favours it. {PAIR_NOTE}"
    )
    return _table(PAIR_HEADERS, rows, note)


def _table(headers: Sequence[str], rows: Sequence[tuple[int, Sequence[str]]], note: str) -> Table:
    return Table(_folded(headers, headers), [(index, _folded(headers, cells)) for index, cells in rows], note)


def _folded(headers: Sequence[str], cells: Sequence[str]) -> list[Cell]:
    """Cells of a row; the columns of intervals are folded into the cells before them."""
    folded: list[Cell] = []
    for header, cell in zip(headers, cells, strict=True):
        if not header.endswith("interval"):
            folded.append(Cell(cell, failed=header == "failed" and cell not in ("0", header)))
        elif cell != "–":
            folded[-1] = replace(folded[-1], interval=cell)
    return folded


def _selected(paths: Sequence[Path]) -> list[Preview]:
    """Up to MAX_PREVIEWS previews, evenly selected."""
    count = min(len(paths), MAX_PREVIEWS)
    selected = [paths[index * len(paths) // count] for index in range(count)]
    return [Preview(path.stem, base64.b64encode(path.read_bytes()).decode()) for path in selected]
