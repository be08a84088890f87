"""Plots of the page as SVG: the room from above, directions of the optical axis, histograms."""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

Floats = NDArray[np.float64]
WIDTH = 460.0
LEFT, BOTTOM, TOP = 26.0, 32.0, 6.0
MAX_LEDS = 4000
BINS = 12
HALF_LABEL = 22.0
"""Half the width of a number of three digits, in units of the plots."""


def floor_plan(room_m: Sequence[float], leds_m: Floats, positions_m: Floats, axes: Floats) -> Markup:
    """The room from above, x right and y up: LEDs, and true positions with the directions in which cameras look."""
    scale = (WIDTH - LEFT - 4) / room_m[0]
    deep = room_m[1] * scale
    height = deep + TOP + BOTTOM

    def place(points_m: Floats) -> Floats:
        return np.column_stack([LEFT + points_m[:, 0] * scale, TOP + deep - points_m[:, 1] * scale])

    step = -(-len(leds_m) // MAX_LEDS) if len(leds_m) else 1
    leds = "".join(f"M{u - 1:.1f} {v - 1:.1f}h2v2h-2z" for u, v in place(leds_m[::step]))
    dots = "".join(f"M{u - 2:.1f} {v:.1f}a2 2 0 1 0 4 0a2 2 0 1 0 -4 0" for u, v in place(positions_m))
    looks = "".join(
        f"M{u:.1f} {v:.1f}l{12 * x:.1f} {-12 * y:.1f}"
        for (u, v), (x, y, _) in zip(place(positions_m), axes, strict=True)
    )
    ticks = "".join(
        f'<text x="{LEFT + value * scale:.1f}" y="{TOP + deep + 15:.1f}" text-anchor="middle">{value:g}</text>'
        for value in _steps(0, room_m[0])
    )
    ticks += "".join(
        f'<text x="{LEFT - 5}" y="{TOP + deep - value * scale + 4:.1f}" text-anchor="end">{value:g}</text>'
        for value in _steps(0, room_m[1])
    )
    wall = f'<rect class="wall" x="{LEFT}" y="{TOP}" width="{WIDTH - LEFT - 4}" height="{deep:.1f}"/>'
    name = f'<text x="{WIDTH - 4}" y="{height - 3:.1f}" text-anchor="end">x, m</text>'
    paths = f'<path class="led" d="{leds}"/><path class="look" d="{looks}"/><path class="truth" d="{dots}"/>'
    return _svg(WIDTH, height, "The room from above", wall + paths + ticks + name)


def directions(axes: Floats) -> Markup:
    """Directions (n, 3) of the optical axis: straight up in the middle, rings every 20 degrees."""
    size, radius = 340.0, 150.0
    polar = np.degrees(np.arccos(np.clip(axes[:, 2], -1, 1)))
    largest = 20.0 * max(2, np.ceil(polar.max() / 20))
    turn = np.arctan2(axes[:, 1], axes[:, 0])
    u, v = (size / 2 + polar / largest * radius * np.cos(turn)), (size / 2 - polar / largest * radius * np.sin(turn))
    values = np.arange(20.0, largest + 1, 20)
    rings = "".join(
        f'<circle class="rule" cx="{size / 2}" cy="{size / 2}" r="{ring / largest * radius:.1f}"/>' for ring in values
    )
    labels = "".join(
        f'<text x="{size / 2 + 3}" y="{size / 2 - ring / largest * radius - 2:.1f}">{ring:g}°</text>' for ring in values
    )
    dots = "".join(f"M{a - 2.5:.1f} {b:.1f}a2.5 2.5 0 1 0 5 0a2.5 2.5 0 1 0 -5 0" for a, b in zip(u, v, strict=True))
    middle, first = size / 2, size / 2 - radius
    cross = f'<path class="rule" d="M{first} {middle}h{2 * radius}M{middle} {first}v{2 * radius}"/>'
    labels += f'<text x="{size / 2 + radius + 4}" y="{size / 2 + 4}">x</text>'
    return _svg(
        size, size, "Directions of the optical axis", rings + cross + f'<path class="dot" d="{dots}"/>' + labels
    )


def histogram(name: str, values: Floats) -> Markup:
    """Frames by a value, with the median as a line; empty where all values agree."""
    if len(values) < 2 or np.ptp(values) <= 1e-9 * np.abs(values).max():
        return Markup("")
    width, height, base, tallest = 230.0, 134.0, 112.0, 94.0
    counts, edges = np.histogram(values, min(BINS, max(2, len(values) // 2)))
    wide = width / len(counts)
    heights = tallest * counts / counts.max()
    bars = "".join(
        f'<rect class="bar" x="{k * wide + 0.5:.1f}" y="{base - high:.1f}" width="{wide - 1:.1f}" height="{high:.1f}">'
        f"<title>{edge:.3g} to {after:.3g}: {count} frames</title></rect>"
        for k, (high, count, edge, after) in enumerate(zip(heights, counts, edges, edges[1:], strict=False))
    )
    median = float(np.median(values))
    middle = width * (median - edges[0]) / (edges[-1] - edges[0])
    # The median's label stands above its line, those of the ends below theirs: none covers another.
    at = min(max(middle, HALF_LABEL), width - HALF_LABEL)
    texts = f'<text class="lab" x="{at:.1f}" y="{TOP + 5}" text-anchor="middle">{median:.3g}</text>'
    texts += f'<text x="0" y="{base + 15}">{edges[0]:.3g}</text>'
    texts += f'<text x="{width}" y="{base + 15}" text-anchor="end">{edges[-1]:.3g}</text>'
    line = f'<line class="axis" x1="{middle:.1f}" x2="{middle:.1f}" y1="{TOP + 9}" y2="{base}"/>'
    return _svg(width, height, f"Frames by {name}; median {median:.3g}", bars + line + texts)


def _steps(low: float, high: float) -> Floats:
    smallest = (high - low) / 8
    decade = 10.0 ** np.floor(np.log10(smallest))
    step = next(digit * decade for digit in (1, 2, 5, 10) if digit * decade >= smallest * (1 - 1e-9))
    return np.arange(low, high * (1 + 1e-9), step)


def _svg(width: float, height: float, label: str, body: str) -> Markup:
    return Markup(f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(label)}">{body}</svg>')
