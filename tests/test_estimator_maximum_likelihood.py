"""Maximum likelihood: exact without noise, consistent covariance with noise, robust against missing LEDs."""

import json
from dataclasses import replace

import numpy as np
import pytest
from estimator_correspondences import EXACT
from estimator_synthetic import View, description, grid, poisson, render, view_of
from numpy.typing import NDArray
from scipy.stats import chi2

from estimator.camera.pose import Pose, rotation
from estimator.errors import EstimationFailure
from estimator.io.camera import Camera
from estimator.io.device import Accelerometer, DecodedSpot, DeviceFrame, Part
from estimator.io.led_map import DiscLed
from estimator.io.sensor import Sensor
from estimator.methods import maximum_likelihood
from estimator.methods.maximum_likelihood import Maximum, maximize, ml
from estimator.pixels import search
from estimator.pixels.initial import Start, gravity_of
from estimator.pixels.led_model import ImageState
from estimator.pixels.led_pixels import gather_led_pixels, leds_in_view
from estimator.pixels.nuisances import Gravity, Nuisances, Priors

Floats = NDArray[np.float64]
TARGET = (3.5, 3.6, 3.5)
SAMPLES = 48
"""On each side of an edge pixel: 0.3 / 48^1.5 = 0.1 % of an LED's light, 4 of 4000 e where the noise is some 45."""
ERROR_DEG = 0.5


def frame_of(view: View, leds_m: Floats, image_dn: NDArray[np.uint32], error_deg: float = ERROR_DEG) -> DeviceFrame:
    """A frame of the whole sensor, gravity read without error though it is said to have one."""
    made = json.loads(json.dumps(description(view, 1, leds_m, 0.01)))
    pixels = view.project(leds_m)
    inside = ((pixels > 0) & (pixels < [view.width_px, view.height_px])).all(axis=1)
    return DeviceFrame(
        parts=(Part(0, 0, image_dn),),
        camera=Camera.model_validate_json(json.dumps(made["cameras"]["main"])),
        sensor=Sensor.model_validate_json(json.dumps(made["sensor"])),
        accelerometer_m_s2=tuple(view.gravity_m_s2.tolist()),
        accelerometer=Accelerometer(kind="tilt-error", error_deg=error_deg),
        exposure_s=1e-3,
        spots=tuple(DecodedSpot(led=10 + int(k), u_px=pixels[k, 0], v_px=pixels[k, 1]) for k in np.flatnonzero(inside)),
        leds={10 + k: DiscLed(id=10 + k, position_m=led, radius_m=0.01) for k, led in enumerate(leds_m)},
    )


SURE = np.eye(6) * 1e-12


def most_likely(frame: DeviceFrame, start: Pose, gravity: Gravity | None = None) -> Maximum:
    """The maximum from a pose that is nearly certain, with an exact map."""
    priors = Priors.of(frame)
    begin = Start(start, Nuisances.zero(priors), SURE, np.zeros(len(frame.leds), dtype=bool))
    return maximize(frame, gravity or gravity_of(frame), priors, begin)


def misread(view: View, frame: DeviceFrame, generator: np.random.Generator) -> DeviceFrame:
    """With the accelerometer's error."""
    tilts = np.radians([view.tilt_x_deg, view.tilt_y_deg] + ERROR_DEG * generator.standard_normal(2))
    return replace(frame, accelerometer_m_s2=tuple((rotation(*tilts) @ [0.0, 0.0, 9.80665]).tolist()))


def with_exact_camera(frame: DeviceFrame) -> DeviceFrame:
    """The device states that its camera is exact."""
    return replace(frame, camera=frame.camera.model_copy(update={"uncertainty": EXACT}))


def off_m(frame: DeviceFrame, view: View) -> float:
    return float(np.linalg.norm(ml(frame).position_m - view.position_m))


def exact(view: View, leds_m: Floats) -> DeviceFrame:
    return frame_of(view, leds_m, np.rint(render(view, leds_m, 0.01, samples=150)).astype(np.uint32))


SIX = grid(3, 2, 0.14, TARGET)


