"""Fuzzing of a recipe's sensor, accelerometer, exposure and pictures: a recipe or an InputError, never a crash."""

import string
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from vlcrender.config.presets import presets
from vlcrender.config.toml_model import read_toml
from vlcrender.dataset.recipe.plan import Plan, load_plan
from vlcrender.dataset.recipe.recipe import Recipe, scaled
from vlcrender.errors import InputError
from vlcrender.sensor.sensor import Sensor

QUICKSTART = ROOT / "datasets/quickstart.toml"
TABLES: dict[str, tuple[str, ...]] = {
    "sensor": (*Sensor.model_fields, "preset"),
    "accelerometer": ("kind", "error_deg", "bias_m_s2", "bits", "range_g", "samples", "temperature_c", "preset"),
    "exposure": ("kind", "share_of_saturation", "level_db", "max_s"),
    "added_noise": ("level_db", "relative_to"),
    "processed": ("curve", "gamma", "format", "quality"),
}
WORDS = (
    *("shot", "none", "full", "rggb", "silicon", "tilt-error", "imu", "peak", "noise-level", "srgb", "gamma", "jpeg"),
    *("png", "photon", "../../etc", "\x00", "ünï\n", *presets("sensors"), *presets("accelerometers")),
)
NUMBERS = st.one_of(
    st.integers(-1, 20), st.integers(), st.floats(), st.sampled_from([0.0, 1.0, 12, 16, 100.0, 4900.0, 2**63])
)
VALUES = st.recursive(
    st.one_of(NUMBERS, st.booleans(), st.sampled_from(WORDS), st.text(max_size=8)),
    lambda of: st.one_of(
        st.lists(of, max_size=3),
        st.dictionaries(st.sampled_from(["wavelengths_nm", "values", "red", "green", "blue", "x"]), of, max_size=4),
    ),
    max_leaves=6,
)
PLAUSIBLE: dict[str, Any] = {
    "sensor.noise": "full",
    "sensor.bits": 14,
    "sensor.iso": 400,
    "sensor.prnu": 0.01,
    "sensor.read_noise_e": 3,
    "sensor.temperature_c": 60.0,
    "sensor.dark_current_e_s": 5.0,
    "sensor.preset": "industrial",
    "accelerometer.preset": "bmi270",
    "exposure": {"kind": "peak", "share_of_saturation": 0.5, "max_s": 1},
    "processed.format": "png",
}
"""Valid values, so that some recipes are valid."""
KEYS = st.sampled_from([f"{table}.{key}" for table, keys in TABLES.items() for key in keys] + [*TABLES, "exposure_s"])


def toml(value: Any) -> str:
    """A value in TOML syntax. Python and TOML write nan and inf alike, but not text."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + "".join(f"\\U{ord(letter):08x}" for letter in value) + '"'
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {toml(item)}' for key, item in value.items())} }}"
    return repr(value)


def valid_or_refused(path: Path, assignments: list[str]) -> None:
    """A valid recipe is the same in a worker, has finite parameters, and can be scaled."""
    try:
        plan = load_plan(path, assignments)
    except InputError:
        return
    recipe = plan.recipe
    assert Recipe.model_validate_json(recipe.model_dump_json()) == recipe
    told = [value for value in recipe.sensor.acting().values() if isinstance(value, (int, float))]
    assert np.isfinite([*told, recipe.accelerometer.error_deg, recipe.sensor.dark_electrons(100.0)]).all()
    smaller(plan)


def smaller(plan: Plan) -> None:
    for mode in ("binned", "same-photons"):
        try:
            made = scaled(plan.recipe, 10, mode)
        except InputError:
            continue
        assert made.camera.width_px == 400


@pytest.mark.slow
@settings(max_examples=80, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(st.sampled_from([(key, toml(value)) for key, value in PLAUSIBLE.items()]), max_size=4),
    st.lists(st.tuples(KEYS, st.one_of(VALUES.map(toml), st.text(max_size=12))), max_size=2),
)
@example([], [("seed", "9" * 5000)])  # Python's limit on reading integers
@example([], [("seed", "0x" + "f" * 5000)])  # and on writing them
@example([], [("exposure_s", "[" * 5000)])
@example([], [("sensor.noise", '"none"\nsensor.bits = 10')])
@example([], [("sensor", "{}"), ("sensor.preset", '"phone-1.2um"'), ("sensor.preset.x", "1")])
def test_any_assignment_is_valid_or_refused(sound: list[tuple[str, str]], odd: list[tuple[str, str]]) -> None:
    valid_or_refused(QUICKSTART, [f"{key}={value}" for key, value in sound + odd])


@pytest.mark.slow
@settings(max_examples=80, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.dictionaries(
        st.sampled_from(sorted(TABLES)),
        st.dictionaries(st.text(string.ascii_lowercase, max_size=3), VALUES, max_size=1),
    ),
    st.data(),
)
def test_any_table_is_valid_or_refused(odd: dict[str, dict[str, Any]], data: st.DataObject) -> None:
    """Some of a table's keys, and sometimes an unknown one."""
    tables = {
        name: data.draw(st.dictionaries(st.sampled_from(TABLES[name]), VALUES, max_size=4)) | more
        for name, more in odd.items()
    }
    text = "".join(
        f"\n[{name}]\n" + "".join(f"{toml(k)} = {toml(v)}\n" for k, v in table.items())
        for name, table in tables.items()
    )
    valid_or_refused_file(text)


@pytest.mark.parametrize("value", ["9" * 5000, "0x" + "f" * 5000, "[" * 5000])
def test_values_beyond_all_bounds_are_refused(value: str) -> None:
    valid_or_refused_file(f"\n[processed]\nquality = {value}\n")


def valid_or_refused_file(tables: str) -> None:
    tree = read_toml(QUICKSTART)
    head = {
        k: v for k, v in tree.items() if not isinstance(v, dict) and not ("[exposure]" in tables and k == "exposure_s")
    }
    head["scene"] = str(ROOT / "scenes/office.toml")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recipe.toml"
        lines = [f"{key} = {toml(value)}\n" for key, value in head.items()]
        path.write_text("".join(lines) + f"poses = {toml(tree['poses'])}\n" + tables, encoding="utf-8")
        valid_or_refused(path, [])
