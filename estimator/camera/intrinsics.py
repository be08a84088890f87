"""Errors of a camera's intrinsics, in the parameters and units of a camera's `uncertainty` (datasets/FORMAT.md)."""

import numpy as np
from numpy.typing import NDArray

from estimator.camera.projection import ProjectedPoints
from estimator.io.device import Camera, Distortion

Floats = NDArray[np.float64]

CAMERA_PARAMETERS = 7
"""Errors of focal length and aspect (relative), principal point (u, v; pixels), k1, p1 and p2: order of derivatives."""


def with_errors(camera: Camera, errors: Floats) -> Camera:
    """The camera whose intrinsics differ from those of `camera` by errors (7,): told plus error is true.

    Errors of the distortion do not apply to an equidistant camera and have to be zero there.
    """
    focal, aspect, cx, cy, k1, p1, p2 = errors.tolist()
    (fx, skew, u0), (_, fy, v0), last = camera.K
    K = (
        (fx * (1 + focal) * (1 + aspect / 2), skew, u0 + cx),
        (0.0, fy * (1 + focal) * (1 - aspect / 2), v0 + cy),
        last,
    )
    distortion = camera.distortion
    if any((k1, p1, p2)):
        told = distortion or Distortion(k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
        distortion = told.model_copy(update={"k1": told.k1 + k1, "p1": told.p1 + p1, "p2": told.p2 + p2})
    return camera.model_copy(update={"K": K, "distortion": distortion})


def camera_slopes(points: ProjectedPoints, camera: Camera) -> Floats:
    """Derivatives (n, 2, 7) of the pixels of projected points by errors of the camera's intrinsics."""
    (fx, _, _), (_, fy, _), _ = camera.K
    image = camera.normalized(points.pixels)
    slopes = np.zeros((len(image), 2, CAMERA_PARAMETERS))
    slopes[:, :, 0] = image * [fx, fy]
    slopes[:, :, 1] = image * [fx / 2, -fy / 2]
    slopes[:, 0, 2] = slopes[:, 1, 3] = 1.0
    if camera.projection == "perspective":
        with np.errstate(all="ignore"):
            a, b = (points.p_cam[:, :2] / points.p_cam[:, 2:]).T
        r2 = a * a + b * b
        slopes[:, 0, 4], slopes[:, 1, 4] = fx * a * r2, fy * b * r2
        slopes[:, 0, 5], slopes[:, 1, 5] = fx * 2 * a * b, fy * (r2 + 2 * b * b)
        slopes[:, 0, 6], slopes[:, 1, 6] = fx * (r2 + 2 * a * a), fy * 2 * a * b
    return slopes
