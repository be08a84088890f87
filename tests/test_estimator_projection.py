"""World to pixels: against the format's formulas, and slopes against differences, for every lens."""

import json

import numpy as np
import pytest
from estimator_synthetic import description, view_of

from estimator.camera.projection import TiltedPose, pose_of_rotation, project
from estimator.io.dataset import Camera

VIEW = view_of((3.5, 3.6, 3.5), 3.0, 25.0, -15.0, 40.0)
POINTS = np.array([[3.5, 3.6, 3.5], [3.7, 3.5, 3.5], [3.3, 3.65, 3.45], [3.52, 3.4, 3.2]])
TURNED = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def camera(**changes: object) -> Camera:
    made = description(VIEW, 1, POINTS, 0.01)["cameras"]["main"]  # type: ignore[index]
    return Camera.model_validate_json(json.dumps({**made, **changes}))


LENSES = {
    "pinhole": {},
    "skew": {"K": [[1500.0, 3.0, 200.0], [0.0, 1480.0, 150.0], [0.0, 0.0, 1.0]]},
    "distorted": {"distortion": {"k1": -0.3, "k2": 0.2, "k3": 0.1, "p1": 0.003, "p2": -0.002}},
    "fish-eye": {"projection": "equidistant"},
    "rig": {"R_cam_rig": TURNED},
}


def pose(lens: Camera) -> TiltedPose:
    return pose_of_rotation(np.array(VIEW.position_m), VIEW.R_cam_world, lens)


def test_a_pinhole_images_points_where_the_format_says() -> None:
    lens = camera()
    assert np.degrees([pose(lens).tilt_x, pose(lens).tilt_y, pose(lens).yaw]) == pytest.approx([25, -15, 40])
    np.testing.assert_allclose(project(POINTS, pose(lens), lens).pixels, VIEW.project(POINTS), atol=1e-9)


def test_lenses_bend_as_the_format_says() -> None:
    """One point by hand: (a, b) = (0.2, -0.1) and theta = atan(sqrt(0.05))."""
    level = TiltedPose(np.zeros(3), 0.0, 0.0, 0.0)
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
        ahead, behind = (project(POINTS, here.moved(sign * 1e-6 * unit), lens).pixels for sign in (1, -1))
        np.testing.assert_allclose(found[:, :, parameter], (ahead - behind) / 2e-6, atol=1e-4)


def test_light_of_a_pinhole_falls_with_the_fourth_power_of_the_cosine() -> None:
    seen = project(POINTS, pose(camera()), camera())
    cosine = seen.p_cam[:, 2] / np.linalg.norm(seen.p_cam, axis=1)
    np.testing.assert_allclose(seen.light, cosine**4, rtol=1e-12)


def test_light_of_a_fish_eye_is_that_of_its_solid_angles() -> None:
    """cos(theta) dOmega / dA with dOmega = sin(theta) dtheta dphi and dA = theta dtheta dphi."""
    seen = project(POINTS[1:], pose(camera()), camera(projection="equidistant"))  # the first is on the axis
    theta = np.arccos(seen.p_cam[:, 2] / np.linalg.norm(seen.p_cam, axis=1))
    np.testing.assert_allclose(seen.light, np.cos(theta) * np.sin(theta) / theta, rtol=1e-9)


def test_what_a_lens_does_not_image_has_no_pixel() -> None:
    level = TiltedPose(np.zeros(3), 0.0, 0.0, 0.0)
    behind, folded = np.array([[0.1, 0.1, -1.0]]), np.array([[3.0, 0.0, 1.0]])
    assert np.isnan(project(behind, level, camera()).pixels).all()
    bent = camera(distortion={"k1": -0.3, "k2": 0.0, "k3": 0.0, "p1": 0.0, "p2": 0.0})
    assert np.isnan(project(folded, level, bent).pixels).all()
    assert np.isfinite(project(behind, level, camera(projection="equidistant")).pixels).all()
