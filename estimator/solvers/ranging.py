"""Ranging: from pairs of leveled spots to distances from the camera to the LEDs (Huynh & Yoo 2016, Eqs. 1 to 3).

The paper takes the angles of the triangle of two LEDs and the camera from the image, where they are the same only if
the two LEDs are at one height. The LEDs send three coordinates, so their heights are known, and the triangle of two
LEDs at unequal heights follows from them: with leveled image points a and b at unit depth, B higher than A by e and
away from it horizontally by r, the depth h of A is the larger root of

    |h (a - b) - e b|^2 = r^2,

which is r / |a - b| at e = 0. This step is not in the paper.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compact, compiled
from estimator.errors import EstimationFailure
from estimator.io.camera import normalized

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
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
    image, leds_m = normalized(level_px, K), compact(leds_m)
    a, b, alpha, beta, separation, depth_a, depth_b = _triangles(compact(image), leds_m)
    # Division by zero gives a range that is not finite, which is refused below.
    with np.errstate(divide="ignore", invalid="ignore"):
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


@compiled
def _triangles(image: Floats, leds_m: Floats) -> tuple[Indices, Indices, Floats, Floats, Floats, Floats, Floats]:
    """Triangles of the camera and every pair a, b of n LEDs (n, 3), from their leveled image (n, 2) at unit depth.

    Returns, for each pair, a and b, the angles alpha at b and beta at a, radians, the distance of the images, and the
    depths of both LEDs, metres; NaN where no depth fits.
    """
    count = len(image)
    pairs = count * (count - 1) // 2
    of_a, of_b = np.empty(pairs, dtype=np.intp), np.empty(pairs, dtype=np.intp)
    alpha, beta, separation = np.empty(pairs), np.empty(pairs), np.empty(pairs)
    depth_a, depth_b = np.empty(pairs), np.empty(pairs)
    pair = 0
    for a in range(count):
        for b in range(a + 1, count):
            h_a, h_b = _depths(image[a], image[b], leds_m[b] - leds_m[a])
            along_x, along_y = image[b, 0] * h_b - image[a, 0] * h_a, image[b, 1] * h_b - image[a, 1] * h_a
            base = math.sqrt(along_x**2 + along_y**2 + (h_b - h_a) ** 2)
            side_a = abs(h_a) * math.sqrt(image[a, 0] ** 2 + image[a, 1] ** 2 + 1)
            side_b = abs(h_b) * math.sqrt(image[b, 0] ** 2 + image[b, 1] ** 2 + 1)
            of_a[pair], of_b[pair], depth_a[pair], depth_b[pair] = a, b, h_a, h_b
            alpha[pair], beta[pair] = _angle(base, side_b, side_a), _angle(base, side_a, side_b)
            separation[pair] = math.sqrt((image[a, 0] - image[b, 0]) ** 2 + (image[a, 1] - image[b, 1]) ** 2)
            pair += 1
    return of_a, of_b, alpha, beta, separation, depth_a, depth_b


@compiled
def _depths(image_a: Floats, image_b: Floats, a_to_b_m: Floats) -> tuple[float, float]:
    """Depths of two LEDs, metres, from their leveled images (2,) at unit depth and their offset (3,) in the world.

    NaN where no depth fits. The images are known up to yaw: of the offset, the height and the horizontal length count.
    """
    across_x, across_y = image_a[0] - image_b[0], image_a[1] - image_b[1]
    east_m, north_m, height_m = a_to_b_m
    square = across_x**2 + across_y**2
    half = height_m * (across_x * image_b[0] + across_y * image_b[1])
    rest = height_m**2 * (image_b[0] ** 2 + image_b[1] ** 2) - (east_m**2 + north_m**2)
    depth_a = (half + np.sqrt(half**2 - square * rest)) / square
    return depth_a, depth_a + height_m


@compiled
def _angle(base: float, side: float, opposite: float) -> float:
    """Angle between `base` and `side`, radians: Eq. 2 with the squares that its print lacks."""
    cosine = (base**2 + side**2 - opposite**2) / (2 * base * side)
    if abs(cosine) > 1:  # by rounding, which NaN is not
        cosine = math.copysign(1.0, cosine)
    return math.acos(cosine)


def _sums(index: Indices, values: Floats, count: int) -> Floats:
    """Sums of `values` by index, (count,)."""
    return np.asarray(np.bincount(index, weights=values, minlength=count), dtype=np.float64)
