"""Public API of the estimator: the functions of `import estimator`, and what the import loads."""

import gc
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import copy_of
from estimator_synthetic import description, grid, poisson, render, view_of

import estimator as est
from estimator.evaluate.run import write_run
from estimator.io.estimates import EstimateRow

LEDS = grid(5, 4, 0.14, (3.5, 3.6, 3.5))
VIEW = view_of((3.5, 3.6, 3.5), 3.0, 10.0, -5.0, 30.0)
HEAVY = ("cv2", "matplotlib", "scipy", "pandas", "mitsuba", "vlcrender")


@pytest.fixture(scope="module")
def folder(synthetic_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copy_of(synthetic_set, tmp_path_factory.mktemp("api"))


def record() -> dict[str, Any]:
    """A frame in the vocabulary of FORMAT.md, with NumPy arrays and scalars for some lists and numbers."""
    made = description(VIEW, 1, LEDS, 0.01)
    pixels = VIEW.project(LEDS)
    return {
        "camera": made["cameras"]["main"],  # type: ignore[index]
        "sensor": made["sensor"],
        "accelerometer": made["accelerometer"],
        "led_map": made["led_map"],
        "exposure_s": np.float64(1e-3),
        "accelerometer_m_s2": VIEW.gravity_m_s2,
        "spots": [{"led": np.int64(10 + k), "u_px": u, "v_px": v} for k, (u, v) in enumerate(pixels)],
        "parts": [{"row": 0, "column": np.int64(0), "image_dn": poisson(render(VIEW, LEDS), 3)}],
        "provenance": "ignored",
    }


def loaded(code: str, packages: Sequence[str] = HEAVY) -> set[str]:
    """Which of some packages a fresh interpreter has loaded after `code`, by default of the heavy ones."""
    report = f"import sys\n{code}\nprint([name for name in {packages!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", report], capture_output=True, text=True, check=True)
    return set(eval(done.stdout.strip().splitlines()[-1]))


def test_the_import_and_the_help_load_no_heavy_package() -> None:
    assert loaded("import estimator; dir(estimator); estimator.__version__; estimator.InputError") == set()
    assert loaded("from estimator.cli import main\nmain(['--help'])") == set()
    assert loaded("from estimator.cli import main\nmain(['run', '--help'])") == set()


def test_a_run_does_without_scipy_stats() -> None:
    """It takes as long to import as all else; `scipy.signal` imports it."""
    assert loaded("import estimator.evaluate.run", ("scipy.stats", "scipy.signal")) == set()


def test_every_public_name_exists_has_a_docstring_and_is_listed() -> None:
    assert dir(est) == sorted(est.__all__)
    for name in est.__all__:
        value = getattr(est, name)
        assert name == "__version__" or value.__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = est.nothing


def test_errors_are_value_errors() -> None:
    assert issubclass(est.InputError, ValueError)
    failure = est.EstimationFailure("detect", "no spot found", {3: 1.5})
    assert isinstance(failure, ValueError)
    assert (str(failure), failure.stage, failure.ranges_m) == ("detect: no spot found", "detect", {3: 1.5})


@pytest.mark.parametrize("as_path", [str, Path])
def test_a_dataset_is_read_estimated_run_and_scored(folder: Path, as_path: Callable[[Path], str | Path]) -> None:
    dataset = est.read_dataset(as_path(folder))
    frame = est.read_frame(dataset, 1)
    assert np.array_equal(frame.parts[0].image_dn, est.read_frame(dataset, dataset.frames[1]).parts[0].image_dn)
    calls: list[tuple[int, int]] = []
    rows = est.run(as_path(folder), ["pnp", "kim"], progress=lambda done, total: calls.append((done, total)))
    assert calls == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert list(rows) == ["pnp", "kim"]
    assert rows["pnp"][1].position_m == tuple(est.estimate(frame, "pnp").position_m.tolist())
    scores = est.score(as_path(folder))
    assert [variant.variant for variant in scores.variants] == ["kim", "pnp"]


def test_a_run_keeps_no_row_that_is_not_kept_for_it(folder: Path) -> None:
    """Rows of two frames are alive at most, of three: those of the frame in hand and of the one before."""
    alive = []

    def count(name: str, rows: Sequence[EstimateRow]) -> None:
        alive.append(sum(isinstance(one, EstimateRow) for one in gc.get_objects()))

    gc.collect()
    before = sum(isinstance(one, EstimateRow) for one in gc.get_objects())
    write_run(folder, count, ["pnp"])
    assert len(alive) == 1 + 3  # before the first frame, and with each
    assert 1 <= max(alive) - before <= 2


