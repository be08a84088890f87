"""Errors of real lamps' centroids by residuals and prior."""

from dataclasses import replace

import numpy as np
import pytest
from estimator_correspondences import device, simulated
from estimator_synthetic import grid, view_of

from estimator.errors import EstimationFailure
from estimator.photo.solve import MAX_HYPOTHESES, Centre
from estimator.photo.solve import _assignments as assignments
from estimator.photo.solve import _sigma_px as sigma_px_of

TARGET = (3.0, 2.0, 3.0)
VIEW = view_of(TARGET, 2.8, 5.0, -3.0, 40.0, (4000, 3000, 3000.0))


@pytest.mark.parametrize(
    ("spots", "expected_px"),
    [
        # Two numbers a spot and two of gravity, less six of the pose; the prior counts as 4 residuals of 1.5 px.
        (3, 1.5 * np.sqrt(4 / (4 + 2))),
        (4, 1.5 * np.sqrt(4 / (4 + 4))),
        # No number of residuals of 0 is evidence of lamps better than half of what photographs have shown.
        (12, 1.5 / 2),
    ],
)
def test_spots_without_residuals_have_the_prior_s_errors_and_half_of_them_at_least(
    spots: int, expected_px: float
) -> None:
    leds_m = grid(4, 3, 0.3, TARGET)[[0, 3, 8, 11, 1, 2, 4, 5, 6, 7, 9, 10][:spots]]
    assert sigma_px_of(device(VIEW, 0.5), simulated(VIEW, leds_m)) == pytest.approx(expected_px, rel=1e-4)


def test_what_the_noise_of_the_centroids_explains_is_no_error_of_the_lamps() -> None:
    """The variance of 3 spots without residuals, less that of their own noise of 0.5 px."""
    spots = simulated(VIEW, grid(4, 3, 0.3, TARGET)[[0, 3, 8]])
    noisy = [replace(one, spot=replace(one.spot, covariance_px2=0.5**2 * np.eye(2))) for one in spots]
    assert sigma_px_of(device(VIEW, 0.5), noisy) == pytest.approx(np.sqrt(1.5 - 0.5**2), rel=1e-4)


def lamps_with_two_candidates(count: int) -> list[Centre]:
    """Lamps that may each be one of two LEDs, which no other lamp may be."""
    return [Centre(0.0, 0.0, (1.0, 0.0, 0.0, 1.0), (2 * number, 2 * number + 1)) for number in range(count)]


def test_lamps_with_too_many_hypotheses_are_refused_before_the_first_fit() -> None:
    """Twelve lamps that may be one of two LEDs have 2^12 = 4096 hypotheses, and each takes a fit. Every further lamp
    doubles the time, so that a picture of twenty would take 256 times as long and seem to hang.
    """
    assert MAX_HYPOTHESES == 2**12
    assert len(list(assignments(lamps_with_two_candidates(12)))) == 2**12
    with pytest.raises(EstimationFailure, match="too many lamps of one frequency; give --spots"):
        next(assignments(lamps_with_two_candidates(13)))
