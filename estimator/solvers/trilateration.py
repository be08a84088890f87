"""Distances to the camera's position in the world, and which LEDs fix one at all."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from estimator.errors import EstimationFailure
from estimator.solvers.ranging import COMMON_HEIGHT_M

Floats = NDArray[np.float64]

# Width over length of the LEDs' pattern. Below this a position across the line is all noise; Table 1's LEDs have 0.083.
MIN_PATTERN_WIDTH = 0.01
# Rahman's "small value" by which LEDs are moved in z; theirs is not known. Well above what rounding does to a range.
SHIFT_M = 0.01
MIN_FOR_ORIENTATION = 4


def position_from_ranges(leds_m: Floats, ranges_m: Floats) -> Floats:
    """The camera's position, (3,) metres, from LEDs (n, 3) at one height above it and its distances (n,) to them.

    Huynh & Yoo 2016, Eq. 4: differences of the spheres are linear in x and y and hold no z, so x and y come from them
    by least squares and z from the spheres themselves, `z = z_L - sqrt(mean(d^2 - rho^2))`.
    Raises EstimationFailure for fewer than three LEDs, LEDs on one line, and a mean below zero.
    """
    _check_ceiling(leds_m, needed=3)
    planar = leds_m[:, :2]
    centre = planar.mean(axis=0)
    offsets = planar - centre
    # With a and p from the LEDs' centre, |a|^2 - d^2 = 2 a . p - (|p|^2 + h^2). What is the same for all LEDs, the last
    # term, is at right angles to the offsets a, which sum to zero: least squares do not see it.
    right = (offsets**2).sum(axis=1) - ranges_m**2
    solution, *_ = np.linalg.lstsq(2 * offsets, right, rcond=None)
    height_m2 = float((ranges_m**2 - ((offsets - solution) ** 2).sum(axis=1)).mean())
    if height_m2 < 0:
        raise EstimationFailure("position", "the ranges are too short to reach the LEDs from below")
    return np.array([*(centre + solution), leds_m[:, 2].mean() - np.sqrt(height_m2)])


def position_by_shifted_leds(leds_m: Floats, ranges_m: Floats) -> Floats:
    """The position that Eq. 4 gives once LEDs are moved slightly in z so that it has a z column, (3,) metres.

    The trick of Rahman, Haque & Kim 2011 that Huynh & Yoo 2016 adopt (section 2.1), and it finds no height. The ranges
    stay those to the true LEDs, at height h, while the spheres are put around LEDs at h + e_i. Their differences are
    then solved by `(x, y, h)`, wherever the camera is, but for terms of the size of the e_i: z comes out at the
    ceiling. Noise in d^2 goes into z divided by 2 e_i, and from there into x and y.

    Filled in: the LEDs' shifts, `SHIFT_M (k / (n - 1))^2` for the k-th of n. They must not go linearly with x and y, or
    the columns would still depend on each other; alternating signs do on a square of four. All differences from the
    mean of the spheres are taken, by least squares. The "vector estimation" to follow is not described.
    Raises EstimationFailure for fewer than four LEDs and LEDs on one line.
    """
    _check_ceiling(leds_m, needed=4)
    shifted = leds_m.copy()
    shifted[:, 2] += SHIFT_M * (np.arange(len(leds_m)) / (len(leds_m) - 1)) ** 2
    centre = shifted.mean(axis=0)
    offsets = shifted - centre
    right = (offsets**2).sum(axis=1) - ranges_m**2
    solution, *_ = np.linalg.lstsq(2 * offsets, right - right.mean(), rcond=None)
    return np.asarray(centre + solution)


def position_by_range_fit(leds_m: Floats, ranges_m: Floats) -> Floats:
    """The position below the LEDs whose distances to them come nearest to the ranges (n,) in squares, (3,) metres.

    Levenberg-Marquardt from below the LEDs' centre, at the mean range. LEDs may be at different heights. Raises
    EstimationFailure for fewer than three LEDs, LEDs on one line, and where the fit ends above the lowest LED.
    """
    check_pattern(leds_m, needed=3, flat=False)
    start = leds_m.mean(axis=0) - [0.0, 0.0, float(np.abs(ranges_m).mean())]

    def residuals(position_m: Floats) -> Floats:
        return np.asarray(np.linalg.norm(position_m - leds_m, axis=1) - ranges_m)

    def slopes(position_m: Floats) -> Floats:
        towards = position_m - leds_m
        return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))

    fit = least_squares(residuals, start, jac=slopes, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    if not fit.x[2] < leds_m[:, 2].min():
        raise EstimationFailure("position", "no position below the LEDs fits the ranges")
    return np.asarray(fit.x, dtype=np.float64)


def check_pattern(leds_m: Floats, needed: int, flat: bool) -> None:
    """Refuse LEDs that do not fix a position: too few, or all on one line (looking at x and y alone where `flat`)."""
    if len(leds_m) < needed:
        raise EstimationFailure("position", f"LEDs identified: {len(leds_m)}, needed: {needed}")
    if on_one_line(leds_m[:, :2] if flat else leds_m):
        raise EstimationFailure("position", "the LEDs are on one line")


def _check_ceiling(leds_m: Floats, needed: int) -> None:
    """Refuse LEDs that do not fix a position by Eq. 4 without its z column, which needs them at one height too."""
    check_pattern(leds_m, needed, flat=True)
    if np.ptp(leds_m[:, 2]) > COMMON_HEIGHT_M:
        raise EstimationFailure("position", "the LEDs are not at a common height")


def on_one_line(points_m: Floats) -> bool:
    """Whether points (n, 2) or (n, 3) are as good as on one line."""
    length, width = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)[:2]
    return bool(width <= MIN_PATTERN_WIDTH * length)


def fix_orientation(leds_m: Floats) -> bool:
    """Whether LEDs (n, 3) give the camera's orientation without gravity, and with one to spare."""
    return len(leds_m) >= MIN_FOR_ORIENTATION and not on_one_line(leds_m)
