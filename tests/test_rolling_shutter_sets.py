"""Rolling shutters in datasets: bursts, gyroscopes, moving cameras, the truth, and what verify tells."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from conftest import copy_of
from numpy.typing import NDArray
from test_rolling_shutter import MOTION, ROLLING, plan_of, rolling

import vlcrender as vr
from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.dataset.format.rows import FrameRow, MapTruthRow, TruthRow
from vlcrender.dataset.format.tables import read_table, write_table
from vlcrender.dataset.run import frame_job
from vlcrender.dataset.world.true_world import gyro_rad_s
from vlcrender.modulation.exposure import LineGains
from vlcrender.modulation.transmission import led_waves
from vlcrender.rendering.crlb import position_bound_m2
from vlcrender.rendering.led_slopes import Cameras
from vlcrender.rendering.moving_led import MovingLed
from vlcrender.rendering.renderer import Renderer


def pixels(path: Path) -> np.ndarray:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        image: np.ndarray = file.channels()["Y"].pixels.astype(float)
    return image


def frames_of(folder: Path) -> tuple[list[FrameRow], list[TruthRow]]:
    return read_table(folder / "frames.parquet", FrameRow), read_table(folder / "truth.parquet", TruthRow)


BURSTS = ("repeats=2", "burst={frames=3,frame_rate_hz=30.0}", "gyroscope={noise_deg_s=0.3,bias_deg_s=1.0}")
RIG = "rig=[{ name = 'beside', offset_m = [0.1, 0.02, 0.0], tilt_x_deg = 5.0, yaw_deg = 30.0 }]"


@pytest.fixture(scope="module")
def bursts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two poses, two bursts of three shots each, by two cameras: 24 frames."""
    folder = tmp_path_factory.mktemp("bursts")
    assert vr.generate(plan_of(folder, *ROLLING, *BURSTS, RIG), folder / "set")
    return folder / "set"


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pose, a burst of two shots by two cameras that move and turn: 4 frames."""
    folder = tmp_path_factory.mktemp("moving")
    burst = ("burst={frames=2,frame_rate_hz=25.0}", "poses.count=1")
    assert vr.generate(plan_of(folder, *ROLLING, *burst, RIG, MOTION), folder / "set")
    return folder / "set"


def test_a_burst_is_shot_at_its_frame_rate_and_two_bursts_start_at_random(bursts: Path) -> None:
    frames, truth = frames_of(bursts)
    assert [row.burst for row in frames] == [number for number in range(4) for _ in range(6)]
    assert [row.shot for row in frames] == [number for number in range(12) for _ in range(2)]
    assert [row.pose for row in frames] == [0] * 12 + [1] * 12
    starts_s = np.array([row.start_s for row in frames]).reshape(4, 3, 2)
    assert (starts_s[:, :, 0] == starts_s[:, :, 1]).all()
    assert starts_s[:, :, 0] - starts_s[:, :1, 0] == pytest.approx(np.tile([0.0, 1 / 30, 2 / 30], (4, 1)), abs=1e-12)
    assert (np.diff(starts_s[:, 0, 0]) > 2 / 30).all()
    phases = [led.phase for row in truth[::6] for led in row.leds[:1]]
    assert len({round(phase, 6) for phase in phases if phase is not None}) == 4


def test_phases_run_on_from_frame_to_frame_by_the_led_s_own_clock(bursts: Path) -> None:
    """Periods of 8 ms (32 chips of 250 us) by a clock 1e-4 fast or slow; phases in double precision."""
    frames, truth = frames_of(bursts)
    for row, later in zip(truth[:-2], truth[2:], strict=True):
        elapsed_s = frames[later.frame].start_s - frames[row.frame].start_s
        leds = {led.led: led for led in later.leds}
        for led in row.leds:
            if led.led in leds:
                assert led.clock_error is not None
                assert led.phase is not None
                periods = elapsed_s / 8e-3 * (1 + led.clock_error)
                after = leds[led.led].phase
                assert after is not None
                assert (led.phase + periods - after + 0.5) % 1 == pytest.approx(0.5, abs=1e-9)
                assert 0 < abs(led.clock_error) < 1e-3


def test_frames_of_a_burst_differ_in_phase_and_noise_alone(bursts: Path) -> None:
    """Each line of each frame over the steady image of the same pose, against the truth's phase, clock and bits."""
    frames, truth = frames_of(bursts)
    plan = plan_of(bursts.parent, *ROLLING, *BURSTS, RIG)
    camera = plan.recipe.camera
    renderer = Renderer(plan.scene)
    row = truth[0]
    pose = Pose(row.position_m, row.tilt_x_deg, row.tilt_y_deg, row.yaw_deg)
    (view,) = renderer.expected_image(PosedCamera(camera, pose)).parts
    exposure_s = frames[0].exposure_s
    checked = 0
    for number in (0, 2, 4, 6):
        assert truth[number].position_m == row.position_m
        image = pixels(bursts / f"expected/{number:06d}.exr")
        for patch in view.patches:
            led = next(led for led in truth[number].leds if led.led == patch.led_id)
            assert led.bits is not None
            assert led.phase is not None
            assert led.clock_error is not None
            v, u = int(patch.center_px[1]), int(patch.center_px[0])
            if not (0 <= v < 300 and 0 <= u < 400):
                continue
            light = patch.electrons_per_s[v - patch.row, u - patch.column] * exposure_s
            instants = v * 100e-6 + exposure_s * (np.arange(4000) + 0.5) / 4000
            periods = led.phase + instants / 8e-3 * (1 + led.clock_error)
            chips = np.floor(periods * 32).astype(int) % 32
            gain = 2 * np.mean([led.bits[chip] == "1" for chip in chips])
            background = view.background_e_per_s[v, u] * exposure_s
            # the background's light of LEDs is 1e-3 of its own, and light the LED's above it
            assert image[v, u] == pytest.approx(background + gain * light, rel=2e-3)
            checked += 1
    assert checked >= 8
    images = [pixels(bursts / f"frames/{number:06d}.exr") for number in (0, 2)]
    assert not np.array_equal(*images)


