"""Images of LEDs under a pose: against faces cut up into many points, and slopes against differences."""

import json

import numpy as np
import pytest
from estimator_synthetic import View, description, view_of
from numpy.typing import NDArray

from estimator.camera.intrinsics import with_errors
from estimator.camera.pose import Pose
from estimator.io.camera import Camera
from estimator.io.led_map import DiscLed, Led, SquareLed
from estimator.pixels.led_model import (
    IMAGE_PARAMETERS,
    LOCAL_PARAMETERS,
    MOTION_COLUMNS,
    PRINCIPAL_POINT,
    SIZE_PARAMETER,
    TILT_PARAMETERS,
    ImageState,
    LedImageModel,
    fall_off,
    led_footprints,
    rim,
)
from estimator.pixels.polygon_raster import RoiStack
from estimator.pixels.psf import LensBlur, disc_diameter_px

Floats = NDArray[np.float64]
TARGET = (3.5, 3.6, 3.5)
VIEW = view_of(TARGET, 3.0, 35.0, -20.0, 30.0, size=(80, 60, 4000.0))
DISTORTION = {"k1": -3.0, "k2": 2.0, "k3": 0.0, "p1": 0.02, "p2": -0.03}
SIZE_PX = 45


def camera(view: View = VIEW, **changes: object) -> Camera:
    made = description(view, 1, np.zeros((1, 3)), 0.01)["cameras"]["main"]  # type: ignore[index]
    return Camera.model_validate_json(json.dumps({**made, **changes}))


def led(shape: str) -> Led:
    centre = (TARGET[0] + 0.002, TARGET[1] - 0.003, TARGET[2])
    if shape == "disc":
        return DiscLed(id=7, position_m=centre, radius_m=0.012)
    return SquareLed(id=7, position_m=centre, side_m=0.024)


def images(lens: Camera, one: Led, pose: Pose) -> LedImageModel:
    footprints = led_footprints([one], state(pose, lens))
    first = np.floor(footprints.centre - SIZE_PX / 2).astype(np.int64)
    size = np.array([SIZE_PX])
    rois = RoiStack(first[:, 1], first[:, 0], size, size)
    return LedImageModel([one], footprints, lens, LensBlur(lens, footprints.defocus_depth_m), rois)


def here(lens: Camera) -> Pose:
    return Pose(np.array(VIEW.position_m), VIEW.R_cam_world)


def state(pose: Pose, lens: Camera, leds: int = 1) -> ImageState:
    return ImageState.as_told(pose, lens, leds)


def share_of(model: LedImageModel, pose: Pose, lens: Camera) -> Floats:
    """The LED's share of each pixel: its light without the lens's fall-off."""
    return model.rois.roi(model.render(state(pose, lens)).light / model.fall_off, 0)


