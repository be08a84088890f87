"""Places of pixels on the sensor, for Dr.Jit kernels that draw random numbers by them (`core.philox`)."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vlcrender.camera.roi import Roi, pixel_numbers
from vlcrender.core.backend import dr, mi


def pixel_indices(rois: Sequence[Roi]) -> tuple[Any, Any]:
    """Column and row in the frame of each pixel of all regions, region by region, row by row, UInt32.

    Regions may extend beyond the sensor: numbers are taken modulo 2^32.
    """
    column, row = pixel_places(rois)(dr.arange(mi.UInt32, sum(roi.pixels for roi in rois)))
    return column, row


def pixel_places(rois: Sequence[Roi]) -> Callable[[Any], tuple[Any, Any]]:
    """`pixel_indices` of some pixels, as a function of their numbers in its order, UInt32."""
    if len(rois) > 1:  # as data: regions of any number and size are then one launch of the same kernel
        columns, rows = (mi.UInt32(numbers.view(np.uint32)) for numbers in pixel_numbers(rois))
        return lambda number: (dr.gather(mi.UInt32, columns, number), dr.gather(mi.UInt32, rows, number))
    (roi,) = rois
    width, first_row, first_column = (dr.opaque(mi.UInt32, n % 2**32) for n in (roi.columns, roi.row, roi.column))
    rows_a_pixel = dr.opaque(mi.Float64, 1 / roi.columns)

    def places(number: Any) -> tuple[Any, Any]:
        # Exact: a pixel's centre is 1 / (2 columns) of a row or more from the next row, and float64 rounds by 2^-52 of
        # the row's number. Vectors have no division of integers.
        down = mi.UInt32((mi.Float64(number) + 0.5) * rows_a_pixel)
        return first_column + (number - down * width), first_row + down

    return places
