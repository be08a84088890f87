"""Halo of a lens's veiling glare, on a grid of nodes a sixth of its radius apart.

The halo is the light of the whole sensor, scattered by `camera.glare`. Light is put onto the nodes, convolved with the
glare spread function there, and interpolated between them. Both steps use the weights of cubic convolution (Catmull and
Rom), which reproduce quadratics: moments of light up to the second are exact. With nodes r_0 / 6 apart the error of a
point's halo is below 0.5 % of its largest value (tested). The light of each LED is kept apart, since its brightness may
change; the light of the room behind is sampled by one ray for 4 x 4 parts of the area of a node.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import sparse

from vlcrender.camera.glare import Glare
from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.rendering.background import Background
from vlcrender.rendering.electron_rates import ElectronRates
from vlcrender.rendering.expected_image import Gain, Gains, Image, gain_in

NODES_PER_RADIUS = 6
"""Nodes along the halo's radius."""
RAYS_PER_NODE = 4
"""Rays across and down the area of a node."""
BORDER_NODES = 2
"""Nodes beyond the sensor's border, between which the outermost pixels lie too."""

Array = NDArray[np.float64]


class SourceOfLight(Protocol):
    """An LED's patch, or its specular reflection."""

    @property
    def led_id(self) -> int:
        """Identity of the LED."""

    @property
    def roi(self) -> Roi:
        """The pixels that it lights."""

    @property
    def electrons_per_s(self) -> NDArray[np.floating]:
        """Its light in each of them."""


@dataclass(frozen=True)
class LightOfLed:
    """A part of one LED's light, or a change of it, as `SourceOfLight`."""

    led_id: int
    roi: Roi
    electrons_per_s: Array


