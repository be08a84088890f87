"""Photon transfer: parameters of a camera from its digital numbers alone, as in EMVA Standard 1288.

A camera is a function that takes an exposure. Known are the exposure time, the photons on each pixel, and the
temperature rise of the camera. Definitions: EMVA Standard 1288, Release 4.0
Linear (2021), linear photon response and signal-independent dark noise:

    mu_y = mu_y.dark + K eta mu_p        sigma_y^2 = sigma_y.dark^2 + K (mu_y - mu_y.dark)
    sigma_y.dark^2 = K^2 sigma_d^2 + 1/12        mu_d = mu_d0 + mu_I t

Standard errors follow from the number of values: a variance of n values has the variance 2 s^4 / n + k4 / n. The fourth
cumulant k4 is taken from Poisson electrons: K^3 times the signal.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.quantity import Quantity, line
from vlcrender.errors import InputError
from vlcrender.sensor.nonuniformity import UNSEEN_DN2, Patterns, patterns

Array = NDArray[np.float64]
Shoot = Callable[[float, float, float], NDArray[np.uint32]]
"""(photons per pixel, exposure_s, temperature rise in deg C) -> digital numbers of a new exposure, (rows, columns)."""

FLAT_EXPOSURE_S = 0.01
"""Exposure time of all flat fields and their dark frames: the light varies, the time does not."""
LEVELS = 50
"""Number of light levels, evenly spaced up to where the noise collapses; the standard requires 50."""
STACK = 64
"""Number of frames averaged for the fixed patterns."""
DARK_TIMES = 6
"""Number of exposure times in a series of dark frames; the standard requires 6."""
MAX_DARK_S = 100.0
WARMER_C = (0.0, 10.0, 20.0)
MAX_PHOTONS = 1e9
ROUNDING_DN2 = 1 / 12
"""Variance of rounding where noise is about half a digital number or more."""
UNDITHERED_DN2 = 0.25
"""Largest variance of rounded numbers without noise: a variance up to this tells nothing about the camera.

The standard's limit for sigma_y.dark^2 is 0.24.
"""


@dataclass(frozen=True)
class Point:
    """Two identical exposures: mean and temporal variance of their digital numbers."""

    photons: float
    exposure_s: float
    mean_dn: float
    variance_dn2: float
    pixels: int

    @property
    def mean(self) -> Quantity:
        """The mean. Its error excludes fixed patterns: they are the same in every mean."""
        sampling = max(self.variance_dn2, ROUNDING_DN2) / (2 * self.pixels)
        return Quantity(self.mean_dn, float(np.hypot(np.sqrt(sampling), self._rounding_errors()[0])))

    def variance(self, fourth_cumulant_dn4: float = 0.0) -> Quantity:
        """The variance: half that of differences, which have the variance 2 s^2 and the fourth cumulant 2 k4."""
        sampling = (2 * max(self.variance_dn2, ROUNDING_DN2) ** 2 + fourth_cumulant_dn4 / 2) / self.pixels
        return Quantity(self.variance_dn2, float(np.hypot(np.sqrt(sampling), self._rounding_errors()[1])))

    def _rounding_errors(self) -> tuple[float, float]:
        """Standard errors of mean and variance by rounding, from m and s^2 + 1/12.

        With normal noise the errors are at most exp(-2 pi^2 s^2) times 1 / pi and times 4 s^2 + 1 / pi^2 (Sheppard's
        corrections, first terms); without noise at most 1/2 and 1/4. They are uniform within these limits, hence the
        root of 3.
        """
        if self.variance_dn2 <= UNDITHERED_DN2:
            return 0.5 / 3**0.5, 0.25 / 3**0.5
        noise = self.variance_dn2 - ROUNDING_DN2
        left = float(np.exp(-2 * np.pi**2 * noise)) / 3**0.5
        return left / np.pi, left * (4 * noise + 1 / np.pi**2)


@dataclass(frozen=True)
class Measurement:
    """The measured parameters of a camera."""

    dark: Point
    """At FLAT_EXPOSURE_S."""
    points: tuple[Point, ...]
    """Flat fields in order of increasing light."""
    faint: tuple[Point, ...]
    """Flat fields of doubling light, from one photon per pixel."""
    saturation_index: int
    """Index of the point with the largest variance."""
    gain: Quantity
    """K, DN per electron."""
    quantum_efficiency: Quantity
    dark_level_dn: Quantity
    """mu_y.dark at exposure time 0; the error includes the error of the pattern's mean."""
    dark_variance_dn2: Quantity
    """sigma_y.dark^2 without the noise of the dark current."""
    dark_current_e_s: Quantity
    doubling_c: Quantity | None
    """Temperature rise that doubles the dark current, deg C; None where the dark current is too small."""
    dark_patterns: Patterns
    bright_patterns: Patterns
    """Patterns at half of saturation."""
    full_well_e: Quantity
    """Mean electrons of a saturated pixel: the well or the ADC is full."""
    linearity_error: Quantity
    linearity_noise: float
    """Mean linearity error of a linear camera with this noise."""

    @property
    def signals_dn(self) -> Array:
        """Mean of each point minus the dark mean."""
        return np.array([p.mean_dn for p in self.points]) - self.dark.mean_dn

    @property
    def saturation_photons(self) -> float:
        """mu_p.sat: photons per pixel at the largest variance."""
        return self.points[self.saturation_index].photons

    @property
    def dark_noise_e2(self) -> Quantity:
        """sigma_d^2: temporal variance in the dark without dark current and rounding."""
        noise = self.dark_variance_dn2.plus(Quantity(-ROUNDING_DN2 if self.dark_variance_dn2.value else 0.0, 0.0))
        return noise.over(self.gain).over(self.gain)

    @property
    def least_photons(self) -> Quantity:
        """mu_p.min = (sqrt(sigma_y.dark^2 / K^2 + 1/4) + 1/2) / eta: photons at a signal-to-noise ratio of 1."""
        noise_e2 = self.dark_variance_dn2.over(self.gain).over(self.gain)
        root = float(np.sqrt(noise_e2.value + 0.25))
        return Quantity(root + 0.5, noise_e2.error / (2 * root)).over(self.quantum_efficiency)


