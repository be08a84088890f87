"""Coverage of parts of the pixels that an LED's edge crosses, for blurs narrower than a pixel.

Only these pixels have to be split; in all others every part has the same coverage. Of a face with a luminance profile
all pixels are split, unless they are so many that the profile hardly changes within one. A pixel is cut into quarters,
and quarters that the edge crosses are cut again: the cost grows with the number of parts on the edge, not with all
parts.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.core.face_profile import FaceProfile
from vlcrender.core.planar_shapes import quadrilateral_area
from vlcrender.rendering.led_coverage import RIM_POINTS, LedCoverage, LedFace, intersections_with_plane

Array = NDArray[np.float64]

COVERAGE_TOLERANCE = 1e-9
"""Coverage within this tolerance of 0 or 1 counts as 0 or 1."""
MAX_PROFILE_PARTS = 4_000_000
"""Parts of all pixels of a face with a profile, beyond which only edge pixels are split: at 64 parts across a pixel the
face has a radius of 18 px, at 16 parts 70 px. Without the split, a pixel of a face of 20 px with a gradient of 0.3 errs
by up to 0.15 % of the luminance."""
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""Corners (u, v) of a part, in units of its side."""
QUARTER_ROWS, QUARTER_COLUMNS = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
"""Row and column of a part's quarters."""


@dataclass(frozen=True)
class LedEdges:
    """The pixels that an LED's edge crosses, and others that are split: rows and columns of the sensor, (k,).

    `excess` (k, n, n): coverage of each part of each pixel, times the face's luminance profile there, minus the pixel's
    mean; or that times the light of full coverage.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    excess: Array

    def times(self, image: Array, roi: Roi) -> "LedEdges":
        """The edges with the excess multiplied by the pixels of an image (rows, columns) of the region."""
        factor = image[self.rows - roi.row, self.columns - roi.column]
        return replace(self, excess=self.excess * factor[:, None, None])

    def within(self, roi: Roi) -> "LedEdges":
        """The edges in a region."""
        down = (self.rows >= roi.row) & (self.rows < roi.end_row)
        inside = down & (self.columns >= roi.column) & (self.columns < roi.end_column)
        return LedEdges(self.rows[inside], self.columns[inside], self.excess[inside])


def edges_of_led(posed: PosedCamera, face: LedFace, image: LedCoverage, split: int) -> LedEdges:
    """The edge pixels of an LED's image, in split x split parts; `split` is a power of 2.

    image: of `coverage_of_led` for the same camera and face.
    """
    splits = image.coverage > COVERAGE_TOLERANCE
    if face.profile is None or np.count_nonzero(splits) * split**2 > MAX_PROFILE_PARTS:
        splits &= image.coverage < 1 - COVERAGE_TOLERANCE
    rows, columns = np.nonzero(splits)
    parts = image.coverage[rows, columns][:, None, None]
    rows, columns = rows + image.roi.row, columns + image.roi.column
    corner_px = np.stack([columns, rows], axis=-1)
    pixel, row, column = np.arange(len(rows)), np.zeros_like(rows), np.zeros_like(rows)
    n = 1
    while n < split:
        n *= 2
        parts = parts.repeat(2, axis=1).repeat(2, axis=2)
        pixel = pixel.repeat(4)
        row = (2 * row[:, None] + QUARTER_ROWS).ravel()
        column = (2 * column[:, None] + QUARTER_COLUMNS).ravel()
        quads_px = corner_px[pixel, None] + (np.stack([column, row], axis=-1)[:, None] + CORNERS) / n
        coverage = _coverage_of_quads(posed, face, quads_px)
        parts[pixel, row, column] = coverage
        crossed = (coverage > COVERAGE_TOLERANCE) & (coverage < 1 - COVERAGE_TOLERANCE)
        pixel, row, column = pixel[crossed], row[crossed], column[crossed]
    if face.profile is not None:
        parts = parts * _profile_of_parts(posed, face, face.profile, corner_px, split)
    return LedEdges(rows, columns, parts - parts.mean(axis=(1, 2), keepdims=True))


def _profile_of_parts(
    posed: PosedCamera, face: LedFace, profile: FaceProfile, corner_px: NDArray[np.int64], split: int
) -> Array:
    """The face's luminance profile at the centres of all parts of the pixels with these corners (k, 2), (k, n, n)."""
    centers = (np.arange(split) + 0.5) / split
    u, v = (corner_px[:, axis, None, None] + at for axis, at in ((0, centers[None, :]), (1, centers[:, None])))
    x, y = intersections_with_plane(posed, face.center_m, u, v)
    half_m = np.abs(face.shape.rim(RIM_POINTS)).max(axis=0)
    return np.maximum(profile.at(np.clip(x, -half_m[0], half_m[0]), np.clip(y, -half_m[1], half_m[1])), 0.0)


def _coverage_of_quads(posed: PosedCamera, face: LedFace, quads_px: Array) -> Array:
    """Share of each quadrilateral (k, 4, 2) of pixel positions that the face covers, (k,)."""
    rays = posed.rays_world(quads_px)
    position_m = posed.pose.position_m
    scale = (face.center_m[2] - position_m[2]) / np.maximum(rays[..., 2], 1e-9)
    quads = scale[..., None] * rays[..., :2] - (face.center_m[:2] - np.array(position_m[:2]))
    share: Array = np.clip(face.shape.shared_area(quads) / quadrilateral_area(quads), 0.0, 1.0)
    return share
