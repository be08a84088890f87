"""The hybrid bound and the model of spots against dense least squares by hand, and how they answer to each sigma."""

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import block_diag
from test_crlb import EXPOSURE_S, POSE, light_of, room_of_leds, variance_at_pose

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera, Pose, rotation_cam_world
from vlcrender.camera.rig import Mounted, mounted_cameras
from vlcrender.camera.roi import LedRegions, RegionImage
from vlcrender.rendering.crlb import FrameSlopes
from vlcrender.rendering.face_motions import face_motions
from vlcrender.rendering.renderer import Renderer
from vlcrender.rendering.spot_errors import SpotErrors
from vlcrender.rendering.uncertainty import (
    INTRINSICS,
    MapLevers,
    Uncertainty,
    intrinsics_displacements_px,
    mounting_tilt_slopes,
    tilt_covariance_rad2,
)
from vlcrender.scene.leds import Leds
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import variance_e2

Array = np.ndarray

TILTS_DEG = (0.3, 0.3)
CAMERA = Camera(
    width_px=400,
    height_px=300,
    pixel_pitch_um=12.0,
    principal_point_px=(203.0, 148.0),
    distortion=Distortion(k1=-0.05, p1=1e-3, p2=-2e-3),
)
LUMINAIRE_OF_LED = np.array([0, 0, 1, 1])
FREE = 10.0
"""A sigma of a size or a face's tilt that is next to no knowledge."""


def calibrated() -> Uncertainty:
    """Errors of a calibrated phone and a surveyed map, in px of CAMERA; all different, so that none replaces another.

    Sizes and faces are unknown: then images tell their place alone, as spots do.
    """
    deg = np.pi / 180
    luminaire = [3e-3, 2e-3, 4e-3, 0.2 * deg, 0.3 * deg, 0.25 * deg]
    ones = np.ones(4)
    return Uncertainty(
        intrinsics=np.array([1e-3, 1e-4, 0.5, 0.6, 2e-3, 3e-4, 2e-4]),
        luminaire_of_led=LUMINAIRE_OF_LED,
        luminaires=np.array([luminaire, luminaire]),
        led_positions_m=np.tile([3e-4, 4e-4, 5e-4], (4, 1)),
        led_sizes=FREE * ones,
        led_gradients=0 * ones,
        led_faces_rad=FREE * ones,
        datum_m=np.array([1e-3, 2e-3, 3e-3]),
        scale=2e-4,
    )


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return room_of_leds()


def slopes_of(renderer: Renderer, mounted: Mounted) -> FrameSlopes:
    variance = variance_at_pose(renderer, mounted.camera)
    found = FrameSlopes.rendered(mounted, POSE, light_of(renderer, range(4)), EXPOSURE_S, variance, 2.6)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def slopes(renderer: Renderer) -> FrameSlopes:
    return slopes_of(renderer, mounted_cameras(CAMERA, ())[0])


def bound_of(slopes: FrameSlopes, leds: Leds, uncertainty: Uncertainty) -> Array:
    bound = slopes.hybrid_bound_m2(TILTS_DEG, leds, uncertainty)
    assert bound is not None
    return bound


def position_by_hand(errors: Array, leds_m: Array) -> Array:
    """As-built positions of the LEDs (FORMAT.md, "Told and true"), (4, 3), for 4 + 2 x 6 errors of the map.

    Datum x, y, z and scale; then shift and rotation vector of each luminaire.
    """
    built = np.zeros_like(leds_m)
    for number in range(2):
        own = np.flatnonzero(number == LUMINAIRE_OF_LED)
        shift, turn = errors[4 + 6 * number :][:3], errors[4 + 6 * number :][3:6]
        center = leds_m[own].mean(axis=0)
        arm = leds_m[own] - center
        built[own] = (1 + errors[3]) * (center + shift + arm + np.cross(turn, arm))
    return built + errors[:3]


