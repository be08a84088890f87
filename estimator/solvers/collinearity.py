"""Collinearity equations: position and rotation together from spots, by nonlinear least squares (SciPy).

An LED, the projection centre and the LED's image lie on one line: `p_cam = R (a - p)` for an LED at a, and its image is
the projection of `p_cam`. Each LED gives two equations in the six unknowns, p and R.
"""

from functools import cache, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.optimize import least_squares

from estimator.camera.pose import Pose, rotation
from estimator.camera.projection import Projection
from estimator.errors import EstimationFailure
from estimator.solvers.trilateration import check_pattern

Floats = NDArray[np.float64]

# With three LEDs up to four poses fit exactly.
MIN_LEDS = 4
# Grid of tilts tried as initial values, on each axis, and the number of its minima that are refined.
START_STEP_DEG = 7.5
MAX_START_DEG = 75.0
MAX_STARTS = 4
MAX_EVALUATIONS = 100
# A relative step this small is the last: convergence is quadratic, so the next would be its square, or rounding.
STEP_TOLERANCE = 1e-10
# Relative change of the cost: at 1e-15 the position is within 3e-8 standard deviations of the minimum.
COST_TOLERANCE = 1e-15
# A leveled ray at a smaller sine of elevation meets the ceiling some ten room heights away.
MIN_ELEVATION_SINE = 0.1


def position_by_collinearity(leds_m: Floats, image: Floats, projection: Projection) -> Floats:
    """Position of the camera, (3,) world metres, from LEDs (n, 3) and their images (n, 2), without gravity.

    `image` is in normalized image coordinates. Among the poses that the fit converges to from `starts`, with the camera
    below the LEDs and the LEDs in its valid range, the one with the smallest sum of squares is returned. Raises
    EstimationFailure for fewer than four LEDs, LEDs on one line, and if there is no such pose.
    """
    check_pattern(leds_m, needed=MIN_LEDS, flat=False)
    min_error, best = np.inf, None
    for start in starts(leds_m, projection.unproject(image)):
        fitted = fit_pose(leds_m, image, projection, start)
        if fitted is None:
            continue
        pose, error = fitted
        if pose.position_m[2] < leds_m[:, 2].min() and error < min_error:
            min_error, best = error, pose.position_m
    if best is None:
        raise EstimationFailure("position", "the collinearity equations do not converge")
    return best


def starts(leds_m: Floats, directions: Floats) -> list[Pose]:
    """Initial poses, best first, for LEDs (n, 3) seen in the directions (n, 3), unit vectors in camera axes.

    If the tilt were known, the leveled spots would be similar to the LEDs on the ceiling, and the similarity would give
    yaw, height and position. Tilts are therefore tried on a grid. Each local minimum of the misfit of the similarity is
    an initial pose. LEDs at different heights are treated as LEDs at their mean height.
    """
    leveling = _tilt_grid()
    rays = directions @ leveling
    up: NDArray[np.bool_] = np.asarray((rays[..., 2] >= MIN_ELEVATION_SINE).all(axis=-1))
    spots = (rays[..., 0] + 1j * rays[..., 1]) / np.where(up[..., None], rays[..., 2], 1.0)
    centred = spots - spots.mean(axis=-1, keepdims=True)
    ceiling = leds_m[:, 0] + 1j * leds_m[:, 1]
    offsets = ceiling - ceiling.mean()
    # spots = scale (ceiling - place), where the complex scale is e^(-i yaw) / depth.
    scale = centred @ offsets.conj() / np.vdot(offsets, offsets).real
    size = _squares(centred)
    up &= np.abs(scale) > 0
    misfits = _squares(centred - scale[..., None] * offsets) / np.where(up, size, 1.0)
    misfits[~up] = np.inf
    minima = np.argwhere(up & (misfits == minimum_filter(misfits, size=3, mode="nearest")))
    poses = []
    for i, j in sorted(minima.tolist(), key=lambda at: float(misfits[at[0], at[1]]))[:MAX_STARTS]:
        place = ceiling.mean() - spots[i, j].mean() / scale[i, j]
        R_cam_world = leveling[i, j] @ rotation(0.0, 0.0, -float(np.angle(scale[i, j])))
        position_m = np.array([place.real, place.imag, leds_m[:, 2].mean() - 1 / abs(scale[i, j])])
        poses.append(Pose(position_m, R_cam_world))
    return poses


def _squares(values: NDArray[np.complex128]) -> Floats:
    """Sums of the squared magnitudes along the last axis, without their roots."""
    return np.asarray((values.real**2 + values.imag**2).sum(axis=-1))


@cache
def _tilt_grid() -> Floats:
    """Rotations of the grid of tilts, (n, n, 3, 3), the same for every frame."""
    axis = np.radians(np.arange(-MAX_START_DEG, MAX_START_DEG + START_STEP_DEG / 2, START_STEP_DEG))
    return np.array([[rotation(tilt_x, tilt_y) for tilt_y in axis.tolist()] for tilt_x in axis.tolist()])


def fit_pose(leds_m: Floats, image: Floats, projection: Projection, start: Pose) -> tuple[Pose, float] | None:
    """Pose at a local minimum of the squared differences from `image` (n, 2), and their sum, by least squares.

    None if an LED has no image at the start, or the fit does not converge.
    """

    @lru_cache(maxsize=1)
    def seen(packed: bytes) -> tuple[Pose, Floats, Floats, Floats]:
        # Residuals and derivatives are asked for at the same parameters, one after the other.
        parameters = np.frombuffer(packed).copy()
        R_cam_world, by_vector = cv2.Rodrigues(parameters[3:])
        pose = Pose(parameters[:3], np.asarray(R_cam_world, dtype=np.float64))
        found, by_point = projection.project(pose.in_camera(leds_m))
        # Derivative of the rotation by its vector, (3, 9), row by row.
        return pose, found, by_point, np.asarray(by_vector.reshape(3, 3, 3), dtype=np.float64)

    def residuals(parameters: Floats) -> Floats:
        return np.asarray(seen(parameters.tobytes())[1] - image).ravel()

    def jacobian(parameters: Floats) -> Floats:
        pose, _, by_point, by_vector = seen(parameters.tobytes())
        rotated = np.einsum("kij,nj->nik", by_vector, leds_m - pose.position_m)
        return np.concatenate([by_point @ -pose.R_cam_world, by_point @ rotated], axis=2).reshape(-1, 6)

    vector = cv2.Rodrigues(start.R_cam_world)[0].ravel()
    first = np.concatenate([start.position_m, vector])
    if not np.isfinite(residuals(first)).all():
        return None
    # MINPACK's trust region shortens a step on which an LED loses its image, as one that lowers no sum: 3000 poses of
    # five kinds end where those of "trf" do, in a third of its time.
    found = least_squares(
        residuals,
        first,
        jacobian,
        method="lm",
        x_scale="jac",
        xtol=STEP_TOLERANCE,
        ftol=COST_TOLERANCE,
        gtol=COST_TOLERANCE,
        max_nfev=MAX_EVALUATIONS,
    )
    return (seen(found.x.tobytes())[0], 2 * float(found.cost)) if found.success else None
