"""Stereo: from the disparity of LEDs in two parallel cameras side by side to vectors to the LEDs."""

import numpy as np
from numpy.typing import NDArray

from estimator.camera.undistort import pinhole_image
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.spots.correspondences import centroids_px, find_correspondences
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]

# Axes that differ by less, in radians, count as parallel: 1/100 px at 15 000 px to the image distance.
MAX_ANGLE_RAD = 1e-6
# Share of the baseline that may lie along the optical axis.
MAX_AXIAL_SHARE = 1e-6


def led_vectors(frame: DeviceFrame) -> tuple[list[Correspondence], Floats]:
    """LEDs that both cameras image, and the vectors to them, (n, 3) metres, in the axes of this frame's camera.

    Spots are centroids of the raw images. Raises EstimationFailure if there is no second camera or no common LED.
    """
    other, baseline_m = stereo_partner(frame)
    of_other = {correspondence.led.id: correspondence for correspondence in find_correspondences(other)}
    common = [correspondence for correspondence in find_correspondences(frame) if correspondence.led.id in of_other]
    if not common:
        raise EstimationFailure("stereo", "no LED is seen by both cameras")
    other_image = _image(other, [of_other[correspondence.led.id] for correspondence in common])
    return common, triangulated(_image(frame, common), other_image, baseline_m)


def stereo_partner(frame: DeviceFrame) -> tuple[DeviceFrame, Floats]:
    """Frame of the parallel camera with the longest baseline, and that baseline (2,), metres, across the axis.

    Raises EstimationFailure if there is no second camera, or none that is parallel and side by side.
    """
    if not frame.other_cameras:
        raise EstimationFailure("stereo", "no second camera took this shot")
    R_cam_rig = frame.camera.R_cam_rig_array()
    best, best_m = None, np.zeros(2)
    for other in frame.other_cameras:
        offset_m = R_cam_rig @ np.subtract(other.camera.offset_m, frame.camera.offset_m)
        parallel = np.abs(other.camera.R_cam_rig_array() @ R_cam_rig.T - np.eye(3)).max() <= MAX_ANGLE_RAD
        side_by_side = abs(offset_m[2]) <= MAX_AXIAL_SHARE * np.linalg.norm(offset_m)
        if parallel and side_by_side and np.linalg.norm(offset_m) > np.linalg.norm(best_m):
            best, best_m = other, offset_m[:2]
    if best is None:
        raise EstimationFailure("stereo", "no second camera is parallel to this one and beside it")
    return best, best_m


def triangulated(image: Floats, other_image: Floats, baseline_m: Floats) -> Floats:
    """Vectors to points, (n, 3) metres, from their images in two parallel cameras, (n, 2) normalized coordinates each.

    Depth is the length of the baseline over the disparity along it. Disparity across the baseline is measurement error
    and is ignored. Raises EstimationFailure for a disparity that is not positive.
    """
    disparity = (image - other_image) @ baseline_m / np.linalg.norm(baseline_m)
    if not (disparity > 0).all():
        raise EstimationFailure("stereo", "the disparity of an LED is not positive")
    depth_m = np.linalg.norm(baseline_m) / disparity
    return np.asarray(np.column_stack([image, np.ones(len(image))]) * depth_m[:, None])


def _image(frame: DeviceFrame, correspondences: list[Correspondence]) -> Floats:
    return pinhole_image(centroids_px(correspondences), frame.camera)
