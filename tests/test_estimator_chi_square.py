"""Limits of chi-square and F: those of SciPy's distributions."""

import pytest
from scipy.stats import chi2, f

from estimator.solvers.chi_square import chi2_limit, pair_limit


@pytest.mark.parametrize("freedom", [1, 2, 3, 17, 400])
def test_limits_are_those_of_the_distributions(freedom: int) -> None:
    """SciPy's upper limit of F takes the lower tail, 1 - 1e-6 to 1e-16: to 1e-10 of the probability, and the limit."""
    assert chi2_limit(1e-6, freedom) == pytest.approx(float(chi2.isf(1e-6, freedom)), rel=1e-12)
    assert chi2_limit(1 - 1e-3, freedom) == pytest.approx(float(chi2.ppf(1e-3, freedom)), rel=1e-10)
    assert pair_limit(1e-6, freedom) == pytest.approx(2 * float(f.isf(1e-6, 2, freedom)), rel=3e-10)
