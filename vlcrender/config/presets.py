"""Presets: parts of recipes that come with the package, such as a sensor's numbers.

A preset of a kind is a TOML file in `preset_files/KIND/NAME.toml` beside this module: a partial recipe, in which each
number says where it is from. In a recipe, or with --set, `preset = "NAME"` in the table that the kind is named for
stands for all that the file says.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from vlcrender.config.toml_model import override, read_toml
from vlcrender.errors import InputError

FOLDER = Path(__file__).parent / "preset_files"
KINDS = {"sensor": "sensors", "accelerometer": "accelerometers"}
"""Table of a recipe -> folder of its presets."""


def presets(kind: str) -> tuple[str, ...]:
    """Names of the presets of a kind, "sensors" or "accelerometers"."""
    return tuple(sorted(path.stem for path in (FOLDER / kind).glob("*.toml")))


def preset(kind: str, name: str) -> dict[str, Any]:
    """The partial recipe of this name. Raises InputError, with the names there are, where there is none."""
    if name not in presets(kind):
        raise InputError(f'preset = "{name}": is not one of the {kind} there are: {", ".join(presets(kind))}')
    return read_toml(FOLDER / kind / f"{name}.toml")


def with_presets(tree: Mapping[str, Any], assignments: Iterable[str], source: str) -> dict[str, Any]:
    """A recipe's tree with its presets put in, then `key=value` assignments as `settings.override` has them.

    What the recipe itself says wins over a preset that it names; a preset that an assignment names takes the place of
    the recipe's own table, and other assignments win over all. `source` names the recipe in the InputError for a preset
    that there is not.
    """
    given = list(assignments)
    chosen = {key: [a for a in given if a.partition("=")[0].strip() == f"{key}.preset"] for key in KINDS}
    tree = dict(tree)
    for key, kind in KINDS.items():
        table = tree.get(key)
        if isinstance(table, dict) and "preset" in table:
            own = {**tree, key: {name: value for name, value in table.items() if name != "preset"}}
            tree = _merged(_named(kind, key, table["preset"], source), own)
        for assignment in chosen[key]:
            name = override({}, [assignment])[key]["preset"]
            tree = _merged({**tree, key: {}}, _named(kind, key, name, source))  # of one part, nothing of another
    return override(tree, [a for a in given if not any(a in of_key for of_key in chosen.values())])


def _named(kind: str, key: str, name: object, source: str) -> dict[str, Any]:
    try:
        return preset(kind, str(name))
    except InputError as error:
        raise InputError(f"{source}: {key}.{error}") from None


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Tables put together, `over` winning, as deep as a recipe's tables with keys of their own: the first level."""
    result = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = {**result[key], **value} if both else value
    return result
