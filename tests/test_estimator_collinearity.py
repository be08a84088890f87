"""Collinearity equations: exact for exact images, covariance as least squares predict, failures by name."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from estimator_synthetic import Array, View, grid, view_of

from estimator.camera.pose import Pose
from estimator.camera.projection import Equidistant, Perspective, Projection
from estimator.errors import EstimationFailure
from estimator.solvers.collinearity import fit_pose, position_by_collinearity, starts

CEILING_M = 2.7
PANEL = grid(5, 4, 0.14, (3, 2, CEILING_M))
WIDE_GRID = grid(6, 4, 1.0, (3.5, 2.5, CEILING_M))
TABLE_1 = np.array([[0.5, 1.5, 3.5], [0.3, 1.9, 3.5], [0.8, 1.2, 3.5], [0.9, 1.1, 3.5]])
TILTS_DEG = [(0, 0), (0.001, 0), (20, 0), (-35, 40), (60, 0), (50, -50), (60, 60)]


def perspective(view: View, leds_m: Array) -> Array:
    seen = (leds_m - view.position_m) @ view.R_cam_world.T
    return np.asarray(seen[:, :2] / seen[:, 2:])


def equidistant(view: View, leds_m: Array) -> Array:
    """theta away from the axis, in the direction of (x, y)."""
    seen = (leds_m - view.position_m) @ view.R_cam_world.T
    rho = np.hypot(seen[:, 0], seen[:, 1])
    return np.asarray(seen[:, :2] / rho[:, None] * np.arctan2(rho, seen[:, 2])[:, None])


@pytest.mark.parametrize("yaw_deg", [0.0, 130.0])
@pytest.mark.parametrize(("tilt_x_deg", "tilt_y_deg"), TILTS_DEG)
@pytest.mark.parametrize("leds", [PANEL, TABLE_1], ids=["panel", "table 1"])
def test_exact_images_of_a_normal_lens_give_the_exact_position(
    leds: Array, tilt_x_deg: float, tilt_y_deg: float, yaw_deg: float
) -> None:
    view = view_of(leds.mean(axis=0), 2.6, tilt_x_deg, tilt_y_deg, yaw_deg)
    found = position_by_collinearity(leds, perspective(view, leds), Perspective())
    # 1e-16 of rounding; Table 1's LEDs, 0.065 m wide at up to 10 m, magnify it some (10 / 0.065)^3 times.
    np.testing.assert_allclose(found, view.position_m, atol=1e-8)


@pytest.mark.parametrize("yaw_deg", [0.0, 130.0])
@pytest.mark.parametrize(("tilt_x_deg", "tilt_y_deg"), [(0, 0), (20, 0), (-15, 20), (40, 40), (60, -30)])
def test_exact_images_of_a_fish_eye_give_the_exact_position(
    tilt_x_deg: float, tilt_y_deg: float, yaw_deg: float
) -> None:
    """Also of LEDs more than 90 deg off the axis: at 60 and -30 deg of tilt there are some."""
    view = view_of((3.5, 2.5, CEILING_M), 1.5, tilt_x_deg, tilt_y_deg, yaw_deg)
    found = position_by_collinearity(WIDE_GRID, equidistant(view, WIDE_GRID), Equidistant())
    np.testing.assert_allclose(found, view.position_m, atol=1e-10)


def test_leds_at_different_heights_are_used() -> None:
    leds = WIDE_GRID + np.random.default_rng(1).uniform(0, 0.3, WIDE_GRID.shape) * [0, 0, 1]
    view = view_of((3.5, 2.5, CEILING_M), 1.5, 15, -20, 70)
    found = position_by_collinearity(leds, equidistant(view, leds), Equidistant())
    np.testing.assert_allclose(found, view.position_m, atol=1e-10)


@pytest.mark.slow
def test_leds_nearly_on_a_line_rarely_lead_to_a_wrong_pose() -> None:
    """Table 1's, 100 random poses: 0.1 % were lost of 1000, so more than 2 have a probability of 2e-4."""
    rng = np.random.default_rng(6)
    lost = 0
    for _ in range(100):
        tilt_x, tilt_y = rng.uniform(-60, 60, 2)
        view = view_of(TABLE_1.mean(axis=0), rng.uniform(1, 2.6), tilt_x, tilt_y, rng.uniform(-180, 180))
        found = position_by_collinearity(TABLE_1, perspective(view, TABLE_1), Perspective())
        lost += np.linalg.norm(found - view.position_m) > 1e-6
    assert lost <= 2


