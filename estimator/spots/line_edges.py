"""Edges of an LED image in its lit lines, at half of each line's own plateau."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.spots.outlines import EdgeEllipse
from estimator.spots.striped_blobs import BlobLight, StripedBlob

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

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


@dataclass(frozen=True, eq=False)
class LineEdges:
    """Edges of lit lines, all (n,): `lines` in the box, `left` and `right` (x), `variance` of each edge, `level` (e).

    `blur_px2` is the variance of the blur that the edges show.
    """

    lines: Floats
    left: Floats
    right: Floats
    variance: Floats
    level: Floats
    blur_px2: float

    def unblurred(self, at: EdgeEllipse) -> "LineEdges":
        """Edges that a sharp ellipse of about this shape would have.

        A blur of variance s^2 along the readout axis adds s^2 / 2 times its second derivative to an edge.
        """
        t2 = np.minimum(((self.lines + 0.5 - at.y0) / at.half_extent) ** 2, MAX_T**2)
        shift = self.blur_px2 / 2 * at.half_chord / at.half_extent**2 / (1 - t2) ** 1.5
        variance = self.variance + (BLUR_UNCERTAINTY * shift) ** 2
        return replace(self, left=self.left - shift, right=self.right + shift, variance=variance)


def edges_of(light: BlobLight, blob: StripedBlob, clipped: Mask) -> LineEdges | None:
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
    return LineEdges(lines[lit], fine_left[lit], fine_right[lit], variance[lit], plateau[lit], blur_px2)


def _at(sums: Floats, x: Floats) -> Floats:
    """Cumulative sums (rows, columns + 1) at continuous x (rows,), by linear interpolation: exact for pixels."""
    low = np.clip(np.floor(x).astype(np.int64), 0, sums.shape[1] - 2)
    every = np.arange(len(x))
    return np.asarray(sums[every, low] + (x - low) * (sums[every, low + 1] - sums[every, low]))
