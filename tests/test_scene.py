"""Scenes: properties of the shipped ones; error messages for impossible ones."""

import tomllib
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.config.toml_model import RENAMED_KEYS, check
from vlcrender.errors import InputError
from vlcrender.scene.leds import Leds, _neighbours
from vlcrender.scene.loader import Scene, build_scene, load_scene
from vlcrender.scene.schema import SceneSettings
from vlcrender.scene.visibility import leds_in_view, level_visibility

ROOT = Path(__file__).parent.parent
TABLE1 = (ROOT / "scenes/table1.toml").read_text()
OFFICE = (ROOT / "scenes/office.toml").read_text()


def test_table1_holds_the_papers_leds_in_metres(table1: Scene) -> None:
    assert table1.leds.ids.tolist() == [1, 2, 3, 4]
    decimetres = [[5, 15, 35], [3, 19, 35], [8, 12, 35], [9, 11, 35]]
    assert np.allclose(table1.leds.centers_m, np.array(decimetres) / 10)
    assert table1.room_m.tolist() == [7.0, 7.0, 3.5]


def test_three_leds_of_table1_lie_on_one_line(table1: Scene) -> None:
    on_line = table1.leds.centers_m[[0, 2, 3], :2]
    assert np.allclose(on_line.sum(axis=1), 2.0)
    spread = np.linalg.svd(table1.leds.centers_m[:, :2] - table1.leds.centers_m[:, :2].mean(axis=0))[1]
    assert spread == pytest.approx([0.78, 0.065], abs=0.005)


def test_the_office_has_0_6_m_panels_of_leds_within_the_papers_luminances(office: Scene) -> None:
    undersides = [s for s in office.surfaces if s.name.endswith("underside")]
    assert len(undersides) == 49
    assert all(np.allclose(sorted(np.abs(s.edge_u_m + s.edge_v_m)), [0, 0.6, 0.6]) for s in undersides)
    assert len(office.leds) == 49 * 25
    assert office.leds.luminances_cd_m2.min() >= 4000
    assert office.leds.luminances_cd_m2.max() <= 16000
    # uniform over the range: mean 10 000, se = 12000 / sqrt(12 * 1225) = 99; 5 sigma
    assert abs(office.leds.luminances_cd_m2.mean() - 10000) < 495


def test_surfaces_face_into_the_room(office: Scene) -> None:
    for surface in office.surfaces[:6]:
        normal = np.cross(surface.edge_u_m, surface.edge_v_m)
        middle = surface.corner_m + (surface.edge_u_m + surface.edge_v_m) / 2
        assert normal @ (office.room_m / 2 - middle) > 0, surface.name


def test_led_ids_count_along_x_first_within_a_panel(office: Scene) -> None:
    first = office.leds.centers_m[:6]
    assert np.allclose(np.diff(first[:5, 0]), 0.13)
    assert np.allclose(first[:5, 1], first[0, 1])
    assert first[5] == pytest.approx([first[0, 0], first[0, 1] + 0.13, 3.45])


def test_four_leds_of_table1_are_in_view_of_36_of_122500_level_poses(table1: Scene) -> None:
    """Counted independently: |x_led - x| f / h within the half sensor, h = 3.5 m, f = 15 000 px."""
    steps = (np.arange(350) + 0.5) * 0.02
    for yaw, half_x, half_y in ((0.0, 2000, 1500), (90.0, 1500, 2000)):
        in_x = np.abs(table1.leds.centers_m[:, 0] - steps[:, None]) * 15000 / 3.5 <= half_x + 1e-6
        in_y = np.abs(table1.leds.centers_m[:, 1] - steps[:, None]) * 15000 / 3.5 <= half_y + 1e-6
        seen = (in_x[:, None, :] & in_y[None, :, :]).sum(axis=2) >= 4
        coverage = level_visibility(Camera(), table1, 0.0, yaw)
        assert (coverage.poses, coverage.seen) == (122_500, int(seen.sum()))
        assert coverage.seen == {0.0: 0, 90.0: 36}[yaw]


def assert_refused(folder: Path, text: str, old: str, new: str, message: str) -> None:
    """A scene file with `old` replaced by `new` is refused in one line that names the file."""
    assert old in text
    path = folder / "bad.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as refusal:
        load_scene(path)
    assert "\n" not in str(refusal.value)
    assert str(path) in str(refusal.value)


