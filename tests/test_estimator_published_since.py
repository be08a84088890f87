"""Methods published since the paper: exact input gives the pose, known errors what a derivation by hand predicts."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from estimator_correspondences import device, simulated
from estimator_synthetic import Array, View, grid, view_of, write_dataset
from test_estimator_cones import rim

from estimator.camera.pose import Pose, rotation
from estimator.errors import EstimationFailure
from estimator.io.dataset import read_dataset, read_frame
from estimator.io.device import DeviceFrame
from estimator.io.led_map import DiscLed, SquareLed
from estimator.methods.catalogue import OWN
from estimator.methods.circle_centre import METHODS, pose_from_centres
from estimator.methods.eca_rssr import ranges_from_ratios
from estimator.methods.kim import position_from_vectors
from estimator.methods.lc_vlp import Curve, fit_curves
from estimator.methods.pnp import pose_from_pixels
from estimator.methods.r_p3p import candidates, large_triangle, pose_by_power
from estimator.methods.up2p import upright_pose
from estimator.methods.v_p4l import pose_from_sides, sides_of
from estimator.methods.v_pca import decide
from estimator.solvers.cones import ellipse_centre, fit_cone
from estimator.solvers.observations import observe
from estimator.solvers.received_power import fluxes, predicted_fluxes, with_power
from estimator.solvers.trilateration import position_from_ranges
from estimator.spots.contours import Contour
from estimator.spots.correspondences import find_correspondences
from estimator.spots.detect import Spot
from estimator.spots.identify import Correspondence

TILTED = view_of((3.5, 3.5, 3.5), 3.0, 25, -15, 40)
LEVEL = view_of((3.5, 3.5, 3.5), 3.0)
SQUARE = grid(2, 2, 0.6, (3.5, 3.5, 3.5))
POINT_ROUNDING_M = 1e-11
"""Rounding of images, 1e-16, times the distance of 3.5 m and some (distance / pattern)^2 = 70, with a margin."""


def pose(view: View) -> Pose:
    return Pose(np.array(view.position_m), view.R_cam_world)


def in_camera(view: View, points_m: Array) -> Array:
    return np.asarray((points_m - view.position_m) @ view.R_cam_world.T)


def image_of(view: View, points_m: Array) -> Array:
    p_cam = in_camera(view, points_m)
    return np.asarray(p_cam[:, :2] / p_cam[:, 2:])


def exact_fluxes(view: View, leds_m: Array) -> Array:
    """Light by Lambert's law, by hand: cos(phi) cos(theta) / d^2 with cos(phi) = height / d and cos(theta) = z / d."""
    height_m, distance_m = leds_m[:, 2] - view.position_m[2], np.linalg.norm(leds_m - view.position_m, axis=1)
    return np.asarray(height_m / distance_m * in_camera(view, leds_m)[:, 2] / distance_m / distance_m**2)


# GOPA


def gopa(view: View, leds_m: Array, held: View | None = None) -> Array:
    """Position from exact spots, where the accelerometer reads as if the camera were `held` so."""
    frame = device(view if held is None else held, 0.0)
    found = upright_pose(observe(frame, simulated(view, leds_m)))
    assert found is not None
    return found.position_m


@pytest.mark.parametrize("view", [LEVEL, TILTED])
def test_gopa_is_exact_at_one_height(view: View) -> None:
    np.testing.assert_allclose(gopa(view, SQUARE[:2]), view.position_m, atol=POINT_ROUNDING_M)
    np.testing.assert_allclose(gopa(view, SQUARE), view.position_m, atol=POINT_ROUNDING_M)


def test_a_tilt_error_moves_gopa_by_the_height_over_one_less_half_the_squared_sine() -> None:
    """Level below the middle of a square: an error t turns each line of sight w, of sine s to the vertical, and its
    distance from the old position is d t x w. The point u nearest to all lines has sum (I - w w^T) u = -t x sum d w =
    -n h t x z, and the mean of w_y^2 is s^2 / 2: u = h t / (1 - s^2 / 2) across. Second order is h t^2.
    """
    t, height_m, s2 = np.radians(1.0), 3.0, 2 * 0.3**2 / (9 + 2 * 0.3**2)
    error = np.abs(gopa(LEVEL, SQUARE, replace(LEVEL, tilt_x_deg=1.0)) - LEVEL.position_m)
    assert error[1] == pytest.approx(height_m * t / (1 - s2 / 2), abs=height_m * t**2)
    assert error[0] < 1e-9
    assert error[2] < height_m * t**2


