"""Robust fit: which spots are outliers, when covariances are widened, and minima that are told apart."""

from dataclasses import replace

import numpy as np
import pytest
from estimator_correspondences import device, simulated
from estimator_synthetic import Array, grid, view_of
from test_estimator_reprojection import bent_spots, fish_eye

from estimator.camera.pose import Pose, rotation
from estimator.errors import EstimationFailure
from estimator.methods.gravity_fit import _from_triples as from_triples
from estimator.methods.gravity_fit import agreement, ambiguous
from estimator.solvers import data_snooping, robust_fit
from estimator.solvers.chi_square import chi2_limit
from estimator.solvers.data_snooping import snooped
from estimator.solvers.local_minima import minima
from estimator.solvers.observations import Observations, observe
from estimator.solvers.reprojection import Fit
from estimator.solvers.robust_fit import Consensus, consensus
from estimator.solvers.robust_fit import _explains_all as explains_all
from estimator.solvers.robust_fit import _plausible as plausible
from estimator.solvers.robust_fit import _score as score

LEDS = grid(3, 3, 0.3, (3, 2, 3.0))
VIEW = view_of((3, 2, 3.0), 2.8, 25, -15, 40, (4000, 3000, 3000.0))
TRUTH = Pose(np.array(VIEW.position_m), VIEW.R_cam_world)
LIMIT = 2 * np.log(1e6)
"""Chi-square of two degrees of freedom exceeds x with the probability exp(-x / 2): one spot in a million this."""


def observed(offsets_px: Array, sigma_px: Array, error_deg: float = 0.1) -> Observations:
    """LEDS seen from VIEW, spots (9,) with offsets (9, 2) from their true pixels, and the sigma that each states."""
    spots = [
        replace(
            one,
            spot=replace(
                one.spot, u_px=one.spot.u_px + du, v_px=one.spot.v_px + dv, covariance_px2=sigma**2 * np.eye(2)
            ),
        )
        for one, (du, dv), sigma in zip(simulated(VIEW, LEDS), offsets_px, sigma_px, strict=True)
    ]
    return observe(device(VIEW, error_deg), spots)


def agreed(observations: Observations) -> Consensus:
    return consensus(observations, [TRUTH], list)


def fitted(cost: float, spots_chi2: Array, tilt_chi2: float = 0.0) -> Fit:
    return Fit(TRUTH, cost, spots_chi2, tilt_chi2, np.diag([1.0, 2.0, 3.0]))


@pytest.mark.parametrize(("spots", "gravity"), [(3, True), (4, False)])
def test_the_covariance_is_widened_where_chance_is_one_in_a_million(spots: int, gravity: bool) -> None:
    """Two numbers a spot and two of gravity, less six of the pose: two degrees of freedom either way."""
    for total, scale in ((0.99 * LIMIT, 1.0), (1.01 * LIMIT, 1.01 * LIMIT / 2)):
        best = fitted(total, np.full(spots, (total - 2 * gravity) / spots), 2.0 * gravity)
        found = Consensus(best, (), np.ones(spots, dtype=bool), gravity).covariance_m2
        np.testing.assert_allclose(found, np.diag([1.0, 2.0, 3.0]) * scale, rtol=1e-12)


def test_three_spots_alone_cannot_widen_their_covariance() -> None:
    """Six numbers for six parameters leave nothing to judge by."""
    lone = Consensus(fitted(1e3, np.full(3, 300.0)), (), np.ones(3, dtype=bool), gravity=False)
    np.testing.assert_allclose(lone.covariance_m2, np.diag([1.0, 2.0, 3.0]))


@pytest.mark.parametrize(("spots", "ratio"), [(6, 8 / 6), (4, 4 / 2), (3, 3.0)])
def test_errors_by_the_residuals_give_the_covariance_of_student_s_distribution(spots: int, ratio: float) -> None:
    """n / (n - 2) with n = 2 spots + 2 of gravity - 6 degrees of freedom, at least three, whatever chi-square is."""
    best = fitted(1e3, np.full(spots, 1e3 / spots))
    found = Consensus(best, (), np.ones(spots, dtype=bool), gravity=True, adapted=True)
    np.testing.assert_allclose(found.covariance_m2, ratio * np.diag([1.0, 2.0, 3.0]), rtol=1e-12)


