"""Striped LED images: spots of modulated LEDs under a rolling shutter, each found as one, with a profile by lines.

A rolling shutter exposes the lines of a sensor one after another, so the image of an LED that is switched on and off
has bright and dark stripes across it. A pixel then holds the product of the gain of its line and of the share of the
pixel that the LED image covers. A plain centroid follows the stripes, some pixels off. Here the outline is measured:

1. Blobs above a low threshold are closed along the readout axis over the longest dark stripe.
2. In each lit line the two edges of the LED image lie at half of the line's own plateau. An edge is measured by the
   light around it, which neither a symmetric blur nor the pixels displace.
3. The edges of a disc lie on an ellipse. In line y they are `m + s (y - y0) -+ A sqrt(1 - ((y - y0) / B)^2)`, here
   averaged over the line's width. Those of a square lie on a parallelogram. The fit is weighted and robust.
   A lamp without such edges, whose luminance falls off towards its rim, has isophotes (`estimator.spots.glow`).
4. The light of a line over the chord of the outline is the profile: the wave, at the times of the lines.

Below, x runs along a line and y counts lines: x is u and y is v where lines are rows, x is v
and y is u where lines are columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from estimator.spots.detect import MAX_BLOB_OF_FRAME, MAX_BLOBS, MIN_BLOB_PX, Readout, Spot, brightest_of, levels_of
from estimator.spots.glow import glow

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Along = Literal["rows", "columns"]

# Smoothing across the lines before the threshold: lines have gains of their own and are not mixed.
SMOOTHING_PX = 5
# Pixels beyond an LED image that hold its blur, and those beyond them that give each line's background.
GAP_PX = 4
RING_PX = 8
MIN_RING_PIXELS = 4
# Light within this distance of an edge gives its position. A line needs a plateau between its two edges.
EDGE_PX = 2.5
MIN_PLATEAU_PX = 3.0
# Signal-to-noise ratio of the mean of three pixels at half level, from which on the half level is found.
MIN_EDGE_SNR = 4.0
# Lines below this share of the bright ones' level have edges of the background.
MIN_LEVEL_SHARE = 0.05
# Lines nearer to the ends of an ellipse than this share of its half extent are not used: their edges are so flat that
# blur along the lines displaces them.
MAX_T = 0.92
MIN_LINES = 7
MAX_ROUNDS = 8
GAUSS_NEWTON_STEPS = 12
OUTLIER_SIGMA = 4.5
# Edges may differ from the model by this much beside their noise: profile of the face, pixels, lens. Ours.
MODEL_PX = 0.02
# Edges of lines with saturated pixels lie further out, by a share of the blur and of a pixel that the light above the
# saturation decides: one standard deviation.
CLIPPED_PX = 0.3
CLIPPED_BLUR = 1.0
# Three pixels' mean of a sharp edge rises by its plateau in three pixels; a normal blur of standard deviation s in
# sqrt(2 pi) s.
SHARP_RISE_PX = 3.0
# Share of the correction for blur that remains as its standard deviation.
BLUR_UNCERTAINTY = 0.5
# Edges that are blurred by more than this share of the shorter half extent are no outline.
MAX_BLUR = 0.15
# Half width of the band of columns that gives the profile of a lamp without edges, as a share of its half chord.
BAND = 0.5
# Share of the edges that a single LED image leaves at most: more are of two LED images, or of none.
MAX_OUTLIERS = 0.35
# The root mean square of the inliers' residuals of an LED image, as a share of its half extent.
MAX_RESIDUAL = 0.06
# A profile is striped if a constant level is less likely than one in a billion by normal noise (chi-square over n).
STRIPED_CHI2 = 4.0
STRIPED_CONTRAST = 0.1
SQUARE_STARTS_DEG = (10.0, 25.0, 40.0, 50.0, 65.0, 80.0)
SQUARE_ROUNDS = 4


class Outline(Protocol):
    """Outline of an LED image: x across the lines and y along the readout axis, of the sensor, pixels."""

    @property
    def centre(self) -> Floats:
        """Centre (x, y), (2,)."""

    @property
    def moments(self) -> Floats:
        """Second moments (2, 2) of the uniform area, px^2."""

    @property
    def extent(self) -> Floats:
        """Half extents (2,) of the upright box."""

    def edges(self, lines: Floats) -> tuple[Floats, Floats]:
        """Mean x of the two edges in lines (n,), each from y = line to line + 1; equal beyond the outline's ends."""

    def contour(self) -> Floats:
        """Points (n, 2) on the outline, in order."""


