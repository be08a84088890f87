"""Reprojection fit: the pose that minimizes the reprojection errors of spots, weighted by their covariances.

The weights are those of generalised least squares. What the device does not know exactly, but states how well it knows,
moves spots together (`estimator.solvers.uncertainty`): with S the covariance of those errors and J the slopes of the
spots by them, the spots have the covariance C = C_centroids + J S J^T, which is not block-diagonal. J depends on the
pose, so the fit is repeated with C at its result. The position's covariance follows from C. Without such statements C
is block-diagonal, and the fit is ordinary weighted least squares.

The centroid of an LED's image differs from the image of the LED's centre; photogrammetry calls the difference
eccentricity (Lenz & Fritsch 1990). Here it has a closed form. A face of uniform luminance, at X from the camera,
illuminates the image plane in proportion to z / |X|^4 per unit of its own area: its solid angle, and the lens's cos^4.
The centroid of its image is then the image of M = mean of X / |X|^4 over the face. With the mean X0, at the distance d,
the upward normal n, and the mean square extent s^2 along any direction of the face, X / |X|^4 to second order puts M
along X0 + 4 s^2 (n . X0) / d^2 n: **the image of a point above the LED by 4 s^2 h / d^2**, where h is the LED's height
above the camera. s^2 is r^2 / 4 for a disc of radius r, and a^2 / 12 for a square of side a. The next order is
r^4 / h^3, a nanometre.

The closed form holds in a pinhole's image plane. A lens that bends straight lines also bends the image of an LED, and
the undistorted centroid is then not the centroid of the undistorted image. `corrected_for_eccentricity` subtracts that
difference once a pose determines the size of the images.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from estimator.camera.leveling import tilt_from_gravity, tilt_sigmas
from estimator.camera.pose import Pose
from estimator.camera.projection import projection_of
from estimator.camera.undistort import has_pinhole_image, pinhole_image
from estimator.errors import EstimationFailure
from estimator.io.device import Camera, DeviceFrame
from estimator.solvers.uncertainty import Uncertainty, assumed_uncertainty, uncertainty
from estimator.spots.correspondences import centroids_px, led_positions_m
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]

# Added to every centroid's covariance, so that a spot without noise has a finite weight.
MIN_CENTROID_SIGMA_PX = 1e-4
# Residuals beyond this many standard deviations are weighted down by the robust loss.
ROBUST_SIGMA = 3.0
MAX_EVALUATIONS = 60
# The slopes of a spot by the map change with the pose by a share of the error of the initial pose: the weights of the
# second repetition are those at a pose that is good to the errors stated.
RELINEARIZATIONS = 2
# Poses closer than both have the same weights, but for a thousandth.
NEAR_M = 3e-3
NEAR_RAD = 1e-3
# Share of the largest redundancy below which a spot's displacement is not controlled by other observations.
MIN_REDUNDANCY = 1e-9


@dataclass(frozen=True, eq=False)
class Observations:
    """Input of a fit: centroids in a pinhole's image plane, and a reading of gravity.

    `leds_m` (n, 3) are the centres of the LEDs, world metres; `lift_m2` (n,) is 4 s^2 of each LED, m^2, see the module.
    `image` (n, 2) are centroids in normalized pinhole coordinates; `whitening` (n, 2, 2) maps an offset in them to one
    of unit covariance, by the centroids' own errors; `from_pixels` (n, 2, 2) maps an offset in pixels to one in them.
    `tilt_rad` (2,) is (tilt_x, tilt_y) by the accelerometer, `tilt_sigma_rad` (2,) its standard deviations, infinite if
    gravity is not used. `uncertainty` are the errors of camera and map that the device states, whose standard
    deviations count `scale` times; `added_sigma_px` is a further standard deviation of each centroid, for errors that
    the device does not state.
    """

    leds_m: Floats
    lift_m2: Floats
    camera: Camera
    image: Floats
    whitening: Floats
    from_pixels: Floats
    tilt_rad: Floats
    tilt_sigma_rad: Floats
    uncertainty: Uncertainty
    scale: float = 1.0
    added_sigma_px: float = 0.0

    @property
    def correlated(self) -> bool:
        """Whether errors of camera or map move spots together."""
        return len(self.uncertainty.sigmas) > 0

    def covariance(self, pose: Pose) -> Floats:
        """Covariance (2n, 2n) of the spots at a pose, in normalized pinhole coordinates, (x, y) of each in turn."""
        count = len(self.leds_m)
        total = np.zeros((count, 2, count, 2))
        if self.correlated:
            # An LED without an image at this pose, an outlier, has no slopes.
            slopes = np.nan_to_num(self.uncertainty.slopes_px(pose) * (self.scale * self.uncertainty.sigmas))
            slopes = self.from_pixels @ slopes
            flat = slopes.reshape(2 * count, -1)
            total = (flat @ flat.T).reshape(count, 2, count, 2)
        every = np.arange(count)
        total[every, :, every] += self.own_covariance()
        return np.asarray(total.reshape(2 * count, 2 * count))

    def own_covariance(self) -> Floats:
        """Covariance (n, 2, 2) of each spot by its centroid's own errors and `added_sigma_px`."""
        spread = np.linalg.inv(self.whitening)
        added = self.added_sigma_px**2 * (self.from_pixels @ self.from_pixels.transpose(0, 2, 1))
        return np.asarray(spread @ spread.transpose(0, 2, 1) + added)

    def with_assumed_camera(self) -> "Observations":
        """The same spots; a camera that states nothing has the errors of one as sold."""
        if self.camera.uncertainty is not None:
            return self
        camera = self.camera.model_copy(update={"uncertainty": assumed_uncertainty(self.camera)})
        return replace(self, uncertainty=self.uncertainty.with_camera(camera))

    def without_gravity(self) -> "Observations":
        """The same spots without gravity."""
        return replace(self, tilt_sigma_rad=np.full(2, np.inf))

    def only(self, chosen: NDArray[np.bool_]) -> "Observations":
        """The chosen spots, (n,), with the same gravity."""
        return replace(
            self,
            leds_m=self.leds_m[chosen],
            lift_m2=self.lift_m2[chosen],
            image=self.image[chosen],
            whitening=self.whitening[chosen],
            from_pixels=self.from_pixels[chosen],
            uncertainty=self.uncertainty.only(chosen),
        )


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

    def response(self, of_spots: Floats) -> tuple[Floats, Floats]:
        """Response of the fit to displacements of the model's spots, (n, 2, k).

        Returns the part that no change of the pose makes up for, whitened, (2n + 2, k), and the movements (3, k) of the
        position by the changes that do.
        """
        white = np.vstack([_whitened(self.whitening, of_spots), np.zeros((2, of_spots.shape[2]))])
        steps = -np.linalg.lstsq(self.slopes, white, rcond=None)[0]
        return np.asarray(white + self.slopes @ steps), np.asarray(self.position_slopes @ steps)

    @property
    def chi2(self) -> float:
        """Sum of squares of all residuals."""
        return float(self.spots_chi2.sum()) + self.tilt_chi2

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


