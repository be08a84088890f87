"""The page's answer: one sentence, the table of errors, the table of shares, and failed frames by reason."""

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from estimator.evaluate.score import Scores, VariantScore
from estimator.evaluate.statistics import Nees
from estimator.report.looks import look_key
from estimator.report.numbers import length, page_unit, three

SHARES = (50, 90, 99)
BOUND_TOLERANCE = 1.1
"""A median up to this multiple of the bound's is said to be at the bound where the ratio's interval holds 1 too."""


@dataclass(frozen=True)
class Length:
    """Cell with a length in the page's unit; infinite where failed frames make it so."""

    size_m: float | None
    out: bool = False
    """Whether it exceeds the room's diagonal."""

    @property
    def text(self) -> str:
        """The length in its own unit, in words where it has none."""
        return "–" if self.size_m is None else "failed" if math.isinf(self.size_m) else length(self.size_m)


@dataclass(frozen=True)
class AnswerRow:
    """Row of the table of errors."""

    variant: VariantScore
    key: Markup
    median: Length
    interval_m: tuple[float, float] | None
    p95: Length
    max: Length
    ratio: str
    ratio_interval: str
    verdict: str
    """Of the covariances: consistent, overconfident, conservative; empty where none is stated."""
    nees: str
    nees_interval: str
    time_ms: str


@dataclass(frozen=True)
class ShareRow:
    """Row of a table of shares: the errors within which SHARES of all frames lie."""

    name: str
    key: Markup
    sizes: Sequence[Length]


def ordered(scores: Scores) -> tuple[list[VariantScore], list[VariantScore]]:
    """Variants by the median of all frames, then the 95th percentile, then name; and those that do not apply.

    A variant that states why it cannot answer this set, and has answered no frame of it, does not apply.
    """

    def place(one: VariantScore) -> tuple[float, float, str]:
        return *(_or_infinity(size) for size in _of_all(one)), one.variant  # type: ignore[return-value]

    applicable = [one for one in scores.variants if one.ok or one.entry.inapplicable is None]
    others = [one for one in scores.variants if not (one.ok or one.entry.inapplicable is None)]
    return sorted(applicable, key=place), sorted(others, key=lambda one: one.variant)


def _of_all(one: VariantScore) -> tuple[float | None, float | None]:
    return (None, None) if one.of_all is None else (one.of_all.median_m, one.of_all.p95_m)


def _or_infinity(size_m: float | None) -> float:
    return math.inf if size_m is None else size_m


def diagonal_m(scores: Scores) -> float:
    """Diagonal of the room, beyond which an error is "out"; infinite where the room is not known."""
    return math.inf if scores.room_m is None else math.hypot(*scores.room_m)


def unit_of(variants: Sequence[VariantScore]) -> str:
    """The page's unit of length for these variants."""
    return page_unit([median_m for one in variants if (median_m := _of_all(one)[0]) is not None])


def answer_rows(variants: Sequence[VariantScore], diag_m: float) -> list[AnswerRow]:
    """Rows of the table of errors, in the order of the variants."""

    def cell(size_m: float | None, none: float | None = None) -> Length:
        size_m = none if size_m is None else size_m
        return Length(size_m, size_m is not None and diag_m < size_m < math.inf)

    rows = []
    for one in variants:
        median_m, p95_m = _of_all(one)
        of_none = math.inf if one.frames else None
        interval, ratio, nees = one.median_interval, one.ratio_to_bound, one.nees
        beyond = one.error_3d is not None and one.error_3d.rmse_m > diag_m
        has_limits = ratio is not None and ratio.low is not None and ratio.high is not None
        rows.append(
            AnswerRow(
                variant=one,
                key=Markup(look_key(one.entry.look)),
                median=cell(median_m, of_none),
                # The interval is that of the frames that succeeded.
                interval_m=None if interval is None or one.failed else (interval.low_m, interval.high_m),
                p95=cell(p95_m, of_none),
                max=cell(None if one.error_3d is None else one.error_3d.max_m),
                ratio="" if ratio is None else "out" if beyond else three(ratio.rms),
                ratio_interval=f"{three(ratio.low or 0)} to {three(ratio.high or 0)}"
                if ratio and has_limits and not beyond
                else "",
                verdict="" if nees is None else verdict_of(nees),
                nees="" if nees is None else three(nees.mean),
                nees_interval="" if nees is None else f"{three(nees.low)} to {three(nees.high)}",
                time_ms="" if one.median_time_s is None else three(one.median_time_s * 1e3),
            )
        )
    return rows


