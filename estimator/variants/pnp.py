"""Perspective-n-point: the camera's position from LEDs and their pixels alone, without any reading of gravity.

Centroids stand for the images of the LEDs' centres, which they are not quite (`solvers/reprojection.py`), and all
weigh alike: this is what one gets from OpenCV as it comes.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.undistort import pinhole_pixels
from estimator.errors import EstimationFailure
from estimator.io.dataset import DeviceFrame
from estimator.solvers.trilateration import check_pattern
from estimator.spots.correspondences import centroids_px, correspondences, led_positions_m
from estimator.variants.variant import Estimate, Variant

Floats = NDArray[np.float64]

# Depth over length: from here on the planar solver starts from a wrong model.
MIN_PATTERN_DETERMINANT = 1e-3


def pnp(frame: DeviceFrame) -> Estimate:
    """The best of SQPNP's answer and, for LEDs in a plane, IPPE's two."""
    return _estimate(frame, (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_IPPE))


def ippe(frame: DeviceFrame) -> Estimate:
    """Infinitesimal plane-based pose estimation (Collins & Bartoli 2014): the better of its two answers."""
    return _estimate(frame, (cv2.SOLVEPNP_IPPE,))


def sqpnp(frame: DeviceFrame) -> Estimate:
    """PnP as a quadratically constrained quadratic program (Terzakis & Lourakis 2020)."""
    return _estimate(frame, (cv2.SOLVEPNP_SQPNP,))


def _estimate(frame: DeviceFrame, methods: Sequence[int]) -> Estimate:
    seen = correspondences(frame)
    pixels = pinhole_pixels(centroids_px(seen), frame.camera)
    return Estimate(position_from_pixels(led_positions_m(seen), pixels, frame.camera.matrix(), methods))


def position_from_pixels(leds_m: Floats, pixels: Floats, K: Floats, methods: Sequence[int]) -> Floats:
    """The camera's position, (3,) metres, from LEDs (n, 3) and their pixels (n, 2) of a pinhole, by OpenCV's `methods`.

    Each candidate is refined by Levenberg-Marquardt. Of those with every LED in front of the camera and above it, the
    one that projects best. IPPE takes part where the LEDs are in a plane. Raises EstimationFailure for fewer than four
    LEDs, LEDs on one line, LEDs in no plane where there is IPPE alone, and where no candidate is left.
    """
    check_pattern(leds_m, needed=4, flat=False)
    if not in_a_plane(leds_m):
        methods = [method for method in methods if method != cv2.SOLVEPNP_IPPE]
        if not methods:
            raise EstimationFailure("position", "the LEDs are not in one plane")
    centre_m = leds_m.mean(axis=0)
    model = np.ascontiguousarray(leds_m - centre_m)
    # OpenCV knows no skew, so K is taken out here; this also makes its pixel convention no matter.
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T
    image = np.ascontiguousarray(rays[:, :2])
    best_error = np.inf
    best: Floats | None = None
    for method in methods:
        for turn, shift in candidates(model, image, method, refined=True):
            seen = model @ turn.T + shift
            position_m = centre_m - turn.T @ shift
            error = float(np.linalg.norm(seen[:, :2] / seen[:, 2:] - image))
            fits = (seen[:, 2] > 0).all() and position_m[2] < leds_m[:, 2].min()
            if fits and error < best_error:
                best_error, best = error, position_m
    if best is None:
        raise EstimationFailure("position", "no pose has the camera below the LEDs and the LEDs in front of it")
    return best


def in_a_plane(leds_m: Floats) -> bool:
    """Whether a planar solver may take these LEDs (n, 3)."""
    length, _, depth = np.linalg.svd(leds_m - leds_m.mean(axis=0), compute_uv=False)
    return bool(depth < MIN_PATTERN_DETERMINANT * length)


def candidates(model: Floats, image: Floats, method: int, refined: bool) -> list[tuple[Floats, Floats]]:
    """Poses as (rotation (3, 3), translation (3,)), of a method of OpenCV's that may find none.

    `model` (n, 3) are points in metres around their centre, `image` (n, 2) their images at unit distance.
    """
    eye = np.eye(3)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-14)
    poses = []
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(model, image, eye, None, flags=method)
        for turn, shift in zip(turns, shifts, strict=True):
            if refined:
                turn, shift = cv2.solvePnPRefineLM(model, image, eye, None, turn, shift, criteria)
            poses.append((cv2.Rodrigues(turn)[0], shift.ravel()))
    except cv2.error:
        return []
    return poses


PNP = Variant("pnp", "perspective-n-point (SQPNP, IPPE, Levenberg-Marquardt) on raw centroids, no gravity", pnp)
IPPE = Variant("ippe", "perspective-n-point for LEDs in a plane: IPPE, Levenberg-Marquardt, no gravity", ippe)
SQPNP = Variant("sqpnp", "perspective-n-point: SQPNP, Levenberg-Marquardt, no gravity", sqpnp)
