"""Maximum likelihood with a rolling shutter: pictures with a pose for every line, and LEDs whose light has gains."""

from dataclasses import replace

import numpy as np
import pytest
from estimator_correspondences import EXACT
from estimator_rolling import Gain, rolling_picture
from estimator_synthetic import Array, View, description, grid, view_of
from numpy.typing import NDArray
from scipy.stats import chi2
from test_estimator_shutter_motion import LEDS, SENSOR, drawn_velocity, drawn_view, moving_pixels, with_shutter

import estimator as est
from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.camera.rolling_projection import project_rolling
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.io.shutter import GLOBAL
from estimator.methods.gravity_fit import gravity_fit
from estimator.methods.maximum_likelihood import Maximum, maximize, ml
from estimator.pixels.initial import Start, gravity_of
from estimator.pixels.nuisances import Nuisances, Priors
from estimator.receiver.receive import receive_frames

TARGET = (3.5, 3.6, 3.5)
SIZE = (400, 300, 1500.0)
ROW_TIME_US = 100.0
"""300 lines are then read in 30 ms, as 3000 lines of 10 us are, and the image moves by as much of a line in a line."""
SAMPLES = 48
ERROR_DEG = 0.5
CHIP_LINES, EXPOSED_LINES = 2.5, 4.0
CODE = np.array([int(chip) for chip in "01101001110010110001011101001101"])


def frame_of(
    view: View,
    leds_m: Array,
    image_dn: NDArray[np.uint32],
    radius_m: float,
    row_time_us: float,
    tilts_deg: Array,
    gyro: tuple[Array, float] | None = None,
    downlink: dict[str, object] | None = None,
) -> DeviceFrame:
    """A frame by the public `estimator.frame`: rolling downwards, tilts read with errors, a gyroscope if any."""
    record = description(view, 1, leds_m, radius_m)
    cameras = record["cameras"]
    assert isinstance(cameras, dict)
    shutter = {"kind": "rolling", "row_time_us": row_time_us, "direction": "down"}
    held = replace(view, tilt_x_deg=view.tilt_x_deg + tilts_deg[0], tilt_y_deg=view.tilt_y_deg + tilts_deg[1])
    pixels = view.project(leds_m)
    inside = np.flatnonzero(((pixels > 0) & (pixels < SIZE[:2])).all(axis=1)).tolist()
    spots = [{"led": 10 + k, "u_px": pixels[k, 0], "v_px": pixels[k, 1]} for k in inside]
    return est.frame(
        {
            **record,
            "camera": {**cameras["main"], "shutter": shutter, "uncertainty": EXACT.model_dump()},
            "accelerometer": {"kind": "tilt-error", "error_deg": ERROR_DEG},
            "exposure_s": EXPOSED_LINES * row_time_us * 1e-6,
            "accelerometer_m_s2": held.gravity_m_s2,
            "spots": [] if downlink else spots,
            "parts": [{"row": 0, "column": 0, "image_dn": image_dn}],
            "gyro_rad_s": None if gyro is None else gyro[0],
            "gyroscope": None if gyro is None else {"noise_rad_s": gyro[1], "bias_rad_s": 0.0},
            "downlink": downlink,
        }
    )


def normalised(error: Array, covariance_m2: Array | None) -> float:
    assert covariance_m2 is not None
    return float(error @ np.linalg.solve(covariance_m2, error))


def interval(freedom: int) -> tuple[float, float]:
    """The 99.9 % interval of chi2."""
    return float(chi2.isf(0.9995, freedom)), float(chi2.isf(0.0005, freedom))


