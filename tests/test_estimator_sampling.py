"""Errors of a centroid by sampling, against images that are integrated over pixels in closed form."""

from typing import Any

import numpy as np
import pytest
from estimator_synthetic import Array
from scipy.optimize import brentq
from test_estimator_device import CAMERA

from estimator.spots.detect import detect
from estimator.spots.led_light import Readout
from estimator.spots.sampling import SHARP, LensBlur, lens_blur, sampling_error, sampling_variance_px2

POSITIONS_PX = np.linspace(20.0, 21.0, 41)
NO_NOISE = np.full(2, 1e-12)


def marginal(half_px: float, centre_px: float) -> tuple[Array, Array]:
    """Centres of pixels and a uniform disc's light in their columns: differences of the half ellipse's integral."""
    edges = np.arange(np.floor(centre_px - half_px) - 1, np.ceil(centre_px + half_px) + 2)
    x = np.clip((edges - centre_px) / half_px, -1, 1)
    return edges[:-1] + 0.5, np.diff(x * np.sqrt(1 - x**2) + np.arcsin(x)) / np.pi


def sampled(half_px: float, centre_px: float) -> tuple[Array, Array]:
    """Centroid and second moment by pixels, each twice, (2,)."""
    u_px, light = marginal(half_px, centre_px)
    centroid = float(light @ u_px)
    return np.full(2, centroid), np.full(2, float(light @ (u_px - centroid) ** 2))


def errors(half_px: float, corrected: bool) -> Array:
    found = []
    for centre_px in POSITIONS_PX:
        centroid, moments = sampled(half_px, centre_px)
        error = sampling_error(centroid, moments, NO_NOISE).error_px if corrected else 0.0
        found.append((centroid - error)[0] - centre_px)
    return np.array(found)


@pytest.mark.parametrize("half_px", [1.3, 2.2, 3.0, 6.1, 12.4])
def test_the_correction_removes_the_sampling_error(half_px: float) -> None:
    """What remains: harmonics from the ninth on, at most sum 8 / (pi x^3)^(1/2) / (pi k) = 4e-4 a^-1.5 px, and the
    shrinking by an uncertain size, whose square the stated variance holds.
    """
    raw, left = errors(half_px, corrected=False), errors(half_px, corrected=True)
    stated = sampling_error(*sampled(half_px, 20.2), NO_NOISE).variance_px2[0]
    assert np.abs(left).max() < 4e-4 * half_px**-1.5 + 3 * np.sqrt(stated)
    assert np.sqrt((left**2).mean()) < 0.2 * np.sqrt((raw**2).mean())


def test_the_error_of_a_disc_of_two_pixels_by_hand() -> None:
    """A disc of 1 px radius a quarter of a pixel right of a border, on three columns: with the circle's segment of
    sagitta h, s(h) = acos(1 - h) - (1 - h) sqrt(2 h - h^2), over pi, the outer two hold s(3/4) and s(1/4).
    """

    def segment(h: float) -> float:
        return float((np.arccos(1 - h) - (1 - h) * np.sqrt(2 * h - h**2)) / np.pi)

    centroid, moments = sampled(1.0, 20.25)
    left, right = segment(0.75), segment(0.25)
    assert centroid[0] == pytest.approx(20.5 - left + right, abs=1e-12)
    assert centroid[0] - 20.25 == pytest.approx(-0.020, abs=1e-3)
    assert sampling_error(centroid, moments, NO_NOISE).error_px[0] == pytest.approx(centroid[0] - 20.25, abs=1e-3)


