"""Least squares on spots: the pose whose LEDs fall where their spots are, each weighed by its covariance.

An LED's image has its centroid off the image of its centre, which photogrammetry calls eccentricity (Lenz & Fritsch
1990). Here it has a closed form. A face that is alike all over, seen at X from the camera, lights the image plane in
proportion to z / |X|^4 a unit of its own area: what it looks like from there, and the lens's cos^4. The centroid of its
image is then the image of M = mean of X / |X|^4 over the face. With the mean X0, at the range d, the upward normal n,
and the mean square extent s^2 along any direction of the face, X / |X|^4 to second order gives M along
X0 + 4 s^2 (n . X0) / d^2 n: **the image of a point above the LED by 4 s^2 h / d^2**, h being its height above the
camera. s^2 is r^2 / 4 for a disc of radius r, and r^2 / 3 for a square of half side r. What is left goes with
r^4 / h^3, a nanometre.

It holds on a pinhole's image plane. A lens that bends also does so within a spot, whose centroid then is not where its
centre goes when the lens is taken out. `straightened` takes that off the centroids, once a pose says how large the
spots are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from estimator.camera.leveling import tilt_from_gravity, tilt_sigmas
from estimator.camera.undistort import lens_pixels, pinhole_pixels
from estimator.errors import EstimationFailure
from estimator.io.dataset import Camera, DeviceFrame
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]

# No centroid is better: keeps a covariance of nothing, of a spot without noise, from weighing without end.
MIN_CENTROID_SIGMA_PX = 1e-4
# Beyond so many standard deviations a robust fit weighs less and less.
ROBUST_SIGMA = 3.0
MAX_EVALUATIONS = 60
# Over 4 s^2 = r^2 for a disc, see above.
SQUARE_TO_DISC = 4.0 / 3.0


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a camera is, (3,) world metres, and how it is turned, `R_cam_world` (3, 3)."""

    R_cam_world: Floats
    position_m: Floats


@dataclass(frozen=True, eq=False)
class Observations:
    """What a pose has to explain: spots on a pinhole's image plane at unit distance, and a reading of gravity."""

    leds_m: Floats
    """Centres of the LEDs, (n, 3), world."""
    lift_m2: Floats
    """4 s^2 of each LED, (n,): see the module."""
    camera: Camera
    plane: Floats
    """Centroids, (n, 2), in units of the image distance."""
    whitening: Floats
    """(n, 2, 2): takes an offset in the plane to one with unit covariance."""
    tilt_rad: Floats
    """The reading, (tilt_x, tilt_y)."""
    tilt_sigma_rad: Floats
    """Its standard deviations, (2,); infinite where gravity takes no part."""

    def without_gravity(self) -> "Observations":
        """The spots alone."""
        return replace(self, tilt_sigma_rad=np.full(2, np.inf))

    def only(self, chosen: NDArray[np.bool_]) -> "Observations":
        """Those of the spots that are chosen, (n,)."""
        return replace(
            self,
            leds_m=self.leds_m[chosen],
            lift_m2=self.lift_m2[chosen],
            plane=self.plane[chosen],
            whitening=self.whitening[chosen],
        )


@dataclass(frozen=True, eq=False)
class Fit:
    """A local minimum of the squared, whitened residuals."""

    pose: Pose
    cost: float
    """What was made least: the sum of squares, or of a robust loss of them."""
    spots_chi2: Floats
    """Of each spot, (n,): two degrees of freedom each."""
    tilt_chi2: float
    covariance_m2: Floats
    """Of the position, (3, 3), from the information matrix."""

    @property
    def chi2(self) -> float:
        """The sum of squares of all residuals."""
        return float(self.spots_chi2.sum()) + self.tilt_chi2