@pytest.mark.parametrize("projection", [Perspective(), Equidistant()])
def test_slopes_are_those_of_differences(projection: Projection) -> None:
    """On the axis too, and beside it. Central differences of step h are off by h^2, and by rounding over h: 1e-9."""
    points = np.array([[0.3, -0.2, 1.1], [0.0, 0.0, 2.0], [1e-7, 0.0, 2.0], [1e-5, 2e-5, 0.7], [-2.0, 1.0, 0.4]])
    _, slopes = projection.project(points)
    for axis in range(3):
        step = 1e-5 * np.eye(3)[axis]
        ahead, behind = projection.project(points + step)[0], projection.project(points - step)[0]
        np.testing.assert_allclose(slopes[:, :, axis], (ahead - behind) / 2e-5, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("projection", "project", "view", "leds", "noise"),
    [
        (Perspective(), perspective, view_of((3, 2, CEILING_M), 2.6, 25, -15, 40), PANEL, 0.02 / 15000),
        (Equidistant(), equidistant, view_of((3.5, 2.5, CEILING_M), 1.5, 10, -20, 40), WIDE_GRID, 0.02 / 1400),
    ],
    ids=["normal", "fish-eye"],
)
def test_the_error_is_what_least_squares_predict(
    projection: Projection, project: object, view: View, leds: Array, noise: float
) -> None:
    """To first order the covariance of (position, rotation) is noise^2 (J^T J)^-1, J by differences of the projection.

    e^T C^-1 e is then chi-square with 3 degrees of freedom, and the mean over n draws has a standard error of
    sqrt(6 / n). Second order is the noise times J's relative change over the error, below 1 %.
    """
    assert callable(project)

    def moved(parameters: Array) -> Array:
        tilts = np.array([view.tilt_x_deg, view.tilt_y_deg, view.yaw_deg]) + np.degrees(parameters[3:])
        x, y, z = np.array(view.position_m) + parameters[:3]
        there = View(view.width_px, view.height_px, view.focal_px, (x, y, z), *map(float, tilts))
        return np.asarray(project(there, leds)).ravel()

    h = 1e-5
    J = np.column_stack([(moved(h * axis) - moved(-h * axis)) / (2 * h) for axis in np.eye(6)])
    precision = np.linalg.inv(noise**2 * np.linalg.inv(J.T @ J)[:3, :3])
    rng, draws = np.random.default_rng(2), 150
    exact = moved(np.zeros(6)).reshape(-1, 2)
    squares = []
    for _ in range(draws):
        error = position_by_collinearity(leds, exact + rng.normal(0, noise, exact.shape), projection) - view.position_m
        squares.append(error @ precision @ error)
    assert abs(np.mean(squares) - 3) < 5 * np.sqrt(6 / draws) + 0.03


@pytest.mark.parametrize(
    ("projection", "project", "leds"),
    [(Perspective(), perspective, PANEL), (Equidistant(), equidistant, WIDE_GRID)],
    ids=["normal", "fish-eye"],
)
def test_no_neighbour_of_a_fitted_pose_has_a_smaller_sum_of_squares(
    projection: Projection, project: Callable[[View, Array], Array], leds: Array
) -> None:
    """Poses 1e-4 m or rad away; the fit ends within some 1e-9 of the minimum. OpenCV needs a turn above 1e-5 rad."""
    target = leds.mean(axis=0)
    image = project(view_of(target, 2.0, 25, -15, 40), leds)
    image = image + np.random.default_rng(4).normal(0, 1e-3, image.shape)
    begin = view_of(target, 2.2, 20, -10, 45)
    fitted = fit_pose(leds, image, projection, Pose(np.array(begin.position_m), begin.R_cam_world))
    assert fitted is not None
    pose, least = fitted

    def total(moved_m: Array, turned: Array) -> float:
        turn = cv2.Rodrigues(turned)[0]
        p_cam = Pose(pose.position_m + moved_m, turn @ pose.R_cam_world).in_camera(leds)
        return float(((projection.project(p_cam)[0] - image) ** 2).sum())

    assert total(np.zeros(3), np.zeros(3)) == pytest.approx(least, rel=1e-12)
    for step in 1e-4 * np.vstack([np.eye(6), -np.eye(6)]):
        assert total(step[:3], step[3:]) > least


def test_a_start_without_images_gives_no_pose() -> None:
    """Facing away from the LEDs, they have no image in a normal lens."""
    view = view_of((3, 2, CEILING_M), 2.6, 10, 5)
    away = np.diag([1.0, -1.0, -1.0])
    assert fit_pose(PANEL, perspective(view, PANEL), Perspective(), Pose(np.array(view.position_m), away)) is None


@pytest.mark.slow
def test_spots_that_no_pose_explains_are_refused_or_fitted_without_a_crash() -> None:
    rng = np.random.default_rng(3)
    outcomes = set()
    for _ in range(40):
        image = rng.normal(0, 0.1, (4, 2)) if rng.uniform() < 0.8 else np.zeros((4, 2))
        try:
            assert np.isfinite(position_by_collinearity(PANEL[[0, 4, 15, 19]], image, Perspective())).all()
            outcomes.add("found")
        except EstimationFailure as failure:
            outcomes.add(str(failure))
    assert outcomes <= {"found", "position: the collinearity equations do not converge"}
    assert len(outcomes) == 2


def test_too_few_and_lines_are_refused() -> None:
    view = view_of((3, 2, CEILING_M), 2.6, 10, 5)
    with pytest.raises(EstimationFailure, match="position: LEDs identified: 3, needed: 4"):
        position_by_collinearity(PANEL[:3], perspective(view, PANEL[:3]), Perspective())
    line = PANEL[:5]
    with pytest.raises(EstimationFailure, match="position: the LEDs are on one line"):
        position_by_collinearity(line, perspective(view, line), Perspective())


@pytest.mark.parametrize("tilts_deg", [(30.0, -22.5), (-30.0, 45.0)])
def test_the_starts_are_minima_of_the_grid_best_first(tilts_deg: tuple[float, float]) -> None:
    """The tilt is a point of the grid of 7.5 deg, where leveled spots are similar to the LEDs: the first start is
    exact. No other minimum is a neighbour of one.
    """
    view = view_of((3, 2, CEILING_M), 2.6, *tilts_deg, 40)
    rays = np.column_stack([perspective(view, PANEL), np.ones(len(PANEL))])
    found = starts(PANEL, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    np.testing.assert_allclose(found[0].position_m, view.position_m, atol=1e-9)
    np.testing.assert_allclose(found[0].R_cam_world, view.R_cam_world, atol=1e-9)
    up = np.array([pose.R_cam_world[:, 2] for pose in found])
    grid_points = np.degrees(np.column_stack([np.arctan2(up[:, 1], up[:, 2]), -np.arcsin(up[:, 0])])) / 7.5
    apart = np.abs(grid_points[:, None] - grid_points).max(axis=2) + 10 * np.eye(len(found))
    assert len(found) > 1
    assert (apart > 1.5).all()
