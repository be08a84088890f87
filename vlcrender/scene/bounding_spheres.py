"""Spheres around LEDs, and which of them a camera may see, in a time that hardly grows with their number."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.projection import FieldOfView
from vlcrender.camera.roi import Roi

BLOCK = 32
"""LEDs of neighbouring identities, mostly of one panel, that are first looked at together."""
ROUNDING = 1e-9
"""Relative allowance of a block's radius, so that rounding leaves out no sphere."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BoundingSpheres:
    """n spheres: centres (n, 3), world, and radii (n,), metres."""

    centers_m: Array
    radii_m: Array

    def candidates(self, posed: PosedCamera, margin_px: float = 0.0, within: Roi | None = None) -> NDArray[np.int64]:
        """Indices of all LEDs that light a pixel of the sensor or up to `margin_px` beside it, and perhaps of others.

        An LED is a candidate where its centre is above the camera and its sphere enters the camera's field of view.
        within: a region in place of the sensor and its margin.
        """
        if within is None:
            view = posed.camera.field_of_view(margin_px)
        else:
            view = posed.camera.field_of_view_of(within.column, within.row, within.end_column, within.end_row)
        near = np.flatnonzero(self._blocks._in_view(posed, view))
        members = (near[:, None] * BLOCK + np.arange(BLOCK)).ravel()
        members = members[members < len(self.radii_m)]
        of_members = BoundingSpheres(self.centers_m[members], self.radii_m[members])
        above = of_members.centers_m[:, 2] > posed.pose.position_m[2]
        found: NDArray[np.int64] = members[above & of_members._in_view(posed, view)]
        return found

    @cached_property
    def _blocks(self) -> Self:
        """A sphere around each BLOCK spheres."""
        starts = np.arange(0, len(self.radii_m), BLOCK)
        counts = np.diff([*starts, len(self.radii_m)])
        centers_m = np.add.reduceat(self.centers_m, starts) / counts[:, None]
        reaches_m = np.linalg.norm(self.centers_m - np.repeat(centers_m, counts, axis=0), axis=1) + self.radii_m
        return type(self)(centers_m, np.maximum.reduceat(reaches_m, starts) * (1 + ROUNDING))

    def _in_view(self, posed: PosedCamera, view: FieldOfView) -> NDArray[np.bool_]:
        """Whether each sphere may enter a field of view of the camera, (n,)."""
        return view.may_contain(posed.camera_coordinates(self.centers_m), self.radii_m)
