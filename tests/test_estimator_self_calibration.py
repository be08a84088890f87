"""Self-calibration held against dense least squares, finite differences, and errors drawn as they are stated."""

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from estimator_correspondences import POINT_M
from estimator_synthetic import Array, View, description, view_of
from scipy.spatial.transform import Rotation

from estimator.camera.intrinsics import intrinsic_slopes_px, with_errors
from estimator.camera.pose import Pose
from estimator.camera.projection import project
from estimator.evaluate.statistics import Groups, nees
from estimator.io.camera import INTRINSICS, Camera
from estimator.io.led_map import DiscLed, Luminaire, MapDatum
from estimator.solvers.device_equations import DeviceEquations, DeviceView, Unknowns
from estimator.solvers.self_calibration import Adjusted, Adjustment, adjust

SIZE = (1600, 1200, 3000.0)
SIGMA_PX = 0.02
# Of the device and of a frame: focal, aspect, cx, cy, k1, p1, p2.
DEVICE = (1e-3, 1e-4, 2.0, 2.0, 5e-3, 1e-4, 1e-4)
SHOT = (3e-4, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0)
LUMINAIRE_M, LUMINAIRE_DEG, LED_M = 3e-3, 0.2, 3e-4
TILT_DEVICE_RAD, TILT_SHOT_RAD = np.radians(0.3), np.radians(0.05)


def camera(device: Sequence[float] = DEVICE, shot: Sequence[float] = SHOT) -> Camera:
    entry = description(View(*SIZE, (0.0, 0.0, 0.0)), 1, np.zeros((0, 3)), 0.01)["cameras"]["main"]  # type: ignore[index]
    stated = {"offset_sigma_m": 0.0, "rotation_sigma_deg": 0.0, "parameters": list(INTRINSICS)}
    entry["uncertainty"] = {**stated, "device_sigma": list(device), "shot_sigma": list(shot)}
    return Camera.model_validate_json(json.dumps(entry))


