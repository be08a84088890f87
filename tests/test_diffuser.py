"""Frames and diffusers of panels: flux in closed form, profiles, what a rim hides, and Mitsuba's own integrator."""

import numpy as np
import pytest
from test_path_traced import SMALL_VIEW, blocks, both_ways, scene_of

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.errors import InputError
from vlcrender.rendering.background import differs_from_neighbour
from vlcrender.rendering.electron_rates import ElectronRates
from vlcrender.rendering.led_radiance import luminance_pattern
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.diffuser import MIN_RELATIVE_LUMINANCE, Diffuser
from vlcrender.scene.loader import Scene
from vlcrender.sensor.radiometry import Silicon, electron_rate_per_cd_m2

DIFFUSER_OFF_CENTRE = Diffuser((0.03, -0.01), 0.04, 0.6, np.pi * 0.005**2, 1.0, (-0.1, -0.05, 0.2, 0.15))
DIFFUSER = {"distance_m": 0.03, "transmittance": 0.6}
FRAME = {"width_m": 0.02, "depth_m": 0.04, "reflectance": 0.4}


def panelled(diffuser: bool, frame: bool, **changes: object) -> Scene:
    """One panel of 3 x 2 LEDs that hangs in the middle of the test room."""
    leds = {"columns": 3, "rows": 2, "pitch_m": [0.15, 0.2], "radius_m": 0.008, "first_id": 1}
    panel = {
        "columns": 1,
        "rows": 1,
        "first_center_m": [1.5, 1.5, 2.4],
        "pitch_m": [1.0, 1.0],
        "size_m": [0.5, 0.4, 0.06],
        "reflectance": 0.7,
        "leds": {**leds, "luminance_cd_m2": [2e5, 2e5]},
    }
    panel |= {"diffuser": DIFFUSER} if diffuser else {}
    panel |= {"frame": FRAME} if frame else {}
    return scene_of(panels=[panel], **changes)


def lit_by_order_1(diffuser: Diffuser) -> float:
    """Closed form of the luminance times area, order 1: each quadrant as a corner's form factor times pi."""
    total = 0.0
    x0, y0, x1, y1 = diffuser.lit_m
    for dx in (diffuser.foot_m[0] - x0, x1 - diffuser.foot_m[0]):
        for dy in (diffuser.foot_m[1] - y0, y1 - diffuser.foot_m[1]):
            a, b = dx / diffuser.distance_m, dy / diffuser.distance_m
            total += (
                a / np.sqrt(1 + a * a) * np.arctan(b / np.sqrt(1 + a * a))
                + b / np.sqrt(1 + b * b) * np.arctan(a / np.sqrt(1 + b * b))
            ) / 2
    return diffuser.transmittance * diffuser.area_m2 / np.pi * total


def test_the_light_of_a_diffuser_is_the_transmitted_share_of_its_illumination() -> None:
    assert DIFFUSER_OFF_CENTRE.quadrants()[1].sum() == pytest.approx(lit_by_order_1(DIFFUSER_OFF_CENTRE), rel=1e-9)


@pytest.mark.parametrize("order", [0.5, 1.0, 5.0])
def test_a_wide_diffuser_transmits_all_light_but_its_dim_rim(order: float) -> None:
    """A circle of cos(theta) = c receives 1 - c^(m+1) of the flux 2 pi I / (m + 1); its luminance is that over pi.

    The lit part is a square, between its inscribed and its circumscribed circle.
    """
    diffuser = Diffuser((0.0, 0.0), 0.04, 0.6, 1e-4, order, (-9.0, -9.0, 9.0, 9.0))
    whole = 0.6 * 1e-4 * 2 / (order + 1)
    cosine = MIN_RELATIVE_LUMINANCE ** (1 / (order + 3))
    corner = 1 / np.sqrt(1 + 2 * (1 / cosine**2 - 1))
    light = diffuser.quadrants()[1].sum()
    assert whole * (1 - cosine ** (order + 1)) < light < whole * (1 - corner ** (order + 1))
    # at the circle's rim the diffuser has MIN_RELATIVE_LUMINANCE of the foot's luminance
    edge = diffuser.at(np.array([0.0, diffuser.lit_radius_m]), np.zeros(2))
    assert edge[1] / edge[0] == pytest.approx(MIN_RELATIVE_LUMINANCE, rel=1e-9)


