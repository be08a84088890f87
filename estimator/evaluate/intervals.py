"""95 % confidence intervals of a mean, a share and a quantile, of frames that are independent or come in samples.

A sample is a set of frames that share errors, such as those of one pose or one device: frames of different samples are
independent. Intervals of independent frames are exact for shares and quantiles, and Student's for means. With several
frames a sample, standard errors are those of the samples' sums, by linearization.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.evaluate.statistics import CONFIDENCE, standard_error

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Limits = tuple[float, float]
"""Lower and upper end; infinite where the frames set no limit."""
TAIL = (1 - CONFIDENCE) / 2


def mean_interval(values: Floats, samples: Sequence[Integers]) -> Limits | None:
    """Interval of the mean of values (n,) by Student's distribution; None for fewer than two samples.

    `samples` holds one or more ways to group the values, (n,) each: that with the largest standard error counts.
    """
    found = _error(values, samples)
    if found is None:
        return None
    mean, half = float(values.mean()), found[0] * _student(found[1])
    return mean - half, mean + half


def share_interval(chosen: NDArray[np.bool_], samples: Sequence[Integers]) -> Limits | None:
    """Interval of the share of `chosen` (n,): by Clopper and Pearson (1934) for independent frames, else Student's."""
    from scipy.stats import beta

    count, of = int(chosen.sum()), len(chosen)
    if of and _independent(samples):
        low = float(beta.ppf(TAIL, count, of - count + 1)) if count else 0.0
        return low, float(beta.ppf(1 - TAIL, count + 1, of - count)) if count < of else 1.0
    limits = mean_interval(chosen.astype(np.float64), samples)
    return None if limits is None else (max(limits[0], 0.0), min(limits[1], 1.0))


def quantile_interval(values: Floats, share: float, samples: Sequence[Integers]) -> Limits | None:
    """Interval of the quantile at `share` of values (n,), which may be infinite: two of the values, by their ranks.

    Of independent frames the number of values below the quantile is binomial (H. A. David and H. N. Nagaraja, Order
    Statistics, 2003, 7.1). Else the share of values up to the quantile has Student's interval, and its ends are ranks
    (R. S. Woodruff, Confidence Intervals for Medians and Other Position Measures, 1952). An end is infinite where no
    value is sure to lie beyond the quantile, such as above the 95th percentile of fewer than 72 frames. None for fewer
    than two samples.
    """
    from scipy.stats import binom

    count, ordered = len(values), np.sort(values)
    if count < 2:
        return None
    if _independent(samples):
        # P(B < low) <= TAIL and P(B >= high) <= TAIL for the number B of values below the quantile.
        low = int(binom.ppf(TAIL, count, share))
        high = int(binom.ppf(1 - TAIL, count, share)) + 1
    else:
        at = ordered[max(0, int(np.ceil(share * count)) - 1)]
        found = _error((values <= at).astype(np.float64), samples)
        if found is None:
            return None
        half = found[0] * _student(found[1])
        low, high = int(np.floor(count * (share - half))), int(np.floor(count * (share + half))) + 1
    return (
        float(ordered[low - 1]) if low >= 1 else -np.inf,
        float(ordered[high - 1]) if high <= count else np.inf,
    )


def _independent(samples: Sequence[Integers]) -> bool:
    """Whether every frame is a sample by itself."""
    return all(len(np.unique(one)) == len(one) for one in samples)


def _error(values: Floats, samples: Sequence[Integers]) -> tuple[float, int] | None:
    """Largest standard error of the mean by any of the groupings, and its number of samples; None without two."""
    found = [(standard_error(values, one), number) for one in samples if (number := len(np.unique(one))) > 1]
    return max(found) if found and len(found) == len(samples) else None


def _student(samples: int) -> float:
    from scipy.stats import t

    return float(t.ppf(1 - TAIL, samples - 1))
