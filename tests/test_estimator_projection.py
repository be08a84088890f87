"""Projections: by the format's formulas, by OpenCV, and derivatives by differences, for every lens."""

import json

import cv2
import numpy as np
import pytest
from estimator_synthetic import description, view_of

from estimator.camera.pose import Pose
from estimator.camera.projection import Equidistant, Perspective, project, projection_of, relative_illumination
from estimator.io.camera import Camera, Distortion

VIEW = view_of((3.5, 3.6, 3.5), 3.0, 25.0, -15.0, 40.0)
POINTS = np.array([[3.5, 3.6, 3.5], [3.7, 3.5, 3.5], [3.3, 3.65, 3.45], [3.52, 3.4, 3.2]])
TURNED = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def camera(**changes: object) -> Camera:
    made = description(VIEW, 1, POINTS, 0.01)["cameras"]["main"]  # type: ignore[index]
    return Camera.model_validate_json(json.dumps({**made, **changes}))


LENSES = {
    "pinhole": {},
    "skew": {"K": [[1510.0, 3.0, 200.0], [0.0, 1490.0, 150.0], [0.0, 0.0, 1.0]]},
    "distorted": {"distortion": {"k1": -0.3, "k2": 0.2, "k3": 0.1, "p1": 0.003, "p2": -0.002}},
    "fish-eye": {"projection": "equidistant"},
    "rig": {"R_cam_rig": TURNED},
}


def pose(lens: Camera) -> Pose:
    return Pose(np.array(VIEW.position_m), VIEW.R_cam_world)


def test_a_pinhole_images_points_where_the_format_says() -> None:
    lens = camera()
    assert np.degrees(pose(lens).rig_angles(lens)) == pytest.approx([25, -15, 40])
    np.testing.assert_allclose(project(POINTS, pose(lens), lens).pixels, VIEW.project(POINTS), atol=1e-9)


def test_distortion_and_fish_eye_are_the_format_s() -> None:
    """One point by hand: (a, b) = (0.2, -0.1) and theta = atan(sqrt(0.05))."""
    level = Pose(np.zeros(3), np.eye(3))
    point = np.array([[0.4, -0.2, 2.0]])
    d = camera(distortion={"k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.01, "p2": 0.02})
    s = 1 + 0.1 * 0.05 + 0.2 * 0.05**2 + 0.3 * 0.05**3
    x = 0.2 * s + 2 * 0.01 * 0.2 * -0.1 + 0.02 * (0.05 + 2 * 0.04)
    y = -0.1 * s + 0.01 * (0.05 + 2 * 0.01) + 2 * 0.02 * 0.2 * -0.1
    assert project(point, level, d).pixels[0] == pytest.approx([200 + 1500 * x, 150 + 1500 * y])
    theta, rho = np.arctan(np.sqrt(0.05)), np.sqrt(0.05)
    fish = project(point, level, camera(projection="equidistant")).pixels[0]
    assert fish == pytest.approx([200 + 1500 * theta * 0.2 / rho, 150 - 1500 * theta * 0.1 / rho])


@pytest.mark.parametrize("name", LENSES)
def test_slopes_are_what_differences_give(name: str) -> None:
    """Steps of 1e-6 m and rad: differences are good to 1e-6^2 times the third derivative, and rounding, 1e-12 / 1e-6
    of some 1000 px.
    """
    lens = camera(**LENSES[name])
    here = pose(lens)
    found = project(POINTS, here, lens).slopes
    for parameter, unit in enumerate(np.eye(6)):
        ahead, behind = (project(POINTS, here.moved(sign * 1e-6 * unit, lens), lens).pixels for sign in (1, -1))
        np.testing.assert_allclose(found[:, :, parameter], (ahead - behind) / 2e-6, atol=1e-4)


def test_light_of_a_pinhole_falls_with_the_fourth_power_of_the_cosine() -> None:
    seen = project(POINTS, pose(camera()), camera())
    cosine = seen.p_cam[:, 2] / np.linalg.norm(seen.p_cam, axis=1)
    np.testing.assert_allclose(relative_illumination(seen.pixels, camera()), cosine**4, rtol=1e-12)


def test_light_of_a_fish_eye_is_that_of_its_solid_angles() -> None:
    """cos(theta) dOmega / dA with dOmega = sin(theta) dtheta dphi and dA = theta dtheta dphi."""
    fish_eye = camera(projection="equidistant")
    seen = project(POINTS[1:], pose(camera()), fish_eye)  # the first is on the axis
    theta = np.arccos(seen.p_cam[:, 2] / np.linalg.norm(seen.p_cam, axis=1))
    expected = np.cos(theta) * np.sin(theta) / theta
    np.testing.assert_allclose(relative_illumination(seen.pixels, fish_eye), expected, rtol=1e-9)


def test_a_point_outside_the_valid_range_has_no_pixel() -> None:
    level = Pose(np.zeros(3), np.eye(3))
    behind, folded = np.array([[0.1, 0.1, -1.0]]), np.array([[3.0, 0.0, 1.0]])
    assert np.isnan(project(behind, level, camera()).pixels).all()
    bent = camera(distortion={"k1": -0.3, "k2": 0.0, "k3": 0.0, "p1": 0.0, "p2": 0.0})
    assert np.isnan(project(folded, level, bent).pixels).all()
    assert np.isfinite(project(behind, level, camera(projection="equidistant")).pixels).all()


def test_the_factory_gives_each_lens_its_projection() -> None:
    assert projection_of(camera()).rectilinear
    bent = camera(**LENSES["distorted"])
    assert projection_of(bent) == Perspective(bent.distortion)
    assert not projection_of(bent).rectilinear
    assert projection_of(camera(projection="equidistant")) == Equidistant()


@pytest.mark.parametrize("name", ["pinhole", "distorted", "fish-eye"])
def test_unproject_is_the_inverse_of_project(name: str) -> None:
    """Double precision of coordinates up to 1; the distortion is inverted to a residual of 1e-12."""
    lens = projection_of(camera(**LENSES[name]))
    angle = np.linspace(0, 6, 40)
    rays = np.column_stack(
        [np.cos(angle) * np.linspace(0, 0.7, 40), np.sin(angle) * np.linspace(0, 0.7, 40), angle * 0 + 1]
    )
    back = lens.unproject(lens.project(3 * rays)[0])
    np.testing.assert_allclose(back, rays / np.linalg.norm(rays, axis=1, keepdims=True), atol=5e-12)


def test_a_fish_eye_is_opencv_s_without_coefficients_up_to_90_deg() -> None:
    theta = np.radians([5.0, 30.0, 60.0, 80.0, 89.0])
    rays = np.column_stack([np.sin(theta), 0.3 * np.sin(theta), np.cos(theta)])
    found = Equidistant().project(rays)[0]
    expected, _ = cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), np.eye(3), np.zeros(4))
    np.testing.assert_allclose(found, expected[:, 0], atol=1e-12)


