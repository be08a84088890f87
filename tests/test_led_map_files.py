"""LED maps of scenes from CSV and JSON: the LEDs of [[led]] tables, or a refusal with line and column."""

import json
from pathlib import Path

import numpy as np
import pytest
from input_files import mutated, read_or_refused

import vlcrender as vr
from vlcrender.errors import InputError
from vlcrender.scene.loader import load_scene

SCENE = """format = "vlcrender-scene"
version = 1
name = "mine"
led_spectrum = "LED-B3"
led_reflectance = 0.5
{led_map}
[room]
size_m = [4, 3, 2.6]
reflectance = {{ floor = 0.2, ceiling = 0.7, walls = 0.5 }}
[ambient]
illuminance_lux = 0
spectrum = "LED-B3"
{rest}
"""
CM = (
    "id;x_cm;Y (cm);height [cm];radius_mm;luminance_cd_m2\n# a comment\n7;100;50;250;40;9000\n\n2;300,;50;250;30;8000\n"
)
CM = CM.replace("300,", "300")


def scene_at(folder: Path, led_map: str, rest: str = "") -> Path:
    path = folder / "scene.toml"
    path.write_text(SCENE.format(led_map=led_map, rest=rest))
    return path


def of_csv(folder: Path, text: str, led_map: str = 'led_map = "leds.csv"', rest: str = "") -> vr.Scene:
    (folder / "leds.csv").write_text(text)
    return load_scene(scene_at(folder, led_map, rest))


def test_a_csv_has_units_in_the_names_of_its_columns(tmp_path: Path) -> None:
    scene = of_csv(tmp_path, CM)
    assert scene.leds.ids.tolist() == [2, 7]
    assert scene.leds.centers_m == pytest.approx(np.array([[3.0, 0.5, 2.5], [1.0, 0.5, 2.5]]))
    assert scene.leds.half_widths_m == pytest.approx([0.03, 0.04])
    assert scene.leds.luminances_cd_m2.tolist() == [8000.0, 9000.0]
    # The resolved scene has all of it: it is the identity of a set, and needs no file.
    assert [entry.id for entry in scene.settings.led] == [7, 2]
    assert "leds.csv" not in scene.settings.model_dump_json()


@pytest.mark.parametrize(("unit", "metres"), [("m", 1), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254), ("ft", 0.3048)])
def test_units_of_a_file_and_of_a_scene(tmp_path: Path, unit: str, metres: float) -> None:
    """In JSON as `units`, in a scene too, where it wins; a unit in a name stands."""
    place = [1.5 / metres, 1.0 / metres, 2.4 / metres]
    led = {"id": 3, **dict(zip("xyz", place, strict=True)), "side_cm": 10, "luminance (nit)": 5000}
    (tmp_path / "leds.json").write_text(json.dumps({"units": unit, "leds": [led]}))
    scene = load_scene(scene_at(tmp_path, 'led_map = "leds.json"'))
    assert scene.leds.centers_m[0] == pytest.approx([1.5, 1.0, 2.4])
    assert scene.leds.squares.tolist() == [True]
    assert scene.leds.half_widths_m == pytest.approx([0.05])
    (tmp_path / "leds.json").write_text(json.dumps([led]))
    table = f'led_map = {{ file = "leds.json", units = "{unit}" }}'
    assert load_scene(scene_at(tmp_path, table)).leds.centers_m[0] == pytest.approx([1.5, 1.0, 2.4])


def test_flux_is_the_leds_flux(tmp_path: Path) -> None:
    """Of discs and squares, for another beam too; the light of an LED is what its data sheet says."""
    text = "x_m,y_m,z_m,side_m,radius_m,flux_lm,half_power_deg\n1,1,2.5,0.1,,800,\n2,1,2.5,,0.05,1200,30\n"
    scene = of_csv(tmp_path, text)
    assert scene.leds.ids.tolist() == [0, 1]
    assert scene.leds.fluxes_lm == pytest.approx([800.0, 1200.0], rel=1e-12)
    # Lambertian: L = flux / (pi A).
    assert scene.leds.luminances_cd_m2[0] == pytest.approx(800 / (np.pi * 0.01), rel=1e-12)


def test_values_of_the_scene_stand_for_columns_that_are_not_there(tmp_path: Path) -> None:
    table = '[led_map]\nfile = "leds.csv"\nunits = "cm"\nside_m = 0.2\nflux_lm = 500\nhalf_power_deg = 45'
    scene = of_csv(tmp_path, "x,y,z,_room\n100,100,250,lobby\n200,100,250,hall\n", "", table)
    assert scene.leds.squares.all()
    assert scene.leds.half_widths_m == pytest.approx([0.1, 0.1])
    assert scene.leds.fluxes_lm == pytest.approx([500.0, 500.0])
    assert scene.settings.led[0].half_power_deg == 45


def test_a_map_stands_behind_the_scenes_own_leds_and_assignments_act_on_both(tmp_path: Path) -> None:
    own = "[[led]]\nid = 1\nposition_m = [2, 2, 2.5]\nradius_m = 0.05\nluminance_cd_m2 = 1000"
    (tmp_path / "leds.csv").write_text(CM)
    (tmp_path / "other.csv").write_text(CM.replace("7;", "9;"))
    path = scene_at(tmp_path, 'led_map = "leds.csv"', own)
    assert [entry.id for entry in load_scene(path).settings.led] == [1, 7, 2]
    scene = load_scene(path, ["led.1.luminance_cd_m2=5", "led_map=other.csv"])
    assert [(entry.id, entry.luminance_cd_m2) for entry in scene.settings.led] == [(1, 1000), (9, 5), (2, 8000)]


