"""Pairs of spots give distances: exact with the corrected Eq. 3, the errata's absurdities with the printed one."""

import numpy as np
import pytest
from estimator_synthetic import Array, View, grid

from estimator.errors import EstimationFailure
from estimator.solvers.ranging import law_of_sines, led_ranges, printed_eq3

SQUARE_K = np.diag([100.0, 100.0, 1.0])
TABLE_1 = np.array([[0.5, 1.5, 3.5], [0.3, 1.9, 3.5], [0.8, 1.2, 3.5], [0.9, 1.1, 3.5]])


def level_pixels(leds_m: Array, position_m: Array, K: Array) -> Array:
    """A level camera: u = fx X / Z + cx."""
    offset = leds_m - position_m
    return (offset / offset[:, 2:]) @ K.T[:, :2]


def test_a_triangle_by_hand() -> None:
    """Camera at the origin, A straight above at 4 m, B 3 m beside it: ranges 4 and 5."""
    leds = np.array([[0.0, 0, 4], [3.0, 0, 4]])
    np.testing.assert_allclose(led_ranges(np.array([[0, 0], [75.0, 0]]), SQUARE_K, leds, law_of_sines), [4, 5])


def test_ranges_are_exact_to_rounding_and_do_not_depend_on_the_principal_point_or_pixel_shape() -> None:
    K = np.array([[15000.0, 12.0, 1990], [0, 14000.0, 1510], [0, 0, 1]])
    leds = grid(4, 3, 0.15, (2, 3, 3.1))
    camera = np.array([1.8, 3.3, 0.4])
    ranges = led_ranges(level_pixels(leds, camera, K), K, leds, law_of_sines)
    np.testing.assert_allclose(ranges, np.linalg.norm(leds - camera, axis=1), rtol=1e-11)


def test_printed_equation_3_gives_the_errata_s_ranges() -> None:
    """Table 1's LEDs 1 and 2 from the floor, 6.7 cm beyond LED 1 on their line: true ranges 3.50 and 3.54 m.

    With t = 0.067 and AB = 0.4472 the angles have cos b = -t / d_A and cos a = (t + AB) / d_B; the extra factors make
    d_A = -t d_B / (t + AB) = -0.46 m and d_B = -(t + AB) d_A / t = -26.9 m.
    """
    leds = TABLE_1[:2]
    along = (leds[0] - leds[1]) / np.linalg.norm(leds[0] - leds[1])
    camera = np.array([*(leds[0] + 0.067 * along)[:2], 0.0])
    pixels = level_pixels(leds, camera, SQUARE_K)
    np.testing.assert_allclose(led_ranges(pixels, SQUARE_K, leds, law_of_sines), [3.50, 3.54], atol=5e-3)
    np.testing.assert_allclose(led_ranges(pixels, SQUARE_K, leds, printed_eq3), [-0.46, -26.9], rtol=5e-3)


def test_printed_equation_3_is_right_only_midway_between_two_leds() -> None:
    leds = np.array([[-3.0, 0, 4], [3.0, 0, 4]])
    np.testing.assert_allclose(led_ranges(np.array([[-75.0, 0], [75, 0]]), SQUARE_K, leds, printed_eq3), [5, 5])


def test_wide_pairs_count_by_the_square_of_their_separation() -> None:
    """A spot off by e puts a pair's range off by e / separation, so that error counts by its separation alone.

    A at 0, B at 1 m and C at 4 m, all 4 m high; B is seen at 0.25 + e instead of 0.25. A's range is from the pairs AB
    (4 / (1 + 4 e), weight (0.25 + e)^2) and AC (4, weight 1): to first order 4 - 16 e 0.0625 / 1.0625.
    """
    leds = np.array([[0.0, 0, 4], [1.0, 0, 4], [4.0, 0, 4]])
    error = 1e-6
    ranges = led_ranges(np.array([[0, 0], [25 + 100 * error, 0], [100.0, 0]]), SQUARE_K, leds, law_of_sines)
    np.testing.assert_allclose((ranges[0] - 4) / error, -16 * 0.0625 / 1.0625, rtol=1e-4)


@pytest.mark.parametrize("spread_m", [0.001, 0.01, 0.3])
def test_leds_at_unequal_heights_have_exact_ranges(spread_m: float) -> None:
    """From exact pixels: 1e-16 of 1600 px over a separation of 20 px and more, twice, and some for the quadratic."""
    leds = grid(4, 3, 0.15, (2, 3, 3.1)) + np.random.default_rng(3).uniform(0, 1, (12, 3)) * [0, 0, spread_m]
    camera = np.array([1.8, 3.3, 0.4])
    ranges = led_ranges(level_pixels(leds, camera, SQUARE_K), SQUARE_K, leds, law_of_sines)
    np.testing.assert_allclose(ranges, np.linalg.norm(leds - camera, axis=1), rtol=1e-10)


def test_a_triangle_of_unequal_heights_by_hand() -> None:
    """A straight above at 4 m, B at 3 m to the side and 6 m high: ranges 4 and sqrt(45), whatever the yaw."""
    leds = np.array([[0.0, 0, 4], [3.0, 0, 6]])
    for pixels in ([[0, 0], [50.0, 0]], [[0, 0], [0, -50.0]]):
        np.testing.assert_allclose(
            led_ranges(np.array(pixels), SQUARE_K, leds, law_of_sines), [4, np.sqrt(45)], rtol=1e-12
        )


def test_a_pair_that_no_depth_fits_is_left_out() -> None:
    """C is 1 m above B and seen 30 px beside it: 0.3 at unit depth. From 4 m below B the horizontal offset of an LED in
    that direction is at least 1.2 m, and C's is 0.1 m. The other two pairs give the ranges of all three LEDs.
    """
    leds = np.array([[0.0, 0, 4], [3.0, 0, 4], [3.1, 0, 5]])
    pixels = np.array([[0, 0], [75.0, 0], [105.0, 0]])
    ranges = led_ranges(pixels, SQUARE_K, leds, law_of_sines)
    assert np.isfinite(ranges).all()
    np.testing.assert_allclose(ranges[1], 5.0, rtol=1e-12)


def test_one_led_is_refused() -> None:
    with pytest.raises(EstimationFailure, match="ranging: LEDs identified: 1, needed: 2"):
        led_ranges(np.zeros((1, 2)), SQUARE_K, np.array([[0.0, 0, 4]]), law_of_sines)


def test_coinciding_spots_and_divisions_by_zero_are_refused() -> None:
    leds = np.array([[0.0, 0, 4], [3.0, 0, 4]])
    with pytest.raises(EstimationFailure, match=r"ranging: .*finite"):
        led_ranges(np.array([[10.0, 0], [10, 0]]), SQUARE_K, leds, law_of_sines)


def test_ranges_do_not_depend_on_yaw() -> None:
    leds = grid(3, 2, 0.2, (3, 3, 3))
    straight = View(400, 300, 1500.0, (2.9, 3.1, 0.5))
    turned = View(400, 300, 1500.0, (2.9, 3.1, 0.5), yaw_deg=50)
    ranges = [led_ranges(view.project(leds), view.K, leds, law_of_sines) for view in (straight, turned)]
    np.testing.assert_allclose(ranges[0], ranges[1], rtol=1e-12)