@dataclass(frozen=True)
class EdgeEllipse:
    """Ellipse with the edges `x0 + slope (y - y0) -+ half_chord sqrt(1 - ((y - y0) / half_extent)^2)`."""

    x0: float
    y0: float
    slope: float
    half_chord: float
    half_extent: float

    @property
    def centre(self) -> Floats:
        """See `Outline`."""
        return np.array([self.x0, self.y0])

    @property
    def moments(self) -> Floats:
        """See `Outline`: a quarter of the conjugate semi-diameters' squares."""
        a, b, s = self.half_chord, self.half_extent, self.slope
        return np.array([[a**2 + (s * b) ** 2, s * b**2], [s * b**2, b**2]]) / 4

    @property
    def extent(self) -> Floats:
        """See `Outline`."""
        return 2 * np.sqrt(np.diag(self.moments))

    def edges(self, lines: Floats) -> tuple[Floats, Floats]:
        """See `Outline.edges`."""
        middle = self.x0 + self.slope * (lines + 0.5 - self.y0)
        half = self.half_chord * self.half_extent * np.diff(_segment(self._t(lines)), axis=0)[0]
        return middle - half, middle + half

    def _t(self, lines: Floats) -> Floats:
        """Lower and upper end of each line, (2, n), in units of the half extent."""
        return np.clip((np.stack([lines, lines + 1]) - self.y0) / self.half_extent, -1.0, 1.0)

    def slopes(self, lines: Floats) -> tuple[Floats, Floats]:
        """Derivatives (n, 5) of the middle and of half the chord by x0, y0, slope, half_chord, half_extent."""
        t = self._t(lines)
        g, root = _segment(t), np.sqrt(1 - t**2)
        area, ends = np.diff(g, axis=0)[0], np.diff(t * root, axis=0)[0]
        of_middle, of_half = np.zeros((len(lines), 5)), np.zeros((len(lines), 5))
        of_middle[:, 0], of_middle[:, 1], of_middle[:, 2] = 1.0, -self.slope, lines + 0.5 - self.y0
        of_half[:, 1] = -self.half_chord * np.diff(root, axis=0)[0]
        of_half[:, 3] = self.half_extent * area
        of_half[:, 4] = self.half_chord * (area - ends)
        return of_middle, of_half

    def contour(self) -> Floats:
        """See `Outline.contour`."""
        angle = np.linspace(0, 2 * np.pi, 73)
        y = self.half_extent * np.sin(angle)
        return np.column_stack([self.x0 + self.slope * y + self.half_chord * np.cos(angle), self.y0 + y])


@dataclass(frozen=True)
class EdgeParallelogram:
    """Parallelogram between two pairs of parallel sides, `|a_i (x - x0) + b_i (y - y0)| <= 1` for i = 1, 2.

    `sides` are ((a_1, b_1), (a_2, b_2)).
    """

    x0: float
    y0: float
    sides: tuple[tuple[float, float], tuple[float, float]]

    @property
    def centre(self) -> Floats:
        """See `Outline`."""
        return np.array([self.x0, self.y0])

    @property
    def _half_sides(self) -> Floats:
        """Vectors from the centre to the middles of two sides, as columns."""
        return np.asarray(np.linalg.inv(np.array(self.sides)))

    @property
    def moments(self) -> Floats:
        """See `Outline`: a third of the half sides' squares."""
        return np.asarray(self._half_sides @ self._half_sides.T / 3)

    @property
    def extent(self) -> Floats:
        """See `Outline`."""
        return np.asarray(np.abs(self._half_sides).sum(axis=1))

    def edges(self, lines: Floats) -> tuple[Floats, Floats]:
        """See `Outline.edges`; the mean of five points across each line."""
        y = lines[:, None] + (np.arange(5) + 0.5) / 5 - self.y0
        low, high = np.full(y.shape, -np.inf), np.full(y.shape, np.inf)
        beyond = np.zeros(y.shape, dtype=bool)
        for a, b in self.sides:
            if abs(a) < 1e-9:
                beyond |= np.abs(b * y) > 1
                continue
            low, high = np.maximum(low, -b / a * y - 1 / abs(a)), np.minimum(high, -b / a * y + 1 / abs(a))
        beyond |= low > high
        middle = (low + high) / 2
        low, high = np.where(beyond, middle, low), np.where(beyond, middle, high)
        return self.x0 + low.mean(axis=1), self.x0 + high.mean(axis=1)

    def contour(self) -> Floats:
        """See `Outline.contour`."""
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]], dtype=np.float64)
        return np.asarray(self.centre + corners @ self._half_sides.T)


def _segment(t: Floats) -> Floats:
    """Integral of sqrt(1 - t^2) from 0 to t."""
    return np.asarray((t * np.sqrt(1 - t**2) + np.arcsin(t)) / 2)


@dataclass(frozen=True, eq=False)
class Profile:
    """Light of an LED image by lines: `lines` (n,), the sensor's rows or columns, in increasing order.

    `level_e` (n,) is the light of a line over the length of the outline's chord in it, electrons a pixel above the
    background: the gain of the line times the LED's own level. `weight` (n,) is the inverse of its variance. Lines in
    which a pixel is or may be saturated are `clipped` (n,): their level is a lower limit.
    """

    lines: Ints
    level_e: Floats
    weight: Floats
    clipped: Mask


