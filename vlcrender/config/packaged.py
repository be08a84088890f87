"""Scenes and recipes that come with the package: a name, such as "office", in place of the path of a file.

An installed package has them in `packaged_files/` beside this module; a checkout has them in its top folders.
"""

import re
import tomllib
from pathlib import Path
from typing import Literal

from vlcrender.errors import InputError

Kind = Literal["scene", "recipe"]
FOLDERS = {"scene": "scenes", "recipe": "datasets"}
INSTALLED = Path(__file__).parent / "packaged_files"
CHECKOUT = Path(__file__).parent.parent.parent
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


def packaged_folder(kind: Kind) -> Path:
    """The folder with the packaged files of a kind."""
    return (INSTALLED if INSTALLED.is_dir() else CHECKOUT) / FOLDERS[kind]


def packaged_names(kind: Kind) -> tuple[str, ...]:
    """Names of the scenes or recipes that come with the package, sorted."""
    return tuple(sorted(path.stem for path in packaged_folder(kind).glob("*.toml")))


def find_file(kind: Kind, name_or_path: str | Path, folder: Path = Path()) -> Path:
    """The file that a packaged name or a path means; relative paths start at `folder`. A file of this path wins.

    Raises InputError with the names there are for a word that is neither. A path that is no such word is returned
    whether or not there is a file: its reader says what is wrong with it.
    """
    path = folder / name_or_path
    if path.is_file() or not NAME.fullmatch(str(name_or_path)):
        return path
    names = packaged_names(kind)
    if str(name_or_path) not in names:
        raise InputError(f"{name_or_path}: is neither a file nor one of the {kind}s there are: {', '.join(names)}")
    return packaged_folder(kind) / f"{name_or_path}.toml"


def is_recipe(name_or_path: str | Path) -> bool:
    """Whether a packaged name or a path means a recipe; of a name that is a scene's too, the scene is meant.

    A file that cannot be read as TOML counts as a scene: its reader says what is wrong with it.
    """
    path = Path(name_or_path)
    if not path.is_file():
        return str(name_or_path) in packaged_names("recipe") and str(name_or_path) not in packaged_names("scene")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8")).get("format") == "vlcrender-recipe"
    except (OSError, ValueError):
        return False
