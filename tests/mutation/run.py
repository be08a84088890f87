"""Mutation testing: does a test fail where the code is changed?

    python tests/mutation/run.py map                        which tests execute which lines (once, some ten minutes),
                                                            with the statements and branches that none executes
    python tests/mutation/run.py chosen [--only NAME]       the kept lists, chosen_*.toml
    python tests/mutation/run.py sample --count 150 --seed 7
    python tests/mutation/run.py sample --test-seconds 30   a first pass with fewer tests; the next one takes its
                                                            survivors only

Each mutant is one change to one file of a copy of the checkout. The tests that execute the changed line run against it,
those of its module first, then the quickest, up to the first failure: killed. A mutant whose tests all pass survived:
a test is missing, or the change is equivalent (equivalent_*.toml says why: `file`, `change`, and `line`, a part of the
source line, where the same change elsewhere in the file would not be). Runs go on where they stopped: results are
kept in out/mutants/results.jsonl under a hash of the mutated source and of the tests.
"""

import argparse
import concurrent.futures
import hashlib
import json
import os
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
sys.path.insert(0, str(HERE))
from operators import sites  # noqa: E402  beside this file

OUT = ROOT / "out/mutants"
PACKAGES = ("vlcrender", "estimator")
MAX_TEST_S = 240.0
"""Recorded time of the tests that one mutant is held against, if no other is asked for; the quickest are taken."""
NEAR = 0.1
"""Tests of a module find most of its mutants: their times are weighted by this."""
BAKING = tuple(f"vlcrender/{floor}" for floor in ("light", "scene", "camera", "config", "core", "sensor"))
"""Mutants here may change the light of rooms; all others share one cache of it."""
PATIENCE = 4.0
"""A mutant that takes this many times the recorded time, and a minute, hangs: killed."""


@dataclass(frozen=True)
class Mutant:
    """One change: the mutated source of `file`, whose changed text starts in `line`."""

    name: str
    file: str
    line: int
    source: str
    change: str

    @property
    def digest(self) -> str:
        """Of file and mutated source."""
        return hashlib.sha256(f"{self.file}\0{self.source}".encode()).hexdigest()[:16]


def chosen(names: Iterable[str]) -> list[Mutant]:
    """The kept lists; SystemExit where an entry no longer fits its file."""
    wanted = set(names)
    mutants = []
    for path in sorted(HERE.glob("chosen*.toml")):
        for entry in tomllib.loads(path.read_text())["mutant"]:
            if not wanted or entry["name"] in wanted:
                mutants.append(_of_entry(entry, path.name))
    return mutants


def _of_entry(entry: dict[str, str], where: str) -> Mutant:
    source = (ROOT / entry["file"]).read_text()
    count = source.count(entry["old"])
    if count != 1:
        sys.exit(f"{where}: {entry['name']}: `old` occurs {count} times in {entry['file']}, needed once")
    line = source.count("\n", 0, source.index(entry["old"])) + 1 + _first_difference(entry["old"], entry["new"])
    mutated = source.replace(entry["old"], entry["new"])
    return Mutant(entry["name"], entry["file"], line, mutated, f"{entry['old']} -> {entry['new']}")


def _first_difference(old: str, new: str) -> int:
    """The line of `old`, from 0, in which `new` starts to differ."""
    same = next((i for i, (a, b) in enumerate(zip(old, new, strict=False)) if a != b), min(len(old), len(new)) - 1)
    return old.count("\n", 0, max(same, 0))


def sample(count: int, seed: int) -> list[Mutant]:
    """Sites drawn evenly over all sites of both packages."""
    places = []
    for file in sorted(str(p.relative_to(ROOT)) for package in PACKAGES for p in (ROOT / package).rglob("*.py")):
        source = (ROOT / file).read_text()
        places += [(file, site, source) for site in sites(source)]
    mutants = []
    for file, site, source in random.Random(seed).sample(places, min(count, len(places))):
        old = source[site.start : site.end].strip()
        name = f"{file}:{site.line}:{site.start}"
        mutants.append(Mutant(name, file, site.line, site.applied(source), f"{old} -> {site.replacement.strip()}"))
    return mutants


