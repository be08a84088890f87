"""Cones of discs and planes of edges, from points of their images; and the contours that the points come from."""

from dataclasses import replace

import numpy as np
import pytest
from estimator_correspondences import device
from estimator_synthetic import Array, View, view_of

from estimator.errors import EstimationFailure
from estimator.io.device import DecodedSpot, DeviceFrame, Part
from estimator.io.led_map import DiscLed
from estimator.solvers.cones import discs, ellipse_centre, ellipse_centres, fit_cone, fit_plane
from estimator.spots.contours import edges, find_contours

RADIUS_M = 0.05
TILTED = view_of((3.5, 3.5, 3.5), 3.0, 25, -15, 40)
AXIS_LED = np.array([3.5, 3.5, 3.5])
SIDE_LED = AXIS_LED + [0.3, -0.2, 0.0]


def rim(view: View, centre_m: Array, radius_m: float = RADIUS_M, turn: float = 1.0, points: int = 200) -> Array:
    """Points of a horizontal disc's edge in the image, at unit depth, over a share of a turn."""
    angle = 2 * np.pi * turn * np.arange(points) / points
    p_world = centre_m + radius_m * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    p_cam = (p_world - view.position_m) @ view.R_cam_world.T
    return np.asarray(p_cam[:, :2] / p_cam[:, 2:])


def in_camera(view: View, point_m: Array) -> Array:
    return np.asarray(view.R_cam_world @ (point_m - view.position_m))


# The smallest eigenvalue of a cone is (r / d)^2 = 1 / 4900 of the others, whose rounding, some 1e-15, changes the
# radius by as much of itself as of the eigenvalue: 5e-12, and depth in the same proportion.
ROUNDING_M = 3.5 * 5e-12


@pytest.mark.parametrize("led", [AXIS_LED, SIDE_LED])
def test_one_of_a_cone_s_two_discs_is_the_disc_and_both_are_on_the_cone(led: Array) -> None:
    cone = fit_cone(rim(TILTED, led))
    centres, normals = discs(cone)
    centre, normal = in_camera(TILTED, led), TILTED.R_cam_world[:, 2]
    off = [
        max(np.abs(RADIUS_M * c - centre).max(), np.abs(n - normal).max()) for c, n in zip(*discs(cone), strict=True)
    ]
    assert min(off) < ROUNDING_M
    assert max(off) > 0.1
    for c, n in zip(centres, normals, strict=True):
        across = np.linalg.svd(n[None])[2][1:]
        on_rim = (
            c
            + np.array([1.0, 0.6, -1.0, 0.0])[:, None] * across[0]
            + np.array([0.0, 0.8, 0.0, -1.0])[:, None] * across[1]
        )
        # Relative to the terms that cancel, c^T Q c.
        np.testing.assert_allclose(np.einsum("ni,ij,nj->n", on_rim, cone, on_rim), 0, atol=1e-12 * (c @ c))
        assert c[2] > 0
        assert n @ c > 0


def test_a_level_disc_has_one_solution() -> None:
    """Of a circle about the axis both are the same; the normal is sqrt(l1 - l2), of rounding: sqrt(1e-15) = 3e-8."""
    view = view_of((3.5, 3.5, 3.5), 3.0)
    centres, normals = discs(fit_cone(rim(view, AXIS_LED)))
    np.testing.assert_allclose(RADIUS_M * centres, [[0, 0, 3], [0, 0, 3]], atol=1e-6)
    np.testing.assert_allclose(normals, [[0, 0, 1], [0, 0, 1]], atol=1e-6)


@pytest.mark.parametrize("turn", [0.55, 0.8])
def test_an_arc_suffices_where_an_obstacle_s_edge_has_the_other_points(turn: float) -> None:
    """The points of the chord are 45 % and less of all. An arc of half a turn magnifies rounding some tens of times."""
    arc = rim(TILTED, SIDE_LED, turn=turn, points=round(200 * turn))
    chord = np.linspace(arc[-1], arc[0], round(190 * (1 - turn)) + 2)[1:-1]
    centres, _ = discs(fit_cone(np.concatenate([arc, chord])))
    assert np.abs(RADIUS_M * centres - in_camera(TILTED, SIDE_LED)).max(axis=1).min() < 100 * ROUNDING_M


def test_points_of_a_hyperbola_are_refused() -> None:
    t = np.linspace(-1, 1, 50)
    with pytest.raises(EstimationFailure, match="contour: no ellipse fits the edge of an LED image"):
        fit_cone(0.01 * np.column_stack([np.cosh(t), np.sinh(t)]))


@pytest.mark.parametrize("led", [AXIS_LED, SIDE_LED])
def test_the_predicted_centre_of_an_ellipse_is_that_of_the_fit(led: Array) -> None:
    centre = in_camera(TILTED, led)
    predicted = ellipse_centres(centre[None], np.array([RADIUS_M]), TILTED.R_cam_world[:, 2])[0]
    np.testing.assert_allclose(predicted, ellipse_centre(fit_cone(rim(TILTED, led))), atol=1e-14)
    assert np.linalg.norm(predicted - centre[:2] / centre[2]) > 1e-5


