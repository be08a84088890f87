"""The room behind the LEDs: surfaces and glazings in every pixel of some regions, averaged over the pixel.

One ray through each pixel's centre, and a grid of rays in each pixel where two surfaces may meet.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi, pixel_numbers
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.light.lightmap import Lightmap
from vlcrender.light.raycast import Hit, Room
from vlcrender.rendering.camera_data import CameraData
from vlcrender.rendering.electron_rates import DARK, ElectronRates
from vlcrender.rendering.expected_image import Image
from vlcrender.rendering.readout import LinePoses
from vlcrender.scene.loader import Scene

EDGE_GRID = 8
"""Rays across a pixel where surfaces meet: the error is about 0.3 / 8^1.5 = 1.3 % of the step between them."""

MAX_RATES = 8
"""Rates whose values of the vertices are kept; the one made first is dropped first."""


@dataclass(frozen=True)
class BackgroundRegion:
    """The room in one region: the mean over each pixel, electrons a second, and the surface at its centre.

    Both (rows, columns); surfaces are numbered as in `raycast.Hit`, in 8 bits where these suffice.
    """

    roi: Roi
    image: Image
    surfaces: NDArray[np.unsignedinteger]


class Background:
    """Casts the rays of cameras into one scene."""

    def __init__(self, scene: Scene, light: Lightmap) -> None:
        """Prepare a scene with its baked light."""
        self.room = Room(light.mesh, scene.glazings, scene.surfaces)
        self._light = light
        self._values: dict[ElectronRates, Any] = {}
        self.cameras_vary = False
        """Whether each view has a camera of its own, so that a camera's numbers are data of the kernels."""

    def with_varying_cameras(self) -> "Background":
        """The same room for views of which each has a camera of its own."""
        background = copy.copy(self)
        background.cameras_vary = True
        return background

    def trace(
        self,
        posed: PosedCamera,
        u: Any,
        v: Any,
        rates: ElectronRates = DARK,
        size_px: float = 1.0,
        lines: LinePoses | None = None,
    ) -> Hit:
        """Surfaces and light seen by squares of `size_px` around the pixel positions (u, v), Dr.Jit arrays.

        lines: poses of the sensor's lines, in place of the pose of `posed`; positions are then on the sensor. The value
        is in electrons a second and includes the lens's relative illumination.
        """
        camera = CameraData.of(posed.camera, mi.Float) if self.cameras_vary else posed.camera
        if rates not in self._values:
            self._values[rates] = self.room.values(self._light, rates.led, rates.ambient)
            while len(self._values) > MAX_RATES:
                del self._values[next(iter(self._values))]
        if lines is None:
            to_world: list[list[Any]] = list(_opaque(posed.rotation.T))
            origin = mi.Point3f(*_opaque(np.array([posed.pose.position_m]))[0])
        else:
            line = mi.UInt32(dr.floor(v if lines.along_rows else u))

            def of_line(numbers: NDArray[np.float64]) -> Any:
                return dr.gather(mi.Float, mi.Float(np.ascontiguousarray(numbers, dtype=np.float32)), line)

            to_world = [[of_line(lines.rotations[:, j, i]) for j in range(3)] for i in range(3)]
            origin = mi.Point3f(*(of_line(lines.positions_m[:, i]) for i in range(3)))

        def ray(u: Any, v: Any) -> Any:
            x, y, z = camera.unproject(u, v, dr)
            return dr.normalize(mi.Vector3f(*(row[0] * x + row[1] * y + row[2] * z for row in to_world)))

        spread = None
        if self.room.textures is not None:
            half = size_px / 2
            spread = ray(u + half, v) - ray(u - half, v), ray(u, v + half) - ray(u, v - half)
        hit = self.room.trace(origin, ray(u, v), self._values[rates], spread=spread)
        value = relative_illumination(camera, u, v, dr, hit.value)
        return replace(hit, value=value)

    def regions(
        self, posed: PosedCamera, rois: Sequence[Roi], rates: ElectronRates, lines: LinePoses | None = None
    ) -> list[BackgroundRegion]:
        """The room in each region. `lines`: as in `trace`; the regions are then on the sensor."""
        sensor = Roi.of_sensor(posed.camera)
        # The neighbours of a region's border pixels tell whether surfaces meet there; pixels beyond the sensor do not.
        padded = [roi.padded(1).intersection(sensor) if sensor.contains(roi) else roi.padded(1) for roi in rois]
        with exact_math():
            hit = self.trace(posed, *_pixel_centers(padded, sensor), rates, lines=lines)
            numbers: Any = getattr(mi, "UInt8" if self.room.nothing < 2**8 else "UInt32")(hit.surface)
            dr.eval(hit.value, numbers)
            values, surfaces = hit.value.numpy(), numbers.numpy()
            starts = np.cumsum([0, *(roi.pixels for roi in padded)])
            regions, edges = [], []
            for outer, roi, start in zip(padded, rois, starts, strict=False):
                pixels, inner = slice(start, start + outer.pixels), outer.slices(roi)
                labels = surfaces[pixels].reshape(outer.rows, outer.columns)
                image = values[pixels].reshape(outer.rows, outer.columns)[inner]
                regions.append(BackgroundRegion(roi, image, labels[inner]))
                edges.append(np.divmod(np.flatnonzero(_edges(labels, outer, sensor)[inner]), roi.columns))
            rows = np.concatenate([r + roi.row for (r, _), roi in zip(edges, rois, strict=True)])
            columns = np.concatenate([c + roi.column for (_, c), roi in zip(edges, rois, strict=True)])
            if len(rows):
                u, v = sub_pixels(rows, columns)
                rays = self.trace(posed, u, v, rates, 1 / EDGE_GRID, lines).value.numpy()
                means = rays.reshape(len(rows), -1).mean(axis=1)
                parts = np.split(means, np.cumsum([len(r) for r, _ in edges])[:-1])
                for region, edge, mean in zip(regions, edges, parts, strict=True):
                    region.image[edge] = mean
            return regions


