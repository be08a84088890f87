"""HTML page of the scores of one or more datasets: one file that needs no other and no network.

report.html beside this module is its template, report.css its style; numbers.js, axes.js, pictures.js and browser.js
draw. A content security policy allows these alone, by their digests, and pictures that the page holds itself.
"""

import base64
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from estimator.errors import InputError
from estimator.evaluate.levels import levels_of
from estimator.evaluate.score import Scores, VariantScore
from estimator.evaluate.score_table import (
    GROUP_HEADERS,
    GROUP_NOTE,
    IDENTITY_HEADERS,
    IDENTITY_NOTE,
    LOST_HEADERS,
    LOST_NOTE,
    group_cells,
    has_groups,
    identity_cells,
    lost_cells,
)
from estimator.io.dataset import read_dataset
from estimator.io.results import dataset_folder
from estimator.report.answer import (
    SHARES,
    AnswerRow,
    ShareRow,
    answer_rows,
    diagonal_m,
    failure_rows,
    lede,
    ordered,
    share_rows,
    unit_of,
)
from estimator.report.facts import facts
from estimator.report.levels import level_plot
from estimator.report.looks import look_key
from estimator.report.numbers import UNITS, three
from estimator.report.page_data import page_data, script_json
from estimator.report.thumbnail import thumbnail

SCRIPTS = ("numbers.js", "axes.js", "pictures.js", "browser.js")
FINE_SHARES = (5, 10, 25, 50, 75, 90, 95, 99, 100)

TEMPLATES = Environment(
    loader=PackageLoader("estimator.report", "."),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
TEMPLATES.filters["three"] = three


@dataclass(frozen=True)
class Table:
    """Table with a column of variants: heads of the other columns, and each variant's mark, name and cells."""

    title: str
    heads: Sequence[str]
    rows: Sequence[tuple[Markup, str, Sequence[str]]]
    note: str


@dataclass(frozen=True)
class Section:
    """Part of the page for one dataset."""

    id: str
    folder: str
    scores: Scores
    variants: Sequence[VariantScore]
    inapplicable: Sequence[VariantScore]
    lede: Markup
    facts: Sequence[tuple[str, str]]
    thumbnail: Markup
    unit: str
    rows: Sequence[AnswerRow]
    shares: Sequence[ShareRow]
    fine_shares: Sequence[ShareRow]
    failures: Sequence[tuple[VariantScore, Markup, list[tuple[str, int]]]]
    tables: Sequence[Table]
    data: Markup

    @property
    def has(self) -> dict[str, bool]:
        """Which columns of the table of errors have a value."""
        return {
            "ratio": any(row.ratio for row in self.rows),
            "nees": any(row.nees for row in self.rows),
            "ambiguous": any(one.ambiguous for one in self.variants),
        }


def page(datasets: Sequence[tuple[Path, Scores]]) -> str:
    """The page, for datasets given as folder and scores; what else their folders still hold is shown too.

    Raises OSError or InputError if a preview cannot be read.
    """
    style = _file("report.css")
    script = "\n".join(map(_file, SCRIPTS))
    return TEMPLATES.get_template("report.html").render(
        sections=[_section(f"set{index}", folder, scores) for index, (folder, scores) in enumerate(datasets)],
        level_plot=Markup(_levels(datasets)),
        style=Markup(style),
        script=Markup(script),
        policy=content_policy(style, script),
        units=UNITS,
        infinity=math.inf,
        share_heads=SHARES,
        fine_share_heads=FINE_SHARES,
        commands=" ".join(str(folder) for folder, _ in datasets),
    )


def content_policy(style: str, script: str) -> str:
    """Content security policy: this style, this script and embedded pictures; nothing from outside, no form."""
    return (
        f"default-src 'none'; style-src '{_digest(style)}'; script-src '{_digest(script)}'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def _file(name: str) -> str:
    return files("estimator.report").joinpath(name).read_text(encoding="utf-8")


def _section(id_: str, folder: Path, scores: Scores) -> Section:
    variants, inapplicable = ordered(scores)
    try:
        dataset = read_dataset(folder)
    except InputError:
        dataset = None  # scores.json holds all that a page has to have
    data: dict[str, Any] = page_data(folder, scores, variants, dataset)
    return Section(
        id=id_,
        folder=str(folder),
        scores=scores,
        variants=variants,
        inapplicable=inapplicable,
        lede=lede(scores, variants),
        facts=facts(dataset_folder(folder), scores),
        thumbnail=thumbnail(scores),
        unit=unit_of(variants),
        rows=answer_rows(variants, diagonal_m(scores)),
        shares=share_rows(variants, scores),
        fine_shares=share_rows(variants, scores, FINE_SHARES),
        failures=failure_rows(variants),
        tables=_tables(variants),
        data=script_json(data),
    )


def _tables(variants: Sequence[VariantScore]) -> list[Table]:
    """Tables that only some sets have: by device and map, identities, failed frames by good LEDs."""
    chosen = (
        (any(map(has_groups, variants)), "By device and map", GROUP_HEADERS, group_cells, GROUP_NOTE),
        (any(one.downlink for one in variants), "Identities", IDENTITY_HEADERS, identity_cells, IDENTITY_NOTE),
        (any(one.failed for one in variants), "Failed frames by good LEDs", LOST_HEADERS, lost_cells, LOST_NOTE),
    )
    return [
        Table(title, heads, [(Markup(look_key(v.entry.look)), v.variant, cells(v)) for v in variants], note)
        for there, title, heads, cells, note in chosen
        if there
    ]


def _levels(datasets: Sequence[tuple[Path, Scores]]) -> str:
    """Plot of the levels; empty unless there are several datasets and all have a bound."""
    try:
        levels = levels_of(datasets)
    except InputError:
        return ""
    return level_plot(levels) if len(levels) > 1 else ""