class Map:
    """Which tests execute which lines, and how long each takes; made by `map`."""

    def __init__(self) -> None:
        """Read what `make_map` recorded."""
        if not (OUT / "branches.sqlite").exists():
            sys.exit("no map of tests yet: run `python tests/mutation/run.py map` first")
        self._times = json.loads((OUT / "times.json").read_text())
        self._rows: dict[str, dict[int, set[str]]] = {}
        of_file: dict[str, set[str]] = {}
        for test in self._times:
            of_file.setdefault(test.split("::")[0], set()).add(test)
        connection = sqlite3.connect(OUT / "branches.sqlite")
        contexts = dict(connection.execute("select id, context from context"))
        # A branch from one line to another executes both; entries and exits of a function have negative numbers.
        query = "select path, context_id, fromno, tono from arc join file on file.id = arc.file_id"
        for path, context, *ends in connection.execute(query):
            test, _, phase = contexts[context].partition("|")
            if not test:
                continue
            # What a fixture of a module or a session executes stands under the first test that needs it alone.
            tests = of_file[test.split("::")[0]] if phase == "setup" else {test}
            lines = self._rows.setdefault(str(Path(path).resolve().relative_to(ROOT)), {})
            for line in (end for end in ends if end > 0):
                lines.setdefault(line, set()).update(tests)

    def tests(self, file: str, line: int, most_s: float) -> tuple[list[str], float]:
        """Tests that execute a line, the quickest first (one of its module counts as NEAR of its time), and their time.

        Those that take `most_s` together; for a line that runs at import, of the tests of the whole file; for a file
        that only runs at import, of the test files that import it.
        """
        lines = self._rows.get(file, {})
        near = lines.get(line) or set().union(*lines.values()) if lines else self._importing(file)
        module = Path(file).stem

        def cost(test: str) -> float:
            return self._times.get(test, 1.0) * (NEAR if module in test.split("::")[0] else 1.0)

        ordered = sorted(near, key=lambda test: (cost(test), test))
        total, taken = 0.0, []
        for test in ordered:
            total += self._times.get(test, 1.0)
            if taken and total > most_s:
                break
            taken.append(test)
        return taken, min(total, most_s)

    def _importing(self, file: str) -> set[str]:
        """Tests of the files that import a module."""
        name = ".".join(Path(file).with_suffix("").parts)
        importing = {of for of in {test.split("::")[0] for test in self._times} if f"from {name} import" in text_of(of)}
        return {test for test in self._times if test.split("::")[0] in importing}


def text_of(test_file: str) -> str:
    """Source of a test file; empty if it is no longer there."""
    path = ROOT / test_file
    return path.read_text() if path.is_file() else ""


def make_map() -> None:
    """Run all tests once under coverage.py with a context a test; keep branches and times, print what never runs."""
    OUT.mkdir(parents=True, exist_ok=True)
    settings = OUT / "coverage.ini"
    settings.write_text(f"[run]\nbranch = true\nsource = {','.join(PACKAGES)}\ndata_file = {OUT / 'branches.sqlite'}\n")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--cov", "--cov-context=test"]
    command += [f"--cov-config={settings}", "--cov-report=", f"--junitxml={OUT / 'times.xml'}"]
    subprocess.run(command, cwd=ROOT, check=False, env=_environment(ROOT))
    report = [sys.executable, "-m", "coverage", "report", f"--rcfile={settings}", "--skip-covered", "--show-missing"]
    subprocess.run(report, cwd=ROOT, check=False)
    import xml.etree.ElementTree as Tree

    times: dict[str, float] = {}
    for case in Tree.parse(OUT / "times.xml").iter("testcase"):
        name = f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}"
        times[name] = float(case.get("time", 1.0))
    (OUT / "times.json").write_text(json.dumps(times))


def _environment(root: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}


class Sandboxes:
    """Copies of the checkout, one a thread, in which files are changed."""

    def __init__(self) -> None:
        """Start with none."""
        self._of_thread = threading.local()
        self._folder = Path(tempfile.mkdtemp(prefix="vlcrender-mutants-"))
        self._count = 0
        self._lock = threading.Lock()

    def mine(self) -> Path:
        """This thread's copy, made at the first call."""
        if not hasattr(self._of_thread, "path"):
            with self._lock:
                self._count += 1
                path = self._folder / str(self._count)
            listed = subprocess.run(
                ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, check=True, capture_output=True
            )
            for name in listed.stdout.decode().splitlines():
                if (ROOT / name).is_file():
                    (path / name).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy2(ROOT / name, path / name)
            self._of_thread.path = path
        return Path(self._of_thread.path)

    def remove(self) -> None:
        """Delete all copies."""
        shutil.rmtree(self._folder, ignore_errors=True)


