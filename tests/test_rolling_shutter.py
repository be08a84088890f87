"""Rolling shutters: gains of lines against sums over time, the room's flicker, moving cameras, what is refused."""

from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, SMALL

import vlcrender as vr
from vlcrender.api import _renderer
from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import mounted_cameras
from vlcrender.camera.roi import Roi
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.dataset.recipe.motion import Motion, poses_during
from vlcrender.dataset.recipe.plan import Plan
from vlcrender.errors import InputError
from vlcrender.modulation.exposure import LineGains, MeanWave
from vlcrender.modulation.transmission import led_waves
from vlcrender.modulation.wave import CosineWave, TwoLevelWave, Wave
from vlcrender.rendering.expected_image import gain_in
from vlcrender.rendering.readout import RollingPoses
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene, load_scene

CODE = 'send = "code"\nchip_us = 250.0'
DIRECTIONS = ("down", "up", "right", "left")


def rolling(direction: str = "down", row_time_us: float = 10.0) -> dict[str, object]:
    return {"kind": "rolling", "row_time_us": row_time_us, "direction": direction}


def scene_file(folder: Path, downlink: str = CODE, ambient_lux: float = 400.0) -> Path:
    """Table 1's room whose LEDs transmit."""
    text = (ROOT / "scenes/table1.toml").read_text(encoding="utf-8")
    text = text.replace("illuminance_lux = 400.0", f"illuminance_lux = {ambient_lux}")
    for luminance in ("4000.0", "8000.0", "12000.0", "16000.0"):
        text = text.replace(
            f"luminance_cd_m2 = {luminance}", f"luminance_cd_m2 = {luminance}\n[led.downlink]\n{downlink}"
        )
    path = folder / "sending.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def sending(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(scene_file(tmp_path_factory.mktemp("scene")))


def plan_of(folder: Path, *assignments: str, downlink: str = CODE, scale: int = 1, ambient_lux: float = 400.0) -> Plan:
    """Frames of the small camera in the room whose LEDs transmit."""
    scene = scene_file(folder, downlink, ambient_lux)
    changes = [*SMALL, f"scene={scene}", "poses.count=2", "poses.min_leds=2", "expected=true", *assignments]
    return vr.load_recipe(ROOT / "datasets/quickstart.toml", changes, scale=scale)


ROLLING = ('camera.shutter={kind="rolling",row_time_us=100.0}',)


def mean_by_sampling(wave: Wave, start_s: float, exposure_s: float) -> float:
    """Mean of a code's levels, chip by chip, at many instants of an exposure."""
    assert wave.bits is not None
    instants = start_s + exposure_s * (np.arange(40_000) + 0.5) / 40_000
    chip_s = wave.period_s / len(wave.bits)
    periods = instants / wave.period_s + wave.start_phase
    chips = np.floor(periods * len(wave.bits)).astype(int) % len(wave.bits)
    assert chip_s > 0
    return float(2 * np.array([bit == "1" for bit in wave.bits])[chips].mean())


POSE = Pose((0.65, 1.35, 0.5), 1.0, -1.0, 5.0)
"""Below three of the LEDs of Table 1, whose images spread over the sensor."""


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_each_line_of_a_lamp_has_the_mean_of_its_wave_over_its_own_exposure(
    sending: Scene, small_camera: Camera, direction: str
) -> None:
    """Rows or columns of each patch over those of the steady image, against sums over 40 000 instants.

    An instant more or less at each of up to 2 edges of chips errs by 2 / 40 000 = 5e-5 each; float32 by 1e-7.
    """
    camera = small_camera.model_copy(update={"shutter": vr.Camera(shutter=rolling(direction, 100.0)).shutter})
    image = Renderer(sending).expected_image(PosedCamera(camera, POSE), room_apart=True)
    waves = led_waves(sending.leds.transmitters, 7)
    start_s, exposure_s = 0.123, 3e-4
    gains = LineGains(waves, start_s + camera.line_starts_s(), exposure_s)
    (part,) = image.parts
    without = part.expected_electrons(exposure_s, dict.fromkeys(waves, 0.0))
    lit = part.expected_electrons(exposure_s, gains) - without
    steady = part.expected_electrons(exposure_s) - without
    assert len(part.patches) >= 3
    checked = 0
    for patch in part.patches:
        axis = 1 if direction in ("down", "up") else 0
        here = part.roi.slices(patch.roi)
        mine, alone = lit[here].sum(axis=axis, dtype=float), steady[here].sum(axis=axis, dtype=float)
        first = patch.row if axis == 1 else patch.column
        size = camera.height_px if axis == 1 else camera.width_px
        for number in np.flatnonzero(alone > 0.1 * alone.max()).tolist():
            line = first + number
            order = line if direction in ("down", "right") else size - 1 - line
            expected = mean_by_sampling(waves[patch.led_id], start_s + order * 100e-6, exposure_s)
            assert mine[number] / alone[number] == pytest.approx(expected, abs=2e-4)
            checked += 1
    assert checked > 20


