"""Floor plan: the room from above, with one variant's estimates and the true positions."""

from collections.abc import Sequence

from estimator.evaluate.score import VariantScore
from estimator.evaluate.score_table import length_text
from estimator.io.records import Triple
from estimator.report.svg import cross, line, mark, picture

WIDTH = 460.0
BORDER = 12.0


def floor_plan(room_m: Triple, leds_m: Sequence[Triple], variant: VariantScore, index: int) -> str:
    """SVG of the room, x right and y up: LEDs, true positions (rings), estimates (marks) and lines between them."""
    scale = (WIDTH - 2 * BORDER) / room_m[0]
    height = room_m[1] * scale + 2 * BORDER

    def place(point_m: Triple) -> tuple[float, float]:
        return BORDER + point_m[0] * scale, height - BORDER - point_m[1] * scale

    parts = [f'<rect x="{BORDER}" y="{BORDER}" width="{WIDTH - 2 * BORDER}" height="{room_m[1] * scale:.1f}"/>']
    parts += [
        f'<rect class="led" x="{u - 2:.1f}" y="{v - 2:.1f}" width="4" height="4"/>' for u, v in map(place, leds_m)
    ]
    for row in variant.rows:
        u, v = place(row.true_m)
        if row.estimate_m is None:
            parts.append(cross(u, v, index, f"frame {row.frame}: {row.reason}"))
            continue
        # Limit far outliers: viewers fail on huge coordinates.
        a, b = (max(-1e4, min(1e4, value)) for value in place(row.estimate_m))
        parts.append(line(u, v, a, b, f"v{index}"))
        parts.append(f'<circle class="truth" cx="{u:.1f}" cy="{v:.1f}" r="4"/>')
        parts.append(mark(a, b, 2.5, index, f"frame {row.frame}: {length_text(row.error_3d_m)}"))
    return picture(WIDTH, height, f"floor plan, {variant.variant}", parts)


def estimates_outside(room_m: Triple, variant: VariantScore) -> int:
    """Number of a variant's estimates outside the walls."""
    estimates = [row.estimate_m for row in variant.rows if row.estimate_m is not None]
    return sum(not (0 <= x <= room_m[0] and 0 <= y <= room_m[1]) for x, y, _ in estimates)
