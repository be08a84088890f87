"""Maximum likelihood: the pose under which the pixels of all LED images together are most likely.

Every LED of the map that should be in view is rendered (`estimator.pixels.led_model`) under the pose: position, tilt_x,
tilt_y, yaw. Electrons are Poisson distributed about their expectation (`estimator.pixels.likelihood`); the
accelerometer's reading is normally distributed about the true tilts. Fisher scoring maximizes the likelihood: the
weights are computed anew at every step, and the inverse of the information is the covariance, which is the Cramer-Rao
bound if the model is true.

What the device states with standard deviations (intrinsics, luminaires, LEDs and their sizes and profiles, the map's
datum) is estimated with the pose, as nuisances with priors (`estimator.pixels.nuisances`); the covariance is then the
hybrid bound. Where the residuals of the spots show that what is stated is too small, all of it counts by the factor
that they tell. What the device does not state is taken as exact, unless the images contradict: if LED images are
displaced against each other by more than their noise explains, or have another size or profile, these become nuisances
as well. The standard deviation of such a nuisance is that of all LEDs of the frame: a variance component (Foerstner
1979). Where the pixels inside LED images have more noise than the sensor states, that noise counts
(`estimator.spots.excess_noise`). A camera that states nothing, or that it is exact, is then assumed to be one as sold,
and so it is where an error of its intrinsics explains the images better than an exact camera does
(`estimator.pixels.camera_check`). A camera that states nothing and that the images do not check adds to the covariance.

With a rolling shutter the velocity of the camera while the frame is read out is estimated with the pose, with the
gyroscope's reading or a hand's motion as a prior (`estimator.solvers.shutter_motion`); the pose is that at mid-readout.

LEDs that send have the gains of their decoded waves, or, where identities are handed over, of their known waves at the
phases that their lines show (`estimator.receiver.known`). One whose phase is not found takes part by its spot alone, in
the initial pose.

Not modelled: light of other sources beside a smooth background, mechanical vignetting (natural vignetting is), and
motion during the exposure of a line. LEDs that the model does not explain are excluded by their goodness of fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.io.led_map import led_arrays
from estimator.methods.camera_statement import Judged, over_frames
from estimator.methods.gravity_fit import agreement_of, ambiguous
from estimator.methods.up2p import upright_pose
from estimator.methods.variant import Estimate, Needs
from estimator.pixels.camera_check import SHIFT_TOLERANCE_PX, camera_errors_by_pixels
from estimator.pixels.elimination import MIN_INFORMATION_SHARE
from estimator.pixels.initial import START_SIGMA_SHARE, Start, gravity_of, start_at_spots
from estimator.pixels.led_model import (
    IMAGE_PARAMETERS,
    PRINCIPAL_POINT,
    PROFILE_PARAMETERS,
    SIZE_PARAMETER,
    rims_of,
)
from estimator.pixels.led_pixels import LedPixels, LedsInView, gather_led_pixels, leds_in_view
from estimator.pixels.likelihood import Noise, fit_photometry, score
from estimator.pixels.nuisances import NO_COMPONENTS, NO_GRAVITY, Components, Gravity, Nuisances, Priors
from estimator.pixels.search import (
    DIVERGED,
    MAX_LAST_PX,
    MAX_STEPS,
    RIM_POINTS,
    ScoringResult,
    Search,
    image_parameters,
    unexplained,
)
from estimator.receiver.known import with_known_gains
from estimator.solvers import second_order
from estimator.solvers.camera_check import CameraErrors
from estimator.solvers.chi_square import chi2_limit
from estimator.solvers.observations import Observations, observe_once
from estimator.solvers.reprojection import fit
from estimator.solvers.uncertainty import assumed_uncertainty
from estimator.spots.correspondences import find_correspondences
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Where the initial pose knows rims less well than this, relative to their centres, the search is damped at first: what
# the images say little of would move far beyond the linearization. Damping starts at the information of the initial
# pose, and changes by DAMPING_RATIO with the length of a step, down to MIN_DAMPING.
DAMPED_SIGMA_PX = 0.3
MIN_FOR_CONSENSUS = 3
# Error of the spots, beside their noise and START_SIGMA_SHARE, up to which the map may be exact.
MAX_MODEL_ERROR_PX = 0.3
# Nuisances that no one states: initial standard deviations, and how much an LED's image may differ from the model
# before it reveals them, beside its noise: shift (SHIFT_TOLERANCE_PX), size, profile.
START_COMPONENTS = Components(place_m=5e-3, size=0.01, profile=0.03)
SIZE_TOLERANCE_PX = 0.02
PROFILE_TOLERANCE = 3e-3
# Probability that noise reveals one.
REVEALED_PROBABILITY = 1e-9
# Movement of an image above which its pixels are gathered once more.
MAX_SETTLED_PX = 0.05
# Largest number of times that pixels are gathered in one search with nuisances.
MAX_GATHERS = 12
# Share of the LEDs in view below which it is not the LEDs that are wrong, but the model.
MIN_USED_SHARE = 0.75
MAX_ROUNDS = 3
FAINT = "the light of most LEDs in view is lost in the noise of the pixels that are not saturated"
# Standard deviation of the position above which the pixels do not determine it.
MAX_SIGMA_M = 1.0


@dataclass(frozen=True, eq=False)
class Maximum:
    """The most likely pose and nuisances, and the ids of the LEDs used.

    `covariance` (6, 6) is that of the pose, or (12, 12) with the velocity's for a rolling shutter. `components` are
    those of the priors. `model_is_wrong` says whether many LEDs are not explained. `last` is the result of the last
    search, with `pixels`. `camera` are the errors that the images say of a camera that states none and is taken as
    exact; None for another camera, and beside an uncertain map.
    """

    pose: Pose
    nuisances: Nuisances
    covariance: Floats
    leds: tuple[int, ...]
    components: Components
    model_is_wrong: bool
    last: ScoringResult
    pixels: LedPixels
    camera: CameraErrors | None = None


def ml(frame: DeviceFrame) -> Estimate:
    """The most likely position and its covariance; raises EstimationFailure."""
    return judged(frame).estimate


def judged(frame: DeviceFrame) -> Judged:
    """The most likely position, and what the frame says of its camera; raises EstimationFailure.

    The initial pose is that of `gravity_fit`, which also decides whether the estimate is ambiguous and whether gravity
    is used. With two spots the initial pose is the fit to them and gravity. LEDs without a size have no model, nor has
    the noise of a sensor without a gain, such as a photograph's.
    """
    if frame.sensor.gain_e_per_dn is None:
        raise EstimationFailure("fit", "the sensor states no gain, so that the noise of its pixels is not known")
    if not led_arrays(frame.leds).have_sizes:
        raise EstimationFailure("fit", "the map does not say how large its LEDs are")
    frame = with_known_gains(frame)
    correspondences = find_correspondences(frame)
    observations = observe_once(frame, correspondences)
    inliers, use_gravity, is_ambiguous = np.ones(len(observations.leds_m), dtype=bool), True, False
    exact, contradicted, unchecked_m2, doubt_m2 = True, False, np.zeros((3, 3)), np.zeros((3, 3))
    scale, student_ratio = 1.0, 1.0
    if len(observations.leds_m) < MIN_FOR_CONSENSUS:
        upright = upright_pose(observations)
        if upright is None:
            raise EstimationFailure("position", "too few LEDs identified to fix a position")
        pose = fit(observations, upright).pose
    else:
        agreed = agreement_of(frame, observations)
        pose, inliers = agreed.best.pose, agreed.inliers
        use_gravity, is_ambiguous = agreed.gravity, ambiguous(agreed)
        scale = agreed.stated_scale
        student_ratio = agreed.student_ratio if scale > 1 else 1.0
        unchecked_m2, doubt_m2, contradicted = agreed.unchecked_m2, agreed.doubt_m2, agreed.contradicted
        # The centroids of large LEDs have model errors of their own, which the pixels do not have.
        limit_px = MAX_MODEL_ERROR_PX + START_SIGMA_SHARE * _radius_px(observations, pose).max()
        exact = agreed.model is None or agreed.model.added_sigma_px < limit_px
    gravity = gravity_of(frame).scaled(scale) if use_gravity else NO_GRAVITY
    positions = set(map(tuple, observations.leds_m[inliers].tolist()))
    spots = [one for one in correspondences if one.led.position_m in positions]
    stated = Priors.of(frame).scaled(scale)
    found, is_assumed = _maximize_honestly(frame, gravity, stated, spots, pose, exact)
    covariance_m2 = found.covariance[:3, :3] * student_ratio
    if isinstance(found, Maximum):
        unchecked_m2 = doubt_m2 = np.zeros((3, 3))
        if found.camera is not None and frame.camera.uncertainty is None:
            unchecked_m2 = found.camera.unchecked_m2()
        elif found.camera is not None:
            doubt_m2 = found.camera.left_open_m2()
    if is_assumed:
        unchecked_m2 = doubt_m2 = np.zeros((3, 3))
    covariance_m2 = covariance_m2 + unchecked_m2
    if observations.motion is not None:
        centre_m = observations.leds_m[inliers].mean(axis=0)
        covariance_m2 = covariance_m2 + second_order.of_pose(found.pose, frame.camera, centre_m, found.covariance)
    estimate = Estimate(found.pose.position_m, covariance_m2=covariance_m2, ambiguous=is_ambiguous)
    return Judged(estimate, contradicted or is_assumed, doubt_m2)


def _camera_is_assumed(frame: DeviceFrame, components: Components) -> bool:
    """Whether a camera that states no errors is taken as one as sold: where the images reveal an inexact place."""
    return frame.camera.states_no_errors and components.place_m > 0


def _radius_px(observations: Observations, pose: Pose) -> Floats:
    """Radii (n,) of the LED images, pixels, roughly."""
    depth_m = np.abs(pose.in_camera(observations.leds_m)[:, 2])
    # lift_m2 is 4 s^2, r^2 for a disc.
    return np.asarray(np.sqrt(observations.lift_m2) / depth_m / observations.camera.pixel_angle_rad)


def _maximize_honestly(
    frame: DeviceFrame, gravity: Gravity, priors: Priors, spots: Sequence[Correspondence], pose: Pose, exact: bool
) -> tuple[Maximum | Start, bool]:
    """Maximum with what the device states, and with what the images reveal beside it. Raises EstimationFailure.

    Also whether a camera that states no errors is taken as one as sold. `priors` are of all LEDs of the map. `exact`
    says whether the spots agree with what the device states. Where the pixels lead nowhere, and place or camera are
    uncertain, the spots' own fit is the result: it is nearly as good then, since the noise of centroids is small beside
    that uncertainty.
    """
    wider = priors
    found, revealed, camera = None, START_COMPONENTS, None
    if exact or not priors.exact:
        start = start_at_spots(frame, gravity, priors, spots, pose, NO_COMPONENTS)
        try:
            found = maximize(frame, gravity, priors, start)
            revealed, camera = _revealed(frame, gravity, priors, found)
        except EstimationFailure:
            if len(spots) < MIN_FOR_CONSENSUS:
                raise
            if exact and not priors.exact:
                return start, False
    for _ in range(MAX_ROUNDS):
        contradicted = camera is not None and camera.revealed
        if found is not None and revealed == found.components and not contradicted:
            return replace(found, camera=camera), wider is not priors
        if contradicted or _camera_is_assumed(frame, revealed):
            wider = replace(priors, camera=assumed_uncertainty(frame.camera).device_sigmas())
        start = start_at_spots(frame, gravity, wider, spots, pose, revealed)
        try:
            found = maximize(frame, gravity, wider, start)
        except EstimationFailure:
            if not _determines_position(start.covariance):
                raise
            return start, wider is not priors
        revealed, camera = _revealed(frame, gravity, wider, found)
    if found is None:
        raise EstimationFailure("fit", DIVERGED)
    return replace(found, camera=camera), wider is not priors


def _revealed(
    frame: DeviceFrame, gravity: Gravity, priors: Priors, found: Maximum
) -> tuple[Components, CameraErrors | None]:
    """Components of a maximum, and those that its images reveal beside them, with an initial value each.

    Also the errors of the camera, as `Maximum` holds them.
    """
    pixels, result, had = found.pixels, found.last, found.components
    if _has_all(had):
        return had, None
    if found.model_is_wrong:
        return START_COMPONENTS, None
    of_leds = priors.only(pixels.index)
    scored = result.checked
    if scored is None or result.last_px >= MAX_LAST_PX:
        state, profile = result.nuisances.state(result.pose, frame.camera, of_leds), result.nuisances.profile()
        rendered = pixels.model.render(state, _to_check(frame, priors, had))
        noise = Noise.of(frame, pixels.excess_e2)
        photometry = fit_photometry(pixels, rendered, result.used, noise, result.photometry, profile)
        scored = score(pixels, rendered, photometry, profile)
    information, gradient = (one[result.used] for one in scored)
    camera = None
    if _checks_camera(frame, priors, had):
        camera = camera_errors_by_pixels(frame, gravity, of_leds, result, information.sum(axis=0), gradient.sum(axis=0))
    radius_px = pixels.radius_px[result.used]

    def reveals(columns: list[int], tolerance: Floats, more: float = 0.0, freedom: int = 0) -> bool:
        return _differ(information[:, columns][:, :, columns], gradient[:, columns], tolerance, more, freedom)

    of_profile = [IMAGE_PARAMETERS + k for k in range(PROFILE_PARAMETERS)]
    placed = result.nuisances.standardized(had.added(priors).only(pixels.index))
    of_priors = gravity.deviance(result.pose.rig_angles(frame.camera)) + _of_places(placed, result.used)
    ones = np.ones(len(radius_px))
    new = {}
    # A shift of the principal point is one of the image.
    if had.place_m == 0 and reveals(list(PRINCIPAL_POINT), SHIFT_TOLERANCE_PX * ones, of_priors, 2):
        new["place_m"] = START_COMPONENTS.place_m
    if had.size == 0 and reveals([SIZE_PARAMETER], SIZE_TOLERANCE_PX / radius_px):
        new["size"] = START_COMPONENTS.size
    if had.profile == 0 and reveals(of_profile, PROFILE_TOLERANCE * ones):
        new["profile"] = START_COMPONENTS.profile
    return replace(had, **new), camera


def _has_all(components: Components) -> bool:
    """Whether there is no component that images may reveal beside these."""
    return components == START_COMPONENTS or all(vars(components).values())


def _checks_camera(frame: DeviceFrame, priors: Priors, components: Components) -> bool:
    """Whether the images of a maximum check the camera: one that states no errors, beside a map that is exact."""
    of_place = priors.camera, priors.datum, priors.luminaires, components.added(priors).leds[:, :3]
    return frame.camera.states_no_errors and not any(part.any() for part in of_place)


def _to_check(frame: DeviceFrame, priors: Priors, components: Components) -> Ints:
    """Parameters of images whose score `_revealed` needs of a maximum, those to estimate among them."""
    checked = np.arange(SIZE_PARAMETER) if _checks_camera(frame, priors, components) else np.array(PRINCIPAL_POINT)
    return np.union1d(image_parameters(components.added(priors)), checked)


def _differ(information: Floats, gradient: Floats, tolerance: Floats, more: float, freedom: int) -> bool:
    """Whether k parameters of n LEDs differ from 0 by more than their noise and a tolerance (n,).

    By their information (n, k, k) and gradient (n, k), and a chi-square `more` of `freedom` degrees of freedom.
    """
    trace = np.trace(information, axis1=1, axis2=2)
    # The light of an LED whose readings determine no amplitude says nothing.
    informed = trace > MIN_INFORMATION_SHARE * trace.max(initial=0.0)
    D, g, trace, tolerance = information[informed], gradient[informed], trace[informed], tolerance[informed]
    spread = D + D @ D * tolerance[:, None, None] ** 2 + 1e-12 * trace[:, None, None] * np.eye(D.shape[1])
    total = np.einsum("ni,ni->", g, np.linalg.solve(spread, g[:, :, None])[:, :, 0]) + more
    return bool(total > chi2_limit(REVEALED_PROBABILITY, g.size + freedom))


def _of_places(z: Nuisances, used: Mask) -> float:
    """Sum of squares of what moves images: standardized nuisances of camera, motion, map, and of the LEDs used (n,)."""
    moving = z.camera, z.datum, z.luminaires, z.leds[used, :3], z.motion
    return float(sum((one**2).sum() for one in moving))


def maximize(frame: DeviceFrame, gravity: Gravity, priors: Priors, start: Start) -> Maximum:
    """Maximum of the likelihood from initial values; `priors` are of all LEDs of the map. Raises EstimationFailure."""
    pose, nuisances, covariance, located = start.pose, start.nuisances, start.covariance, start.located.copy()
    components = start.components
    excluded = np.zeros(len(priors.leds), dtype=bool)
    max_settled_px = MAX_SETTLED_PX if priors.exact else np.inf
    wrong, settled = 0, False
    to_check = None if _has_all(components) else _to_check(frame, priors, components)
    start_information = np.asarray(np.linalg.inv(start.covariance), dtype=np.float64)
    damping = 1.0 if _shape_sigma_px(frame, priors, start) > DAMPED_SIGMA_PX else 0.0

    def in_view() -> LedsInView:
        state = nuisances.state(pose, frame.camera, priors)
        return leds_in_view(frame, state, covariance, components.added(priors).position_sigma_m(), located)

    for _ in range(MAX_STEPS if priors.exact else MAX_GATHERS):
        pixels = gather_led_pixels(frame, in_view(), image_parameters(components.added(priors)))
        located[pixels.index] = True
        used = ~excluded[pixels.index]
        of_leds = priors.only(pixels.index)
        search = Search(frame, pixels, gravity, of_leds, start_information, damping, to_check)
        result = search.run(used, pose, nuisances.only(pixels.index), components)
        if not result.converged and 2 * result.faint.sum() > used.sum():
            raise EstimationFailure("fit", FAINT)
        while result.converged and (wrong_ones := unexplained(result)).any():
            used &= ~wrong_ones
            wrong += 0 if result.faint.any() else int(wrong_ones.sum())
            if _model_is_wrong(wrong, int(used.sum())):
                break
            result = search.run(used, result.pose, result.nuisances, result.components)
        pose, nuisances = result.pose, nuisances.updated(pixels.index, result.nuisances)
        components, damping = result.components, result.damping
        excluded[pixels.index[~used]] = True
        # Which pixels are next to an edge depends on where it was when they were gathered. Beside nuisances that is
        # nothing.
        if result.converged and (result.moved_px < max_settled_px or settled):
            covariance = result.solution.covariance
            if not _determines_position(covariance):
                raise EstimationFailure("fit", "the LEDs in view do not determine a position")
            # The better known pose may determine the images of more LEDs.
            if not pixels.more or np.array_equal(pixels.index, in_view().index):
                ids = tuple(sorted(led.id for led, use in zip(pixels.leds, used, strict=True) if use))
                return Maximum(
                    pose, nuisances, covariance, ids, components, _model_is_wrong(wrong, len(ids)), result, pixels
                )
        settled = result.converged
    raise EstimationFailure("fit", DIVERGED)


def _determines_position(covariance: Floats) -> bool:
    """Whether a covariance of the pose, its first three parameters the position, is below MAX_SIGMA_M; NaN is not."""
    return bool(np.trace(covariance[:3, :3]) < MAX_SIGMA_M**2)


def _shape_sigma_px(frame: DeviceFrame, priors: Priors, start: Start) -> float:
    """Largest standard deviation of the rims of the LEDs located, relative to their centres, by the initial pose."""
    located = np.flatnonzero(start.located)
    if len(located) == 0:
        return 0.0
    every_led = tuple(frame.leds.values())
    leds = [every_led[k] for k in located]
    rims_m = rims_of(leds, RIM_POINTS)
    state = start.nuisances.state(start.pose, frame.camera, priors).of(located)
    centres_m = np.array([led.position_m for led in leds]) + state.shifts_m
    points_m = np.concatenate([centres_m[:, None], centres_m[:, None] + rims_m], axis=1)
    slopes = state.project(points_m.reshape(-1, 3)).slopes.reshape(len(leds), -1, 2, POSE_PARAMETERS)
    slopes = slopes[:, 1:] - slopes[:, :1]
    covariance = start.covariance[:POSE_PARAMETERS, :POSE_PARAMETERS]
    return float(np.sqrt(np.nanmax(((slopes @ covariance) * slopes).sum(axis=(2, 3)))))


def _model_is_wrong(wrong: int, used: int) -> bool:
    """Whether so many LEDs are not explained that the model is wrong, and not these LEDs."""
    return used < min(wrong + used - 1, MIN_USED_SHARE * (wrong + used))


ML = over_frames(
    "ml",
    "maximum likelihood on the pixels: true faces under the pose, Poisson, gravity as a prior, with covariance",
    judged,
    Needs(2, sizes=True, sensors=("accelerometer",), optional=("gyroscope",)),
)
