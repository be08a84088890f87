"""Scores on a terminal or in a text: one unit a table, nearest variant first, no figure cut whatever the width."""

import csv
import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby

from estimator.errors import InputError
from estimator.evaluate.score import Scores, VariantScore
from estimator.evaluate.statistics import Summary
from estimator.io.dataset import Dataset
from estimator.report.answer import diagonal_m, ordered, unit_of, verdict_of
from estimator.report.numbers import UNITS, three

GAP = "  "
FEW_FRAMES = 20
"""Frames below which the lines say that there are few."""
MAX_REASONS = 4
"""Reasons of failed frames that are told of a variant, the most frequent ones."""
BARS, PLAIN_BARS = " ▁▂▃▄▅▆▇█", " .:-=+*#@"
MAX_DECADE_TEXT = 7
"""Characters of the longest name of a decade, `100 µm`, and a space."""
BINS_A_DECADE = 8
"""Bins of the spread in a decade of errors."""
MAX_DECADES = 6
CAPTION = "3D error in {unit}, nearest first; a failed frame counts as infinitely wrong."


@dataclass(frozen=True)
class Column:
    """Column of figures; where the width does not suffice for all, those of the highest `rank` are left out."""

    name: str
    rank: int
    cells: Sequence[str]

    @property
    def is_empty(self) -> bool:
        """Whether no variant has a value."""
        return not any(self.cells)

    def aligned(self) -> list[str]:
        """Header and cells of one width: decimal points stand under each other."""
        tail = max((len(_tail(cell)) for cell in self.cells), default=0)
        cells = [cell + " " * (tail - len(_tail(cell))) for cell in self.cells]
        width = max(map(len, [self.name, *cells]))
        return [one.rjust(width) for one in (self.name, *cells)]


def _tail(cell: str) -> str:
    """A figure from its decimal point on, with the mark behind it; nothing of an interval."""
    if " to " in cell:
        return ""
    digits = cell.rstrip("+-")
    point = digits.find(".")
    return cell[point if point >= 0 else len(digits) :] if digits[:1].isdigit() else ""


def columns_of(variants: Sequence[VariantScore], unit: str, diag_m: float) -> list[Column]:
    """All columns that have a value; lengths in `unit`, "out" beyond `diag_m`."""
    unit_m = UNITS[unit]

    def size(size_m: float | None) -> str:
        if size_m is None or math.isinf(size_m):
            return "inf"
        return "out" if size_m > diag_m else three(size_m / unit_m).replace("\u202f", " ")

    def of_answered(summary: Callable[[VariantScore], Summary | None], field: str) -> list[str]:
        found = [(summary(one), one.frames) for one in variants]
        return ["" if part is None else size(getattr(part, field)) for part, _ in found]

    def interval(one: VariantScore) -> str:
        if one.median_interval is None or one.failed:
            return ""
        return f"{size(one.median_interval.low_m)} to {size(one.median_interval.high_m)}"

    def nees(one: VariantScore) -> str:
        if one.nees is None:
            return ""
        mark = {"overconfident": "+", "conservative": "-", "consistent": ""}[verdict_of(one.nees)]
        return three(one.nees.mean).replace("\u202f", " ") + mark

    columns = (
        Column("median", 0, [size(None if one.of_all is None else one.of_all.median_m) for one in variants]),
        Column("95 %", 2, [size(None if one.of_all is None else one.of_all.p95_m) for one in variants]),
        Column("max", 5, [size(_max_of_all(one)) for one in variants]),
        Column("median's 95 %", 6, [interval(one) for one in variants]),
        Column("horizontal", 7, of_answered(lambda one: one.horizontal, "median_m")),
        Column("vertical", 8, of_answered(lambda one: one.vertical, "median_m")),
        Column("RMSE", 9, of_answered(lambda one: one.error_3d, "rmse_m")),
        Column("/bound", 3, ["" if (r := one.ratio_to_bound) is None else three(r.rms) for one in variants]),
        Column("NEES", 4, [nees(one) for one in variants]),
        Column("ms", 10, ["" if one.median_time_s is None else three(one.median_time_s * 1e3) for one in variants]),
        Column("answered", 1, [f"{one.ok}/{one.frames}" for one in variants]),
    )
    return [column for column in columns if not column.is_empty]


def _max_of_all(one: VariantScore) -> float | None:
    return None if one.failed or one.error_3d is None else one.error_3d.max_m


def unit_named(name: str) -> str:
    """A unit of lengths by its name, `um` too. Raises InputError."""
    unit = "µm" if name in ("um", "μm") else name
    if unit not in UNITS:
        raise InputError(f"--unit {name}: needed one of um, mm, m")
    return unit


