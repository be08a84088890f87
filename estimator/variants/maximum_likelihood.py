"""The limit: the pose under which the pixels themselves are most likely, all LEDs at once.

Every LED of the map that should be in view is drawn as what it is (`led_model`) under the pose: position, tilt_x,
tilt_y, yaw. Electrons are Poisson about what that makes them (`pixel_likelihood`), the reading of gravity is normal
about the true tilts. The likelihood is climbed by Fisher's scoring: weights are made anew at every step, and the
inverse of the information is the covariance, which is the Cramer-Rao bound if the model is true.

What is not known: how the background changes across an LED, light of other lamps, how an LED's own light depends on the
direction, mechanical vignetting (the lens's natural one is), and motion. LEDs that do not look like themselves are left
out by a goodness of fit.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.camera.leveling import tilt_from_gravity, tilt_sigmas
from estimator.camera.projection import POSE_PARAMETERS, TiltedPose, pose_of_rotation, project
from estimator.errors import EstimationFailure
from estimator.io.dataset import DeviceFrame
from estimator.pixels.likelihood import LedLight, Noise, led_light, misfit, score
from estimator.pixels.measurements import EDGE_PX, Measurements, gather
from estimator.solvers.reprojection import fit, observations
from estimator.spots.correspondences import correspondences
from estimator.variants.gravity_fit import agreement, ambiguous
from estimator.variants.up2p import upright_pose
from estimator.variants.variant import Estimate, Variant

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_STEPS = 40
# Fisher's scoring stops after a step of a tenth of a standard deviation, squared: the next would be far shorter.
SMALL_STEP = 1e-2
# No LED moves further in one step: edges are where the model holds to first order.
MAX_STEP_PX = 1.0
# A step that makes the mean deviance of a reading this many times greater was too long. Less may come from readings
# that are left out or let in as their pixels get near to full.
WORSE = 1.01
# An LED has to stand out of its background by so many standard deviations of its amplitude, or it says nothing.
MIN_SIGNAL_TO_NOISE = 5.0
# LEDs whose chi2 is too great by this share of the worst one's go with it, and the rest are looked at again.
AS_BAD = 0.25
# Centroids are good to this, a model's error included: says which other LEDs' places are sure from the start.
START_PX = 0.05
MIN_FOR_CONSENSUS = 3
STRAYED = "the likelihood has no maximum near where the spots are"
# A position that the pixels leave open by more than this is none.
MAX_SIGMA_M = 1.0


@dataclass(frozen=True, eq=False)
class Maximum:
    """The most likely pose, the covariance (6, 6) of its parameters, and the LEDs that took part."""

    pose: TiltedPose
    covariance: Floats
    leds: tuple[int, ...]


def ml(frame: DeviceFrame) -> Estimate:
    """The most likely position, its covariance; raises EstimationFailure.

    The start is what `gravity_fit` makes of the spots' centroids, which also says whether it is ambiguous and whether
    the reading of gravity is to be believed; with two spots it is the pose that fits them and gravity.
    """
    seen = observations(frame, correspondences(frame))
    inliers, level, unsure = np.ones(len(seen.leds_m), dtype=bool), True, False
    if len(seen.leds_m) < MIN_FOR_CONSENSUS:
        upright = upright_pose(seen)
        if upright is None:
            raise EstimationFailure("position", "too few LEDs identified to fix a position")
        begin = fit(seen, upright).pose
    else:
        agreed = agreement(seen)
        begin, inliers, level, unsure = agreed.best.pose, agreed.inliers, agreed.gravity, ambiguous(agreed)
    gravity = Gravity.of(frame) if level else NO_GRAVITY
    start = pose_of_rotation(begin.position_m, begin.R_cam_world, frame.camera)
    slopes = project(seen.leds_m[inliers], start, frame.camera).slopes.reshape(-1, POSE_PARAMETERS)
    information = slopes.T @ slopes / START_PX**2 + gravity.information()
    found = maximize(frame, gravity, start, _covariance(information))
    return Estimate(found.pose.position_m, covariance_m2=found.covariance[:3, :3], ambiguous=unsure)


def maximize(frame: DeviceFrame, gravity: "Gravity", start: TiltedPose, covariance: Floats) -> Maximum:
    """Climb from a pose known to a covariance (6, 6). Raises EstimationFailure."""
    pose, left_out = start, set[int]()
    before: set[int] = set()
    for _ in range(MAX_STEPS):
        measurements = gather(frame, pose, covariance)
        seen = {led.id for led in measurements.leds}
        used = np.array([led.id not in left_out for led in measurements.leds])
        climb = _climb(frame, measurements, gravity, used, pose)
        while climb.settled and (bad := _unlike(climb)).any():
            used &= ~bad
            climb = _climb(frame, measurements, gravity, used, climb.pose)
        pose = climb.pose
        left_out |= {led.id for led, use in zip(measurements.leds, used, strict=True) if not use}
        if climb.settled:
            covariance = _covariance(climb.information)
            if not measurements.more or seen == before:
                return Maximum(pose, covariance, tuple(sorted(seen - left_out)))
            # Now that more is known of the pose, more LEDs' places may be.
            before = seen
    raise EstimationFailure("fit", STRAYED)


@dataclass(frozen=True)
class Gravity:
    """A reading of the rig's tilts, (2,) radians, and their standard deviations."""

    tilts: Floats
    sigma: Floats

    @staticmethod
    def of(frame: DeviceFrame) -> "Gravity":
        """What a frame's accelerometer says."""
        x, y, z = (np.array(frame.camera.R_cam_rig).T @ frame.accelerometer_m_s2).tolist()
        tilts = tilt_from_gravity((x, y, z))
        return Gravity(np.array(tilts), tilt_sigmas(frame.accelerometer, tilts[1]))

    def information(self) -> Floats:
        """About the pose, (6, 6)."""
        return np.diag([0.0, 0.0, 0.0, *(self.sigma**-2), 0.0])

    def gradient(self, pose: TiltedPose) -> Floats:
        """Of the logarithm of its likelihood by the pose, (6,)."""
        return np.array([0.0, 0.0, 0.0, *(self._off(pose) / self.sigma**2), 0.0])

    def deviance(self, pose: TiltedPose) -> float:
        """Squares of what the reading is off, in standard deviations."""
        return float(((self._off(pose) / self.sigma) ** 2).sum())

    def _off(self, pose: TiltedPose) -> Floats:
        off = self.tilts - [pose.tilt_x, pose.tilt_y]
        return np.asarray(off - 2 * np.pi * np.round(off / (2 * np.pi)))


