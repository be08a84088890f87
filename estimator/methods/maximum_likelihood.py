"""Maximum likelihood: the pose under which the pixels of all LED images together are most likely.

Every LED of the map that should be in view is rendered (`estimator.pixels.led_model`) under the pose: position, tilt_x,
tilt_y, yaw. Electrons are Poisson distributed about their expectation (`estimator.pixels.likelihood`); the
accelerometer's reading is normally distributed about the true tilts. Fisher scoring maximizes the likelihood: the
weights are computed anew at every step, and the inverse of the information is the covariance, which is the Cramer-Rao
bound if the model is true.

What the device states with standard deviations (intrinsics, luminaires, LEDs and their sizes and profiles, the map's
datum) is estimated with the pose, as nuisances with priors (`estimator.pixels.nuisances`); the covariance is then the
hybrid bound. What it does not state is taken as exact, unless the images contradict: if LED images are displaced
against each other by more than their noise explains, or have another size or profile, these become nuisances as well.
The standard deviation of such a nuisance is that of all LEDs of the frame: a variance component (Foerstner 1979). A
camera that states nothing is then assumed to be one as sold. A displacement common to all images is not revealed. Nor
is a focal length where the view does not check it: `estimator.solvers.robust_fit` says what it adds to the covariance.

Not modelled: light of other sources beside a smooth background, mechanical vignetting (natural vignetting is), and
motion. LEDs that the model does not explain are excluded by their goodness of fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from estimator.camera.intrinsics import intrinsic_slopes_px, with_errors
from estimator.camera.leveling import tilt_from_gravity, tilt_sigmas
from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.camera.projection import project
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.gravity_fit import agreement, ambiguous
from estimator.methods.up2p import upright_pose
from estimator.methods.variant import Estimate, Variant
from estimator.pixels.led_model import (
    COARSE_POINTS,
    IMAGE_PARAMETERS,
    POSE_ALONE,
    PROFILE_PARAMETERS,
    SIZE_PARAMETER,
    TILT_PARAMETERS,
    ImageState,
    RenderedLeds,
    rim,
)
from estimator.pixels.led_pixels import LedPixels, LedsInView, gather_led_pixels, leds_in_view
from estimator.pixels.likelihood import Noise, PhotometricFit, excess_chi2, fit_photometry, score
from estimator.pixels.nuisances import (
    LOCAL_PARAMETERS,
    NO_COMPONENTS,
    NO_GRAVITY,
    PROFILE,
    SIZE,
    TILTS,
    Components,
    Gravity,
    Nuisances,
    Priors,
    Solution,
    solve,
    square_root,
)
from estimator.solvers.observations import Observations, observe
from estimator.solvers.reprojection import fit
from estimator.solvers.uncertainty import assumed_uncertainty
from estimator.spots.correspondences import find_correspondences
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_STEPS = 40
# Fisher scoring has converged at a step of a tenth of a standard deviation, squared: the next is far shorter.
CONVERGED_STEP2 = 1e-2
# A search that ends by the number of its steps has converged if they are shorter than a standard deviation, squared.
MAX_CIRCLE2 = 1.0
# Points of a rim whose movement is looked at.
RIM_POINTS = 4
# With nuisances a step of the pose may be short while LEDs still move in their images: no rim may move by more. Smaller
# than the shift that `likelihood` tolerates in an LED's chi-square.
CONVERGED_PX = 0.02
# A step that multiplies the mean deviance by more was too long. Smaller increases occur when readings near saturation
# enter or leave.
MAX_DEVIANCE_RATIO = 1.01
# A step is shortened so many times at most: where a wrong LED's weights change, the deviance grows without a step.
MAX_SHORTENED = 3
# A step that takes back more than this share of the one before overshoots and is halved: where an edge enters a pixel,
# the likelihood is curved more than the information says, and full steps would go back and forth for ever.
MAX_RETURN = 0.5
# Signal-to-noise ratio of an LED's amplitude below which it is not used.
MIN_SIGNAL_TO_NOISE = 5.0
# Among LEDs that are not explained, those with at least this share of the largest excess are excluded together.
MIN_EXCLUDED_SHARE = 0.25
# Accuracy of centroids, with the model error, and its share of an LED image's half width: determines which LEDs' images
# are certain at the start.
START_SIGMA_PX = 0.05
START_SIGMA_SHARE = 2e-3
# Radius from which on the area of a spot tells an LED image's size, and the error of that radius. Detection smooths
# over 5 x 5 pixels, a variance of 2 px^2, which moves the edge of a disc by 2 / (2 r), 0.12 px; blur may do as much.
MIN_SIZED_PX = 8.0
START_RADIUS_PX = 0.2
# Where the initial pose knows rims less well than this, relative to their centres, the search is damped at first: what
# the images say little of would move far beyond the linearization. Damping starts at the information of the initial
# pose, and changes by DAMPING_RATIO with the length of a step, down to MIN_DAMPING.
DAMPED_SIGMA_PX = 0.3
DAMPING_RATIO = 8.0
MIN_DAMPING = 1e-3
MIN_FOR_CONSENSUS = 3
START_STEPS = 10
# Error of the spots, beside their noise and START_SIGMA_SHARE, up to which the map may be exact.
MAX_MODEL_ERROR_PX = 0.3
# Nuisances that no one states: initial standard deviations, and how much an LED's image may differ from the model
# before it reveals them, beside its noise: shift, size, profile.
START_COMPONENTS = Components(place_m=5e-3, size=0.01, profile=0.03)
SHIFT_TOLERANCE_PX = 3e-3
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
MAX_TUNING = 10
DIVERGED = "the likelihood has no maximum near the pose of the spots"
# Standard deviation of the position above which the pixels do not determine it.
MAX_SIGMA_M = 1.0
# An edge is displaced by errors of the background that it does not share with the pixels beyond it: at most this many
# pixels times the background's share of the LED's luminance, one standard deviation.
BACKGROUND_EDGE_PX = 0.02


@dataclass(frozen=True, eq=False)
class Start:
    """Initial values: pose, nuisances of all LEDs of the map, the pose's covariance (6, 6), and which LEDs of the map
    have an image that the initial values predict, whatever the covariance, (n,). `components` are added to the priors.
    """

    pose: Pose
    nuisances: Nuisances
    covariance: Floats
    located: Mask
    components: Components = NO_COMPONENTS


@dataclass(frozen=True, eq=False)
class Maximum:
    """The most likely pose and nuisances, the covariance (6, 6) of the pose, and the ids of the LEDs used.

    `components` are those of the priors. `model_is_wrong` says whether many LEDs are not explained. `last` is the
    result of the last search, with `pixels`.
    """

    pose: Pose
    nuisances: Nuisances
    covariance: Floats
    leds: tuple[int, ...]
    components: Components
    model_is_wrong: bool
    last: "_ScoringResult"
    pixels: LedPixels


def ml(frame: DeviceFrame) -> Estimate:
    """The most likely position and its covariance; raises EstimationFailure.

    The initial pose is that of `gravity_fit`, which also decides whether the estimate is ambiguous and whether gravity
    is used. With two spots the initial pose is the fit to them and gravity.
    """
    correspondences = find_correspondences(frame)
    observations = observe(frame, correspondences)
    inliers, use_gravity, is_ambiguous = np.ones(len(observations.leds_m), dtype=bool), True, False
    exact, unchecked_m2 = True, np.zeros((3, 3))
    if len(observations.leds_m) < MIN_FOR_CONSENSUS:
        upright = upright_pose(observations)
        if upright is None:
            raise EstimationFailure("position", "too few LEDs identified to fix a position")
        pose = fit(observations, upright).pose
    else:
        agreed = agreement(observations)
        pose, inliers = agreed.best.pose, agreed.inliers
        use_gravity, is_ambiguous, unchecked_m2 = agreed.gravity, ambiguous(agreed), agreed.unchecked_m2
        # The centroids of large LEDs have model errors of their own, which the pixels do not have.
        limit_px = MAX_MODEL_ERROR_PX + START_SIGMA_SHARE * _radius_px(observations, pose).max()
        exact = agreed.model is None or agreed.model.added_sigma_px < limit_px
    gravity = gravity_of(frame) if use_gravity else NO_GRAVITY
    positions = set(map(tuple, observations.leds_m[inliers].tolist()))
    spots = [one for one in correspondences if one.led.position_m in positions]
    found = _maximize_honestly(frame, gravity, spots, pose, exact)
    covariance_m2 = found.covariance[:3, :3]
    if not _camera_is_assumed(frame, found.components):
        covariance_m2 = covariance_m2 + unchecked_m2
    return Estimate(found.pose.position_m, covariance_m2=covariance_m2, ambiguous=is_ambiguous)


def _camera_is_assumed(frame: DeviceFrame, components: Components) -> bool:
    """Whether a camera that states nothing is taken as one as sold: where the images reveal an inexact place."""
    return frame.camera.uncertainty is None and components.place_m > 0


def _radius_px(observations: Observations, pose: Pose) -> Floats:
    """Radii (n,) of the LED images, pixels, roughly."""
    depth_m = np.abs(pose.in_camera(observations.leds_m)[:, 2])
    # lift_m2 is 4 s^2, r^2 for a disc.
    return np.asarray(np.sqrt(observations.lift_m2) / depth_m / observations.camera.pixel_angle_rad)


def _maximize_honestly(
    frame: DeviceFrame, gravity: Gravity, spots: Sequence[Correspondence], pose: Pose, exact: bool
) -> Maximum | Start:
    """Maximum with what the device states, and with what the images reveal beside it. Raises EstimationFailure.

    `exact` says whether the spots agree with what the device states. Where the pixels lead nowhere, and place or camera
    are uncertain, the spots' own fit is the result: it is nearly as good then, since the noise of centroids is small
    beside that uncertainty.
    """
    priors = Priors.of(frame, tuple(frame.leds.values()))
    found, revealed = None, START_COMPONENTS
    if exact or not priors.exact:
        start = start_at_spots(frame, gravity, priors, spots, pose, NO_COMPONENTS)
        try:
            found = maximize(frame, gravity, priors, start)
            revealed = _revealed(frame, gravity, priors, found)
        except EstimationFailure:
            if len(spots) < MIN_FOR_CONSENSUS:
                raise
            if exact and not priors.exact:
                return start
    for _ in range(MAX_ROUNDS):
        if found is not None and revealed == found.components:
            return found
        wider = priors
        if _camera_is_assumed(frame, revealed):
            wider = replace(priors, camera=assumed_uncertainty(frame.camera).device_sigmas())
        start = start_at_spots(frame, gravity, wider, spots, pose, revealed)
        try:
            found = maximize(frame, gravity, wider, start)
        except EstimationFailure:
            if not np.trace(start.covariance[:3, :3]) < MAX_SIGMA_M**2:
                raise
            return start
        revealed = _revealed(frame, gravity, wider, found)
    if found is None:
        raise EstimationFailure("fit", DIVERGED)
    return found


def gravity_of(frame: DeviceFrame) -> Gravity:
    """Prior of the rig's tilts by a frame's accelerometer."""
    x, y, z = (frame.camera.R_cam_rig_array().T @ frame.accelerometer_m_s2).tolist()
    tilts = tilt_from_gravity((x, y, z))
    return Gravity(np.array(tilts), tilt_sigmas(frame.accelerometer, tilts[1]))


def start_at_spots(
    frame: DeviceFrame,
    gravity: Gravity,
    priors: Priors,
    spots: Sequence[Correspondence],
    pose: Pose,
    components: Components,
) -> Start:
    """Initial values from the centroids of identified spots, with the same priors as the pixels.

    `priors` are of all LEDs of the map. Where LEDs are not where the map says, their images then are where their spots
    are. Raises EstimationFailure if the spots do not determine a pose.
    """
    number = {led: k for k, led in enumerate(frame.leds)}
    index = np.array([number[one.led.id] for one in spots], dtype=np.int64)
    of_spots, nuisances = priors.only(index), Nuisances.zero(priors).only(index)
    lift_m2 = np.array([4 * one.led.mean_square_extent_m2 for one in spots])
    by_gradient_m = lift_m2 / 4 / np.array([one.led.half_width_m for one in spots])
    measured_px = np.array([(one.spot.u_px, one.spot.v_px) for one in spots])
    used = np.ones(len(spots), dtype=bool)
    for _ in range(START_STEPS):
        camera = with_errors(frame.camera, nuisances.camera)
        points_m = of_spots.positions_m + nuisances.shifts_m(of_spots)
        offset_m = points_m - pose.position_m
        # See `estimator.solvers.observations` on the eccentricity of a centroid.
        points_m[:, 2] += lift_m2 * offset_m[:, 2] / (offset_m**2).sum(axis=1)
        points_m[:, :2] += by_gradient_m[:, None] * nuisances.profile()[:, :2]
        images = project(points_m, pose, camera)
        radius_px = np.sqrt(lift_m2) / np.linalg.norm(offset_m, axis=1) / camera.pixel_angle_rad
        sigma_px = np.hypot(START_SIGMA_PX, START_SIGMA_SHARE * radius_px)
        rows = np.zeros((len(spots), 2, LOCAL_PARAMETERS))
        rows[:, :, :POSE_PARAMETERS] = images.slopes
        rows[:, :, POSE_PARAMETERS:SIZE_PARAMETER] = intrinsic_slopes_px(
            images.p_cam, camera.normalized(images.pixels), camera
        )
        # A gradient of luminance g over a half width r moves a centroid as a shift of the LED by g s^2 / r does.
        rows[:, :, IMAGE_PARAMETERS : IMAGE_PARAMETERS + 2] = images.slopes[:, :, :2] * -by_gradient_m[:, None, None]
        rows /= sigma_px[:, None, None]
        right = (measured_px - images.pixels) / sigma_px[:, None]
        angles = pose.rig_angles(camera)
        components, solution = _tuned(components, of_spots, used, rows, right, nuisances, gravity, angles)
        pose, nuisances = pose.moved(solution.pose_step, camera), nuisances.moved(solution.step)
        if solution.step2 < CONVERGED_STEP2:
            break
    sizes = _sizes_of_spots(spots, nuisances.state(pose, frame.camera, of_spots), components.added(of_spots))
    nuisances.leds[:, SIZE] = sizes
    located = np.zeros(len(priors.leds), dtype=bool)
    located[index] = True
    everything = Nuisances.zero(priors).updated(index, nuisances)
    return Start(pose, everything, solution.covariance, located, components)


def _sizes_of_spots(spots: Sequence[Correspondence], state: ImageState, priors: Priors) -> Floats:
    """Relative errors (n,) of the LEDs' sizes, from the areas of their spots, weighted by their priors."""
    sigma = priors.leds[:, SIZE]
    if not sigma.any():
        return np.zeros(len(spots))
    rims_m = state.rims_m(np.stack([rim(one.led, COARSE_POINTS) for one in spots])) + (
        priors.positions_m[:, None] + state.shifts_m[:, None]
    )
    u, v = project(rims_m.reshape(-1, 3), state.pose, state.camera).pixels.reshape(len(spots), COARSE_POINTS, 2).T
    area_px = np.abs((u * np.roll(v, -1, axis=0) - v * np.roll(u, -1, axis=0)).sum(axis=0)) / 2
    whole = np.array([not (one.spot.touches_border or one.spot.saturated) for one in spots]) & (
        area_px >= np.pi * MIN_SIZED_PX**2
    )
    area_px[~whole] = 1.0
    seen_px = np.where(whole, [float(one.spot.area_px) for one in spots], area_px)
    weight = sigma**2 / (sigma**2 + START_RADIUS_PX**2 * np.pi / area_px)
    return np.asarray(np.where(whole, weight * (np.sqrt(seen_px / area_px) - 1), 0.0))


