"""What the lens makes of a point: against the discs and edges of closed forms."""

import json

import numpy as np
import pytest
from estimator_synthetic import description, view_of
from numpy.typing import NDArray
from scipy.special import j0, j1

from estimator.io.camera import Camera
from estimator.pixels.psf import LensBlur, airy_scale_px, disc_diameter_px

Floats = NDArray[np.float64]
VIEW = view_of((3.5, 3.6, 3.5), 3.0, size=(400, 300, 15000.0))


def camera(**changes: object) -> Camera:
    made = description(VIEW, 1, np.zeros((1, 3)), 0.01)["cameras"]["main"]  # type: ignore[index]
    return Camera.model_validate_json(json.dumps({**made, **changes}))


def focused_for(disc_px: float, depth_m: float) -> Camera:
    """Focused where a point at that depth becomes a disc of that diameter: 18 mm at f/2 and 1.2 um give 9 mm pupil."""
    focus = 1 / depth_m + disc_px * 1.2e-6 / (9e-3 * 18e-3)
    return camera(focus_distance_m=1 / focus)


def edge_of_disc(diameter: float, offsets: Floats) -> Floats:
    """Light in pixels whose centres are `offsets` beyond a straight edge: a disc's strips, over a pixel's width."""
    t = (np.arange(20000) + 0.5) / 20000 * diameter - diameter / 2
    strips = np.sqrt(diameter**2 / 4 - t**2)
    return np.array([(strips * np.clip(t - x + 0.5, 0, 1)).sum() for x in offsets]) / strips.sum()


def edge_of_kernel(kernel: Floats, factor: int, offsets: Floats) -> Floats:
    """The same by the kernel, on pixels subdivided by `factor`, then averaged."""
    line = kernel.sum(axis=0)
    away = (np.arange(len(line)) - len(line) // 2) / factor
    within = (np.arange(factor) + 0.5) / factor - 0.5
    at = offsets[:, None, None] + within[:, None] - away
    return np.asarray((np.clip(0.5 - at * factor, 0, 1) @ line).mean(axis=1))


def test_defocus_by_hand() -> None:
    """f = 18 mm at f/2, sensor at 18 mm, 1.2 um: focused at 2 m, a point at 3 m spreads over 9 mm x 18 mm / 6 m."""
    found = disc_diameter_px(camera(focus_distance_m=2.0), np.array([3.0, 2.0, 1.5]))
    assert found == pytest.approx([22.5, 0.0, 22.5])
    assert disc_diameter_px(camera(focus_distance_m="infinity"), np.array([3.0])) == pytest.approx([45.0])
    assert disc_diameter_px(camera(), np.array([3.0])) == pytest.approx([0.0])


def test_a_sharp_lens_has_no_kernels() -> None:
    lens = LensBlur(camera(), np.array([3.0, 5.0]))
    assert (lens.kernels, lens.slope_kernels, lens.radius_px, lens.factors.tolist()) == ([], [], 0, [1, 1])


@pytest.mark.parametrize("disc_px", [1.0, 2.0, 3.0, 5.0, 8.0, 20.0])
def test_an_edge_is_blurred_as_a_disc_does(disc_px: float) -> None:
    """A kernel of pixels counts a pixel's square twice, which makes an edge's step wrong by 0.2 / n^1.5 with n pixels
    across a disc: 0.9 % with 8. Of a disc of 1 px there are but 4, and then pixels of four of them are averaged.
    """
    lens = LensBlur(focused_for(disc_px, 3.0), np.array([3.0]))
    (fine,), (factor,) = lens.kernels, lens.factors.tolist()
    assert fine.sum() == pytest.approx(1)
    for phase in np.arange(0, 1, 0.125):
        offsets = np.arange(-15, 16) + phase
        found, expected = edge_of_kernel(fine, factor, offsets), edge_of_disc(disc_px, offsets)
        assert np.abs(found - expected).max() < 0.008


def test_the_airy_patterns_light_is_where_its_closed_form_says() -> None:
    """Encircled energy 1 - J0^2 - J1^2 (Born & Wolf 8.5.2, Eq. 18) at the first dark ring is 83.8 %; the kernel leaves
    out the 2 % beyond its radius, and pixels of 1/25 of the ring's diameter cut its rim by less than 1 %.
    """
    lens_camera = camera(psf="diffraction", f_number=22.0)
    scale = airy_scale_px(lens_camera)
    assert scale == pytest.approx(22 * 0.55 / 1.2)
    kernel = LensBlur(lens_camera, np.array([3.0])).kernels[0]
    centre = len(kernel) // 2
    v, u = np.mgrid[: len(kernel), : len(kernel)] - centre
    inside = kernel[np.hypot(u, v) <= 1.22 * scale].sum()
    x = 1.22 * np.pi
    assert inside == pytest.approx((1 - j0(x) ** 2 - j1(x) ** 2) / 0.98, abs=0.01)


def test_a_measured_kernel_is_used_unchanged() -> None:
    """On subdivided pixels the kernel has values at whole-pixel shifts alone."""
    rows = [[0.0, 0.1, 0.0], [0.2, 0.4, 0.1], [0.0, 0.2, 0.0]]
    lens = LensBlur(camera(psf="measured", psf_kernel=rows), np.array([3.0]))
    assert lens.factors.tolist() == [1]
    np.testing.assert_allclose(lens.kernels[0], rows)
    blurred = focused_for(2.0, 3.0).model_copy(update={"psf": "measured", "psf_kernel": tuple(map(tuple, rows))})
    both = LensBlur(blurred, np.array([3.0]))
    factor = int(both.factors[0])
    assert factor == 16
    fine, size = both.kernels[0], len(both.kernels[0])
    v, u = (np.mgrid[:size, :size] - size // 2) / factor
    # Its mean is the measured one's: (0.1 - 0.2, 0.2 - 0.1).
    assert (fine * u).sum() == pytest.approx(-0.1)
    assert (fine * v).sum() == pytest.approx(0.1)


def test_the_airy_pattern_grows_with_the_image_distance() -> None:
    """Focused at 0.5 m an 18 mm lens has its sensor at 1 / (1 / 18 - 1 / 500) mm, and the pupil of 18 mm / 22 under a
    smaller angle: the pattern is lambda f_i / D, 3.7 % wider than lambda N.
    """
    image_mm = 1 / (1 / 18 - 1 / 500)
    K = [[image_mm / 1.2e-3, 0.0, 200.0], [0.0, image_mm / 1.2e-3, 150.0], [0.0, 0.0, 1.0]]
    close = camera(psf="diffraction", f_number=22.0, focus_distance_m=0.5, image_distance_mm=image_mm, K=K)
    assert airy_scale_px(close) == pytest.approx(0.55 * image_mm / (18 / 22) / 1.2)
    assert airy_scale_px(close) / airy_scale_px(camera(psf="diffraction", f_number=22.0)) > 1.037
