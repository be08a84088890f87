"""Make docs/reference.md and docs/schemas from the models of scenes and recipes: python docs/make_reference.py"""

import copy
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vlcrender.config.presets import KINDS, PHONES, presets
from vlcrender.dataset.recipe.pose_file import PoseFile
from vlcrender.dataset.recipe.recipe import RecipeFile
from vlcrender.scene.led_map_file import LedMapFile
from vlcrender.scene.schema import SceneSettings

DOCS = Path(__file__).parent
PAGE = DOCS / "reference.md"
SCHEMAS = DOCS / "schemas"
UNITS = {
    "bias_drift_m_s2_per_k": "m/s2/K",
    "ug_rthz": "ug/sqrt(Hz)",
    "e_per_dn": "e/DN",
    "deg_s": "deg/s",
    "cd_m2": "cd/m2",
    "m_s2": "m/s2",
    "e_s": "e/s",
    "m_s": "m/s",
    "percent": "%",
    "ppm": "ppm",
    "deg": "deg",
    "lux": "lux",
    "db": "dB",
    "dn": "DN",
    "hz": "Hz",
    "lm": "lm",
    "mm": "mm",
    "nm": "nm",
    "px": "px",
    "um": "um",
    "us": "us",
    "c": "deg C",
    "e": "e",
    "g": "g",
    "m": "m",
    "s": "s",
}
"""Ending of a key -> unit, longer endings first."""
INTRODUCTION = """\
# Keys of scenes and recipes

Made by `make docs` from the models that check the files (`docs/make_reference.py`). Every key is listed with its type,
default, range and unit. A key without a default is required. Unknown keys are refused.

JSON Schemas of both files: [scene](schemas/scene.schema.json), [recipe](schemas/recipe.schema.json). An editor with
TOML support completes and checks keys with them, for instance after a first line
`#:schema ../docs/schemas/recipe.schema.json`.
"""

Schema = dict[str, Any]

CALIBRATION: Schema = {
    "calibration": {
        "type": "string",
        "description": "Path of a calibration from the recipe's folder: OpenCV's YAML or npz, Kalibr, ROS camera_info "
        "or COLMAP's cameras.txt. It states size, focal length (with pixel_pitch_um), principal point, aspect ratio, "
        "skew, projection and distortion, which are then no keys of this table. See inputs.md.",
    },
    "calibration_camera": {
        "type": "string",
        "description": "The camera of a Kalibr or COLMAP file of several, such as `cam1` or `2`.",
    },
}
"""Keys of [camera] that stand for others."""


@dataclass
class Table:
    """A table of a TOML file: where it stands, what it is for, and its keys."""

    heading: str
    purpose: str
    rows: list[tuple[str, ...]] = field(default_factory=list)


def scene_schema() -> Schema:
    """JSON Schema of a scene file."""
    tree = SceneSettings.model_json_schema()
    tree["$defs"]["LedMapFile"] = LedMapFile.model_json_schema()
    tree["properties"]["led_map"] = {
        "anyOf": [{"type": "string"}, {"$ref": "#/$defs/LedMapFile"}],
        "description": "LEDs of a CSV or JSON file, behind those of `led`: its path, or a table with it as `file`.",
        "default": None,
    }
    return _schema(tree, "vlcrender scene")


def recipe_schema() -> Schema:
    """JSON Schema of a recipe file, with the keys `preset` and those of files, which stand for several others."""
    tree = RecipeFile.model_json_schema()
    tables, properties = tree["$defs"], tree["properties"]
    of_camera = _preset("camera")
    of_camera["description"] += " It is whole: the sensor's preset is in it. Under [camera] alone, not in a rig."
    tables["Camera"]["properties"] = {"preset": of_camera, **CALIBRATION, **tables["Camera"]["properties"]}
    of_phone = {"enum": list(presets(PHONES)), "type": "string"}
    of_phone["description"] = (
        "A whole phone: camera, shutter, sensor and accelerometer; the recipe's keys override its."
    )
    tree["properties"] = properties = {**properties, "preset": of_phone}
    tables["PoseFile"] = PoseFile.model_json_schema()
    properties["poses"]["oneOf"].append({"$ref": "#/$defs/PoseFile"})
    properties["poses"]["discriminator"]["mapping"]["file"] = "#/$defs/PoseFile"
    tables["Sensor"]["properties"] = {"preset": _preset("sensor"), **tables["Sensor"]["properties"]}
    tables["Belief"]["properties"] = {"preset": _preset("belief"), **tables["Belief"]["properties"]}
    preset_imu = copy.deepcopy(tables["Imu"])
    preset_imu["description"] = "An accelerometer by the name of a preset; keys beside it replace the preset's values."
    preset_imu["properties"] = {"preset": _preset("accelerometer"), **preset_imu["properties"]}
    preset_imu["required"] = ["preset"]
    tables["PresetImu"] = preset_imu
    kinds = properties["accelerometer"].pop("oneOf")
    del properties["accelerometer"]["discriminator"]
    properties["accelerometer"]["anyOf"] = [*kinds, {"$ref": "#/$defs/PresetImu"}]
    return _schema(tree, "vlcrender recipe")


