"""Statistics of errors: summaries with failures counted, bootstrap intervals, efficiency, covariance consistency."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from estimator.io.records import Number, Row, Size

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

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


class RatioToBound(Row):
    """Root mean square of error / bound, frame by frame, over `frames` that succeeded and have a positive bound.

    1 is the bound itself. `low` and `high` are its 95 % interval, null for fewer than two frames. Unlike the efficiency
    of pooled squares, frames with a large bound do not rule it.
    """

    frames: int = Field(ge=1)
    rms: Size
    low: Size | None
    high: Size | None


class Nees(Row):
    """Covariance consistency: mean of `e^T C^-1 e` over the `frames` that report a covariance C of their error e (3,).

    If C is the true covariance and errors are normal, the mean lies in `low` to `high` with 99 % probability. Above the
    interval the variant is overconfident, below it conservative. `devices` and `maps` are the independent samples.

    - One device, frames independent: `frames` times the mean is chi-square with 3 `frames` degrees of freedom
      (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.4.2).
    - Several devices, whose frames share errors: Student's interval of the devices' means, see `nees`.
    """

    frames: int = Field(ge=1)
    devices: int = Field(ge=1)
    maps: int = Field(ge=1)
    mean: Size
    low: Size
    high: Size
    within: bool


class DeviceScore(Row):
    """Score of one device of a variant; RMSE and mean NEES are over its `ok` frames, null without one."""

    device: int
    map: int
    frames: int = Field(ge=1)
    failed: int
    rmse_m: Size | None
    nees: Size | None


class MapScore(Row):
    """Score of all devices in one building as built, as DeviceScore."""

    map: int
    devices: int = Field(ge=1)
    frames: int = Field(ge=1)
    failed: int
    rmse_m: Size | None
    nees: Size | None


class GoodLeds(Row):
    """Failed frames among those with `good_leds` good LEDs; 4 stands for four or more."""

    good_leds: int = Field(ge=0, le=4)
    frames: int
    failed: int


@dataclass(frozen=True, eq=False)
class Groups:
    """Device and map (building) of each of n frames, (n,) integers."""

    device: Integers
    map: Integers

    @classmethod
    def of(cls, device: Sequence[int], map_: Sequence[int]) -> "Groups":
        """Groups of frames given one by one."""
        return cls(np.array(device, dtype=np.int64), np.array(map_, dtype=np.int64))

    def only(self, chosen: NDArray[np.bool_]) -> "Groups":
        """Groups of the chosen frames, (n,)."""
        return Groups(self.device[chosen], self.map[chosen])

    @property
    def devices(self) -> int:
        """Number of devices."""
        return len(np.unique(self.device))

    @property
    def maps(self) -> int:
        """Number of maps."""
        return len(np.unique(self.map))

    def resampled(self, generator: np.random.Generator) -> Integers:
        """How often each frame is in each of RESAMPLES resamples, (RESAMPLES, n).

        A resample draws as many maps as there are, and within each as many devices as it has, with all their frames. A
        device in two maps counts as two.
        """
        counts = np.zeros((RESAMPLES, len(self.device)), dtype=np.int64)
        maps = np.unique(self.map)
        drawn = generator.multinomial(len(maps), np.full(len(maps), 1 / len(maps)), RESAMPLES)
        for one, times in zip(maps, drawn.T, strict=True):
            inside = np.flatnonzero(self.map == one)
            devices, of_frame = np.unique(self.device[inside], return_inverse=True)
            share = np.full(len(devices), 1 / len(devices))
            counts[:, inside] = generator.multinomial(times * len(devices), share)[:, of_frame]
        return counts


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
    return OfAll(median_m=percentile_of_all(errors_m, 50), p95_m=percentile_of_all(errors_m, 95))


def percentile_of_all(errors_m: Sequence[float | None], percent: int) -> float | None:
    """The smallest error that `percent` of all frames do not exceed, None for a failed frame; None is infinite."""
    ordered = sorted(np.inf if error_m is None else error_m for error_m in errors_m)
    error_m = ordered[-(-percent * len(ordered) // 100) - 1]
    return error_m if np.isfinite(error_m) else None


def root_mean_square(values: Floats, axis: int = -1) -> Floats:
    """Root mean square over an axis."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=axis)))


def median_interval(values_m: Sequence[float], groups: Groups | None = None) -> Interval | None:
    """Confidence interval of the median; None for fewer than two values."""
    return _interval(values_m, np.median, _medians, groups)


def rmse_interval(errors_m: Sequence[float], groups: Groups | None = None) -> Interval | None:
    """Confidence interval of the root mean square; None for fewer than two errors."""
    return _interval(errors_m, root_mean_square, _root_mean_squares, groups)