# eCA-RSSR and R-P3P: received power


def rssr(view: View, leds_m: Array, flux: Array) -> Array:
    return position_from_ranges(leds_m, ranges_from_ratios(leds_m, image_of(view, leds_m), flux))


@pytest.mark.parametrize("view", [LEVEL, TILTED])
def test_ratios_of_power_give_the_position_whatever_the_radiance(view: View) -> None:
    for leds_m in (SQUARE, SQUARE[:3], grid(3, 2, 0.25, (3.5, 3.6, 3.5))):
        flux = 7e6 * exact_fluxes(view, leds_m)
        np.testing.assert_allclose(rssr(view, leds_m, flux), view.position_m, atol=10 * POINT_ROUNDING_M)


def test_five_percent_of_one_led_s_flux_move_rssr_by_a_quarter_of_a_metre() -> None:
    """Level below a square of LEDs at rho from its middle, at distances d. A share e of the flux makes one range
    shorter by n = e / 3. Its pairs have half of the squared lengths, so the law of cosines makes all ranges longer by
    n / 4. The differences of squared ranges are those of n d^2 for one LED, and with 4 rho^2 p = 2 d^2 n a the position
    moves by p = e d^2 / (6 rho) towards it; the mean squared range stays, and so does z to first order. Second order is
    a share n of that, and p^2 / (2 h) in z.
    """
    share, rho, height_m = 0.05, 0.3 * np.sqrt(2), 3.0
    flux = exact_fluxes(LEVEL, SQUARE)
    flux[0] *= 1 + share
    error = rssr(LEVEL, SQUARE, flux) - LEVEL.position_m
    predicted_m = share * (height_m**2 + rho**2) / (6 * rho)
    assert predicted_m > 0.15
    towards = (SQUARE[0] - SQUARE.mean(axis=0)) / rho
    np.testing.assert_allclose(error[:2], predicted_m * towards[:2], atol=2 * share / 3 * predicted_m)
    assert abs(error[2]) < predicted_m**2 / height_m


THREE = np.array([[3.2, 3.2, 3.5], [3.9, 3.3, 3.5], [3.4, 3.9, 3.3]])
# The quartic of P3P has roots to the square root of rounding where two of them are close, and to rounding elsewhere.
P3P_M = 1e-6


def test_power_decides_between_solutions_of_p3p() -> None:
    """Over fifty poses several candidates are below the LEDs in most; the right one is taken in each."""
    rng, several = np.random.default_rng(3), 0
    for _ in range(50):
        tilts = rng.uniform(-35, 35, 2)
        view = view_of((3.5, 3.5, 3.5), float(rng.uniform(1.5, 3)), *tilts, rng.uniform(0, 360))
        image, flux = image_of(view, THREE), 3e5 * exact_fluxes(view, THREE)
        below = [one for one in candidates(THREE, image) if one.position_m[2] < 3.3]
        several += len(below) > 1
        found = pose_by_power(THREE, image, flux, np.arange(3))
        np.testing.assert_allclose(found.position_m, view.position_m, atol=P3P_M)
    assert several > 25


def test_power_decides_and_moves_nothing() -> None:
    """An error of flux below that of the nearest candidate leaves the position as it is, to the last bit; fluxes of
    another candidate give that one.
    """
    image, flux = image_of(TILTED, THREE), exact_fluxes(TILTED, THREE)
    right = pose_by_power(THREE, image, flux, np.arange(3))
    flux[0] *= 1.05
    assert (pose_by_power(THREE, image, flux, np.arange(3)).position_m == right.position_m).all()
    other = max(candidates(THREE, image), key=lambda one: float(np.linalg.norm(one.position_m - right.position_m)))
    of_other = predicted_fluxes(other.in_camera(THREE), other.R_cam_world[:, 2])
    assert np.linalg.norm(other.position_m - right.position_m) > 0.1
    found = pose_by_power(THREE, image, of_other, np.arange(3))
    np.testing.assert_allclose(found.position_m, other.position_m, atol=1e-12)