def test_a_luminaire_moves_and_turns_its_leds_as_the_format_says(renderer: Renderer) -> None:
    """LEDs at different heights, so that turns about x and y move them sideways too. Positions are linear in each
    error, so that a difference by two sigmas is exact but for rounding: 2^-52 of some 3 m, over a sigma of 2e-3.
    """
    heights_m = np.outer([0.0, 0.05, -0.03, 0.08], [0.0, 0.0, 1.0])
    leds = replace(renderer.scene.leds, centers_m=renderer.scene.leds.centers_m + heights_m)
    levers = MapLevers(calibrated(), leds, np.arange(4)).of_luminaires
    for unknown, sigma in enumerate(calibrated().luminaires[0]):
        errors = np.zeros(16)
        errors[[4 + unknown, 10 + unknown]] = sigma
        moved_m = (position_by_hand(errors, leds.centers_m) - position_by_hand(-errors, leds.centers_m)) / 2
        np.testing.assert_allclose(levers[:, :, unknown], moved_m, rtol=0, atol=4 * 2**-52 * 3)


def spots_by_hand(pose: Array, lens: Array, positions_m: Array) -> Array:
    """Images (8,) of points, px, with the lens's errors (7,) as FORMAT.md has them; pose: x, y, z, m, angles, rad."""
    p = (positions_m - pose[:3]) @ rotation_cam_world(*np.degrees(pose[3:])).T
    x, y = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]
    r2 = x * x + y * y
    k1, p1, p2 = -0.05 + lens[4], 1e-3 + lens[5], -2e-3 + lens[6]
    x_d = x * (1 + k1 * r2) + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    y_d = y * (1 + k1 * r2) + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    f = 1500.0 * (1 + lens[0])
    u = f * (1 + lens[1] / 2) * x_d + 203.0 + lens[2]
    v = f * (1 - lens[1] / 2) * y_d + 148.0 + lens[3]
    return np.stack([u, v], axis=1).ravel()


def bound_by_hand(leds_m: Array, uncertainty: Uncertainty, noise_px2: Array) -> Array:
    """Covariance of the position by generalised least squares of point LEDs, all errors in one dense matrix."""
    x, y, z = POSE.position_m
    pose = np.array([x, y, z, *np.radians([POSE.tilt_x_deg, POSE.tilt_y_deg, POSE.yaw_deg])])
    at = np.concatenate([pose, np.zeros(7 + 4 + 12 + 12)])

    def spots(unknowns: Array) -> Array:
        positions = position_by_hand(unknowns[13:29], leds_m) + unknowns[29:].reshape(4, 3)
        return spots_by_hand(unknowns[:6], unknowns[6:13], positions)

    steps = 1e-5 * np.eye(len(at))
    jacobian = np.stack([(spots(at + step) - spots(at - step)) / 2e-5 for step in steps], axis=1)
    sigmas = np.concatenate(
        [
            uncertainty.intrinsics,
            uncertainty.datum_m,
            [uncertainty.scale],
            uncertainty.luminaires.ravel(),
            uncertainty.led_positions_m.ravel(),
        ]
    )
    covariance = noise_px2 + (jacobian[:, 6:] * sigmas**2) @ jacobian[:, 6:].T
    information = jacobian[:, :6].T @ np.linalg.inv(covariance) @ jacobian[:, :6]
    information[[3, 4], [3, 4]] += np.radians(TILTS_DEG) ** -2
    return np.linalg.inv(information)[:3, :3]


ONLY = {
    "lens": ("intrinsics",),
    "luminaires": ("luminaires",),
    "datum and scale": ("datum_m", "scale"),
    "all": ("intrinsics", "luminaires", "datum_m", "scale"),
}


def only(names: tuple[str, ...]) -> Uncertainty:
    """`calibrated` with these errors, those of the LEDs in their luminaire, and unknown sizes and faces."""
    kept = {*names, "luminaire_of_led", "led_positions_m", "led_sizes", "led_faces_rad"}
    gone = {f.name: 0 * getattr(calibrated(), f.name) for f in fields(Uncertainty) if f.name not in kept}
    return replace(calibrated(), **gone)


@pytest.mark.parametrize("names", ONLY.values(), ids=ONLY.keys())
def test_bound_is_that_of_dense_least_squares(slopes: FrameSlopes, renderer: Renderer, names: tuple[str, ...]) -> None:
    """LEDs of 6 px in radius, whose images tell their place to 0.003 px: the map's errors of 0.2 px hide that.

    The noise by hand is the spots' own. What remains: LEDs are no points. Linear terms agree to (6 px / 1500 px)^2 =
    2e-5; shapes that the six numbers describe, but whose slopes are those of rim points next to pixels' centres, tell
    at most 1e-2 of what the place tells, and it is the map's errors that count: 1e-3 in the standard deviation.
    """
    uncertainty, leds = only(names), renderer.scene.leds
    bound = bound_of(slopes, leds, uncertainty)
    noise = slopes.spot_covariances_px2(leds)
    by_hand = bound_by_hand(leds.centers_m, uncertainty, block_diag(*(noise[i] for i in range(4))))
    sigma, expected = np.sqrt(np.diag(bound)), np.sqrt(np.diag(by_hand))
    assert sigma == pytest.approx(expected, rel=1e-3)
    assert bound / np.outer(sigma, sigma) == pytest.approx(by_hand / np.outer(expected, expected), abs=2e-3)
    assert expected.min() > 3e-4  # 0.3 mm, so that what is compared is not pixel noise


