"""Presets: parts of recipes that come with the package, such as the parameters of a sensor.

A preset is a TOML file `preset_files/KIND/NAME.toml` beside this module: a partial recipe with the source of each
number. `preset = "NAME"` in the table of its kind, in a recipe or with --set, inserts the file's tables. A preset of a
camera is whole: a lens, and a sensor by the name of its preset. `preset = "NAME"` at the top of a recipe is a phone:
camera, shutter, sensor and accelerometer.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from vlcrender.config.toml_model import override, read_toml
from vlcrender.errors import InputError

FOLDER = Path(__file__).parent / "preset_files"
KINDS = {"camera": "cameras", "sensor": "sensors", "accelerometer": "accelerometers", "belief": "beliefs"}
"""Folder of the presets, by table of a recipe. Cameras come first: they name presets of sensors."""
PHONES = "phones"
"""Folder of the presets at the top of a recipe."""
PHONE_TABLES = ("camera", "sensor", "accelerometer")
"""Tables of a recipe that a phone named by an assignment replaces."""
NOT_OF_PRESETS = {"belief": ("devices", "maps", "stated_factor")}
"""Keys of a recipe's table that its presets leave alone, and that stay where an assignment names another preset."""


def presets(kind: str) -> tuple[str, ...]:
    """Names of the presets of a kind, "cameras", "sensors", "accelerometers", "beliefs" or "phones", sorted."""
    return tuple(sorted(path.stem for path in (FOLDER / kind).glob("*.toml")))


def preset(kind: str, name: str) -> dict[str, Any]:
    """The partial recipe of a preset. Raises InputError that lists the presets for an unknown name."""
    if name not in presets(kind):
        raise InputError(f'preset = "{name}": unknown; presets of {kind}: {", ".join(presets(kind))}')
    return read_toml(FOLDER / kind / f"{name}.toml")


def with_presets(
    tree: Mapping[str, Any], assignments: Iterable[str], source: str, how: str = "--set "
) -> dict[str, Any]:
    """A recipe's tree with presets inserted and `key=value` assignments applied, as `resolved` has it."""
    return resolved(tree, assignments, source, how)[0]


def resolved(
    tree: Mapping[str, Any], assignments: Iterable[str], source: str, how: str = "--set "
) -> tuple[dict[str, Any], dict[str, str]]:
    """The tree with presets inserted and `key=value` assignments applied, and the name of each table's preset.

    Keys of the recipe override a preset that it names. A preset named by an assignment replaces the recipe's table; a
    camera's replaces the sensor's table too. Other assignments override everything. Raises InputError that starts with
    `source` for an unknown preset, with `how` for an impossible assignment.
    """
    given = list(assignments)
    chosen = {key: [a for a in given if a.partition("=")[0].strip() == f"{key}.preset"] for key in KINDS}
    names: dict[str, str] = {}
    phones = [assignment for assignment in given if assignment.partition("=")[0].strip() == "preset"]
    tree = _with_phone(dict(tree), phones, source, how)
    for key, kind in KINDS.items():
        table = tree.get(key)
        if isinstance(table, dict) and "preset" in table:
            names[key] = str(table["preset"])
            own = {**tree, key: {name: value for name, value in table.items() if name != "preset"}}
            tree = _merged(_named(kind, key, table["preset"], source), own)
        for assignment in chosen[key]:
            name = override({}, [assignment], how)[key]["preset"]
            named = _named(kind, key, name, source)
            names[key] = str(name)
            replaced = named if key == "camera" else (key,)
            # No key of another preset remains.
            tree = _merged({**tree, **{table: _kept(tree, table) for table in replaced}}, named)
    rest = [a for a in given if not any(a in of_key for of_key in (phones, *chosen.values()))]
    return override(tree, rest, how), names


def _with_phone(tree: dict[str, Any], assignments: list[str], source: str, how: str) -> dict[str, Any]:
    """A recipe's tree with the phone that its key `preset` names, or the last assignment, which replaces its tables."""
    name = tree.pop("preset", None)
    for assignment in assignments:
        name = override({}, [assignment], how)["preset"]
    if name is None:
        return tree
    phone = _named(PHONES, "", name, source)
    own = {key: value for key, value in tree.items() if key not in PHONE_TABLES} if assignments else tree
    return _merged(phone, own)


def _kept(tree: Mapping[str, Any], key: str) -> dict[str, Any]:
    """The keys of a recipe's table that no preset replaces."""
    table, stays = tree.get(key), NOT_OF_PRESETS.get(key, ())
    return {own: value for own, value in table.items() if own in stays} if isinstance(table, dict) else {}


def _named(kind: str, key: str, name: object, source: str) -> dict[str, Any]:
    try:
        return preset(kind, str(name))
    except InputError as error:
        raise InputError(f"{source}: {key and key + '.'}{error}") from None


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Two trees merged table by table, to any depth; keys of `over` override."""
    result = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = _merged(result[key], value) if both else value
    return result
