"""Maximum likelihood: the pose under which the pixels of all LED images together are most likely.

Every LED of the map that should be in view is rendered (`estimator.pixels.led_model`) under the pose: position, tilt_x,
tilt_y, yaw. Electrons are Poisson distributed about their expectation (`estimator.pixels.likelihood`); the
accelerometer's reading is normally distributed about the true tilts. Fisher scoring maximizes the likelihood: the
weights are computed anew at every step, and the inverse of the information is the covariance, which is the Cramer-Rao
bound if the model is true.

Not modelled: gradients of the background across an LED, light of other sources, the dependence of an LED's luminance on
direction, mechanical vignetting (natural vignetting is modelled), and motion. LEDs that the model does not explain are
excluded by their goodness of fit.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.camera.leveling import tilt_from_gravity, tilt_sigmas
from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.camera.projection import project
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.gravity_fit import agreement, ambiguous
from estimator.methods.up2p import upright_pose
from estimator.methods.variant import Estimate, Variant
from estimator.pixels.led_model import rim
from estimator.pixels.led_pixels import EDGE_PX, LedPixels, gather_led_pixels, leds_in_view
from estimator.pixels.likelihood import Noise, PhotometricFit, excess_chi2, fit_photometry, score
from estimator.solvers.reprojection import Observations, fit, observe
from estimator.spots.correspondences import find_correspondences

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_STEPS = 40
# Fisher scoring has converged at a step of a tenth of a standard deviation, squared: the next is far shorter.
CONVERGED_STEP2 = 1e-2
# Points of a rim whose movement is looked at.
RIM_POINTS = 4
# Largest movement of an LED's image in one step: the linearization at edges holds within it.
MAX_STEP_PX = 1.0
# A step that multiplies the mean deviance by more was too long. Smaller increases occur when readings near saturation
# enter or leave.
MAX_DEVIANCE_RATIO = 1.01
# A step that takes back more than this share of the one before overshoots and is halved: where an edge enters a pixel,
# the likelihood is curved more than the information says, and full steps would go back and forth for ever.
MAX_RETURN = 0.5
# Signal-to-noise ratio of an LED's amplitude below which it is not used.
MIN_SIGNAL_TO_NOISE = 5.0
# Among LEDs that are not explained, those with at least this share of the largest excess are excluded together.
MIN_EXCLUDED_SHARE = 0.25
# Accuracy of centroids, with the model error, and its share of an LED image's half width: determines which LEDs' images are certain at the start.
START_SIGMA_PX = 0.05
START_SIGMA_SHARE = 2e-3
MIN_FOR_CONSENSUS = 3
DIVERGED = "the likelihood has no maximum near the pose of the spots"
# Standard deviation of the position above which the pixels do not determine it.
MAX_SIGMA_M = 1.0


@dataclass(frozen=True, eq=False)
class Maximum:
    """The most likely pose, the covariance (6, 6) of its parameters, and the ids of the LEDs used."""

    pose: Pose
    covariance: Floats
    leds: tuple[int, ...]


def ml(frame: DeviceFrame) -> Estimate:
    """The most likely position and its covariance; raises EstimationFailure.

    The initial pose is that of `gravity_fit`, which also decides whether the estimate is ambiguous and whether gravity
    is used. With two spots the initial pose is the fit to them and gravity.
    """
    correspondences = find_correspondences(frame)
    observations = observe(frame, correspondences)
    inliers, use_gravity, is_ambiguous = np.ones(len(observations.leds_m), dtype=bool), True, False
    if len(observations.leds_m) < MIN_FOR_CONSENSUS:
        upright = upright_pose(observations)
        if upright is None:
            raise EstimationFailure("position", "too few LEDs identified to fix a position")
        start = fit(observations, upright).pose
    else:
        agreed = agreement(observations)
        start, inliers = agreed.best.pose, agreed.inliers
        use_gravity, is_ambiguous = agreed.gravity, ambiguous(agreed)
    gravity = Gravity.of(frame) if use_gravity else NO_GRAVITY
    slopes = project(observations.leds_m[inliers], start, frame.camera).slopes.reshape(-1, POSE_PARAMETERS)
    slopes /= np.repeat(_start_sigma_px(observations, inliers, start), 2)[:, None]
    information = slopes.T @ slopes + gravity.information()
    located = {led.id for led in frame.leds.values() if led.position_m in set(map(tuple, observations.leds_m[inliers]))}
    found = maximize(frame, gravity, start, _covariance(information), located)
    return Estimate(found.pose.position_m, covariance_m2=found.covariance[:3, :3], ambiguous=is_ambiguous)


def _start_sigma_px(observations: Observations, inliers: Mask, start: Pose) -> Floats:
    """Accuracy (n,) of the inliers' centroids with the model error, which grows with an LED image."""
    depth_m = start.in_camera(observations.leds_m[inliers])[:, 2]
    # lift_m2 is 4 s^2, r^2 for a disc.
    radius_px = np.sqrt(observations.lift_m2[inliers]) / np.abs(depth_m) / observations.camera.pixel_angle_rad
    return np.asarray(np.hypot(START_SIGMA_PX, START_SIGMA_SHARE * radius_px))


