"""The Cramér-Rao bound against the information of moving edges, and its dependence on light, LEDs and gravity."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from conftest import ROOT

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import Mounted, mounted_cameras
from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.config.toml_model import check, read_toml
from vlcrender.dataset.recipe import load_plan
from vlcrender.errors import InputError
from vlcrender.rendering.crlb import MARGIN_PX, position_bound_m2
from vlcrender.rendering.expected_image import LedPatch
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import build_scene
from vlcrender.scene.schema import SceneSettings
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import variance_e2

EXPOSURE_S = 1.6e-6
POSE = Pose((3.1, 3.2, 1.0), tilt_x_deg=8.0, tilt_y_deg=-12.0, yaw_deg=20.0)
RADIUS_M = 0.01
LEDS_M = np.array([[0.0, 0.0, 0.0], [0.25, 0.03, 0.0], [0.06, 0.2, 0.0], [-0.2, 0.07, 0.0]])


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    axis = POSE.rotation[2]
    aim = np.array(POSE.position_m) + axis * 2.5 / axis[2]
    tree = read_toml(ROOT / "scenes/table1.toml")
    leds = [
        {"id": k, "position_m": (aim + led).round(6).tolist(), "radius_m": RADIUS_M, "luminance_cd_m2": 9000.0}
        for k, led in enumerate(LEDS_M)
    ]
    return Renderer(build_scene(check({**tree, "led": leds}, SceneSettings, "bound"), "bound"))


def light_of(renderer: Renderer, led_ids: Sequence[int]) -> Callable[[PosedCamera], list[LedPatch]]:
    return lambda posed: [patch for patch in renderer.led_patches(posed) if patch.led_id in led_ids]


def alone(camera: Camera) -> Mounted:
    """A camera that is the whole rig."""
    return mounted_cameras(camera, ())[0]


def bound_m2(
    renderer: Renderer, camera: Camera, led_ids: Sequence[int], sigma_deg: float, exposure_s: float = EXPOSURE_S
) -> np.ndarray | None:
    expected = renderer.expected_image(PosedCamera(camera, POSE)).expected_electrons(exposure_s)
    variance = [RegionImage(Roi.of_sensor(camera), variance_e2(Sensor(full_well_e=1e6), expected, EXPOSURE_S))]
    return position_bound_m2(
        alone(camera), POSE, light_of(renderer, led_ids), exposure_s, variance, 2.6, (sigma_deg, sigma_deg)
    )


def moved(unknown: int, by: float) -> Pose:
    numbers = [*POSE.position_m, POSE.tilt_x_deg, POSE.tilt_y_deg, POSE.yaw_deg]
    numbers[unknown] += by if unknown < 3 else np.degrees(by)
    return Pose((numbers[0], numbers[1], numbers[2]), *numbers[3:])


def edge_slopes(camera: Camera, center_m: np.ndarray, box: Roi) -> np.ndarray:
    """d coverage / d (x, y, z, tilt_x, tilt_y, yaw) in a box of pixels, (6, rows, columns).

    As the pose changes, the coverage of a pixel grows by the area that the disc's edge sweeps in it: the integral of
    velocity times outward normal along the edge (the transport theorem), here a sum over 40 000 pieces of the rim.
    """
    around = np.linspace(0, 2 * np.pi, 40_001)
    rim = center_m + RADIUS_M * np.column_stack([np.cos(around), np.sin(around), 0 * around])
    edge = PosedCamera(camera, POSE).project(rim)
    piece, middle = np.diff(edge, axis=0), (edge[1:] + edge[:-1]) / 2
    normal = np.column_stack([piece[:, 1], -piece[:, 0]])  # as long as the piece
    normal *= np.sign((normal * (middle - edge.mean(axis=0))).sum())
    column, row = (np.floor(middle).astype(int) - [box.column, box.row]).T
    slopes = np.zeros((6, box.rows, box.columns))
    for unknown in range(6):
        there, back = (PosedCamera(camera, moved(unknown, sign * 1e-6)).project(rim) for sign in (1, -1))
        velocity = (there - back) / 2e-6
        swept = ((velocity[1:] + velocity[:-1]) / 2 * normal).sum(axis=1)
        np.add.at(slopes[unknown], (row, column), swept)
    return slopes


@pytest.mark.slow
def test_bound_agrees_with_the_information_of_moving_edges(renderer: Renderer, small_camera: Camera) -> None:
    """By the transport theorem, with all nuisances in one matrix; the renderer gives the amplitudes only.

    The theorem leaves out: an LED's brightness changes with the pose by cos^4, which its unknown amplitude
    takes up to a part in 1000, and the edge's brightness is not exactly the brightest pixel's: cos^4 changes by 4
    tan(16 deg) / 1500 = 1e-3 a pixel, over 5 pixels by 0.5 %. Held to 1 %.
    """
    mean = renderer.expected_image(PosedCamera(small_camera, POSE))
    expected = mean.expected_electrons(EXPOSURE_S).astype(float)
    count = len(mean.patches)
    information = np.zeros((6 + 2 * count, 6 + 2 * count))
    for number, patch in enumerate(mean.patches):
        box = patch.roi.padded(int(MARGIN_PX))
        here = Roi.of_sensor(small_camera).slices(box)
        light = np.zeros((box.rows, box.columns))
        light[box.slices(patch.roi)] = patch.electrons_per_s * EXPOSURE_S
        slopes = np.zeros((len(information), box.rows, box.columns))
        slopes[:6] = light.max() * edge_slopes(small_camera, renderer.scene.leds.centers_m[number], box)
        slopes[6 + 2 * number], slopes[7 + 2 * number] = light, 1.0
        weighted = slopes / expected[here]
        information += np.tensordot(slopes, weighted, axes=([1, 2], [1, 2]))
    information[[3, 4], [3, 4]] += np.radians(0.5) ** -2
    scale = 1 / np.sqrt(np.diag(information))
    by_hand = (np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))[:3, :3]
    bound = bound_m2(renderer, small_camera, range(count), 0.5)
    assert bound is not None
    assert np.sqrt(np.diag(bound)) == pytest.approx(np.sqrt(np.diag(by_hand)), rel=0.01)
    correlation, expected_correlation = (m / np.sqrt(np.outer(np.diag(m), np.diag(m))) for m in (bound, by_hand))
    assert np.abs(correlation - expected_correlation).max() < 0.02


@pytest.mark.slow
def test_four_times_the_light_quarters_the_bound(renderer: Renderer, small_camera: Camera) -> None:
    """Shot noise: information is proportional to the light; an accelerometer of 45 deg adds almost none."""
    once, more = (bound_m2(renderer, small_camera, range(4), 45.0, t * EXPOSURE_S) for t in (0.25, 1))
    assert once is not None
    assert more is not None
    # the variance is a float32 image, 1e-7; slopes 1e-7; the tilts' 45 deg against minutes of arc, squared, 1e-6
    assert more * 4 == pytest.approx(once, rel=1e-4, abs=1e-4 * float(np.diag(once).max()))


@pytest.mark.slow
def test_gravity_and_more_leds_lower_the_bound(renderer: Renderer, small_camera: Camera) -> None:
    sizes = []
    for ids, sigma in ((range(4), 0.0), (range(4), 0.05), (range(4), 45.0), (range(3), 45.0)):
        bound = bound_m2(renderer, small_camera, ids, sigma)
        assert bound is not None
        assert (np.linalg.eigvalsh(bound) > 0).all()
        sizes.append(float(np.trace(bound)))
    assert sizes == sorted(sizes)
    assert sizes[0] < 0.5 * sizes[2] < 0.9 * sizes[3]


def test_each_tilt_has_its_own_error(renderer: Renderer, small_camera: Camera) -> None:
    """A large error on one tilt raises the bound, and by less than a large error on both."""
    expected = renderer.expected_image(PosedCamera(small_camera, POSE)).expected_electrons(EXPOSURE_S)
    variance = [RegionImage(Roi.of_sensor(small_camera), variance_e2(Sensor(full_well_e=1e6), expected, EXPOSURE_S))]
    sizes = [
        position_bound_m2(alone(small_camera), POSE, light_of(renderer, [0, 1]), EXPOSURE_S, variance, 2.6, s)
        for s in ((0.1, 0.1), (0.1, 5.0), (5.0, 0.1), (5.0, 5.0))
    ]
    none, y, x, both = (float(np.trace(bound)) for bound in sizes if bound is not None)
    assert none < x < both
    assert none < y < both
    assert x != pytest.approx(y, rel=0.01)


@pytest.mark.slow
def test_bound_on_a_rig_is_of_the_cameras_own_position(renderer: Renderer, small_camera: Camera) -> None:
    """A camera mounted 0.3 m beside another, with its axes: the bound of a lone camera at that position.

    With two LEDs and tilts known to 0.5 deg, the bounds at the two positions differ by the tilts times the lever.
    Slopes are exact to 1e-7; the lever's differences, of 1e-8 m, to 1e-8 of rounding.
    """
    offset_m = np.array([0.3, 0.0, 0.0])
    x, y, z = np.array(POSE.position_m) - POSE.rotation.T @ offset_m
    main = Pose((x, y, z), POSE.tilt_x_deg, POSE.tilt_y_deg, POSE.yaw_deg)
    expected = renderer.expected_image(PosedCamera(small_camera, POSE)).expected_electrons(EXPOSURE_S)
    variance = [RegionImage(Roi.of_sensor(small_camera), variance_e2(Sensor(full_well_e=1e6), expected, EXPOSURE_S))]
    mounted = Mounted("beside", small_camera, np.eye(3), offset_m)
    bound = position_bound_m2(mounted, main, light_of(renderer, [0, 1]), EXPOSURE_S, variance, 2.6, (0.5, 0.5))
    assert bound == pytest.approx(bound_m2(renderer, small_camera, [0, 1], 0.5), rel=1e-4, abs=1e-12)


@pytest.mark.slow
def test_a_frame_that_determines_no_position_has_no_bound(renderer: Renderer, small_camera: Camera) -> None:
    """One disc has the same image for any yaw, and a frame without LEDs has no information."""
    assert bound_m2(renderer, small_camera, [0], 0.5) is None
    assert bound_m2(renderer, small_camera, [], 0.5) is None
    assert bound_m2(renderer, small_camera, [0, 1], 0.5) is not None


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