@dataclass(frozen=True)
class HaloGrid:
    """Nodes over a sensor: node (i, j) is at the pixel position v = (i - BORDER_NODES) step, u = (j - ...) step."""

    step_px: int
    sensor: Roi

    @classmethod
    def of(cls, camera: Camera, glare: Glare) -> "HaloGrid":
        """The grid of a camera's glare."""
        step = max(1, int(glare.radius_um / camera.pixel_pitch_um / NODES_PER_RADIUS))
        return cls(step, Roi.of_sensor(camera))

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes down and across."""
        rows, columns = (
            -(-size // self.step_px) + 1 + 2 * BORDER_NODES for size in (self.sensor.rows, self.sensor.columns)
        )
        return rows, columns

    def weights(self, positions_px: Array, axis: int) -> "sparse.csr_array":
        """Weights (n, nodes) of the nodes along an axis (0: down) in the value at each position v or u, on the sensor.

        The transpose puts light at the positions onto the nodes.
        """
        at = positions_px / self.step_px + BORDER_NODES
        first = np.floor(at).astype(int)
        t = at - first
        taps = np.stack(
            [
                ((2 - t) * t - 1) * t / 2,
                ((3 * t - 5) * t * t + 2) / 2,
                ((4 - 3 * t) * t + 1) * t / 2,
                (t - 1) * t * t / 2,
            ],
            axis=1,
        )
        nodes = first[:, None] + np.arange(-1, 3)
        starts = np.arange(0, 4 * len(at) + 1, 4)
        return sparse.csr_array((taps.ravel(), nodes.ravel(), starts), shape=(len(at), self.shape[axis]))

    def gathered(self, light: NDArray[np.floating], rows_px: Array, columns_px: Array) -> Array:
        """Light (rows, columns) at positions v and u, put onto the nodes (nodes down, nodes across)."""
        down = self.weights(rows_px, 0).T @ light.astype(np.float64)
        return np.ascontiguousarray((self.weights(columns_px, 1).T @ down.T).T)

    def spread(self, light: Array, glare: Glare, pixel_pitch_um: float) -> Array:
        """The halo at the nodes, electrons a pixel, of light on the nodes."""
        down, across = (np.arange(1 - size, size, dtype=np.float64) * self.step_px for size in self.shape)
        kernel = glare.share * glare.spread_per_px2(np.hypot(down[:, None], across), pixel_pitch_um)
        return np.maximum(scipy.signal.fftconvolve(kernel, light, mode="valid"), 0.0)

    def values_by_line(self, sources: "Sequence[tuple[Array, Array]]", roi: Roi) -> Array:
        """Sum of values times a gain for each row or column of the sensor, (rows, columns). All gains are of one shape.

        Each of `sources` is a gain, of the shape of `expected_image.Gain`, and values at the nodes.
        """
        u, v = roi.centers_px()
        down, across = self.weights(v[:, 0], 0), self.weights(u[0], 1)
        if sources[0][0].shape[1] == 1:
            by_row = sum((gain_in(gain, roi) * (down @ at_nodes) for gain, at_nodes in sources), np.zeros(()))
            return np.ascontiguousarray((across @ by_row.T).T)
        by_column = sum((gain_in(gain, roi) * (across @ at_nodes.T).T for gain, at_nodes in sources), np.zeros(()))
        return np.ascontiguousarray(down @ by_column)

    def values(self, at_nodes: Array, roi: Roi) -> Array:
        """Values at the centres of the pixels of a region of the sensor, (rows, columns)."""
        u, v = roi.centers_px()
        down = self.weights(v[:, 0], 0) @ at_nodes
        return np.ascontiguousarray((self.weights(u[0], 1) @ down.T).T)


@dataclass(frozen=True, eq=False)
class GlareHalo:
    """The halo of one image: light on the nodes, electrons a second, of the room and of each LED by its id."""

    grid: HaloGrid
    glare: Glare
    pixel_pitch_um: float
    room: Array
    leds: tuple[tuple[int, Array], ...]
    room_by_leds: Array | None = None
    """Part of `room` that left an LED; None where it was not asked for."""

    def electrons_per_s(self, roi: Roi, gains: Gains | None = None, room_gain: Gain = 1.0) -> Image:
        """As `expected_image.Halo`. A line of pixels has the gains of its own exposure, whichever lines the light that
        is scattered onto it would have reached.
        """
        if gains is None and not isinstance(room_gain, np.ndarray) and room_gain == 1:
            return self.grid.values(self._unmodulated, roi).astype(np.float32)
        steady = self.room.copy()
        by_line: list[tuple[Array, Array]] = []
        for light, gain in self._modulated(gains or {}, room_gain):
            if isinstance(gain, np.ndarray):
                by_line.append((gain, light))
            else:
                steady += gain * light
        image = self.grid.values(self._spread(steady), roi)
        if by_line:
            image += self.grid.values_by_line([(gain, self._spread(light)) for gain, light in by_line], roi)
            np.maximum(image, 0, out=image)
        return image.astype(np.float32)

    def _modulated(self, gains: Gains, room_gain: Gain) -> "Iterator[tuple[Array, Gain]]":
        """Light on the nodes and its gain: of each LED, and of the room the part by LEDs, beyond its mean."""
        for led_id, of_led in self.leds:
            yield of_led, gains.get(led_id, 1.0)
        if isinstance(room_gain, np.ndarray) or room_gain != 1:
            if self.room_by_leds is None:
                raise ValueError("room_gain: the part of the halo that left an LED is not known")
            yield self.room_by_leds, room_gain - 1.0

    @cached_property
    def _unmodulated(self) -> Array:
        light = self.room.copy()
        for _, of_led in self.leds:
            light += 1.0 * of_led
        return self._spread(light)

    def _spread(self, light: Array) -> Array:
        return self.grid.spread(light, self.glare, self.pixel_pitch_um)


def halo_of_sources(camera: Camera, glare: Glare, sources: Sequence[SourceOfLight], roi: Roi) -> Array:
    """The halo, in a region of the sensor, of light of which `glare.share` is scattered already, (rows, columns)."""
    grid = HaloGrid.of(camera, glare)
    light = np.zeros(grid.shape)
    for source in sources:
        u, v = source.roi.centers_px()
        light += grid.gathered(source.electrons_per_s, v[:, 0], u[0]) / (1 - glare.share)
    return grid.values(grid.spread(light, glare, camera.pixel_pitch_um), roi)


def glare_halo(
    posed: PosedCamera,
    background: Background,
    rates: ElectronRates,
    sources: Sequence[SourceOfLight],
    room_apart: bool = False,
) -> GlareHalo | None:
    """The halo of a view; None for a lens without glare.

    background: the room, seen from this pose; rates: of light that is not scattered; sources: the light of the LEDs
    that it images on the sensor, less the share that is scattered; room_apart: whether the room's light that left an
    LED is wanted apart. LEDs' faces, which hide a little of the room, are left out of its light.
    """
    camera, glare = posed.camera, posed.camera.glare
    if glare is None:
        return None
    grid = HaloGrid.of(camera, glare)
    sharp = 1 / (1 - glare.share)
    cell = max(1, grid.step_px // RAYS_PER_NODE)
    rows, columns = (np.arange(0, size, cell) for size in (camera.height_px, camera.width_px))
    heights, widths = (
        np.minimum(starts + cell, size) - starts
        for starts, size in ((rows, camera.height_px), (columns, camera.width_px))
    )
    v, u = rows + heights / 2, columns + widths / 2
    areas = np.outer(heights, widths)

    def room(rates: ElectronRates) -> Array:
        with exact_math():
            across, down = np.meshgrid(u.astype(np.float32), v.astype(np.float32))
            hit = background.trace(posed, mi.Float(across.ravel()), mi.Float(down.ravel()), rates, size_px=float(cell))
            dr.eval(hit.value)
            light = hit.value.numpy().reshape(len(v), len(u)).astype(np.float64)
        return sharp * grid.gathered(light * areas, v, u)

    leds: dict[int, Array] = {}
    for source in sources:
        roi = source.roi
        u_px, v_px = roi.centers_px()
        light = sharp * grid.gathered(source.electrons_per_s, v_px[:, 0], u_px[0])
        leds[source.led_id] = leds[source.led_id] + light if source.led_id in leds else light
    return GlareHalo(
        grid,
        glare,
        camera.pixel_pitch_um,
        room(rates),
        tuple(leds.items()),
        room(replace(rates, ambient=0.0)) if room_apart else None,
    )
