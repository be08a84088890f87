"""Sampling of an LED image by pixels: the error that it causes in the centroid, and its correction.

A pixel gathers the light on its area, and a centroid puts that light at the pixel's centre. The errors of the pixels
cancel but for the image's spectrum at whole cycles a pixel. With U(k) the Fourier transform of the image's marginal
along u over its flux, at k cycles a pixel, and u0 the true centroid in pixels with pixel centres at +0.5, Poisson's
summation formula gives for a marginal that is even about u0:

    centroid = u0 + sum over k >= 1 of U(k) sin(2 pi k u0) / (pi k)
    second moment about u0 = true one + 1 / 12 + sum over k >= 1 of cos(2 pi k u0) (U(k) / k^2 - U'(k) / k) / pi^2

and the same along v. The marginal of a uniform ellipse of half extent a is a semi-ellipse: U(k) = 2 J1(x) / x and
U'(k) = -4 pi a J2(x) / x with x = 2 pi k a, and its true second moment is a^2 / 4. The error in the centroid of a disc
is up to 0.02 px for a = 1 px and falls as a^-1.5. A lens that blurs the image lowers U(k).
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0, j1

from estimator.compiled import compiled
from estimator.io.camera import Camera

Floats = NDArray[np.float64]

# U(k) / k falls as k^-2.5: the eighth is 0.6 % of the first.
HARMONICS = np.arange(1.0, 9.0)
PIXEL_VARIANCE = 1 / 12
# Relative uncertainty of the half extent that a second moment gives, on a face that is not uniform: a gradient of 4 %
# from the centre to the rim changes it by g^2 / 8 = 2e-4, and a fall-off of 1.2 % by 1.2 % / 12. Ours.
SHAPE_UNCERTAINTY = 0.001
# The light of a smaller image is in one or two pixels, which do not determine its centre and its size.
MIN_HALF_EXTENT_PX = 0.7
# A centroid that moves by less than this share of the LED image's movement says little about it.
MIN_SLOPE = 0.3
# Second moment by light beyond the two columns around the centroid below which the half extent is not determined: 1 %
# of the light in a third column adds 0.02 px^2 at most. Noise, by these standard deviations, may have added it as well.
MIN_THIRD_COLUMN_PX2 = 0.02
THIRD_COLUMN_SIGMA = 3.0
# Half extent of the narrowest LED image, a disc of MIN_HALF_EXTENT_PX tilted by 60 deg.
NARROWEST_PX = 0.35
MAX_ROUNDS = 30
CONVERGED_PX = 1e-5
SOLVED_PX = 1e-3


@dataclass(frozen=True)
class LensBlur:
    """Blur of a lens: whether it is `sharp`, and an upper limit of its transfer function at one cycle a pixel."""

    sharp: bool = True
    transfer: float = 1.0


SHARP = LensBlur()


def lens_blur(camera: Camera) -> LensBlur:
    """Blur that the device knows of; the transfer function of defocus and of a measured kernel counts as 1."""
    if camera.psf == "none" and camera.focus_distance_m is None:
        return SHARP
    if camera.psf != "diffraction":
        return LensBlur(sharp=False)
    # A circular pupil: (2 / pi) (acos s - s sqrt(1 - s^2)) up to the cutoff, s = 1 (Goodman, Fourier Optics, 6.4).
    f_number = camera.f_number * camera.image_distance_mm / camera.focal_length_mm
    s = min(camera.psf_wavelength_nm / 1000 * f_number / camera.pixel_pitch_um, 1.0)
    return LensBlur(sharp=False, transfer=float(2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s**2))))


@cache
def _of_two_columns() -> tuple[Floats, Floats, Floats]:
    """Expected error of a centroid with light in two columns alone, and its variance, by the share p of one, all (n,).

    A disc of half extent a <= 1 at d from the border of the columns, a + |d| <= 1, has the share p = 1/2 +
    (asin(d / a) + d / a sqrt(1 - (d / a)^2)) / pi; any a down to NARROWEST_PX and any d are equally likely.
    """
    half, offset = (grid.ravel() for grid in np.meshgrid(np.linspace(NARROWEST_PX, 1, 141), np.linspace(-1, 1, 4001)))
    inside = half + np.abs(offset) <= 1
    ratio = np.clip(offset[inside] / half[inside], -1, 1)
    shares = 0.5 + (np.arcsin(ratio) + ratio * np.sqrt(1 - ratio**2)) / np.pi
    errors = shares - 0.5 - offset[inside]
    edges = np.linspace(0, 1, 51)
    count, first, second = (np.histogram(shares, edges, weights=errors**power)[0] for power in range(3))
    mean = first / count
    shares = np.pad((edges[1:] + edges[:-1]) / 2, 1, constant_values=(0, 1))
    # By symmetry the error of light in one column alone, and in two equally, is 0 on average.
    return shares, np.pad((mean - mean[::-1]) / 2, 1), np.pad(np.maximum(second / count - mean**2, 0.0), 1, "edge")


@dataclass(frozen=True, eq=False)
class SamplingError:
    """Errors of coordinates of centroids by sampling, all (n,).

    `error_px` is the error to subtract, `variance_px2` the variance of the error that remains, `slope` the derivative
    of the centroid by the true one: noise in the centroid is noise of 1 / `slope` times that in the corrected one.
    """

    error_px: Floats
    variance_px2: Floats
    slope: Floats


def sampling_variance_px2(half_extent_px: Floats, square: bool) -> Floats:
    """Variance of the sampling error over all positions on the pixels, px^2, for half extents (n,).

    The mean of sin^2 is 1/2. The mean of U(k)^2 over half extents of about the same size is 4 / (pi x^3) for an ellipse
    and 1 / (2 x^2) for a square with sides along the pixels' rows, x = 2 pi k a; U(k)^2 is at most 1.
    """
    x = 2 * np.pi * HARMONICS * np.maximum(half_extent_px, 1e-3)[:, None]
    spectrum2 = np.minimum(1 / (2 * x**2) if square else 4 / (np.pi * x**3), 1.0)
    return np.asarray((spectrum2 / (np.pi * HARMONICS) ** 2).sum(axis=1) / 2)


def sampling_error(centroid_px: Floats, moments_px2: Floats, moment_sigmas_px2: Floats) -> SamplingError:
    """Sampling errors of sharp, uniform ellipses, from coordinates of centroids and second moments by pixels, (n,).

    A coordinate is u or v; its second moment about the centroid, which has the standard deviation `moment_sigmas_px2`
    by noise, gives the half extent along it. A standard deviation s of the half extent makes the phase of U(k)
    uncertain by 2 pi k s: the expected error shrinks by the mean of a cosine, exp(-(2 pi k s)^2 / 2), and the rest is
    variance. Light in two columns alone does not tell position and size: error and variance are then those of all
    positions and sizes with this share of light in one (`_of_two_columns`). Where no size is found otherwise, the error
    is 0 and its variance that over all positions.
    """
    true_px, half_px, solved = _solve(centroid_px, moments_px2)
    step_px = 1e-3
    smaller, here, larger = (_sampled(true_px, half_px + step) for step in (-step_px, 0.0, step_px))
    before, after = _sampled(true_px - step_px, half_px), _sampled(true_px + step_px, half_px)
    by_half, by_centre, error_by_half = (
        (more - less) / (2 * step_px)
        for more, less in (
            (larger.moment_px2, smaller.moment_px2),
            (after.moment_px2, before.moment_px2),
            (larger.error_px, smaller.error_px),
        )
    )
    # The sampled centroid is given: the true one changes with the half extent.
    by_half -= by_centre * error_by_half / np.maximum(here.slope, MIN_SLOPE)
    model_px2 = SHAPE_UNCERTAINTY * half_px**2 / 2
    sigma_px = np.hypot(moment_sigmas_px2, model_px2) / np.maximum(np.abs(by_half), 1e-6)
    shrinking = np.exp(-((2 * np.pi * HARMONICS * sigma_px[:, None]) ** 2) / 2)
    likely = _sampled(true_px, half_px, shrinking)
    # The envelope of J1 is sqrt(2 / (pi x)). The mean of sin^2 over positions is 1/2.
    x = 2 * np.pi * HARMONICS * half_px[:, None]
    envelope2 = np.minimum(8 / (np.pi * x**3), 1.0)
    rest = (envelope2 * (1 - shrinking**2) / (np.pi * HARMONICS) ** 2).sum(axis=1) / 2
    # Light in two columns alone has the second moment p (1 - p) with the share p of one: nothing of its half extent.
    share = (centroid_px - 0.5) % 1
    third_px2 = moments_px2 - share * (1 - share) - MIN_THIRD_COLUMN_PX2
    two_columns = third_px2 <= 0
    # An image of more than two pixels has light in a third column.
    by_noise = (half_px < 1) & (third_px2 <= THIRD_COLUMN_SIGMA * moment_sigmas_px2)
    usable = solved & (likely.slope > MIN_SLOPE) & ~two_columns & ~by_noise
    shares, expected_px, spread_px2 = _of_two_columns()
    return SamplingError(
        error_px=np.select([usable, two_columns], [likely.error_px, np.interp(share, shares, expected_px)]),
        variance_px2=np.select(
            [usable, two_columns],
            [rest, np.interp(share, shares, spread_px2)],
            sampling_variance_px2(half_px, square=False),
        ),
        slope=np.where(usable, likely.slope, 1.0),
    )


def _solve(centroid_px: Floats, moments_px2: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """True centroids and half extents (n,) for sampled centroids and second moments, and whether they were found."""
    true_px = centroid_px
    half_px = 2 * np.sqrt(np.maximum(moments_px2 - PIXEL_VARIANCE, MIN_HALF_EXTENT_PX**2 / 4))
    for _ in range(MAX_ROUNDS):
        here = _sampled(true_px, half_px)
        step_px = (centroid_px - true_px - here.error_px) / np.maximum(here.slope, MIN_SLOPE)
        excess_px2 = here.moment_px2 - half_px**2 / 4
        found_px = 2 * np.sqrt(np.maximum(moments_px2 - excess_px2, MIN_HALF_EXTENT_PX**2 / 4))
        change_px = np.abs(found_px - half_px)
        # Half of the change: near the smallest sizes the whole one would swing about the solution.
        true_px, half_px = true_px + step_px, (half_px + found_px) / 2
        if max(np.abs(step_px).max(), change_px.max()) < CONVERGED_PX:
            break
    solved = (np.abs(step_px) < SOLVED_PX) & (change_px < SOLVED_PX) & (found_px > MIN_HALF_EXTENT_PX)
    return true_px, half_px, np.asarray(solved)


@dataclass(frozen=True, eq=False)
class _Sampled:
    """What pixels make of ellipses, all (n,): the errors of their centroids, the slopes of these by the true ones, and
    the second moments about the sampled centroids.
    """

    error_px: Floats
    slope: Floats
    moment_px2: Floats


def _sampled(true_px: Floats, half_px: Floats, weights: Floats | None = None) -> _Sampled:
    """Ellipses at true centroids (n,) with half extents (n,) as sampled; `weights` (n, k) are the harmonics'."""
    x = 2 * np.pi * HARMONICS * half_px[:, None]
    return _Sampled(*_sums(true_px, half_px, j0(x), j1(x), np.ones_like(x) if weights is None else weights))


