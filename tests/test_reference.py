"""The reference of keys, its schemas and the page of the API are what the code says; our files fit the schemas."""

import copy
import importlib.util
import tomllib
from contextlib import nullcontext
from types import ModuleType
from typing import Any

import pytest
from conftest import ROOT
from jsonschema import Draft202012Validator

from vlcrender.config.packaged import packaged_folder
from vlcrender.config.presets import with_presets
from vlcrender.config.toml_model import check
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.errors import InputError


def script(name: str) -> ModuleType:
    """A script of docs/ as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / f"docs/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def reference() -> ModuleType:
    return script("make_reference")


def schema_of(kind: str, reference: ModuleType) -> dict[str, Any]:
    schema: dict[str, Any] = {"scene": reference.scene_schema, "recipe": reference.recipe_schema}[kind]()
    return schema


@pytest.mark.parametrize("name", ["make_reference", "make_api"])
def test_what_is_made_is_up_to_date(name: str) -> None:
    """`make docs` makes it anew."""
    for path, text in script(name).files().items():
        assert path.read_text(encoding="utf-8") == text, f"{path}: run make docs"


def test_every_key_of_the_models_has_a_row(reference: ModuleType) -> None:
    for kind in ("scene", "recipe"):
        schema = schema_of(kind, reference)
        keys = {key for tree in (schema, *schema["$defs"].values()) for key in tree["properties"]}
        rows = [row for table in reference.tables_of(schema, kind) for row in table.rows]
        assert {row[0].strip("`") for row in rows} == keys
        assert all(row[1] for row in rows), "a key without a type"


def test_every_key_is_described(reference: ModuleType) -> None:
    assert [key for kind in ("scene", "recipe") for key in reference.undescribed(schema_of(kind, reference))] == []


def test_units_are_those_of_the_keys(reference: ModuleType) -> None:
    units = {"exposure_s": "s", "luminance_cd_m2": "cd/m2", "gain_e_per_dn": "e/DN", "dark_current_e_s": "e/s"}
    units |= {"bias_drift_m_s2_per_k": "m/s2/K", "angular_velocity_deg_s": "deg/s", "f_number": "", "prnu": ""}
    assert {key: reference._unit(key) for key in units} == units


@pytest.mark.parametrize("kind", ["scene", "recipe"])
def test_schemas_accept_the_packaged_files_and_refuse_unknown_keys(kind: str, reference: ModuleType) -> None:
    schema = schema_of(kind, reference)
    Draft202012Validator.check_schema(schema)
    validator = Draft202012Validator(schema)
    files = sorted(packaged_folder("scene" if kind == "scene" else "recipe").glob("*.toml"))
    assert files
    for path in files:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
        assert not list(validator.iter_errors(tree)), path
        wrong = copy.deepcopy(tree)
        wrong["led_spectrun" if kind == "scene" else "exposure_ms"] = 1
        assert list(validator.iter_errors(wrong))


@pytest.mark.parametrize(
    ("table", "accepted"),
    [
        ({"sensor": {"preset": "phone-1.2um", "bits": 12}}, True),
        ({"sensor": {"preset": "phone"}}, False),
        ({"sensor": {"bits": 9}}, False),
        ({"accelerometer": {"error_deg": 0.5}}, True),
        ({"accelerometer": {"preset": "bmi270", "misalignment_deg": 0.2}}, True),
        ({"accelerometer": {"kind": "imu", "misalignment_deg": 0.2}}, True),
        ({"accelerometer": {"misalignment_deg": 0.2}}, False),
        ({"camera": {"focus_distance_m": "infinity"}}, True),
        ({"camera": {"focus_distance_m": "near"}}, False),
    ],
)
def test_the_schema_of_recipes_agrees_with_the_check(
    table: dict[str, Any], accepted: bool, reference: ModuleType
) -> None:
    tree = {**tomllib.loads((ROOT / "datasets/quickstart.toml").read_text(encoding="utf-8")), **table}
    errors = list(Draft202012Validator(schema_of("recipe", reference)).iter_errors(tree))
    assert (not errors) == accepted, [error.message for error in errors]
    with nullcontext() if accepted else pytest.raises(InputError):
        check(with_presets(tree, [], "recipe"), Recipe, "recipe")
