"""Reader of the dataset format: valid files are read, invalid ones refused in one line."""

import contextlib
import copy
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from estimator_synthetic import FRAMES_SCHEMA
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from estimator.errors import InputError
from estimator.io.dataset import FrameRecord, read_dataset, read_frame

Rows = list[dict[str, Any]]


@pytest.fixture(scope="module")
def good(synthetic_set: Path) -> Path:
    return synthetic_set


@pytest.fixture
def folder(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "copy"))


def refused(folder: Path) -> str:
    """Message of the error when the dataset is read."""
    with pytest.raises(InputError) as caught:
        read_dataset(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def read_or_refuse(folder: Path) -> None:
    """Any exception but InputError fails the test that calls this."""
    with contextlib.suppress(InputError):
        read_dataset(folder)


def change_json(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads((folder / "dataset.json").read_text())
    change(content)
    (folder / "dataset.json").write_text(json.dumps(content))


def change_rows(folder: Path, change: Callable[[Rows], object], schema: pa.Schema = FRAMES_SCHEMA) -> None:
    rows: Rows = pq.read_table(folder / "frames.parquet").to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows, schema), folder / "frames.parquet")


def test_a_good_dataset_is_read_as_written(good: Path) -> None:
    dataset = read_dataset(good)
    assert (len(dataset.frames), len(dataset.leds), min(dataset.leds)) == (3, 20, 10)
    frame = read_frame(dataset, dataset.frames[1])
    with OpenEXR.File(str(good / "frames/000001.exr")) as file:
        (part,) = frame.parts
        np.testing.assert_array_equal(part.image_dn, file.channels()["Y"].pixels)
    np.testing.assert_array_equal(frame.camera.matrix(), [[1500, 0, 200], [0, 1500, 150], [0, 0, 1]])
    assert frame.accelerometer_m_s2 == pytest.approx((9.80665 * np.sin(np.radians(20)), 4.6076, 7.9806), abs=1e-4)


def test_electrons_undo_the_black_level_and_the_gain(folder: Path) -> None:
    change_json(folder, lambda c: c["sensor"].update(gain_e_per_dn=2.5, black_level_dn=16))
    dataset = read_dataset(folder)
    frame = read_frame(dataset, dataset.frames[0])
    (part,) = frame.parts
    np.testing.assert_allclose(frame.electrons(part), (part.image_dn.astype(float) - 16) * 2.5)


def test_a_full_pixel_is_clipped_at_the_full_well_or_at_the_last_number(folder: Path) -> None:
    change_json(folder, lambda c: c["sensor"].update(full_well_e=4000, gain_e_per_dn=2, black_level_dn=10))
    dataset = read_dataset(folder)
    assert dataset.sensor.saturation_dn() == 2010
    frame = read_frame(dataset, dataset.frames[0])
    (part,) = frame.parts
    np.testing.assert_array_equal(frame.clipped(part), part.image_dn >= 2010)
    change_json(folder, lambda c: c["sensor"].update(bits=10))
    assert read_dataset(folder).sensor.saturation_dn() == 1023


def test_provenance_is_not_needed_and_not_kept(folder: Path) -> None:
    change_json(folder, lambda c: c.pop("provenance"))
    assert "seed" not in repr(read_dataset(folder))


def test_only_the_scorer_and_its_tables_know_of_the_truth() -> None:
    package = Path(__file__).parent.parent / "estimator"
    assert {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if "truth.parquet" in re.sub(r'""".*?"""', "", path.read_text(), flags=re.S)
    } == {"evaluate/score.py", "evaluate/sources.py", "evaluate/frame_columns.py", "io/withheld.py"}


JSON_KEYS = [
    *("format", "version", "name", "frame_count", "cameras", "sensor", "accelerometer", "led_map", "room_m"),
    *("gyroscope", "downlink"),
]


