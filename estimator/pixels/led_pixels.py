"""Pixel readings of LED images: edge pixels one by one, uniform pixels inside an LED image as sums.

The sum of Poisson variables is a sufficient statistic of a common mean, so the uniform pixels of an LED's face need not
be read one by one: each block of them is one reading. Its expectation is exact, a sum over its pixels.

An LED that sends is brighter in some lines of a rolling shutter than in others: its light in a pixel is multiplied by
the gain of the pixel's line, as decoded (`DeviceFrame.gains`). Its blocks are of one line each. An LED that may send,
and whose gains are not known, has no model and is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame, LineGains, Part
from estimator.io.led_map import Led
from estimator.pixels.led_model import (
    POSE_ALONE,
    ImageState,
    LedFootprints,
    LedImageModel,
    RenderedLeds,
    led_footprints,
)
from estimator.pixels.polygon_raster import RoiStack
from estimator.pixels.psf import LensBlur
from estimator.spots.excess_noise import excess_noise_e2

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

# An image may move by nearly this much before its pixels have to be sorted into edge, inside and background again.
EDGE_PX = 2
# Pixels up to NEAR_PX beyond those that an LED lights tell the background of its edge. Those further off may show
# another surface: the panel that LEDs are mounted on ends, and the ceiling or the panel's side begins.
NEAR_PX = 1
# Blocks of the uniform pixels of a face along each axis, each summed for a reading: the light changes little over one.
BLOCKS = 6
# A pixel whose share of an LED's light is within this of 0 or 1 is uniform.
UNIFORM_TOLERANCE = 1e-3
# An LED is used once the pose determines its image to this, one standard deviation.
MAX_IMAGE_SIGMA_PX = 0.5
# Share of the pixels inside an LED image that have to be known: read out and not saturated.
MIN_KNOWN_SHARE = 0.5
NONE_IN_VIEW = "no LED of the map is in view from the pose that the spots give"
NO_GAINS = "the LEDs in view send waves whose phases are not found"
# Step of the phase, in lines, for derivatives of gains.
PHASE_STEP = 0.25
# Extent of an LED image in half widths: 1.4 for a square's vertex, and the scale of a tilted view varies over a face.
MAX_EXTENT = 3.0


@dataclass(frozen=True, eq=False)
class LedPixels:
    """Readings around n LEDs, m in all: edge pixels, and sums over blocks of the uniform pixels inside.

    A group of readings has a common amplitude and background: an LED, or an LED's pixels of one colour; there are g.
    The readings of a group follow each other, from `starts[k]` to `starts[k + 1]`, (g + 1,); each group has an edge
    pixel. `led` (g,) is the LED of each group, an index to `leds`.

    `index` (n,) is the number of each LED in the map, `model` the image model of the LEDs, `state` the state that the
    pixels were sorted by, `rendered` the images there. `edges` (e,) are the readings that are edge pixels, `cells` (e,)
    their cells in `model.rois`. `pixel_counts` (m,) is the number of pixels of a reading, `electrons` (m,) their sum.

    With the coordinates (a, b) of a pixel on the face, in half widths from its centre: `background` (m, 4) is the
    lens's fall-off times 1, a, b and a^2 + b^2; `face` (m, 3) is the mean of a, b and a^2 + b^2 - 1/2 over a reading.
    `uniform_light` (m,) is the light inside the LED image summed over the pixels of a reading, 0 for edge pixels, whose
    light depends on the state. `gains` are those of the readings where an LED sends, None where all are steady.
    `radius_px` (n,) is half the larger side of an LED image's bounding box. Images may move by `max_move_px` before
    their pixels have to be sorted anew. `more` says whether other LEDs of the map may be in view, whose images the
    state does not determine well enough. `excess_e2` is the variance of a pixel beside that which the device states
    (`estimator.spots.excess_noise`).
    """

    leds: tuple[Led, ...]
    index: Ints
    model: LedImageModel
    state: ImageState
    rendered: RenderedLeds
    edges: Ints
    cells: Ints
    pixel_counts: Floats
    electrons: Floats
    background: Floats
    face: Floats
    uniform_light: Floats
    starts: Ints
    led: Ints
    radius_px: Floats
    max_move_px: float
    more: bool
    excess_e2: float
    gains: "ReadingGains | None" = None

    @cached_property
    def group(self) -> Ints:
        """Group of each reading, (m,)."""
        return np.repeat(np.arange(len(self.led)), np.diff(self.starts))

    def sum_by_group(self, values: Floats) -> Floats:
        """Sums over each group, (..., g), of values (..., m)."""
        return np.asarray(np.add.reduceat(values, self.starts[:-1], axis=-1))

    def light(self, rendered: RenderedLeds) -> Floats:
        """Light (m,) of each reading, in that of a pixel at the LED image's centre."""
        light = self.uniform_light.copy()
        light[self.edges] = rendered.light[self.cells]
        return light


