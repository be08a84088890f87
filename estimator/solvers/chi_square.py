"""Limits of chi-square and of Fisher's F, a hundred times faster than by the objects of `scipy.stats`."""

from functools import lru_cache

from scipy.special import chdtri


@lru_cache(maxsize=256)
def chi2_limit(probability: float, freedom: float) -> float:
    """Chi-square of some degrees of freedom that is exceeded with a probability."""
    return float(chdtri(freedom, probability))


def pair_limit(probability: float, freedom: int) -> float:
    """Sum of two squares that is exceeded with a probability, in variances estimated with `freedom` degrees of freedom.

    Half of it has Fisher's distribution of 2 and n degrees, whose upper tail at x is (1 + 2 x / n)^(-n / 2).
    """
    return float(freedom * (probability ** (-2 / freedom) - 1))