def observations(frame: DeviceFrame, seen: Sequence[Correspondence]) -> Observations:
    """Spots and gravity as a fit takes them; a spot that the lens cannot be taken out of is left out.

    Raises EstimationFailure where gravity reads nothing or no spot is left.
    """
    camera = frame.camera
    pixels = np.array([(correspondence.spot.u_px, correspondence.spot.v_px) for correspondence in seen]).reshape(-1, 2)
    covariance_px2 = np.array([correspondence.spot.covariance_px2 for correspondence in seen]).reshape(-1, 2, 2)
    leds = [correspondence.led for correspondence in seen]
    try:
        out, slope = _pinhole(pixels, camera)
    except EstimationFailure:
        kept = [k for k, pixel in enumerate(pixels) if _has_pinhole(pixel, camera)]
        if not kept:
            raise
        pixels, covariance_px2, leds = pixels[kept], covariance_px2[kept], [leds[k] for k in kept]
        out, slope = _pinhole(pixels, camera)
    from_pixels = np.linalg.inv(camera.matrix())
    to_plane = from_pixels[:2, :2] @ slope
    covariance = to_plane @ (covariance_px2 + MIN_CENTROID_SIGMA_PX**2 * np.eye(2)) @ to_plane.transpose(0, 2, 1)
    lift = [led.radius_m**2 * (SQUARE_TO_DISC if led.shape == "square" else 1.0) for led in leds]
    tilt = tilt_from_gravity(frame.accelerometer_m_s2)
    return Observations(
        leds_m=np.array([led.position_m for led in leds]),
        lift_m2=np.array(lift),
        camera=camera,
        plane=out @ from_pixels[:2, :2].T + from_pixels[:2, 2],
        whitening=np.linalg.inv(np.linalg.cholesky(covariance)),
        tilt_rad=np.array(tilt),
        tilt_sigma_rad=tilt_sigmas(frame.accelerometer, tilt[1]),
    )


