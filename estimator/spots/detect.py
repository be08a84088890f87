"""Image to LED spots: where each lamp's image is, to a hundredth of a pixel, and how sure that is.

Blobs are found in a lightly smoothed copy with one low threshold. Each is then looked at alone: the part above half of
its own level gives an ellipse, and the centroid is taken over that ellipse grown by a margin, so that all of the spot's
light is in it, blurred or not, and the background around it cancels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure

Pixels = NDArray[np.float64]

# The 5 x 5 mean that blobs are searched in: keeps a spot whole that is but a few electrons a pixel.
SMOOTHING_PX = 5
# Ceiling and walls at 1/100 of a lamp stay below this share of the brightest; a lamp at a quarter of it stays above.
THRESHOLD_OF_BRIGHTEST = 0.05
THRESHOLD_SIGMA = 6.0
# A demodulator's pixel is off by some 10 px: the lamp is within so many of it.
NEAR_PX = 40.0
# One bright pixel smoothed covers 25; smaller blobs are noise near the threshold.
MIN_BLOB_PX = 16
# No scene has as many lamps: what is smaller than the thousand largest blobs is noise in an image that holds no lamp.
MAX_BLOBS = 1000
# A blob over a tenth of the frame is a wall or a window.
MAX_BLOB_OF_FRAME = 0.1
# Pieces of a blob above half level count as lamps of their own from a fifth of the largest piece's area on.
MIN_PIECE = 0.2
# A square of half side r has the second moments of a disc of radius 2 r / sqrt(3), and corners at sqrt(2) r.
SQUARE_STRETCH = 1.5**0.5
# Where a disc of blur has fallen to the threshold it has a fifth of its way to go.
FRINGE_BEYOND = 1.25
MARGIN_PX = 2.0
RING_PX = 3.0
MIN_SIGNAL_TO_NOISE = 5.0


@dataclass(frozen=True, eq=False)
class Spot:
    """A lamp's image, in continuous pixels with pixel centres at +0.5.

    `covariance_px2` is (2, 2), of the centroid (u, v), from the pixels' noise. The brightest pixel is given by its
    centre; on a flat-topped or clipped lamp noise alone decides which one it is, and ties go to the first row's first.
    """

    u_px: float
    v_px: float
    covariance_px2: NDArray[np.float64]
    brightest_u_px: float
    brightest_v_px: float
    area_px: int
    peak_e: float
    touches_border: bool
    saturated: bool


@dataclass(frozen=True, eq=False)
class Readout:
    """A window of the sensor in electrons, (rows, columns), from pixel (row, column) of the sensor on.

    `raw_e` is the image before the denoiser and `clipped` where it was full. Beside shot noise a pixel's variance has a
    part that stays, `floor_e2`, and one that goes with the square of its light, by the pixels' unequal response `prnu`.
    """

    row: int
    column: int
    image_e: NDArray[np.float32]
    raw_e: NDArray[np.float32]
    clipped: NDArray[np.bool_]
    floor_e2: float = 0.0
    prnu: float = 0.0


@dataclass(frozen=True, eq=False)
class _Ellipse:
    """The part of a blob above half level: its centroid (u, v) and the ellipse of the same second moments."""

    centre_px: NDArray[np.float64]
    axes: NDArray[np.float64]
    semi_axes_px: NDArray[np.float64]
    low_px: NDArray[np.float64]
    high_px: NDArray[np.float64]
    """Corners of the upright box around the part itself."""
    area_px: int
    fringe_px: float
    """How much further than a sharp lamp's the light goes that was found around it."""

    def distance2(self, u_px: NDArray[np.float64], v_px: NDArray[np.float64], grown_px: float) -> NDArray[np.float64]:
        """Squared distance from the centre in units of the grown ellipse: at most 1 inside. Takes a row of u, a column
        of v.
        """
        du, dv = u_px - self.centre_px[0], v_px - self.centre_px[1]
        (uu, uv), (_, vv) = (self.axes / (self.semi_axes_px + grown_px) ** 2) @ self.axes.T
        return np.asarray(uu * du**2 + vv * dv**2 + (2 * uv * dv) * du)

    def half_extent(self, grown_px: float) -> NDArray[np.float64]:
        """Half width and half height of the upright box around the grown ellipse."""
        return np.asarray(np.sqrt((self.axes**2) @ (self.semi_axes_px + grown_px) ** 2))