def score_lines(
    scores: Scores, about: str, width: int, unit: str | None = None, spread: bool = False, plain: bool = False
) -> list[str]:
    """The scores in lines of at most `width` columns, however long names and reasons are.

    about: what was photographed, as `about` says. unit: of all lengths; by the smallest median where None. spread:
    histograms of the errors too. plain: without characters beyond ASCII.
    """
    variants, others = ordered(scores)
    chosen, diag_m = unit or unit_of(variants), diagonal_m(scores)
    lines = [*folded(f"{scores.dataset}: {about}", width), *folded(CAPTION.format(unit=chosen), width), ""]
    lines += _table([one.variant for one in variants], columns_of(variants, chosen, diag_m), width)
    for one in variants:
        reasons = sorted(one.failures.items(), key=lambda item: -item[1])
        for reason, count in reasons[:MAX_REASONS]:
            lines += folded(f"failed  {count} x {one.variant}: {reason}", width)
        if rest := sum(count for _, count in reasons[MAX_REASONS:]):
            lines += folded(f"failed  {rest} x {one.variant}: {len(reasons) - MAX_REASONS} other reasons", width)
    for why, some in groupby(sorted(others, key=lambda one: one.entry.inapplicable or ""), _why):
        lines += folded(f"not for this set  {', '.join(one.variant for one in some)}: {why}", width)
    lines += [line for note in _notes(variants, diag_m) for line in folded(note, width)]
    if spread:
        lines += ["", *spread_lines(variants, diag_m, width, plain)]
    if variants and variants[0].frames < FEW_FRAMES:
        few = f"{variants[0].frames} frames are few: differences between variants may be chance."
        lines += ["", *folded(few, width)]
    return [line.replace("µ", "u") for line in lines] if plain else lines


def _why(one: VariantScore) -> str:
    return one.entry.inapplicable or ""


def _notes(variants: Sequence[VariantScore], diag_m: float) -> Iterable[str]:
    """What "out", "inf" and the marks of the NEES mean, where they stand in the table."""
    verdicts = {verdict_of(one.nees) for one in variants if one.nees is not None}
    if verdicts - {"consistent"}:
        yield "NEES: 3 where the stated covariance is right; + overconfident, - conservative beyond its 99 % interval"
    sizes_m = [_max_of_all(one) for one in variants]
    sizes_m += [size_m for one in variants if one.of_all for size_m in (one.of_all.median_m, one.of_all.p95_m)]
    if any(size_m is not None and diag_m < size_m < math.inf for size_m in sizes_m):
        yield f"out: farther from the truth than the room's diagonal, {three(diag_m)} m"
    if any(one.failed for one in variants):
        yield "inf: so many frames failed"


def _table(names: Sequence[str], columns: Sequence[Column], width: int) -> list[str]:
    """Rows with as many columns as fit whole; long names stand on lines of their own, above their figures."""
    longest = max(map(len, ["variant", *names]), default=0)
    own_lines = longest > width // 2
    lead = len(GAP) if own_lines else longest
    kept = list(columns)
    while len(kept) > 1 and lead + sum(len(GAP) + len(one.aligned()[0]) for one in kept) > width:
        kept.remove(max(kept, key=lambda one: one.rank))
    aligned = [one.aligned() for one in kept]
    rows = [GAP + GAP.join(cells) for cells in zip(*aligned, strict=True)]
    rule = "-" * (lead + len(rows[0]))
    if own_lines:
        body = [line for name, row in zip(names, rows[1:], strict=True) for line in (*folded(name, width), GAP + row)]
        return [(GAP + rows[0]).rstrip(), rule, *map(str.rstrip, body), rule]
    leads = [name.ljust(lead) for name in ("variant", *names)]
    lines = [(one + row).rstrip() for one, row in zip(leads, rows, strict=True)]
    return [lines[0], rule, *lines[1:], rule]