@pytest.mark.parametrize("key", JSON_KEYS)
def test_a_missing_key_is_named(folder: Path, key: str) -> None:
    change_json(folder, lambda c: c.pop(key))
    assert f"dataset.json: {key}" in refused(folder)


@pytest.mark.parametrize(
    ("key", "place"),
    [
        ("luminaires", lambda c: c),
        ("map_datum", lambda c: c),
        ("cameras.main.uncertainty", lambda c: c["cameras"]["main"]),
        ("cameras.main.shutter", lambda c: c["cameras"]["main"]),
        ("sensor.crosstalk", lambda c: c["sensor"]),
        ("accelerometer.device_error_deg", lambda c: c["accelerometer"]),
        ("led_map.3.radius_sigma_m", lambda c: c["led_map"][3]),
        ("led_map.3.luminaire", lambda c: c["led_map"][3]),
    ],
)
def test_what_a_device_does_not_state_is_null_and_not_missing(
    folder: Path, key: str, place: Callable[[dict[str, Any]], dict[str, Any]]
) -> None:
    """Keys that `estimator.frame` may lack; every key of dataset.json is always present."""
    change_json(folder, lambda c: place(c).pop(key.rpartition(".")[2]))
    assert refused(folder).endswith(f"dataset.json: {key}: Field required")


CODES: dict[str, Any] = {
    **{"send": "code", "chip_us": 25.0, "depth": 1.0, "clock_error": 1e-4},
    **{"leds": [10, 11], "codes": ["0011", "0101"]},
}
TONES: dict[str, Any] = {
    **{"send": "tone", "duty": 0.5, "depth": 1.0, "clock_error": 0.0},
    **{"leds": [12, 13], "frequencies_hz": [1500.0, 1500.0]},
}
PACKETS: dict[str, Any] = {
    **{"send": "packet", "chip_us": 50.0, "depth": 0.5, "clock_error": 1e-4, "preamble": "00011011000111"},
    **{"polynomial": 15717, "coordinate_bits": 13, "coordinate_unit_m": 0.001},
    **{"delays_chips": [5, 0], "offsets_m": [[-0.07, 0.0], [0.07, 0.0]], "led": {"shape": "disc", "radius_m": 0.01}},
}


def sending(*transmitters: dict[str, Any], demodulation: str = "given") -> dict[str, Any]:
    return {"demodulation": demodulation, "transmitters": copy.deepcopy(list(transmitters))}


def rolling(content: dict[str, Any], **changes: Any) -> None:
    shutter = {"kind": "rolling", "row_time_us": 10.0, "direction": "down", **changes}
    content["cameras"]["main"]["shutter"] = {key: value for key, value in shutter.items() if value is not None}


