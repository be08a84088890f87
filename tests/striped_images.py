"""Striped LED images made apart from vlcrender: exact coverage of pixels, times the gain of each line, with noise."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from estimator.spots.led_light import Readout

Array = NDArray[np.float64]

FLOOR_E = 3.0


def coverage(
    size: int, centre: Array, semi_axes: Array, angle: float, square: bool = False, samples: int = 10
) -> Array:
    """Share of each pixel, (size, size), that an ellipse covers, or a rectangle with half sides `semi_axes`."""
    if square and angle == 0:
        pixels = np.arange(size)[:, None]
        low, high = np.maximum(pixels, centre - semi_axes), np.minimum(pixels + 1, centre + semi_axes)
        u, v = np.clip(high - low, 0, None).T
        return np.asarray(np.outer(v, u))
    fine = (np.arange(size * samples) + 0.5) / samples
    x, y = np.meshgrid(fine - centre[0], fine - centre[1])
    c, s = np.cos(angle), np.sin(angle)
    p, q = (c * x + s * y) / semi_axes[0], (c * y - s * x) / semi_axes[1]
    inside = np.maximum(np.abs(p), np.abs(q)) <= 1 if square else p**2 + q**2 <= 1
    return np.asarray(inside.reshape(size, samples, size, samples).mean(axis=(1, 3)))


def code(rng: np.random.Generator, length: int = 32, longest: int = 4) -> Array:
    """A balanced code of chips 0 and 1 whose longest run, around its end too, is `longest`."""
    while True:
        chips = rng.permutation(np.repeat([0.0, 1.0], length // 2))
        ends = np.flatnonzero(np.diff(np.concatenate([chips, chips, chips])))
        if np.diff(ends).max() <= longest:
            return chips


def gains(chips: Array, chip_us: float, starts_us: Array, exposure_us: float) -> Array:
    """Mean of a periodic wave of chips over exposures that start at `starts_us` (n,), exactly."""
    before = np.concatenate([[0.0], np.cumsum(chips)])

    def integral(t: Array) -> Array:
        whole = np.floor(t / chip_us).astype(int)
        k = whole % len(chips)
        return chip_us * (whole // len(chips) * before[-1] + before[k] + chips[k] * (t / chip_us - whole))

    return np.asarray((integral(starts_us + exposure_us) - integral(starts_us)) / exposure_us)


def readout(
    covered: Array,
    line_gains: Array,
    lit_e: float,
    rng: np.random.Generator,
    blur_px: float = 0.0,
    full_e: float = np.inf,
    along: str = "rows",
    origin: tuple[int, int] = (0, 0),
) -> Readout:
    """A region with shot noise, read noise of FLOOR_E, and a background of a hundredth of the LED's level."""
    if blur_px:
        covered = gaussian_filter1d(gaussian_filter1d(covered, blur_px, 0), blur_px, 1)
    shaped = line_gains[:, None] if along == "rows" else line_gains[None, :]
    expected = lit_e * covered * shaped + lit_e / 100
    image = rng.poisson(expected) + rng.normal(0, FLOOR_E, expected.shape)
    image = np.minimum(image, full_e).astype(np.float32)
    return Readout(*origin, image, image, image >= full_e, FLOOR_E**2)
