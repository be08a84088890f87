"""Perspective-n-point: position from LEDs and their pixels alone, without gravity. Baseline: OpenCV defaults.

Centroids stand for the images of the LEDs' centres, from which they differ slightly
(`estimator.solvers.observations`), and all have equal weight. The covariance is that of such a fit
(`estimator.solvers.ordinary_covariance`). With a rolling shutter the turns that the gyroscope says are undone first;
the rest of the motion is not fitted, but its prior counts in the covariance (`estimator.solvers.shutter_motion`).
"""

import weakref
from collections.abc import Callable, Sequence
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.motion import turned_back
from estimator.camera.pose import Pose
from estimator.camera.undistort import pinhole_pixels
from estimator.errors import EstimationFailure
from estimator.io.camera import normalized
from estimator.io.device import DeviceFrame
from estimator.io.records import is_covariance
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.observations import observe, observe_once
from estimator.solvers.ordinary_covariance import ordinary_covariance
from estimator.solvers.shutter_motion import motion_prior
from estimator.solvers.trilateration import check_pattern, extents
from estimator.spots.correspondences import centroids_px, find_correspondences, led_positions_m
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]
Candidates = list[tuple[Floats, Floats]]
Once = Callable[[int, Callable[[], Candidates]], Candidates]

# Depth over length of the LEDs' pattern, from which on the planar solver is no use. Its poses are initial values, so
# that errors of the map, and luminaires that hang a little askew, may lift LEDs out of the plane.
MAX_PLANE_DEPTH = 0.02
IPPE_ONLY = (cv2.SOLVEPNP_IPPE,)
SQPNP_ONLY = (cv2.SOLVEPNP_SQPNP,)


def pnp(frame: DeviceFrame) -> Estimate:
    """The best of SQPNP's pose and, for LEDs in a plane, IPPE's two; raises EstimationFailure."""
    return _estimate(frame, (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_IPPE))


def ippe(frame: DeviceFrame) -> Estimate:
    """Infinitesimal plane-based pose estimation (Collins & Bartoli 2014): the better of its two poses."""
    return _estimate(frame, IPPE_ONLY)


def sqpnp(frame: DeviceFrame) -> Estimate:
    """PnP as a quadratically constrained quadratic program (Terzakis & Lourakis 2020)."""
    return _estimate(frame, SQPNP_ONLY)


def _estimate(frame: DeviceFrame, methods: Sequence[int]) -> Estimate:
    """The estimate from a frame's own spots; what variants of the frame compute alike is computed once."""

    def once(method: int, compute: Callable[[], Candidates]) -> Candidates:
        return frame.once(("pnp", weakref.ref(frame), method), compute)

    correspondences = find_correspondences(frame)
    pose = _pose(frame, correspondences, methods, once)
    # `pnp` has the pose of one of the others, to the bit, and with it the covariance.
    key = "ordinary covariance", weakref.ref(frame), pose.position_m.tobytes(), pose.R_cam_world.tobytes()
    covariance_m2 = frame.once(key, lambda: ordinary_covariance(observe_once(frame, correspondences), pose))
    return _with_covariance(pose, covariance_m2)


def fit_correspondences(
    frame: DeviceFrame,
    correspondences: Sequence[Correspondence],
    methods: Sequence[int] = (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_IPPE),
) -> Estimate:
    """The estimate from identified spots by OpenCV `methods`; of the frame, the camera is used."""
    pose = _pose(frame, correspondences, methods)
    return _with_covariance(pose, ordinary_covariance(observe(frame, correspondences), pose))


def _pose(
    frame: DeviceFrame, correspondences: Sequence[Correspondence], methods: Sequence[int], once: Once | None = None
) -> Pose:
    """Pose by `pose_from_pixels`, with the turns undone that a gyroscope says of a rolling shutter."""
    pixels = pinhole_pixels(centroids_px(correspondences), frame.camera)
    if (prior := motion_prior(frame)) is not None:
        times_s = frame.camera.times_s(*centroids_px(correspondences).T)
        pixels = frame.camera.to_pixels(turned_back(frame.camera.normalized(pixels), prior.velocity, times_s))
    return pose_from_pixels(led_positions_m(correspondences), pixels, frame.camera.matrix(), methods, once)


