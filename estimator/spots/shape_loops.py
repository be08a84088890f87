"""Loops over the shapes of spots: masks and pieces of them, spans of rows, ellipses, and what is around either.

Masks are (rows, columns). `left` and `top` are the first column and row of a rectangle in its region, u and v are
continuous pixels of the region with pixel centres at +0.5. An ellipse is (u, v, uu, uv, vv): a pixel at the offset
(du, dv) from (u, v) is inside where uu du^2 + 2 uv du dv + vv dv^2 is at most 1.

A piece (10,) is pixels of a mask: the sums of 1, u, v, u^2, u v and v^2 over them, u the column and v the row, and the
box around them: first column and row, last column and row.

Spans (2, rows) are pixels of a rectangle, in each row from a first column to before a last one: none where the last one
is not behind the first.
"""

import math

import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Long = NDArray[np.int64]
Mask = NDArray[np.bool_]
Form = tuple[float, float, float, float, float]

# A chord by its equation is longer by this on each side before its ends are tested: rounding changes it by far less.
SPARE_PX = 1e-3


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
def pieces_of(mask: Mask) -> tuple[Long, Ints]:
    """Pieces (k, 10) of a mask, in the order of their first pixels, and its runs (n, 4).

    Pixels of a piece are connected, also by a corner. A run is a row, the first column, the one behind the last, and
    the number of its piece. OpenCV's labels alone take twice as long for a thin LED image of 60 pixels.
    """
    runs = _runs_of(mask)
    # Of each run one before it that it is connected to, or itself (Rosenfeld and Pfaltz 1966, with runs for pixels).
    root, above, row_begins = np.arange(len(runs)), 0, 0
    for k in range(len(runs)):
        if k > 0 and runs[k, 0] > runs[k - 1, 0]:
            above, row_begins = row_begins if runs[k, 0] == runs[k - 1, 0] + 1 else k, k
        while above < row_begins and runs[above, 2] < runs[k, 1]:
            above += 1
        other = above
        while other < row_begins and runs[other, 1] <= runs[k, 2]:
            a, b = _first(root, other), _first(root, k)
            root[max(a, b)] = min(a, b)
            other += 1
    count = 0
    for k in range(len(runs)):
        first = _first(root, k)
        if first == k:
            runs[k, 3] = count
            count += 1
        runs[k, 3] = runs[first, 3]
    pieces = np.zeros((count, 10), dtype=np.int64)
    pieces[:, 6], pieces[:, 7], pieces[:, 8:] = mask.shape[1], mask.shape[0], -1
    for k in range(len(runs)):
        _add_run(pieces[runs[k, 3]], runs[k, 0], runs[k, 1], runs[k, 2])
    return pieces, runs


@compiled
def _runs_of(mask: Mask) -> Ints:
    """Runs (n, 4) of the pixels of a mask, row by row; the last value is left open."""
    height, width = mask.shape
    runs, count = np.empty((height * (width // 2 + 1), 4), dtype=np.int32), 0
    for row in range(height):
        line, column = mask[row], 0
        while column < width:
            first = column
            while column < width and line[column]:
                column += 1
            runs[count, 0], runs[count, 1], runs[count, 2] = row, first, column
            count += first < column
            while column < width and not line[column]:
                column += 1
    return runs[:count]


@compiled
def _first(root: Long, run: int) -> int:
    """First of the runs connected to a run, as far as known; the way there becomes shorter."""
    while root[run] != run:
        root[run] = root[root[run]]
        run = root[run]
    return run


@compiled
def pixels_of(runs: Ints, number: int, height: int, width: int) -> Mask:
    """Mask (height, width) of the runs of a piece, by its number."""
    mask = np.zeros((height, width), dtype=np.bool_)
    for k in range(len(runs)):
        if runs[k, 3] == number:
            mask[runs[k, 0], runs[k, 1] : runs[k, 2]] = True
    return mask


@compiled
def _add_run(piece: Long, row: int, first: int, last: int) -> None:
    """Add the pixels of a row from a first column to before a last one to a piece."""
    size = last - first
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
    return _padded(mask, _spans_of(mask)[0], radius_px, larger_px)


@compiled
def _padded(mask: Mask, spans: Ints, radius_px: float, larger_px: float) -> tuple[Mask, Mask]:
    """See `padded`; `spans` contain all pixels of the mask."""
    height, width = mask.shape
    near, nearby = np.zeros((height, width), dtype=np.bool_), np.zeros((height, width), dtype=np.bool_)
    halves, larger_halves = _half_chords(radius_px), _half_chords(larger_px)
    for row in range(height):
        line, column, last = mask[row], spans[0, row], spans[1, row]
        while column < last:
            first = column
            while column < last and line[column]:
                column += 1
            _widen(near, row, first, column, halves)
            _widen(nearby, row, first, column, larger_halves)
            while column < last and not line[column]:
                column += 1
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
        left, own, right = line[:width], line[step:], line[2 * step :]
        for column in range(width):
            found[column] |= left[column] & own[column] & right[column] & up[column] & down[column]
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
def around_face(face: Mask, margin_px: float, ring_px: float, border_px: float) -> tuple[Mask, Ints, Mask]:
    """The face of an LED image padded by a margin, (rows, columns); rows and columns (n, 2) of the ring of pixels up to
    `ring_px` beyond; and the pixels more than `border_px` inside the face, (rows, columns).
    """
    height, width = face.shape
    spans, solid = _spans_of(face)
    if not solid:
        support, outer = _padded(face, spans, margin_px, margin_px + ring_px)
        thick = _is_thick(face, border_px)
        inside = ~padded(~face, border_px, 0.0)[0] if thick else np.zeros((height, width), dtype=np.bool_)
        return support, _beside(support, outer), inside
    inner, outer_spans = _padded_spans(spans, width, margin_px), _padded_spans(spans, width, margin_px + ring_px)
    # What is not in the face are a span before it and one behind it in each row.
    before, behind = np.zeros((2, height), dtype=np.int32), np.full((2, height), width, dtype=np.int32)
    before[1], behind[0] = spans[0], spans[1]
    within = np.empty((2, height), dtype=np.int32)
    within[0] = _padded_spans(before, width, border_px)[1]
    within[1] = _padded_spans(behind, width, border_px)[0]
    return _within(inner, width), _between(inner, outer_spans), _within(within, width)


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