@compiled
def _sums(
    true_px: Floats, half_px: Floats, of_zeroth: Floats, of_first: Floats, weights: Floats
) -> tuple[Floats, Floats, Floats]:
    """The arrays of `_Sampled`, by the Bessel functions J0 and J1 of 2 pi k a, (n, k)."""
    count, harmonics = of_first.shape
    error_px, slope, moment_px2 = np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        error, turned, excess = 0.0, 0.0, 0.0
        for number in range(harmonics):
            k = number + 1.0
            x, phase, first = 2 * np.pi * k * half_px[i], 2 * np.pi * k * true_px[i], of_first[i, number]
            spectrum = weights[i, number] * 2 * first / x
            # J2(x) = 2 J1(x) / x - J0(x), many times faster than the general function; x is 4 at least.
            by_k = weights[i, number] * -4 * np.pi * half_px[i] * (2 * first / x - of_zeroth[i, number]) / x
            error += spectrum * math.sin(phase) / (np.pi * k)
            turned += spectrum * math.cos(phase)
            excess += math.cos(phase) * (spectrum / k - by_k) / k
        error_px[i], slope[i] = error, 1 + 2 * turned
        moment_px2[i] = half_px[i] ** 2 / 4 + PIXEL_VARIANCE + excess / np.pi**2 - error**2
    return error_px, slope, moment_px2