def _preset(kind: str) -> Schema:
    return {
        "enum": list(presets(KINDS[kind])),
        "type": "string",
        "description": "Name of a preset, whose values stand for the keys of this table that are not given.",
    }


def _schema(tree: Schema, title: str) -> Schema:
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, **_without_titles(tree)}


def _without_titles(node: Any, of_keys: bool = False) -> Any:
    """A schema without the titles that pydantic adds; with `of_keys` the names in `node` are keys of a file."""
    if isinstance(node, list):
        return [_without_titles(item) for item in node]
    if not isinstance(node, dict):
        return node
    return {
        name: value if name == "default" and not of_keys else _without_titles(value, name in ("properties", "$defs"))
        for name, value in node.items()
        if of_keys or name != "title"
    }


def tables_of(schema: Schema, kind: str) -> list[Table]:
    """All tables of a file in the order of their keys, parents first. `kind` is "scene" or "recipe"."""
    tables: list[Table] = []
    seen: dict[str, str] = {}
    _collect(schema, schema, f"Top level of a {kind}", "", tables, seen)
    return tables


def undescribed(schema: Schema) -> list[str]:
    """Keys without a description, as MODEL.key; the constant keys format, version and kind explain themselves."""
    models = {schema["title"]: schema, **schema.get("$defs", {})}
    return sorted(
        f"{model}.{key}"
        for model, tree in models.items()
        for key, node in tree.get("properties", {}).items()
        if "description" not in node and "const" not in node
    )


def _collect(root: Schema, node: Schema, heading: str, path: str, tables: list[Table], seen: dict[str, str]) -> None:
    table = Table(heading, " ".join(node.get("description", "").split()) if path else "")
    tables.append(table)
    below: list[tuple[Schema, str, str]] = []
    for key, value in node["properties"].items():
        inner = f"{path}.{key}".lstrip(".")
        required = key in node.get("required", [])
        members = list(_members(root, value))
        headings = []
        for member, is_list in members:
            name = member["$ref"].rpartition("/")[2]
            target = root["$defs"][name]
            label = f"[[{inner}]]" if is_list else f"[{inner}]"
            tags = [(tag, key["const"]) for tag, key in target["properties"].items() if "const" in key]
            if name == "PresetImu":
                label += " with preset"
            elif tags and len(members) > 1:
                label += f" {tags[0][0]} = {json.dumps(tags[0][1])}"
            if name in seen:
                headings.append(f"as `{seen[name]}`")
                continue
            headings.append(f"`{label}`")
            seen[name] = label
            below.append((target, label, inner))
        kinds = [*_types(root, value), *([f"table {_or(headings)}"] if headings else [])]
        description = " ".join(value.get("description", "").split())
        cells = (f"`{key}`", _or(kinds), _default(value, required), _range(root, value), _unit(key), description)
        table.rows.append(tuple(cell.replace("|", "\\|") for cell in cells))
    for target, label, inner in below:
        _collect(root, target, label, inner, tables, seen)


def _members(root: Schema, node: Schema, is_list: bool = False) -> Iterator[tuple[Schema, bool]]:
    """References to tables in a key's schema, and whether the key is an array of them."""
    if "$ref" in node:
        yield node, is_list
    for choice in (*node.get("anyOf", ()), *node.get("oneOf", ())):
        yield from _members(root, choice, is_list)
    if isinstance(node.get("items"), dict):
        yield from _members(root, node["items"], True)


