"""Floor plan of the room in small: LEDs and true positions from above, as SVG."""

from markupsafe import Markup

from estimator.evaluate.score import Scores

SIDE = 176.0
MAX_DOTS = 2000


def thumbnail(scores: Scores) -> Markup:
    """SVG of the room, x right and y up; empty where the room is not known."""
    if scores.room_m is None:
        return Markup("")
    across, deep, _ = scores.room_m
    scale = SIDE / max(across, deep)
    width, height = across * scale, deep * scale

    def dots(places: list[tuple[float, float]]) -> str:
        shown = places[:: -(-len(places) // MAX_DOTS)] if places else []
        return "".join(f"M{x * scale:.1f} {height - y * scale:.1f}h0" for x, y in shown)

    leds = dots([led.position_m[:2] for led in scores.led_map])
    rows = scores.variants[0].rows if scores.variants else ()
    true = dots([row.true_m[:2] for row in rows])
    return Markup(
        f'<svg class="thumb" viewBox="-1 -1 {width + 2:.0f} {height + 2:.0f}" role="img" '
        f'aria-label="The room from above"><rect class="wall" width="{width:.1f}" height="{height:.1f}"/>'
        f'<path class="led" d="{leds}"/><path class="truth" d="{true}"/></svg>'
    )
