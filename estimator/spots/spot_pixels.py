"""Loops over the pixels of spots: blobs above half level, light and its background, moments and their noise.

Images are (rows, columns) of electrons. `left` and `top` are the first column and row of a rectangle in its region, u
and v are continuous pixels of the region with pixel centres at +0.5. An ellipse is (u, v, uu, uv, vv): a pixel at the
offset (du, dv) from (u, v) is inside where uu du^2 + 2 uv du dv + vv dv^2 is at most 1. A plane of illumination is
(u, v, slope along u, slope along v): 1 at (u, v), with these slopes per pixel.

Loops go over slices of rows, and sum or compare by columns: the processor's vectors then take several pixels at once.
"""

import math

import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compiled

Image = NDArray[np.float32]
Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Mask = NDArray[np.bool_]
Form = tuple[float, float, float, float, float]
Plane = tuple[float, float, float, float]

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
            some[count] = values[k]
            count += (values[k] >= low) & (values[k] <= high)
            below += values[k] < low
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


@compiled
def piece_sums(pieces: Ints, piece: int) -> tuple[tuple[int, int, int, int, int, int], tuple[int, int, int, int]]:
    """Sums of 1, u, v, u^2, u v and v^2 over the pixels of a piece, u its column and v its row, and the box around it:
    first column and row, last column and row.
    """
    height, width = pieces.shape
    count, of_u, of_v, of_uu, of_uv, of_vv = 0, 0, 0, 0, 0, 0
    first_column, first_row, last_column, last_row = width, height, -1, -1
    for row in range(height):
        size, sum_u, sum_uu, first, last = 0, 0, 0, width, -1
        for column in range(width):
            own = pieces[row, column] == piece
            size += own
            sum_u += own * column
            sum_uu += own * column * column
            first = min(first, column if own else width)
            last = max(last, column if own else -1)
        if size > 0:
            count += size
            of_u += sum_u
            of_v += size * row
            of_uu += sum_uu
            of_uv += sum_u * row
            of_vv += size * row * row
            first_column, last_column = min(first_column, first), max(last_column, last)
            first_row, last_row = min(first_row, row), row
    return (count, of_u, of_v, of_uu, of_uv, of_vv), (first_column, first_row, last_column, last_row)


@compiled
def distance2(form: Form, u: float, v: float) -> float:
    """Squared distance of a point from the centre of an ellipse, at most 1 inside."""
    du, dv = u - form[0], v - form[1]
    return (form[2] * du + 2 * form[3] * dv) * du + form[4] * dv * dv


@compiled
def inside_ellipse(form: Form, left: int, top: int, width: int, height: int) -> Mask:
    """Pixels of a rectangle inside an ellipse, (height, width)."""
    inside = np.empty((height, width), dtype=np.bool_)
    for row in range(height):
        for column in range(width):
            inside[row, column] = distance2(form, left + column + 0.5, top + row + 0.5) <= 1
    return inside


@compiled
def around_ellipse(own: Form, outer: Form, left: int, top: int, width: int, height: int) -> tuple[Mask, Mask]:
    """Pixels of a rectangle inside an ellipse, and those beside it inside an outer one, (height, width)."""
    support, ring = inside_ellipse(own, left, top, width, height), inside_ellipse(outer, left, top, width, height)
    for row in range(height):
        for column in range(width):
            ring[row, column] &= not support[row, column]
    return support, ring


@compiled
def _half_chords(radius_px: float) -> Ints:
    """Pixels to either side of the middle at most a radius from the centre of a disc, by rows from the centre's on."""
    halves = np.empty(int(radius_px) + 1, dtype=np.int32)
    for step in range(len(halves)):
        halves[step] = int(math.sqrt(radius_px * radius_px - step * step))
    return halves


@compiled
def _widen(near: Mask, row: int, first: int, last: int, halves: Ints) -> None:
    """Mark the pixels at most a radius from a run of pixels of a row, given the disc's `_half_chords`."""
    height, width = near.shape
    for other in range(max(row - len(halves) + 1, 0), min(row + len(halves), height)):
        half = halves[abs(other - row)]
        near[other, max(first - half, 0) : min(last + half, width)] = True