@pytest.mark.parametrize("square", [False, True])
@pytest.mark.parametrize("half_px", [1.0, 3.0, 8.0])
def test_the_variance_over_positions_and_sizes(half_px: float, square: bool) -> None:
    """The mean over half extents of half a pixel, one period of sin^2(2 pi a). 1 / a^2 and 1 / a^3 vary over it by up
    to a factor of 4.6 at 1 px, and J1 is not yet its asymptote: within a third.
    """
    squares = []
    for half in half_px + np.linspace(-0.25, 0.25, 41)[:-1]:
        for centre_px in POSITIONS_PX[:-1]:
            if square:
                edges = np.arange(np.floor(centre_px - half) - 1, np.ceil(centre_px + half) + 2)
                light = np.diff(np.clip((edges - centre_px) / half, -1, 1)) / 2
                u_px = edges[:-1] + 0.5
            else:
                u_px, light = marginal(half, centre_px)
            squares.append((float(light @ u_px) - centre_px) ** 2)
    assert sampling_variance_px2(np.array([half_px]), square)[0] == pytest.approx(np.mean(squares), rel=1 / 3)


def test_an_uncertain_size_leaves_the_centroid_as_it_is() -> None:
    """A size uncertain by a pixel says nothing of the phase: no correction, and the variance is twice that over sizes,
    because the envelope of J1^2 is twice its mean.
    """
    centroid, moments = sampled(3.0, 20.2)
    found = sampling_error(centroid, moments, np.full(2, 3.0))
    assert np.abs(found.error_px).max() < 1e-6
    np.testing.assert_allclose(found.slope, 1.0, atol=1e-6)
    np.testing.assert_allclose(found.variance_px2, 2 * sampling_variance_px2(np.full(2, 3.0), False), rtol=0.05)


@pytest.mark.parametrize("half_px", [20.0, 40.0])
def test_a_size_is_uncertain_by_1_in_1000_without_noise(half_px: float) -> None:
    """s = 0.001 a makes the phase of the k-th harmonic uncertain by 2 pi k s. Its share 1 - exp(-(2 pi k s)^2) of the
    envelope's mean square, 4 / (pi x^3) / (pi k)^2 with x = 2 pi k a, is variance.

    The second moment changes by a / 2 with the half extent, and harmonics add to that up to 8 U(k), relative, with
    U(k) <= sqrt(8 / (pi x^3)): twice this in a squared size.
    """
    k = np.arange(1.0, 9.0)
    x = 2 * np.pi * k * half_px
    shares = 1 - np.exp(-((2 * np.pi * k * 0.001 * half_px) ** 2))
    expected = (4 / (np.pi * x**3) / (np.pi * k) ** 2 * shares).sum()
    found = sampling_error(*sampled(half_px, 20.2), NO_NOISE).variance_px2
    np.testing.assert_allclose(found, expected, rtol=16 * np.sqrt(8 / (np.pi * x**3)).sum())


@pytest.mark.parametrize("half_px", [0.9, 1.0])
def test_noise_of_a_moment_makes_a_size_uncertain_at_a_known_centroid(half_px: float) -> None:
    """The half extent changes with the moment as for images of one sampled centroid, whose true ones differ: for a
    disc of 1 px, which pixels sample coarsely, that is a tenth of it. By differences of images in closed form.

    The model has eight harmonics. The derivative's terms are 4 a U(k) at most, with U(k) <= sqrt(8 / (pi x^3)), and
    have both signs: what is left out is below the ninth of them, and twice as much in a variance.
    """
    step_px, centre_px, sigma_px2 = 1e-3, 20.25, 1e-3
    centroid, moments = sampled(half_px, centre_px)

    def moment_px2(half: float) -> float:
        same = brentq(lambda at: sampled(half, at)[0][0] - centroid[0], centre_px - 0.1, centre_px + 0.1, xtol=1e-12)
        return float(sampled(half, same)[1][0])

    slope = (moment_px2(half_px + step_px) - moment_px2(half_px - step_px)) / (2 * step_px)
    sigma_px = np.hypot(sigma_px2, 0.001 * half_px**2 / 2) / slope
    k = np.arange(1.0, 9.0)
    x = 2 * np.pi * k * half_px
    expected = (4 / (np.pi * x**3) / (np.pi * k) ** 2 * (1 - np.exp(-((2 * np.pi * k * sigma_px) ** 2)))).sum()
    found = sampling_error(centroid, moments, np.full(2, sigma_px2)).variance_px2
    ninth = np.sqrt(8 / (np.pi * (2 * np.pi * 9 * half_px) ** 3))
    np.testing.assert_allclose(found, expected, rtol=2 * 4 * half_px * ninth / slope)