def test_without_errors_the_bound_is_the_exact_one(slopes: FrameSlopes, renderer: Renderer) -> None:
    """To the bit; and the six numbers of each image hold all its information.

    They take the rim at the point next to a pixel's centre, up to half a pixel along the rim from the mean point of the
    rim in the pixel. So slopes by deformations err by 0.5 / 6 of themselves in a pixel, of either sign; over a rim of
    40 pixels by 0.5 / 6 / sqrt(12) / sqrt(40) = 4e-3.
    """
    leds = renderer.scene.leds
    exact = slopes.exact_bound_m2(TILTS_DEG)
    assert exact is not None
    assert (bound_of(slopes, leds, Uncertainty.none(4)) == exact).all()
    of_faces = slopes.bound_of_faces_m2(TILTS_DEG, leds, Uncertainty.none(4))
    assert of_faces is not None
    assert np.diag(of_faces) == pytest.approx(np.diag(exact), rel=8e-3)
    shape_unknown = replace(Uncertainty.none(4), led_faces_rad=np.full(4, FREE), led_sizes=np.full(4, FREE))
    assert np.trace(bound_of(slopes, leds, shape_unknown)) > 1.02 * np.trace(exact)  # shapes count


def test_the_level_of_the_background_is_unknown_to_the_hybrid_bound_too() -> None:
    """LEDs of 1 px without a margin, where a known level lowers the exact bound by 8 to 17 % in the variance.

    So small images tell their place; what their shape tells is (1 px / distance of the LEDs)^2 of that, below 1e-3.
    """
    small = room_of_leds(radius_m=0.002)
    mounted = mounted_cameras(Camera(width_px=400, height_px=300, pixel_pitch_um=12.0), ())[0]
    parts = small.expected_image(mounted.posed(POSE), LedRegions(kind="leds", margin_px=0)).parts
    variance = [
        RegionImage(part.roi, variance_e2(Sensor(), part.expected_electrons(EXPOSURE_S), EXPOSURE_S)) for part in parts
    ]
    found = FrameSlopes.rendered(mounted, POSE, light_of(small, range(4)), EXPOSURE_S, variance, 2.6)
    assert found is not None
    exact = found.exact_bound_m2(TILTS_DEG)
    of_faces = found.bound_of_faces_m2(TILTS_DEG, small.scene.leds, Uncertainty.none(4))
    assert exact is not None
    assert of_faces is not None
    assert np.diag(of_faces) == pytest.approx(np.diag(exact), rel=1e-2)


def test_datum_and_scale_move_the_position_directly(slopes: FrameSlopes, renderer: Renderer) -> None:
    """No image shows them: the datum adds its covariance, the scale (p sigma)(p sigma)'; rounding alone remains."""
    leds, position = renderer.scene.leds, np.array(POSE.position_m)
    base = only(("intrinsics", "luminaires"))
    before = bound_of(slopes, leds, base)
    datum = bound_of(slopes, leds, replace(base, datum_m=calibrated().datum_m)) - before
    assert datum == pytest.approx(np.diag(calibrated().datum_m ** 2), rel=1e-6, abs=1e-6 * np.trace(datum))
    scale = bound_of(slopes, leds, replace(base, scale=2e-4)) - before
    # Differences of faces are right to 1e-9 of a metre's effect, of which 2e-4 is the scale's.
    assert scale == pytest.approx(np.outer(position, position) * 4e-8, rel=1e-4, abs=1e-4 * np.trace(scale))