def test_the_room_of_a_set_flickers(tmp_path: Path) -> None:
    """Without ambient light: each row of the ceiling over its mean in time, by the luminances of Table 1; float32."""
    plan = plan_of(tmp_path, *ROLLING, "poses.count=1", ambient_lux=0.0)
    vr.generate(plan, tmp_path / "set")
    (frame,), (row,) = frames_of(tmp_path / "set")
    pose = Pose(row.position_m, row.tilt_x_deg, row.tilt_y_deg, row.yaw_deg)
    (view,) = Renderer(plan.scene).expected_image(PosedCamera(plan.recipe.camera, pose)).parts
    lit = np.zeros((300, 400), dtype=bool)
    for patch in view.patches:
        lit[patch.roi.row : patch.roi.end_row, patch.column : patch.roi.end_column] = True
    waves = led_waves(plan.scene.leds.transmitters, plan.recipe.seed)
    ratio = pixels(tmp_path / "set/expected/000000.exr") / (view.background_e_per_s * frame.exposure_s)
    for line in (5, 100, 250):
        start_s = frame.start_s + line * 100e-6
        mean = sum(led * wave.mean(start_s, frame.exposure_s) for led, wave in waves.items()) / 10
        assert ratio[line][~lit[line]] == pytest.approx(np.full(np.count_nonzero(~lit[line]), mean), abs=1e-5)
    assert np.ptp(ratio[~lit]) > 0.5


@pytest.mark.slow
def test_a_burst_is_rendered_once_for_each_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views: list[tuple[int, int]] = []
    rendered = frame_job._rendered

    def counted(job: object, pose: int, number: int, which: int, frame: int | None) -> object:
        views.append((pose, which))
        return rendered(job, pose, number, which, frame)  # type: ignore[arg-type]

    monkeypatch.setattr(frame_job, "_rendered", counted)
    vr.generate(plan_of(tmp_path, *ROLLING, *BURSTS, RIG), tmp_path / "set")
    assert views == [(0, 0), (0, 1), (1, 0), (1, 1)]


@pytest.mark.slow
def test_more_workers_make_the_same_bits(bursts: Path, tmp_path: Path) -> None:
    vr.generate(plan_of(bursts.parent, *ROLLING, *BURSTS, RIG), tmp_path / "set", workers=2)
    for name in ("frames.parquet", "truth.parquet", *(f"frames/{n:06d}.exr" for n in range(24))):
        assert (tmp_path / "set" / name).read_bytes() == (bursts / name).read_bytes()


def test_steady_leds_under_a_rolling_shutter_have_the_bits_of_a_global_one(tmp_path: Path) -> None:
    steady = 'send = "steady"'
    for name, shutter in (("rolling", ROLLING), ("global", ())):
        vr.generate(plan_of(tmp_path, *shutter, downlink=steady), tmp_path / name)
    for number in range(2):
        images = [
            pixels(tmp_path / name / f"{folder}/{number:06d}.exr")
            for folder in ("frames", "expected")
            for name in ("rolling", "global")
        ]
        assert np.array_equal(images[0], images[1])
        assert np.array_equal(images[2], images[3])
    frames, truth = frames_of(tmp_path / "global")
    assert [(row.burst, row.start_s, row.gyro_rad_s) for row in frames] == [(0, 0.0, None), (1, 0.0, None)]
    assert all((led.clock_error, led.phase, led.bits) == (None, None, None) for row in truth for led in row.leds)


