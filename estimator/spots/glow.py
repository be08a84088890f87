"""Lamps whose luminance falls off towards their rim: the centre by isophotes of the lit lines.

The image of such a lamp has no edge at half of a line's plateau. Lines in which the lamp is fully lit all have one
gain: the outermost pixels of a level lie on an isophote of the steady image. In lines that are lit in part they lie
further in. An ellipse is fitted to the outer ones, at several levels; their scatter is the centre's standard
deviation.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Levels as shares of the lamp's peak.
LEVELS = np.geomspace(0.08, 0.65, 9)
MIN_LEVELS = 3
MIN_LINES = 7
ROUNDS = 8
# Chords, squared, are kept from this many standard deviations below the ellipse to this many above.
BELOW, ABOVE = 1.5, 3.0
# Standard deviation of a centre beside the scatter: luminance of a real lamp. Ours.
MIN_SIGMA_PX = 0.5
# The centres of a lamp's isophotes scatter by less than this share of their size.
MAX_SCATTER = 0.35


@dataclass(frozen=True)
class Isophote:
    """Ellipse `x0 + slope (y - y0) -+ half_chord sqrt(1 - ((y - y0) / half_extent)^2)` of one level."""

    x0: float
    y0: float
    slope: float
    half_chord: float
    half_extent: float


@dataclass(frozen=True, eq=False)
class Glow:
    """A lamp by its isophotes: their median ellipse, and the variances (2,) of its centre, x and y."""

    ellipse: Isophote
    variance: Floats


def glow(smooth: Floats, usable: Mask, peak: float, lowest: float) -> Glow | None:
    """The lamp in an image (rows, columns), smoothed across the lines, above its background; None if it is none.

    `usable` marks pixels that may belong to it, `peak` is its peak, and `lowest` the lowest level that is no noise.
    """
    found = [
        one for level in LEVELS * peak if level >= lowest and (one := _isophote((smooth > level) & usable)) is not None
    ]
    if len(found) < MIN_LEVELS:
        return None
    values = np.array([(one.x0, one.y0, one.slope, one.half_chord, one.half_extent) for one in found])
    middle = np.median(values, axis=0)
    scatter = 1.4826 * np.median(np.abs(values[:, :2] - middle[:2]), axis=0)
    if (scatter > MAX_SCATTER * middle[3:]).any():
        return None
    return Glow(Isophote(*middle.tolist()), scatter**2 + MIN_SIGMA_PX**2)


def _isophote(above: Mask) -> Isophote | None:
    """Ellipse through the outermost pixels of the widest lines; None if they lie on none."""
    lit = np.flatnonzero(above.any(axis=1))
    if len(lit) < MIN_LINES:
        return None
    first = above.argmax(axis=1)[lit]
    last = above.shape[1] - above[:, ::-1].argmax(axis=1)[lit]
    y, chord2, middle = lit + 0.5, (last - first).astype(np.float64) ** 2, (first + last) / 2
    kept = np.ones(len(y), dtype=bool)
    centre, scale = float(y.mean()), max(float(np.ptp(y)) / 2, 1.0)
    t = (y - centre) / scale
    design = np.stack([np.ones_like(t), t, t**2], axis=1)
    for _ in range(ROUNDS):
        coefficients = np.linalg.lstsq(design[kept], chord2[kept], rcond=None)[0]
        off = chord2 - design @ coefficients
        spread = max(1.4826 * float(np.median(np.abs(off[kept]))), 1.0)
        kept = (off > -BELOW * spread) & (off < ABOVE * spread)
        if kept.sum() < MIN_LINES:
            return None
    c0, c1, c2 = coefficients.tolist()
    if c2 >= 0:
        return None
    top, peak2 = -c1 / (2 * c2), c0 - c1**2 / (4 * c2)
    if peak2 <= 0 or abs(top) > 1:
        return None
    slope, x0 = np.polyfit(t[kept] - top, middle[kept], 1)
    half_extent = scale * float(np.sqrt(-peak2 / c2))
    return Isophote(float(x0), centre + scale * top, float(slope) / scale, float(np.sqrt(peak2)) / 2, half_extent)