@pytest.mark.parametrize("name", ["intrinsics", "luminaires", "led_positions_m", "led_sizes", "led_gradients", "scale"])
def test_a_larger_sigma_never_lowers_the_bound(slopes: FrameSlopes, renderer: Renderer, name: str) -> None:
    """And raises it somewhere: gradients aside, which show inside the face and not in its place."""
    leds = renderer.scene.leds
    base = replace(
        calibrated(), led_sizes=np.full(4, 0.02), led_gradients=np.full(4, 0.05), led_faces_rad=np.full(4, 0.02)
    )
    bounds = [bound_of(slopes, leds, replace(base, **{name: getattr(base, name) * f})) for f in (0.0, 1.0, 3.0)]
    for lower, higher in pairwise(bounds):
        change = np.linalg.eigvalsh(higher - lower)
        assert change.min() > -1e-9 * np.trace(lower)
        assert change.max() > (1e-9 if name == "led_gradients" else 1e-5) * np.trace(lower)


def test_priors_far_wider_than_the_data_lose_no_digits(slopes: FrameSlopes, renderer: Renderer) -> None:
    """Sigmas a million times too wide are no knowledge at all: the pose is not determined, and the bound says None.

    With lens and datum known and luminaires free to shift, one luminaire's shift and the position are the same.
    """
    leds = renderer.scene.leds
    wide = replace(only(()), luminaires=1e6 * calibrated().luminaires)
    bound = slopes.hybrid_bound_m2(TILTS_DEG, leds, wide)
    assert bound is None or np.sqrt(np.trace(bound)) > 1.0


def test_contributions_add_up_to_the_covariance_of_the_estimate(slopes: FrameSlopes, renderer: Renderer) -> None:
    """They add up to that of dense least squares; every unknown is in it. An estimator of other weights does worse."""
    leds = renderer.scene.leds
    uncertainty = replace(calibrated(), led_gradients=np.full(4, 0.05))
    model = SpotErrors.of_frame(slopes, TILTS_DEG, leds, uncertainty)
    assert model is not None
    gain = model.gain()
    assert gain is not None
    contributions = model.contributions_m2(gain)
    noise = slopes.spot_covariances_px2(leds)
    # A gradient of 5 % moves the centroid of a disc of 1 cm by 5 % of a quarter of its radius: an error of the map.
    shifted = np.hypot(uncertainty.led_positions_m, [0.05 * 0.01 / 4, 0.05 * 0.01 / 4, 0])
    by_hand = bound_by_hand(
        leds.centers_m, replace(uncertainty, led_positions_m=shifted), block_diag(*(noise[i] for i in range(4)))
    )
    total = sum(contributions.values())
    assert total == pytest.approx(by_hand, rel=1e-5, abs=1e-5 * np.trace(by_hand))
    assert {name for name, part in contributions.items() if np.trace(part) == 0} == {"mounting"}
    trusting = model.gain(dict.fromkeys(set(model.effects) - {"noise", "accelerometer"}, 0.0))
    assert trusting is not None
    assert np.trace(sum(model.contributions_m2(trusting).values())) > 1.2 * np.trace(total)


@pytest.mark.parametrize(("square", "part"), [(False, 4), (True, 3)], ids=["disc", "square"])
def test_a_gradient_moves_the_centroid_of_a_face(
    slopes: FrameSlopes, renderer: Renderer, square: bool, part: int
) -> None:
    """Luminance 1 + g x / r: the mean of x (1 + g x / r) is g r / 4 over a disc, g r / 3 over a square of side 2 r.

    So it does what LEDs displaced by as much do.
    """
    leds = replace(renderer.scene.leds, squares=np.full(4, square))
    graded = replace(Uncertainty.none(4), led_gradients=np.full(4, 0.05))
    displaced = replace(Uncertainty.none(4), led_positions_m=np.tile([0.05 * 0.01 / part] * 2 + [0.0], (4, 1)))
    models = [SpotErrors.of_frame(slopes, TILTS_DEG, leds, each) for each in (graded, displaced)]
    by_gradient, by_place = (
        model and model.effects[name] for model, name in zip(models, ("led_gradient", "led_xy"), strict=True)
    )
    assert by_gradient is not None
    assert by_gradient == pytest.approx(by_place, rel=1e-12)


