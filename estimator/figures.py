"""Scores as inline SVG: errors over the frames, and the room seen from above. Colours come from the page's style."""

import math
from collections.abc import Sequence
from html import escape

from estimator.score import VariantScore, length_text
from estimator.tables import Triple

WIDTH = 960
SMALLEST_SHOWN_M = 1e-6
MARGINS = {"left": 72, "right": 16, "top": 12, "bottom": 40}


def error_plot(variants: Sequence[VariantScore]) -> str:
    """3D error of each frame on a logarithmic axis, a colour a variant; failed frames are crosses in lanes below."""
    lane = 16
    plot_height = 300
    lanes_top = MARGINS["top"] + plot_height + 14
    height = lanes_top + lane * len(variants) + MARGINS["bottom"]
    errors_m = [max(row.error_3d_m, SMALLEST_SHOWN_M) for v in variants for row in v.rows if row.error_3d_m is not None]
    low = math.floor(math.log10(min(errors_m, default=1e-3)))
    high = max(math.ceil(math.log10(max(errors_m, default=1.0))), low + 1)
    frames = max((v.frames for v in variants), default=0)

    def x(frame: int) -> float:
        inner = WIDTH - MARGINS["left"] - MARGINS["right"]
        return MARGINS["left"] + inner * (frame + 0.5) / max(frames, 1)

    def y(error_m: float) -> float:
        share = (math.log10(max(error_m, SMALLEST_SHOWN_M)) - low) / (high - low)
        return MARGINS["top"] + plot_height * (1 - share)

    parts = []
    for decade in range(low, high + 1):
        at = y(10.0**decade)
        parts.append(_line(MARGINS["left"], at, WIDTH - MARGINS["right"], at, "rule"))
        parts.append(_text(MARGINS["left"] - 8, at + 4, length_text(10.0**decade), "end"))
    ticks = range(0, frames, max(1, math.ceil(frames / 12)))
    axis_y = lanes_top + lane * len(variants)
    parts += [_text(x(frame), axis_y + 16, str(frame), "middle") for frame in ticks]
    parts.append(_text(WIDTH / 2, axis_y + 34, "frame", "middle"))
    for index, variant in enumerate(variants):
        lane_y = lanes_top + lane * (index + 0.5)
        parts.append(_line(MARGINS["left"], lane_y, WIDTH - MARGINS["right"], lane_y, "rule"))
        parts.append(_text(MARGINS["left"] - 8, lane_y + 4, "failed", "end"))
        for row in variant.rows:
            place = f"{variant.variant}, frame {row.frame}"
            if row.error_3d_m is None:
                title = escape(f"{place}: {row.reason}")
                parts.append(_cross(x(row.frame), lane_y, f"v{index}", title))
            else:
                title = escape(f"{place}: {length_text(row.error_3d_m)}")
                parts.append(_dot(x(row.frame), y(row.error_3d_m), 3, f"v{index}", title))
    return _svg(WIDTH, height, "3D error of each frame", parts)


def plan(room_m: Triple, leds_m: Sequence[Triple], variant: VariantScore, index: int) -> str:
    """The room from above, x right and y up: LEDs, true positions (rings), estimates (dots) and the errors between."""
    width, border = 460.0, 12.0
    scale = (width - 2 * border) / room_m[0]
    height = room_m[1] * scale + 2 * border

    def place(point_m: Triple) -> tuple[float, float]:
        return border + point_m[0] * scale, height - border - point_m[1] * scale

    parts = [f'<rect x="{border}" y="{border}" width="{width - 2 * border}" height="{room_m[1] * scale:.1f}"/>']
    parts += [
        f'<rect class="led" x="{u - 2:.1f}" y="{v - 2:.1f}" width="4" height="4"/>' for u, v in map(place, leds_m)
    ]
    for row in variant.rows:
        u, v = place(row.true_m)
        if row.estimate_m is None:
            parts.append(_cross(u, v, f"v{index}", escape(f"frame {row.frame}: {row.reason}")))
            continue
        title = escape(f"frame {row.frame}: {length_text(row.error_3d_m)}")
        # Far outside, a coordinate says no more than a nearer one, and viewers choke on huge numbers.
        a, b = (max(-1e4, min(1e4, value)) for value in place(row.estimate_m))
        parts.append(_line(u, v, a, b, f"v{index}"))
        parts.append(f'<circle class="truth" cx="{u:.1f}" cy="{v:.1f}" r="4"/>')
        parts.append(_dot(a, b, 2.5, f"v{index}", title))
    return _svg(width, height, "plan of the room", parts)


def outside(room_m: Triple, variant: VariantScore) -> int:
    """How many of a variant's estimates lie beyond the plan's walls."""
    estimates = [row.estimate_m for row in variant.rows if row.estimate_m is not None]
    return sum(not (0 <= x <= room_m[0] and 0 <= y <= room_m[1]) for x, y, _ in estimates)


def _svg(width: float, height: float, label: str, parts: Sequence[str]) -> str:
    body = "\n".join(parts)
    return f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(label)}">\n{body}\n</svg>'


def _line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _dot(x: float, y: float, radius: float, kind: str, title: str) -> str:
    return f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="{radius}"><title>{title}</title></circle>'


def _cross(x: float, y: float, kind: str, title: str) -> str:
    strokes = f"M{x - 3:.1f} {y - 3:.1f}l6 6m0 -6l-6 6"
    return f'<path class="{kind}" d="{strokes}"><title>{title}</title></path>'
