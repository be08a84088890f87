"""Likelihood of pixel readings: expected electrons, their variance, and the information about the pose.

A reading is expected to be `background + amplitude x light x (1 + profile)`. Light is the LED's share of the pixels'
light, dimmed by the lens. The background is the lens's fall-off times a quadratic polynomial (without the product ab
and the difference a^2 - b^2) in the coordinates a, b on the face: the room's light changes across an LED, and a halo of
the LED's own light falls off around it. The profile (luminance over the face) is given. Amplitude and background of
each LED (of each colour, if the sensor has a mosaic) are unknown. Given the image they have a closed form, a linear fit
weighted by 1 / variance under the model; that the background changes by more than its own level is improbable a priori.
The part of a change of the image that they could explain is subtracted from the information: the Schur complement.

The light of an LED that sends is multiplied by the gain of each line (`LedPixels.gains`), whose phase is known about as
well as a receiver decodes it. A small error of the phase changes the light linearly: its product with the amplitude is
one more coefficient of the linear fit, about the phase of the fit before.

With `sensor.noise` "full" the variance is shot noise plus the data sheet's dark noise, PRNU and rounding
(quasi-likelihood). Offsets of whole rows and columns are approximated by independent noise of the pixels. With noise
"none" shot noise is assumed.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimator.camera.motion import MOTION_PARAMETERS
from estimator.io.device import DeviceFrame
from estimator.pixels.led_model import IMAGE_PARAMETERS, LOCAL_PARAMETERS, PROFILE_PARAMETERS, RenderedLeds
from estimator.pixels.led_pixels import LedPixels
from estimator.spots.spot_pixels import MAX_ROUNDING_SHARE

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Expected distance from saturation, in standard deviations, below which a pixel is not used. The expectation decides,
# not the reading: excluding high readings would bias the mean.
SATURATION_MARGIN_SIGMA = 3.0
# Lower limit of a variance, electrons squared: keeps weights finite.
MIN_VARIANCE_E2 = 1e-3
# Background coefficients and amplitude of a group.
COEFFICIENTS = 5
AMPLITUDE = COEFFICIENTS - 1
# Standard deviation of the phase of an LED's wave as decoded, in lines: ours, half a line, which the image of any LED
# that was decoded improves on.
PHASE_SIGMA_LINES = 0.5
# Largest change of the phase in one fit, and in all, lines.
MAX_PHASE_STEP = 0.5
MAX_PHASE = 2.0
# Relative determinant below which readings do not determine amplitude and background, which are not used then.
MIN_DETERMINANT = 1e-9
# Standard deviations a priori of the background's slopes by a and b, its curvature: relative to
# the background's level plus HALO_SHARE of the amplitude.
BACKGROUND_SIGMAS = (0.3, 0.3, 0.05)
HALO_SHARE = 0.05
# Limit of an LED's chi-square: its degrees of freedom, its own scatter in standard deviations, and a model error of the
# edge, at most this share of the LED's light: by an inaccurate blur of the lens, or a shift of 0.05 px.
CHI2_SIGMA = 5.0
MODEL_ERROR_SHARE = 0.05
# Share of an LED's light below which a pixel counts as unlit.
MAX_UNLIT_SHARE = 1e-3


@dataclass(frozen=True)
class Noise:
    """Noise beside shot noise: variance of a dark pixel, PRNU squared, and the electrons that saturate a pixel.

    `rounding_e2` is the part of the dark pixel's variance that is by the ADC's steps.
    """

    dark_e2: float
    prnu2: float
    saturation_e: float
    rounding_e2: float = 0.0

    @staticmethod
    def of(frame: DeviceFrame, excess_e2: float = 0.0) -> "Noise":
        """Noise of a frame's sensor as stated, and a variance beside it, electrons squared."""
        sensor = frame.sensor
        dark_e2 = sensor.floor_e2() + sensor.row_offset_e**2 + sensor.column_offset_e**2 + excess_e2
        saturation_e = (sensor.clipping_dn() - sensor.black_level_dn) * sensor.gain
        return Noise(dark_e2, sensor.prnu**2, saturation_e, sensor.rounding_e2())

    def reduced_where_alike(self, variance: Floats, off_e: Floats, n: Floats, unlit: Mask, group: Ints) -> Floats:
        """Variances (m,) of pixels; those of `unlit` ones as measured in each group where the ADC's steps exceed noise.

        Pixels of an even background are then rounded alike, while `variance` has independent rounding errors. `off_e`
        are the readings, of `n` pixels each, less what is expected.
        """
        alike = np.flatnonzero(unlit & (self.rounding_e2 > MAX_ROUNDING_SHARE * variance))
        if not len(alike):
            return variance
        of_group, stated = group[alike], variance[alike]
        squares = np.bincount(of_group, off_e[alike] ** 2 / (stated * n[alike]))
        freedom = np.maximum(np.bincount(of_group) - AMPLITUDE, 1)
        reduced = variance.copy()
        reduced[alike] = np.clip(stated * (squares / freedom)[of_group], stated - self.rounding_e2, stated)
        return reduced


