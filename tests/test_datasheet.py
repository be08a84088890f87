"""Photon transfer held against a camera written here in plain NumPy; then the sensor's own data sheet and its page."""

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from html_text import texts
from numpy.typing import NDArray
from scipy.stats import norm

from vlcrender.core.quantity import Quantity, line
from vlcrender.emva1288.datasheet import LABELS, Datasheet, Row, cells, compare, load_sensor, make_datasheet
from vlcrender.emva1288.page import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, page
from vlcrender.emva1288.photon_transfer import Measurement, Shoot, measure, take_pair
from vlcrender.errors import InputError
from vlcrender.sensor.nonuniformity import UNSEEN_DN2, patterns, response_variance
from vlcrender.sensor.saturation import clipped, full_well_e, saturation_e
from vlcrender.sensor.sensor import Sensor

FULL: dict[str, Any] = {
    "noise": "full",
    "bits": 12,
    "gain_e_per_dn": 1.6,
    "full_well_e": 5500.0,
    "black_level_dn": 100,
    "prnu": 0.01,
    "dark_current_e_s": 8.0,
    "dsnu_e": 1.5,
    "read_noise_e": 2.2,
    "adc_noise_dn": 0.5,
    "row_offset_e": 0.4,
    "column_offset_e": 0.6,
}


def numpy_camera(seed: int, side: int = 64) -> Shoot:
    """0.5 DN/e, QE 0.7, 3 e of dark noise, 20 e/s doubling every 7 degrees, 3000 e at most; DSNU 2 e and PRNU 1 %."""
    rng = np.random.Generator(np.random.Philox(seed))
    response, offset = 1 + 0.01 * rng.standard_normal((side, side)), 2.0 * rng.standard_normal((side, side))

    def shoot(photons: float, exposure_s: float, warmer_c: float) -> NDArray[np.uint32]:
        electrons = rng.poisson(0.7 * photons * response + 20 * 2 ** (warmer_c / 7) * exposure_s) + offset
        signal = np.minimum(electrons, 3000) + 3 * rng.standard_normal((side, side))
        return np.clip(np.rint(0.5 * signal + 50), 0, 4095).astype(np.uint32)

    return shoot


TRUTH: dict[str, tuple[float, Callable[[Measurement], Quantity]]] = {
    "gain": (0.5, lambda m: m.gain),
    "quantum efficiency": (0.7, lambda m: m.quantum_efficiency),
    "dark level": (50.0, lambda m: m.dark_level_dn),
    "dark noise": (9.0, lambda m: m.dark_noise_e2),
    "dark current": (20.0, lambda m: m.dark_current_e_s),
    "doubling": (7.0, lambda m: m.doubling_c or Quantity(0.0, 0.0)),
    "full well": (3000 - 0.2, lambda m: m.full_well_e),
    "dark pattern": (4.0, lambda m: m.dark_patterns.total.over(m.gain).over(m.gain)),
    "response": (1e-4, lambda m: response_variance(m.dark_patterns, m.bright_patterns)),
}


@pytest.mark.slow
def test_photon_transfer_finds_a_camera_of_numpy_and_states_its_own_error() -> None:
    """Over 30 cameras the deviations over the stated errors have a mean of 0 and a spread of 1.

    5 standard errors: the mean's is 1 / sqrt(30), the spread's 1 / sqrt(2 * 29).
    """
    cameras = [measure(numpy_camera(seed)) for seed in range(30)]
    for name, (truth, of) in TRUTH.items():
        found = [of(camera) for camera in cameras]
        scores = np.array([(q.value - truth) / q.error for q in found])
        assert abs(scores.mean()) < 5 / np.sqrt(30), name
        assert abs(scores.std(ddof=1) - 1) < 5 / np.sqrt(58), name
    # The least signal: (sqrt(9 + 1/12/0.25 + 1/4) + 1/2) / 0.7 photons; saturation somewhat below the well.
    least = [camera.least_photons for camera in cameras]
    scores = [(q.value - (np.sqrt(9 + 1 / 3 + 0.25) + 0.5) / 0.7) / q.error for q in least]
    assert abs(np.mean(scores)) < 5 / np.sqrt(30)
    # Variances of 4096 pairs are known to sqrt(2 / 4096), differences to 3 %: the largest is found where the true one
    # is 13 % smaller at most, so at 13 % less light, and short of the well, where it has fallen to a half.
    for camera in cameras:
        assert 0.8 * 3000 < 0.7 * camera.saturation_photons < 3000
        assert camera.linearity_error.value < camera.linearity_noise + 5 * camera.linearity_error.error