NO_GRAVITY = Gravity(np.zeros(2), np.full(2, np.inf))


@dataclass(frozen=True, eq=False)
class _Climb:
    pose: TiltedPose
    settled: bool
    """Whether the maximum was reached, and not the border of where the evidence is good."""
    information: Floats
    used: Mask
    """Of the LEDs, (n,), as what follows."""
    faint: Mask
    """Those used that do not stand out."""
    excess: Floats
    """By how much their chi2 is too much."""


def _climb(frame: DeviceFrame, measurements: Measurements, gravity: Gravity, used: Mask, pose: TiltedPose) -> _Climb:
    """Fisher's scoring with the LEDs used, (n,), until it stands or the images have left the gathered pixels."""
    middles_m = np.array([led.position_m for led in measurements.leds])
    origin = project(middles_m, measurements.pose, frame.camera).pixels
    noise = Noise.of(frame)
    light: LedLight | None = None
    step, reached, least = np.zeros(POSE_PARAMETERS), pose, np.inf
    for _ in range(MAX_STEPS):
        drawing = measurements.drawing if pose is measurements.pose else measurements.images.draw(pose)
        now = led_light(measurements, drawing, used, noise, light)
        surprise = now.deviance + gravity.deviance(pose) / len(measurements.cells)
        if surprise > WORSE * least:  # too long a step: light is not linear in the pose
            step = step / 4
            pose = reached.moved(step)
            continue
        light, reached, least = now, pose, surprise
        information, gradient = score(measurements, drawing, light)
        information, gradient = information + gravity.information(), gradient + gravity.gradient(pose)
        step = _solved(information, gradient)
        middles = project(middles_m, pose, frame.camera)
        step *= min(1.0, MAX_STEP_PX / max(float(np.linalg.norm(middles.slopes @ step, axis=1).max()), 1e-12))
        settled = float(step @ information @ step) < SMALL_STEP
        pose = pose.moved(step)
        inside = bool((np.linalg.norm(middles.pixels + middles.slopes @ step - origin, axis=1) < EDGE_PX - 1).all())
        if settled or not inside:
            break
    else:
        raise EstimationFailure("fit", STRAYED)
    count = len(measurements.leds)
    strongest = np.zeros(count)
    np.maximum.at(strongest, measurements.led, light.signal_to_noise)
    excess: Floats = np.asarray(
        np.bincount(measurements.led, misfit(measurements, drawing, light), count), dtype=np.float64
    )
    return _Climb(pose, settled, information, used, used & (strongest < MIN_SIGNAL_TO_NOISE), excess)


def _solved(information: Floats, gradient: Floats) -> Floats:
    """The step of Fisher's scoring, parameters scaled to one size; raises EstimationFailure where it is not fixed."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    try:
        factor = np.linalg.cholesky(information / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        raise EstimationFailure("fit", "the LEDs that are seen do not fix a position") from None
    return np.asarray(np.linalg.solve(factor.T, np.linalg.solve(factor, gradient / scale)) / scale)


def _covariance(information: Floats) -> Floats:
    covariance = np.stack([_solved(information, unit) for unit in np.eye(POSE_PARAMETERS)])
    if not np.trace(covariance[:3, :3]) < MAX_SIGMA_M**2:
        raise EstimationFailure("fit", "the LEDs that are seen do not fix a position")
    return (covariance + covariance.T) / 2


def _unlike(climb: _Climb) -> Mask:
    """Of the LEDs used, those that do not stand out; or else those that look least like themselves, if any do not.

    A wrong LED draws the pose to itself, so that right ones near it misfit too, but by far less.
    """
    if climb.faint.any():
        return climb.faint
    excess = np.where(climb.used, climb.excess, 0.0)
    return np.asarray((excess > 0) & (excess >= AS_BAD * excess.max()))


ML = Variant(
    "ml",
    "maximum likelihood on the pixels: true faces under the pose, Poisson, gravity as a prior, with covariance",
    ml,
)