@compiled
def padded(mask: Mask, radius_px: float, larger_px: float, outside_px: float) -> tuple[Mask, Mask, Mask]:
    """Pixels at most a radius, and a larger one, from one of a mask, and at most `outside_px` from one not in it."""
    height, width = mask.shape
    near, nearby = np.zeros((height, width), dtype=np.bool_), np.zeros((height, width), dtype=np.bool_)
    outside = np.zeros((height, width), dtype=np.bool_)
    halves, larger_halves, outside_halves = _half_chords(radius_px), _half_chords(larger_px), _half_chords(outside_px)
    for row in range(height):
        column = 0
        while column < width:
            first, own = column, mask[row, column]
            while column < width and mask[row, column] == own:
                column += 1
            if own:
                _widen(near, row, first, column, halves)
                _widen(nearby, row, first, column, larger_halves)
            else:
                _widen(outside, row, first, column, outside_halves)
    return near, nearby, outside


@compiled
def around_face(
    image_e: Image, left: int, top: int, face: Mask, margin_px: float, ring_px: float, border_px: float
) -> tuple[Mask, Mask, Plane]:
    """The face of an LED image padded by a margin, the ring of pixels up to `ring_px` beyond, and the illumination by
    the lens.

    The illumination is the plane of the light more than `border_px` inside the face.
    """
    support, ring, outside = padded(face, margin_px, margin_px + ring_px, border_px)
    for row in range(len(ring)):
        for column in range(ring.shape[1]):
            ring[row, column] &= not support[row, column]
    return support, ring, _fall_off(image_e, left, top, outside)


@compiled
def _fall_off(image_e: Image, left: int, top: int, outside: Mask) -> Plane:
    """Plane that the light inside an LED image follows, 1 at its middle.

    With the second moments S of the pixels inside, a relative gradient g of the light moves their centroid by S g.
    """
    height, width = outside.shape
    # Sums of 1, v and v^2, of the light, and of the light times v, with v from the rectangle's middle.
    sums = np.zeros((5, width))
    for row in range(height):
        v, line_e = row - 0.5 * height, image_e[top + row, left : left + width]
        for column in range(width):
            inside = 0.0 if outside[row, column] else 1.0
            light = inside * line_e[column]
            sums[0, column] += inside
            sums[1, column] += inside * v
            sums[2, column] += inside * v * v
            sums[3, column] += light
            sums[4, column] += light * v
    count, of_u, of_v, of_uu, of_uv, of_vv, total, light_u, light_v = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for column in range(width):
        u = column - 0.5 * width
        count += sums[0, column]
        of_u += sums[0, column] * u
        of_v += sums[1, column]
        of_uu += sums[0, column] * u * u
        of_uv += sums[1, column] * u
        of_vv += sums[2, column]
        total += sums[3, column]
        light_u += sums[3, column] * u
        light_v += sums[4, column]
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
    light = 1 + plane[2] * (u - plane[0]) + plane[3] * (v - plane[1])
    light = MIN_FALL_OFF if light < MIN_FALL_OFF else light
    return MAX_FALL_OFF if light > MAX_FALL_OFF else light


@compiled
def share_among(support: Mask, ring: Mask, left: int, top: int, own: Form, others: Floats, bare: Floats) -> None:
    """Take pixels nearer to one of k other ellipses out of a support, and those inside of one out of a ring.

    `own` and the `others` (k, 5) are padded, `bare` (k, 5) are the others without padding: the ring is what is outside
    of these if all of it is inside of the padded ones.
    """
    height, width = support.shape
    around, left_over = ring.copy(), False
    for row in range(height):
        for column in range(width):
            if not (support[row, column] or ring[row, column]):
                continue
            u, v = left + column + 0.5, top + row + 0.5
            here = distance2(own, u, v)
            for k in range(len(others)):
                form = (others[k, 0], others[k, 1], others[k, 2], others[k, 3], others[k, 4])
                there = distance2(form, u, v)
                support[row, column] &= here <= there
                ring[row, column] &= there > 1
            left_over |= ring[row, column]
    if left_over:
        return
    for row in range(height):
        for column in range(width):
            ring[row, column] = around[row, column]
            for k in range(len(bare)):
                form = (bare[k, 0], bare[k, 1], bare[k, 2], bare[k, 3], bare[k, 4])
                ring[row, column] &= distance2(form, left + column + 0.5, top + row + 0.5) > 1