def judge(mutant: Mutant, tests: Map, sandboxes: Sandboxes, most_s: float) -> dict[str, object]:
    """Run the tests of a mutant: killed by which, or survived."""
    names, seconds = tests.tests(mutant.file, mutant.line, most_s)
    result: dict[str, object] = {"name": mutant.name, "change": mutant.change, "tests": len(names)}
    if not names:
        return {**result, "outcome": "survived", "by": "no test executes this line", "s": 0.0}
    root = sandboxes.mine()
    target = root / mutant.file
    original = target.read_text()
    start = time.monotonic()
    try:
        target.write_text(mutant.source)
        command = [sys.executable, "-P", "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--no-header", *names]
        with tempfile.TemporaryDirectory() as own:
            cache = own if mutant.file.startswith(BAKING) else str(OUT / "cache")
            done = subprocess.run(
                command,
                cwd=root,
                env={**_environment(root), "VLCRENDER_CACHE": cache},
                capture_output=True,
                text=True,
                timeout=60 + PATIENCE * seconds,
                start_new_session=True,
            )
    except subprocess.TimeoutExpired:
        return {**result, "outcome": "killed", "by": "time", "s": time.monotonic() - start}
    finally:
        target.write_text(original)
    took = time.monotonic() - start
    if done.returncode == 0:
        return {**result, "outcome": "survived", "by": "", "s": took}
    if "ERROR: not found:" in done.stdout + done.stderr:  # a test has been renamed or removed since the map was made
        return {**result, "outcome": "survived", "by": "tests are not those of the map: make it anew", "s": took}
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return {**result, "outcome": "killed", "by": failed[0][:160] if failed else f"exit {done.returncode}", "s": took}


def run(mutants: list[Mutant], workers: int, most_s: float) -> int:
    """Judge all mutants that have no result yet; print each and the score. The number of survivors."""
    tests, sandboxes = Map(), Sandboxes()
    state = _digest_of_tests()
    kept = OUT / "results.jsonl"
    known = {}
    if kept.exists():
        for line in kept.read_text().splitlines():
            row = json.loads(line)
            # A kill stays one; a survivor is tried again when tests have changed, or if more of them are asked for.
            if row["outcome"] == "killed" or (row["state"] == state and row.get("most_s", 0.0) >= most_s):
                known[row["digest"]] = row
    equivalents = [
        entry for path in HERE.glob("equivalent*.toml") for entry in tomllib.loads(path.read_text())["mutant"]
    ]
    lock, outcomes, survivors = threading.Lock(), Counter[str](), []
    try:
        with concurrent.futures.ThreadPoolExecutor(workers) as pool:
            pending = {
                pool.submit(lambda m=m: known.get(m.digest) or judge(m, tests, sandboxes, most_s)): m for m in mutants
            }
            for future in concurrent.futures.as_completed(pending):
                mutant, row = pending[future], future.result()
                outcome = str(row["outcome"])
                if outcome == "survived" and any(_is(mutant, entry) for entry in equivalents):
                    outcome = "equivalent"
                with lock:
                    outcomes[outcome] += 1
                    if mutant.digest not in known:
                        with kept.open("a") as file:
                            file.write(
                                json.dumps({**row, "digest": mutant.digest, "state": state, "most_s": most_s}) + "\n"
                            )
                    if outcome == "survived":
                        survivors.append(mutant.name)
                    print(f"{outcome:10} {mutant.name}: {mutant.change!r} {row['by']} ({row['s']:.0f} s)", flush=True)
    finally:
        sandboxes.remove()
    counted = outcomes["killed"] + outcomes["survived"]
    print(
        f"{outcomes['killed']} of {counted} killed ({100 * outcomes['killed'] / max(counted, 1):.1f} %), "
        f"{outcomes['equivalent']} equivalent and not counted"
    )
    return len(survivors)


def _is(mutant: Mutant, entry: dict[str, str]) -> bool:
    """Whether an entry of equivalent_*.toml explains a mutant."""
    line = (ROOT / mutant.file).read_text().splitlines()[mutant.line - 1]
    return (entry["file"], entry["change"]) == (mutant.file, mutant.change) and entry.get("line", "") in line


def _digest_of_tests() -> str:
    digest = hashlib.sha256()
    for path in sorted((ROOT / "tests").glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="Mutation testing of vlcrender and estimator")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("map")
    of_chosen = commands.add_parser("chosen")
    of_chosen.add_argument("--only", action="append", default=[])
    of_sample = commands.add_parser("sample")
    of_sample.add_argument("--count", type=int, default=150)
    of_sample.add_argument("--seed", type=int, default=1)
    for command in (of_chosen, of_sample):
        command.add_argument("--workers", type=int, default=2)
        command.add_argument("--test-seconds", type=float, default=MAX_TEST_S)
    arguments = parser.parse_args()
    if arguments.command == "map":
        make_map()
        return
    mutants = chosen(arguments.only) if arguments.command == "chosen" else sample(arguments.count, arguments.seed)
    sys.exit(1 if run(mutants, arguments.workers, arguments.test_seconds) else 0)


if __name__ == "__main__":
    main()