@dataclass(frozen=True, eq=False)
class PhotometricFit:
    """Amplitudes and backgrounds of g groups given the image, and the m readings expected by them.

    `basis` (m, c) are the derivatives of the readings by a group's c = 5 coefficients, four of the background and its
    amplitude, and where LEDs send by a sixth, the amplitude times a change of the phase;
    `amplitude`, `background` (by the face) and `signal_to_noise` are (g,); `expected` (m,) are electrons; `weight` (m,)
    is 1 / variance, 0 for readings not used; `covariance` (g, c, c) is that of the coefficients, 0 if the readings do
    not determine them; `level` (g,) is the scale of the background's prior; `deviance` is the mean over the readings of
    twice the log likelihood ratio of a saturated model, expected to be near 1. Where LEDs send, `phase` (g,) are the
    errors of their waves' phases, in lines, and `gain` (m,) the gains by which the light of the readings is multiplied.
    """

    basis: Floats
    amplitude: Floats
    background: Floats
    signal_to_noise: Floats
    expected: Floats
    weight: Floats
    covariance: Floats
    level: Floats
    deviance: float
    phase: Floats | None = None
    gain: Floats | None = None


def fit_photometry(
    pixels: LedPixels,
    rendered: RenderedLeds,
    used: Mask,
    noise: Noise,
    before: PhotometricFit | None = None,
    profile: Floats | None = None,
    may_enter: bool = True,
) -> PhotometricFit:
    """Amplitude and background of every group, weighted by the variances of a previous fit, if any.

    `used` (n,) are the LEDs to use; `profile` (n, 3) are the coefficients of a, b and a^2 + b^2 - 1/2 of each LED's
    luminance, 0 if None. Readings that the previous fit did not use may enter if `may_enter`, and else may only leave.
    """
    n, y, group = pixels.pixel_counts, pixels.electrons, pixels.group
    light = pixels.light(rendered)
    if profile is not None:
        light = light * (1 + np.einsum("mi,mi->m", pixels.face, profile[pixels.led][group]))
    unlit = light < MAX_UNLIT_SHARE * pixels.background[:, 0]
    floor_e = _floor_e(pixels, unlit)
    phase = gain = None
    if pixels.gains is not None:
        phase = np.zeros(len(pixels.led)) if before is None or before.phase is None else before.phase
    of_used_led = used[pixels.led][group]
    weight = of_used_led / n if before is None else before.weight
    level = np.maximum.reduceat(y / n, pixels.starts[:-1]) if before is None else before.level
    count = COEFFICIENTS if phase is None else COEFFICIENTS + 1
    # One coefficient after another in memory: (c + 1, m), the readings last.
    columns = np.empty((count + 1, len(y)))
    columns[:AMPLITUDE], columns[AMPLITUDE], columns[-1] = pixels.background.T, light, y
    # Without variances of a previous fit, iterate: the first weights are a guess.
    for _ in range(3 if before is None else 1):
        if pixels.gains is not None and phase is not None:
            gain, by_phase = pixels.gains.at(phase)
            columns[AMPLITUDE], columns[AMPLITUDE + 1] = light * gain, light * by_phase
        normal, right = _normal_equations(pixels.starts, columns, weight)
        determined = (normal[:, 0, 0] > 0) & (normal[:, AMPLITUDE, AMPLITUDE] > 0)
        prior = np.maximum(np.outer(level, BACKGROUND_SIGMAS), MIN_VARIANCE_E2) ** -2.0
        slopes = range(1, AMPLITUDE)
        normal[:, slopes, slopes] += prior
        if phase is not None:
            # The prior is that of the phase, of which the coefficient changes `phase` by its ratio to the amplitude.
            bright = np.maximum(level if before is None else before.amplitude, MIN_VARIANCE_E2)
            of_phase = (PHASE_SIGMA_LINES * bright) ** -2.0
            normal[:, -1, -1] += of_phase
            right[:, -1] -= of_phase * bright * phase
        normal[~determined] = np.eye(count)
        # Of matrices with a diagonal of ones: no larger than the determinant of background and amplitude alone.
        determined &= np.linalg.det(_of_equal_size(normal)[0]) > MIN_DETERMINANT
        normal[~determined] = np.eye(count)
        covariance = _inverse(normal) * determined[:, None, None]
        coefficients = np.einsum("gij,gj->gi", covariance, right)
        expected = (columns[:-1] * np.repeat(coefficients.T, np.diff(pixels.starts), axis=1)).sum(axis=0)
        per_pixel = np.maximum(expected / n, floor_e)
        variance = per_pixel + noise.dark_e2 + noise.prnu2 * per_pixel**2
        variance = np.maximum(noise.reduced_where_alike(variance, y - expected, n, unlit, group), MIN_VARIANCE_E2)
        unsaturated = per_pixel + SATURATION_MARGIN_SIGMA * np.sqrt(variance) < noise.saturation_e
        usable = of_used_led & unsaturated & determined[group]
        if before is not None and not may_enter:
            usable &= before.weight > 0
        weight = np.where(usable, 1 / (variance * n), 0.0)
        if phase is not None:
            bright = coefficients[:, AMPLITUDE]
            change = np.divide(coefficients[:, -1], bright, out=np.zeros_like(bright), where=bright > 0)
            phase = np.clip(phase + np.clip(change, -MAX_PHASE_STEP, MAX_PHASE_STEP), -MAX_PHASE, MAX_PHASE)
        level = np.maximum(coefficients[:, 0], 0.0) + HALO_SHARE * np.maximum(coefficients[:, AMPLITUDE], 0.0)
    amplitude = coefficients[:, AMPLITUDE]
    sigma = np.sqrt(covariance[:, AMPLITUDE, AMPLITUDE])
    signal_to_noise = np.divide(amplitude, sigma, out=np.zeros_like(sigma), where=sigma > 0)
    weighed = weight > 0
    deviance = _mean_deviance(y[weighed], expected[weighed], n[weighed] * noise.dark_e2)
    return PhotometricFit(
        columns[:-1].T,
        amplitude,
        coefficients[:, 0],
        signal_to_noise,
        expected,
        weight,
        covariance,
        level,
        deviance,
        phase,
        gain,
    )