def test_the_three_leds_span_a_large_triangle() -> None:
    chosen = large_triangle(grid(4, 3, 0.1, (3, 3, 3)))
    assert set(chosen.tolist()) <= {0, 3, 8, 11}
    assert len(set(chosen.tolist())) == 3


def test_predicted_fluxes_are_lambert_s() -> None:
    found = predicted_fluxes(in_camera(TILTED, THREE), TILTED.R_cam_world[:, 2])
    np.testing.assert_allclose(found, exact_fluxes(TILTED, THREE), rtol=1e-13)


def spot(flux_e: float, saturated: bool = False) -> Spot:
    return Spot(10.0, 10.0, np.eye(2), 10.0, 10.0, 50, 1000.0, False, saturated, flux_e)


def test_fluxes_are_per_area_and_saturated_ones_are_left_out() -> None:
    disc = DiscLed(id=1, position_m=(0, 0, 3), radius_m=0.02)
    square = SquareLed(id=2, position_m=(0, 0, 3), side_m=0.02)
    found = fluxes([Correspondence(disc, spot(5.0)), Correspondence(square, spot(5.0))])
    np.testing.assert_allclose(found, [5 / (np.pi * 4e-4), 5 / 4e-4])
    kept = with_power([Correspondence(disc, spot(5.0, True)), Correspondence(square, spot(5.0))])
    assert [one.led.id for one in kept] == [2]
    with pytest.raises(EstimationFailure, match="power: all LED images are saturated"):
        with_power([Correspondence(disc, spot(5.0, True))])
    with pytest.raises(EstimationFailure, match="power: the flux of LED images with stripes is not measured"):
        with_power([Correspondence(disc, spot(np.nan))])
    unknown = disc.model_copy(update={"radius_m": None})
    with pytest.raises(EstimationFailure, match="power: the map does not say how large its LEDs are"):
        with_power([Correspondence(unknown, spot(5.0))])


# V-PCA

RADIUS_M = 0.05
# As in test_estimator_cones.py: some (d / r)^2 times rounding, times the distance over the pattern for the yaw.
CONE_M = 10 * 3.5 * 5e-12


def v_pca(view: View, leds_m: Array, cones: list[Array], radius_m: float = RADIUS_M) -> Array:
    vectors_m, up = decide(leds_m, np.full(len(leds_m), radius_m), cones)
    tilt_x, tilt_y = np.arctan2(up[1], up[2]), -np.arcsin(up[0])
    return position_from_vectors(leds_m, vectors_m @ rotation(float(tilt_x), float(tilt_y)))


def cones_of(view: View, leds_m: Array, turn: float = 1.0) -> list[Array]:
    return [fit_cone(rim(view, led, turn=turn)) for led in leds_m]


@pytest.mark.parametrize("tilts", [(25, -15, 40), (40, 35, -100), (-50, 10, 200)])
def test_two_discs_give_the_position_by_their_cones(tilts: tuple[float, float, float]) -> None:
    view = view_of((3.5, 3.5, 3.5), 3.0, *tilts)
    for leds_m in (SQUARE[:2], SQUARE[[0, 3]], SQUARE):
        np.testing.assert_allclose(v_pca(view, leds_m, cones_of(view, leds_m)), view.position_m, atol=CONE_M)


def test_half_an_arc_gives_the_same_position() -> None:
    """A whole disc and half of another, the paper's case: an arc magnifies rounding some tens of times."""
    cones = [*cones_of(TILTED, SQUARE[:1]), *cones_of(TILTED, SQUARE[1:2], turn=0.5)]
    np.testing.assert_allclose(v_pca(TILTED, SQUARE[:2], cones), TILTED.position_m, atol=100 * CONE_M)