def verdict_of(nees: Nees) -> str:
    """What the mean NEES says of a variant's covariances."""
    return "consistent" if nees.within else "overconfident" if nees.mean > nees.high else "conservative"


def share_rows(variants: Sequence[VariantScore], scores: Scores, shares: Sequence[int] = SHARES) -> list[ShareRow]:
    """Errors that shares of all frames do not exceed, and those of errors at the bound; a failed frame is infinite."""
    diag_m = diagonal_m(scores)
    rows = []
    for one in variants:
        sizes_m = sorted(_or_infinity(row.error_3d_m) for row in one.rows)
        found = [sizes_m[-(-share * len(sizes_m) // 100) - 1] if sizes_m else None for share in shares]
        cells = [Length(size_m, size_m is not None and diag_m < size_m < math.inf) for size_m in found]
        rows.append(ShareRow(one.variant, Markup(look_key(one.entry.look)), cells))
    if scores.bound_quantiles_m is not None:
        cells = [Length(scores.bound_quantiles_m[share]) for share in shares]
        rows.append(ShareRow("at the bound", Markup(""), cells))
    return rows


def lede(scores: Scores, variants: Sequence[VariantScore]) -> Markup:
    """The answer in a sentence: the nearest variant, the next one of another error, the last, and failed frames."""
    if not variants or not variants[0].frames:
        return Markup("No variant has estimates of a frame.")
    first, frames = variants[0], variants[0].frames
    median_m, p95_m = _of_all(first)
    if median_m is None:
        found = max(variants, key=lambda one: one.ok)
        text = Markup("No variant answers half of the {} frames; <b>{}</b> answers {}.").format(
            frames, found.variant, found.ok
        )
        return text
    text = Markup("Nearest is <b>{}</b>: half of the {} frames within <b>{}</b>").format(
        first.variant, frames, length(median_m)
    )
    text += Markup(", 95 % within {}").format(length(p95_m)) if p95_m is not None else ""
    ratio, quantiles = first.ratio_to_bound, scores.bound_quantiles_m
    if ratio is not None and ratio.low is not None and ratio.high is not None and quantiles is not None:
        if ratio.low <= 1 <= ratio.high and median_m <= BOUND_TOLERANCE * quantiles[50]:
            text += Markup(", which is at the Cramér-Rao bound")
        elif ratio.low > 1:
            text += Markup(", {} times the Cramér-Rao bound").format(three(ratio.rms))
    text += Markup(". ")
    answered = [(one, size_m) for one in variants[1:] if (size_m := _of_all(one)[0]) is not None]
    others = [(one, size_m) for one, size_m in answered if size_m > 1.05 * median_m]
    same = [one.variant for one, size_m in answered if size_m <= 1.05 * median_m]
    if same:
        text += Markup("As near: {}. ").format(
            ", ".join(same[:3]) + (f" and {len(same) - 3} more" if len(same) > 3 else "")
        )
    if others:
        (one, size_m), (last, last_m) = others[0], others[-1]
        text += Markup("Next: {}, {}").format(one.variant, length(size_m))
        if last is not one:
            text += Markup("; last: {}, {}").format(
                last.variant, "beyond the room" if last_m > diagonal_m(scores) else length(last_m)
            )
        text += Markup(". ")
    failing = [one for one in variants if one.failed]
    if not failing:
        return text + Markup("No frame failed.")
    words = [f"{one.failed} of {one.variant}" for one in failing[:3]]
    more = f" and {len(failing) - 3} variants more" if len(failing) > 3 else ""
    return text + Markup("Failed frames, of {}: {}{}.").format(frames, ", ".join(words), more)


def failure_rows(variants: Sequence[VariantScore]) -> list[tuple[VariantScore, Markup, list[tuple[str, int]]]]:
    """Failed frames of each variant by reason, most frequent first; reasons that differ in numbers alone are one."""
    rows = []
    for one in variants:
        if one.failed:
            kinds: Counter[str] = Counter()
            for reason, count in one.failures.items():
                kinds[kind_of(reason)] += count
            rows.append((one, Markup(look_key(one.entry.look)), kinds.most_common()))
    return rows


def kind_of(reason: str) -> str:
    """A reason up to its first semicolon, with N for numbers."""
    return re.sub(r"(?<!\w)\d+(\.\d+)?", "N", reason.partition(";")[0])
