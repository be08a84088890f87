"""Presets, renamed keys, and limits of a recipe's sensor: error messages are one line with key and value."""

import re
from pathlib import Path
from typing import get_args

import pytest
from conftest import ROOT
from pydantic import BaseModel

from vlcrender.camera.intrinsics import Camera
from vlcrender.config.presets import preset, presets, with_presets
from vlcrender.config.toml_model import RENAMED_KEYS
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.errors import InputError
from vlcrender.scene.schema import SceneSettings
from vlcrender.sensor.radiometry import detectors, electron_rate_per_cd_m2
from vlcrender.sensor.sensor import Sensor

QUICKSTART = ROOT / "datasets/quickstart.toml"


def recipe(*assignments: str) -> Recipe:
    return load_plan(QUICKSTART, assignments).recipe


@pytest.mark.parametrize("name", presets("sensors"))
def test_every_preset_is_a_valid_sensor(name: str) -> None:
    made = recipe(f"sensor.preset={name}")
    given = preset("sensors", name)
    assert set(given) == {"camera", "sensor"}
    assert made.camera.pixel_pitch_um == given["camera"]["pixel_pitch_um"]
    assert made.sensor.model_dump(include=set(given["sensor"])) == given["sensor"]
    # The full well is at 90 to 110 % of the ADC's range.
    level = made.sensor.full_well_e / made.sensor.gain_at_iso_e_per_dn + made.sensor.black_level_dn
    assert name == "ideal" or 0.9 < level / made.sensor.largest_dn < 1.1


@pytest.mark.parametrize("name", presets("sensors"))
def test_every_number_of_a_preset_names_its_source(name: str) -> None:
    text = (ROOT / f"vlcrender/config/preset_files/sensors/{name}.toml").read_text()
    for line in text.splitlines():
        if "=" in line and not line.startswith("#") and name != "ideal":
            assert "#" in line or "noise = " in line or "quantum_efficiency" in line, line


def test_the_presets_include_ideal_industrial_and_phone() -> None:
    assert {"ideal", "industrial", "phone-1.2um"} < set(presets("sensors"))


@pytest.mark.parametrize("name", presets("cameras"))
def test_every_camera_preset_is_whole_and_names_its_sources(name: str) -> None:
    """A lens that light can pass, with diffraction, and a real sensor; in place of the recipe's own."""
    made = recipe(f"camera.preset={name}")
    given = preset("cameras", name)
    assert set(given) == {"camera", "sensor"}
    assert made.camera.model_dump(include=set(given["camera"]) - {"distortion"}) == {
        key: value for key, value in given["camera"].items() if key != "distortion"
    }
    assert made.camera.psf == "diffraction"
    of_sensor = preset("sensors", given["sensor"]["preset"])
    assert made.camera.pixel_pitch_um == of_sensor["camera"]["pixel_pitch_um"]
    assert made.sensor == Sensor.preset(given["sensor"]["preset"])  # none of quickstart's [sensor] is left
    assert made.sensor.noise == "full"
    assert Camera.preset(name) == made.camera
    text = (ROOT / f"vlcrender/config/preset_files/cameras/{name}.toml").read_text()
    for line in text.splitlines():
        if "=" in line and not line.startswith(("#", "preset = ")):
            assert "#" in line, line


def test_a_recipe_overrides_keys_and_sensor_of_its_camera_preset() -> None:
    tree = {"camera": {"preset": "phone-wide", "f_number": 2.4}, "sensor": {"prnu": 0.01}}
    made = with_presets(tree, [], "here")
    assert (made["camera"]["f_number"], made["camera"]["focal_length_mm"]) == (2.4, 3.6)
    assert (made["sensor"]["prnu"], made["sensor"]["full_well_e"]) == (0.01, 4900.0)
    made = with_presets({**tree, "sensor": {"preset": "phone-1.55um"}}, ["camera.transmittance=0.8"], "here")
    assert (made["sensor"]["full_well_e"], made["camera"]["pixel_pitch_um"]) == (8180.0, 1.55)
    assert (made["camera"]["transmittance"], made["camera"]["focal_length_mm"]) == (0.8, 3.6)
    with pytest.raises(
        InputError, match=r'^here: camera\.preset = "phone": unknown; presets of cameras: machine-vision'
    ):
        with_presets({"camera": {"preset": "phone"}}, [], "here")
    with pytest.raises(InputError, match=r"presets of cameras: machine-vision, phone-wide"):
        Camera.preset("phone")


