"""R-P3P: Bai, Yang, Feng & Guo, "A novel received signal strength assisted perspective-three-point algorithm for indoor
visible light positioning", arXiv 2005.11162, 2020: received power decides which solution of P3P is right.

Published, as far as known from its abstract: three LEDs of any orientation; the camera gives the angles of incidence;
the law of cosines and Wu and Ritt's zero decomposition give the candidate distances; angles, candidates and the
physical characteristics of the LEDs select the right ones; linear least squares give the position; within 10 cm over
70 % of the area in simulation.

Chosen here: P3P by OpenCV on the three LEDs that span the largest triangle in the map. Every LED's
flux (`estimator.solvers.received_power`) judges a candidate: with one unknown radiance of all LEDs, the logarithms of
measured over predicted flux have to be equal, and the candidate with the smallest standard deviation is taken. All
faces point down. The ranges of the three LEDs go into `position_from_ranges`; it needs no accelerometer.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import Pose
from estimator.camera.undistort import pinhole_image
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.received_power import fluxes, predicted_fluxes, with_power
from estimator.solvers.trilateration import check_pattern, position_from_ranges
from estimator.spots.correspondences import centroids_px, find_correspondences, led_positions_m

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def r_p3p(frame: DeviceFrame) -> Estimate:
    """Position from three spots and received power; raises EstimationFailure."""
    correspondences = with_power(find_correspondences(frame))
    leds_m = led_positions_m(correspondences)
    check_pattern(leds_m, needed=3, flat=True)
    image = pinhole_image(centroids_px(correspondences), frame.camera)
    three = large_triangle(leds_m)
    pose = pose_by_power(leds_m, image, fluxes(correspondences), three)
    distances_m = np.linalg.norm(leds_m[three] - pose.position_m, axis=1)
    ranges_m = {correspondences[k].led.id: float(d) for k, d in zip(three, distances_m, strict=True)}
    return Estimate(position_from_ranges(leds_m[three], distances_m), ranges_m)


def large_triangle(leds_m: Floats) -> Ints:
    """Indices (3,) of LEDs (n, 3) that span a large triangle: far from the middle, far from it, far from both."""
    first = int(np.linalg.norm(leds_m - leds_m.mean(axis=0), axis=1).argmax())
    second = int(np.linalg.norm(leds_m - leds_m[first], axis=1).argmax())
    areas = np.linalg.norm(np.cross(leds_m - leds_m[first], leds_m[second] - leds_m[first]), axis=1)
    return np.array([first, second, int(areas.argmax())])


def pose_by_power(leds_m: Floats, image: Floats, flux: Floats, three: Ints) -> Pose:
    """P3P's pose, camera below the LEDs, under which the fluxes (n,) of the spots `image` (n, 2) agree best.

    `leds_m` (n, 3) are the LEDs and `three` (3,) the indices of those that P3P uses. Raises EstimationFailure.
    """
    best, min_spread = None, np.inf
    for pose in candidates(leds_m[three], image[three]):
        vectors_m = pose.in_camera(leds_m)
        predicted = predicted_fluxes(vectors_m, pose.R_cam_world[:, 2])
        if not ((predicted > 0).all() and (vectors_m[:, 2] > 0).all()):
            continue
        spread = float(np.log(flux / predicted).std())
        if spread < min_spread:
            best, min_spread = pose, spread
    if best is None:
        raise EstimationFailure("position", "P3P finds no pose below the LEDs")
    return best


def candidates(leds_m: Floats, image: Floats) -> list[Pose]:
    """Poses, at most four, of three LEDs (3, 3) and their images (3, 2) at unit depth."""
    centre_m = leds_m.mean(axis=0)
    model, image = np.ascontiguousarray(leds_m - centre_m), np.ascontiguousarray(image)
    _, vectors, shifts = cv2.solveP3P(model, image, np.eye(3), None, flags=cv2.SOLVEPNP_P3P)
    rotations = [cv2.Rodrigues(vector)[0] for vector in vectors]
    return [Pose(centre_m - R.T @ shift.ravel(), R) for R, shift in zip(rotations, shifts, strict=True)]


R_P3P = Variant(
    "r-p3p",
    "Bai et al. 2020: P3P of three LEDs, received power decides between its solutions, linear least squares",
    r_p3p,
    needs=Needs(3, sizes=True),
)
