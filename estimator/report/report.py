"""HTML page of the scores of one or more datasets; it needs no other file and no network."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from estimator.evaluate.comparison import best, compare
from estimator.evaluate.score import Scores, VariantScore
from estimator.evaluate.score_table import (
    ERROR_HEADERS,
    ERROR_NOTE,
    LIMIT_HEADERS,
    LIMIT_NOTE,
    PAIR_HEADERS,
    PAIR_NOTE,
    error_cells,
    limit_cells,
    pair_cells,
)
from estimator.report.figures import distribution_plot, error_plot, frames_with_bound
from estimator.report.floor_plan import estimates_outside, floor_plan
from estimator.report.svg import key, style_of_variants

# Previews are for an impression; a page of thousands of them would not open.
MAX_PREVIEWS = 12
MAX_LARGE_PLANS = 6

STYLE = """
:root { color-scheme: light dark; --ink: #1c2024; --soft: #667078; --line: #dde2e6; --paper: #fff; --back: #f4f6f8;
  --see: .75; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ec; --soft: #9aa4ad; --line: #363d44; --paper: #1d2126; --back: #14171a; --see: 1; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1320px; padding: 32px 20px 64px; background: var(--back); color: var(--ink);
  font: 15px/1.5 system-ui, sans-serif; }
h1 { font-size: 26px; margin: 0 0 4px; }
h2 { font-size: 21px; margin: 48px 0 4px; }
h3 { font-size: 16px; margin: 28px 0 8px; }
p { margin: 4px 0; color: var(--soft); }
section > .card { background: var(--paper); border: 1px solid var(--line); border-radius: 10px; padding: 14px 18px;
  overflow-x: auto; }
