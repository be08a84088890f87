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

import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compiled
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame, LineGains
from estimator.io.led_map import Led, led_arrays
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
from estimator.pixels.readings import (
    EDGE_PX,
    UNIFORM_TOLERANCE,
    Faces,
    Readings,
    known_shares,
    read,
    sorted_pixels,
)
from estimator.spots.excess_noise import excess_noise_e2
from estimator.spots.lamps import readouts_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

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
class LedPixels(Readings):
    """Readings around n LEDs, and the model of their images. The regions of the readings are the LEDs, in order.

    `index` (n,) is the number of each LED in the map, `model` the image model of the LEDs, `state` the state that the
    pixels were sorted by, `rendered` the images there; the cells are those of `model.rois`. `radius_px` (n,) is half
    the larger side of an LED image's bounding box. Images may move by `max_move_px` before their pixels have to be
    sorted anew. `more` says whether other LEDs of the map may be in view, whose images the state does not determine
    well enough. `excess_e2` is the variance of a pixel beside that which the device states
    (`estimator.spots.excess_noise`). `gains` are those of the readings where an LED sends, None where all are steady.
    """

    leds: tuple[Led, ...]
    index: Ints
    model: LedImageModel
    state: ImageState
    rendered: RenderedLeds
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

    def brightness(self, profile: Floats) -> Floats:
        """Mean luminance (m,) over the face of the pixels of each reading, 1 at the centre, by profiles (n, 3)."""
        return _brightness(self.starts, self.led, self.face, profile)

    def light(self, rendered: RenderedLeds) -> Floats:
        """Light (m,) of each reading, in that of a pixel at the LED image's centre."""
        light = self.uniform_light.copy()
        light[self.edges] = rendered.light[self.cells]
        return light


@compiled
def _brightness(starts: Ints, led: Ints, face: Floats, profile: Floats) -> Floats:
    """See `LedPixels.brightness`."""
    brightness = np.ones(len(face))
    for g in range(len(led)):
        for i in range(starts[g], starts[g + 1]):
            for k in range(face.shape[1]):
                brightness[i] += face[i, k] * profile[led[g], k]
    return brightness


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
    pixels = sorted_pixels(rois, rendered.light, model.fall_off)
    electrons, known = _readings(frame, rois)
    known_share = known_shares(pixels.share, known, rois.heights, rois.widths, rois.starts)
    saturated = ~(known_share > MIN_KNOWN_SHARE)
    left_out = saturated & ~saturated.all()
    own, other = rois.meeting(rois)
    beside = (own != other) & ~left_out[own]
    own, other = own[beside], other[beside]
    for k, its, (here, there) in zip(own.tolist(), other.tolist(), rois.intersections(own, rois, other), strict=True):
        rois.roi(known, k)[here] &= ~rois.roi(pixels.lit, its)[there]
    lines = _lines(frame, leds, rois)
    edge, inside = known & pixels.edge & pixels.near, known & ~pixels.edge & (pixels.share > 0.5)
    faces = Faces(footprints.centre, footprints.to_face, model.fall_off)
    for k in np.flatnonzero(left_out).tolist():
        rois.roi(edge, k)[:] = rois.roi(inside, k)[:] = False
    readings = read(rois, faces, electrons, edge, inside, lines, 1 if frame.sensor.mosaic == "none" else 4)
    if len(readings.led) == 0:
        raise EstimationFailure("fit", "no pixel of the LEDs in view is usable: all are saturated or overlap others")
    wholly = known & (pixels.share > 1 - UNIFORM_TOLERANCE)
    inside_steady = (
        (rois.roi(electrons, k), rois.roi(wholly, k)) for k, led in enumerate(leds) if led.id not in frame.gains
    )
    return LedPixels(
        **vars(readings),
        leds=leds,
        index=view.index,
        model=model,
        state=state,
        rendered=rendered,
        radius_px=(footprints.high - footprints.low).max(axis=1) / 2,
        max_move_px=EDGE_PX - 1,
        more=view.more,
        excess_e2=excess_noise_e2(inside_steady, frame.sensor),
        gains=_gains(frame, leds, readings),
    )


def _lines(frame: DeviceFrame, leds: Sequence[Led], rois: RoiStack) -> Ints:
    """Lines of the cells of regions, (cells,); -1 for those of LEDs that do not send, (0,) where none does."""
    if not frame.gains:
        return np.zeros(0, dtype=np.int64)
    lines = np.full(rois.cells(), -1)
    for k, led in enumerate(leds):
        if led.id in frame.gains:
            v, u = np.mgrid[: rois.heights[k], : rois.widths[k]] + 0.5
            rois.roi(lines, k)[:] = np.floor(frame.camera.line_of(u + rois.columns[k], v + rois.rows[k]))
    return lines


def _gains(frame: DeviceFrame, leds: Sequence[Led], readings: Readings) -> ReadingGains | None:
    """Gains of the readings of groups, whose LEDs are among `leds`; None where all are steady."""
    of_group = tuple(frame.gains.get(leds[k].id) for k in readings.led)
    if all(gains is None for gains in of_group):
        return None
    return ReadingGains(of_group, readings.lines.astype(float), readings.starts)


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
    leds, arrays = tuple(frame.leds.values()), led_arrays(frame.leds)
    centres_m = arrays.positions_m + state.shifts_m
    centres = state.project(centres_m)
    with np.errstate(invalid="ignore"):
        # The image moves with the camera as much as a point of the face moves it from its centre.
        scale = np.linalg.norm(centres.slopes[:, :, :3], axis=(1, 2))
        extent_px = (MAX_EXTENT * arrays.half_widths_m * scale)[:, None]
        near = ((centres.pixels > low - extent_px) & (centres.pixels < high + extent_px)).all(axis=1)
    unknown = frame.unknown_gains
    candidates = np.array([k for k in np.flatnonzero(near).tolist() if leds[k].id not in unknown], dtype=np.int64)
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


def _readings(frame: DeviceFrame, rois: RoiStack) -> tuple[NDArray[np.float32], Mask]:
    """Electrons in the cells of regions, (cells,), and which of them are known: read out and not saturated."""
    electrons, known = np.zeros(rois.cells(), dtype=np.float32), np.zeros(rois.cells(), dtype=bool)
    readouts = readouts_of(frame)
    first = np.array([(readout.row, readout.column) for readout in readouts])
    regions = RoiStack(*first.T, *np.array([readout.raw_e.shape for readout in readouts]).T)
    numbers, own = regions.meeting(rois)
    boxes = regions.intersections(numbers, rois, own)
    for number, k, (source, target) in zip(numbers.tolist(), own.tolist(), boxes, strict=True):
        rois.roi(electrons, k)[target] = readouts[number].raw_e[source]
        np.logical_not(readouts[number].clipped[source], out=rois.roi(known, k)[target])
    return electrons, known