HEAD = "id,x_m,y_m,z_m,radius_m,luminance_cd_m2\n1,1,1,2.5,0.05,9000\n"
REFUSALS = {
    "no unit": ("id,x,y_m,z_m\n1,1,1,2\n", r"line 2: column 'x' has no unit: name it x_m or x_cm .* or give units"),
    "other unit": ("id,x_km,y_m,z_m\n1,1,1,2\n", "line 2: column 'x_km': unit 'km' is not one of m, cm, mm, in, ft"),
    "unknown": (HEAD.replace("id", "idd"), "line 2: unknown column 'idd'; allowed: id, x_m|cm|mm|in|ft, "),
    "twice": (HEAD.replace("id", "x_cm"), "line 2: column 'x_m': another column says x already"),
    "same": (HEAD.replace("id", "x_m"), "line 1: column 'x_m' is there twice"),
    "word": (HEAD + "2,2,high,2.5,0.05,9000\n", "line 3: column 'y_m': 'high' is not a finite number"),
    "infinite": (HEAD + "2,2,inf,2.5,0.05,9000\n", "line 3: column 'y_m': 'inf' is not a finite number"),
    "empty": (HEAD + "2,2,,2.5,0.05,9000\n", "line 3: no y; each LED has x, y and z"),
    "cells": (HEAD + "2,2,2.5\n", "line 3: 3 cells; the header has 6 columns"),
    "id": (HEAD + "2.5,2,1,2.5,0.05,9000\n", "line 3: column 'id': 2.5 is not a whole number"),
    "size": ("x_m,y_m,z_m,flux_lm\n1,1,2.5,800\n", r"line 2: no radius; add a column radius_m, or radius_m under"),
    "small": (HEAD + "2,2,1,2.5,0,9000\n", "line 3: column 'radius': 0 has to be above 0"),
    "light": ("x_m,y_m,z_m,radius_m\n1,1,2.5,0.1\n", "line 2: has neither luminance nor flux; give luminance_cd_m2"),
    "shape": (HEAD.replace("id", "shape").replace("\n1,", "\nstar,"), "line 2: column 'shape': 'star' is not disc or"),
    "square": (
        HEAD.replace("id", "shape").replace("\n1,", "\nsquare,"),
        "line 2: column 'shape': a square has no radius",
    ),
    # Found by the scene's own checks, which name a table [[led]].
    "negative": (HEAD + "2,2,1,2.5,0.05,-3\n", "line 3: luminance_cd_m2 = -3.0: input should be greater than 0"),
    "outside": (HEAD + "\n\n2,9,1,2.5,0.05,9000\n", "line 5: .*room"),
    "overlap": (HEAD + "2,1.02,1,2.5,0.05,9000\n", "line 3: LEDs 1 and 2 overlap"),
    "id twice": (HEAD + "1,2,1,2.5,0.05,9000\n", "line 3: .*id"),
    "nothing": ("id,x_m\n", "0 LEDs; 1 to 100000 are allowed"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_wrong_map_is_refused_with_line_and_column(tmp_path: Path, case: str) -> None:
    text, message = REFUSALS[case]
    with pytest.raises(InputError, match=message.replace("|", r"\|")) as refused:
        of_csv(tmp_path, text)
    assert str(refused.value).startswith(f"{tmp_path}/scene.toml: ")
    assert f"{tmp_path}/leds.csv" in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not JSON"),
        ('{"lamps": []}', "unknown key 'lamps'; allowed: leds, units"),
        ('{"units": 3, "leds": []}', "units = 3: allowed are m, cm"),
        ('{"units": "yd", "leds": []}', "units = 'yd': allowed are m, cm"),
        ("[1]", "has to be a list of objects"),
        ('[{"x_m": [1], "y_m": 1, "z_m": 2}]', r"leds\[0\]: column 'x_m': \[1\] is not a finite number"),
        ('[{"x_m": true, "y_m": 1, "z_m": 2}]', "column 'x_m': True is not a finite number"),
        (f'[{{"x_m": 1{"0" * 400}}}]', "is not a finite number"),
    ],
)
def test_wrong_json_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "leds.json").write_text(text)
    with pytest.raises(InputError, match=message):
        load_scene(scene_at(tmp_path, 'led_map = "leds.json"'))


@pytest.mark.parametrize(
    ("led_map", "message"),
    [
        ('led_map = "no.csv"', "no.csv: cannot be read: No such file"),
        ("led_map = 3", "led_map = 3"),
        ('led_map = { file = "leds.csv", radius_cm = 3 }', "unknown key led_map.radius_cm; did you mean radius_m"),
        ('led_map = { units = "m" }', "key led_map.file is missing"),
    ],
)
def test_a_wrong_key_is_refused(tmp_path: Path, led_map: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        of_csv(tmp_path, CM, led_map)


@pytest.mark.parametrize("name", ["leds.csv", "leds.json"])
def test_a_damaged_map_is_read_or_refused(tmp_path: Path, name: str) -> None:
    """Seeded mutations of a map, through all checks of the scene."""
    rng, path, refused = np.random.default_rng(16), scene_at(tmp_path, f'led_map = "{name}"'), 0
    rows = [{"id": n, "x_m": n, "y_m": 1, "z_m": 2.5, "radius_cm": 5, "flux_lm": 800} for n in (1, 2, 3)]
    data = CM.encode() if name == "leds.csv" else json.dumps({"units": "m", "leds": rows}).encode()
    for _ in range(150):
        (tmp_path / name).write_bytes(mutated(data, rng))
        scene = read_or_refused(path, lambda: load_scene(path))
        refused += scene is None
        if scene is not None:
            assert np.isfinite(scene.leds.centers_m).all()
            assert (scene.leds.luminances_cd_m2 > 0).all()
    assert 0 < refused < 150