@pytest.mark.slow
@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0, 10.0), (30.0, -20.0, 40.0), (60.0, 0.0, 100.0)])
def test_without_noise_the_error_is_rounding(tilt_deg: tuple[float, float, float]) -> None:
    """The reference's edges err by 0.3 / 150^1.5 of 4000 e, and numbers round by 0.3 e: 0.7 e, where the dimmest edges
    have a noise of 6 e. A tenth of the standard deviation that is reported, in each of three dimensions, and where all
    LEDs fall alike on their pixels their errors are alike too.
    """
    view = view_of(TARGET, 3.0, *tilt_deg)
    frame = exact(view, SIX)
    estimate = ml(frame)
    assert estimate.covariance_m2 is not None
    error = estimate.position_m - view.position_m
    assert error @ np.linalg.solve(estimate.covariance_m2, error) < 0.3**2
    assert not estimate.ambiguous


def nees_of_draws(view: View, leds_m: Floats, sensor: dict[str, object], draws: int) -> list[float]:
    """Normalised squared errors over noise drawn as FORMAT.md and the sensor's keys say."""
    generator = np.random.default_rng(7)
    expected = render(view, leds_m, 0.01, 3000.0, samples=SAMPLES)
    plain = frame_of(view, leds_m, np.zeros(expected.shape, dtype=np.uint32))
    plain = with_exact_camera(replace(plain, sensor=plain.sensor.model_copy(update=sensor)))
    chip = plain.sensor
    nees = []
    for _ in range(draws):
        prnu, dsnu = 1 + chip.prnu * generator.standard_normal(expected.shape), chip.dsnu_e
        electrons = generator.poisson(np.maximum(expected * prnu, 0)).astype(float)
        electrons += np.hypot(dsnu, chip.read_noise_e) * generator.standard_normal(expected.shape)
        dn = np.rint(electrons / chip.gain_e_per_dn + chip.adc_noise_dn * generator.standard_normal(expected.shape))
        image = np.clip(dn + chip.black_level_dn, 0, 2**chip.bits - 1).astype(np.uint32)
        frame = misread(view, replace(plain, parts=(Part(0, 0, image),)), generator)
        estimate = ml(frame)
        error = estimate.position_m - view.position_m
        assert estimate.covariance_m2 is not None
        nees.append(float(error @ np.linalg.solve(estimate.covariance_m2, error)))
    return nees


SHOT: dict[str, object] = {}
FULL: dict[str, object] = {
    **{"noise": "full", "prnu": 0.05, "dsnu_e": 8.0, "read_noise_e": 20.0, "adc_noise_dn": 1.0},
    **{"gain_e_per_dn": 6.0, "black_level_dn": 64.0, "bits": 12},
}


@pytest.mark.slow
@pytest.mark.parametrize("leds", [6, 2])
@pytest.mark.parametrize("sensor", [SHOT, FULL], ids=["shot", "full"])
def test_errors_agree_with_the_covariance(sensor: dict[str, object], leds: int) -> None:
    """The sum of normalised squared errors is chi2 with three degrees a draw: within its 99.9 % interval.

    Two LEDs need the reading of gravity, and their discs' shapes say more of the tilt than it does: far from linear.
    """
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0, size=(320, 240, 1500.0))
    draws = 40
    chosen = SIX if leds == 6 else SIX[[0, 4]]
    total = sum(nees_of_draws(view, chosen, sensor, draws))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * draws)
    assert low < total < high


def test_read_noise_increases_the_covariance() -> None:
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0, size=(320, 240, 1500.0))
    image = poisson(render(view, SIX, 0.01, 3000.0), 1)
    quiet = frame_of(view, SIX, image)
    loud = replace(quiet, sensor=quiet.sensor.model_copy(update={"noise": "full", "read_noise_e": 60.0}))
    sure, unsure = (ml(frame).covariance_m2 for frame in (quiet, loud))
    assert sure is not None
    assert unsure is not None
    # At edges a variance of some 1500 e^2 becomes 5100.
    assert 1.5 < np.trace(unsure) / np.trace(sure) < 10


def test_leds_cut_by_the_border_are_used() -> None:
    """Twelve whole, eight cut in the middle by the left and right borders: with them the position is better known."""
    view = view_of(TARGET, 3.0, size=(281, 300, 1500.0))
    leds_m = grid(3, 4, 0.281, TARGET)
    leds_m = leds_m[np.abs(view.project(leds_m)[:, 1] - 150) < 140]
    pixels = view.project(leds_m)
    cut = np.abs(pixels[:, 0] - 140.5) > 135
    assert (cut.sum(), (~cut).sum()) == (4, 2)
    wider = np.concatenate([leds_m, [[TARGET[0], TARGET[1], TARGET[2]], [TARGET[0] + 0.1, TARGET[1] + 0.1, TARGET[2]]]])
    frame = with_exact_camera(frame_of(view, wider, poisson(render(view, wider, 0.01, samples=SAMPLES), 3)))
    uncut = replace(frame, leds={key: led for key, led in frame.leds.items() if key - 10 not in np.flatnonzero(cut)})
    uncut = replace(uncut, spots=tuple(spot for spot in frame.spots if spot.led in uncut.leds))
    with_cut, without = ml(frame), ml(uncut)
    assert with_cut.covariance_m2 is not None
    assert without.covariance_m2 is not None
    assert np.trace(with_cut.covariance_m2) < 0.8 * np.trace(without.covariance_m2)
    error = with_cut.position_m - view.position_m
    assert error @ np.linalg.solve(with_cut.covariance_m2, error) < chi2.ppf(0.9999, 3)


