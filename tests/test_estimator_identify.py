"""Whose spot is whose, and when that is not said."""

import numpy as np
import pytest

from estimator.errors import EstimationFailure
from estimator.io.device import DecodedSpot
from estimator.io.led_map import DiscLed
from estimator.spots.detect import Spot
from estimator.spots.identify import gate_px, identify

LEDS = {k: DiscLed(id=k, position_m=(0.1 * k, 0.0, 3.0), radius_m=0.01) for k in range(10)}


def spot(u_px: float, v_px: float, touches_border: bool = False) -> Spot:
    return Spot(u_px, v_px, np.eye(2), u_px, v_px, 50, 1000.0, touches_border, saturated=False)


def claim(led: int, u_px: float, v_px: float) -> DecodedSpot:
    return DecodedSpot(led=led, u_px=u_px, v_px=v_px)


GATE_PX = gate_px(4000)


def matches(spots: list[Spot], decoded: list[DecodedSpot], width_px: int = 4000) -> dict[int, float]:
    found = identify(spots, decoded, LEDS, gate_px(width_px))
    return {correspondence.led.id: correspondence.spot.u_px for correspondence in found}


def test_each_identity_gets_the_spot_next_to_it() -> None:
    spots = [spot(300, 50), spot(100, 50), spot(200, 50)]
    assert matches(spots, [claim(7, 108, 44), claim(3, 195, 57), claim(5, 290, 50)]) == {7: 100, 3: 200, 5: 300}


def test_nothing_is_matched_beyond_the_gate() -> None:
    spots = [spot(100, 50), spot(300, 50)]
    beyond = claim(2, 300 + GATE_PX + 1, 50)
    assert matches(spots, [claim(1, 100, 50), beyond]) == {1: 100}
    assert matches(spots, [claim(1, 100, 50), beyond, claim(3, 301, 50)]) == {1: 100, 3: 300}


@pytest.mark.parametrize("second_u_px", [111.0, 130.0])
def test_two_identities_with_one_spot_are_both_left_out(second_u_px: float) -> None:
    """A merged blob of two LEDs may lie much nearer to the brighter one, and is assigned to no LED."""
    spots = [spot(100, 50), spot(300, 50)]
    assert matches(spots, [claim(1, 95, 50), claim(2, second_u_px, 50), claim(3, 300, 50)]) == {3: 300}


def test_an_identity_without_a_spot_inside_a_blob_leaves_the_blob_out() -> None:
    """Three LED images of radius 2 in a row merge: at a gate of 2 px the outer two are beyond it, at 4 px."""
    blob = Spot(100, 50, np.eye(2), 100, 50, round(3 * np.pi * 2**2), 1000.0, False, saturated=False)
    inner, outer, further = claim(1, 100, 50), claim(2, 104, 50), claim(4, 107, 50)
    assert matches([blob, spot(150, 50)], [inner, outer, claim(3, 150, 50)], width_px=200) == {3: 150}
    assert matches([blob, spot(150, 50)], [inner, further, claim(3, 150, 50)], width_px=200) == {1: 100, 3: 150}


def test_an_identity_that_has_its_own_spot_does_not_stand_in_anothers_way() -> None:
    assert matches([spot(100, 50), spot(120, 50)], [claim(1, 106, 50), claim(2, 119, 50)]) == {1: 100, 2: 120}


def test_one_identity_between_two_spots_is_left_out() -> None:
    assert matches([spot(100, 50), spot(121, 50), spot(300, 50)], [claim(1, 110, 50), claim(3, 300, 50)]) == {3: 300}


def test_a_spot_at_the_border_keeps_its_identity_to_itself() -> None:
    spots = [spot(2, 50, touches_border=True), spot(35, 50), spot(300, 50)]
    assert matches(spots, [claim(1, 5, 50), claim(3, 300, 50)]) == {3: 300}


def test_no_match_is_a_named_failure() -> None:
    with pytest.raises(EstimationFailure, match=r"no whole spot .*: 1 without a spot within 40 px$"):
        matches([spot(100, 50)], [claim(1, 200, 50)])
    with pytest.raises(EstimationFailure, match=r"identity: 2 near two spots, or two identities near one spot$"):
        matches([spot(100, 50)], [claim(1, 101, 50), claim(2, 102, 50)])
    cut = [spot(100, 50), spot(300, 50, touches_border=True)]
    with pytest.raises(EstimationFailure, match=r"1 without a spot within 40 px; 1 with a spot cut by the border of"):
        matches(cut, [claim(1, 200, 50), claim(2, 300, 50)])
    with pytest.raises(EstimationFailure, match="identify: no identity was decoded"):
        matches([spot(100, 50)], [])


@pytest.mark.parametrize(("distance_px", "is_matched"), [(39.9, True), (40.1, False)])
def test_the_gate_is_four_standard_deviations_of_a_decoded_pixel(distance_px: float, is_matched: bool) -> None:
    """10 px along each axis: the distance is beyond r with exp(-r^2 / 200), one identity of 3000 beyond 40 px. The
    allowance for the centroid, 4 x 0.25 px in quadrature, adds 0.01 px."""
    found = matches([spot(100, 50), spot(300, 50)], [claim(1, 100, 50 + distance_px), claim(3, 300, 50)])
    assert (1 in found) == is_matched


@pytest.mark.parametrize("width_px", [80, 400, 4000, 8000])
def test_the_gate_scales_with_the_width(width_px: int) -> None:
    """Decoded pixels of 10 px at a width of 4000 and in proportion: of a two-dimensional normal error a share of
    exp(-8) is beyond four standard deviations, 1 of 3000. 10 000 draws leave 3.4 +- 1.8 of them outside, and the
    allowance for the centroid fewer: more than 12 would be 5 sigma. A spot beyond the gate is another LED's.
    """
    errors_px = np.random.default_rng(width_px).normal(0, 10 * width_px / 4000, (10_000, 2))
    assert (np.hypot(*errors_px.T) > gate_px(width_px)).sum() <= 12
    far = claim(1, 50, 50 + 1.01 * gate_px(width_px))
    assert matches([spot(50, 50), spot(500, 50)], [far, claim(2, 500, 50)], width_px) == {2: 500}


@pytest.mark.parametrize(("second_px", "is_matched"), [(19.8, False), (20.2, True)])
def test_another_spot_has_to_be_twice_as_far(second_px: float, is_matched: bool) -> None:
    found = matches([spot(100, 50), spot(110 + second_px, 50), spot(300, 50)], [claim(1, 110, 50), claim(3, 300, 50)])
    assert found == ({1: 100, 3: 300} if is_matched else {3: 300})
