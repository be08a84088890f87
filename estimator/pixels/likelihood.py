"""How likely readings are: expected electrons, their variance, and what they say of the pose.

A reading expects `background + amplitude x light`, the light being the share of the LED's that falls on its pixels;
amplitude and background of each LED (of each colour, where the sensor has a mosaic) are not known. Given the pose they
follow in closed form, weighted by 1 / variance under the model. What they could explain of a change of the pose is
taken out of the information about it: the Schur complement.

With `sensor.noise` "full" the variance is that of shot noise plus what the data sheet says of the dark image, of
PRNU and of rounding (quasi-likelihood); offsets of whole rows and columns are taken for noise of single pixels, which
they are not. With noise "none" it is as if there were shot noise.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.io.dataset import DeviceFrame
from estimator.pixels.led_model import Drawing
from estimator.pixels.measurements import Measurements

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A pixel this near to full, in standard deviations, may have been cut off: whether it was may not decide its use.
CLEAR_OF_FULL = 5.0
# Light below this, in electrons, is as good as none: it keeps weights finite.
MIN_VARIANCE_E2 = 1e-3
# Readings that fix amplitude and background no better than this leave them open, and take no part.
MIN_DETERMINANT = 1e-9
# An LED's chi-square may exceed its degrees of freedom by its own scatter and by what the model leaves out of a true
# LED's edge, where most is this share of its light: a lens blurs no better known than that, or a shift of 0.1 px.
CHI2_SIGMA = 5.0
MODEL_SHARE = 0.05


@dataclass(frozen=True)
class Noise:
    """What adds to shot noise: variance of a dark pixel, PRNU squared, and the electrons that fill a pixel."""

    dark_e2: float
    prnu2: float
    full_e: float

    @staticmethod
    def of(frame: DeviceFrame) -> "Noise":
        """What a frame's sensor says."""
        sensor = frame.sensor
        dark_e2 = sensor.floor_e2() + sensor.row_offset_e**2 + sensor.column_offset_e**2
        full_e = (sensor.full_dn() - sensor.black_level_dn) * sensor.gain_e_per_dn
        return Noise(dark_e2, sensor.prnu**2, full_e)


@dataclass(frozen=True, eq=False)
class LedLight:
    """Amplitudes and backgrounds given the pose, by closed form, and what they leave, reading by reading."""

    light: Floats
    """(m,): share of a full pixel's light."""
    amplitude: Floats
    """(g,), as `signal_to_noise`."""
    signal_to_noise: Floats
    expected: Floats
    """(m,), as `weight`, which is 1 / variance and 0 for what takes no part."""
    weight: Floats
    inverse: Floats
    """(2, 2, g): covariance of background and amplitude; 0 where the readings do not fix them."""
    deviance: float
    """Twice what the mean reading's log likelihood is below that of a model that fits it exactly: some 1."""


def led_light(
    measurements: Measurements, drawing: Drawing, used: Mask, noise: Noise, before: LedLight | None = None
) -> LedLight:
    """Amplitude and background of every group under a pose, weighted by the variances of those before, or by none.

    `used` (n,) says which LEDs take part.
    """
    n, y, group = measurements.pixels, measurements.electrons, measurements.group
    s = np.concatenate([measurements.weights * drawing.share[measurements.cells], measurements.flat_light])
    taking_part = used[measurements.led][group]
    weight = taking_part / n if before is None else before.weight
    products = np.stack([n * n, n * s, s * s, n * y, s * y])
    # Without variances from before, their first guess is worth making anew.
    for _ in range(3 if before is None else 1):
        nn, ns, ss, ny, sy = measurements.total(products * weight)
        determinant = nn * ss - ns * ns
        fixed = determinant > MIN_DETERMINANT * nn * ss
        safe = np.where(fixed, determinant, 1.0)
        inverse = np.stack([ss, -ns, -ns, nn]).reshape(2, 2, -1) * (fixed / safe)
        background, amplitude = np.einsum("ijg,jg->ig", inverse, np.stack([ny, sy]))
        expected = n * background[group] + s * amplitude[group]
        each = np.maximum(expected / n, 0.0)
        variance = np.maximum(each + noise.dark_e2 + noise.prnu2 * each**2, MIN_VARIANCE_E2)
        clear = each + CLEAR_OF_FULL * np.sqrt(variance) < noise.full_e
        weight = np.where(taking_part & clear & fixed[group], 1 / (variance * n), 0.0)
    sigma = np.sqrt(inverse[1, 1])
    signal_to_noise = np.divide(amplitude, sigma, out=np.zeros_like(sigma), where=sigma > 0)
    deviance = _mean_deviance(y[weight > 0], expected[weight > 0], n[weight > 0] * noise.dark_e2)
    return LedLight(s, amplitude, signal_to_noise, expected, weight, inverse, deviance)


def _mean_deviance(electrons: Floats, expected: Floats, dark_e2: Floats) -> float:
    """Of Poisson variables; what adds a variance of its own is as good as so many electrons more."""
    if len(electrons) == 0:
        return 0.0
    had, due = np.maximum(electrons + dark_e2, 1e-9), np.maximum(expected + dark_e2, MIN_VARIANCE_E2)
    return float(2 * (had * np.log(had / due) - (had - due)).mean())


def score(measurements: Measurements, drawing: Drawing, light: LedLight) -> tuple[Floats, Floats]:
    """Information (6, 6) and gradient (6,) of the log likelihood by the pose, what the light could explain taken out.

    Flat pixels do not change with the pose.
    """
    edges = len(measurements.cells)
    brightness = measurements.weights * light.amplitude[measurements.group[:edges]]
    slopes = drawing.slopes(measurements.cells) * brightness[:, None]
    weighted = slopes.T * light.weight[:edges]
    information = weighted @ slopes
    gradient = weighted @ (measurements.electrons - light.expected)[:edges]
    # Information between the pose and each group's background and amplitude.
    mixed = measurements.total(np.stack([weighted, weighted * light.light[:edges]]))
    explained = np.einsum("ipg,ijg,jqg->pq", mixed, light.inverse, mixed, optimize=True)
    return information - explained, gradient


def misfit(measurements: Measurements, drawing: Drawing, light: LedLight) -> Floats:
    """By how much the chi2 of each group (g,) exceeds what it may be: above 0 an LED does not look like itself."""
    weight, edges = light.weight, len(measurements.cells)
    chi2 = measurements.total((measurements.electrons - light.expected) ** 2 * weight)
    freedom = np.maximum(measurements.total((weight > 0).astype(float)) - 2, 0.0)
    # A sharp edge's model is wrong where the edge is: 4 share (1 - share) is 1 half way and nothing where it is flat.
    share = drawing.share[measurements.cells]
    wrong_e = MODEL_SHARE * light.amplitude[measurements.group[:edges]] * 4 * share * (1 - share)
    return np.asarray(
        chi2 - freedom - CHI2_SIGMA * np.sqrt(2 * freedom) - measurements.total(wrong_e**2 * weight[:edges])
    )