def test_a_gyroscope_has_the_noise_of_each_shot_and_the_bias_of_its_device(tmp_path: Path) -> None:
    """1000 shots: noise to 5 standard errors about a bias that stays; biases of 1000 seeds to 5 standard errors."""
    plan = plan_of(tmp_path, *BURSTS, MOTION)
    recipe, gyroscope = plan.recipe, plan.recipe.gyroscope
    assert gyroscope is not None
    count = 1000
    true = np.radians([4.0, -3.0, 8.0])
    shots = np.array([gyro_rad_s(recipe, gyroscope, 0, shot) for shot in range(count)]) - true
    assert shots.std(axis=0, ddof=1) == pytest.approx(np.full(3, np.radians(0.3)), rel=5 / np.sqrt(2 * count))
    biases = np.array(
        [
            gyro_rad_s(
                recipe.model_copy(update={"seed": seed}), gyroscope.model_copy(update={"noise_deg_s": 0.0}), 0, 0
            )
            for seed in range(count)
        ]
    )
    assert (biases - true).std(axis=0, ddof=1) == pytest.approx(np.full(3, np.radians(1.0)), rel=5 / np.sqrt(2 * count))
    own = gyro_rad_s(recipe, gyroscope.model_copy(update={"noise_deg_s": 0.0}), 0, 0) - true
    assert shots.mean(axis=0) == pytest.approx(own, abs=5 * np.radians(0.3) / np.sqrt(count))


def test_a_camera_beside_reads_the_gyroscope_in_its_own_axes(bursts: Path) -> None:
    frames, _ = frames_of(bursts)
    (mounted,) = (c for c in plan_of(bursts.parent, RIG).recipe.cameras if c.name == "beside")
    for main, beside in zip(frames[::2], frames[1::2], strict=True):
        assert main.gyro_rad_s is not None
        assert beside.gyro_rad_s == pytest.approx(mounted.rotation @ np.array(main.gyro_rad_s), abs=1e-15)
    assert len({row.gyro_rad_s for row in frames}) == len(frames)


def test_a_moving_set_is_consistent_and_its_burst_moves_on(moving: Path) -> None:
    assert vr.verify(moving) == []
    frames, truth = frames_of(moving)
    first, second = np.array(truth[0].position_m), np.array(truth[2].position_m)
    assert second - first == pytest.approx(np.array([0.2, -0.1, 0.3]) * 0.04, abs=1e-12)
    assert truth[0].angular_velocity_rad_s == pytest.approx(np.radians([4.0, -3.0, 8.0]))
    assert truth[0].linear_velocity_m_s == pytest.approx([0.2, -0.1, 0.3])
    later = [row.start_s for row in frames]
    assert later[2] - later[0] == pytest.approx(0.04)
    # the camera beside, from its positions in two frames: (p2 - p1) / t is its mean velocity
    beside = (np.array(truth[3].position_m) - truth[1].position_m) / 0.04
    mean = (np.array(truth[1].linear_velocity_m_s) + truth[3].linear_velocity_m_s) / 2
    # the offset of 0.1 m turns at 9.4 deg/s = 0.16 rad/s: its jerk over 0.04 s is 0.1 * 0.16^3 * 0.04^2 / 12
    assert beside == pytest.approx(mean, abs=1e-6)


Rows = tuple[FrameRow, TruthRow]


def of_leds(row: TruthRow, **changes: object) -> TruthRow:
    return row.model_copy(update={"leds": tuple(led.model_copy(update=changes) for led in row.leds)})