@pytest.mark.parametrize("direction", ["down", "up", "right", "left"])
def test_points_are_seen_where_their_line_is_exposed(direction: str) -> None:
    """The same solution as by ten substitutions, to 1e-9 px of rounding of pixels of 4000, and its derivatives: the
    steps of 1e-6 leave third derivatives of some 1e5 px times 1e-12 and rounding of 1e-12 / 1e-6, of 15 000 px a rad.
    """
    rng = np.random.default_rng(1)
    view, velocity = drawn_view(rng), drawn_velocity(rng, 20.0)
    frame = with_shutter(frame_of(view_of(TARGET, 3.0), grid(1, 1, 1.0, TARGET), EMPTY, 0.01, 10.0, np.zeros(2)))
    shutter = frame.camera.shutter.model_copy(update={"direction": direction})
    K = tuple(map(tuple, view.K.tolist()))
    camera = frame.camera.model_copy(update={"shutter": shutter, "K": K, "width_px": 4000, "height_px": 3000})
    pose = Pose(np.array(view.position_m), view.R_cam_world)
    seen = project_rolling(LEDS, pose, camera, velocity)
    np.testing.assert_allclose(seen.pixels, moving_pixels(view, LEDS, velocity, direction), atol=1e-6)
    assert seen.motion_slopes is not None
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        after, before = (
            project_rolling(LEDS, pose.moved(sign * step, camera), camera, velocity).pixels for sign in (1, -1)
        )
        np.testing.assert_allclose(seen.slopes[:, :, k], (after - before) / 2e-6, atol=0.02)
        after, before = (project_rolling(LEDS, pose, camera, velocity + sign * step).pixels for sign in (1, -1))
        np.testing.assert_allclose(seen.motion_slopes[:, :, k], (after - before) / 2e-6, atol=0.02)
    assert seen.slopes.shape[2] == POSE_PARAMETERS
    assert SENSOR[2] == camera.K[0][0]


EMPTY = np.zeros((SIZE[1], SIZE[0]), dtype=np.uint32)
SIX = grid(3, 2, 0.14, TARGET)


@pytest.mark.slow
@pytest.mark.parametrize("gyro", [False, True])
def test_errors_in_motion_agree_with_the_covariance(gyro: bool) -> None:
    """20 deg/s and some 5 cm/s: chi2 of three degrees a draw, within its 99.9 % interval."""
    rng, draws = np.random.default_rng([2, gyro]), 12
    nees, squares = 0.0, []
    for _ in range(draws):
        view = view_of(TARGET, 3.0, *rng.uniform(-25, 25, 2), rng.uniform(0, 360), size=SIZE)
        velocity, sigma = drawn_velocity(rng, 20.0), np.radians(0.3)
        expected = rolling_picture(view, SIX, 0.01, velocity, ROW_TIME_US * 1e-6, samples=SAMPLES)
        reading = (velocity[:3] + sigma * rng.normal(size=3), float(sigma)) if gyro else None
        off_deg = ERROR_DEG * rng.normal(size=2)
        image = rng.poisson(expected).astype(np.uint32)
        frame = frame_of(view, SIX, image, 0.01, ROW_TIME_US, off_deg, reading)
        found = ml(frame)
        error = found.position_m - view.position_m
        nees += normalised(error, found.covariance_m2)
        squares.append(error @ error)
    low, high = interval(3 * draws)
    assert low < nees < high
    # Ignored, 8 px of motion at the border displace a position by centimetres.
    assert np.sqrt(np.mean(squares)) < 0.03


@pytest.mark.slow
def test_motion_that_is_ignored_is_not_explained() -> None:
    """The same picture and a shutter said to be global: centimetres, or no estimate; with the shutter, millimetres."""
    rng = np.random.default_rng(4)
    leds = grid(4, 3, 0.12, TARGET)
    view = view_of(TARGET, 3.0, 12.0, -18.0, 70.0, size=SIZE)
    velocity = np.array([*np.radians([12.0, -14.0, 8.0]), 0.03, -0.05, 0.02])
    image = rng.poisson(rolling_picture(view, leds, 0.01, velocity, ROW_TIME_US * 1e-6)).astype(np.uint32)
    frame = frame_of(view, leds, image, 0.01, ROW_TIME_US, np.zeros(2))
    still = replace(frame, camera=frame.camera.model_copy(update={"shutter": GLOBAL}))
    rolls = np.linalg.norm(ml(frame).position_m - view.position_m)
    try:
        ignored = np.linalg.norm(ml(still).position_m - view.position_m)
    except EstimationFailure:
        ignored = np.inf
    assert rolls < 0.02 < ignored


def gain_of(code: Array, start_chips: float) -> Gain:
    """Gains of a code of chips 2 and 0, exact: the mean over the exposure of each line, by the integral of the wave."""
    ends = np.concatenate([[0.0], np.cumsum(2.0 * code)])
    period = len(code)

    def integral(chips: Array) -> Array:
        whole = np.floor(chips / period)
        return np.asarray(whole * ends[-1] + np.interp(chips - whole * period, np.arange(period + 1), ends))

    def gains(lines: Array) -> Array:
        first = start_chips + np.asarray(lines, dtype=float) / CHIP_LINES
        during = EXPOSED_LINES / CHIP_LINES
        return (integral(first + during) - integral(first)) / during

    return gains


