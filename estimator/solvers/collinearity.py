"""Position and rotation at once from spots: the collinearity equations, solved by Gauss-Newton.

An LED, the projection centre and the LED's image lie on one line: `p_cam = R (a - p)` for an LED at a, and its image is
where the lens takes the direction of `p_cam`. Each LED gives two equations in the six unknowns, p and R.
"""

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from estimator.camera.leveling import rotation
from estimator.errors import EstimationFailure
from estimator.solvers.trilateration import check_pattern

Floats = NDArray[np.float64]
Projection = Literal["perspective", "equidistant"]
Pose = tuple[Floats, Floats]
"""R_cam_world (3, 3) and the projection centre (3,), world metres."""

# With three LEDs up to four poses fit exactly.
MIN_LEDS = 4
# Tilts tried for a start, on each axis, and how many of the minima among them are followed. From exact pixels of
# Table 1's four LEDs, nearly on a line, 3 of 1000 poses up to 60 deg still end elsewhere (64 from one start, 30 in
# steps of 15 deg); of LEDs on a square none does.
START_STEP_DEG = 7.5
START_REACH_DEG = 75.0
MAX_STARTS = 4
MAX_STEPS = 50
# A step this small, in radians and of the distance, is the last: the next would be its square, or noise times it.
TOLERANCE = 1e-9
# Directions closer to the axis than this have the slopes of the axis itself, to 1e-12.
ON_AXIS = 1e-6
# A levelled ray that rises less would meet the ceiling some ten room heights away.
MIN_SINE = 0.1


def position_by_collinearity(leds_m: Floats, image: Floats, projection: Projection) -> Floats:
    """The camera's position, (3,) metres, from LEDs (n, 3) and their images (n, 2), without any reading of gravity.

    `image` is in units of the image distance from the principal point: what `K` maps to pixels. Of the poses that the
    equations converge to from `starts`, with the camera below the LEDs and the LEDs before it, the one that leaves the
    smallest sum of squares. Raises EstimationFailure for fewer than four LEDs, LEDs on one line, and where none is
    left.
    """
    check_pattern(leds_m, needed=MIN_LEDS, flat=False)
    best_error, best = np.inf, None
    for start in starts(leds_m, _directions(image, projection)):
        pose = gauss_newton(leds_m, image, projection, start)
        if pose is None:
            continue
        R_cam_world, position_m = pose
        error = float(((image_of((leds_m - position_m) @ R_cam_world.T, projection)[0] - image) ** 2).sum())
        if position_m[2] < leds_m[:, 2].min() and error < best_error:
            best_error, best = error, position_m
    if best is None:
        raise EstimationFailure("position", "the collinearity equations do not converge")
    return best


def starts(leds_m: Floats, directions: Floats) -> list[Pose]:
    """Poses to start from, best first, for LEDs (n, 3) seen in these directions (n, 3) of the camera.

    Were the tilt known, the levelled spots would be similar to the LEDs on the ceiling, and the similarity would give
    yaw, height and place. So tilts are tried on a grid, and where the spots are more similar than at all tilts around
    is a start. LEDs of unequal height are taken for LEDs at their mean height.
    """
    axis = np.radians(np.arange(-START_REACH_DEG, START_REACH_DEG + START_STEP_DEG / 2, START_STEP_DEG))
    levelling = np.array([[rotation(tilt_x, tilt_y) for tilt_y in axis] for tilt_x in axis])
    rays = directions @ levelling
    up = (rays[..., 2] >= MIN_SINE).all(axis=-1)
    spots = (rays[..., 0] + 1j * rays[..., 1]) / np.where(up[..., None], rays[..., 2], 1.0)
    centred = spots - spots.mean(axis=-1, keepdims=True)
    ceiling = leds_m[:, 0] + 1j * leds_m[:, 1]
    offsets = ceiling - ceiling.mean()
    # spots = scale (ceiling - place), where the complex scale is e^(-i yaw) / depth.
    scale = centred @ offsets.conj() / np.vdot(offsets, offsets).real
    size = (np.abs(centred) ** 2).sum(axis=-1)
    up &= np.abs(scale) > 0
    misfits = (np.abs(centred - scale[..., None] * offsets) ** 2).sum(axis=-1) / np.where(up, size, 1.0)
    misfits[~up] = np.inf
    lowest = np.argwhere(up & (misfits == minimum_filter(misfits, size=3, mode="nearest")))
    poses = []
    for i, j in sorted(lowest.tolist(), key=lambda at: float(misfits[at[0], at[1]]))[:MAX_STARTS]:
        place = ceiling.mean() - spots[i, j].mean() / scale[i, j]
        c, s = scale[i, j].real / abs(scale[i, j]), -scale[i, j].imag / abs(scale[i, j])
        turn = levelling[i, j] @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        poses.append((turn, np.array([place.real, place.imag, leds_m[:, 2].mean() - 1 / abs(scale[i, j])])))
    return poses


