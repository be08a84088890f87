"""Loops over the light of spots: half level of blobs, the background and its noise, sums and moments.

Images are (rows, columns) of electrons. `left` and `top` are the first column and row of a rectangle in its region, u
and v are continuous pixels of the region with pixel centres at +0.5; masks and spans are those of
`estimator.spots.shape_loops`.

A plane of illumination is (u, v, slope along u, slope along v): 1 at (u, v), with these slopes per pixel. A background
is its level at the middle of the illumination, what its noise stays below as far as the device knows of it, and by how
much its variance exceeds the known one. Noise is a pixel's signal-independent variance, the photo response
nonuniformity, and the part of the variance that is rounding. All in electrons or their squares.

Loops go over slices of rows: the processor's vectors then take several pixels at once.
"""

import math

import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compiled, compiled_sums

Image = NDArray[np.float32]
Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Mask = NDArray[np.bool_]
Plane = tuple[float, float, float, float]
Background = tuple[float, float, float]
Noise = tuple[float, float, float]
Sums = tuple[float, float, float, float, float, float, float, float, float, float, float, float]

# Pixels of the ring this many standard deviations from its median are no background of the LED.
BACKGROUND_SIGMA = 3.0
# Of fewer pixels the variance is not measured.
MIN_RING_PIXELS = 20
# Of fewer pixels within an LED image the gradient of its light is not measured.
MIN_INSIDE_PIXELS = 20
# Illumination beside an LED image, relative to its middle: luminaires of 60 cm have 0.8 to 1.2; noise may give any.
MIN_FALL_OFF, MAX_FALL_OFF = 0.5, 2.0
# A ring whose variance exceeds the noise's by this many standard deviations has a structure.
STRUCTURE_SIGMA = 4.0
# Below this share of the variance, which noise of half a step exceeds, rounding errors are independent.
MAX_ROUNDING_SHARE = 0.25
# A sample of numbers, and the ranks in it to either side of one that is looked for, two standard deviations.
SAMPLE, SPREAD = 64, 8
LEVEL: Plane = (0.0, 0.0, 0.0, 0.0)


@compiled
def _front(values: Floats, first: int, last: int, limit: float, equal: bool) -> int:
    """Bring the numbers below a limit, or those `equal` to it, of values[first:last] to their front; their end."""
    front = first
    for k in range(first, last):
        value = values[k]
        values[k], values[front] = values[front], value
        front += value == limit if equal else value < limit
    return front


