"""What a device does not know: presets, standard deviations, and draws of cameras, LEDs and accelerometers."""

from itertools import pairwise

import numpy as np
import pytest
from conftest import ROOT
from test_belief import CALIBRATED, Array, plan

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.config.presets import presets
from vlcrender.dataset.recipe.belief import CAMERA_PARAMETERS, Belief
from vlcrender.dataset.recipe.plan import Plan, load_plan
from vlcrender.dataset.world.true_world import (
    built_leds,
    device_sensor,
    reading_m_s2,
    tilt_errors_deg,
    true_camera,
)
from vlcrender.errors import InputError

# Presets and sigmas


@pytest.mark.parametrize("name", presets("beliefs"))
def test_every_number_of_a_preset_names_its_source_or_says_ours(name: str) -> None:
    text = (ROOT / f"vlcrender/config/preset_files/beliefs/{name}.toml").read_text()
    numbers = [line for line in text.splitlines() if "=" in line and not line.startswith("#")]
    assert len(numbers) == 17
    for line in numbers:
        assert "# " in line, line
    assert Belief.preset(name).camera.focal_percent > 0


def test_the_presets_grow_from_laboratory_to_as_sold() -> None:
    cameras = plan().recipe.cameras
    levels = [
        Belief.preset(name).true_sigmas(cameras, plan().recipe.accelerometer)
        for name in ("laboratory", "calibrated", "as-sold")
    ]
    for low, high in pairwise(levels):
        assert (low.cameras["main"].device < high.cameras["main"].device).all()
        assert (low.luminaire_m < high.luminaire_m).all()
        assert (low.led_m < high.led_m).all()
        assert low.accelerometer_device_deg < high.accelerometer_device_deg


def test_keys_beside_a_preset_override_it_one_by_one() -> None:
    recipe = plan(*CALIBRATED, "belief.camera.focal_percent=0.7").recipe
    assert recipe.belief is not None
    assert recipe.belief.camera.focal_percent == 0.7
    assert recipe.belief.camera.principal_point_um == 6.0
    assert (recipe.belief.devices, recipe.belief.maps) == (3, 2)


def test_more_maps_than_devices_are_refused_in_one_line() -> None:
    with pytest.raises(InputError, match=r"belief\.maps: is 4; .* at most devices = 3") as refusal:
        plan("belief.preset=calibrated", "belief.devices=3")
    assert "\n" not in str(refusal.value)


def test_overscan_is_refused_where_the_lens_has_distortion_errors() -> None:
    with pytest.raises(InputError, match=r"overscan = true: \[belief\.camera\] gives lenses a distortion"):
        plan(*CALIBRATED, "regions.overscan=true")
    none = ("belief.camera.radial_corner_um=0", "belief.camera.decentering_corner_um=0")
    assert plan(*CALIBRATED, "regions.overscan=true", *none).recipe.belief is not None


def test_sigmas_of_the_distortion_are_displacements_at_the_corner() -> None:
    """By the projection itself, at full size and binned: 1.2 um radially; 0.36 um along the axis of p1."""
    for scale in (1, 4):
        recipe = load_plan(ROOT / "datasets/quickstart.toml", CALIBRATED, scale).recipe
        camera = recipe.camera
        assert recipe.belief is not None
        sigmas = recipe.belief.true_sigmas(recipe.cameras, recipe.accelerometer).cameras["main"]
        of = dict(zip(CAMERA_PARAMETERS, sigmas.device, strict=True))
        pitch_um = camera.pixel_pitch_um
        assert of["cx_px"] * pitch_um == pytest.approx(6.0, rel=1e-12)
        r = np.hypot(camera.width_px, camera.height_px) / 2 / camera.focal_px
        assert r == pytest.approx(2500 / 15000)
        for name, point, displacement_um in (("k1", (0.8 * r, 0.6 * r), 1.2), ("p1", (0.0, r), 0.36)):
            lens = Camera.model_validate({**camera.model_dump(), "distortion": {name: of[name]}})
            there = np.array([*point, 1.0])
            moved_px = np.hypot(*(lens.image_of_points(there) - camera.image_of_points(there)))
            # Both are exact in the undistorted radius, up to the rounding of pixels of some 2000.
            assert moved_px * pitch_um == pytest.approx(displacement_um, rel=1e-9)


# Draws


