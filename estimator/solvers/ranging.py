"""Ranging: from pairs of leveled spots to distances from the camera to the LEDs (Huynh & Yoo 2016, Eqs. 1 to 3)."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.io.device import normalized

# LEDs whose heights differ by less are on one ceiling: 1 mm at 3 m costs 1e-3 m in range, as much as a good centroid.
COMMON_HEIGHT_M = 1e-3

Floats = NDArray[np.float64]
PairLaw = Callable[[Floats, Floats, Floats], tuple[Floats, Floats]]
"""From angles alpha, beta (n,) and LED distances (n,) of n pairs to the two ranges of each pair, (n,) each."""


def law_of_sines(alpha: Floats, beta: Floats, distance_m: Floats) -> tuple[Floats, Floats]:
    """Eq. 3 corrected: `d_A = AB sin(alpha) / sin(alpha + beta)`, `d_B = AB sin(beta) / sin(alpha + beta)`, metres.

    alpha is the angle at B between BA and BO, beta the angle at A, radians. They are the same in the image and in the
    world, whose planes are parallel.
    """
    third = np.sin(alpha + beta)
    return distance_m * np.sin(alpha) / third, distance_m * np.sin(beta) / third


def printed_eq3(alpha: Floats, beta: Floats, distance_m: Floats) -> tuple[Floats, Floats]:
    """Eq. 3 as printed, with extra factors cos(beta)/cos(alpha) and cos(alpha)/cos(beta): wrong, even negative."""
    range_a, range_b = law_of_sines(alpha, beta, distance_m)
    return range_a * np.cos(beta) / np.cos(alpha), range_b * np.cos(alpha) / np.cos(beta)


def led_ranges(level_px: Floats, K: Floats, leds_m: Floats, pair_law: PairLaw) -> Floats:
    """Distances (n,) from the camera to the LEDs, metres, from leveled pixels (n, 2) and LEDs (n, 3) in world metres.

    Every pair of LEDs gives two ranges: Eq. 1 with the image distance as unit, Eq. 2 corrected (the law of cosines with
    its squares), then `pair_law`. Eq. 2 as printed divides lengths by areas, so its angles depend on the unit of
    length; there is no variant with it.

    A range is proportional to `AB / A'B'`, so an image error e causes a relative error of e / A'B'. The ranges of an
    LED from all its pairs are averaged with weights A'B'^2, the inverse of their variances.

    Raises EstimationFailure for fewer than two LEDs, LEDs of different heights (image and world are not similar then),
    and if an LED has no finite range.
    """
    count = len(leds_m)
    if count < 2:
        raise EstimationFailure("ranging", "LEDs identified: 1, needed: 2")
    if np.ptp(leds_m[:, 2]) > COMMON_HEIGHT_M:
        raise EstimationFailure("ranging", "the LEDs are not at a common height")
    rays = np.column_stack([normalized(level_px, K), np.ones(count)])
    to_image = np.linalg.norm(rays, axis=1)
    a, b = np.triu_indices(count, k=1)
    separation = np.linalg.norm(rays[a] - rays[b], axis=1)
    distance_m = np.linalg.norm(leds_m[a] - leds_m[b], axis=1)
    # Division by zero gives a range that is not finite, which is refused below.
    with np.errstate(divide="ignore", invalid="ignore"):
        alpha = _angle(separation, to_image[b], to_image[a])
        beta = _angle(separation, to_image[a], to_image[b])
        range_a, range_b = pair_law(alpha, beta, distance_m)
    weight = separation**2
    ranges_m = _sums(a, weight * range_a, count) + _sums(b, weight * range_b, count)
    ranges_m /= _sums(a, weight, count) + _sums(b, weight, count)
    if not np.isfinite(ranges_m).all():
        raise EstimationFailure("ranging", "a pair of spots gives no finite range")
    return ranges_m


def _angle(base: Floats, side: Floats, opposite: Floats) -> Floats:
    """Angle between `base` and `side`, radians: Eq. 2 with the squares that its print lacks."""
    cosine = (base**2 + side**2 - opposite**2) / (2 * base * side)
    return np.asarray(np.arccos(np.clip(cosine, -1, 1)))


def _sums(index: NDArray[np.intp], values: Floats, count: int) -> Floats:
    """Sums of `values` by index, (count,)."""
    return np.asarray(np.bincount(index, weights=values, minlength=count), dtype=np.float64)