@dataclass(frozen=True, eq=False)
class Lamp:
    """A striped or steady LED image: centre of its outline, continuous pixels with pixel centres at +0.5.

    `covariance_px2` (2, 2) is the centre's, u and v. `along` says what lines are. `touches_border` marks an outline
    that may be cut by the border of its region, `clipped` one with a pixel that is or may be saturated, `striped` a
    profile that is not constant, `uniform` a lamp whose outline is by edges, not isophotes. `residual_px` is the root
    mean square of the edges' residuals; `peak_e` the level of the bright lines; `brightest_px` the centre (u, v) of the
    brightest pixel.
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
    background_e, threshold_e = levels_of(smooth, whole, brightest_of(readouts, smooth, decoded_px, near_px))
    lamps: list[tuple[int, Lamp]] = []
    for readout, image in zip(readouts, smooth, strict=True):
        mask = (image > threshold_e).view(np.uint8)
        turned = _Turned.of(readout, along)
        closed = _closed(mask if along == "rows" else np.ascontiguousarray(mask.T), stripe_px)
        for blob in _blobs(closed, MAX_BLOB_OF_FRAME * sensor_px):
            lamp = _lamp(turned, blob, background_e, any_square, stripe_px, along)
            if lamp is not None:
                lamps.append((blob.area_px, lamp))
    return tuple(lamp for _, lamp in sorted(lamps, key=lambda one: -one[0]))


@dataclass(frozen=True, eq=False)
class _Turned:
    """A region with lines as rows: views of the readout's arrays."""

    line: int
    across: int
    electrons: NDArray[np.float32]
    clipped: Mask
    floor_e2: float
    prnu: float

    @classmethod
    def of(cls, readout: Readout, along: Along) -> "_Turned":
        if along == "rows":
            return cls(readout.row, readout.column, readout.raw_e, readout.clipped, readout.floor_e2, readout.prnu)
        return cls(readout.column, readout.row, readout.raw_e.T, readout.clipped.T, readout.floor_e2, readout.prnu)


def _closed(mask: NDArray[np.uint8], stripe_px: float) -> NDArray[np.uint8]:
    """The mask, closed along its columns over gaps of `stripe_px` lines."""
    length = int(np.ceil(stripe_px)) + 1
    padded = cv2.copyMakeBorder(mask, length, length, 0, 0, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((length, 1), np.uint8))
    return np.ascontiguousarray(closed[length:-length])


@dataclass(frozen=True, eq=False)
class _Blob:
    """A connected part of a closed mask: its upright box and its pixels in it, and the pixels of other blobs there."""

    left: int
    top: int
    right: int
    bottom: int
    own: Mask
    others: Mask
    area_px: int