def maximize(
    frame: DeviceFrame, gravity: "Gravity", start: Pose, covariance: Floats, located: Collection[int] = frozenset()
) -> Maximum:
    """Maximum of the likelihood from an initial pose with a covariance (6, 6). Raises EstimationFailure.

    `located` are the ids of LEDs whose images the initial pose predicts, whatever its covariance.
    """
    pose, excluded = start, set[int]()
    ids_before: set[int] = set()
    found = set(located)
    for _ in range(MAX_STEPS):
        pixels = gather_led_pixels(frame, leds_in_view(frame, pose, covariance, found))
        ids = {led.id for led in pixels.leds}
        found |= ids
        used = np.array([led.id not in excluded for led in pixels.leds])
        result = _fisher_scoring(frame, pixels, gravity, used, pose)
        while result.converged and (unexplained := _unexplained(result)).any():
            used &= ~unexplained
            result = _fisher_scoring(frame, pixels, gravity, used, result.pose)
        pose = result.pose
        excluded |= {led.id for led, use in zip(pixels.leds, used, strict=True) if not use}
        if result.converged:
            covariance = _covariance(result.information)
            if not pixels.more or ids == ids_before:
                return Maximum(pose, covariance, tuple(sorted(ids - excluded)))
            # The better known pose may determine the images of more LEDs.
            ids_before = ids
    raise EstimationFailure("fit", DIVERGED)


@dataclass(frozen=True)
class Gravity:
    """Prior of the rig's tilts by the accelerometer: means (2,) and standard deviations (2,), radians."""

    tilts: Floats
    sigma: Floats

    @staticmethod
    def of(frame: DeviceFrame) -> "Gravity":
        """Prior by a frame's accelerometer."""
        x, y, z = (frame.camera.R_cam_rig_array().T @ frame.accelerometer_m_s2).tolist()
        tilts = tilt_from_gravity((x, y, z))
        return Gravity(np.array(tilts), tilt_sigmas(frame.accelerometer, tilts[1]))

    def information(self) -> Floats:
        """Information about the pose, (6, 6)."""
        return np.diag([0.0, 0.0, 0.0, *(self.sigma**-2), 0.0])

    def gradient(self, angles: Floats) -> Floats:
        """Gradient of the log prior by the pose, (6,), at the rig's (tilt_x, tilt_y, yaw)."""
        return np.array([0.0, 0.0, 0.0, *(self._residual(angles) / self.sigma**2), 0.0])

    def deviance(self, angles: Floats) -> float:
        """Sum of the squared residuals of the tilts, in standard deviations."""
        return float(((self._residual(angles) / self.sigma) ** 2).sum())

    def _residual(self, angles: Floats) -> Floats:
        residual = self.tilts - angles[:2]
        return np.asarray(residual - 2 * np.pi * np.round(residual / (2 * np.pi)))


NO_GRAVITY = Gravity(np.zeros(2), np.full(2, np.inf))


@dataclass(frozen=True, eq=False)
class _ScoringResult:
    """Result of Fisher scoring.

    `converged` says whether the maximum was reached, and not the limit of validity of the gathered pixels. `used`,
    `faint` (used, but with a low signal-to-noise ratio) and `excess` (of chi-square over its limit) are by LED, (n,).
    """

    pose: Pose
    converged: bool
    information: Floats
    used: Mask
    faint: Mask
    excess: Floats


