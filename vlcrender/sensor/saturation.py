"""Expected results of photon transfer at saturation, from the settings of a sensor."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from vlcrender.sensor.sensor import Sensor

Array = NDArray[np.float64]


def full_well_e(sensor: Sensor, dark_e: float) -> float:
    """Mean signal of a full pixel, electrons over the dark mean `dark_e`: limited by the well or by the ADC.

    Where both limits are close, the ADC clips part of the noise that is added after the well.
    """
    acting, gain = sensor.acting(), sensor.gain_at_iso_e_per_dn
    parts = [acting["read_noise_e"], acting["adc_noise_dn"] * gain, acting["row_offset_e"], acting["column_offset_e"]]
    noise = max(float(np.linalg.norm(parts)), 1e-6)
    mean, _ = clipped(np.array(sensor.full_well_e), np.array(noise), _adc_e(sensor))
    return float(mean) - dark_e


def saturation_e(sensor: Sensor, dark_e: float, levels_e: Array, pixels: int) -> tuple[float, float]:
    """Signal of the largest temporal variance, electrons, and the standard error of its measurement.

    The measurement picks one of `levels_e`, evenly spaced, by variances over `pixels` pixels with a relative standard
    error of sqrt(2 / pixels). It may pick any level whose expected variance is within 4 standard errors of a difference
    from the largest, or a neighbour of the best. The farthest of these levels counts as 4 standard errors.
    """
    fine = np.linspace(0.5 * levels_e[-1], levels_e[-1], 2001)
    variances = _temporal_variance_e2(sensor, dark_e, fine)
    best = float(fine[np.argmax(variances)])
    doubt = 4 * np.sqrt(2) * np.sqrt(2 / pixels)
    good = levels_e[_temporal_variance_e2(sensor, dark_e, levels_e) >= (1 - doubt) * variances.max()]
    return best, float(max(np.abs(good - best).max(initial=0.0), levels_e[1] - levels_e[0])) / 4


def _temporal_variance_e2(sensor: Sensor, dark_e: float, signal_e: Array) -> Array:
    """Variance at mean signals, shape (n,), averaged over the pixels' responses and offsets (31 nodes).

    The well clips before read noise is added, the ADC after.
    """
    acting, gain = sensor.acting(), sensor.gain_at_iso_e_per_dn
    after_e2 = acting["read_noise_e"] ** 2 + (acting["adc_noise_dn"] * gain) ** 2
    nodes, weights = np.polynomial.hermite_e.hermegauss(31)
    spread = np.hypot(acting["prnu"] * signal_e, acting["dsnu_e"])
    means = np.maximum((signal_e + dark_e)[:, None] + spread[:, None] * nodes, 1e-9)
    if sensor.full_well_e <= _adc_e(sensor):
        variances = clipped(means, np.sqrt(means), sensor.full_well_e)[1] + after_e2
    else:
        variances = clipped(means, np.sqrt(means + after_e2), _adc_e(sensor))[1]
    average: Array = variances @ weights / weights.sum()
    return average


def _adc_e(sensor: Sensor) -> float:
    """Electrons of the largest number of the ADC."""
    return (sensor.largest_dn - sensor.black_level_dn) * sensor.gain_at_iso_e_per_dn


def clipped(mean: Array, deviation: Array, limit: float) -> tuple[Array, Array]:
    """Mean and variance of normal variables clipped at a limit.

    With x standard normal and Q = 1 - Phi: E min(x, z) = z Q - phi and E min(x, z)^2 = Phi - z phi + z^2 Q.
    """
    z = (limit - mean) / deviation
    density, beyond = np.exp(-z * z / 2) / np.sqrt(2 * np.pi), ndtr(-z)
    first = z * beyond - density
    second = ndtr(z) - z * density + z * z * beyond
    return mean + deviation * first, deviation**2 * (second - first**2)