def _types(root: Schema, node: Schema) -> list[str]:
    """What a key's value may be, tables left out."""
    if "const" in node:
        return [f"`{json.dumps(node['const'])}`"]
    if "enum" in node:
        return [f"`{json.dumps(value)}`" for value in node["enum"]]
    choices = [*node.get("anyOf", ()), *node.get("oneOf", ())]
    if choices:
        return [text for choice in choices for text in _types(root, choice)]
    kind = node.get("type")
    if kind == "array":
        items = node.get("prefixItems") or [node.get("items", {})]
        inner = _types(root, items[0]) if items[0] else ["value"]
        count = f"{len(node['prefixItems'])} " if "prefixItems" in node else ""
        plural = {"number": "numbers", "integer": "integers", "text": "texts"}
        return [f"list of {count}{_or([plural.get(text, text + 's') for text in inner])}"] if inner else []
    names = {"number": "number", "integer": "integer", "string": "text", "boolean": "`true`, `false`"}
    return [names[kind]] if kind in names else []


def _default(node: Schema, required: bool) -> str:
    if required:
        return ""
    value = node.get("default")
    if value is None:
        return "not given"
    return "its defaults" if isinstance(value, dict) else f"`{json.dumps(value)}`"


def _range(root: Schema, node: Schema) -> str:
    """Limits of a number, of each number in a list, or of a text."""
    choices = [*node.get("anyOf", ()), *node.get("oneOf", ())]
    if choices:
        return "; ".join(dict.fromkeys(text for choice in choices if (text := _range(root, choice))))
    if "enum" in node or "const" in node:
        return ""
    if node.get("type") == "array":
        items = node.get("prefixItems") or [node.get("items", {})]
        ranges = [_range(root, item) for item in items]
        if len(set(ranges)) > 1:
            return "; ".join(text or "any" for text in ranges)
        own = [f"{node['minItems']} or more"] if node.get("minItems") and "prefixItems" not in node else []
        return ", ".join([*own, *([f"each {ranges[0].removeprefix('each ')}"] if ranges[0] else [])])
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    limits = [f"{sign} {_number(node[name])}" for name, sign in signs.items() if name in node]
    if "pattern" in node:
        limits.append(f"matches `{node['pattern']}`")
    if "minLength" in node or "maxLength" in node:
        limits.append(f"{node.get('minLength', 0)} to {node.get('maxLength', 'any number of')} characters")
    return ", ".join(limits)


def _number(value: float) -> str:
    for power in (31, 32, 63, 64):
        if value == 2**power:
            return f"2^{power}"
    return f"{value:.10g}"


def _unit(key: str) -> str:
    return next((unit for ending, unit in UNITS.items() if key == ending or key.endswith(f"_{ending}")), "")


def _or(texts: list[str]) -> str:
    """ "a, b or c"."""
    texts = list(dict.fromkeys(texts))
    return " or ".join(filter(None, [", ".join(texts[:-1]), texts[-1]])) if texts else ""


def page() -> str:
    """The reference page, Markdown."""
    text = INTRODUCTION
    for kind, schema in (("scene", scene_schema()), ("recipe", recipe_schema())):
        text += f"\n## {kind.capitalize()}\n"
        for table in tables_of(schema, kind):
            heading = f"`{table.heading}`" if table.heading.startswith("[") else table.heading
            text += f"\n### {heading}\n\n"
            text += f"{table.purpose}\n\n" if table.purpose else ""
            text += "| key | type | default | range | unit | description |\n| --- | --- | --- | --- | --- | --- |\n"
            text += "".join(f"| {' | '.join(row)} |\n" for row in table.rows)
    text += "\n## Presets\n"
    text += f"\n`preset = ...` at the top: {', '.join(f'`{name}`' for name in presets(PHONES))}\n"
    for table, folder in KINDS.items():
        text += f"\n`[{table}] preset = ...`: {', '.join(f'`{name}`' for name in presets(folder))}\n"
    return text


def files() -> dict[Path, str]:
    """All that is made, by path."""
    schemas = {"scene": scene_schema(), "recipe": recipe_schema()}
    texts = {SCHEMAS / f"{kind}.schema.json": json.dumps(tree, indent=1) + "\n" for kind, tree in schemas.items()}
    return {PAGE: page(), **texts}


def main() -> None:
    """Write the page and the schemas."""
    SCHEMAS.mkdir(exist_ok=True)
    for path, text in files().items():
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