@pytest.mark.parametrize(
    "diffuser", [DIFFUSER_OFF_CENTRE, Diffuser((0.0, 0.0), 0.04, 0.6, 1e-4, 1.0, (-9.0, -9.0, 9.0, 9.0))]
)
def test_four_points_illuminate_as_the_diffuser_does(diffuser: Diffuser) -> None:
    """Against a fine grid, within 70 deg of straight down, to the errors that `point_sources` documents."""
    at, light = diffuser.quadrants()
    x0, y0, x1, y1 = diffuser.lit_m
    n = 400
    x, y = np.meshgrid(x0 + (np.arange(n) + 0.5) / n * (x1 - x0), y0 + (np.arange(n) + 0.5) / n * (y1 - y0))
    fine = diffuser.at(x, y) * (x1 - x0) * (y1 - y0) / n**2

    def lux(sx: np.ndarray, sy: np.ndarray, weight: np.ndarray, place: np.ndarray) -> float:
        d2 = (sx - place[0]) ** 2 + (sy - place[1]) ** 2 + place[2] ** 2
        return float((weight * (place[2] ** 2 / d2) / d2).sum())

    for distance_m, error in ((0.4, 0.07), (1.2, 0.006)):  # 10 and 30 times the LED's from the diffuser
        for angle in np.radians([0, 30, 50, 70]):
            for turn in np.radians([0, 90, 200]):
                sine = np.sin(angle)
                place = distance_m * np.array([sine * np.cos(turn), sine * np.sin(turn), -np.cos(angle)])
                place[:2] += diffuser.foot_m
                points = lux(at[:, 0], at[:, 1], light, place)
                assert points == pytest.approx(lux(x, y, fine, place), rel=error)


@pytest.mark.slow
def test_the_image_of_a_diffuser_has_the_luminance_and_the_flux_of_the_model() -> None:
    scene = panelled(diffuser=True, frame=False)
    camera = Camera(width_px=500, height_px=400, pixel_pitch_um=16.0)
    pose = Pose((1.5, 1.5, 0.4))
    view = Renderer(scene).expected_image(PosedCamera(camera, pose))
    rate = electron_rate_per_cd_m2(camera, "LED-B3", Silicon())
    assert [patch.led_id for patch in view.patches] == [1, 2, 3, 4, 5, 6]
    area_m2 = (2.0 * 16e-6 / 18e-3) ** 2
    for patch, diffuser in zip(view.patches, scene.leds.diffusers, strict=True):
        assert diffuser is not None
        u, v = patch.center_px
        column, row = int(u) - patch.column, int(v) - patch.row
        # the foot: T E / pi with E = L A / d^2; half a pixel is 0.9 mm of 3 cm, 4 (0.9 / 30)^2 / 2 * 2 =
        # 4e-3; and cos^4 of the view, which is 1 - 2 * 0.18^2 / 4 at 0.18 m off the axis 2 m away
        foot = 0.6 * 2e5 * np.pi * 0.008**2 / 0.03**2 / np.pi
        cos4 = (1 + ((u - 250) ** 2 + (v - 200) ** 2) / camera.focal_px**2) ** -2
        assert patch.electrons_per_s[row, column] / rate == pytest.approx(foot * cos4, rel=4e-3)
        # all of it: cos^4 falls by 2 % over the panel
        total = patch.electrons_per_s.sum(dtype=float) / rate * area_m2
        assert total == pytest.approx(2e5 * lit_by_order_1(diffuser) * cos4, rel=0.01)
        assert patch.visible_fraction == pytest.approx(1.0)


def test_a_rim_has_the_width_of_the_frame_on_all_sides() -> None:
    """A frame of 2 cm around 0.5 x 0.4 m: its hole is 0.46 m along x, b, and 0.36 m along y, a."""
    (rim,) = (one for one in panelled(diffuser=False, frame=True).surfaces if one.name.endswith("rim"))
    assert rim.holes == (pytest.approx((0.02 / 0.4, 0.02 / 0.5, 0.38 / 0.4, 0.48 / 0.5), rel=1e-12),)


