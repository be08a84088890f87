"""Ranging: from pairs of leveled spots to distances from the camera to the LEDs (Huynh & Yoo 2016, Eqs. 1 to 3).

The paper takes the angles of the triangle of two LEDs and the camera from the image, where they are the same only if
the two LEDs are at one height. The LEDs send three coordinates, so their heights are known, and the triangle of two
LEDs at unequal heights follows from them: with leveled image points a and b at unit depth, B higher than A by e and
away from it horizontally by r, the depth h of A is the larger root of

    |h (a - b) - e b|^2 = r^2,

which is r / |a - b| at e = 0. This step is not in the paper.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.io.camera import normalized

Floats = NDArray[np.float64]
PairLaw = Callable[[Floats, Floats, Floats], tuple[Floats, Floats]]
"""From angles alpha, beta (n,) and LED distances (n,) of n pairs to the two ranges of each pair, (n,) each."""


def law_of_sines(alpha: Floats, beta: Floats, distance_m: Floats) -> tuple[Floats, Floats]:
    """Eq. 3 corrected: `d_A = AB sin(alpha) / sin(alpha + beta)`, `d_B = AB sin(beta) / sin(alpha + beta)`, metres.

    alpha is the angle at B between BA and BO, beta the angle at A, radians.
    """
    third = np.sin(alpha + beta)
    return distance_m * np.sin(alpha) / third, distance_m * np.sin(beta) / third


def printed_eq3(alpha: Floats, beta: Floats, distance_m: Floats) -> tuple[Floats, Floats]:
    """Eq. 3 as printed, with extra factors cos(beta)/cos(alpha) and cos(alpha)/cos(beta): wrong, even negative."""
    range_a, range_b = law_of_sines(alpha, beta, distance_m)
    return range_a * np.cos(beta) / np.cos(alpha), range_b * np.cos(alpha) / np.cos(beta)


def led_ranges(level_px: Floats, K: Floats, leds_m: Floats, pair_law: PairLaw) -> Floats:
    """Distances (n,) from the camera to the LEDs, metres, from leveled pixels (n, 2) and LEDs (n, 3) in world metres.

    Every pair of LEDs gives two ranges: the triangle of the pair and the camera (see the module), Eq. 1 and Eq. 2
    corrected (the lengths of its sides, the law of cosines with its squares), then `pair_law`. Eq. 2 as printed divides
    lengths by areas, so its angles depend on the unit of length; there is no variant with it.

    A range is proportional to `AB / A'B'`, so an image error e causes a relative error of e / A'B'. The ranges of an
    LED from all its pairs are averaged with weights A'B'^2, the inverse of their variances. A pair whose heights do not
    fit its image, as with LEDs one above the other, has no triangle and is left out.

    Raises EstimationFailure for fewer than two LEDs, and if an LED has no finite range.
    """
    count = len(leds_m)
    if count < 2:
        raise EstimationFailure("ranging", "LEDs identified: 1, needed: 2")
    rays = np.column_stack([normalized(level_px, K), np.ones(count)])
    a, b = np.triu_indices(count, k=1)
    separation = np.linalg.norm(rays[a] - rays[b], axis=1)
    # Division by zero gives a range that is not finite, which is refused below.
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_a, depth_b = _depths(rays[a], rays[b], leds_m[b] - leds_m[a])
        to_a, to_b = rays[a] * depth_a[:, None], rays[b] * depth_b[:, None]
        sides = [np.linalg.norm(side, axis=1) for side in (to_b - to_a, to_a, to_b)]
        alpha = _angle(sides[0], sides[2], sides[1])
        beta = _angle(sides[0], sides[1], sides[2])
        range_a, range_b = pair_law(alpha, beta, np.linalg.norm(leds_m[a] - leds_m[b], axis=1))
    level = leds_m[a, 2] == leds_m[b, 2]
    used = level | (np.isfinite(range_a) & np.isfinite(range_b) & (depth_a > 0) & (depth_b > 0))
    a, b, separation, range_a, range_b = a[used], b[used], separation[used], range_a[used], range_b[used]
    weight = separation**2
    ranges_m = _sums(a, weight * range_a, count) + _sums(b, weight * range_b, count)
    with np.errstate(invalid="ignore"):
        ranges_m /= _sums(a, weight, count) + _sums(b, weight, count)
    if not np.isfinite(ranges_m).all():
        raise EstimationFailure("ranging", "a pair of spots gives no finite range")
    return ranges_m


def _depths(rays_a: Floats, rays_b: Floats, a_to_b_m: Floats) -> tuple[Floats, Floats]:
    """Depths of both LEDs of n pairs, (n,) metres, from leveled rays (n, 3) at unit depth and offsets (n, 3) in world.

    NaN where no depth fits. The rays are known up to yaw: of the offset, the height and the horizontal length count.
    """
    across, image_b, height_m = (rays_a - rays_b)[:, :2], rays_b[:, :2], a_to_b_m[:, 2]
    square = (across**2).sum(axis=1)
    half = height_m * (across * image_b).sum(axis=1)
    rest = height_m**2 * (image_b**2).sum(axis=1) - (a_to_b_m[:, :2] ** 2).sum(axis=1)
    depth_a = (half + np.sqrt(half**2 - square * rest)) / square
    return depth_a, depth_a + height_m


def _angle(base: Floats, side: Floats, opposite: Floats) -> Floats:
    """Angle between `base` and `side`, radians: Eq. 2 with the squares that its print lacks."""
    cosine = (base**2 + side**2 - opposite**2) / (2 * base * side)
    return np.asarray(np.arccos(np.clip(cosine, -1, 1)))


def _sums(index: NDArray[np.intp], values: Floats, count: int) -> Floats:
    """Sums of `values` by index, (count,)."""
    return np.asarray(np.bincount(index, weights=values, minlength=count), dtype=np.float64)
