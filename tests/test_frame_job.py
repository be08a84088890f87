"""Frames of a dataset: what is new in each frame and what is shared, and the bound of a frame against a direct call."""

import gc
import weakref
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from conftest import ROOT, SMALL

import vlcrender as vr
from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.dataset.format.rows import FrameRow, TruthRow
from vlcrender.dataset.format.tables import read_table
from vlcrender.dataset.recipe.plan import Plan, load_plan
from vlcrender.dataset.run import frame_job
from vlcrender.dataset.run.frame_job import Job, _white_balance
from vlcrender.dataset.run.generate import generate
from vlcrender.rendering.crlb import position_bound_m2
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import load_scene
from vlcrender.sensor.quantum_efficiency import QuantumEfficiency
from vlcrender.sensor.sensor import Sensor

TABLE1 = ("scene=../scenes/table1.toml", "poses.min_leds=2", "expected=true")


def plan_of(*assignments: str) -> Plan:
    return load_plan(ROOT / "datasets/quickstart.toml", [*SMALL, *TABLE1, *assignments])


def pixels(path: Path) -> np.ndarray:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        image: np.ndarray = file.channels()["Y"].pixels.astype(float)
    return image


def test_the_memory_of_a_view_is_free_as_soon_as_the_next_is_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without Python's search for circles of references, which would find the images of some 15 full frames later."""
    for name in ("frames", "expected", "previews"):
        (tmp_path / name).mkdir()
    plan, views = plan_of("poses.count=2", "bound=true"), []
    rendered = frame_job._rendered

    def noted(*place: object) -> object:
        view = rendered(*place)  # type: ignore[arg-type]
        views.append(weakref.ref(view))
        return view

    monkeypatch.setattr(frame_job, "_rendered", noted)
    job = Job.of(plan, tmp_path)
    gc.collect()
    gc.disable()
    try:
        for frame in range(2):
            frame_job.make_frame(job, frame)
        first, second = views
        assert first() is None
        assert second() is not None
    finally:
        gc.enable()