def errors_of_camera(recipe_plan: Plan, device: int, frame: int | None = None) -> Array:
    """Errors of the camera `main` in the order of CAMERA_PARAMETERS, read back from K and the distortion."""
    told, true = recipe_plan.recipe.camera, true_camera(recipe_plan.recipe, 0, device, frame).camera
    fx, fy = true.matrix[0, 0] / told.matrix[0, 0], true.matrix[1, 1] / told.matrix[1, 1]
    focal = (fx + fy) / 2 - 1
    lens = true.distortion
    return np.array(
        [
            focal,
            (fx - fy) / (1 + focal),
            true.matrix[0, 2] - told.matrix[0, 2],
            true.matrix[1, 2] - told.matrix[1, 2],
            *((0.0, 0.0, 0.0) if lens is None else (lens.k1, lens.p1, lens.p2)),
        ]
    )


def assert_scatter(values: Array, sigma: Array) -> None:
    """Mean 0 and standard deviation `sigma` of normal values (n, k), at 5 sigma of the sample's own scatter."""
    n = len(values)
    assert (np.abs(values.mean(axis=0)) < 5 * sigma / np.sqrt(n)).all()
    assert (np.abs(values.std(axis=0) - sigma) < 5 * sigma / np.sqrt(2 * n)).all()


def test_cameras_scatter_over_devices_and_over_shots_as_the_sigmas_say() -> None:
    of = plan(*CALIBRATED, "belief.devices=400")
    assert of.recipe.belief is not None
    sigmas = of.recipe.belief.true_sigmas(of.recipe.cameras, of.recipe.accelerometer).cameras["main"]
    devices = np.array([errors_of_camera(of, device) for device in range(400)])
    assert_scatter(devices, sigmas.device)
    shots = np.array([errors_of_camera(of, 7, frame) for frame in range(400)]) - devices[7]
    free = sigmas.shot > 0
    assert free.tolist() == [True, False, True, True, False, False, False]
    # focal: (1 + device + shot) has no cross term, but aspect and focal share fx and fy to 1e-3 of themselves
    assert_scatter(shots[:, free], sigmas.shot[free])
    assert np.abs(shots[:, ~free]).max() < 1e-9
    correlations = np.corrcoef(devices.T) - np.eye(7)
    assert np.abs(correlations).max() < 5 / np.sqrt(400)


def test_leds_scatter_over_luminaires_and_leds_as_the_sigmas_say() -> None:
    """49 panels of 25 LEDs in two maps."""
    none = ("belief.leds.position_mm=[0, 0, 0]", "belief.luminaires.tilt_deg=0", "belief.luminaires.yaw_deg=0")
    of = plan(*CALIBRATED, *none)
    told = of.scene.leds
    shifts = [built_leds(of.recipe, of.scene, number).centers_m - told.centers_m for number in range(2)]
    by_panel = np.stack(shifts).reshape(2, 49, 25, 3)
    assert np.ptp(by_panel, axis=2).max() < 1e-12, "LEDs of one panel move together"
    assert_scatter(by_panel[:, :, 0].reshape(-1, 3), np.full(3, 3e-3))
    alone = plan(*CALIBRATED, "belief.luminaires={}", "belief.leds.position_mm=[0.3, 0.6, 0.9]")
    built = built_leds(alone.recipe, alone.scene, 1)
    assert_scatter(built.centers_m - told.centers_m, np.array([3e-4, 6e-4, 9e-4]))
    assert_scatter((built.half_widths_m / told.half_widths_m - 1)[:, None], np.array([0.02]))
    assert_scatter(built.face_gradients - told.face_gradients, np.array([0.05, 0.05]))


def test_a_luminaire_turns_about_its_centre() -> None:
    """A yaw alone: distances from the panel's centre stay, and +x goes towards +y for a positive angle."""
    of = plan("belief.luminaires.yaw_deg=1", "belief.devices=1", "belief.maps=1")
    told = of.scene.leds.centers_m.reshape(49, 25, 3)
    built = built_leds(of.recipe, of.scene, 0).centers_m.reshape(49, 25, 3)
    before, after = told - told.mean(axis=1, keepdims=True), built - told.mean(axis=1, keepdims=True)
    assert np.abs(np.linalg.norm(after, axis=2) - np.linalg.norm(before, axis=2)).max() < 1e-12
    outer = 4  # the last LED of the first row
    angles = np.degrees(np.arctan2(*after[:, outer, 1::-1].T) - np.arctan2(*before[:, outer, 1::-1].T))
    assert_scatter(angles[:, None], np.array([1.0]))
    turned = plan("belief.luminaires.tilt_deg=1", "belief.devices=1", "belief.maps=1")
    heights = built_leds(turned.recipe, turned.scene, 0).centers_m.reshape(49, 25, 3)[:, :, 2] - told[:, :, 2]
    # z = angle_x y - angle_y x to first order, zero mean over the panel
    fit, *_ = np.linalg.lstsq(before[0, :, :2], heights.T, rcond=None)
    assert_scatter(np.degrees(fit.T), np.array([1.0, 1.0]))
    assert np.abs(before[0, :, :2] @ fit - heights.T).max() < 1e-9