def _tuned(
    components: Components,
    stated: Priors,
    used: Mask,
    rows: Floats,
    right: Floats,
    now: Nuisances,
    gravity: Gravity,
    angles: Floats,
) -> tuple[Components, Solution]:
    """Components of the LEDs used, (n,), that agree with the step they lead to, and that step; see `solve`."""
    solution = solve(rows, right, components.added(stated), now, gravity, angles)
    for _ in range(MAX_TUNING):
        new = components.updated(stated, now.moved(solution.step), solution.redundancy, used)
        if not new.differs(components):
            break
        components = new
        solution = solve(rows, right, components.added(stated), now, gravity, angles)
    return components, solution


def _revealed(frame: DeviceFrame, gravity: Gravity, priors: Priors, found: Maximum) -> Components:
    """Components of a maximum, and those that its images reveal beside them, with an initial value each."""
    pixels, result, had = found.pixels, found.last, found.components
    if had == START_COMPONENTS or all(vars(had).values()):
        return had
    if found.model_is_wrong:
        return START_COMPONENTS
    state = result.nuisances.state(result.pose, frame.camera, priors.only(pixels.index))
    rendered = pixels.model.render(state, np.arange(IMAGE_PARAMETERS))
    profile = result.nuisances.profile()
    photometry = fit_photometry(pixels, rendered, result.used, Noise.of(frame), result.photometry, profile)
    information, gradient = (one[result.used] for one in score(pixels, rendered, photometry, profile))
    radius_px = pixels.radius_px[result.used]

    def reveals(columns: list[int], tolerance: Floats, more: float = 0.0, freedom: int = 0) -> bool:
        """Whether the LEDs' parameters of these columns differ from 0 by more than the noise and a tolerance (n,)."""
        D, g = information[:, columns][:, :, columns], gradient[:, columns]
        spread = (
            D
            + D @ D * tolerance[:, None, None] ** 2
            + 1e-12 * np.trace(D, axis1=1, axis2=2)[:, None, None] * np.eye(len(columns))
        )
        total = np.einsum("ni,ni->", g, np.linalg.solve(spread, g[:, :, None])[:, :, 0]) + more
        return bool(total > chi2.isf(REVEALED_PROBABILITY, g.size + freedom))

    # A shift of the principal point is one of the image.
    shift = [POSE_PARAMETERS + 2, POSE_PARAMETERS + 3]
    size, of_profile = [SIZE_PARAMETER], [IMAGE_PARAMETERS + k for k in range(PROFILE_PARAMETERS)]
    z = result.nuisances.standardized(had.added(priors).only(pixels.index))
    of_priors = gravity.deviance(result.pose.rig_angles(frame.camera)) + float(
        (z.camera**2).sum() + (z.datum**2).sum() + (z.luminaires**2).sum() + (z.leds[result.used, :3] ** 2).sum()
    )
    ones = np.ones(len(radius_px))
    new = {}
    if had.place_m == 0 and reveals(shift, SHIFT_TOLERANCE_PX * ones, of_priors, 2):
        new["place_m"] = START_COMPONENTS.place_m
    if had.size == 0 and reveals(size, SIZE_TOLERANCE_PX / radius_px):
        new["size"] = START_COMPONENTS.size
    if had.profile == 0 and reveals(of_profile, PROFILE_TOLERANCE * ones):
        new["profile"] = START_COMPONENTS.profile
    return replace(had, **new)


