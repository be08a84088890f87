"""Check of a camera that states no errors (`estimator.solvers.camera_check`) by the pixels at a maximum."""

import numpy as np
from numpy.typing import NDArray

from estimator.camera.intrinsics import intrinsic_slopes_px
from estimator.camera.pose import POSE_PARAMETERS
from estimator.io.device import DeviceFrame
from estimator.pixels.led_model import MOTION_COLUMNS, SIZE_PARAMETER
from estimator.pixels.nuisances import Gravity, Priors
from estimator.pixels.search import ScoringResult
from estimator.solvers.camera_check import CameraErrors
from estimator.solvers.uncertainty import assumed_uncertainty

Floats = NDArray[np.float64]

SHIFT_TOLERANCE_PX = 3e-3
"""Displacement of an LED's image from the model's that reveals no error, beside its noise: the model's own."""
MIN_OWN_SHARE = 1e-12
"""Share of an intrinsic's information that rounding may leave where the view makes up for all of it."""


def camera_errors_by_pixels(
    frame: DeviceFrame, gravity: Gravity, priors: Priors, result: ScoringResult, information: Floats, gradient: Floats
) -> CameraErrors:
    """Errors of the intrinsics that each by itself make the images of a maximum most likely, to first order.

    `priors` are those of the result's LEDs, with a camera and a map taken as exact. `information` (p, p) and `gradient`
    (p,) are those of all images together by LOCAL_PARAMETERS and motion at the maximum; view and motion follow an error
    of the camera.
    """
    information, gradient = information.copy(), gradient.copy()
    motion = MOTION_COLUMNS[: len(priors.motion)]
    state = result.nuisances.state(result.pose, frame.camera, priors)
    tilts = [3, 4]
    information[tilts, tilts] += 1 / gravity.sigma**2
    gradient[tilts] += gravity.residual(result.pose.rig_angles(frame.camera)) / gravity.sigma
    information[motion, motion] += 1 / priors.motion**2
    gradient[motion] -= result.nuisances.standardized(priors).motion / priors.motion
    view, camera = np.concatenate([np.arange(POSE_PARAMETERS), motion]), np.arange(POSE_PARAMETERS, SIZE_PARAMETER)
    # What a change of the view makes up for says nothing of the camera.
    steps = np.linalg.solve(information[np.ix_(view, view)], information[np.ix_(view, camera)])
    own = np.diag(information)[camera] - (information[np.ix_(camera, view)] * steps.T).sum(axis=1)
    own = np.maximum(own, np.maximum(MIN_OWN_SHARE * np.diag(information)[camera], np.finfo(float).tiny))
    centres_m = priors.positions_m[result.used]
    images = state.of(result.used).project(centres_m)
    slopes_px = intrinsic_slopes_px(images.p_cam, frame.camera.normalized(images.pixels), frame.camera)
    moved2_px2 = np.maximum((slopes_px**2).sum(axis=1).mean(axis=0), np.finfo(float).tiny)
    return CameraErrors(
        found=(gradient[camera] - steps.T @ gradient[view]) / own,
        sigmas=np.sqrt(1 / own + SHIFT_TOLERANCE_PX**2 / moved2_px2),
        assumed=assumed_uncertainty(frame.camera).device_sigmas(),
        moved=-steps[:3],
    )