def test_datum_and_scale_move_all_leds_together() -> None:
    of = plan("belief.datum={ position_mm = [5, 5, 5], scale_ppm = 100 }", "belief.devices=1", "belief.maps=1")
    told, built = of.scene.leds.centers_m, built_leds(of.recipe, of.scene, 0).centers_m
    scale = np.linalg.norm(built[-1] - built[0]) / np.linalg.norm(told[-1] - told[0])
    assert 1e-6 < abs(scale - 1) < 5e-4
    assert np.ptp(built - scale * told, axis=0).max() < 1e-12


def test_accelerometers_have_a_bias_of_their_own_and_noise_of_each_shot() -> None:
    of = plan(*CALIBRATED, "belief.devices=500")
    biases = np.array([tilt_errors_deg(of.recipe, device) for device in range(500)])
    assert_scatter(biases, np.array([0.3, 0.3]))
    level = Pose((3.0, 3.0, 1.0))
    readings = np.array([reading_m_s2(of.recipe, 7, shot, level) for shot in range(500)]) / 9.80665
    # R_cam_world (0, 0, 1) is (-sin y, sin x cos y, cos x cos y)
    tilts = np.degrees(np.column_stack([np.arctan2(readings[:, 1], readings[:, 2]), -np.arcsin(readings[:, 0])]))
    assert_scatter(tilts - biases[7], np.array([0.05, 0.05]))


def test_devices_are_individual_parts() -> None:
    """Fixed patterns and an IMU derive from the device; without [belief] from the recipe's serial."""
    of = plan(*CALIBRATED, "sensor.preset=phone-1.2um", "accelerometer.preset=bmi270")
    assert len({device_sensor(of.recipe, device).serial for device in range(3)}) == 3
    assert device_sensor(plan("sensor.serial=5").recipe, 0).serial == 5
    level = Pose((3.0, 3.0, 1.0))
    means = [np.mean([reading_m_s2(of.recipe, d, shot, level) for shot in range(20)], axis=0) for d in range(2)]
    # noise of 20 readings is below 0.02 m/s2, the zero-g offset of the part 0.196 m/s2
    assert np.abs(means[0] - means[1]).max() > 0.02
    rows = [tilt_errors_deg(of.recipe, device) for device in range(3)]
    assert rows == [(0.0, 0.0)] * 3


SIGMAS: dict[str, str] = {
    "belief.camera.focal_percent": "0.4",
    "belief.shot.principal_point_um": "9",
    "belief.luminaires.position_mm": "[9, 3, 3]",
    "belief.luminaires.yaw_deg": "0.5",
    "belief.leds.position_mm": "[0.3, 0.3, 0.9]",
    "belief.leds.radius_percent": "4",
    "belief.leds.gradient_percent": "1",
    "belief.accelerometer.device_error_deg": "0.9",
    "belief.datum.scale_ppm": "20",
}


def world(of: Plan) -> dict[str, Array]:
    """All that is drawn, each kind of error apart."""
    camera, leds, told = errors_of_camera(of, 1), built_leds(of.recipe, of.scene, 1), of.scene.leds
    shifts = leds.centers_m - told.centers_m
    of_panels = shifts.reshape(49, 25, 3)
    before = told.centers_m[:25, :2] - told.centers_m[:25, :2].mean(axis=0)
    yaws = (of_panels[:, :, 1] * before[:, 0] - of_panels[:, :, 0] * before[:, 1]).sum(axis=1)
    return {
        "camera": camera[:2],
        "lens": camera[4:],
        "shot": (errors_of_camera(of, 1, 5) - camera)[2:4],
        "x": shifts[:, 0],
        "y": shifts[:, 1],
        "z": shifts[:, 2],
        "yaw": yaws,
        "size": leds.half_widths_m,
        "gradient": leds.face_gradients,
        "tilt": np.array(tilt_errors_deg(of.recipe, 1)),
    }