def test_saturated_leds_are_used_by_their_unsaturated_edges() -> None:
    """All LEDs three times over the full well: their edges below it are still where they are, and known less well."""
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0)
    expected = render(view, SIX, 0.01, 9000.0, samples=SAMPLES)
    frame = frame_of(view, SIX, np.minimum(poisson(expected, 5), 3000).astype(np.uint32))
    frame = replace(frame, sensor=frame.sensor.model_copy(update={"full_well_e": 3000.0}))
    estimate = ml(frame)
    assert estimate.covariance_m2 is not None
    error = estimate.position_m - view.position_m
    assert error @ np.linalg.solve(estimate.covariance_m2, error) < chi2.ppf(0.9999, 3)
    # Cutting readings without leaving them out moves edges by half their width: metres off in units of the error.
    assert np.linalg.norm(error) < 1e-3


def test_leds_that_the_model_does_not_explain_are_left_out() -> None:
    """One dark, one half hidden: the answer is that of the others."""
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0)
    leds_m = grid(4, 3, 0.14, TARGET)
    clean = frame_of(view, leds_m, poisson(render(view, leds_m, 0.01, 4000.0, samples=SAMPLES), 9))
    image = clean.parts[0].image_dn.copy()
    u, v = np.floor(view.project(leds_m)).astype(int).T
    image[v[0] - 12 : v[0] + 12, u[0] - 12 : u[0] + 12] = 40
    image[v[1] - 12 : v[1] + 12, u[1] - 12 : u[1]] = 40
    spoilt = ml(replace(clean, parts=(Part(0, 0, image),)))
    others = {key: led for key, led in clean.leds.items() if key not in (10, 11)}
    spots = tuple(spot for spot in clean.spots if spot.led in others)
    np.testing.assert_allclose(spoilt.position_m, ml(replace(clean, leds=others, spots=spots)).position_m, atol=2e-6)


def test_gravity_and_two_leds_fix_a_position_and_one_does_not() -> None:
    """The reading's 0.5 deg cause 26 mm at 3 m along each axis; the shapes of the discs reduce it."""
    view = view_of(TARGET, 3.0, 10.0, 5.0, 30.0)
    leds_m = SIX[:2] + [0.07, 0.07, 0.0]
    image = poisson(render(view, leds_m, 0.01, 4000.0, samples=SAMPLES), 2)
    estimate = ml(misread(view, frame_of(view, leds_m, image), np.random.default_rng(1)))
    assert estimate.covariance_m2 is not None
    sigma = np.sqrt(np.diag(estimate.covariance_m2))
    assert 1e-3 < sigma[:2].max() < 0.026
    error = estimate.position_m - view.position_m
    assert error @ np.linalg.solve(estimate.covariance_m2, error) < chi2.ppf(0.9999, 3)
    one = frame_of(view, leds_m[:1], poisson(render(view, leds_m[:1], 0.01), 2))
    with pytest.raises(EstimationFailure, match=r"^position: "):
        ml(one)


@pytest.mark.slow
def test_exact_gravity_is_exact() -> None:
    """Said to be without error, as the camera is but for 1e-9 of its focal length, a reading that is off by 0.1 deg
    moves the answer by 3 m times that, 5 mm. A camera without any error would be contradicted, and not the reading.
    """
    view = view_of(TARGET, 3.0, 10.0, 5.0, 30.0)
    frame = exact(view, SIX)
    stated = EXACT.model_copy(update={"parameters": ("focal",), "device_sigma": (1e-9,), "shot_sigma": (0.0,)})
    frame = replace(frame, camera=frame.camera.model_copy(update={"uncertainty": stated}))
    off = rotation(np.radians(10.1), np.radians(5.0)) @ [0.0, 0.0, 9.80665]
    wrong = replace(
        frame, accelerometer_m_s2=tuple(off.tolist()), accelerometer=Accelerometer(kind="tilt-error", error_deg=0.0)
    )
    right = replace(frame, accelerometer=Accelerometer(kind="tilt-error", error_deg=0.0))
    assert off_m(right, view) < 1e-4
    assert 3e-3 < off_m(wrong, view) < 8e-3


