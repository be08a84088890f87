"""Detection: centroids, their covariances, and flags of LED images that are cut or saturated."""

import cv2
import numpy as np
import pytest
from estimator_synthetic import Array, View, grid, poisson, render, view_of

from estimator.errors import EstimationFailure
from estimator.spots.denoise import NEIGHBOURHOOD_RADIUS_PX, neighbourhood_mean
from estimator.spots.detect import Spot, detect
from estimator.spots.led_light import Ellipse, Readout, light_of
from estimator.spots.sampling import LensBlur

SMALL = (400, 300, 1500.0)
# A tenth of the full frame's width with the full frame's pixels.
SHARP = (480, 360, 15000.0)


def spots_of(expected_e: Array, denoised: bool = False) -> list[Spot]:
    image = expected_e.astype(np.float32)
    none_full = np.zeros(image.shape, bool)
    if denoised:
        return list(
            detect([Readout(0, 0, neighbourhood_mean(image), image, none_full)], image.size, NEIGHBOURHOOD_RADIUS_PX)
        )
    return list(detect([Readout(0, 0, image, image, none_full)], image.size, 0))


def centroids(spots: list[Spot]) -> Array:
    return np.array([(spot.u_px, spot.v_px) for spot in spots])


def by_nearest(spots: list[Spot], pixels: Array) -> Array:
    """Centroid minus pixel, for the spot nearest to each pixel."""
    found = centroids(spots)
    return np.array([found[np.argmin(np.hypot(*(found - pixel).T))] - pixel for pixel in pixels])


def test_pixel_centres_are_at_half() -> None:
    """A square of 7 x 7 pixels from row 10 and column 20 on has its centre at u = 23.5, v = 13.5."""
    image = np.full((40, 60), 5.0)
    image[10:17, 20:27] = 1000
    (spot,) = spots_of(image)
    np.testing.assert_allclose((spot.u_px, spot.v_px), (23.5, 13.5), atol=1e-9)


def test_the_brightest_pixel_is_given_by_its_centre() -> None:
    image = np.full((40, 60), 5.0)
    image[10:17, 20:27] = 1000
    image[12, 25] = 1001
    (spot,) = spots_of(image)
    assert (spot.brightest_u_px, spot.brightest_v_px, spot.peak_e) == (25.5, 12.5, 1001)


@pytest.mark.parametrize("denoised", [False, True])
@pytest.mark.parametrize(("size", "radius_px"), [(SMALL, 5.0), (SHARP, 50.0)])
def test_a_uniform_disc_has_its_centroid_at_its_centre(
    size: tuple[int, int, float], radius_px: float, denoised: bool
) -> None:
    """Level and noise-free, the image of a disc is a disc around the image of its centre."""
    view = view_of((3, 3, 3), 3.0, size=size)
    # 16 x 16 samples err by 0.3 / 16^1.5 of the light in each of some 2 pi r edge pixels, at a lever of r / sqrt(2).
    edge = 0.3 / 16**1.5 * np.sqrt(2 * np.pi * radius_px) * radius_px / np.sqrt(2) / (np.pi * radius_px**2)
    for shift in [(0, 0), (0.0007, 0.0003), (-0.004, 0.0021)]:
        led = np.array([[3 + shift[0], 3 + shift[1], 3.0]])
        (spot,) = spots_of(render(view, led), denoised)
        np.testing.assert_allclose([(spot.u_px, spot.v_px)], view.project(led), atol=5 * edge)


@pytest.mark.slow
@pytest.mark.parametrize("denoised", [False, True])
@pytest.mark.parametrize(("led_e", "background_e"), [(4000.0, 40.0), (60.0, 2.0)])
def test_scatter_agrees_with_the_stated_covariance(denoised: bool, led_e: float, background_e: float) -> None:
    """Squared Mahalanobis distances of n centroids sum to chi^2 with 2 n degrees of freedom: 2 n +- sqrt(4 n)."""
    view = view_of((3, 3, 3), 3.0, 20, 10, size=(70, 60, 1500.0))
    expected = render(view, np.array([[3.001, 3.0, 3.0]]), led_e=led_e, background_e=background_e)
    (clean,) = spots_of(expected, denoised)
    n, total = 800, 0.0
    for seed in range(n):
        (spot,) = spots_of(poisson(expected, seed), denoised)
        error = np.array([spot.u_px - clean.u_px, spot.v_px - clean.v_px])
        total += error @ np.linalg.inv(spot.covariance_px2) @ error
    assert abs(total / (2 * n) - 1) < 5 * np.sqrt(4 * n) / (2 * n)


