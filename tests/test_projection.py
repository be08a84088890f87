"""Facts of the projections that other modules rely on, and cameras at poses."""

import numpy as np
import pytest

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.projection import Equidistant, Perspective, Projection
from vlcrender.camera.rig import mounted_cameras

BARREL = Perspective(Distortion(k1=-0.3))
LENSES: dict[str, Projection] = {
    "pinhole": Perspective(),
    "barrel": BARREL,
    "tangential": Perspective(Distortion(k1=-0.2, k2=0.05, p1=0.01, p2=-0.02)),
    "fish-eye": Equidistant(),
}


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_lines_stay_straight_where_the_projection_says_so(lens: Projection) -> None:
    start, end = np.array([-0.5, 0.3, 1.0]), np.array([0.6, 0.4, 1.5])
    line = start + np.linspace(0, 1, 9)[:, None] * (end - start)
    x, y = lens.project(*line.T)
    (dx, dy), (ex, ey) = (x - x[0], y - y[0]), (x[-1] - x[0], y[-1] - y[0])
    deviation = np.abs(dx * ey - dy * ex).max() / np.hypot(ex, ey)
    # rounding: 2^-52 of numbers below 1, a dozen operations; bends of these lenses are some 1e-2
    assert (deviation < 1e-14) == lens.keeps_lines_straight
    assert lens.keeps_lines_straight or deviation > 1e-3


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_unproject_inverts_project(lens: Projection, rng: np.random.Generator) -> None:
    points = rng.uniform([-0.6, -0.5, 1.0], [0.6, 0.5, 2.0], (1000, 3))
    assert lens.images(*points.T).all()
    ray = np.stack(lens.unproject(*lens.project(*points.T)), axis=-1)
    # Newton's method ends within 1e-12 (`Distortion.folds`), and divides by a slope of 0.6 and more here
    assert np.abs(np.cross(ray, points)).max() < 1e-11
    assert (np.einsum("ij,ij->i", ray, points) > 0).all()


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_relative_illumination_is_the_solid_angle_times_the_cosine(lens: Projection, rng: np.random.Generator) -> None:
    x, y = rng.uniform(-0.5, 0.5, (2, 200))
    light, tangent = lens.illumination(x, y, np, 1.0)
    h = 1e-5
    rays = [
        np.stack(lens.unproject(x + i * h, y + j * h), axis=-1) for i, j in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    ray, right, left, below, above = (r / np.linalg.norm(r, axis=-1, keepdims=True) for r in rays)
    solid_angle = np.linalg.norm(np.cross(right - left, below - above), axis=-1) / (2 * h) ** 2
    # central differences: curvature h^2 = 1e-10, rounding 2^-52 / h = 2e-11, twice
    assert np.allclose(light, solid_angle * ray[:, 2], rtol=1e-9)
    assert np.allclose(tangent, np.hypot(ray[:, 0], ray[:, 1]) / ray[:, 2], rtol=1e-12)


def test_outlines_beyond_the_fold_are_moved_to_it_and_stay_outside() -> None:
    # r (1 - 0.3 r^2) turns at r = 1.054, where the image has its greatest radius, 0.703
    outline = np.array([[0.1, 0.0, 1.0], [3.0, 0.0, 1.0], [0.0, -3.0, 1.0]])
    moved = BARREL.into_range(outline, 1.0)
    assert moved is not None
    assert np.array_equal(moved[0], outline[0])
    assert BARREL.images(*moved.T).all()
    x, y = BARREL.project(*moved[1:].T)
    # at 0.999 of the fold's radius: second order, (1e-3)^2 * 3/2 of the greatest radius, which is (2/3) r
    assert np.hypot(x, y) == pytest.approx(2 / 3 / np.sqrt(0.9), rel=1e-5)
    assert outline[1, 0] == 3.0  # the points given are not changed
    assert BARREL.into_range(np.array([[0.1, 0.0, -1.0]]), 1.0) is None
    assert Perspective().into_range(np.array([[0.1, 0.0, 5e-4]]), 1.0) is None
    behind = np.array([[0.1, 0.0, -1.0]])
    assert Equidistant().into_range(behind, 1.0) is behind


def test_defocus_follows_the_depth_or_for_a_fish_eye_the_distance() -> None:
    point = np.array([[1.0, 2.0, 2.5]])
    pose = Pose((1.0, 1.0, 0.5), yaw_deg=30.0)
    perspective = PosedCamera(Camera(), pose)
    fish_eye = PosedCamera(Camera(projection="equidistant"), pose)
    assert perspective.focus_depths_m(point) == pytest.approx([2.0])
    assert fish_eye.focus_depths_m(point) == pytest.approx([np.sqrt(5.0)])


def test_a_camera_at_another_pose_is_the_same_camera() -> None:
    posed = PosedCamera(Camera(skew_px=3.0), Pose((1.0, 1.0, 0.5)))
    other = posed.at(Pose((2.0, 1.0, 0.5), 5.0))
    assert other == PosedCamera(posed.camera, Pose((2.0, 1.0, 0.5), 5.0))
    assert posed.pose == Pose((1.0, 1.0, 0.5))


def test_the_main_camera_of_a_rig_has_the_pose_of_the_rig() -> None:
    (main,) = mounted_cameras(Camera(), ())
    pose = Pose((1.0, 1.0, 0.5), 5.0, -7.0, 80.0)
    assert main.posed(pose) == PosedCamera(Camera(), pose)


@pytest.mark.parametrize(("point", "imaged"), [((0.0, 0.1), True), ((0.1, 0.0), True), ((0.0, 0.0), False)])
def test_a_fish_eye_images_all_that_is_behind_it_but_for_its_axis(point: tuple[float, float], imaged: bool) -> None:
    """On the axis behind the lens all directions of the image are equally right."""
    x, y = (np.array([value]) for value in point)
    assert Equidistant().images(x, y, np.array([-1.0])).tolist() == [imaged]