def observe(
    frame: DeviceFrame, correspondences: Sequence[Correspondence], centroid_sigma_px: float = 0.0
) -> Observations:
    """Observations of a frame; spots that cannot be undistorted are left out.

    `centroid_sigma_px` is a standard deviation of each centroid's coordinates beside that by the pixels' noise. Raises
    EstimationFailure if the accelerometer reads zero or no spot is left.
    """
    camera = frame.camera
    usable = has_pinhole_image(centroids_px(correspondences), camera)
    if usable.any():
        correspondences = [one for one, use in zip(correspondences, usable, strict=True) if use]
    image = pinhole_image(centroids_px(correspondences), camera)
    covariance_px2 = np.array([one.spot.covariance_px2 for one in correspondences]).reshape(-1, 2, 2)
    added_px2 = MIN_CENTROID_SIGMA_PX**2 + centroid_sigma_px**2
    # At depth 1 the projection's Jacobian by x and y is that from pinhole coordinates to the lens's.
    rays = np.column_stack([image, np.ones(len(image))])
    to_pixels = camera.matrix()[:2, :2] @ projection_of(camera).project(rays)[1][:, :, :2]
    from_pixels = np.linalg.inv(to_pixels)
    covariance = from_pixels @ (covariance_px2 + added_px2 * np.eye(2)) @ from_pixels.transpose(0, 2, 1)
    tilt, tilt_sigma_rad = (0.0, 0.0), np.full(2, np.inf)
    if frame.accelerometer is not None:
        tilt = tilt_from_gravity(frame.accelerometer_m_s2)
        tilt_sigma_rad = tilt_sigmas(frame.accelerometer, tilt[1])
    return Observations(
        leds_m=led_positions_m(correspondences),
        lift_m2=np.array([4 * one.led.mean_square_extent_m2 for one in correspondences]),
        camera=camera,
        image=image,
        whitening=np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=np.float64),
        from_pixels=np.asarray(from_pixels, dtype=np.float64),
        tilt_rad=np.array(tilt),
        tilt_sigma_rad=tilt_sigma_rad,
        uncertainty=uncertainty(camera, [one.led for one in correspondences], frame.luminaires, frame.map_datum),
    )