@pytest.mark.parametrize("name", ["focal", "luminaire_xy", "led_z", "accelerometer", "datum"])
def test_an_unknown_made_exact_contributes_nothing_and_helps(
    slopes: FrameSlopes, renderer: Renderer, name: str
) -> None:
    model = SpotErrors.of_frame(slopes, TILTS_DEG, renderer.scene.leds, calibrated())
    assert model is not None
    both, scales = model.gain(), {name: 0.0}
    without = model.gain(scales)
    assert both is not None
    assert without is not None
    parts = model.contributions_m2(without, scales)
    assert np.trace(parts[name]) == 0
    whole = model.contributions_m2(both)
    # At least its own contribution goes, for the same gain would do that.
    assert np.trace(sum(parts.values())) <= np.trace(sum(whole.values())) - np.trace(whole[name]) * (1 - 1e-9)


def test_spots_tell_what_pixels_tell_where_shapes_are_unknown(slopes: FrameSlopes, renderer: Renderer) -> None:
    """Within a per cent, by the reasons of `test_bound_is_that_of_dense_least_squares`."""
    leds = renderer.scene.leds
    model = SpotErrors.of_frame(slopes, TILTS_DEG, leds, calibrated())
    assert model is not None
    gain = model.gain()
    assert gain is not None
    total = sum(model.contributions_m2(gain).values())
    assert np.sqrt(np.diag(total)) == pytest.approx(np.sqrt(np.diag(bound_of(slopes, leds, calibrated()))), rel=1e-2)


@pytest.mark.parametrize("projection", ["perspective", "equidistant"])
def test_displacements_by_the_lens_are_those_of_a_changed_camera(projection: str) -> None:
    told = (
        CAMERA
        if projection == "perspective"
        else CAMERA.model_copy(update={"projection": "equidistant", "distortion": None})
    )
    points = np.array([[0.3, -0.2, 2.5], [-0.2, 0.25, 2.0], [0.0, 0.1, 3.0]])
    u, v = told.image_of_points(points).T
    found = intrinsics_displacements_px(told, u, v)

    def image(step: float, name: str) -> Array:
        own = told.distortion or Distortion()
        changes: dict[str, object] = {
            "focal": {"focal_length_mm": told.focal_length_mm * (1 + step)},
            # fx / fy = (1 + s/2) / (1 - s/2) at the same mean
            "aspect": {"aspect_ratio": (1 + step / 2) / (1 - step / 2)},
            "cx_px": {"principal_point_px": (203.0 + step, 148.0)},
            "cy_px": {"principal_point_px": (203.0, 148.0 + step)},
        }.get(name, {"distortion": own.model_copy(update={name: getattr(own, name, 0.0) + step})})
        return told.model_copy(update=changes).image_of_points(points).T

    for name, displacement in zip(INTRINSICS, found, strict=True):
        if projection == "equidistant" and name in ("k1", "p1", "p2"):
            assert not displacement.any()
            continue
        # Central differences of 1e-5: rounding 1e-12 / 1e-5 of up to 200 px.
        assert displacement == pytest.approx((image(1e-5, name) - image(-1e-5, name)) / 2e-5, rel=1e-6, abs=1e-6)


def test_motions_of_a_face_move_its_rendered_image(renderer: Renderer) -> None:
    """A focal length 2 % longer and shorter: the centroid of the rendered disc against the motion of the face's centre.

    A pixel's coverage is off by up to 3e-4 (`test_crlb.assert_same_bound`). With all 40 pixels of the rim off to one
    side, 6 px from the centre of 113 px, a centroid is off by 40 * 6 * 3e-4 / 113 = 6e-4 px, and the slope by 0.03 px.
    """
    pinhole = CAMERA.model_copy(update={"distortion": None})
    mounted, leds, step = mounted_cameras(pinhole, ())[0], renderer.scene.leds, 0.02
    places = []
    for change in (step, -step):
        longer = pinhole.model_copy(update={"focal_length_mm": 18.0 * (1 + change)})
        (patch,) = (p for p in renderer.led_patches(mounted_cameras(longer, ())[0].posed(POSE)) if p.led_id == 1)
        u, v = patch.roi.centers_px()
        light = patch.electrons_per_s
        places.append(np.array([(light * u).sum(), (light * v).sum()]) / light.sum())
    shift = 1e-6 * np.array([*face_motions(mounted, POSE, leds, np.array([1])).lens[0, :2, 0], 0.0])
    center = leds.centers_m[1]
    predicted = (mounted.posed(POSE).project(center + shift) - mounted.posed(POSE).project(center - shift)) / 2e-6
    assert predicted == pytest.approx((places[0] - places[1]) / (2 * step), abs=0.03)


