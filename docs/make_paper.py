"""Reproduce Huynh & Yoo, Sensors 2016, for docs/paper.md and docs/paper.html: python docs/make_paper.py [ITEM ...]

Each item makes its sets from the recipes of docs/paper/, runs the variants and keeps tables, plots and errors in
docs/paper/. Sets and estimates that are finished are kept in the folder `--out`; interrupted ones are continued. The
pages are written from what docs/paper/ keeps: items without it are listed as not run. With `--full` the sets have the
paper's sizes, or a thousand poses a setting; their tables go to docs/paper/full/, and the pages stay as they are.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import time
from pathlib import Path

from paper_figures import Tables
from paper_items import ITEMS, Item
from paper_page import write_pages
from paper_sets import (
    PAGE,
    ROOT,
    Clock,
    OutOfTime,
    cpu_s,
    draw,
    keep_scores,
    keep_view,
    measure,
    program_digest,
    rounded,
)


def make(item: Item, chosen: argparse.Namespace, clock: Clock) -> None:
    """Measure an item and write what docs/paper/ keeps of it. Raises OutOfTime."""
    sets = {one.name: measure(one, chosen.out, chosen.seeds, chosen.full, chosen.workers, clock) for one in item.sets}
    kept_in = PAGE / "full" if chosen.full else PAGE
    kept_in.mkdir(exist_ok=True)
    views = [keep_view(item.name, view, sets[view.set].folder, kept_in) for view in item.views]
    for one in item.sets:
        if one.variants and not chosen.full:
            keep_scores(one, sets[one.name].folder)
    grids, extra = item.extra(sets) if item.extra else ([], {})
    for grid in grids:
        if "svg" in grid:
            (kept_in / grid["plot"]).write_text(grid.pop("svg"))
    figures = item.figures(Tables({view["name"]: view for view in views}, extra))
    kept = {
        "item": item.name,
        "command": f"python docs/make_paper.py {item.name}{' --full' * chosen.full} --seeds {chosen.seeds}",
        "commit": _commit(),
        "program": program_digest(),
        "seeds": chosen.seeds,
        "sets": [
            {
                "name": name,
                "recipe": hashlib.sha256((PAGE / f"{name}.toml").read_bytes()).hexdigest(),
                "digest": one.digest,
                "frames": one.frames,
                "generate_s": round(one.generate_s, 1),
                "estimate_s": round(one.estimate_s, 1),
            }
            for name, one in sets.items()
        ],
        "figures": {key: rounded(value) for key, value in figures.items()},
        "views": views,
        "grids": grids,
    }
    text = json.dumps(kept, indent=1, ensure_ascii=False) + "\n"
    (kept_in / f"{item.name}.json").write_text(text, encoding="utf-8")


def _commit() -> str:
    found = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return found.stdout.strip() or "none"


def main() -> int:
    """Measure the items that are named, by default all, then write the pages. Returns 1 where time ran out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("items", nargs="*", metavar="ITEM", help=f"of {', '.join(ITEMS)}; default: all")
    parser.add_argument("--full", action="store_true", help="the size of the paper, in place of one of minutes")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="end after this time; a later run goes on")
    parser.add_argument("--out", type=Path, default=Path("out/paper"), help="folder of the sets")
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds, 1, 2, ...")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument(
        "--pages", action="store_true", help="draw and write the pages from what is kept; measure nothing"
    )
    chosen = parser.parse_args()
    unknown = [name for name in chosen.items if name not in ITEMS]
    if unknown:
        parser.error(f"ITEM {unknown[0]}: unknown; allowed: {', '.join(ITEMS)}")
    chosen.out.mkdir(parents=True, exist_ok=True)
    clock = Clock(time.monotonic() + 60 * chosen.minutes)
    for item in ITEMS.values() if chosen.pages else ():
        for view in item.views:
            draw(item.name, view, PAGE)
    for name in () if chosen.pages else chosen.items or ITEMS:
        start, start_cpu_s = time.monotonic(), cpu_s()
        try:
            make(ITEMS[name], chosen, clock)
        except OutOfTime:
            print(f"{name}: out of time; the same command goes on", file=sys.stderr)
            write_pages()
            return 1
        print(
            f"{name}: {time.monotonic() - start:.0f} s, CPU {cpu_s() - start_cpu_s:.0f} s", file=sys.stderr, flush=True
        )
    write_pages()
    return 0


if __name__ == "__main__":
    sys.exit(main())