def test_the_variance_of_a_pair_excludes_fixed_patterns_and_a_change_of_light() -> None:
    """Of two given frames: sigma^2 = mean((A - B)^2)/2 - (mean A - mean B)^2/2, by hand."""
    pattern = np.arange(16, dtype=np.uint32).reshape(4, 4) * 100
    frames = iter([pattern + 1, pattern + 1 + 4])
    assert take_pair(lambda *_: next(frames), 5.0).variance_dn2 == 0
    chequered = np.indices((4, 4)).sum(axis=0).astype(np.uint32) % 2
    frames = iter([pattern, pattern + 6 * chequered])
    point = take_pair(lambda *_: next(frames), 5.0)
    assert point.variance_dn2 == pytest.approx(18 / 2 - 3**2 / 2)
    assert point.mean_dn == pytest.approx(750 + 1.5)


def test_patterns_are_separated_into_rows_columns_and_pixels(rng: np.random.Generator) -> None:
    """Rows of 3 DN, columns of 2, pixels of 1 under noise of 4: each found within 5 of its standard errors."""
    rows, columns = 3 * rng.standard_normal((200, 1)), 2 * rng.standard_normal(300)
    fixed = 500 + rows + columns + rng.standard_normal((200, 300))
    found = patterns(np.rint(fixed + 4 * rng.standard_normal(fixed.shape)).astype(np.uint32) for _ in range(24))
    for quantity, truth in ((found.row, 9.0), (found.column, 4.0), (found.pixel, 1.0), (found.total, 14.0)):
        assert abs(quantity.value - truth) < 5 * quantity.error
        assert quantity.error < 0.15 * truth
    # their own mean, of 200 rows, 300 columns and 60 000 pixels; variances are known to 10 % of rows, the most of them
    assert found.mean_error == pytest.approx(np.sqrt(9 / 200 + 4 / 300 + 1 / 60_000), rel=5 * 0.05)
    # of 24 frames, 16 + 1/12 of noise: known to sqrt(2 / (23 * 60 000))
    assert found.noise_dn2 == pytest.approx((16 + 1 / 12) / 24, rel=5 * np.sqrt(2 / (23 * 60_000)))


def test_lines_and_ratios_carry_their_errors() -> None:
    intercept, slope = line([0.0, 1.0, 2.0], [Quantity(1.0, 0.1), Quantity(3.0, 0.1), Quantity(5.0, 0.1)])
    # equal weights: Var(slope) = s^2 / sum (x - 1)^2, Var(intercept) = s^2 (1/3 + 1 / sum (x - 1)^2)
    assert slope == pytest.approx((2.0, 0.1 / np.sqrt(2)))
    assert intercept == pytest.approx((1.0, 0.1 * np.sqrt(1 / 3 + 1 / 2)))
    assert Quantity(6.0, 0.3).over(Quantity(2.0, 0.2)) == pytest.approx((3.0, 3 * np.hypot(0.05, 0.1)))
    assert Quantity(6.0, 0.3).times(Quantity(2.0, 0.2)) == pytest.approx((12.0, 12 * np.hypot(0.05, 0.1)))


