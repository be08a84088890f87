"""Undistortion: from pixels of any lens to those of a pinhole with the same `K`."""

import numpy as np
from numpy.typing import NDArray

from estimator.camera.projection import projection_of
from estimator.errors import EstimationFailure
from estimator.io.camera import Camera

Floats = NDArray[np.float64]

# Pinhole coordinates diverge towards 90 deg: at 80 deg an error of one pixel is magnified to 33.
MAX_FIELD_ANGLE_DEG = 80.0


def pinhole_pixels(pixels: Floats, camera: Camera) -> Floats:
    """Pixels (n, 2) that a pinhole with the camera's `K` would have; they may lie beyond the sensor.

    Pixels of a camera that is a pinhole are returned unchanged. Raises EstimationFailure as `pinhole_image`.
    """
    if projection_of(camera).rectilinear:
        return pixels
    return camera.to_pixels(pinhole_image(pixels, camera))


def pinhole_image(pixels: Floats, camera: Camera) -> Floats:
    """Normalized image coordinates (n, 2), `(x_cam, y_cam) / z_cam`, that a pinhole would have, of pixels (n, 2).

    Raises EstimationFailure if a pixel is MAX_FIELD_ANGLE_DEG or more off the axis, or the lens images nothing there.
    """
    image, valid, within_field = _undistorted(pixels, camera)
    if not within_field.all():
        why = f"a spot is {MAX_FIELD_ANGLE_DEG:.0f} deg or more off the optical axis"
        raise EstimationFailure("undistort", why)
    if not valid.all():
        raise EstimationFailure("undistort", "the distortion cannot be undone at a spot")
    return image


def has_pinhole_image(pixels: Floats, camera: Camera) -> NDArray[np.bool_]:
    """Whether `pinhole_image` exists, for each of the pixels (n, 2)."""
    _, valid, within_field = _undistorted(pixels, camera)
    return valid & within_field


def _undistorted(pixels: Floats, camera: Camera) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_]]:
    """Pinhole image (n, 2), which pixels the lens images something at, and which are within the field angle."""
    image, projection = camera.normalized(pixels), projection_of(camera)
    if projection.rectilinear:
        every = np.ones(len(pixels), dtype=bool)
        return image, every, every
    rays = projection.unproject(image)
    valid = np.isfinite(rays).all(axis=1)
    within_field = ~(rays[:, 2] <= np.cos(np.radians(MAX_FIELD_ANGLE_DEG)))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(rays[:, :2] / rays[:, 2:]), np.asarray(valid), np.asarray(within_field)