def gauss_newton(leds_m: Floats, image: Floats, projection: Projection, start: Pose) -> Pose | None:
    """The pose at which the sum of squared differences from `image` (n, 2) stands still, or None where none is met."""
    R_cam_world, position_m = start
    for _ in range(MAX_STEPS):
        seen = (leds_m - position_m) @ R_cam_world.T
        expected, slopes = image_of(seen, projection)
        imaged = np.isfinite(expected).all() and np.isfinite(slopes).all()
        if not imaged or (projection == "perspective" and (seen[:, 2] <= 0).any()):
            return None
        # A small turn w after R moves p_cam by w x p_cam: no angles, and so no gimbal lock.
        turned = np.cross(np.eye(3)[None], seen[:, None])
        columns = np.concatenate([slopes @ -R_cam_world, slopes @ turned.transpose(0, 2, 1)], axis=2).reshape(-1, 6)
        step, *_ = np.linalg.lstsq(columns, (image - expected).ravel(), rcond=None)
        position_m = position_m + step[:3]
        R_cam_world = cv2.Rodrigues(step[3:])[0] @ R_cam_world
        if np.linalg.norm(step[:3]) <= TOLERANCE * np.linalg.norm(seen, axis=1).max() and (
            np.linalg.norm(step[3:]) <= TOLERANCE
        ):
            return R_cam_world, position_m
    return None


def image_of(seen: Floats, projection: Projection) -> tuple[Floats, Floats]:
    """Where points (n, 3) of the camera's axes are imaged, (n, 2) in units of the image distance; slopes (n, 2, 3)."""
    x, y, z = seen.T
    # What has no image, or lies beyond all numbers, is found by who asks.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if projection == "perspective":
            scale, by_z, by_rho = 1 / z, -1 / z**2, np.zeros_like(z)
        else:
            rho2 = x**2 + y**2
            rho, size2 = np.sqrt(rho2), rho2 + z**2
            near = rho < ON_AXIS * np.abs(z)
            scale = np.where(near, 1 / z, np.arctan2(rho, z) / rho)
            by_z = -1 / size2
            # Its slope along rho, divided by rho.
            by_rho = np.where(near, -2 / (3 * z**3), (z / size2 - scale) / rho2)
        image = seen[:, :2] * scale[:, None]
        slopes = np.zeros((len(seen), 2, 3))
        slopes[:, 0, 0] = slopes[:, 1, 1] = scale
        slopes[:, :, :2] += by_rho[:, None, None] * seen[:, :2, None] * seen[:, None, :2]
        slopes[:, :, 2] = seen[:, :2] * by_z[:, None]
    return image, slopes


def _directions(image: Floats, projection: Projection) -> Floats:
    """Unit vectors (n, 3) in the camera's axes to what is imaged there."""
    if projection == "perspective":
        ahead = np.column_stack([image, np.ones(len(image))])
        return np.asarray(ahead / np.linalg.norm(ahead, axis=1, keepdims=True))
    theta = np.linalg.norm(image, axis=1)
    return np.column_stack([image * np.sinc(theta / np.pi)[:, None], np.cos(theta)])