def maximize(frame: DeviceFrame, gravity: Gravity, priors: Priors, start: Start) -> Maximum:
    """Maximum of the likelihood from initial values; `priors` are of all LEDs of the map. Raises EstimationFailure."""
    pose, nuisances, covariance, located = start.pose, start.nuisances, start.covariance, start.located.copy()
    components = start.components
    excluded = np.zeros(len(priors.leds), dtype=bool)
    max_settled_px = MAX_SETTLED_PX if priors.exact else np.inf
    wrong, settled = 0, False
    start_information = np.asarray(np.linalg.inv(start.covariance), dtype=np.float64)
    damping = 1.0 if _shape_sigma_px(frame, priors, start) > DAMPED_SIGMA_PX else 0.0

    def in_view() -> LedsInView:
        state = nuisances.state(pose, frame.camera, priors)
        return leds_in_view(frame, state, covariance, components.added(priors).position_sigma_m(), located)

    for _ in range(MAX_STEPS if priors.exact else MAX_GATHERS):
        pixels = gather_led_pixels(frame, in_view(), _parameters(components.added(priors)))
        located[pixels.index] = True
        used = ~excluded[pixels.index]
        search = _Search(frame, pixels, gravity, priors.only(pixels.index), start_information, damping)
        result = search.run(used, pose, nuisances.only(pixels.index), components)
        while result.converged and (unexplained := _unexplained(result)).any():
            used &= ~unexplained
            wrong += 0 if result.faint.any() else int(unexplained.sum())
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
            if not np.trace(covariance[:3, :3]) < MAX_SIGMA_M**2:
                raise EstimationFailure("fit", "the LEDs in view do not determine a position")
            # The better known pose may determine the images of more LEDs.
            if not pixels.more or np.array_equal(pixels.index, in_view().index):
                ids = tuple(sorted(led.id for led, use in zip(pixels.leds, used, strict=True) if use))
                return Maximum(
                    pose, nuisances, covariance, ids, components, _model_is_wrong(wrong, len(ids)), result, pixels
                )
        settled = result.converged
    raise EstimationFailure("fit", DIVERGED)