def detect(
    readouts: Sequence[Readout],
    sensor_px: int,
    reach_px: int,
    lamps_px: Pixels | None = None,
    corners: bool = False,
) -> tuple[Spot, ...]:
    """Find the lamps in what was read out of a sensor of `sensor_px` pixels: all of it, or windows around lamps.

    What counts as bright is measured near `lamps_px`, (n, 2), where somebody saw lamps that matter, so that a brighter
    one elsewhere hides none of them; without, or where nothing is read out there, the image's brightest does. `corners`
    says that lamps may have some: the ellipse that a square's centroid is taken over goes around it.
    `reach_px` is the half width of the box that the denoiser averaged over, 0 where the images are the raw ones. A spot
    whose light may go over the border of its window is reported and flagged: its centroid is biased. Raises
    EstimationFailure where there is no spot at all.
    """
    size = (SMOOTHING_PX, SMOOTHING_PX)
    smooth = [cv2.blur(readout.image_e, size, borderType=cv2.BORDER_REPLICATE) for readout in readouts]
    whole = sum(image.size for image in smooth) == sensor_px and len(smooth) == 1
    background_e, threshold_e = _levels(smooth, whole, _brightest(readouts, smooth, lamps_px))
    spots: list[Spot] = []
    for readout, image in zip(readouts, smooth, strict=True):
        stretch = SQUARE_STRETCH if corners else 1.0
        ellipses = _ellipses(image, background_e, threshold_e, MAX_BLOB_OF_FRAME * sensor_px, stretch)
        spots += _spots(readout, ellipses, reach_px)
    if not spots:
        raise EstimationFailure("detect", "no spot found")
    return tuple(spots)


def _spots(readout: Readout, ellipses: Sequence[_Ellipse], reach_px: int) -> list[Spot]:
    """Measure each ellipse of a window, beside those near it."""
    fringe_px = max((ellipse.fringe_px for ellipse in ellipses), default=0.0)
    margin_px = MARGIN_PX + max(reach_px, fringe_px)
    centres = np.array([ellipse.centre_px for ellipse in ellipses]).reshape(-1, 2)
    extents = np.array([ellipse.half_extent(margin_px + RING_PX) for ellipse in ellipses]).reshape(-1, 2)
    spots = []
    for index, ellipse in enumerate(ellipses):
        overlaps = (np.abs(centres - centres[index]) < extents + extents[index]).all(axis=1)
        overlaps[index] = False
        others = [ellipses[other] for other in np.flatnonzero(overlaps).tolist()]
        spot = _measure(readout, ellipse, others, reach_px)
        if spot is not None:
            spots.append(spot)
    return spots


def _brightest(readouts: Sequence[Readout], smooth: Sequence[NDArray[np.float32]], lamps_px: Pixels | None) -> float:
    """How bright the lamps are, electrons: the median of what is brightest near each, or the image's brightest."""
    peaks = []
    if lamps_px is not None:
        first = np.array([(readout.column, readout.row) for readout in readouts])
        size = np.array([image.shape[::-1] for image in smooth])
        for lamp_px in lamps_px:
            low = np.clip(lamp_px - NEAR_PX - first, 0, size).astype(int)
            high = np.clip(lamp_px + NEAR_PX - first, 0, size).astype(int)
            for part in np.flatnonzero((low < high).all(axis=1)).tolist():
                (left, top), (right, bottom) = low[part], high[part]
                peaks.append(float(smooth[part][top:bottom, left:right].max()))
    return float(np.median(peaks)) if peaks else max(float(image.max()) for image in smooth)


