"""Search of the most likely pose: the length of its steps, and LEDs that it leaves out."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from estimator_synthetic import Array, poisson, render, view_of
from test_estimator_likelihood import SIX, TARGET, drawn, gathered, true_pose
from test_estimator_maximum_likelihood import frame_of

from estimator.camera.pose import Pose
from estimator.pixels import search
from estimator.pixels.elimination import Solution
from estimator.pixels.initial import gravity_of, tuned
from estimator.pixels.led_model import PRINCIPAL_POINT, SIZE_PARAMETER, RenderedLeds
from estimator.pixels.led_pixels import LedPixels
from estimator.pixels.likelihood import Noise, PhotometricFit, fit_photometry, score
from estimator.pixels.nuisances import NO_COMPONENTS, NO_GRAVITY, SIZE, Components, Nuisances, Priors
from estimator.pixels.search import ScoringResult, Search, is_last, step_factor, unexplained


def step_of(length: float) -> Solution:
    """A step of the first parameter of the view, in standard deviations."""
    step, none = np.zeros(6), np.zeros(0)
    step[0] = length
    zero = Nuisances(none, none, none, none)
    return Solution(step, zero, np.eye(6), np.zeros((0, 9)), length**2, np.eye(6))


@pytest.mark.parametrize("curvature", [0.8, 1.0, 1.4, 2.2, 3.0, 3.8])
def test_steps_end_where_the_likelihood_is_curved_up_to_four_times_as_the_information_says(curvature: float) -> None:
    """From x a step is -c x. Full steps leave (1 - c) x: they take back the share c - 1 of the one before, and from
    c = 2 on they grow. Half steps leave (1 - c / 2) x, which is less up to c = 4.
    """
    x, factor, before = 1.0, 1.0, None
    for _ in range(200):
        step = step_of(-curvature * x)
        factor = 1.0 if before is None else step_factor(step, before, factor)
        x, before = x + factor * step.view_step[0], step
    assert abs(x) < 1e-3


def test_a_step_that_takes_back_less_than_half_is_a_full_one() -> None:
    """Halved, a search with a curvature of less than 1.5 would leave more than with full steps."""
    assert step_factor(step_of(-0.49), step_of(1.0), 1.0) == 1.0
    assert step_factor(step_of(-0.51), step_of(1.0), 1.0) == 0.5
    assert step_factor(step_of(-0.24), step_of(1.0), 0.5) == 1.0  # of half a step before
    assert step_factor(step_of(-0.26), step_of(1.0), 0.5) == 0.5


def test_a_step_of_a_third_of_a_standard_deviation_is_the_last_where_it_is_a_tenth_of_the_one_before() -> None:
    """A tenth of it is left then, less than of the step of a tenth that ends a search anyway."""
    assert is_last(0.09**2, 0.0, 1.0, are_large=False)
    assert is_last(0.3**2, 3.1**2, 0.9e-4, are_large=True)
    assert not is_last(0.3**2, 2.9**2, 0.9e-4, are_large=True)
    assert not is_last(0.32**2, 10.0**2, 0.9e-4, are_large=True)
    assert not is_last(0.3**2, 3.1**2, 1.1e-4, are_large=True), "it moves an image"
    assert not is_last(0.3**2, 3.1**2, 0.9e-4, are_large=False), "weights are not settled"
    assert not is_last(0.3**2, 0.0, 0.9e-4, are_large=True), "the first step"


@pytest.mark.parametrize(("moved_px", "shortened"), [(0.5, True), (0.015, False)])
def test_a_step_that_makes_the_images_less_likely_is_cut_to_a_quarter(
    monkeypatch: pytest.MonkeyPatch, moved_px: float, shortened: bool
) -> None:
    """Half a pixel from the maximum edges of 4000 e are off by hundreds of them, where noise is 60. A step that moves
    no image by 0.02 px is taken as it is. The search ends at the maximum either way.
    """
    frame = drawn(4000.0, 3)
    pose = true_pose(frame)
    pixels, priors = gathered(frame, pose), Priors.of(frame)
    used, zero = np.ones(len(pixels.leds), dtype=bool), Nuisances.zero(priors)

    def searched() -> ScoringResult:
        return Search(frame, pixels, NO_GRAVITY, priors, np.eye(6), 0.0).run(used, pose, zero, NO_COMPONENTS)

    free, factors, steps = searched(), list[float](), 0

    def first_wrong(*arguments: Any) -> tuple[Components, Solution]:
        nonlocal steps
        components, step = tuned(*arguments)
        steps += 1
        turn = np.array([0, 0, 0, moved_px / frame.camera.K[0][0], 0, 0])
        return components, replace(step, view_step=turn, step2=1e6) if steps == 1 else step

    def noted(of: Search, start: tuple[Pose, Nuisances], step: Solution, factor: float) -> tuple[Pose, Nuisances]:
        factors.append(factor)
        return moved(of, start, step, factor)

    moved = Search._moved
    monkeypatch.setattr(search, "tuned", first_wrong)
    monkeypatch.setattr(Search, "_moved", noted)
    found = searched()
    assert found.converged
    assert factors[:2] == [1.0, 0.25 if shortened else 0.5]  # a half where the next step takes it back
    off_m = found.pose.position_m - free.pose.position_m
    assert off_m @ np.linalg.solve(free.solution.covariance[:3, :3], off_m) < 0.1**2


def test_what_is_to_be_checked_is_scored_in_the_last_step_and_changes_no_estimate() -> None:
    """By pose, size and principal point, and the profile's three: the search's own maximum has no gradient by the pose
    there, but for the last step, at most a tenth of a standard deviation, 0.1 by its information's root.
    """
    frame = drawn(4000.0, 3)
    pose = true_pose(frame)
    pixels, priors = gathered(frame, pose), Priors.of(frame)
    used, zero = np.ones(len(pixels.leds), dtype=bool), Nuisances.zero(priors)
    to_check = np.array([*range(6), *PRINCIPAL_POINT, SIZE_PARAMETER])
    alone, checked = (
        Search(frame, pixels, NO_GRAVITY, priors, np.eye(6), 0.0, columns).run(used, pose, zero, NO_COMPONENTS)
        for columns in (None, to_check)
    )
    assert alone.checked is None
    np.testing.assert_allclose(checked.pose.position_m, alone.pose.position_m, rtol=1e-12)
    np.testing.assert_allclose(checked.solution.covariance, alone.solution.covariance, rtol=1e-9)
    assert checked.checked is not None
    information, gradient = (one.sum(axis=0) for one in checked.checked)
    informed = [*to_check, *range(SIZE_PARAMETER + 3, SIZE_PARAMETER + 6)]
    assert np.flatnonzero(np.diag(information)).tolist() == informed
    view = np.s_[:6]
    assert gradient[view] @ np.linalg.solve(information[view, view], gradient[view]) < 0.1**2


@pytest.mark.parametrize("angle_rad", [0.0, 2e-4])
def test_a_step_is_by_amplitudes_and_background_at_its_own_pose(
    monkeypatch: pytest.MonkeyPatch, angle_rad: float
) -> None:
    """A search may start where its pixels were gathered, whose light is fitted already, or 0.3 px beside (a second one,
    without a wrong LED): the light of the first pose would bend the first step.
    """
    frame = drawn(4000.0, 3)
    pose = true_pose(frame)
    pixels, priors = gathered(frame, pose), Priors.of(frame)
    used, steps = np.ones(len(pixels.leds), dtype=bool), list[tuple[RenderedLeds, PhotometricFit]]()

    def noted(
        of: LedPixels, rendered: RenderedLeds, photometry: PhotometricFit, profile: Array | None
    ) -> tuple[Array, Array]:
        steps.append((rendered, photometry))
        return score(of, rendered, photometry, profile)

    monkeypatch.setattr(search, "score", noted)
    start = pose.moved(np.array([0, 0, 0, angle_rad, 0, 0]), frame.camera) if angle_rad else pose
    made = Search(frame, pixels, gravity_of(frame), priors, np.eye(6), 0.0)
    assert made.run(used, start, Nuisances.zero(priors), NO_COMPONENTS).converged
    rendered, photometry = steps[0]
    assert (rendered is pixels.rendered) == (angle_rad == 0)
    expected = fit_photometry(pixels, rendered, used, Noise.of(frame))
    np.testing.assert_array_equal(photometry.amplitude, expected.amplitude)
    np.testing.assert_array_equal(photometry.background, expected.background)


def test_the_hold_on_the_start_is_gone_at_the_maximum() -> None:
    """Steps that are short are right, and each holds the next one less: the search ends where it ends without a hold,
    to the tenth of a standard deviation at which it is converged.
    """
    frame = drawn(4000.0, 3)
    pose = true_pose(frame)
    pixels, priors = gathered(frame, pose), Priors.of(frame)
    used, zero = np.ones(len(pixels.leds), dtype=bool), Nuisances.zero(priors)

    def searched(information: Array, damping: float) -> ScoringResult:
        made = Search(frame, pixels, gravity_of(frame), priors, information, damping)
        return made.run(used, pose, zero, NO_COMPONENTS)

    free = searched(np.eye(6), 0.0)
    held = searched(free.solution.information, 1.0)
    assert held.converged
    assert held.damping == 0.0
    moved_m = held.pose.position_m - free.pose.position_m
    assert moved_m @ np.linalg.solve(free.solution.covariance[:3, :3], moved_m) < 0.1**2


def test_a_background_makes_the_size_of_a_small_image_uncertain() -> None:
    """Edges displaced by 0.02 px times the background's share: of discs of 10 mm, 3 m above a level camera of 1500 px,
    5 px in radius, wherever in the image. The map is level and so is the camera: rounding alone differs.
    """
    view = view_of(TARGET, 3.0, 0.0, 0.0, 30.0)
    image = poisson(render(view, SIX, 0.01, 4000.0, samples=8), 1)
    frame = frame_of(view, SIX, image.astype(np.uint32))
    pose = Pose(np.array(view.position_m), view.R_cam_world)
    pixels, priors = gathered(frame, pose), Priors.of(frame)
    made = Search(frame, pixels, gravity_of(frame), priors, np.eye(6), 0.0)
    photometry = fit_photometry(pixels, pixels.rendered, np.ones(6, dtype=bool), Noise.of(frame))
    radius_px = 5 * np.sqrt(np.pi / 2)  # to the vertices of a square of the same area, which stand for the rim
    share = np.array([(photometry.background / photometry.amplitude)[pixels.led == k].max() for k in range(6)])
    sizes = made._with_edge_errors(photometry).leds[:, SIZE]
    np.testing.assert_allclose(sizes, np.hypot(priors.leds[:, SIZE], 0.02 * share / radius_px), rtol=1e-6)


@pytest.mark.parametrize("seed", [0, 3, 4, 5])
def test_readings_near_saturation_do_not_go_round(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """Faces of 2000 e with noise of 200 e saturate at 2600 e, three standard deviations above: a brighter amplitude
    excludes faces, without which it is darker. A search in which they enter and leave for ever takes all forty steps;
    without saturation the same images take six at most: half of forty is far from either.
    """
    view, noise_e, black_dn = view_of(TARGET, 3.0, 25.0, -15.0, 30.0), 200.0, 4000.0
    expected_e = render(view, SIX, 0.01, 2000.0)
    rng = np.random.default_rng(seed)
    image = np.rint(rng.poisson(expected_e) + rng.normal(black_dn, noise_e, expected_e.shape))
    frame = frame_of(view, SIX, np.clip(image, 0, black_dn + 2600.0).astype(np.uint32))
    sensor = {"noise": "full", "read_noise_e": noise_e, "black_level_dn": black_dn, "full_well_e": 2600.0}
    frame = replace(frame, sensor=frame.sensor.model_copy(update=sensor))
    pose, priors = true_pose(frame), Priors.of(frame)
    steps = 0

    def counted(
        pixels: LedPixels, rendered: RenderedLeds, photometry: PhotometricFit, profile: Array | None
    ) -> tuple[Array, Array]:
        nonlocal steps
        steps += 1
        return score(pixels, rendered, photometry, profile)

    monkeypatch.setattr(search, "score", counted)
    pixels = gathered(frame, pose)
    made = Search(frame, pixels, gravity_of(frame), priors, np.eye(6), 0.0)
    assert made.run(np.ones(len(pixels.leds), dtype=bool), pose, Nuisances.zero(priors), NO_COMPONENTS).converged
    assert steps <= 20


def result_of(excess: Array, used: Array, faint: Array) -> ScoringResult:
    """What `unexplained` needs of a search's result."""
    made = object.__new__(ScoringResult)
    for name, value in {"excess": excess, "used": used, "faint": faint}.items():
        object.__setattr__(made, name, value)
    return made


def test_of_unexplained_leds_those_with_a_quarter_of_the_largest_excess_are_left_out() -> None:
    """Three like LEDs fix a common shift of their images. One that is d off moves the pose by d / 3, stays 2 d / 3 off
    itself, and the true ones are d / 3 off: a quarter of its square, and less among more LEDs. One with more is wrong
    itself.
    """
    none = np.zeros(4, dtype=bool)
    excess = np.array([100.0, 26.0, 24.0, -5.0])
    assert unexplained(result_of(excess, ~none, none)).tolist() == [True, True, False, False]
    # an LED that is left out already does not count, nor do those that are explained
    assert unexplained(result_of(excess, np.array([False, True, True, True]), none)).tolist() == [
        False,
        True,
        True,
        False,
    ]
    assert not unexplained(result_of(-excess[:3], ~none[:3], none[:3])).any()


def test_faint_leds_are_left_out_before_others() -> None:
    faint = np.array([False, False, True])
    assert (
        unexplained(result_of(np.array([100.0, 0.0, -1.0]), np.ones(3, dtype=bool), faint)).tolist() == faint.tolist()
    )
