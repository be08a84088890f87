"""Pixel readings of LED images: edge pixels one by one, uniform pixels inside and around an LED image as sums.

The sum of Poisson variables is a sufficient statistic of a common mean, so the uniform pixels of an LED's face, and
those of the background around it, need not be read one by one.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import Pose
from estimator.camera.projection import project
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame, Led, Part
from estimator.pixels.led_model import LedFootprints, LedImageModel, RenderedLeds, led_footprints
from estimator.pixels.polygon_raster import RoiStack
from estimator.pixels.psf import LensBlur

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

# An image may move by nearly this much before its pixels have to be sorted into edge, inside and background again.
EDGE_PX = 2
# Width of the background ring around the edge: the ambient light changes little over it.
RING_PX = 8
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
    """Readings around n LEDs, m in all: the first e are edge pixels, the rest are sums over uniform pixels.

    A group of readings has a common amplitude and background: an LED, or an LED's pixels of one colour; there are g.

    `model` is the image model of the LEDs, `pose` the pose that the pixels were sorted by, `rendered` the images there.
    `cells` (e,) are the edge pixels' cells in `model.rois`. `weights` (e,) is the relative illumination of an edge
    pixel, 1 at the LED image's centre. `pixel_counts` (m,) is the number of pixels of a reading, `electrons` (m,) their
    sum. `uniform_light` (m - e,) is the light of a full pixel summed over uniform pixels, which does not depend on the
    pose. `group` (m,) is the group of each reading, ascending over edge pixels; `first_edge` (g,) the first edge pixel
    of each group, which has at least one; `led` (g,) the LED of each group, an index to `leds`. `more` says whether
    other LEDs of the map may be in view, whose images the pose does not determine well enough.
    """

    leds: tuple[Led, ...]
    model: LedImageModel
    pose: Pose
    rendered: RenderedLeds
    cells: Ints
    weights: Floats
    pixel_counts: Floats
    electrons: Floats
    uniform_light: Floats
    group: Ints
    first_edge: Ints
    led: Ints
    more: bool

    def sum_by_group(self, values: Floats) -> Floats:
        """Sums over each group, (..., g), of values (..., m) of all readings, or (..., e) of edge pixels alone."""
        edges = len(self.cells)
        sums = np.add.reduceat(values[..., :edges], self.first_edge, axis=-1)
        if values.shape[-1] > edges:
            np.add.at(sums.T, self.group[edges:], values[..., edges:].T)  # along the last axis
        return np.asarray(sums)


def gather_led_pixels(frame: DeviceFrame, pose: Pose, covariance: Floats) -> LedPixels:
    """Readings of the LEDs of the map that are in view from a pose with a covariance (6, 6) of its parameters.

    Left out are LEDs whose image is not determined to MAX_IMAGE_SIGMA_PX, saturated pixels, and pixels that another LED
    of the map illuminates as well. LEDs with a mostly saturated image are left out unless all are: the location of an
    edge depends on the amplitude, which the unsaturated rim alone determines poorly. Raises EstimationFailure if no
    reading is left.
    """
    leds, footprints, more = _leds_in_view(frame, pose, covariance)
    lens = LensBlur(frame.camera, footprints.defocus_depth_m)
    rois = _rois(frame, footprints, EDGE_PX + RING_PX + lens.radius_px)
    model = LedImageModel(leds, footprints, frame.camera, lens, rois)
    rendered = model.render(pose)
    shares = [rois.roi(rendered.share, k) for k in range(len(leds))]
    masks = [_edge_and_lit(share) for share in shares]
    readings = [_readings(frame, rois, k) for k in range(len(leds))]
    saturated = np.array([_mostly_saturated(share, known) for share, (_, known) in zip(shares, readings, strict=True)])
    edges: list[tuple[Ints, Floats, Floats]] = []
    sums: list[tuple[int, float, float, float]] = []
    led_of_group: list[int] = []
    for k in range(len(leds)):
        electrons, known = readings[k]
        if saturated[k] and not saturated.all():
            continue
        for other in rois.overlapping(k):
            own_slices, other_slices = rois.intersection(k, other)
            known[own_slices] &= ~masks[other][1][other_slices]
        rows = np.arange(rois.rows[k], rois.rows[k] + rois.heights[k])[:, None]
        columns = np.arange(rois.columns[k], rois.columns[k] + rois.widths[k])
        (slope_u, slope_v), (u, v) = footprints.illumination_slope[k].tolist(), footprints.centre[k].tolist()
        weights = (1 + slope_u * (columns + 0.5 - u)) + slope_v * (rows + 0.5 - v)
        light = shares[k] * weights
        edge_mask = masks[k][0]
        for of_colour in _colours(frame, rows, columns):
            use = known & of_colour
            row, column = np.nonzero(use & edge_mask)
            if len(row) == 0:
                continue
            cells = rois.cell(np.full(len(row), k), row + rois.rows[k], column + rois.columns[k])
            edges.append((cells, weights[row, column], electrons[row, column]))
            use &= ~edge_mask
            inside = use & (shares[k] > 0.5)
            for uniform in (inside, use & ~inside):
                if uniform.any():
                    sum_e, sum_light = float(electrons[uniform].sum()), float(light[uniform].sum())
                    sums.append((len(led_of_group), float(uniform.sum()), sum_e, sum_light))
            led_of_group.append(k)
    if not edges:
        raise EstimationFailure("fit", "no LED of the map is in view")
    cells, weights, electrons = (np.concatenate(column) for column in zip(*edges, strict=True))
    counts = np.array([len(edge[0]) for edge in edges])
    sum_group, sum_pixels, sum_electrons, sum_of_light = np.array(sums).reshape(-1, 4).T
    return LedPixels(
        leds=leds,
        model=model,
        pose=pose,
        rendered=rendered,
        cells=cells,
        weights=weights,
        pixel_counts=np.concatenate([np.ones(len(cells)), sum_pixels]),
        electrons=np.concatenate([electrons, sum_electrons]),
        uniform_light=sum_of_light,
        group=np.concatenate([np.repeat(np.arange(len(counts)), counts), sum_group.astype(np.int64)]),
        first_edge=np.cumsum(counts) - counts,
        led=np.array(led_of_group),
        more=more,
    )


def _leds_in_view(frame: DeviceFrame, pose: Pose, covariance: Floats) -> tuple[tuple[Led, ...], LedFootprints, bool]:
    """LEDs of the map whose images overlap the regions read out, their footprints, and whether there may be more."""
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
        raise EstimationFailure("fit", "no LED of the map is in view")
    footprints = led_footprints([leds[k] for k in candidates], pose, frame.camera)
    slopes = centres.slopes[candidates]
    with np.errstate(invalid="ignore"):
        in_view = np.isfinite(footprints.illumination_slope).all(axis=1)
        in_view &= (footprints.high > low).all(axis=1) & (footprints.low < high).all(axis=1)
        certain = ((slopes @ covariance) * slopes).sum(axis=(1, 2)) < MAX_IMAGE_SIGMA_PX**2
    if not (in_view & certain).any():
        raise EstimationFailure("fit", "no LED of the map is in view")
    chosen = tuple(leds[k] for k in candidates[in_view & certain])
    return chosen, footprints.of(in_view & certain), bool((in_view & ~certain).any())


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


def _edge_and_lit(share: Floats) -> tuple[Mask, Mask]:
    """Pixels that may be partly lit by an LED while its image moves by EDGE_PX, and those that may be lit at all."""
    lit = share > UNIFORM_TOLERANCE
    partly_lit = lit & (share < 1 - UNIFORM_TOLERANCE)
    size = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), dtype=np.uint8)
    edge, near_lit = (cv2.dilate(mask.astype(np.uint8), size).astype(bool) for mask in (partly_lit, lit))
    return edge, near_lit


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
