"""Start two `vlcrender generate` in one folder at once: exit code 0 of either only where `verify` finds no damage.

    python tests/damage/races.py [--count 20] [--frames 6] [--seed 1]

The second run starts up to two seconds after the first, and in every third race with another seed, as another dataset.
Prints one line a race and exits with 1 where a run ended with 0 before the dataset was whole, where both runs failed,
where a refusal is not one line that names the holder, or where a file or a lock is left over.
"""

import argparse
import random
import sys
import time
from pathlib import Path

from runs import end, generate_command, manifest, start, verified, work_folder


def race(folder: Path, frames: int, chance: random.Random, differ: bool, wanted: dict[str, str]) -> tuple[str, str]:
    """What happened in a race, and what was wrong with it."""
    options = ["--workers", "2"] if chance.random() < 0.3 else []
    first = start(generate_command(folder, frames, options))
    time.sleep(chance.choice((0.0, chance.uniform(0.0, 2.0))))
    second = start(generate_command(folder, frames, [*options, *(["--set", "seed=7"] if differ else [])]))
    running, problems, codes = {"first": first, "second": second}, [], {}
    while running:
        for name, process in list(running.items()):
            if process.poll() is None:
                continue
            codes[name] = process.returncode
            del running[name]
            output = process.communicate()[0]
            if process.returncode == 0 and (damage := verified(folder)):
                problems.append(f"{name} ended with 0, but: {damage.strip()[:300]}")
            lines = [line for line in output.splitlines() if line.startswith("vlcrender: ")]
            if process.returncode == 2 and not (
                "in use by `vlcrender generate`" in output or "another recipe" in output
            ):
                problems.append(f"{name}: {output.strip()[-300:]}")
            if process.returncode not in (0, 2) or "Traceback" in output or len(lines) > 1:
                problems.append(f"{name}: exit code {process.returncode}: {output.strip()[-300:]}")
        time.sleep(0.01)
    if 0 not in codes.values():
        problems.append("neither run made the dataset")
    for process in (first, second):
        end(process)
    found = manifest(folder)
    if not differ and found != wanted:
        problems.append(f"differs: {sorted(name for name in found if found[name] != wanted.get(name))}")
    left = [path.name for path in folder.rglob("*") if path.suffix == ".partial" or path.name == ".vlcrender.lock"]
    if left:
        problems.append(f"left over: {', '.join(left)}")
    return f"exit codes {codes['first']} and {codes['second']}", "; ".join(problems)


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description="two runs in one folder at once")
    parser.add_argument("--count", type=int, default=20, help="races")
    parser.add_argument("--frames", type=int, default=6, help="frames of the dataset")
    parser.add_argument("--seed", type=int, default=1, help="of the moments")
    given = parser.parse_args()
    chance = random.Random(given.seed)
    failures = 0
    with work_folder() as work:
        alone = start(generate_command(work / "alone", given.frames))
        if alone.wait() != 0:
            print(alone.communicate()[0])
            return 1
        wanted = manifest(work / "alone")
        for number in range(given.count):
            happened, problem = race(work / f"race-{number}", given.frames, chance, number % 3 == 2, wanted)
            failures += bool(problem)
            print(f"race {number}: {happened}: {problem or 'right'}", flush=True)
    print(f"{given.count} races: {given.count - failures} right, {failures} wrong")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
