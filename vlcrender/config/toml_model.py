"""TOML files into checked models. Error messages name file, key, value and the allowed values."""

import difflib
import json
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from vlcrender.errors import InputError


class Settings(BaseModel):
    """Base class of the tables of TOML files. It refuses unknown keys, NaN, infinities and values of another type."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


S = TypeVar("S", bound=Settings)

RENAMED_KEYS = {
    "exposure.longest_s": "exposure.max_s",
    "window": "glazing",
    "windows": "regions",
}
"""Former key -> present key of recipes and scenes, dotted paths without array indices. `check` refuses former keys."""


def key_error(key: str, message: str) -> PydanticCustomError:
    """The exception that a model's validator raises for one `key` of its table; `message` follows the key."""
    return PydanticCustomError("key_error", "{message}", {"key": key, "message": message})


def read_toml(path: Path) -> dict[str, Any]:
    """The tree of a TOML file. Raises InputError for a file that is missing, not UTF-8 or not TOML."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text; give a TOML file") from None
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # ValueError: also for numbers of thousands of digits
        raise InputError(f"{path}: is not TOML: {error}") from None


def override(tree: Mapping[str, Any], assignments: Iterable[str], how: str = "--set ") -> dict[str, Any]:
    """A copy of `tree` with `key=value` assignments applied. Values are TOML or bare words.

    Keys are dotted. An item of a list has its number, counted from 0, or as a table its `name`: `rig.left.yaw`.
    Raises InputError, which starts with `how`, for an assignment without a key or value, for a key below a value that
    is no table, and for an item that a list has not.
    """
    result = dict(tree)
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        parts = [part.strip() for part in key.split(".")]
        if not equals or not all(parts):
            raise InputError(f"{how}{assignment}: is not key=value; write, for example, --set camera.f_number=2.8")
        node: Any = result
        for parent in parts[:-1]:
            place = _place(node, parent, f"{how}{assignment}")
            below = node.get(place, {}) if isinstance(node, dict) else node[place]
            if not isinstance(below, dict | list):
                raise InputError(f"{how}{assignment}: {parent} is not a table of the recipe")
            copied = dict(below) if isinstance(below, dict) else list(below)  # `tree` is not changed
            node[place] = copied
            node = copied
        node[_place(node, parts[-1], f"{how}{assignment}")] = _value(text)
    return result


def _place(node: dict[str, Any] | list[Any], part: str, source: str) -> Any:
    """The key of a table, or the index of the item of a list that a part of a dotted key names."""
    if isinstance(node, dict):
        return part
    names = [item.get("name") if isinstance(item, dict) else None for item in node]
    if part in names:
        return names.index(part)
    if part.isdecimal() and int(part) < len(node):
        return int(part)
    known = ", ".join(name for name in names if isinstance(name, str))
    raise InputError(f"{source}: no item {part}: {len(node)} items, numbered from 0{known and f' or named {known}'}")


def toml_text(value: object, source: str) -> str:
    """A value as TOML has it. Raises InputError, which starts with `source`, for one that TOML has not."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{json.dumps(str(k))} = {toml_text(v, source)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml_text(item, source) for item in value) + "]"
    if isinstance(value, bool | int | float | str):
        return json.dumps(value, ensure_ascii=False)
    raise InputError(f"{source} = {value!r}: has to be a number, a text, true or false, a list or a table")


def _value(text: str) -> Any:
    """The value of a TOML expression; any other text is a bare word, such as `none` in noise=none."""
    try:
        table = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text.strip()
    return table["value"] if len(table) == 1 else text.strip()  # text with a second line is a bare word


def check(tree: Mapping[str, Any], model: type[S], source: str) -> S:
    """The model of a tree. Raises InputError, one line that starts with `source`, for the first problem."""
    for former, present in RENAMED_KEYS.items():
        if _has_key(tree, former.split(".")):
            raise InputError(f"{source}: key {former} was renamed: write {present}")
    try:
        # Strict JSON accepts 1 for 1.0 and a list for a tuple, but neither "1" nor true for 1.
        return model.model_validate_json(json.dumps(tree, default=str), strict=True)
    except ValidationError as error:
        # A key in another unit is reported as unknown and as missing: report the unknown one, which says more.
        problems = sorted(error.errors(include_url=False), key=lambda problem: problem["type"] != "extra_forbidden")
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise InputError(f"{source}: {_one_line(problems[0], model)}{more}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{source}: {error}") from None


