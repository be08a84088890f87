"""From distances to the position: exact where it can be, refused by name where it cannot."""

import numpy as np
import pytest
from estimator_synthetic import Array, grid

from estimator.errors import EstimationFailure
from estimator.position import position_from_ranges

TABLE_1 = np.array([[0.5, 1.5, 3.5], [0.3, 1.9, 3.5], [0.8, 1.2, 3.5], [0.9, 1.1, 3.5]])
TRIANGLE = np.array([[0.0, 0, 4], [3.0, 0, 4], [0, 3.0, 4]])


def ranges_from(leds_m: Array, position_m: Array) -> Array:
    return np.linalg.norm(leds_m - position_m, axis=1)


def test_a_position_by_hand() -> None:
    """LEDs 4 m up at (0, 0), (3, 0), (0, 3) and ranges 4, 5, 5: the camera is at the origin, below and not above."""
    np.testing.assert_allclose(position_from_ranges(TRIANGLE, np.array([4.0, 5, 5])), [0, 0, 0], atol=1e-14)


@pytest.mark.parametrize("leds", [TABLE_1, TRIANGLE, grid(5, 4, 0.14, (3, 2, 2.7))], ids=["table 1", "three", "grid"])
@pytest.mark.parametrize("position", [(0.6, 1.4, 0.0), (2.0, 5.0, 1.0), (-3.0, 0.5, 2.0)])
def test_exact_ranges_give_the_exact_position(leds: Array, position: tuple[float, float, float]) -> None:
    found = position_from_ranges(leds, ranges_from(leds, np.array(position)))
    # d^2 up to 50 m2 rounds at 1e-14, over twice Table 1's narrow side of 0.065 m.
    np.testing.assert_allclose(found, position, atol=1e-11)


def test_leds_on_one_line_are_refused() -> None:
    """Table 1's LEDs 1, 3 and 4 lie on x + y = 20 dm."""
    leds = TABLE_1[[0, 2, 3]]
    with pytest.raises(EstimationFailure, match="position: the LEDs are on one line"):
        position_from_ranges(leds, ranges_from(leds, np.array([0.6, 1.4, 0.0])))


def test_two_leds_are_refused() -> None:
    with pytest.raises(EstimationFailure, match="position: LEDs identified: 2, needed: 3"):
        position_from_ranges(TRIANGLE[:2], np.array([4.0, 5.0]))


def test_ranges_too_short_are_refused() -> None:
    with pytest.raises(EstimationFailure, match=r"position: .*too short"):
        position_from_ranges(TRIANGLE, np.array([1.0, 1.0, 1.0]))
