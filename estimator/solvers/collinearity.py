"""Collinearity equations: position and rotation together from spots, by nonlinear least squares (SciPy).

An LED, the projection centre and the LED's image lie on one line: `p_cam = R (a - p)` for an LED at a, and its image is
the projection of `p_cam`. Each LED gives two equations in the six unknowns, p and R.
"""

import cmath
from functools import cache, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.optimize import leastsq

from estimator.camera.pose import Pose, rotation
from estimator.camera.projection import Projection
from estimator.compiled import compact, compiled, compiled_sums
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
# MINPACK's outcomes of a search that ends by one of the tolerances.
CONVERGED = (1, 2, 3, 4)
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
    leveling, centre_m = _tilt_grid(), leds_m.mean(axis=0)
    misfits, similarities = _similarities(leveling, compact(directions.T), compact((leds_m - centre_m).T))
    minima = np.argwhere(np.isfinite(misfits) & (misfits == minimum_filter(misfits, size=3, mode="nearest")))
    poses = []
    for i, j in sorted(minima.tolist(), key=lambda at: float(misfits[at[0], at[1]]))[:MAX_STARTS]:
        scale, mean = similarities[i, j].tolist()
        place, height_m = -mean / scale, 1 / abs(scale)
        R_cam_world = leveling[i, j] @ rotation(0.0, 0.0, -cmath.phase(scale))
        poses.append(Pose(centre_m + [place.real, place.imag, -height_m], R_cam_world))
    return poses


@compiled_sums
def _similarities(leveling: Floats, directions: Floats, offsets_m: Floats) -> tuple[Floats, NDArray[np.complex128]]:
    """Misfits (m, m) of similarities of LEDs and leveled spots, and the similarities (m, m, 2), for a grid of tilts.

    `leveling` (m, m, 3, 3) are the tilts' rotations, `directions` (3, n) the spots' unit vectors, `offsets_m` (3, n)
    those of the LEDs from their mean. A spot x + iy is scale (offset) + mean, where the complex scale is
    e^(-i yaw) / depth; scale and mean are the similarity. A misfit is relative to the spots' spread, and infinite where
    a spot is not above the horizon or the scale is zero.
    """
    rows, columns, count = len(leveling), leveling.shape[1], directions.shape[1]
    misfits = np.full((rows, columns), np.inf)
    similarities = np.zeros((rows, columns, 2), dtype=np.complex128)
    x, y, extent = np.empty(count), np.empty(count), 0.0
    for k in range(count):
        extent += offsets_m[0, k] ** 2 + offsets_m[1, k] ** 2
    for i in range(rows):
        for j in range(columns):
            # As numbers they stay in registers.
            (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = leveling[i, j, 0], leveling[i, j, 1], leveling[i, j, 2]
            up, mean_x, mean_y = 0, 0.0, 0.0
            for k in range(count):
                a, b, c = directions[0, k], directions[1, k], directions[2, k]
                depth = a * xz + b * yz + c * zz
                up += depth >= MIN_ELEVATION_SINE
                by_depth = 1 / depth
                x[k], y[k] = (a * xx + b * yx + c * zx) * by_depth, (a * xy + b * yy + c * zy) * by_depth
                mean_x += x[k]
                mean_y += y[k]
            if up < count:
                continue
            mean_x, mean_y = mean_x / count, mean_y / count
            real = imaginary = size = left = 0.0
            for k in range(count):
                at_x, at_y = x[k] - mean_x, y[k] - mean_y
                real += at_x * offsets_m[0, k] + at_y * offsets_m[1, k]
                imaginary += at_y * offsets_m[0, k] - at_x * offsets_m[1, k]
                size += at_x * at_x + at_y * at_y
            real, imaginary = real / extent, imaginary / extent
            if real == 0 and imaginary == 0:
                continue
            for k in range(count):
                off_x = x[k] - mean_x - (real * offsets_m[0, k] - imaginary * offsets_m[1, k])
                off_y = y[k] - mean_y - (real * offsets_m[1, k] + imaginary * offsets_m[0, k])
                left += off_x * off_x + off_y * off_y
            misfits[i, j] = left / size
            similarities[i, j, 0], similarities[i, j, 1] = complex(real, imaginary), complex(mean_x, mean_y)
    return misfits, similarities


@cache
def _tilt_grid() -> Floats:
    """Rotations of the grid of tilts, (n, n, 3, 3), the same for every frame."""
    axis = np.radians(np.arange(-MAX_START_DEG, MAX_START_DEG + START_STEP_DEG / 2, START_STEP_DEG))
    return np.array([[rotation(tilt_x, tilt_y) for tilt_y in axis.tolist()] for tilt_x in axis.tolist()])


def fit_pose(leds_m: Floats, image: Floats, projection: Projection, start: Pose) -> tuple[Pose, float] | None:
    """Pose at a local minimum of the squared differences from `image` (n, 2), and their sum, by least squares.

    None if an LED has no image at the start, or the fit does not converge.
    """
    leds_m = compact(leds_m)

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
        return _slopes(by_point, leds_m, pose.position_m, pose.R_cam_world, by_vector)

    vector = cv2.Rodrigues(start.R_cam_world)[0].ravel()
    first = np.concatenate([start.position_m, vector])
    if not np.isfinite(residuals(first)).all():
        return None
    # MINPACK's trust region shortens a step on which an LED loses its image, as one that lowers no sum: 3000 poses of
    # five kinds end where those of `least_squares` by "trf" do, in a third of its time.
    parameters, _, details, _, outcome = leastsq(
        residuals,
        first,
        Dfun=jacobian,
        full_output=True,
        xtol=STEP_TOLERANCE,
        ftol=COST_TOLERANCE,
        gtol=COST_TOLERANCE,
        maxfev=MAX_EVALUATIONS,
    )
    left = details["fvec"]
    return (seen(parameters.tobytes())[0], float(left @ left)) if outcome in CONVERGED else None


@compiled
def _slopes(by_point: Floats, leds_m: Floats, position_m: Floats, R_cam_world: Floats, by_vector: Floats) -> Floats:
    """Derivatives (2n, 6) of the images of LEDs (n, 3) by the position and the rotation vector.

    `by_point` (n, 2, 3) are those by the LEDs in camera axes, `by_vector` (3, 3, 3) of `R_cam_world` by the vector.
    """
    slopes = np.empty((2 * len(leds_m), 6))
    for i in range(len(leds_m)):
        for row in range(2):
            for k in range(3):
                by_position = by_turn = 0.0
                for axis in range(3):
                    turned = 0.0
                    for of in range(3):
                        turned += by_vector[k, axis, of] * (leds_m[i, of] - position_m[of])
                    by_position -= by_point[i, row, axis] * R_cam_world[axis, k]
                    by_turn += by_point[i, row, axis] * turned
                slopes[2 * i + row, k], slopes[2 * i + row, 3 + k] = by_position, by_turn
    return slopes