def test_a_radius_error_makes_v_pca_s_vectors_longer_by_its_share() -> None:
    """All vectors to the LEDs by 1 %, and so that to their middle: exactly 1 % of it."""
    found = v_pca(TILTED, SQUARE, cones_of(TILTED, SQUARE), radius_m=1.01 * RADIUS_M)
    expected = -0.01 * (SQUARE.mean(axis=0) - TILTED.position_m)
    np.testing.assert_allclose(found - TILTED.position_m, expected, atol=CONE_M)


def test_one_disc_has_two_solutions_and_is_refused() -> None:
    with pytest.raises(EstimationFailure, match="position: LEDs identified: 1, needed: 2"):
        v_pca(TILTED, SQUARE[:1], cones_of(TILTED, SQUARE[:1]))


# Circle centres

LARGE_M = 0.15
FIVE = np.vstack([SQUARE, [[3.6, 3.3, 3.5]]])


def centres_of(view: View, leds_m: Array) -> Array:
    return np.array([ellipse_centre(fit_cone(rim(view, led, LARGE_M))) for led in leds_m])


@pytest.mark.parametrize("view", [LEVEL, TILTED])
def test_corrected_centres_give_the_position(view: View) -> None:
    """Repeated until the position moves by 1e-9 m, with each repetition some (r / d)^2 of the one before."""
    found = pose_from_centres(FIVE, np.full(5, LARGE_M), centres_of(view, FIVE))
    np.testing.assert_allclose(found.position_m, view.position_m, atol=1e-9)


def test_without_correction_and_with_a_wrong_radius_the_error_is_as_its_square() -> None:
    """The difference of the centres goes as r^2: with a radius larger by e it is corrected (1 + e)^2 times, and
    -2 e - e^2 of the uncorrected error stays, to first order in that error. It is below 5 cm of 3.5 m, 0.015, by which
    the difference at the uncorrected pose is off.
    """
    centres, share = centres_of(TILTED, FIVE), 0.05
    raw = pose_from_pixels(FIVE, centres, np.eye(3), METHODS).position_m - TILTED.position_m
    assert 1e-3 < np.linalg.norm(raw) < 0.05
    off = pose_from_centres(FIVE, np.full(5, (1 + share) * LARGE_M), centres).position_m - TILTED.position_m
    predicted = -((1 + share) ** 2 - 1) * raw
    np.testing.assert_allclose(off, predicted, atol=0.015 * np.linalg.norm(predicted))


# LC-VLP


