"""Data sheet of a sensor: values measured on its simulated exposures, beside the set values.

The test bench runs the sensor's whole chain (`signal_chain.expose`) under light of one wavelength, uniform over the
pixels. `photon_transfer` measures it by EMVA Standard 1288 from digital numbers alone. A measured value passes where it
lies within SIGMAS standard errors of the set value. Random numbers are keyed: a data sheet is reproducible.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vlcrender.config.presets import KINDS, preset, with_presets
from vlcrender.config.toml_model import Settings, check, read_toml
from vlcrender.core.quantity import Quantity
from vlcrender.core.random_keys import random_key
from vlcrender.emva1288.photon_transfer import (
    FLAT_EXPOSURE_S,
    ROUNDING_DN2,
    UNDITHERED_DN2,
    Measurement,
    Shoot,
    measure,
)
from vlcrender.errors import InputError
from vlcrender.sensor.nonuniformity import response_variance
from vlcrender.sensor.quantum_efficiency import COLOURS
from vlcrender.sensor.radiometry import detectors
from vlcrender.sensor.saturation import full_well_e, saturation_e
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

SIGMAS = 4.0
"""Tolerance in standard errors: with 15 values, about one page in 1000 has a value off by chance."""


class _SensorTable(Settings):
    sensor: Sensor


LABELS = {
    "K": ("system gain", "DN/e", "slope of variance over mean, up to 70 % of saturation"),
    "QE": ("quantum efficiency", "%", "slope of mean over photons, / K"),
    "mu_y.dark": ("dark level", "DN", "mean of dark frames at exposure time 0"),
    "sigma_d": ("dark noise", "e", "dark variance at exposure time 0, minus 1/12 of rounding, / K²"),
    "mu_I": ("dark current", "e/s", "slope of the dark mean over time, / K"),
    "T_d": ("doubling temperature", "°C", "dark current at three temperatures"),
    "DSNU1288": ("dark nonuniformity", "e", "of rows, columns and pixels, in the mean of 64 dark frames"),
    "DSNU1288.row": ("of rows", "e", "deviation of rows beyond that of their pixels"),
    "DSNU1288.col": ("of columns", "e", "deviation of columns beyond that of their pixels"),
    "PRNU1288": ("response nonuniformity", "%", "variance at half of saturation minus DSNU's, over the signal"),
    "full well": ("largest signal", "e", "mean at twice the light of saturation, / K: well or ADC full"),
    "mu_e.sat": ("saturation capacity", "e", "QE times photons at the largest variance"),
    "SNR_max": ("largest signal to noise", "dB", "root of mu_e.sat"),
    "DR": ("dynamic range", "dB", "photons at saturation over photons at a signal to noise of 1"),
    "LE": ("linearity error", "%", "mean deviation from a line, 5 to 95 % of saturation"),
}
"""Name, unit and definition of each row."""


@dataclass(frozen=True)
class Row:
    """A row of the data sheet. A parameter that is not set has the value 0."""

    key: str
    name: str
    unit: str
    definition: str
    set_value: float
    measured: float | None
    """None where it cannot be measured."""
    tolerance: float | None
    """SIGMAS standard errors; an upper bound of the value where it cannot be measured."""
    passed: bool | None


@dataclass(frozen=True)
class Datasheet:
    """A data sheet and the measurement that its plots show."""

    title: str
    conditions: tuple[str, ...]
    sensor: Sensor
    efficiency: float
    """Electrons per photon, as set."""
    measurement: Measurement
    rows: tuple[Row, ...]


def load_sensor(text: str) -> tuple[str, Sensor]:
    """Name and settings of a sensor given by a preset's name or by a TOML file with a [sensor] table.

    Raises InputError for any other text, and for values out of range.
    """
    if text.endswith(".toml"):
        tree = with_presets({key: value for key, value in read_toml(Path(text)).items() if key in KINDS}, [], text)
        if "sensor" not in tree:
            raise InputError(f"{text}: has no [sensor] table")
        name, source = Path(text).stem, text
    else:
        try:
            tree = preset("sensors", text)
        except InputError as error:
            raise InputError(f"{error}; or give a .toml file with a [sensor] table") from None
        name, source = text, f"preset {text}"
    return name, check({"sensor": tree["sensor"]}, _SensorTable, source).sensor


def make_datasheet(
    title: str,
    sensor: Sensor,
    wavelength_nm: float = 530.0,
    side_px: int = 512,
    progress: Callable[[int], None] = lambda frames: None,
) -> Datasheet:
    """Measure a sensor of `side_px` x `side_px` pixels. `progress` is called with the number of frames taken.

    Raises InputError for a sensor without response at this wavelength, without noise, or without saturation, and for
    one with hot pixels. Crosstalk does not show: the light is uniform.
    """
    if sensor.hot_pixel_share > 0:
        raise InputError(
            f"sensor.hot_pixel_share = {sensor.hot_pixel_share:g}: the set values of a data sheet are those of pixels "
            "without defects; set it to 0"
        )
    kinds = detectors(sensor)
    detector = kinds[0] if len(kinds) == 1 else kinds[COLOURS.index("green")]
    efficiency = float(detector.quantum_efficiency(np.array([wavelength_nm]))[0])
    if not efficiency > 0:
        raise InputError(f"--wavelength-nm {wavelength_nm:g}: quantum efficiency is 0 there")
    measured = measure(bench(sensor, efficiency, side_px, progress))
    conditions = (
        f"light of {wavelength_nm:g} nm, uniform over the pixels" + (", all of them green" if len(kinds) > 1 else ""),
        f"{sensor.temperature_c:g} °C, ISO {sensor.iso:g}, {sensor.bits} bits, noise = {sensor.noise}",
        f"{side_px} x {side_px} pixels, flat fields of {FLAT_EXPOSURE_S * 1000:g} ms",
    )
    return Datasheet(title, conditions, sensor, efficiency, measured, compare(sensor, efficiency, measured))


def bench(
    sensor: Sensor, efficiency: float, side_px: int, progress: Callable[[int], None] = lambda frames: None
) -> Shoot:
    """A camera of this sensor under uniform light: each call is a new exposure with its own random numbers.

    Fixed patterns and random numbers depend on the sensor's `serial`.
    """
    taken = 0

    def shoot(photons: float, exposure_s: float, warmer_c: float) -> NDArray[np.uint32]:
        nonlocal taken
        taken += 1
        progress(taken)
        warm = sensor.model_copy(update={"temperature_c": sensor.temperature_c + warmer_c})
        light = np.full((side_px, side_px), photons * efficiency, dtype=np.float32)
        return expose(warm, light, random_key("datasheet", sensor.serial, taken), exposure_s=exposure_s)

    return shoot


def compare(sensor: Sensor, efficiency: float, measured: Measurement) -> tuple[Row, ...]:
    """Rows of set and measured values, one for each of LABELS."""
    acting, gain = sensor.acting(), 1 / sensor.gain_at_iso_e_per_dn
    dark_e = sensor.dark_electrons(FLAT_EXPOSURE_S) if sensor.noise == "full" else 0.0
    dark_noise_e = float(np.hypot(acting["read_noise_e"], acting["adc_noise_dn"] / gain))
    current = acting["dark_current_e_s"]
    total_e = float(np.linalg.norm([acting[key] for key in ("row_offset_e", "column_offset_e", "dsnu_e")]))
    found = measured.dark_patterns
    of_rows, of_columns, dsnu = (
        variance.over(measured.gain).over(measured.gain) for variance in (found.row, found.column, found.total)
    )
    prnu = response_variance(found, measured.bright_patterns)
    levels_e = np.array([p.photons for p in measured.points]) * efficiency
    full_e, full_error_e = saturation_e(sensor, dark_e, levels_e, measured.dark.pixels)
    light = Quantity(measured.saturation_photons, full_error_e / efficiency)
    saturation = light.times(measured.quantum_efficiency)
    rounding_e2 = ROUNDING_DN2 / gain**2 if dark_noise_e else 0.0
    least_e = float(np.sqrt(dark_noise_e**2 + rounding_e2 + 0.25)) + 0.5
    hidden = 0 < measured.dark_variance_dn2.value <= UNDITHERED_DN2
    return (
        _row("K", gain, measured.gain),
        _row("QE", efficiency * 100, measured.quantum_efficiency.times(100)),
        _row("mu_y.dark", sensor.black_level_dn, measured.dark_level_dn),
        _hidden_row("sigma_d", dark_noise_e, measured)
        if hidden
        else _root_row("sigma_d", dark_noise_e, measured.dark_noise_e2),
        _row("mu_I", current, measured.dark_current_e_s),
        _row("T_d", sensor.dark_current_doubling_c if current else 0.0, measured.doubling_c),
        _root_row("DSNU1288", total_e, dsnu),
        _root_row("DSNU1288.row", acting["row_offset_e"], of_rows),
        _root_row("DSNU1288.col", acting["column_offset_e"], of_columns),
        _root_row("PRNU1288", acting["prnu"] * 100, prnu.times(100**2)),
        _row("full well", full_well_e(sensor, dark_e), measured.full_well_e),
        _row("mu_e.sat", full_e, saturation),
        _row("SNR_max", _db(full_e) / 2, _in_db(saturation).times(0.5)),
        _row("DR", _db(full_e / least_e), None if hidden else _in_db(light.over(measured.least_photons))),
        _linearity_row(measured),
    )


def _row(key: str, set_value: float, measured: Quantity | None) -> Row:
    if measured is None:
        return Row(key, *LABELS[key], set_value, None, None, None)
    tolerance = SIGMAS * measured.error
    return Row(key, *LABELS[key], set_value, measured.value, tolerance, abs(measured.value - set_value) <= tolerance)


def _root_row(key: str, set_value: float, square: Quantity) -> Row:
    """A row for the root of a measured square. Squares are compared: near 0 their errors are normal, the roots' not."""
    doubt = SIGMAS * square.error
    tolerance = float(np.sqrt(set_value**2 + doubt)) - set_value
    passed = abs(square.value - set_value**2) <= doubt
    return Row(key, *LABELS[key], set_value, float(np.sqrt(max(square.value, 0.0))), tolerance, passed)


