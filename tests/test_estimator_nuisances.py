"""Nuisances of LED images: elimination against one dense least-squares problem, and priors from statements."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from estimator.pixels.elimination import solve, square_root
from estimator.pixels.led_model import LOCAL_PARAMETERS
from estimator.pixels.nuisances import (
    LED_PARAMETERS,
    NO_COMPONENTS,
    Components,
    Gravity,
    Nuisances,
    Priors,
)

Floats = NDArray[np.float64]
LEDS, LUMINAIRES, ROWS = 5, 2, 9
LED_OF = np.array([0, 0, 1, 1, -1])


def drawn_priors(generator: np.random.Generator) -> Priors:
    return Priors(
        camera=generator.uniform(0.1, 1, 7),
        datum=generator.uniform(0.1, 1, 4),
        luminaires=generator.uniform(0.1, 1, (LUMINAIRES, 6)),
        leds=generator.uniform(0.1, 1, (LEDS, LED_PARAMETERS)),
        positions_m=generator.standard_normal((LEDS, 3)),
        centres_m=generator.standard_normal((LUMINAIRES, 3)),
        luminaire=LED_OF,
    )


def cross(centre: Floats, point: Floats) -> Floats:
    """Derivative (3, 3) of a small rotation about `centre`, w x (point - centre), by w."""
    return np.stack([np.cross(axis, point - centre) for axis in np.eye(3)], axis=1)


@pytest.mark.parametrize("some_are_exact", [False, True])
@pytest.mark.parametrize("hung", [True, False])
def test_elimination_gives_what_all_unknowns_at_once_give(some_are_exact: bool, hung: bool) -> None:
    """One design matrix of pose, camera, datum, luminaires and LEDs, by hand, with a row for each prior: the step and
    the pose's covariance agree to rounding, 1e-16 times a condition number of some 1e4, and margin. What is known
    exactly is none of the unknowns, and does not move.
    """
    generator = np.random.default_rng(1)
    priors = drawn_priors(generator)
    led_of = LED_OF if hung else np.full(LEDS, -1)
    priors = replace(priors, luminaire=led_of)
    if some_are_exact:
        for part in (priors.camera[2:5], priors.datum[3:], priors.leds[:, 4:6], priors.leds[2]):
            part[...] = 0.0
    now = Nuisances(*(generator.standard_normal(one.shape) for one in vars(Nuisances.zero(priors)).values()))
    for value, sigma in ((now.camera, priors.camera), (now.datum, priors.datum), (now.leds, priors.leds)):
        value[sigma == 0] = 0.0
    rows, right = generator.standard_normal((LEDS, ROWS, LOCAL_PARAMETERS)), generator.standard_normal((LEDS, ROWS))
    gravity, angles = Gravity(np.array([0.1, 0.2]), np.array([0.3, 0.4])), np.array([0.0, 0.1, 0.5])
    found = solve(rows, right, priors, now, gravity, angles)

    pose, camera, datum = np.arange(6), 6 + np.arange(7), 13 + np.arange(4)
    luminaires = 17 + np.arange(6 * LUMINAIRES).reshape(LUMINAIRES, 6)
    leds = 17 + 6 * LUMINAIRES + np.arange(LED_PARAMETERS * LEDS).reshape(LEDS, LED_PARAMETERS)
    count = int(leds.max()) + 1
    blocks = []
    for k in range(LEDS):
        block, moves = np.zeros((ROWS, count)), -rows[k][:, :3]
        block[:, pose], block[:, camera] = rows[k][:, :6], rows[k][:, 6:13]
        block[:, datum[:3]], block[:, datum[3]] = moves, moves @ priors.positions_m[k]
        if led_of[k] >= 0:
            own = luminaires[led_of[k]]
            block[:, own[:3]] = moves
            block[:, own[3:]] = moves @ cross(priors.centres_m[led_of[k]], priors.positions_m[k])
        block[:, leds[k]] = np.column_stack([moves, rows[k][:, 13:]])
        blocks.append(block)
    sigmas = np.concatenate([priors.camera, priors.datum, priors.luminaires.ravel(), priors.leds.ravel()])
    values = np.concatenate([now.camera, now.datum, now.luminaires.ravel(), now.leds.ravel()])
    unknown = np.concatenate([np.ones(6, dtype=bool), sigmas > 0])
    held = np.zeros((count - 6, count))
    held[:, 6:] = np.diag(np.divide(1.0, sigmas, out=np.zeros_like(sigmas), where=sigmas > 0))
    tilt = np.zeros((2, count))
    tilt[0, 3], tilt[1, 4] = 1 / gravity.sigma
    design = np.concatenate([*blocks, held, tilt])
    measured = np.concatenate([right.ravel(), -held[:, 6:] @ values, (gravity.tilts - angles[:2]) / gravity.sigma])
    expected = np.zeros(count)
    expected[unknown] = np.linalg.lstsq(design[:, unknown], measured, rcond=None)[0]
    covariance = np.linalg.inv(design[:, unknown].T @ design[:, unknown])
    np.testing.assert_allclose(found.pose_step, expected[pose], rtol=1e-9)
    np.testing.assert_allclose(found.step.camera, expected[camera], rtol=1e-9)
    np.testing.assert_allclose(found.step.datum, expected[datum], rtol=1e-9)
    if hung:
        np.testing.assert_allclose(found.step.luminaires, expected[luminaires], rtol=1e-9)
    np.testing.assert_allclose(found.step.leds, expected[leds], rtol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance[:6, :6], rtol=1e-8)


def test_a_square_root_has_the_information_and_the_gradient() -> None:
    """R^T R is the information and R^T r the gradient, of 20 readings by parameters of very different units."""
    generator = np.random.default_rng(2)
    design = generator.standard_normal((3, 20, LOCAL_PARAMETERS)) * 10.0 ** generator.integers(-4, 5, LOCAL_PARAMETERS)
    information = design.transpose(0, 2, 1) @ design
    gradient = np.einsum("nrp,nr->np", design, generator.standard_normal((3, 20)))
    rows, right = square_root(information, gradient, np.arange(LOCAL_PARAMETERS))
    np.testing.assert_allclose(rows.transpose(0, 2, 1) @ rows, information, rtol=1e-6)
    np.testing.assert_allclose(np.einsum("nrp,nr->np", rows, right), gradient, rtol=1e-6)


def test_a_square_root_of_some_parameters_takes_the_others_as_known() -> None:
    """It has their information and gradient, and as many rows as they are; the others' columns are 0."""
    design, some = np.random.default_rng(2).standard_normal((3, 30, LOCAL_PARAMETERS)), np.array([0, 2, 5, 13])
    gradient = design.sum(axis=1)
    rows, right = square_root(design.transpose(0, 2, 1) @ design, gradient, some)
    assert rows.shape == (3, len(some), LOCAL_PARAMETERS)
    np.testing.assert_allclose(
        rows[:, :, some].transpose(0, 2, 1) @ rows[:, :, some],
        (design.transpose(0, 2, 1) @ design)[:, some][:, :, some],
        rtol=1e-9,
    )
    np.testing.assert_allclose(np.einsum("nrp,nr->np", rows, right)[:, some], gradient[:, some], rtol=1e-9)
    assert not np.delete(rows, some, axis=2).any()