BAD_TABLE1 = [
    ("radius_m = 0.01", "radius_m = -0.01", r"led\[0\]\.radius_m = -0\.01: .*greater than 0"),
    ("radius_m = 0.01", "radius_cm = 1.0", r"unknown key led\[0\]\.radius_cm; did you mean radius_m\?"),
    ("radius_m = 0.01", "", r"led\[0\]\.radius_m is missing"),
    ("radius_m = 0.01", 'radius_m = "1 cm"', r"led\[0\]\.radius_m = \"1 cm\": .*valid number"),
    ("radius_m = 0.01", "radius_m = nan", r"led\[0\]\.radius_m"),
    ("radius_m = 0.01", "radius_m = true", r"led\[0\]\.radius_m = true"),
    (
        "radius_m = 0.01",
        "radius_m = 0.01\ncolour = 3",
        r"unknown key led\[0\]\.colour; allowed: downlink, face_falloff, face_gradient,",
    ),
    ("radius_m = 0.01", 'shape = "square"\nradius_m = 0.01', r"led\[0\]\.radius_m: .*a square has side_m"),
    ("radius_m = 0.01", "side_m = 0.02", r"led\[0\]\.side_m: .*a disc has radius_m"),
    ("radius_m = 0.01", "radius_m = 0.01\nside_m = 0.02", r"led\[0\]\.side_m: .*a disc has radius_m"),
    ("radius_m = 0.01", 'shape = "square"', r"key led\[0\]\.side_m is missing"),
    ("radius_m = 0.01", 'shape = "square"\nside_m = 0.0', r"led\[0\]\.side_m = 0\.0: .*greater than 0"),
    ("[[led]]", '[[window]]\nwall = "x=0"\n[[led]]', r"key window was renamed: write glazing"),
    ("position_m = [0.5, 1.5, 3.5]", "position_m = [5, 15, 35]", r"led\[0\]: LED 1 .*not inside the room"),
    ("position_m = [0.5, 1.5, 3.5]", "position_m = [0.005, 1.5, 3.5]", r"LED 1 .*not inside the room"),
    ("position_m = [0.5, 1.5, 3.5]", "position_m = [0.5, 1.5]", r"led\[0\]\.position_m"),
    ("position_m = [0.5, 1.5, 3.5]", "position_m = [0.3, 1.9, 3.5]", r"LEDs 1 and 2 overlap"),
    ("id = 2", "id = 1", r"LED id 1 is used twice"),
    ("id = 2", "id = -2", r"led\[1\]\.id = -2"),
    ("id = 2", "id = 2.5", r"led\[1\]\.id = 2\.5"),
    ("floor = 0.2", "floor = 1.2", r"room\.reflectance\.floor = 1\.2: .*less than or equal to 1"),
    (
        "illuminance_lux = 400.0",
        "illuminance_fc = 37",
        r"unknown key ambient\.illuminance_fc; did you mean illuminance_lux",
    ),
    ("illuminance_lux = 400.0", "illuminance_lux = inf", r"ambient\.illuminance_lux"),
    ('spectrum = "LED-B3"', 'spectrum = "sun"', r"spectrum = \"sun\": .*'LED-B1'"),
    ("version = 1", "version = 2", r"version = 2: "),
    ("[room]", "[room", r"is not TOML"),
    ("size_m = [7.0, 7.0, 3.5]", "size_m = [7.0, 7.0, 0.0]", r"room\.size_m\[2\] = 0\.0"),
]


@pytest.mark.parametrize(
    ("old", "new", "message"), BAD_TABLE1, ids=[row[1].replace("\n", " ") or "nothing" for row in BAD_TABLE1]
)
def test_a_bad_scene_is_refused_in_one_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert_refused(tmp_path, TABLE1, old, new, message)


def test_a_renamed_key_is_found_in_arrays_of_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(RENAMED_KEYS, "led.radius_m", "led.half_width_m")
    with pytest.raises(InputError, match=r"^test: key led\.radius_m was renamed: write led\.half_width_m$"):
        check(tomllib.loads(TABLE1), SceneSettings, "test")


BAD_OFFICE = [
    ("columns = 7\nrows = 7", "columns = 8\nrows = 7", r"panels\[0\].*not inside the room"),
    ("pitch_m = [1.0, 1.0]", "pitch_m = [0.5, 1.0]", r"panels\[0\]\.pitch_m: .*overlap"),
    ("pitch_m = [0.13, 0.13]", "pitch_m = [0.15, 0.13]", r"panels\[0\]\.leds: 5 columns .*the panel is 0\.6 m"),
    ("radius_m = 0.01", 'shape = "square"\nradius_m = 0.01', r"panels\[0\]\.leds\.radius_m: .*a square has side_m"),
    ("[4000.0, 16000.0]", "[16000.0, 4000.0]", r"put the lower value first"),
    ("columns = 7", "columns = 0", r"panels\[0\]\.columns = 0"),
    ("first_id = 0", "first_id = 2147483648", r"panels\[0\]\.leds\.first_id = 2147483648"),
    ("first_id = 0", "frist_id = 0", r"did you mean first_id"),
]


@pytest.mark.parametrize(("old", "new", "message"), BAD_OFFICE, ids=[row[1].replace("\n", " ") for row in BAD_OFFICE])
def test_a_bad_panel_is_refused_in_one_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert_refused(tmp_path, OFFICE, old, new, message)


