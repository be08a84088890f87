"""Presets of whole phones: valid recipes, sources of every number, and what overrides what."""

import numpy as np
import pytest
from conftest import ROOT

from vlcrender.config.presets import presets, with_presets
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.errors import InputError
from vlcrender.sensor.accelerometer import Imu

QUICKSTART = ROOT / "datasets/quickstart.toml"


@pytest.mark.parametrize("name", presets("phones"))
def test_a_phone_is_whole_and_names_its_sources(name: str) -> None:
    recipe = load_plan(QUICKSTART, [f"preset={name}"]).recipe
    assert recipe.camera.shutter.kind == "rolling"
    assert recipe.camera.psf == "diffraction"
    assert recipe.sensor.noise == "full"
    assert recipe.accelerometer == Imu.preset("lsm6dso" if "2023" in name else "bmi270")
    # The last line is read within 1/60 s, and the full well is at 90 to 110 % of the ADC's range.
    assert recipe.camera.line_starts_s().max() < 1 / 60
    level = recipe.sensor.full_well_e / recipe.sensor.gain_at_iso_e_per_dn + recipe.sensor.black_level_dn
    assert 0.9 < level / recipe.sensor.largest_dn < 1.1
    for line in (ROOT / f"vlcrender/config/preset_files/phones/{name}.toml").read_text().splitlines():
        if "=" in line and not line.startswith(("#", 'preset = "phone-wide"')):
            assert "#" in line, line


def test_the_focal_length_of_2023_is_that_of_its_field_of_view() -> None:
    camera = load_plan(QUICKSTART, ["preset=phone-2023-main", "camera.focus_distance_m=infinity"]).recipe.camera
    diagonal_px = np.hypot(camera.width_px, camera.height_px)
    # 82 deg by its maker, to a degree; the lens without its distortion.
    assert 2 * np.degrees(np.arctan(diagonal_px / 2 / camera.focal_px)) == pytest.approx(82, abs=0.5)


def test_a_recipe_overrides_its_phone_and_an_assignment_replaces_its_tables() -> None:
    tree = {"preset": "phone-2023-main", "camera": {"f_number": 2.4}, "sensor": {"prnu": 0.01}}
    made = with_presets(tree, [], "here")
    assert (made["camera"]["f_number"], made["camera"]["focal_length_mm"], made["sensor"]["prnu"]) == (2.4, 7.05, 0.01)
    assert "preset" not in made
    made = with_presets(tree, ["preset=phone-2019-main", "camera.transmittance=0.8"], "here")
    assert (made["camera"]["f_number"], made["camera"]["transmittance"]) == (1.8, 0.8)
    assert made["camera"]["shutter"]["row_time_us"] == 5.5
    with pytest.raises(
        InputError, match=r'^here: preset = "phone": unknown; presets of phones: phone-2019-main, phone-20'
    ):
        with_presets({"preset": "phone"}, [], "here")
