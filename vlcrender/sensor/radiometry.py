"""Radiometry: luminance in cd/m2 to photoelectrons a second in a pixel.

Electrons in a pixel = (pi/4) (D/f_i)^2 cos^4(theta) A_pix t tau * integral of L_lambda QE(lambda) lambda/(h c) dlambda
with D = f/N and f_i the image distance: D/f_i is one over the working f-number.

Sources: spectra of white LEDs and luminous efficiency V(lambda), `spectra`; absorption of silicon, `silicon`.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import constants

from vlcrender.camera.intrinsics import Camera
from vlcrender.sensor.quantum_efficiency import COLOURS, QuantumEfficiency
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.silicon import silicon_absorption_per_m
from vlcrender.sensor.spectra import LED_FIRST_NM, LED_SPECTRA, LED_STEP_NM, LUMINOUS_EFFICIENCY

WAVELENGTHS_NM: NDArray[np.float64] = np.arange(380.0, 781.0, 1.0)
"""The wavelengths of `spectra.LUMINOUS_EFFICIENCY`."""
LUMINOUS_EFFICACY_LM_W = 683.0
"""The rounded value of photometric tables; 683.002 for V(lambda) in standard air."""


class Detector(Protocol):
    """A quantum efficiency over wavelength."""

    def quantum_efficiency(self, wavelengths_nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Electrons per photon, same shape as the wavelengths."""


@dataclass(frozen=True)
class Tabulated:
    """A detector with a tabulated quantum efficiency: one colour of the table, or "values" without a mosaic."""

    table: QuantumEfficiency
    colour: str = "values"

    def quantum_efficiency(self, wavelengths_nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Electrons per photon, same shape as the wavelengths."""
        return self.table.at(wavelengths_nm, self.colour)


@dataclass(frozen=True)
class Silicon:
    """A back-illuminated silicon photodiode at 300 K: every photon absorbed in the active depth gives an electron."""

    active_depth_um: float = 3.0
    """Depth of the photodiode, micrometres."""
    surface_transmittance: float = 0.9
    """Share of the photons that enter the silicon."""

    def quantum_efficiency(self, wavelengths_nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Electrons per photon, same shape as the wavelengths."""
        absorbed = -np.expm1(-silicon_absorption_per_m(wavelengths_nm) * self.active_depth_um * 1e-6)
        qe: NDArray[np.float64] = self.surface_transmittance * absorbed
        return qe


def relative_spectrum(name: str) -> NDArray[np.float64]:
    """Relative spectral power of a CIE LED illuminant at WAVELENGTHS_NM (linear between its 5 nm samples)."""
    spectrum = LED_SPECTRA[name]
    samples_nm = LED_FIRST_NM + LED_STEP_NM * np.arange(len(spectrum))
    return np.asarray(np.interp(WAVELENGTHS_NM, samples_nm, spectrum), dtype=np.float64)


def luminous_efficiency() -> NDArray[np.float64]:
    """V(lambda) at WAVELENGTHS_NM."""
    return np.array(LUMINOUS_EFFICIENCY)


def spectral_radiance(luminance_cd_m2: float, spectrum: NDArray[np.float64]) -> NDArray[np.float64]:
    """L_lambda in W/(m2 sr nm) at WAVELENGTHS_NM of a source with this luminance and relative spectrum."""
    luminous = LUMINOUS_EFFICACY_LM_W * np.trapezoid(spectrum * luminous_efficiency(), WAVELENGTHS_NM)
    radiance: NDArray[np.float64] = luminance_cd_m2 * spectrum / luminous
    return radiance


def detectors(sensor: Sensor) -> tuple[Detector, ...]:
    """The detector of a sensor, or with a mosaic the detectors of COLOURS in order."""
    table = sensor.quantum_efficiency
    if table == "silicon":
        return (Silicon(),)
    return tuple(Tabulated(table, colour) for colour in (COLOURS if table.coloured else ("values",)))


def electron_rate_per_cd_m2(camera: Camera, spectrum_name: str, detector: Detector) -> float:
    """Electrons a second in a pixel on the optical axis, per cd/m2 of luminance."""
    watt_per_nm = spectral_radiance(1.0, relative_spectrum(spectrum_name))
    photon_j = constants.h * constants.c / (WAVELENGTHS_NM * 1e-9)
    electrons = np.trapezoid(watt_per_nm * detector.quantum_efficiency(WAVELENGTHS_NM) / photon_j, WAVELENGTHS_NM)
    solid_angle_sr = np.pi / 4 / camera.working_f_number**2
    fx, fy = camera.focal_xy_px
    # A pixel sees a solid angle of 1 / (fx fy), not of 1 / f_i^2. The factor is exactly 1 for fx = fy.
    area_m2 = (camera.pixel_pitch_um * 1e-6) ** 2 * (camera.focal_px**2 / (fx * fy))
    return float(solid_angle_sr * area_m2 * camera.transmittance * electrons)