def _has_key(tree: Any, path: list[str]) -> bool:
    """Whether a tree has a key at a path; a path passes through arrays of tables."""
    if isinstance(tree, (list, tuple)):
        return any(_has_key(item, path) for item in tree)
    if not isinstance(tree, Mapping) or path[0] not in tree:
        return False
    return len(path) == 1 or _has_key(tree[path[0]], path[1:])


def _one_line(problem: Any, model: type[Settings]) -> str:
    """The message of a problem that pydantic reports."""
    location = [part for part in problem["loc"] if not _is_tag(part, model)]
    kind, message, value = str(problem["type"]), str(problem["msg"]), problem["input"]
    if kind == "key_error":
        location.append(problem["ctx"]["key"])
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
    message = message.removeprefix("Value error, ").replace("\n", " ")
    if kind == "key_error":
        return f"{key}: {message}" if message != "is missing" else f"key {key} is missing"
    if kind == "extra_forbidden":
        allowed = _keys_at(model, list(problem["loc"])[:-1])
        unknown = str(location[-1])
        near = [name for name in allowed if _stem(name) == _stem(unknown)] or difflib.get_close_matches(
            unknown, allowed, n=1
        )
        hint = f"did you mean {near[0]}? " if near else ""
        return f"unknown key {key}; {hint}allowed: {', '.join(sorted(allowed))}"
    if kind == "missing":
        return f"key {key} is missing"
    shown = json.dumps(value, default=str)
    shown = shown if len(shown) <= 60 else shown[:57] + "..."
    if not key:
        return message
    return f"{key} = {shown}: {message[:1].lower() + message[1:]}"


UNITS = (
    *("m", "cm", "mm", "um", "nm", "ft", "in", "px", "s", "ms", "us", "deg", "rad", "lux", "lx", "fc"),
    *("cd_m2", "nit", "nits", "e", "dn", "e_per_dn", "m_s2", "percent", "db"),
)


def _stem(key: str) -> str:
    """A key without its unit: radius_cm and radius_m have the same stem."""
    for unit in sorted(UNITS, key=len, reverse=True):
        if key.lower().endswith("_" + unit):
            return key[: -len(unit) - 1]
    return key


def _is_tag(part: object, model: type[Settings]) -> bool:
    """Whether a part of a location is a tag, which pydantic inserts for a member of a tagged union."""
    return isinstance(part, str) and part in _tags(model)


def _tags(annotation: Any) -> set[str]:
    tags: set[str] = set()
    unions: list[tuple[Any, FieldInfo]] = []
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        for field in annotation.model_fields.values():
            unions.append((field.annotation, field))
            tags |= _tags(field.annotation)
    elif get_origin(annotation) is Annotated:  # an optional union has its discriminator here
        union, *metadata = get_args(annotation)
        unions = [(union, item) for item in metadata if isinstance(item, FieldInfo)]
    for union, field in unions:
        if field.discriminator:
            for member in get_args(union):
                tags |= set(get_args(member.model_fields[str(field.discriminator)].annotation))
    for argument in get_args(annotation):
        tags |= _tags(argument)
    return tags


def _keys_at(annotation: Any, location: list[Any]) -> set[str]:
    """The keys that a model allows at a location, through tables, arrays and unions (of a tagged union: its member)."""
    origin = get_origin(annotation)
    if origin in (Union, UnionType):
        members = get_args(annotation)
        tagged = [member for member in members if location and location[0] in _literals(member)]
        if tagged:
            return _keys_at(tagged[0], location[1:])
        return set().union(*(_keys_at(member, location) for member in members))
    if origin is Annotated:
        return _keys_at(get_args(annotation)[0], location)
    if origin in (list, tuple):
        return _keys_at(get_args(annotation)[0], location[1:] if location else location)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        if not location:
            return set(annotation.model_fields)
        field = annotation.model_fields.get(str(location[0]))
        return _keys_at(field.annotation, location[1:]) if field else set()
    return set()


def _literals(model: Any) -> set[Any]:
    """The values of a model's literal fields, including its tag."""
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        return set()
    return {value for field in model.model_fields.values() for value in get_args(field.annotation)}