def _levels(smooth: Sequence[NDArray[np.float32]], whole: bool, brightest_e: float) -> tuple[float, float]:
    """Background and the threshold for blobs, electrons.

    In the whole image most pixels are background, and every few of them are enough. A lamp may fill most of a window
    around it, but not of the window's outermost pixels: the darkest quarter of these is background, blurred or not.
    """
    if whole:
        (image,) = smooth
        step = max(1, image.shape[1] // 500)
        sample = image[::step, ::step]
        background = float(np.median(sample))
        sigma = 1.4826 * float(np.median(np.abs(sample - background)))
    else:
        outermost = np.concatenate([np.concatenate([s[0], s[-1], s[:, 0], s[:, -1]]) for s in smooth])
        low, background = map(float, np.percentile(outermost, [5, 25]))
        sigma = (background - low) / 0.9704  # between these percentiles of a normal distribution
    above_walls = THRESHOLD_OF_BRIGHTEST * (brightest_e - background)
    return background, background + max(THRESHOLD_SIGMA * sigma, above_walls)


def _ellipses(
    smooth: NDArray[np.float32], background_e: float, threshold_e: float, largest_px: float, stretch: float
) -> list[_Ellipse]:
    """The blobs above the threshold, cut at half of their own level, as ellipses made longer by `stretch`."""
    mask = (smooth > threshold_e).view(np.uint8)
    # Outlines are found a hundred times sooner than labels and their statistics for all of a large image.
    outlines, nesting = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    outer = (
        [outline for outline, (*_, parent) in zip(outlines, nesting[0], strict=True) if parent < 0] if outlines else []
    )
    ellipses = []
    for outline in sorted(outer, key=len, reverse=True)[:MAX_BLOBS]:
        left, top, width, height = cv2.boundingRect(outline)
        roi = np.s_[top : top + height, left : left + width]
        column, row = outline[0, 0]
        labels = cv2.connectedComponents(mask[roi], connectivity=8)[1]
        own = labels == labels[row - top, column - left]
        values = smooth[roi][own]
        if not MIN_BLOB_PX <= len(values) <= largest_px:
            continue
        # The upper quartile is the plateau of a lamp; the maximum would be its noise.
        quartile = 3 * len(values) // 4
        half_e = background_e + (float(np.partition(values, quartile)[quartile]) - background_e) / 2
        core = (own & (smooth[roi] >= half_e)).view(np.uint8)
        pieces = cv2.connectedComponents(core, connectivity=8)[1]
        areas = np.bincount(pieces.ravel())[1:]
        for piece in np.flatnonzero(areas >= MIN_PIECE * areas.max()).tolist():
            ellipse = _ellipse(pieces == piece + 1, left, top, stretch)
            if len(areas) == 1:
                box = np.array([left, top]), np.array([left + width, top + height])
                ellipse = replace(ellipse, fringe_px=_fringe_px(ellipse, *box))
            ellipses.append(ellipse)
    return ellipses


def _ellipse(core: NDArray[np.bool_], left: int, top: int, stretch: float) -> _Ellipse:
    """The ellipse with the centroid and second moments of the pixels set; (left, top) is the window's first pixel."""
    weights = core.astype(np.float64)
    of_columns, of_rows = weights.sum(axis=0), weights.sum(axis=1)
    count = of_rows.sum()
    u_px, v_px = np.arange(core.shape[1]) + left + 0.5, np.arange(core.shape[0]) + top + 0.5
    centre = np.array([of_columns @ u_px, of_rows @ v_px]) / count
    du, dv = u_px - centre[0], v_px - centre[1]
    mixed = dv @ weights @ du
    moments = np.array([[of_columns @ du**2, mixed], [mixed, of_rows @ dv**2]]) / count
    variances, axes = np.linalg.eigh(moments)
    # A uniform ellipse has variance a^2 / 4 along its semi-axis a.
    semi_axes_px = 2 * stretch * np.sqrt(np.maximum(variances, 0)) + 0.5
    columns, rows = np.flatnonzero(of_columns), np.flatnonzero(of_rows)
    low_px = np.array([columns[0] + left, rows[0] + top], dtype=np.float64)
    high_px = np.array([columns[-1] + left + 1, rows[-1] + top + 1], dtype=np.float64)
    return _Ellipse(centre, axes, semi_axes_px, low_px, high_px, int(count), fringe_px=0.0)


def _fringe_px(ellipse: _Ellipse, low_px: NDArray[np.int64], high_px: NDArray[np.int64]) -> float:
    """How far a blob's box goes beyond its ellipse's, without what the smoothing adds; none where it is no lamp's own.

    A fringe wider than the lamp itself is not its blur but something bright beside it.
    """
    fringe_px = max((ellipse.low_px - low_px).max(), (high_px - ellipse.high_px).max()) - SMOOTHING_PX // 2
    return FRINGE_BEYOND * float(fringe_px) if 0 < fringe_px < ellipse.semi_axes_px.max() else 0.0


def _measure(readout: Readout, ellipse: _Ellipse, others: list[_Ellipse], reach_px: int) -> Spot | None:
    """Centroid and covariance of one spot, or None where it does not stand out of its own noise."""
    margin_px = MARGIN_PX + max(reach_px, ellipse.fringe_px)
    height_px, width_px = readout.image_e.shape
    reach = ellipse.half_extent(margin_px + RING_PX)
    left, top = np.maximum(np.floor(ellipse.centre_px - reach), 0).astype(int)
    right, bottom = np.minimum(np.ceil(ellipse.centre_px + reach), (width_px, height_px)).astype(int)
    roi = np.s_[top:bottom, left:right]
    u_px, v_px = np.arange(left, right)[None, :] + 0.5, np.arange(top, bottom)[:, None] + 0.5
    electrons = readout.image_e[roi].astype(np.float64)

    distance2 = ellipse.distance2(u_px, v_px, margin_px)
    support = distance2 <= 1
    ring = ~support & (ellipse.distance2(u_px, v_px, margin_px + RING_PX) <= 1)
    for other in others:
        # Where two supports meet, a pixel belongs to the spot it is nearer to.
        other_distance2 = other.distance2(u_px, v_px, MARGIN_PX + max(reach_px, other.fringe_px))
        support &= distance2 <= other_distance2
        ring &= other_distance2 > 1
    background_e = electrons[ring].mean() if ring.any() else 0.0

    signal = np.where(support, electrons - background_e, 0.0)
    # Shot noise: a raw pixel's variance is its electrons.
    raw_e = np.maximum(readout.raw_e[roi].astype(np.float64), 0.0)
    variance = raw_e + readout.floor_e2 + (readout.prnu * raw_e) ** 2
    flux = signal.sum()
    if flux <= MIN_SIGNAL_TO_NOISE * np.sqrt(variance[support].sum()):
        return None
    u, v = float(signal.sum(axis=0) @ u_px[0] / flux), float(signal.sum(axis=1) @ v_px[:, 0] / flux)
    # A centroid of box means is a sum over the raw pixels, whose weights are the box means of the centroid's weights.
    box = (2 * reach_px + 1, 2 * reach_px + 1)
    levers = np.stack([support * ((u_px - u) / flux), support * ((v_px - v) / flux)])
    weights = np.stack([cv2.blur(lever, box, borderType=cv2.BORDER_CONSTANT).ravel() for lever in levers])
    covariance = (weights * variance.ravel()) @ weights.T

    inside = ellipse.distance2(u_px, v_px, 0.0) <= 1
    brightest = np.unravel_index(np.argmax(np.where(inside, electrons, -np.inf)), inside.shape)
    low, high = ellipse.low_px - margin_px, ellipse.high_px + margin_px
    return Spot(
        u_px=u + readout.column,
        v_px=v + readout.row,
        covariance_px2=covariance,
        brightest_u_px=float(u_px[0, brightest[1]]) + readout.column,
        brightest_v_px=float(v_px[brightest[0], 0]) + readout.row,
        area_px=ellipse.area_px,
        peak_e=float(electrons[brightest]),
        touches_border=bool((low < 0).any() or high[0] > width_px or high[1] > height_px),
        saturated=bool(readout.clipped[roi][inside].any()),
    )