def _hidden_row(key: str, set_value: float, measured: Measurement) -> Row:
    """Dark noise that rounding hides: bounded by the largest variance of rounded numbers without noise."""
    most = float(np.sqrt(UNDITHERED_DN2)) / measured.gain.value
    return Row(key, *LABELS[key], set_value, None, most, set_value <= most)


def _linearity_row(measured: Measurement) -> Row:
    """The chain is linear: the linearity error must be that of noise."""
    most = measured.linearity_noise + SIGMAS * measured.linearity_error.error
    found = measured.linearity_error.value
    return Row("LE", *LABELS["LE"], 0.0, found * 100, most * 100, found <= most)


def cells(row: Row) -> tuple[str, str, str, str]:
    """Set value, measured value, tolerance and verdict of a row as text, to the second digit of the tolerance."""
    digits = 3 if not row.tolerance else max(0, 1 - int(np.floor(np.log10(row.tolerance))))
    set_text = f"{row.set_value:.{digits}f}" if row.set_value else "none set"
    verdict = "not measurable" if row.passed is None else "pass" if row.passed else "OFF"
    if row.measured is None:
        return set_text, "" if row.tolerance is None else f"< {row.tolerance:.{digits}f}", "", verdict
    return set_text, f"{row.measured:.{digits}f}", f"{row.tolerance:.{digits}f}", verdict


def _db(ratio: float) -> float:
    return 20 * float(np.log10(ratio))


def _in_db(ratio: Quantity) -> Quantity:
    return Quantity(_db(ratio.value), 20 / float(np.log(10)) * ratio.error / ratio.value)
