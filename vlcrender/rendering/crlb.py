"""Cramér-Rao bound of a frame: the smallest covariance of the camera's position that its information allows.

No unbiased estimator has a smaller covariance than the inverse of the Fisher information (S. M. Kay, Fundamentals of
Statistical Signal Processing: Estimation Theory, 1993, chapter 3). Unknown are the camera's position, tilts and yaw;
and, as nuisance parameters, the brightness of each LED and the background level of each group of LEDs whose margins
overlap. Known are the shapes and positions of the LEDs, the lens, the sensor, and which LED each image is of, whether
its identity was decoded or not. With the expected image mu(p) and its variance var(p) of pixel p, the information about
unknowns i and j is

    J_ij = sum over p of (d mu / d i) (d mu / d j) / var,

exact for Poisson counts (var = mu); for a sensor with further noise it is the information in the mean, without the
information in the variance, which goes as 1 / mu. The derivatives with respect to the pose are central differences of
images whose edges are exact. The accelerometer adds 1 / sigma^2 to each of the two tilts.
The glare of a lens is known too: an LED's image includes its halo in the group of LEDs that it belongs to; halos of
other groups are part of the background.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import Mounted
from vlcrender.camera.roi import LedRegions, RegionImage, Roi, led_regions
from vlcrender.rendering.expected_image import LedPatch

Array = NDArray[np.float64]

MARGIN_PX = 10.0
"""Background around each LED that counts: its level is an unknown, and more pixels of it add little information."""
STEP_PX = 1e-5
"""Displacement of the two images of a difference to either side. The slope of a pixel's coverage jumps where the edge
enters or leaves the pixel. So small a step crosses such a point in very few pixels. This matters because directions
that are hardly determined depend on small differences between slopes. Images are exact to some 1e-12, slopes then to
1e-7."""
MAX_CONDITION = 1e12
"""Condition number of the information, in units of the steps, above which a direction holds only rounding errors."""

Render = Callable[[PosedCamera], Sequence[LedPatch]]
HaloOf = Callable[[Sequence[LedPatch], Roi], Array]
"""The halo of some patches in a region of the sensor, electrons a second."""


def position_bound_m2(
    mounted: Mounted,
    main: Pose,
    render: Render,
    exposure_s: float,
    variance_e2: Sequence[RegionImage],
    distance_m: float,
    tilt_sigmas_deg: tuple[float, float],
    overscan: bool = False,
    halo_of: HaloOf | None = None,
) -> Array | None:
    """Bound of the covariance of a camera's position, (3, 3), m2, world; None where the frame does not determine it.

    mounted: the camera on its rig. main: the pose of `main`, to which the accelerometer is fixed. render: patches of
    the LEDs with the camera at poses near this, electrons a second. variance_e2: the regions read out, with the
    variance of each pixel, inf for pixels without information (saturated ones). distance_m: from the camera to the
    LEDs, roughly. tilt_sigmas_deg: standard deviations of the accelerometer on tilt_x and tilt_y; 0 means that both
    tilts are known. overscan: whether LEDs count beyond the sensor. halo_of: halos of a lens with glare.
    """

    def patches_at(pose: Pose) -> Sequence[LedPatch]:
        return render(mounted.posed(pose))

    at_pose = patches_at(main)
    if not at_pose:
        return None
    camera = mounted.camera
    # Steps of x, y, z in metres and tilt_x, tilt_y, yaw in radians; each moves images by about STEP_PX.
    angle = STEP_PX / camera.focal_px
    steps = (angle * distance_m,) * 3 + (angle,) * 3
    pairs = [
        tuple({patch.led_id: patch for patch in patches_at(_moved(main, i, sign * step))} for sign in (1, -1))
        for i, step in enumerate(steps)
    ]
    information = np.zeros((6, 6))
    with_margin = LedRegions(kind="leds", margin_px=MARGIN_PX, overscan=overscan)
    for box in led_regions((patch.roi for patch in at_pose), camera, with_margin):
        for roi, variance in variance_e2:
            if roi.overlaps(box):
                common = roi.intersection(box)
                inside = [patch for patch in at_pose if common.overlaps(patch.roi)]
                slopes = np.stack(
                    [
                        (_image(common, plus, inside, halo_of) - _image(common, minus, inside, halo_of))
                        * exposure_s
                        / (2 * step)
                        for (plus, minus), step in zip(pairs, steps, strict=True)
                    ]
                )
                now = {patch.led_id: patch for patch in inside}
                nuisances = [_image(common, now, [patch], halo_of) * exposure_s for patch in inside]
                nuisances.append(np.ones((common.rows, common.columns)))
                weight = 1 / variance[roi.slices(common)].astype(np.float64)
                information += _marginal(slopes, np.stack(nuisances), weight)
    ends = [
        [mounted.posed(_moved(main, i, sign * step)).pose.position_m for sign in (1, -1)]
        for i, step in enumerate(steps)
    ]
    lever = np.diff(ends, axis=1)[:, 0].T / (-2 * np.array(steps))
    return _position_covariance(information, np.radians(tilt_sigmas_deg), steps, lever)


def _moved(pose: Pose, unknown: int, by: float) -> Pose:
    """The pose with one of x, y, z (m), tilt_x, tilt_y, yaw (rad) changed."""
    x, y, z = pose.position_m
    numbers = [x, y, z, pose.tilt_x_deg, pose.tilt_y_deg, pose.yaw_deg]
    numbers[unknown] += by if unknown < 3 else float(np.degrees(by))
    return Pose((numbers[0], numbers[1], numbers[2]), *numbers[3:])


def _image(roi: Roi, patches: Mapping[int, LedPatch], leds: Sequence[LedPatch], halo_of: HaloOf | None = None) -> Array:
    """Light of some LEDs in a region, electrons a second: of those in `patches` (by id) that `leds` names."""
    found = [patches[led.led_id] for led in leds if led.led_id in patches]
    image = np.zeros((roi.rows, roi.columns)) if halo_of is None else halo_of(found, roi)
    for patch in found:
        if roi.overlaps(patch.roi):
            both = roi.intersection(patch.roi)
            image[roi.slices(both)] += patch.electrons_per_s[patch.roi.slices(both)]
    return image


def _marginal(slopes: Array, nuisances: Array, weight: Array) -> Array:
    """Information about the pose with unknown nuisance parameters: the Schur complement, (6, 6).

    slopes: (6, rows, columns), nuisances: (n, rows, columns), derivatives of the image; weight: 1 / variance.
    """
    scale = np.sqrt(weight).ravel()
    pose_part = slopes.reshape(len(slopes), -1) * scale
    nuisance_part = nuisances.reshape(len(nuisances), -1) * scale
    # The part of each slope that is orthogonal to all nuisances.
    basis, lengths, _ = np.linalg.svd(nuisance_part.T, full_matrices=False)
    basis = basis[:, lengths > 1e-9 * lengths.max()]
    orthogonal = pose_part - (pose_part @ basis) @ basis.T
    product: Array = orthogonal @ orthogonal.T
    return product


def _position_covariance(information: Array, tilt_sigmas: Array, steps: Sequence[float], lever: Array) -> Array | None:
    """Covariance of the position, whose Jacobian to the unknowns is `lever` (3, 6); None where it is not determined."""
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
