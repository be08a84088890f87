"""Kill `vlcrender generate` (SIGKILL) at random moments, resume it, and compare the dataset with one made at once.

    python tests/damage/kills.py [--count 50] [--frames 12] [--seed 1]

The runs take turns: one worker, two workers, and a local dask cluster, of which the client, and in some turns one of
the two workers too, is killed. A run is killed up to three times before it may end. Prints one line a turn and exits
with 1 where a resumed run fails, where `verify` finds damage, or where one file of a dataset differs.
"""

import argparse
import random
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import psutil
from runs import end, generate_command, journal_size, manifest, start, verified, work_folder

KINDS = ("1 worker", "2 workers", "cluster")
WORKERS = 2
"""Workers of the cluster; one that is killed is followed by no other until there are as many again."""
HANG_S = 600.0
"""A run that takes longer hangs."""


def cluster_address(stack: ExitStack) -> str:
    """Address of a local dask cluster with WORKERS processes."""
    from distributed import LocalCluster

    cluster = stack.enter_context(LocalCluster(n_workers=WORKERS, threads_per_worker=1, dashboard_address=None))
    return str(cluster.scheduler_address)


def workers_of_cluster() -> list[psutil.Process]:
    """Worker processes of the cluster, children of this process."""
    return [one for one in psutil.Process().children(recursive=True) if "spawn_main" in " ".join(one.cmdline())]


def kill_at_random(command: list[str], folder: Path, chance: random.Random, usual_s: float) -> float | None:
    """Start a command and kill it alone, not its workers, after a random part of a run; None where it ended before.

    Every second time, on average, the part counts from the next frame on that is in the journal.
    """
    before = journal_size(folder)
    process = start(command)
    begun = time.monotonic()
    wait_s = chance.uniform(0.02, 1.0) * usual_s
    if chance.random() < 0.5:
        while process.poll() is None and journal_size(folder) <= before:
            time.sleep(0.005)
        wait_s = chance.uniform(0.0, 0.2) * usual_s
    try:
        process.wait(wait_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return time.monotonic() - begun
    finally:
        # A worker may go on until it notices: the next run starts at once.
        if process.stdout is not None:
            process.stdout.close()
    return None


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description="kill runs at random moments, resume them, compare the datasets")
    parser.add_argument("--count", type=int, default=50, help="kills")
    parser.add_argument("--frames", type=int, default=12, help="frames of the dataset")
    parser.add_argument("--seed", type=int, default=1, help="of the moments")
    parser.add_argument("--kinds", default=",".join(KINDS), help="of 1 worker, 2 workers, cluster")
    given = parser.parse_args()
    kinds = given.kinds.split(",")
    chance = random.Random(given.seed)
    failures = kills = turn = 0
    with work_folder() as work, ExitStack() as stack:
        usual_s = 0.0
        for folder in (work / "whole", work / "again"):  # the second time without the bake
            begun = time.monotonic()
            subprocess.run(generate_command(folder, given.frames), check=True, capture_output=True, cwd=work)
            usual_s = time.monotonic() - begun
        wanted = manifest(work / "whole")
        if manifest(work / "again") != wanted:
            print("two runs without a kill differ")
            return 1
        while kills < given.count:
            kind = kinds[turn % len(kinds)]
            turn += 1
            folder = work / f"turn-{turn}"
            stack.close()  # the last turn's cluster; a worker that is killed while it starts is not started again
            options: tuple[str, ...] = ("--workers", "1" if kind == "1 worker" else "2")
            if kind == "cluster":
                options = ("--scheduler", cluster_address(stack))
            command = generate_command(folder, given.frames, options)
            killed: list[str] = []
            for _ in range(min(chance.randint(1, 3), given.count - kills)):
                after_s = kill_at_random(command, folder, chance, usual_s)
                if after_s is None:
                    break
                kills += 1
                killed.append(f"{after_s:.2f} s ({journal_size(folder)} bytes of journal)")
                if kind == "cluster" and turn % 2 and len(found := workers_of_cluster()) == WORKERS:
                    chance.choice(found).kill()
            process = start(command)
            try:
                output = process.communicate(timeout=HANG_S)[0]
            except subprocess.TimeoutExpired:
                output = "hangs"
            end(process)
            problem = "" if process.returncode == 0 else f"exit code {process.returncode}: {output.strip()[-300:]}"
            problem = problem or verified(folder)
            if not problem and (found_files := manifest(folder)) != wanted:
                names = sorted(name for name in {*found_files, *wanted} if found_files.get(name) != wanted.get(name))
                problem = f"differs: {', '.join(names)}"
            failures += bool(problem)
            print(f"{kind}, killed after {', '.join(killed) or 'its end'}: {problem or 'identical'}", flush=True)
    print(f"{kills} kills in {turn} runs: {turn - failures} identical, {failures} not")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