def test_recipes_say_the_electrons_of_their_brightest_led() -> None:
    """Light of its own in a pixel on the axis: luminance * rate * time, as `generate` computes it."""
    said = 0
    for path in sorted((ROOT / "datasets").glob("*.toml")):
        found = re.search(r"the brightest LED, ([\d ]+) cd/m2, gives ([\d ]+) electrons", path.read_text())
        assert found or "brightest LED" not in path.read_text(), path
        if not found:
            continue
        plan = load_plan(path)
        luminance, electrons = (float(number.replace(" ", "")) for number in found.groups())
        brightest = plan.scene.leds.luminances_cd_m2.max()
        (detector,) = detectors(plan.recipe.sensor)
        rate = electron_rate_per_cd_m2(plan.recipe.camera, plan.scene.settings.led_spectrum, detector)
        assert plan.recipe.exposure_s is not None
        # both are rounded to the digit
        assert abs(brightest - luminance) <= 0.5
        assert abs(brightest * rate * plan.recipe.exposure_s - electrons) <= 0.5
        assert electrons < plan.recipe.sensor.full_well_e
        said += 1
    assert said >= 5


def test_keys_of_a_recipe_override_its_preset(tmp_path: Path) -> None:
    tree = {"sensor": {"preset": "phone-1.2um", "bits": 12}, "camera": {"f_number": 1.8}, "name": "x"}
    made = with_presets(tree, [], "here")
    assert made["sensor"]["bits"] == 12
    assert made["sensor"]["full_well_e"] == 4900.0
    assert made["camera"] == {"pixel_pitch_um": 1.2, "f_number": 1.8}
    assert "preset" not in made["sensor"]
    assert tree["sensor"]["preset"] == "phone-1.2um", "the tree given is left as it is"


def test_an_assigned_preset_overrides_the_recipe_and_other_assignments_override_it() -> None:
    made = recipe("sensor.read_noise_e=9", "sensor.preset=industrial", "camera.pixel_pitch_um=3.0")
    assert made.sensor.read_noise_e == 9.0
    assert made.sensor.full_well_e == 9458.0
    assert made.camera.pixel_pitch_um == 3.0


REFUSED = {
    "preset": (["sensor.preset=phone"], ["sensor.preset", "phone-1.2um", "ideal", "industrial"]),
    "preset is no name": (["sensor.preset=[1]"], ["sensor.preset"]),
    "bits": (["sensor.bits=9.5"], ["sensor.bits = 9.5", "8, 10, 12 or 14"]),
    "gain": (["sensor.gain_e_per_dn=-1"], ["sensor.gain_e_per_dn = -1", "greater than 0"]),
    "nan": (["sensor.prnu=nan"], ["sensor.prnu", "NaN", "finite"]),
    "noise": (["sensor.read_noise_e=-2"], ["sensor.read_noise_e = -2"]),
    "well": (
        ["sensor.read_noise_e=300", "sensor.full_well_e=250"],
        ["full_well_e = 250", "exceed the noise of 300 e", "read_noise_e"],
    ),
    "black": (["sensor.bits=8", "sensor.black_level_dn=255"], ["black_level_dn = 255", "below 255"]),
    "iso": (["sensor.iso=0"], ["sensor.iso = 0"]),
    "doubling": (["sensor.dark_current_doubling_c=0"], ["sensor.dark_current_doubling_c = 0"]),
    "qe above 1": (
        ["sensor.quantum_efficiency={wavelengths_nm=[400, 500], values=[0.5, 1.2]}"],
        ["sensor.quantum_efficiency", "values[1] = 1.2", "less than or equal to 1"],
    ),
    "qe short": (
        ["sensor.quantum_efficiency={wavelengths_nm=[400, 500, 600], values=[0.5, 0.2]}"],
        ["sensor.quantum_efficiency", "2 numbers for 3"],
    ),
    "qe backwards": (
        ["sensor.quantum_efficiency={wavelengths_nm=[500, 400], values=[0.5, 0.2]}"],
        ["wavelengths_nm: must increase"],
    ),
    "qe half": (
        ["sensor.quantum_efficiency={wavelengths_nm=[400, 500], red=[0.5, 0.2]}"],
        ["sensor.quantum_efficiency", "red, green and blue"],
    ),
    "qe word": (["sensor.quantum_efficiency=gold"], ['"gold"', '"silicon"', "wavelengths_nm"]),
    "qe of no visible light": (
        ["sensor.quantum_efficiency={wavelengths_nm=[100, 200], values=[0.5, 0.5]}"],
        ["sensor.quantum_efficiency", "380 to 780 nm"],
    ),
    "qe of nothing": (
        ["sensor.quantum_efficiency={wavelengths_nm=[400, 700], values=[0, 0]}"],
        ["sensor.quantum_efficiency", "380 to 780 nm"],
    ),
    "mosaic without colours": (["sensor.mosaic=rggb"], ['mosaic = "rggb"', "red, green and blue"]),
    "mosaic": (["sensor.mosaic=gbbr"], ["sensor.mosaic", "rggb"]),
    "two exposures": (
        ["exposure_s=1e-4", "exposure.kind=noise-level", "exposure.level_db=-9"],
        ["exactly one of exposure_s"],
    ),
    "metered motion": (
        ["exposure.kind=noise-level", "exposure.level_db=-9", "motion.linear_velocity_m_s=[1, 0, 0]"],
        ["exposure", "motion", "exposure_s"],
    ),
    "share": (
        ["exposure.kind=peak", "exposure.share_of_saturation=1.5", "exposure.max_s=1.0"],
        ["exposure.share_of_saturation = 1.5"],
    ),
    "level": (["exposure.kind=noise-level", "exposure.level_db=nan"], ["exposure.level_db"]),
    "repeats": (["repeats=0"], ["repeats = 0"]),
    "processed regions": (["processed={}", "regions.kind=leds"], ["processed", "regions"]),
    "quality": (["processed.quality=101"], ["processed.quality = 101"]),
}