def _fisher_scoring(frame: DeviceFrame, pixels: LedPixels, gravity: Gravity, used: Mask, start: Pose) -> _ScoringResult:
    """Fisher scoring with the LEDs used, (n,), to convergence or until the images leave the gathered pixels."""
    camera = frame.camera
    # Of a large LED, a point of the rim moves more than the centre.
    rims_m = np.concatenate([rim(led, RIM_POINTS) + np.array(led.position_m) for led in pixels.leds])
    origin_px = project(rims_m, pixels.state.pose, camera).pixels
    noise = Noise.of(frame)
    photometry: PhotometricFit | None = None
    pose, step, accepted, min_deviance = start, np.zeros(POSE_PARAMETERS), start, np.inf
    for _ in range(MAX_STEPS):
        rendered = (
            pixels.rendered
            if pose is pixels.state.pose
            else pixels.model.render(replace(pixels.state, pose=pose))
        )
        angles = pose.rig_angles(camera)
        candidate = fit_photometry(pixels, rendered, used, noise, photometry)
        deviance = candidate.deviance + gravity.deviance(angles) / len(pixels.electrons)
        if deviance > MAX_DEVIANCE_RATIO * min_deviance:  # the step was too long for the linearization
            step = step / 4
            pose = accepted.moved(step, camera)
            continue
        photometry, accepted, min_deviance = candidate, pose, deviance
        information, gradient = (of_leds.sum(axis=0) for of_leds in score(pixels, rendered, photometry))
        information, gradient = information + gravity.information(), gradient + gravity.gradient(angles)
        before, step = step, _solved(information, gradient)
        if step @ information @ before < -MAX_RETURN * (before @ information @ before):
            step = step / 2
        rims = project(rims_m, pose, camera)
        step *= min(1.0, MAX_STEP_PX / max(float(np.linalg.norm(rims.slopes @ step, axis=1).max()), 1e-12))
        converged = float(step @ information @ step) < CONVERGED_STEP2
        pose = pose.moved(step, camera)
        moved_px = np.linalg.norm(rims.pixels + rims.slopes @ step - origin_px, axis=1)
        if converged or not bool((moved_px < EDGE_PX - 1).all()):
            break
    else:
        raise EstimationFailure("fit", DIVERGED)
    count = len(pixels.leds)
    max_signal_to_noise = np.zeros(count)
    np.maximum.at(max_signal_to_noise, pixels.led, photometry.signal_to_noise)
    excess: Floats = np.asarray(
        np.bincount(pixels.led, excess_chi2(pixels, rendered, photometry), count), dtype=np.float64
    )
    faint = used & (max_signal_to_noise < MIN_SIGNAL_TO_NOISE)
    return _ScoringResult(pose, converged, information, used, faint, excess)


def _solved(information: Floats, gradient: Floats) -> Floats:
    """Step of Fisher scoring, with parameters scaled to equal size; raises EstimationFailure if it is undetermined."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    try:
        factor = np.linalg.cholesky(information / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        raise EstimationFailure("fit", "the LEDs in view do not determine a position") from None
    return np.asarray(np.linalg.solve(factor.T, np.linalg.solve(factor, gradient / scale)) / scale)


def _covariance(information: Floats) -> Floats:
    covariance = np.stack([_solved(information, unit) for unit in np.eye(POSE_PARAMETERS)])
    if not np.trace(covariance[:3, :3]) < MAX_SIGMA_M**2:
        raise EstimationFailure("fit", "the LEDs in view do not determine a position")
    return (covariance + covariance.T) / 2


def _unexplained(result: _ScoringResult) -> Mask:
    """LEDs used to exclude: the faint ones, or else those with the largest excess of chi-square, if any is positive.

    A wrong LED biases the pose, so that true LEDs near it have an excess too, but a far smaller one.
    """
    if result.faint.any():
        return result.faint
    excess = np.where(result.used, result.excess, 0.0)
    return np.asarray((excess > 0) & (excess >= MIN_EXCLUDED_SHARE * excess.max()))


ML = Variant(
    "ml",
    "maximum likelihood on the pixels: true faces under the pose, Poisson, gravity as a prior, with covariance",
    ml,
)
