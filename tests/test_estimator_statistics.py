"""Summaries held against closed forms: failures counted, intervals, bound and NEES."""

from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import binom, chi2, norm

from estimator.evaluate.statistics import (
    RESAMPLES,
    Groups,
    _medians,
    _root_mean_squares,
    against_bound,
    median_interval,
    nees,
    nees_by_map,
    of_all,
    rmse_interval,
    squared_in_sigmas,
    summary,
)
from estimator.io.records import is_covariance

ERRORS = st.lists(st.floats(0, 1e6), min_size=1, max_size=60)


def test_of_all_by_hand() -> None:
    """Of 20 frames the 10th and the 19th smallest: 2 failures leave 9.5 -> the 19th infinite, 11 also the 10th."""
    errors = [float(k) for k in range(1, 21)]
    assert of_all(errors[::-1]) == of_all(errors)
    found = of_all(errors)
    assert found is not None
    assert (found.median_m, found.p95_m) == (10.0, 19.0)
    for failures, expected in ((1, (10.0, 19.0)), (2, (10.0, None)), (10, (10.0, None)), (11, (None, None))):
        found = of_all([*errors[: 20 - failures], *[None] * failures])
        assert found is not None
        assert (found.median_m, found.p95_m) == expected
    assert of_all([]) is None


@given(errors=ERRORS, drawn=st.data())
def test_to_drop_the_largest_errors_or_any_others_never_helps(errors: list[float], drawn: st.DataObject) -> None:
    """By construction: a frame that is dropped, which is to fail, is infinitely wrong, which is no less than it was.

    What the ok frames' own summary would win by it is shown beside it: that is why it is no score by itself.
    """
    count = len(errors)
    dropped = set(np.argsort(errors)[count - drawn.draw(st.integers(0, count), "largest") :].tolist())
    dropped |= drawn.draw(st.sets(st.integers(0, count - 1)), "others")
    left = [None if frame in dropped else error for frame, error in enumerate(errors)]
    before, after = of_all(errors), of_all(left)
    assert before is not None
    assert after is not None
    for was, now in ((before.median_m, after.median_m), (before.p95_m, after.p95_m)):
        assert was is not None
        assert now is None or now >= was


def test_a_summary_of_the_ok_frames_alone_would_gain_by_a_drop() -> None:
    errors = [1.0, 2.0, 3.0, 100.0]
    everything, dropped = summary(errors), summary(errors[:3])
    assert everything is not None
    assert dropped is not None
    assert dropped.rmse_m < everything.rmse_m / 10


