"""Axes and signs of projection, each stated once, and lenses against closed forms and OpenCV."""

import cv2
import numpy as np
import pytest

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera, Pose, rotation_cam_world
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.config.toml_model import check
from vlcrender.core.backend import dr, mi
from vlcrender.errors import InputError

LED_M = np.array([3.0, 4.0, 3.5])


def image_of(led_m: np.ndarray = LED_M, camera: Camera | None = None, **pose: float) -> np.ndarray:
    at = (pose.pop("x", 3.0), pose.pop("y", 4.0), pose.pop("z", 0.5))
    pixels = PosedCamera(camera or Camera(), Pose(at, **pose)).project(led_m)
    return pixels


def test_an_led_straight_above_a_level_camera_is_at_the_principal_point() -> None:
    assert image_of() == pytest.approx([2000.0, 1500.0])


def test_the_level_pose_is_the_identity_and_points_up() -> None:
    assert np.array_equal(Pose((0, 0, 0)).rotation, np.eye(3))


def test_an_led_moved_to_plus_x_moves_its_image_to_plus_u() -> None:
    # f = 18 mm / 1.2 um = 15 000 px; 0.1 m at 3 m depth is 500 px
    assert image_of(LED_M + [0.1, 0, 0]) == pytest.approx([2500.0, 1500.0])


def test_an_led_moved_to_plus_y_moves_its_image_to_plus_v() -> None:
    assert image_of(LED_M + [0, 0.1, 0]) == pytest.approx([2000.0, 2000.0])


def test_a_camera_moved_to_plus_x_moves_the_image_to_minus_u() -> None:
    assert image_of(x=3.1) == pytest.approx([1500.0, 1500.0])


def test_a_camera_raised_makes_the_image_larger() -> None:
    assert image_of(LED_M + [0.1, 0, 0], z=2.0)[0] == pytest.approx(2000 + 15000 * 0.1 / 1.5)


def test_raising_tilt_x_moves_the_image_to_plus_v() -> None:
    assert image_of(tilt_x_deg=1.0) == pytest.approx([2000.0, 1500 + 15000 * np.tan(np.radians(1.0))])


def test_raising_tilt_y_moves_the_image_to_minus_u() -> None:
    assert image_of(tilt_y_deg=1.0) == pytest.approx([2000 - 15000 * np.tan(np.radians(1.0)), 1500.0])


def test_raising_yaw_turns_an_image_from_plus_u_towards_minus_v() -> None:
    assert image_of(LED_M + [0.1, 0, 0], yaw_deg=90.0) == pytest.approx([2000.0, 1000.0])


def test_tilts_compose_as_equation_5_of_the_paper() -> None:
    # Eq. 6 multiplied out by hand at psi = 30, xi = 60, zeta = 0 (see the errata for its two misprints)
    s, c = np.sin(np.radians([30.0, 60.0])), np.cos(np.radians([30.0, 60.0]))
    expected = [[c[1], 0, -s[1]], [s[0] * s[1], c[0], s[0] * c[1]], [c[0] * s[1], -s[0], c[0] * c[1]]]
    assert np.allclose(rotation_cam_world(30, 60, 0), expected, atol=1e-15)


def test_principal_point_and_skew_enter_as_in_k() -> None:
    camera = Camera(principal_point_px=(1990.5, 1510.25), skew_px=30.0)
    # x/z = 0.1/3, y/z = 0.2/3
    u, v = image_of(LED_M + [0.1, 0.2, 0], camera)
    assert (u, v) == pytest.approx((1990.5 + 500 + 30 * 0.2 / 3, 1510.25 + 1000))


