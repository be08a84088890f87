"""Format version 4: LED map entries by shape, names of EXR parts, and the refusal of other versions."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from conftest import ROOT, SMALL

from vlcrender.dataset.format.files import read_dataset_file
from vlcrender.dataset.format.schema import DATA_VERSION, led_map
from vlcrender.dataset.recipe.plan import Plan, load_plan
from vlcrender.dataset.run.generate import generate
from vlcrender.dataset.verify.verify import verify
from vlcrender.errors import InputError
from vlcrender.scene.loader import Scene


def plan() -> Plan:
    """Two LED-region frames of the office."""
    regions = 'regions={ kind = "leds", margin_px = 2 }'
    return load_plan(ROOT / "datasets/quickstart.toml", [*SMALL, "poses.count=2", regions])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("format") / "set"
    generate(plan(), directory)
    return directory


def test_the_version_is_4_and_discs_have_a_radius(made: Path) -> None:
    tree = json.loads((made / "dataset.json").read_text())
    assert tree["version"] == 4
    assert tree["provenance"]["data_version"] == DATA_VERSION
    assert len(tree["led_map"]) == 49 * 25
    for led in tree["led_map"]:
        stated = {"luminaire", "sigma_m", "radius_sigma_m", "gradient_sigma"}
        assert set(led) == {"id", "position_m", "shape", "radius_m", *stated}
        assert (led["shape"], led["radius_m"]) == ("disc", 0.01)
        assert {led[key] for key in stated} == {None}


def test_squares_have_their_whole_side(office: Scene) -> None:
    """The scene's arrays hold half the side; the map states the side, and no radius."""
    squares = replace(office.leds, squares=np.arange(len(office.leds)) % 2 == 1)
    entries = [entry.model_dump() for entry in led_map(squares)]
    for disc, square in zip(entries[::2], entries[1::2], strict=False):
        assert (disc["shape"], disc["radius_m"], "side_m" in disc) == ("disc", 0.01, False)
        assert (square["shape"], square["side_m"], "radius_m" in square) == ("square", 0.02, False)


def test_parts_are_named_region_and_their_number(made: Path) -> None:
    with OpenEXR.File(str(made / "frames/000000.exr"), separate_channels=True) as file:
        names = [part.name() for part in file.parts]
    assert len(names) > 1
    assert names == [f"region {number}" for number in range(len(names))]


@pytest.mark.parametrize("version", [3, 5, "4", None])
def test_another_version_is_refused_in_one_line(made: Path, tmp_path: Path, version: object) -> None:
    shutil.copytree(made, tmp_path / "set")
    path = tmp_path / "set/dataset.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "version": version}))
    for reader in (read_dataset_file, verify):
        with pytest.raises(InputError, match="reads version 4; generate the dataset again") as refusal:
            reader(tmp_path / "set")
        assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("led", [{"side_m": 0.02}, {"radius_m": 0.01, "side_m": 0.02}, {}])
def test_a_disc_with_other_keys_than_its_own_is_refused(made: Path, tmp_path: Path, led: dict[str, float]) -> None:
    shutil.copytree(made, tmp_path / "set")
    path = tmp_path / "set/dataset.json"
    tree = json.loads(path.read_text())
    tree["led_map"][0] = {"id": 0, "position_m": [0.0, 0.0, 3.0], "shape": "disc", **led}
    path.write_text(json.dumps(tree))
    with pytest.raises(InputError, match=r"led_map\[0\]"):
        read_dataset_file(tmp_path / "set")