def test_an_estimate_takes_a_name_options_or_a_variant(folder: Path) -> None:
    frame = est.read_frame(est.read_dataset(folder), 0)
    named = {variant.name: variant for variant in est.variants()}
    assert np.array_equal(est.estimate(frame).position_m, est.estimate(frame, named["ml"]).position_m)
    assert est.estimate(frame, "huynh2016:denoise=none").position_m.shape == (3,)
    with pytest.raises(est.InputError, match="variant best: unknown"):
        est.estimate(frame, "best")
    with pytest.raises(est.EstimationFailure, match="stereo: no second camera"):
        est.estimate(frame, "kim")


def test_frames_of_a_device_are_estimated_together(folder: Path) -> None:
    """As by `run`, to the last bit, from a generator. Where nothing is stated, one frame alone gives the same."""
    dataset = est.read_dataset(folder)
    found = est.estimate_device(est.read_frame(dataset, k) for k in range(3))
    rows = est.run(folder, ["self-calibrated"])["self-calibrated"]
    assert [tuple(one.position_m.tolist()) for one in found if isinstance(one, est.Estimate)] == [
        row.position_m for row in rows
    ]
    alone = est.estimate(est.read_frame(dataset, 1), "self-calibrated")
    assert alone.position_m == pytest.approx(np.array(rows[1].position_m), abs=1e-8)
    each = est.estimate_device((est.read_frame(dataset, k) for k in range(2)), "kim")
    assert [str(one) for one in each] == ["stereo: no second camera took this shot"] * 2
    (folder / "estimates/self-calibrated.parquet").unlink()


def test_frames_of_several_devices_are_not_estimated_together(folder: Path) -> None:
    dataset = est.read_dataset(folder)
    frames = [replace(est.read_frame(dataset, k), device=k) for k in range(2)]
    with pytest.raises(est.InputError, match=r"frames: of the devices 0, 1; needed the frames of one device"):
        est.estimate_device(frames)


def test_a_frame_that_does_not_exist_is_refused(folder: Path) -> None:
    for number in (-1, 3):
        with pytest.raises(est.InputError, match=f"no frame {number}; there are 3"):
            est.read_frame(est.read_dataset(folder), number)