def test_on_the_axis_the_centre_moves_by_r2_sin_cos_over_d2() -> None:
    """Exactly r^2 sin t cos t / (d^2 - r^2 sin^2 t), by hand from the ends of the ellipse in the plane of the tilt:
    x = +-r cos t / (d -+ r sin t), whose mean it is.
    """
    d, r, t = 3.0, 0.2, np.radians(30)
    normal = np.array([np.sin(t), 0.0, np.cos(t)])
    ends = [s * r * np.cos(t) / (d - s * r * np.sin(t)) for s in (1, -1)]
    found = ellipse_centres(np.array([[0.0, 0.0, d]]), np.array([r]), normal)[0]
    np.testing.assert_allclose(found, [np.mean(ends), 0.0], atol=1e-16)
    assert np.mean(ends) == pytest.approx(r**2 * np.sin(t) * np.cos(t) / (d**2 - (r * np.sin(t)) ** 2), rel=1e-12)


def test_a_plane_holds_the_points_of_a_line_and_leaves_out_a_corner_s() -> None:
    """Points to rounding on a line of 0.2 at unit depth: its normal to 1e-15 over 0.2. Five of 45 are 0.01 off."""
    line = np.linspace([-0.1, 0.05], [0.1, 0.03], 40)
    corner = line[-1] + np.linspace([0.0, 0.01], [0.0, 0.05], 5)
    normal = fit_plane(np.concatenate([line, corner]))
    expected = np.cross([*line[0], 1.0], [*line[-1], 1.0])
    np.testing.assert_allclose(np.abs(normal), np.abs(expected) / np.linalg.norm(expected), atol=1e-13)


SUBLINES = 64


def disc_image(size: int, centre: tuple[float, float], radius_px: float) -> Array:
    """A disc of 1000 e on 10 e: in each of SUBLINES lines of a row the share of a pixel that is lit is exact."""
    y = (np.arange(size * SUBLINES) + 0.5) / SUBLINES - centre[1]
    half = np.sqrt(np.maximum(radius_px**2 - y**2, 0.0))
    columns = np.arange(size)
    low, high = centre[0] - half[:, None], centre[0] + half[:, None]
    lit = np.clip(np.minimum(high, columns + 1) - np.maximum(low, columns), 0, None)
    return np.asarray(10 + 990 * lit.reshape(size, SUBLINES, size).mean(axis=1))


@pytest.mark.parametrize("radius_px", [8.0, 30.3])
def test_a_contour_is_on_the_edge_or_a_little_inside(radius_px: float) -> None:
    """The mean of a circle over a line's width lies 1 / (24 r cos^2 a) px inside where the line meets its normal at a,
    a <= 45 deg; columns are lit by sublines, to 1 / 128 px.
    """
    centre = (40.3, 40.8)
    image = disc_image(80, centre, radius_px)
    points = edges(image, image > 505)
    off = np.hypot(*(points - centre).T) - radius_px
    assert len(points) > 4 * radius_px
    assert off.max() < 1 / 128
    assert off.min() > -1 / (12 * radius_px) - 1 / 128 - 1e-3  # pixels beyond 45 deg by noise of the gradient
    angles = np.sort(np.arctan2(*(points - centre).T))
    assert np.diff(angles).max() < 3 / radius_px  # all around, at most three pixels without a point


def frame_of(image: Array, led: DiscLed, spot_px: tuple[float, float]) -> DeviceFrame:
    """A frame of 400 x 300 pixels that reads out one region, its first pixel the sensor's first."""
    decoded = (DecodedSpot(led=led.id, u_px=spot_px[0], v_px=spot_px[1]),)
    part = Part(0, 0, np.rint(image).astype(np.uint32))
    return replace(device(View(400, 300, 1500.0, (0, 0, 0)), 0.0), parts=(part,), spots=decoded, leds={led.id: led})


LED = DiscLed(id=7, position_m=(0.0, 0.0, 3.0), radius_m=RADIUS_M)


def test_of_a_cut_image_the_arc_is_found_and_only_where_asked_for() -> None:
    """The region ends in the disc: no point lies where it is cut, all are on the edge. Digital numbers of 1 of 990 e
    round each of four pixels by 0.3 e: 1e-3 px.
    """
    image = disc_image(80, (75.0, 40.0), 20.0)
    frame = frame_of(image, LED, (70.0, 40.0))
    with pytest.raises(EstimationFailure, match="identify: no whole spot"):
        find_contours(frame)
    (contour,) = find_contours(frame, "disc", cut_too=True)
    points = frame.camera.to_pixels(contour.image)
    assert np.abs(np.hypot(*(points - [75.0, 40.0]).T) - 20.0).max() < 1 / (12 * 20) + 1 / 128 + 5e-3
    assert len(points) > 60


def test_what_has_no_contour_is_refused_by_name() -> None:
    image = disc_image(80, (40.0, 40.0), 20.0)
    frame = frame_of(image, LED, (40.0, 40.0))
    with pytest.raises(EstimationFailure, match="contour: none of the LEDs identified is a square"):
        find_contours(frame, "square")
    with pytest.raises(EstimationFailure, match="contour: the map does not say how large its LEDs are"):
        find_contours(frame_of(image, LED.model_copy(update={"radius_m": None}), (40.0, 40.0)))
    with pytest.raises(EstimationFailure, match="contour: LED images are too small: none has 16 points"):
        find_contours(frame_of(disc_image(80, (40.0, 40.0), 2.0), LED, (40.0, 40.0)))
