"""Pixel readings of LED images: edge pixels one by one, uniform pixels inside and around an LED image as sums.

The sum of Poisson variables is a sufficient statistic of a common mean, so the uniform pixels of an LED's face, and
those of the background around it, need not be read one by one: each block of them is one reading. Its expectation is
exact, a sum over its pixels.
"""

from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import Pose
from estimator.camera.projection import project
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame, Led, Part
from estimator.pixels.led_model import ImageState, LedFootprints, LedImageModel, RenderedLeds, led_footprints
from estimator.pixels.polygon_raster import RoiStack
from estimator.pixels.psf import LensBlur

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

# An image may move by nearly this much before its pixels have to be sorted into edge, inside and background again.
EDGE_PX = 2
# The background of the edge pixels is that of pixels up to NEAR_PX beyond them. Further off it may be another surface: a
# frame around the luminaire, the panel that LEDs are mounted on, the ceiling beyond it.
NEAR_PX = 1
# Width of the background ring around the edge.
RING_PX = 0
# Blocks of the uniform pixels of a face along each axis, and sectors of the ring, each summed for a reading: the light
# changes little over a block.
BLOCKS = 6
SECTORS = 12
# A pixel whose share of an LED's light is within this of 0 or 1 is uniform.
UNIFORM_TOLERANCE = 1e-3
# An LED is used once the pose determines its image to this, one standard deviation.
MAX_IMAGE_SIGMA_PX = 0.5
# Share of the pixels inside an LED image that have to be known: read out and not saturated.
MIN_KNOWN_SHARE = 0.5
# Extent of an LED image in half widths: 1.4 for a square's vertex, and the scale of a tilted view varies over a face.
MAX_EXTENT = 3.0


@dataclass(frozen=True, eq=False)
class LedPixels:
    """Readings around n LEDs, m in all: edge pixels, and sums over blocks of uniform pixels.

    A group of readings has a common amplitude and background: an LED, or an LED's pixels of one colour; there are g.
    The readings of a group follow each other, from `starts[k]` to `starts[k + 1]`, (g + 1,); each group has an edge
    pixel. `led` (g,) is the LED of each group, an index to `leds`.

    `model` is the image model of the LEDs, `state` the state that the pixels were sorted by, `rendered` the images
    there. `edges` (e,) are the readings that are edge pixels, `cells` (e,) their cells in `model.rois`. `pixel_counts`
    (m,) is the number of pixels of a reading, `electrons` (m,) their sum.

    With the coordinates (a, b) of a pixel on the face, in half widths from its centre: `background` (m, 5) is the
    lens's fall-off times 1, a, b, a^2 + b^2, and 1 for pixels far from the face; `face` (m, 3) is the mean of a, b and
    a^2 + b^2 - 1/2 over the LED's light.
    `uniform_light` (m,) is the light inside the LED image summed over the pixels of a reading, 0 for edge pixels, whose
    light depends on the state. `more` says whether other LEDs of the map may be in view, whose images the state does
    not determine well enough.
    """

    leds: tuple[Led, ...]
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
    more: bool

    @property
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
class _Readings:
    """Readings of one group; see `LedPixels`."""

    cells: Ints
    pixel_counts: Floats
    electrons: Floats
    background: Floats
    face: Floats
    uniform_light: Floats


@dataclass(frozen=True, eq=False)
class LedsInView:
    """LEDs of the map whose images overlap the regions read out, under a state of them; see `leds_in_view`.

    `more` says whether there may be others, whose images the state does not determine well enough.
    """

    leds: tuple[Led, ...]
    state: ImageState
    footprints: LedFootprints
    more: bool