def test_motions_of_a_face_over_a_level_camera_are_known(renderer: Renderer) -> None:
    """Of a pinhole h below the LED's plane, with the LED at (a, b) from its foot: what each unknown does to the face.

    x, y: shifts by -1. z and the focal length: growth about the foot, by 1 / h a metre and by 1. Yaw: a turn about the
    foot, of which a disc shows the shift alone. Faces' tilts: points lifted by w_x y - w_y x move away from the foot by
    lift / h. Differences of 1e-6 with 1e-16 of rounding: 1e-9.
    """
    leds = renderer.scene.leds
    x, y, height = POSE.position_m
    mounted = mounted_cameras(CAMERA.model_copy(update={"distortion": None}), ())[0]
    motions = face_motions(mounted, Pose(POSE.position_m), leds, np.array([0, 1]))
    pose, lens, own = motions.pose[1], motions.lens[1], motions.own[1]
    (a, b, h) = leds.centers_m[1] - np.array([x, y, height])
    grown = np.array([a, b, 1, 0, 0, 1])
    still = [0, 0, 0, 0]
    for motion, expected in (
        (pose[:, 0], [-1, 0, *still]),
        (pose[:, 1], [0, -1, *still]),
        (pose[:, 2], grown / h),
        (lens[:, 0], grown),
        (lens[:, 2], [h / 1500, 0, *still]),
        (own[:, 0], [1, 0, *still]),
        (own[:, 2], -grown / h),
        (own[:, 3], [0, 0, 1, 0, 0, 1]),
        (np.abs(pose[:, 5]), [abs(b), abs(a), *still]),
        # lift w_x y moves a point by -lift (a, b) / h to first order in the size of the face
        (own[:, 4], [0, 0, 0, -a / h / 2, -a / h / 2, -b / h]),
        (own[:, 5], [0, 0, a / h, b / h / 2, b / h / 2, 0]),
    ):
        assert motion == pytest.approx(np.array(expected), abs=1e-8)


def test_levers_are_derivatives_of_the_map_as_built(renderer: Renderer) -> None:
    leds, uncertainty = renderer.scene.leds, calibrated()
    levers = MapLevers(uncertainty, leds, np.arange(4)).shared
    sigmas = np.concatenate([uncertainty.datum_m, [uncertainty.scale], uncertainty.luminaires.ravel()])
    for number, sigma in enumerate(sigmas):
        step = 1e-4 * np.eye(16)[number]
        change = (position_by_hand(step, leds.centers_m) - position_by_hand(-step, leds.centers_m)) / 2e-4
        assert levers[:, :, number] == pytest.approx(change * sigma, rel=1e-9, abs=1e-15)


def test_a_mounting_that_errs_blurs_the_tilts() -> None:
    """Axes parallel to those of `main`, level: a turn about x or y is a tilt, one about z none. `main` has no error."""
    main, beside = (Mounted(name, CAMERA, np.eye(3), np.zeros(3)) for name in ("main", "beside"))
    level = Pose((1.0, 2.0, 0.5), yaw_deg=25.0)
    assert np.abs(mounting_tilt_slopes(beside, level)) == pytest.approx(np.eye(2, 3), abs=1e-9)
    own = np.radians(0.1) ** 2 * np.eye(2)
    assert tilt_covariance_rad2(main, level, (0.1, 0.1), 0.01) == pytest.approx(own)
    assert tilt_covariance_rad2(beside, level, (0.1, 0.1), 0.01) == pytest.approx(own + 1e-4 * np.eye(2), rel=1e-6)


@pytest.mark.parametrize("mounting_rad", [0.0, 1e-3])
def test_a_mounting_counts_for_cameras_beside_main_alone(renderer: Renderer, mounting_rad: float) -> None:
    """At the same place, with the same axes: only the mounting's error makes a difference."""
    uncertainty = replace(calibrated(), mounting_rad=mounting_rad)
    traces = []
    for name in ("main", "beside"):
        mounted = Mounted(name, CAMERA, np.eye(3), np.zeros(3))
        traces.append(np.trace(bound_of(slopes_of(renderer, mounted), renderer.scene.leds, uncertainty)))
    # A pose that goes through a rotation matrix and back differs in the last digits.
    assert (traces[1] > traces[0] * (1 + 1e-6)) == (mounting_rad > 0)