def test_distortion_and_its_derivatives_are_opencv_s() -> None:
    lens, points = Distortion(k1=-0.3, k2=0.2, k3=0.1, p1=0.003, p2=-0.002), POINTS - (3.5, 3.6, 2.0)
    image, jacobian = Perspective(lens).project(points)
    coefficients, zero = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]), np.zeros(3)
    expected, slopes, *_ = cv2.projectPoints(points, zero, zero, np.eye(3), coefficients)
    np.testing.assert_allclose(image, expected[:, 0], atol=1e-14)
    # OpenCV's columns 3 to 5 are by the translation, which shifts the points.
    np.testing.assert_allclose(jacobian, slopes[:, 3:6].reshape(-1, 2, 3), atol=1e-14)


def test_a_fish_eye_images_directions_beyond_90_deg() -> None:
    """120 deg off the axis along -y: the image is at (0, -2 pi / 3)."""
    ray = np.array([[0.0, -np.sin(np.radians(120)), np.cos(np.radians(120))]])
    np.testing.assert_allclose(Equidistant().project(ray)[0], [[0.0, -2 * np.pi / 3]], atol=1e-15)
    np.testing.assert_allclose(Equidistant().unproject(np.array([[0.0, -2 * np.pi / 3]])), ray, atol=1e-15)


def test_undistortion_has_no_direction_beyond_the_fold_and_finds_all_before_it() -> None:
    """r (1 - r^2 / 2) has its maximum at r = sqrt(2/3) = 0.816, of 0.544."""
    barrel = Perspective(Distortion(k1=-0.5, k2=0.0, k3=0.0, p1=0.0, p2=0.0))
    r = np.array([0.1, 0.5, 0.75, 0.81])
    rays = barrel.unproject(np.column_stack([r * (1 - r**2 / 2), 0 * r]))
    # At the fold an error of the residual, 1e-12, is multiplied by 1 / (1 - 3 r^2 / 2), 63 at 0.81.
    np.testing.assert_allclose(rays[:, 0] / rays[:, 2], r, atol=1e-10)
    assert np.isnan(barrel.unproject(np.array([[0.55, 0.0]]))).all()


def test_an_image_that_is_mirrored_through_the_centre_is_no_image() -> None:
    """s(r) = 1 - 4 r^2 + 2.9 r^4 is -0.1 at r = 1, while the radius r s(r) grows again, by 1 - 12 + 14.5: a lens images
    nothing on the other side of its axis.
    """
    wild = Perspective(Distortion(k1=-4.0, k2=2.9, k3=0.0, p1=0.0, p2=0.0))
    image = wild.project(np.array([[1.0, 0.0, 1.0], [0.0, -1.0, 1.0], [0.1, 0.0, 1.0]]))[0]
    assert np.isnan(image).all(axis=1).tolist() == [True, True, False]
