"""Checks of FORMAT.md: verify and the reader, which share no code, come to the same verdict of a dataset."""

import json
import os
import random
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pandas as pd
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import sealed

from estimator.errors import InputError as ReaderError
from estimator.io.dataset import read_dataset, read_frame
from estimator.io.truth import read_truth
from vlcrender.core.digest import sha256_of
from vlcrender.dataset.verify.verify import verify
from vlcrender.errors import InputError

Tree = dict[str, Any]
TABLES = ("frames.parquet", "truth.parquet")


@pytest.fixture(scope="module")
def good(rendered_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first two frames of the rendered set, with uncertain luminaires and codes stated, and without a recipe.

    The checks of values are those that need no recipe.
    """
    folder = tmp_path_factory.mktemp("checks") / "set"
    shutil.copytree(rendered_set, folder)
    for name in TABLES:
        pq.write_table(pq.read_table(folder / name).slice(0, 2), folder / name)

    def change(tree: Tree) -> None:
        tree["frame_count"] = 2
        del tree["provenance"]["recipe"]
        ids = [led["id"] for led in tree["led_map"][:2]]
        one = {"send": "code", "chip_us": 25.0, "depth": 1.0, "clock_error": 1e-4, "leds": ids, "codes": ["01", "10"]}
        tree["downlink"] = {"demodulation": "given", "transmitters": [one]}
        sigmas = {"sigma_m": [0.0] * 3, "sigma_rotation_deg": [0.0] * 3}
        tree["luminaires"] = [{"id": 0, "position_m": [0.0] * 3, **sigmas}]
        tree["led_map"][0].update(luminaire=0, sigma_m=[0.0] * 3, radius_sigma_m=0.0, gradient_sigma=0.0)
        tree["map_datum"] = {"sigma_m": [0.0] * 3, "scale_sigma_ppm": 0.0}

    change_json(folder, change)
    return folder


def change_json(folder: Path, change: Callable[[Tree], object]) -> None:
    tree = json.loads((folder / "dataset.json").read_text())
    change(tree)
    (folder / "dataset.json").write_text(json.dumps(tree))


def change_row(folder: Path, name: str, change: Callable[[Tree], object], row: int = 1) -> None:
    table = pq.read_table(folder / name)
    rows = table.to_pylist()
    change(rows[row])
    pq.write_table(pa.Table.from_pylist(rows, table.schema), folder / name)


def change_image(folder: Path, header: Tree, channels: dict[str, Any]) -> None:
    """Another EXR file of frame 1, and its digest in the table."""
    camera = json.loads((folder / "dataset.json").read_text())["cameras"]["main"]
    sensor = (np.zeros(2, np.int32), np.array([camera["width_px"] - 1, camera["height_px"] - 1], np.int32))
    header = {"type": OpenEXR.scanlineimage, "displayWindow": sensor, "dataWindow": sensor, **header}
    path = folder / "frames/000001.exr"
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
    change_row(folder, "frames.parquet", lambda row: row.update(sha256=sha256_of(path)))


def verdict_of_verify(folder: Path) -> str | None:
    """The first problem, None for a valid dataset; with a new seal, since the files were changed on purpose."""
    try:
        with suppress(InputError, ValueError):  # of a dataset.json that cannot be read, or written as JSON
            sealed(folder)
        return next(iter(verify(folder)), None)
    except InputError as error:
        return str(error)


def verdict_of_reader(folder: Path) -> str | None:
    """The same of the reader, which reads the images and, as the scorer does, the truth."""
    try:
        dataset = read_dataset(folder)
        read_truth(folder / "truth.parquet", len(dataset.frames))
        for record in dataset.frames:
            read_frame(dataset, record)
    except ReaderError as error:
        return str(error)
    return None


def test_the_set_is_valid_before_it_is_damaged(good: Path) -> None:
    assert (verdict_of_verify(good), verdict_of_reader(good)) == (None, None)


def at(*path: str | int, value: object) -> Callable[[Path], None]:
    """Damage: another value at a place of dataset.json."""

    def damage(folder: Path) -> None:
        change_json(folder, lambda tree: put(tree, path, value))

    return damage


def put(tree: Any, path: tuple[str | int, ...], value: object) -> None:
    for key in path[:-1]:
        tree = tree[key]
    tree[path[-1]] = value


def cell(table: str, value: object, *path: str | int) -> Callable[[Path], None]:
    """Damage: another value in the second row of a table."""
    return lambda folder: change_row(folder, f"{table}.parquet", lambda row: put(row, path, value))


def image(header: Tree | None = None, **channels: Any) -> Callable[[Path], None]:
    return lambda folder: change_image(folder, header or {}, channels)


def retyped(name: str, column: str, kind: pa.DataType) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        table = pq.read_table(folder / name)
        place = table.schema.get_field_index(column)
        pq.write_table(table.set_column(place, column, table[column].cast(kind)), folder / name)

    return damage


def without(name: str, column: str) -> Callable[[Path], None]:
    return lambda folder: pq.write_table(pq.read_table(folder / name).drop_columns([column]), folder / name)


MAIN = ("cameras", "main")
DARK = np.zeros((300, 400), np.uint32)
TURNED = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
"""Orthonormal, determinant -1."""
LENS = {"k1": 0.0, "k2": 0.0, "k3": 0.0, "p1": 0.0, "p2": 0.0}
SMALL_BOX = (np.zeros(2, np.int32), np.array([399, 300], np.int32))
FLAT = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]

DAMAGES: list[tuple[int, str, Callable[[Path], None]]] = [
    (1, "text for a number", at("frame_count", value="2")),
    (1, "truth for a number", at("sensor", "bits", value=True)),
    (1, "unknown key of a camera", at(*MAIN, "zoom", value=1.0)),
    (1, "unknown key of the sensor", at("sensor", "offset_dn", value=1.0)),
    (1, "unknown key of an LED", at("led_map", 0, "colour", value="red")),
    (1, "unknown distortion key", at(*MAIN, "distortion", value={**LENS, "k4": 0.1})),
    (1, "side of a disc", at("led_map", 0, "side_m", value=0.02)),
    (1, "key of a rolling shutter", at(*MAIN, "shutter", value={"kind": "global", "row_time_us": 1.0})),
    (2, "no exposures", without("frames.parquet", "exposure_s")),
    (2, "no tilts", without("truth.parquet", "tilt_x_deg")),
    (2, "frames as texts", retyped("frames.parquet", "frame", pa.string())),
    (2, "half frames", lambda folder: halve(folder)),
    (2, "exposures as texts", retyped("frames.parquet", "exposure_s", pa.string())),
    (3, "NaN reading", cell("frames", float("nan"), "accelerometer_m_s2", 0)),
    (3, "infinite position", cell("truth", float("inf"), "position_m", 1)),
    (3, "position beyond 1e100", cell("truth", 1e101, "position_m", 1)),
    (3, "infinity in JSON", at("led_map", 3, "position_m", 0, value=float("inf"))),
    (3, "negative device", cell("frames", -1, "device")),
    (4, "seven pixels", at(*MAIN, "width_px", value=7)),
    (4, "lower triangle of K", at(*MAIN, "K", 1, 0, value=1.0)),
    (4, "image distance", at(*MAIN, "image_distance_mm", value=19.0)),
    (4, "no f-number", at(*MAIN, "f_number", value=0.0)),
    (4, "distortion of a fish-eye", lambda folder: bend_a_fish_eye(folder)),
    (4, "kernel without its psf", at(*MAIN, "psf_kernel", value=[[1.0]])),
    (4, "negative deviation", at(*MAIN, "uncertainty", "shot_sigma", 0, value=-1.0)),
    (4, "row time of 0", at(*MAIN, "shutter", value={"kind": "rolling", "row_time_us": 0.0, "direction": "down"})),
    (5, "mirrored mounting", at(*MAIN, "R_cam_rig", value=TURNED)),
    (5, "stretched mounting", at(*MAIN, "R_cam_rig", 2, 2, value=1 + 1e-8)),
    (5, "stretched pose", lambda folder: change_row(folder, "truth.parquet", stretch)),
    (5, "pose of zeros", cell("truth", [0.0] * 9, "R_cam_world")),
    (6, "no bits", at("sensor", "bits", value=0)),
    (6, "33 bits", at("sensor", "bits", value=33)),
    (6, "gain of 0", at("sensor", "gain_e_per_dn", value=0.0)),
    (6, "full well of 1e-320", at("sensor", "full_well_e", value=1e-320)),
    (6, "full well of infinity", at("sensor", "full_well_e", value=float("inf"))),
    (6, "full well of NaN", at("sensor", "full_well_e", value=float("nan"))),
    (6, "negative noise", at("sensor", "read_noise_e", value=-1.0)),
    (6, "hot pixels", at("sensor", "hot_pixel_share", value=1.5)),
    (6, "mosaic x", at("sensor", "mosaic", value="x")),
    (6, "noise x", at("sensor", "noise", value="x")),
    (6, "black above the last code", at("sensor", "black_level_dn", value=2**20)),
    (6, "black between codes", at("sensor", "black_level_dn", value=0.5)),
    (7, "negative tilt error", at("accelerometer", "error_deg", value=-0.1)),
    (7, "tilt error of 200 deg", at("accelerometer", "error_deg", value=200.0)),
    (7, "negative scale", at("map_datum", "scale_sigma_ppm", value=-1.0)),
    (8, "id twice", lambda folder: change_json(folder, lambda t: t["led_map"].append(t["led_map"][0]))),
    (8, "LED without a size", at("led_map", 0, "radius_m", value=0.0)),
    (8, "LED of a kilometre", at("led_map", 0, "radius_m", value=1001.0)),
    (8, "LED out of the world", at("led_map", 0, "position_m", 2, value=1.1e6)),
    (8, "flat room", at("room_m", 2, value=0.0)),
    (9, "luminaire twice", lambda folder: change_json(folder, lambda t: t["luminaires"].append(t["luminaires"][0]))),
    (9, "unknown luminaire", at("led_map", 0, "luminaire", value=7)),
    (10, "code of one kind", at("downlink", "transmitters", 0, "codes", 0, value="11")),
    (10, "unknown LED sends", at("downlink", "transmitters", 0, "leds", 0, value=10**6)),
    (10, "nothing sent", at("downlink", "transmitters", value=[])),
    (10, "no map and no packets", at("led_map", value=None)),
    (11, "one row more", at("frame_count", value=1)),
    (11, "frames out of order", cell("frames", 3, "frame")),
    (11, "shot skipped", cell("frames", 2, "shot")),
    (11, "shot of two bursts", cell("frames", 0, "shot")),
    (11, "no exposure", cell("frames", 0.0, "exposure_s")),
    (11, "unknown camera", cell("frames", "left", "camera")),
    (11, "path out of the set", cell("frames", "../frames/000001.exr", "file")),
    (11, "LED decoded twice", lambda folder: change_row(folder, "frames.parquet", decode_twice)),
    (11, "unknown LED decoded", cell("frames", 10**6, "spots", 0, "led")),
    (11, "reading of no gyroscope", cell("frames", [0.0, 0.0, 0.0], "gyro_rad_s")),
    (11, "no digest", cell("frames", "", "sha256")),
    (12, "truth out of order", cell("truth", 5, "frame")),
    (12, "tilt of 400 deg", cell("truth", 400.0, "tilt_x_deg")),
    (12, "share above 1", cell("truth", 1.1, "leds", 0, "visible_fraction")),
    (12, "negative share", cell("truth", -0.1, "leds", 0, "visible_fraction")),
    (12, "bound of no matrix", cell("truth", [-x for x in FLAT], "bound_m2")),
    (13, "tiles", image({"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}, Y=DARK)),
    (13, "two channels", image(Y=DARK, Z=DARK)),
    (13, "another channel", image(X=DARK)),
    (13, "float pixels", image(Y=DARK.astype(np.float32))),
    (13, "half pixels", image(Y=DARK.astype(np.float16))),
    (13, "window beyond the sensor", image({"dataWindow": SMALL_BOX}, Y=np.zeros((301, 400), np.uint32))),
    (13, "another sensor", image({"displayWindow": SMALL_BOX}, Y=DARK)),
    (13, "not capturable, but on the sensor", cell("frames", False, "capturable")),
    (13, "other bytes", lambda folder: change_bytes(folder)),
    (14, "numbers beyond the bits", image(Y=DARK + np.uint32(2**31))),
]


def bend_a_fish_eye(folder: Path) -> None:
    at(*MAIN, "projection", value="equidistant")(folder)
    at(*MAIN, "distortion", value=LENS)(folder)


def change_bytes(folder: Path) -> None:
    (folder / "frames/000001.exr").write_bytes(b"no EXR")


def halve(folder: Path) -> None:
    """Frames 0, 0.5, ... as reals."""
    table = pq.read_table(folder / "frames.parquet")
    numbers = pa.array([frame / 2 for frame in table["frame"].to_pylist()])
    pq.write_table(table.set_column(0, "frame", numbers), folder / "frames.parquet")


def stretch(row: Tree) -> None:
    """Longer by 1e-8."""
    row["R_cam_world"] = [x * (1 + 1e-8) for x in row["R_cam_world"]]


def decode_twice(row: Tree) -> None:
    row["spots"][0]["led"] = row["spots"][1]["led"]


@pytest.mark.parametrize(("check", "name", "damage"), DAMAGES, ids=[f"{check}-{name}" for check, name, _ in DAMAGES])
def test_both_refuse(good: Path, tmp_path: Path, check: int, name: str, damage: Callable[[Path], None]) -> None:
    folder = copied(good, tmp_path)
    damage(folder)
    for verdict in (verdict_of_verify(folder), verdict_of_reader(folder)):
        assert verdict, f"check {check}: {name}"
        assert "\n" not in verdict


@pytest.mark.parametrize(("rows", "valid"), [(255, True), (256, False), (257, False)])
def test_a_kernel_has_255_rows_at_most(good: Path, tmp_path: Path, rows: int, valid: bool) -> None:
    folder = copied(good, tmp_path)
    at(*MAIN, "psf", value="measured")(folder)
    kernel = np.zeros((rows, rows))
    kernel[rows // 2, rows // 2] = 1.0
    at(*MAIN, "psf_kernel", value=kernel.tolist())(folder)
    refused = "has to be square, with an odd number of rows of at most 255"
    # The seal alone differs where the kernel is valid; the reader does not check it.
    assert (refused in (verdict_of_verify(folder) or "")) != valid
    assert (refused in (verdict_of_reader(folder) or "")) != valid


def test_every_check_has_a_damage() -> None:
    text = (Path(__file__).parent.parent / "datasets/FORMAT.md").read_text()
    section = text.partition("\n## Checks\n")[2].partition("\n## ")[0]
    numbers = [int(line.partition(".")[0]) for line in section.splitlines() if line[:1].isdigit()]
    assert numbers == sorted({check for check, _, _ in DAMAGES})


def copied(good: Path, tmp_path: Path) -> Path:
    """A copy of the files that a test may damage: links to all others."""
    folder = tmp_path / "set"
    shutil.copytree(good, folder, copy_function=lambda a, b: Path(b).symlink_to(a))
    for path in ("dataset.json", *TABLES, "frames/000001.exr"):
        (folder / path).unlink()
        shutil.copy(good / path, folder / path)
    return folder


def by_pandas(path: Path) -> None:
    pd.read_parquet(path).to_parquet(path)


def by_pandas_with_arrow_types(path: Path) -> None:
    pd.read_parquet(path, dtype_backend="pyarrow").to_parquet(path, index=True)


def by_polars(path: Path) -> None:
    pl.read_parquet(path).write_parquet(path)


def by_polars_in_arrow(path: Path) -> None:
    pq.write_table(pl.read_parquet(path).to_arrow(), path)


def in_other_groups(path: Path) -> None:
    pq.write_table(pq.read_table(path), path, row_group_size=1, compression="zstd", use_dictionary=False, version="1.0")


def with_other_types(path: Path) -> None:
    """Narrow integers, a dictionary of texts, plain and large lists."""
    table = pq.read_table(path)
    kinds = {pa.int64(): pa.int32(), pa.string(): pa.dictionary(pa.int32(), pa.string())}
    schema = [
        (f.name, pa.large_list(pa.float64()) if pa.types.is_fixed_size_list(f.type) else kinds.get(f.type, f.type))
        for f in table.schema
    ]
    pq.write_table(table.cast(pa.schema(schema)), path)


def in_another_order_with_more_columns(path: Path) -> None:
    table = pq.read_table(path)
    table = table.select(table.column_names[::-1]).append_column("remark", pa.array(["x"] * len(table)))
    pq.write_table(table, path)


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize(
    "rewrite",
    [
        *(by_pandas, by_pandas_with_arrow_types, by_polars, by_polars_in_arrow),
        *(in_other_groups, with_other_types, in_another_order_with_more_columns),
    ],
)
def test_both_accept_tables_that_other_programs_rewrite(
    good: Path, tmp_path: Path, table: str, rewrite: Callable[[Path], None]
) -> None:
    folder = copied(good, tmp_path)
    rewrite(folder / table)
    assert (verdict_of_verify(folder), verdict_of_reader(folder)) == (None, None)


def test_both_accept_unknown_keys_of_the_outermost_object(good: Path, tmp_path: Path) -> None:
    folder = copied(good, tmp_path)
    at("remark", value="x")(folder)
    assert (verdict_of_verify(folder), verdict_of_reader(folder)) == (None, None)


def places(tree: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Places of all values below `tree`; of lists, the first three items."""
    if path:
        yield path
    if isinstance(tree, dict):
        for key in sorted(tree):
            yield from places(tree[key], (*path, key))
    elif isinstance(tree, list):
        for index, item in enumerate(tree[:3]):
            yield from places(item, (*path, index))


def mutated(value: object, chance: random.Random) -> object:
    """Another value: of another kind, out of any range, or beside the former one."""
    others: list[object] = [None, "x", [], {}, -1, 0, 1, 1e-320, 1e150, 2**63, float("nan"), float("inf"), True]
    if isinstance(value, int | float) and not isinstance(value, bool):
        others += [-value, value * 2, value + 1e-7, value * (1 + 1e-4)] * 2
    if isinstance(value, list) and value:
        others += [value[1:], [*value, value[0]], value[::-1]] * 2
    if isinstance(value, dict) and value:
        others += [{**value, "unknown": 1}, {key: value[key] for key in sorted(value)[1:]}] * 2
    return chance.choice(others)


def mutate(folder: Path, good: Path, chance: random.Random) -> tuple[str, object]:
    """Damage one value of dataset.json or of a table; returns its place, `file/key/...`, and the value."""
    file = chance.choice(["dataset.json", "dataset.json", *TABLES])
    if file == "dataset.json":
        tree = json.loads((good / file).read_text())
        # The provenance is for people and for `generate`; readers drop it.
        path = chance.choice([path for path in places(tree) if path[0] != "provenance"])
        value = mutated(at_path(tree, path), chance)
        put(tree, path, value)
        (folder / file).write_text(json.dumps(tree))
        return f"{file}/{'/'.join(map(str, path))}", value
    table = pq.read_table(good / file)
    rows = table.to_pylist()
    path = chance.choice(list(places(rows[1])))
    value = mutated(at_path(rows[1], path), chance)
    put(rows[1], path, value)
    try:
        changed = pa.Table.from_pylist(rows, table.schema)
    except (pa.ArrowException, TypeError, ValueError, OverflowError):
        return "", None  # no table can hold it
    pq.write_table(changed, folder / file)
    return f"{file}/{'/'.join(map(str, path))}", value


VERIFY_ALONE = {
    r"dataset\.json/(accelerometer|room_m|sensor/(gain_e_per_dn|full_well_e)|led_map/\d+/radius_m)": "null is for "
    "photographs, which are not rendered",
    r"dataset\.json/cameras/main/(K|distortion|shutter|projection|R_cam_rig|offset_m)(/.*)?": "the lens is "
    "invertible on the sensor; the camera is that of the true poses",
    r"dataset\.json/led_map(/\d+(/(id|position_m|luminaire)(/\d)?)?)?": "the true poses put LEDs at their pixels",
    r"dataset\.json/(downlink|gyroscope)(/.*)?": "the scene of the provenance tells what LEDs send",
    r"frames\.parquet/(start_s|burst|shot|pose|device|accelerometer_m_s2)": "the recipe tells times and devices",
    r"dataset\.json/(summary|licence|manifest_sha256|seal|withheld)(/.*)?": "readers do not use it",
    r"frames\.parquet/(exposure_s|camera)": "the header of a frame's file states it",
    r"truth\.parquet/.*": "readers take of the truth what scores need",
}
"""Places where verify, which has the recipe and the truth, may refuse what readers accept, with the reason."""


def test_both_agree_on_a_dataset_with_one_other_value(good: Path, tmp_path: Path) -> None:
    """A reader never refuses what verify accepts; the reverse at places of VERIFY_ALONE only.

    40 mutations; CHECKS_MUTATIONS=1000 tries more. A third and more of them change the verdict.
    """
    folder, chance, refused = copied(good, tmp_path), random.Random(15), 0
    count = int(os.environ.get("CHECKS_MUTATIONS", "40"))
    for _ in range(count):
        for name in ("dataset.json", *TABLES):
            shutil.copy(good / name, folder / name)
        place, value = mutate(folder, good, chance)
        by_verify, by_reader = verdict_of_verify(folder), verdict_of_reader(folder)
        said = f"{place} = {value!r:.80}: verify: {by_verify}; reader: {by_reader}"
        assert by_reader is None or by_verify is not None, said
        if by_verify is not None and by_reader is None:
            assert any(re.fullmatch(pattern, place) for pattern in VERIFY_ALONE), said
        refused += by_reader is not None
    assert refused >= count / 4  # else the mutations test nothing


def at_path(tree: Any, path: tuple[str | int, ...]) -> object:
    for key in path:
        tree = tree[key]
    return tree
