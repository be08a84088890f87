"""Sorting of the pixels of regions by an LED's share of their light, and readings of them: one by one, or in blocks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compiled, compiled_sums
from estimator.pixels.polygon_raster import RoiStack

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

# An image may move by nearly this much before its pixels have to be sorted into edge, inside and background again.
EDGE_PX = 2
# Pixels up to NEAR_PX beyond those that an LED lights tell the background of its edge. Those further off may show
# another surface: the panel that LEDs are mounted on ends, and the ceiling or the panel's side begins.
NEAR_PX = 1
# Blocks of the uniform pixels of a face along each axis, each summed for a reading: the light changes little over one.
BLOCKS = 6
# A pixel whose share of an LED's light is within this of 0 or 1 is uniform.
UNIFORM_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class SortedPixels:
    """Cells of regions by an LED's `share` (cells,) of their light, NaN where the lens lets none in.

    Masks (cells,): `edge` may be partly lit by the LED while its image moves by EDGE_PX, `lit` may be lit at all,
    `near` are at most NEAR_PX beyond the pixels that it lights. The cells beyond the regions' ends are in none.
    """

    share: Floats
    edge: Mask
    lit: Mask
    near: Mask


def sorted_pixels(rois: RoiStack, light: Floats, fall_off: Floats) -> SortedPixels:
    """Sort the cells by the LED's light in them, (cells,), of which a pixel inside has as much as the `fall_off`."""
    with np.errstate(all="ignore"):
        share = light / fall_off
    lit = share > UNIFORM_TOLERANCE
    partly_lit = lit & (share < 1 - UNIFORM_TOLERANCE)
    near = _widened(rois, lit, NEAR_PX)
    may_be_lit = _widened(rois, near, EDGE_PX - NEAR_PX)
    return SortedPixels(share, _widened(rois, partly_lit, EDGE_PX), may_be_lit, near)


def _widened(rois: RoiStack, mask: Mask, by_px: int) -> Mask:
    """Cells (cells,) of each region that are at most `by_px` from one of a mask, along rows and along columns."""
    for _ in range(by_px):
        mask = _with_neighbours(mask.view(np.uint8), rois.heights, rois.widths, rois.starts).view(np.bool_)
    return mask


@compiled
def _with_neighbours(mask: NDArray[np.uint8], heights: Ints, widths: Ints, starts: Ints) -> NDArray[np.uint8]:
    """Cells (cells,) that are 1 in a mask, and their up to eight neighbours in the same region.

    The cells beyond the regions' ends, set to 0, part a row from the next.
    """
    mask = mask.copy()
    _clear_ends(mask, heights, widths, starts)
    along = mask.copy()
    before, own, after = mask[:-2], along[1:-1], mask[2:]
    for i in range(len(own)):
        own[i] |= before[i] | after[i]
    wide = along.copy()
    for k in range(len(heights)):
        region, stride = slice(starts[k], starts[k + 1]), widths[k] + 1
        above, below = along[region][:-stride], along[region][stride:]
        upper, lower = wide[region][:-stride], wide[region][stride:]
        for i in range(len(above)):
            lower[i] |= above[i]
        for i in range(len(above)):
            upper[i] |= below[i]
    _clear_ends(wide, heights, widths, starts)
    return wide


@compiled
def _clear_ends(mask: NDArray[np.uint8], heights: Ints, widths: Ints, starts: Ints) -> None:
    """Set the cells beyond the regions' ends to 0."""
    for k in range(len(heights)):
        for row in range(heights[k]):
            mask[starts[k] + row * (widths[k] + 1) + widths[k]] = 0


@compiled
def known_shares(share: Floats, known: Mask, heights: Ints, widths: Ints, starts: Ints) -> Floats:
    """Share of the pixels wholly inside the LED image of each of n regions that are known, (n,); 1 without such."""
    shares = np.ones(len(heights))
    for k in range(len(heights)):
        inside, both = 0, 0
        for row in range(heights[k]):
            first = starts[k] + row * (widths[k] + 1)
            line, known_line = share[first : first + widths[k]], known[first : first + widths[k]]
            for i in range(len(line)):
                is_inside = line[i] > 1 - UNIFORM_TOLERANCE
                inside += is_inside
                both += is_inside & known_line[i]
        if inside > 0:
            shares[k] = both / inside
    return shares


