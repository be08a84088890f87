"""Damage study: one-bit flips over all files of a dataset, and what comes of each.

    python tests/damage/flips.py --finished 2000 --unfinished 500

A small set with expected, processed and preview images is made and finished, and made again and interrupted half way.
Each flip inverts one random bit of one file in a copy: files take turns by their kind, so that small files get as many
flips as large ones. In a finished set `verify` has to find it; in an unfinished one the same `generate` has to refuse
it, or to finish the set as if nothing had happened. The exit code is 1 if a flip is missed.
"""

import argparse
import logging
import os
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import vlcrender as vr
from vlcrender.dataset.format.files import read_json_object
from vlcrender.errors import InputError

RECIPE = Path(__file__).parent.parent.parent / "datasets/quickstart.toml"
FRAMES, DONE = 4, 2
"""Frames of the set, and those that the interrupted run had made."""
ASSIGNMENTS = (f"poses.count={FRAMES}", "expected=true", "processed.format=png")
REGIONS = 'regions={ kind = "leds", margin_px = 2 }'
SHARDED = (REGIONS, "files.frames_per_file=2", f"poses.count={FRAMES}", "expected=true")
OUTCOMES = ("found", "refused", "made again", "harmless", "MISSED")
"""By verify; by an error; the files of a frame anew; the same values; other values and no word."""


class Interrupted(Exception):
    """Raised by the progress of a run to end it half way."""


def plan(scale: int, is_sharded: bool) -> vr.Plan:
    """The plan of the set."""
    return vr.load_recipe(RECIPE, list(SHARDED if is_sharded else ASSIGNMENTS), scale=scale)


def make_unfinished(of: vr.Plan, folder: Path) -> None:
    """Make DONE frames and stop."""

    def stop(progress: vr.Progress) -> None:
        if progress.stage == "frames" and progress.done >= DONE:
            raise Interrupted

    try:
        vr.generate(of, folder, progress=stop)
    except Interrupted:
        return
    raise AssertionError("the run was not interrupted")


def content(folder: Path) -> dict[str, object]:
    """Every file by its path: bytes, and of JSON files the values."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            name = path.relative_to(folder).as_posix()
            found[name] = read_json_object(path) if path.suffix == ".json" else path.read_bytes()
    return found


def kind_of(name: str) -> str:
    """A file's row in the table."""
    return name if "/" not in name else f"{name.partition('/')[0]}/*{Path(name).suffix}"


def flips(folder: Path, count: int, rng: np.random.Generator) -> Iterator[tuple[str, int, int]]:
    """File, byte and bit of each flip, kinds of files in turn."""
    kinds: dict[str, list[str]] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.stat().st_size:
            name = path.relative_to(folder).as_posix()
            kinds.setdefault(kind_of(name), []).append(name)
    for number in range(count):
        names = list(kinds.values())[number % len(kinds)]
        name = names[int(rng.integers(len(names)))]
        yield name, int(rng.integers((folder / name).stat().st_size)), int(rng.integers(8))


def flip(path: Path, byte: int, bit: int) -> None:
    """Invert a bit of a file, which is a file of its own: not one with several names."""
    data = bytearray(path.read_bytes())
    data[byte] ^= 1 << bit
    path.unlink()
    path.write_bytes(data)


def of_finished(whole: dict[str, object]) -> Callable[[Path], str]:
    """What comes of a flip in a finished set of this content."""

    def outcome(folder: Path) -> str:
        try:
            if vr.verify(folder):
                return "found"
        except InputError:
            return "refused"
        return "harmless" if content(folder) == whole else "MISSED"

    return outcome


def of_unfinished(of: vr.Plan, whole: dict[str, object]) -> Callable[[Path], str]:
    """What comes of a flip in an unfinished set, whose content is `whole` when it is finished."""

    def outcome(folder: Path) -> str:
        resumed: list[float] = []
        try:
            vr.generate(of, folder, progress=lambda p: resumed.append(p.done) if p.stage == "frames" else None)
            if vr.verify(folder):
                return "found"
        except InputError:
            return "refused"
        if content(folder) != whole:
            return "MISSED"
        return "harmless" if resumed[0] == DONE else "made again"

    return outcome


def study(start: Path, count: int, seed: int, work: Path, outcome: Callable[[Path], str]) -> dict[str, Counter[str]]:
    """Outcomes of flips in copies of a folder, by kinds of files. An error other than InputError counts as MISSED."""
    found: dict[str, Counter[str]] = {}
    for name, byte, bit in flips(start, count, np.random.default_rng(seed)):
        copy = work / "copy"
        if copy.exists():
            shutil.rmtree(copy)
        shutil.copytree(start, copy, copy_function=os.link)  # `flip` makes the changed file one of its own
        if (copy / "journal.jsonl").exists():  # to which a run appends
            (copy / "journal.jsonl").unlink()
            shutil.copyfile(start / "journal.jsonl", copy / "journal.jsonl")
        flip(copy / name, byte, bit)
        try:
            result = outcome(copy)
        except Exception as error:  # a fault of the program: what a user would see
            print(f"{name}: byte {byte}, bit {bit}: {type(error).__name__}: {error}", file=sys.stderr)
            result = "MISSED"
        if result == "MISSED":
            print(f"{name}: byte {byte}, bit {bit}: missed", file=sys.stderr)
        found.setdefault(kind_of(name), Counter())[result] += 1
    return found


def print_table(title: str, found: dict[str, Counter[str]]) -> int:
    """Print the counts by kind of file, and return those that were missed."""
    print(f"\n{title}")
    print(f"{'file':<22}" + "".join(f"{name:>12}" for name in OUTCOMES))
    total: Counter[str] = Counter()
    for kind, counts in sorted(found.items()):
        print(f"{kind:<22}" + "".join(f"{counts[name]:>12}" for name in OUTCOMES))
        total += counts
    print(f"{'all':<22}" + "".join(f"{total[name]:>12}" for name in OUTCOMES), flush=True)
    return total["MISSED"]


def main() -> int:
    """Run the study; the exit code."""
    parser = argparse.ArgumentParser(description="One-bit flips over all files of a dataset")
    parser.add_argument("--finished", type=int, default=200, help="flips in a finished set")
    parser.add_argument("--unfinished", type=int, default=50, help="flips in an unfinished set")
    parser.add_argument("--scale", type=int, default=20, help="pixels binned into one, across and down")
    parser.add_argument("--sharded", action="store_true", help="regions, two frames in each file")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    missed = 0
    with tempfile.TemporaryDirectory(prefix="flips-") as name:
        work = Path(name)
        of = plan(options.scale, options.sharded)
        vr.generate(of, work / "whole")
        whole = content(work / "whole")
        if options.finished:
            found = study(work / "whole", options.finished, options.seed, work, of_finished(whole))
            missed += print_table(f"finished set of {FRAMES} frames: {options.finished} flips", found)
        if options.unfinished:
            make_unfinished(of, work / "half")
            found = study(work / "half", options.unfinished, options.seed, work, of_unfinished(of, whole))
            missed += print_table(f"unfinished set, {DONE} of {FRAMES} frames: {options.unfinished} flips", found)
    print(f"\n{missed} missed")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