DAMAGE: dict[str, tuple[Callable[[FrameRow, TruthRow], Rows], str]] = {
    "burst": (lambda d, t: (d.model_copy(update={"burst": 1}), t), "burst 1, but a burst has 2 shots"),
    "start_s": (lambda d, t: (d.model_copy(update={"start_s": d.start_s + 1e-3}), t), "start_s = "),
    "gyro": (lambda d, t: (d.model_copy(update={"gyro_rad_s": (0.0, 0.0, 0.0)}), t), "gyro_rad_s and the gyroscope"),
    "still": (
        lambda d, t: (d, t.model_copy(update={"angular_velocity_rad_s": (0.0, 0.0, 0.0)})),
        "is not where the pose puts it",
    ),
    "phase": (lambda d, t: (d, of_leds(t, phase=0.5)), "clock_error, phase or bits are not those of its wave"),
    "bits": (lambda d, t: (d, of_leds(t, bits="01" * 16)), "clock_error, phase or bits are not those of its wave"),
    "steady": (lambda d, t: (d, of_leds(t, phase=None)), "is modulated, but clock_error or phase is null"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_verify_tells_a_column_that_contradicts(moving: Path, tmp_path: Path, name: str) -> None:
    damage, line = DAMAGE[name]
    folder = copy_of(moving, tmp_path / "set")
    frames, truth = frames_of(folder)
    frames[0], truth[0] = damage(frames[0], truth[0])
    write_table(folder / "frames.parquet", frames, FrameRow)
    write_table(folder / "truth.parquet", truth, TruthRow)
    assert any(line in problem for problem in vr.verify(folder))


@pytest.mark.slow
def test_the_bound_of_striped_leds_is_that_of_their_lit_lines(tmp_path: Path) -> None:
    """A direct call with each patch times its gains, in another frame of a burst; expected images are float32, 6e-8."""
    burst = ("burst={frames=2,frame_rate_hz=30.0}", "poses.count=1", "bound=true", "exposure_s=0.9e-6")
    plan = plan_of(tmp_path, *ROLLING, *burst)
    vr.generate(plan, tmp_path / "set")
    frames, truth = frames_of(tmp_path / "set")
    bounds = []
    for number in (0, 1):
        row = truth[number]
        assert row.bound_m2 is not None
        pose = Pose(row.position_m, row.tilt_x_deg, row.tilt_y_deg, row.yaw_deg)
        (mounted,) = plan.recipe.cameras
        exposure_s = frames[number].exposure_s
        waves = led_waves(plan.scene.leds.transmitters, plan.recipe.seed)
        starts_s = frames[number].start_s + mounted.camera.line_starts_s()
        gains = LineGains(waves, starts_s, exposure_s)
        renderer = Renderer(plan.scene)

        def striped(
            posed: PosedCamera,
            changes: Sequence[Cameras],
            gains: LineGains = gains,
            renderer: Renderer = renderer,
        ) -> list[MovingLed]:
            def lit(led: MovingLed, gain: NDArray[np.float64]) -> MovingLed:
                return replace(led, pixels=lambda roi: led.within(roi) * gain[roi.row : roi.end_row])

            return [lit(led, gains[led.led_id]) for led in renderer.led_slopes(posed, changes)]

        variance = RegionImage(Roi.of_sensor(mounted.camera), pixels(tmp_path / f"set/expected/{number:06d}.exr"))
        distance_m = float(np.median(np.linalg.norm(plan.scene.leds.centers_m - row.position_m, axis=1)))
        bound = position_bound_m2(mounted, pose, striped, exposure_s, [variance], distance_m, (0.1, 0.1))
        assert bound is not None
        found = np.array(row.bound_m2).reshape(3, 3)
        assert found == pytest.approx(bound, rel=1e-5, abs=1e-5 * np.trace(bound))
        bounds.append(np.trace(found))
    assert abs(bounds[1] / bounds[0] - 1) > 0.01


def test_a_sent_map_is_null_for_the_device_and_sealed_in_the_truth(tmp_path: Path) -> None:
    packets = ('map="sent"', 'demodulation="pixels"', "poses.count=1")
    plan = plan_of(tmp_path, *ROLLING, *packets, downlink='send = "packet"\nchip_us = 250.0')
    vr.generate(plan, tmp_path / "set")
    dataset = json.loads((tmp_path / "set/dataset.json").read_text(encoding="utf-8"))
    assert dataset["led_map"] is None
    assert dataset["luminaires"] == []
    assert dataset["downlink"]["demodulation"] == "pixels"
    assert dataset["cameras"]["main"]["shutter"] == rolling("down", 100.0)
    rows = read_table(tmp_path / "set/truth_map.parquet", MapTruthRow)
    assert {row.led: row.position_m for row in rows}[4] == (0.9, 1.1, 3.5)
    assert frames_of(tmp_path / "set")[0][0].spots == ()
    assert vr.verify(tmp_path / "set") == []


def test_expose_gives_the_bits_of_a_frame_of_a_set(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, *ROLLING)
    vr.generate(plan, tmp_path / "set")
    frames, truth = frames_of(tmp_path / "set")
    row = truth[1]
    pose = Pose(row.position_m, row.tilt_x_deg, row.tilt_y_deg, row.yaw_deg)
    mean = vr.render(plan.scene, plan.recipe.camera, pose, sensor=plan.recipe.sensor)
    arguments = (mean, plan.recipe.sensor, frames[1].exposure_s, plan.recipe.seed)
    raw = vr.expose(*arguments, frame=1, start_s=frames[1].start_s, demodulation="pixels")
    assert np.array_equal(raw.image_dn, pixels(tmp_path / "set/frames/000001.exr"))
    record = raw.record()
    assert record["spots"] == []
    assert record["downlink"]["demodulation"] == "pixels"
    assert record["start_s"] == frames[1].start_s
    earlier = vr.expose(*arguments, frame=1)
    assert not np.array_equal(raw.image_dn, earlier.image_dn)
    assert len(earlier.spots) > 0