def gather_led_pixels(frame: DeviceFrame, view: LedsInView) -> LedPixels:
    """Readings of LEDs in view.

    Left out are saturated pixels, and pixels that another LED of the map illuminates as well. LEDs with a mostly
    saturated image are left out unless all are: the location of an edge depends on the amplitude, which the unsaturated
    rim alone determines poorly. Raises EstimationFailure if no reading is left.
    """
    leds, state, footprints = view.leds, view.state, view.footprints
    lens = LensBlur(frame.camera, footprints.defocus_depth_m)
    rois = _rois(frame, footprints, EDGE_PX + RING_PX + lens.radius_px)
    model = LedImageModel(leds, footprints, frame.camera, lens, rois)
    rendered = model.render(state)
    fall_offs = [rois.roi(model.fall_off, k) for k in range(len(leds))]
    with np.errstate(all="ignore"):
        shares = [np.nan_to_num(rois.roi(rendered.light, k) / fall_offs[k]) for k in range(len(leds))]
    masks = [_edge_and_lit(share) for share in shares]
    readings = [_readings(frame, rois, k) for k in range(len(leds))]
    saturated = np.array([_mostly_saturated(share, known) for share, (_, known) in zip(shares, readings, strict=True)])
    groups: list[_Readings] = []
    led_of_group: list[int] = []
    for k in range(len(leds)):
        electrons, known = readings[k]
        if saturated[k] and not saturated.all():
            continue
        for other in rois.overlapping(k):
            own_slices, other_slices = rois.intersection(k, other)
            known[own_slices] &= ~masks[other].lit[other_slices]
        rows = np.arange(rois.rows[k], rois.rows[k] + rois.heights[k])[:, None]
        columns = np.arange(rois.columns[k], rois.columns[k] + rois.widths[k])
        (au, av), (bu, bv) = footprints.to_face[k].tolist()
        u, v = footprints.centre[k].tolist()
        du, dv = columns + 0.5 - u, rows + 0.5 - v
        position = _FacePixels(au * du + av * dv, bu * du + bv * dv, fall_offs[k], shares[k] > 0.5, masks[k].far)
        for of_colour in _colours(frame, rows, columns):
            row, column = np.nonzero(known & of_colour & masks[k].edge)
            if len(row) == 0:
                continue
            cells = rois.cell(np.full(len(row), k), row + rois.rows[k], column + rois.columns[k])
            row_u, column_u = np.nonzero(known & of_colour & ~masks[k].edge)
            groups.append(_group(position, electrons, cells, (row, column), (row_u, column_u)))
            led_of_group.append(k)
    if not groups:
        raise EstimationFailure("fit", "no pixel of the LEDs in view is usable: all are saturated or overlap others")
    counts = np.array([len(group.electrons) for group in groups])
    starts = np.concatenate([[0], np.cumsum(counts)])
    edges = np.concatenate([first + np.arange(len(g.cells)) for first, g in zip(starts.tolist(), groups, strict=False)])

    def joined(name: str) -> Floats:
        return np.concatenate([getattr(group, name) for group in groups])

    return LedPixels(
        leds=leds,
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
        more=view.more,
    )


@dataclass(frozen=True, eq=False)
class _FacePixels:
    """A region's pixels, (rows, columns): coordinates `a`, `b` on the face, the lens's fall-off, and whether a
    pixel is inside, or far (see `_Masks`).
    """

    a: Floats
    b: Floats
    fall_off: Floats
    inside: Mask
    far: Mask


def _group(
    pixels: _FacePixels, electrons: Floats, cells: Ints, edge: tuple[Ints, Ints], uniform: tuple[Ints, Ints]
) -> _Readings:
    """Readings of the edge pixels and of blocks of the uniform pixels, both given by (row, column)."""
    a, b, fall_off = pixels.a[edge], pixels.b[edge], pixels.fall_off[edge]
    r2 = a * a + b * b
    background = np.stack([fall_off * basis for basis in (np.ones(len(a)), a, b, r2, pixels.far[edge])], axis=1)
    face = np.stack([a, b, r2 - 0.5], axis=1)
    count = np.ones(len(a))
    light = np.zeros(len(a))
    a, b, fall_off, inside, far = (values[uniform] for values in vars(pixels).values())
    r2 = a * a + b * b
    # Blocks: the face in BLOCKS x BLOCKS, the ring in sectors.
    tile = np.clip(np.floor((a + 1) * BLOCKS / 2), 0, BLOCKS - 1) * BLOCKS
    tile += np.clip(np.floor((b + 1) * BLOCKS / 2), 0, BLOCKS - 1)
    sector = np.floor((np.arctan2(b, a) / np.pi + 1) / 2 * SECTORS) % SECTORS
    _, block = np.unique(np.where(inside, tile, BLOCKS**2 + sector), return_inverse=True)
    blocks = int(block.max()) + 1 if len(block) else 0

    def summed(values: Floats) -> Floats:
        return np.asarray(np.bincount(block, values, blocks), dtype=np.float64)

    sums = [summed(fall_off * basis) for basis in (np.ones(len(a)), a, b, r2, far)]
    lit = summed(inside.astype(float)) > 0
    mean = [np.divide(one, sums[0], out=np.zeros(blocks), where=lit & (sums[0] > 0)) for one in sums[1:4]]
    return _Readings(
        cells=cells,
        pixel_counts=np.concatenate([count, summed(np.ones(len(a)))]),
        electrons=np.concatenate([electrons[edge], summed(electrons[uniform])]),
        background=np.concatenate([background, np.stack(sums, axis=1)]),
        face=np.concatenate([face, np.stack([mean[0], mean[1], np.where(lit, mean[2] - 0.5, 0.0)], axis=1)]),
        uniform_light=np.concatenate([light, np.where(lit, sums[0], 0.0)]),
    )