def test_fx_over_fy_is_the_aspect_ratio_and_their_mean_the_image_distance() -> None:
    """Led 0.1 m to +x and to +y of a camera 3 m below it."""
    camera = Camera(aspect_ratio=1.02)
    ((fx, _, _), (_, fy, _), _) = camera.matrix.tolist()
    assert fx / fy == pytest.approx(1.02, rel=1e-15)
    assert (fx + fy) / 2 == pytest.approx(15000.0, rel=1e-15)
    u, v = image_of(np.array([3.1, 4.1, 3.5]), camera) - [2000.0, 1500.0]
    assert (u, v) == pytest.approx((fx / 30, fy / 30), rel=1e-9)
    across, down = camera.view_angles_deg()
    assert across == pytest.approx(2 * np.degrees(np.arctan(2000 / fx)))
    assert down == pytest.approx(2 * np.degrees(np.arctan(1500 / fy)))


def test_rays_invert_projection(rng: np.random.Generator) -> None:
    camera = Camera(principal_point_px=(1900.0, 1600.0), skew_px=12.0)
    pose = Pose((3.0, 2.0, 1.0), 35.0, -50.0, 120.0)
    pixels = rng.uniform([0, 0], [4000, 3000], (100, 2))
    points = np.array(pose.position_m) + 2.5 * PosedCamera(camera, pose).rays_world(pixels)
    posed = PosedCamera(camera, pose)
    again, depth = posed.project(points), posed.camera_coordinates(points)[:, 2]
    # double precision: 1e4 px * 2^-52 * a few operations
    assert np.allclose(again, pixels, atol=1e-9)
    assert np.allclose(depth, 2.5)


def test_a_point_behind_the_camera_has_no_pixel() -> None:
    posed, point = PosedCamera(Camera(), Pose((3.0, 4.0, 0.5))), np.array([3.0, 4.0, 0.1])
    pixels, depth = posed.project(point), posed.camera_coordinates(point)[2]
    assert np.isnan(pixels).all()
    assert depth < 0


def test_the_field_of_view_is_15_19_degrees_not_the_printed_24() -> None:
    across, down = Camera().view_angles_deg()
    assert (round(across, 2), round(down, 2)) == (15.19, 11.42)


def test_mitsubas_camera_is_a_proper_rotation_with_x_left_and_y_up() -> None:
    pose = Pose((1.0, 2.0, 0.5), 20.0, 40.0, 60.0)
    matrix = PosedCamera(Camera(), pose).mitsuba_to_world()
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    assert np.allclose(matrix[:3, 0], -pose.rotation[0])  # Mitsuba's +x is our image's left
    assert np.allclose(matrix[:3, 1], -pose.rotation[1])  # its +y our image's up
    assert np.allclose(matrix[:3, 2], pose.rotation[2])  # +z of both is the optical axis


WIDE = {"width_px": 4000, "height_px": 3000, "pixel_pitch_um": 1.2, "focal_length_mm": 4.0}
"""62 x 48 deg: distorted positions have radii up to 0.75."""
BARREL = Camera(**WIDE, skew_px=5.0, distortion=Distortion(k1=-0.2, k2=0.05, k3=-0.01, p1=0.002, p2=-0.003))
PINCUSHION = Camera(**WIDE, distortion=Distortion(k1=0.2, k2=0.1, p1=-0.01, p2=0.01))
FISHEYE = Camera(**(WIDE | {"focal_length_mm": 1.4}), projection="equidistant", principal_point_px=(1950.0, 1540.0))
"""Field angles up to 102 deg in the corners."""
LENSES = {"barrel": BARREL, "pincushion": PINCUSHION, "fish-eye": FISHEYE}


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_unproject_inverts_project(camera: Camera, rng: np.random.Generator) -> None:
    u, v = rng.uniform([[0], [0]], [[4000], [3000]], (2, 10_000))
    again = camera.project(*camera.unproject(u, v))
    # 4000 px * 2^-52 = 1e-12 px, times the dozen operations there and back
    assert np.abs(again[0] - u).max() < 1e-10
    assert np.abs(again[1] - v).max() < 1e-10


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_rays_are_the_same_in_a_kernel(camera: Camera, rng: np.random.Generator) -> None:
    u, v = rng.uniform([[0], [0]], [[4000], [3000]], (2, 1000)).astype(np.float32)
    rays = np.stack(camera.unproject(u.astype(float), v.astype(float)))
    kernel = np.stack([x.numpy() for x in camera.unproject(mi.Float(u), mi.Float(v), dr)])
    # float32: 2^-24 = 6e-8 an operation, a few dozen operations on numbers up to 1
    assert np.abs(kernel - rays).max() < 2e-6
    pixels = np.stack([x.numpy() for x in camera.project(*(mi.Float(x.astype(np.float32)) for x in rays), dr)])
    assert np.abs(pixels - [u, v]).max() < 4000 * 2e-6