def _shape_sigma_px(frame: DeviceFrame, priors: Priors, start: Start) -> float:
    """Largest standard deviation of the rims of the LEDs located, relative to their centres, by the initial pose."""
    located = np.flatnonzero(start.located)
    if len(located) == 0:
        return 0.0
    leds = [one for one, is_located in zip(frame.leds.values(), start.located, strict=True) if is_located]
    rims_m = np.stack([rim(led, RIM_POINTS) for led in leds])
    state = start.nuisances.state(start.pose, frame.camera, priors).of(located)
    centres_m = np.array([led.position_m for led in leds]) + state.shifts_m
    points_m = np.concatenate([centres_m[:, None], centres_m[:, None] + rims_m], axis=1)
    slopes = project(points_m.reshape(-1, 3), state.pose, state.camera).slopes.reshape(
        len(leds), -1, 2, POSE_PARAMETERS
    )
    slopes = slopes[:, 1:] - slopes[:, :1]
    return float(np.sqrt(np.nanmax(((slopes @ start.covariance) * slopes).sum(axis=(2, 3)))))


def _model_is_wrong(wrong: int, used: int) -> bool:
    """Whether so many LEDs are not explained that the model is wrong, and not these LEDs."""
    return used < min(wrong + used - 1, MIN_USED_SHARE * (wrong + used))


