"""From photometric units to photoelectrons: cd/m2 at the lens to electrons a second in a pixel.

Electrons in a pixel = (pi/4) (D/f_i)^2 cos^4(theta) A_pix t tau * integral of L_lambda QE(lambda) lambda/(h c) dlambda
with D = f/N and f_i the image distance: D/f_i is one over the working f-number.

Sources: spectra of white LEDs, CIE 15:2018 illuminants LED-B1 to LED-V2; luminous efficiency V(lambda), CIE 1924
photopic observer; both as tabulated by the package colour-science. Silicon: `silicon_absorption_per_m`.
"""

from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import constants

from vlcrender.camera.intrinsics import Camera
from vlcrender.sensor.quantum_efficiency import COLOURS, QuantumEfficiency
from vlcrender.sensor.sensor import Sensor

WAVELENGTHS_NM: NDArray[np.float64] = np.arange(380.0, 781.0, 1.0)
LUMINOUS_EFFICACY_LM_W = 683.0
"""Rounded by every photometric table; 683.002 for V(lambda) in standard air."""


class Detector(Protocol):
    """What turns photons into electrons."""

    def quantum_efficiency(self, wavelengths_nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Electrons a photon, same shape as the wavelengths."""


@dataclass(frozen=True)
class Tabulated:
    """A detector of which a table is known; one colour of it, or "values" where there is no mosaic."""

    table: QuantumEfficiency
    colour: str = "values"

    def quantum_efficiency(self, wavelengths_nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Electrons a photon, same shape as the wavelengths."""
        return self.table.at(wavelengths_nm, self.colour)


@dataclass(frozen=True)
class Silicon:
    """A back-illuminated silicon photodiode: what enters is absorbed in its active depth and collected whole."""

    active_depth_um: float = 3.0
    surface_transmittance: float = 0.9
    temperature_k: float = 300.0

    def quantum_efficiency(self, wavelengths_nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Electrons a photon, same shape as the wavelengths."""
        absorbed = -np.expm1(
            -silicon_absorption_per_m(wavelengths_nm, self.temperature_k) * self.active_depth_um * 1e-6
        )
        qe: NDArray[np.float64] = self.surface_transmittance * absorbed
        return qe


def silicon_absorption_per_m(wavelengths_nm: NDArray[np.float64], temperature_k: float = 300.0) -> NDArray[np.float64]:
    """Absorption coefficient of silicon in 1/m.

    Source: Rajkanan, Singh & Shewchun, Absorption coefficient of silicon for solar cell calculations, Solid-State
    Electronics 22 (1979) 793: two phonon-assisted indirect gaps and one direct gap.
    """
    kt_ev = constants.k * temperature_k / constants.e
    shift = 7.021e-4 * temperature_k**2 / (temperature_k + 1108.0)
    photon_ev = constants.h * constants.c / (wavelengths_nm * 1e-9) / constants.e
    alpha_per_cm = np.zeros_like(photon_ev)
    for gap_ev, a in ((1.1557 - shift, 3.231e2), (2.5 - shift, 7.237e3)):
        for phonon_ev, c in ((1.827e-2, 5.5), (5.773e-2, 4.0)):
            absorbing = np.maximum(photon_ev - gap_ev + phonon_ev, 0) ** 2 / np.expm1(phonon_ev / kt_ev)
            emitting = np.maximum(photon_ev - gap_ev - phonon_ev, 0) ** 2 / -np.expm1(-phonon_ev / kt_ev)
            alpha_per_cm = alpha_per_cm + c * a * (absorbing + emitting)
    alpha_per_cm = alpha_per_cm + 1.052e6 * np.sqrt(np.maximum(photon_ev - (3.2 - shift), 0))
    alpha_per_m: NDArray[np.float64] = alpha_per_cm * 100.0
    return alpha_per_m


@cache
def _colour_science(kind: str, name: str) -> NDArray[np.float64]:
    import colour  # takes a second to load, and only photometry needs it

    table = {"illuminant": colour.SDS_ILLUMINANTS, "efficiency": colour.SDS_LEFS}[kind][name]
    values: NDArray[np.float64] = np.interp(WAVELENGTHS_NM, np.asarray(table.wavelengths), np.asarray(table.values))
    return values


def relative_spectrum(name: str) -> NDArray[np.float64]:
    """Relative spectral power of a CIE LED illuminant at WAVELENGTHS_NM (linear between its 5 nm samples)."""
    return _colour_science("illuminant", name)


def luminous_efficiency() -> NDArray[np.float64]:
    """V(lambda) at WAVELENGTHS_NM."""
    return _colour_science("efficiency", "CIE 1924 Photopic Standard Observer")


def spectral_radiance(luminance_cd_m2: float, spectrum: NDArray[np.float64]) -> NDArray[np.float64]:
    """L_lambda in W/(m2 sr nm) at WAVELENGTHS_NM of a source of this luminance and relative spectrum."""
    luminous = LUMINOUS_EFFICACY_LM_W * np.trapezoid(spectrum * luminous_efficiency(), WAVELENGTHS_NM)
    radiance: NDArray[np.float64] = luminance_cd_m2 * spectrum / luminous
    return radiance


def detectors(sensor: Sensor) -> tuple[Detector, ...]:
    """A sensor's one detector, or with a mosaic those under each of COLOURS."""
    table = sensor.quantum_efficiency
    if table == "silicon":
        return (Silicon(),)
    return tuple(Tabulated(table, colour) for colour in (COLOURS if table.coloured else ("values",)))


def electron_rate_per_cd_m2(camera: Camera, spectrum_name: str, detector: Detector) -> float:
    """Electrons a second in an on-axis pixel that sees 1 cd/m2. The image model of datasets/FORMAT.md's frames."""
    watt_per_nm = spectral_radiance(1.0, relative_spectrum(spectrum_name))
    photon_j = constants.h * constants.c / (WAVELENGTHS_NM * 1e-9)
    electrons = np.trapezoid(watt_per_nm * detector.quantum_efficiency(WAVELENGTHS_NM) / photon_j, WAVELENGTHS_NM)
    solid_angle_sr = np.pi / 4 / camera.working_f_number**2
    area_m2 = (camera.pixel_pitch_um * 1e-6) ** 2
    return float(solid_angle_sr * area_m2 * camera.transmittance * electrons)