def centroid_images(pose: Pose, leds_m: Floats, lift_m2: Floats) -> tuple[Floats, Floats]:
    """Centroids (n, 2) of the images of LEDs (n, 3) in the pinhole's image plane, and the LEDs' depths (n,), metres."""
    offset = leds_m - pose.position_m
    lifted = leds_m.copy()
    lifted[:, 2] += lift_m2 * offset[:, 2] / (offset**2).sum(axis=1)
    p_cam = pose.in_camera(lifted)
    # An LED behind the camera has no image; here it only has to be far off, and finite.
    depth = np.where(np.abs(p_cam[:, 2]) < 1e-9, 1e-9, p_cam[:, 2])
    return p_cam[:, :2] / depth[:, None], p_cam[:, 2]


def pose_slopes(observations: Observations, pose: Pose) -> tuple[Floats, Floats]:
    """Derivatives by six parameters of a pose: of spots in normalized coordinates (n, 2, 6), of the position (3, 6).

    The parameters are a rotation vector and a translation of the LEDs about their mean.
    """
    centre = observations.leds_m.mean(axis=0)
    vector = Rotation.from_matrix(pose.R_cam_world).as_rotvec()
    x = np.concatenate([vector, pose.R_cam_world @ (centre - pose.position_m)])
    model = np.ascontiguousarray(observations.leds_m - centre)
    of_image = cv2.projectPoints(model, x[:3], x[3:], np.eye(3), None)[1][:, :6].reshape(-1, 2, 6)
    return of_image, _position_slopes(x)


def corrected_for_eccentricity(observations: Observations, pose: Pose) -> Observations:
    """Observations with centroids as a lens that does not bend the images would have them, of the size by a pose.

    Each LED is represented by four points, sqrt(2) s from its centre along x and y, which have its s^2. Their images
    are weighted by the lens's irradiance, z / |X|^4, for any lens: a lens that spreads light over more pixels makes it
    dimmer. An LED with a point that has no image is not corrected.
    """
    steps = np.sqrt(observations.lift_m2 / 2)[:, None, None] * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    points_m = (observations.leds_m[:, None] + steps).reshape(-1, 3)
    p_cam = pose.in_camera(points_m)
    camera = observations.camera
    lens_image = projection_of(camera).project(p_cam)[0].reshape(-1, 4, 2)
    p_cam = p_cam.reshape(-1, 4, 3)
    imaged = (p_cam[..., 2] > 0).all(axis=1) & np.isfinite(lens_image).all(axis=(1, 2))
    p_cam, lens_image = p_cam[imaged], lens_image[imaged]
    weights = p_cam[..., 2] / (p_cam**2).sum(axis=2) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    lens_centroids = pinhole_image(camera.to_pixels((weights[..., None] * lens_image).sum(axis=1)), camera)
    pinhole_centroids = (weights[..., None] * p_cam[..., :2] / p_cam[..., 2:]).sum(axis=1)
    image = observations.image.copy()
    image[imaged] -= lens_centroids - pinhole_centroids
    return replace(observations, image=image)


