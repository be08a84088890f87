"""Where an LED's edge runs within the pixels it crosses: their coverage part by part.

Only these pixels have to be split where a narrow blur needs finer ones than the camera's: all others are of one piece.
A pixel is cut into quarters, of which those that the edge crosses are cut again: the cost goes with the parts that lie
on the edge, not with all.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose, rays_world
from vlcrender.camera.roi import Roi
from vlcrender.core.planar_shapes import Disc, Rectangle, quadrilateral_area
from vlcrender.rendering.led_coverage import LedCoverage

Array = NDArray[np.float64]

WHOLE = 1e-9
"""A part is of one piece that an LED covers but for this share, or by no more than this."""
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""Of a part, in (u, v)."""
DOWN, RIGHT = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
"""Row and column of a part's quarters."""


@dataclass(frozen=True)
class LedEdges:
    """The pixels that an LED's edge crosses, (k,) rows and columns of the sensor.

    `excess` (k, n, n): coverage of each part of each pixel less the pixel's mean, or the light that makes.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    excess: Array

    def times(self, image: Array, roi: Roi) -> "LedEdges":
        """The excess times what an image (rows, columns) of the window holds in each pixel."""
        factor = image[self.rows - roi.row, self.columns - roi.column]
        return replace(self, excess=self.excess * factor[:, None, None])


def edges_of_led(
    camera: Camera, pose: Pose, center_m: Array, shape: Disc | Rectangle, image: LedCoverage, split: int
) -> LedEdges:
    """The edge pixels of an LED's image, split x split parts each; `split` is a power of 2.

    center_m: (3,), world, as `image_of_led` takes it, which made `image`.
    """
    rows, columns = np.nonzero((image.coverage > WHOLE) & (image.coverage < 1 - WHOLE))
    parts = image.coverage[rows, columns][:, None, None]
    rows, columns = rows + image.row, columns + image.column
    corner_px = np.stack([columns, rows], axis=-1)
    pixel, row, column = np.arange(len(rows)), np.zeros_like(rows), np.zeros_like(rows)
    n = 1
    while n < split:
        n *= 2
        parts = parts.repeat(2, axis=1).repeat(2, axis=2)
        pixel = pixel.repeat(4)
        row = (2 * row[:, None] + DOWN).ravel()
        column = (2 * column[:, None] + RIGHT).ravel()
        places = corner_px[pixel, None] + (np.stack([column, row], axis=-1)[:, None] + CORNERS) / n
        covered = _covered(camera, pose, center_m, shape, places)
        parts[pixel, row, column] = covered
        crossed = (covered > WHOLE) & (covered < 1 - WHOLE)
        pixel, row, column = pixel[crossed], row[crossed], column[crossed]
    return LedEdges(rows, columns, parts - parts.mean(axis=(1, 2), keepdims=True))


def _covered(camera: Camera, pose: Pose, center_m: Array, shape: Disc | Rectangle, places: Array) -> Array:
    """Share of each quadrilateral (k, 4, 2) of pixel positions that the face covers, (k,)."""
    rays = rays_world(camera, pose, places)
    reach = (center_m[2] - pose.position_m[2]) / np.maximum(rays[..., 2], 1e-9)
    quads = reach[..., None] * rays[..., :2] - (center_m[:2] - np.array(pose.position_m[:2]))
    share: Array = np.clip(shape.shared_area(quads) / quadrilateral_area(quads), 0.0, 1.0)
    return share
