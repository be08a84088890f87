"""Two parallel cameras beside each other: from the disparity of an LED to the vector that leads to it."""

import numpy as np
from numpy.typing import NDArray

from estimator.camera.undistort import pinhole_pixels
from estimator.errors import EstimationFailure
from estimator.io.dataset import DeviceFrame
from estimator.spots.correspondences import centroids_px, correspondences
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]

# Axes that differ by less, in radians, are parallel: 1/100 px at 15 000 px to the image distance.
PARALLEL = 1e-6
# A camera in front of or behind the other by more than this share of the way between them is not beside it.
BESIDE = 1e-6


def led_vectors(frame: DeviceFrame) -> tuple[list[Correspondence], Floats]:
    """LEDs that both cameras see, and the vectors to them, (n, 3) metres, in the axes of this frame's camera.

    Spots are centroids of the raw images. Raises EstimationFailure where there is no partner or nothing in common.
    """
    other, baseline_m = partner(frame)
    there = {correspondence.led.id: correspondence for correspondence in correspondences(other)}
    seen = [correspondence for correspondence in correspondences(frame) if correspondence.led.id in there]
    if not seen:
        raise EstimationFailure("stereo", "no LED is seen by both cameras")
    image_there = _image(other, [there[correspondence.led.id] for correspondence in seen])
    return seen, triangulated(_image(frame, seen), image_there, baseline_m)


def partner(frame: DeviceFrame) -> tuple[DeviceFrame, Floats]:
    """The frame's mate from the parallel camera furthest beside it, and where that is, (2,) metres, across the axis."""
    if not frame.other_cameras:
        raise EstimationFailure("stereo", "no second camera took this shot")
    turn = np.array(frame.camera.R_cam_rig)
    best, best_m = None, np.zeros(2)
    for other in frame.other_cameras:
        offset_m = turn @ np.subtract(other.camera.offset_m, frame.camera.offset_m)
        parallel = np.abs(np.array(other.camera.R_cam_rig) @ turn.T - np.eye(3)).max() <= PARALLEL
        beside = abs(offset_m[2]) <= BESIDE * np.linalg.norm(offset_m)
        if parallel and beside and np.linalg.norm(offset_m) > np.linalg.norm(best_m):
            best, best_m = other, offset_m[:2]
    if best is None:
        raise EstimationFailure("stereo", "no second camera is parallel to this one and beside it")
    return best, best_m


def triangulated(here: Floats, there: Floats, baseline_m: Floats) -> Floats:
    """Vectors to points, (n, 3) metres, from their images in two parallel cameras, (n, 2) each, image distance 1.

    The point's depth is the distance between the cameras over the disparity along the line between them; what
    disparity there is across that line can only be error. Raises EstimationFailure for a disparity not above zero.
    """
    disparity = (here - there) @ baseline_m / np.linalg.norm(baseline_m)
    if not (disparity > 0).all():
        raise EstimationFailure("stereo", "an LED is no further off in one camera than in the other")
    depth_m = np.linalg.norm(baseline_m) / disparity
    return np.asarray(np.column_stack([here, np.ones(len(here))]) * depth_m[:, None])


def _image(frame: DeviceFrame, seen: list[Correspondence]) -> Floats:
    pixels = pinhole_pixels(centroids_px(seen), frame.camera)
    return np.asarray((np.column_stack([pixels, np.ones(len(seen))]) @ np.linalg.inv(frame.camera.matrix()).T)[:, :2])