def fit(observations: Observations, start: Pose, loss: Literal["linear", "soft_l1"] = "linear") -> Fit:
    """Local minimum from an initial pose, by Levenberg-Marquardt (SciPy) with exact derivatives.

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


def _whitened(whitening: Floats, of_spots: Floats) -> Floats:
    """Residuals (n, 2) or slopes (n, 2, k) of spots, whitened, (2n,) or (2n, k)."""
    flat = of_spots.reshape(2 * len(of_spots), *of_spots.shape[2:])
    if whitening.ndim == 2:
        return np.asarray(whitening @ flat)
    return np.asarray(np.einsum("nij,nj...->ni...", whitening, of_spots)).reshape(flat.shape)


def _fit(observations: Observations, start: Pose, whitening: Floats, loss: Literal["linear", "soft_l1"]) -> Fit:
    centre = observations.leds_m.mean(axis=0)
    model = np.ascontiguousarray(observations.leds_m - centre)

    def pose_of(x: Floats) -> Pose:
        R_cam_world = np.asarray(Rotation.from_rotvec(x[:3]).as_matrix())
        return Pose(centre - R_cam_world.T @ x[3:], R_cam_world)

    def residuals(x: Floats) -> Floats:
        pose = pose_of(x)
        offset = centroid_images(pose, observations.leds_m, observations.lift_m2)[0] - observations.image
        return np.concatenate([_whitened(whitening, offset), _tilt_residual(pose, observations)])

    def jacobian(x: Floats) -> Floats:
        # The lift of an LED, some micrometres, changes these by some millionths.
        of_image = cv2.projectPoints(model, x[:3], x[3:], np.eye(3), None)[1][:, :6].reshape(-1, 2, 6)
        return np.vstack([_whitened(whitening, of_image), _tilt_jacobian(x, observations)])

    try:
        with np.errstate(all="ignore"):
            vector = Rotation.from_matrix(start.R_cam_world).as_rotvec()
            x0 = np.concatenate([vector, start.R_cam_world @ (centre - start.position_m)])
            # MINPACK ("lm") is several times faster, and has no robust loss.
            found = least_squares(
                residuals,
                x0,
                jacobian,
                method="lm" if loss == "linear" else "trf",
                loss=loss,
                f_scale=ROBUST_SIGMA,
                x_scale="jac",
                max_nfev=MAX_EVALUATIONS,
            )
            # SciPy's own Jacobian is scaled by the robust loss, and so is not the information.
            slope = jacobian(found.x)
            information = slope.T @ slope
            covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    except (np.linalg.LinAlgError, ValueError, cv2.error):
        raise EstimationFailure("position", "the observations do not determine a pose") from None
    pose = pose_of(found.x)
    at_minimum = residuals(found.x)
    count = len(observations.leds_m)
    of_spots = at_minimum[: 2 * count]
    position_slopes = _position_slopes(found.x)
    # At the minimum J^T C^-1 r with gravity's share is zero, and so q = C^-1 r.
    roots = whitening.reshape(2 * count, count, 2) if whitening.ndim == 2 else None
    if roots is None:
        score = np.einsum("nji,nj->ni", whitening, of_spots.reshape(-1, 2))
        own = whitening.transpose(0, 2, 1) @ whitening
        pulled = whitening.transpose(0, 2, 1) @ slope[: 2 * count].reshape(-1, 2, 6)
    else:
        score = (whitening.T @ of_spots).reshape(-1, 2)
        own = np.einsum("kia,kib->iab", roots, roots)
        pulled = (whitening.T @ slope[: 2 * count]).reshape(-1, 2, 6)
    return Fit(
        pose=pose,
        cost=2 * float(found.cost),
        spots_chi2=(of_spots.reshape(-1, 2) ** 2).sum(axis=1),
        tilt_chi2=float((at_minimum[2 * count :] ** 2).sum()),
        covariance_m2=position_slopes @ covariance @ position_slopes.T,
        position_slopes=position_slopes,
        spots_score=score,
        spots_redundancy=own - pulled @ covariance @ pulled.transpose(0, 2, 1),
        log_determinant=float(np.linalg.slogdet(information)[1]),
        residuals=at_minimum,
        slopes=slope,
        whitening=whitening,
    )


def _tilt_residual(pose: Pose, observations: Observations) -> Floats:
    """Tilts of a pose minus the accelerometer's, in standard deviations, (2,)."""
    x, y, z = pose.R_cam_world[:, 2]
    off = np.array([np.arctan2(y, z), -np.arcsin(np.clip(x, -1, 1))]) - observations.tilt_rad
    # Wrapped to -pi ... pi.
    return np.asarray((off + np.pi) % (2 * np.pi) - np.pi) / observations.tilt_sigma_rad


def _tilt_jacobian(x: Floats, observations: Observations) -> Floats:
    """Derivatives of `_tilt_residual` by the six parameters, (2, 6)."""
    R_cam_world, by_vector = cv2.Rodrigues(x[:3])
    up_y, up_z = R_cam_world[1:, 2]
    by_x, by_y, by_z = by_vector[:, [2, 5, 8]].T
    # tilt_x is undefined where the camera's x axis is vertical.
    across2 = max(up_y**2 + up_z**2, 1e-12)
    slopes = np.zeros((2, 6))
    slopes[0, :3] = (up_z * by_y - up_y * by_z) / across2
    slopes[1, :3] = -by_x / np.sqrt(across2)
    return slopes / observations.tilt_sigma_rad[:, None]


def _position_slopes(x: Floats) -> Floats:
    """Derivatives (3, 6) of `centre - R^T t` by the rotation vector and t."""
    R_cam_world, by_vector = cv2.Rodrigues(x[:3])
    by_rotation = np.column_stack([-by_vector[k].reshape(3, 3).T @ x[3:] for k in range(3)])
    return np.hstack([by_rotation, -R_cam_world.T])