SHOTS = 4


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shots of one pose by two cameras with the same axes in the same place."""
    directory = tmp_path_factory.mktemp("twins") / "set"
    rig = "rig=[{ name = 'twin', offset_m = [0.0, 0.0, 0.0] }]"
    tilts = ("poses.tilt_x_deg=[0, 5]", "poses.tilt_y_deg=[0, 5]")
    generate(plan_of("poses.count=1", f"repeats={SHOTS}", rig, *tilts), directory)
    return directory


def test_cameras_of_a_rig_have_photon_noise_of_their_own(twins: Path) -> None:
    """Standardised noise of two frames with the same means: correlation 0 within 5 / sqrt(pixels)."""
    first, twin = (pixels(twins / f"expected/{frame:06d}.exr") for frame in (0, 1))
    assert np.array_equal(first, twin)
    noise = [(pixels(twins / f"frames/{n:06d}.exr") - first).ravel() / np.sqrt(first.ravel()) for n in range(2 * SHOTS)]
    correlations = np.corrcoef(noise)[np.triu_indices(2 * SHOTS, 1)]
    assert np.abs(correlations).max() < 5 / np.sqrt(first.size)


def test_rough_pixels_have_a_new_error_in_each_frame(twins: Path) -> None:
    """Errors on the same LEDs in the same place, frame by frame: no two are equal."""
    errors = []
    for row, truth in zip(
        read_table(twins / "frames.parquet", FrameRow), read_table(twins / "truth.parquet", TruthRow), strict=True
    ):
        true = {led.led: (led.u_px, led.v_px) for led in truth.leds}
        errors.append([np.subtract((spot.u_px, spot.v_px), true[spot.led]) for spot in row.spots])
    found = np.array(errors)
    assert found.shape[0] == 2 * SHOTS
    assert found.shape[1] >= 2
    assert len(np.unique(found[..., 0])) == found[..., 0].size
    assert len(np.unique(found[..., 1])) == found[..., 1].size


def test_a_shot_has_one_reading_and_the_next_another(twins: Path) -> None:
    readings = [row.accelerometer_m_s2 for row in read_table(twins / "frames.parquet", FrameRow)]
    assert readings[::2] == readings[1::2]
    assert len(set(readings)) == SHOTS


def test_the_bound_of_a_frame_is_that_of_its_noise_and_its_accelerometer(tmp_path: Path) -> None:
    """A direct call with variance and tilt errors by hand: strong dark current, and tilts whose errors differ.

    At tilt_y = 60 deg an IMU's error on tilt_x is twice its error across gravity (1 / cos 60 deg). The variance is
    light + dark current + read noise^2 + rounding^2 / 12. Expected images are stored in float32, 6e-8, and the direct
    call has the same steps: 1e-5 leaves room for both.
    """
    plan = plan_of(
        *("poses.count=1", "poses.tilt_x_deg=[5, 5]", "poses.tilt_y_deg=[60, 60]", "bound=true"),
        *('sensor={ noise = "full", dark_current_e_s = 1e9, read_noise_e = 3.0, gain_e_per_dn = 2.0 }',),
        'accelerometer={ kind = "imu", misalignment_deg = 0.4, bits = 24 }',
    )
    generate(plan, tmp_path / "set")
    (truth,) = read_table(tmp_path / "set/truth.parquet", TruthRow)
    assert truth.bound_m2 is not None
    expected = pixels(tmp_path / "set/expected/000000.exr")
    pose = Pose(truth.position_m, truth.tilt_x_deg, truth.tilt_y_deg, truth.yaw_deg)
    (mounted,) = plan.recipe.cameras
    variance = RegionImage(Roi.of_sensor(mounted.camera), expected + 1e9 * 1.6e-6 + 3.0**2 + 2.0**2 / 12)
    renderer = Renderer(plan.scene)
    bound = position_bound_m2(
        mounted,
        pose,
        renderer.led_slopes,
        1.6e-6,
        [variance],
        float(np.median(np.linalg.norm(plan.scene.leds.centers_m - truth.position_m, axis=1))),
        (0.8, 0.4),
    )
    assert bound is not None
    assert np.array(truth.bound_m2).reshape(3, 3) == pytest.approx(bound, rel=1e-5, abs=1e-5 * np.trace(bound))
    assert truth.bound_exact_m2 == truth.bound_m2  # without [belief]


def test_with_a_belief_the_truth_has_the_hybrid_bound_beside_the_exact_one(tmp_path: Path) -> None:
    """The hybrid one is the budget's of the same pose; the exact one is that of pixel noise alone, below.

    The frame's camera and LEDs are the true ones, the budget's the told ones. A luminaire 3 mm and 0.2 deg off in 2.5 m
    and a focal length 0.1 % off change distances and angles by 1e-3; LEDs 0.3 mm off, the distances of 130 mm between
    them by 2e-3. Bounds follow with small powers of these: 1e-2.
    """
    plan = plan_of("poses.count=1", "bound=true", "belief.preset=calibrated")
    generate(plan, tmp_path / "set")
    (truth,) = read_table(tmp_path / "set/truth.parquet", TruthRow)
    assert truth.bound_m2 is not None
    assert truth.bound_exact_m2 is not None
    hybrid, exact = (np.array(bound).reshape(3, 3) for bound in (truth.bound_m2, truth.bound_exact_m2))
    of_budget = vr.budget(plan, poses=1).bound
    assert of_budget is not None
    assert 1e3 * np.sqrt(hybrid[2, 2]) == pytest.approx(of_budget.vertical_mm, rel=1e-2)
    assert 1e3 * np.sqrt(hybrid[0, 0] + hybrid[1, 1]) == pytest.approx(of_budget.horizontal_mm, rel=1e-2)
    assert np.linalg.eigvalsh(hybrid - exact).min() > 0


def test_white_balance_multiplies_the_weaker_colours_and_leaves_a_blind_one() -> None:
    """Green strongest, red half of it at each wavelength, blue blind: factors 2, 1 and 1."""
    curves = {"red": (0.3, 0.3), "green": (0.6, 0.6), "blue": (0.0, 0.0)}
    sensor = Sensor(mosaic="rggb", quantum_efficiency=QuantumEfficiency(wavelengths_nm=(380.0, 780.0), **curves))
    scene = load_scene(ROOT / "scenes/table1.toml")
    assert _white_balance(Camera(), sensor, scene) == pytest.approx((2.0, 1.0, 1.0))
    assert _white_balance(Camera(), Sensor(), scene) == (1.0, 1.0, 1.0)


def test_frames_have_the_scene_that_their_process_has_loaded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A plan's scene is loaded once in the process that makes the plan; another process builds it from the job."""
    plan = plan_of("poses.count=1")
    job = Job.of(plan, tmp_path)
    parts = job.scene_key, plan.recipe.sensor.spectral_response
    frame_job._renderer.cache_clear()  # an earlier test's renderer of the same scene
    assert frame_job._renderer(*parts).scene is plan.scene
    monkeypatch.setattr(frame_job, "_loaded", {})
    frame_job._renderer.cache_clear()
    elsewhere = frame_job._renderer(*parts)
    assert elsewhere.scene is not plan.scene
    assert np.array_equal(elsewhere.scene.leds.centers_m, plan.scene.leds.centers_m)