def _parameters(priors: Priors) -> Ints:
    """The IMAGE_PARAMETERS to estimate: pose, intrinsics and tilts with a prior, sizes because of the background."""
    of_camera = POSE_PARAMETERS + np.flatnonzero(priors.camera)
    of_face = [SIZE_PARAMETER, *(TILT_PARAMETERS if priors.leds[:, TILTS].any() else ())]
    return np.concatenate([POSE_ALONE, of_camera, of_face])


@dataclass(frozen=True, eq=False)
class _ScoringResult:
    """Result of Fisher scoring.

    `converged` says whether the maximum was reached, and not the limit of validity of the gathered pixels. `used`,
    `faint` (used, but with a low signal-to-noise ratio) and `excess` (of chi-square over its limit) are by LED, (n,).
    `moved_px` is the largest movement of an image since its pixels were gathered, `damping` that of the next step.
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


class _Search:
    """Fisher scoring with the readings around LEDs; `priors` are those of the LEDs."""

    def __init__(
        self,
        frame: DeviceFrame,
        pixels: LedPixels,
        gravity: Gravity,
        priors: Priors,
        start_information: Floats,
        damping: float,
    ) -> None:
        self._camera = frame.camera
        self._pixels = pixels
        self._gravity = gravity
        self._priors = priors
        self._noise = Noise.of(frame)
        self._start_information = start_information
        self._first_damping = damping
        # Of a large LED, a point of the rim moves more than the centre.
        self._rims_m = np.stack([rim(led, RIM_POINTS) for led in pixels.leds])
        self._centres_m = np.array([led.position_m for led in pixels.leds])
        self._origin_px = self._rims_px(pixels.state)

    def run(self, used: Mask, pose: Pose, nuisances: Nuisances, components: Components) -> _ScoringResult:
        """Scoring with the LEDs used, (n,), to convergence or until the images leave the gathered pixels."""
        pixels, camera = self._pixels, self._camera
        stated = self._with_edge_errors(used)
        priors = components.added(stated)
        photometry: PhotometricFit | None = None
        factor, accepted, min_deviance = 1.0, (pose, nuisances), np.inf
        step: Solution | None = None
        damping, shortened = self._first_damping, 0
        for _ in range(MAX_STEPS):
            state = nuisances.state(pose, camera, priors)
            rendered = self._rendered(state)
            profile = nuisances.profile() if priors.leds[:, PROFILE].any() else None
            angles = pose.rig_angles(camera)
            candidate = fit_photometry(pixels, rendered, used, self._noise, photometry, profile)
            of_priors = self._gravity.deviance(angles) + nuisances.deviance(priors)
            deviance = candidate.deviance + of_priors / len(pixels.electrons)
            too_long = deviance > MAX_DEVIANCE_RATIO * min_deviance  # for the linearization
            if step is not None and too_long and shortened < MAX_SHORTENED:
                shortened += 1
                factor /= 4
                pose, nuisances = self._moved(accepted, step, factor)
                continue
            photometry, accepted, shortened = candidate, (pose, nuisances), 0
            rows, right = square_root(*score(pixels, rendered, photometry, profile))
            before = step
            if damping > 0:
                held = damping * self._start_information
                step = solve(rows, right, priors, nuisances, self._gravity, angles, held)
            else:
                components, step = _tuned(components, stated, used, rows, right, nuisances, self._gravity, angles)
            priors = components.added(stated)
            of_priors = self._gravity.deviance(angles) + nuisances.deviance(priors)
            min_deviance = candidate.deviance + of_priors / len(pixels.electrons)
            factor = 1.0 if before is None else self._damping(step, before, factor)
            moved_px = self._movement_px(accepted, step, factor, priors)
            factor *= min(1.0, pixels.max_move_px / max(moved_px, 1e-12))
            short = moved_px < pixels.max_move_px
            converged = step.step2 * factor**2 < CONVERGED_STEP2 and short and damping == 0
            converged &= priors.exact or moved_px < CONVERGED_PX
            if damping > 0:
                damping *= DAMPING_RATIO ** (-1 if short else moved_px > 4 * pixels.max_move_px)
                damping = damping if damping > MIN_DAMPING else 0.0
            pose, nuisances = self._moved(accepted, step, factor)
            off_px = self._rims_px(nuisances.state(pose, camera, priors)) - self._origin_px
            if converged or not bool((np.linalg.norm(off_px, axis=-1) < pixels.max_move_px).all()):
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
        excess: Floats = np.asarray(
            np.bincount(pixels.led, excess_chi2(pixels, rendered, photometry), count), dtype=np.float64
        )
        faint = used & (max_signal_to_noise < MIN_SIGNAL_TO_NOISE)
        moved = float(np.linalg.norm(off_px, axis=-1).max())
        return _ScoringResult(
            pose, nuisances, converged, step, components, photometry, used, faint, excess, moved, damping
        )

    def _damping(self, step: Solution, before: Solution, factor: float) -> float:
        """Factor of a step: a half where it takes back much of the one before."""
        inner = step.pose_step @ step.information @ before.pose_step * factor
        length2 = before.pose_step @ step.information @ before.pose_step * factor**2
        return 0.5 if inner < -MAX_RETURN * length2 else 1.0

    def _with_edge_errors(self, used: Mask) -> Priors:
        """The priors, with the errors of the sizes that an imperfect background causes."""
        pixels = self._pixels
        photometry = fit_photometry(pixels, pixels.rendered, used, self._noise)
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
        return pixels.rendered if state is pixels.state else pixels.model.render(state, pixels.rendered.parameters)

    def _moved(self, start: tuple[Pose, Nuisances], step: Solution, factor: float) -> tuple[Pose, Nuisances]:
        return start[0].moved(factor * step.pose_step, self._camera), start[1].moved(step.step, factor)

    def _movement_px(self, start: tuple[Pose, Nuisances], step: Solution, factor: float, priors: Priors) -> float:
        """Largest movement of a point of a rim by a step."""
        before, after = (
            self._rims_px(nuisances.state(pose, self._camera, priors))
            for pose, nuisances in (start, self._moved(start, step, factor))
        )
        return float(np.nan_to_num(np.linalg.norm(after - before, axis=-1), nan=np.inf).max())

    def _rims_px(self, state: ImageState) -> Floats:
        """Points of the rims, (n, RIM_POINTS, 2)."""
        centres_m = self._centres_m + state.shifts_m
        points_m = centres_m[:, None] + state.rims_m(self._rims_m)
        return project(points_m.reshape(-1, 3), state.pose, state.camera).pixels.reshape(-1, RIM_POINTS, 2)


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