def test_a_global_shutter_has_one_gain_for_all_rows(sending: Scene, small_camera: Camera) -> None:
    waves = led_waves(sending.leds.transmitters, 7)
    gains = LineGains(waves, 0.123 + small_camera.line_starts_s(), 3e-4)
    (part,) = Renderer(sending).expected_image(PosedCamera(small_camera, POSE)).parts
    exposed = part.expected_electrons(3e-4, gains)
    numbers = {led: mean_by_sampling(wave, 0.123, 3e-4) for led, wave in waves.items()}
    assert exposed == pytest.approx(part.expected_electrons(3e-4, numbers), rel=2e-4)
    assert len({round(number, 3) for number in numbers.values()}) > 1


def test_the_room_flickers_with_all_leds_by_their_flux(tmp_path: Path, small_camera: Camera) -> None:
    """Floor and walls without ambient light, from a camera that sees no LED: each row is the mean of all waves.

    All LEDs have the same size and order, so that luminances are the weights. Sampling errs by 5e-5 for each edge, one
    LED of Table 1 in four weighs up to 0.4: 2e-4.
    """
    scene = load_scene(scene_file(tmp_path, ambient_lux=0.0))
    camera = small_camera.model_copy(update={"shutter": vr.Camera(shutter=rolling("down", 100.0)).shutter})
    looking_away = Pose((5.0, 5.0, 1.0), 0.0, 0.0, 0.0)
    image = Renderer(scene).expected_image(PosedCamera(camera, looking_away), room_apart=True)
    assert not image.patches
    waves = led_waves(scene.leds.transmitters, 7)
    starts_s = 0.5 + camera.line_starts_s()
    fluxes = dict(zip(scene.leds.ids.tolist(), scene.leds.fluxes_lm.tolist(), strict=True))
    room = MeanWave.of(waves, fluxes).mean(starts_s, 3e-4)
    (part,) = image.parts
    ratio = part.expected_electrons(3e-4, {}, room) / part.expected_electrons(3e-4)
    weights = {1: 4 / 40, 2: 8 / 40, 3: 12 / 40, 4: 16 / 40}
    for row in range(0, 300, 37):
        expected = sum(w * mean_by_sampling(waves[led], 0.5 + row * 100e-6, 3e-4) for led, w in weights.items())
        assert ratio[row] == pytest.approx(np.full(400, expected), abs=2e-4)
    assert np.ptp(ratio[:, 0]) > 0.5


def test_ambient_light_does_not_flicker(sending: Scene, small_camera: Camera) -> None:
    """With LEDs dark, the room has its ambient light alone: 400 lux times the reflectance of the ceiling over pi."""
    looking_away = Pose((5.0, 5.0, 1.0), 0.0, 0.0, 0.0)
    renderer = Renderer(sending)
    image = renderer.expected_image(PosedCamera(small_camera, looking_away), room_apart=True)
    dark = image.expected_electrons(1.0, {}, 0.0)
    rates = renderer._rates(small_camera)
    assert dark[150, 200] == pytest.approx(rates.ambient * 400 * 0.8 / np.pi, rel=1e-4)
    assert image.expected_electrons(1.0)[150, 200] > dark[150, 200]


def test_a_room_gain_needs_the_light_of_leds_apart(sending: Scene, small_camera: Camera) -> None:
    image = Renderer(sending).expected_image(PosedCamera(small_camera, POSE))
    with pytest.raises(ValueError, match="room_gain"):
        image.expected_electrons(1.0, {}, 0.5)
    assert np.array_equal(image.expected_electrons(1.0, {}, 1.0), image.expected_electrons(1.0))


def waves_of_all_kinds() -> dict[int, Wave]:
    chips = [TwoLevelWave.of_chips(bits, 50e-6, depth) for bits, depth in (("00101101", 1.0), ("01110010", 0.6))]
    waves: dict[int, Wave] = {}
    for led in range(12):
        waves[led] = chips[led % 2].started(1e-4, (0.3 + led * 3 / 8) % 1)
    waves[12] = chips[0].started(2e-4, 0.3)
    waves[13] = chips[0].started(1e-4, 0.3 + 0.01)
    waves[14] = TwoLevelWave.of_pulse(1700.0, 0.3, 0.9).started(0.0, 0.2)
    waves[15] = waves[16] = CosineWave(0.01, depth=0.4).started(0.0, 0.9)
    return waves