def share_by_points(one: Led, lens: Camera, rois: RoiStack, blur_px: float = 0.0) -> Floats:
    """Points of the face, each put in its pixel and worth the area of the image it stands for.

    Through a lens written out again here; with blur, every pixel's points are smeared over a disc of points.
    """
    step = one.half_width_m / 600
    x, y = np.meshgrid(*[np.arange(-one.half_width_m + step / 2, one.half_width_m, step)] * 2)
    inside = np.hypot(x, y) <= one.half_width_m if one.shape == "disc" else np.ones(x.shape, dtype=bool)
    face = np.stack([x[inside], y[inside], np.zeros(inside.sum())], axis=1) + np.array(one.position_m)
    footprints = (face - VIEW.position_m) @ VIEW.R_cam_world.T

    def pixels_of(points: Floats) -> Floats:
        a, b = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        if lens.distortion is not None:
            d, r2 = lens.distortion, a * a + b * b
            s = 1 + d.k1 * r2 + d.k2 * r2**2
            a, b = (
                a * s + 2 * d.p1 * a * b + d.p2 * (r2 + 2 * a * a),
                b * s + d.p1 * (r2 + 2 * b * b) + 2 * d.p2 * a * b,
            )
        return 4000 * np.column_stack([a, b]) + [40, 30]

    pixels = pixels_of(footprints)
    along = [(pixels_of(footprints + VIEW.R_cam_world[:, k] * step) - pixels) for k in (0, 1)]
    area = np.abs(along[0][:, 0] * along[1][:, 1] - along[0][:, 1] * along[1][:, 0])
    first = np.array([rois.columns[0], rois.rows[0]])
    share = np.zeros((SIZE_PX, SIZE_PX))
    shifts = np.zeros((1, 2))
    if blur_px:
        grid = np.stack(np.meshgrid(*[(np.arange(16) + 0.5) / 8 - 1] * 2), axis=-1).reshape(-1, 2)
        shifts = grid[np.hypot(*grid.T) <= 1] * blur_px / 2
        pixels, area = pixels[::7], area[::7] * 7
    for shift in shifts:
        column, row = np.floor(pixels + shift - first).astype(int).T
        ok = (column >= 0) & (column < SIZE_PX) & (row >= 0) & (row < SIZE_PX)
        share += np.bincount(row[ok] * SIZE_PX + column[ok], area[ok], SIZE_PX**2).reshape(SIZE_PX, SIZE_PX)
    return share / len(shifts)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["disc", "square"])
@pytest.mark.parametrize("distorted", [False, True])
def test_a_sharp_face_covers_what_its_points_do(shape: str, distorted: bool) -> None:
    """A pixel is 40 points across: what a face's or a pixel's border cuts off there is the lattice's discrepancy, some
    40^(2/3) points of 40^2, 0.7 %, on each of up to five borders (Sierpinski's bound for circles, as an order).
    """
    lens = camera(distortion=DISTORTION if distorted else None)
    model = images(lens, led(shape), here(lens))
    share = share_of(model, here(lens), lens)
    expected = share_by_points(led(shape), lens, model.rois)
    assert share.sum() == pytest.approx(expected.sum(), rel=1e-3)
    inside = (share > 0) & (share < 1)
    assert inside.sum() > 40
    assert np.abs(share - expected)[inside].max() < 0.03
    assert np.abs((share - expected)[inside]).mean() < 0.007
    assert np.all(share[expected == 0] < 0.01)


@pytest.mark.slow
def test_a_defocused_face_is_its_points_spread_over_discs() -> None:
    """A disc of 6 px on pixels of its half, good to 0.7 % at a straight edge; points, at 15 a pixel and 200 shifts, to
    half a percent.
    """
    view = camera(focus_distance_m=1.5)
    one = led("disc")
    depth = led_footprints([one], state(here(view), view)).defocus_depth_m
    f_number = float(disc_diameter_px(view, depth)[0]) * view.f_number / 6.0
    lens = view.model_copy(update={"f_number": f_number})
    assert disc_diameter_px(lens, depth) == pytest.approx([6.0])
    model = images(lens, one, here(lens))
    share = share_of(model, here(lens), lens)
    expected = share_by_points(one, lens, model.rois, 6.0)
    assert np.abs(share - expected).max() < 0.012
    sharp = share_by_points(one, lens, model.rois)
    assert np.abs(sharp - expected).max() > 0.3


