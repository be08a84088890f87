"""The lens out: from pixels of a real lens to those of a pinhole with the same `K`, and back."""

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.io.dataset import Camera, Distortion

Floats = NDArray[np.float64]

# A pinhole's pixels go off to infinity towards 90 deg: at 80 an error of a pixel has become one of 33.
MAX_FIELD_ANGLE_DEG = 80.0
# Newton's method doubles the digits a step; a lens that takes more all but folds the image.
MAX_STEPS = 20
# In units of the image distance: 1e-8 px of a sensor with 15 000 pixels to the image distance.
TOLERANCE = 1e-12


def pinhole_pixels(pixels: Floats, camera: Camera) -> Floats:
    """Pixels (n, 2) of a camera as a pinhole with its `K` would have them, (n, 2); they may lie beyond the sensor.

    A perspective camera without distortion is one already, and its pixels come back as they are. Raises
    EstimationFailure where a pixel is further off the axis than WIDEST_DEG, or where the lens images nothing.
    """
    if camera.projection == "perspective" and camera.distortion is None:
        return pixels
    K = camera.matrix()
    # OpenCV knows no skew, so K is taken out here; this also makes its pixel convention no matter.
    on_sensor = (np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T)[:, :2]
    plane = _from_angles(on_sensor) if camera.distortion is None else _undistorted(on_sensor, camera.distortion)
    return np.asarray(plane @ K[:2, :2].T + K[:2, 2])


def lens_pixels(pixels: Floats, camera: Camera) -> Floats:
    """The way back: pixels (n, 2) of a pinhole with a camera's `K` as the camera itself has them, (n, 2)."""
    if camera.projection == "perspective" and camera.distortion is None:
        return pixels
    K = camera.matrix()
    plane = (np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T)[:, :2]
    if camera.distortion is None:
        tangent = np.linalg.norm(plane, axis=1, keepdims=True)
        plane = plane * np.divide(np.arctan(tangent), tangent, out=np.ones_like(tangent), where=tangent > 0)
    else:
        plane = _distorted(plane, _coefficients(camera.distortion))[0]
    return np.asarray(plane @ K[:2, :2].T + K[:2, 2])


def _from_angles(on_sensor: Floats) -> Floats:
    """Positions (n, 2) at a distance theta from the axis to those at tan(theta)."""
    theta = np.linalg.norm(on_sensor, axis=1, keepdims=True)
    if not (theta < np.radians(MAX_FIELD_ANGLE_DEG)).all():
        raise EstimationFailure("undistort", f"a spot is {MAX_FIELD_ANGLE_DEG:.0f} deg or more off the optical axis")
    # On the axis itself the limit is 1.
    scale = np.divide(np.tan(theta), theta, out=np.ones_like(theta), where=theta > 0)
    return np.asarray(on_sensor * scale)


def _undistorted(on_sensor: Floats, distortion: Distortion) -> Floats:
    """Distorted positions (n, 2) to undistorted ones, by Newton's method."""
    coefficients = _coefficients(distortion)
    plane = on_sensor
    with np.errstate(all="ignore"):
        for _ in range(MAX_STEPS):
            again, slope = _distorted(plane, coefficients)
            # A folded image has a second place for the same pixel, where it is the wrong way round.
            if (np.linalg.norm(again - on_sensor, axis=1) <= TOLERANCE).all() and (np.linalg.det(slope) > 0).all():
                return plane
            try:
                plane = plane - np.linalg.solve(slope, (again - on_sensor)[:, :, None])[:, :, 0]
            except np.linalg.LinAlgError:
                break
    raise EstimationFailure("undistort", "the distortion cannot be undone at a spot")


def _coefficients(distortion: Distortion) -> Floats:
    """As OpenCV orders them."""
    return np.array([distortion.k1, distortion.k2, distortion.p1, distortion.p2, distortion.k3])


def _distorted(plane: Floats, coefficients: Floats) -> tuple[Floats, Floats]:
    """Distorted positions (n, 2) of undistorted ones, and their slopes (n, 2, 2), as OpenCV has them."""
    ahead = np.column_stack([plane, np.ones(len(plane))])
    distorted, jacobian = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), np.eye(3), coefficients)[:2]
    # Columns: three of rotation, three of translation. At depth 1 to be moved across is to be elsewhere in the plane.
    return distorted.reshape(-1, 2), jacobian[:, 3:5].reshape(-1, 2, 2)