GLAZING = {"wall": "x=0", "corner_m": [1.0, 1.0], "size_m": [1.0, 1.0], "luminance_cd_m2": 100.0}
BAD_ADDITIONS: list[tuple[dict[str, object], str]] = [
    ({"glazing": [{**GLAZING, "size_m": [7.0, 1.0]}]}, r"glazing\[0\]: .*does not fit"),
    (
        {"glazing": [GLAZING, {**GLAZING, "corner_m": [1.5, 1.5]}]},
        r"glazing\[1\]: overlaps another glazing in wall x=0",
    ),
    ({"glazing": [{**GLAZING, "wall": "north"}]}, r"glazing\[0\]\.wall = \"north\": .*'x=0'"),
    ({"glazing": [{**GLAZING, "refractive_index": 0.5}]}, r"refractive_index = 0\.5"),
    ({"furniture": [{"file": "nowhere.ply"}]}, r"furniture\[0\]\.file = 'nowhere.ply': no such file"),
    (
        {"furniture": [{"file": "../chair.ply"}]},
        r"furniture\[0\]\.file = '\.\./chair.ply': is outside the scene's folder",
    ),
    ({"furniture": [{"file": "/etc/chair.ply"}]}, r"file = '/etc/chair.ply': is outside the scene's folder"),
    ({"furniture": [{"file": "x" * 300 + ".ply"}]}, r"File name too long"),
    ({"furniture": [{"file": "\0.ply"}]}, r"is no path of a file"),
    ({"furniture": [{"file": "chair.blend"}]}, r"furniture\[0\]\.file = \"chair.blend\""),
    ({"bake": {"texel_m": 0.0}}, r"bake\.texel_m = 0\.0"),
    ({"bake": {"paths": 2}}, r"bake\.paths = 2"),
    ({"led": [{"id": 1, "position_m": [1, 1, 3], "radius_m": 0.01, "luminance_cd_m2": 1, "half_power_deg": 95}]}, "95"),
]


@pytest.mark.parametrize(("changes", "message"), BAD_ADDITIONS)
def test_impossible_glazing_furniture_and_bakes_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message) as refusal:
        build_scene(check({**tomllib.loads(TABLE1), **changes}, SceneSettings, "test"), "test")
    assert "\n" not in str(refusal.value)


def test_a_square_led_is_in_view_with_all_its_corners_only() -> None:
    """Half side 0.01 m at 3 m is 50 px, its corner 71 px from the centre; yaw of 45 deg turns it to the border."""
    led = {"id": 1, "position_m": [3.0, 3.0, 3.5], "luminance_cd_m2": 1e4}
    # the centre is 60 px inside the left border
    pose = Pose((3.0 + 1940 * 3 / 15000 * np.sqrt(0.5), 3.0 + 1940 * 3 / 15000 * np.sqrt(0.5), 0.5), yaw_deg=45.0)
    seen = {}
    for shape, size in (("disc", {"radius_m": 0.01}), ("square", {"side_m": 0.02})):
        tree = {**tomllib.loads(TABLE1), "led": [{**led, "shape": shape, **size}]}
        scene = build_scene(check(tree, SceneSettings, "test"), "test")
        seen[shape] = len(leds_in_view(PosedCamera(Camera(), pose), scene))
    assert seen == {"disc": 1, "square": 0}


def test_half_widths_are_radii_of_discs_and_half_sides_of_squares() -> None:
    """A disc of 0.01 m radius has pi 1e-4 m2, a square of 0.02 m has 4e-4 m2; its corner is sqrt(2) 0.01 m away."""
    base = tomllib.loads(TABLE1)["led"]
    square = {key: value for key, value in base[1].items() if key != "radius_m"} | {"shape": "square", "side_m": 0.02}
    tree = {**tomllib.loads(TABLE1), "led": [base[0], square]}
    leds = build_scene(check(tree, SceneSettings, "test"), "test").leds
    assert leds.half_widths_m.tolist() == [0.01, 0.01]
    assert leds.areas_m2 == pytest.approx([np.pi * 1e-4, 4e-4])
    assert leds.circumradii_m == pytest.approx([0.01, np.sqrt(2) * 0.01])


def test_a_room_without_leds_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "dark.toml"
    path.write_text(TABLE1[: TABLE1.index("[[led]]")])
    with pytest.raises(InputError, match="has no LED"):
        load_scene(path)


