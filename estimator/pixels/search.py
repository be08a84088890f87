"""Search of the most likely pose and nuisances with given pixel readings: Fisher scoring."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.pixels.elimination import Solution, solve, square_root
from estimator.pixels.goodness_of_fit import excess_chi2
from estimator.pixels.initial import CONVERGED_STEP2, tuned
from estimator.pixels.led_model import (
    IMAGE_PARAMETERS,
    MOTION_COLUMNS,
    POSE_ALONE,
    PROFILE_PARAMETERS,
    SIZE_PARAMETER,
    TILT_PARAMETERS,
    ImageState,
    RenderedLeds,
    rims_of,
)
from estimator.pixels.led_pixels import LedPixels
from estimator.pixels.likelihood import Noise, PhotometricFit, fit_photometry, score
from estimator.pixels.nuisances import (
    PROFILE,
    SIZE,
    TILTS,
    Components,
    Gravity,
    Nuisances,
    Priors,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Fitted = tuple[PhotometricFit, Pose, Nuisances]

MAX_STEPS = 40
# Images that a step moves by less are next to those after it: a small share of the shift that `camera_check` tolerates.
MAX_LAST_PX = 3e-4
# A step of up to a third of a standard deviation, squared, is the last where it moves no image by more and is a tenth
# of the one before: a tenth of it is left. In images with a smaller radius weights settle later than the pose.
MAX_LAST_STEP2, MAX_LAST_RATIO2, MAX_LEFT_PX, MIN_LARGE_PX = 0.1, 0.01, 1e-4, 10.0
# A search that ends by the number of its steps has converged if they are shorter than a standard deviation, squared.
MAX_CIRCLE2 = 1.0
# Points of a rim whose movement is looked at.
RIM_POINTS = 4
# After a step that moves images by less, the next is mostly the last: the score is then by the parameters to check too.
NEARLY_AT_MAXIMUM_PX = 0.1
# With nuisances a step of the pose may be short while LEDs still move in their images: no rim may move by more. Smaller
# than the shift that `likelihood` tolerates in an LED's chi-square.
CONVERGED_PX = 0.02
# A step that multiplies the mean deviance by more was too long. Smaller increases occur when readings near saturation
# enter or leave.
MAX_DEVIANCE_RATIO = 1.01
# A step that moves no image by more is not too long for the linearization.
MAX_LINEAR_PX = 0.02
# After so many steps readings near saturation may only leave: amplitudes decide which are used and come from them,
# so that they could enter and leave for ever.
SETTLING_STEPS = 4
# A step is shortened so many times at most: where a wrong LED's weights change, the deviance grows without a step.
MAX_SHORTENED = 3
# A step that takes back more than this share of the one before overshoots and is halved: where an edge enters a pixel,
# the likelihood is curved more than the information says, and full steps would go back and forth for ever.
MAX_RETURN = 0.5
# Signal-to-noise ratio of an LED's amplitude below which it is not used.
MIN_SIGNAL_TO_NOISE = 5.0
# Among LEDs that are not explained, those with at least this share of the largest excess are excluded together.
MIN_EXCLUDED_SHARE = 0.25
DAMPING_RATIO = 8.0
MIN_DAMPING = 1e-3
DIVERGED = "the likelihood has no maximum near the pose of the spots"
# An edge is displaced by errors of the background that it does not share with the pixels beyond it: at most this many
# pixels times the background's share of the LED's luminance, one standard deviation.
BACKGROUND_EDGE_PX = 0.02


def image_parameters(priors: Priors) -> Ints:
    """The parameters to estimate: pose, intrinsics, tilts and motion with a prior, sizes because of the background."""
    of_camera = POSE_PARAMETERS + np.flatnonzero(priors.camera)
    of_face = [SIZE_PARAMETER, *(TILT_PARAMETERS if priors.leds[:, TILTS].any() else ())]
    return np.concatenate([POSE_ALONE, of_camera, of_face, MOTION_COLUMNS[: len(priors.motion)]])


@dataclass(frozen=True, eq=False)
class ScoringResult:
    """Result of Fisher scoring.

    `converged` says whether the maximum was reached, and not the limit of validity of the gathered pixels. `used`,
    `faint` (used, but with a low signal-to-noise ratio) and `excess` (of chi-square over its limit) are by LED, (n,).
    `moved_px` is the largest movement of an image since its pixels were gathered, `damping` that of the next step.
    `checked` are information and gradient (see `likelihood.score`) before the last step, which moved images by
    `last_px` at most, by the parameters to check; None where these were not found.
    """

    pose: Pose
    nuisances: Nuisances
    converged: bool
    solution: Solution
    components: Components
    photometry: PhotometricFit
    used: Mask
    faint: Mask
    excess: Floats
    moved_px: float
    damping: float
    checked: tuple[Floats, Floats] | None
    last_px: float


class Search:
    """Fisher scoring with the readings around LEDs; `priors` are those of the LEDs.

    `to_check` are parameters, those to estimate among them, whose score at the maximum is wanted, with the profile's.
    """

    def __init__(
        self,
        frame: DeviceFrame,
        pixels: LedPixels,
        gravity: Gravity,
        priors: Priors,
        start_information: Floats,
        damping: float,
        to_check: Ints | None = None,
    ) -> None:
        """Prepare a search; `start_information` (6, 6) is that of the initial pose, which `damping` times holds it."""
        self._camera = frame.camera
        self._pixels = pixels
        self._gravity = gravity
        self._priors = priors
        self._noise = Noise.of(frame, pixels.excess_e2)
        self._start_information = start_information
        self._first_damping = damping
        self._to_check = to_check
        # Of a large LED, a point of the rim moves more than the centre.
        self._rims_m = rims_of(pixels.leds, RIM_POINTS)
        self._centres_m = np.array([led.position_m for led in pixels.leds])
        self._origin_px = self._rims_px(pixels.state)

    def run(self, used: Mask, pose: Pose, nuisances: Nuisances, components: Components) -> ScoringResult:
        """Scoring with the LEDs used, (n,), to convergence or until the images leave the gathered pixels."""
        pixels, camera = self._pixels, self._camera
        at_start = fit_photometry(pixels, pixels.rendered, used, self._noise)
        stated = self._with_edge_errors(at_start)
        priors = components.added(stated)
        photometry: PhotometricFit | None = None
        factor, accepted = 1.0, (pose, nuisances)
        step: Solution | None = None
        rims_px: Floats | None = None
        checked, moved_px, length2 = None, np.inf, 0.0
        damping, shortened, steps = self._first_damping, 0, 0
        are_large = bool(pixels.radius_px.min() > MIN_LARGE_PX)
        for _ in range(MAX_STEPS):
            state = nuisances.state(pose, camera, priors)
            rendered = self._rendered(state)
            profile = nuisances.profile() if priors.leds[:, PROFILE].any() else None
            angles = pose.rig_angles(camera)
            first = photometry is None and profile is None and rendered is pixels.rendered
            may_enter = steps < SETTLING_STEPS
            candidate = (
                at_start
                if first
                else fit_photometry(pixels, rendered, used, self._noise, photometry, profile, may_enter)
            )
            too_long = (
                step is not None
                and photometry is not None
                and moved_px > MAX_LINEAR_PX
                and self._is_worse((candidate, pose, nuisances), (photometry, *accepted), priors)
            )
            if step is not None and too_long and shortened < MAX_SHORTENED:
                shortened += 1
                factor /= 4
                pose, nuisances = self._moved(accepted, step, factor)
                rims_px = None
                continue
            photometry, accepted, shortened, steps = candidate, (pose, nuisances), 0, steps + 1
            estimated = rendered.parameters
            if profile is not None:
                estimated = np.concatenate([estimated, IMAGE_PARAMETERS + np.arange(PROFILE_PARAMETERS)])
            checked = None
            if self._to_check is not None and moved_px < NEARLY_AT_MAXIMUM_PX:
                of_images = checked = score(pixels, rendered.by(self._to_check), photometry, nuisances.profile())
            else:
                of_images = score(pixels, rendered, photometry, profile)
            rows, right = square_root(*of_images, estimated)
            before = step
            if damping > 0:
                held = damping * self._start_information
                step = solve(rows, right, priors, nuisances, self._gravity, angles, held)
            else:
                components, step = tuned(components, stated, used, rows, right, nuisances, self._gravity, angles)
            priors = components.added(stated)
            factor = 1.0 if before is None else step_factor(step, before, factor)
            before_px = self._rims_px(state) if rims_px is None else rims_px
            pose, nuisances = self._moved(accepted, step, factor)
            rims_px = self._rims_px(nuisances.state(pose, camera, priors))
            moved_px = _largest(rims_px - before_px)
            short = moved_px < pixels.max_move_px
            if not short:
                factor *= pixels.max_move_px / moved_px
                pose, nuisances = self._moved(accepted, step, factor)
                rims_px = self._rims_px(nuisances.state(pose, camera, priors))
            before2, length2 = length2, step.step2 * factor**2
            converged = is_last(length2, before2, moved_px, are_large) and short and damping == 0
            converged &= priors.exact or moved_px < CONVERGED_PX
            if damping > 0:
                damping *= DAMPING_RATIO ** (-1 if short else moved_px > 4 * pixels.max_move_px)
                damping = damping if damping > MIN_DAMPING else 0.0
            off_px = _largest(rims_px - self._origin_px)
            if converged or not off_px < pixels.max_move_px:
                break
        else:
            # Wrong LEDs may make the search go round in small circles.
            converged = damping == 0 and step is not None and step.step2 * factor**2 < MAX_CIRCLE2
            if not converged:
                raise EstimationFailure("fit", DIVERGED)
        assert step is not None
        assert photometry is not None
        self._first_damping = damping
        count = len(pixels.leds)
        max_signal_to_noise = np.zeros(count)
        np.maximum.at(max_signal_to_noise, pixels.led, photometry.signal_to_noise)
        excess: Floats = np.asarray(np.bincount(pixels.led, excess_chi2(pixels, photometry), count), dtype=np.float64)
        faint = used & (max_signal_to_noise < MIN_SIGNAL_TO_NOISE)
        return ScoringResult(
            pose=pose,
            nuisances=nuisances,
            converged=converged,
            solution=step,
            components=components,
            photometry=photometry,
            used=used,
            faint=faint,
            excess=excess,
            moved_px=off_px,
            damping=damping,
            checked=checked,
            last_px=moved_px,
        )

    def _is_worse(self, now: Fitted, before: Fitted, priors: Priors) -> bool:
        """Whether the mean deviance of readings and priors has grown by more than a step may let it."""
        deviance, least = (
            photometry.deviance
            + (self._gravity.deviance(pose.rig_angles(self._camera)) + nuisances.deviance(priors))
            / len(self._pixels.electrons)
            for photometry, pose, nuisances in (now, before)
        )
        return deviance > MAX_DEVIANCE_RATIO * least

    def _with_edge_errors(self, photometry: PhotometricFit) -> Priors:
        """The priors, with the errors of the sizes that an imperfect background causes."""
        pixels = self._pixels
        amplitude, background = np.zeros(len(pixels.leds)), np.zeros(len(pixels.leds))
        np.maximum.at(amplitude, pixels.led, photometry.amplitude)
        np.maximum.at(background, pixels.led, photometry.background)
        share = np.divide(background, amplitude, out=np.zeros_like(amplitude), where=amplitude > 0)
        size_px = np.linalg.norm(self._origin_px - self._origin_px.mean(axis=1, keepdims=True), axis=-1).mean(axis=1)
        leds = self._priors.leds.copy()
        leds[:, SIZE] = np.hypot(leds[:, SIZE], BACKGROUND_EDGE_PX * np.minimum(share, 1.0) / size_px)
        return replace(self._priors, leds=leds)

    def _rendered(self, state: ImageState) -> RenderedLeds:
        pixels = self._pixels
        return (
            pixels.rendered if state.same_as(pixels.state) else pixels.model.render(state, pixels.rendered.parameters)
        )

    def _moved(self, start: tuple[Pose, Nuisances], step: Solution, factor: float) -> tuple[Pose, Nuisances]:
        return start[0].moved(factor * step.pose_step, self._camera), start[1].moved(step.step, factor)

    def _rims_px(self, state: ImageState) -> Floats:
        """Points of the rims, (n, RIM_POINTS, 2)."""
        centres_m = self._centres_m + state.shifts_m
        points_m = centres_m[:, None] + state.rims_m(self._rims_m)
        return state.project(points_m.reshape(-1, 3)).pixels.reshape(-1, RIM_POINTS, 2)


def is_last(length2: float, before2: float, moved_px: float, are_large: bool) -> bool:
    """Whether a step leaves next to nothing: one of a length, squared, after another, 0 for none.

    Lengths are in standard deviations. It moved an image by `moved_px` at most; `are_large` says whether images are
    larger than MIN_LARGE_PX.
    """
    if length2 < CONVERGED_STEP2:
        return True
    return are_large and moved_px < MAX_LEFT_PX and length2 < min(MAX_LAST_STEP2, MAX_LAST_RATIO2 * before2)


def step_factor(step: Solution, before: Solution, factor: float) -> float:
    """Factor of a step: a half where it takes back much of the one before, which had a `factor`."""
    inner = step.view_step @ step.information @ before.view_step * factor
    length2 = before.view_step @ step.information @ before.view_step * factor**2
    return 0.5 if inner < -MAX_RETURN * length2 else 1.0


def _largest(offsets_px: Floats) -> float:
    """Largest length of offsets (..., 2); infinite where a point has no image."""
    return float(np.nan_to_num(np.linalg.norm(offsets_px, axis=-1), nan=np.inf).max())


def unexplained(result: ScoringResult) -> Mask:
    """LEDs used to exclude: the faint ones, or else those with the largest excess of chi-square, if any is positive.

    A wrong LED biases the pose, so that true LEDs near it have an excess too, but a far smaller one.
    """
    if result.faint.any():
        return result.faint
    excess = np.where(result.used, result.excess, 0.0)
    return np.asarray((excess > 0) & (excess >= MIN_EXCLUDED_SHARE * excess.max()))