@pytest.mark.parametrize("camera", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])
def test_distortion_agrees_with_opencv(camera: Camera, rng: np.random.Generator) -> None:
    points = rng.uniform([-1, -0.7, 1.8], [1, 0.7, 2.2], (500, 3))
    d = camera.distortion
    assert d is not None
    # cv2 has no skew: put it in by hand
    straight = camera.model_copy(update={"skew_px": 0.0})
    coefficients = np.array([d.k1, d.k2, d.p1, d.p2, d.k3])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), straight.matrix, coefficients)
    expected = expected.reshape(-1, 2)
    expected[:, 0] += camera.skew_px * (expected[:, 1] - camera.center_px[1]) / camera.focal_px
    assert np.allclose(camera.image_of_points(points), expected, atol=1e-9)


def test_negative_k1_is_a_barrel_and_p1_and_p2_pull_along_v_and_u() -> None:
    at = np.array([0.3, 0.2, 1.0])
    plain, barrel, p1, p2 = (
        Camera(**WIDE, distortion=Distortion(**d)).image_of_points(at) - [2000, 1500]
        for d in ({}, {"k1": -0.1}, {"p1": 0.01}, {"p2": 0.01})
    )
    # r^2 = 0.13; f = 10 000 / 3 px
    assert np.allclose(barrel, plain * (1 - 0.1 * 0.13))
    assert np.allclose(p1 - plain, 1e4 / 3 * 0.01 * np.array([2 * 0.06, 0.13 + 2 * 0.04]))
    assert np.allclose(p2 - plain, 1e4 / 3 * 0.01 * np.array([0.13 + 2 * 0.09, 2 * 0.06]))


def test_the_jacobian_of_the_distortion_agrees_with_differences(rng: np.random.Generator) -> None:
    d = Distortion(k1=-0.2, k2=0.05, k3=-0.3, p1=0.02, p2=-0.03)
    x, y = rng.uniform(-0.7, 0.7, (2, 100))
    h = 1e-6
    right, left = d.distort(x + h, y), d.distort(x - h, y)
    below, above = d.distort(x, y + h), d.distort(x, y - h)
    _, _, xx, xy, yy = d.distort(x, y)
    # central differences: h^2 = 1e-12 and 2^-52 / h = 2e-10
    assert np.allclose((right[0] - left[0]) / (2 * h), xx, atol=2e-9)
    assert np.allclose((below[0] - above[0]) / (2 * h), xy, atol=2e-9)
    assert np.allclose((right[1] - left[1]) / (2 * h), xy, atol=2e-9)
    assert np.allclose((below[1] - above[1]) / (2 * h), yy, atol=2e-9)


def test_a_point_beyond_the_fold_of_a_barrel_has_no_pixel() -> None:
    # r (1 - 0.3 r^2) turns at r = 1.054; r = 1.6 would come back to 0.37, in the middle of the image
    camera = Camera(**(WIDE | {"focal_length_mm": 6.0}), distortion=Distortion(k1=-0.3))
    assert np.isnan(camera.image_of_points(np.array([1.6, 0.0, 1.0]))).all()
    assert np.isfinite(camera.image_of_points(np.array([0.4, 0.0, 1.0]))).all()


