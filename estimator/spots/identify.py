"""Spots to LED identities, by the rough pixel that a demodulator gives; to be replaced by demodulation proper."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimator.errors import EstimationFailure
from estimator.io.dataset import DecodedSpot, Led
from estimator.spots.detect import Spot

# Four sigma of a decoded pixel, which is rough to some 10 px.
GATE_PX = 40.0
# The next spot has to be this many times further from a decoded pixel, or either could be meant.
CLEARANCE = 2.0


@dataclass(frozen=True, eq=False)
class Correspondence:
    """An LED of the map and its spot in the image."""

    led: Led
    spot: Spot


def identify(
    spots: Sequence[Spot], decoded: Sequence[DecodedSpot], leds: Mapping[int, Led]
) -> tuple[Correspondence, ...]:
    """Match spots and decoded identities one to one; the result is in the order of `decoded`.

    An identity gets the spot nearest to it, at most GATE_PX away, unless another spot is within CLEARANCE times that
    distance, or another identity has the same nearest spot: two lamps melted into one are nobody's.
    Spots that touch the image's border take part, so that their identity goes to no one else, and are then left out
    for their biased centroid. Raises EstimationFailure where nothing is left.
    """
    if not decoded:
        raise EstimationFailure("identify", "no identity was decoded")
    where = np.array([(spot.u_px, spot.v_px) for spot in spots]).reshape(-1, 2)
    claims = np.array([(claim.u_px, claim.v_px) for claim in decoded])
    distance_px = np.linalg.norm(claims[:, None] - where[None], axis=2)
    nearest = np.argmin(distance_px, axis=1)
    inside = distance_px.min(axis=1) <= GATE_PX
    claimed = np.bincount(nearest[inside], minlength=len(spots))
    correspondences = []
    for row, claim in enumerate(decoded):
        spot = spots[nearest[row]]
        second_px = np.delete(distance_px[row], nearest[row]).min(initial=np.inf)
        clear = second_px >= CLEARANCE * distance_px[row].min() and claimed[nearest[row]] == 1
        if inside[row] and clear and not spot.touches_border:
            correspondences.append(Correspondence(leds[claim.led], spot))
    if not correspondences:
        raise EstimationFailure("identify", "no whole spot matches a decoded identity")
    return tuple(correspondences)