def test_the_median_s_interval_has_the_exact_bootstrap_s_limits() -> None:
    """Of an odd number of values the bootstrap's distribution is known (Efron, Ann. Statist. 7, 1979, section 3):
    the median of a resample is at most the k-th smallest with the probability that more than half of n draws fall
    among the k smallest. A limit is the value where this passes 2.5 or 97.5 %, give or take the draw of 1999
    resamples: 4 sigma of a share of 2.5 % are 4 sqrt(0.025 x 0.975 / 1999), which leaves out 5 %.
    """
    n = 401
    values = np.random.default_rng(3).permutation(n).astype(float).tolist()  # the k-th smallest is k - 1
    below = binom.sf(n // 2, n, np.arange(1, n + 1) / n)
    slack = 4 * sqrt(0.025 * 0.975 / RESAMPLES)
    found = median_interval(values)
    assert found is not None
    for limit, share in ((found.low_m, 0.025), (found.high_m, 0.975)):
        first, last = np.searchsorted(below, (share - slack, share + slack))
        assert first <= limit <= last
    assert median_interval(values) == found


def test_the_rmse_s_interval_is_the_normal_one_of_a_large_sample() -> None:
    """By the delta method the RMSE r of n values scatters by s / (2 r sqrt(n)), with s that of their squares.

    Terms left out are, with the skewness 2.8 of a squared normal, (1.96^2 - 1) 2.8 / 6 / sqrt(n) = 0.9 % of a half
    width, and as much again for the root's own curvature. The draw of the resamples moves a limit by
    sqrt(0.025 x 0.975 / 1999) / phi(1.96) = 0.06 sigma, 3 % of the half width, 9 % at three of its own. Limits of 90 %
    would be 16 % nearer.
    """
    errors = np.random.default_rng(4).normal(0, 2, 20_000)
    rmse = float(np.sqrt(np.mean(errors**2)))
    half = float(norm.ppf(0.975) * np.std(errors**2) / (2 * rmse * sqrt(len(errors))))
    found = rmse_interval(errors.tolist())
    assert found is not None
    assert found.high_m - rmse == pytest.approx(half, rel=0.11)
    assert rmse - found.low_m == pytest.approx(half, rel=0.11)


def test_too_few_values_have_no_interval() -> None:
    assert median_interval([]) is None
    assert rmse_interval([1.0]) is None
    found = median_interval([2.0, 2.0])
    assert found is not None
    assert (found.low_m, found.high_m) == (2.0, 2.0)


def test_efficiency_by_hand() -> None:
    """Bounds 3 and 4, errors 5 and 5 sqrt(3): sqrt(25 / 2) over sqrt(100 / 2) is 0.5."""
    found = against_bound([5.0, 5 * sqrt(3)], [3.0, 4.0])
    assert found is not None
    assert (found.frames, found.efficiency) == (2, pytest.approx(0.5))
    without_error = against_bound([0.0], [1.0])
    assert without_error is not None
    assert without_error.efficiency is None
    assert against_bound([], []) is None


def test_errors_of_a_known_covariance_have_the_nees_they_should() -> None:
    """Of 3000 errors drawn from their covariance the mean lies in the interval, of 1.2 times as large ones above.

    The interval's half width is 2.58 sqrt(6 / 3000) = 0.12; 1.44 times 3 is 1.32 above, and 0.69 times 0.92 below.
    One seed in a hundred would fail the first by chance: this one is fixed.
    """
    rng = np.random.default_rng(5)
    root = np.array([[0.01, 0, 0], [0.004, 0.02, 0], [-0.01, 0.3, 0.1]])
    covariance = (root @ root.T).ravel().tolist()
    errors = rng.normal(size=(3000, 3)) @ root.T
    for scale, where in ((1.0, 0), (1.2, 1), (1 / 1.2, -1)):
        found = nees([squared_in_sigmas(scale * error, covariance) for error in errors])
        assert found is not None
        assert (found.mean > found.high) - (found.mean < found.low) == where
        assert found.within == (where == 0)
    assert nees([]) is None


def test_nees_by_hand() -> None:
    """One frame, one standard deviation along each axis: 3. The interval is chi-square's with three degrees."""
    square = squared_in_sigmas(np.array([0.1, -0.2, 0.3]), [0.01, 0, 0, 0, 0.04, 0, 0, 0, 0.09])
    assert square == pytest.approx(3)
    # Two errors that go together are to be expected together: (1, 1) by [[1, 1/2], [1/2, 1]] is 4/3.
    together = [1e-4, 0.5e-4, 0, 0.5e-4, 1e-4, 0, 0, 0, 1e-4]
    assert squared_in_sigmas(np.array([0.01, 0.01, 0]), together) == pytest.approx(4 / 3)
    assert squared_in_sigmas(np.array([0.01, -0.01, 0]), together) == pytest.approx(4)
    found = nees([square])
    assert found is not None
    assert chi2.cdf(found.low, 3) == pytest.approx(0.005)
    assert chi2.cdf(found.high, 3) == pytest.approx(0.995)


COVARIANCES = [
    ([1e-6, 0, 0, 0, 1e-6, 0, 0, 0, 1e-6], True),
    ([1e-60, 0, 0, 0, 1e90, 0, 0, 0, 1], True),
    ([1, 0.999, 0, 0.999, 1, 0, 0, 0, 1], True),
    ([1, 0.5, 0, 0.5 + 1e-5, 1, 0, 0, 0, 1], False),
    ([1, 1, 0, 1, 1, 0, 0, 0, 1], False),
    ([1, 2, 0, 2, 1, 0, 0, 0, 1], False),
    ([1, 2, 2, 2, 1, 2, 2, 2, 1], False),  # eigenvalues 5, -1, -1: the determinant is positive
    ([1, 0.8, -0.8, 0.8, 1, 0.8, -0.8, 0.8, 1], False),  # all correlations of two are possible, that of three is not
    ([1, 0, 0, 0, -1, 0, 0, 0, 1], False),
    ([0, 0, 0, 0, 1, 0, 0, 0, 1], False),
    ([np.nan] * 9, False),
    ([1, 0, np.nan, 0, 1, 0, np.nan, 0, 1], False),
    ([1, 0, 0, 0, np.inf, 0, 0, 0, 1], False),
]


@pytest.mark.parametrize(("values", "good"), COVARIANCES)
def test_a_covariance_is_symmetric_and_positive_definite(values: list[float], good: bool) -> None:
    assert is_covariance(values) == good


def test_the_nees_interval_of_two_frames_by_hand() -> None:
    """Squares 3 and 12: mean 7.5. Chi-square with six degrees of freedom: 0.6757 at 0.5 %, 18.548 at 99.5 %.

    Half of these is the interval of the mean: consistent. With three degrees of freedom it would end at 6.42, and the
    verdict would be overconfident.
    """
    found = nees([3.0, 12.0])
    assert found is not None
    assert (found.frames, found.mean, found.within) == (2, 7.5, True)
    assert found.low == pytest.approx(0.6757 / 2, abs=0.5e-4)
    assert found.high == pytest.approx(18.548 / 2, abs=0.5e-3)
    overconfident = nees([3.0, 16.0])
    assert overconfident is not None
    assert not overconfident.within


def test_a_covariance_of_rounding_is_symmetric_and_of_a_thousandth_is_not() -> None:
    """Why MAX_ASYMMETRY is 1e-6: covariances may come from single precision, where a term is rounded by 6e-8.

    Sums of 16 such terms agree to 1e-6; entries that differ by more are not of one matrix.
    """
    rounded = np.float32(0.3)
    assert is_covariance([1, float(rounded), 0, 0.3, 1, 0, 0, 0, 1])
    assert is_covariance([1, 0.3, 0, 0.3 + 0.9e-6, 1, 0, 0, 0, 1])
    assert not is_covariance([1, 0.3, 0, 0.3 + 1.1e-6, 1, 0, 0, 0, 1])


def test_a_covariance_whose_inverse_has_no_digits_is_refused() -> None:
    """Why MIN_EIGENVALUE is 1e-14: a correlation matrix's inverse is off by eps over its smallest eigenvalue.

    eps is 2.2e-16, so that 1e-14 leaves 2 %, by which the mean NEES of 1700 frames scatters: sqrt(2 / (3 n)). Of
    [[1, r], [r, 1]] the eigenvalues are 1 - r and 1 + r.
    """
    for gap, good in ((4e-14, True), (2e-15, False), (0.0, False)):
        assert is_covariance([1, 1 - gap, 0, 1 - gap, 1, 0, 0, 0, 1]) == good
    # Of three equal correlations r the smallest is 1 + 2 r. Units do not count.
    for gap, good in ((1e-3, True), (1e-8, True), (4e-14, True), (-1e-8, False), (-1e-3, False)):
        across = (gap - 1) / 2
        matrix = np.array([[1, across, across], [across, 1, across], [across, across, 1]])
        scale = np.array([1e-6, 1.0, 1e4])
        assert is_covariance((scale[:, None] * matrix * scale).ravel().tolist()) == good


@pytest.mark.parametrize("error_m", [0.0, 5e-324, 1e-170, 1e-161, 1e-100])
def test_an_efficiency_is_finite_or_none_for_errors_of_any_size(error_m: float) -> None:
    """Squares below 5e-324 are zero, and so are errors below 1e-162; the largest bound of the format is 1.7e50 m."""
    found = against_bound([error_m], [3e100**0.5])
    assert found is not None
    assert (found.efficiency is None) == (error_m < 1e-162)
    assert found.efficiency is None or found.efficiency == pytest.approx(3e100**0.5 / found.rmse_m)


DEVICES, MAPS, FRAMES = 20, 4, 20


def nested_groups() -> Groups:
    device = [frame % DEVICES for frame in range(DEVICES * FRAMES)]
    return Groups.of(device, [one % MAPS for one in device])


def nested_errors(rng: np.random.Generator, by_device: float, by_map: float) -> NDArray[np.float64]:
    """Errors (frames, 3) of unit variance, of which devices and maps have the given shares in common."""
    groups = nested_groups()
    own = rng.normal(size=(len(groups.device), 3))
    of_device, of_map = rng.normal(size=(DEVICES, 3)), rng.normal(size=(MAPS, 3))
    shared = sqrt(by_device) * of_device[groups.device] + sqrt(by_map) * of_map[groups.map]
    return np.asarray(shared + sqrt(1 - by_device - by_map) * own)


@pytest.mark.parametrize(("by_device", "by_map"), [(0.2, 0.0), (0.2, 0.1), (0.4, 0.0)])
def test_the_nees_interval_by_devices_holds_for_frames_that_share_errors(by_device: float, by_map: float) -> None:
    """Of 300 consistent sets at least 94 % lie within the 99 % interval, by chi-square of independent frames fewer.

    300 draws of a probability of 0.97 give less than 0.94 once in 200, by the binomial distribution. With a
    share r in common the mean over n frames of a device has the variance 6 (1 + (n - 1) r^2) / n and not 6 / n.
    """
    rng, groups = np.random.default_rng(8), nested_groups()
    assert binom.cdf(0.94 * 300, 300, 0.97) < 5e-3
    held, by_frames = 0, 0
    for _ in range(300):
        squares = (nested_errors(rng, by_device, by_map) ** 2).sum(axis=1).tolist()
        found, independent = nees(squares, groups), nees(squares)
        assert found is not None
        assert independent is not None
        assert (found.frames, found.devices, found.maps) == (400, DEVICES, MAPS)
        assert found.mean == independent.mean
        held += found.within
        by_frames += independent.within
    assert held >= 0.94 * 300
    assert by_frames < held


def test_the_nees_interval_by_devices_finds_a_covariance_that_is_off() -> None:
    """Covariances too small by 2: the mean is 6 and the devices' relative scatter unchanged. Too large by 2: 1.5.

    With 20 devices that scatter by a third of their mean the interval is 3 (1 +- 2.86 / 3 / sqrt(20)), 0.64 wide.
    """
    rng, groups = np.random.default_rng(9), nested_groups()
    squares = (nested_errors(rng, 0.2, 0.0) ** 2).sum(axis=1)
    for factor, where in ((1.0, 0), (2.0, 1), (0.5, -1)):
        found = nees((factor * squares).tolist(), groups)
        assert found is not None
        assert (found.mean > found.high) - (found.mean < found.low) == where
        assert found.within == (where == 0)


def test_the_nees_interval_of_two_devices_by_hand() -> None:
    """Means 2 and 4: the standard error is 1, Student's quantile with one degree of freedom 63.657 at 99.5 %.

    By maps: the same two, so the same; with one device in each of two maps both tell one story.
    """
    groups = Groups.of([5, 5, 9, 9], [0, 0, 1, 1])
    found = nees([1.0, 3.0, 4.0, 4.0], groups)
    assert found is not None
    assert (found.devices, found.maps, found.mean, found.low) == (2, 2, 3.0, 0.0)
    assert found.high == pytest.approx(3 + 3 * 63.657 * 1 / 3, abs=2e-3)
    assert nees_by_map([1.0, 3.0, 4.0, 4.0], groups) == found
    assert nees_by_map([1.0, 3.0], groups.only(np.array([True, True, False, False]))) is None
    one = nees([1.0, 3.0], groups.only(np.array([True, True, False, False])))
    assert one == nees([1.0, 3.0])


def test_devices_that_agree_where_their_maps_do_not_are_counted_by_maps() -> None:
    """Four devices in two maps: means 2, 2, 4, 4. By devices the error is sqrt(4 / 3) / 2 = 0.577, by maps 1.

    The larger counts, with the devices' three degrees of freedom: 5.8409 at 99.5 %.
    """
    groups = Groups.of([0, 1, 2, 3], [0, 0, 1, 1])
    found = nees([2.0, 2.0, 4.0, 4.0], groups)
    assert found is not None
    assert found.high == pytest.approx(3 + 5.8409, abs=1e-4)


@pytest.mark.slow
def test_intervals_by_devices_are_as_wide_as_frames_that_share_errors_make_them() -> None:
    """95 % intervals of the RMSE hold the true one in at least 88 % of 200 sets; by independent frames in fewer.

    Below 0.88 are 200 draws of a probability of 0.93 once in 70. The true RMSE is sqrt(3).
    """
    rng, groups = np.random.default_rng(10), nested_groups()
    held, by_frames = 0, 0
    assert binom.cdf(0.88 * 200, 200, 0.93) < 1.5e-2
    for _ in range(200):
        errors = np.linalg.norm(nested_errors(rng, 0.3, 0.1), axis=1).tolist()
        found, independent = rmse_interval(errors, groups), rmse_interval(errors)
        assert found is not None
        assert independent is not None
        held += found.low_m <= sqrt(3) <= found.high_m
        by_frames += independent.low_m <= sqrt(3) <= independent.high_m
    assert held >= 0.88 * 200
    assert by_frames < 0.8 * 200


def test_a_resample_draws_whole_devices() -> None:
    """Two devices of equal errors, 1 and 3: an RMSE of a resample is 1, sqrt(5) or 3, so the limits are 1 and 3.

    In two maps with one device each as well. By frames, all 16 of a resample would be of one device once in 2^16. One
    device of many frames is resampled by frames.
    """
    errors, of_device = [1.0] * 8 + [3.0] * 8, [0] * 8 + [1] * 8
    for of_map in ([0] * 16, of_device):
        found = rmse_interval(errors, Groups.of(of_device, of_map))
        assert found is not None
        assert (found.low_m, found.high_m) == (pytest.approx(1.0), pytest.approx(3.0))
        assert median_interval(errors, Groups.of(of_device, of_map)) == found
    values = np.random.default_rng(3).normal(size=30).tolist()
    assert rmse_interval(values, Groups.of([4] * 30, [0] * 30)) == rmse_interval(values)


def test_devices_are_drawn_within_their_map() -> None:
    """Map 0 with two devices, map 1 with one of three frames: a resample has two maps, never a part of a device.

    Map 1 twice are six frames, map 0 twice eight, both seven. Each map is drawn once in two, each device of map 0 too:
    4 sigma of 1999 resamples are 4 sqrt(2 x 1/2 x 1/2 / 1999) = 0.063 for the times of a map.
    """
    groups = Groups.of([0, 0, 1, 1, 2, 2, 2], [0, 0, 0, 0, 1, 1, 1])
    counts = groups.resampled(np.random.default_rng(1))
    assert set(np.unique(counts.sum(axis=1)).tolist()) == {6, 7, 8}
    for device in (0, 1, 2):
        of_device = counts[:, groups.device == device]
        assert (of_device == of_device[:, :1]).all()
    assert counts[:, 0].mean() == pytest.approx(1.0, abs=0.09)  # given its map's times, as many draws again
    assert counts[:, 4].mean() == pytest.approx(1.0, abs=0.063)
    assert (counts[:, 0] + counts[:, 2] + 2 * counts[:, 4] == 4).all()


def test_statistics_of_resamples_are_those_of_their_values() -> None:
    """Each value as often as it is counted, written out, and then NumPy's median and root mean square."""
    rng = np.random.default_rng(2)
    values, counts = rng.normal(size=9), rng.integers(0, 4, (200, 9))
    written = [np.repeat(values, row) for row in counts]
    assert _medians(values, counts) == pytest.approx([np.median(one) for one in written])
    assert _root_mean_squares(values, counts) == pytest.approx([np.sqrt(np.mean(one**2)) for one in written])
