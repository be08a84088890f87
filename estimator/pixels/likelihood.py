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

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimator.camera.motion import MOTION_PARAMETERS
from estimator.compiled import compiled, compiled_sums
from estimator.io.device import DeviceFrame
from estimator.pixels.led_model import IMAGE_PARAMETERS, LOCAL_PARAMETERS, PROFILE_PARAMETERS, RenderedLeds
from estimator.pixels.led_pixels import LedPixels
from estimator.spots.light_loops import MAX_ROUNDING_SHARE

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
        if not self.rounding_e2 > MAX_ROUNDING_SHARE * variance.min():
            return variance
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

    `light` (m,) is that of the image, of an even face; a group has c = 5 coefficients, four of the background and its
    amplitude, and where LEDs send a sixth, the amplitude times a change of the phase; `by_light` (c - 4, m) are the
    derivatives of the readings by the amplitude and the sixth; `amplitude`, `background` (by the face) and
    `signal_to_noise` are (g,); `expected` (m,) are electrons; `weight` (m,) is 1 / variance, 0 for readings not used;
    `covariance` (g, c, c) is that of the coefficients, 0 if the readings do not determine them; `level` (g,) is the
    scale of the background's prior; `electrons` (m,) are those of the readings, `dark_e2` (m,) their variances in the
    dark. Where LEDs send, `phase` (g,) are the errors of their waves' phases, in lines, and `gain` (m,) the gains by
    which the light of the readings is multiplied.
    """

    light: Floats
    by_light: Floats
    amplitude: Floats
    background: Floats
    signal_to_noise: Floats
    expected: Floats
    weight: Floats
    covariance: Floats
    level: Floats
    electrons: Floats
    dark_e2: Floats
    phase: Floats | None = None
    gain: Floats | None = None

    @cached_property
    def deviance(self) -> float:
        """Mean over the readings of twice the log likelihood ratio of a saturated model, expected to be near 1."""
        return _mean_deviance(self.electrons, self.expected, self.dark_e2, self.weight > 0)


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
    n, y, group, starts = pixels.pixel_counts, pixels.electrons, pixels.group, pixels.starts
    light = of_image = pixels.light(rendered)
    if profile is not None:
        light = light * pixels.brightness(profile)
    unlit = light < MAX_UNLIT_SHARE * pixels.background[:, 0]
    floors_e = _floors_e(starts, y, n, unlit)
    phase = gain = None
    if pixels.gains is not None:
        phase = np.zeros(len(pixels.led)) if before is None or before.phase is None else before.phase
    used_groups = used[pixels.led]
    weight = used_groups[group] / n if before is None else before.weight
    level = np.maximum.reduceat(y / n, starts[:-1]) if before is None else before.level
    count = COEFFICIENTS if phase is None else COEFFICIENTS + 1
    # One coefficient after another in memory, the readings last.
    basis = pixels.background.T, light[None]
    # Without variances of a previous fit, iterate: the first weights are a guess.
    for _ in range(3 if before is None else 1):
        if pixels.gains is not None and phase is not None:
            gain, by_phase = pixels.gains.at(phase)
            basis = pixels.background.T, np.stack([light * gain, light * by_phase])
        normal, right = _normal_equations(starts, *basis, y, weight)
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
        scaled, scale = _of_equal_size(normal)
        # Of matrices with a diagonal of ones: no larger than the determinant of background and amplitude alone.
        determined &= np.linalg.det(scaled) > MIN_DETERMINANT
        scaled[~determined] = np.eye(count)
        covariance = np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None] * determined[:, None, None]
        coefficients = np.einsum("gij,gj->gi", covariance, right)
        expected, per_pixel, variance = _expected(starts, *basis, n, coefficients, floors_e, noise.dark_e2, noise.prnu2)
        variance = noise.reduced_where_alike(variance, y - expected, n, unlit, group)
        weight = _weights(starts, n, per_pixel, variance, used_groups & determined, noise.saturation_e)
        if before is not None and not may_enter:
            weight[before.weight == 0] = 0.0
        if phase is not None:
            bright = coefficients[:, AMPLITUDE]
            change = np.divide(coefficients[:, -1], bright, out=np.zeros_like(bright), where=bright > 0)
            phase = np.clip(phase + np.clip(change, -MAX_PHASE_STEP, MAX_PHASE_STEP), -MAX_PHASE, MAX_PHASE)
        level = np.maximum(coefficients[:, 0], 0.0) + HALO_SHARE * np.maximum(coefficients[:, AMPLITUDE], 0.0)
    amplitude = coefficients[:, AMPLITUDE]
    sigma = np.sqrt(covariance[:, AMPLITUDE, AMPLITUDE])
    signal_to_noise = np.divide(amplitude, sigma, out=np.zeros_like(sigma), where=sigma > 0)
    return PhotometricFit(
        of_image,
        basis[1],
        amplitude,
        coefficients[:, 0],
        signal_to_noise,
        expected,
        weight,
        covariance,
        level,
        y,
        n * noise.dark_e2,
        phase,
        gain,
    )


@compiled
def _floors_e(starts: Ints, electrons: Floats, pixel_counts: Floats, unlit: Mask) -> Floats:
    """Half of the mean of the unlit pixels of each of g groups, (g,): no expectation is lower.

    The background of a few counts, extrapolated, may come out at 0 or less: its pixels would have no noise. Half a
    count more (Jeffreys 1946), so that no counts at all do not either.
    """
    floors_e = np.empty(len(starts) - 1)
    for g in range(len(floors_e)):
        total, size = 0.0, 0.0
        for i in range(starts[g], starts[g + 1]):
            if unlit[i]:
                total += electrons[i]
                size += pixel_counts[i]
        floors_e[g] = (max(total, 0.0) + 0.5) / max(size, 1.0) / 2
    return floors_e


@compiled_sums
def _normal_equations(
    starts: Ints, background: Floats, by_light: Floats, electrons: Floats, weight: Floats
) -> tuple[Floats, Floats]:
    """Normal equations (g, c, c) and right-hand sides (g, c) of readings (m,), weighted (m,).

    The derivatives by the c coefficients are those of the `background` (b, m), then those `by_light` (c - b, m).
    """
    groups, of_background = len(starts) - 1, len(background)
    count = of_background + len(by_light)
    normal, right = np.empty((groups, count, count)), np.empty((groups, count))
    for g in range(groups):
        readings = slice(starts[g], starts[g + 1])
        weights, values = weight[readings], electrons[readings]
        for a in range(count):
            first = background[a, readings] if a < of_background else by_light[a - of_background, readings]
            total = 0.0
            for i in range(len(weights)):
                total += weights[i] * first[i] * values[i]
            right[g, a] = total
            for b in range(a + 1):
                second = background[b, readings] if b < of_background else by_light[b - of_background, readings]
                total = 0.0
                for i in range(len(weights)):
                    total += weights[i] * first[i] * second[i]
                normal[g, a, b] = normal[g, b, a] = total
    return normal, right


@compiled
def _expected(
    starts: Ints,
    background: Floats,
    by_light: Floats,
    pixel_counts: Floats,
    coefficients: Floats,
    floors_e: Floats,
    dark_e2: float,
    prnu2: float,
) -> tuple[Floats, Floats, Floats]:
    """Expected electrons (m,), those that a pixel has noise of, (m,), and a pixel's variance, (m,).

    The derivatives by the `coefficients` (g, c) are as in `_normal_equations`. No pixel has less noise than of
    `floors_e` (g,).
    """
    readings, of_background = len(pixel_counts), len(background)
    expected, per_pixel, variance = np.zeros(readings), np.empty(readings), np.empty(readings)
    for g in range(len(starts) - 1):
        group, floor_e = slice(starts[g], starts[g + 1]), floors_e[g]
        total, lit, noise, counts = expected[group], per_pixel[group], variance[group], pixel_counts[group]
        for a in range(coefficients.shape[1]):
            coefficient = coefficients[g, a]
            one = background[a, group] if a < of_background else by_light[a - of_background, group]
            for i in range(len(one)):
                total[i] += coefficient * one[i]
        for i in range(len(counts)):
            lit[i] = max(total[i] / counts[i], floor_e)
            noise[i] = lit[i] + dark_e2 + prnu2 * lit[i] * lit[i]
    return expected, per_pixel, variance


@compiled
def _weights(
    starts: Ints, pixel_counts: Floats, per_pixel: Floats, variance: Floats, usable: Mask, saturation_e: float
) -> Floats:
    """1 / variance (m,) of readings; 0 for pixels near saturation, and in groups that are not `usable` (g,)."""
    weight = np.zeros(len(variance))
    for g in range(len(starts) - 1):
        if usable[g]:
            for i in range(starts[g], starts[g + 1]):
                of_pixel = max(variance[i], MIN_VARIANCE_E2)
                if per_pixel[i] + SATURATION_MARGIN_SIGMA * math.sqrt(of_pixel) < saturation_e:
                    weight[i] = 1 / (of_pixel * pixel_counts[i])
    return weight


def _of_equal_size(matrices: Floats) -> tuple[Floats, Floats]:
    """Positive definite matrices (n, k, k) with parameters scaled to a diagonal of ones, and the scales (n, k)."""
    scale = 1 / np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
    return np.asarray(matrices * scale[:, :, None] * scale[:, None]), np.asarray(scale)


def _mean_deviance(electrons: Floats, expected: Floats, dark_e2: Floats, weighed: Mask) -> float:
    """Mean deviance of the Poisson variables (m,) that are `weighed` (m,), 0 without any.

    A Gaussian variance s^2 is approximated by s^2 extra Poisson electrons.
    """
    observed, mean = np.maximum(electrons + dark_e2, 1e-9), np.maximum(expected + dark_e2, MIN_VARIANCE_E2)
    deviance = 2 * (observed * np.log(observed / mean) - (observed - mean))
    return float(deviance.sum(where=weighed) / max(np.count_nonzero(weighed), 1))


def score(
    pixels: LedPixels, rendered: RenderedLeds, photometry: PhotometricFit, profile: Floats | None = None
) -> tuple[Floats, Floats]:
    """Information (n, p, p) and gradient (n, p) of the log likelihood by the LOCAL_PARAMETERS of each of n LEDs.

    Those of the motion follow where `rendered` has derivatives by them.

    Amplitudes and backgrounds are eliminated. Parameters that `rendered` has no derivatives by have no information; so
    has the profile if `profile` (n, 3) is None.
    """
    at_edges, slopes = rendered.places_of_slopes(pixels.cells)
    place = np.full(len(pixels.electrons), -1)
    place[pixels.edges] = at_edges
    columns, face = rendered.parameters, pixels.face[:, :0]
    light, factor = photometry.light, np.ones(len(place)) if photometry.gain is None else photometry.gain
    if profile is not None:
        face = pixels.face
        light = light if photometry.gain is None else light * photometry.gain
        factor = factor * pixels.brightness(profile)
        columns = np.concatenate([columns, IMAGE_PARAMETERS + np.arange(PROFILE_PARAMETERS)])
    in_motion = bool((columns >= LOCAL_PARAMETERS).any())
    all_of_them = LOCAL_PARAMETERS + (MOTION_PARAMETERS if in_motion else 0)
    information = np.zeros((len(pixels.leds), all_of_them, all_of_them))
    gradient = np.zeros((len(pixels.leds), all_of_them))
    off_e = pixels.electrons - photometry.expected
    fit = pixels.background.T, photometry.by_light, off_e, photometry.weight
    # By the parameters, by the coefficients, and the gradient: (g, p, p + c + 1).
    products, count = _products(pixels.starts, slopes, place, factor, face, light, *fit), len(columns)
    own, mixed = products[:, :, :count], products[:, :, count:-1]
    # Less what a change of amplitude and background makes up for.
    own = own - mixed @ photometry.covariance @ mixed.transpose(0, 2, 1)
    amplitude = photometry.amplitude[:, None, None]
    # The groups of an LED follow each other.
    first = np.flatnonzero(np.diff(pixels.led, prepend=-1))
    leds = pixels.led[first]
    information[np.ix_(leds, columns, columns)] = np.add.reduceat(amplitude**2 * own, first, axis=0)
    gradient[np.ix_(leds, columns)] = np.add.reduceat(amplitude[:, 0] * products[:, :, -1], first, axis=0)
    return information, gradient


@compiled_sums
def _products(
    starts: Ints,
    slopes: Floats,
    place: Ints,
    factor: Floats,
    face: Floats,
    light: Floats,
    background: Floats,
    by_light: Floats,
    off_e: Floats,
    weight: Floats,
) -> Floats:
    """Sums (g, p, p + c + 1) over the readings of each group, of weighted products of the derivatives by p parameters.

    The products are with these, with the derivatives by c coefficients, as in `_normal_equations`, and with what a
    reading is off, `off_e` (m,). A reading that changes as images move has derivatives at its `place` (m,) in `slopes`
    (s, q), times its `factor` (m,); one that does not has the place -1. By the face's profile it has those of `face`
    (m, r), (m, 0) for none, times its `light` (m,): p = q + r.
    """
    of_image, of_face, of_background = slopes.shape[1], face.shape[1], len(background)
    count, others = of_image + of_face, of_face + of_background + len(by_light) + 1
    products = np.zeros((len(starts) - 1, count, of_image + others))
    for g in range(len(starts) - 1):
        first, size = starts[g], starts[g + 1] - starts[g]
        readings = slice(first, first + size)
        # All is times the square root of the weight; a derivative after another in memory.
        root, of_light = np.sqrt(weight[readings]), light[readings]
        every = np.empty((others, size))
        for a in range(of_face):
            one, of_one = every[a], face[readings, a]
            for i in range(size):
                one[i] = root[i] * of_light[i] * of_one[i]
        for a in range(others - of_face):
            one, of_one = every[of_face + a], off_e[readings]
            if a < of_background:
                of_one = background[a, readings]
            elif a < of_background + len(by_light):
                of_one = by_light[a - of_background, readings]
            for i in range(size):
                one[i] = root[i] * of_one[i]
        moving, moved = np.empty(size, dtype=np.int64), 0
        for i in range(size):
            moving[moved] = i
            moved += root[i] > 0 and place[first + i] >= 0
        design = np.empty((of_image + others, moved))
        for n in range(moved):
            i = moving[n]
            change, at = root[i] * factor[first + i], place[first + i]
            for a in range(of_image):
                design[a, n] = change * slopes[at, a]
        for a in range(others):
            one, of_one = design[of_image + a], every[a]
            for n in range(moved):
                one[n] = of_one[moving[n]]
        for a in range(of_image):
            for b in range(a, of_image + others):
                one, other, total = design[a], design[b], 0.0
                for n in range(moved):
                    total += one[n] * other[n]
                products[g, a, b] = total
        for a in range(of_face):
            for b in range(a, others):
                one, other, total = every[a], every[b], 0.0
                for i in range(size):
                    total += one[i] * other[i]
                products[g, of_image + a, of_image + b] = total
        for a in range(count):
            for b in range(a):
                products[g, a, b] = products[g, b, a]
    return products
