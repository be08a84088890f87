"""The lens: relative illumination against solid angles, blur against similar triangles, Airy pattern and energy."""

import numpy as np
import pytest
from scipy.special import j0, j1

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.psf import blur, blur_kernel, defocus_diameter_px
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.core.backend import dr, mi
from vlcrender.core.planar_shapes import rectangle_polygon_area

WIDE = {"width_px": 400, "height_px": 300, "pixel_pitch_um": 12.0, "focal_length_mm": 4.0}
LENSES = {
    "pinhole": Camera(**WIDE),
    "near focus": Camera(**WIDE, focus_distance_m=0.05),
    "distorted": Camera(**WIDE, distortion=Distortion(k1=-0.2, k2=0.05, p1=0.01, p2=-0.02)),
    "fish-eye": Camera(**(WIDE | {"focal_length_mm": 2.0}), projection="equidistant"),
}


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_relative_illumination_is_cosine_times_solid_angle(camera: Camera, rng: np.random.Generator) -> None:
    u, v = rng.uniform([[0], [0]], [[400], [300]], (2, 200))
    h = 1e-3
    corners = [
        np.stack(camera.unproject(u + i * h, v + j * h), axis=-1) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    corners = [c / np.linalg.norm(c, axis=-1, keepdims=True) for c in corners]
    spread = np.cross(corners[2] - corners[0], corners[3] - corners[1])
    solid_angle = np.linalg.norm(spread, axis=-1) / 2 / (2 * h) ** 2
    ray = np.stack(camera.unproject(u, v), axis=-1)
    cosine = ray[:, 2] / np.linalg.norm(ray, axis=-1)
    # differences over 2 h = 2e-3 px: 2^-52 / (2e-3 / 167 px) = 2e-11, twice; curvature (2e-3 / 167)^2 is less
    expected = cosine * solid_angle * camera.focal_px**2
    assert np.allclose(relative_illumination(camera, u, v), expected, rtol=1e-8)


def test_relative_illumination_is_cos4_of_a_pinhole_and_cos_sinc_of_a_fisheye() -> None:
    camera = Camera(**WIDE)
    u = 200 + camera.focal_px * np.tan(np.radians(20.0))
    assert relative_illumination(camera, u, 150.0) == pytest.approx(np.cos(np.radians(20.0)) ** 4)
    fisheye = LENSES["fish-eye"].model_copy(update={"focal_length_mm": 1.0})
    theta = np.radians([0.0, 60.0, 90.0, 110.0])
    u = 200 + fisheye.focal_px * theta
    expected = [1.0, 0.5 * np.sin(theta[1]) / theta[1], 0.0, 0.0]
    assert np.allclose(relative_illumination(fisheye, u, np.full(4, 150.0)), expected, atol=1e-12)


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_relative_illumination_is_the_same_in_a_kernel(camera: Camera, rng: np.random.Generator) -> None:
    camera = camera.model_copy(update={"vignetting_deg": 50.0})
    u, v = rng.uniform([[0], [0]], [[400], [300]], (2, 500)).astype(np.float32)
    plain = relative_illumination(camera, u.astype(float), v.astype(float), luminance=7.0)
    kernel = relative_illumination(camera, mi.Float(u), mi.Float(v), dr, mi.Float(7.0)).numpy()
    # float32: 2^-24 = 6e-8 an operation; acos near a hidden pupil loses half the digits of the visible share
    assert np.abs(kernel - plain).max() < 7 * 1e-5
    assert kernel.min() >= 0


def test_a_second_stop_hides_the_pupil_step_by_step() -> None:
    camera = Camera(**WIDE, vignetting_deg=40.0)
    stop = np.tan(np.radians(40.0))
    open_camera = Camera(**WIDE)
    s = np.array([0.0, 0.5, 1.0, 1.3])
    u = 200 + camera.focal_px * stop * s
    left = relative_illumination(camera, u, np.full(4, 150.0)) / relative_illumination(
        open_camera, u, np.full(4, 150.0)
    )
    # two circles, each through the centre of the other, share 2/3 - sqrt(3)/(2 pi) of one
    assert np.allclose(left, [1.0, 2 / 3 - np.sqrt(3) / (2 * np.pi), 0.0, 0.0], atol=1e-12)


def test_the_visible_pupil_agrees_with_a_count() -> None:
    camera = Camera(**WIDE, vignetting_deg=40.0)
    s = 0.3
    u = 200 + camera.focal_px * np.tan(np.radians(40.0)) * s
    grid = np.linspace(-1, 1, 2001)
    x, y = np.meshgrid(grid, grid)
    first, second = x**2 + y**2 < 1, (x - 2 * s) ** 2 + y**2 < 1
    left = relative_illumination(camera, u, 150.0) / relative_illumination(Camera(**WIDE), u, 150.0)
    # counted on a grid of 1e-3: its error is about 1e-3^1.5
    assert left == pytest.approx((first & second).sum() / first.sum(), abs=2e-4)


@pytest.mark.parametrize("focus", ["infinity", 0.5, 2.0])
@pytest.mark.parametrize("depth", [0.3, 3.5])
def test_defocus_by_the_lens_equation_and_similar_triangles(focus: float | str, depth: float) -> None:
    camera = Camera(focus_distance_m=focus)
    f = 0.018
    sensor_at = f if focus == "infinity" else 1 / (1 / f - 1 / float(focus))
    image_at = 1 / (1 / f - 1 / depth)
    blur_m = f / 2.2 * abs(sensor_at - image_at) / image_at
    assert float(defocus_diameter_px(camera, depth)) == pytest.approx(blur_m / 1.2e-6, rel=1e-9)


def test_defocus_of_the_phone_of_table_1() -> None:
    # D f / (z pitch) = 8.18 mm * 18 mm / (3.5 m * 1.2 um)
    assert float(defocus_diameter_px(Camera(focus_distance_m="infinity"), 3.5)) == pytest.approx(35.06, abs=0.01)
    assert defocus_diameter_px(Camera(focus_distance_m=3.5), 3.5) == 0
    assert (defocus_diameter_px(Camera(), np.array([0.1, 3.5])) == 0).all()


KERNELS = {
    "disc": Camera(focus_distance_m="infinity"),
    "near disc": Camera(focus_distance_m=3.3),
    "Airy": Camera(psf="diffraction"),
    "disc and Airy": Camera(focus_distance_m=2.0, psf="diffraction"),
    "wide Airy": Camera(f_number=16.0, psf="diffraction", focus_distance_m="infinity"),
    "measured": Camera(psf="measured", psf_kernel=((0.0, 0.1, 0.0), (0.1, 0.6, 0.1), (0.0, 0.1, 0.0))),
}


@pytest.mark.parametrize("camera", KERNELS.values(), ids=KERNELS)
def test_a_kernel_is_odd_and_symmetric_with_sum_1(camera: Camera) -> None:
    kernel = blur_kernel(camera, 3.5)
    assert kernel is not None
    assert kernel.shape[0] == kernel.shape[1]
    assert kernel.shape[0] % 2 == 1
    assert kernel.min() >= 0
    assert kernel.sum() == pytest.approx(1.0, abs=1e-12)
    for other in (kernel.T, kernel[::-1], kernel[:, ::-1]):
        assert np.allclose(kernel, other, atol=1e-15)


def test_a_point_in_focus_has_no_kernel() -> None:
    assert blur_kernel(Camera(), 3.5) is None
    assert blur_kernel(Camera(focus_distance_m=3.5), 3.5) is None


def second_moment(kernel: np.ndarray) -> float:
    at = np.arange(len(kernel)) - len(kernel) // 2
    return float((kernel.sum(axis=0) * at**2).sum())


@pytest.mark.parametrize("diameter", [4.0, 10.0, 35.0])
def test_a_discs_second_moment_is_c2_over_16_plus_a_pixels(diameter: float) -> None:
    camera = Camera(focus_distance_m="infinity")
    depth = float(defocus_diameter_px(camera, 1.0)) / diameter
    kernel = blur_kernel(camera, depth)
    assert kernel is not None
    # putting light at pixel centres adds 1/12 px^2 on average over where the disc's rim falls in its pixels:
    # a ring of half a pixel's moves, 1/2 * R * (rim's share of the light, about R^-1.5) either way
    assert second_moment(kernel) == pytest.approx(diameter**2 / 16 + 1 / 12, abs=0.5 * (diameter / 2) ** -0.5 / 2)


def test_variances_of_disc_and_measured_kernel_add_up() -> None:
    rows = KERNELS["measured"].psf_kernel
    disc = blur_kernel(Camera(focus_distance_m="infinity"), 3.5)
    both = blur_kernel(Camera(focus_distance_m="infinity", psf="measured", psf_kernel=rows), 3.5)
    assert disc is not None
    assert both is not None
    assert second_moment(both) == pytest.approx(second_moment(disc) + 0.2, abs=1e-9)


def test_the_airy_pattern_is_dark_at_1_22_lambda_n() -> None:
    scale_px = 30 / 1.2196699  # lambda N in pixels, such that the first dark ring has a radius of 30
    camera = Camera(psf="diffraction", pixel_pitch_um=0.55 * 2.2 / scale_px)
    kernel = blur_kernel(camera, 3.5)
    assert kernel is not None
    middle = len(kernel) // 2
    profile = kernel[middle, middle:] / kernel[middle, middle]
    assert 20 + int(profile[20:40].argmin()) == 30
    assert profile[30] < 1e-3  # averaged over a pixel: (pi / scale)^2 / 12 of the slope^2, 2e-4
    x = np.pi * np.arange(60) / scale_px + 1e-9
    assert np.allclose(profile[:60], (2 * j1(x) / x) ** 2, atol=2e-3)  # 1/24 of the curvature, (pi / scale)^2
    # Encircled energy 1 - J0^2 - J1^2 at the first dark ring, of all light; of the light within 150 px at most
    r = np.hypot(*np.meshgrid(np.arange(len(kernel)) - middle, np.arange(len(kernel)) - middle))
    v0, v150 = np.pi * 30 / scale_px, np.pi * 150 / scale_px
    encircled, held = (1 - j0(v) ** 2 - j1(v) ** 2 for v in (v0, v150))
    assert encircled - 1e-3 < kernel[r <= 30].sum() < encircled / held + 1e-3


def test_a_pixels_share_of_a_small_airy_pattern() -> None:
    """A pixel of Table 1's phone, 1.2 um at f/2.2, has the square's share, here summed on a grid."""
    kernel = blur_kernel(Camera(psf="diffraction"), 3.5)
    assert kernel is not None
    n = 400
    at = ((np.arange(n) + 0.5) / n - 0.5) * 1.2
    x = np.pi * np.hypot(*np.meshgrid(at, at)) / (0.55 * 2.2)
    share = ((2 * j1(x) / x) ** 2).mean() * 1.2**2 * np.pi / 4 / (0.55 * 2.2) ** 2
    # the kernel is scaled up by the light left out, at most AIRY_TAIL = 1 %
    assert share < kernel.max() < share / 0.99


def test_diffraction_widens_with_the_wavelength_and_the_working_f_number() -> None:
    peaks = [
        float(np.max(blur_kernel(Camera(psf="diffraction", **more), 0.198)))
        for more in ({}, {"psf_wavelength_nm": 605.0}, {"focus_distance_m": 0.198})
    ]
    # focus at 0.198 m makes f_i / D 1.1 times as large, as the wavelength
    assert peaks[1] < 0.95 * peaks[0]
    assert peaks[2] == pytest.approx(peaks[1], rel=1e-9)


def test_blur_keeps_the_light_and_the_centroid_of_a_patch(rng: np.random.Generator) -> None:
    kernel = blur_kernel(KERNELS["disc"], 3.5)
    assert kernel is not None
    patch = rng.random((40, 30)).astype(np.float32)
    blurred = blur(patch, kernel)
    m = len(kernel) // 2
    assert blurred.shape == (40 + 2 * m, 30 + 2 * m)
    assert blurred.dtype == np.float32
    assert blurred.min() >= 0
    # float32 results: 2^-24 each, thousands of them
    assert blurred.sum(dtype=float) == pytest.approx(patch.sum(dtype=float), rel=1e-6)
    for axis in (0, 1):
        before = (patch.sum(axis=1 - axis, dtype=float) * (np.arange(patch.shape[axis]) + m)).sum()
        after = (blurred.sum(axis=1 - axis, dtype=float) * np.arange(blurred.shape[axis])).sum()
        assert after == pytest.approx(before, rel=1e-6)


def test_blur_with_border_edge_repeats_the_border_pixels(rng: np.random.Generator) -> None:
    kernel = blur_kernel(KERNELS["near disc"], 3.5)
    assert kernel is not None
    assert np.allclose(blur(np.full((50, 60), 7.0), kernel, "edge"), 7.0, rtol=1e-12)
    image = rng.random((50, 60))
    m = len(kernel) // 2
    wide = np.pad(image, m, mode="edge")
    expected = [[(wide[r : r + 2 * m + 1, c : c + 2 * m + 1] * kernel).sum() for c in range(60)] for r in range(50)]
    assert np.allclose(blur(image, kernel, "edge"), expected, rtol=1e-12)
    assert blur(image, None, "edge") is image


@pytest.mark.parametrize("diameter", [1.0, 2.0, 4.0, 8.0, 16.0])
def test_the_error_of_blurring_pixel_averages_is_bounded(diameter: float) -> None:
    """A sharp edge, exact in each pixel, then blurred, against the exact blurred edge averaged over pixels."""
    camera = Camera(focus_distance_m="infinity")
    kernel = blur_kernel(camera, float(defocus_diameter_px(camera, 1.0)) / diameter)
    kernel = np.ones((1, 1)) if kernel is None else kernel
    m = len(kernel) // 2
    pixels = 2 * (m + int(diameter / 2) + 2) + 1
    left = np.arange(pixels) - pixels / 2
    u, v = np.meshgrid(left, left)
    quads = np.stack([np.stack([u + i, v + j], -1) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))], 2).reshape(-1, 4, 2)
    fine = np.add.outer(left, (np.arange(8) + 0.5) / 8).ravel()
    max_error = 0.0
    for angle in np.radians([0, 20, 45]):
        c, s = np.cos(angle), np.sin(angle)
        across = quads @ np.array([[c, -s], [s, c]])
        for shift in (0.0, 0.25, 0.5, 0.75):
            # the edge is one side of a very large square
            sharp = rectangle_polygon_area(across - [shift + 100, 0], 100, 100).reshape(pixels, pixels)
            t = np.clip(np.add.outer(s * fine, c * fine - shift) / (diameter / 2), -1, 1)
            truth = 0.5 + (t * np.sqrt(1 - t * t) + np.arcsin(t)) / np.pi
            truth = truth.reshape(pixels, 8, pixels, 8).mean(axis=(1, 3))
            inner = slice(m, pixels - m)
            max_error = max(
                max_error,
                float(np.abs(blur(sharp, kernel)[m : -m or None, m : -m or None] - truth)[inner, inner].max()),
            )
    assert max_error < 0.2 / diameter**1.5
    assert max_error > 0  # the kernel is an approximation