def _medians(values: Floats, counts: Integers) -> Floats:
    """Median of each resample, (resamples,), in which each of the values (n,) is counted (resamples, n) times."""
    order = np.argsort(values)
    up_to = np.cumsum(counts[:, order], axis=1)
    total = up_to[:, -1:]
    middle = [values[order[np.argmax(up_to > place, axis=1)]] for place in ((total - 1) // 2, total // 2)]
    return np.asarray((middle[0] + middle[1]) / 2)


def _root_mean_squares(values: Floats, counts: Integers) -> Floats:
    """Root mean square of each resample, (resamples,), as `_medians`."""
    return np.asarray(np.sqrt(counts @ np.square(values) / counts.sum(axis=1)))


def _interval(
    values_m: Sequence[float],
    statistic: Callable[..., Floats],
    of_resamples: Callable[[Floats, Integers], Floats],
    groups: Groups | None,
) -> Interval | None:
    """Percentile bootstrap; the same values give the same interval.

    Without groups, or with one device, frames are resampled, which are assumed independent. With several devices all
    frames of a device are drawn together, with several maps first maps and then devices within each (two-stage cluster
    bootstrap: Davison and Hinkley, Bootstrap Methods and their Application, 1997, 3.8). Simulated with 20 devices in 4
    maps, 95 % intervals of the RMSE held 93 to 95 % so, 88 to 90 % by devices alone, and 58 to 78 % by frames.

    Not BCa: its jackknife is inconsistent for a median (Efron and Tibshirani, An Introduction to the Bootstrap, 1993,
    11.6), and its time grows with the square of the number of frames.
    """
    if len(values_m) < 2:
        return None
    values = np.array(values_m, dtype=np.float64)
    generator = np.random.Generator(np.random.Philox(key=BOOTSTRAP_KEY))
    if groups is not None and groups.devices > 1:
        beyond = 50 * (1 - CONFIDENCE)
        low, high = np.percentile(of_resamples(values, groups.resampled(generator)), [beyond, 100 - beyond])
        return Interval(low_m=float(low), high_m=float(high))
    # Imported here and below: the import takes a second, which other commands need not wait for.
    from scipy.stats import bootstrap

    result = bootstrap(
        (values,),
        statistic,
        n_resamples=RESAMPLES,
        batch=max(1, MAX_RESAMPLED_AT_ONCE // len(values_m)),
        vectorized=True,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=generator,
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


def ratio_to_bound(errors_m: Sequence[float], bounds_m: Sequence[float], groups: Groups | None) -> RatioToBound | None:
    """Ratio of errors to the positive bounds of the same frames; None without a frame, no interval without groups."""
    if not errors_m:
        return None
    ratios = (np.array(errors_m) / np.array(bounds_m)).tolist()
    interval = None if groups is None else rmse_interval(ratios, groups)
    return RatioToBound(
        frames=len(ratios),
        rms=float(root_mean_square(np.array(ratios))),
        low=None if interval is None else interval.low_m,
        high=None if interval is None else interval.high_m,
    )


def squared_in_sigmas(error_m: Floats, covariance_m2: Sequence[float]) -> float:
    """`e^T C^-1 e` of an error (3,) and its covariance, nine numbers row by row."""
    matrix = np.reshape(np.asarray(covariance_m2), (3, 3))
    sigma_m = np.sqrt(np.diag(matrix))
    error = error_m / sigma_m
    return max(0.0, float(error @ np.linalg.solve(matrix / np.outer(sigma_m, sigma_m), error)))


def nees(squares: Sequence[float], groups: Groups | None = None) -> Nees | None:
    """Mean and interval of `e^T C^-1 e` over frames; None without a frame.

    With several devices the interval is `3 (1 -+ t s / mean)` with the standard error s of the mean over devices, or
    over maps if that is larger: the frames of a device share its errors, the devices in a building share the map's. The
    relative scatter is that of consistent covariances, whatever their common factor.
    """
    if not squares:
        return None
    values = np.array(squares, dtype=np.float64)
    count, mean = len(values), float(values.mean())
    if groups is None or groups.devices < 2:
        from scipy.stats import chi2

        low, high = (float(limit) / count for limit in chi2.interval(NEES_CONFIDENCE, 3 * count))
        return Nees(frames=count, devices=1, maps=1, mean=mean, low=low, high=high, within=low <= mean <= high)
    error = standard_error(values, groups.device)
    if groups.maps > 1:
        error = max(error, standard_error(values, groups.map))
    return _by_samples(values, groups, error, groups.devices)


def nees_by_map(squares: Sequence[float], groups: Groups) -> Nees | None:
    """The same with the maps as the only samples; None with fewer than two maps."""
    if not squares or groups.maps < 2:
        return None
    values = np.array(squares, dtype=np.float64)
    return _by_samples(values, groups, standard_error(values, groups.map), groups.maps)


def standard_error(values: Floats, sample: Integers) -> float:
    """Standard error of the mean of values (n,) whose samples (n,) are independent (a ratio's, by linearization)."""
    _, of_value = np.unique(sample, return_inverse=True)
    sums = np.bincount(of_value, values - values.mean())
    return float(np.sqrt(len(sums) / (len(sums) - 1) * np.square(sums).sum())) / len(values)


def _by_samples(values: Floats, groups: Groups, error: float, samples: int) -> Nees:
    from scipy.stats import t

    mean = float(values.mean())
    half = 3 * float(t.ppf((1 + NEES_CONFIDENCE) / 2, samples - 1)) * (error / mean if mean > 0 else 0.0)
    low, high = max(0.0, 3 - half), 3 + half
    within = low <= mean <= high
    counts = {"frames": len(values), "devices": groups.devices, "maps": groups.maps}
    return Nees(**counts, mean=mean, low=low, high=high, within=within)
