"""Light to electrons against hand calculations and closed forms."""

import math

import colour
import numpy as np
import pytest
from pydantic import ValidationError

from vlcrender.camera.intrinsics import Camera
from vlcrender.sensor.quantum_efficiency import QuantumEfficiency
from vlcrender.sensor.radiometry import (
    WAVELENGTHS_NM,
    Silicon,
    Tabulated,
    electron_rate_per_cd_m2,
    luminous_efficiency,
    relative_spectrum,
    spectral_radiance,
)
from vlcrender.sensor.silicon import silicon_absorption_per_m
from vlcrender.sensor.spectra import LED_FIRST_NM, LED_SPECTRA, LED_STEP_NM


def test_luminance_of_a_spectral_radiance_is_what_was_asked_for() -> None:
    radiance = spectral_radiance(12345.0, relative_spectrum("LED-B3"))
    luminance = 683 * np.trapezoid(radiance * luminous_efficiency(), WAVELENGTHS_NM)
    assert luminance == pytest.approx(12345.0, rel=1e-12)


def test_photopic_efficiency_peaks_at_555_nm() -> None:
    assert WAVELENGTHS_NM[np.argmax(luminous_efficiency())] == 555
    assert luminous_efficiency().max() == 1.0


def test_the_tables_are_those_of_colour_science() -> None:
    """Every number, as colour-science 0.4.7 has it: constants are copied, so that no tolerance is needed."""
    wavelengths_nm = LED_FIRST_NM + LED_STEP_NM * np.arange(81)
    assert set(LED_SPECTRA) == {
        name for name in colour.SDS_ILLUMINANTS if name.startswith("LED-") and "RGB" not in name
    }
    for name, spectrum in LED_SPECTRA.items():
        table = colour.SDS_ILLUMINANTS[name]
        assert np.array_equal(table.wavelengths, wavelengths_nm)
        assert np.array_equal(table.values, spectrum)
    table = colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"]
    visible = np.isin(table.wavelengths, WAVELENGTHS_NM)
    assert np.array_equal(table.values[visible], luminous_efficiency())
    assert np.count_nonzero(visible) == len(WAVELENGTHS_NM)


def test_the_white_led_has_a_blue_peak_and_a_phosphor() -> None:
    spectrum = relative_spectrum("LED-B3")
    blue = (WAVELENGTHS_NM >= 440) & (WAVELENGTHS_NM <= 470)
    dip = (WAVELENGTHS_NM >= 475) & (WAVELENGTHS_NM <= 490)
    phosphor = (WAVELENGTHS_NM >= 560) & (WAVELENGTHS_NM <= 640)
    assert spectrum[dip].min() < 0.6 * min(spectrum[blue].max(), spectrum[phosphor].max())


EXTINCTION = (
    *(0.946, 0.445, 0.296, 0.227, 0.176, 0.138, 0.107, 8.6302e-2, 7.1381e-2, 6.2086e-2),
    *(5.5004e-2, 4.9131e-2, 4.4165e-2, 3.9367e-2, 3.6415e-2, 3.3108e-2, 3.0295e-2, 2.7968e-2, 2.5758e-2, 2.4131e-2),
    *(2.2524e-2, 2.1081e-2, 1.9934e-2, 1.8446e-2, 1.7367e-2, 1.6444e-2, 1.5432e-2, 1.4431e-2, 1.3498e-2, 1.2743e-2),
    *(1.1905e-2, 1.1201e-2, 1.0528e-2, 1.0057e-2, 9.6257e-3, 8.9461e-3, 8.3620e-3, 7.8185e-3, 7.1970e-3, 6.7402e-3),
    *(6.3933e-3,),
)
"""Extinction coefficient k of silicon at 380, 390, ... 780 nm: the same source in another form, from another hand,
refractiveindex.info's Green-2008. alpha = 4 pi k / lambda."""


def test_silicon_absorbs_as_its_extinction_coefficient_says() -> None:
    """Both tables are rounded: alpha to three digits, k to three below 450 nm and to five from there on.

    Half a step of the last digit over the number itself, of both together.
    """
    for number, k in enumerate(EXTINCTION):
        nm = 380.0 + 10 * number
        per_cm = float(silicon_absorption_per_m(np.array([nm]))[0]) / 100
        alpha_step = 10.0 ** (math.floor(math.log10(per_cm)) - 2)
        k_step = 1e-3 if nm < 450 else 10.0 ** (math.floor(math.log10(k)) - 4)
        assert 4 * math.pi * k / (nm * 1e-7) == pytest.approx(per_cm, rel=alpha_step / 2 / per_cm + k_step / 2 / k)


@pytest.mark.parametrize(
    ("nm", "per_cm"),
    [
        (450.0, 2.41e4),
        (700.0, 1.89e3),
        (555.0, math.sqrt(6.39e3 * 5.78e3)),  # halfway between 550 and 560 nm, the logarithm is linear
    ],
)
def test_absorption_is_the_published_number(nm: float, per_cm: float) -> None:
    assert silicon_absorption_per_m(np.array([nm]))[0] == pytest.approx(100 * per_cm, rel=1e-12)
    # Beer and Lambert over 3 um, 90 % enter
    assert Silicon().quantum_efficiency(np.array([nm]))[0] == pytest.approx(0.9 * (1 - math.exp(-per_cm * 3e-4)))