def without(entry: dict[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in entry.items() if name != key}


LENS = {"k1": -0.05, "k2": 0.0, "k3": 0.0, "p1": 0.0, "p2": 0.0}
WRONG_VALUES: list[tuple[str, Callable[[dict[str, Any]], object]]] = [
    ("version", lambda c: c.update(version=1)),
    ("format", lambda c: c.update(format="other")),
    ("frame_count", lambda c: c.update(frame_count="3")),
    ("frame_count", lambda c: c.update(frame_count=4)),
    ("cameras.main.width_px", lambda c: c["cameras"]["main"].update(width_px=400.5)),
    ("cameras.main.width_px", lambda c: c["cameras"]["main"].update(width_px=10**9)),
    ("cameras.main.K", lambda c: c["cameras"]["main"].update(K=[[1, 0, 0], [0, 1, 0]])),
    ("cameras.main.K", lambda c: c["cameras"]["main"].update(K=[[1, 0, 0], [0, 0, 0], [0, 0, 1]])),
    ("cameras.main.K", lambda c: c["cameras"]["main"]["K"][1].__setitem__(0, 1)),
    ("cameras.main.K.0.2", lambda c: c["cameras"]["main"]["K"][0].__setitem__(2, float("nan"))),
    ("cameras.main.projection", lambda c: c["cameras"]["main"].update(projection="stereographic")),
    ("cameras.main.projection", lambda c: c["cameras"]["main"].pop("projection")),
    ("cameras.main.distortion", lambda c: c["cameras"]["main"].pop("distortion")),
    ("cameras.main.distortion.k3", lambda c: c["cameras"]["main"].update(distortion={**LENS, "k3": None})),
    (
        "cameras.main.distortion.p2",
        lambda c: c["cameras"]["main"].update(distortion={"k1": 0, "k2": 0, "k3": 0, "p1": 0}),
    ),
    (
        "cameras.main.distortion: Value error, unknown key 'k4'; allowed: k1, k2, k3, p1, p2",
        lambda c: c["cameras"]["main"].update(distortion={**LENS, "k4": 0.1}),
    ),
    ("distortion", lambda c: c["cameras"]["main"].update(projection="equidistant", distortion=LENS)),
    ("cameras.main.image_distance_mm", lambda c: c["cameras"]["main"].update(image_distance_mm=0)),
    ("sensor.noise", lambda c: c["sensor"].update(noise="loud")),
    ("sensor.gain_e_per_dn", lambda c: c["sensor"].update(gain_e_per_dn=0)),
    ("sensor.bits", lambda c: c["sensor"].update(bits=33)),
    ("accelerometer.error_deg", lambda c: c["accelerometer"].update(error_deg=-1)),
    ("led_map", lambda c: c["led_map"].append(c["led_map"][0])),
    ("led_map.0.id", lambda c: c["led_map"][0].update(id=-1)),
    ("led_map.2.position_m", lambda c: c["led_map"][2].update(position_m=[1, 2])),
    ("led_map.0.radius_m", lambda c: c["led_map"][0].update(radius_m=float("inf"))),
    ("room_m", lambda c: c.update(room_m=[1, 2, -3])),
    ("cameras.main.shutter.kind", lambda c: c["cameras"]["main"].update(shutter={"kind": "leaf"})),
    ("cameras.main.shutter.row_time_us: Field required", lambda c: rolling(c, row_time_us=None)),
    ("cameras.main.shutter: Value error, row_time_us has to be more than 0", lambda c: rolling(c, row_time_us=0)),
    ("cameras.main.shutter.direction", lambda c: rolling(c, direction="diagonal")),
    ("gyroscope.bias_rad_s", lambda c: c.update(gyroscope={"noise_rad_s": 0.01, "bias_rad_s": -1.0})),
    ("downlink.demodulation", lambda c: c.update(downlink=sending(CODES, demodulation="guessed"))),
    ("downlink.transmitters", lambda c: c.update(downlink=sending())),
    ("downlink.transmitters.0", lambda c: c.update(downlink=sending({**CODES, "send": "morse"}))),
    ("downlink.transmitters.0.chip_us", lambda c: c.update(downlink=sending({**CODES, "chip_us": 0}))),
    ("downlink.transmitters.0.depth", lambda c: c.update(downlink=sending({**CODES, "depth": 1.5}))),
    ("downlink.transmitters.0.clock_error", lambda c: c.update(downlink=sending({**CODES, "clock_error": 0.1001}))),
    ("downlink.transmitters.0.codes", lambda c: c.update(downlink=sending(without(CODES, "codes")))),
    ("downlink.transmitters.0.codes.1", lambda c: c.update(downlink=sending({**CODES, "codes": ["01", "02"]}))),
    ("codes have to be of one length", lambda c: c.update(downlink=sending({**CODES, "codes": ["01", "011"]}))),
    ("a code needs chips of both kinds", lambda c: c.update(downlink=sending({**CODES, "codes": ["01", "11"]}))),
    ("codes: needed one for each of leds", lambda c: c.update(downlink=sending({**CODES, "codes": ["01"]}))),
    ("downlink: names LED 99, which is not in", lambda c: c.update(downlink=sending({**CODES, "leds": [10, 99]}))),
    ("an LED is in leds twice", lambda c: c.update(downlink=sending(CODES, {**TONES, "leds": [11, 12]}))),
    ("downlink.transmitters.0.duty", lambda c: c.update(downlink=sending({**TONES, "duty": 1.0}))),
    ("frequencies_hz: needed one", lambda c: c.update(downlink=sending({**TONES, "frequencies_hz": [1.5e3]}))),
    ("frequencies_hz.1", lambda c: c.update(downlink=sending({**TONES, "frequencies_hz": [1500.0, 0.0]}))),
    ("transmitters.0.polynomial", lambda c: c.update(downlink=sending({**PACKETS, "polynomial": 65536}))),
    ("transmitters.0.preamble", lambda c: c.update(downlink=sending({**PACKETS, "preamble": "0012"}))),
    ("transmitters.0.coordinate_bits", lambda c: c.update(downlink=sending({**PACKETS, "coordinate_bits": 17}))),
    ("transmitters.0.delays_chips.0", lambda c: c.update(downlink=sending({**PACKETS, "delays_chips": [-5, 0]}))),
    ("offsets_m: needed one for each", lambda c: c.update(downlink=sending({**PACKETS, "offsets_m": [[0, 0]]}))),
    ("transmitters.0.led.radius_m", lambda c: c.update(downlink=sending({**PACKETS, "led": {"shape": "disc"}}))),
    ("led_map: null needs a downlink", lambda c: c.update(led_map=None)),
    ("led_map: null needs a downlink", lambda c: c.update(led_map=None, downlink=sending(PACKETS))),
    (
        "names LED 10, but led_map is null",
        lambda c: c.update(led_map=None, downlink=sending(CODES, PACKETS, demodulation="pixels")),
    ),
]


@pytest.mark.parametrize(("key", "change"), WRONG_VALUES, ids=[f"{i}-{k}" for i, (k, _) in enumerate(WRONG_VALUES)])
def test_a_wrong_value_is_named(folder: Path, key: str, change: Callable[[dict[str, Any]], object]) -> None:
    change_json(folder, change)
    message = refused(folder)
    assert str(folder) in message
    assert key in message


@pytest.mark.slow
def test_all_wrong_types_everywhere_in_the_json_are_input_errors(folder: Path) -> None:
    """Each value of the document replaced by each of a few others: read or refused, never another exception."""
    original = json.loads((folder / "dataset.json").read_text())
    rolling(original)
    original.update(
        gyroscope={"noise_rad_s": 0.01, "bias_rad_s": 0.02},
        downlink=sending(CODES, TONES, PACKETS),
        led_map=original["led_map"][:5],
    )
    places: list[tuple[Any, ...]] = []

    def walk(node: Any, path: tuple[Any, ...]) -> None:
        places.append(path)
        for key, value in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
            if path != ("led_map",) or key == 0:
                walk(value, (*path, key))

    walk(original, ())
    for path in places:
        for value in (None, "x", -1, 10**400, 1e308, 1e-320, [], {}, True):
            content = copy.deepcopy(original)
            if path:
                node = content
                for key in path[:-1]:
                    node = node[key]
                node[path[-1]] = value
            else:
                content = value
            (folder / "dataset.json").write_text(json.dumps(content))
            read_or_refuse(folder)


WRONG_ROWS: list[tuple[str, Callable[[Rows], object]]] = [
    ("row 1", lambda rows: rows[1].update(frame=2)),
    ("3 rows", lambda rows: rows.append({**rows[0], "frame": 3})),
    ("shot 2; shots have to be 0, 1, 2", lambda rows: rows[1].update(shot=2)),
    ("camera 'other'", lambda rows: rows[0].update(camera="other")),
    ("2.sha256", lambda rows: rows[2].update(sha256="0123")),
    ("0.exposure_s", lambda rows: rows[0].update(exposure_s=0.0)),
    ("0.accelerometer_m_s2", lambda rows: rows[0].update(accelerometer_m_s2=[0.0, float("nan"), 9.8])),
    ("accelerometer_m_s2 is null, but accelerometer is given", lambda rows: rows[0].update(accelerometer_m_s2=None)),
    ("0.spots.0.u_px", lambda rows: rows[0]["spots"][0].update(u_px=float("inf"))),
    ("0.spots.0.led", lambda rows: rows[0]["spots"][0].update(led=None)),
    ("LED 99", lambda rows: rows[0]["spots"][0].update(led=99)),
    ("twice", lambda rows: rows[0]["spots"][0].update(led=rows[0]["spots"][1]["led"])),
    ("0.file", lambda rows: rows[0].update(file="../frames/000000.exr")),
    ("0.file", lambda rows: rows[0].update(file="/etc/passwd")),
    ("0.file", lambda rows: rows[0].update(file=None)),
    ("burst 3", lambda rows: rows[1].update(burst=3)),
    ("its shot 1 is of burst 1", lambda rows: rows[2].update(shot=1)),
    ("burst 0 is of device 0", lambda rows: rows[1].update(burst=0, device=1)),
    ("start_s 0.0; has to be later", lambda rows: rows[1].update(burst=0)),
    ("0.start_s", lambda rows: rows[0].update(start_s=float("nan"))),
    ("0.gyro_rad_s", lambda rows: rows[0].update(gyro_rad_s=[0.0, 0.0, float("inf")])),
    ("gyro_rad_s is given, but gyroscope is null", lambda rows: rows[0].update(gyro_rad_s=[0.0, 0.0, 0.1])),
]


@pytest.mark.parametrize(("words", "change"), WRONG_ROWS, ids=[f"{i}-{w}" for i, (w, _) in enumerate(WRONG_ROWS)])
def test_a_wrong_row_is_named(folder: Path, words: str, change: Callable[[Rows], object]) -> None:
    if words == "3 rows":
        change_json(folder, lambda c: c.update(frame_count=3))
        words = "4 rows"
    change_rows(folder, change)
    message = refused(folder)
    assert "frames.parquet" in message
    assert words in message


def test_a_missing_or_retyped_column_is_named(folder: Path) -> None:
    table = pq.read_table(folder / "frames.parquet")
    for column in ("exposure_s", "device", "burst", "start_s", "gyro_rad_s"):
        pq.write_table(table.drop_columns([column]), folder / "frames.parquet")
        assert f"column '{column}'" in refused(folder)
    numbers = table.set_column(0, "frame", table["frame"].cast(pa.string()))
    pq.write_table(numbers, folder / "frames.parquet")
    assert "column 'frame' has type string, needed int64" in refused(folder)


def test_what_the_leds_send_is_read_as_written(folder: Path) -> None:
    """Every field of a downlink, the readings of a gyroscope, and two bursts of which the first has two shots."""
    pixels = sending(CODES, TONES, PACKETS, demodulation="pixels")

    def modulated(content: dict[str, Any]) -> None:
        rolling(content, direction="left", row_time_us=12.5)
        content.update(gyroscope={"noise_rad_s": 0.01, "bias_rad_s": 0.02}, downlink=pixels)

    change_json(folder, modulated)
    message = refused(folder)
    assert "frame 0: 20 spots, but they have to be empty" in message
    times = [(0, 1.5), (0, 1.75), (1, 0.25)]
    change_rows(
        folder,
        lambda rows: [
            row.update(spots=[], burst=burst, start_s=start_s, gyro_rad_s=[0.1, 0.2, float(burst)])
            for row, (burst, start_s) in zip(rows, times, strict=True)
        ],
    )
    frame = read_frame(read_dataset(folder), 1)
    assert (frame.burst, frame.start_s, frame.gyro_rad_s) == (0, 1.75, (0.1, 0.2, 0.0))
    assert frame.gyroscope is not None
    assert frame.downlink is not None
    assert (frame.gyroscope.noise_rad_s, frame.gyroscope.bias_rad_s) == (0.01, 0.02)
    # Through JSON, in which arrays are lists.
    assert json.loads(frame.downlink.model_dump_json()) == pixels
    assert frame.camera.shutter.model_dump() == {"kind": "rolling", "row_time_us": 12.5, "direction": "left"}


def test_a_map_may_be_left_to_the_packets(folder: Path) -> None:
    downlink = sending(PACKETS, demodulation="pixels")
    change_json(folder, lambda c: c.update(led_map=None, downlink=downlink))
    change_rows(folder, lambda rows: [row.update(spots=[]) for row in rows])
    assert read_frame(read_dataset(folder), 0).leds == {}


def test_lists_of_any_length_type_are_read(folder: Path) -> None:
    """The synthetic writer uses fixed-size lists; plain and large ones hold the same."""
    for maker in (pa.list_, pa.large_list):
        at = FRAMES_SCHEMA.get_field_index("accelerometer_m_s2")
        schema = FRAMES_SCHEMA.set(at, pa.field("accelerometer_m_s2", maker(pa.float64())))
        change_rows(folder, lambda rows: None, schema)
        assert len(read_dataset(folder).frames) == 3


def test_missing_parts_are_named(folder: Path, tmp_path: Path) -> None:
    assert refused(tmp_path / "nowhere").endswith("nowhere: no such folder")
    (folder / "frames.parquet").unlink()
    assert refused(folder).endswith("frames.parquet: no such file")
    (folder / "dataset.json").unlink()
    assert "not a dataset" in refused(folder)


@pytest.mark.parametrize("file", ["dataset.json", "frames.parquet"])
@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_damaged_bytes_are_read_or_refused(good: Path, tmp_path: Path, file: str, data: st.DataObject) -> None:
    folder = Path(shutil.copytree(good, tmp_path / "damaged", dirs_exist_ok=True))
    content = bytearray((good / file).read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
        (folder / file).write_bytes(content)
        refused(folder)
    else:
        for _ in range(data.draw(st.integers(1, 3))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        (folder / file).write_bytes(content)
        read_or_refuse(folder)


def test_records_are_unchangeable(good: Path) -> None:
    record: FrameRecord = read_dataset(good).frames[0]
    with pytest.raises(ValueError, match="frozen"):
        record.frame = 7  # type: ignore[misc]


def test_another_version_is_refused_in_one_line_that_names_4(folder: Path) -> None:
    for version in (3, 5):
        change_json(folder, lambda c, version=version: c.update(version=version, led_map=None))
        with pytest.raises(InputError, match=f"version {version} of the format, needed 4$"):
            read_dataset(folder)


def test_a_dataset_may_be_empty(folder: Path) -> None:
    change_json(folder, lambda c: c.update(frame_count=0))
    change_rows(folder, lambda rows: rows.clear())
    assert read_dataset(folder).frames == ()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_leds_lie_within_1000_km_of_the_origin(folder: Path, axis: int) -> None:
    """So that the range from any position of an estimate to any LED can be written: both are far below 1e100 m."""
    for metres, good in ((1e6, True), (-1e6, True), (1.01e6, False), (-1.01e6, False)):
        change_json(folder, lambda c, metres=metres: c["led_map"][0]["position_m"].__setitem__(axis, metres))
        if good:
            assert read_dataset(folder).leds[10].position_m[axis] == metres
        else:
            assert f"led_map.0.position_m.{axis}: Input should be" in refused(folder)


@pytest.mark.parametrize(("length", "shown"), [(58, "x" * 58 + "'"), (59, "x" * 56 + "...")])
def test_a_message_quotes_at_most_60_characters_of_a_value(folder: Path, length: int, shown: str) -> None:
    """58 characters and two quotation marks are 60: shown whole. Of longer ones, 57 characters and three dots."""
    change_json(folder, lambda c: c.update(frame_count="x" * length))
    assert refused(folder).endswith(f"(got '{shown})")
