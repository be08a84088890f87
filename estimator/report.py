"""One HTML page about one or more scored datasets; it needs no other file and no network."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from estimator.figures import error_plot, outside, plan
from estimator.score import TABLE_HEADERS, Scores, VariantScore, table_cells

# Pictures are to get an impression; a page of thousands of them would open nowhere.
MOST_PREVIEWS = 12

# Okabe and Ito's colours, told apart by colour-blind readers too; they repeat after seven variants.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a7a00")

STYLE = """
:root { color-scheme: light dark; --ink: #1c2024; --soft: #667078; --line: #dde2e6; --paper: #fff; --back: #f4f6f8; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ec; --soft: #9aa4ad; --line: #363d44; --paper: #1d2126; --back: #14171a; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1200px; padding: 32px 20px 64px; background: var(--back); color: var(--ink);
  font: 15px/1.5 system-ui, sans-serif; }
h1 { font-size: 26px; margin: 0 0 4px; }
h2 { font-size: 21px; margin: 48px 0 4px; }
h3 { font-size: 16px; margin: 28px 0 8px; }
p { margin: 4px 0; color: var(--soft); }
section > .card { background: var(--paper); border: 1px solid var(--line); border-radius: 10px; padding: 14px 18px;
  overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th { color: var(--soft); font-weight: 500; font-size: 13px; }
th, td { padding: 6px 10px; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
tr:last-child td { border-bottom: 0; }
.text { text-align: left; }
.wrap { white-space: normal; }
.failed { color: #d03b3b; font-weight: 600; }
.key { display: inline-block; width: 10px; height: 10px; border-radius: 50%; margin-right: 8px; }
.name { margin-right: 18px; white-space: nowrap; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(300px, 1fr)); gap: 16px; }
figure { margin: 0; }
figcaption { color: var(--soft); font-size: 13px; margin-top: 4px; }
img { width: 100%; border-radius: 6px; background: #000; }
svg { width: 100%; height: auto; display: block; }
svg text { fill: var(--soft); font: 12px system-ui, sans-serif; }
svg rect { fill: none; stroke: var(--soft); }
svg .led { fill: #e8b100; stroke: none; }
svg .rule { stroke: var(--line); }
svg .truth { fill: none; stroke: var(--ink); }
svg circle { fill-opacity: .75; }
svg path { fill: none; stroke-width: 1.6; }
"""


def page(datasets: Sequence[tuple[Path, Scores]]) -> str:
    """The whole page, for datasets given as folder and scores; previews are read from the folders, nothing else is.

    Raises OSError where a preview cannot be read.
    """
    body = "\n".join(_dataset(folder, scores) for folder, scores in datasets)
    names = ", ".join(escape(scores.dataset) for _, scores in datasets)
    most = max((len(scores.variants) for _, scores in datasets), default=0)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Positioning report: {names}</title>
<style>{STYLE}{_variant_style(most)}</style>
</head>
<body>
<h1>Positioning report</h1>
<p>Errors are over the frames that succeeded; failed frames are counted beside them, and none is dropped.</p>
{body}
</body>
</html>
"""


def _variant_style(count: int) -> str:
    rules = []
    for index in range(count):
        colour = COLOURS[index % len(COLOURS)]
        rules.append(f"svg .v{index} {{ stroke: {colour}; }} svg circle.v{index} {{ fill: {colour}; stroke: none; }}")
        rules.append(f".key.v{index} {{ background: {colour}; }}")
    return "\n".join(rules)


def _dataset(folder: Path, scores: Scores) -> str:
    frames = scores.variants[0].frames if scores.variants else 0
    x, y, z = scores.room_m
    leds_m = [led.position_m for led in scores.led_map]
    plans = "\n".join(
        f"<figure>{plan(scores.room_m, leds_m, variant, index)}<figcaption>{_key(index)}{escape(variant.variant)}"
        f"{_outside_note(scores, variant)}</figcaption></figure>"
        for index, variant in enumerate(scores.variants)
    )
    legend = " ".join(
        f'<span class="name">{_key(index)}{escape(variant.variant)}</span>'
        for index, variant in enumerate(scores.variants)
    )
    return f"""<section>
<h2>{escape(scores.dataset)}</h2>
<p>{frames} frames · {len(leds_m)} LEDs · room {x:g} × {y:g} × {z:g} m</p>
<h3>Scores</h3>
<div class="card">{_score_table(scores)}</div>
{_failure_card(scores)}
<h3>3D error of each frame</h3>
<div class="card"><p>{legend}</p>{error_plot(scores.variants)}</div>
<h3>The room from above</h3>
<p>Yellow: LEDs. Rings: true positions. Dots: estimates, joined to the truth. Crosses: failed frames.</p>
<div class="card grid">{plans}</div>
{_previews(folder)}
</section>"""


def _score_table(scores: Scores) -> str:
    rows = []
    for index, variant in enumerate(scores.variants):
        ok, failed, *others = table_cells(variant)
        kind = "failed" if variant.failed else "none"
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in others)
        name = f'<td class="text">{_key(index)}{escape(variant.variant)}</td>'
        rows.append(f'<tr>{name}<td>{ok}</td><td class="{kind}">{failed}</td>{cells}</tr>')
    head = "".join(f"<th>{header}</th>" for header in TABLE_HEADERS)
    return f"""<table>
<thead><tr><th class="text">variant</th>{head}</tr></thead>
<tbody>{"".join(rows)}</tbody>
</table>
<p>Median to max: 3D error. Horizontal, vertical, range and time: medians, range over all distances made, failed
frames' included.</p>"""


def _failure_card(scores: Scores) -> str:
    rows = "".join(
        f'<tr><td class="text">{_key(index)}{escape(variant.variant)}</td><td>{count}</td>'
        f'<td class="text wrap">{escape(reason)}</td></tr>'
        for index, variant in enumerate(scores.variants)
        for reason, count in variant.failures.items()
    )
    if not rows:
        return ""
    head = '<thead><tr><th class="text">variant</th><th>frames</th><th class="text">reason</th></tr></thead>'
    return f'<h3>Failures</h3><div class="card"><table>{head}<tbody>{rows}</tbody></table></div>'


def _outside_note(scores: Scores, variant: VariantScore) -> str:
    count = outside(scores.room_m, variant)
    return f" · {count} estimates outside the walls" if count else ""


def _key(index: int) -> str:
    return f'<span class="key v{index}"></span>'


def _previews(folder: Path) -> str:
    """Up to MOST_PREVIEWS of the dataset's small pictures, evenly picked, as data in the page; nothing without any."""
    paths = sorted((folder / "previews").glob("*.png"))
    if not paths:
        return ""
    count = min(len(paths), MOST_PREVIEWS)
    figures = []
    for path in (paths[index * len(paths) // count] for index in range(count)):
        data = base64.b64encode(path.read_bytes()).decode()
        image = f'<img alt="{escape(path.stem)}" src="data:image/png;base64,{data}">'
        figures.append(f"<figure>{image}<figcaption>frame {escape(path.stem)}</figcaption></figure>")
    return f'<h3>Previews</h3><p>{count} of {len(paths)}</p><div class="card grid">{"".join(figures)}</div>'
