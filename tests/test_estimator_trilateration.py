"""From distances to the position: exact where it can be, refused by name where it cannot."""

import numpy as np
import pytest
from estimator_synthetic import Array, grid

from estimator.errors import EstimationFailure
from estimator.solvers.trilateration import (
    SHIFT_M,
    extents,
    position_by_range_fit,
    position_by_shifted_leds,
    position_from_ranges,
)

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


def test_extents_of_a_rectangle() -> None:
    """Sides 4 and 2 m: four corners 2 and 1 m from the middle lines have roots of sums of squares of 4 and 2 m. They
    depend on neither place nor order in memory.
    """
    corners = np.array([[0.0, 0, 3], [4, 0, 3], [4, 2, 3], [0, 2, 3]])
    np.testing.assert_allclose(extents(corners), [4, 2, 0], atol=1e-12)
    np.testing.assert_allclose(extents(corners[:, 1::-1] + 5), [4, 2], atol=1e-12)


def test_two_leds_are_refused() -> None:
    with pytest.raises(EstimationFailure, match="position: LEDs identified: 2, needed: 3"):
        position_from_ranges(TRIANGLE[:2], np.array([4.0, 5.0]))


def test_ranges_too_short_are_refused() -> None:
    with pytest.raises(EstimationFailure, match=r"position: .*too short"):
        position_from_ranges(TRIANGLE, np.array([1.0, 1.0, 1.0]))


@pytest.mark.parametrize("spread_m", [0.001, 0.01, 0.3])
@pytest.mark.parametrize("position", [(2.6, 1.4, 0.0), (2.0, 3.0, 1.0), (4.1, 0.5, 1.5)])
def test_leds_at_unequal_heights_give_the_exact_position(spread_m: float, position: tuple[float, float, float]) -> None:
    """The turns end at a change of h below 1e-10 m; each halves the error at least, and x and y change by it or less
    times the slope of the LEDs' plane, some 0.3 m over 0.5 m here.
    """
    leds = grid(5, 4, 0.14, (3, 2, 2.7)) + np.random.default_rng(5).uniform(0, 1, (20, 3)) * [0, 0, spread_m]
    found = position_from_ranges(leds, ranges_from(leds, np.array(position)))
    np.testing.assert_allclose(found, position, atol=1e-9)


def test_a_sloped_ceiling_by_hand() -> None:
    """LEDs 3, 3 and 4 m above the camera: 12, 13 and 0 m to the side."""
    leds = np.array([[12.0, 0, 4], [-12.0, 0, 4], [0, 4.0, 4 + 1.0]])
    ranges = np.sqrt([144.0 + 9, 144.0 + 9, 16.0 + 16])
    np.testing.assert_allclose(position_from_ranges(leds, ranges), [0, 0, 1], atol=1e-9)


def test_a_steep_plane_of_leds_is_left_to_the_range_fit() -> None:
    """Steeper than 45 deg: each turn would multiply the error by more than one. Exact to the rounding of the fit."""
    leds = np.array([[0.0, 0, 3], [1.0, 0, 3], [0, 0.5, 6], [1.0, 0.5, 6]])
    found = position_from_ranges(leds, ranges_from(leds, np.array([0.4, 0.1, 0.0])))
    np.testing.assert_allclose(found, [0.4, 0.1, 0.0], atol=1e-9)


def test_ranges_that_contradict_the_map_have_an_answer_below_it() -> None:
    """The first LED 0.1 m too near: x and y by differences are 5 m off, and the spheres do not reach the LEDs. Least
    squares of the ranges shares the 0.1 m among the LEDs: each residual is smaller.
    """
    leds = np.array([[0.0, 0, 3], [0.05, 0, 3.001], [0, 0.05, 3], [0.05, 0.05, 3]])
    ranges = ranges_from(leds, np.array([0.4, 0.1, 0.0])) - [0.1, 0, 0, 0]
    found = position_from_ranges(leds, ranges)
    assert found[2] < 3
    assert np.abs(ranges_from(leds, found) - ranges).max() < 0.1


def test_negative_ranges_are_refused_at_any_heights() -> None:
    leds = TRIANGLE + np.array([[0, 0, 0.001], [0, 0, 0], [0, 0, 0]])
    with pytest.raises(EstimationFailure, match=r"position: .*too short"):
        position_from_ranges(leds, np.array([-1.0, 1.0, 1.0]))


