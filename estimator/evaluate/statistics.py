"""Statistics of errors: summaries with failures counted, bootstrap intervals, efficiency, covariance consistency."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from estimator.io.records import Number, Row, Size

Floats = NDArray[np.float64]

CONFIDENCE = 0.95
RESAMPLES = 1999
"""50 of them lie beyond each limit, so that the share beyond it is 2.5 % with a standard error of 0.35 %."""
BOOTSTRAP_KEY = 20161118
MAX_RESAMPLED_AT_ONCE = 2_000_000
NEES_CONFIDENCE = 0.99


class Summary(Row):
    """Summary of absolute errors, metres; `p95_m` is interpolated linearly."""

    median_m: Size
    mean_m: Size
    rmse_m: Size
    p95_m: Size
    max_m: Size


class OfAll(Row):
    """Median and 95th percentile of the 3D error over all frames, metres; null is infinite.

    A failed frame counts as infinite error. The percentiles are errors of frames, not interpolated, because there is no
    value between a number and infinity. A frame that fails instead of being wrong can only increase them.
    """

    median_m: Size | None
    p95_m: Size | None


class Interval(Row):
    """95 % confidence interval, metres."""

    low_m: Number
    high_m: Number


class AgainstBound(Row):
    """Efficiency `bound_rms_m / rmse_m`, both over the same `frames`: those that succeeded and have a bound.

    `bound_rms_m` is the root of the mean trace of the bound; the efficiency is null if the errors are zero.
    """

    frames: int = Field(ge=1)
    bound_rms_m: Size
    rmse_m: Size
    efficiency: Size | None


class Nees(Row):
    """Covariance consistency: mean of `e^T C^-1 e` over the `frames` that report a covariance C of their error e (3,).

    If C is the true covariance, errors are normal and frames independent, `frames` times the mean is chi-square with
    3 `frames` degrees of freedom, and the mean lies in `low` to `high` with 99 % probability (Bar-Shalom, Li and
    Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.4.2). Above the interval the variant
    is overconfident, below it conservative.
    """

    frames: int = Field(ge=1)
    mean: Size
    low: Size
    high: Size
    within: bool


def summary(errors_m: Sequence[float]) -> Summary | None:
    """Summary of errors of either sign; None without errors."""
    if not errors_m:
        return None
    size_m = np.abs(np.array(errors_m, dtype=np.float64))
    return Summary(
        median_m=float(np.median(size_m)),
        mean_m=float(size_m.mean()),
        rmse_m=float(root_mean_square(size_m)),
        p95_m=float(np.percentile(size_m, 95)),
        max_m=float(size_m.max()),
    )


def of_all(errors_m: Sequence[float | None]) -> OfAll | None:
    """Percentiles of the errors of all frames, None for a failed one; None without a frame."""
    if not errors_m:
        return None
    ordered = sorted(np.inf if error_m is None else error_m for error_m in errors_m)

    def percentile(percent: int) -> float | None:
        error_m = ordered[-(-percent * len(ordered) // 100) - 1]
        return error_m if np.isfinite(error_m) else None

    return OfAll(median_m=percentile(50), p95_m=percentile(95))


def root_mean_square(values: Floats, axis: int = -1) -> Floats:
    """Root mean square over an axis."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=axis)))


def median_interval(values_m: Sequence[float]) -> Interval | None:
    """Confidence interval of the median; None for fewer than two values."""
    return _interval(values_m, np.median)


def rmse_interval(errors_m: Sequence[float]) -> Interval | None:
    """Confidence interval of the root mean square; None for fewer than two errors."""
    return _interval(errors_m, root_mean_square)


def _interval(values_m: Sequence[float], statistic: Callable[..., Floats]) -> Interval | None:
    """Percentile bootstrap over frames, which are assumed independent; the same values give the same interval.

    Not BCa: its jackknife is inconsistent for a median (Efron and Tibshirani, An Introduction to the Bootstrap, 1993,
    11.6), and its time grows with the square of the number of frames.
    """
    if len(values_m) < 2:
        return None
    # Imported here and below: the import takes a second, which other commands need not wait for.
    from scipy.stats import bootstrap

    result = bootstrap(
        (np.array(values_m, dtype=np.float64),),
        statistic,
        n_resamples=RESAMPLES,
        batch=max(1, MAX_RESAMPLED_AT_ONCE // len(values_m)),
        vectorized=True,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.Generator(np.random.Philox(key=BOOTSTRAP_KEY)),
    )
    return Interval(low_m=float(result.confidence_interval.low), high_m=float(result.confidence_interval.high))


def against_bound(errors_m: Sequence[float], bounds_m: Sequence[float]) -> AgainstBound | None:
    """Efficiency of errors by the bounds of the same frames, each the root of its trace; None without a frame."""
    if not errors_m:
        return None
    rmse_m, bound_rms_m = (float(root_mean_square(np.array(sizes))) for sizes in (errors_m, bounds_m))
    return AgainstBound(
        frames=len(errors_m),
        bound_rms_m=bound_rms_m,
        rmse_m=rmse_m,
        efficiency=bound_rms_m / rmse_m if rmse_m > 0 else None,
    )


def squared_in_sigmas(error_m: Floats, covariance_m2: Sequence[float]) -> float:
    """`e^T C^-1 e` of an error (3,) and its covariance, nine numbers row by row."""
    matrix = np.reshape(np.asarray(covariance_m2), (3, 3))
    sigma_m = np.sqrt(np.diag(matrix))
    error = error_m / sigma_m
    return max(0.0, float(error @ np.linalg.solve(matrix / np.outer(sigma_m, sigma_m), error)))


def nees(squares: Sequence[float]) -> Nees | None:
    """Mean and interval of `e^T C^-1 e` over frames; None without a frame."""
    if not squares:
        return None
    from scipy.stats import chi2

    count = len(squares)
    low, high = (float(limit) / count for limit in chi2.interval(NEES_CONFIDENCE, 3 * count))
    mean = float(np.mean(squares))
    return Nees(frames=count, mean=mean, low=low, high=high, within=low <= mean <= high)