@dataclass(frozen=True, eq=False)
class ReadingGains:
    """Gains of m readings by their `lines` (m,).

    `of_group` are those of the LED of each of g groups, None for a steady one, whose gain is 1. The readings of a group
    follow each other, from `starts[k]` to `starts[k + 1]`, (g + 1,).
    """

    of_group: tuple[LineGains | None, ...]
    lines: Floats
    starts: Ints

    def at(self, phase_lines: Floats) -> tuple[Floats, Floats]:
        """Gains (m,) of waves that are `phase_lines` (g,) lines further, and their derivatives by these."""
        gain, by_phase = np.ones(len(self.lines)), np.zeros(len(self.lines))
        for k, gains in enumerate(self.of_group):
            if gains is not None:
                readings = slice(self.starts[k], self.starts[k + 1])
                lines = self.lines[readings] + phase_lines[k]
                gain[readings] = gains(lines)
                by_phase[readings] = (gains(lines + PHASE_STEP) - gains(lines - PHASE_STEP)) / (2 * PHASE_STEP)
        return gain, by_phase


@dataclass(frozen=True, eq=False)
class _Readings:
    """Readings of one group; see `LedPixels`. `lines` are those of the readings of an LED that sends, else None."""

    cells: Ints
    pixel_counts: Floats
    electrons: Floats
    background: Floats
    face: Floats
    uniform_light: Floats
    lines: Ints | None = None


@dataclass(frozen=True, eq=False)
class LedsInView:
    """LEDs of the map whose images overlap the regions read out, under a state of them; see `leds_in_view`.

    `index` (n,) is the number of each in the map. `more` says whether there may be others, whose images the state does
    not determine well enough.
    """

    leds: tuple[Led, ...]
    index: Ints
    state: ImageState
    footprints: LedFootprints
    more: bool