def _pinhole(pixels: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """Pixels (n, 2) with the lens taken out, and the slopes (n, 2, 2) of that, by central differences over a pixel."""
    steps = np.array([[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    out = pinhole_pixels((pixels + steps[:, None]).reshape(-1, 2), camera).reshape(5, -1, 2)
    return out[0], np.stack([out[1] - out[2], out[3] - out[4]], axis=2)


def _has_pinhole(pixel: Floats, camera: Camera) -> bool:
    """Whether the lens can be taken out of a pixel (2,)."""
    try:
        _pinhole(pixel[None], camera)
    except EstimationFailure:
        return False
    return True


def projected(pose: Pose, leds_m: Floats, lift_m2: Floats) -> tuple[Floats, Floats]:
    """Where the images of LEDs (n, 3) have their centroids in the plane, (n, 2), and the LEDs' depths (n,), metres."""
    offset = leds_m - pose.position_m
    lifted = offset.copy()
    lifted[:, 2] += lift_m2 * offset[:, 2] / (offset**2).sum(axis=1)
    seen = lifted @ pose.R_cam_world.T
    # Of what is behind the camera nothing is an image; it only has to be far off, and finite.
    depth = np.where(np.abs(seen[:, 2]) < 1e-9, 1e-9, seen[:, 2])
    return seen[:, :2] / depth[:, None], seen[:, 2]


def corrected_for_eccentricity(seen: Observations, pose: Pose) -> Observations:
    """The same with centroids as if the lens had not bent the spots, by the sizes they have from a pose.

    Each LED is four points, sqrt(2) s from its centre along x and y, which have its s^2. Their images weigh as the
    lens's light does, z / |X|^4, whatever the lens: what it spreads over more pixels it makes dimmer.
    """
    steps = np.sqrt(seen.lift_m2 / 2)[:, None, None] * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    points = (seen.leds_m[:, None] + steps - pose.position_m) @ pose.R_cam_world.T
    before = (points[..., 2] > 0).all(axis=1)
    points = points[before]
    weights = points[..., 2] / (points**2).sum(axis=2) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    straight = points[..., :2] / points[..., 2:]
    K = seen.camera.matrix()
    bent = lens_pixels(straight.reshape(-1, 2) @ K[:2, :2].T + K[:2, 2], seen.camera).reshape(straight.shape)
    centroids = pinhole_pixels((weights[..., None] * bent).sum(axis=1), seen.camera)
    plane = seen.plane.copy()
    taken_out = (np.column_stack([centroids, np.ones(len(centroids))]) @ np.linalg.inv(K).T)[:, :2]
    plane[before] -= taken_out - (weights[..., None] * straight).sum(axis=1)
    return replace(seen, plane=plane)


def fit(seen: Observations, start: Pose, loss: Literal["linear", "soft_l1"] = "linear") -> Fit:
    """The local minimum from `start` on, by Levenberg's and Marquardt's method (SciPy) with exact derivatives.

    Raises EstimationFailure where what is seen does not fix a pose there.
    """
    centre = seen.leds_m.mean(axis=0)
    model = np.ascontiguousarray(seen.leds_m - centre)

    def pose_of(x: Floats) -> Pose:
        turn = cv2.Rodrigues(x[:3])[0]
        return Pose(turn, centre - turn.T @ x[3:])

    def residuals(x: Floats) -> Floats:
        pose = pose_of(x)
        offset = projected(pose, seen.leds_m, seen.lift_m2)[0] - seen.plane
        white = np.einsum("nij,nj->ni", seen.whitening, offset)
        return np.concatenate([white.ravel(), _tilt_residual(pose, seen)])

    def slopes(x: Floats) -> Floats:
        # Lifting an LED by some micrometres changes these by some millionths.
        of_plane = cv2.projectPoints(model, x[:3], x[3:], np.eye(3), None)[1][:, :6].reshape(-1, 2, 6)
        white = np.einsum("nij,njk->nik", seen.whitening, of_plane).reshape(-1, 6)
        return np.vstack([white, _tilt_slopes(x, seen)])

    x0 = np.concatenate([cv2.Rodrigues(start.R_cam_world)[0].ravel(), start.R_cam_world @ (centre - start.position_m)])
    try:
        with np.errstate(all="ignore"):
            # MINPACK is several times faster, and knows no robust loss.
            found = least_squares(
                residuals,
                x0,
                slopes,
                method="lm" if loss == "linear" else "trf",
                loss=loss,
                f_scale=ROBUST_SIGMA,
                x_scale="jac",
                max_nfev=MAX_EVALUATIONS,
            )
            # Of a robust loss it would not be the information.
            slope = slopes(found.x)
            covariance = np.asarray(np.linalg.inv(slope.T @ slope), dtype=np.float64)
    except (np.linalg.LinAlgError, ValueError, cv2.error):
        raise EstimationFailure("position", "what is seen does not fix a pose") from None
    pose = pose_of(found.x)
    at_end = residuals(found.x)
    count = len(seen.leds_m)
    return Fit(
        pose=pose,
        cost=2 * float(found.cost),
        spots_chi2=(at_end[: 2 * count].reshape(-1, 2) ** 2).sum(axis=1),
        tilt_chi2=float((at_end[2 * count :] ** 2).sum()),
        covariance_m2=_position_covariance(found.x, covariance),
    )


def _tilt_residual(pose: Pose, seen: Observations) -> Floats:
    """Tilts of a pose less the reading's, in standard deviations, (2,)."""
    x, y, z = pose.R_cam_world[:, 2]
    off = np.array([np.arctan2(y, z), -np.arcsin(np.clip(x, -1, 1))]) - seen.tilt_rad
    # The short way round.
    return np.asarray((off + np.pi) % (2 * np.pi) - np.pi) / seen.tilt_sigma_rad


def _tilt_slopes(x: Floats, seen: Observations) -> Floats:
    """Derivatives of `_tilt_residual` by the six parameters, (2, 6)."""
    turn, by_vector = cv2.Rodrigues(x[:3])
    up_y, up_z = turn[1:, 2]
    by_x, by_y, by_z = by_vector[:, [2, 5, 8]].T
    # Where the camera's x axis is upright, tilt_x is none.
    across2 = max(up_y**2 + up_z**2, 1e-12)
    slopes = np.zeros((2, 6))
    slopes[0, :3] = (up_z * by_y - up_y * by_z) / across2
    slopes[1, :3] = -by_x / np.sqrt(across2)
    return slopes / seen.tilt_sigma_rad[:, None]


def _position_covariance(x: Floats, covariance: Floats) -> Floats:
    """Of `centre - R^T t`, (3, 3), from that of the rotation vector and t, (6, 6)."""
    turn, by_vector = cv2.Rodrigues(x[:3])
    by_turn = np.column_stack([-by_vector[k].reshape(3, 3).T @ x[3:] for k in range(3)])
    slope = np.hstack([by_turn, -turn.T])
    return np.asarray(slope @ covariance @ slope.T)
