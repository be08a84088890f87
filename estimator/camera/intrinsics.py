"""Errors of a camera's intrinsics, in the parameters and units of a camera's `uncertainty` (datasets/FORMAT.md)."""

import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compiled
from estimator.io.camera import INTRINSICS, Camera, Distortion

Floats = NDArray[np.float64]

CAMERA_PARAMETERS = len(INTRINSICS)
"""Errors of focal length and aspect (relative), principal point (u, v; pixels), k1, p1 and p2: order of derivatives."""


def with_errors(camera: Camera, errors: Floats) -> Camera:
    """The camera whose intrinsics differ from those of `camera` by errors (7,) of INTRINSICS: told plus error is true.

    Errors of the distortion do not apply to an equidistant camera and have to be zero there.
    """
    if not errors.any():
        return camera
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


def intrinsic_slopes_px(p_cam: Floats, image: Floats, camera: Camera) -> Floats:
    """Derivatives (n, 2, 7) of the pixels of points by the errors of INTRINSICS.

    `p_cam` (n, 3) are the points in camera axes, `image` (n, 2) their normalized image coordinates. An equidistant lens
    has no k1, p1, p2: their slopes are 0.
    """
    return _slopes(p_cam, image, camera.matrix(), camera.projection == "perspective")


@compiled
def _slopes(p_cam: Floats, image: Floats, K: Floats, is_perspective: bool) -> Floats:
    """See `intrinsic_slopes_px`."""
    slopes = np.zeros((len(p_cam), 2, CAMERA_PARAMETERS))
    for i in range(len(p_cam)):
        u, v = K[0, 0] * image[i, 0], K[1, 1] * image[i, 1]
        slopes[i, 0, 0], slopes[i, 1, 0] = u, v
        slopes[i, 0, 1], slopes[i, 1, 1] = u / 2, -v / 2
        slopes[i, 0, 2] = slopes[i, 1, 3] = 1.0
        if is_perspective:
            a, b = p_cam[i, 0] / p_cam[i, 2], p_cam[i, 1] / p_cam[i, 2]
            r2 = a * a + b * b
            along_x, along_y = (a * r2, 2 * a * b, r2 + 2 * a * a), (b * r2, r2 + 2 * b * b, 2 * a * b)
            for row in range(2):
                for k in range(3):
                    slopes[i, row, 4 + k] = K[row, 0] * along_x[k] + K[row, 1] * along_y[k]
    return slopes