def test_regions_give_the_position_of_the_full_frame() -> None:
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0)
    whole = frame_of(view, SIX, poisson(render(view, SIX, 0.01, samples=SAMPLES), 4))
    image = whole.parts[0].image_dn
    parts = []
    for u, v in np.floor(view.project(SIX)).astype(int):
        top, left = max(v - 30, 0), max(u - 30, 0)
        parts.append(Part(top, left, image[top : v + 30, left : u + 30]))
    assert np.linalg.norm(ml(replace(whole, parts=tuple(parts))).position_m - ml(whole).position_m) < 1e-6


def test_each_colour_of_a_mosaic_has_its_amplitude() -> None:
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0)
    expected = render(view, SIX, 0.01, 4000.0, samples=SAMPLES)
    passed = np.array([[0.9, 1.0], [1.0, 0.8]])
    tiles = np.tile(passed, (expected.shape[0] // 2, expected.shape[1] // 2))
    frame = frame_of(view, SIX, poisson(expected * tiles, 6))
    frame = replace(frame, sensor=frame.sensor.model_copy(update={"mosaic": "rggb"}))
    estimate = ml(frame)
    assert estimate.covariance_m2 is not None
    error = estimate.position_m - view.position_m
    assert error @ np.linalg.solve(estimate.covariance_m2, error) < chi2.ppf(0.9999, 3)


# Two LEDs of 2 px radius: few pixels, so that every one of them can be changed in turn.
PAIR = grid(2, 2, 0.05, TARGET)[[0, 3]]
PAIR_RADIUS_M = 0.004


def test_the_covariance_is_that_of_small_changes_of_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Linear propagation by hand: change each reading, and each tilt, by a tenth of its sigma and see where the answer
    goes. A reading's variance is its own expectation: shot noise.

    The answer is curved: at a whole sigma of the readings some squared steps are 1.6 % off along the worst axis, all
    of it second order, which at a tenth is ten times less. The limit is for that and 0.3 e of rounding in 100 e.
    """
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0, size=(60, 60, 1500.0))
    frame = frame_of(
        view, PAIR, np.rint(render(view, PAIR, PAIR_RADIUS_M, 20000.0, samples=100)).astype(np.uint32), 0.05
    )
    leds = {key: led.model_copy(update={"radius_m": PAIR_RADIUS_M}) for key, led in frame.leds.items()}
    frame = with_exact_camera(replace(frame, leds=leds))
    start, gravity = Pose(np.array(view.position_m), view.R_cam_world), gravity_of(frame)
    state = ImageState.as_told(start, frame.camera, 2)
    view_of_leds = leds_in_view(frame, state, SURE, np.zeros(2), np.zeros(2, dtype=bool))
    pixels = gather_led_pixels(frame, view_of_leds, search.image_parameters(Priors.of(frame)))
    monkeypatch.setattr(search, "CONVERGED_STEP2", 1e-10)

    def answer_m(electrons: Floats, gravity: Gravity = gravity) -> Floats:
        changed = replace(pixels, electrons=electrons)
        monkeypatch.setattr(maximum_likelihood, "gather_led_pixels", lambda *_: changed)
        return most_likely(frame, start, gravity).pose.position_m

    unchanged_m, share = answer_m(pixels.electrons), 0.1
    steps = [
        answer_m(pixels.electrons + share * np.sqrt(expected_e) * unit) - unchanged_m
        for expected_e, unit in zip(pixels.electrons, np.eye(len(pixels.electrons)), strict=True)
    ]
    for axis in np.eye(2):
        turned = Gravity(gravity.tilts + share * gravity.sigma * axis, gravity.sigma)
        steps.append(answer_m(pixels.electrons, turned) - unchanged_m)
    by_hand_m2 = np.array(steps).T @ np.array(steps) / share**2
    monkeypatch.undo()
    stated_m2 = ml(frame).covariance_m2
    assert stated_m2 is not None
    ratios = np.linalg.eigvals(np.linalg.solve(stated_m2, by_hand_m2))
    assert ratios.real == pytest.approx(np.ones(3), abs=0.01)


def nearly_exact(view: View, leds_m: Floats) -> DeviceFrame:
    """As `exact`, in a tenth of the time: edges err by 4 e, where noise is 6 e in the dimmest and 60 e in the brightest
    pixels, so that a position errs by less than its standard deviation.
    """
    return frame_of(view, leds_m, np.rint(render(view, leds_m, 0.01, samples=SAMPLES)).astype(np.uint32))


def test_gravity_is_read_in_the_axes_of_the_rig() -> None:
    """A camera turned on its rig, and two LEDs, which need gravity: its tilts are the rig's, not the camera's."""
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0)
    upright = nearly_exact(view, SIX[[0, 4]])
    for turned_deg in ((0.0, 0.0, 90.0), (20.0, -10.0, 90.0)):
        rows = tuple(map(tuple, rotation(*np.radians(turned_deg)).tolist()))
        estimate = ml(replace(upright, camera=upright.camera.model_copy(update={"R_cam_rig": rows})))
        assert estimate.covariance_m2 is not None
        error = estimate.position_m - view.position_m
        # See `nearly_exact`.
        assert error @ np.linalg.solve(estimate.covariance_m2, error) < 1.0


def test_an_led_is_used_from_a_signal_of_five_sigma_on() -> None:
    """12 LEDs of the map are dark: the noise of one in six looks like light of more than one sigma, the noise of one in
    three million like more than five. A dim one of 20 e before 40 e covers 69 px, next to some 35 px of background: its
    signal is 20 e / sqrt(60 / 69 + 40 / 35), 14 sigma, or half of it for a background with slopes, and is used.
    """
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0)
    leds_m = grid(4, 4, 0.1, TARGET)
    lit = np.zeros(16)
    lit[[0, 3, 5, 12]] = [4000.0, 4000.0, 60.0, 4000.0]
    image = poisson(render(view, leds_m, 0.01, np.where(lit > 0, lit, 40.0), samples=16), 1)
    frame = frame_of(view, leds_m, image)
    found = most_likely(frame, Pose(np.array(view.position_m), view.R_cam_world))
    assert found.leds == (10, 13, 15, 22)


def test_a_reading_of_gravity_that_the_spots_contradict_is_not_used() -> None:
    """Off by 3 deg, said to be good to 0.1 deg; six LEDs give the tilt to some hundredths of a degree."""
    view = view_of(TARGET, 3.0, 25.0, -15.0, 30.0)
    frame = nearly_exact(view, SIX)
    off = rotation(*np.radians([28.0, -15.0])) @ [0.0, 0.0, 9.80665]
    accelerometer = Accelerometer(kind="tilt-error", error_deg=0.1)
    estimate = ml(replace(frame, accelerometer_m_s2=tuple(off.tolist()), accelerometer=accelerometer))
    assert estimate.covariance_m2 is not None
    error = estimate.position_m - view.position_m
    # See `nearly_exact`.
    assert error @ np.linalg.solve(estimate.covariance_m2, error) < 1.0


WIDE_VIEW = view_of(TARGET, 3.0, 25.0, -15.0, 30.0)
TWELVE = grid(4, 3, 0.13, TARGET)


def test_reasons_tell_what_is_missing() -> None:
    """No LED in view, LEDs with unknown images, and LEDs without a usable pixel are three failures."""
    frame = nearly_exact(WIDE_VIEW, TWELVE)
    pose = Pose(np.array(WIDE_VIEW.position_m), WIDE_VIEW.R_cam_world)
    away = pose.moved(np.array([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]), frame.camera)
    leds = len(frame.leds)
    nothing, none_located = np.zeros(leds), np.zeros(leds, dtype=bool)
    with pytest.raises(EstimationFailure, match=r"^fit: no LED of the map is in view"):
        leds_in_view(frame, ImageState.as_told(away, frame.camera, leds), SURE, nothing, none_located)
    state = ImageState.as_told(pose, frame.camera, leds)
    with pytest.raises(EstimationFailure, match=r"^fit: LEDs of the map in view: 12, but the best known image to "):
        leds_in_view(frame, state, SURE, nothing + 0.1, none_located)
    full = replace(frame, parts=(Part(0, 0, np.full_like(frame.parts[0].image_dn, 2**12 - 1)),))
    full = replace(full, sensor=full.sensor.model_copy(update={"full_well_e": 1000.0}))
    with pytest.raises(EstimationFailure, match=r"^fit: no pixel of the LEDs in view is usable"):
        gather_led_pixels(full, leds_in_view(full, state, SURE, nothing, none_located))
