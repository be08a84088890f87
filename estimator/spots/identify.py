"""Identification: spots to LED identities by the rough pixels of decoded identities, in place of demodulation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimator.errors import EstimationFailure
from estimator.io.device import DecodedSpot
from estimator.io.led_map import Led
from estimator.spots.detect import Spot

# Standard deviation of a decoded pixel as a share of the sensor's width: 10 px of 4000 (datasets/FORMAT.md).
ROUGH_SHARE = 10 / 4000
# Error of a centroid that the decoded pixel's does not include, on a sensor of any width.
CENTROID_PX = 0.25
GATE_SIGMA = 4.0
# The second nearest spot has to be this many times further from a decoded pixel, or the identity is ambiguous.
CLEARANCE = 2.0
# Half the length of a blob of three LED images in a row, in radii of a disc of the blob's area.
MERGED_RADII = 3**0.5


@dataclass(frozen=True, eq=False)
class Correspondence:
    """An LED of the map and its spot in the image."""

    led: Led
    spot: Spot


def gate_px(width_px: int) -> float:
    """Largest distance of a spot from its decoded pixel on a sensor `width_px` wide, px: four standard deviations."""
    return float(GATE_SIGMA * np.hypot(ROUGH_SHARE * width_px, CENTROID_PX))


def identify(
    spots: Sequence[Spot],
    decoded: Sequence[DecodedSpot],
    leds: Mapping[int, Led],
    gate_px: float,
    cut_too: bool = False,
) -> tuple[Correspondence, ...]:
    """Match spots and decoded identities one to one; the result is in the order of `decoded`.

    An identity is assigned its nearest spot, at most `gate_px` away, unless another spot is within CLEARANCE times that
    distance, another identity has the same nearest spot, or one without a spot lies in this one: a merged blob is
    assigned to no LED. Spots that touch the image's border take part, so that their identity is not assigned to another
    spot, and are then left out because their centroid is biased; with `cut_too` they stay, and may be further away by
    their radius. Raises EstimationFailure, with the number of identities by cause, if no correspondence is left.
    """
    if not decoded:
        raise EstimationFailure("identify", "no identity was decoded")
    spots_px = np.array([(spot.u_px, spot.v_px) for spot in spots]).reshape(-1, 2)
    radius_px = np.sqrt(np.array([spot.area_px for spot in spots]) / np.pi)
    cut_off = np.array([spot.touches_border for spot in spots])
    decoded_px = np.array([(identity.u_px, identity.v_px) for identity in decoded])
    distance_px = np.hypot(decoded_px[:, :1] - spots_px[:, 0], decoded_px[:, 1:] - spots_px[:, 1])
    nearest, every = np.argmin(distance_px, axis=1), np.arange(len(decoded))
    # The centroid of a cut LED image may be off by its radius.
    off_px = np.where(cut_off & cut_too, radius_px, 0.0)
    nearest_px = distance_px[every, nearest]
    inside = nearest_px <= (gate_px + off_px)[nearest]
    identities_of_spot = np.bincount(nearest[inside], minlength=len(spots))
    identities_of_spot += (distance_px[~inside] < MERGED_RADII * radius_px).sum(axis=0)
    distance_px[every, nearest] = np.inf
    clear = (distance_px.min(axis=1) >= CLEARANCE * nearest_px) & (identities_of_spot[nearest] == 1)
    correspondences = []
    beyond, unclear, cut = 0, 0, 0
    for identity, place, is_inside, is_clear in zip(
        decoded, nearest.tolist(), inside.tolist(), clear.tolist(), strict=True
    ):
        spot = spots[place]
        if not is_inside:
            beyond += 1
        elif not is_clear:
            unclear += 1
        elif spot.touches_border and not cut_too:
            cut += 1
        else:
            correspondences.append(Correspondence(leds[identity.led], spot))
    if not correspondences:
        causes = [
            (beyond, f"without a spot within {gate_px:.3g} px"),
            (unclear, "near two spots, or two identities near one spot"),
            (cut, "with a spot cut by the border of its region"),
        ]
        told = "; ".join(f"{count} {cause}" for count, cause in causes if count)
        raise EstimationFailure("identify", f"no whole spot matches a decoded identity: {told}")
    return tuple(correspondences)