def sub_pixels(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> "tuple[mi.Float, mi.Float]":
    """Positions (u, v) of an EDGE_GRID x EDGE_GRID grid in each of the pixels, pixel by pixel."""
    grid = EDGE_GRID
    index = dr.arange(mi.UInt32, len(rows) * grid * grid)
    number = index // (grid * grid)
    sub = index - number * (grid * grid)
    sub_row = sub // grid
    left, top = (dr.gather(mi.Float, mi.Float(x.astype(np.float32)), number) for x in (columns, rows))
    return left + (mi.Float(sub - sub_row * grid) + 0.5) / grid, top + (mi.Float(sub_row) + 0.5) / grid


def _pixel_centers(rois: Sequence[Roi], sensor: Roi) -> "tuple[mi.Float, mi.Float]":
    """Positions (u, v) of the centres of all pixels of all regions, region by region, row by row."""
    if list(rois) == [sensor]:
        index = dr.arange(mi.UInt32, sensor.pixels)
        row = index // sensor.columns
        return mi.Float(index - row * sensor.columns) + 0.5, mi.Float(row) + 0.5
    # As data, not computed in the kernel: regions of any number and size are then one launch of the same kernel.
    u, v = (mi.Float(numbers.astype(np.float32) + np.float32(0.5)) for numbers in pixel_numbers(rois))
    return u, v


def _opaque(matrix: NDArray[np.float64]) -> "list[list[mi.Float]]":
    """A matrix as data: as literals its numbers would be part of the kernel, and each pose would compile a new one."""
    return [[dr.opaque(mi.Float, number) for number in row] for row in matrix.tolist()]


def _edges(surfaces: NDArray[np.unsignedinteger], roi: Roi, sensor: Roi) -> NDArray[np.bool_]:
    """Pixels of a region in which surfaces may meet; `surfaces` are the numbers at the pixel centres."""
    edges = differs_from_neighbour(surfaces)
    if not sensor.contains(roi) and sensor.overlaps(roi):
        on_sensor = roi.slices(roi.intersection(sensor))  # as in a full frame, which has no neighbours beyond
        edges[on_sensor] = differs_from_neighbour(surfaces[on_sensor])
    return edges


def differs_from_neighbour(labels: NDArray[Any]) -> NDArray[np.bool_]:
    """Pixels (rows, columns) with another label than one of their 8 neighbours.

    These are the pixels of all 2 x 2 squares with two labels, and each such square has a change across or down. Changes
    are few, so each is marked by itself.
    """
    rows, columns = labels.shape
    flat = labels.ravel()
    wide = np.zeros((rows + 2, columns + 2), dtype=bool)  # squares may extend beyond the border
    row, column = np.divmod(np.flatnonzero(flat[1:] != flat[:-1]), columns)
    row, column = row[column < columns - 1], column[column < columns - 1]
    for down in (0, 1, 2):
        for right in (1, 2):
            wide[row + down, column + right] = True
    row, column = np.divmod(np.flatnonzero(flat[columns:] != flat[:-columns]), columns)
    for down in (1, 2):
        for right in (0, 1, 2):
            wide[row + down, column + right] = True
    return wide[1:-1, 1:-1]