@pytest.mark.parametrize(
    ("key", "moved"),
    [
        ("belief.camera.focal_percent", {"camera"}),
        ("belief.shot.principal_point_um", {"shot"}),
        ("belief.luminaires.position_mm", {"x"}),
        ("belief.luminaires.yaw_deg", {"x", "y", "z", "yaw"}),
        ("belief.leds.position_mm", {"z"}),
        ("belief.leds.radius_percent", {"size"}),
        ("belief.leds.gradient_percent", {"gradient"}),
        ("belief.accelerometer.device_error_deg", {"tilt"}),
        ("belief.datum.scale_ppm", {"x", "y", "z"}),
    ],
)
def test_a_change_of_one_sigma_moves_nothing_else(key: str, moved: set[str]) -> None:
    before, after = world(plan(*CALIBRATED)), world(plan(*CALIBRATED, f"{key}={SIGMAS[key]}"))
    for name, values in before.items():
        # Errors are read back as differences of numbers of up to 7 m and 1250 px: 1e-12 is their rounding.
        same = bool(np.allclose(values, after[name], rtol=0, atol=1e-9 if name == "shot" else 1e-11))
        if name in moved:
            assert not same, name
        elif not (name == "yaw" and moved & {"x", "y"}):
            assert same, name


def test_devices_shots_and_maps_differ() -> None:
    of = plan(*CALIBRATED)
    devices = [errors_of_camera(of, device) for device in range(3)]
    assert all((a != b).all() for a, b in pairwise(devices))
    maps = [built_leds(of.recipe, of.scene, number).centers_m for number in range(2)]
    assert (maps[0] != maps[1]).all()
    assert (errors_of_camera(of, 0, 4) != errors_of_camera(of, 0, 5))[[0, 2, 3]].all()
    other = plan(*CALIBRATED, "seed=77")
    assert (errors_of_camera(other, 0) != devices[0]).all()


def test_a_stated_factor_leaves_the_true_sigmas() -> None:
    """Each table has its own factor, or the common one: what a device is told changes by it, the truth does not.

    Powers of 2 are exact.
    """
    recipe = plan(*CALIBRATED).recipe
    alone = Belief.preset("calibrated")
    leds = alone.leds.model_copy(update={"stated_factor": 0.5})
    belief = alone.model_copy(update={"stated_factor": 4.0, "leds": leds})
    true = belief.true_sigmas(recipe.cameras, recipe.accelerometer)
    stated = belief.stated_sigmas(recipe.cameras, recipe.accelerometer)
    expected = alone.true_sigmas(recipe.cameras, recipe.accelerometer)
    for name in ("luminaire_m", "luminaire_rotation_deg", "accelerometer_device_deg", "accelerometer_shot_deg"):
        np.testing.assert_array_equal(getattr(true, name), getattr(expected, name))
        np.testing.assert_array_equal(getattr(stated, name), 4.0 * np.asarray(getattr(true, name)))
    for name in ("led_m", "led_size", "led_gradient"):
        np.testing.assert_array_equal(getattr(true, name), getattr(expected, name))
        np.testing.assert_array_equal(getattr(stated, name), 0.5 * np.asarray(getattr(true, name)))
    np.testing.assert_array_equal(true.cameras["main"].device, expected.cameras["main"].device)
    np.testing.assert_array_equal(stated.cameras["main"].device, 4.0 * true.cameras["main"].device)


def test_a_focused_lens_keeps_its_focus_and_aperture() -> None:
    """K is told times 1 + focal also where the focus is near; relative aperture and focus stay."""
    near = plan(*CALIBRATED, "camera.focus_distance_m=1.0", "belief.camera.aspect_percent=0")
    far = plan(*CALIBRATED, "belief.camera.aspect_percent=0")
    told, true = near.recipe.camera, true_camera(near.recipe, 0, 2).camera
    assert true.focus_distance_m == told.focus_distance_m
    # f, f_i and K are functions of one another, each rounded once or twice
    assert true.focal_px / told.focal_px - 1 == pytest.approx(float(errors_of_camera(far, 2)[0]), rel=1e-9)


def test_a_rigs_mounting_errors_are_those_of_the_recipe_in_metres() -> None:
    """1.5 mm are 0.0015 m; the main camera carries the rig's frame and has none."""
    recipe = plan(*CALIBRATED, 'rig=[{name="left", offset_m=[0.1, 0.0, 0.0]}]').recipe
    belief = Belief.preset("calibrated")
    belief = belief.model_copy(update={"rig": belief.rig.model_copy(update={"offset_mm": 1.5, "rotation_deg": 0.25})})
    cameras = belief.true_sigmas(recipe.cameras, recipe.accelerometer).cameras
    found = {name: (one.offset_m, one.rotation_deg) for name, one in cameras.items()}
    assert found == {"main": (0.0, 0.0), "left": (pytest.approx(0.0015, rel=1e-12), 0.25)}
