"""Reprojection fit: the pose that minimizes the reprojection errors of spots, weighted by their covariances.

The weights are those of generalised least squares, by the covariance C of the spots (`estimator.solvers.observations`).
C depends on the pose, so the fit is repeated with C at its result. The position's covariance follows from C. Where the
device states no errors C is block-diagonal, and the fit is ordinary weighted least squares.

Where the camera has a rolling shutter, its velocity while the frame is read out is fitted with the pose, with a prior
(`estimator.solvers.shutter_motion`); the pose is that at mid-readout.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from estimator.camera.motion import MOTION_PARAMETERS
from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.compiled import compact, compiled
from estimator.errors import EstimationFailure
from estimator.solvers import second_order
from estimator.solvers.least_squares import Function, least_squares_minimum
from estimator.solvers.observations import Observations, moving_slopes, position_slopes, spot_slopes

Floats = NDArray[np.float64]
Loss = Literal["linear", "soft_l1"]

# With gravity, two spots have as many coordinates as a pose has parameters.
MIN_SPOTS = 2
# Residuals beyond this many standard deviations are weighted down by the robust loss.
ROBUST_SIGMA = 3.0
MAX_EVALUATIONS = 60
# Relative change of the sum, found and promised by the derivatives, at which a search ends.
TOLERANCE = 1e-8
# The same for a search that only has to tell how bad another minimum is.
COARSE_TOLERANCE = 0.2
# The slopes of a spot by the map change with the pose by a share of the error of the initial pose: the weights of the
# second repetition are those at a pose that is good to the errors stated.
RELINEARIZATIONS = 2
# Poses closer than both have the same weights, but for a thousandth.
NEAR_M = 3e-3
NEAR_RAD = 1e-3
# Share of the largest redundancy below which a spot's displacement is not controlled by other observations.
MIN_REDUNDANCY = 1e-9
UNDETERMINED = "the observations do not determine a pose"


@dataclass(frozen=True, eq=False)
class Fit:
    """Local minimum of the squared, whitened residuals.

    `cost` is the minimized sum of squares, or of a robust loss of them. `spots_chi2` (n,) is the share of each spot in
    the sum of squares: its chi-square, of two degrees of freedom, where spots are not correlated. `tilt_chi2` is that
    of gravity. `covariance_m2` (3, 3) is the position's, the first block of the inverse of the information matrix.

    `spots_score` (n, 2) and `spots_redundancy` (n, 2, 2) are of each spot q_i and P_ii, where P = C^-1 - C^-1 J (J^T
    C^-1 J + gravity)^-1 J^T C^-1 and q = P r with the residuals r (Baarda 1968): P_ii^-1 q_i is the displacement of the
    spot that the other observations say, and P_ii^-1 its covariance. `log_determinant` is that of the information
    matrix. `residuals` (2n + 2,) and `slopes` (2n + 2, 6), by the pose, are whitened, gravity last; `whitening` is that
    of the spots. `position_slopes` (3, 6) are those of the position by the parameters of the pose.

    With a rolling shutter the parameters are 12, those of the pose and the velocity, and the prior of the velocity is
    the last 6 of the residuals; `velocity` (6,) is the velocity found, `motion_chi2` the prior's sum of squares. With a
    global shutter `velocity` is (0,).
    """

    pose: Pose
    cost: float
    spots_chi2: Floats
    tilt_chi2: float
    covariance_m2: Floats
    spots_score: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    spots_redundancy: Floats = field(default_factory=lambda: np.zeros((0, 2, 2)))
    log_determinant: float = 0.0
    residuals: Floats = field(default_factory=lambda: np.zeros(0))
    slopes: Floats = field(default_factory=lambda: np.zeros((0, 6)))
    whitening: Floats = field(default_factory=lambda: np.zeros((0, 2, 2)))
    position_slopes: Floats = field(default_factory=lambda: np.zeros((3, 6)))
    velocity: Floats = field(default_factory=lambda: np.zeros(0))
    motion_chi2: float = 0.0

    def response(self, of_spots: Floats) -> tuple[Floats, Floats]:
        """Response of the fit to displacements of the model's spots, (n, 2, k).

        Returns the part that no change of the pose makes up for, whitened, of the shape of `residuals` and k, and the
        movements (3, k) of the position by the changes that do.
        """
        of_priors = np.zeros((len(self.slopes) - 2 * len(of_spots), of_spots.shape[2]))
        white = _whitened(self.whitening, of_spots, of_priors)
        steps = -np.linalg.lstsq(self.slopes, white, rcond=None)[0]
        return np.asarray(white + self.slopes @ steps), np.asarray(self.position_slopes @ steps)

    @property
    def chi2(self) -> float:
        """Sum of squares of all residuals."""
        return float(self.spots_chi2.sum()) + self.tilt_chi2 + self.motion_chi2

    def outlier_chi2(self, model_error: float = 0.0) -> Floats:
        """Chi-square (n,) of each spot's displacement from where the other observations put it, correlated or not.

        Of two degrees of freedom, or fewer for a spot that the others do not control. `model_error` is a standard
        deviation that is added to that of the displacement, in normalized coordinates.
        """
        redundancy, axes = np.linalg.eigh(self.spots_redundancy)
        along = np.einsum("nij,ni->nj", axes, self.spots_score)
        controlled = redundancy > MIN_REDUNDANCY * self._own_redundancy
        redundancy = np.where(controlled, redundancy, 1.0)
        terms = along**2 / (redundancy * (1 + model_error**2 * redundancy))
        return np.asarray(np.where(controlled, terms, 0.0).sum(axis=1))

    @property
    def _own_redundancy(self) -> float:
        """Scale of `spots_redundancy`, below a share of which rounding is all there is."""
        return float(np.abs(self.spots_redundancy).max(initial=0.0))


def fit(observations: Observations, start: Pose, loss: Loss = "linear") -> Fit:
    """Local minimum from an initial pose, by Levenberg-Marquardt with exact derivatives.

    A robust loss disregards the correlation of spots. Raises EstimationFailure if the observations do not determine a
    pose there.
    """
    at = start
    found = _fit(observations, at, _whitening(observations, at, loss), loss)
    if observations.correlated and loss == "linear":
        for _ in range(RELINEARIZATIONS):
            if _near(found.pose, at):
                break
            at = found.pose
            found = _fit(observations, at, _whitening(observations, at, loss), loss)
    return found


def coarse_fit(observations: Observations, start: Pose) -> tuple[Pose, float]:
    """A pose on the way to the local minimum from an initial one, and its sum of squares, about that of the minimum.

    A further step would lower the sum by less than COARSE_TOLERANCE. Raises EstimationFailure as `fit` does.
    """
    search = _Search(observations, _whitening(observations, start, "linear"))
    x, _, cost = search.minimum(start, "linear", COARSE_TOLERANCE)
    return search.pose_of(x), cost


def _near(one: Pose, other: Pose) -> bool:
    """Whether the spots have the same covariance at both poses, but for a thousandth."""
    moved_m = np.linalg.norm(one.position_m - other.position_m)
    return bool(moved_m < NEAR_M and np.linalg.norm(one.R_cam_world - other.R_cam_world) < NEAR_RAD)


def _whitening(observations: Observations, pose: Pose, loss: str) -> Floats:
    """Matrices that map residuals to ones of unit covariance: (n, 2, 2), or (2n, 2n) where spots are correlated."""
    if not observations.correlated:
        return (
            observations.whitening if observations.added_sigma_px == 0 else _inverse_root(observations.own_covariance())
        )
    total = observations.covariance(pose)
    if loss == "linear":
        return _inverse_root(total)
    count = len(observations.leds_m)
    return _inverse_root(total.reshape(count, 2, count, 2)[np.arange(count), :, np.arange(count)])


def _inverse_root(covariance: Floats) -> Floats:
    """Inverse of the Cholesky factor of a matrix or matrices; raises EstimationFailure."""
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise EstimationFailure("position", "the covariance of the spots is not positive definite") from None


def _whitened(whitening: Floats, of_spots: Floats, of_priors: Floats) -> Floats:
    """Residuals or slopes (n, 2, k) of spots, whitened, above those of priors (m, k), whitened before: (2n + m, k)."""
    if whitening.ndim == 3:
        return _whitened_each(compact(whitening), compact(of_spots), compact(of_priors))
    return np.concatenate([whitening @ of_spots.reshape(2 * len(of_spots), -1), of_priors])


@compiled
def _whitened_each(whitening: Floats, of_spots: Floats, of_priors: Floats) -> Floats:
    """See `_whitened`, with a `whitening` (n, 2, 2) of each spot."""
    count, columns = len(of_spots), of_spots.shape[2]
    white = np.empty((2 * count + len(of_priors), columns))
    for i in range(count):
        for row in range(2):
            for k in range(columns):
                of_x, of_y = whitening[i, row, 0] * of_spots[i, 0, k], whitening[i, row, 1] * of_spots[i, 1, k]
                white[2 * i + row, k] = of_x + of_y
    for row in range(len(of_priors)):
        for k in range(columns):
            white[2 * count + row, k] = of_priors[row, k]
    return white


class _Search:
    """Residuals of a pose and velocity, whitened, and their derivatives, by a vector of parameters (6,) or (12,)."""

    def __init__(self, observations: Observations, whitening: Floats) -> None:
        self.observations, self.whitening = observations, whitening
        self.centre = observations.leds_m.mean(axis=0)
        self.model = compact(observations.leds_m - self.centre)

    def pose_of(self, x: Floats) -> Pose:
        """The pose of parameters."""
        R_cam_world = cv2.Rodrigues(x[:3])[0]
        return Pose(self.centre - R_cam_world.T @ x[3:POSE_PARAMETERS], R_cam_world)

    def residuals(self, x: Floats) -> Floats:
        """Residuals (2n + 2,), or (2n + 8,) with those of the velocity."""
        observations = self.observations
        pose, velocity = self.pose_of(x), x[POSE_PARAMETERS:]
        offset = observations.images(pose, velocity)[0] - observations.image
        of_priors = _tilt_residual(pose, observations)
        if observations.motion is not None:
            of_priors = np.concatenate([of_priors, observations.motion.residuals(velocity)])
        return _whitened(self.whitening, offset[:, :, None], of_priors[:, None])[:, 0]

    def jacobian(self, x: Floats) -> Floats:
        """Derivatives of the residuals."""
        observations, motion = self.observations, self.observations.motion
        # The eccentricity changes these by s^2 / d^2: some millionths for an LED of 1 cm, a hundredth for one of 60 cm.
        R_cam_world, by_vector = cv2.Rodrigues(x[:3])
        by_vector = by_vector.reshape(3, 3, 3)
        of_tilts = _tilt_jacobian(R_cam_world, by_vector, observations)
        if motion is None:
            of_image = spot_slopes(self.model, R_cam_world, by_vector, x[3:])
            return _whitened(self.whitening, of_image, of_tilts)
        of_image = moving_slopes(observations, self.pose_of(x), x[POSE_PARAMETERS:], x)
        of_priors = np.zeros((2 + MOTION_PARAMETERS, POSE_PARAMETERS + MOTION_PARAMETERS))
        of_priors[:2, :POSE_PARAMETERS] = of_tilts
        of_priors[2:, POSE_PARAMETERS:] = np.diag(1 / motion.prior.sigmas)
        return _whitened(self.whitening, of_image, of_priors)

    def minimum(self, start: Pose, loss: Loss, tolerance: float) -> tuple[Floats, Floats, float]:
        """Parameters at the minimum, the residuals there, and their sum; raises EstimationFailure."""
        motion = self.observations.motion
        try:
            if len(self.model) < MIN_SPOTS:
                raise ValueError("fewer observations than parameters")
            with np.errstate(all="ignore"):
                vector = cv2.Rodrigues(start.R_cam_world)[0].ravel()
                velocity = np.zeros(0) if motion is None else motion.prior.velocity
                shift = start.R_cam_world @ (self.centre - start.position_m)
                x0 = np.concatenate([vector, shift, velocity])
                if loss == "soft_l1":
                    return _robustly(self.residuals, x0, self.jacobian)
                return least_squares_minimum(self.residuals, x0, self.jacobian, tolerance, MAX_EVALUATIONS)
        except (np.linalg.LinAlgError, ValueError, cv2.error):
            raise EstimationFailure("position", UNDETERMINED) from None


def _fit(observations: Observations, start: Pose, whitening: Floats, loss: Loss) -> Fit:
    search, count, motion = _Search(observations, whitening), len(observations.leds_m), observations.motion
    x, at_minimum, cost = search.minimum(start, loss, TOLERANCE)
    try:
        with np.errstate(all="ignore"):
            slope = search.jacobian(x)
            information = slope.T @ slope
            covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    except (np.linalg.LinAlgError, cv2.error):
        raise EstimationFailure("position", UNDETERMINED) from None
    pose = search.pose_of(x)
    of_spots = at_minimum[: 2 * count]
    of_position = np.zeros((3, len(x)))
    of_position[:, :POSE_PARAMETERS] = position_slopes(x[:POSE_PARAMETERS])
    covariance_m2 = of_position @ covariance @ of_position.T
    if motion is not None:
        covariance_m2 = covariance_m2 + second_order.of_pose_vector(x, covariance)
    # At the minimum J^T C^-1 r with the shares of gravity and motion is zero, and so q = C^-1 r.
    if whitening.ndim == 3:
        score, redundancy = _redundancy_each(compact(whitening), of_spots, slope, covariance)
    else:
        roots = whitening.reshape(2 * count, count, 2)
        score = (whitening.T @ of_spots).reshape(-1, 2)
        pulled = (whitening.T @ slope[: 2 * count]).reshape(count, 2, -1)
        redundancy = np.einsum("kia,kib->iab", roots, roots) - pulled @ covariance @ pulled.transpose(0, 2, 1)
    return Fit(
        pose=pose,
        cost=cost,
        spots_chi2=(of_spots.reshape(-1, 2) ** 2).sum(axis=1),
        tilt_chi2=float((at_minimum[2 * count : 2 * count + 2] ** 2).sum()),
        covariance_m2=covariance_m2,
        position_slopes=of_position,
        spots_score=score,
        spots_redundancy=redundancy,
        log_determinant=float(np.linalg.slogdet(information)[1]),
        residuals=at_minimum,
        slopes=slope,
        whitening=whitening,
        velocity=x[POSE_PARAMETERS:],
        motion_chi2=float((at_minimum[2 * count + 2 :] ** 2).sum()),
    )


@compiled
def _redundancy_each(whitening: Floats, of_spots: Floats, slopes: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """`spots_score` (n, 2) and `spots_redundancy` (n, 2, 2) of a `Fit` with a `whitening` (n, 2, 2) of each spot.

    `of_spots` (2n,) are the whitened residuals of the spots, `slopes` (2n + m, k) those of all residuals by the
    parameters, which have the `covariance` (k, k).
    """
    count, parameters = len(whitening), len(covariance)
    score, redundancy = np.zeros((count, 2)), np.zeros((count, 2, 2))
    pulled = np.empty((2, parameters))
    for i in range(count):
        for a in range(2):
            for row in range(2):
                score[i, a] += whitening[i, row, a] * of_spots[2 * i + row]
            for k in range(parameters):
                pulled[a, k] = 0.0
                for row in range(2):
                    pulled[a, k] += whitening[i, row, a] * slopes[2 * i + row, k]
        for a in range(2):
            for b in range(2):
                for row in range(2):
                    redundancy[i, a, b] += whitening[i, row, a] * whitening[i, row, b]
                for k in range(parameters):
                    for other in range(parameters):
                        redundancy[i, a, b] -= pulled[a, k] * covariance[k, other] * pulled[b, other]
    return score, redundancy


def _robustly(residuals: Function, x0: Floats, jacobian: Function) -> tuple[Floats, Floats, float]:
    """Minimum of the sum of a robust loss of the squares from x0, the residuals there, and the sum."""
    found = least_squares(
        residuals, x0, jacobian, loss="soft_l1", f_scale=ROBUST_SIGMA, x_scale="jac", max_nfev=MAX_EVALUATIONS
    )
    return found.x, residuals(found.x), 2 * float(found.cost)


def _tilt_residual(pose: Pose, observations: Observations) -> Floats:
    """Tilts of a pose minus the accelerometer's, in standard deviations, (2,)."""
    x, y, z = pose.R_cam_world[:, 2].tolist()
    tilts = math.atan2(y, z), -math.asin(min(max(x, -1.0), 1.0))
    read, sigmas = observations.tilt_rad.tolist(), observations.tilt_sigma_rad.tolist()
    off = [math.remainder(tilt - one, 2 * math.pi) for tilt, one in zip(tilts, read, strict=True)]
    return np.array([one / sigma for one, sigma in zip(off, sigmas, strict=True)])


def _tilt_jacobian(R_cam_world: Floats, by_vector: Floats, observations: Observations) -> Floats:
    """Derivatives of `_tilt_residual` by the six parameters, (2, 6).

    `by_vector` (3, 3, 3) are those of `R_cam_world` by the first three, its rotation vector.
    """
    slopes, (sigma_x, sigma_y) = np.zeros((2, POSE_PARAMETERS)), observations.tilt_sigma_rad.tolist()
    _, up_y, up_z = R_cam_world[:, 2].tolist()
    # tilt_x is undefined where the camera's x axis is vertical.
    across2 = max(up_y**2 + up_z**2, 1e-12)
    for k, (by_x, by_y, by_z) in enumerate(by_vector[:, :, 2].tolist()):
        slopes[0, k] = (up_z * by_y - up_y * by_z) / across2 / sigma_x
        slopes[1, k] = -by_x / math.sqrt(across2) / sigma_y
    return slopes