@pytest.mark.slow
def test_saturation_agrees_with_random_draws(rng: np.random.Generator) -> None:
    """Limits of well and ADC close to each other: the mean of many draws clipped by both, to 5 standard errors."""
    sensor = Sensor(**{**FULL, "full_well_e": 6390.0, "read_noise_e": 10.0})
    top = (4095 - 100) * 1.6
    noise = np.sqrt(10**2 + (0.5 * 1.6) ** 2 + 0.4**2 + 0.6**2)
    draws = np.minimum(6390.0 + noise * rng.standard_normal(1_000_000), top)
    assert abs(full_well_e(sensor, 3.0) - (draws.mean() - 3.0)) < 5 * draws.std() / 1000
    # The largest variance, of pixels that differ by 5 %: of draws, 2000 pixels of 400 each, so known to 0.16 %.
    levels = np.linspace(0.6, 1.0, 21) * 5500
    response = 1 + 0.05 * rng.standard_normal(2000)
    variances = [
        np.mean([np.minimum(rng.poisson(level * r, 400), 5500).var(ddof=1) for r in response]) for level in levels
    ]
    best, error = saturation_e(Sensor(**{**FULL, "prnu": 0.05}), 0.0, levels, 800_000)
    assert abs(levels[int(np.argmax(variances))] - best) <= 4 * error < 250
    assert best < 5500 - 4 * np.sqrt(5500)  # where it would be if they were all alike: the brightest are full by then


def test_read_noise_does_not_move_the_saturation_of_a_well() -> None:
    """The well clips first: noise that is added later raises all temporal variances alike, bit for bit in the maximum.

    Where the ADC limits, it clips read noise as well, and the variance falls at less light.
    """
    levels = np.linspace(0.6, 1.0, 41) * 6300
    well, noisy = (Sensor(**{**FULL, "read_noise_e": sigma, "adc_noise_dn": 0.0}) for sigma in (0.0, 60.0))
    assert saturation_e(well, 0.0, levels, 800_000)[0] == saturation_e(noisy, 0.0, levels, 800_000)[0]
    adc, noisy = (
        Sensor(**{**FULL, "full_well_e": 1e5, "read_noise_e": sigma, "adc_noise_dn": 0.0}) for sigma in (0.0, 60.0)
    )
    assert saturation_e(noisy, 0.0, levels, 800_000)[0] < saturation_e(adc, 0.0, levels, 800_000)[0]


def test_the_saturation_of_an_adc_agrees_with_random_draws(rng: np.random.Generator) -> None:
    """Shot noise and 60 e of read noise, clipped together by the ADC; variances of 100 000 draws at each level."""
    sensor = Sensor(**{**FULL, "full_well_e": 1e5, "prnu": 0.0, "dsnu_e": 0.0, "read_noise_e": 60.0})
    levels = np.linspace(0.6, 1.0, 41) * 6300
    noise = np.sqrt(levels + 60.0**2 + 0.8**2)
    draws = np.minimum(levels + noise * rng.standard_normal((100_000, 41)), (4095 - 100) * 1.6)
    best, error = saturation_e(sensor, 0.0, levels, 100_000)
    assert abs(levels[int(np.argmax(draws.var(axis=0)))] - best) <= 4 * error < 500


def test_the_error_of_the_saturation_is_how_far_a_variance_may_pass_for_the_largest() -> None:
    """6400 pixels know a variance to sqrt(2 / 6400), a difference of two to 1 / 40: four are 10 %. The error is
    a fourth of the way to where a well of Poisson numbers has lost 10 % of its largest variance, to half a level.
    """
    sensor = Sensor(**{**FULL, "prnu": 0.0, "dsnu_e": 0.0, "read_noise_e": 0.0, "adc_noise_dn": 0.0})
    levels = np.linspace(0.7, 1.0, 601) * 5500
    variances = clipped(levels, np.sqrt(levels), 5500)[1]
    far = levels[variances >= 0.9 * variances.max()]
    best, error = saturation_e(sensor, 0.0, levels, 6400)
    assert best == pytest.approx(levels[np.argmax(variances)], abs=levels[1] - levels[0])
    assert error == pytest.approx(np.abs(far - best).max() / 4, abs=(levels[1] - levels[0]) / 2 / 4)


@pytest.mark.parametrize("z", [-1.0, 0.0, 0.7, 3.0])
def test_clipped_normal_moments_agree_with_random_draws(z: float, rng: np.random.Generator) -> None:
    """Mean and variance of a million, each to 5 standard errors from the draws' own moments."""
    draws = np.minimum(50.0 + 4.0 * rng.standard_normal(1_000_000), 50.0 + 4.0 * z)
    mean, variance = clipped(np.array(50.0), np.array(4.0), 50.0 + 4.0 * z)
    assert abs(draws.mean() - mean) < 5 * draws.std() / 1000
    assert abs(draws.var() - variance) < 5 * np.std((draws - draws.mean()) ** 2) / 1000


