"""Places of pixels on the sensor, for Dr.Jit kernels that draw random numbers by them (`core.philox`)."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vlcrender.camera.roi import Roi, pixel_numbers
from vlcrender.core.backend import dr, mi


def pixel_indices(rois: Sequence[Roi]) -> tuple[Any, Any]:
    """Column and row in the frame of each pixel of all regions, region by region, row by row, UInt32.

    Regions may extend beyond the sensor: numbers are taken modulo 2^32.
    """
    if len(rois) > 1:  # as data: regions of any number and size are then one launch of the same kernel
        column, row = (mi.UInt32(numbers.view(np.uint32)) for numbers in pixel_numbers(rois))
        return column, row
    (roi,) = rois
    columns, first_row, first_column = (
        dr.opaque(mi.UInt32, number % 2**32) for number in (roi.columns, roi.row, roi.column)
    )
    index = dr.arange(mi.UInt32, roi.pixels)
    down = index // columns
    return first_column + (index - down * columns), first_row + down
