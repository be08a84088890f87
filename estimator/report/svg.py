"""SVG for plots and files: lines, text, and the marks and colours of the variants."""

import hashlib
from collections.abc import Sequence
from html import escape

# Okabe and Ito's colours, distinguishable by colour-blind readers. From the eighth variant on they repeat with another
# mark and another dash pattern.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a7a00")
# Vertices in units of the radius of a disc of the same visual size; the first mark is that disc.
MARKS = (
    (),
    ((-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)),
    ((0.0, -1.3), (1.2, 0.8), (-1.2, 0.8)),
    ((0.0, -1.35), (1.35, 0.0), (0.0, 1.35), (-1.35, 0.0)),
)
DASHES = ("none", "7 3", "2 3", "9 3 2 3")
FILE_STYLE = """svg { background: #fff; font: 12px system-ui, sans-serif; }
svg text { fill: #444; }
svg path { fill: none; stroke-width: 1.6; }
svg .rule { stroke: #dde2e6; }
svg .bound { stroke: #1c2024; stroke-width: 2; }
svg .mark { stroke: none !important; }"""
"""Style of a file; a page has its own."""


def slots_of(groups: Sequence[tuple[str, str]], known: Sequence[str]) -> list[int]:
    """Index of the mark and colour of each group, given by a name, which fixes them, and what else tells it apart.

    That of a name is its place in `known`, or one by its hash. Groups of one name have its colour, and the marks from
    its own on. A group whose place another one has takes the next that is free.
    """
    places = len(COLOURS) * len(MARKS)
    others = sorted({other for _, other in groups})
    taken: dict[tuple[str, str], int] = {}
    for name, other in sorted(groups, key=lambda group: (group[0] not in known, group)):
        digest = hashlib.sha256(name.encode()).digest()
        slot = known.index(name) if name in known else int.from_bytes(digest[:4], "big")
        slot += len(COLOURS) * others.index(other)
        if len(taken) < places:
            slot = next(one for one in range(slot, slot + places) if one % places not in taken.values())
        taken[name, other] = slot % places
    return [taken[group] for group in groups]


def style_of_variants(count: int) -> str:
    """CSS of the classes `v0`, `v1`, ... of `count` variants."""
    rules = []
    for index in range(count):
        colour, dash = COLOURS[index % len(COLOURS)], DASHES[index // len(COLOURS) % len(DASHES)]
        rules.append(f"svg .v{index} {{ stroke: {colour}; }} svg .mark.v{index} {{ fill: {colour}; }}")
        rules.append(f"svg .curve.v{index} {{ stroke-dasharray: {dash}; }}")
    return "\n".join(rules)


def picture(width: float, height: float, label: str, parts: Sequence[str]) -> str:
    """SVG element as wide as its container, with a label for screen readers."""
    body = "\n".join(parts)
    return f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(label)}">\n{body}\n</svg>'


def svg_file(element: str, style: str) -> str:
    """A `picture` as a file of its own, with its styles."""
    head, body = element.split(">", 1)
    size = head.split('viewBox="0 0 ')[1].split('"')[0].split()
    root = f'{head} xmlns="http://www.w3.org/2000/svg" width="{size[0]}" height="{size[1]}"'
    whole = escape(f"{FILE_STYLE}\n{style}", quote=False)
    return f"{root}>\n<style>{whole}</style>{body}\n"


def mark(x: float, y: float, radius: float, index: int, title: str = "") -> str:
    """Mark of a variant; the title shows under the pointer."""
    tooltip = f"<title>{escape(title)}</title>" if title else ""
    vertices = MARKS[index // len(COLOURS) % len(MARKS)]
    if not vertices:
        return f'<circle class="mark v{index}" cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}">{tooltip}</circle>'
    places = "L".join(f"{x + a * radius:.1f} {y + b * radius:.1f}" for a, b in vertices)
    return f'<path class="mark v{index}" d="M{places}z">{tooltip}</path>'


def cross(x: float, y: float, index: int, title: str) -> str:
    """Cross that marks a failed frame of a variant."""
    strokes = f"M{x - 3:.1f} {y - 3:.1f}l6 6m0 -6l-6 6"
    return f'<path class="v{index}" d="{strokes}"><title>{escape(title)}</title></path>'


def line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    """Straight line of a CSS class."""
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def text(x: float, y: float, words: str, anchor: str) -> str:
    """Text that starts at, ends at, or is centred on (x, y): anchor `start`, `end` or `middle`."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(words)}</text>'
