"""Distances to the camera's position in the world, and which LEDs fix one at all."""

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure

Floats = NDArray[np.float64]

# Width over length of the LEDs' pattern. Below this a position across the line is all noise; Table 1's LEDs have 0.083.
NARROWEST_PATTERN = 0.01
FEWEST_FOR_ORIENTATION = 4


def position_from_ranges(leds_m: Floats, ranges_m: Floats) -> Floats:
    """The camera's position, (3,) metres, from LEDs (n, 3) at one height above it and its distances (n,) to them.

    Huynh & Yoo 2016, Eq. 4: differences of the spheres are linear in x and y and hold no z, so x and y come from them
    by least squares and z from the spheres themselves, `z = z_L - sqrt(mean(d^2 - rho^2))`.
    Raises EstimationFailure for fewer than three LEDs, LEDs on one line, and a mean below zero.
    """
    check_pattern(leds_m, needed=3, flat=True)
    planar = leds_m[:, :2]
    centre = planar.mean(axis=0)
    offsets = planar - centre
    # With a and p from the LEDs' centre, |a|^2 - d^2 = 2 a . p - (|p|^2 + h^2). What is the same for all LEDs, the last
    # term, is at right angles to the offsets a, which sum to zero: least squares do not see it.
    right = (offsets**2).sum(axis=1) - ranges_m**2
    solution, *_ = np.linalg.lstsq(2 * offsets, right, rcond=None)
    height_m2 = float((ranges_m**2 - ((offsets - solution) ** 2).sum(axis=1)).mean())
    if height_m2 < 0:
        raise EstimationFailure("position", "the ranges are too short to reach the LEDs from below")
    return np.array([*(centre + solution), leds_m[:, 2].mean() - np.sqrt(height_m2)])


def check_pattern(leds_m: Floats, needed: int, flat: bool) -> None:
    """Refuse LEDs that do not fix a position: too few, or all on one line (looking at x and y alone where `flat`)."""
    if len(leds_m) < needed:
        raise EstimationFailure("position", f"LEDs identified: {len(leds_m)}, needed: {needed}")
    if on_one_line(leds_m[:, :2] if flat else leds_m):
        raise EstimationFailure("position", "the LEDs are on one line")


def on_one_line(points_m: Floats) -> bool:
    """Whether points (n, 2) or (n, 3) are as good as on one line."""
    length, width = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)[:2]
    return bool(width <= NARROWEST_PATTERN * length)


def fix_orientation(leds_m: Floats) -> bool:
    """Whether LEDs (n, 3) give the camera's orientation without gravity, and with one to spare."""
    return len(leds_m) >= FEWEST_FOR_ORIENTATION and not on_one_line(leds_m)
