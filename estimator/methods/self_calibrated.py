"""Self-calibration over a device's frames: camera, accelerometer and map are corrected by what all frames show.

Each frame is fitted by itself first, as by `gravity-fit`, which finds its pose and leaves out wrong identities. All
frames of the device are then fitted together (`estimator.solvers.self_calibration`). Only what the device states a
standard deviation for is corrected. Estimates use other frames of the same device, never the truth.

A frame keeps its own estimate where the others cannot improve it: its errors are not those stated (the map's are not
stated, and its spots show some), the device's frames contradict a camera that states no errors, its camera has a
rolling shutter, whose motion the common fit does not know, or too few of its spots agree with the device's other
frames; the last is reported as ambiguous.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.camera.leveling import MIN_TILT_SIGMA_DEG, tilt_from_gravity, tilt_sigmas
from estimator.camera.undistort import has_pinhole_image
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.camera_statement import Judged, contradicted_by, judged_by_device
from estimator.methods.gravity_fit import agreement, agreement_of, judged_by
from estimator.methods.variant import DeviceMethod, Estimate, Needs, Variant
from estimator.solvers.device_equations import DeviceView
from estimator.solvers.observations import MIN_CENTROID_SIGMA_PX, Observations, observe, observe_once
from estimator.solvers.robust_fit import Consensus
from estimator.solvers.self_calibration import adjust
from estimator.spots.correspondences import centroids_px, find_correspondences
from estimator.spots.identify import Correspondence


@dataclass(frozen=True, eq=False)
class FittedFrame:
    """A frame fitted by itself: its own estimate, `judged`, and its `view` for the common fit.

    `scale` is the factor of the stated standard deviations that its spots show; `view` is None where they show errors
    that the device does not state, and with a rolling shutter.
    """

    judged: Judged
    view: DeviceView | None
    scale: float

    @property
    def estimate(self) -> Estimate:
        """The frame's own estimate."""
        return self.judged.estimate


def fit_frame(frame: DeviceFrame) -> FittedFrame:
    """Fit a frame by itself; raises EstimationFailure."""
    correspondences = find_correspondences(frame)
    observations = observe_once(frame, correspondences)
    return _fitted(frame, correspondences, observations, agreement_of(frame, observations))


def fit_correspondences(frame: DeviceFrame, correspondences: Sequence[Correspondence]) -> FittedFrame:
    """The same from identified spots; of the frame, camera, accelerometer, luminaires and datum are used."""
    observations = observe(frame, correspondences)
    return _fitted(frame, correspondences, observations, agreement(observations))


def _fitted(
    frame: DeviceFrame, correspondences: Sequence[Correspondence], observations: Observations, agreed: Consensus
) -> FittedFrame:
    # Observations leave out the same spots.
    usable = has_pinhole_image(centroids_px(correspondences), frame.camera)
    correspondences = [one for one, use in zip(correspondences, usable, strict=True) if use]
    alone, model = judged_by(agreed), agreed.model
    # The last two: a camera that is not exact, or that nothing vouches for, counts in the covariance of a frame alone.
    unshared = observations.motion is not None or agreed.contradicted or agreed.unchecked_m2.any()
    if (model is not None and model.added_sigma_px > 0) or unshared:
        return FittedFrame(alone, None, 1.0)
    return FittedFrame(alone, _view(frame, correspondences, agreed), 1.0 if model is None else float(model.scale))


def _view(frame: DeviceFrame, correspondences: Sequence[Correspondence], agreed: Consensus) -> DeviceView:
    inliers = [one for one, use in zip(correspondences, agreed.inliers, strict=True) if use]
    stated = frame.accelerometer
    if stated is None or frame.accelerometer_m_s2 is None:
        raise EstimationFailure("leveling", "the device has no accelerometer")
    x, y, z = (frame.camera.R_cam_rig_array().T @ frame.accelerometer_m_s2).tolist()
    tilt = tilt_from_gravity((x, y, z))
    total_rad = np.radians(max(stated.error_deg, MIN_TILT_SIGMA_DEG))
    lever = tilt_sigmas(stated, tilt[1]) / total_rad
    shot_deg = stated.error_deg if stated.shot_error_deg is None else stated.shot_error_deg
    shot_rad = np.radians(max(shot_deg, MIN_TILT_SIGMA_DEG)) if agreed.gravity else np.inf
    return DeviceView(
        camera=frame.camera,
        leds=tuple(one.led for one in inliers),
        luminaires=frame.luminaires,
        datum=frame.map_datum,
        centroids_px=centroids_px(inliers),
        covariance_px2=np.array([one.spot.covariance_px2 for one in inliers]) + MIN_CENTROID_SIGMA_PX**2 * np.eye(2),
        tilt_rad=np.array(tilt),
        tilt_shot_sigma_rad=shot_rad * lever,
        tilt_device_sigma_rad=float(np.radians(stated.device_error_deg or 0.0)),
        tilt_lever=lever,
        pose=agreed.best.pose,
    )


def fit_device(frames: Sequence[FittedFrame]) -> list[Estimate | EstimationFailure]:
    """Estimates of all frames of a device together, in the order of the frames."""
    views = [frame.view for frame in frames if frame.view is not None]
    own = [frame.judged for frame in frames]
    if not views or contradicted_by(own):
        return judged_by_device(own)
    scale = float(np.median([frame.scale for frame in frames if frame.view is not None]))
    adjusted = iter(adjust(views, scale).frames)
    results: list[Estimate | EstimationFailure] = []
    for frame in frames:
        found = None if frame.view is None else next(adjusted)
        alone = frame.estimate
        if found is not None:
            joint = Estimate(found.pose.position_m, covariance_m2=found.covariance_m2, ambiguous=alone.ambiguous)
            results.append(joint)
        else:
            disagrees = frame.view is not None
            results.append(Estimate(alone.position_m, {}, alone.covariance_m2, alone.ambiguous or disagrees))
    return results


SELF_CALIBRATED = Variant.over_device(
    "self-calibrated",
    "all frames of a device at once: gravity-fit with the errors of camera, accelerometer and map as unknowns",
    DeviceMethod(fit_frame, fit_device),
    Needs(3, optional=("accelerometer", "gyroscope")),
)