@pytest.mark.parametrize(("slope", "share"), [(1.75, 1.0), (2.0, 0.5), (2.25, 0.0)])
def test_a_rim_hides_leds_from_the_side(slope: float, share: float) -> None:
    """LED 1 is 8 cm from the rim's inside, which stands 4 cm down: half of it is visible at a slope of 2.

    With its radius of 8 mm it is visible whole up to 72 / 40 = 1.8 and not at all from 88 / 40 = 2.2 on.
    """
    scene = panelled(diffuser=False, frame=True, bake={"texel_m": 0.5, "paths": 8})
    led = scene.leds.centers_m[0]
    assert led[0] - (1.5 - 0.25 + 0.02) == pytest.approx(0.08)
    pose = Pose((0.1, float(led[1]), float(led[2] - (led[0] - 0.1) / slope)), 0.0, 60.0)
    camera = Camera(width_px=600, height_px=400, pixel_pitch_um=20.0)
    middle = PosedCamera(camera, pose).project(led)
    assert 100 < middle[0] < 500
    seen = [patch for patch in Renderer(scene).expected_image(PosedCamera(camera, pose)).patches if patch.led_id == 1]
    assert sum(patch.visible_fraction for patch in seen) == pytest.approx(share, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    "frame",
    [pytest.param(False, id="diffuser"), pytest.param(True, id="frame and diffuser", marks=pytest.mark.slow)],
)
def test_diffusers_and_frames_agree_with_the_reference(frame: bool) -> None:
    scene = panelled(diffuser=True, frame=frame)
    camera = Camera(**{**SMALL_VIEW, "pixel_pitch_um": 160.0})
    pose = Pose((1.1, 1.2, 0.6), 12.0, 8.0, 20.0)
    ours, reference, variance, lit = both_ways(scene, camera, pose, 128)
    assert lit.mean() > 0.03

    # The diffuser, where a pixel and its neighbours show nothing else: noise (t of 7 degrees of freedom, some hundred
    # pixels), and 1 %: the reference's image is linear between points d / 16 apart, 4 / 8 / 16^2 = 0.2 % at the foot; a
    # pixel of 1.6 cm is half of d and averaged from 2 x 2 places: (1/2)^4 / 4320 of the fourth derivative, 4 * 6 * 8 *
    # 10 at the foot, 0.3 %; and the light that the frame's inside, which is baked too dark, reflects: 0.4 % measured.
    sensor = Roi.of_sensor(camera)
    (region,) = Renderer(scene)._background.regions(PosedCamera(camera, pose), (sensor,), ElectronRates(1.0, 1.0))
    inside = lit & ~differs_from_neighbour(region.surfaces)
    assert inside.sum() > 200
    z = (ours - reference)[inside] / np.sqrt(variance + (0.01 * reference) ** 2)[inside]
    assert np.abs(z).max() < 7.9
    if not frame:  # with its border, where pixels are exact, it is all light of the panel
        assert ours[lit].sum() == pytest.approx(reference[lit].sum(), rel=0.01)

    kept = blocks(lit.astype(float))[0] == 0
    mine, theirs, spread = (b[kept] for b in blocks(ours, reference, variance))
    # as for furniture
    z = (mine - theirs) / np.sqrt(spread / 100 + (0.005 * theirs) ** 2)
    assert np.abs(z).max() < 7.9


@pytest.mark.parametrize(
    ("panel", "message"),
    [
        ({"frame": {**FRAME, "width_m": 0.1}}, r"columns 0\.15 m apart.*its frame leaves 0\.3 m"),
        ({"frame": {**FRAME, "depth_m": 2.5}}, "is not inside the room"),
        ({"diffuser": {**DIFFUSER, "distance_m": 0.02}}, r"distance_m = 0\.02: is not from 0\.024 m"),
        ({"diffuser": {**DIFFUSER, "distance_m": 0.07}}, r"distance_m = 0\.07.*to 0\.06 m \(the panel's height\)"),
        ({"diffuser": {**DIFFUSER, "transmittance": 1.1}}, r"diffuser\.transmittance = 1\.1"),
    ],
)
def test_impossible_frames_and_diffusers_are_refused(panel: dict[str, object], message: str) -> None:
    base = panelled(diffuser=False, frame=False).settings.panels[0].model_dump()
    with pytest.raises(InputError, match=message) as refusal:
        scene_of(panels=[{**base, **panel}])
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("width_shares", [0.01, 0.3])
def test_a_pixel_of_a_diffuser_has_the_mean_luminance_over_its_area(width_shares: float) -> None:
    """Against 24 x 24 points of each pixel, for pixels of this width on the diffuser in distances of the LED behind it.

    Luminance at the centre alone errs by 2 (m + 3) w^2 / 24: 3e-5 at 0.01, but 3 % at 0.3. There two by two points err
    by the fourth order, some (m + 3)^2 w^4 / 500 = 3e-4.
    """
    scene = panelled(diffuser=True, frame=False)
    # 1 m below: a pixel is pitch / f wide
    camera = Camera(width_px=8, height_px=8, pixel_pitch_um=18000.0 * width_shares * 0.03)
    posed = PosedCamera(camera, Pose((float(scene.leds.centers_m[0, 0]), float(scene.leds.centers_m[0, 1]), 1.4)))
    pattern = luminance_pattern(scene.leds, 0, posed, Roi.of_sensor(camera))
    diffuser = scene.leds.diffusers[0]
    assert diffuser is not None
    inside = (np.arange(24) + 0.5) / 24
    x, y = (((np.arange(8)[:, None] + inside).ravel() - 4) * width_shares * 0.03 + foot for foot in diffuser.foot_m)
    fine = diffuser.at(x[None, :], y[:, None]).reshape(8, 24, 8, 24).mean(axis=(1, 3))
    # the points of the comparison err by 24^-2 of the error of the centre alone: 5e-5
    assert pattern == pytest.approx(fine, rel=5e-4)
