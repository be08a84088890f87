"""Likelihood of pixel readings: expected electrons, their variance, and the information about the pose.

A reading is expected to be `background + amplitude x light`, where light is the LED's share of the pixels' light.
Amplitude and background of each LED (of each colour, if the sensor has a mosaic) are unknown. Given the pose they have
a closed form, a linear fit weighted by 1 / variance under the model. The part of a change of the pose that they could
explain is subtracted from the information: the Schur complement.

With `sensor.noise` "full" the variance is shot noise plus the data sheet's dark noise, PRNU and rounding
(quasi-likelihood). Offsets of whole rows and columns are approximated by independent noise of the pixels. With noise
"none" shot noise is assumed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.io.device import DeviceFrame
from estimator.pixels.led_model import RenderedLeds
from estimator.pixels.led_pixels import LedPixels

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Expected distance from saturation, in standard deviations, below which a pixel is not used. The expectation decides,
# not the reading: excluding high readings would bias the mean.
SATURATION_MARGIN_SIGMA = 5.0
# Lower limit of a variance, electrons squared: keeps weights finite.
MIN_VARIANCE_E2 = 1e-3
# Relative determinant below which readings do not determine amplitude and background; they are then not used.
MIN_DETERMINANT = 1e-9
# Limit of an LED's chi-square: its degrees of freedom, its own scatter in standard deviations, and a model error of the
# edge, at most this share of the LED's light: by an inaccurate blur of the lens, or a shift of 0.05 px.
CHI2_SIGMA = 5.0
MODEL_ERROR_SHARE = 0.05


@dataclass(frozen=True)
class Noise:
    """Noise beside shot noise: variance of a dark pixel, PRNU squared, and the electrons that saturate a pixel."""

    dark_e2: float
    prnu2: float
    saturation_e: float

    @staticmethod
    def of(frame: DeviceFrame) -> "Noise":
        """Noise of a frame's sensor."""
        sensor = frame.sensor
        dark_e2 = sensor.floor_e2() + sensor.row_offset_e**2 + sensor.column_offset_e**2
        saturation_e = (sensor.clipping_dn() - sensor.black_level_dn) * sensor.gain_e_per_dn
        return Noise(dark_e2, sensor.prnu**2, saturation_e)


@dataclass(frozen=True, eq=False)
class PhotometricFit:
    """Amplitudes and backgrounds of g groups given the pose, and the m readings expected by them.

    `light` (m,) is the share of a full pixel's light; `amplitude` and `signal_to_noise` are (g,); `expected` (m,) are
    electrons; `weight` (m,) is 1 / variance, 0 for readings not used; `covariance` (2, 2, g) is that of background and
    amplitude, 0 if the readings do not determine them; `deviance` is the mean over the readings of twice the log
    likelihood ratio of a saturated model, expected to be near 1.
    """

    light: Floats
    amplitude: Floats
    signal_to_noise: Floats
    expected: Floats
    weight: Floats
    covariance: Floats
    deviance: float


def fit_photometry(
    pixels: LedPixels, rendered: RenderedLeds, used: Mask, noise: Noise, before: PhotometricFit | None = None
) -> PhotometricFit:
    """Amplitude and background of every group under a pose, weighted by the variances of a previous fit, if any.

    `used` (n,) are the LEDs to use.
    """
    n, y, group = pixels.pixel_counts, pixels.electrons, pixels.group
    s = np.concatenate([pixels.weights * rendered.share[pixels.cells], pixels.uniform_light])
    of_used_led = used[pixels.led][group]
    weight = of_used_led / n if before is None else before.weight
    products = np.stack([n * n, n * s, s * s, n * y, s * y])
    # Without variances of a previous fit, iterate: the first weights are a guess.
    for _ in range(3 if before is None else 1):
        nn, ns, ss, ny, sy = pixels.sum_by_group(products * weight)
        determinant = nn * ss - ns * ns
        determined = determinant > MIN_DETERMINANT * nn * ss
        safe = np.where(determined, determinant, 1.0)
        covariance = np.stack([ss, -ns, -ns, nn]).reshape(2, 2, -1) * (determined / safe)
        background, amplitude = np.einsum("ijg,jg->ig", covariance, np.stack([ny, sy]))
        expected = n * background[group] + s * amplitude[group]
        per_pixel = np.maximum(expected / n, 0.0)
        variance = np.maximum(per_pixel + noise.dark_e2 + noise.prnu2 * per_pixel**2, MIN_VARIANCE_E2)
        unsaturated = per_pixel + SATURATION_MARGIN_SIGMA * np.sqrt(variance) < noise.saturation_e
        weight = np.where(of_used_led & unsaturated & determined[group], 1 / (variance * n), 0.0)
    sigma = np.sqrt(covariance[1, 1])
    signal_to_noise = np.divide(amplitude, sigma, out=np.zeros_like(sigma), where=sigma > 0)
    deviance = _mean_deviance(y[weight > 0], expected[weight > 0], n[weight > 0] * noise.dark_e2)
    return PhotometricFit(s, amplitude, signal_to_noise, expected, weight, covariance, deviance)


def _mean_deviance(electrons: Floats, expected: Floats, dark_e2: Floats) -> float:
    """Mean deviance of Poisson variables; a Gaussian variance s^2 is approximated by s^2 extra Poisson electrons."""
    if len(electrons) == 0:
        return 0.0
    observed, mean = np.maximum(electrons + dark_e2, 1e-9), np.maximum(expected + dark_e2, MIN_VARIANCE_E2)
    return float(2 * (observed * np.log(observed / mean) - (observed - mean)).mean())


def score(pixels: LedPixels, rendered: RenderedLeds, photometry: PhotometricFit) -> tuple[Floats, Floats]:
    """Information (6, 6) and gradient (6,) of the log likelihood by the pose, amplitudes and backgrounds eliminated.

    Uniform pixels do not depend on the pose.
    """
    edges = len(pixels.cells)
    brightness = pixels.weights * photometry.amplitude[pixels.group[:edges]]
    slopes = rendered.slopes(pixels.cells) * brightness[:, None]
    weighted = slopes.T * photometry.weight[:edges]
    information = weighted @ slopes
    gradient = weighted @ (pixels.electrons - photometry.expected)[:edges]
    # Mixed information of the pose and each group's background and amplitude.
    mixed = pixels.sum_by_group(np.stack([weighted, weighted * photometry.light[:edges]]))
    explained = np.einsum("ipg,ijg,jqg->pq", mixed, photometry.covariance, mixed, optimize=True)
    return information - explained, gradient


def excess_chi2(pixels: LedPixels, rendered: RenderedLeds, photometry: PhotometricFit) -> Floats:
    """Excess of each group's chi-square, (g,), over its limit: positive for an LED that the model does not explain."""
    weight, edges = photometry.weight, len(pixels.cells)
    chi2 = pixels.sum_by_group((pixels.electrons - photometry.expected) ** 2 * weight)
    freedom = np.maximum(pixels.sum_by_group((weight > 0).astype(float)) - 2, 0.0)
    # The model error is largest at the edge: 4 share (1 - share) is 1 at half coverage and 0 on uniform pixels.
    share = rendered.share[pixels.cells]
    model_error_e = MODEL_ERROR_SHARE * photometry.amplitude[pixels.group[:edges]] * 4 * share * (1 - share)
    model_chi2 = pixels.sum_by_group(model_error_e**2 * weight[:edges])
    return np.asarray(chi2 - freedom - CHI2_SIGMA * np.sqrt(2 * freedom) - model_chi2)