@pytest.fixture(scope="module")
def full() -> Datasheet:
    return make_datasheet("full", Sensor(**FULL), side_px=256)


def row_of(rows: tuple[Row, ...], key: str) -> Row:
    return next(row for row in rows if row.key == key)


@pytest.mark.slow
def test_the_data_sheet_of_the_chain_finds_the_set_values(full: Datasheet) -> None:
    for row in full.rows:
        assert row.passed, row
    assert {row.key for row in full.rows} == set(LABELS)
    assert row_of(full.rows, "K").set_value == pytest.approx(1 / 1.6)
    assert row_of(full.rows, "sigma_d").set_value == pytest.approx(np.hypot(2.2, 0.5 * 1.6))
    assert row_of(full.rows, "DSNU1288").set_value == pytest.approx(np.sqrt(1.5**2 + 0.4**2 + 0.6**2))


WRONG: dict[str, dict[str, float]] = {
    "K": {"gain_e_per_dn": 1.6 * 1.01},
    "mu_y.dark": {"black_level_dn": 101},
    "sigma_d": {"read_noise_e": 2.2 * 1.03},
    "mu_I": {"dark_current_e_s": 8.0 * 1.01},
    "T_d": {"dark_current_doubling_c": 6.05},
    "DSNU1288": {"dsnu_e": 1.6},
    "DSNU1288.row": {"row_offset_e": 0.6},
    "DSNU1288.col": {"column_offset_e": 0.8},
    "PRNU1288": {"prnu": 0.0103},
    "full well": {"full_well_e": 5450.0},
    "mu_e.sat": {"full_well_e": 5100.0},
    "SNR_max": {"full_well_e": 5100.0},
    "DR": {"full_well_e": 5100.0},
}


@pytest.mark.slow
@pytest.mark.parametrize("key", WRONG)
def test_a_wrong_set_value_is_rejected(full: Datasheet, key: str) -> None:
    """The measurement of one sensor against the settings of another: a hundredth in gain is off, and so on."""
    other = Sensor(**{**FULL, **WRONG[key]})
    assert row_of(compare(other, full.efficiency, full.measurement), key).passed is False


@pytest.mark.slow
def test_an_efficiency_off_by_one_percent_is_rejected(full: Datasheet) -> None:
    assert row_of(compare(full.sensor, full.efficiency * 1.01, full.measurement), "QE").passed is False


@pytest.mark.slow
def test_missing_read_noise_is_rejected(full: Datasheet) -> None:
    silent = make_datasheet("silent", Sensor(**{**FULL, "read_noise_e": 0.0, "adc_noise_dn": 0.0}), side_px=64)
    assert row_of(compare(full.sensor, full.efficiency, silent.measurement), "sigma_d").passed is False


@pytest.mark.slow
def test_shot_noise_alone_has_nothing_else_set() -> None:
    """At 1 e/DN the dark frames are all alike, and the rest is Poisson."""
    sheet = make_datasheet("shot", Sensor(), side_px=256)
    assert not [row for row in sheet.rows if row.passed is False]
    for key in ("sigma_d", "mu_I", "DSNU1288", "DSNU1288.row", "PRNU1288", "LE"):
        assert cells(row_of(sheet.rows, key))[0] == "none set"
    linearity = row_of(sheet.rows, "LE")  # percent, as its tolerance
    assert linearity.measured == pytest.approx(100 * sheet.measurement.linearity_error.value)
    assert linearity.tolerance is not None
    assert linearity.tolerance > 100 * sheet.measurement.linearity_noise
    assert row_of(sheet.rows, "sigma_d").measured == 0
    assert row_of(sheet.rows, "T_d").passed is None
    assert row_of(sheet.rows, "full well").set_value == 4095  # limit of the ADC, below the well's 6000 e


@pytest.mark.slow
def test_noise_hidden_by_rounding_has_an_upper_bound() -> None:
    sheet = make_datasheet(
        "coarse",
        Sensor(**{**FULL, "bits": 8, "black_level_dn": 10, "gain_e_per_dn": 20.0, "adc_noise_dn": 0.0}),
        side_px=64,
    )
    row = row_of(sheet.rows, "sigma_d")
    assert (row.measured, row.passed) == (None, True)
    assert row.tolerance is not None
    assert 2.2 < row.tolerance < 20
    assert cells(row)[1].startswith("< ")
    assert row_of(sheet.rows, "DR").measured is None


