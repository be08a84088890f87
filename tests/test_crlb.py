"""The Cramér-Rao bound against the information of moving edges, and its dependence on light, LEDs and gravity."""

from collections.abc import Sequence

import numpy as np
import pytest
from conftest import ROOT

from vlcrender.camera.intrinsics import Camera, Pose, rotation_cam_world
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import Mounted, mounted_cameras, pose_of
from vlcrender.camera.roi import LedRegions, RegionImage, Roi
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.config.toml_model import check, read_toml
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.errors import InputError
from vlcrender.rendering import crlb
from vlcrender.rendering.crlb import MARGIN_PX, Render, position_bound_m2
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import build_scene
from vlcrender.scene.schema import SceneSettings
from vlcrender.sensor.radiometry import Silicon, electron_rate_per_cd_m2
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import variance_e2

EXPOSURE_S = 1.6e-6
POSE = Pose((3.1, 3.2, 1.0), tilt_x_deg=8.0, tilt_y_deg=-12.0, yaw_deg=20.0)
RADIUS_M = 0.01
LEDS_M = np.array([[0.0, 0.0, 0.0], [0.25, 0.03, 0.0], [0.06, 0.2, 0.0], [-0.2, 0.07, 0.0]])


NO_TURN, NO_OFFSET = np.eye(3), np.zeros(3)


def room_of_leds(radius_m: float = RADIUS_M, illuminance_lux: float = 400.0) -> Renderer:
    """Table 1's room with LEDS_M about the optical axis at POSE."""
    axis = POSE.rotation[2]
    aim = np.array(POSE.position_m) + axis * 2.5 / axis[2]
    tree = read_toml(ROOT / "scenes/table1.toml")
    leds = [
        {"id": k, "position_m": (aim + led).round(6).tolist(), "radius_m": radius_m, "luminance_cd_m2": 9000.0}
        for k, led in enumerate(LEDS_M)
    ]
    ambient = {**tree["ambient"], "illuminance_lux": illuminance_lux}
    return Renderer(build_scene(check({**tree, "led": leds, "ambient": ambient}, SceneSettings, "bound"), "bound"))


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return room_of_leds()


def light_of(renderer: Renderer, led_ids: Sequence[int]) -> Render:
    return lambda posed, changes: [led for led in renderer.led_slopes(posed, changes) if led.led_id in led_ids]


def alone(camera: Camera) -> Mounted:
    """A camera that is the whole rig."""
    return mounted_cameras(camera, ())[0]


def variance_at_pose(renderer: Renderer, camera: Camera, exposure_s: float = EXPOSURE_S) -> list[RegionImage]:
    expected = renderer.expected_image(PosedCamera(camera, POSE)).expected_electrons(exposure_s)
    return [RegionImage(Roi.of_sensor(camera), variance_e2(Sensor(full_well_e=1e6), expected, EXPOSURE_S))]


def bound_m2(
    renderer: Renderer,
    camera: Camera,
    led_ids: Sequence[int],
    sigmas_deg: tuple[float, float],
    exposure_s: float = EXPOSURE_S,
) -> np.ndarray | None:
    variance = variance_at_pose(renderer, camera, exposure_s)
    return position_bound_m2(alone(camera), POSE, light_of(renderer, led_ids), exposure_s, variance, 2.6, sigmas_deg)