def test_the_mean_of_many_waves_is_the_sum_of_their_means() -> None:
    """Chips that coincide are summed before; the same to rounding, 1e-12. LEDs 17 and 18 are steady."""
    waves = waves_of_all_kinds()
    weights = {led: 1.0 + led % 5 for led in range(19)}
    starts_s = np.linspace(0.0, 3.0, 1001)[:, None]
    mean = MeanWave.of(waves, weights)
    direct = sum(
        weight * (waves[led].mean(starts_s, 70e-6) if led in waves else 1.0) for led, weight in weights.items()
    ) / sum(weights.values())
    assert mean.mean(starts_s, 70e-6) == pytest.approx(direct, abs=1e-10)
    assert len(mean.chips) + len(mean.others) == 5


GLARE = {"share": 0.1, "radius_um": 300.0}


@pytest.mark.parametrize("direction", ["down", "right"])
def test_a_line_of_a_halo_is_that_of_all_leds_at_the_line_s_gains(
    sending: Scene, small_camera: Camera, direction: str
) -> None:
    """Against the halo with numbers as gains, line by line; float32 and convolution by FFT, 1e-5 of the largest."""
    camera = Camera(**{**small_camera.model_dump(), "shutter": rolling(direction, 100.0), "glare": GLARE})
    (part,) = Renderer(sending).expected_image(PosedCamera(camera, POSE), room_apart=True).parts
    assert part.halo is not None
    waves = led_waves(sending.leds.transmitters, 7)
    gains = LineGains(waves, camera.line_starts_s(), 3e-4)
    by_lines = part.halo.electrons_per_s(part.roi, gains, gains[1] / 2)
    for line in (0, 57, 290):
        at = np.s_[line, :] if direction == "down" else np.s_[:, line]
        numbers = {led: float(gains[led].ravel()[line]) for led in gains}
        alone = part.halo.electrons_per_s(part.roi, numbers, numbers[1] / 2)
        assert by_lines[at] == pytest.approx(alone[at], abs=1e-5 * float(alone.max()))


@pytest.mark.slow
def test_light_of_leds_apart_is_no_part_of_it_with_crosstalk_and_mosaic(sending: Scene, small_camera: Camera) -> None:
    """Through a mosaic, with crosstalk: what remains is ambient light, of the axis the same in each pixel of a colour.

    Of 1e7 electrons a second float32 has 6e-8 each; a difference of two, of a sum of five: 1e-6. cos^4 is as in the
    middle of five pixels: its curvature, 4 / 1500^2, is 2e-6. A pixel off by one tells more, 3e-3.
    """
    curves = {"red": (0.2, 0.6), "green": (0.5, 0.4), "blue": (0.6, 0.1)}
    sensor = vr.Sensor(
        mosaic="rggb",
        crosstalk=0.1,
        quantum_efficiency={"wavelengths_nm": (380.0, 780.0), **curves},
    )
    renderer = _renderer(sending, sensor)
    looking_away = PosedCamera(small_camera, Pose((5.0, 5.0, 1.0), 0.0, 0.0, 0.0))
    (part,) = renderer.expected_image(looking_away, room_apart=True).parts
    assert part.led_background_e_per_s is not None
    ambient = part.background_e_per_s - part.led_background_e_per_s
    u, v = part.roi.centers_px()
    of_axis = ambient / relative_illumination(small_camera, u, v)
    assert of_axis[10:290, 10:390] == pytest.approx(np.tile(of_axis[150:152, 200:202], (140, 190)), rel=1e-5)
    assert part.led_background_e_per_s.min() > 0


def test_a_gain_of_lines_is_cut_to_a_region() -> None:
    column, row, one = np.arange(300.0)[:, None], np.arange(400.0)[None, :], np.array([[2.0]])
    roi = Roi(10, 20, 3, 4)
    assert gain_in(column, roi).tolist() == [[10], [11], [12]]
    assert gain_in(row, roi).tolist() == [[20, 21, 22, 23]]
    assert gain_in(one, roi).tolist() == [[2]]
    assert gain_in(0.5, roi) == 0.5