def test_light_in_two_columns_is_corrected_by_the_mean_of_all_discs_with_its_share() -> None:
    """Two columns tell one number, the share of one of them: not both position and half extent. Over discs of which all
    sizes and positions are equally likely, the mean of e^2 is that of the variance v. Of 4 000 discs its standard
    deviation is sqrt((k - 1) / 4000) of it with the kurtosis k of e, 10 at most: 0.05, of which four are allowed. Left
    alone, the centroids have an e^2 four times as large.
    """
    rng = np.random.default_rng(5)
    half, offset = rng.uniform(0.35, 1.0, 40_000), rng.uniform(-1.0, 1.0, 40_000)
    in_two = (half + np.abs(offset) <= 1) & (np.abs(offset) < half)
    discs = [sampled(a, 21 + d) for a, d in zip(half[in_two][:4000], offset[in_two][:4000], strict=True)]
    centroid, moments = (np.array([disc[which][0] for disc in discs]) for which in (0, 1))
    found = sampling_error(centroid, moments, np.full(len(discs), 1e-12))
    left_px = centroid - found.error_px - 21 - offset[in_two][:4000]
    assert np.mean(left_px**2) == pytest.approx(np.mean(found.variance_px2), rel=4 * 0.05)


@pytest.mark.parametrize(("half_px", "centre_px"), [(0.3, 20.5), (0.5, 20.5)])
def test_light_in_a_pixel_is_not_corrected(half_px: float, centre_px: float) -> None:
    """One column tells nothing but that the LED image is in it."""
    centroid, moments = sampled(half_px, centre_px)
    found = sampling_error(centroid, moments, NO_NOISE)
    np.testing.assert_array_equal(found.error_px, 0.0)
    # 1/12 px^2 is the variance of a point's position in its pixel.
    assert (found.variance_px2 < 1 / 12).all()
    assert (found.variance_px2 > 1e-4).all()


def changed_camera(**changes: Any) -> LensBlur:
    return lens_blur(CAMERA.model_copy(update=changes))


def test_a_lens_with_blur_is_told_by_its_camera() -> None:
    """Diffraction at f/2 and 0.5 um: the cutoff is 1 cycle a um. Pixels of 2 um have s = 1/2 at one cycle a pixel, a
    transfer of (2 / pi) (pi / 3 - sqrt(3) / 4) = 0.391; pixels of 1 um have none.
    """
    optics = {"psf_wavelength_nm": 500.0, "f_number": 2.0, "image_distance_mm": 18.0, "focal_length_mm": 18.0}
    assert changed_camera(psf="none", focus_distance_m=None) == SHARP
    assert changed_camera(psf="none", focus_distance_m=3.0) == LensBlur(sharp=False, transfer=1.0)
    assert changed_camera(psf="measured", psf_kernel=((1.0,),)) == LensBlur(sharp=False, transfer=1.0)
    half = changed_camera(psf="diffraction", pixel_pitch_um=2.0, **optics)
    assert (half.sharp, half.transfer) == (False, pytest.approx(2 / np.pi * (np.pi / 3 - np.sqrt(3) / 4), abs=1e-12))
    assert changed_camera(psf="diffraction", pixel_pitch_um=1.0, **optics).transfer == pytest.approx(0, abs=1e-12)