def gather_led_pixels(frame: DeviceFrame, view: LedsInView, parameters: Ints = POSE_ALONE) -> LedPixels:
    """Readings of LEDs in view; `parameters` are those that the derivatives of their images are by.

    Left out are saturated pixels, and pixels that another LED of the map illuminates as well. LEDs with a mostly
    saturated image are left out unless all are: the location of an edge depends on the amplitude, which the unsaturated
    rim alone determines poorly. Raises EstimationFailure if no reading is left.
    """
    leds, state, footprints = view.leds, view.state, view.footprints
    lens = LensBlur(frame.camera, footprints.defocus_depth_m)
    rois = _rois(frame, footprints, EDGE_PX + lens.radius_px)
    model = LedImageModel(leds, footprints, frame.camera, lens, rois)
    rendered = model.render(state, parameters)
    with np.errstate(all="ignore"):
        share_of_cells = np.nan_to_num(rendered.light / model.fall_off)
    shares = [rois.roi(share_of_cells, k) for k in range(len(leds))]
    masks = [_edge_and_lit(share) for share in shares]
    readings = _readings(frame, rois)
    saturated = np.array([_mostly_saturated(share, known) for share, (_, known) in zip(shares, readings, strict=True)])
    groups: list[_Readings] = []
    led_of_group: list[int] = []
    for k in range(len(leds)):
        electrons, known = readings[k]
        if saturated[k] and not saturated.all():
            continue
        for other in rois.meeting(rois, k):
            if other == k:
                continue
            own_slices, other_slices = rois.intersection(k, rois, other)
            known[own_slices] &= ~masks[other].lit[other_slices]
        rows = np.arange(rois.rows[k], rois.rows[k] + rois.heights[k])[:, None]
        columns = np.arange(rois.columns[k], rois.columns[k] + rois.widths[k])
        (au, av), (bu, bv) = footprints.to_face[k].tolist()
        u, v = footprints.centre[k].tolist()
        du, dv = columns + 0.5 - u, rows + 0.5 - v
        lines = _lines(frame, leds[k], rows, columns)
        position = _FacePixels(au * du + av * dv, bu * du + bv * dv, rois.roi(model.fall_off, k))
        edge, inside = known & masks[k].edge & masks[k].near, known & ~masks[k].edge & (shares[k] > 0.5)
        for of_colour in _colours(frame, rows, columns):
            of_edge = edge & of_colour
            row, column = np.nonzero(of_edge)
            if len(row) == 0:
                continue
            cells = rois.cell(np.full(len(row), k), row + rois.rows[k], column + rois.columns[k])
            groups.append(_group(position, electrons, cells, of_edge, inside & of_colour, lines))
            led_of_group.append(k)
    if not groups:
        raise EstimationFailure("fit", "no pixel of the LEDs in view is usable: all are saturated or overlap others")
    inside_steady = (
        (electrons, known & (share > 1 - UNIFORM_TOLERANCE))
        for led, share, (electrons, known) in zip(leds, shares, readings, strict=True)
        if led.id not in frame.gains
    )
    counts = np.array([len(group.electrons) for group in groups])
    starts = np.concatenate([[0], np.cumsum(counts)])
    edges = np.concatenate([first + np.arange(len(g.cells)) for first, g in zip(starts.tolist(), groups, strict=False)])

    def joined(name: str) -> Floats:
        return np.concatenate([getattr(group, name) for group in groups])

    return LedPixels(
        leds=leds,
        index=view.index,
        model=model,
        state=state,
        rendered=rendered,
        edges=edges,
        cells=np.concatenate([group.cells for group in groups]),
        pixel_counts=joined("pixel_counts"),
        electrons=joined("electrons"),
        background=joined("background"),
        face=joined("face"),
        uniform_light=joined("uniform_light"),
        starts=starts,
        led=np.array(led_of_group),
        radius_px=(footprints.high - footprints.low).max(axis=1) / 2,
        max_move_px=EDGE_PX - 1,
        more=view.more,
        excess_e2=excess_noise_e2(inside_steady, frame.sensor),
        gains=_gains(frame, [leds[k] for k in led_of_group], groups, starts),
    )


def _lines(frame: DeviceFrame, led: Led, rows: Ints, columns: Ints) -> Ints | None:
    """Lines of a region's pixels, (rows, columns), of an LED that sends; None for a steady one."""
    if led.id not in frame.gains:
        return None
    u, v = np.broadcast_arrays(columns + 0.5, rows + 0.5)
    return np.floor(frame.camera.line_of(u, v)).astype(np.int64)


def _gains(frame: DeviceFrame, leds: Sequence[Led], groups: Sequence[_Readings], starts: Ints) -> ReadingGains | None:
    """Gains of the readings of groups, whose LEDs are `leds`; None where all are steady."""
    if all(group.lines is None for group in groups):
        return None
    lines = [np.zeros(len(group.electrons)) if group.lines is None else group.lines for group in groups]
    return ReadingGains(tuple(frame.gains.get(led.id) for led in leds), np.concatenate(lines).astype(float), starts)


@dataclass(frozen=True, eq=False)
class _FacePixels:
    """A region's pixels, (rows, columns): coordinates `a`, `b` on the face, and the lens's fall-off."""

    a: Floats
    b: Floats
    fall_off: Floats