@compiled
def _variance(raw_e: float, floor_e2: float, prnu: float) -> float:
    """Variance of a pixel with raw electrons, electrons squared."""
    lit_e = raw_e if raw_e > 0 else 0.0
    uneven_e = prnu * lit_e
    # Shot noise: a raw pixel's variance is its electrons.
    return lit_e + floor_e2 + uneven_e * uneven_e


@compiled
def above_background(
    image_e: Image,
    raw_e: Image,
    left: int,
    top: int,
    support: Mask,
    ring: Mask,
    plane: Plane,
    floor_e2: float,
    prnu: float,
    rounding_e2: float,
) -> tuple[Floats, Floats, float, Floats]:
    """Electrons above the background, and a pixel's variance, (rows, columns); what noise of the background stays below
    as far as the device knows of it; and how far pixels of the ring are from the background, (n,).

    The background is the mean of the ring without pixels of another surface or light, times the illumination; of all of
    it where its median is between two surfaces.
    """
    height, width = support.shape
    ring_e, of_raw_e, of_ring_e2 = np.empty(ring.size), np.empty(ring.size), np.empty(ring.size)
    columns, count = np.empty(width + 1, dtype=np.int64), 0
    for row in range(height):
        line, found = ring[row], 0
        for column in range(width):
            columns[found] = column
            found += line[column]
        image, raw = image_e[top + row, left : left + width], raw_e[top + row, left : left + width]
        for column in columns[:found]:
            light = _illumination(plane, left + column + 0.5, top + row + 0.5)
            ring_e[count], of_raw_e[count] = image[column] / light, raw[column] / light
            of_ring_e2[count] = _variance(raw[column], floor_e2, prnu)
            count += 1
    ring_e, of_raw_e, of_ring_e2 = ring_e[:count], of_raw_e[:count], of_ring_e2[:count]
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
    above_e, variance_e2 = np.empty((height, width)), np.empty((height, width))
    for row in range(height):
        image, raw = image_e[top + row, left : left + width], raw_e[top + row, left : left + width]
        for column in range(width):
            above = image[column] - background_e * _illumination(plane, left + column + 0.5, top + row + 0.5)
            variance = _variance(raw[column], floor_e2, prnu)
            of_ring = variance + excess_e2 if variance > -excess_e2 else 0.0
            above_e[row, column] = above
            variance_e2[row, column] = of_ring if support[row, column] & (above <= gate_e) else variance
    return above_e, variance_e2, gate_e, off_e


@compiled
def _mean_where(values: Floats, off_e: Floats, limit_e: float) -> float:
    """Mean of the numbers whose pixels are off the background by at most a limit."""
    total, count = 0.0, 0
    for k in range(len(values)):
        if off_e[k] <= limit_e:
            total += values[k]
            count += 1
    return total / count


@compiled
def _excess_variance(ring_e: Floats, off_e: Floats, limit_e: float, model_e2: float, rounding_e2: float) -> float:
    """Variance of a pixel without light of an LED, by the ring's pixels off the background by at most a limit, less
    that by the model, electrons squared.

    It is negative where the ADC's steps exceed the noise: neighbouring pixels are then rounded alike, while the model's
    rounding errors are independent. It is positive where the background has a structure.
    """
    mean_e, total_e2, count = _mean_where(ring_e, off_e, limit_e), 0.0, 0
    for k in range(len(ring_e)):
        if off_e[k] <= limit_e:
            total_e2 += (ring_e[k] - mean_e) * (ring_e[k] - mean_e)
            count += 1
    excess_e2 = total_e2 / (count - 1) - model_e2
    # The variance of n normal numbers has a relative standard deviation of sqrt(2 / n).
    structured = excess_e2 > STRUCTURE_SIGMA * math.sqrt(2 / count) * model_e2
    return excess_e2 if structured or rounding_e2 > MAX_ROUNDING_SHARE * model_e2 else 0.0


