"""Marks of variants as SVG, by their looks (`estimator.methods.looks`); report.css gives a family its hue."""

import math
from html import escape

from estimator.methods.looks import Look

_STAR = tuple(
    (
        (0.58 if k % 2 else 1.4) * math.cos(math.pi * (k / 5 - 0.5)),
        (0.58 if k % 2 else 1.4) * math.sin(math.pi * (k / 5 - 0.5)),
    )
    for k in range(10)
)
SHAPES: dict[str, tuple[tuple[float, float], ...]] = {
    "disc": tuple((math.cos(math.pi * k / 12), math.sin(math.pi * k / 12)) for k in range(24)),
    "square": ((-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)),
    "triangle": ((0.0, -1.25), (1.15, 0.8), (-1.15, 0.8)),
    "diamond": ((0.0, -1.35), (1.35, 0.0), (0.0, 1.35), (-1.35, 0.0)),
    "down": ((0.0, 1.25), (1.15, -0.8), (-1.15, -0.8)),
    "star": _STAR,
}
"""Vertices of each mark in units of the radius of a disc of the same visual size."""


HUES = {
    "pixels": "#1f5fbf",
    "gravity": "#0d9276",
    "spots": "#c2409f",
    "paper": "#9c3a06",
    "published": "#a98600",
    "other": "#1b1f24",
}
"""Hue of each family on a light ground; report.css has them for both themes."""
LOOK_STYLE = "\n".join(
    f"svg .hue-{family} .curve {{ stroke: {hue}; }} svg .hue-{family} .mark {{ fill: {hue}; }} "
    f"svg .hue-{family}.hollow .mark {{ fill: #fff; stroke: {hue} !important; }} "
    f"svg .hue-{family}.hollow .curve {{ stroke-dasharray: 6 3; }}"
    for family, hue in HUES.items()
)
"""CSS of the looks in a file of its own."""


def look_class(look: Look) -> str:
    """CSS classes of a look."""
    return f"hue-{look.family}{' hollow' if look.hollow else ''}"


def look_key(look: Look) -> str:
    """Mark of a look, as an SVG element for running text."""
    places = "L".join(f"{6.5 + 4.6 * a:.1f} {6.5 + 4.6 * b:.1f}" for a, b in SHAPES[look.mark])
    head = f'<svg class="key {look_class(look)}" viewBox="0 0 13 13" aria-hidden="true">'
    return f'{head}<path class="mark" d="M{places}z"/></svg>'


def look_mark(x: float, y: float, radius: float, look: Look, title: str = "") -> str:
    """Mark of a look at a place of an SVG; the title shows under the pointer."""
    tooltip = f"<title>{escape(title)}</title>" if title else ""
    places = "L".join(f"{radius * a:.1f} {radius * b:.1f}" for a, b in SHAPES[look.mark])
    path = f'<path class="mark" transform="translate({x:.1f} {y:.1f})" d="M{places}z">{tooltip}</path>'
    return f'<g class="{look_class(look)}">{path}</g>'