@pytest.mark.parametrize("shape", ["disc", "square"])
@pytest.mark.parametrize("changes", [{}, {"distortion": DISTORTION}, {"focus_distance_m": 1.5, "f_number": 10.0}])
def test_slopes_are_what_differences_give(shape: str, changes: dict[str, object]) -> None:
    """Central differences over 1e-3 px. Slopes of sharp images are exact but for pixels that an edge just enters within
    the step (1e-3 / 2 of slopes up to 1) and an edge's middle standing for it; those of blurred ones, on whole pixels
    or halves where images have quarters, are good to some percent of the largest.
    """
    lens = camera(**changes)
    one, pose = led(shape), here(lens)
    model = images(lens, one, pose)
    cells = np.arange(model.rois.cells())
    found = model.render(state(pose, lens)).slopes(cells)
    for parameter in range(6):
        unit = np.eye(6)[parameter] * (1e-3 / 4000 * (3 if parameter < 3 else 1))
        ahead, behind = (model.render(state(pose.moved(sign * unit, lens), lens)).light for sign in (1, -1))
        difference = (ahead - behind) / (2 * unit[parameter])
        largest = np.abs(difference).max()
        tolerance = 0.12 if "f_number" in changes else 0.01
        assert np.abs(found[:, parameter] - difference).max() < tolerance * largest
        assert largest > 10


