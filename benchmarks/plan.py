"""Time of plans, the checks before a first frame: 122 500 poses of Table 1, and a million aimed poses.

    python benchmarks/plan.py

Exits with 1 where a plan takes longer than wanted, in processor time.
"""

import time
from pathlib import Path

from target import Targets

import vlcrender as vr
from vlcrender.dataset.run.possible import check_possible

ROOT = Path(__file__).parent.parent
SECONDS = 10.0
"""Largest time wanted."""
GROWTH = 2.0
"""Largest ratio wanted, of a million poses over a thousand, of which as many are made."""


def planned_s(recipe: str, *assignments: str) -> float:
    """Processor time of a plan's reading and checks."""
    start_s = time.process_time()
    check_possible(vr.load_recipe(ROOT / f"datasets/{recipe}.toml", assignments))
    return time.process_time() - start_s


def main() -> None:
    """Measure, print, and hold."""
    targets = Targets()
    planned_s("office200")  # imports, and the room's mesh
    table_s = planned_s("table1", "poses.columns=350", "poses.rows=350")
    few_s, many_s = (planned_s("office200", f"poses.count={count}") for count in (1000, 1_000_000))
    targets.at_most("122 500 poses of Table 1, s", table_s, SECONDS)
    targets.at_most("1 000 000 aimed poses, s", many_s, SECONDS)
    targets.at_most("1 000 000 poses / 1 000 poses", many_s / few_s, GROWTH)
    targets.finish()


if __name__ == "__main__":
    main()
