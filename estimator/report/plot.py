"""Plots of tables of settings, as SVG: lines with their intervals for one key, heat maps for two."""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from html import escape

from estimator.errors import InputError
from estimator.evaluate.table import SUCCESS_RATE, Key, Statistic, Table, TableRow
from estimator.evaluate.table_text import ends_text, key_text, value_text
from estimator.methods.catalogue import VARIANTS
from estimator.report.axes import Axis
from estimator.report.svg import cross, line, mark, picture, slots_of, style_of_variants, svg_file, text

WIDTH, HEIGHT = 560, 360
LEFT, TOP, BOTTOM = 84, 40, 48
LEGEND, LETTER = 36, 7.3
"""Width of the legend's marks, and of a letter of its names at most on average."""
LINE = 18
PANEL, CELL_GAP = 360, 1
PANELS_ACROSS = 3
MAX_PANELS = 20
COLOUR_MAP = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
"""Red, green and blue of matplotlib's viridis at 0, 1/4, ... 1."""
STEPS = 32
"""Colours of the scale beside heat maps."""
BAND = "svg .band { stroke: none !important; fill-opacity: 0.15; } svg .cell, svg .none { stroke: none; }"
LOGARITHMIC = ("x", "y", "value")
"""Axes that may be logarithmic: those of a plot with lines, and the colours of a heat map."""

Line = tuple[float, str]
"""Value and label of a horizontal line."""


def plot(table: Table, log: Collection[str] | None = None, lines: Sequence[Line] = ()) -> str:
    """The plot of a table with one statistic, a whole SVG file; the same table gives the same bytes.

    One key gives a line for each group, with a band from the lower to the upper end of the intervals; a cross at the
    upper edge marks an infinite value. Two keys give a heat map for each group, first key across.

    Parameters
    ----------
    table
        Table with one or two keys and one statistic.
    log
        Axes to make logarithmic, of `x`, `y` and (heat maps) `value`; if None, those whose values span a factor of 50.
    lines
        Values to draw across the plot, with their labels; for one key only.

    Raises
    ------
    InputError
        The table has another number of keys or statistics, or no rows; `log` has another name.
    """
    if len(table.statistics) != 1:
        raise InputError(
            f"statistics {', '.join(table.statistics)}: a plot shows one; of_all is two, median_of_all and p95_of_all"
        )
    if len(table.x) not in (1, 2):
        raise InputError(f"keys {', '.join(table.x) or 'none'}: a plot has one or two")
    if not table.rows:
        raise InputError("the table has no rows: no frame has a value of each key")
    for name in log or ():
        if name not in LOGARITHMIC:
            raise InputError(f"log {name}: unknown axis; allowed: {', '.join(LOGARITHMIC)}")
    if len(table.x) == 1:
        return _line_plot(table, log, lines)
    if lines:
        raise InputError("lines: a heat map has none; give one key")
    return _heat_maps(table, log)


def _groups(table: Table) -> dict[tuple[str, ...], list[TableRow]]:
    """Rows of each group."""
    groups: dict[tuple[str, ...], list[TableRow]] = {}
    for row in table.rows:
        groups.setdefault(row.group, []).append(row)
    return groups


def _slots(table: Table, groups: Iterable[tuple[str, ...]]) -> list[int]:
    """Mark and colour of each group, fixed by its variant where it has one."""
    at = table.by.index("variant") if "variant" in table.by else None
    pairs = [(", ".join(g), "") if at is None else (g[at], ", ".join(g[:at] + g[at + 1 :])) for g in groups]
    return slots_of(pairs, list(VARIANTS))


def _asked(log: Collection[str] | None, name: str) -> bool | None:
    return None if log is None else name in log


def _axis_of_keys(keys: Sequence[Key], log: Collection[str] | None) -> Axis:
    numbers = [key.value for key in keys if not isinstance(key.value, str)]
    if len(numbers) < len(keys):
        return Axis.of_texts([str(text) for text in dict.fromkeys(key.value for key in keys)])
    return Axis.of(numbers, _asked(log, "x"))


def _place(axis: Axis, key: Key) -> float:
    return axis.share(float(axis.texts.index(key.value)) if isinstance(key.value, str) else key.value)


def _unit(table: Table) -> str:
    """Column that a value's text is of."""
    return SUCCESS_RATE if table.statistics[0] == SUCCESS_RATE else table.metric


