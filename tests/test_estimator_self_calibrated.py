"""The variant over all frames of a device: what it makes of a frame, and of frames that cannot take part."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from estimator_correspondences import device
from estimator_synthetic import Array, View
from test_estimator_self_calibration import (
    SIZE,
    TILT_DEVICE_RAD,
    TILT_SHOT_RAD,
    DeviceView,
    camera,
    device_views,
)

from estimator.camera.pose import Pose, rotation
from estimator.errors import EstimationFailure
from estimator.io.device import Accelerometer, DeviceFrame
from estimator.methods.self_calibrated import SELF_CALIBRATED, FittedFrame, fit_correspondences, fit_device
from estimator.methods.variant import Estimate
from estimator.spots.detect import Spot
from estimator.spots.identify import Correspondence

STATED = Accelerometer(
    kind="tilt-error",
    error_deg=float(np.degrees(np.hypot(TILT_DEVICE_RAD, TILT_SHOT_RAD))),
    device_error_deg=float(np.degrees(TILT_DEVICE_RAD)),
    shot_error_deg=float(np.degrees(TILT_SHOT_RAD)),
)


def frame_of(view: DeviceView) -> tuple[DeviceFrame, list[Correspondence]]:
    """The frame of a view as a device has it, and its identified spots."""
    x, y, z = (view.camera.R_cam_rig_array() @ rotation(*view.tilt_rad.tolist()) @ [0, 0, 9.80665]).tolist()
    frame = replace(
        device(View(*SIZE, (0.0, 0.0, 0.0)), 1.0),
        camera=view.camera,
        accelerometer=STATED,
        accelerometer_m_s2=(x, y, z),
        luminaires=view.luminaires,
        leds={led.id: led for led in view.leds},
    )
    spots = [
        Correspondence(led, Spot(u, v, covariance, u, v, 50, 1000.0, touches_border=False, saturated=False))
        for led, (u, v), covariance in zip(view.leds, view.centroids_px.tolist(), view.covariance_px2, strict=True)
    ]
    return frame, spots


def fitted(views: Sequence[DeviceView]) -> list[FittedFrame]:
    return [fit_correspondences(*frame_of(view)) for view in views]


def rms_m(estimates: Sequence[Estimate | EstimationFailure], truth_m: Array) -> float:
    errors = [one.position_m - true for one, true in zip(estimates, truth_m, strict=True) if isinstance(one, Estimate)]
    assert len(errors) == len(truth_m)
    return float(np.sqrt(np.square(errors).sum(axis=1).mean()))


def test_frames_of_a_device_improve_each_other() -> None:
    """Ten frames of one device: less than 0.6 of the errors of frames by themselves, here and by the covariances."""
    views, truth_m = device_views(np.random.default_rng(2), 10)
    frames = fitted(views)
    together, alone = fit_device(frames), [one.estimate for one in frames]
    assert rms_m(together, truth_m) < 0.6 * rms_m(alone, truth_m)
    for one, other in zip(together, alone, strict=True):
        assert isinstance(one, Estimate)
        assert one.covariance_m2 is not None
        assert other.covariance_m2 is not None
        assert np.trace(one.covariance_m2) < np.trace(other.covariance_m2)


def test_a_frame_alone_is_the_fit_by_itself() -> None:
    """The same model and the same spots: the same position, to a tenth of its standard deviation, and covariance.

    Weights are linearized at poses that differ by the convergence of either fit.
    """
    (view,), _ = device_views(np.random.default_rng(3), 1)
    (frame,) = fitted([view])
    (joint,) = fit_device([frame])
    assert isinstance(joint, Estimate)
    assert joint.covariance_m2 is not None
    assert frame.estimate.covariance_m2 is not None
    sigma_m = np.sqrt(np.diag(frame.estimate.covariance_m2))
    assert np.abs((joint.position_m - frame.estimate.position_m) / sigma_m).max() < 0.1
    assert np.sqrt(np.diag(joint.covariance_m2)) == pytest.approx(sigma_m, rel=0.05)


def test_the_accelerometer_is_read_in_the_rig_s_axes() -> None:
    """A camera turned by 90 deg about its axis on the rig: the view has the rig's tilts, whose errors are stated."""
    (view,), _ = device_views(np.random.default_rng(5), 1, exact=True)
    turned = view.camera.model_copy(update={"R_cam_rig": ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))})
    # The image is that of the former pose; the rig is turned the other way instead.
    (before,) = fitted([view])
    rig_tilt = Pose(np.zeros(3), turned.R_cam_rig_array().T @ rotation(*view.tilt_rad.tolist())).R_cam_world[:, 2]
    tilt = np.array([np.arctan2(rig_tilt[1], rig_tilt[2]), -np.arcsin(rig_tilt[0])])
    (after,) = fitted([replace(view, camera=turned, tilt_rad=tilt)])
    assert before.view is not None
    assert after.view is not None
    assert after.view.tilt_rad == pytest.approx(tilt, abs=1e-12)
    assert after.view.pose.rig_angles(turned)[:2] == pytest.approx(tilt, abs=1e-6)
    assert after.view.tilt_shot_sigma_rad == pytest.approx(np.full(2, TILT_SHOT_RAD))
    assert after.view.tilt_device_sigma_rad == pytest.approx(TILT_DEVICE_RAD)
    (one,), (other,) = fit_device([before]), fit_device([after])
    assert isinstance(one, Estimate)
    assert isinstance(other, Estimate)
    assert one.position_m == pytest.approx(other.position_m, abs=1e-6)


