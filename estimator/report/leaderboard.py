"""Leaderboard of the submissions to a benchmark, as a page of HTML without other files, or as Markdown.

Ranked by the third quartile of the errors of all frames, as the competitions of the IPIN conference are (F. Potortì et
al., Comparing the performance of indoor localization systems through the EvAAL framework, Sensors 17 (2017) 2327). A
frame without an answer counts as infinite error. leaderboard.html beside this module is the template.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

from jinja2 import Environment, PackageLoader, StrictUndefined

from estimator.evaluate.score_table import length_text, share_text
from estimator.evaluate.statistics import percentile_of_all
from estimator.evaluate.submission import Entry

RankedBy = Literal["horizontal", "3d"]
HEADERS = ("rank", "submission", "author", "variant", "third quartile", "median", "95 %")
OTHER_HEADERS = ("third quartile", "median", "95 %", "answered")
NOTE = (
    "Third quartile, median and 95th percentile of the errors of all {frames} judged frames; a frame without an answer "
    "counts as infinite error, and percentiles are not interpolated. Ranked by the third quartile of the {by} error; "
    "equal ones share a rank."
)
NAMES: dict[RankedBy, str] = {"horizontal": "horizontal", "3d": "3D"}


@dataclass(frozen=True)
class Place:
    """Row of the leaderboard; percentiles in metres, None for infinite ones."""

    rank: int
    entry: Entry
    horizontal_m: tuple[float | None, float | None, float | None]
    """Third quartile, median, 95th percentile."""
    error_3d_m: tuple[float | None, float | None, float | None]

    def cells(self, by: RankedBy) -> list[str]:
        """Texts of the row: the ranking error first, then the other."""
        first, other = (self.horizontal_m, self.error_3d_m)[:: 1 if by == "horizontal" else -1]
        score = self.entry.score
        return [
            *(str(self.rank), self.entry.name, self.entry.author or "–", score.variant),
            *map(_text, first),
            *map(_text, other),
            share_text(score.ok, score.frames),
        ]


def places(entries: Sequence[Entry], by: RankedBy = "3d") -> list[Place]:
    """Rows in the order of their ranks; those of one rank by median, then 95th percentile, then name."""
    found = []
    for entry in entries:
        horizontal = [row.horizontal_error_m for row in entry.score.rows]
        error_3d = [row.error_3d_m for row in entry.score.rows]
        found.append(Place(0, entry, _quartiles(horizontal), _quartiles(error_3d)))

    def order(place: Place) -> tuple[float, ...]:
        sizes_m = place.horizontal_m if by == "horizontal" else place.error_3d_m
        return tuple(float("inf") if size_m is None else size_m for size_m in sizes_m)

    found.sort(key=lambda place: (order(place), place.entry.name, place.entry.score.variant))
    firsts = [order(place)[0] for place in found]
    return [
        Place(firsts.index(first) + 1, place.entry, place.horizontal_m, place.error_3d_m)
        for first, place in zip(firsts, found, strict=True)
    ]


def _quartiles(errors_m: Sequence[float | None]) -> tuple[float | None, float | None, float | None]:
    q75, q50, q95 = (percentile_of_all(errors_m, percent) for percent in (75, 50, 95))
    return q75, q50, q95


def _text(size_m: float | None) -> str:
    return "∞" if size_m is None else length_text(size_m)


def headers(by: RankedBy) -> list[str]:
    """Headers of `Place.cells`."""
    other: RankedBy = "3d" if by == "horizontal" else "horizontal"
    first = [f"{NAMES[by]} {header}" if at >= 4 else header for at, header in enumerate(HEADERS)]
    return [*first, *(f"{NAMES[other]} {header}" if header != "answered" else header for header in OTHER_HEADERS)]


def note(found: Sequence[Place], by: RankedBy) -> str:
    """The sentence below the table."""
    return NOTE.format(frames=found[0].entry.score.frames if found else 0, by=NAMES[by])


def html_page(dataset: str, found: Sequence[Place], by: RankedBy) -> str:
    """The page, which needs no other file and no network; texts of submissions are escaped."""
    environment = Environment(
        loader=PackageLoader("estimator.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    rows = [place.cells(by) for place in found]
    return environment.get_template("leaderboard.html").render(
        dataset=dataset, headers=headers(by), rows=rows, note=note(found, by), texts=4
    )


def markdown(dataset: str, found: Sequence[Place], by: RankedBy) -> str:
    """The same table in Markdown; texts of submissions are escaped."""
    head = headers(by)
    lines = [f"# Leaderboard: {_escaped(dataset)}", "", _row(head), _row(["---"] * 4 + ["---:"] * (len(head) - 4))]
    lines += [_row([_escaped(cell) for cell in place.cells(by)]) for place in found]
    return "\n".join([*lines, "", note(found, by), ""])


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _escaped(text: str) -> str:
    return escape("".join(f"\\{letter}" if letter in "\\`*_[]|#!" else letter for letter in text), quote=False)