@compiled
def _nth(values: Floats, n: int) -> float:
    """The n-th smallest of numbers (from 0), which are put in another order: none before it is larger (Hoare 1961)."""
    first, last = 0, len(values)
    while True:
        pivot = float(values[(first + last) // 2])
        below = _front(values, first, last, pivot, False)
        if n < below:
            last = below
            continue
        first = _front(values, below, last, pivot, True)
        if n < first or first == below:  # nothing equals a pivot that is no number
            return pivot


@compiled
def _near_nth(values: Floats, n: int) -> tuple[Floats, int]:
    """Some of the numbers, with the n-th smallest (from 0) and the one before it, and its place among them.

    Limits by a sample leave a fifth of the numbers (Floyd and Rivest 1975).
    """
    size = len(values)
    if size > 4 * SAMPLE:
        sample = values[:: size // SAMPLE].copy()
        rank = n * len(sample) // size
        low, high = _nth(sample, max(rank - SPREAD, 0)), _nth(sample, min(rank + SPREAD, len(sample) - 1))
        some, count, below = np.empty(size), 0, 0
        for k in range(size):
            below += values[k] < low
        for k in range(size):
            some[count] = values[k]
            count += (values[k] >= low) & (values[k] <= high)
        if below < n < below + count:
            return some[:count], n - below
    return values.copy(), n


@compiled
def median(values: Floats) -> float:
    """Median of numbers (n,)."""
    some, middle = _near_nth(values, len(values) // 2)
    upper = _nth(some, middle)
    if len(values) % 2 == 1:
        return upper
    lower = float(some[0])
    for k in range(1, middle):
        lower = max(lower, float(some[k]))
    return (lower + upper) / 2


@compiled
def above_half_level(smooth: Image, left: int, top: int, blob: Mask, background_e: float) -> Mask:
    """Pixels of a blob (rows, columns) at least half as far above the background as its upper quartile.

    The upper quartile is the plateau of an LED image; the maximum would be its noise.
    """
    height, width = blob.shape
    values, count = np.empty(height * width + 1), 0
    for row in range(height):
        line = smooth[top + row, left : left + width]
        for column in range(width):
            values[count] = line[column]
            count += blob[row, column]
    plateau_e = _nth(*_near_nth(values[:count], 3 * count // 4))
    half_e = np.float32(background_e + (plateau_e - background_e) / 2)
    core = np.empty((height, width), dtype=np.bool_)
    for row in range(height):
        line = smooth[top + row, left : left + width]
        for column in range(width):
            core[row, column] = blob[row, column] & (line[column] >= half_e)
    return core


@compiled_sums
def fall_off(image_e: Image, left: int, top: int, inside: Mask) -> Plane:
    """Plane that the light inside an LED image (rows, columns) follows, 1 at its middle: the illumination by the lens.

    With the second moments S of the pixels inside, a relative gradient g of the light moves their centroid by S g.
    """
    height, width = inside.shape
    count, of_u, of_v, of_uu, of_uv, of_vv, total, light_u, light_v = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for row in range(height):
        v, line, line_e = row - 0.5 * height, inside[row], image_e[top + row, left : left + width]
        size, sum_u, sum_uu, light, moved = 0.0, 0.0, 0.0, 0.0, 0.0
        for column in range(width):
            u, own = column - 0.5 * width, 1.0 if line[column] else 0.0
            size += own
            sum_u += own * u
            sum_uu += own * u * u
            light += own * line_e[column]
            moved += own * line_e[column] * u
        count += size
        of_u += sum_u
        of_v += size * v
        of_uu += sum_uu
        of_uv += sum_u * v
        of_vv += size * v * v
        total += light
        light_u += moved
        light_v += light * v
    if count < MIN_INSIDE_PIXELS:
        return LEVEL
    u, v = of_u / count, of_v / count
    uu, uv, vv = of_uu / count - u * u, of_uv / count - u * v, of_vv / count - v * v
    moved_u, moved_v = light_u / total - u, light_v / total - v
    determinant = uu * vv - uv * uv
    slope_u, slope_v = (vv * moved_u - uv * moved_v) / determinant, (uu * moved_v - uv * moved_u) / determinant
    return left + u + 0.5 * (width + 1), top + v + 0.5 * (height + 1), slope_u, slope_v


@compiled
def _illumination(plane: Plane, u: float, v: float) -> float:
    """Illumination by the lens, relative to a plane's middle."""
    if plane[2] == 0 and plane[3] == 0:
        return 1.0
    light = 1 + plane[2] * (u - plane[0]) + plane[3] * (v - plane[1])
    light = MIN_FALL_OFF if light < MIN_FALL_OFF else light
    return MAX_FALL_OFF if light > MAX_FALL_OFF else light


@compiled
def _variance(raw_e: float, floor_e2: float, prnu: float) -> float:
    """Variance of a pixel with raw electrons, electrons squared."""
    lit_e = raw_e if raw_e > 0 else 0.0
    uneven_e = prnu * lit_e
    # Shot noise: a raw pixel's variance is its electrons.
    return lit_e + floor_e2 + uneven_e * uneven_e


@compiled_sums
def background_of(
    image_e: Image, raw_e: Image, left: int, top: int, ring: Ints, plane: Plane, noise: Noise
) -> tuple[Background, Floats]:
    """Background by the pixels of a ring, rows and columns (n, 2), and how far these are from it, (n,).

    It is the mean of the ring without pixels of another surface or light; of all of it where its median is between two
    surfaces.
    """
    floor_e2, prnu, rounding_e2 = noise
    count = len(ring)
    ring_e, of_raw_e, of_ring_e2 = np.empty(count), np.empty(count), np.empty(count)
    for k in range(count):
        row, column = ring[k, 0], ring[k, 1]
        light = _illumination(plane, left + column + 0.5, top + row + 0.5)
        raw = raw_e[top + row, left + column]
        ring_e[k], of_raw_e[k] = image_e[top + row, left + column] / light, raw / light
        of_ring_e2[k] = _variance(raw, floor_e2, prnu)
    background_e, gate_e, excess_e2, off_e = 0.0, math.inf, 0.0, np.empty(count)
    if count > 0:
        # One electron more: the noise of a pixel with fewer is not normal.
        gate_e = BACKGROUND_SIGMA * math.sqrt(median(of_ring_e2) + 1.0)
        middle_e = median(ring_e)
        even = 0
        for k in range(count):
            off_e[k] = abs(ring_e[k] - middle_e)
            even += off_e[k] <= gate_e
        limit_e = gate_e if even > 0 else math.inf
        background_e = _mean_where(ring_e, off_e, limit_e)
        if (even if even > 0 else count) >= MIN_RING_PIXELS:
            model_e2 = _mean_where(of_ring_e2, off_e, limit_e)
            excess_e2 = _excess_variance(of_raw_e, off_e, limit_e, model_e2, rounding_e2)
    return (background_e, gate_e, excess_e2), off_e


@compiled_sums
def light_within(
    image_e: Image, raw_e: Image, left: int, top: int, support: Mask, plane: Plane, background: Background, noise: Noise
) -> tuple[Floats, Floats, Sums]:
    """Electrons above the background times the illumination, and a pixel's variance, (rows, columns); and the
    `light_sums` of a support.
    """
    height, width = support.shape
    (background_e, gate_e, excess_e2), (floor_e2, prnu, _) = background, noise
    above_e, variance_e2 = np.empty((height, width)), np.empty((height, width))
    for row in range(height):
        image, raw_line = image_e[top + row, left : left + width], raw_e[top + row, left : left + width]
        for column in range(width):
            above = image[column] - background_e * _illumination(plane, left + column + 0.5, top + row + 0.5)
            variance = _variance(raw_line[column], floor_e2, prnu)
            of_ring = variance + excess_e2 if variance > -excess_e2 else 0.0
            above_e[row, column] = above
            variance_e2[row, column] = of_ring if support[row, column] & (above <= gate_e) else variance
    return above_e, variance_e2, light_sums(above_e, support, variance_e2, left, top)


@compiled_sums
def centroid_within(
    image_e: Image, raw_e: Image, left: int, top: int, support: Mask, plane: Plane, background: Background, noise: Noise
) -> tuple[float, float, float, float]:
    """Flux, centroid (u, v) and the sum of variances by `light_within`, without images, in two thirds of its time."""
    height, width = support.shape
    (background_e, gate_e, excess_e2), (floor_e2, prnu, _) = background, noise
    flux, u, v, of_noise = 0.0, 0.0, 0.0, 0.0
    for row in range(height):
        image, raw_line = image_e[top + row, left : left + width], raw_e[top + row, left : left + width]
        inside, light, along = support[row], 0.0, 0.0
        for column in range(width):
            above = image[column] - background_e * _illumination(plane, left + column + 0.5, top + row + 0.5)
            variance = _variance(raw_line[column], floor_e2, prnu)
            of_ring = variance + excess_e2 if variance > -excess_e2 else 0.0
            here = above if inside[column] else 0.0
            light += here
            along += here * (column + 0.5)
            of_noise += (of_ring if above <= gate_e else variance) if inside[column] else 0.0
        flux += light
        u += along
        v += light * (row + 0.5)
    return flux, left + u / flux, top + v / flux, of_noise


@compiled_sums
def _mean_where(values: Floats, off_e: Floats, limit_e: float) -> float:
    """Mean of the numbers whose pixels are off the background by at most a limit."""
    total, count = 0.0, 0
    for k in range(len(values)):
        total += values[k] if off_e[k] <= limit_e else 0.0
        count += off_e[k] <= limit_e
    return total / count


@compiled_sums
def _excess_variance(ring_e: Floats, off_e: Floats, limit_e: float, model_e2: float, rounding_e2: float) -> float:
    """Variance of a pixel without light of an LED, by the ring's pixels off the background by at most a limit, less
    that by the model, electrons squared.

    It is negative where the ADC's steps exceed the noise: neighbouring pixels are then rounded alike, while the model's
    rounding errors are independent. It is positive where the background has a structure.
    """
    mean_e, total_e2, count = _mean_where(ring_e, off_e, limit_e), 0.0, 0
    for k in range(len(ring_e)):
        off = ring_e[k] - mean_e if off_e[k] <= limit_e else 0.0
        total_e2 += off * off
        count += off_e[k] <= limit_e
    excess_e2 = total_e2 / (count - 1) - model_e2
    # The variance of n normal numbers has a relative standard deviation of sqrt(2 / n).
    structured = excess_e2 > STRUCTURE_SIGMA * math.sqrt(2 / count) * model_e2
    return excess_e2 if structured or rounding_e2 > MAX_ROUNDING_SHARE * model_e2 else 0.0


@compiled_sums
def light_sums(above_e: Floats, support: Mask, variance_e2: Floats, left: int, top: int) -> Sums:
    """Flux and centroid (u, v) of the light in a support (rows, columns), and the sum of the variances there; the light
    times du^2, du dv and dv^2 about the centroid, and the variances times du^2, du dv, dv^2, du^4 and dv^4.
    """
    height, width = above_e.shape
    flux, u, v = 0.0, 0.0, 0.0
    for row in range(height):
        line, own, light, along = above_e[row], support[row], 0.0, 0.0
        for column in range(width):
            here = line[column] if own[column] else 0.0
            light += here
            along += here * (column + 0.5)
        flux += light
        u += along
        v += light * (row + 0.5)
    u, v = u / flux, v / flux
    uu, uv, vv = 0.0, 0.0, 0.0
    noise, noise_uu, noise_uv, noise_vv, noise_uuuu, noise_vvvv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for row in range(height):
        line, line_e2, own = above_e[row], variance_e2[row], support[row]
        light, light_u, light_uu, of_noise, of_u, of_uu, of_uuuu = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for column in range(width):
            du = column + 0.5 - u
            here, here_e2 = (line[column], line_e2[column]) if own[column] else (0.0, 0.0)
            light += here
            light_u += here * du
            light_uu += here * du * du
            of_noise += here_e2
            of_u += here_e2 * du
            of_uu += here_e2 * du * du
            of_uuuu += here_e2 * du * du * du * du
        dv = row + 0.5 - v
        uu += light_uu
        uv += light_u * dv
        vv += light * dv * dv
        noise += of_noise
        noise_uu += of_uu
        noise_uv += of_u * dv
        noise_vv += of_noise * dv * dv
        noise_uuuu += of_uuuu
        noise_vvvv += of_noise * dv * dv * dv * dv
    of_light = flux, left + u, top + v, noise, uu, uv, vv
    return *of_light, noise_uu, noise_uv, noise_vv, noise_uuuu, noise_vvvv


@compiled
def brightest(image_e: Image, clipped: Mask, left: int, top: int, spans: Ints) -> tuple[int, int, bool]:
    """Row and column of the brightest pixel in spans of a rectangle, row by row the first of equal ones, and whether a
    pixel there is `clipped`.
    """
    height = spans.shape[1]
    peaks_e, saturated = np.full(max(spans[1].max(), 1), -np.inf, dtype=np.float32), 0
    for row in range(height):
        first, last = spans[0, row], spans[1, row]
        line_e, highest_e = image_e[top + row, left + first : left + last], peaks_e[first:last]
        for k in range(len(highest_e)):
            highest_e[k] = max(highest_e[k], line_e[k])
        for is_clipped in clipped[top + row, left + first : left + last]:
            saturated += is_clipped
    peak_e = peaks_e.max()
    for row in range(height):
        first, last = spans[0, row], spans[1, row]
        line_e, equal = image_e[top + row, left + first : left + last], 0
        for pixel_e in line_e:
            equal += pixel_e == peak_e
        if equal > 0:
            return top + row, left + first + line_e.argmax(), saturated > 0
    return top, left, False
