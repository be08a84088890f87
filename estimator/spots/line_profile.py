"""Profile of an LED image: its light by lines, and whether this has stripes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.spots.line_edges import EDGE_PX, MIN_PLATEAU_PX
from estimator.spots.outlines import Outline
from estimator.spots.striped_blobs import BlobLight, StripedBlob, TurnedRegion

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Half width of the band of columns that gives the profile of a lamp without edges, as a share of its half chord.
BAND = 0.5
# A profile is striped if a constant level is less likely than one in a billion by normal noise (chi-square over n).
STRIPED_CHI2 = 4.0
STRIPED_CONTRAST = 0.1


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


def profile_of(
    turned: TurnedRegion, blob: StripedBlob, light: BlobLight, outline: Outline, uniform: bool
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


def is_striped(profile: Profile) -> bool:
    """Whether the level varies by more than its noise and a tenth of itself."""
    mean = float(np.average(profile.level_e, weights=profile.weight))
    off = profile.level_e - mean
    inner = np.abs(profile.lines - profile.lines.mean()) < 0.4 * len(profile.lines)
    if not inner.any() or mean <= 0:
        return False
    chi2 = float((off[inner] ** 2 * profile.weight[inner]).mean())
    contrast = float(off[inner].std()) / mean
    return chi2 > STRIPED_CHI2 and contrast > STRIPED_CONTRAST