@pytest.mark.slow
def test_noise_clipped_in_the_dark_is_reported_as_off() -> None:
    """Black level 0 clips half of the read noise; a data sheet must show it."""
    sheet = make_datasheet("clipped", Sensor(**{**FULL, "black_level_dn": 0}), side_px=64)
    assert row_of(sheet.rows, "sigma_d").passed is False


@pytest.mark.slow
def test_a_data_sheet_is_the_same_each_time_and_another_device_s_is_not() -> None:
    first, again, other = (make_datasheet("x", Sensor(**FULL, serial=s), side_px=32).rows for s in (1, 1, 2))
    assert first == again
    assert row_of(first, "K").measured != row_of(other, "K").measured


def test_an_unmeasurable_camera_is_refused(rng: np.random.Generator) -> None:
    with pytest.raises(InputError, match="needs noise, and the sensor has none"):
        make_datasheet("x", Sensor(noise="none"), side_px=32)

    def endless(photons: float, exposure_s: float, warmer_c: float) -> NDArray[np.uint32]:
        return rng.poisson(0.001 * photons, (32, 32)).astype(np.uint32)

    with pytest.raises(InputError, match="does not saturate"):
        measure(endless)


@pytest.mark.slow
def test_a_mosaic_is_measured_by_its_green_pixels() -> None:
    curves = {"red": [0.1, 0.6], "green": [0.4, 0.5], "blue": [0.6, 0.0]}
    coloured = {"mosaic": "rggb", "quantum_efficiency": {"wavelengths_nm": [500, 600], **curves}}
    sheet = make_datasheet("x", Sensor.model_validate({**FULL, **coloured}), wavelength_nm=550.0, side_px=64)
    row = row_of(sheet.rows, "QE")
    assert row.set_value == pytest.approx(45.0)
    assert row.passed
    assert "green" in sheet.conditions[0]


def test_sensors_are_presets_or_files(tmp_path: Path) -> None:
    assert load_sensor("ideal")[1].noise == "shot"
    file = tmp_path / "mine.toml"
    file.write_text('[sensor]\npreset = "industrial"\nprnu = 0.02\n[camera]\nwidth_px = 10\n')
    name, sensor = load_sensor(str(file))
    assert (name, sensor.prnu, sensor.noise) == ("mine", 0.02, "full")
    for text, content, mentions in (
        ("nikon", "", ["nikon", "ideal", "industrial", ".toml"]),
        (str(tmp_path / "no.toml"), "", ["no.toml", "No such file"]),
        (str(file), "[camera]\n", ["mine.toml", "no [sensor] table"]),
        (str(file), "[sensor]\nbits = 9.5\n", ["mine.toml", "sensor.bits = 9.5"]),
        (str(file), "[sensor]\ngain_e_per_dn = -1\n", ["sensor.gain_e_per_dn = -1"]),
        (str(file), "sensor = 3\n", ["mine.toml", "sensor = 3"]),
    ):
        file.write_text(content)
        with pytest.raises(InputError) as refusal:
            load_sensor(text)
        for mention in mentions:
            assert mention in str(refusal.value)


@pytest.mark.slow
def test_the_page_stands_alone_and_shows_every_row(full: Datasheet) -> None:
    text = page(full)
    assert text.count("<svg") == 2
    assert text.count("<circle") > 2 * 45
    for row in full.rows:
        assert f">{row.key}<" in text
        assert f">{cells(row)[1]}<" in text
    assert not [word for word in ("http", "url(", "<script", "nan", "inf ") if word in text.split("</style>")[1]]