def _floor_e(pixels: LedPixels, unlit: Mask) -> Floats:
    """Half of the mean of the unlit pixels of each reading's group, (m,): no expectation is lower.

    The background of a few counts, extrapolated, may come out at 0 or less: its pixels would have no noise. Half a
    count more (Jeffreys 1946), so that no counts at all do not either.
    """
    counts = pixels.sum_by_group(np.where(unlit, pixels.electrons, 0.0))
    sizes = pixels.sum_by_group(np.where(unlit, pixels.pixel_counts, 0.0))
    return np.asarray(((np.maximum(counts, 0.0) + 0.5) / np.maximum(sizes, 1.0))[pixels.group] / 2)


def _normal_equations(starts: Ints, columns: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Normal equations (g, c, c) and right-hand sides (g, c) of readings (m,), weighted (m,).

    `columns` (c + 1, m) are the derivatives by the c coefficients, then the readings.
    """
    weighted = columns * weight
    bounds = pairwise(starts.tolist())
    products = np.stack([weighted[:, first:end] @ columns[:, first:end].T for first, end in bounds])
    return products[:, :-1, :-1], products[:, :-1, -1]


def _inverse(matrices: Floats) -> Floats:
    """Inverses of positive definite matrices (n, k, k)."""
    scaled, scale = _of_equal_size(matrices)
    return np.asarray(np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None])


def _of_equal_size(matrices: Floats) -> tuple[Floats, Floats]:
    """Positive definite matrices (n, k, k) with parameters scaled to a diagonal of ones, and the scales (n, k)."""
    scale = 1 / np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
    return np.asarray(matrices * scale[:, :, None] * scale[:, None]), np.asarray(scale)


def _mean_deviance(electrons: Floats, expected: Floats, dark_e2: Floats) -> float:
    """Mean deviance of Poisson variables; a Gaussian variance s^2 is approximated by s^2 extra Poisson electrons."""
    if len(electrons) == 0:
        return 0.0
    observed, mean = np.maximum(electrons + dark_e2, 1e-9), np.maximum(expected + dark_e2, MIN_VARIANCE_E2)
    return float(2 * (observed * np.log(observed / mean) - (observed - mean)).mean())


def score(
    pixels: LedPixels, rendered: RenderedLeds, photometry: PhotometricFit, profile: Floats | None = None
) -> tuple[Floats, Floats]:
    """Information (n, p, p) and gradient (n, p) of the log likelihood by the LOCAL_PARAMETERS of each of n LEDs.

    Those of the motion follow where `rendered` has derivatives by them.

    Amplitudes and backgrounds are eliminated. Parameters that `rendered` has no derivatives by have no information; so
    has the profile if `profile` (n, 3) is None.
    """
    slopes = rendered.slopes(pixels.cells).T
    edges, light = pixels.edges, None
    if photometry.gain is not None:
        slopes *= photometry.gain[edges]
    if profile is not None:
        slopes *= (1 + np.einsum("mi,mi->m", pixels.face, profile[pixels.led][pixels.group]))[edges]
        light = pixels.light(rendered) if photometry.gain is None else pixels.light(rendered) * photometry.gain
    residual = photometry.weight * (pixels.electrons - photometry.expected)
    columns = rendered.parameters
    in_motion = bool((columns >= LOCAL_PARAMETERS).any())
    if profile is not None:
        columns = np.concatenate([columns, IMAGE_PARAMETERS + np.arange(PROFILE_PARAMETERS)])
    all_of_them = LOCAL_PARAMETERS + (MOTION_PARAMETERS if in_motion else 0)
    information = np.zeros((len(pixels.leds), all_of_them, all_of_them))
    gradient = np.zeros((len(pixels.leds), all_of_them))
    first_edge = np.searchsorted(edges, pixels.starts).tolist()
    bounds = zip(pairwise(pixels.starts.tolist()), pairwise(first_edge), strict=True)
    for g, ((start, end), (first, last)) in enumerate(bounds):
        # The edge pixels are the first readings of a group, and the image's shape does not change the others.
        design = slopes[:, first:last]
        if light is None:
            end = start + last - first
        else:
            of_shape, design = design, np.zeros((len(columns), end - start))
            design[: len(slopes), : last - first] = of_shape
            design[len(slopes) :] = (pixels.face[start:end] * light[start:end, None]).T
        weighted = design * photometry.weight[start:end]
        mixed = weighted @ photometry.basis[start:end]
        amplitude, led = photometry.amplitude[g], pixels.led[g]
        own = weighted @ design.T - mixed @ photometry.covariance[g] @ mixed.T
        information[led][np.ix_(columns, columns)] += amplitude**2 * own
        gradient[led][columns] += amplitude * (design @ residual[start:end])
    return information, gradient


def excess_chi2(pixels: LedPixels, rendered: RenderedLeds, photometry: PhotometricFit) -> Floats:
    """Excess of each group's chi-square, (g,), over its limit: positive for an LED that the model does not explain."""
    weight, edges = photometry.weight, pixels.edges
    chi2 = pixels.sum_by_group((pixels.electrons - photometry.expected) ** 2 * weight)
    freedom = np.maximum(pixels.sum_by_group((weight > 0).astype(float)) - photometry.basis.shape[1], 0.0)
    # The model error is largest at the edge: 4 share (1 - share) is 1 at half coverage and 0 on uniform pixels.
    share = np.zeros(len(weight))
    share[edges] = rendered.light[pixels.cells] / pixels.background[edges, 0]
    model_error_e = MODEL_ERROR_SHARE * photometry.amplitude[pixels.group] * 4 * share * (1 - share)
    if photometry.gain is not None:
        model_error_e *= photometry.gain
    model_chi2 = pixels.sum_by_group(model_error_e**2 * weight)
    return np.asarray(chi2 - freedom - CHI2_SIGMA * np.sqrt(2 * freedom) - model_chi2)
