"""Loops over the pixels of spots: blobs above half level, light and its background, moments and their noise.

Images are (rows, columns) of electrons. `left` and `top` are the first column and row of a rectangle in its region, u
and v are continuous pixels of the region with pixel centres at +0.5. An ellipse is (u, v, uu, uv, vv): a pixel at the
offset (du, dv) from (u, v) is inside where uu du^2 + 2 uv du dv + vv dv^2 is at most 1. A plane of illumination is
(u, v, slope along u, slope along v): 1 at (u, v), with these slopes per pixel. A background is its level at the middle
of the illumination, what its noise stays below as far as the device knows of it, and by how much its variance exceeds
the known one. Noise is a pixel's signal-independent variance, the photo response nonuniformity, and the part of the
variance that is rounding. All in electrons or their squares.

A piece (10,) is pixels of a mask: the sums of 1, u, v, u^2, u v and v^2 over them, u the column and v the row, and the
box around them: first column and row, last column and row.

Spans (2, rows) are pixels of a rectangle, in each row from a first column to before a last one: none where the last one
is not behind the first. Loops go over slices of rows: the processor's vectors then take several pixels at once.
"""

import math

import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compiled, compiled_sums

Image = NDArray[np.float32]
Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Long = NDArray[np.int64]
Mask = NDArray[np.bool_]
Form = tuple[float, float, float, float, float]
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
# A chord by its equation is longer by this on each side before its ends are tested: rounding changes it by far less.
SPARE_PX = 1e-3
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
def above_half_level(smooth: Image, left: int, top: int, blob: Mask, background_e: float) -> tuple[Mask, Long, bool]:
    """Pixels of a blob (rows, columns) at least half as far above the background as its upper quartile, whether they
    are one piece, as far as `_spans_of` tells, and if so that piece.

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
    spans, solid = _spans_of(core)
    (piece,) = _no_pieces(1, height, width)
    if solid:
        for row in range(height):
            _add_run(piece, row, spans[0, row], spans[1, row])
    return core, piece, solid


@compiled
def _spans_of(mask: Mask) -> tuple[Ints, bool]:
    """Spans from the first to the last pixel of each row of a mask, and whether they are all of it and adjoin each
    other: it is one piece then.
    """
    height, width = mask.shape
    spans, solid, begun, ended = np.empty((2, height), dtype=np.int32), True, False, False
    for row in range(height):
        line, first, last, count = mask[row], 0, width, 0
        while first < width and not line[first]:
            first += 1
        while last > first and not line[last - 1]:
            last -= 1
        for column in range(first, last):
            count += line[column]
        if first < last:
            solid &= count == last - first and not ended
            solid &= not begun or (first <= spans[1, row - 1] and last >= spans[0, row - 1])
        ended |= begun and first == last
        begun |= first < last
        spans[0, row], spans[1, row] = first, last
    return spans, solid


@compiled
def pieces_of(numbers: Ints, count: int) -> Long:
    """Pieces (count, 10) of the pixels (rows, columns) with each number below a count; none of number 0."""
    height, width = numbers.shape
    pieces = _no_pieces(count, height, width)
    for row in range(height):
        line, column = numbers[row], 0
        while column < width:
            first, number = column, line[column]
            while column < width and line[column] == number:
                column += 1
            if number > 0:
                _add_run(pieces[number], row, first, column)
    return pieces


@compiled
def _no_pieces(count: int, height: int, width: int) -> Long:
    """Pieces (count, 10) without pixels, of a mask of this size."""
    pieces = np.zeros((count, 10), dtype=np.int64)
    pieces[:, 6], pieces[:, 7], pieces[:, 8:] = width, height, -1
    return pieces


@compiled
def _add_run(piece: Long, row: int, first: int, last: int) -> None:
    """Add the pixels of a row from a first column to before a last one to a piece."""
    size = last - first
    if size <= 0:
        return
    sum_u = (first + last - 1) * size // 2
    piece[0] += size
    piece[1] += sum_u
    piece[2] += size * row
    piece[3] += ((last - 1) * last * (2 * last - 1) - (first - 1) * first * (2 * first - 1)) // 6
    piece[4] += sum_u * row
    piece[5] += size * row * row
    piece[6], piece[7] = min(piece[6], first), min(piece[7], row)
    piece[8], piece[9] = max(piece[8], last - 1), max(piece[9], row)


@compiled
def distance2(form: Form, u: float, v: float) -> float:
    """Squared distance of a point from the centre of an ellipse, at most 1 inside."""
    du, dv = u - form[0], v - form[1]
    return (form[2] * du + 2 * form[3] * dv) * du + form[4] * dv * dv


@compiled
def ellipse_spans(form: Form, left: int, top: int, width: int, height: int) -> Ints:
    """Spans of the pixels of a rectangle inside an ellipse."""
    spans = np.empty((2, height), dtype=np.int32)
    for row in range(height):
        v = top + row + 0.5
        dv = v - form[1]
        middle = form[0] - left - form[3] * dv / form[2]
        half = math.sqrt(max(form[3] * form[3] * dv * dv - form[2] * (form[4] * dv * dv - 1), 0.0)) / form[2] + SPARE_PX
        first = math.ceil(max(middle - half - 0.5, 0.0))
        last = math.floor(max(min(middle + half + 0.5, width), 0.0))
        while first < last and distance2(form, left + first + 0.5, v) > 1:
            first += 1
        while first < last and distance2(form, left + last - 0.5, v) > 1:
            last -= 1
        spans[0, row], spans[1, row] = first, last
    return spans


@compiled
def _within(spans: Ints, width: int) -> Mask:
    """Pixels of spans, (rows, width)."""
    height = spans.shape[1]
    inside = np.zeros((height, width), dtype=np.bool_)
    for row in range(height):
        inside[row, spans[0, row] : spans[1, row]] = True
    return inside


@compiled
def _between(inner: Ints, outer: Ints) -> Ints:
    """Rows and columns (n, 2) of the pixels of outer spans that are not in inner ones."""
    count, found = 0, 0
    for row in range(outer.shape[1]):
        count += max(outer[1, row] - outer[0, row], 0)
    pixels = np.empty((count, 2), dtype=np.int32)
    for row in range(outer.shape[1]):
        first, last = outer[0, row], outer[1, row]
        hole, beyond = inner[0, row], inner[1, row]
        if hole >= beyond:
            hole, beyond = last, last
        for column in range(first, hole):
            pixels[found, 0], pixels[found, 1] = row, column
            found += 1
        for column in range(beyond, last):
            pixels[found, 0], pixels[found, 1] = row, column
            found += 1
    return pixels[:found]


@compiled
def around_ellipse(own: Form, outer: Form, left: int, top: int, width: int, height: int) -> tuple[Mask, Ints]:
    """Pixels of a rectangle inside an ellipse, (height, width), and rows and columns (n, 2) of those beside it that are
    inside an outer one.
    """
    inner = ellipse_spans(own, left, top, width, height)
    return _within(inner, width), _between(inner, ellipse_spans(outer, left, top, width, height))


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
def padded(mask: Mask, radius_px: float, larger_px: float) -> tuple[Mask, Mask]:
    """Pixels at most a radius, and a larger one, from one of a mask."""
    height, width = mask.shape
    near, nearby = np.zeros((height, width), dtype=np.bool_), np.zeros((height, width), dtype=np.bool_)
    halves, larger_halves = _half_chords(radius_px), _half_chords(larger_px)
    for row in range(height):
        column = 0
        while column < width:
            first, own = column, mask[row, column]
            while column < width and mask[row, column] == own:
                column += 1
            if own:
                _widen(near, row, first, column, halves)
                _widen(nearby, row, first, column, larger_halves)
    return near, nearby


@compiled
def _is_thick(mask: Mask, radius_px: float) -> bool:
    """Whether a pixel of a mask is further than a radius from those not in it, up, down, left and right alone.

    Without one none is further from all of them: a thin ring is told in a tenth of the time.
    """
    height, width = mask.shape
    step = int(radius_px)
    wide = np.ones((height + 2 * step, width + 2 * step), dtype=np.bool_)
    wide[step : step + height, step : step + width] = mask
    found = np.zeros(width, dtype=np.bool_)
    for row in range(height):
        up, line, down = wide[row, step:], wide[row + step], wide[row + 2 * step, step:]
        left, right = line[:width], line[2 * step :]
        for column in range(width):
            own = line[column + step] & left[column] & right[column]
            found[column] |= own & up[column] & down[column]
    return bool(found.any())


@compiled
def _padded_spans(spans: Ints, width: int, radius_px: float) -> Ints:
    """Spans of the pixels at most a radius from a pixel of spans, of which those of neighbouring rows adjoin."""
    height, halves = spans.shape[1], _half_chords(radius_px)
    near = np.empty((2, height), dtype=np.int32)
    near[0], near[1] = width, 0
    for step in range(1 - len(halves), len(halves)):
        half = halves[abs(step)]
        for row in range(max(-step, 0), min(height - step, height)):
            first, last = spans[0, row + step], spans[1, row + step]
            near[0, row] = min(near[0, row], max(first - half, 0) if first < last else width)
            near[1, row] = max(near[1, row], min(last + half, width) if first < last else 0)
    return near


@compiled
def _beside(mask: Mask, larger: Mask) -> Ints:
    """Rows and columns (n, 2) of the pixels of a larger mask that are not in a mask."""
    height, width = mask.shape
    pixels, count = np.empty((height * width + 1, 2), dtype=np.int32), 0
    for row in range(height):
        for column in range(width):
            pixels[count, 0], pixels[count, 1] = row, column
            count += larger[row, column] and not mask[row, column]
    return pixels[:count]


@compiled
def around_face(
    image_e: Image, left: int, top: int, face: Mask, margin_px: float, ring_px: float, border_px: float
) -> tuple[Mask, Ints, Plane]:
    """The face of an LED image padded by a margin, (rows, columns); rows and columns (n, 2) of the ring of pixels up to
    `ring_px` beyond; and the illumination by the lens.

    The illumination is the plane of the light more than `border_px` inside the face.
    """
    height, width = face.shape
    spans, solid = _spans_of(face)
    if not solid:
        support, outer = padded(face, margin_px, margin_px + ring_px)
        plane = LEVEL
        if _is_thick(face, border_px):
            plane = _fall_off(image_e, left, top, padded(~face, border_px, 0.0)[0])
        return support, _beside(support, outer), plane
    inner, outer_spans = _padded_spans(spans, width, margin_px), _padded_spans(spans, width, margin_px + ring_px)
    # What is not in the face are a span before it and one behind it in each row.
    before, behind = np.zeros((2, height), dtype=np.int32), np.full((2, height), width, dtype=np.int32)
    before[1], behind[0] = spans[0], spans[1]
    inside = np.empty((2, height), dtype=np.int32)
    inside[0] = _padded_spans(before, width, border_px)[1]
    inside[1] = _padded_spans(behind, width, border_px)[0]
    return _within(inner, width), _between(inner, outer_spans), _fall_off(image_e, left, top, ~_within(inside, width))


@compiled_sums
def _fall_off(image_e: Image, left: int, top: int, outside: Mask) -> Plane:
    """Plane that the light inside an LED image follows, 1 at its middle.

    With the second moments S of the pixels inside, a relative gradient g of the light moves their centroid by S g.
    """
    height, width = outside.shape
    count, of_u, of_v, of_uu, of_uv, of_vv, total, light_u, light_v = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for row in range(height):
        v, line, line_e = row - 0.5 * height, outside[row], image_e[top + row, left : left + width]
        size, sum_u, sum_uu, light, moved = 0.0, 0.0, 0.0, 0.0, 0.0
        for column in range(width):
            u, inside = column - 0.5 * width, 0.0 if line[column] else 1.0
            size += inside
            sum_u += inside * u
            sum_uu += inside * u * u
            light += inside * line_e[column]
            moved += inside * line_e[column] * u
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
def share_among(support: Mask, ring: Ints, left: int, top: int, own: Form, others: Floats, bare: Floats) -> Ints:
    """Take pixels nearer to one of k other ellipses out of a support; the pixels of a ring, rows and columns (n, 2),
    that are outside of these.

    `own` and the `others` (k, 5) are padded, `bare` (k, 5) are the others without padding: the ring is what is outside
    of these if all of it is inside of the padded ones.
    """
    height, width = support.shape
    for row in range(height):
        line, v = support[row], top + row + 0.5
        for k in range(len(others)):
            form = (others[k, 0], others[k, 1], others[k, 2], others[k, 3], others[k, 4])
            for column in range(width):
                u = left + column + 0.5
                line[column] &= distance2(own, u, v) <= distance2(form, u, v)
    outside = _outside(ring, left, top, others)
    return outside if len(outside) > 0 else _outside(ring, left, top, bare)


@compiled
def _outside(pixels: Ints, left: int, top: int, ellipses: Floats) -> Ints:
    """Those of pixels, rows and columns (n, 2), outside of all ellipses (k, 5)."""
    found, count = np.empty((len(pixels) + 1, 2), dtype=np.int32), 0
    for number in range(len(pixels)):
        row, column = pixels[number, 0], pixels[number, 1]
        free = True
        for k in range(len(ellipses)):
            form = (ellipses[k, 0], ellipses[k, 1], ellipses[k, 2], ellipses[k, 3], ellipses[k, 4])
            free &= distance2(form, left + column + 0.5, top + row + 0.5) > 1
        found[count, 0], found[count, 1] = row, column
        count += free
    return found[:count]


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
    """Flux, centroid (u, v) and the sum of the variances by `light_within`, without the images, in half of the time."""
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
def brightest(
    image_e: Image, clipped: Mask, left: int, top: int, width: int, height: int, form: Form
) -> tuple[int, int, bool]:
    """Row and column of the brightest pixel of a rectangle inside an ellipse, row by row the first of equal ones, and
    whether a pixel inside is `clipped`.
    """
    spans = ellipse_spans(form, left, top, width, height)
    peaks_e, saturated = np.full(width, -np.inf, dtype=np.float32), 0
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