@pytest.mark.parametrize("adapted", [False, True])
def test_an_unchecked_camera_adds_its_covariance_unscaled(adapted: bool) -> None:
    """Neither the scale of chi-square, 500, nor Student's, 2, applies to it."""
    best, unchecked_m2 = fitted(2e3, np.full(4, 500.0)), np.outer([0.0, 1.0, 20.0], [0.0, 1.0, 20.0])
    found = Consensus(best, (), np.ones(4, dtype=bool), True, adapted=adapted, unchecked_m2=unchecked_m2)
    scale = 2.0 if adapted else 500.0
    np.testing.assert_allclose(found.covariance_m2, scale * np.diag([1.0, 2.0, 3.0]) + unchecked_m2, rtol=1e-12)


@pytest.mark.parametrize(("sigma_px", "what"), [(1.0, "noise"), (0.05, "the image model")])
def test_a_spot_is_left_out_beyond_its_noise_and_the_model_s_error(sigma_px: float, what: str) -> None:
    """The other spots state a thousandth of a pixel and fix the pose; this one is off by more or less than the limit.

    0.1 px is what detection's centroids may be off behind the edge of a wall (test_estimator_detect), and a twentieth
    of what an LED of 5 px radius is moved by that is half hidden, 4 r / 3 pi.
    """
    limit_px = np.sqrt(LIMIT * (sigma_px**2 + 0.1**2))
    sigmas = np.full(9, 1e-3)
    sigmas[4] = sigma_px
    for share in (0.98, 1.02):
        offsets = np.zeros((9, 2))
        offsets[4] = share * limit_px * np.array([0.6, -0.8])
        found = agreed(observed(offsets, sigmas))
        expected = np.ones(9, dtype=bool)
        expected[4] = share < 1
        np.testing.assert_array_equal(found.inliers, expected, err_msg=what)
        assert len(found.best.spots_chi2) == expected.sum()


def test_true_spots_are_not_left_out() -> None:
    """450 spots with normal errors of 1 px: one of a million is an outlier, so 4 in 10 000 such tests have one."""
    rng = np.random.default_rng(5)
    for _ in range(50):
        found = agreed(observed(rng.standard_normal((9, 2)), np.ones(9)))
        assert found.inliers.all()


def test_two_wrong_spots_are_left_out_and_the_position_is_that_of_the_others() -> None:
    """One off by 1 px, one by 30 px: the second alone moves a fit of all by pixels, so that true spots look wrong."""
    offsets = np.zeros((9, 2))
    offsets[2], offsets[7] = (1.0, 0.0), (-18.0, 24.0)
    found = agreed(observed(offsets, np.full(9, 0.02)))
    assert np.flatnonzero(~found.inliers).tolist() == [2, 7]
    # Exact pixels of the others; 1e-4 px of them are some 1e-7 m.
    np.testing.assert_allclose(found.best.pose.position_m, VIEW.position_m, atol=1e-7)


def test_the_worst_spot_alone_is_removed() -> None:
    """Two spots off by 3 and 5 px to one side: the robust fit leaves out the second alone, and a fit of the others does
    not explain the first.
    """
    offsets = np.zeros((9, 2))
    offsets[3], offsets[6] = (4.1, -2.8), (2.9, -0.8)
    found = agreed(observed(offsets, np.full(9, 0.2)))
    assert np.flatnonzero(~found.inliers).tolist() == [3, 6]


def test_data_snooping_leaves_out_the_spot_that_is_off() -> None:
    """From all nine spots, of 0.2 px, and one of them off by 4 px, which pulls the fit."""
    offsets = np.zeros((9, 2))
    offsets[4] = (2.4, -3.2)
    found = snooped(observed(offsets, np.full(9, 0.2)), TRUTH, np.ones(9, dtype=bool), adapted=False)
    assert found is not None
    assert np.flatnonzero(~found[2]).tolist() == [4]


def test_a_spot_that_was_left_out_returns_if_it_passes() -> None:
    """Three of nine spots, of 0.2 px, are not there to begin with; the one of them that is off by 4 px stays out."""
    offsets, begun = np.zeros((9, 2)), ~np.isin(np.arange(9), [1, 4, 8])
    offsets[4] = (2.4, -3.2)
    found = snooped(observed(offsets, np.full(9, 0.2)), TRUTH, begun, adapted=False)
    assert found is not None
    assert np.flatnonzero(~found[2]).tolist() == [4]
    assert len(found[1].spots_chi2) == 8


@pytest.mark.parametrize(("share", "expected"), [(0.99, True), (1.01, False)])
def test_a_reading_of_gravity_is_plausible_up_to_one_in_a_million(share: float, expected: bool) -> None:
    """Two tilts: chi-square of two degrees of freedom, however many the spots have. Beside errors of a camera as sold,
    the spots do not check it.
    """
    best = fitted(share * LIMIT, np.zeros(9), share * LIMIT)
    found = Consensus(best, (), np.ones(9, dtype=bool), gravity=True)
    assert plausible(found, observed(np.zeros((9, 2)), np.ones(9)).with_assumed_camera()) == expected


