"""Bits: hard decisions on the chips that an LED image shows, and how often theory has them wrong."""

import numpy as np
from scipy.special import erfc

from estimator.receiver.signal import ChipWave, Floats, Ints, Signal, overlaps

NOT_SEEN = "-"
MIN_SEEN = 0.15
"""Chips that the lines show with less than this share of the best chip's weight are not decided."""
RIDGE = 1e-6


def chip_levels(signal: Signal, chip_s: float, phase: float) -> tuple[Floats, Floats]:
    """Levels (chips,) of the chips of a signal that starts `phase` chips into the first, and their covariance.

    By weighted least squares without any knowledge of the chips; a chip that no line shows has a large variance.
    """
    shares = overlaps(signal, chip_s, phase)
    weighted = shares * signal.weight[:, None]
    normal = weighted.T @ shares
    normal += RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return np.asarray(covariance @ (signal.level @ weighted)), covariance


def bits_seen(signal: Signal, wave: ChipWave) -> str:
    """Chips of one period as the lines show them by themselves: "1" bright, "0" dark, "-" not seen.

    The decoded wave gives the phase and the levels of bright and dark, and nothing else. The threshold is in the middle
    between the two. Several images of a chip within the signal count by their sum.
    """
    at = (signal.start_s[0] - wave.at_s) / wave.chip_s + wave.start_chips
    first = int(np.floor(at))
    levels, covariance = chip_levels(signal, wave.chip_s, float(at - first))
    gains = wave.gains(signal.start_s, signal.exposure_s)
    design = np.column_stack([np.ones(len(gains)), gains]) * np.sqrt(signal.weight)[:, None]
    offset, slope = np.linalg.lstsq(design, signal.level * np.sqrt(signal.weight), rcond=None)[0]
    middle = offset + slope * (wave.levels.max() + wave.levels.min()) / 2
    weight = 1 / np.diag(covariance)
    length = len(wave.chips)
    total, evidence = np.zeros(length), np.zeros(length)
    np.add.at(total, (first + np.arange(len(levels))) % length, weight)
    np.add.at(evidence, (first + np.arange(len(levels))) % length, weight * (levels - middle))
    seen = total >= MIN_SEEN * total.max()
    return "".join("01"[int(e > 0)] if s else NOT_SEEN for e, s in zip(evidence, seen, strict=True))


def bit_error_rates(shares: Floats, electrons: Floats, variance_e2: Floats, noise_e2: Floats, firsts: Ints) -> Floats:
    """Expected error rates of bits in Manchester code that are decided by least squares.

    Parameters
    ----------
    shares
        Share of each line's exposure in each chip, (n, chips).
    electrons
        Electrons of each line while the LED is bright, (n,).
    variance_e2
        Variance of each line that the least squares take, (n,), electrons squared.
    noise_e2
        Variance that each line has, shot noise of its own light included, (n,), electrons squared.
    firsts
        The first of each bit's two chips, (bits,).

    Returns
    -------
    array
        `Q(1 / sqrt(v))`, (bits,). Where both variances are S, `v = f^T (A^T S^-1 A)^-1 f`, A the shares times
        electrons, f = +1, -1 on the bit's chips: their difference is 1 in size, with variance v. Normal noise is
        assumed.
    """
    design = shares * electrons[:, None]
    normal = design.T @ (design / variance_e2[:, None])
    normal += RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
    solution = np.linalg.solve(normal, design.T / variance_e2)
    differences = solution[firsts] - solution[firsts + 1]
    return np.asarray(erfc(1 / np.sqrt(2 * differences**2 @ noise_e2)) / 2)
