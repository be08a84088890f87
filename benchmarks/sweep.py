"""What the cells of a sweep cost: CPU time of ten cells over that of one dataset.

    python benchmarks/sweep.py [POSES] [REPEATS]

LED regions of `office20`, 4000 x 3000 pixels, without and with the bound. CPU time of all threads, alternately in one
process, all files included. The peer is one plain dataset: ten of them would cost 10, and ten starts of the program.
"""

import itertools
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from target import Targets, alternating_s, ratio

from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run.generate import generate

OFFICE20 = Path(__file__).parent.parent / "datasets/office20.toml"
CELLS = 10
SWEEPS = {
    "accelerometer.error_deg": ("accelerometer", 2.5),
    "sensor.read_noise_e": ("read noise", 7.5),
    "camera.f_number": ("f-number", 10.0),
}
"""Swept keys: what they are called, and the largest ratio wanted: a quarter of ten sets where frames are linked, three
quarters where views are used again, all of them where nothing is shared but the start."""


def set_of(folder: Path, overrides: list[str]) -> Callable[[], object]:
    """A function that makes a dataset or a sweep, each time in a folder of its own."""
    plan, numbers = load_plan(OFFICE20, overrides), itertools.count()
    own = Path(tempfile.mkdtemp(dir=folder))
    return lambda: generate(plan, own / str(next(numbers)))


def main() -> None:
    """Measure and print."""
    poses = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    repeats = int(sys.argv[2]) if len(sys.argv) > 2 else 2
    targets = Targets()
    print(f"{poses} frames of LED regions of 4000 x 3000 pixels a set, {CELLS} cells a sweep, {repeats} repeats")
    for bound in (False, True):
        shared = [f"poses.count={poses}", "regions.kind=leds", "sensor.noise=full", f"bound={str(bound).lower()}"]
        for key, (name, most) in SWEEPS.items():
            sweep = f'sweep=[{{ key = "{key}", grid = [1, 4, {CELLS}] }}]'
            with tempfile.TemporaryDirectory() as folder:
                make = partial(set_of, Path(folder))
                seconds = alternating_s([make([*shared, sweep]), make(shared)], repeats, time.process_time)
            with_bound = ", with bound" if bound else ""
            targets.at_most(f"{CELLS} cells of {name} / one set{with_bound}", ratio(*seconds), most)
    targets.finish()


if __name__ == "__main__":
    main()
