"""The room behind the LEDs: surfaces and glazings in every pixel of some regions, averaged over the pixel.

One ray through each pixel's centre, and a grid of rays in each pixel where two surfaces may meet.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import transform
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi, pixel_numbers
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.light.lightmap import Lightmap
from vlcrender.light.raycast import Hit, Room
from vlcrender.rendering.camera_data import CameraData
from vlcrender.rendering.electron_rates import DARK, ElectronRates
from vlcrender.rendering.expected_image import Image
from vlcrender.rendering.readout import LinePoses, mean_poses
from vlcrender.scene.loader import Scene

EDGE_GRID = 8
"""Rays across a pixel where surfaces meet: the error is about 0.3 / 8^1.5 = 1.3 % of the step between them."""

EDGE_BATCH = 2**14
"""Pixels where surfaces meet whose rays, 1 million, are cast at once.

Frames differ in the number of these pixels, and Dr.Jit keeps memory for the largest of them.
"""

MAX_REACH_PX = 2.0
"""Motion of a surface's image to either side during an exposure, up to which light counts as linear along the motion.
Light is interpolated between vertices: a pixel next to an edge of a triangle errs by a quarter of the reach, px, times
the change of the slope there."""
REACH_POINTS = 9
"""Points across and down the sensor whose motion is found."""

MAX_RATES = 8
"""Rates whose values of the vertices are kept; the one made first is dropped first."""


@dataclass(frozen=True)
class BackgroundRegion:
    """The room in one region: the mean over each pixel, electrons a second, and the surface at its centre.

    Images, one for each of the rates that were asked for, and surfaces are (rows, columns); surfaces are numbered as in
    `raycast.Hit`, in 8 bits where these suffice.
    """

    roi: Roi
    images: tuple[Image, ...]
    surfaces: NDArray[np.unsignedinteger]

    @property
    def image(self) -> Image:
        """The first of the images."""
        return self.images[0]


class Background:
    """Casts the rays of cameras into one scene."""

    def __init__(self, scene: Scene, light: Lightmap) -> None:
        """Prepare a scene with its baked light."""
        self.room = Room(light.mesh, scene.glazings, scene.surfaces)
        self._light = light
        self._values: dict[tuple[ElectronRates, ...], list[Any]] = {}
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
        *rates: ElectronRates,
        size_px: float = 1.0,
        during: Sequence[LinePoses] = (),
        step: Any = None,
    ) -> Hit:
        """Surfaces and light seen by squares of `size_px` around the pixel positions (u, v), Dr.Jit arrays.

        rates: none for rays whose light is not needed, one, or two, whose values are a pair. during: poses of the
        sensor's lines at one or more times, in place of the pose of `posed`; positions are then on the sensor. step: of
        each ray, the number of its time; the first where not given. The value is in electrons a
        second and includes the lens's relative illumination.
        """
        camera = CameraData.of(posed.camera, mi.Float) if self.cameras_vary else posed.camera
        rates = rates or (DARK,)
        if rates not in self._values:
            self._values[rates] = [self.room.values(self._light, one.led, one.ambient) for one in rates]
            while len(self._values) > MAX_RATES:
                del self._values[next(iter(self._values))]
        if not during:
            to_world: list[list[Any]] = list(_opaque(posed.rotation.T))
            origin = mi.Point3f(*_opaque(np.array([posed.pose.position_m]))[0])
        else:
            count = len(during[0].positions_m)
            line = mi.UInt32(dr.floor(v if during[0].along_rows else u)) if count > 1 else mi.UInt32(0)
            if step is not None:
                line += step * count

            def of_line(numbers: Sequence[NDArray[np.float64]]) -> Any:
                return dr.gather(mi.Float, mi.Float(np.concatenate(numbers).astype(np.float32)), line)

            to_world = [[of_line([at.rotations[:, j, i] for at in during]) for j in range(3)] for i in range(3)]
            origin = mi.Point3f(*(of_line([at.positions_m[:, i] for at in during]) for i in range(3)))

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

    def reach_px(self, posed: PosedCamera, during: Sequence[LinePoses]) -> int | None:
        """Distance from its mean place that a surface's image moves during an exposure, rounded up to whole pixels.

        None where the mean over the exposure has to be taken pose by pose: for more than MAX_REACH_PX, and where light
        varies within surfaces, by textures or in glazings. Of a grid of points; posed: the camera at mid-exposure.
        """
        if len(during) < 2 or self.room.textures is not None or self.room.first_glazing < self.room.nothing:
            return 0 if len(during) < 2 else None
        size = np.array([posed.camera.width_px, posed.camera.height_px])
        at = np.stack(np.meshgrid(*(np.linspace(0.02, 0.98, REACH_POINTS),) * 2), axis=-1).reshape(-1, 2) * size
        with exact_math():
            u, v = (mi.Float(numbers.astype(np.float32)) for numbers in at.T)
            hit = self.trace(posed, u, v)
            distance_m = hit.distance_m.numpy()
        rays = posed.rays_world(at)
        points_m = posed.position_m + rays * (distance_m / np.linalg.norm(rays, axis=1))[:, None]
        line = len(during[0].positions_m) // 2
        start, end = (
            posed.camera.image_of_points(transform(poses.rotations[line], points_m - poses.positions_m[line]))
            for poses in (during[0], during[-1])
        )
        reach = float(np.nanmax(np.hypot(*(end - start).T), initial=0.0)) / 2
        return int(np.ceil(reach)) if reach <= MAX_REACH_PX else None

    def regions(
        self,
        posed: PosedCamera,
        rois: Sequence[Roi],
        *rates: ElectronRates,
        during: Sequence[LinePoses] = (),
        reach_px: int = 0,
    ) -> list[BackgroundRegion]:
        """The room in each region, with an image for each of the one or two rates.

        during: as in `trace`; the regions are then on the sensor. Of several times the mean is taken: where surfaces
        meet within `reach_px`, each ray of a pixel's grid has one of the times; elsewhere light is next to linear along
        the motion, and one ray has the mean pose.
        """
        sensor = Roi.of_sensor(posed.camera)
        middle = during if len(during) < 2 else (mean_poses(during),)
        # The neighbours of a region's border pixels tell whether surfaces meet there; pixels beyond the sensor do not.
        outer = 1 + reach_px
        padded = [roi.padded(outer).intersection(sensor) if sensor.contains(roi) else roi.padded(outer) for roi in rois]
        with exact_math():
            hit = self.trace(posed, *_pixel_centers(padded, sensor), *rates, during=middle)
            numbers: Any = getattr(mi, "UInt8" if self.room.nothing < 2**8 else "UInt32")(hit.surface)
            dr.eval(hit.value, numbers)
            values, surfaces = np.atleast_2d(hit.value.numpy()), numbers.numpy()
            starts = np.cumsum([0, *(roi.pixels for roi in padded)])
            regions, edges = [], []
            for around, roi, start in zip(padded, rois, starts, strict=False):
                pixels, inner = slice(start, start + around.pixels), around.slices(roi)
                labels = surfaces[pixels].reshape(around.shape)
                images = [value[pixels].reshape(around.shape)[inner] for value in values]
                regions.append(BackgroundRegion(roi, tuple(images), labels[inner]))
                meet = widened(_edges(labels, around, sensor), reach_px)
                edges.append(np.divmod(np.flatnonzero(meet[inner]), roi.columns))
            rows = np.concatenate([r + roi.row for (r, _), roi in zip(edges, rois, strict=True)])
            columns = np.concatenate([c + roi.column for (_, c), roi in zip(edges, rois, strict=True)])
            if len(rows):
                batches = [slice(start, start + EDGE_BATCH) for start in range(0, len(rows), EDGE_BATCH)]
                means = [self._pixel_means(posed, rows[some], columns[some], rates, during) for some in batches]
                parts = np.split(np.concatenate(means, axis=1), np.cumsum([len(r) for r, _ in edges])[:-1], axis=1)
                for region, edge, mean in zip(regions, edges, parts, strict=True):
                    for image, of_image in zip(region.images, mean, strict=True):
                        image[edge] = of_image
            return regions

    def _pixel_means(
        self,
        posed: PosedCamera,
        rows: NDArray[np.int64],
        columns: NDArray[np.int64],
        rates: Sequence[ElectronRates],
        during: Sequence[LinePoses],
    ) -> NDArray[np.float32]:
        """Means over a grid of rays in each of the pixels: (rates, pixels)."""
        u, v = sub_pixels(rows, columns)
        step = None if len(during) < 2 else _steps_of_sub_pixels(len(rows), len(during))
        hit = self.trace(posed, u, v, *rates, size_px=1 / EDGE_GRID, during=during, step=step)
        means: NDArray[np.float32] = hit.value.numpy().reshape(len(rates), len(rows), -1).mean(axis=2)
        return means


def sub_pixels(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> "tuple[mi.Float, mi.Float]":
    """Positions (u, v) of an EDGE_GRID x EDGE_GRID grid in each of the pixels, pixel by pixel."""
    grid = EDGE_GRID
    index = dr.arange(mi.UInt32, len(rows) * grid * grid)
    number = index // (grid * grid)
    sub = index - number * (grid * grid)
    sub_row = sub // grid
    left, top = (dr.gather(mi.Float, mi.Float(x.astype(np.float32)), number) for x in (columns, rows))
    return left + (mi.Float(sub - sub_row * grid) + 0.5) / grid, top + (mi.Float(sub_row) + 0.5) / grid


def _steps_of_sub_pixels(pixels: int, steps: int) -> "mi.UInt32":
    """Of the rays of `sub_pixels`, numbers below `steps`, spread evenly over each pixel and any part of it.

    Multiples of the two numbers of M. Roberts' R2 sequence (2018), modulo 1.
    """
    sub = dr.arange(mi.UInt32, pixels * EDGE_GRID**2) % EDGE_GRID**2
    place = mi.Float(sub // EDGE_GRID) * 0.7548777 + mi.Float(sub % EDGE_GRID) * 0.5698403
    return dr.minimum(
        mi.UInt32((place - dr.floor(place)) * dr.opaque(mi.Float, steps)), dr.opaque(mi.UInt32, steps - 1)
    )


def widened(pixels: NDArray[np.bool_], by_px: int) -> NDArray[np.bool_]:
    """Pixels at most so many rows and columns from one of the given ones, which are few."""
    if by_px == 0:
        return pixels
    rows, columns = pixels.shape
    row, column = np.divmod(np.flatnonzero(pixels), columns)
    wide = np.zeros((rows + 2 * by_px, columns + 2 * by_px), dtype=bool)
    for down in range(2 * by_px + 1):
        for right in range(2 * by_px + 1):
            wide[row + down, column + right] = True
    return wide[by_px:-by_px, by_px:-by_px]


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
