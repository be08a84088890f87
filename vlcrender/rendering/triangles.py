"""Least squares over many pixels: their numbers, reduced to a triangle that has the same products.

Of pixels in rows and unknowns in columns, R of the QR decomposition holds all that least squares ask for, without the
products, which lose the digits of what is hardly determined. Triangles of tiles are reduced together to that of all.
"""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from vlcrender.camera.roi import Roi

Array = NDArray[np.float64]
ColumnsOf = Callable[[Roi], tuple[Array, list[int]]]
"""Of some pixels, the numbers that are not zero, by unknown first, and the numbers of these unknowns."""

PIXELS_AT_ONCE = 100_000
"""Pixels above which tiles are reduced: bounds the memory for LEDs as large as the image."""
TILE_PX = 150
"""Rows and columns of a tile: the fewer, the fewer of many large images a tile has a part of."""
TRIANGLES_AT_ONCE = 32
"""Triangles of tiles that are reduced together."""


def triangle_of(rows: Array) -> Array:
    """R of the rows' QR decomposition: R' R = rows' rows, without forming the product."""
    triangle: Array = np.asarray(np.linalg.qr(rows, mode="r"))
    return triangle


def all_columns(roi: Roi, width: int, columns_of: ColumnsOf) -> Array:
    """The numbers of all unknowns in a region's pixels, (width, pixels)."""
    columns, which = columns_of(roi)
    if which == list(range(width)):
        return columns
    whole = np.zeros((width, columns.shape[1]))
    whole[which] = columns
    return whole


def triangle_of_tiles(roi: Roi, width: int, columns_of: ColumnsOf) -> Array:
    """The triangle of `all_columns`, (width, at most width), from tiles: of each only the unknowns that it shows."""
    factor, triangles = np.zeros((0, width)), []
    with threadpool_limits(limits=1, user_api="blas"):  # a second thread spends as much time, and spares none
        for tile in _tiles(roi):
            columns, which = columns_of(tile)
            triangle = triangle_of(columns.T)
            wide = np.zeros((len(triangle), width))
            wide[:, which] = triangle
            triangles.append(wide)
            if len(triangles) == TRIANGLES_AT_ONCE:
                factor, triangles = triangle_of(np.concatenate([factor, *triangles])), []
        return triangle_of(np.concatenate([factor, *triangles])).T


def _tiles(roi: Roi) -> Iterator[Roi]:
    for row in range(roi.row, roi.end_row, TILE_PX):
        for column in range(roi.column, roi.end_column, TILE_PX):
            yield roi.intersection(Roi(row, column, TILE_PX, TILE_PX))


def marginal(pose_part: Array, nuisance_part: Array) -> Array:
    """Information about the pose with unknown nuisance parameters: the Schur complement, (n, n).

    pose_part: (n, pixels), nuisance_part: (m, pixels), derivatives of the image over each pixel's standard deviation.
    """
    moving = np.flatnonzero(pose_part.any(axis=0))
    if 2 * len(moving) < pose_part.shape[1]:
        # of pixels that show the nuisances alone, as few numbers as have the same products
        at_rest = nuisance_part.copy()
        at_rest[:, moving] = 0.0
        few = triangle_of(at_rest.T).T
        nuisance_part = np.concatenate([nuisance_part.take(moving, axis=1), few], axis=1)
        pose_part = np.concatenate([pose_part.take(moving, axis=1), np.zeros((len(pose_part), few.shape[1]))], axis=1)
    # The part of each slope that is orthogonal to all nuisances.
    basis, lengths, _ = np.linalg.svd(nuisance_part.T, full_matrices=False)
    basis = basis[:, lengths > 1e-9 * lengths.max()]
    orthogonal = pose_part - (pose_part @ basis) @ basis.T
    product: Array = orthogonal @ orthogonal.T
    return product