def square_rim(view: View, centre_m: Array, half_m: float, points: int = 160) -> Array:
    """Points of a square's edge in the image, none of them a corner."""
    along = (np.arange(points // 4) + 0.5) / (points // 4) * 2 - 1
    side = half_m * np.column_stack([along, np.ones(len(along)), 0 * along])
    world = np.concatenate([side @ rotation(0.0, 0.0, k * np.pi / 2) for k in range(4)]) + centre_m
    return image_of(view, world)


def off_by_a_degree(view: View) -> Pose:
    """An initial pose 5 cm and 1 deg beside the right one, as an accelerometer may give it."""
    turned = rotation(np.radians(1), np.radians(-1), np.radians(1)) @ view.R_cam_world
    return Pose(np.add(view.position_m, [0.05, -0.05, 0.05]), turned)


@pytest.mark.parametrize("view", [LEVEL, TILTED])
def test_a_disc_and_a_square_give_the_pose_whatever_the_start(view: View) -> None:
    """The fit ends where a step changes the position by 1e-12 of itself or the cost by as much, whose root is 1e-6 of
    the first step of 5 cm.
    """
    disc = DiscLed(id=1, position_m=tuple(SQUARE[0].tolist()), radius_m=RADIUS_M)
    square = SquareLed(id=2, position_m=tuple(SQUARE[3].tolist()), side_m=0.2)
    images = rim(view, SQUARE[0]), square_rim(view, SQUARE[3], 0.1)
    curves = [Curve.of(Contour(led, spot(1.0), image)) for led, image in zip((disc, square), images, strict=True)]
    found = fit_curves(curves, off_by_a_degree(view))
    np.testing.assert_allclose(found.position_m, view.position_m, atol=5e-8)
    np.testing.assert_allclose(found.R_cam_world, view.R_cam_world, atol=5e-8)


def test_a_square_s_size_error_scales_the_vector_to_it() -> None:
    """One square in view of a camera is a similar one, larger by 2 %, of a camera 2 % further from its centre."""
    curve = Curve(SQUARE[3], 1.02 * 0.1, np.inf, square_rim(TILTED, SQUARE[3], 0.1))
    found = fit_curves([curve], off_by_a_degree(TILTED))
    expected = -0.02 * (SQUARE[3] - TILTED.position_m)
    np.testing.assert_allclose(found.position_m - TILTED.position_m, expected, atol=5e-7)


# V-P4L

CENTRE_M = np.array([3.5, 3.5, 3.5])


def v_p4l(view: View, half_m: float, others_m: Array, true_half_m: float = 0.3) -> Pose:
    sides = sides_of(square_rim(view, CENTRE_M, true_half_m))
    return pose_from_sides(sides, CENTRE_M, half_m, others_m, image_of(view, others_m))


@pytest.mark.parametrize("tilts", [(0, 0, 0), (25, -15, 40), (-40, 30, 130), (10, 45, -100)])
def test_four_edges_give_the_pose_and_another_led_the_yaw(tilts: tuple[float, float, float]) -> None:
    """The planes of opposite sides meet at the angle of the square, 0.2: rounding of 1e-15 over 0.2, twice, at 3 m."""
    view = view_of((3.6, 3.4, 3.5), 3.0, *tilts)
    found = v_p4l(view, 0.3, CENTRE_M + [[1.0, 0.3, -0.2]])
    np.testing.assert_allclose(found.position_m, view.position_m, atol=1e-11)
    np.testing.assert_allclose(found.R_cam_world, view.R_cam_world, atol=1e-11)


def test_a_square_may_be_near() -> None:
    """The same image from a sixth of the distance: the position is as good."""
    view = view_of((3.55, 3.45, 3.5), 0.5, 25, -15, 40)
    found = v_p4l(view, 0.05, CENTRE_M + [[0.17, 0.05, -0.03]], true_half_m=0.05)
    np.testing.assert_allclose(found.position_m, view.position_m, atol=1e-11)


def test_a_square_turned_by_a_quarter_looks_the_same_and_has_another_position() -> None:
    """Where the other LED is said to be a quarter turn on, so is the camera."""
    quarter = rotation(0.0, 0.0, np.pi / 2)
    sides, other_m = sides_of(square_rim(TILTED, CENTRE_M, 0.3)), CENTRE_M + [[1.0, 0.3, -0.2]]
    turned_m = CENTRE_M + (other_m - CENTRE_M) @ quarter
    found = pose_from_sides(sides, CENTRE_M, 0.3, turned_m, image_of(TILTED, other_m))
    expected = CENTRE_M + (np.array(TILTED.position_m) - CENTRE_M) @ quarter
    np.testing.assert_allclose(found.position_m, expected, atol=1e-11)


def test_an_error_of_the_side_scales_the_vector_to_the_square() -> None:
    found = v_p4l(TILTED, 1.05 * 0.3, CENTRE_M + [[1.0, 0.3, -0.2]])
    expected = -0.05 * (CENTRE_M - TILTED.position_m)
    np.testing.assert_allclose(found.position_m - TILTED.position_m, expected, atol=1e-11)


def test_a_disc_has_not_four_sides() -> None:
    with pytest.raises(EstimationFailure, match="contour: the outline of a square LED has not four sides"):
        sides_of(rim(LEVEL, CENTRE_M, points=12))


# Through images of discs that are not the renderer's: 25 px of radius, edges of 16 x 16 samples a pixel, no noise

IMAGED = [view_of((3.5, 3.6, 3.5), 3.0, *tilt, size=(800, 600, 2500.0)) for tilt in ((30, -20, 0), (-15, 25, 70))]
IMAGED_RADIUS_M = 0.03


@pytest.fixture(scope="module")
def imaged(tmp_path_factory: pytest.TempPathFactory) -> list[DeviceFrame]:
    """Two tilted frames of six discs."""
    leds_m = grid(3, 2, 0.25, (3.5, 3.6, 3.5))
    folder = tmp_path_factory.mktemp("since") / "discs"
    dataset = read_dataset(write_dataset(folder, IMAGED, leds_m, IMAGED_RADIUS_M, noise=False))
    return [read_frame(dataset, record) for record in dataset.frames]


def errors_m(name: str, frames: Sequence[DeviceFrame], views: Sequence[View]) -> list[float]:
    return [
        float(np.linalg.norm(OWN[name].estimate(frame).position_m - view.position_m))
        for frame, view in zip(frames, views, strict=True)
    ]


def test_contours_of_images_give_the_position(imaged: list[DeviceFrame]) -> None:
    """A contour lies up to 1 / (12 r) = 0.0033 px inside, a share 1.3e-4 of the radius: V-PCA's vectors of 3.7 m are
    too long by 0.5 mm, and its normals off by 1e-4 over the sine of the tilt, 0.4 mm and more. Samples of 1/16 px are
    off by some 0.02 px at each of 150 points: 0.0023 px of a centre, or 3.4 um on the ceiling, which the distance of
    3.7 m to a pattern of 0.5 m makes 0.025 mm; four times that.
    """
    assert max(errors_m("v-pca", imaged, IMAGED)) < 1e-3
    assert max(errors_m("lc-vlp", imaged, IMAGED)) < 1e-4
    assert max(errors_m("circle-centre", imaged, IMAGED)) < 1e-4


def test_circle_centres_are_better_than_centroids_by_the_eccentricity(imaged: list[DeviceFrame]) -> None:
    """The centre of an ellipse is off by f (r / d)^2 sin t = 0.06 px, and by a tenth of that from LED to LED."""
    corrected, plain = errors_m("circle-centre", imaged, IMAGED), errors_m("pnp", imaged, IMAGED)
    assert min(plain) > 5 * max(corrected)


def test_an_obstacle_before_a_third_of_a_disc_leaves_v_pca_where_it_was(imaged: list[DeviceFrame]) -> None:
    """The obstacle's edge has a fourth of the contour's points. The centroid of such a disc is 6 px off."""
    frame, view = imaged[0], IMAGED[0]
    led = frame.spots[0]
    u, v = view.project(np.array([frame.leds[led.led].position_m]))[0]
    image = frame.parts[0].image_dn.copy()
    image[int(v) - 40 : int(v) + 40, int(u) + 8 : int(u) + 40] = image[0, 0]
    hidden = replace(frame, parts=(replace(frame.parts[0], image_dn=image),))
    moved = OWN["v-pca"].estimate(hidden).position_m - OWN["v-pca"].estimate(frame).position_m
    assert np.linalg.norm(moved) < 1e-3
    assert np.linalg.norm(OWN["pnp"].estimate(hidden).position_m - view.position_m) > 1e-2


def test_v_pca_uses_a_disc_that_the_border_of_the_region_cuts(imaged: list[DeviceFrame]) -> None:
    """The disc furthest to the right loses a third; its arc gives its range as the others do, to a millimetre."""
    frame, view = imaged[1], IMAGED[1]
    last = max(frame.spots, key=lambda one: one.u_px).led
    led_m = np.array(frame.leds[last].position_m)
    border = int(view.project(led_m[None])[0, 0]) + 8
    part = replace(frame.parts[0], image_dn=np.ascontiguousarray(frame.parts[0].image_dn[:, :border]))
    cut = replace(frame, parts=(part,))
    assert last not in [one.led.id for one in find_correspondences(cut)]
    estimate = OWN["v-pca"].estimate(cut)
    assert estimate.ranges_m[last] == pytest.approx(np.linalg.norm(led_m - view.position_m), abs=2e-3)
    assert np.linalg.norm(estimate.position_m - view.position_m) < 2e-3