def test_an_outlier_costs_the_area_where_it_may_be() -> None:
    """Two explanations that differ in one spot alone: its normal density of sigma 1 px at 0 is 1 / (2 pi), the
    uniform one of an outlier 1 / (pi r^2), with r a hundredth of the 4000 px of the width, as far as a decoded pixel
    may be off. The score is minus twice the logarithm. A variance has (1e-4 px)^2 beside: 2e-8 of the score.
    """
    seen, eight = observed(np.zeros((9, 2)), np.ones(9)), np.arange(9) != 4
    nine, out = (score(Consensus(fitted(0.0, np.zeros(9)), (), one, True), seen) for one in (eight | True, eight))
    assert out - nine == pytest.approx(2 * np.log(np.pi * 40**2) - 2 * np.log(2 * np.pi), abs=1e-7)


def sure_of(found: Consensus) -> float:
    """Squared error of the position in units of the covariance."""
    error = found.best.pose.position_m - VIEW.position_m
    return float(error @ np.linalg.solve(found.covariance_m2, error))


@pytest.mark.parametrize("spots", [8, 9])
def test_four_spots_are_not_most_of_eight(spots: int) -> None:
    """The other four or five are anywhere: no more than half of all agree on a pose. 120 px uniformly to both sides
    are 70 px, more than the 30 px of an error of 0.01 rad that a map may have.
    """
    rng = np.random.default_rng(2)
    offsets = np.zeros((9, 2))
    offsets[[1, 3, 5, 7, 4]] = rng.uniform(-60, 60, (5, 2))
    chosen = np.arange(9) != (4 if spots == 8 else 9)
    with pytest.raises(EstimationFailure, match="position: no pose explains gravity and most of the spots"):
        agreed(observed(2 * offsets, np.full(9, 0.02)).only(chosen))
    offsets[[4, 5]] = 0
    exact = agreed(observed(offsets, np.full(9, 0.02)))
    assert np.flatnonzero(~exact.inliers).tolist() == [1, 3, 7]
    assert not exact.adapted


def test_four_sharp_spots_are_not_most_of_eight() -> None:
    """Four spots of 0.02 px hold the fit against four of 5 px, off by 100 px or 20 sigma each: half of all pass."""
    offsets, sigma_px = np.zeros((9, 2)), np.full(9, 0.02)
    offsets[[1, 3, 5, 7]] = 100 * np.array([[0.6, 0.8], [-0.8, 0.6], [0.0, -1.0], [0.8, -0.6]])
    sigma_px[[1, 3, 5, 7]] = 5.0
    seen = observed(offsets, sigma_px)
    with pytest.raises(EstimationFailure, match="position: no pose explains gravity and most of the spots"):
        agreed(seen.only(np.arange(9) != 4))
    found = agreed(seen)
    assert np.flatnonzero(~found.inliers).tolist() == [1, 3, 5, 7]


def test_three_spots_do_not_outvote_a_fourth() -> None:
    """Three spots fit some pose whichever they are: a fourth that does not fit it may be the only right one."""
    offsets = np.zeros((9, 2))
    offsets[8] = (20.0, 10.0)
    corners = np.isin(np.arange(9), [0, 2, 6, 8])
    found = agreed(observed(offsets, np.full(9, 0.02), 1e-3).only(corners))
    assert found.inliers.all()
    assert found.adapted
    assert sure_of(found) < 30.7


def test_a_wrong_reading_of_gravity_is_left_out() -> None:
    """Off by 2 deg, said to be good to 0.1 deg, and 9 spots of 0.02 px that fix the tilt to a hundredth of that."""
    seen = observed(np.zeros((9, 2)), np.full(9, 0.02))
    wrong = replace(seen, tilt_rad=seen.tilt_rad + np.radians([2.0, 0.0]))
    found = agreement(wrong)
    assert not found.gravity
    assert found.inliers.all()
    assert agreement(seen).gravity
    np.testing.assert_allclose(found.best.pose.position_m, VIEW.position_m, atol=1e-7)