def leds_in_view(
    frame: DeviceFrame, pose: Pose, covariance: Floats, found: Collection[int] = frozenset()
) -> LedsInView:
    """LEDs of the map that are in view from a pose with a covariance (6, 6) of its parameters.

    Left out are LEDs whose image is not determined to MAX_IMAGE_SIGMA_PX, but for those `found` before, by id. Raises
    EstimationFailure if none is left.
    """
    low, high = _read_out(frame)
    leds = tuple(frame.leds.values())
    centres = project(np.array([led.position_m for led in leds]), pose, frame.camera)
    half_widths_m = np.array([led.half_width_m for led in leds])
    with np.errstate(invalid="ignore"):
        # The image moves with the camera as much as a point of the face moves it from its centre.
        scale = np.linalg.norm(centres.slopes[:, :, :3], axis=(1, 2))
        extent_px = (MAX_EXTENT * half_widths_m * scale)[:, None]
        near = ((centres.pixels > low - extent_px) & (centres.pixels < high + extent_px)).all(axis=1)
    candidates = np.flatnonzero(near)
    if len(candidates) == 0:
        raise EstimationFailure("fit", "no LED of the map is in view from the pose of the spots")
    near_leds = [leds[k] for k in candidates]
    footprints = led_footprints(near_leds, ImageState.as_told(pose, frame.camera, len(near_leds)))
    slopes = centres.slopes[candidates]
    with np.errstate(invalid="ignore"):
        in_view = footprints.whole & (footprints.high > low).all(axis=1) & (footprints.low < high).all(axis=1)
        certain = ((slopes @ covariance) * slopes).sum(axis=(1, 2)) < MAX_IMAGE_SIGMA_PX**2
    certain |= np.array([led.id in found for led in near_leds])
    if not in_view.any():
        raise EstimationFailure("fit", "no LED of the map is in view from the pose of the spots")
    if not (in_view & certain).any():
        raise EstimationFailure(
            "fit", f"LEDs of the map in view: {in_view.sum()}, none with an image known to {MAX_IMAGE_SIGMA_PX} px"
        )
    chosen = in_view & certain
    used = tuple(led for led, use in zip(near_leds, chosen, strict=True) if use)
    state = ImageState.as_told(pose, frame.camera, len(used))
    return LedsInView(used, state, footprints.of(chosen), bool((in_view & ~certain).any()))


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
    all, `far` are more than NEAR_PX beyond the pixels that it lights.
    """

    edge: Mask
    lit: Mask
    far: Mask


def _edge_and_lit(share: Floats) -> _Masks:
    """Masks of a region by the LED's share of each pixel's light, (rows, columns)."""
    lit = share > UNIFORM_TOLERANCE
    partly_lit = lit & (share < 1 - UNIFORM_TOLERANCE)
    edge, near_lit, near = (
        cv2.dilate(mask.astype(np.uint8), np.ones((2 * px + 1, 2 * px + 1), dtype=np.uint8)).astype(bool)
        for mask, px in ((partly_lit, EDGE_PX), (lit, EDGE_PX), (lit, NEAR_PX))
    )
    return _Masks(edge, near_lit, ~near)


def _readings(frame: DeviceFrame, rois: RoiStack, k: int) -> tuple[Floats, Mask]:
    """Electrons in region k, (rows, columns), and which of them are known: read out and not saturated."""
    top, left = int(rois.rows[k]), int(rois.columns[k])
    bottom, right = top + int(rois.heights[k]), left + int(rois.widths[k])
    electrons, known = np.zeros((bottom - top, right - left)), np.zeros((bottom - top, right - left), dtype=bool)
    for part in frame.parts:
        height, width = part.image_dn.shape
        v0, v1 = max(top, part.row), min(bottom, part.row + height)
        u0, u1 = max(left, part.column), min(right, part.column + width)
        if v0 < v1 and u0 < u1:
            piece = Part(v0, u0, part.image_dn[v0 - part.row : v1 - part.row, u0 - part.column : u1 - part.column])
            target = np.s_[v0 - top : v1 - top, u0 - left : u1 - left]
            electrons[target] = frame.electrons(piece)
            known[target] = ~frame.clipped(piece)
    return electrons, known


def _mostly_saturated(share: Floats, known: Mask) -> bool:
    """Whether an LED image has pixels inside, and less than MIN_KNOWN_SHARE of them are known."""
    inside = share > 1 - UNIFORM_TOLERANCE
    return bool(inside.any() and not known[inside].mean() > MIN_KNOWN_SHARE)


def _colours(frame: DeviceFrame, rows: Ints, columns: Ints) -> list[Mask]:
    """Masks of a region's pixels by site of the 2 x 2 mosaic; one mask of all pixels without a mosaic."""
    if frame.sensor.mosaic == "none":
        return [np.ones((1, 1), dtype=bool)]
    return [(rows % 2 == site // 2) & (columns % 2 == site % 2) for site in range(4)]