def test_a_component_is_what_values_and_redundancy_say() -> None:
    """50 LEDs displaced by 2 mm along each axis, fully redundant: 2 mm again, to 1 / sqrt(2 150) of it, four times."""
    generator = np.random.default_rng(3)
    nothing = np.zeros((50, LED_PARAMETERS))
    stated = Priors(
        np.zeros(7), np.zeros(4), np.zeros((0, 6)), nothing, np.zeros((50, 3)), np.zeros((0, 3)), np.full(50, -1)
    )
    values = Nuisances.zero(stated)
    values.leds[:, :3] = 2e-3 * generator.standard_normal((50, 3))
    redundancy, used = np.ones((50, LED_PARAMETERS)), np.ones(50, dtype=bool)
    found = Components(place_m=1e-3).updated(stated, values, redundancy, used)
    assert abs(found.place_m / 2e-3 - 1) < 4 / np.sqrt(2 * 150)
    assert (found.size, found.profile) == (0.0, 0.0)
    # Nothing is controlled: the component stays.
    assert Components(place_m=1e-3).updated(stated, values, 0 * redundancy, used) == Components(place_m=1e-3)
    assert NO_COMPONENTS.added(stated).exact


def test_tilts_on_both_sides_of_half_a_turn_are_near_each_other() -> None:
    """Measured 0.01 rad before half a turn, the rig is 0.02 rad beyond it: 0.03 rad back, 3 standard deviations."""
    gravity = Gravity(np.array([np.pi - 0.01, 0.1]), np.array([0.01, 0.01]))
    residual = gravity.residual(np.array([-np.pi + 0.02, 0.1, 0.0]))
    np.testing.assert_allclose(residual, [-3.0, 0.0], atol=1e-12)  # rounding of pi, 4e-16, over 0.01


def test_shifts_are_those_of_the_datum_the_luminaires_and_the_leds_together() -> None:
    """An LED at p of a luminaire about c: its own shift, the map's, its scale times p, the luminaire's, w x (p - c)."""
    generator = np.random.default_rng(5)
    priors = drawn_priors(generator)
    now = Nuisances(*(generator.standard_normal(one.shape) for one in vars(Nuisances.zero(priors)).values()))
    found = now.shifts_m(priors)
    for k, own in enumerate(LED_OF.tolist()):
        expected = now.leds[k, :3] + now.datum[:3] + now.datum[3] * priors.positions_m[k]
        if own >= 0:
            arm_m = priors.positions_m[k] - priors.centres_m[own]
            expected = expected + now.luminaires[own, :3] + np.cross(now.luminaires[own, 3:], arm_m)
        np.testing.assert_allclose(found[k], expected, rtol=1e-12)