MOTION = "motion={angular_velocity_deg_s=[4.0,-3.0,8.0],linear_velocity_m_s=[0.2,-0.1,0.3]}"


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_an_led_of_a_moving_camera_is_where_its_own_line_sees_it(
    sending: Scene, small_camera: Camera, direction: str
) -> None:
    """A turn of 20 deg/s about y moves images by -524 px/s; the LED's line is (v - 150) * 100 us from the middle.

    tan: at 100 px of 1500 the speed is 0.4 % more.
    """
    camera = Camera(**{**small_camera.model_dump(), "shutter": rolling(direction, 100.0)})
    (mounted,) = mounted_cameras(camera, ())
    motion = Motion(angular_velocity_deg_s=(0.0, 20.0, 0.0))
    during = poses_during(motion, mounted, POSE, 1e-5, sending)
    assert isinstance(during, RollingPoses)
    image = Renderer(sending).expected_image(PosedCamera(camera, POSE), None, during)
    at_rest = Renderer(sending).expected_image(PosedCamera(camera, POSE))
    still = {patch.led_id: patch.center_px for patch in at_rest.patches}
    speed = -1500 * np.radians(20.0)
    compared = whole = 0
    for patch in image.patches:
        (u, v), (u0, v0) = patch.center_px, still[patch.led_id]
        lines = {"down": v - 150, "up": 150 - v, "right": u - 200, "left": 200 - u}[direction]
        assert u - u0 == pytest.approx(speed * lines * 100e-6, abs=0.01 * abs(speed * lines * 100e-6) + 1e-4)
        assert v - v0 == pytest.approx(0, abs=0.1)
        compared += abs(u - u0) > 0.5
        # Whole at rest and 8 px from the border, as far as images move within the readout: whole in all lines.
        (top, left), (rows, columns) = (patch.row, patch.column), patch.electrons_per_s.shape
        if min(top, left, 300 - top - rows, 400 - left - columns) > 8:
            assert patch.visible_fraction == pytest.approx(1, abs=1e-6)
            assert patch.imaged_fraction == pytest.approx(1, abs=1e-6)
            whole += 1
    assert whole >= 2
    assert compared >= 2


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_light_of_a_moving_camera_is_where_the_truth_puts_it(
    sending: Scene, small_camera: Camera, direction: str
) -> None:
    """Centroid of each patch less the motion, against the truth's centre, of discs of 5 px radius.

    A centroid lies beside the centre's image by 0.001 px (perspective) at rest; subtracted. Shear within the disc moves
    no centroid. A line whose weight changes with the motion, by speed times row time 5 %, shifts it by less than 5 % of
    the second moment over the radius times the change of speed: 1e-3. The pixel's own area, for edges that are curved:
    0.01 px.
    """
    camera = Camera(**{**small_camera.model_dump(), "shutter": rolling(direction, 100.0)})
    (mounted,) = mounted_cameras(camera, ())
    motion = Motion(angular_velocity_deg_s=(12.0, 15.0, -20.0), linear_velocity_m_s=(0.3, 0.2, -0.4))
    during = poses_during(motion, mounted, POSE, 1e-5, sending)
    renderer = Renderer(sending)
    found = renderer.expected_image(PosedCamera(camera, POSE), None, during).patches
    still = renderer.expected_image(PosedCamera(camera, POSE)).patches
    offsets = []
    for patches in (found, still):
        centroids = {}
        for patch in patches:
            rows, columns = np.indices(patch.electrons_per_s.shape)
            weights = patch.electrons_per_s.astype(float)
            centroid = np.array([(columns * weights).sum(), (rows * weights).sum()]) / weights.sum()
            centroids[patch.led_id] = centroid + [patch.column + 0.5, patch.row + 0.5] - patch.center_px
        offsets.append(centroids)
    whole = [patch.led_id for patch in still if patch.visible_fraction > 0.999]
    assert len(whole) >= 2
    for led in whole:
        assert offsets[0][led] == pytest.approx(offsets[1][led], abs=0.02)


