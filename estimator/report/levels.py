"""Plot of levels: every variant's RMSE against the bound of each of several datasets, as SVG."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from estimator.evaluate.levels import Level, variants_of
from estimator.evaluate.score_table import length_text
from estimator.methods.looks import Look, look_of
from estimator.report.looks import LOOK_STYLE, look_class, look_mark
from estimator.report.svg import line, picture, svg_file, text

WIDTH, HEIGHT = 560, 420
LEFT, TOP, BOTTOM = 72, 44, 44
LEGEND = 250
LINE = 18
LABEL = 13
MIN_SHOWN_M = 1e-6
MAX_LABELS = 12


@dataclass(frozen=True)
class Decades:
    """A logarithmic axis from 10**low to 10**high metres."""

    low: int
    high: int

    @classmethod
    def around(cls, shown_m: Sequence[float]) -> "Decades":
        """Axis that contains some lengths, all positive."""
        low = math.floor(math.log10(min(shown_m, default=1e-3)))
        return cls(low, max(math.ceil(math.log10(max(shown_m, default=1.0))), low + 1))

    def share(self, size_m: float) -> float:
        """Position along the axis, 0 to 1."""
        return (math.log10(max(size_m, MIN_SHOWN_M)) - self.low) / (self.high - self.low)

    def labelled_m(self) -> list[float]:
        """Decades to label, all of them up to MAX_LABELS."""
        step = math.ceil((self.high - self.low) / MAX_LABELS)
        return [10.0**decade for decade in range(self.low, self.high + 1, step)]


def level_plot(levels: Sequence[Level]) -> str:
    """SVG element: bound across and RMSE up, both logarithmic; the diagonal is the bound itself.

    A mark with failed frames has their number beside it: its RMSE leaves them out.
    """
    variants = variants_of(levels)
    sizes_m = [level.bound_rms_m for level in levels]
    sizes_m += [size for level in levels for one in variants if (size := level.rmse_m(one)) is not None and size > 0]
    up = Decades.around(sizes_m)
    across = Decades.around([level.bound_rms_m for level in levels])
    height = max(HEIGHT, LINE * len(variants))

    def x(size_m: float) -> float:
        return LEFT + WIDTH * across.share(size_m)

    def y(size_m: float) -> float:
        return TOP + height * (1 - up.share(size_m))

    parts = []
    for decade_m in up.labelled_m():
        parts.append(line(LEFT, y(decade_m), LEFT + WIDTH, y(decade_m), "rule"))
        parts.append(text(LEFT - 8, y(decade_m) + 4, length_text(decade_m), "end"))
    for decade_m in across.labelled_m():
        parts.append(line(x(decade_m), TOP, x(decade_m), TOP + height, "rule"))
        parts.append(text(x(decade_m), TOP + height + 16, length_text(decade_m), "middle"))
    for rank, level in enumerate(levels):
        parts.append(line(x(level.bound_rms_m), TOP, x(level.bound_rms_m), TOP + height, "rule"))
        parts.append(text(x(level.bound_rms_m), TOP - 8 - 14 * (rank % 2), level.name, "middle"))
    parts.append(text(LEFT + WIDTH / 2, TOP + height + 34, "bound of the dataset", "middle"))
    parts.append(text(LEFT - 8, TOP - 12, "RMSE", "end"))
    first, last = 10.0 ** max(up.low, across.low), 10.0 ** min(up.high, across.high)
    if last > first:
        parts.append(line(x(first), y(first), x(last), y(last), "bound"))
    failed: list[tuple[float, float, str]] = []
    for index, variant in enumerate(variants):
        look = _look(levels, variant)
        places = [(level, size) for level in levels if (size := level.rmse_m(variant)) is not None]
        if len(places) > 1:
            steps = "L".join(f"{x(level.bound_rms_m):.1f} {y(size):.1f}" for level, size in places)
            parts.append(f'<g class="{look_class(look)}"><path class="curve" d="M{steps}"/></g>')
        for level, size in places:
            of_variant = level.variants[variant]
            lost = f", {of_variant.failed} of {of_variant.frames} frames failed" if of_variant.failed else ""
            title = f"{variant}, {level.name}: {length_text(size)}{lost}"
            parts.append(look_mark(x(level.bound_rms_m), y(size), 4, look, title))
            if of_variant.failed:
                failed.append((x(level.bound_rms_m) + 8, y(size) - 4, f"{of_variant.failed} failed"))
        parts.append(look_mark(LEFT + WIDTH + 40, TOP + LINE * (index + 0.5), 4, look))
        parts.append(text(LEFT + WIDTH + 52, TOP + LINE * (index + 0.5) + 4, variant, "start"))
    parts += [text(across_px, down_px, words, "start") for across_px, down_px, words in _apart(failed)]
    return picture(LEFT + WIDTH + LEGEND, TOP + height + BOTTOM, "RMSE of each variant by the datasets' bounds", parts)


def _apart(labels: Sequence[tuple[float, float, str]]) -> list[tuple[float, float, str]]:
    """Labels (x, y, words) of which those of a column are at least LABEL apart, moved down where they are not."""
    placed: list[tuple[float, float, str]] = []
    for x, y, words in sorted(labels):
        low = placed[-1][1] + LABEL if placed and placed[-1][0] == x else y
        placed.append((x, max(y, low), words))
    return placed


def _look(levels: Sequence[Level], variant: str) -> Look:
    """Look of a variant as its scores state it."""
    found = (one.entry.look for level in levels if (one := level.variants.get(variant)) is not None)
    return next(found, look_of(variant))


def level_picture(levels: Sequence[Level]) -> str:
    """The plot as a file of its own, with its styles."""
    return svg_file(level_plot(levels), LOOK_STYLE)
