"""Initial values of maximum likelihood: pose and nuisances by the centroids of identified spots."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.camera.intrinsics import intrinsic_slopes_px, with_errors
from estimator.camera.leveling import tilt_from_gravity, tilt_sigmas
from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.io.device import DeviceFrame
from estimator.io.led_map import led_arrays
from estimator.pixels.elimination import Solution, solve
from estimator.pixels.led_model import (
    COARSE_POINTS,
    IMAGE_PARAMETERS,
    LOCAL_PARAMETERS,
    SIZE_PARAMETER,
    ImageState,
    rims_of,
)
from estimator.pixels.nuisances import (
    NO_COMPONENTS,
    NO_GRAVITY,
    SIZE,
    Components,
    Gravity,
    Nuisances,
    Priors,
)
from estimator.solvers.observations import light_centres_m
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Fisher scoring has converged at a step of a tenth of a standard deviation, squared: the next is far shorter.
CONVERGED_STEP2 = 1e-2
# Accuracy of centroids, with the model error, and its share of an LED image's half width: determines which LEDs' images
# are certain at the start.
START_SIGMA_PX = 0.05
START_SIGMA_SHARE = 2e-3
# Radius from which on the area of a spot tells an LED image's size, and the error of that radius. Detection smooths
# over 5 x 5 pixels, a variance of 2 px^2, which moves the edge of a disc by 2 / (2 r), 0.12 px; blur may do as much.
MIN_SIZED_PX = 8.0
START_RADIUS_PX = 0.2
START_STEPS = 10
MAX_TUNING = 10


@dataclass(frozen=True, eq=False)
class Start:
    """Initial values: pose, nuisances of all LEDs of the map, and which of these have an image that the values predict.

    `covariance` (6, 6) is that of the pose, or (12, 12) with the velocity's for a rolling shutter. The images of the
    LEDs `located` (n,) are predicted whatever the covariance. `components` are added to the priors.
    """

    pose: Pose
    nuisances: Nuisances
    covariance: Floats
    located: Mask
    components: Components = NO_COMPONENTS


def gravity_of(frame: DeviceFrame) -> Gravity:
    """Prior of the rig's tilts by a frame's accelerometer; NO_GRAVITY without one."""
    if frame.accelerometer is None or frame.accelerometer_m_s2 is None:
        return NO_GRAVITY
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
    number = led_arrays(frame.leds).numbers
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
        points_m = light_centres_m(points_m, lift_m2, pose.position_m)
        points_m[:, :2] += by_gradient_m[:, None] * nuisances.profile()[:, :2]
        images = nuisances.state(pose, frame.camera, of_spots).project(points_m)
        radius_px = np.sqrt(lift_m2) / np.linalg.norm(offset_m, axis=1) / camera.pixel_angle_rad
        sigma_px = np.hypot(START_SIGMA_PX, START_SIGMA_SHARE * radius_px)
        rows = np.zeros((len(spots), 2, LOCAL_PARAMETERS + len(priors.motion)))
        if images.motion_slopes is not None:
            rows[:, :, LOCAL_PARAMETERS:] = images.motion_slopes
        rows[:, :, :POSE_PARAMETERS] = images.slopes
        rows[:, :, POSE_PARAMETERS:SIZE_PARAMETER] = intrinsic_slopes_px(
            images.p_cam, camera.normalized(images.pixels), camera
        )
        # A gradient of luminance g over a half width r moves a centroid as a shift of the LED by g s^2 / r does.
        rows[:, :, IMAGE_PARAMETERS : IMAGE_PARAMETERS + 2] = images.slopes[:, :, :2] * -by_gradient_m[:, None, None]
        rows /= sigma_px[:, None, None]
        right = (measured_px - images.pixels) / sigma_px[:, None]
        angles = pose.rig_angles(camera)
        components, solution = tuned(components, of_spots, used, rows, right, nuisances, gravity, angles)
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
    rims_m = state.rims_m(rims_of([one.led for one in spots], COARSE_POINTS)) + (
        priors.positions_m[:, None] + state.shifts_m[:, None]
    )
    u, v = state.project(rims_m.reshape(-1, 3)).pixels.reshape(len(spots), COARSE_POINTS, 2).T
    area_px = np.abs((u * np.roll(v, -1, axis=0) - v * np.roll(u, -1, axis=0)).sum(axis=0)) / 2
    whole = np.array([not (one.spot.touches_border or one.spot.saturated) for one in spots]) & (
        area_px >= np.pi * MIN_SIZED_PX**2
    )
    area_px[~whole] = 1.0
    seen_px = np.where(whole, [float(one.spot.area_px) for one in spots], area_px)
    weight = sigma**2 / (sigma**2 + START_RADIUS_PX**2 * np.pi / area_px)
    return np.asarray(np.where(whole, weight * (np.sqrt(seen_px / area_px) - 1), 0.0))


def tuned(
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
    for _ in range(0 if components == NO_COMPONENTS else MAX_TUNING):
        new = components.updated(stated, now.moved(solution.step), solution.redundancy, used)
        if not new.differs(components):
            break
        components = new
        solution = solve(rows, right, components.added(stated), now, gravity, angles)
    return components, solution