def position_and_rotation(
    unknowns: np.ndarray, mount: np.ndarray, offset_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Of a camera on a rig, p_cam = R_cam_rig (p_rig - offset). Unknowns: x, y, z (m), tilts, yaw (rad) of `main`."""
    rig = rotation_cam_world(*np.degrees(unknowns[3:]))
    return unknowns[:3] + rig.T @ offset_m, mount @ rig


def by_hand_m2(
    renderer: Renderer,
    camera: Camera,
    led_ids: Sequence[int],
    sigmas_deg: tuple[float, float],
    *,
    margin_px: int = int(MARGIN_PX),
    radius_m: float = RADIUS_M,
    main: Pose = POSE,
    mount: np.ndarray = NO_TURN,
    offset_m: np.ndarray = NO_OFFSET,
    level_known: bool = False,
) -> np.ndarray:
    """The bound by the transport theorem, with the unknowns of the pose and of all LEDs in one matrix; (3, 3), m2.

    As the pose changes, the coverage of a pixel grows by the area that the disc's edge sweeps in it: the integral of
    velocity times outward normal along the edge, here a sum over 20 000 pieces of the rim. A pixel's light is its
    coverage times the LED's luminance times relative illumination, of which coverage alone depends on the pose.

    Of the renderer are the mean image, for the variance, and each LED's light, for the slope by its brightness.
    """
    pose = np.array([*main.position_m, *np.radians([main.tilt_x_deg, main.tilt_y_deg, main.yaw_deg])])
    center_px = np.array(camera.center_px)

    def project(unknowns: np.ndarray, points_m: np.ndarray) -> np.ndarray:
        position_m, rotation = position_and_rotation(unknowns, mount, offset_m)
        p_cam = (points_m - position_m) @ rotation.T
        return p_cam[:, :2] / p_cam[:, 2:] * camera.focal_px + center_px

    posed = PosedCamera(camera, pose_of(*position_and_rotation(pose, mount, offset_m)))
    mean = renderer.expected_image(posed)
    expected = mean.expected_electrons(EXPOSURE_S).astype(float)
    patches = {patch.led_id: patch for patch in mean.patches}
    information = np.zeros((6 + 2 * len(led_ids), 6 + 2 * len(led_ids)))
    around = np.linspace(0, 2 * np.pi, 20_001)
    circle_m = radius_m * np.column_stack([np.cos(around), np.sin(around), 0 * around])
    rate = electron_rate_per_cd_m2(camera, "LED-B3", Silicon())
    for number, led_id in enumerate(led_ids):
        box = patches[led_id].roi.padded(margin_px)
        rim_m = renderer.scene.leds.centers_m[led_id] + circle_m
        edge = project(pose, rim_m)
        piece, middle = np.diff(edge, axis=0), (edge[1:] + edge[:-1]) / 2
        normal = np.column_stack([piece[:, 1], -piece[:, 0]])  # as long as the piece
        normal *= np.sign((normal * (middle - edge.mean(axis=0))).sum())
        column, row = (np.floor(middle).astype(int) - [box.column, box.row]).T
        slopes = np.zeros((len(information), box.rows, box.columns))
        for unknown, step in enumerate(1e-6 * np.eye(6)):
            velocity = (project(pose + step, rim_m) - project(pose - step, rim_m)) / 2e-6
            np.add.at(slopes[unknown], (row, column), ((velocity[1:] + velocity[:-1]) / 2 * normal).sum(axis=1))
        luminance = renderer.scene.leds.luminances_cd_m2[led_id]
        slopes[:6] *= rate * luminance * EXPOSURE_S * relative_illumination(camera, *box.centers_px())
        slopes[6 + 2 * number][box.slices(patches[led_id].roi)] = patches[led_id].electrons_per_s * EXPOSURE_S
        slopes[7 + 2 * number] = 1.0
        weighted = slopes / expected[Roi.of_sensor(camera).slices(box)]
        information += np.tensordot(slopes, weighted, axes=([1, 2], [1, 2]))
    known = [3, 4] if not any(sigmas_deg) else []
    if any(sigmas_deg):
        information[[3, 4], [3, 4]] += np.radians(sigmas_deg) ** -2
    if level_known:
        known += range(7, len(information), 2)
    free = np.setdiff1d(np.arange(len(information)), known)
    scale = 1 / np.sqrt(np.diag(information)[free])
    covariance = np.linalg.inv(information[np.ix_(free, free)] * np.outer(scale, scale)) * np.outer(scale, scale)
    lever = np.zeros((3, len(information)))
    for unknown, step in enumerate(1e-6 * np.eye(6)):
        there, back = (position_and_rotation(pose + sign * step, mount, offset_m)[0] for sign in (1, -1))
        lever[:, unknown] = (there - back) / 2e-6
    return lever[:, free] @ covariance @ lever[:, free].T


def assert_same_bound(bound: np.ndarray | None, by_hand: np.ndarray) -> None:
    """Standard deviations and correlations agree.

    The theorem's slopes are exact. The renderer takes the image's scale as the same all over a pixel; it changes by 3
    tan(16 deg) / 1500 = 6e-4 a pixel, either way on the two sides of a pixel's middle, where the edge may be. So slopes
    of single pixels differ by up to 3e-4, and of the whole rim by less. The rim's pieces, of 2e-3 px, are counted to
    the pixel of their middle: 1e-3 of the slope of a pixel, one way or the other, over some 40 pixels.
    """
    assert bound is not None
    sigma, expected = np.sqrt(np.diag(bound)), np.sqrt(np.diag(by_hand))
    assert sigma == pytest.approx(expected, rel=5e-4)
    assert bound / np.outer(sigma, sigma) == pytest.approx(by_hand / np.outer(expected, expected), abs=1e-3)


@pytest.mark.parametrize(
    ("led_ids", "sigmas_deg"),
    [
        (range(4), (45.0, 45.0)),
        (range(4), (0.1, 0.1)),
        (range(4), (0.0, 0.0)),
        ([0, 1], (45.0, 45.0)),
        ([0, 1], (0.1, 0.1)),
        ([0, 1], (0.1, 0.4)),
    ],
    ids=[
        "4 LEDs alone",
        "4 LEDs, 0.1 deg",
        "4 LEDs, no error",
        "2 LEDs alone",
        "2 LEDs, 0.1 deg",
        "2 LEDs, unequal tilts",
    ],
)
def test_bound_agrees_with_the_information_of_moving_edges(
    renderer: Renderer, small_camera: Camera, led_ids: Sequence[int], sigmas_deg: tuple[float, float]
) -> None:
    """Without an accelerometer (45 deg tell nothing), with one that hardly counts, one that decides, one without error.

    Two LEDs need the accelerometer: twice its information at 0.1 deg would lower the bound by 20 %.
    """
    bound = bound_m2(renderer, small_camera, led_ids, sigmas_deg)
    assert_same_bound(bound, by_hand_m2(renderer, small_camera, led_ids, sigmas_deg))


@pytest.mark.slow
def test_the_unknown_level_of_the_background_raises_the_bound() -> None:
    """LEDs of 1 px in regions without a margin, where few pixels tell the level from the LED's light.

    One who knew the level would know the position by some per cent better, far more than the tolerance of the bound.
    """
    small = room_of_leds(radius_m=0.002)
    camera = Camera(width_px=400, height_px=300, pixel_pitch_um=12.0)
    parts = small.expected_image(PosedCamera(camera, POSE), LedRegions(kind="leds", margin_px=0)).parts
    assert len(parts) == len(LEDS_M)
    variance = [
        RegionImage(part.roi, variance_e2(Sensor(), part.expected_electrons(EXPOSURE_S), EXPOSURE_S)) for part in parts
    ]
    bound = position_bound_m2(alone(camera), POSE, light_of(small, range(4)), EXPOSURE_S, variance, 2.6, (45.0, 45.0))
    unknown, known = (
        by_hand_m2(small, camera, range(4), (45.0, 45.0), margin_px=0, radius_m=0.002, level_known=known)
        for known in (False, True)
    )
    assert_same_bound(bound, unknown)
    assert (np.diag(known) < np.diag(unknown) / 1.05).all()


def test_the_margin_is_wide_enough_to_tell_the_level(monkeypatch: pytest.MonkeyPatch) -> None:
    """A margin four times as wide changes the bound by less than the level's error can: half of the ratio of areas.

    The level's variance, of n pixels of background, over that of an LED's mean light, of k pixels, is k / n where both
    are about as bright; information falls by at most this share, a standard deviation rises by half of it.
    """
    dim = room_of_leds(radius_m=0.002, illuminance_lux=20_000.0)
    camera = Camera(width_px=400, height_px=300, pixel_pitch_um=12.0)
    usual = bound_m2(dim, camera, [0, 1], (45.0, 45.0))
    monkeypatch.setattr(crlb, "MARGIN_PX", 4 * MARGIN_PX)
    wide = bound_m2(dim, camera, [0, 1], (45.0, 45.0))
    assert usual is not None
    assert wide is not None
    led_px2 = np.pi * (0.002 * camera.focal_px / 2.5) ** 2
    ratio = led_px2 / (2 * 10.0) ** 2
    assert (np.sqrt(np.diag(usual) / np.diag(wide)) < 1 + ratio / 2).all()


def test_four_times_the_light_quarters_the_bound(renderer: Renderer, small_camera: Camera) -> None:
    """Shot noise: information is proportional to the light; an accelerometer of 45 deg adds almost none."""
    once, more = (bound_m2(renderer, small_camera, range(4), (45.0, 45.0), t * EXPOSURE_S) for t in (0.25, 1))
    assert once is not None
    assert more is not None
    # the variance is a float32 image, 1e-7; slopes 1e-7; the tilts' 45 deg against minutes of arc, squared, 1e-6
    assert more * 4 == pytest.approx(once, rel=1e-4, abs=1e-4 * float(np.diag(once).max()))


def test_gravity_and_more_leds_lower_the_bound(renderer: Renderer, small_camera: Camera) -> None:
    sizes = []
    for ids, sigma in ((range(4), 0.0), (range(4), 0.05), (range(4), 45.0), (range(3), 45.0)):
        bound = bound_m2(renderer, small_camera, ids, (sigma, sigma))
        assert bound is not None
        assert (np.linalg.eigvalsh(bound) > 0).all()
        sizes.append(float(np.trace(bound)))
    assert sizes == sorted(sizes)
    assert sizes[0] < 0.5 * sizes[2] < 0.9 * sizes[3]


@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 0.0), (6.0, -4.0, 100.0)], ids=["parallel", "turned"])
def test_bound_on_a_rig_is_of_the_cameras_own_position(
    renderer: Renderer, small_camera: Camera, turn_deg: tuple[float, float, float]
) -> None:
    """A camera 0.3 m beside `main`, whose tilts the accelerometer tells: by hand, with FORMAT.md's transformation."""
    mount, offset_m = rotation_cam_world(*turn_deg), np.array([0.3, 0.02, -0.01])
    turned = mount.T @ POSE.rotation
    main = pose_of(np.array(POSE.position_m) - turned.T @ offset_m, turned)
    mounted = Mounted("beside", small_camera, mount, offset_m)
    variance = variance_at_pose(renderer, small_camera)
    bound = position_bound_m2(mounted, main, light_of(renderer, [0, 1]), EXPOSURE_S, variance, 2.6, (0.1, 0.4))
    by_hand = by_hand_m2(renderer, small_camera, [0, 1], (0.1, 0.4), main=main, mount=mount, offset_m=offset_m)
    assert_same_bound(bound, by_hand)
    # A plain camera in the same place knows its tilts as well where its axes are those of `main`, and only there.
    plain = bound_m2(renderer, small_camera, [0, 1], (0.1, 0.4))
    assert bound is not None
    assert plain is not None
    assert (np.abs(np.diag(bound) / np.diag(plain) - 1).max() < 1e-3) == (turn_deg == (0.0, 0.0, 0.0))


def test_a_frame_that_determines_no_position_has_no_bound(renderer: Renderer, small_camera: Camera) -> None:
    """One disc has the same image for any yaw, and a frame without LEDs has no information."""
    assert bound_m2(renderer, small_camera, [0], (0.5, 0.5)) is None
    assert bound_m2(renderer, small_camera, [], (0.5, 0.5)) is None
    assert bound_m2(renderer, small_camera, [0, 1], (0.5, 0.5)) is not None


def test_saturated_pixels_have_no_information() -> None:
    mean = np.array([[100.0, 5999.0, 6000.0, 9000.0]], dtype=np.float32)
    assert variance_e2(Sensor(full_well_e=6000, bits=12, gain_e_per_dn=2.0), mean, 0.0).tolist() == [
        [100.0 + 1 / 3, 5999.0 + 1 / 3, np.inf, np.inf]
    ]
    assert np.isinf(variance_e2(Sensor(bits=8), mean, 0.0)).tolist() == [[False, True, True, True]]


@pytest.mark.parametrize("key", ["motion={angular_velocity_deg_s=[1.0,0.0,0.0]}", "sensor.noise=none"])
def test_bound_with_motion_or_without_noise_is_refused(key: str) -> None:
    with pytest.raises(InputError, match="bound = true"):
        load_plan(ROOT / "datasets/quickstart.toml", ["bound=true", key])