section > .rows { padding: 6px 0; }
table { border-collapse: collapse; width: 100%; font-size: 14px; font-variant-numeric: tabular-nums; }
th { color: var(--soft); font-weight: 500; font-size: 13px; vertical-align: bottom; }
th, td { padding: 5px 10px; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
tbody tr:last-child td { border-bottom: 0; }
tr > :first-child { position: sticky; left: 0; background: var(--paper); }
tr > :last-child { padding-right: 18px; }
small { display: block; color: var(--soft); font-size: 11.5px; font-weight: 400; }
.text { text-align: left; }
.wrap, tr > td:first-child { white-space: normal; }
tr > :first-child { min-width: 215px; padding-left: 37px; text-indent: -19px; }
tr > th:first-child { text-indent: 0; padding-left: 18px; }
.failed { color: #d03b3b; font-weight: 600; }
svg.key { display: inline-block; width: 12px; height: 12px; margin-right: 7px; vertical-align: -1px; }
.name { margin-right: 18px; white-space: nowrap; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(300px, 1fr)); gap: 16px; }
.many { grid-template-columns: repeat(auto-fill, minmax(200px, 1fr)); gap: 12px; }
figure { margin: 0; }
figcaption { color: var(--soft); font-size: 13px; margin-top: 4px; }
img { width: 100%; border-radius: 6px; background: #000; }
svg { width: 100%; height: auto; display: block; }
svg text { fill: var(--soft); font: 12px system-ui, sans-serif; }
svg rect { fill: none; stroke: var(--soft); }
svg .led { fill: #e8b100; stroke: none; }
svg .rule { stroke: var(--line); }
svg .truth { fill: none; stroke: var(--ink); }
svg path { fill: none; stroke-width: 1.6; }
svg .bound { stroke: var(--ink); stroke-width: 2; }
svg .mark { fill-opacity: var(--see); stroke: none !important; }
svg.key .mark { fill-opacity: 1; }
"""


def page(datasets: Sequence[tuple[Path, Scores]]) -> str:
    """The page, for datasets given as folder and scores; of the folders, only previews are read.

    Raises OSError if a preview cannot be read.
    """
    body = "\n".join(_dataset(folder, scores) for folder, scores in datasets)
    names = ", ".join(escape(scores.dataset) for _, scores in datasets)
    max_variants = max((len(scores.variants) for _, scores in datasets), default=0)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Positioning report: {names}</title>
<style>{STYLE}{style_of_variants(max_variants)}</style>
</head>
<body>
<h1>Positioning report</h1>
<p>No frame is dropped: failed frames are counted beside the errors of the others, and count as infinite errors in the
columns “of all”.</p>
{body}
</body>
</html>
"""


def _dataset(folder: Path, scores: Scores) -> str:
    frames = scores.variants[0].frames if scores.variants else 0
    x, y, z = scores.room_m
    leds_m = [led.position_m for led in scores.led_map]
    plans = "\n".join(
        f"<figure>{floor_plan(scores.room_m, leds_m, variant, index)}<figcaption>{_name(scores, index)}"
        f"{_outside_note(scores, variant)}</figcaption></figure>"
        for index, variant in enumerate(scores.variants)
    )
    legend = " ".join(
        f'<span class="name">{_name(scores, index)}</span>' for index, variant in enumerate(scores.variants)
    )
    bounded = len(frames_with_bound(scores.variants))
    of_frames = f" Short lines: the Cramér-Rao bound, of {bounded} of {frames} frames." if bounded else ""
    of_all = " Vertical line: root mean square of the bound." if bounded else ""
    return f"""<section>
<h2>{escape(scores.dataset)}</h2>
<p>{frames} frames · {len(leds_m)} LEDs · room {x:g} × {y:g} × {z:g} m</p>
<h3>Scores</h3>
{_score_table(scores)}
{_limit_table(scores)}
{_pair_table(scores)}
{_failure_card(scores)}
<h3>3D error of each frame</h3>
<p>Crosses: failed frames.{of_frames}</p>
<div class="card"><p>{legend}</p>{error_plot(scores.variants)}</div>
<h3>Distribution of the 3D error</h3>
<p>A curve ends, on the right, at the variant's success rate.{of_all}</p>
<div class="card"><p>{legend}</p>{distribution_plot(scores.variants)}</div>
<h3>Floor plans</h3>
<p>Yellow: LEDs. Rings: true positions. Marks: estimates, joined to the truth. Crosses: failed frames.</p>
<div class="card grid{" many" if len(scores.variants) > MAX_LARGE_PLANS else ""}">{plans}</div>
{_previews(folder)}
</section>"""


def _score_table(scores: Scores) -> str:
    rows = [(_name(scores, index), error_cells(variant)) for index, variant in enumerate(scores.variants)]
    return _table(ERROR_HEADERS, rows, ERROR_NOTE)


def _limit_table(scores: Scores) -> str:
    """Table of bounds and covariances; empty if there is none, and no estimate is ambiguous."""
    if not any(variant.against_bound or variant.nees or variant.ambiguous for variant in scores.variants):
        return ""
    rows = [(_name(scores, index), limit_cells(variant)) for index, variant in enumerate(scores.variants)]
    return "<h3>Cramér-Rao bound and covariance consistency</h3>" + _table(LIMIT_HEADERS, rows, LIMIT_NOTE)


def _pair_table(scores: Scores) -> str:
    """Table of every variant compared with the best; empty for a single variant."""
    if len(scores.variants) < 2:
        return ""
    of_best = best(scores.variants)
    rows = [
        (_name(scores, index), pair_cells(compare(variant, of_best)))
        for index, variant in enumerate(scores.variants)
        if variant is not of_best
    ]
    note = (
        f"A: the row's variant. B: {of_best.variant}, with the smallest median error of all frames. It was selected on "
        f"the same frames, which favours it. {PAIR_NOTE}"
    )
    return f"<h3>Frame by frame against {escape(of_best.variant)}</h3>" + _table(PAIR_HEADERS, rows, note)


def _table(headers: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]], note: str) -> str:
    """Table of rows, each a variant's name as HTML and its cells; an interval stands in small type below its value."""
    body = "".join(f'<tr><td class="text">{name}</td>{_folded(headers, cells, "td")}</tr>' for name, cells in rows)
    return f"""<div class="card rows"><table>
<thead><tr><th class="text">variant</th>{_folded(headers, headers, "th")}</tr></thead>
<tbody>{body}</tbody>
</table></div>
<p>{escape(note)}</p>"""


def _folded(headers: Sequence[str], cells: Sequence[str], tag: str) -> str:
    folded: list[str] = []
    for header, cell in zip(headers, cells, strict=True):
        if header.endswith("interval"):
            if cell == "–":
                continue
            folded[-1] = folded[-1].removesuffix(f"</{tag}>") + f"<small>{escape(cell)}</small></{tag}>"
        else:
            kind = ' class="failed"' if header == "failed" and cell not in ("0", header) else ""
            folded.append(f"<{tag}{kind}>{escape(cell)}</{tag}>")
    return "".join(folded)


def _failure_card(scores: Scores) -> str:
    rows = "".join(
        f'<tr><td class="text">{_name(scores, index)}</td><td>{count}</td>'
        f'<td class="text wrap">{escape(reason)}</td></tr>'
        for index, variant in enumerate(scores.variants)
        for reason, count in variant.failures.items()
    )
    if not rows:
        return ""
    head = '<thead><tr><th class="text">variant</th><th>frames</th><th class="text">reason</th></tr></thead>'
    return f'<h3>Failures</h3><div class="card rows"><table>{head}<tbody>{rows}</tbody></table></div>'


def _outside_note(scores: Scores, variant: VariantScore) -> str:
    count = estimates_outside(scores.room_m, variant)
    return f" · {count} estimates outside the walls" if count else ""


def _name(scores: Scores, index: int) -> str:
    """Mark and name of a variant, with line breaks allowed before its options."""
    name = escape(scores.variants[index].variant)
    return key(index) + name.replace(":", ":<wbr>").replace(",", ",<wbr>")


def _previews(folder: Path) -> str:
    """Up to MAX_PREVIEWS previews of the dataset, evenly selected, embedded in the page; empty without previews."""
    paths = sorted((folder / "previews").glob("*.png"))
    if not paths:
        return ""
    count = min(len(paths), MAX_PREVIEWS)
    figures = []
    for path in (paths[index * len(paths) // count] for index in range(count)):
        data = base64.b64encode(path.read_bytes()).decode()
        image = f'<img alt="{escape(path.stem)}" src="data:image/png;base64,{data}">'
        figures.append(f"<figure>{image}<figcaption>frame {escape(path.stem)}</figcaption></figure>")
    return f'<h3>Previews</h3><p>{count} of {len(paths)}</p><div class="card grid">{"".join(figures)}</div>'