def _title(table: Table, row: TableRow) -> str:
    (one,) = row.statistics
    keys = ", ".join(f"{name} {key_text(name, key)}" for name, key in zip(table.x, row.keys, strict=True))
    value = f"{value_text(_unit(table), one.value)} ({ends_text(_unit(table), one)})"
    return f"{', '.join(row.group)}, {keys}: {value}, {row.answered} of {row.frames} frames answered"


def _name(table: Table) -> str:
    (statistic,) = table.statistics
    return "success rate" if statistic == SUCCESS_RATE else f"{statistic.replace('_', ' ')} of {table.metric}"


def _line_plot(table: Table, log: Collection[str] | None, lines: Sequence[Line]) -> str:
    groups = _groups(table)
    slots = _slots(table, groups)
    across = _axis_of_keys([row.keys[0] for row in table.rows], log)
    shown = [row.statistics[0] for row in table.rows]
    ends = [end for one in shown for end in (one.low, one.high)]
    values = [one.value for one in shown] + [value for value, _ in lines]
    # Lower ends below zero, such as a mean's, do not keep an axis of positive values from being logarithmic.
    positive = all(value > 0 for value in values if math.isfinite(value))
    up = Axis.of(values + [end for end in ends if end > 0 or not positive], _asked(log, "y"))
    height = max(HEIGHT, LINE * (len(groups) + 1))

    def x(key: Key) -> float:
        return LEFT + WIDTH * _place(across, key)

    def y(value: float) -> float:
        return TOP + height * (1 - up.share(value))

    parts = []
    for label in up.labels():
        parts.append(line(LEFT, y(label), LEFT + WIDTH, y(label), "rule"))
        parts.append(text(LEFT - 8, y(label) + 4, value_text(_unit(table), label), "end"))
    for label in across.labels():
        place = LEFT + WIDTH * across.share(label)
        parts.append(line(place, TOP, place, TOP + height, "rule"))
        words = across.texts[int(label)] if across.texts else key_text(table.x[0], Key(label))
        parts.append(text(place, TOP + height + 16, words, "middle"))
    parts.append(text(LEFT + WIDTH / 2, TOP + height + 36, table.x[0], "middle"))
    parts.append(text(LEFT - 8, TOP - 16, _name(table), "start"))
    for value, label_text in lines:
        parts.append(line(LEFT, y(value), LEFT + WIDTH, y(value), "bound"))
        parts.append(text(LEFT + WIDTH - 4, y(value) - 4, label_text, "end"))
    for slot, rows in zip(slots, groups.values(), strict=True):
        for run in _runs(rows):
            parts += _band([(x(row.keys[0]), row.statistics[0]) for row in run], y, slot)
            steps = "L".join(f"{x(row.keys[0]):.1f} {y(row.statistics[0].value):.1f}" for row in run)
            parts.append(f'<path class="curve v{slot}" d="M{steps}"/>')
        for row in rows:
            value = row.statistics[0].value
            if math.isinf(value):
                parts.append(cross(x(row.keys[0]), TOP, slot, _title(table, row)))
            elif not math.isnan(value):
                parts.append(mark(x(row.keys[0]), y(value), 3.5, slot, _title(table, row)))
    for place, (slot, group) in enumerate(zip(slots, groups, strict=True)):
        parts.append(mark(LEFT + WIDTH + 24, TOP + LINE * (place + 0.5), 4, slot))
        parts.append(text(LEFT + WIDTH + 36, TOP + LINE * (place + 0.5) + 4, ", ".join(group), "start"))
    legend = LEGEND + LETTER * max(len(", ".join(group)) for group in groups)
    whole = picture(LEFT + WIDTH + legend, TOP + height + BOTTOM, f"{_name(table)} by {table.x[0]}", parts)
    return svg_file(whole, f"{style_of_variants(max(slots) + 1)}\n{BAND}")


def _runs(rows: Sequence[TableRow]) -> Iterator[list[TableRow]]:
    """Rows of a group without a gap: a row without a finite value ends a line."""
    run: list[TableRow] = []
    for row in rows:
        if math.isfinite(row.statistics[0].value):
            run.append(row)
        elif run:
            yield run
            run = []
    if run:
        yield run


