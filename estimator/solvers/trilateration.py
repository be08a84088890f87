"""Trilateration: from distances to LEDs to the camera's position, and checks of the LEDs' geometry."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from estimator.compiled import compact
from estimator.errors import EstimationFailure

Floats = NDArray[np.float64]

# Width over length of the LEDs' pattern, from which on a position across it is not noise alone. Table 1's have 0.083.
MIN_PATTERN_WIDTH = 0.01
# Shift of LEDs along z, Rahman's "small value", whose size is not published. Well above the rounding of a range.
SHIFT_M = 0.01
MIN_FOR_ORIENTATION = 4
# Each round multiplies the error by the square of the slope of the LEDs' plane, or less.
MAX_ROUNDS = 100
# Well above the rounding of squared ranges over the height, and far below any centroid's error.
CONVERGED_M = 1e-10


def position_from_ranges(leds_m: Floats, ranges_m: Floats) -> Floats:
    """Position of the camera below LEDs (n, 3), (3,) world metres, from distances (n,) to them.

    Huynh & Yoo 2016, Eq. 4: differences of the spheres are linear in x and y and do not contain z if the LEDs are at
    one height. x and y follow by least squares, z from the spheres: `z = z_L - sqrt(mean(d^2 - rho^2))`. At unequal
    heights, with LEDs at z_L + e, a sphere is that of an LED at z_L with the squared range d^2 - 2 h e - e^2, where
    h = z_L - z: x, y and h are then computed in turns. Where the turns end in no position, as by a wrong map or below a
    steep plane of LEDs, the position is that of `position_by_range_fit`.
    Raises EstimationFailure for fewer than three LEDs, LEDs on one line in x and y, and ranges that no position fits.
    """
    check_pattern(leds_m, needed=3, flat=True)
    planar, heights_m = leds_m[:, :2], leds_m[:, 2]
    centre, ceiling_m = planar.mean(axis=0), heights_m.mean()
    offsets, above_m = planar - centre, heights_m - ceiling_m
    height_m, inverse = 0.0, np.linalg.pinv(2 * offsets)
    for _ in range(MAX_ROUNDS):
        ranges2 = ranges_m**2 - above_m * (2 * height_m + above_m)
        # With a and p measured from the LEDs' centre, |a|^2 - d^2 = 2 a . p - (|p|^2 + h^2). The last term is the same
        # for all LEDs and so orthogonal to the offsets a, which sum to zero: it does not change the solution.
        solution = inverse @ ((offsets**2).sum(axis=1) - ranges2)
        height_m2 = float((ranges2 - ((offsets - solution) ** 2).sum(axis=1)).mean())
        if height_m2 < 0:
            break
        before_m, height_m = height_m, float(np.sqrt(height_m2))
        if not above_m.any() or abs(height_m - before_m) < CONVERGED_M:
            return np.array([*(centre + solution), ceiling_m - height_m])
    if above_m.any() and (ranges_m > 0).all():
        return position_by_range_fit(leds_m, ranges_m)
    raise EstimationFailure("position", "the ranges are too short to reach the LEDs from below")


def position_by_shifted_leds(leds_m: Floats, ranges_m: Floats) -> Floats:
    """Position by Eq. 4 with LEDs shifted slightly along z so that the system has a z column, (3,) world metres.

    The method of Rahman, Haque & Kim 2011, which Huynh & Yoo 2016 adopt (section 2.1). It does not determine the
    height of a camera below LEDs at one height h. The ranges are those to the true LEDs, while the spheres are centred
    on LEDs at h + e_i. The differences of the spheres are then solved by `(x, y, h)` for any camera height, up to terms
    of the size of the e_i: z comes out at the ceiling. Noise in d^2 enters z divided by 2 e_i, and from there x and y.
    LEDs at unequal heights have a z column without the shifts, which are added all the same.

    Not published, chosen here: the shifts, `SHIFT_M (k / (n - 1))^2` for the k-th of n LEDs. They must not be linear in
    x and y, or the columns would stay linearly dependent; alternating signs are, on a square of four. The differences
    are those from the mean of the spheres, solved by least squares. The "vector estimation" that follows is not
    described.
    Raises EstimationFailure for fewer than four LEDs, and LEDs on one line.
    """
    check_pattern(leds_m, needed=4, flat=True)
    shifted = leds_m.copy()
    shifted[:, 2] += SHIFT_M * (np.arange(len(leds_m)) / (len(leds_m) - 1)) ** 2
    centre = shifted.mean(axis=0)
    offsets = shifted - centre
    right = (offsets**2).sum(axis=1) - ranges_m**2
    solution, *_ = np.linalg.lstsq(2 * offsets, right - right.mean(), rcond=None)
    return np.asarray(centre + solution)


def position_by_range_fit(leds_m: Floats, ranges_m: Floats) -> Floats:
    """Position below the LEDs (n, 3) with the least squared differences from the ranges (n,), (3,) world metres.

    Levenberg-Marquardt from below the LEDs' centre, at the mean range. LEDs may be at different heights. Raises
    EstimationFailure for fewer than three LEDs, LEDs on one line, and if the fit ends above the lowest LED.
    """
    check_pattern(leds_m, needed=3, flat=False)
    start = leds_m.mean(axis=0) - [0.0, 0.0, float(np.abs(ranges_m).mean())]

    def residuals(position_m: Floats) -> Floats:
        return np.asarray(np.linalg.norm(position_m - leds_m, axis=1) - ranges_m)

    def jacobian(position_m: Floats) -> Floats:
        from_leds = position_m - leds_m
        return np.asarray(from_leds / np.linalg.norm(from_leds, axis=1, keepdims=True))

    fit = least_squares(residuals, start, jac=jacobian, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    if not fit.x[2] < leds_m[:, 2].min():
        raise EstimationFailure("position", "no position below the LEDs fits the ranges")
    return np.asarray(fit.x, dtype=np.float64)


def check_pattern(leds_m: Floats, needed: int, flat: bool) -> None:
    """Raise EstimationFailure for fewer than `needed` LEDs (n, 3), or LEDs on one line (in x and y if `flat`)."""
    if len(leds_m) < needed:
        raise EstimationFailure("position", f"LEDs identified: {len(leds_m)}, needed: {needed}")
    if on_one_line(leds_m[:, :2] if flat else leds_m):
        raise EstimationFailure("position", "the LEDs are on one line")


def on_one_line(points_m: Floats) -> bool:
    """Whether points (n, 2) or (n, 3) are on one line, within MIN_PATTERN_WIDTH of its length."""
    length, width, *_ = extents(points_m)
    return width <= MIN_PATTERN_WIDTH * length


def extents(points_m: Floats) -> tuple[float, ...]:
    """Singular values of points (n, k) about their mean, largest first: their length, width and depth times root n."""
    return _extents(compact(points_m).tobytes(), points_m.shape[1])


@lru_cache(maxsize=8)  # most variants of a frame ask for those of the same LEDs
def _extents(packed: bytes, columns: int) -> tuple[float, ...]:
    points_m = np.frombuffer(packed).reshape(-1, columns)
    return tuple(np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False).tolist())


def determine_orientation(leds_m: Floats) -> bool:
    """Whether LEDs (n, 3) determine the camera's orientation without gravity, and redundantly."""
    return len(leds_m) >= MIN_FOR_ORIENTATION and not on_one_line(leds_m)