@pytest.mark.slow
def test_lines_of_the_room_have_their_own_pose(office: Scene, small_camera: Camera) -> None:
    """Rows of the background of a moving camera are rows of cameras at rest at the poses of the rows."""
    camera = Camera(**{**small_camera.model_dump(), "shutter": rolling("down", 100.0)})
    (mounted,) = mounted_cameras(camera, ())
    motion = Motion(angular_velocity_deg_s=(12.0, 15.0, -20.0), linear_velocity_m_s=(0.3, 0.2, -0.4))
    pose = Pose((3.15, 3.1, 0.6), 6, -8, 20)
    renderer = Renderer(office)
    during = poses_during(motion, mounted, pose, 1e-5, office)
    (moving_part,) = renderer.expected_image(PosedCamera(camera, pose), None, during).parts
    moving_image = moving_part.expected_electrons(1.0)
    (middle,) = renderer.expected_image(PosedCamera(camera, pose)).parts
    unlike = 0.0
    for row in (3, 80, 151, 290):
        at = PosedCamera(camera, motion.pose_at(pose, (row - 149.5) * 100e-6))
        (still,) = renderer.expected_image(at).parts
        expected, other = still.expected_electrons(1.0)[row], middle.expected_electrons(1.0)[row]
        # edges of LEDs are interpolated between knots: a pixel errs by up to 3 % of its light
        off = np.abs(moving_image[row] - expected) > 1e-3 * expected
        assert off.mean() < 0.05
        unlike = max(unlike, float((np.abs(other - expected) > 1e-3 * expected).mean()))
    assert unlike > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("direction", ["down", "left"])
def test_edges_of_leds_are_those_of_their_line_s_pose(sending: Scene, small_camera: Camera, direction: str) -> None:
    """Lines of an LED's light, over its brightest, against cameras at rest at the poses of the lines.

    Between knots 1/8 px apart, of a coverage with a kink at which its slope changes by 1 a pixel, interpolation errs by
    a quarter of 1/8 px at most; where the edge is not along the lines, the coverage has no kink. The relative
    illumination changes by less than 1e-3 in 1/8 px.
    """
    camera = Camera(**{**small_camera.model_dump(), "shutter": rolling(direction, 100.0)})
    (mounted,) = mounted_cameras(camera, ())
    motion = Motion(angular_velocity_deg_s=(12.0, 15.0, -20.0), linear_velocity_m_s=(0.3, 0.2, -0.4))
    during = poses_during(motion, mounted, POSE, 1e-5, sending)
    renderer = Renderer(sending)
    errors, moved = [], 0.0
    for moving in renderer.expected_image(PosedCamera(camera, POSE), None, during).patches:
        brightest = moving.electrons_per_s.max()
        lines = range(moving.roi.row, moving.roi.end_row)
        if direction == "left":
            lines = range(moving.roi.column, moving.roi.end_column)
        for line in lines:
            row, column = (line, 0) if direction == "down" else (0, line)
            time_s = float(camera.times_s(column + 0.5, row + 0.5))
            seen = renderer.expected_image(PosedCamera(camera, motion.pose_at(POSE, time_s))).patches
            whole = np.zeros((camera.height_px, camera.width_px))
            for patch in seen:
                if patch.led_id == moving.led_id:
                    whole[Roi.of_sensor(camera).slices(patch.roi)] = patch.electrons_per_s
            here = np.zeros_like(whole)
            here[Roi.of_sensor(camera).slices(moving.roi)] = moving.electrons_per_s
            of_line = np.s_[line] if direction == "down" else np.s_[:, line]
            errors.append(np.abs(here[of_line] - whole[of_line]).max() / brightest)
            moved = max(moved, abs(time_s) * np.radians(20.0) * 1500)
    assert max(errors) < 1 / 32 + 1e-3
    assert moved > 1


def test_a_motion_of_zero_has_the_bits_of_a_camera_at_rest(sending: Scene, small_camera: Camera) -> None:
    camera = Camera(**{**small_camera.model_dump(), "shutter": rolling("down", 100.0)})
    (mounted,) = mounted_cameras(camera, ())
    level = Pose((0.3, 1.9, 0.5))
    assert poses_during(Motion(), mounted, level, 1e-5, sending) == (level,)


def test_an_image_that_runs_along_with_the_readout_is_refused(sending: Scene, small_camera: Camera) -> None:
    """600 deg/s moves images by 15 700 px/s, 1.6 px in a row time of 100 us; 120 deg/s by 0.3 px."""
    camera = Camera(**{**small_camera.model_dump(), "shutter": rolling("down", 100.0)})
    (mounted,) = mounted_cameras(camera, ())
    with pytest.raises(
        InputError, match=r"motion: moves the image by up to 1\.\d+ px from line to line; .* at most 0.5"
    ):
        poses_during(Motion(angular_velocity_deg_s=(600.0, 0.0, 0.0)), mounted, POSE, 1e-5, sending)
    assert poses_during(Motion(angular_velocity_deg_s=(120.0, 0.0, 0.0)), mounted, POSE, 1e-5, sending)
