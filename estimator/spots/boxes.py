"""Upright boxes of pixels: those around decoded pixels, and which of several overlap."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compact, compiled
from estimator.spots.led_light import Pixels, Readout

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


class Box(NamedTuple):
    """Pixels of a region, by its number: columns from `left` to before `right`, rows from `top` to before `bottom`."""

    region: int
    left: int
    top: int
    right: int
    bottom: int


def boxes_near(readouts: Sequence[Readout], decoded_px: Pixels | None, near_px: float) -> list[Box]:
    """Boxes of pixels of regions within `near_px` of pixels (n, 2) of the sensor; none without such."""
    if decoded_px is None:
        return []
    regions = [(readout.column, readout.row, *readout.image_e.shape[::-1]) for readout in readouts]
    return [Box(*values) for values in boxes_around(compact(decoded_px), compact(regions), near_px).tolist()]


@compiled
def boxes_around(points: Floats, regions: Floats, near: float) -> Ints:
    """Boxes (k, 5) of the pixels of regions (n, 4) within `near` of points (m, 2) in u and in v, point by point.

    A region is its first column and row on the sensor, its width and its height. A box is its region's number, and in
    the region its first column and row and those behind its last.
    """
    boxes, count = np.empty((len(points) * len(regions), 5), dtype=np.int32), 0
    for point in range(len(points)):
        for region in range(len(regions)):
            u, v = points[point, 0] - regions[region, 0], points[point, 1] - regions[region, 1]
            width, height = regions[region, 2], regions[region, 3]
            left, right = int(min(max(u - near, 0.0), width)), int(min(max(u + near, 0.0), width))
            top, bottom = int(min(max(v - near, 0.0), height)), int(min(max(v + near, 0.0), height))
            if left < right and top < bottom:
                boxes[count, 0], boxes[count, 1], boxes[count, 2] = region, left, top
                boxes[count, 3], boxes[count, 4] = right, bottom
                count += 1
    return boxes[:count]


@compiled
def overlapping(boxes: Floats) -> Ints:
    """Pairs (k, 2) of the numbers of upright boxes (n, 4) that overlap, in both orders.

    A box is its centre and its half extent, (u, v, along u, along v).
    """
    count = len(boxes)
    pairs, found = np.empty((count * count + 1, 2), dtype=np.int32), 0
    for one in range(count):
        for other in range(count):
            u, v = abs(boxes[one, 0] - boxes[other, 0]), abs(boxes[one, 1] - boxes[other, 1])
            across_u, across_v = boxes[one, 2] + boxes[other, 2], boxes[one, 3] + boxes[other, 3]
            pairs[found, 0], pairs[found, 1] = one, other
            found += one != other and u < across_u and v < across_v
    return pairs[:found]
