"""What the images of a frame reveal beside what the device states: the test of it, and images off along one axis."""

from dataclasses import replace

import numpy as np
import pytest
from estimator_synthetic import Array, view_of
from scipy.stats import chi2
from test_estimator_maximum_likelihood import SIX, TARGET, most_likely, nearly_exact

from estimator.camera.pose import Pose
from estimator.methods.maximum_likelihood import _determines_position as determines_position
from estimator.methods.maximum_likelihood import _differ as differ
from estimator.methods.maximum_likelihood import _of_places as of_places
from estimator.methods.maximum_likelihood import _revealed as revealed
from estimator.pixels.initial import gravity_of
from estimator.pixels.nuisances import Nuisances, Priors


@pytest.mark.parametrize(("share", "expected"), [(0.99, False), (1.01, True)])
@pytest.mark.parametrize("tolerance", [0.0, 0.3])
@pytest.mark.parametrize(("more", "freedom"), [(0.0, 0), (7.0, 2)])
def test_parameters_differ_where_chance_is_one_in_a_billion(
    share: float, expected: bool, tolerance: float, more: float, freedom: int
) -> None:
    """Two LEDs with two parameters each: displacements d with the variance 1 / D of the noise and that of the
    tolerance, four squares of d and `more` against chi-square of 4 + `freedom`.
    """
    D = np.array([[4.0, 25.0], [9.0, 1.0]])
    limit = float(chi2.isf(1e-9, 4 + freedom))
    d = np.sqrt((share * limit - more) / 4 * (1 / D + tolerance**2))
    information = np.stack([np.diag(row) for row in D])
    assert differ(information, D * d, np.full(2, tolerance), more, freedom) == expected


@pytest.mark.parametrize("rounding", [0.0, 1e-45, 1e-10])
def test_an_led_without_information_reveals_nothing(rounding: float) -> None:
    """What its amplitude and background make up for is subtracted: rounding errors are left, of a gradient too."""
    information = np.stack([np.diag([4e5, 2e5]), rounding * np.eye(2)])
    assert not differ(information, np.array([[10.0, 10.0], [1e-5, -1e-5]]), np.full(2, 3e-3), 0.0, 0)


def test_what_moves_images_counts_by_its_square_and_unused_leds_and_shapes_do_not() -> None:
    """Each nuisance of one standard deviation alone, and then of three."""
    zero = Nuisances(np.zeros(7), np.zeros(4), np.zeros((2, 6)), np.zeros((3, 9)), np.zeros(6))
    used = np.array([True, False, True])
    for size in (1.0, 3.0):
        for name in ("camera", "datum", "luminaires", "motion"):
            values = np.zeros_like(getattr(zero, name))
            values.flat[-1] = size
            assert of_places(replace(zero, **{name: values}), used) == size**2
        leds = np.zeros((3, 9))
        leds[:, 2:] = size  # the shift along z, size, tilts and profile
        assert of_places(replace(zero, leds=leds), used) == 2 * size**2


@pytest.mark.parametrize("axis", [0, 1])
def test_images_off_along_one_axis_reveal_a_wrong_map(axis: int) -> None:
    """A camera that looks straight up, and LEDs that are 80 um off, 0.04 px, in turns to both sides, along u or v:
    less than an LED may be off and still be explained. An image of 10 px in diameter and 4000 e a pixel has some 16 px
    of edge across either axis with a noise of 63 / 4000 px each, 0.004 px together: ten sigma, of six LEDs.
    """
    view = view_of(TARGET, 3.0)
    frame = nearly_exact(view, SIX)
    sides = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])

    def place_m(off_m: float) -> float:
        moved: Array = SIX.copy()
        moved[:, axis] += off_m * sides
        leds = {
            key: led.model_copy(update={"position_m": tuple(place)})
            for (key, led), place in zip(frame.leds.items(), moved.tolist(), strict=True)
        }
        told = replace(frame, leds=leds)
        found = most_likely(told, Pose(np.array(view.position_m), view.R_cam_world))
        assert len(found.leds) == len(SIX)
        components, _ = revealed(told, gravity_of(told), Priors.of(told), found)
        return components.place_m

    assert place_m(0.0) == 0.0
    assert place_m(8e-5) > 0.0


@pytest.mark.parametrize("size", [6, 12])
def test_a_position_is_determined_below_a_standard_deviation_of_1_m(size: int) -> None:
    """Beyond, it may be anywhere between the walls of a room of 3.5 m. Three axes together, 0.48^2 + 0.6^2 + 0.64^2 =
    1, whatever the angles and the velocity are known to.
    """
    variances = np.full(size, 1e6)
    for scale, expected in ((0.999, True), (1.001, False), (np.nan, False)):
        variances[:3] = (scale * np.array([0.48, 0.6, 0.64])) ** 2
        assert determines_position(np.diag(variances)) == expected