def test_a_variant_of_one_s_own_runs_without_registration_in_one_process(folder: Path) -> None:
    def at_origin(frame: est.DeviceFrame) -> est.Estimate:
        return est.Estimate(np.zeros(3))

    mine = est.Variant("origin", "the origin", at_origin)
    rows = est.run(folder, [mine])
    assert [row.position_m for row in rows["origin"]] == [(0.0, 0.0, 0.0)] * 3
    with pytest.raises(est.InputError, match="variant origin: is not registered under its name, so workers has to be"):
        est.run(folder, [mine], workers=2)
    (folder / "estimates/origin.parquet").unlink()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"workers": 0}, "workers 0: is not 1 or more"),
        ({"variants": "ml"}, "variants 'ml': needed a sequence of names"),
        ({"variants": ["../x"]}, "variant ../x: unknown"),
    ],
)
def test_run_refuses_wrong_arguments(folder: Path, arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(est.InputError, match=words):
        est.run(folder, **arguments)


def test_scores_are_tables(folder: Path) -> None:
    pytest.importorskip("pandas")
    est.run(folder, ["pnp", "kim"])
    scores = est.score(folder)
    table = scores.to_pandas().set_index("variant")
    assert table.loc["pnp", "error_3d_median_m"] == scores.variants[1].error_3d.median_m  # type: ignore[union-attr]
    assert table.loc["pnp", "success_rate"] == 1.0
    # All frames of kim failed: infinite errors over all frames, no summary of the others.
    assert table.loc["kim", "of_all_median_m"] == np.inf
    assert np.isnan(table.loc["kim", "error_3d_median_m"])
    assert not {"rows", "failures", "error_3d"} & set(table.columns)
    frames = scores.frames_to_pandas()
    assert len(frames) == 6
    first = frames[(frames.variant == "pnp") & (frames.frame == 0)].iloc[0]
    row = scores.variants[1].rows[0]
    assert (first.true_x_m, first.true_y_m, first.true_z_m) == row.true_m
    assert (first.estimate_x_m, first.estimate_y_m, first.estimate_z_m) == row.estimate_m
    assert first.error_3d_m == row.error_3d_m
    assert frames[frames.variant == "kim"].estimate_x_m.isna().all()


def test_without_pandas_the_message_says_how_to_install_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    est.run(folder, ["pnp"])
    scores = est.score(folder)
    monkeypatch.setitem(sys.modules, "pandas", None)
    for table in (scores.to_pandas, scores.frames_to_pandas):
        with pytest.raises(est.InputError, match="pip install pandas"):
            table()


def test_a_record_makes_a_frame_that_is_estimated() -> None:
    """Centroids of 20 LEDs of 4000 e are good to 0.02 px of 1500, 40 um at 3 m; the pattern makes 0.2 mm of it."""
    given = record()
    frame = est.frame(given)
    assert np.linalg.norm(est.estimate(frame, "gravity-fit").position_m - VIEW.position_m) < 1e-3
    image = given["parts"][0]["image_dn"]
    assert np.array_equal(frame.parts[0].image_dn, image)
    with pytest.raises(ValueError, match="read-only"):
        frame.parts[0].image_dn[0, 0] = 0
    image[0, 0] += 1
    assert frame.parts[0].image_dn[0, 0] != image[0, 0]


def without(key: str) -> Callable[[dict[str, Any]], Any]:
    return lambda made: made.pop(key)


def part(**changes: object) -> Callable[[dict[str, Any]], Any]:
    return lambda made: made["parts"][0].update(changes)


WRONG: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no camera": (without("camera"), "record: camera: Field required"),
    "no parts": (without("parts"), "record: parts: needed a sequence of at least one"),
    "a wrong value": (lambda m: m["camera"].update(width_px=0), "record: camera.width_px: Input should be greater"),
    "not a number": (lambda m: m.update(exposure_s=float("nan")), "record: exposure_s: Input should be a finite"),
    "an object": (lambda m: m.update(exposure_s=object()), "record: a object is not a value of the format"),
    "LEDs of one id": (lambda m: m["led_map"][1].update(id=10), "record: LED ids have to be unique"),
    "an unknown LED": (lambda m: m["spots"][0].update(led=99), "record: spots name LED 99, which is not in led_map"),
    "an LED twice": (lambda m: m["spots"][0].update(led=11), "record: an LED is decoded twice in spots"),
    "side of a disc": (lambda m: m["led_map"][0].update(side_m=0.1), "a disc has radius_m, not side_m"),
    "radius of a square": (
        lambda m: m["led_map"][0].update(shape="square"),
        "a square has side_m .the whole side.,",
    ),
    "floats": (part(image_dn=np.zeros((3, 3))), "record: parts.0.image_dn: needed a uint32 array"),
    "empty": (part(image_dn=np.zeros((0, 3), np.uint32)), "record: parts.0.image_dn: needed a uint32 array"),
    "no row": (lambda m: m["parts"][0].pop("row"), "record: parts.0.row: Field required"),
    "a number too large": (
        part(image_dn=np.full((3, 3), 65536, np.uint32)),
        "record: parts: digital number 65536",
    ),
    "an overlap": (lambda m: m["parts"].append(m["parts"][0]), "record: parts: region .* overlaps another"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_record_is_refused_by_key(case: str) -> None:
    change, words = WRONG[case]
    made = record()
    change(made)
    with pytest.raises(est.InputError, match=words) as error:
        est.frame(made)
    assert "\n" not in str(error.value)


def test_a_record_that_is_no_mapping_is_refused() -> None:
    with pytest.raises(est.InputError, match="record: is a list, needed a mapping"):
        est.frame([])  # type: ignore[arg-type]


def test_a_square_has_its_side() -> None:
    made = record()
    led = made["led_map"][0]
    led.update(shape="square", side_m=0.03, side_sigma_m=led.pop("radius_sigma_m"))
    del led["radius_m"]
    frame = est.frame(made)
    assert frame.leds[10].half_width_m == 0.015
    # s^2 of a square is a twelfth of its side squared, of a disc a quarter of its radius squared.
    assert frame.leds[10].mean_square_extent_m2 == pytest.approx(0.03**2 / 12)
    assert frame.leds[11].mean_square_extent_m2 == pytest.approx(0.01**2 / 4)


def test_what_a_photograph_does_not_say_may_be_null() -> None:
    """Electrons are then digital numbers, the last code saturates, and an LED has the extent of a point."""
    unknown = record()
    sensor = {**unknown["sensor"], "gain_e_per_dn": None, "full_well_e": None, "bits": 8}
    led_map = [{**led, "radius_m": None} for led in unknown["led_map"]]
    parts = [{"row": 0, "column": 0, "image_dn": np.full((2, 3), 255, np.uint32)}]
    unknown |= {"sensor": sensor, "led_map": led_map, "accelerometer": None, "accelerometer_m_s2": None, "parts": parts}
    frame = est.frame(unknown)
    assert frame.electrons(frame.parts[0]).max() == 255
    assert frame.clipped(frame.parts[0]).all()
    led = next(iter(frame.leds.values()))
    assert not led.has_size
    assert (led.mean_square_extent_m2, led.shift_by_gradient_m) == (0, 0)
    for problem in ({"accelerometer_m_s2": [0, 0, 9.8]}, {"accelerometer": {"kind": "imu", "error_deg": 1.0}}):
        with pytest.raises(est.InputError, match="accelerometer"):
            est.frame({**unknown, **problem})