def test_an_accelerometer_that_states_no_device_error_is_new_in_each_frame() -> None:
    (view,), _ = device_views(np.random.default_rng(6), 1)
    frame, spots = frame_of(view)
    plain = replace(frame, accelerometer=Accelerometer(kind="tilt-error", error_deg=0.3))
    found = fit_correspondences(plain, spots).view
    assert found is not None
    assert found.tilt_device_sigma_rad == 0.0
    assert found.tilt_shot_sigma_rad == pytest.approx(np.full(2, np.radians(0.3)))
    part = replace(frame, accelerometer=Accelerometer(kind="imu", error_deg=0.3))
    across = fit_correspondences(part, spots).view
    assert across is not None
    # Of a part the tilt about x errs more, by 1 / cos(tilt_y).
    assert across.tilt_shot_sigma_rad == pytest.approx(np.radians(0.3) / np.array([np.cos(view.tilt_rad[1]), 1.0]))


def test_a_frame_that_shows_errors_which_are_not_stated_keeps_its_own_estimate() -> None:
    """A map that is 10 mm off an LED where nothing is stated: no frame's errors are learnt, and none is lost."""
    views, _ = device_views(np.random.default_rng(7), 3, exact=True)
    rng = np.random.default_rng(8)
    silent = []
    for view in views:
        leds = tuple(
            led.model_copy(
                update={
                    "luminaire": None,
                    "sigma_m": None,
                    "position_m": tuple((np.array(led.position_m) + 0.01 * rng.standard_normal(3)).tolist()),
                }
            )
            for led in view.leds
        )
        known = camera().model_copy(update={"uncertainty": None})
        silent.append(replace(view, leds=leds, luminaires={}, camera=known))
    frames = fitted(silent)
    assert [one.view for one in frames] == [None] * 3
    assert [one.position_m.tolist() for one in fit_device(frames) if isinstance(one, Estimate)] == [
        one.estimate.position_m.tolist() for one in frames
    ]


def test_a_frame_that_disagrees_with_the_device_keeps_its_own_estimate_as_ambiguous() -> None:
    """The spots of one frame are mixed after it was fitted: its own estimate is good, and no other frame agrees."""
    views, _ = device_views(np.random.default_rng(9), 8)
    frames = fitted(views)
    assert frames[0].view is not None
    wrong = frames[0].view
    shuffled = np.random.default_rng(1).permutation(wrong.centroids_px)
    frames[0] = replace(frames[0], view=replace(wrong, centroids_px=shuffled))
    found = fit_device(frames)
    assert [one.ambiguous for one in found if isinstance(one, Estimate)] == [True] + [False] * 7
    assert isinstance(found[0], Estimate)
    assert found[0].position_m.tolist() == frames[0].estimate.position_m.tolist()


def test_the_variant_says_that_it_uses_a_device() -> None:
    assert SELF_CALIBRATED.of_device is not None
    assert fit_device([]) == []
