"""Marks of variants as SVG, by their looks (`estimator.methods.looks`); report.css gives a family its hue."""

import math

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


def look_class(look: Look) -> str:
    """CSS classes of a look."""
    return f"hue-{look.family}{' hollow' if look.hollow else ''}"


def look_key(look: Look) -> str:
    """Mark of a look, as an SVG element for running text."""
    places = "L".join(f"{6.5 + 4.6 * a:.1f} {6.5 + 4.6 * b:.1f}" for a, b in SHAPES[look.mark])
    head = f'<svg class="key {look_class(look)}" viewBox="0 0 13 13" aria-hidden="true">'
    return f'{head}<path class="mark" d="M{places}z"/></svg>'