@pytest.mark.parametrize("size", [SMALL, (1200, 900, 4500.0)])
def test_dim_and_bright_leds_are_all_found_before_walls_and_panels(size: tuple[int, int, float]) -> None:
    """Lamps of 4000 to 16000 electrons before a background of 40 to 100 with straight edges in it."""
    view = view_of((3, 3, 3), 3.0, 25, -15, size=size)
    leds = grid(4, 3, 0.16, (3, 3, 3))
    expected = render(view, leds, led_e=np.tile([4000.0, 16000.0, 8000.0], 4), background_e=40)
    expected[:, : size[0] // 3] += 60
    expected[size[1] // 2 :] += 20
    spots = spots_of(poisson(expected, 1))
    assert len(spots) == len(leds)
    # The wall's edge through an LED's region biases by a few hundredths; the rest is shot noise of 0.01 px.
    assert np.abs(by_nearest(spots, view.project(leds))).max() < 0.1


def test_a_neighbour_in_the_support_does_not_bias() -> None:
    """Two LEDs whose rims are 7 pixels apart, one 4 times brighter: shared supports are split between them."""
    view = view_of((3, 3, 3), 3.0, size=(80, 60, 1500.0))
    leds = np.array([[2.983, 3.0, 3.0], [3.017, 3.0, 3.0]])
    spots = spots_of(render(view, leds, led_e=[2000, 8000]))
    assert len(spots) == 2
    assert np.abs(by_nearest(spots, view.project(leds))).max() < 0.01


def test_a_neighbour_s_blurred_light_does_not_bias() -> None:
    """Rims 10 px apart: the denoiser brings each LED's light 5 px closer, into the other's support of 7 px."""
    view = view_of((3, 3, 3), 3.0, size=(400, 300, 7500.0))
    leds = np.array([[2.988, 3.0, 3.0], [3.012, 3.0, 3.0]])
    spots = spots_of(render(view, leds), denoised=True)
    assert len(spots) == 2
    assert np.abs(by_nearest(spots, view.project(leds))).max() < 0.01


def test_leds_of_one_electron_are_found() -> None:
    """Noise level 0 dB: mean 1 electron in the brightest pixel, over discs of 7800 pixels."""
    view = view_of((3, 3, 3), 3.0, size=(900, 700, 15000.0))
    leds = grid(2, 2, 0.08, (3, 3, 3))
    spots = spots_of(poisson(render(view, leds, led_e=1.0, background_e=0.01, samples=4), 1))
    assert len(spots) == 4
    # sigma = (r / 2) / sqrt(electrons) = 25 / sqrt(7854) = 0.28 px.
    assert np.abs(by_nearest(spots, view.project(leds))).max() < 5 * 0.28


@pytest.mark.parametrize(("du", "dv"), [(0.01, 0), (0, 0.01)])
def test_an_led_moved_along_x_or_y_moves_right_or_down(du: float, dv: float) -> None:
    view = view_of((3, 3, 3), 3.0, size=SMALL)
    (before,) = spots_of(render(view, np.array([[3.0, 3, 3]])))
    (after,) = spots_of(render(view, np.array([[3 + du, 3 + dv, 3]])))
    # 1 cm at 3 m with f = 1500 px is 5 px.
    np.testing.assert_allclose([after.u_px - before.u_px, after.v_px - before.v_px], [500 * du, 500 * dv], atol=0.01)


def test_spots_at_the_border_are_flagged_and_others_are_not() -> None:
    view = View(400, 300, 1500.0, (3, 3, 0))
    # Image at u = 200 + 500 (x - 3): the first is cut, the second ends 3 px inside, the third is well inside.
    leds = np.array([[3.398, 3, 3], [3.0, 3.284, 3], [2.7, 3, 3]])
    spots = spots_of(render(view, leds))
    flags = {round(spot.u_px / 50): spot.touches_border for spot in spots}
    assert flags == {8: True, 4: False, 1: False}
    blurred = spots_of(render(view, leds), denoised=True)
    assert {round(spot.u_px / 50): spot.touches_border for spot in blurred} == {8: True, 4: True, 1: False}


def test_saturation_is_told_from_the_raw_image() -> None:
    view = view_of((3, 3, 3), 3.0, size=SMALL)
    image = render(view, np.array([[2.9, 3, 3], [3.1, 3, 3]]), led_e=[900, 1000]).astype(np.float32)
    spots = detect(
        [Readout(0, 0, neighbourhood_mean(image), image, image >= 1000)], image.size, NEIGHBOURHOOD_RADIUS_PX
    )
    assert {spot.u_px > 200: spot.saturated for spot in spots} == {False: False, True: True}


@pytest.mark.parametrize("background_e", [0.0, 0.01, 40.0])
def test_an_image_without_leds_is_a_named_failure(background_e: float) -> None:
    with pytest.raises(EstimationFailure, match="detect: no spot"):
        spots_of(poisson(np.full((300, 400), background_e), 1))


def regions_around(image: Array, pixels: Array, half_px: int, denoised: bool) -> list[Readout]:
    """Square regions of an image around pixels (n, 2), as if nothing else had been read out."""
    readouts = []
    for u, v in pixels.astype(int):
        row, column = max(v - half_px, 0), max(u - half_px, 0)
        raw = image[row : v + half_px, column : u + half_px].astype(np.float32)
        shown = neighbourhood_mean(raw) if denoised else raw
        readouts.append(Readout(row, column, shown, raw, np.zeros(raw.shape, bool)))
    return readouts


@pytest.mark.parametrize("denoised", [False, True])
def test_regions_give_the_spots_of_the_full_frame(denoised: bool) -> None:
    """Discs of 12 px radius fill a third of regions of 36 px: not most pixels, but most of the outermost ones, are
    background. Both medians are off by noise, which moves the half level by a thousandth of itself and with it at most
    a few of the pixels at the support's rim, which hold noise alone: a fraction of the centroid's own sigma.
    """
    view = view_of((3, 3, 3), 3.0, 20.0, -10.0, size=(900, 700, 4000.0))
    leds = grid(3, 2, 0.15, (3, 3, 3))
    image = poisson(render(view, leds, led_e=[1000, 2000, 3000, 4000, 2000, 1000]), 3)
    whole = spots_of(image, denoised)
    radius_px = NEIGHBOURHOOD_RADIUS_PX if denoised else 0
    rois = regions_around(image, view.project(leds), 36, denoised)
    parts = detect(rois, image.size, radius_px)
    assert len(parts) == len(whole) == 6
    for spot in parts:
        same = min(whole, key=lambda other: np.hypot(other.u_px - spot.u_px, other.v_px - spot.v_px))
        sigma_px = np.sqrt(np.trace(same.covariance_px2))
        assert np.hypot(same.u_px - spot.u_px, same.v_px - spot.v_px) < 0.5 * sigma_px
        assert (same.brightest_u_px, same.brightest_v_px) == (spot.brightest_u_px, spot.brightest_v_px)
        assert not spot.touches_border


def test_an_led_image_that_fills_its_region_is_found_and_flagged() -> None:
    """The denoiser's neighbourhood extends beyond the region's border, and so may the light."""
    view = view_of((3, 3, 3), 3.0, size=(900, 700, 4000.0))
    leds = np.array([[3.0, 3.0, 3.0]])
    image = render(view, leds)
    tight = regions_around(image, view.project(leds), 17, True)  # radius 13.3 px: less than 5 + 2 px of margin
    (spot,) = detect(tight, image.size, NEIGHBOURHOOD_RADIUS_PX)
    assert spot.touches_border
    (raw,) = detect(regions_around(image, view.project(leds), 17, False), image.size, 0)
    assert not raw.touches_border


def square(view: View, led_m: Array, half_m: float) -> Array:
    """Electrons of a square LED with sides along x and y, by 2 x 2 points a pixel: coarse, and as good as another."""
    sub = (np.arange(2 * view.width_px) + 0.5) / 2, (np.arange(2 * view.height_px) + 0.5) / 2
    u, v = np.meshgrid(*sub)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ (view.R_cam_world.T @ np.linalg.inv(view.K)).T
    hit = np.asarray(view.position_m) + rays * ((led_m[2] - view.position_m[2]) / rays[..., 2:])
    inside = (np.abs(hit[..., :2] - led_m[:2]) <= half_m).all(axis=-1)
    cover = inside.reshape(view.height_px, 2, view.width_px, 2).mean(axis=(1, 3))
    return 40 + 3960 * cover


@pytest.mark.parametrize("yaw_deg", [0.0, 20.0, 45.0])
def test_the_centroid_of_a_square_includes_its_vertices(yaw_deg: float) -> None:
    """The ellipse of a square's moments leaves out its vertices, unevenly in a tilted view.

    The square is so small that the ellipse is used where no LED may be square.
    """
    view = view_of((3, 3, 3), 3.0, 50.0, 20.0, yaw_deg, size=(400, 320, 9000.0))
    expected = square(view, np.array([3.0003, 2.9998, 3.0]), 0.015)
    v, u = np.mgrid[: view.height_px, : view.width_px] + 0.5
    light = expected - 40
    exact = np.array([(light * u).sum(), (light * v).sum()]) / light.sum()
    image = expected.astype(np.float32)
    readout = Readout(0, 0, image, image, np.zeros(image.shape, bool))
    (around,) = detect([readout], image.size, 0, any_square=True)
    (without,) = detect([readout], image.size, 0)
    # float32 electrons summed in double precision: the remaining error is their rounding, 1e-7.
    assert np.hypot(around.u_px - exact[0], around.v_px - exact[1]) < 1e-5
    assert np.hypot(without.u_px - exact[0], without.v_px - exact[1]) > 1e-3


@pytest.mark.parametrize(("shape", "half_px"), [("square", 70), ("disc", 70), ("disc", 42)])
def test_the_background_of_a_large_led_image_has_the_fall_off_of_its_light(shape: str, half_px: int) -> None:
    """A plane of illumination, a third across the LED image, over LED and ceiling alike; the face hides the ceiling.

    The centroid is that of the LED's light. A level background of 2 % moves it by 0.1 px.
    """
    v, u = np.mgrid[:500, :600] + 0.5
    du, dv = u - 310.3, v - 240.2
    off_px = np.hypot(du, dv) if shape == "disc" else np.maximum(abs(du + 0.2 * dv), abs(dv - 0.2 * du))
    cover = off_px < half_px
    illumination = 1 + 0.0021 * du - 0.0012 * dv
    light = cover * illumination
    exact = np.array([(light * u).sum(), (light * v).sum()]) / light.sum()
    image = (illumination * (80 + 3920 * cover)).astype(np.float32)
    readout = Readout(0, 0, image, image, np.zeros(image.shape, bool))
    (spot,) = detect([readout], image.size, 0, any_square=shape == "square")
    # float32 electrons: rounding of 3e-8 of 4000 in each of 2e4 pixels, at 70 px, is 1e-7 px when it adds at random.
    assert np.hypot(spot.u_px - exact[0], spot.v_px - exact[1]) < 1e-6


def test_an_led_between_two_surfaces_of_equal_share_has_a_centroid() -> None:
    """Half of the ring has 40 electrons, half 160: none of its pixels is near its median, 100.

    With their mean as background the margin of 2.5 px about the disc of 9 px has 60 electrons too few on one side and
    too many on the other: 160 px at some 6.5 px along u move the centroid of 254 px of 3900 electrons by 0.06 px.
    """
    v, u = np.mgrid[:100, :120] + 0.5
    image = np.where(np.hypot(u - 60, v - 50) < 9, 4000.0, np.where(u < 60, 40.0, 160.0))
    (spot,) = spots_of(image)
    assert np.hypot(spot.u_px - 60, spot.v_px - 50) < 0.1


def test_an_led_image_in_the_angle_of_another_is_one_alone() -> None:
    """Its area is a quarter of the other's: as a piece in the other's box it would count twice."""
    v, u = np.mgrid[:150, :180] + 0.5
    angle = (u > 20) & (v < 80) & ((u < 30) & (v > 20) | (u < 80) & (v > 70))
    found = spots_of(np.where(angle | (np.hypot(u - 60, v - 40) < 9), 4000.0, 40.0))
    assert sorted(spot.area_px for spot in found) == pytest.approx([254, 1100], rel=0.05)


def test_without_covariances_all_else_is_the_same() -> None:
    """But for rounding: sums of a thousand pixels in another order, 1e-16 each, differ by 1e-14 of the largest."""
    v, u = np.mgrid[:100, :120] + 0.5
    image = (40 + 3960.0 * (np.hypot(u - 60.3, v - 50.2) < 9)).astype(np.float32)
    readout = Readout(0, 0, neighbourhood_mean(image), image, np.zeros(image.shape, bool))
    (whole,) = detect([readout], image.size, NEIGHBOURHOOD_RADIUS_PX)
    (spot,) = detect([readout], image.size, NEIGHBOURHOOD_RADIUS_PX, with_covariances=False)
    assert np.isfinite(whole.covariance_px2).all()
    assert np.isnan(spot.covariance_px2).all()
    for name, value in vars(whole).items():
        if name != "covariance_px2":
            assert getattr(spot, name) == pytest.approx(value, rel=1e-12), name


@pytest.mark.parametrize("blur_px", [3, 12, 24])
def test_the_support_contains_all_light_of_a_blurred_led(blur_px: int) -> None:
    """A disc seen at 60 deg and out of focus, by a uniform disc: its ellipse at half level is not where its light ends.
    The blur is even and leaves the centroid where it was. What is cut off may move it by a fifth of the shot noise's
    sigma, 4 % of its variance; without a fringe it is up to 1.2 sigma.
    """
    view = view_of((3, 3, 3), 3.0, 60.0, 0.0, 30.0, size=(400, 300, 9000.0))
    sharp = render(view, np.array([[3.0001, 3.0002, 3.0]]), radius_m=0.012)
    y, x = np.mgrid[-blur_px : blur_px + 1, -blur_px : blur_px + 1]
    kernel = (x**2 + y**2 <= blur_px**2).astype(float)
    image = cv2.filter2D(sharp, -1, kernel / kernel.sum())
    light = sharp - 40
    v, u = np.mgrid[: view.height_px, : view.width_px] + 0.5
    (spot,) = spots_of(image)
    off = np.array([spot.u_px, spot.v_px]) - [(light * u).sum() / light.sum(), (light * v).sum() / light.sum()]
    assert (np.abs(off) < 0.2 * np.sqrt(np.diag(spot.covariance_px2))).all()


def test_scatter_includes_the_photo_response_nonuniformity() -> None:
    """20 000 e and 5 %: a pixel's variance is 20 000 of shot noise and 1 000 000 of its own response. The sum over n
    centroids is 2 n +- sqrt(4 n), as above.
    """
    view = view_of((3, 3, 3), 3.0, 20, 10, size=(70, 60, 1500.0))
    expected = render(view, np.array([[3.001, 3.0, 3.0]]), led_e=20000.0)
    (clean,) = spots_of(expected)
    rng = np.random.default_rng(4)
    n, total = 200, 0.0
    for _ in range(n):
        response = 1 + 0.05 * rng.standard_normal(expected.shape)
        image = rng.poisson(expected * response).astype(np.float32)
        (spot,) = detect([Readout(0, 0, image, image, np.zeros(image.shape, bool), prnu=0.05)], image.size, 0)
        error = np.array([spot.u_px - clean.u_px, spot.v_px - clean.v_px])
        total += error @ np.linalg.inv(spot.covariance_px2) @ error
    assert abs(total / (2 * n) - 1) < 5 * np.sqrt(4 * n) / (2 * n)


def test_a_floor_counts_as_much_as_background() -> None:
    """700 e of light have a variance of 700 e^2, and so has a floor of that: the centroid's covariance is the same."""
    image = np.full((60, 60), 100.0, dtype=np.float32)
    image[25:34, 20:29] = 1100.0
    none = np.zeros(image.shape, bool)
    (quiet,) = detect([Readout(0, 0, image, image, none)], image.size, 0)
    (floor,) = detect([Readout(0, 0, image, image, none, floor_e2=700.0)], image.size, 0)
    (light,) = detect([Readout(0, 0, image + 700, image + 700, none)], image.size, 0)
    np.testing.assert_allclose(floor.covariance_px2, light.covariance_px2, rtol=1e-6, atol=1e-12)
    # The square's own: the sum of (u - u0)^2 is 9 x 60, times 1100 e, over the flux squared; the margin adds to it.
    assert (np.diag(quiet.covariance_px2) > 540 * 1100.0 / (81 * 1000.0) ** 2).all()


@pytest.mark.parametrize(("led_e", "found"), [(36.0, 0), (46.0, 1)])
def test_a_spot_has_a_signal_of_five_sigma(led_e: float, found: int) -> None:
    """A square of 7 x 7 pixels before 1000 e: its flux is 49 led_e. Half of the upper quartile of its 5 x 5 mean is a
    level of 0.3, which 69 pixels reach; the support is about the disc of that area and 0.5 + 2 px around it, 162 pixels
    of 1000 e. 36 e are 4.4 sigma and 46 e are 5.5 sigma: below five, the noise moves a centroid by the support's radius
    over that ratio, more than a pixel.
    """
    image = np.full((60, 60), 1000.0)
    image[25:32, 20:27] += led_e
    support_px = np.pi * (np.sqrt(69 / np.pi) + 2.5) ** 2
    ratio = 49 * led_e / np.sqrt(support_px * 1000 + 49 * led_e)
    assert (ratio > 5) == bool(found)
    if found:
        (spot,) = spots_of(image)
        assert spot.area_px == 69
    else:
        with pytest.raises(EstimationFailure, match="detect: no spot"):
            spots_of(image)


def test_the_margin_holds_the_blur_that_the_smoothing_hides() -> None:
    """A blur of up to half of the 5 x 5 mean widens a blob by nothing that is told from the mean's own fringe, and only
    the margin holds its light. The support then has all light: what is left is the rounding of float32 electrons.
    """
    view = view_of((3, 3, 3), 3.0, 60.0, 0.0, 30.0, size=(200, 150, 9000.0))
    sharp = render(view, np.array([[3.0001, 3.0002, 3.0]]), radius_m=0.012)
    y, x = np.mgrid[-2:3, -2:3]
    kernel = (x**2 + y**2 <= 4).astype(float)
    image = cv2.filter2D(sharp, -1, kernel / kernel.sum())
    light = image - 40
    v, u = np.mgrid[: view.height_px, : view.width_px] + 0.5
    none_full = np.zeros(image.shape, bool)
    exposed = image.astype(np.float32)
    (spot,) = detect([Readout(0, 0, exposed, exposed, none_full)], image.size, 0, lens=LensBlur(sharp=False))
    assert spot.u_px == pytest.approx((light * u).sum() / light.sum(), abs=1e-5)
    assert spot.v_px == pytest.approx((light * v).sum() / light.sum(), abs=1e-5)


def blank(value_e: float, size_px: int = 60) -> Array:
    return np.full((size_px, size_px), value_e)


def test_a_frame_without_a_spot_says_what_was_seen() -> None:
    """Nothing; a quarter of the frame; 147 e before 100 e a pixel, 1 sigma; a pixel in the frame's corner, which the
    5 x 5 mean spreads over 9 px.
    """
    with pytest.raises(EstimationFailure, match=r"^detect: no spot found; no area is brighter than 100 e$"):
        spots_of(blank(100.0))
    walled = blank(100.0)
    walled[:30, :30] = 1000.0
    with pytest.raises(EstimationFailure, match=r"bright areas: 1 larger than 0.1 of the sensor$"):
        spots_of(walled)
    faint = blank(100.0)
    faint[25:32, 20:27] += 3.0
    with pytest.raises(EstimationFailure, match=r"bright areas: 1 fainter than 5 sigma$"):
        spots_of(faint)
    cornered = blank(100.0)
    cornered[0, 0] = 200.0
    with pytest.raises(EstimationFailure, match=r"bright areas: 1 smaller than 16 px$"):
        spots_of(cornered)


def test_a_ring_of_two_surfaces_has_a_background() -> None:
    """Half the ring is dark and half bright: no pixel is near the median between, and all of them count."""
    image = np.full((60, 60), 100.0)
    image[:, 30:] = 10_000.0
    image[27:34, 27:33] = 1e6
    (spot,) = spots_of(image)
    # The support has at most 14 x 14 pixels, each half off its background by 4950 e at a mean lever of 3.5 px.
    assert abs(spot.u_px - 30.0) < 14 * 14 * 4950 * 3.5 / 42e6


def test_a_neighbour_s_pixels_are_neither_light_nor_background() -> None:
    """Two discs of radius 5 px, 11.2 px apart: the margins of 2 px overlap, and each is in the other's ring."""
    v, u = np.mgrid[:60, :60] + 0.5
    image = np.full((60, 60), 100.0, dtype=np.float32)
    one, other = (
        Ellipse((at, 30.0), (1.0, 0.0), (5.0, 5.0), (at - 5, 25.0), (at + 5, 35.0), 78, 1.0) for at in (20.0, 31.2)
    )
    off_px, other_px = np.hypot(u - 20, v - 30), np.hypot(u - 31.2, v - 30)
    light = light_of(Readout(0, 0, image, image, np.zeros(image.shape, bool)), one, [other], 0)
    nearer, ring = (off_px <= 7) & (off_px <= other_px), (off_px > 7) & (off_px <= 10) & (other_px > 7)
    assert light.support.sum() == nearer.sum() < (off_px <= 7).sum()
    assert len(light.ring_off_e) == ring.sum()
