"""Runs of `vlcrender generate` as processes, and what they leave: for kills.py and races.py."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
SMALL = (
    *("camera.width_px=400", "camera.height_px=300", "camera.pixel_pitch_um=12.0"),
    *("exposure_s=1.6e-6", "poses.border_px=4.0", "expected=true"),
)
"""The quickstart camera with a hundredth of the pixels."""
NOT_OF_THE_SET = ("manifest.json", ".vlcrender.lock")


def program(*arguments: str) -> list[str]:
    """Command that runs this checkout's `vlcrender`."""
    return [sys.executable, "-c", "import sys; from vlcrender.cli import main; sys.exit(main())", *arguments]


def generate_command(folder: Path, frames: int, options: Sequence[str] = ()) -> list[str]:
    """Command that generates a small dataset."""
    sets = [part for one in (*SMALL, f"poses.count={frames}") for part in ("--set", one)]
    return program("generate", "quickstart", "--out", str(folder), *sets, *options)


def start(command: Sequence[str]) -> subprocess.Popen[str]:
    """Start a command in a group of processes of its own; stdout and stderr in one pipe."""
    return subprocess.Popen(
        command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
    )


def end(process: subprocess.Popen[str]) -> None:
    """Kill what is left of a command's group; its leader may have ended."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def verified(folder: Path) -> str:
    """What `vlcrender verify` finds wrong; nothing where the dataset is complete and intact."""
    done = subprocess.run(program("verify", str(folder)), cwd=ROOT, capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else done.stderr or f"exit code {done.returncode}"


def manifest(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of a dataset: by its own manifest.json, where it has one that agrees, and by the files."""
    files = {str(path.relative_to(folder)): path for path in sorted(folder.rglob("*")) if path.is_file()}
    found = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()}
    if "manifest.json" in files:
        stated = json.loads(files["manifest.json"].read_bytes())["files"]
        for name, entry in stated.items():
            if found.get(name) != entry["sha256"]:
                raise SystemExit(f"{folder}: {name} is not what manifest.json says")
    return {name: digest for name, digest in found.items() if name not in NOT_OF_THE_SET}


def journal_size(folder: Path) -> int:
    """Bytes of the journal of an unfinished dataset; 0 where there is none."""
    try:
        return (folder / "journal.jsonl").stat().st_size
    except FileNotFoundError:
        return 0


@contextmanager
def work_folder() -> Iterator[Path]:
    """A temporary folder with a cache of light of its own, which all runs share."""
    with tempfile.TemporaryDirectory(prefix="vlcrender-damage-") as name:
        os.environ.setdefault("VLCRENDER_CACHE", f"{name}/cache")
        os.environ["PYTHONPATH"] = str(ROOT)
        yield Path(name)