def _band(points: Sequence[tuple[float, Statistic]], y: Callable[[float], float], slot: int) -> list[str]:
    """Area between the ends of the intervals of points, with their places across; unlimited ends are at the edge."""
    known = [(x, one) for x, one in points if not math.isnan(one.low)]
    if len(known) < 2:
        return [f'<path class="v{slot}" d="M{x:.1f} {y(one.low):.1f}V{y(one.high):.1f}"/>' for x, one in known]
    upper = [f"{x:.1f} {y(one.high):.1f}" for x, one in known]
    lower = [f"{x:.1f} {y(one.low):.1f}" for x, one in reversed(known)]
    return [f'<path class="mark band v{slot}" d="M{"L".join(upper + lower)}z"/>']


def _heat_maps(table: Table, log: Collection[str] | None) -> str:
    groups = _groups(table)
    if len(groups) > MAX_PANELS:
        raise InputError(
            f"{len(groups)} groups: a figure has room for {MAX_PANELS} heat maps; choose variants, or fewer columns"
        )
    across, down = (sorted({row.keys[index] for row in table.rows}, key=_order) for index in (0, 1))
    scale = Axis.of([row.statistics[0].value for row in table.rows], _asked(log, "value"), pad=0.0)
    width, height = PANEL / len(across), PANEL / len(down)
    deep = TOP + PANEL + BOTTOM
    parts = [text(LEFT, 18, _name(table), "start")]
    for number, (group, rows) in enumerate(groups.items()):
        left = LEFT + number % PANELS_ACROSS * (PANEL + LEFT)
        top = TOP + 20 + number // PANELS_ACROSS * deep
        parts.append(text(left + PANEL / 2, top - 8, ", ".join(group), "middle"))
        for row in rows:
            x = left + width * across.index(row.keys[0])
            y = top + PANEL - height * (down.index(row.keys[1]) + 1)
            value = row.statistics[0].value
            fill = "#bbb" if math.isnan(value) else "#000" if math.isinf(value) else _colour(scale.share(value))
            size = f'width="{width - CELL_GAP:.1f}" height="{height - CELL_GAP:.1f}" fill="{fill}"'
            parts.append(
                f'<rect class="cell" x="{x:.1f}" y="{y:.1f}" {size}><title>{escape(_title(table, row))}</title></rect>'
            )
        for index in _labelled(len(across)):
            words = key_text(table.x[0], across[index])
            parts.append(text(left + width * (index + 0.5), top + PANEL + 16, words, "middle"))
        for index in _labelled(len(down)):
            words = key_text(table.x[1], down[index])
            parts.append(text(left - 6, top + PANEL - height * (index + 0.5) + 4, words, "end"))
        parts.append(text(left + PANEL / 2, top + PANEL + 36, table.x[0], "middle"))
        parts.append(text(left - 6, top - 8, table.x[1], "end"))
    left = min(len(groups), PANELS_ACROSS) * (PANEL + LEFT) + 24
    parts += _colour_scale(table, scale, left)
    down_px = math.ceil(len(groups) / PANELS_ACROSS) * deep
    whole = picture(left + 110, 20 + down_px, f"{_name(table)} by {table.x[0]} and {table.x[1]}", parts)
    return svg_file(whole, BAND)


def _order(key: Key) -> tuple[str, float]:
    return (key.value, 0.0) if isinstance(key.value, str) else ("", key.value)


def _labelled(count: int) -> range:
    """Numbers of the values to label, at most 8."""
    return range(0, count, math.ceil(count / 8))


def _colour(share: float) -> str:
    """Colour at a place of the scale, 0 to 1."""
    place = share * (len(COLOUR_MAP) - 1)
    first = min(int(place), len(COLOUR_MAP) - 2)
    mixed = [a + (b - a) * (place - first) for a, b in zip(COLOUR_MAP[first], COLOUR_MAP[first + 1], strict=True)]
    return "#" + "".join(f"{round(one):02x}" for one in mixed)


def _colour_scale(table: Table, scale: Axis, left: float) -> list[str]:
    top, step = TOP + 20, PANEL / STEPS
    parts = [
        f'<rect class="cell" x="{left:.1f}" y="{top + PANEL - step * (index + 1):.1f}" width="16" '
        f'height="{step + 0.5:.1f}" fill="{_colour((index + 0.5) / STEPS)}"/>'
        for index in range(STEPS)
    ]
    for label in scale.labels():
        place = top + PANEL * (1 - scale.share(label))
        parts.append(text(left + 22, place + 4, value_text(_unit(table), label), "start"))
    return parts
