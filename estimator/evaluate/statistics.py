"""Errors of many frames in a few numbers: with failures counted, with intervals, against bounds and covariances."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from estimator.io.records import Number, Row, Size

Floats = NDArray[np.float64]

CONFIDENCE = 0.95
RESAMPLES = 1999
"""50 of them lie beyond each limit, so that the share beyond it is 2.5 % give or take 0.35."""
BOOTSTRAP_KEY = 20161118
MAX_RESAMPLED_AT_ONCE = 2_000_000
NEES_CONFIDENCE = 0.99
MIN_ERROR_M = 1e-100
"""What is below is zero; nothing is divided by it."""


class Summary(Row):
    """Of absolute errors, metres; `p95_m` is interpolated linearly."""

    median_m: Size
    mean_m: Size
    rmse_m: Size
    p95_m: Size
    max_m: Size


class OfAll(Row):
    """Errors that half, and 95 %, of all frames do not exceed, a failed frame's being infinite; null is infinite.

    They are errors of frames, not interpolated between two, for there is nothing between a number and infinity. A frame
    that fails instead of being wrong can only make them larger.
    """

    median_m: Size | None
    p95_m: Size | None


class Interval(Row):
    """Between these a quantity lies with 95 % confidence, metres."""

    low_m: Number
    high_m: Number


class AgainstBound(Row):
    """`bound_rms_m / rmse_m`, both over the same `frames`: those that succeeded and have a bound.

    `bound_rms_m` is the root of the mean trace of the bound; the efficiency is null where no frame has an error.
    """

    frames: int = Field(ge=1)
    bound_rms_m: Size
    rmse_m: Size
    efficiency: Size | None


class Nees(Row):
    """Mean of `e^T C^-1 e` over the `frames` that report a covariance C of their error e (3,).

    Where C is honest, errors normal and frames independent, `frames` times it is chi-square with 3 `frames` degrees of
    freedom, and it lies from `low` to `high` with 99 % probability (Bar-Shalom, Li and Kirubarajan, Estimation with
    Applications to Tracking and Navigation, 2001, 5.4.2). Above, the variant is too sure of itself; below, too modest.
    """

    frames: int = Field(ge=1)
    mean: Size
    low: Size
    high: Size
    within: bool


def summary(errors_m: Sequence[float]) -> Summary | None:
    """Summarise errors of either sign; None without any."""
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
    """Errors of all frames, None for a failed one, which counts as infinite; None without a frame."""
    if not errors_m:
        return None
    ordered = sorted(np.inf if error_m is None else error_m for error_m in errors_m)

    def kept_by(percent: int) -> float | None:
        error_m = ordered[-(-percent * len(ordered) // 100) - 1]
        return error_m if np.isfinite(error_m) else None

    return OfAll(median_m=kept_by(50), p95_m=kept_by(95))


def root_mean_square(values: Floats, axis: int = -1) -> Floats:
    """Over an axis."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=axis)))


def median_interval(values_m: Sequence[float]) -> Interval | None:
    """Interval of the median of what the values are a sample of; None for fewer than two."""
    return _interval(values_m, np.median)


def rmse_interval(errors_m: Sequence[float]) -> Interval | None:
    """Interval of the root mean square of what the errors are a sample of; None for fewer than two."""
    return _interval(errors_m, root_mean_square)


def _interval(values_m: Sequence[float], statistic: Callable[..., Floats]) -> Interval | None:
    """Percentile bootstrap over frames, which it takes as independent; the same values give the same interval.

    Not BCa: it corrects by a jackknife, which is inconsistent for a median (Efron and Tibshirani, An Introduction to
    the Bootstrap, 1993, 11.6), and which takes time with the square of the number of frames.
    """
    if len(values_m) < 2:
        return None
    # Here and below: its import takes a second, which commands that score nothing are spared.
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
    """Hold errors against the bounds of the same frames, each the root of the bound's trace; None without any."""
    if not errors_m:
        return None
    rmse_m, bound_rms_m = (float(root_mean_square(np.array(sizes))) for sizes in (errors_m, bounds_m))
    return AgainstBound(
        frames=len(errors_m),
        bound_rms_m=bound_rms_m,
        rmse_m=rmse_m,
        efficiency=bound_rms_m / rmse_m if rmse_m >= MIN_ERROR_M else None,
    )


def squared_in_sigmas(error_m: Floats, covariance_m2: Sequence[float]) -> float:
    """`e^T C^-1 e` of one error (3,) and its covariance, nine numbers row by row."""
    matrix = np.reshape(np.asarray(covariance_m2), (3, 3))
    sigma_m = np.sqrt(np.diag(matrix))
    error = error_m / sigma_m
    return max(0.0, float(error @ np.linalg.solve(matrix / np.outer(sigma_m, sigma_m), error)))


def nees(squares: Sequence[float]) -> Nees | None:
    """Mean and interval of `e^T C^-1 e` over frames; None without any."""
    if not squares:
        return None
    from scipy.stats import chi2

    count = len(squares)
    low, high = (float(limit) / count for limit in chi2.interval(NEES_CONFIDENCE, 3 * count))
    mean = float(np.mean(squares))
    return Nees(frames=count, mean=mean, low=low, high=high, within=low <= mean <= high)