def test_rims_have_the_faces_area_and_go_round_once() -> None:
    for shape, area in (("disc", np.pi * 0.012**2), ("square", 4 * 0.012**2)):
        points = rim(led(shape), 32)
        x, y, _ = points.T
        assert (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2 == pytest.approx(area)
        assert len(np.unique(points.round(9), axis=0)) == 32


@pytest.mark.parametrize("distorted", [False, True])
@pytest.mark.parametrize("factor", [1, 2])
def test_the_fall_off_is_the_lens_s_in_every_pixel(factor: int, distorted: bool) -> None:
    """By hand at pixels of a region of 0.5 rad: cos^4 of the ray's angle, over the determinant of the distortion.

    Interpolated at 10 Chebyshev nodes, a function with poles 4 half widths from the middle leaves some 8^-10 = 1e-9 of
    it, times the order of the poles: far below 1e-6.
    """
    view = view_of(TARGET, 3.0, 0.0, 0.0, 0.0, size=(80, 60, 4000.0))
    distortion = {"k1": -0.2, "k2": 0.0, "k3": 0.0, "p1": 0.0, "p2": 0.0} if distorted else None
    lens = camera(view, distortion=distortion)
    one = np.ones(1, dtype=np.int64)
    rois = RoiStack(-200 * factor * one, 300 * factor * one, 1900 * factor * one, 2000 * factor * one)
    centre = np.array([[1300.0, 700.0]])
    values = rois.roi(fall_off(rois, centre, lens, factor * one), 0)

    def by_hand(u: Floats, v: Floats) -> Floats:
        # Radius on the sensor r + k1 r^3: its inverse by Newton's steps.
        radius = np.hypot((u - 40) / 4000, (v - 30) / 4000)
        k1, r = (-0.2 if distorted else 0.0), radius.copy()
        for _ in range(20):
            r -= (r + k1 * r**3 - radius) / (1 + 3 * k1 * r**2)
        return np.asarray(1 / (1 + r * r) ** 2 / ((1 + 3 * k1 * r**2) * (1 + k1 * r**2)))

    row, column = np.array([3, 800, 1850]) * factor, np.array([5, 900, 1990]) * factor
    u, v = (column + 0.5) / factor + 300, (row + 0.5) / factor - 200
    expected = by_hand(u, v) / by_hand(centre[:, 0], centre[:, 1])
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(values[row, column], expected, rtol=1e-6)


@pytest.mark.parametrize("distortion", [None, DISTORTION])
@pytest.mark.parametrize("parameter", range(6, IMAGE_PARAMETERS))
def test_slopes_by_camera_and_face_are_what_differences_give(
    parameter: int, distortion: dict[str, float] | None
) -> None:
    """As for the pose. The image is within 45 px of the principal point: steps of k1, p1 and p2 are large."""
    lens, one = camera(distortion=distortion), led("disc")
    pose = here(lens)
    model = images(lens, one, pose)
    found = model.render(state(pose, lens), np.arange(IMAGE_PARAMETERS)).slopes(np.arange(model.rois.cells()))
    largest = np.abs(found[:, parameter]).max()
    step = 1e-3 / largest

    def moved(sign: int) -> Floats:
        errors, size, tilts = np.zeros(7), np.ones(1), np.zeros((1, 2))
        if parameter < SIZE_PARAMETER:
            errors[parameter - 6] = sign * step
        elif parameter == SIZE_PARAMETER:
            size = size + sign * step
        else:
            tilts[0, parameter - TILT_PARAMETERS[0]] = sign * step
        return model.render(ImageState(pose, with_errors(lens, errors), np.zeros((1, 3)), size, tilts)).light

    difference = (moved(1) - moved(-1)) / (2 * step)
    assert np.abs(found[:, parameter] - difference).max() < 0.01 * largest


@pytest.mark.parametrize("changes", [{}, {"focus_distance_m": 1.5, "f_number": 10.0}])
def test_an_image_has_derivatives_by_other_parameters_than_it_was_rendered_with(changes: dict[str, object]) -> None:
    """They are those of a rendering by these parameters."""
    lens, one = camera(**changes), led("disc")
    model = images(lens, one, here(lens))
    cells, at = np.arange(model.rois.cells()), state(here(lens), lens)
    found = model.render(at, np.array([0, 5, SIZE_PARAMETER])).by(np.array([*PRINCIPAL_POINT, SIZE_PARAMETER]))
    expected = model.render(at, np.array([*PRINCIPAL_POINT, SIZE_PARAMETER]))
    assert found.parameters.tolist() == expected.parameters.tolist()
    largest = np.abs(expected.slopes(cells)).max()
    np.testing.assert_allclose(found.slopes(cells), expected.slopes(cells), atol=1e-12 * largest)


def test_an_led_that_moves_does_as_the_camera_that_moves_back() -> None:
    """A shift of 1e-3 px of the LED against the slopes by the position, with the opposite sign."""
    lens, one = camera(), led("square")
    pose = here(lens)
    model = images(lens, one, pose)
    found = model.render(state(pose, lens)).slopes(np.arange(model.rois.cells()))
    for axis in range(3):
        shift = np.zeros((1, 3))
        shift[0, axis] = 1e-3 / 4000 * 3
        ahead, behind = (
            model.render(ImageState(pose, lens, sign * shift, np.ones(1), np.zeros((1, 2)))).light for sign in (1, -1)
        )
        difference = (ahead - behind) / (2 * shift[0, axis])
        assert np.abs(difference + found[:, axis]).max() < 0.01 * np.abs(difference).max()


def test_a_tilted_face_is_the_points_that_it_says() -> None:
    """Tangents 0.2 along x and -0.1 along y: a square's rim is higher by 0.2 x - 0.1 y, its vertices by 0.3 and 0.1
    half widths and the opposite.
    """
    one = led("square")
    half_m = one.half_width_m
    tilted = ImageState(here(camera()), camera(), np.zeros((1, 3)), np.ones(1), np.array([[0.2, -0.1]]))
    heights_m = tilted.rims_m(rim(one, 4)[None])[0]
    vertices = {(round(x), round(y)): z for x, y, z in (heights_m / half_m).tolist()}
    assert vertices == pytest.approx({(1, 1): 0.1, (1, -1): 0.3, (-1, 1): -0.3, (-1, -1): -0.1})


def test_leds_that_are_not_imaged_have_no_footprint() -> None:
    lens = camera()
    pose = here(lens)
    behind = DiscLed(id=1, position_m=(3.5, 3.6, -5.0), radius_m=0.01)
    assert np.isnan(led_footprints([behind, led("disc")], state(pose, lens, 2)).centre).any(axis=1).tolist() == [
        True,
        False,
    ]


def test_the_motion_s_columns_are_those_behind_the_local_ones() -> None:
    """Six of a velocity: three of the place, three of the rotation."""
    assert (np.asarray(MOTION_COLUMNS) - LOCAL_PARAMETERS).tolist() == [0, 1, 2, 3, 4, 5]