@compiled
def light_sums(
    above_e: Floats, support: Mask, variance_e2: Floats, left: int, top: int
) -> tuple[float, float, float, float, float, float, float, float, float, float, float, float]:
    """Flux and centroid (u, v) of the light in a support (rows, columns), its sums times du^2, du dv and dv^2 about the
    centroid, and the sums of the variances there times 1, du^2, du dv, dv^2, du^4 and dv^4.
    """
    height, width = above_e.shape
    sums = np.zeros((2, width))
    for row in range(height):
        for column in range(width):
            light = above_e[row, column] if support[row, column] else 0.0
            sums[0, column] += light
            sums[1, column] += light * (row + 0.5)
    flux, u, v = 0.0, 0.0, 0.0
    for column in range(width):
        flux += sums[0, column]
        u += sums[0, column] * (column + 0.5)
        v += sums[1, column]
    u, v = u / flux, v / flux
    of_light, of_noise = np.zeros((3, width)), np.zeros((4, width))
    for row in range(height):
        dv = row + 0.5 - v
        dv2 = dv * dv
        for column in range(width):
            light = above_e[row, column] if support[row, column] else 0.0
            noise = variance_e2[row, column] if support[row, column] else 0.0
            of_light[0, column] += light
            of_light[1, column] += light * dv
            of_light[2, column] += light * dv2
            of_noise[0, column] += noise
            of_noise[1, column] += noise * dv
            of_noise[2, column] += noise * dv2
            of_noise[3, column] += noise * dv2 * dv2
    uu, uv, vv = 0.0, 0.0, 0.0
    noise, noise_uu, noise_uv, noise_vv, noise_uuuu, noise_vvvv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for column in range(width):
        du = column + 0.5 - u
        du2 = du * du
        uu += of_light[0, column] * du2
        uv += of_light[1, column] * du
        vv += of_light[2, column]
        noise += of_noise[0, column]
        noise_uu += of_noise[0, column] * du2
        noise_uv += of_noise[1, column] * du
        noise_vv += of_noise[2, column]
        noise_uuuu += of_noise[0, column] * du2 * du2
        noise_vvvv += of_noise[3, column]
    of_light_itself = flux, left + u, top + v, uu, uv, vv
    return *of_light_itself, noise, noise_uu, noise_uv, noise_vv, noise_uuuu, noise_vvvv


@compiled
def brightest(
    image_e: Image, clipped: Mask, left: int, top: int, width: int, height: int, form: Form
) -> tuple[int, int, bool]:
    """Row and column of the brightest pixel of a rectangle inside an ellipse, row by row the first of equal ones, and
    whether a pixel inside is `clipped`.
    """
    inside = inside_ellipse(form, left, top, width, height)
    peaks_e, rows = np.full(width, -np.inf, dtype=np.float32), np.zeros(width, dtype=np.int32)
    saturated = False
    for row in range(height):
        line_e, line_clipped = image_e[top + row, left : left + width], clipped[top + row, left : left + width]
        for column in range(width):
            higher = inside[row, column] & (line_e[column] > peaks_e[column])
            peaks_e[column] = line_e[column] if higher else peaks_e[column]
            rows[column] = row if higher else rows[column]
            saturated |= inside[row, column] & line_clipped[column]
    best = 0
    for column in range(1, width):
        earlier = rows[column] < rows[best] and peaks_e[column] == peaks_e[best]
        best = column if peaks_e[column] > peaks_e[best] or earlier else best
    return top + int(rows[best]), left + best, saturated
