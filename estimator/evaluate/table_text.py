"""Tables of settings as text, CSV and JSON."""

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from estimator.evaluate.score_table import length_text, share_text
from estimator.evaluate.table import SUCCESS_RATE, Key, Statistic, Table, failures_text

TABLE_NOTE = (
    "Statistics with their 95 % intervals. Of all: a failed frame counts as infinite (∞); the others are over the "
    "frames that have a value. An interval that ends at ∞ reaches beyond the largest value. Means have Student's "
    "interval, quantiles and shares that by order statistics and the binomial distribution. Frames of one pose, or of "
    "one device where there are several, count as dependent."
)


MAX_REASONS = 2
"""Reasons of failed frames that a line shows."""


def table_text(table: Table) -> str:
    """The table in aligned columns, a line each, as wide as it needs to be; the first line has the names."""
    headers = [*table.x, *table.by, "frames", "answered"]
    for name in table.statistics:
        headers += [name.replace("_", " "), "95 %"]
    lines = [[*headers, "failures"]]
    for row in table.rows:
        cells = [key_text(name, key) for name, key in zip(table.x, row.keys, strict=True)]
        cells += [*row.group, str(row.frames), str(row.answered)]
        for name, one in zip(table.statistics, row.statistics, strict=True):
            rate = share_text(row.answered, row.frames) if name == SUCCESS_RATE else value_text(table.metric, one.value)
            cells += [rate, ends_text(table.metric if name != SUCCESS_RATE else SUCCESS_RATE, one)]
        reasons = list(row.failures.items())
        shown = failures_text(replace(row, failures=dict(reasons[:MAX_REASONS])))
        rest = sum(count for _, count in reasons[MAX_REASONS:])
        lines.append([*cells, f"{shown}; {rest} x other" if rest else shown])
    return _aligned(lines, left=range(len(table.x), len(table.x) + len(table.by)))


def _aligned(lines: Sequence[Sequence[str]], left: range) -> str:
    """Columns two spaces apart, to the right; those of `left`, and the last one, to the left."""
    last = len(lines[0]) - 1
    widths = [max(len(line[column]) for line in lines) for column in range(last)]
    found = []
    for line in lines:
        cells = [
            cell.ljust(width) if column in left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=False))
        ]
        found.append("  ".join([*cells, line[last]]).rstrip())
    return "\n".join(found)


def key_text(name: str, key: Key) -> str:
    """A key's value, or its bin as `0.1 to 0.2`; lengths of columns in metres have a unit."""
    if isinstance(key.value, str):
        return key.value
    if key.low is None or key.high is None:
        return value_text(name, key.value) if name.endswith("_m") else f"{key.value:.6g}"
    return f"{value_text(name, key.low)} to {value_text(name, key.high)}"


def value_text(name: str, value: float) -> str:
    """A value of a column with its unit, to three digits; `∞` for failed frames, a dash where there is none."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞"
    if name == SUCCESS_RATE:
        return f"{100 * value:.1f} %"
    return length_text(value) if name.endswith("_m") else f"{value:.3g}"


def ends_text(name: str, one: Statistic) -> str:
    """Ends of an interval; a dash without one."""
    if math.isnan(one.low):
        return "–"
    return f"{value_text(name, one.low)} to {value_text(name, one.high)}"


def table_csv(table: Table) -> str:
    """The table's records as CSV, numbers in full; `inf` is infinite, an empty cell is none."""
    records = table.records()
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(records[0]) if records else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return buffer.getvalue()


def table_json(table: Table) -> str:
    """The table as JSON; null for an infinite value (`of_all`), an end without a limit, and where there is none."""
    rows: list[dict[str, Any]] = []
    for row, record in zip(table.rows, table.records(), strict=True):
        values = {
            key: None if isinstance(value, float) and math.isinf(value) else value for key, value in record.items()
        }
        rows.append(values | {"failures": dict(row.failures)})
    names = {"metric": table.metric, "x": table.x, "by": table.by, "statistics": table.statistics}
    return json.dumps({"format": "estimator-table", "version": 1, **names, "rows": rows}, indent=1, allow_nan=False)
