"""The pixels that LEDs' images are read from: those at their edges one by one, flat ones inside and around as sums.

A Poisson variable's sum says all that its parts do of a mean they share, so that the pixels of a flat face need not be
looked at one by one, nor those around it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.projection import TiltedPose, project
from estimator.errors import EstimationFailure
from estimator.io.dataset import DeviceFrame, Led, Part
from estimator.pixels.led_model import Drawing, LedImages, Views, views
from estimator.pixels.polygon_raster import Canvas
from estimator.pixels.psf import LensBlur

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

# An image may move nearly this far from where the pixels were sorted into edge, inside and around.
EDGE_PX = 2
# Around the edge, for the background: a ceiling's light changes little over so short a way.
RING_PX = 8
# What holds less than this of an LED's light, or lacks less, is flat.
FLAT = 1e-3
# An LED takes part once the pose says to this where it is, one standard deviation.
CERTAIN_PX = 0.5
# Of the pixels inside an LED so many have to be known, that is read out and not full.
MIN_KNOWN = 0.5
# A square's corner is 1.4 half sides away; a slanted lens's scale varies over a face.
MAX_DISTANCE = 3.0


@dataclass(frozen=True, eq=False)
class Measurements:
    """Readings around n LEDs: the first e are pixels at edges, the rest are sums over flat ones; m in all.

    A group is what shares an amplitude and a background: an LED, or an LED's pixels of one colour; there are g.
    """

    leds: tuple[Led, ...]
    images: LedImages
    pose: TiltedPose
    """What the pixels were sorted by, and the images from there."""
    drawing: Drawing
    cells: Ints
    """(e,): the edges' places on the canvas of `images`."""
    weights: Floats
    """(e,): the light of a full pixel there over that in the LED's middle."""
    pixels: Floats
    """(m,): how many pixels a reading is the sum of."""
    electrons: Floats
    """(m,): their sum."""
    flat_light: Floats
    """(m - e,): the light of full pixels that falls on flat ones; for edges it depends on the pose."""
    group: Ints
    """(m,): of each reading; those of edges go up."""
    first_edge: Ints
    """(g,): the first edge of each group, which has one at least."""
    led: Ints
    """(g,): the LED of each group, an index to `leds`."""
    more: bool
    """Whether more LEDs of the map may be in view, whose places the pose does not say well enough."""

    def total(self, values: Floats) -> Floats:
        """Sums over each group, (..., g), of values (..., m), or (..., e) of edges alone."""
        edges = len(self.cells)
        sums = np.add.reduceat(values[..., :edges], self.first_edge, axis=-1)
        if values.shape[-1] > edges:
            np.add.at(sums.T, self.group[edges:], values[..., edges:].T)  # of the last axis
        return np.asarray(sums)