def disc(centre_px: tuple[float, float], radius_px: float, size_px: int = 26, parts: int = 80) -> Array:
    """A disc of 50 000 e a pixel before 40 e, by parts x parts points a pixel.

    A pixel at the edge errs by 0.3 / parts^1.5 of its light, the centroid of a disc of 1 px by 2e-4 px.
    """
    at = (np.arange(size_px * parts) + 0.5) / parts
    inside = (at[None, :] - centre_px[0]) ** 2 + (at[:, None] - centre_px[1]) ** 2 <= radius_px**2
    return 40 + 50_000 * inside.reshape(size_px, parts, size_px, parts).mean(axis=(1, 3))


@pytest.mark.parametrize("radius_px", [1.0, 1.4, 2.2, 3.0])
def test_detected_spots_have_the_covariance_of_their_errors(radius_px: float) -> None:
    """Discs of 2 to 6 px at n = 24 positions, Poisson noise: their squared Mahalanobis distances sum to chi^2 with 2 n
    degrees of freedom, 48 +- 10. A detection that knows of no sampling error is beyond five sigma.
    """
    rng = np.random.default_rng(round(10 * radius_px))
    total = uncorrected = 0.0
    n = 24
    for centre_px in rng.uniform(12.5, 13.5, (n, 2)):
        expected = disc((centre_px[0], centre_px[1]), radius_px)
        image = rng.poisson(expected).astype(np.float32)
        readout = Readout(0, 0, image, image, np.zeros(image.shape, bool))
        (spot,) = detect([readout], 100 * image.size, 0)
        off = np.array([spot.u_px, spot.v_px]) - centre_px
        total += off @ np.linalg.solve(spot.covariance_px2, off)
        (raw,) = detect([readout], 100 * image.size, 0, lens=LensBlur(sharp=False, transfer=0.0))
        off = np.array([raw.u_px, raw.v_px]) - centre_px
        uncorrected += off @ np.linalg.solve(raw.covariance_px2, off)
    # Below, the stated rest of the sampling error is for an image that is less exactly a uniform disc than this one.
    assert 0.3 * 2 * n < total < 2 * n + 5 * np.sqrt(4 * n)
    assert uncorrected > 2 * n + 5 * np.sqrt(4 * n)


def centroid_px(image: Array, crosstalk: float) -> Array:
    """Centroid (2,) of the one spot of an image of electrons, detected with this crosstalk."""
    electrons = image.astype(np.float32)
    readout = Readout(0, 0, electrons, electrons, np.zeros(image.shape, bool))
    (spot,) = detect([readout], 100 * image.size, 0, crosstalk=crosstalk)
    return np.array([spot.u_px, spot.v_px])


@pytest.mark.parametrize("centre_px", [(12.8, 13.3), (13.15, 12.6)])
@pytest.mark.parametrize("crosstalk", [0.1, 0.3])
@pytest.mark.parametrize("radius_px", [1.0, 2.2])
def test_crosstalk_leaves_the_corrected_centroid_as_it_is(
    radius_px: float, crosstalk: float, centre_px: tuple[float, float]
) -> None:
    """A symmetric kernel of whole pixels moves no centroid and adds its own variance, c / 2, to the second moments.

    What remains is the shrinking by the size's standard deviation s, which is below 0.005 px here and changes a little
    with the moments: a share (2 pi s)^2 / 2 = 5e-4 of at most 0.02 px. Without the subtraction, the size is too large
    by c / 2 over half of it: 0.045 px at 2.2 px and c = 0.1, 0.28 rad of an error of 0.01 px.
    """
    sharp = disc(centre_px, radius_px)
    around = [np.roll(sharp, shift, axis) for axis in (0, 1) for shift in (-1, 1)]
    shared = (1 - crosstalk) * sharp + crosstalk / 4 * sum(around, np.zeros_like(sharp))
    expected = centroid_px(sharp, 0.0)
    assert np.abs(centroid_px(shared, crosstalk) - expected).max() < 1e-5
    assert np.abs(centroid_px(shared, 0.0) - expected).max() > 1e-3