def folded(text: str, width: int) -> list[str]:
    """A text in lines of at most `width` columns, broken between words, the later ones indented."""
    lines, rest = [], text
    indent = " " * min(8, width // 4)
    while len(rest) > width:
        cut = rest.rfind(" ", len(indent) + 1, width + 1)
        cut = cut if cut > 0 else width
        lines.append(rest[:cut].rstrip())
        rest = indent + rest[cut:].lstrip()
    return [*lines, rest]


def spread_lines(variants: Sequence[VariantScore], diag_m: float, width: int, plain: bool = False) -> list[str]:
    """Histograms of the errors on one logarithmic axis, a line a variant."""
    errors = {
        one.variant: [row.error_3d_m for row in one.rows if row.error_3d_m and row.error_3d_m <= diag_m]
        for one in variants
    }
    sizes_m = [size_m for some in errors.values() for size_m in some]
    if not sizes_m:
        return []
    lead = max(map(len, ["spread", *errors])) + 1
    first, last = math.floor(math.log10(min(sizes_m))), math.ceil(math.log10(max(sizes_m)) + 1e-12)
    first = max(first, last - MAX_DECADES)
    decade = max(1, min(BINS_A_DECADE, (width - lead) // (last - first)))
    every = -(-MAX_DECADE_TEXT // decade)
    marks = "".join(_decade_name(power).ljust(decade * every) for power in range(first, last, every))
    lines = [("spread".ljust(lead) + marks).rstrip()]
    bars = PLAIN_BARS if plain else BARS
    for name, some in errors.items():
        if not some:
            told = "all outside the room or failed"
            lines.append(f"{name.ljust(lead)}{told if lead + len(told) <= width else '-'}")
            continue
        counts = [0] * ((last - first) * decade)
        for size_m in some:
            counts[max(0, min(len(counts) - 1, int((math.log10(size_m) - first) * decade)))] += 1
        cells = [bars[math.ceil(count * (len(bars) - 1) / max(counts))] for count in counts]
        drawn = ["." if cell == " " and i % decade == 0 else cell for i, cell in enumerate(cells)]
        lines.append((name.ljust(lead) + "".join(drawn)).rstrip())
    return lines


def _decade_name(power: int) -> str:
    unit, unit_m = next((item for item in reversed(UNITS.items()) if 10**power >= 0.999 * item[1]), ("µm", 1e-6))
    return f"{10**power / unit_m:g} {unit}"


def about(dataset: Dataset) -> str:
    """What was photographed, in one line: frames, room, cameras, accelerometer."""
    parts = [f"{len(dataset.frames)} frames"]
    if dataset.room_m is not None:
        parts.append(" x ".join(f"{side:g}" for side in dataset.room_m) + " m")
    sizes = dict.fromkeys(f"{one.width_px} x {one.height_px} px" for one in dataset.cameras.values())
    parts.append((f"{len(dataset.cameras)} cameras, " if len(dataset.cameras) > 1 else "") + ", ".join(sizes))
    told = dataset.accelerometer
    parts.append("no accelerometer" if told is None else f"accelerometer {told.error_deg:.3g} deg")
    return ", ".join(parts)


def _whole(scores: Scores, unit: str | None) -> tuple[str, list[list[str]]]:
    """Unit, and all columns of all variants, header first."""
    variants, _ = ordered(scores)
    chosen = unit or unit_of(variants)
    columns = columns_of(variants, chosen, diagonal_m(scores))
    names = Column("variant", 0, [one.variant for one in variants])
    return chosen, [[one.name for one in (names, *columns)]] + [
        [one.cells[row] for one in (names, *columns)] for row in range(len(variants))
    ]


def score_markdown(scores: Scores, unit: str | None = None) -> str:
    """The table with all columns, in Markdown; a caption below."""
    chosen, (header, *rows) = _whole(scores, unit)
    body = [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in (header, *rows)]
    ruler = "| --- |" + " ---: |" * (len(header) - 1)
    return "\n".join([body[0], ruler, *body[1:], "", f"{scores.dataset}. {CAPTION.format(unit=chosen)}"])


def score_latex(scores: Scores, unit: str | None = None) -> str:
    """The table with all columns, as a LaTeX tabular with the caption in a comment; it needs no package."""
    chosen, (header, *rows) = _whole(scores, unit)
    chosen = chosen.replace("µ", "$\\mu$")
    body = [" & ".join(map(_latex, row)) + r" \\" for row in (header, *rows)]
    return "\n".join(
        [
            f"% {scores.dataset}. {CAPTION.format(unit=chosen)}",
            rf"\begin{{tabular}}{{l{'r' * (len(header) - 1)}}}",
            r"\hline",
            body[0],
            r"\hline",
            *body[1:],
            r"\hline",
            r"\end{tabular}",
        ]
    )


def _latex(text: str) -> str:
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    special |= {one: "\\" + one for one in "&%$#_{}"}
    return "".join(special.get(one, one) for one in text)


def score_csv(rows: Sequence[dict[str, object]]) -> str:
    """Rows of `Scores.summary_rows` as CSV, lengths in metres; an empty cell where there is no value."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: "" if value is None else value for key, value in row.items()} for row in rows)
    return text.getvalue().rstrip("\n")