@pytest.mark.slow
def test_the_grids_of_the_plots_fill_their_frames(full: Datasheet) -> None:
    """The last decade of photons is at the right edge; no line of a grid or curve is outside."""
    for plot in page(full).split("<svg")[1:]:
        rules = [
            [float(value) for value in re.findall(r'[xy][12]="([-0-9.]+)"', line)]
            for line in re.findall(r'<line class="rule"[^>]*>', plot)
        ]
        xs, ys = [x for x1, _, x2, _ in rules for x in (x1, x2)], [y for _, y1, _, y2 in rules for y in (y1, y2)]
        assert (min(xs), max(xs)) == (LEFT, WIDTH - RIGHT)
        assert min(ys) >= TOP
        assert max(ys) == HEIGHT - BOTTOM
        curve = np.array(
            [place.split(",") for path in re.findall(r'd="M([^"]*)"', plot) for place in path.split()], float
        )
        dots = np.array(re.findall(r'cx="([-0-9.]+)" cy="([-0-9.]+)"', plot), float)
        for places in (curve, dots):
            assert places[:, 0].min() >= LEFT
            assert places[:, 0].max() <= WIDTH - RIGHT
            assert places[:, 1].min() >= TOP
            assert places[:, 1].max() <= HEIGHT - BOTTOM


def test_a_curve_below_the_plot_begins_at_its_lower_border(full: Datasheet) -> None:
    """60 e of read noise: one photon has a signal-to-noise ratio of 0.01, where the plot begins: 0.1. The first of 200
    points that is shown is at most one step of the curve above the border: there as many decades up as across.
    """
    noisy = dataclasses.replace(full, sensor=Sensor(**{**FULL, "read_noise_e": 60.0}))
    plot = page(noisy).split("<svg")[2]
    curve, limit = (
        np.array([place.split(",") for place in re.findall(f'class="{kind}" d="M([^"]*)"', plot)[0].split()], float)
        for kind in ("set", "limit")
    )
    assert len(limit) == 200
    # The limit is the root of the photons: half as many decades up as across.
    step_px = 2 * np.abs(np.diff(limit[:, 1])).mean()
    assert 0 <= HEIGHT - BOTTOM - curve[0, 1] <= step_px + 0.1  # places have one decimal


def test_the_text_of_the_page_is_the_data_sheet(full: Datasheet) -> None:
    """In order: title, conditions, the rows, and the legends of the two plots; names are text, never markup."""
    named = dataclasses.replace(full, title="<b>&'x'")
    found = texts(page(named))
    rows = []
    for row in full.rows:
        set_value, measured, tolerance, verdict = cells(row)
        rows += [row.key, row.name, set_value, measured, f"± {tolerance}" if tolerance else "", row.unit, verdict]
        rows.append(row.definition)
    assert found[:4] == [
        "Data sheet: <b>&'x'",
        "Data sheet of the sensor <b>&'x'",
        " · ".join(full.conditions),
        "Measured from digital numbers by EMVA Standard 1288, Release 4.0 Linear. A value passes where it lies within "
        "the tolerance, four standard errors, of the set value.",
    ]
    plots = found.index("Photon transfer")
    assert found[4:plots] == ["Set and measured", "set", "measured", "tolerance", "measured as", *filter(None, rows)]
    legend = "Temporal variance minus dark variance, against mean minus dark mean."
    assert found[plots + 1 : plots + 5] == [legend, "measured", "set: K times the signal", "saturation"]
    curves = found.index("Signal to noise")
    legend = "Mean minus dark mean, divided by its temporal noise, against photons per pixel."
    assert found[curves + 1 : curves + 5] == [legend, "measured", "set", "limit of photon noise"]
    assert {"mean, DN", "variance, DN²"} < set(found[plots:curves])
    assert {"photons per pixel", "signal to noise"} < set(found[curves:])


def test_a_value_that_is_off_stands_out(full: Datasheet) -> None:
    assert 'class="off"' not in page(full)
    wrong = tuple(dataclasses.replace(row, passed=False) if row.key == "K" else row for row in full.rows)
    assert page(dataclasses.replace(full, rows=wrong)).count('<td class="off">OFF</td>') == 1


def test_a_variance_that_rounding_hides_has_the_standard_error_of_what_may_be_hidden() -> None:
    """Of 5e5 normal numbers one is expected beyond half a DN: the variance is anything up to that, uniformly.

    The constants have two and three digits: 1 %.
    """
    largest_dn2 = (0.5 / norm.isf(0.5 / 5e5)) ** 2
    assert pytest.approx(largest_dn2 / 3**0.5, rel=0.01) == UNSEEN_DN2