def _blobs(closed: NDArray[np.uint8], largest_px: float) -> list[_Blob]:
    """Blobs of a closed mask, the largest first; the box of each is wider by what gives its background."""
    outlines, nesting = cv2.findContours(closed, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        return []
    outer = [one for one, (*_, parent) in zip(outlines, nesting[0], strict=True) if parent < 0]
    blobs = []
    around = GAP_PX + RING_PX
    height, width = closed.shape
    for outline in sorted(outer, key=len, reverse=True)[:MAX_BLOBS]:
        left, top, columns, rows = cv2.boundingRect(outline)
        x0, y0 = max(left - around, 0), max(top - around, 0)
        x1, y1 = min(left + columns + around, width), min(top + rows + around, height)
        if (x1 - x0) * (y1 - y0) > 4 * largest_px:
            continue
        labels = cv2.connectedComponents(np.ascontiguousarray(closed[y0:y1, x0:x1]), connectivity=8)[1]
        column, row = outline[0, 0]
        own = labels == labels[row - y0, column - x0]
        area = int(np.count_nonzero(own))
        if MIN_BLOB_PX <= area <= largest_px:
            blobs.append(_Blob(x0, y0, x1, y1, own, (labels > 0) & ~own, area))
    return blobs


@dataclass(frozen=True, eq=False)
class _Edges:
    """Edges of lit lines, all (n,): `lines` in the box, `left` and `right` (x), `variance` of each edge, `level` (e).

    `blur_px2` is the variance of the blur that the edges show.
    """

    lines: Floats
    left: Floats
    right: Floats
    variance: Floats
    level: Floats
    blur_px2: float

    def unblurred(self, at: "EdgeEllipse") -> "_Edges":
        """Edges that a sharp ellipse of about this shape would have.

        A blur of variance s^2 along the readout axis adds s^2 / 2 times its second derivative to an edge.
        """
        t2 = np.minimum(((self.lines + 0.5 - at.y0) / at.half_extent) ** 2, MAX_T**2)
        shift = self.blur_px2 / 2 * at.half_chord / at.half_extent**2 / (1 - t2) ** 1.5
        variance = self.variance + (BLUR_UNCERTAINTY * shift) ** 2
        return replace(self, left=self.left - shift, right=self.right + shift, variance=variance)


@dataclass(frozen=True, eq=False)
class _Light:
    """Light of a blob's box, (rows, columns): electrons above each line's background, and their variances."""

    signal: Floats
    variance: Floats
    usable: Mask
    background_variance: Floats


def _light(turned: _Turned, blob: _Blob, background_e: float) -> _Light:
    box = np.s_[blob.top : blob.bottom, blob.left : blob.right]
    electrons = turned.electrons[box].astype(np.float64)
    usable = ~cv2.dilate(blob.others.view(np.uint8), np.ones((3, 3), np.uint8)).view(np.bool_)
    # The lines of a flickering room have backgrounds of their own, beside the LED image.
    near = cv2.dilate(blob.own.view(np.uint8), np.ones((2 * GAP_PX + 1, 2 * GAP_PX + 1), np.uint8)).view(np.bool_)
    ring = usable & ~near
    count = ring.sum(axis=1)
    whole_e = float(np.median(electrons[ring])) if ring.any() else background_e
    sums = np.where(ring, electrons, 0.0).sum(axis=1)
    enough = count >= MIN_RING_PIXELS
    lines_e = np.where(enough, sums / np.maximum(count, 1), whole_e)
    raw = np.maximum(electrons, 0.0)
    variance = raw + turned.floor_e2 + (turned.prnu * raw) ** 2
    background_variance = (np.maximum(lines_e, 0.0) + turned.floor_e2) / np.maximum(count, MIN_RING_PIXELS)
    return _Light(electrons - lines_e[:, None], variance, usable, background_variance)


def _edges(light: _Light, blob: _Blob, clipped: Mask) -> _Edges | None:
    """Edges at half of each lit line's plateau; None if too few lines have both."""
    own, signal = blob.own, light.signal
    rows, columns = signal.shape
    lit = own.any(axis=1)
    first = own.argmax(axis=1)
    last = columns - 1 - own[:, ::-1].argmax(axis=1)
    middle = (first + last) // 2
    x = np.arange(columns)
    sums = np.concatenate([np.zeros((rows, 1)), np.cumsum(signal, axis=1)], axis=1)
    variances = np.concatenate([np.zeros((rows, 1)), np.cumsum(light.variance, axis=1)], axis=1)
    every = np.arange(rows)
    quarter = (last - first) // 4
    inner = np.maximum(last - first - 2 * quarter, 0) + 1
    plateau = (sums[every, first + quarter + inner] - sums[every, first + quarter]) / inner
    three = cv2.blur(signal, (3, 1), borderType=cv2.BORDER_REPLICATE)
    noise2 = np.maximum(plateau, 0.0) / 2 + np.median(light.variance[~own]) if (~own).any() else np.maximum(plateau, 0)
    lit &= plateau > 2 * MIN_EDGE_SNR * np.sqrt(noise2 / 3)
    if not lit.any():
        return None
    lit &= plateau > MIN_LEVEL_SHARE * np.percentile(plateau[lit], 80)
    for _ in range(2):
        half = plateau[:, None] / 2
        below = (three < half) | ~light.usable
        before = np.where(below & (x <= middle[:, None]), x, -1).max(axis=1)
        after = np.where(below & (x >= middle[:, None]), x, columns).min(axis=1)
        lit &= (before >= 1) & (after <= columns - 2) & (after - before > 2 * EDGE_PX + MIN_PLATEAU_PX)
        b, a = np.clip(before, 0, columns - 2), np.clip(after, 1, columns - 1)
        left = b + 0.5 + (plateau / 2 - three[every, b]) / np.maximum(three[every, b + 1] - three[every, b], 1e-9)
        right = a + 0.5 - (plateau / 2 - three[every, a]) / np.maximum(three[every, a - 1] - three[every, a], 1e-9)
        left, right = np.clip(left, b, b + 2), np.clip(right, a - 1, a + 1)
        within = right - left - 2 * EDGE_PX
        lit &= within >= MIN_PLATEAU_PX
        within = np.maximum(within, MIN_PLATEAU_PX)
        plateau = np.where(lit, (_at(sums, right - EDGE_PX) - _at(sums, left + EDGE_PX)) / within, plateau)
        plateau = np.maximum(plateau, 1e-9)
    lit &= (left >= EDGE_PX) & (right <= columns - EDGE_PX)
    if lit.sum() < MIN_LINES:
        return None
    fine_left = left + EDGE_PX - (_at(sums, left + EDGE_PX) - _at(sums, left - EDGE_PX)) / plateau
    fine_right = right - EDGE_PX + (_at(sums, right + EDGE_PX) - _at(sums, right - EDGE_PX)) / plateau
    around = (_at(variances, left + EDGE_PX) - _at(variances, left - EDGE_PX)) / 2
    around += (_at(variances, right + EDGE_PX) - _at(variances, right - EDGE_PX)) / 2
    of_plateau = EDGE_PX**2 * (_at(variances, right - EDGE_PX) - _at(variances, left + EDGE_PX)) / within**2
    of_background = (2 * EDGE_PX) ** 2 * light.background_variance
    variance = (around + of_plateau + of_background) / plateau**2 + MODEL_PX**2
    rises = np.stack([three[every, b + 1] - three[every, b], three[every, a - 1] - three[every, a]])
    rise_px = float(np.median((plateau / np.maximum(rises, 1e-9))[:, lit]))
    blur_px2 = max(rise_px**2 - SHARP_RISE_PX**2, 0.0) / (2 * np.pi)
    variance += clipped.any(axis=1) * (CLIPPED_PX + CLIPPED_BLUR * np.sqrt(blur_px2)) ** 2
    agrees = (np.abs(fine_left - left) < EDGE_PX) & (np.abs(fine_right - right) < EDGE_PX)
    lit &= agrees & np.isfinite(variance)
    if lit.sum() < MIN_LINES:
        return None
    lines = every.astype(np.float64)
    return _Edges(lines[lit], fine_left[lit], fine_right[lit], variance[lit], plateau[lit], blur_px2)


def _at(sums: Floats, x: Floats) -> Floats:
    """Cumulative sums (rows, columns + 1) at continuous x (rows,), by linear interpolation: exact for pixels."""
    low = np.clip(np.floor(x).astype(np.int64), 0, sums.shape[1] - 2)
    every = np.arange(len(x))
    return np.asarray(sums[every, low] + (x - low) * (sums[every, low + 1] - sums[every, low]))


@dataclass(frozen=True, eq=False)
class _Found:
    """An outline in box coordinates, the covariance (2, 2) of its centre, and how well it explains the edges."""

    outline: Outline
    covariance: Floats
    cost: float
    residual_px: float
    outliers: float


def _ellipse(measured: _Edges) -> _Found | None:
    """Robust, weighted fit of an ellipse to edges."""
    start = _start_ellipse(measured)
    if start is None:
        return None
    at, kept, edges = start, np.ones((2, len(measured.lines)), dtype=bool), measured
    for _ in range(MAX_ROUNDS):
        edges = measured.unblurred(at)
        within = np.abs((edges.lines + 0.5 - at.y0) / at.half_extent) <= MAX_T
        used = kept & within
        if used.sum() < 2 * MIN_LINES or not used.any(axis=0).sum() >= MIN_LINES:
            return None
        solved = _gauss_newton(edges, at, used)
        if solved is None:
            return None
        at, information, residuals = solved
        within = np.abs((edges.lines + 0.5 - at.y0) / at.half_extent) <= MAX_T
        white = residuals / np.sqrt(edges.variance)
        spread = max(1.0, 1.4826 * float(np.median(np.abs(white[:, within]))) if within.any() else 1.0)
        new = np.abs(white) <= OUTLIER_SIGMA * spread
        if (new == kept).all():
            break
        kept = new
    used = kept & within
    if used.sum() < 2 * MIN_LINES:
        return None
    chi2 = float((white[used] ** 2).sum()) / max(used.sum() - 5, 1)
    try:
        covariance = np.linalg.inv(information)[:2, :2] * max(chi2, 1.0)
    except np.linalg.LinAlgError:
        return None
    outliers = 1 - used.sum() / max(2 * within.sum(), 1)
    rms = float(np.sqrt((residuals[used] ** 2).mean()))
    # Lines near the ends count as outliers of the other outline would.
    cost = float(np.minimum(white**2, OUTLIER_SIGMA**2).sum() + 5 * np.log(white.size)) / len(edges.lines)
    return _Found(at, covariance, cost, rms, outliers)


def _start_ellipse(edges: _Edges) -> EdgeEllipse | None:
    """Ellipse by linear least squares: the squared chord is quadratic in y, the middle linear."""
    y = edges.lines + 0.5
    centre, scale = y.mean(), max(float(np.ptp(y)) / 2, 1.0)
    t = (y - centre) / scale
    chord2, middle = (edges.right - edges.left) ** 2, (edges.left + edges.right) / 2
    kept = np.ones(len(y), dtype=bool)
    for _ in range(3):
        weight = kept / np.sqrt(edges.variance * chord2)
        design = np.stack([np.ones_like(t), t, t**2], axis=1)
        c0, c1, c2 = np.linalg.lstsq(design * weight[:, None], chord2 * weight, rcond=None)[0]
        off = np.abs(chord2 - design @ (c0, c1, c2)) * weight
        scatter = 1.4826 * float(np.median(off[kept]))
        kept = off <= max(OUTLIER_SIGMA * scatter, 1e-9)
        if kept.sum() < MIN_LINES:
            return None
    if c2 >= 0:
        return None
    top = -c1 / (2 * c2)
    peak2 = c0 - c1**2 / (4 * c2)
    if peak2 <= 0:
        return None
    line = np.polyfit(t[kept], middle[kept], 1, w=1 / np.sqrt(edges.variance[kept]))
    half_extent = scale * float(np.sqrt(-peak2 / c2))
    return EdgeEllipse(
        float(np.polyval(line, top)),
        float(centre + scale * top),
        float(line[0] / scale),
        float(np.sqrt(peak2)) / 2,
        half_extent,
    )


def _gauss_newton(edges: _Edges, start: EdgeEllipse, used: Mask) -> tuple[EdgeEllipse, Floats, Floats] | None:
    """Least squares from a start: the ellipse, its information (5, 5), and residuals (2, n) of left and right edges."""
    at, weight = start, used / np.sqrt(edges.variance)
    measured = np.stack([edges.left, edges.right])
    information = np.eye(5)
    for _ in range(GAUSS_NEWTON_STEPS):
        residuals = measured - np.stack(at.edges(edges.lines))
        of_middle, of_half = at.slopes(edges.lines)
        design = np.stack([of_middle - of_half, of_middle + of_half]) * weight[:, :, None]
        flat = design.reshape(-1, 5)
        information = flat.T @ flat
        try:
            step = np.linalg.solve(information, flat.T @ (residuals * weight).ravel())
        except np.linalg.LinAlgError:
            return None
        # An extent must not shrink below the lines that are used, nor run away.
        limit = 0.3 * at.half_extent
        step *= min(1.0, limit / max(np.abs(step[[0, 1, 3, 4]]).max(), 1e-12))
        new = EdgeEllipse(*(np.array([at.x0, at.y0, at.slope, at.half_chord, at.half_extent]) + step).tolist())
        if not (new.half_chord > 0 and new.half_extent > 0 and np.isfinite(step).all()):
            return None
        at = new
        if np.abs(step[[0, 1, 3, 4]]).max() < 1e-5:
            break
    residuals = measured - np.stack(at.edges(edges.lines))
    return at, information, residuals


def _square(edges: _Edges, stripe_px: float) -> _Found | None:
    """Robust, weighted fit of a parallelogram to edges, and to the first and last lit line.

    The true ends lie beyond the first and last lit line by at most a dark stripe: their mean has a variance of at most
    stripe_px^2 / 24. That alone says where a square with sides across the lines is.
    """
    ends = _Ends(edges.lines.min(), edges.lines.max() + 1, max(stripe_px, 1.0))
    models: list[_ParallelogramModel] = [_UprightModel(edges, ends), *_TurnedModel.starts(edges, ends)]
    found = [one for one in (model.fit() for model in models) if one is not None]
    return min(found, key=lambda one: one.cost, default=None)


@dataclass(frozen=True)
class _Ends:
    """First lit line, end of the last one, and the longest dark stripe, lines."""

    first: float
    last: float
    stripe_px: float

    @property
    def middle(self) -> float:
        return (self.first + self.last) / 2

    @property
    def sigma(self) -> float:
        return self.stripe_px / float(np.sqrt(24))


@dataclass(frozen=True, eq=False)
class _ParallelogramModel:
    """Parameters of a parallelogram, of which the first two are its centre (x, y), and how to fit them."""

    edges: _Edges
    ends: _Ends
    start: Floats

    def outline(self, p: Floats) -> EdgeParallelogram:
        raise NotImplementedError

    def residuals(self, p: Floats) -> Floats:
        """Whitened residuals (2n + 1,): of the left edges, of the right edges, and of the middle of the ends."""
        measured = np.stack([self.edges.left, self.edges.right])
        off = (np.stack(self.outline(p).edges(self.edges.lines)) - measured) / np.sqrt(self.edges.variance)
        return np.concatenate([off.ravel(), [(p[1] - self.ends.middle) / self.ends.sigma]])

    def _kept_residuals(self, p: Floats, kept: Mask) -> Floats:
        return self.residuals(p)[kept]

    def fit(self) -> _Found | None:
        """The fit from the start; None where there is none."""
        at, kept = self.start, np.ones(2 * len(self.edges.lines) + 1, dtype=bool)
        white = self.residuals(at)
        try:
            for _ in range(SQUARE_ROUNDS):
                solved = least_squares(self._kept_residuals, at, method="lm", x_scale="jac", max_nfev=200, args=(kept,))
                at, white = solved.x, self.residuals(solved.x)
                spread = max(1.0, 1.4826 * float(np.median(np.abs(white[:-1]))))
                new = np.append(np.abs(white[:-1]) <= OUTLIER_SIGMA * spread, True)
                if (new == kept).all():
                    break
                kept = new
            slopes = np.asarray(solved.jac, dtype=np.float64)
            inverse = np.linalg.inv(slopes.T @ slopes)
        except (ValueError, np.linalg.LinAlgError):
            return None
        scale = max(float((white[kept] ** 2).sum()) / max(int(kept.sum()) - len(at), 1), 1.0)
        off = white[:-1] * np.tile(np.sqrt(self.edges.variance), 2)
        rms = float(np.sqrt((off[kept[:-1]] ** 2).mean()))
        cost = float(np.minimum(white[:-1] ** 2, OUTLIER_SIGMA**2).sum() + white[-1] ** 2)
        # Parameters that explain nothing must not win: the Bayesian information criterion.
        cost += len(at) * float(np.log(len(white)))
        count = len(self.edges.lines)
        covariance = np.asarray(inverse[:2, :2] * scale, dtype=np.float64)
        return _Found(self.outline(at), covariance, cost / count, rms, 1 - float(kept[:-1].mean()))


@dataclass(frozen=True, eq=False)
class _UprightModel(_ParallelogramModel):
    """Two sides across the lines; (x, y), the slope of the other two, and half their distance along x."""

    start: Floats = field(default_factory=lambda: np.zeros(4))

    def __post_init__(self) -> None:
        middle = (self.edges.left + self.edges.right) / 2
        slope, x = np.polyfit(self.edges.lines + 0.5 - self.ends.middle, middle, 1)
        half = float(np.median(self.edges.right - self.edges.left)) / 2
        object.__setattr__(self, "start", np.array([x, self.ends.middle, slope, half]))

    def outline(self, p: Floats) -> EdgeParallelogram:
        a = 1 / max(abs(p[3]), 1e-6)
        # The lit lines all lie between the two sides across: the edges do not depend on these.
        extent = (self.ends.last - self.ends.first) / 2 + self.ends.stripe_px
        return EdgeParallelogram(p[0], p[1], ((a, -a * p[2]), (0.0, 1 / extent)))


@dataclass(frozen=True, eq=False)
class _TurnedModel(_ParallelogramModel):
    """Two pairs of sides that lines cross; (x, y) and the coefficients of `EdgeParallelogram.sides`."""

    @classmethod
    def starts(cls, edges: _Edges, ends: _Ends) -> "list[_ParallelogramModel]":
        """The two of SQUARE_STARTS_DEG that fit the edges best as they are."""
        x = float(np.average((edges.left + edges.right) / 2, weights=edges.level))
        models = []
        for degrees in SQUARE_STARTS_DEG:
            c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
            a, b = np.array([c, s]) * 2 * (c + s) / (ends.last - ends.first)
            models.append(cls(edges, ends, np.array([x, ends.middle, a, b, -b, a])))
        return sorted(models, key=lambda one: float(np.abs(one.residuals(one.start)).sum()))[:2]  # type: ignore[return-value]

    def outline(self, p: Floats) -> EdgeParallelogram:
        return EdgeParallelogram(p[0], p[1], ((p[2], p[3]), (p[4], p[5])))

    def fit(self) -> _Found | None:
        """The fit; None also where a pair of sides bounds a few lines at the ends alone, which says little of it."""
        found = super().fit()
        if found is None or not isinstance(found.outline, EdgeParallelogram):
            return None
        y = self.edges.lines + 0.5 - found.outline.y0
        (a1, b1), (a2, b2) = found.outline.sides
        if min(abs(a1), abs(a2)) < 1e-9:
            return None
        low = np.stack([-b1 / a1 * y - 1 / abs(a1), -b2 / a2 * y - 1 / abs(a2)])
        high = np.stack([-b1 / a1 * y + 1 / abs(a1), -b2 / a2 * y + 1 / abs(a2)])
        bounded = [(low.argmax(axis=0) == k).sum() + (high.argmin(axis=0) == k).sum() for k in (0, 1)]
        return found if min(bounded) >= MIN_LINES else None


def _lamp(
    turned: _Turned, blob: _Blob, background_e: float, any_square: bool, stripe_px: float, along: Along
) -> Lamp | None:
    """The LED image of a blob; None if no outline explains its edges."""
    light = _light(turned, blob, background_e)
    box = np.s_[blob.top : blob.bottom, blob.left : blob.right]
    edges = _edges(light, blob, turned.clipped[box] & blob.own)
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
    profile, peak_e = _profile(turned, blob, light, outline, uniform)
    if profile is None:
        return None
    low = centre - extent + (blob.left, blob.top)
    high = centre + extent + (blob.left, blob.top)
    size = turned.electrons.shape[::-1]
    touches = bool((low < 0).any() or (high > size).any())
    x, y = (centre + (blob.left + turned.across, blob.top + turned.line)).tolist()
    moved = _moved(outline, blob.left + turned.across, blob.top + turned.line)
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
        clipped=bool(profile.clipped.any()),
        striped=_is_striped(profile),
        uniform=uniform,
        brightest_px=(brightest[0], brightest[1]) if along == "rows" else (brightest[1], brightest[0]),
    )


