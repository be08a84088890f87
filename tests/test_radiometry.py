"""Light to electrons against hand calculations and closed forms."""

import numpy as np
import pytest

from vlcrender.camera.intrinsics import Camera
from vlcrender.sensor.radiometry import (
    WAVELENGTHS_NM,
    Silicon,
    electron_rate_per_cd_m2,
    luminous_efficiency,
    relative_spectrum,
    silicon_absorption_per_m,
    spectral_radiance,
)


def test_luminance_of_a_spectral_radiance_is_what_was_asked_for() -> None:
    radiance = spectral_radiance(12345.0, relative_spectrum("LED-B3"))
    luminance = 683 * np.trapezoid(radiance * luminous_efficiency(), WAVELENGTHS_NM)
    assert luminance == pytest.approx(12345.0, rel=1e-12)


def test_photopic_efficiency_peaks_at_555_nm() -> None:
    assert WAVELENGTHS_NM[np.argmax(luminous_efficiency())] == 555
    assert luminous_efficiency().max() == 1.0


def test_the_white_led_has_a_blue_peak_and_a_phosphor() -> None:
    spectrum = relative_spectrum("LED-B3")
    blue = (WAVELENGTHS_NM >= 440) & (WAVELENGTHS_NM <= 470)
    dip = (WAVELENGTHS_NM >= 475) & (WAVELENGTHS_NM <= 490)
    phosphor = (WAVELENGTHS_NM >= 560) & (WAVELENGTHS_NM <= 640)
    assert spectrum[dip].min() < 0.6 * min(spectrum[blue].max(), spectrum[phosphor].max())


def test_silicon_absorbs_as_the_textbook_says() -> None:
    # 1.1e4 /cm at 500 nm and about 1e3 /cm at 800 nm; the model is good to 20 to 30 % (Rajkanan et al. 1979)
    alpha_500, alpha_800 = silicon_absorption_per_m(np.array([500.0, 800.0])) / 100
    assert alpha_500 == pytest.approx(1.1e4, rel=0.25)
    assert alpha_800 == pytest.approx(1.0e3, rel=0.3)


def test_quantum_efficiency_is_a_fraction_that_falls_to_the_red() -> None:
    qe = Silicon().quantum_efficiency(WAVELENGTHS_NM)
    assert (qe > 0).all()
    assert (qe <= 0.9).all()
    assert (np.diff(qe) <= 1e-12).all()


def test_electrons_agree_with_a_hand_calculation() -> None:
    # 1e4 cd/m2 at f/2.2, 1.2 um, 1 ms, tau 0.9. LED-B3 has 317 lm/W, so 31.6 W/(m2 sr) reach
    # (pi/4)/2.2^2 = 0.1623 sr * 1.44e-12 m2 * 0.9 = 2.103e-13 m2 sr: 6.64e-12 W. Its photons are about 574 nm on
    # average: 2.89e18 a joule, 1.92e7 a second, 1.92e4 in 1 ms. With a QE of about 0.76: 1.46e4 electrons.
    # The two averages are read off to 2 %, so 3 % together.
    electrons = 1e4 * 1e-3 * electron_rate_per_cd_m2(Camera(), "LED-B3", Silicon())
    assert electrons == pytest.approx(1.46e4, rel=0.03)


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
    ],
)
def test_electrons_scale_with_aperture_area_and_transmittance(change: dict[str, float], factor: float) -> None:
    changed = electron_rate_per_cd_m2(Camera(**change), "LED-B3", Silicon())
    assert changed == pytest.approx(factor * electron_rate_per_cd_m2(Camera(), "LED-B3", Silicon()), rel=1e-12)