def measure(shoot: Shoot) -> Measurement:
    """Take flat and dark frames of a camera and measure its parameters.

    Raises InputError where the camera has no noise, or does not saturate at MAX_PHOTONS.
    """
    dark = take_pair(shoot, 0.0)
    most, way = collapse(shoot, dark)
    points = tuple(take_pair(shoot, most * level / LEVELS) for level in range(1, LEVELS + 1))
    top = int(np.argmax([p.variance_dn2 for p in points]))
    used = [p for p in points if p.mean_dn - dark.mean_dn <= 0.7 * (points[top].mean_dn - dark.mean_dn)]
    gain = fit_gain(dark, used)
    full = take_pair(shoot, 2 * most)
    lights = (0.0, points[top].photons / 2)
    stacks = [patterns(shoot(light, FLAT_EXPOSURE_S, 0.0) for _ in range(STACK)) for light in lights]
    series = [dark_series(shoot, full.mean_dn - dark.mean_dn, warmer) for warmer in WARMER_C]
    fits = [line([p.exposure_s for p in darks], [p.mean for p in darks]) for darks in series]
    currents_dn_s = [slope for _, slope in fits]
    dark_variance, _ = line([p.exposure_s for p in series[0]], [p.variance() for p in series[0]])
    if dark_variance.value <= 0:
        dark_variance = Quantity(0.0, UNSEEN_DN2)
    deviation, noise = linearity(dark, points[: top + 1])
    return Measurement(
        dark=dark,
        points=points,
        faint=way,
        saturation_index=top,
        gain=gain,
        quantum_efficiency=fit_responsivity(dark, used, stacks[1]).over(gain),
        dark_level_dn=fits[0][0].plus(Quantity(0.0, stacks[0].mean_error)),
        dark_variance_dn2=dark_variance,
        dark_current_e_s=currents_dn_s[0].over(gain),
        doubling_c=doubling(currents_dn_s),
        dark_patterns=stacks[0],
        bright_patterns=stacks[1],
        full_well_e=full.mean.plus(dark.mean.times(-1)).over(gain),
        linearity_error=deviation,
        linearity_noise=noise,
    )


def take_pair(shoot: Shoot, photons: float, exposure_s: float = FLAT_EXPOSURE_S, warmer_c: float = 0.0) -> Point:
    """Expose twice: mean, and sigma_y^2 = mean((A - B)^2)/2 - (mean A - mean B)^2/2, free of fixed patterns."""
    a, b = (shoot(photons, exposure_s, warmer_c).astype(np.float64) for _ in range(2))
    difference = a - b
    variance = float(np.mean(difference**2) / 2 - np.mean(difference) ** 2 / 2)
    return Point(photons, exposure_s, float((a.mean() + b.mean()) / 2), variance, a.size)