def _sharp(edges: _Edges, any_square: bool, stripe_px: float) -> _Found | None:
    """The outline by edges, None if there is none that explains them."""
    found = _ellipse(edges)
    if any_square:
        square = _square(edges, stripe_px)
        if square is not None and (found is None or square.cost < found.cost):
            found = square
    if found is None or found.outliers > MAX_OUTLIERS:
        return None
    extent = float(found.outline.extent.min())
    limit_px = max(MAX_RESIDUAL * extent, 5 * float(np.sqrt(np.median(edges.variance))))
    sharp = np.sqrt(edges.blur_px2) <= max(MAX_BLUR * extent, 1.0)
    return found if sharp and found.residual_px <= limit_px else None


def _faded(light: _Light, blob: _Blob) -> _Found | None:
    """The outline by isophotes, None if there are none."""
    smooth = cv2.blur(np.where(light.usable, light.signal, 0.0), (SMOOTHING_PX, 1))
    noise = float(np.sqrt(np.median(light.variance[~blob.own]) / SMOOTHING_PX)) if (~blob.own).any() else 0.0
    peak = float(np.percentile(smooth[blob.own], 98))
    found = glow(smooth, blob.own & light.usable, peak, 6 * noise)
    if found is None:
        return None
    one = found.ellipse
    ellipse = EdgeEllipse(one.x0, one.y0, one.slope, one.half_chord, one.half_extent)
    return _Found(ellipse, np.diag(found.variance), 0.0, float(np.sqrt(found.variance.mean())), 0.0)


