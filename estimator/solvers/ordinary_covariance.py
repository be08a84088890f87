"""Covariance of a position by ordinary least squares, whose weights are equal whatever the errors of the spots are.

With the slopes J of the spots by the pose, in normalized coordinates, the fit's pose moves by H J^T e, H = (J^T J)^-1,
for errors e of the spots. With the covariance C of e, by the centroids, by the errors of camera and map that the device
states and by the motion of a camera with a rolling shutter, that of the pose is H J^T C J H (the "sandwich" of White
1980). Residuals that are much larger than C says are taken as they are: where the map's errors are stated, C is
multiplied by their ratio, otherwise each spot has a further variance, and a camera that states nothing is one as sold.
The fit takes centroids as images of the LEDs' centres: the movement by their known difference
(`estimator.solvers.observations`) adds its square. Motion displaces spots by so much that the terms of second order of
the position count as well.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import Pose
from estimator.solvers import second_order
from estimator.solvers.chi_square import chi2_limit
from estimator.solvers.data_snooping import OUTLIER_PROBABILITY
from estimator.solvers.observations import Observations, centroid_images, pose_slopes, pose_vector

Floats = NDArray[np.float64]


def ordinary_covariance(observations: Observations, pose: Pose) -> Floats:
    """Covariance (3, 3), m^2, of the position of the least-squares pose of at least four spots, without gravity."""
    of_image, of_position = pose_slopes(observations, pose)
    slopes = of_image.reshape(-1, 6)
    of_pose = np.linalg.pinv(slopes)
    gain = of_position @ of_pose
    left_open = np.eye(len(slopes)) - slopes @ of_pose
    centres = centroid_images(pose, observations.leds_m, np.zeros_like(observations.lift_m2))[0]
    lifted = centroid_images(pose, observations.leds_m, observations.lift_m2)[0]
    residuals = left_open @ (observations.still_image - centres).ravel()
    covariance = observations.total_covariance(pose)
    freedom = max(len(slopes) - 6, 1)
    expected = float(np.einsum("ij,ji->", left_open, covariance))
    eccentric = left_open @ (lifted - centres).ravel()
    ratio = float(residuals @ residuals) / (expected + float(eccentric @ eccentric))
    if ratio > chi2_limit(OUTLIER_PROBABILITY, freedom) / freedom:
        if any(parameter.group == "map" for parameter in observations.uncertainty.parameters):
            covariance = covariance * ratio
        else:
            covariance = observations.with_assumed_camera().total_covariance(pose)
            covariance = covariance + (ratio - 1) * expected / freedom * np.eye(len(slopes))
    moved = gain @ (lifted - centres).ravel()
    total = gain @ covariance @ gain.T + np.outer(moved, moved)
    if observations.motion is not None:
        total = total + second_order.of_pose_vector(pose_vector(observations, pose), of_pose @ covariance @ of_pose.T)
    return np.asarray(total)