def _with_covariance(pose: Pose, covariance_m2: Floats) -> Estimate:
    """An estimate, without the covariance where that is none."""
    stated = covariance_m2 if is_covariance(covariance_m2.ravel().tolist()) else None
    return Estimate(pose.position_m, covariance_m2=stated)


def position_from_pixels(leds_m: Floats, pixels: Floats, K: Floats, methods: Sequence[int]) -> Floats:
    """Position, (3,) world metres, by `pose_from_pixels`."""
    return pose_from_pixels(leds_m, pixels, K, methods).position_m


def pose_from_pixels(
    leds_m: Floats, pixels: Floats, K: Floats, methods: Sequence[int], once: Once | None = None
) -> Pose:
    """Pose from LEDs (n, 3) and their pixels (n, 2) in a pinhole with `K`, by OpenCV `methods`.

    Each candidate is refined by Levenberg-Marquardt; `once`, if given, keeps those of a method. Of those with every LED
    in front of the camera and above it, the one with the smallest reprojection error is returned. IPPE is used for LEDs
    in a plane. Raises EstimationFailure for fewer than four LEDs, LEDs on one line, LEDs in no plane if IPPE is the
    only method, and if no candidate is left.
    """
    check_pattern(leds_m, needed=4, flat=False)
    if not in_a_plane(leds_m):
        methods = [method for method in methods if method != cv2.SOLVEPNP_IPPE]
        if not methods:
            raise EstimationFailure("position", "the LEDs are not in one plane")
    centre_m = leds_m.mean(axis=0)
    model = np.ascontiguousarray(leds_m - centre_m)
    # OpenCV supports no skew and has another pixel convention: pass normalized coordinates.
    image = np.ascontiguousarray(normalized(pixels, K))
    min_error = np.inf
    best: Pose | None = None
    for method in methods:
        compute = partial(candidates, model, image, method, refined=True)
        for R_cam_world, shift in compute() if once is None else once(method, compute):
            p_cam = model @ R_cam_world.T + shift
            position_m = centre_m - R_cam_world.T @ shift
            error = float(np.linalg.norm(p_cam[:, :2] / p_cam[:, 2:] - image))
            possible = (p_cam[:, 2] > 0).all() and position_m[2] < leds_m[:, 2].min()
            if possible and error < min_error:
                min_error, best = error, Pose(position_m, R_cam_world)
    if best is None:
        raise EstimationFailure("position", "no pose has the camera below the LEDs and the LEDs in front of it")
    return best


def in_a_plane(leds_m: Floats) -> bool:
    """Whether a planar solver can be used for LEDs (n, 3)."""
    length, _, depth = extents(leds_m)
    return depth < MAX_PLANE_DEPTH * length


def candidates(model: Floats, image: Floats, method: int, refined: bool) -> Candidates:
    """Candidate poses by an OpenCV method, as (rotation (3, 3), translation (3,)); the method may find none.

    `model` (n, 3) are points in metres relative to their centre, `image` (n, 2) their normalized image coordinates.
    IPPE is given the points projected into their plane; the refinement takes them as they are.
    """
    eye = np.eye(3)
    given = model
    if method == cv2.SOLVEPNP_IPPE:
        normal = np.linalg.svd(model - model.mean(axis=0))[2][2]
        given = np.ascontiguousarray(model - np.outer((model - model.mean(axis=0)) @ normal, normal))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-14)
    poses = []
    try:
        _, vectors, shifts, _ = cv2.solvePnPGeneric(given, image, eye, None, flags=method)
        for vector, shift in zip(vectors, shifts, strict=True):
            if refined:
                vector, shift = cv2.solvePnPRefineLM(model, image, eye, None, vector, shift, criteria)
            poses.append((cv2.Rodrigues(vector)[0], shift.ravel()))
    except cv2.error:
        return []
    return poses


FOUR_LEDS = Needs(4, optional=("gyroscope",))
PNP = Variant(
    "pnp",
    "perspective-n-point (SQPNP, IPPE, Levenberg-Marquardt) on raw centroids, no gravity",
    pnp,
    needs=FOUR_LEDS,
)
IPPE = Variant(
    "ippe",
    "perspective-n-point for LEDs in a plane: IPPE, Levenberg-Marquardt, no gravity",
    ippe,
    needs=FOUR_LEDS,
)
SQPNP = Variant("sqpnp", "perspective-n-point: SQPNP, Levenberg-Marquardt, no gravity", sqpnp, needs=FOUR_LEDS)