def test_one_minimum_is_given_once_and_the_best_first() -> None:
    """Starts on all sides lead to the true pose, and to the second one of a plane, which gravity makes worse."""
    small = grid(2, 2, 0.06, (3, 2, 3.0))
    view = view_of((3, 2, 3.0), 3.0, 15, 0, 10, (800, 600, 3000.0))
    seen = observe(device(view, 20.0), simulated(view, small, 0.1))
    starts = [
        Pose(np.array(view_of((3, 2, 3.0), 3.0, tilt, 0, 10).position_m), rotation(*np.radians([tilt, 0, 10])))
        for tilt in (14.0, -14.0, 15.5, -16.0)
    ]
    found = minima(seen, starts[::-1])
    assert len(found) == 2
    assert found[0].cost < found[1].cost
    np.testing.assert_allclose(found[0].pose.position_m, view.position_m, atol=1e-6)


def test_centroids_of_a_lens_that_bends_are_corrected() -> None:
    """A fish-eye, discs of 2 cm, 2 m away: 2 um are left, and some tens without the correction, as is derived in
    test_estimator_reprojection.
    """
    leds = grid(3, 3, 0.6, (3, 3.2, 3.4))
    view = view_of((3, 3.2, 3.4), 2.0, 15, -10, 30, (4000, 3000, 1500.0))
    frame, spots = bent_spots(view, leds, fish_eye, {"projection": "equidistant"})
    found = consensus(observe(frame, spots), [Pose(np.array(view.position_m), view.R_cam_world)], list)
    assert np.linalg.norm(found.best.pose.position_m - view.position_m) < 2e-6


@pytest.mark.parametrize(("share", "expected"), [(0.98, True), (1.02, False)])
def test_a_minimum_of_a_hundredth_of_the_likelihood_is_ambiguous(share: float, expected: bool) -> None:
    """The likelihood goes with exp(-cost / 2): a hundredth at a cost higher by 2 ln 100."""
    other = fitted(3.0 + share * 2 * np.log(100), np.ones(4))
    assert ambiguous(Consensus(fitted(3.0, np.ones(4)), (other,), np.ones(4, dtype=bool), True)) is expected


@pytest.mark.parametrize("depth_m", [0.3, 2.8])
def test_leds_at_any_depth_in_front_of_the_camera_have_a_pose(depth_m: float) -> None:
    view = view_of((3, 2, 3.0), depth_m, 10, -5, 40, (4000, 3000, 3000.0))
    seen = observe(device(view, 0.1), simulated(view, grid(3, 3, 0.1 * depth_m, (3, 2, 3.0)), 0.02))
    pose = Pose(np.array(view.position_m), view.R_cam_world)
    assert len(minima(seen, [pose])) == len(minima(seen, [pose], robust=True)) == 1


def test_poses_of_three_spots_are_ranked_by_the_others() -> None:
    """Three of seven spots are wrong, and every triple is tried, also those on one line, which have none. The best
    poses are those of three true spots, exact but for rounding, which the pattern makes some hundred times more.
    """
    offsets = np.zeros((9, 2))
    offsets[[0, 2, 5]] = [(80.0, -60.0), (-40.0, 90.0), (70.0, 70.0)]
    seven = observed(offsets, np.full(9, 0.02)).only(np.arange(9) < 7)
    for pose in from_triples(seven):
        np.testing.assert_allclose(pose.position_m, VIEW.position_m, atol=1e-6)


def test_a_size_of_errors_that_no_fit_settles_leaves_the_other_explanations(monkeypatch: pytest.MonkeyPatch) -> None:
    """One wrong spot of nine: errors as stated with an outlier explain it, without errors by the residuals."""

    def unsettled(*_: object) -> None:
        raise EstimationFailure("position", "the covariance of the spots is not positive definite")

    monkeypatch.setattr(data_snooping, "_settled", unsettled)
    monkeypatch.setattr(robust_fit, "MIN_SURE_INLIERS", 99)  # so that every explanation is tried
    monkeypatch.setattr(robust_fit, "MIN_SURE_SHARE", 99.0)
    found = agreed(observed(np.vstack([np.zeros((8, 2)), [[30.0, 0.0]]]), np.full(9, 0.02)))
    assert found.inliers.tolist() == [True] * 8 + [False]


def test_a_fit_explains_gravity_up_to_the_limit_itself() -> None:
    """As with spots, whose limit belongs to what is explained."""
    seen = observed(np.zeros((9, 2)), np.ones(9))
    limit = chi2_limit(data_snooping.OUTLIER_PROBABILITY, 2)
    assert explains_all(fitted(limit, np.zeros(9), limit), seen)
    assert not explains_all(fitted(limit, np.zeros(9), float(np.nextafter(limit, np.inf))), seen)
