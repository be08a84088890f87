"""Striped LED images: spots of modulated LEDs under a rolling shutter, each found as one, with a profile by lines.

A rolling shutter exposes the lines of a sensor one after another, so the image of an LED that is switched on and off
has bright and dark stripes across it. A pixel then holds the product of the gain of its line and of the share of the
pixel that the LED image covers. A plain centroid follows the stripes, some pixels off. Here the outline is measured:

1. Blobs above a low threshold are closed along the readout axis over the longest dark stripe (`striped_blobs`).
2. In each lit line the two edges of the LED image lie at half of the line's own plateau. An edge is measured by the
   light around it, which neither a symmetric blur nor the pixels displace (`line_edges`).
3. The edges of a disc lie on an ellipse. In line y they are `m + s (y - y0) -+ A sqrt(1 - ((y - y0) / B)^2)`, here
   averaged over the line's width. Those of a square lie on a parallelogram. The fits are weighted and robust
   (`ellipse_fit`, `parallelogram_fit`).
   A lamp without such edges, whose luminance falls off towards its rim, has isophotes (`estimator.spots.glow`).
4. The light of a line over the chord of the outline is the profile: the wave, at the times of the lines
   (`line_profile`).

In these modules, x runs along a line and y counts lines: x is u and y is v where lines are rows, x is v and y is u
where lines are columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.spots.boxes import boxes_near
from estimator.spots.detect import MAX_BLOB_OF_FRAME, Spot, brightest_of, levels_of
from estimator.spots.ellipse_fit import fit_ellipse
from estimator.spots.glow import glow
from estimator.spots.led_light import Readout
from estimator.spots.line_edges import LineEdges, edges_of
from estimator.spots.line_profile import Profile, is_striped, profile_of
from estimator.spots.outlines import EdgeEllipse, Outline, OutlineFit, moved_outline
from estimator.spots.parallelogram_fit import fit_parallelogram
from estimator.spots.striped_blobs import (
    Along,
    BlobLight,
    StripedBlob,
    TurnedRegion,
    blobs_of,
    closed_along_readout,
    light_of,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Smoothing across the lines before the threshold: lines have gains of their own and are not mixed.
SMOOTHING_PX = 5
# Edges that are blurred by more than this share of the shorter half extent are no outline.
MAX_BLUR = 0.15
# Share of the edges that a single LED image leaves at most: more are of two LED images, or of none.
MAX_OUTLIERS = 0.35
# The centre of a cut outline is this share of its larger half extent inside the region: the visible part then tells it.
# Isophotes scatter by their stripes, and end where a stripe does: docs/measure_downlink.py cut.
MIN_ARC = 0.25
MIN_FADED_ARC = 0.6
# The root mean square of the inliers' residuals of an LED image, as a share of its half extent.
MAX_RESIDUAL = 0.06


@dataclass(frozen=True, eq=False)
class Lamp:
    """A striped or steady LED image: centre of its outline, continuous pixels with pixel centres at +0.5.

    `covariance_px2` (2, 2) is the centre's, u and v. `along` says what lines are. `touches_border` marks an outline
    that may be cut by the border of its region, `measured` one whose visible part tells the centre as well as the
    covariance says: a whole one, or one whose centre is well inside the region and that is by lines that are not cut.
    `clipped` marks one with a pixel that is or may be saturated, `striped` a profile that is not constant, `uniform` a
    lamp whose outline is by edges, not isophotes. `residual_px` is the root mean square of the edges' residuals;
    `peak_e` the level of the bright lines; `brightest_px` the centre (u, v) of the brightest pixel.
    """

    u_px: float
    v_px: float
    covariance_px2: Floats
    along: Along
    outline: Outline
    profile: Profile
    residual_px: float
    peak_e: float
    touches_border: bool
    measured: bool
    clipped: bool
    striped: bool
    uniform: bool
    brightest_px: tuple[float, float]

    @property
    def moments_px2(self) -> Floats:
        """Second moments (2, 2), u and v, of a uniform image of this outline."""
        moments = self.outline.moments
        return moments if self.along == "rows" else moments[::-1, ::-1]

    def chord(self, lines: Ints) -> Floats:
        """Mean length (n,) of the outline's chord in lines (n,), pixels; 0 beyond its ends."""
        low, high = self.outline.edges(np.asarray(lines, dtype=np.float64))
        return np.asarray(high - low)

    def contour_px(self) -> Floats:
        """Points (n, 2), u and v, on the outline."""
        points = self.outline.contour()
        return points if self.along == "rows" else points[:, ::-1]

    def spot(self) -> Spot:
        """The LED image as a spot, with the centre of its outline as centroid."""
        area = float(np.pi * 4 * np.sqrt(max(np.linalg.det(self.outline.moments), 0.0)))
        return Spot(
            u_px=self.u_px,
            v_px=self.v_px,
            covariance_px2=self.covariance_px2,
            brightest_u_px=self.brightest_px[0],
            brightest_v_px=self.brightest_px[1],
            area_px=round(area),
            peak_e=self.peak_e,
            touches_border=self.touches_border,
            saturated=self.clipped,
        )