@pytest.mark.parametrize("theta_deg", [0.0, 1e-7, 60.0, 90.0, 100.0])
def test_a_fisheye_images_at_a_radius_equal_to_the_field_angle(theta_deg: float) -> None:
    theta = np.radians(theta_deg)
    direction = np.array([np.sin(theta) * 0.6, -np.sin(theta) * 0.8, np.cos(theta)])
    f = FISHEYE.focal_px
    pixel = FISHEYE.image_of_points(3.0 * direction)
    assert pixel == pytest.approx([1950 + 0.6 * f * theta, 1540 - 0.8 * f * theta], abs=1e-9)
    assert np.allclose(FISHEYE.unproject(*pixel), direction, atol=1e-12)


def test_a_near_focus_moves_the_sensor_back() -> None:
    # 1/f = 1/s + 1/f_i: f = 18 mm and s = 198 mm give f_i = 19.8 mm
    camera = Camera(focus_distance_m=0.198)
    assert camera.image_distance_mm == pytest.approx(19.8)
    assert camera.matrix[0, 0] == pytest.approx(16500)
    assert camera.working_f_number == pytest.approx(2.2 * 1.1)
    assert Camera(focus_distance_m="infinity").matrix[0, 0] == Camera().matrix[0, 0] == 15000


def test_view_angles_follow_the_lens() -> None:
    assert Camera(focus_distance_m=0.198).view_angles_deg()[0] == pytest.approx(2 * np.degrees(np.arctan(2000 / 16500)))
    assert FISHEYE.view_angles_deg()[0] == pytest.approx(np.degrees(4000 / FISHEYE.focal_px))
    barrel = Camera(**WIDE, distortion=Distortion(k1=-0.1)).view_angles_deg()[0]
    x = np.tan(np.radians(barrel / 2))
    assert x * (1 - 0.1 * x * x) == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"projection": "fisheye"}, "projection"),
        (
            {"projection": "equidistant", "distortion": {"k1": 0.1}},
            'distortion: is for projection = "perspective" only',
        ),
        ({"projection": "equidistant", "focal_length_mm": 0.9}, "180"),
        ({"focal_length_mm": 4.0, "distortion": {"k1": -0.5}}, "distortion: k1 = -0.5 folds the image"),
        ({"focal_length_mm": 4.0, "distortion": {"p2": 0.9}}, "distortion: p2 = 0.9 folds the image"),
        ({"distortion": {"k4": 0.1}}, "unknown key distortion.k4"),
        ({"focus_distance_m": 0.018}, "focus_distance_m = 0.018: has to exceed the focal length of 0.018 m"),
        ({"focus_distance_m": -1.0}, 'focus_distance_m = -1.0: has to be a distance in m above 0, or "infinity"'),
        ({"focus_distance_m": "near"}, "focus_distance_m"),
        ({"focus_distance_m": True}, "focus_distance_m"),
        ({"psf": "gauss"}, "psf"),
        ({"psf": "measured"}, "psf_kernel has to be given"),
        ({"psf_kernel": [[1.0]]}, "psf_kernel has to be given"),
        ({"psf": "measured", "psf_kernel": [[0.5, 0.5]]}, "psf_kernel: has to be square, with an odd number"),
        ({"psf": "measured", "psf_kernel": [[0.9]]}, "psf_kernel: adds up to 0.9"),
        ({"psf": "measured", "psf_kernel": [[-0.1]]}, "psf_kernel[0][0] = -0.1"),
        ({"vignetting_deg": 90.0}, "vignetting_deg"),
        ({"vignetting_deg": 0.0}, "vignetting_deg"),
    ],
)
def test_an_impossible_lens_is_refused_in_one_line(settings: dict[str, object], said: str) -> None:
    with pytest.raises(InputError) as refusal:
        check(settings, Camera, "recipe.toml")
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)