def test_quantum_efficiency_is_a_fraction_that_falls_to_the_red() -> None:
    qe = Silicon().quantum_efficiency(WAVELENGTHS_NM)
    assert (qe > 0).all()
    assert (qe <= 0.9).all()
    assert (np.diff(qe) <= 1e-12).all()


def test_electrons_agree_with_a_hand_calculation() -> None:
    """The quickstart's brightest LED, 16 000 cd/m2 at f/2.2, 1.2 um, 160 us, tau 0.9: every 5 nm, in plain Python.

    N = (pi/4) / 2.2^2 * (1.2 um)^2 * 0.9 * 160 us * 16 000 / 683 * sum(S QE lambda) / (h c) / sum(S V), with S and V
    from their tables and QE from k, linear between its 10 nm. The code sums every 1 nm, log(alpha) linear:
    - the trapezoidal rule of 5 nm errs by 3e-5 in the photons and 2.5e-4 in the luminance (against one of 0.01 nm),
    - alpha falls by a tenth in 10 nm, so that a line lies above the exponential by 0.1^2 / 8 = 1.3e-3 at most and
      0.8e-3 on average; QE follows with x / (e^x - 1), 0.3 to 0.8 for x = 3 um * alpha: 6e-4.
    Together below 1e-3.
    """
    h_c = 6.62607015e-34 * 299_792_458
    spectrum, efficiency = colour.SDS_ILLUMINANTS["LED-B3"], colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"]
    photons_qe = luminous = 0.0
    for nm in range(380, 781, 5):
        index, part = divmod(nm - 380, 10)
        after = EXTINCTION[min(index + 1, len(EXTINCTION) - 1)]
        k = EXTINCTION[index] * (1 - part / 10) + after * part / 10
        qe = 0.9 * (1 - math.exp(-4 * math.pi * k / (nm * 1e-9) * 3e-6))
        weight = 2.5 if nm in (380, 780) else 5.0
        photons_qe += weight * float(spectrum[nm]) * qe * nm * 1e-9 / h_c
        luminous += weight * float(spectrum[nm]) * float(efficiency[nm])
    etendue = math.pi / 4 / 2.2**2 * (1.2e-6) ** 2 * 0.9
    by_hand = etendue * 160e-6 * 16_000 / 683 * photons_qe / luminous
    electrons = 16_000 * 160e-6 * electron_rate_per_cd_m2(Camera(), "LED-B3", Silicon())
    assert electrons == pytest.approx(by_hand, rel=1e-3)
    assert electrons == pytest.approx(3313, abs=0.5)  # as recipes and docs/sensor.md say


def test_a_perfect_photodiode_counts_every_photon_of_a_narrow_line() -> None:
    # 1 cd/m2 at 555 nm is 1/683 W/(m2 sr); photons a joule: lambda / (h c) = 555e-9 / 1.98645e-25 = 2.79393e18
    line = (WAVELENGTHS_NM == 555).astype(float)
    watt = np.trapezoid(spectral_radiance(1.0, line), WAVELENGTHS_NM)
    assert watt == pytest.approx(1 / 683, rel=1e-12)


@pytest.mark.parametrize(
    ("change", "factor"),
    [
        ({"f_number": 4.4}, 1 / 4),
        ({"pixel_pitch_um": 2.4}, 4),
        ({"transmittance": 0.45}, 1 / 2),
        ({"focal_length_mm": 36.0}, 1),  # at infinity focus only the f-number counts
        # f_i = f s / (s - f): the working f-number is N / (1 - f / s), of 18 mm
        ({"focus_distance_m": 2.0}, (1 - 0.009) ** 2),
        ({"focus_distance_m": 0.5}, (1 - 0.036) ** 2),
    ],
)
def test_electrons_scale_with_aperture_area_and_transmittance(change: dict[str, float], factor: float) -> None:
    changed = electron_rate_per_cd_m2(Camera(**change), "LED-B3", Silicon())
    assert changed == pytest.approx(factor * electron_rate_per_cd_m2(Camera(), "LED-B3", Silicon()), rel=1e-12)


def test_a_measured_table_is_linear_between_its_wavelengths_and_0_outside() -> None:
    table = QuantumEfficiency(wavelengths_nm=(400.0, 500.0, 700.0), values=(0.2, 0.6, 0.4))
    found = Tabulated(table).quantum_efficiency(np.array([399.9, 400.0, 425.0, 500.0, 600.0, 700.0, 700.1]))
    assert found == pytest.approx([0.0, 0.2, 0.3, 0.6, 0.5, 0.4, 0.0])


@pytest.mark.parametrize("share", [-0.001, 1.001])
def test_an_efficiency_below_0_or_above_1_is_refused(share: float) -> None:
    with pytest.raises(ValidationError, match=r"values\.1"):
        QuantumEfficiency(wavelengths_nm=(400.0, 500.0), values=(0.0, share))
    assert QuantumEfficiency(wavelengths_nm=(400.0, 500.0), values=(0.0, 1.0)).values == (0.0, 1.0)