def _moved(outline: Outline, x: float, y: float) -> Outline:
    if isinstance(outline, EdgeEllipse | EdgeParallelogram):
        return replace(outline, x0=outline.x0 + x, y0=outline.y0 + y)
    raise TypeError(f"{type(outline).__name__} is no outline")


def _profile(
    turned: _Turned, blob: _Blob, light: _Light, outline: Outline, uniform: bool
) -> tuple[Profile | None, float]:
    """Light by lines over the chord, for lines with a chord of MIN_PLATEAU_PX and more; and the bright lines' level.

    Without edges, the mean in a band of columns about the centre, for all lines of the blob.
    """
    rows, columns = light.signal.shape
    lines = np.arange(rows, dtype=np.float64)
    low, high = outline.edges(lines)
    if not uniform:
        half = max(BAND * float(outline.extent[0]), MIN_PLATEAU_PX)
        inside = blob.own.any(axis=1)
        x0 = float(outline.centre[0])
        low, high = np.where(inside, x0 - half, x0), np.where(inside, x0 + half, x0)
    chord = high - low
    usable = (chord >= MIN_PLATEAU_PX) & (low >= 0) & (high <= columns)
    if not usable.any():
        return None, 0.0
    x, margin = np.arange(columns) + 0.5, EDGE_PX if uniform else 0.0
    support = (x >= low[:, None] - margin) & (x <= high[:, None] + margin)
    usable &= (light.usable | ~support).all(axis=1)
    if not usable.any():
        return None, 0.0
    total = np.where(support, light.signal, 0.0).sum(axis=1)
    variance = np.where(support, light.variance, 0.0).sum(axis=1)
    variance += support.sum(axis=1) ** 2 * light.background_variance
    box = np.s_[blob.top : blob.bottom, blob.left : blob.right]
    clipped = np.asarray((turned.clipped[box] & support).any(axis=1))
    chosen = np.flatnonzero(usable)
    level = total[chosen] / chord[chosen]
    weight = chord[chosen] ** 2 / np.maximum(variance[chosen], 1e-12)
    profile = Profile(chosen + blob.top + turned.line, level, weight, clipped[chosen])
    return profile, float(np.percentile(level, 90))


def _is_striped(profile: Profile) -> bool:
    """Whether the level varies by more than its noise and a tenth of itself."""
    mean = float(np.average(profile.level_e, weights=profile.weight))
    off = profile.level_e - mean
    inner = np.abs(profile.lines - profile.lines.mean()) < 0.4 * len(profile.lines)
    if not inner.any() or mean <= 0:
        return False
    chi2 = float((off[inner] ** 2 * profile.weight[inner]).mean())
    contrast = float(off[inner].std()) / mean
    return chi2 > STRIPED_CHI2 and contrast > STRIPED_CONTRAST
