"""Run the commands of docs/tutorial_hall.md and write their outputs into the page: python docs/make_tutorial.py

A block ```toml title="NAME" of the page is a file. A block ```sh is run line by line. A block ```text holds what the
block before it printed.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

DOCS = Path(__file__).parent
PAGE = DOCS / "tutorial_hall.md"
PICTURE = DOCS / "pictures/tutorial_hall.png"
BLOCK = re.compile(r'^```(toml title="(?P<name>[^"]+)"|sh|text)\n(?P<body>.*?)^```$', re.MULTILINE | re.DOTALL)
COLUMNS = 80
UNSTEADY = re.compile(r"disk use")
"""Lines whose figures depend on versions of libraries: they are left out."""


def executed(page: str, folder: Path, environment: Mapping[str, str] | None = None) -> str:
    """The page with the outputs of its commands, which are run in a folder.

    Raises subprocess.CalledProcessError for a command that fails.
    """
    printed = ""

    def done(block: re.Match[str]) -> str:
        nonlocal printed
        if block["name"]:
            (folder / block["name"]).write_text(block["body"], encoding="utf-8")
        elif block[1] == "sh":
            printed = "".join(_run(line, folder, environment or {}) for line in _lines(block["body"]))
        else:
            return f"```text\n{printed}```"
        return block[0]

    return BLOCK.sub(done, page)


def _lines(commands: str) -> list[str]:
    """Commands of a block; one may go on after a backslash at the end of its line."""
    return commands.replace("\\\n", " ").splitlines()


def _run(line: str, folder: Path, environment: Mapping[str, str]) -> str:
    """What a command prints to stdout."""
    program, *arguments = shlex.split(line)
    call = f"import sys; from {program}.cli import main; sys.exit(main(sys.argv[1:]))"
    finished = subprocess.run(
        [sys.executable, "-c", call, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(DOCS.parent), **environment, "COLUMNS": str(COLUMNS)},
        stdout=subprocess.PIPE,
        check=True,
        encoding="utf-8",
    )
    lines = (text.rstrip() for text in finished.stdout.splitlines() if not UNSTEADY.search(text))
    return "".join(f"{textwrap.fill(text, COLUMNS) if len(text) > COLUMNS else text}\n" for text in lines)


def main() -> None:
    """Write the page and its picture."""
    with TemporaryDirectory() as folder:
        page = executed(PAGE.read_text(encoding="utf-8"), Path(folder))
        shutil.copyfile(Path(folder) / "hall.png", PICTURE)
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