@pytest.mark.slow
@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_damaged_scene_file_gives_a_scene_or_one_line(tmp_path: Path, data: st.DataObject) -> None:
    """Cut, overwrite or splice the file anywhere."""
    raw = TABLE1.encode()
    start = data.draw(st.integers(0, len(raw)))
    stop = data.draw(st.integers(start, min(len(raw), start + 40)))
    filling = data.draw(
        st.one_of(st.binary(max_size=8), st.sampled_from([b"-", b"1e999", b"[[", b"nan", b"{}", b"''"]))
    )
    path = tmp_path / "fuzzed.toml"
    path.write_bytes(raw[:start] + filling + raw[stop:])
    try:
        outcome = f"{len(load_scene(path).leds)} LEDs"
    except InputError as refusal:
        outcome = str(refusal)
    assert "\n" not in outcome


def test_the_shipped_files_are_toml_with_units_in_their_keys() -> None:
    assert tomllib.loads(OFFICE)["room"]["size_m"] == [7.0, 7.0, 3.5]


@pytest.mark.parametrize("path", sorted((ROOT / "scenes").glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_scene_loads(path: Path) -> None:
    scene = load_scene(path)
    assert len(scene.leds) == len(scene.leds.diffusers)
    assert all(0 < surface.reflectance < 1 for surface in scene.surfaces)


def models_in(annotation: object) -> set[type[BaseModel]]:
    """All models in an annotation, those of their own keys included."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation}.union(*(models_in(field.annotation) for field in annotation.model_fields.values()))
    return set().union(*(models_in(argument) for argument in get_args(annotation)))


@pytest.mark.parametrize("model", sorted(models_in(SceneSettings), key=lambda model: model.__name__))
def test_every_key_of_a_scene_is_described(model: type[BaseModel]) -> None:
    assert {name for name, field in model.model_fields.items() if not field.description} == set()


def test_leds_in_descending_order_of_id_keep_their_own_values() -> None:
    """[[led]] and panels in any order: each LED is as its entry says."""
    tree = tomllib.loads(TABLE1)
    led = {"radius_m": 0.01, "luminance_cd_m2": 5000.0}
    square = {"shape": "square", "side_m": 0.05, "luminance_cd_m2": 7000.0, "half_power_deg": 30.0}
    panel = {**{"columns": 1, "rows": 1, "first_center_m": [3.0, 3.0, 3.4], "pitch_m": [1.0, 1.0]}, "reflectance": 0.7}
    array = {"columns": 1, "rows": 1, "pitch_m": [0.1, 0.1], "radius_m": 0.02, "first_id": 4, "half_power_deg": 45.0}
    diffuse = {**panel, "size_m": [0.6, 0.6, 0.1], "diffuser": {"distance_m": 0.07, "transmittance": 0.5}}
    diffuse["leds"] = {**array, "luminance_cd_m2": [6000.0, 6000.0]}
    entries = [{"id": 9, "position_m": [1.0, 1.0, 3.5], **led}, {"id": 2, "position_m": [2.0, 1.0, 3.5], **square}]
    scene = build_scene(check({**tree, "led": entries, "panels": [diffuse]}, SceneSettings, "test"), "test")
    leds = scene.leds
    assert leds.ids.tolist() == [2, 4, 9]
    assert leds.centers_m[:, 0].tolist() == [2.0, 3.0, 1.0]
    assert leds.half_widths_m.tolist() == [0.025, 0.02, 0.01]
    assert leds.luminances_cd_m2.tolist() == [7000.0, 6000.0, 5000.0]
    assert leds.squares.tolist() == [True, False, False]
    # I = I_0 cos^m is I_0 / 2 at the half-power angle
    assert np.cos(np.radians([30.0, 45.0, 60.0])) ** leds.orders == pytest.approx([0.5] * 3)
    (first, behind, last) = leds.diffusers
    assert (first, last) == (None, None)
    assert behind is not None
    assert behind.foot_m == (3.0, 3.0)
    assert (behind.distance_m, behind.order) == (0.07, leds.orders[1])
    assert behind.area_m2 == pytest.approx(np.pi * 0.02**2)


def test_every_pair_of_leds_that_overlap_is_looked_at() -> None:
    """LEDs of very different sizes at random places, against all pairs."""
    rng, count = np.random.default_rng(3), 1300
    centers = rng.uniform(0, (30.0, 20.0, 0.2), (count, 3))
    half_widths = np.where(rng.uniform(size=count) < 0.02, 0.8, 0.05)
    even = {"face_gradients": np.zeros((count, 2)), "face_falloffs": np.ones(count)}
    leds = Leds(
        np.arange(count),
        centers,
        half_widths,
        np.ones(count),
        np.ones(count),
        np.zeros(count, bool),
        (None,) * count,
        **even,
    )
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)
    overlap = np.argwhere(np.triu(apart < half_widths[:, None] + half_widths, 1))
    found = [(int(i), int(j)) for one, other in _neighbours(leds) for i, j in zip(one, other, strict=True)]
    assert len(overlap) > 100
    assert set(map(tuple, overlap.tolist())) <= set(found)
    assert len(set(found)) == len(found) < count**2 / 8