def find_lamps(
    readouts: Sequence[Readout],
    along: Along,
    stripe_px: float,
    sensor_px: int,
    any_square: bool = False,
    decoded_px: Floats | None = None,
    near_px: float = 40.0,
) -> tuple[Lamp, ...]:
    """Find LED images with stripes, and without, in the regions read out of a sensor of `sensor_px` pixels.

    Parameters
    ----------
    readouts
        Regions in electrons; of the images, `raw_e` is used.
    along
        "rows" if the lines of the shutter are rows of the image, "columns" if they are columns.
    stripe_px
        Length of the longest dark stripe, lines. LED images that are nearer to each other along the readout axis merge.
    sensor_px
        Number of pixels of the sensor.
    any_square
        Whether LEDs may be square. Of ellipse and parallelogram the likelier outline is taken. Sides across the stripes
        show their place by the first and last lit line only, and the covariance says so.
    decoded_px, near_px
        Rough pixels (n, 2) of LEDs, see `estimator.spots.detect.detect`.

    Returns
    -------
    tuple of Lamp
        The LED images whose edges one outline explains, larger ones first; none is an empty tuple.
    """
    size = (SMOOTHING_PX, 1) if along == "rows" else (1, SMOOTHING_PX)
    smooth = [cv2.blur(one.image_e, size, borderType=cv2.BORDER_REPLICATE) for one in readouts]
    whole = len(smooth) == 1 and smooth[0].size == sensor_px
    background_e, threshold_e = levels_of(
        smooth, whole, brightest_of(smooth, boxes_near(readouts, decoded_px, near_px))
    )
    lamps: list[tuple[int, Lamp]] = []
    for readout, image in zip(readouts, smooth, strict=True):
        mask = (image > threshold_e).view(np.uint8)
        turned = TurnedRegion.of(readout, along)
        closed = closed_along_readout(mask if along == "rows" else np.ascontiguousarray(mask.T), stripe_px)
        for blob in blobs_of(closed, MAX_BLOB_OF_FRAME * sensor_px):
            lamp = _lamp(turned, blob, background_e, any_square, stripe_px, along)
            if lamp is not None:
                lamps.append((blob.area_px, lamp))
    return tuple(lamp for _, lamp in sorted(lamps, key=lambda one: -one[0]))


def _lamp(
    turned: TurnedRegion, blob: StripedBlob, background_e: float, any_square: bool, stripe_px: float, along: Along
) -> Lamp | None:
    """The LED image of a blob; None if no outline explains its edges."""
    light = light_of(turned, blob, background_e)
    box = np.s_[blob.top : blob.bottom, blob.left : blob.right]
    edges = edges_of(light, blob, turned.clipped[box] & blob.own)
    found = None if edges is None else _sharp(edges, any_square, stripe_px)
    uniform = found is not None
    if found is None:
        found = _faded(light, blob)
    if found is None:
        return None
    outline = found.outline
    rows, columns = light.signal.shape
    centre, extent = outline.centre, outline.extent
    if not ((centre > -extent) & (centre < np.array([columns, rows]) + extent)).all():
        return None
    profile, peak_e = profile_of(turned, blob, light, outline, uniform)
    if profile is None:
        return None
    low = centre - extent + (blob.left, blob.top)
    high = centre + extent + (blob.left, blob.top)
    size = turned.electrons.shape[::-1]
    touches = bool((low < 0).any() or (high > size).any())
    at, least = centre + (blob.left, blob.top), (MIN_ARC if uniform else MIN_FADED_ARC) * extent.max()
    inside = bool(((at > least) & (at < size - least)).all())
    # Edges need both ends of a line; isophotes would take the border for one.
    lines_cut = (blob.left == 0 and blob.own[:, 0].any()) or (blob.right == size[0] and blob.own[:, -1].any())
    x, y = (centre + (blob.left + turned.across, blob.top + turned.line)).tolist()
    moved = moved_outline(outline, blob.left + turned.across, blob.top + turned.line)
    covariance = found.covariance
    line, column = np.unravel_index(np.argmax(np.where(blob.own, light.signal, -np.inf)), light.signal.shape)
    brightest = (
        float(column) + blob.left + turned.across + 0.5,
        float(line) + blob.top + turned.line + 0.5,
    )
    if along == "columns":
        x, y, covariance = y, x, covariance[::-1, ::-1]
    return Lamp(
        u_px=x,
        v_px=y,
        covariance_px2=covariance,
        along=along,
        outline=moved,
        profile=profile,
        residual_px=found.residual_px,
        peak_e=peak_e,
        touches_border=touches,
        measured=not touches or (inside and (uniform or not lines_cut)),
        clipped=bool(profile.clipped.any()),
        striped=is_striped(profile),
        uniform=uniform,
        brightest_px=(brightest[0], brightest[1]) if along == "rows" else (brightest[1], brightest[0]),
    )


def _sharp(edges: LineEdges, any_square: bool, stripe_px: float) -> OutlineFit | None:
    """The outline by edges, None if there is none that explains them."""
    found = fit_ellipse(edges)
    if any_square:
        square = fit_parallelogram(edges, stripe_px)
        if square is not None and (found is None or square.cost < found.cost):
            found = square
    if found is None or found.outliers > MAX_OUTLIERS:
        return None
    extent = float(found.outline.extent.min())
    limit_px = max(MAX_RESIDUAL * extent, 5 * float(np.sqrt(np.median(edges.variance))))
    sharp = np.sqrt(edges.blur_px2) <= max(MAX_BLUR * extent, 1.0)
    return found if sharp and found.residual_px <= limit_px else None


def _faded(light: BlobLight, blob: StripedBlob) -> OutlineFit | None:
    """The outline by isophotes, None if there are none."""
    smooth = cv2.blur(np.where(light.usable, light.signal, 0.0), (SMOOTHING_PX, 1))
    noise = float(np.sqrt(np.median(light.variance[~blob.own]) / SMOOTHING_PX)) if (~blob.own).any() else 0.0
    peak = float(np.percentile(smooth[blob.own], 98))
    found = glow(smooth, blob.own & light.usable, peak, 6 * noise)
    if found is None:
        return None
    one = found.ellipse
    ellipse = EdgeEllipse(one.x0, one.y0, one.slope, one.half_chord, one.half_extent)
    return OutlineFit(ellipse, np.diag(found.variance), 0.0, float(np.sqrt(found.variance.mean())), 0.0)
