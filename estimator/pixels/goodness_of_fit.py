"""Goodness of fit of LED images: which of them the model does not explain."""

import numpy as np
from numpy.typing import NDArray

from estimator.pixels.led_pixels import LedPixels
from estimator.pixels.likelihood import PhotometricFit

Floats = NDArray[np.float64]

# Limit of an LED's chi-square: its degrees of freedom, its own scatter in standard deviations, and a model error of the
# edge, at most this share of the LED's light: by an inaccurate blur of the lens, or a shift of 0.05 px.
CHI2_SIGMA = 5.0
MODEL_ERROR_SHARE = 0.05


def excess_chi2(pixels: LedPixels, photometry: PhotometricFit) -> Floats:
    """Excess of each group's chi-square, (g,), over its limit: positive for an LED that the model does not explain."""
    weight = photometry.weight
    chi2 = pixels.sum_by_group((pixels.electrons - photometry.expected) ** 2 * weight)
    freedom = np.maximum(pixels.sum_by_group((weight > 0).astype(float)) - photometry.covariance.shape[1], 0.0)
    # The model error is largest at the edge: 4 share (1 - share) is 1 at half coverage and 0 on uniform pixels.
    share = photometry.light / pixels.background[:, 0]
    model_error_e = MODEL_ERROR_SHARE * photometry.amplitude[pixels.group] * 4 * share * (1 - share)
    if photometry.gain is not None:
        model_error_e *= photometry.gain
    model_chi2 = pixels.sum_by_group(model_error_e**2 * weight)
    return np.asarray(chi2 - freedom - CHI2_SIGMA * np.sqrt(2 * freedom) - model_chi2)
