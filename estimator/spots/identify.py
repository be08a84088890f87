"""Identification: spots to LED identities by the rough pixels of decoded identities, in place of demodulation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimator.errors import EstimationFailure
from estimator.io.device import DecodedSpot, Led
from estimator.spots.detect import Spot

# Four standard deviations of a decoded pixel, about 10 px each.
GATE_PX = 40.0
# The second nearest spot has to be this many times further from a decoded pixel, or the identity is ambiguous.
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

    An identity is assigned its nearest spot, at most GATE_PX away, unless another spot is within CLEARANCE times that
    distance, or another identity has the same nearest spot: a merged blob is assigned to no LED. Spots that touch the
    image's border take part, so that their identity is not assigned to another spot, and are then left out because
    their centroid is biased. Raises EstimationFailure if no correspondence is left.
    """
    if not decoded:
        raise EstimationFailure("identify", "no identity was decoded")
    spots_px = np.array([(spot.u_px, spot.v_px) for spot in spots]).reshape(-1, 2)
    decoded_px = np.array([(identity.u_px, identity.v_px) for identity in decoded])
    distance_px = np.linalg.norm(decoded_px[:, None] - spots_px[None], axis=2)
    nearest = np.argmin(distance_px, axis=1)
    inside = distance_px.min(axis=1) <= GATE_PX
    identities_of_spot = np.bincount(nearest[inside], minlength=len(spots))
    correspondences = []
    for row, identity in enumerate(decoded):
        spot = spots[nearest[row]]
        second_px = np.delete(distance_px[row], nearest[row]).min(initial=np.inf)
        clear = second_px >= CLEARANCE * distance_px[row].min() and identities_of_spot[nearest[row]] == 1
        if inside[row] and clear and not spot.touches_border:
            correspondences.append(Correspondence(leds[identity.led], spot))
    if not correspondences:
        raise EstimationFailure("identify", "no whole spot matches a decoded identity")
    return tuple(correspondences)