def building(times: float = 1.0) -> tuple[dict[int, Luminaire], dict[int, DiscLed]]:
    """Four luminaires of nine LEDs each, 0.9 m apart at 3 m; the stated sigmas are `times` those of the constants."""
    luminaires, leds = {}, {}
    for number in range(4):
        centre = np.array([0.9 * (number % 2), 0.9 * (number // 2), 3.0 + 0.1 * number])
        luminaires[number] = Luminaire(
            id=number,
            position_m=tuple(centre.tolist()),
            sigma_m=(LUMINAIRE_M * times,) * 3,
            sigma_rotation_deg=(LUMINAIRE_DEG * times,) * 3,
        )
        for k in range(9):
            place = centre + [0.15 * (k % 3 - 1), 0.15 * (k // 3 - 1), 0.0]
            leds[9 * number + k] = DiscLed(
                id=9 * number + k,
                position_m=tuple(place.tolist()),
                radius_m=POINT_M,
                luminaire=number,
                sigma_m=(LED_M * times,) * 3,
            )
    return luminaires, leds


def poses(count: int, rng: np.random.Generator) -> list[Pose]:
    """Views of one or two luminaires, from 2.5 m below, tilted by up to 40 deg and turned."""
    found = []
    for _ in range(count):
        target = (*rng.uniform(-0.1, 1.0, 2), 3.0)
        view = view_of(target, 2.5, *rng.uniform(-40, 40, 2), rng.uniform(0, 360), size=SIZE)
        found.append(Pose(np.array(view.position_m), view.R_cam_world))
    return found


def as_built(rng: np.random.Generator) -> dict[int, Array]:
    """True positions of the LEDs, drawn about the stated ones."""
    luminaires, leds = building()
    moved = {
        one: (
            LUMINAIRE_M * rng.standard_normal(3),
            Rotation.from_rotvec(np.radians(LUMINAIRE_DEG) * rng.standard_normal(3)),
        )
        for one in luminaires
    }
    found = {}
    for key, led in leds.items():
        centre = np.array(luminaires[led.luminaire or 0].position_m)
        shift, turn = moved[led.luminaire or 0]
        found[key] = centre + shift + turn.apply(led.position_m - centre) + LED_M * rng.standard_normal(3)
    return found


def device_views(
    rng: np.random.Generator, count: int, times: float = 1.0, exact: bool = False
) -> tuple[list[DeviceView], Array]:
    """Frames of one device in one building, and their true positions (count, 3).

    Errors have the sigmas of the constants, the stated ones are `times` those. `exact`: without any error.
    """
    luminaires, leds = building(times)
    size = 0.0 if exact else 1.0
    truth = {key: np.array(led.position_m) for key, led in leds.items()} if exact else as_built(rng)
    places = np.array(list(truth.values()))
    told = camera(np.multiply(DEVICE, times).tolist(), np.multiply(SHOT, times).tolist())
    of_device = size * rng.standard_normal(7) * DEVICE
    bias = size * TILT_DEVICE_RAD * rng.standard_normal(2)
    views, positions_m = [], []
    for pose in poses(count, rng):
        pixels = project(places, pose, with_errors(told, of_device + size * rng.standard_normal(7) * SHOT)).pixels
        seen = ((pixels > 5) & (pixels < np.array(SIZE[:2]) - 5)).all(axis=1)
        n = int(seen.sum())
        tilt = pose.rig_angles(told)[:2] + bias + size * TILT_SHOT_RAD * rng.standard_normal(2)
        views.append(
            DeviceView(
                camera=told,
                leds=tuple(led for led, use in zip(leds.values(), seen, strict=True) if use),
                luminaires=luminaires,
                datum=None,
                centroids_px=pixels[seen] + size * SIGMA_PX * rng.standard_normal((n, 2)),
                covariance_px2=np.tile(SIGMA_PX**2 * np.eye(2), (n, 1, 1)),
                tilt_rad=tilt,
                tilt_shot_sigma_rad=np.full(2, TILT_SHOT_RAD * times),
                tilt_device_sigma_rad=float(TILT_DEVICE_RAD * times),
                tilt_lever=np.ones(2),
                pose=Pose(pose.position_m + rng.normal(0, 0.01, 3), pose.R_cam_world),
            )
        )
        positions_m.append(pose.position_m)
    return views, np.array(positions_m)


def errors_m(found: Sequence[Adjusted | None], truth_m: Array) -> Array:
    return np.array([one.pose.position_m - true for one, true in zip(found, truth_m, strict=True) if one is not None])


def squares(found: Sequence[Adjusted | None], truth_m: Array) -> list[float]:
    """`e^T C^-1 e` of each frame."""
    covariances = [one.covariance_m2 for one in found if one is not None]
    return [float(e @ np.linalg.solve(c, e)) for e, c in zip(errors_m(found, truth_m), covariances, strict=True)]


def each_alone(views: Sequence[DeviceView]) -> list[Adjusted | None]:
    return [adjust([view]).frames[0] for view in views]


def test_exact_frames_give_their_poses_and_no_error_of_the_device(rng: np.random.Generator) -> None:
    """From 1 cm beside them; rounding of 1e-12 px is nothing beside 10 nm. Every unknown is zero to 1e-4 sigma."""
    views, truth_m = device_views(rng, 6, exact=True)
    found = adjust(views)
    assert np.abs(errors_m(found.frames, truth_m)).max() < 1e-8
    assert found.chi2 < 1e-6
    assert all(abs(value) < 1e-4 * stated(name) for name, (value, _) in found.unknowns.items())


def stated(name: tuple[str, int, int]) -> float:
    kind, _, component = name
    return {
        "camera": DEVICE[component] if kind == "camera" else 0.0,
        "gravity": TILT_DEVICE_RAD,
        "luminaire": LUMINAIRE_M if component < 3 else np.radians(LUMINAIRE_DEG),
        "led": LED_M,
    }[kind]


def test_slopes_by_every_unknown_are_differences_of_the_residuals(rng: np.random.Generator) -> None:
    """Central differences: of 1e-4 sigma of common unknowns, 1e-6 m and rad of the pose.

    Their own error is the third derivative times the step squared, some 1e-8 of a slope, and rounding, 1e-11 px over
    steps that move a spot by 1e-6 px or more. The slopes by a turned luminaire's rotation are exact to half its
    rotation: three times 0.3 sigma of 0.2 deg is 3e-3 rad, so 1.6e-3.
    """
    (view, other), _ = device_views(rng, 2)
    view = replace(view, datum=MapDatum(sigma_m=(1e-3, 1e-3, 1e-3), scale_sigma_ppm=200.0))
    other = replace(other, leds=view.leds, centroids_px=view.centroids_px, covariance_px2=view.covariance_px2)
    unknowns = Unknowns([view, other], {})
    frame = DeviceEquations(view, unknowns)
    shot = 0.5 * np.array(SHOT)
    common = 0.3 * rng.standard_normal(unknowns.count)
    line = frame.linear(view.pose, shot, common, frame.residuals(view.pose, shot, common))

    def slope(pose_step: Array, shot_step: Array, common_step: Array, size: float) -> Array:
        ends = [
            frame.residuals(
                view.pose.moved(sign * pose_step, view.camera), shot + sign * shot_step, common + sign * common_step
            )
            for sign in (1, -1)
        ]
        return (ends[0] - ends[1]) / (2 * size)

    own = [slope(1e-6 * np.eye(6)[k], np.zeros(7), 0 * common, 1e-6) for k in range(6)]
    own += [slope(np.zeros(6), 1e-4 * SHOT[k] * np.eye(7)[k], 0 * common, 1e-4 * SHOT[k]) for k in frame.shot_places]
    J = -np.array(own).T
    K = -np.array([slope(np.zeros(6), np.zeros(7), 1e-4 * row, 1e-4) for row in np.eye(unknowns.count)]).T
    assert {kind for kind, _, _ in unknowns.names} == {"camera", "gravity", "luminaire", "led", "datum"}
    inverse = np.linalg.pinv(J)
    G = inverse @ K[:, line.columns]
    scale = np.sqrt(np.diag(line.own))[:, None]
    assert line.G / scale == pytest.approx(G / scale, rel=1e-3, abs=2e-3 * np.abs(G / scale).max())
    rows = K[:, line.columns] - J @ G
    assert line.rows == pytest.approx(rows, abs=2e-3 * np.abs(K).max())
    assert line.own == pytest.approx(inverse @ inverse.T, rel=1e-3, abs=1e-3 * float(np.abs(line.own).min()))


def test_a_frame_by_itself_has_the_covariance_of_generalised_least_squares(rng: np.random.Generator) -> None:
    """All errors in the weights: C = centroids + J S J^T, dense, with gravity's (device and shot) and the pose alone.

    The elimination by QR and by the common unknowns gives the same, but for the errors found, see below.
    """
    (view,), _ = device_views(rng, 1)
    found = adjust([view]).frames[0]
    assert found is not None
    twice = Unknowns([view, view], {})  # so that each LED is an unknown
    frame = DeviceEquations(replace(view, pose=found.pose), twice)
    at = project(frame.told_m, found.pose, view.camera)
    by_camera = intrinsic_slopes_px(at.p_cam, view.camera.normalized(at.pixels), view.camera)
    n = len(view.leds)
    everything = frame._by_common(at.slopes, by_camera, np.zeros(twice.count)).reshape(2 * n, -1)[:, frame.present]
    known = everything * twice.sigma[frame.columns]
    shots = by_camera.reshape(2 * n, 7) * np.array(SHOT)
    C = np.zeros((2 * n + 2, 2 * n + 2))
    C[: 2 * n, : 2 * n] = SIGMA_PX**2 * np.eye(2 * n) + known @ known.T + shots @ shots.T
    C[2 * n :, 2 * n :] = (TILT_DEVICE_RAD**2 + TILT_SHOT_RAD**2) * np.eye(2)
    J = np.vstack([at.slopes.reshape(2 * n, 6), np.eye(6)[3:5]])
    dense = np.linalg.inv(J.T @ np.linalg.solve(C, J))[:3, :3]
    # The errors found are some sigma, and change slopes by 1e-3 of themselves.
    assert found.covariance_m2 == pytest.approx(dense, rel=1e-2, abs=1e-2 * float(np.diag(dense).min()))


def test_two_frames_have_the_covariance_of_one_dense_system(rng: np.random.Generator) -> None:
    """Every unknown of both frames in one matrix, without elimination, at the poses found."""
    views, _ = device_views(rng, 2)
    found = adjust(views)
    unknowns = Unknowns(views, {})
    sizes = [6 + 3, 6 + 3, unknowns.count]  # focal length and principal point change with each frame
    total = np.diag([*np.zeros(18), *np.ones(unknowns.count)])
    for k, (view, one) in enumerate(zip(views, found.frames, strict=True)):
        assert one is not None
        frame = DeviceEquations(replace(view, pose=one.pose), unknowns)
        at = project(frame.told_m, one.pose, view.camera)
        by_camera = intrinsic_slopes_px(at.p_cam, view.camera.normalized(at.pixels), view.camera)
        n = len(view.leds)
        A = np.zeros((2 * n + 2 + 3, sum(sizes)))
        first = 9 * k
        spots = frame.whitening
        whiten = lambda M, spots=spots, n=n: np.einsum("nij,njk->nik", spots, M).reshape(2 * n, -1)  # noqa: E731
        A[: 2 * n, first : first + 6] = whiten(at.slopes)
        A[: 2 * n, first + 6 : first + 9] = whiten(by_camera[:, :, [0, 2, 3]])
        shared = whiten(frame._by_common(at.slopes, by_camera, np.zeros(unknowns.count)))[:, frame.present]
        A[: 2 * n, 18 + frame.columns] = shared * unknowns.sigma[frame.columns]
        A[2 * n : 2 * n + 2, first + 3 : first + 5] = np.eye(2) / TILT_SHOT_RAD
        gravity = unknowns.places("gravity", 0, 2)
        A[2 * n : 2 * n + 2, 18 + gravity] = np.eye(2) * TILT_DEVICE_RAD / TILT_SHOT_RAD
        A[2 * n + 2 :, first + 6 : first + 9] = np.diag(1 / np.array(SHOT)[[0, 2, 3]])
        total += A.T @ A
    scale = 1 / np.sqrt(np.diag(total))
    dense = scale[:, None] * np.linalg.inv(total * scale[:, None] * scale) * scale
    for k, one in enumerate(found.frames):
        assert one is not None
        expected = dense[9 * k : 9 * k + 3, 9 * k : 9 * k + 3]
        assert one.covariance_m2 == pytest.approx(expected, rel=2e-2, abs=2e-2 * float(np.diag(expected).min()))


def test_the_datum_s_uncertainty_is_the_position_s(rng: np.random.Generator) -> None:
    """No residual shows a shift of the whole map: its variance adds to that of every position, and moves none."""
    views, _ = device_views(rng, 3)
    before = adjust(views).frames
    sigma_m = (1e-3, 2e-3, 3e-3)
    after = adjust([replace(one, datum=MapDatum(sigma_m=sigma_m, scale_sigma_ppm=0.0)) for one in views])
    for one, other in zip(before, after.frames, strict=True):
        assert one is not None
        assert other is not None
        added = other.covariance_m2 - one.covariance_m2
        assert added == pytest.approx(np.diag(np.square(sigma_m)), abs=1e-8)
        # Converged to a thousandth of a standard deviation, 10 um.
        assert other.pose.position_m == pytest.approx(one.pose.position_m, abs=1e-5)
    for component, sigma in enumerate(sigma_m):
        value, spread = after.unknowns["datum", 0, component]
        assert abs(value) < 1e-3 * sigma
        assert spread == pytest.approx(sigma, rel=1e-6)


def test_without_stated_errors_each_frame_is_by_itself(rng: np.random.Generator) -> None:
    views, _ = device_views(rng, 3, exact=True)
    known = camera((0.0,) * 7, (0.0,) * 7)
    noisy = [
        replace(
            view,
            camera=known,
            luminaires={},
            leds=tuple(led.model_copy(update={"luminaire": None, "sigma_m": None}) for led in view.leds),
            tilt_device_sigma_rad=0.0,
            centroids_px=view.centroids_px + rng.normal(0, SIGMA_PX, view.centroids_px.shape),
        )
        for view in views
    ]
    together = adjust(noisy)
    assert together.unknowns == {}
    for one, alone in zip(together.frames, each_alone(noisy), strict=True):
        assert one is not None
        assert alone is not None
        assert one.pose.position_m == pytest.approx(alone.pose.position_m, abs=1e-8)
        assert one.covariance_m2 == pytest.approx(alone.covariance_m2, rel=1e-6)


@pytest.fixture(scope="module")
def ten_devices() -> list[tuple[list[Adjusted | None], Adjustment, Array]]:
    """Of ten devices in buildings of their own 12 frames each: by themselves, together, and the true positions."""
    rng = np.random.default_rng(4)
    drawn = [device_views(rng, 12) for _ in range(10)]
    return [(each_alone(views), adjust(views), truth_m) for views, truth_m in drawn]


@pytest.mark.slow
def test_frames_together_are_better_and_as_sure_as_they_say(
    ten_devices: list[tuple[list[Adjusted | None], Adjustment, Array]],
) -> None:
    """Covariances hold, of frames by themselves and together (99 % by devices); the errors are less than half."""
    device = [k for k, (_, _, truth_m) in enumerate(ten_devices) for _ in truth_m]
    groups = Groups.of(device, device)
    for found in (
        [one for alone, _, truth_m in ten_devices for one in squares(alone, truth_m)],
        [one for _, together, truth_m in ten_devices for one in squares(together.frames, truth_m)],
    ):
        judged = nees(found, groups)
        assert judged is not None
        assert judged.within
    rms = [
        np.sqrt(np.mean([np.square(errors_m(frames, truth_m)).sum(axis=1) for frames, truth_m in pairs]))
        for pairs in (
            [(alone, truth_m) for alone, _, truth_m in ten_devices],
            [(together.frames, truth_m) for _, together, truth_m in ten_devices],
        )
    ]
    assert rms[1] < 0.5 * rms[0]


def test_a_wrong_spot_that_one_frame_cannot_see_is_found(rng: np.random.Generator) -> None:
    """A spot moved by 2 px, as if its LED were 1.7 mm off: six sigma of a frame's LED errors, and 100 of its noise."""
    views, truth_m = device_views(rng, 8)
    moved = views[3].centroids_px.copy()
    moved[0] += [2.0, 0.0]
    views[3] = replace(views[3], centroids_px=moved)
    found = adjust(views)
    used = [one.used for one in found.frames if one is not None]
    assert len(used) == 8
    assert not used[3][0]
    assert sum(int((~one).sum()) for one in used) == 1
    assert max(squares(found.frames, truth_m)) < 30.7  # exceeded once in a million by chi-square with three degrees


@pytest.mark.slow
@pytest.mark.parametrize("times", [1 / 3, 3.0])
def test_stated_errors_that_are_off_by_three_are_corrected(times: float) -> None:
    """LEDs: 108 numbers, of which some 70 are determined: their scale has a relative sigma of sqrt(1 / (2 x 70)).

    It is 0.085, so that a factor of 3 is found to 0.3 of itself. The positions keep 15 % of their errors.
    """
    rng = np.random.default_rng(7)
    stated_well, truth_m = device_views(rng, 10)
    stated_badly, _ = device_views(np.random.default_rng(7), 10, times)
    right, wrong = adjust(stated_well), adjust(stated_badly)
    assert right.scales["led"] == 1.0
    assert times * wrong.scales["led"] == pytest.approx(1.0, rel=0.3)
    rms = [float(np.sqrt(np.square(errors_m(one.frames, truth_m)).mean())) for one in (right, wrong)]
    assert rms[1] < 1.15 * rms[0]


@pytest.mark.slow
def test_a_frame_with_nothing_but_wrong_spots_is_left_out(rng: np.random.Generator) -> None:
    """The others are not harmed: they stay within six sigma a coordinate."""
    views, truth_m = device_views(rng, 8)
    shuffled = rng.permutation(views[2].centroids_px)
    views[2] = replace(views[2], centroids_px=shuffled)
    found = adjust(views)
    assert found.frames[2] is None
    others = [k for k in range(8) if k != 2]
    kept = [found.frames[k] for k in others]
    assert None not in kept
    assert max(squares(kept, truth_m[others])) < 40