def collapse(shoot: Shoot, dark: Point) -> tuple[float, tuple[Point, ...]]:
    """Photons per pixel at which the variance falls to half of its maximum, and the flat fields measured up to there.

    The flat fields have doubling light, from one photon per pixel until the signal stops growing in proportion. Raises
    InputError where the signal grows up to MAX_PHOTONS, and where there is no variance.
    """
    way = [take_pair(shoot, 1.0)]
    signal = previous = 0.0
    while signal < 5 or signal > 1.5 * previous:  # below 5 DN the signal is mostly rounding
        if way[-1].photons > MAX_PHOTONS:
            raise InputError(f"the sensor does not saturate at up to {MAX_PHOTONS:g} photons per pixel")
        way.append(take_pair(shoot, 2 * way[-1].photons))
        signal, previous = (point.mean_dn - dark.mean_dn for point in (way[-1], way[-2]))
    largest = max(point.variance_dn2 for point in way)
    if not largest:
        raise InputError("photon transfer needs noise, and the sensor has none")
    low, high = way[-1].photons / 4, way[-1].photons
    for _ in range(9):
        middle = (low + high) / 2
        variance = take_pair(shoot, middle).variance_dn2
        largest = max(largest, variance)
        low, high = (low, middle) if variance < largest / 2 else (middle, high)
    return high, tuple(point for point in way if point.photons < low)


def fit_gain(dark: Point, points: Sequence[Point]) -> Quantity:
    """K: slope through the origin of variance against mean, both minus the dark values."""
    x = np.array([p.mean_dn - dark.mean_dn for p in points])
    y = np.array([p.variance_dn2 - dark.variance_dn2 for p in points])
    slope = float(x @ y / (x @ x))
    # an error of a mean acts as K times that error of the variance; all points share the error of the dark frames
    errors = [np.hypot(p.variance(slope**3 * s).error, slope * p.mean.error) for p, s in zip(points, x, strict=True)]
    shared = np.hypot(dark.variance().error, slope * dark.mean.error)
    return Quantity(slope, float(np.hypot(np.linalg.norm(x * errors), x.sum() * shared) / (x @ x)))


def fit_responsivity(dark: Point, points: Sequence[Point], bright: Patterns) -> Quantity:
    """R, DN per photon: slope through the origin of the mean, minus the dark mean, against photons.

    The mean response of these pixels errs by the nonuniformity over the root of their number.
    """
    x = np.array([p.photons for p in points])
    y = np.array([p.mean_dn - dark.mean_dn for p in points])
    slope = float(x @ y / (x @ x))
    errors = np.array([p.mean.error for p in points])
    uneven = np.sqrt(max(bright.total.value, 0.0) / dark.pixels) / (bright.mean_dn - dark.mean_dn)
    of_means = np.hypot(np.linalg.norm(x * errors), x.sum() * dark.mean.error) / (x @ x)
    return Quantity(slope, float(np.hypot(of_means, slope * uneven)))


def dark_series(shoot: Shoot, swing_dn: float, warmer_c: float) -> list[Point]:
    """Dark pairs at evenly spaced times from 0 to where the dark signal is a tenth of `swing_dn`, or to MAX_DARK_S."""
    start = float(shoot(0.0, 0.0, warmer_c).mean())
    longest = MAX_DARK_S / 2**14
    while longest < MAX_DARK_S and shoot(0.0, longest, warmer_c).mean() - start < 0.1 * swing_dn:
        longest *= 2
    return [take_pair(shoot, 0.0, float(t), warmer_c) for t in np.linspace(0.0, longest, DARK_TIMES)]


def doubling(currents: Sequence[Quantity]) -> Quantity | None:
    """Temperature rise that doubles the dark current, from the currents at WARMER_C; None below 10 standard errors."""
    if any(current.value < 10 * current.error for current in currents):
        return None
    logs = [Quantity(float(np.log2(c.value)), c.error / c.value / float(np.log(2))) for c in currents]
    return Quantity(1.0, 0.0).over(line(WARMER_C, logs)[1])


def linearity(dark: Point, points: Sequence[Point]) -> tuple[Quantity, float]:
    """LE: mean of |y / line - 1| over 5 to 95 % of the last point; the line minimises the relative deviations.

    Also the mean by noise alone: absolute normal deviations of standard errors e_i have the mean sqrt(2 / pi) e_i and
    the variance (1 - 2 / pi) e_i^2, from which the error of LE follows.
    """
    swing = points[-1].mean_dn - dark.mean_dn
    used = [p for p in points if 0.05 * swing <= p.mean_dn - dark.mean_dn <= 0.95 * swing]
    x = np.array([p.photons for p in used])
    y = np.array([p.mean_dn - dark.mean_dn for p in used])
    offset, slope = np.polynomial.polynomial.polyfit(x, y, 1, w=1 / y)
    errors = np.array([p.mean.error for p in used]) / y
    chance = np.sqrt((1 - 2 / np.pi) * (errors @ errors)) / len(used)
    deviation = np.abs(y / (offset + slope * x) - 1).mean()
    return Quantity(float(deviation), float(chance)), float(np.sqrt(2 / np.pi) * errors.mean())