def gather(frame: DeviceFrame, pose: TiltedPose, covariance: Floats) -> Measurements:
    """What a frame shows of the LEDs of the map that are seen from a pose known to a covariance (6, 6).

    LEDs whose place is not sure to CERTAIN_PX are left out, and so are full pixels, pixels that another LED of the map
    lights too. LEDs whose inside is mostly full are left out unless all are: how bright they are, on which hangs where
    an edge is, only their dim rims can say. Raises EstimationFailure where nothing is left.
    """
    leds, seen, more = _in_view(frame, pose, covariance)
    lens = LensBlur(frame.camera, seen.depth_m)
    canvas = _windows(frame, seen, EDGE_PX + RING_PX + lens.reach_px)
    images = LedImages(leds, seen, frame.camera, lens, canvas)
    drawing = images.draw(pose)
    shares = [canvas.roi(drawing.share, k) for k in range(len(leds))]
    near = [_near_edge_and_lit(of_led) for of_led in shares]
    readings = [_readings(frame, canvas, k) for k in range(len(leds))]
    full = np.array([_is_full(share, known) for share, (_, known) in zip(shares, readings, strict=True)])
    edges: list[tuple[Ints, Floats, Floats]] = []
    flats: list[tuple[int, float, float, float]] = []
    led_of_group: list[int] = []
    for k in range(len(leds)):
        electrons, known = readings[k]
        if full[k] and not full.all():
            continue
        for other in _neighbours(canvas, k):
            here, there = _common(canvas, k, other)
            known[here] &= ~near[other][1][there]
        rows = np.arange(canvas.rows[k], canvas.rows[k] + canvas.heights[k])[:, None]
        columns = np.arange(canvas.columns[k], canvas.columns[k] + canvas.widths[k])
        (along_u, along_v), (u, v) = seen.dimming[k].tolist(), seen.centre[k].tolist()
        weights = (1 + along_u * (columns + 0.5 - u)) + along_v * (rows + 0.5 - v)
        light = shares[k] * weights
        for of_colour in _colours(frame, rows, columns):
            use = known & of_colour
            row, column = np.nonzero(use & near[k][0])
            if len(row) == 0:
                continue
            cells = canvas.cell(np.full(len(row), k), row + canvas.rows[k], column + canvas.columns[k])
            edges.append((cells, weights[row, column], electrons[row, column]))
            use &= ~near[k][0]
            inside = use & (shares[k] > 0.5)
            for flat in (inside, use & ~inside):
                if flat.any():
                    total_e, total = float(electrons[flat].sum()), float(light[flat].sum())
                    flats.append((len(led_of_group), float(flat.sum()), total_e, total))
            led_of_group.append(k)
    if not edges:
        raise EstimationFailure("fit", "no LED of the map is in view")
    cells, weights, electrons = (np.concatenate(column) for column in zip(*edges, strict=True))
    counts = np.array([len(edge[0]) for edge in edges])
    flat_group, flat_pixels, flat_electrons, flat_light = np.array(flats).reshape(-1, 4).T
    return Measurements(
        leds=leds,
        images=images,
        pose=pose,
        drawing=drawing,
        cells=cells,
        weights=weights,
        pixels=np.concatenate([np.ones(len(cells)), flat_pixels]),
        electrons=np.concatenate([electrons, flat_electrons]),
        flat_light=flat_light,
        group=np.concatenate([np.repeat(np.arange(len(counts)), counts), flat_group.astype(np.int64)]),
        first_edge=np.cumsum(counts) - counts,
        led=np.array(led_of_group),
        more=more,
    )


def _in_view(frame: DeviceFrame, pose: TiltedPose, covariance: Floats) -> tuple[tuple[Led, ...], Views, bool]:
    """LEDs of the map whose images are on what was read out, at least in part, and where.

    And whether there may be more, whose places are not sure.
    """
    low, high = _read_out(frame)
    leds = tuple(frame.leds.values())
    middles = project(np.array([led.position_m for led in leds]), pose, frame.camera)
    reach_m = np.array([led.radius_m for led in leds])
    with np.errstate(invalid="ignore"):
        # By how much an image moves with the camera, a face's reaches from its middle.
        scale = np.linalg.norm(middles.slopes[:, :, :3], axis=(1, 2))
        beside_px = (MAX_DISTANCE * reach_m * scale)[:, None]
        near = ((middles.pixels > low - beside_px) & (middles.pixels < high + beside_px)).all(axis=1)
    candidates = np.flatnonzero(near)
    if len(candidates) == 0:
        raise EstimationFailure("fit", "no LED of the map is in view")
    seen = views([leds[k] for k in candidates], pose, frame.camera)
    slopes = middles.slopes[candidates]
    with np.errstate(invalid="ignore"):
        shown = np.isfinite(seen.dimming).all(axis=1) & (seen.high > low).all(axis=1) & (seen.low < high).all(axis=1)
        sure = ((slopes @ covariance) * slopes).sum(axis=(1, 2)) < CERTAIN_PX**2
    if not (shown & sure).any():
        raise EstimationFailure("fit", "no LED of the map is in view")
    chosen = tuple(leds[k] for k in candidates[shown & sure])
    return chosen, seen.of(shown & sure), bool((shown & ~sure).any())