def _group(
    pixels: _FacePixels,
    electrons: Floats,
    cells: Ints,
    edge: Mask,
    inside: Mask,
    lines: Ints | None,
) -> _Readings:
    """Readings of the edge pixels and of blocks of the pixels inside the face, both given by masks (rows, columns).

    `lines` (rows, columns) are those of the pixels where the LED sends.
    """
    a, b, fall_off = pixels.a[edge], pixels.b[edge], pixels.fall_off[edge]
    r2 = a * a + b * b
    background = np.stack([fall_off * basis for basis in (np.ones(len(a)), a, b, r2)], axis=1)
    face = np.stack([a, b, r2 - 0.5], axis=1)
    count = np.ones(len(a))
    light = np.zeros(len(a))
    a, b, fall_off = (values[inside] for values in vars(pixels).values())
    r2 = a * a + b * b
    tile = np.clip((a + 1) * (BLOCKS / 2), 0, BLOCKS - 1).astype(np.int64) * BLOCKS
    tile += np.clip((b + 1) * (BLOCKS / 2), 0, BLOCKS - 1).astype(np.int64)
    first_line = 0
    if lines is not None and len(tile):
        lines_inside = lines[inside]
        first_line = int(lines_inside.min())
        tile += BLOCKS**2 * (lines_inside - first_line)
    pixels_in = np.bincount(tile)
    blocks = np.flatnonzero(pixels_in)

    def summed(values: Floats) -> Floats:
        return np.asarray(np.bincount(tile, values)[blocks], dtype=np.float64)

    sums = np.stack([summed(fall_off * basis) for basis in (np.ones(len(a)), a, b, r2)], axis=1)
    mean = sums[:, 1:] / sums[:, :1]
    return _Readings(
        cells=cells,
        pixel_counts=np.concatenate([count, pixels_in[blocks]]),
        electrons=np.concatenate([electrons[edge], summed(electrons[inside])]),
        background=np.concatenate([background, sums]),
        face=np.concatenate([face, mean - [0.0, 0.0, 0.5]]),
        uniform_light=np.concatenate([light, sums[:, 0]]),
        lines=None if lines is None else np.concatenate([lines[edge], first_line + blocks // BLOCKS**2]),
    )


def leds_in_view(
    frame: DeviceFrame, state: ImageState, covariance: Floats, sigma_m: Floats, located: Mask
) -> LedsInView:
    """LEDs of the map, n in all, that are in view under a state of them.

    Left out are LEDs of unknown gains, and those whose image is not determined to MAX_IMAGE_SIGMA_PX by the pose, of
    covariance (6, 6), or (12, 12) with that of the velocity for a rolling shutter, and by their own position, of
    standard deviation `sigma_m` (n,), but for those whose image is `located` (n,). Raises EstimationFailure if none is
    left.
    """
    low, high = _read_out(frame)
    leds = tuple(frame.leds.values())
    centres_m = np.array([led.position_m for led in leds]) + state.shifts_m
    centres = state.project(centres_m)
    half_widths_m = np.array([led.half_width_m for led in leds])
    with np.errstate(invalid="ignore"):
        # The image moves with the camera as much as a point of the face moves it from its centre.
        scale = np.linalg.norm(centres.slopes[:, :, :3], axis=(1, 2))
        extent_px = (MAX_EXTENT * half_widths_m * scale)[:, None]
        near = ((centres.pixels > low - extent_px) & (centres.pixels < high + extent_px)).all(axis=1)
    unknown = frame.unknown_gains
    candidates = np.flatnonzero(near & [led.id not in unknown for led in leds])
    if len(candidates) == 0:
        raise EstimationFailure("fit", NO_GAINS if near.any() else NONE_IN_VIEW)
    footprints = led_footprints([leds[k] for k in candidates], state.of(candidates))
    slopes = centres.slopes[candidates]
    if centres.motion_slopes is not None:
        slopes = np.concatenate([slopes, centres.motion_slopes[candidates]], axis=2)
    with np.errstate(invalid="ignore"):
        in_view = footprints.whole & (footprints.high > low).all(axis=1) & (footprints.low < high).all(axis=1)
        variance_px2 = ((slopes @ covariance) * slopes).sum(axis=(1, 2)) + (sigma_m * scale)[candidates] ** 2
        chosen = in_view & ((variance_px2 < MAX_IMAGE_SIGMA_PX**2) | located[candidates])
    if not in_view.any():
        raise EstimationFailure("fit", NONE_IN_VIEW)
    if not chosen.any():
        sigma_px = float(np.sqrt(variance_px2[in_view].min()))
        raise EstimationFailure(
            "fit",
            f"LEDs of the map in view: {in_view.sum()}, but the best known image to {sigma_px:.1f} px only, "
            f"needed {MAX_IMAGE_SIGMA_PX} px",
        )
    index = candidates[chosen]
    used = tuple(leds[k] for k in index)
    return LedsInView(used, index, state.of(index), footprints.of(chosen), bool((in_view & ~chosen).any()))


def _read_out(frame: DeviceFrame) -> tuple[Ints, Ints]:
    """Bounding box of all parts: first pixel (u, v), and the pixel after the last."""
    first = [(part.column, part.row) for part in frame.parts]
    end = [(part.column + part.image_dn.shape[1], part.row + part.image_dn.shape[0]) for part in frame.parts]
    return np.min(first, axis=0), np.max(end, axis=0)


def _rois(frame: DeviceFrame, footprints: LedFootprints, margin_px: int) -> RoiStack:
    """Regions of interest around the footprints with a margin, within the pixels read out."""
    low, high = _read_out(frame)
    first = np.maximum(np.floor(footprints.low).astype(np.int64) - margin_px, low)
    end = np.minimum(np.ceil(footprints.high).astype(np.int64) + margin_px, high)
    return RoiStack(first[:, 1], first[:, 0], end[:, 1] - first[:, 1], end[:, 0] - first[:, 0])


@dataclass(frozen=True, eq=False)
class _Masks:
    """Pixels of a region: `edge` may be partly lit by the LED while its image moves by EDGE_PX, `lit` may be lit at
    all, `near` are at most NEAR_PX beyond the pixels that it lights.
    """

    edge: Mask
    lit: Mask
    near: Mask


def _edge_and_lit(share: Floats) -> _Masks:
    """Masks of a region by the LED's share of each pixel's light, (rows, columns)."""
    lit = share > UNIFORM_TOLERANCE
    partly_lit = lit & (share < 1 - UNIFORM_TOLERANCE)
    edge, near_lit, near = (
        cv2.dilate(mask.view(np.uint8), np.ones((2 * px + 1, 2 * px + 1), dtype=np.uint8)).view(bool)
        for mask, px in ((partly_lit, EDGE_PX), (lit, EDGE_PX), (lit, NEAR_PX))
    )
    return _Masks(edge, near_lit, near)


def _readings(frame: DeviceFrame, rois: RoiStack) -> list[tuple[Floats, Mask]]:
    """Electrons in each region, (rows, columns), and which of them are known: read out and not saturated."""
    shapes = zip(rois.heights.tolist(), rois.widths.tolist(), strict=True)
    readings = [(np.zeros(shape), np.zeros(shape, dtype=bool)) for shape in shapes]
    first = np.array([(part.row, part.column) for part in frame.parts])
    parts = RoiStack(*first.T, *np.array([part.image_dn.shape for part in frame.parts]).T)
    for k, (electrons, known) in enumerate(readings):
        for number in parts.meeting(rois, k):
            part = frame.parts[number]
            source, target = parts.intersection(number, rois, k)
            piece = Part(0, 0, part.image_dn[source])
            electrons[target] = frame.electrons(piece)
            known[target] = ~frame.clipped(piece)
    return readings


def _mostly_saturated(share: Floats, known: Mask) -> bool:
    """Whether an LED image has pixels inside, and less than MIN_KNOWN_SHARE of them are known."""
    inside = share > 1 - UNIFORM_TOLERANCE
    return bool(inside.any() and not known[inside].mean() > MIN_KNOWN_SHARE)


def _colours(frame: DeviceFrame, rows: Ints, columns: Ints) -> list[Mask]:
    """Masks of a region's pixels by site of the 2 x 2 mosaic; one mask of all pixels without a mosaic."""
    if frame.sensor.mosaic == "none":
        return [np.ones((1, 1), dtype=bool)]
    return [(rows % 2 == site // 2) & (columns % 2 == site % 2) for site in range(4)]