RENAMED = {
    "windows.margin_px=3": "key windows was renamed: write regions",
    "windows={}": "key windows was renamed: write regions",
    "exposure.longest_s=1.0": "key exposure.longest_s was renamed: write exposure.max_s",
}


@pytest.mark.parametrize("assignment", RENAMED)
def test_a_renamed_key_is_refused_with_its_present_name(assignment: str) -> None:
    with pytest.raises(InputError) as refusal:
        recipe(assignment)
    assert str(refusal.value) == f"{QUICKSTART} with --set: {RENAMED[assignment]}"


def test_every_present_name_of_a_renamed_key_is_a_key() -> None:
    """The present names are keys of the models, the former ones are not."""
    for former, present in RENAMED_KEYS.items():
        keys = [any(_is_key(name.split("."), model) for model in (Recipe, SceneSettings)) for name in (former, present)]
        assert keys == [False, True], (former, present)


def _is_key(path: list[str], model: type[BaseModel]) -> bool:
    if path[0] not in model.model_fields:
        return False
    models = _models(model.model_fields[path[0]].annotation)
    return len(path) == 1 or any(_is_key(path[1:], inner) for inner in models)


def _models(annotation: object) -> list[type[BaseModel]]:
    """Models in an annotation: of tables, arrays of tables and unions."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in get_args(annotation) for model in _models(argument)]


@pytest.mark.parametrize("case", REFUSED)
def test_a_bad_value_is_refused_in_one_line(case: str) -> None:
    assignments, mentions = REFUSED[case]
    with pytest.raises(InputError) as refusal:
        recipe(*assignments)
    line = str(refusal.value)
    assert "\n" not in line
    assert "quickstart.toml" in line
    for mention in mentions:
        assert mention in line, line


def test_tables_that_a_preset_does_not_have_stay_as_they_are() -> None:
    """A table of the recipe alone, one of the preset alone, and a value where the preset has a table."""
    tree = {"sensor": {"preset": "phone-1.2um"}, "poses": {"count": 3}, "name": "x"}
    made = with_presets(tree, [], "here")
    assert (made["poses"], made["name"], made["camera"]) == ({"count": 3}, "x", {"pixel_pitch_um": 1.2})
    assert with_presets({**tree, "camera": 3}, [], "here")["camera"] == 3  # the check of the recipe names it
    assert with_presets({"sensor": 3}, ["sensor.preset=phone-1.2um"], "here")["sensor"]["full_well_e"] == 4900.0


def test_an_accelerometer_and_a_sensor_have_presets_of_their_own() -> None:
    made = with_presets({}, ["accelerometer.preset=bmi270", "sensor.preset=industrial"], "here")
    assert set(made) == {"accelerometer", "sensor", "camera"}
    assert made["accelerometer"] == preset("accelerometers", "bmi270")["accelerometer"]
    assert made["sensor"] == preset("sensors", "industrial")["sensor"]
    with pytest.raises(InputError, match=r'^here: accelerometer\.preset = "industrial": unknown; presets of accelero'):
        with_presets({"accelerometer": {"preset": "industrial"}}, [], "here")


def test_an_assigned_preset_leaves_no_key_of_the_recipes_preset() -> None:
    """A phone's preset has a black level and noise that "ideal" has not, and the recipe has a PRNU of its own."""
    tree = {"sensor": {"preset": "phone-1.2um", "prnu": 0.01}}
    made = with_presets(tree, ["sensor.preset=ideal", "sensor.bits=14"], "here")
    assert made["sensor"] == {**preset("sensors", "ideal")["sensor"], "bits": 14}
