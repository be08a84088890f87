"""The Cramér-Rao bound of a frame: how well its pixels and the accelerometer can tell where the camera is.

No unbiased estimator has a smaller covariance than the inverse of the Fisher information (S. M. Kay, Fundamentals of
Statistical Signal Processing: Estimation Theory, 1993, chapter 3). The unknowns are the camera's position and its two
tilts and yaw; for each LED how bright it is, and for each group of LEDs whose surroundings touch the level of the
background, both nuisances. The LEDs' shapes and places, the lens and the sensor are known, and so is which LED each
image is of, decoded or not: a pose known to pixels says that too. With the expected image mu(p) and its variance var(p)
of pixel p, the information about unknowns i and j is

    J_ij = sum over p of (d mu / d i) (d mu / d j) / var,

exact for Poisson counts (var = mu); for a sensor with more noise than that it is what the mean alone tells, and less by
the information in the variance, which goes as 1 / mu. The derivatives over the pose are central differences of images
whose edges are exact. The accelerometer adds 1 / sigma^2 to each of the two tilts.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.roi import LedRegions, Roi, led_regions
from vlcrender.rendering.expected_image import LedPatch

Array = NDArray[np.float64]

MARGIN_PX = 10.0
"""Background around each LED that counts: its level is an unknown, and more pixels of it tell little more."""
STEP_PX = 1e-5
"""How far the two images of a difference are to either side. The slope of a pixel's coverage jumps where the edge
enters or leaves the pixel: so small a step hits such a place in hardly any pixel, which matters because
directions that are hardly determined live on small differences between slopes. Images are exact to some 1e-12, slopes
then to 1e-7."""
MAX_CONDITION = 1e12
"""Of the information, in units of the steps: beyond it a direction has no more of it than rounding makes."""

Render = Callable[[Pose], Sequence[LedPatch]]
Variance = Sequence[tuple[Roi, Array]]


def position_bound_m2(
    camera: Camera,
    pose: Pose,
    render: Render,
    exposure_s: float,
    variance_e2: Variance,
    distance_m: float,
    tilt_sigmas_deg: tuple[float, float],
    overscan: bool = False,
    mounted: Callable[[Pose], Pose] = lambda pose: pose,
) -> Array | None:
    """Bound of the covariance of the camera's position, (3, 3), world axes; None where the frame does not determine it.

    pose: of what the accelerometer is fixed to; `mounted` makes the camera's of it, which is another on a rig. render:
    the LEDs' own light at such a pose near `pose`, electrons a second. variance_e2: the windows read out, each
    (rows, columns), with the variance of each pixel, inf where it tells nothing (a saturated one). distance_m: roughly,
    from the camera to the LEDs. tilt_sigmas_deg: of the accelerometer, on tilt_x and tilt_y; 0 means that the tilts
    are known. overscan: whether LEDs count beyond the sensor.
    """
    at_pose = render(pose)
    if not at_pose:
        return None
    # Of x, y, z in metres and tilt_x, tilt_y, yaw in radians: each moves images by some STEP_PX.
    angle = STEP_PX / camera.focal_px
    steps = (angle * distance_m,) * 3 + (angle,) * 3
    pairs = [
        tuple({patch.led_id: patch for patch in render(_moved(pose, i, sign * step))} for sign in (1, -1))
        for i, step in enumerate(steps)
    ]
    information = np.zeros((6, 6))
    around = LedRegions(kind="leds", margin_px=MARGIN_PX, overscan=overscan)
    for box in led_regions((patch.roi for patch in at_pose), camera, around):
        for roi, variance in variance_e2:
            if roi.overlaps(box):
                here = roi.intersection(box)
                inside = [patch for patch in at_pose if here.overlaps(patch.roi)]
                slopes = np.stack(
                    [
                        (_image(here, plus, inside) - _image(here, minus, inside)) * exposure_s / (2 * step)
                        for (plus, minus), step in zip(pairs, steps, strict=True)
                    ]
                )
                now = {patch.led_id: patch for patch in inside}
                nuisances = [_image(here, now, [patch]) * exposure_s for patch in inside]
                nuisances.append(np.ones((here.rows, here.columns)))
                weight = 1 / variance[roi.slices(here)].astype(np.float64)
                information += _marginal(slopes, np.stack(nuisances), weight)
    ends = [[mounted(_moved(pose, i, sign * step)).position_m for sign in (1, -1)] for i, step in enumerate(steps)]
    lever = np.diff(ends, axis=1)[:, 0].T / (-2 * np.array(steps))
    return _position_covariance(information, np.radians(tilt_sigmas_deg), steps, lever)


def _moved(pose: Pose, unknown: int, by: float) -> Pose:
    """The pose with one of x, y, z (m), tilt_x, tilt_y, yaw (rad) changed."""
    x, y, z = pose.position_m
    numbers = [x, y, z, pose.tilt_x_deg, pose.tilt_y_deg, pose.yaw_deg]
    numbers[unknown] += by if unknown < 3 else float(np.degrees(by))
    return Pose((numbers[0], numbers[1], numbers[2]), *numbers[3:])


def _image(roi: Roi, patches: Mapping[int, LedPatch], of: Sequence[LedPatch]) -> Array:
    """The light of some LEDs in a window, electrons a second."""
    image = np.zeros((roi.rows, roi.columns))
    for wanted in of:
        patch = patches.get(wanted.led_id)
        if patch is not None and roi.overlaps(patch.roi):
            both = roi.intersection(patch.roi)
            image[roi.slices(both)] += patch.electrons_per_s[patch.roi.slices(both)]
    return image


def _marginal(slopes: Array, nuisances: Array, weight: Array) -> Array:
    """Information about the first unknowns, the nuisances being unknown too: the Schur complement, (6, 6)."""
    scale = np.sqrt(weight).ravel()
    pose_part = slopes.reshape(len(slopes), -1) * scale
    other_part = nuisances.reshape(len(nuisances), -1) * scale
    # What of each slope no change of the nuisances can imitate.
    basis, lengths, _ = np.linalg.svd(other_part.T, full_matrices=False)
    basis = basis[:, lengths > 1e-9 * lengths.max()]
    left = pose_part - (pose_part @ basis) @ basis.T
    product: Array = left @ left.T
    return product


def _position_covariance(information: Array, tilt_sigmas: Array, steps: Sequence[float], lever: Array) -> Array | None:
    """Covariance of what moves by `lever` (3, 6) with the unknowns."""
    free = [0, 1, 2, 5] if not tilt_sigmas.any() else [0, 1, 2, 3, 4, 5]
    total = information.copy()
    if tilt_sigmas.any():
        total[[3, 4], [3, 4]] += tilt_sigmas**-2
    units = np.array(steps)[free]
    scaled = total[np.ix_(free, free)] * np.outer(units, units)
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > MAX_CONDITION:
        return None
    covariance = np.linalg.inv(scaled) * np.outer(units, units)
    bound: Array = lever[:, free] @ covariance @ lever[:, free].T
    return (bound + bound.T) / 2