def _read_out(frame: DeviceFrame) -> tuple[Ints, Ints]:
    """The box of pixels around all parts: its first (u, v) and the one behind its last."""
    first = [(part.column, part.row) for part in frame.parts]
    behind = [(part.column + part.image_dn.shape[1], part.row + part.image_dn.shape[0]) for part in frame.parts]
    return np.min(first, axis=0), np.max(behind, axis=0)


def _windows(frame: DeviceFrame, seen: Views, reach_px: int) -> Canvas:
    """Windows that reach so far around the images, as far as there are readings."""
    low, high = _read_out(frame)
    first = np.maximum(np.floor(seen.low).astype(np.int64) - reach_px, low)
    last = np.minimum(np.ceil(seen.high).astype(np.int64) + reach_px, high)
    return Canvas(first[:, 1], first[:, 0], last[:, 1] - first[:, 1], last[:, 0] - first[:, 0])


def _near_edge_and_lit(share: Floats) -> tuple[Mask, Mask]:
    """Pixels that may hold a part of an LED's light while its image moves by EDGE_PX, and those that may hold any."""
    lit = share > FLAT
    part = lit & (share < 1 - FLAT)
    size = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), dtype=np.uint8)
    near, lit_near = (cv2.dilate(mask.astype(np.uint8), size).astype(bool) for mask in (part, lit))
    return near, lit_near


def _readings(frame: DeviceFrame, canvas: Canvas, k: int) -> tuple[Floats, Mask]:
    """Electrons in window k of the canvas, and where they are known."""
    top, left = int(canvas.rows[k]), int(canvas.columns[k])
    bottom, right = top + int(canvas.heights[k]), left + int(canvas.widths[k])
    electrons, known = np.zeros((bottom - top, right - left)), np.zeros((bottom - top, right - left), dtype=bool)
    for part in frame.parts:
        height, width = part.image_dn.shape
        v0, v1 = max(top, part.row), min(bottom, part.row + height)
        u0, u1 = max(left, part.column), min(right, part.column + width)
        if v0 < v1 and u0 < u1:
            piece = Part(v0, u0, part.image_dn[v0 - part.row : v1 - part.row, u0 - part.column : u1 - part.column])
            here = np.s_[v0 - top : v1 - top, u0 - left : u1 - left]
            electrons[here] = frame.electrons(piece)
            known[here] = ~frame.clipped(piece)
    return electrons, known


def _is_full(share: Floats, known: Mask) -> bool:
    """Whether of the pixels that an LED fills, if there are any, most are not known."""
    inside = share > 1 - FLAT
    return bool(inside.any() and not known[inside].mean() > MIN_KNOWN)


def _neighbours(canvas: Canvas, k: int) -> Sequence[int]:
    """Other windows that share pixels with window k."""
    bottom, right = canvas.rows + canvas.heights, canvas.columns + canvas.widths
    meets = (canvas.rows < bottom[k]) & (bottom > canvas.rows[k])
    meets &= (canvas.columns < right[k]) & (right > canvas.columns[k])
    meets[k] = False
    return list(map(int, np.flatnonzero(meets)))


def _common(canvas: Canvas, one: int, other: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """The pixels that two windows share, as slices of each."""
    slices = []
    for first, sizes in ((canvas.rows, canvas.heights), (canvas.columns, canvas.widths)):
        low = max(first[one], first[other])
        high = min(first[one] + sizes[one], first[other] + sizes[other])
        slices.append([slice(int(low - first[k]), int(high - first[k])) for k in (one, other)])
    return (slices[0][0], slices[1][0]), (slices[0][1], slices[1][1])


def _colours(frame: DeviceFrame, rows: Ints, columns: Ints) -> list[Mask]:
    """Which pixels of a window are of one colour, by place in the mosaic of 2 x 2; all of them where there is none."""
    if frame.sensor.mosaic == "none":
        return [np.ones((1, 1), dtype=bool)]
    return [(rows % 2 == site // 2) & (columns % 2 == site % 2) for site in range(4)]
