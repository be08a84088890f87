"""The room behind the LEDs: surfaces and panes in every pixel of some windows, averaged over the pixel.

One ray through each pixel's centre, and a grid of rays in each pixel where two surfaces may meet.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose, ray_of_pixel
from vlcrender.camera.lens import relative_illumination
from vlcrender.camera.roi import Roi
from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.light.lightmap import Lightmap
from vlcrender.light.raycast import Hit, Room
from vlcrender.rendering.expected_image import Image
from vlcrender.scene.loader import Scene

EDGE_GRID = 8
"""Rays across a pixel where surfaces meet: the error is about 0.3 / 8^1.5 = 1.3 % of the step between them."""


class Background:
    """Casts the camera's rays into one scene. Two factors, `rates`, turn cd/m2 into what images hold.

    rates: of light that left an LED, and of all other light.
    """

    def __init__(self, scene: Scene, light: Lightmap) -> None:
        """Prepare a scene with its baked light."""
        self.room = Room(light.mesh, scene.glazings, scene.surfaces)
        self._light = light
        self._values: dict[tuple[float, float], Any] = {}

    def trace(
        self,
        camera: Camera,
        pose: Pose,
        u: Any,
        v: Any,
        rates: tuple[float, float] = (0.0, 0.0),
        size_px: float = 1.0,
    ) -> Hit:
        """What squares of `size_px` about the pixel positions (u, v) see, Dr.Jit arrays.

        The lens's relative illumination is in the value.
        """
        if rates not in self._values:
            self._values[rates] = self.room.values(self._light, *rates)
        to_world = _opaque(pose.rotation.T)

        def ray(u: Any, v: Any) -> Any:
            x, y, z = ray_of_pixel(camera, u, v, dr)
            return dr.normalize(mi.Vector3f(*(row[0] * x + row[1] * y + row[2] * z for row in to_world)))

        spread = None
        if self.room.textures is not None:
            half = size_px / 2
            spread = ray(u + half, v) - ray(u - half, v), ray(u, v + half) - ray(u, v - half)
        origin = mi.Point3f(*_opaque(np.array([pose.position_m]))[0])
        hit = self.room.trace(origin, ray(u, v), self._values[rates], spread=spread)
        value = relative_illumination(camera, u, v, dr, hit.value)
        return replace(hit, value=value)

    def images(
        self, camera: Camera, pose: Pose, frames: Sequence[Roi], rates: tuple[float, float]
    ) -> tuple[list[Image], list[NDArray[np.uint32]]]:
        """Window by window: the mean over each pixel, and the number of the surface at its centre."""
        sensor = Roi.of_sensor(camera)
        # A border pixel's neighbours say whether two surfaces meet in it; beyond the sensor nobody looks.
        wider = [w.padded(1).intersection(sensor) if sensor.contains(w) else w.padded(1) for w in frames]
        with exact_math():
            hit = self.trace(camera, pose, *_pixel_centers(wider, sensor), rates)
            dr.eval(hit.value, hit.surface)
            values, surfaces = hit.value.numpy(), hit.surface.numpy()
            starts = np.cumsum([0, *(w.pixels for w in wider)])
            images, labels, edges = [], [], []
            for roi, frame, start in zip(wider, frames, starts, strict=False):
                here, inner = slice(start, start + roi.pixels), roi.slices(frame)
                label = surfaces[here].reshape(roi.rows, roi.columns)
                images.append(values[here].reshape(roi.rows, roi.columns)[inner])
                labels.append(label[inner])
                edges.append(_edges(label, roi, sensor)[inner])
            pixels = [np.nonzero(edge) for edge in edges]
            rows = np.concatenate([r + frame.row for (r, _), frame in zip(pixels, frames, strict=True)])
            columns = np.concatenate([c + frame.column for (_, c), frame in zip(pixels, frames, strict=True)])
            if len(rows):
                u, v = sub_pixels(rows, columns)
                means = (
                    self.trace(camera, pose, u, v, rates, 1 / EDGE_GRID)
                    .value.numpy()
                    .reshape(len(rows), -1)
                    .mean(axis=1)
                )
                parts = np.split(means, np.cumsum([len(r) for r, _ in pixels])[:-1])
                for image, pixel, mean in zip(images, pixels, parts, strict=True):
                    image[pixel] = mean
            return images, labels


def sub_pixels(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> "tuple[mi.Float, mi.Float]":
    """(u, v) of an EDGE_GRID x EDGE_GRID grid in each of the pixels, pixel by pixel."""
    grid = EDGE_GRID
    index = dr.arange(mi.UInt32, len(rows) * grid * grid)
    number = index // (grid * grid)
    sub = index - number * (grid * grid)
    sub_row = sub // grid
    left, top = (dr.gather(mi.Float, mi.Float(x.astype(np.float32)), number) for x in (columns, rows))
    return left + (mi.Float(sub - sub_row * grid) + 0.5) / grid, top + (mi.Float(sub_row) + 0.5) / grid


def _pixel_centers(regions: Sequence[Roi], sensor: Roi) -> "tuple[mi.Float, mi.Float]":
    """(u, v) of all pixels of all windows, window by window, row by row."""
    if list(regions) == [sensor]:
        index = dr.arange(mi.UInt32, sensor.pixels)
        row = index // sensor.columns
        return mi.Float(index - row * sensor.columns) + 0.5, mi.Float(row) + 0.5
    # As data, not reckoned in the kernel: windows of any number and size are then one launch of the same kernel.
    u = [np.tile(np.arange(w.column, w.end_column, dtype=np.float32) + np.float32(0.5), w.rows) for w in regions]
    v = [np.repeat(np.arange(w.row, w.end_row, dtype=np.float32) + np.float32(0.5), w.columns) for w in regions]
    return mi.Float(np.concatenate(u)), mi.Float(np.concatenate(v))


def _opaque(matrix: NDArray[np.float64]) -> "list[list[mi.Float]]":
    """A matrix as data: as literals its numbers would be part of the kernel, and each pose would compile a new one."""
    return [[dr.opaque(mi.Float, number) for number in row] for row in matrix.tolist()]


def _edges(surfaces: NDArray[np.uint32], roi: Roi, sensor: Roi) -> NDArray[np.bool_]:
    """Pixels of a window in which surfaces may meet, whose numbers at the pixel centres are given."""
    edges = differs_from_neighbour(surfaces)
    if not sensor.contains(roi) and sensor.overlaps(roi):
        on_sensor = roi.slices(roi.intersection(sensor))  # as in a full frame, which has no neighbours beyond
        edges[on_sensor] = differs_from_neighbour(surfaces[on_sensor])
    return edges


def differs_from_neighbour(labels: NDArray[Any]) -> NDArray[np.bool_]:
    """Pixels (rows, columns) of which one of the 8 neighbours has another label."""
    differs = np.zeros(labels.shape, dtype=bool)
    for here, there in (
        (np.s_[:, 1:], np.s_[:, :-1]),
        (np.s_[1:, :], np.s_[:-1, :]),
        (np.s_[1:, 1:], np.s_[:-1, :-1]),
        (np.s_[1:, :-1], np.s_[:-1, 1:]),
    ):
        change = labels[here] != labels[there]
        differs[here] |= change
        differs[there] |= change
    return differs