def test_shifted_leds_take_unequal_heights() -> None:
    """Heights spread over 0.5 m, far more than the shifts e_i of up to 0.01 m: these change d^2 by up to 2 h e_i, and
    the position by 0.02 h / 0.5 m of the spread and some more for the pattern's noise: below 0.3 m at h = 2.3 m.
    """
    leds = grid(5, 4, 0.5, (3, 2, 2.7)) + np.random.default_rng(5).uniform(0, 0.5, (20, 3)) * [0, 0, 1]
    found = position_by_shifted_leds(leds, ranges_from(leds, np.array([2.6, 1.4, 0.4])))
    assert np.linalg.norm(found - [2.6, 1.4, 0.4]) < 0.3


@pytest.mark.parametrize("leds", [TABLE_1, TRIANGLE, grid(5, 4, 0.14, (3, 2, 2.7))], ids=["table 1", "three", "grid"])
@pytest.mark.parametrize("position", [(0.6, 1.4, 0.0), (2.0, 5.0, 1.0), (-3.0, 0.5, 2.0)])
def test_the_range_fit_agrees(leds: Array, position: tuple[float, float, float]) -> None:
    """Least squares stand still where rounding does: 1e-15 of 5 m over Table 1's narrowness of 0.065 m, at 6 m."""
    found = position_by_range_fit(leds, ranges_from(leds, np.array(position)))
    np.testing.assert_allclose(found, position, atol=1e-9)


def test_the_range_fit_takes_leds_at_different_heights() -> None:
    leds = grid(3, 3, 0.4, (3, 2, 2.7)) + np.random.default_rng(1).uniform(0, 0.3, (9, 3))
    found = position_by_range_fit(leds, ranges_from(leds, np.array([2.5, 2.2, 0.4])))
    np.testing.assert_allclose(found, [2.5, 2.2, 0.4], atol=1e-10)


def test_the_range_fit_minimises_the_squares_of_the_ranges() -> None:
    """At the minimum every direction leads up: by half the curvature, n = 9 LEDs, times the step squared, or less."""
    leds = grid(3, 3, 0.5, (3, 2, 2.7))
    ranges = ranges_from(leds, np.array([2.5, 2.2, 0.4])) + np.random.default_rng(2).normal(0, 0.01, 9)
    found = position_by_range_fit(leds, ranges)

    def cost(position: Array) -> float:
        return float(((ranges_from(leds, position) - ranges) ** 2).sum())

    for step in 1e-3 * np.concatenate([np.eye(3), -np.eye(3)]):
        assert cost(found + step) > cost(found)


@pytest.mark.parametrize("leds", [TABLE_1, grid(5, 4, 0.14, (3, 2, 3.5)), grid(2, 2, 0.3, (3, 2, 3.5))])
@pytest.mark.parametrize("position", [(0.6, 1.4, 0.0), (2.0, 3.0, 1.0), (2.5, 0.5, 2.0)])
def test_shifted_leds_find_no_height(leds: Array, position: tuple[float, float, float]) -> None:
    """Exact ranges, and the answer is at the LEDs' 3.5 m wherever the camera is; x and y are right.

    What the shifts e_i leave is the best fit of e_i^2 / 2 by x, y and e_i. By e_i alone it needs at most SHIFT_M, and
    that in x and y at most SHIFT_M^2 over the pattern's width, 0.065 m for Table 1's.
    """
    found = position_by_shifted_leds(leds, ranges_from(leds, np.array(position)))
    assert abs(found[2] - 3.5) < 2 * SHIFT_M
    np.testing.assert_allclose(found[:2], position[:2], atol=2 * SHIFT_M**2 / 0.065)


def test_shifted_leds_and_range_fits_refuse_what_fixes_nothing() -> None:
    with pytest.raises(EstimationFailure, match="position: LEDs identified: 3, needed: 4"):
        position_by_shifted_leds(TRIANGLE, np.array([4.0, 5, 5]))
    with pytest.raises(EstimationFailure, match="position: LEDs identified: 2, needed: 3"):
        position_by_range_fit(TRIANGLE[:2], np.array([4.0, 5]))
    line = TABLE_1[[0, 2, 3]]
    with pytest.raises(EstimationFailure, match="position: the LEDs are on one line"):
        position_by_range_fit(line, ranges_from(line, np.array([0.6, 1.4, 0.0])))