@dataclass(frozen=True, eq=False)
class Faces:
    """Places of pixels on the faces of n LEDs: their offsets from the `centre` (n, 2) of an LED image, pixels, times
    `to_face` (n, 2, 2) are coordinates in half widths. `fall_off` (cells,) is the lens's.
    """

    centre: Floats
    to_face: Floats
    fall_off: Floats


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings in regions around LEDs, m in all: edge pixels, and sums over blocks of the uniform pixels inside.

    A group of readings has a common amplitude and background: an LED, or an LED's pixels of one colour; there are g.
    The readings of a group follow each other, from `starts[k]` to `starts[k + 1]`, (g + 1,); each group has an edge
    pixel. `led` (g,) is the region of each group. `edges` (e,) are the readings that are edge pixels, `cells` (e,)
    their cells in the regions. `pixel_counts` (m,) is the number of pixels of a reading, `electrons` (m,) their sum.

    With the coordinates (a, b) of a pixel on the face, in half widths from its centre: `background` (m, 4) is the
    lens's fall-off times 1, a, b and a^2 + b^2; `face` (m, 3) is the mean of a, b and a^2 + b^2 - 1/2 over a reading.
    `uniform_light` (m,) is the light inside the LED image summed over the pixels of a reading, 0 for edge pixels, whose
    light depends on the pose. `lines` (m,) are those of the readings of an LED that sends, else 0.
    """

    led: Ints
    starts: Ints
    edges: Ints
    cells: Ints
    pixel_counts: Floats
    electrons: Floats
    background: Floats
    face: Floats
    uniform_light: Floats
    lines: Ints


def read(
    rois: RoiStack, faces: Faces, electrons: NDArray[np.float32], edge: Mask, inside: Mask, lines: Ints, sites: int
) -> Readings:
    """Readings of the pixels of the `edge` (cells,) and of blocks of those `inside` (cells,).

    A group is a region's pixels of one of the `sites` of a mosaic, 4 or 1; without a pixel of the edge there is none.
    `electrons` (cells,) and `lines` (cells,), -1 where the LED does not send, are those of the pixels; `lines` is (0,)
    where none sends.
    """
    most = int(np.count_nonzero(edge)) + int(np.count_nonzero(inside))
    groups = len(rois.rows) * sites
    made = Readings(
        led=np.empty(groups, dtype=np.int64),
        starts=np.zeros(groups + 1, dtype=np.int64),
        edges=np.empty(most, dtype=np.int64),
        cells=np.empty(most, dtype=np.int64),
        pixel_counts=np.empty(most),
        electrons=np.empty(most),
        background=np.empty((4, most)),  # one coefficient after another in memory
        face=np.empty((most, 3)),
        uniform_light=np.empty(most),
        lines=np.zeros(most, dtype=np.int64),
    )
    regions = rois.rows, rois.columns, rois.heights, rois.widths, rois.starts
    of_cells = electrons, edge, inside, lines, faces.fall_off
    groups, singles = _read(*regions, *of_cells, faces.centre, faces.to_face, sites, *vars(made).values())
    total = int(made.starts[groups])
    return Readings(
        led=made.led[:groups],
        starts=made.starts[: groups + 1],
        edges=made.edges[:singles],
        cells=made.cells[:singles],
        pixel_counts=made.pixel_counts[:total],
        electrons=made.electrons[:total],
        background=made.background[:, :total].copy().T,
        face=made.face[:total],
        uniform_light=made.uniform_light[:total],
        lines=made.lines[:total],
    )


@compiled
def _block(a: float, b: float) -> int:
    """Number of the block of a face that a place on it is in, or nearest to."""
    row = min(max(int((a + 1) * (BLOCKS / 2)), 0), BLOCKS - 1)
    return row * BLOCKS + min(max(int((b + 1) * (BLOCKS / 2)), 0), BLOCKS - 1)


@compiled_sums
def _add_run(
    sums: Floats, electrons: NDArray[np.float32], fall_off: Floats, a: float, b: float, to_a: float, to_b: float
) -> None:
    """Add n pixels of a line, of `electrons` (n,) and `fall_off` (n,), to the sums (6,) of a block.

    The first is at (a, b) on the face, each further one at (to_a, to_b) from the one before.
    """
    total, light_1, light_a, light_b, light_r2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(electrons)):
        at_a, at_b = a + i * to_a, b + i * to_b
        total += np.float64(electrons[i])
        light_1 += fall_off[i]
        light_a += fall_off[i] * at_a
        light_b += fall_off[i] * at_b
        light_r2 += fall_off[i] * (at_a * at_a + at_b * at_b)
    sums[0] += len(electrons)
    sums[1] += total
    sums[2] += light_1
    sums[3] += light_a
    sums[4] += light_b
    sums[5] += light_r2


@compiled
def _read(
    rows: Ints,
    columns: Ints,
    heights: Ints,
    widths: Ints,
    starts: Ints,
    cell_electrons: NDArray[np.float32],
    edge: Mask,
    inside: Mask,
    cell_lines: Ints,
    fall_off: Floats,
    centre: Floats,
    to_face: Floats,
    sites: int,
    led: Ints,
    group_starts: Ints,
    edges: Ints,
    cells: Ints,
    pixel_counts: Floats,
    electrons: Floats,
    background: Floats,
    face: Floats,
    uniform_light: Floats,
    lines: Ints,
) -> tuple[int, int]:
    """Number of groups, and of single pixels; fills the arrays of `Readings`."""
    groups, singles, reading = 0, 0, 0
    for k in range(len(rows)):
        height, width, stride = heights[k], widths[k], widths[k] + 1
        first_line, last_line, line = -1, -1, -1
        for cell in range(starts[k], starts[k + 1] if len(cell_lines) > 0 else starts[k]):
            line = cell_lines[cell]
            if inside[cell] and line >= 0:
                first_line = line if first_line < 0 else min(first_line, line)
                last_line = max(last_line, line)
        (to_a, across_a), (to_b, across_b) = to_face[k]
        for site in range(sites):
            before = singles
            sums = np.zeros((BLOCKS * BLOCKS * (last_line - first_line + 1), 6))
            # Of a mosaic each second row and column.
            step = 1 if sites == 1 else 2
            first_row = 0 if sites == 1 else (site // 2 - rows[k]) % 2
            first_column = 0 if sites == 1 else (site % 2 - columns[k]) % 2
            for row in range(first_row, height, step):
                start = starts[k] + row * stride
                du, dv = columns[k] + 0.5 - centre[k, 0], row + rows[k] + 0.5 - centre[k, 1]
                row_a, row_b = to_a * du + across_a * dv, to_b * du + across_b * dv
                column = first_column
                while column < width:
                    cell, a, b = start + column, row_a + to_a * column, row_b + to_b * column
                    if len(cell_lines) > 0:
                        line = cell_lines[cell]
                    if edge[cell]:
                        r2, light = a * a + b * b, fall_off[cell]
                        edges[singles], cells[singles] = reading, cell
                        pixel_counts[reading], electrons[reading] = 1.0, cell_electrons[cell]
                        background[0, reading], background[1, reading] = light, light * a
                        background[2, reading], background[3, reading] = light * b, light * r2
                        face[reading, 0], face[reading, 1], face[reading, 2] = a, b, r2 - 0.5
                        uniform_light[reading] = 0.0
                        lines[reading] = max(line, 0)
                        singles += 1
                        reading += 1
                    end = column + step
                    if inside[cell]:
                        block = _block(a, b)
                        while (
                            end < width
                            and inside[start + end]
                            and _block(row_a + to_a * end, row_b + to_b * end) == block
                            and (line < 0 or cell_lines[start + end] == line)
                        ):
                            end += step
                        run = slice(cell, start + end, step)
                        of_line = BLOCKS * BLOCKS * (line - first_line) if line >= 0 else 0
                        _add_run(
                            sums[block + of_line], cell_electrons[run], fall_off[run], a, b, step * to_a, step * to_b
                        )
                    column = end
            if singles == before:
                continue
            for block in range(len(sums)):
                if sums[block, 0] == 0:
                    continue
                pixel_counts[reading], electrons[reading] = sums[block, 0], sums[block, 1]
                for basis in range(4):
                    background[basis, reading] = sums[block, 2 + basis]
                for basis in range(3):
                    face[reading, basis] = sums[block, 3 + basis] / sums[block, 2]
                face[reading, 2] -= 0.5
                uniform_light[reading] = sums[block, 2]
                lines[reading] = first_line + block // (BLOCKS * BLOCKS) if first_line >= 0 else 0
                reading += 1
            led[groups] = k
            groups += 1
            group_starts[groups] = reading
    return groups, singles