def found_with_gains(frame: DeviceFrame, view: View) -> Maximum:
    """The maximum from a pose half a millimetre off."""
    priors = Priors.of(frame)
    start = Pose(np.array(view.position_m) + [5e-4, -5e-4, 5e-4], view.R_cam_world)
    unlocated = np.zeros(len(frame.leds), dtype=bool)
    return maximize(
        frame, gravity_of(frame), priors, Start(start, Nuisances.zero(priors), 1e-12 * np.eye(12), unlocated)
    )


@pytest.mark.slow
def test_known_gains_are_as_good_as_steady_light() -> None:
    """LEDs that send codes, phases told with errors of half a line: errors agree with the covariance, of six LEDs used;
    the same LEDs steady have a standard deviation that is smaller by a tenth at most (half of the lines are dim, half
    twice as bright: shot noise is about that of the mean).
    """
    rng, draws, nees = np.random.default_rng(5), 5, 0.0
    rest = np.zeros(6)
    for _ in range(draws):
        view = view_of(TARGET, 3.0, *rng.uniform(-25, 25, 2), rng.uniform(0, 360), size=SIZE)
        codes, phases = [rng.permutation(CODE) for _ in SIX], rng.uniform(0, len(CODE), len(SIX))
        gains = [gain_of(code, phase) for code, phase in zip(codes, phases, strict=True)]
        told = phases + 0.5 * rng.normal(size=len(SIX)) / CHIP_LINES
        expected = rolling_picture(view, SIX, 0.04, rest, 1e-5, led_e=2000.0, samples=32, gains=gains)
        image = rng.poisson(expected).astype(np.uint32)
        still = (np.zeros(3), 0.0)
        frame = frame_of(view, SIX, image, 0.04, 10.0, ERROR_DEG * rng.normal(size=2), still)
        known = {10 + k: gain_of(code, phase) for k, (code, phase) in enumerate(zip(codes, told, strict=True))}
        found = found_with_gains(replace(frame, gains=known), view)
        assert len(found.leds) == len(SIX)
        nees += normalised(found.pose.position_m - view.position_m, found.covariance[:3, :3])
    # A hand's speed of 5 cm/s is part of the covariance, and here it is 0: no lower limit.
    assert nees < interval(3 * draws)[1]
    assert found_with_gains(frame, view).model_is_wrong  # taken as steady


@pytest.mark.slow
def test_codes_from_pixels_to_a_position() -> None:
    """From a picture of LEDs that send codes, no identity told: the receiver decodes, `ml` uses its gains."""
    rng = np.random.default_rng(6)
    leds, radius_m = grid(3, 2, 0.2, TARGET), 0.08
    view = view_of(TARGET, 2.6, 8.0, -10.0, 20.0, size=SIZE)
    codes, phases = [rng.permutation(CODE) for _ in leds], rng.uniform(0, len(CODE), len(leds))
    gains = [gain_of(code, phase) for code, phase in zip(codes, phases, strict=True)]
    velocity = np.array([*np.radians([9.0, -7.0, 5.0]), 0.03, -0.02, 0.04])
    expected = rolling_picture(view, leds, radius_m, velocity, 1e-5, led_e=2000.0, samples=32, gains=gains)
    transmitter: dict[str, object] = {
        **{"send": "code", "chip_us": CHIP_LINES * 10.0, "depth": 1.0, "clock_error": 1e-5},
        "leds": [10 + k for k in range(len(leds))],
        "codes": ["".join(str(chip) for chip in code) for code in codes],
    }
    downlink: dict[str, object] = {"demodulation": "pixels", "transmitters": [transmitter]}
    frame = frame_of(view, leds, rng.poisson(expected).astype(np.uint32), radius_m, 10.0, np.zeros(2), None, downlink)
    (received,) = receive_frames([frame])
    assert sorted(spot.led for spot in received.spots) == [10 + k for k in range(len(leds))]
    for method in (gravity_fit, ml):
        found = method(received)
        error = found.position_m - view.position_m
        assert normalised(error, found.covariance_m2) < chi2.isf(1e-4, 3)
