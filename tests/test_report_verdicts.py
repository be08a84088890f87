"""What the report's page says of a mean NEES."""

import pytest

from estimator.evaluate.statistics import Nees
from estimator.report.answer import verdict_of


@pytest.mark.parametrize(("mean", "verdict"), [(1.9, "conservative"), (3.1, "consistent"), (4.2, "overconfident")])
def test_a_mean_below_the_interval_is_conservative_and_one_above_it_overconfident(mean: float, verdict: str) -> None:
    assert (
        verdict_of(Nees(frames=60, devices=1, maps=1, mean=mean, low=2.3, high=3.9, within=2.3 <= mean <= 3.9))
        == verdict
    )
