"""Observations of a fit: spots in a pinhole's image plane with their covariances, gravity, and motion.

What the device does not know exactly, but states how well it knows, moves spots together
(`estimator.solvers.uncertainty`): with S the covariance of those errors and J the slopes of the spots by them, the
spots have the covariance C = C_centroids + J S J^T, which is not block-diagonal. A camera that moves while its lines
are exposed one after another displaces spots by its velocity (`estimator.solvers.shutter_motion`).

The centroid of an LED's image differs from the image of the LED's centre; photogrammetry calls the difference
eccentricity (Lenz & Fritsch 1990). A face of uniform luminance, at X from the camera, illuminates the image plane in
proportion to z / |X|^4 per unit of its own area: its solid angle, and the lens's cos^4. The centroid of its image is
then the image of the face's mean X, weighted by 1 / |X|^4. To second order that point is on the line of sight to a
point **above the LED by 4 s^2 h / d^2**, where s^2 is the mean square extent of the face along any direction, h the
height of the LED above the camera, and d its distance. s^2 is r^2 / 4 for a disc of radius r, and a^2 / 12 for a square
of side a. `light_centres_m` takes the mean by Gauss's rule of 3 x 3 points, which is exact for the terms of fourth
order of a square; with second order alone the position is off by some r^4 / h^3, a nanometre for LEDs of 1 cm and
0.1 mm for luminaires of 60 cm. A disc has the points of the square with the same s^2, which is exact to second order.

The mean holds in a pinhole's image plane. A lens that bends straight lines also bends the image of an LED, and
the undistorted centroid is then not the centroid of the undistorted image. `corrected_for_eccentricity` subtracts that
difference once a pose determines the size of the images.
"""

import math
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.leveling import tilt_from_gravity, tilt_sigmas
from estimator.camera.motion import seen_in_motion
from estimator.camera.pose import Pose
from estimator.camera.projection import projection_of
from estimator.camera.undistort import has_pinhole_image, pinhole_image
from estimator.compiled import compact, compiled
from estimator.io.camera import Camera
from estimator.io.device import DeviceFrame
from estimator.solvers.shutter_motion import ShutterMotion, image_slopes, motion_prior
from estimator.solvers.uncertainty import Uncertainty, assumed_camera, uncertainty
from estimator.spots.correspondences import centroids_px, led_positions_m
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]

# Added to every centroid's covariance, so that a spot without noise has a finite weight.
MIN_CENTROID_SIGMA_PX = 1e-4
# Gauss's rule of three points on a square of s = 1, whose half side is sqrt(3): nodes (9, 2) and weights (9,).
_ALONG, _SHARES = np.sqrt(1.8) * np.array([-1.0, 0.0, 1.0]), np.array([5.0, 8.0, 5.0]) / 18
FACE_NODES = np.stack(np.meshgrid(_ALONG, _ALONG, indexing="ij"), axis=-1).reshape(-1, 2)
FACE_WEIGHTS = np.outer(_SHARES, _SHARES).ravel()


@dataclass(frozen=True, eq=False)
class Observations:
    """Input of a fit: centroids in a pinhole's image plane, and a reading of gravity.

    `leds_m` (n, 3) are the centres of the LEDs, world metres; `lift_m2` (n,) is 4 s^2 of each LED, m^2, see the module.
    `image` (n, 2) are centroids in normalized pinhole coordinates; `whitening` (n, 2, 2) maps an offset in them to one
    of unit covariance, by the centroids' own errors; `from_pixels` (n, 2, 2) maps an offset in pixels to one in them.
    `tilt_rad` (2,) is (tilt_x, tilt_y) by the accelerometer, `tilt_sigma_rad` (2,) its standard deviations, infinite if
    gravity is not used. `uncertainty` are the errors of camera and map that the device states, whose standard
    deviations count `scale` times; `added_sigma_px` is a further standard deviation of each centroid, for errors that
    the device does not state. `motion` are the times of the spots and the prior of the velocity where the camera has a
    rolling shutter, else None.
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
    motion: ShutterMotion | None = None

    @property
    def correlated(self) -> bool:
        """Whether errors of camera or map move spots together."""
        return len(self.uncertainty.sigmas) > 0

    @property
    def displaced(self) -> bool:
        """Whether spots may be displaced by more than their centroids' errors: by those of camera or map, or motion."""
        return self.correlated or self.motion is not None

    @property
    def still_image(self) -> Floats:
        """Spots (n, 2) with the turns of the camera undone that the gyroscope says; `image` for a global shutter."""
        return self.image if self.motion is None else self.motion.turned_back(self.image)

    def images(self, pose: Pose, velocity: Floats | None = None) -> tuple[Floats, Floats]:
        """Centroids (n, 2) that a pose at mid-readout predicts, and depths (n,), metres; see `centroid_images`.

        `velocity` (6,) is the camera's, that of the prior if None; a global shutter has none.
        """
        if self.motion is None:
            return centroid_images(pose, self.leds_m, self.lift_m2)
        now = self.motion.prior.velocity if velocity is None else velocity
        camera_m = pose.position_m + self.motion.times_s[:, None] * now[3:]
        points_m = light_centres_m(self.leds_m, self.lift_m2, camera_m)
        p_cam = seen_in_motion(points_m, pose, now, self.motion.times_s).p_cam
        return _in_plane(p_cam), p_cam[:, 2]

    def total_covariance(self, pose: Pose) -> Floats:
        """`covariance` with the displacements by the prior of the velocity, (2n, 2n)."""
        total = self.covariance(pose)
        return total if self.motion is None else total + self.motion.covariance(self.leds_m, pose)

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
        """The same spots; a camera that states no errors has those of one as sold."""
        if not self.camera.states_no_errors:
            return self
        return replace(self, uncertainty=self.uncertainty.with_camera(assumed_camera(self.camera)))

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
            motion=None if self.motion is None else self.motion.only(chosen),
        )


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
    image, prior = pinhole_image(centroids_px(correspondences), camera), motion_prior(frame)
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
        motion=None if prior is None else ShutterMotion(camera.times_s(*centroids_px(correspondences).T), prior),
    )


def observe_once(
    frame: DeviceFrame, correspondences: Sequence[Correspondence], centroid_sigma_px: float = 0.0
) -> Observations:
    """`observe` of a frame's own spots, once for all variants of the frame."""
    # The reference does not keep the frame, which holds the results, and no other frame equals it.
    key = "observations", weakref.ref(frame), centroid_sigma_px
    return frame.once(key, lambda: observe(frame, correspondences, centroid_sigma_px))


def centroid_images(pose: Pose, leds_m: Floats, lift_m2: Floats) -> tuple[Floats, Floats]:
    """Centroids (n, 2) of the images of LEDs (n, 3) in the pinhole's image plane, and the LEDs' depths (n,), metres."""
    return _images(compact(leds_m), compact(lift_m2), compact(pose.position_m), compact(pose.R_cam_world))


@compiled
def _images(leds_m: Floats, lift_m2: Floats, position_m: Floats, R_cam_world: Floats) -> tuple[Floats, Floats]:
    """See `centroid_images`."""
    p_cam = _light_centres(leds_m, lift_m2, position_m.reshape(1, 3))
    depths_m = np.empty(len(p_cam))
    for i in range(len(p_cam)):
        x, y, z = p_cam[i, 0] - position_m[0], p_cam[i, 1] - position_m[1], p_cam[i, 2] - position_m[2]
        for k in range(3):
            p_cam[i, k] = R_cam_world[k, 0] * x + R_cam_world[k, 1] * y + R_cam_world[k, 2] * z
        depths_m[i] = p_cam[i, 2]
    return _in_plane(p_cam), depths_m


def light_centres_m(leds_m: Floats, lift_m2: Floats, camera_m: Floats) -> Floats:
    """Points (n, 3) of the faces of LEDs (n, 3) whose images are the centroids of the LEDs' images, see the module.

    `lift_m2` (n,) is 4 s^2 of each, `camera_m` (3,) or (n, 3) the projection centre; all in world metres.
    """
    return _light_centres(compact(leds_m), compact(lift_m2), compact(camera_m).reshape(-1, 3))


@compiled
def _light_centres(leds_m: Floats, lift_m2: Floats, cameras_m: Floats) -> Floats:
    """See `light_centres_m`; `cameras_m` are (n, 3), or (1, 3) for all."""
    points_m = leds_m.copy()
    for i in range(len(leds_m)):
        s = math.sqrt(lift_m2[i] / 4)
        of = min(i, len(cameras_m) - 1)
        x, y, z = leds_m[i, 0] - cameras_m[of, 0], leds_m[i, 1] - cameras_m[of, 1], leds_m[i, 2] - cameras_m[of, 2]
        total = along_x = along_y = 0.0
        for k in range(len(FACE_WEIGHTS)):
            at_x, at_y = s * FACE_NODES[k, 0], s * FACE_NODES[k, 1]
            distance2 = (x + at_x) ** 2 + (y + at_y) ** 2 + z * z
            weight = FACE_WEIGHTS[k] / (distance2 * distance2)
            total += weight
            along_x += weight * at_x
            along_y += weight * at_y
        points_m[i, 0] += along_x / total
        points_m[i, 1] += along_y / total
    return points_m


@compiled
def _in_plane(p_cam: Floats) -> Floats:
    """Points (n, 3) in camera axes in the pinhole's image plane, (n, 2)."""
    image = np.empty((len(p_cam), 2))
    for i in range(len(p_cam)):
        # An LED behind the camera has no image; here it only has to be far off, and finite.
        depth = p_cam[i, 2] if abs(p_cam[i, 2]) >= 1e-9 else 1e-9
        image[i, 0], image[i, 1] = p_cam[i, 0] / depth, p_cam[i, 1] / depth
    return image


def pose_vector(observations: Observations, pose: Pose) -> Floats:
    """Parameters (6,) of a pose: a rotation vector, and the mean of the LEDs in camera axes, metres.

    OpenCV gives no vector to a turn below 1e-5 rad, by which slopes change by their share of 1e-5.
    """
    vector = cv2.Rodrigues(pose.R_cam_world)[0].ravel()
    return np.concatenate([vector, pose.R_cam_world @ (observations.leds_m.mean(axis=0) - pose.position_m)])


def pose_slopes(observations: Observations, pose: Pose) -> tuple[Floats, Floats]:
    """Derivatives by six parameters of a pose: of spots in normalized coordinates (n, 2, 6), of the position (3, 6).

    The parameters are a rotation vector and a translation of the LEDs about their mean. Motion is left out.
    """
    x = pose_vector(observations, pose)
    R_cam_world, by_vector = cv2.Rodrigues(x[:3])
    model = observations.leds_m - observations.leds_m.mean(axis=0)
    return spot_slopes(compact(model), R_cam_world, by_vector.reshape(3, 3, 3), x[3:]), position_slopes(x)


@compiled
def spot_slopes(model_m: Floats, R_cam_world: Floats, by_vector: Floats, shift_m: Floats) -> Floats:
    """Derivatives (n, 2, 6) of the images of points R m + t in the pinhole's image plane by rotation vector and t.

    `model_m` (n, 3) are the m, `by_vector` (3, 3, 3) those of R = `R_cam_world` by the vector, `shift_m` is t.
    """
    slopes = np.zeros((len(model_m), 2, 6))
    for i in range(len(model_m)):
        p = np.empty(3)
        for row in range(3):
            p[row] = shift_m[row]
            for k in range(3):
                p[row] += R_cam_world[row, k] * model_m[i, k]
        a, b, by_depth = p[0] / p[2], p[1] / p[2], 1 / p[2]
        for parameter in range(3):
            for row in range(3):
                p[row] = 0.0
                for k in range(3):
                    p[row] += by_vector[parameter, row, k] * model_m[i, k]
            slopes[i, 0, parameter] = (p[0] - a * p[2]) * by_depth
            slopes[i, 1, parameter] = (p[1] - b * p[2]) * by_depth
        slopes[i, 0, 3] = slopes[i, 1, 4] = by_depth
        slopes[i, 0, 5], slopes[i, 1, 5] = -a * by_depth, -b * by_depth
    return slopes


def moving_slopes(observations: Observations, pose: Pose, velocity: Floats, x: Floats) -> Floats:
    """Derivatives (n, 2, 12) of spots in normalized coordinates by the six parameters x of `pose_slopes`, and velocity.

    The camera has a rolling shutter.
    """
    motion = observations.motion
    assert motion is not None
    seen = seen_in_motion(observations.leds_m, pose, velocity, motion.times_s)
    by_point = image_slopes(seen.p_cam)
    centre = observations.leds_m.mean(axis=0)
    # About the LEDs' mean, without the translation.
    arms = seen.offset_m - (centre - pose.position_m)
    by_vector = cv2.Rodrigues(x[:3])[1].reshape(3, 3, 3)
    by_pose = np.concatenate([np.einsum("kij,nj->nik", by_vector, arms), np.tile(np.eye(3), (len(arms), 1, 1))], axis=2)
    return np.asarray(by_point @ np.concatenate([seen.turned @ by_pose, seen.by_motion], axis=2))


def corrected_for_eccentricity(observations: Observations, pose: Pose) -> Observations:
    """Observations with centroids as a lens that does not bend the images would have them, of the size by a pose.

    Each LED is represented by the nodes of `light_centres_m`. Their images are weighted by the lens's irradiance,
    z / |X|^4, for any lens: a lens that spreads light over more pixels makes it dimmer. An LED with a node that has no
    image is not corrected. Motion shifts an image by some pixels, over which the difference does not change.
    """
    nodes = np.sqrt(observations.lift_m2 / 4)[:, None, None] * np.column_stack([FACE_NODES, 0 * FACE_WEIGHTS])
    points_m = (observations.leds_m[:, None] + nodes).reshape(-1, 3)
    p_cam = pose.in_camera(points_m)
    camera = observations.camera
    lens_image = projection_of(camera).project(p_cam)[0].reshape(-1, len(FACE_NODES), 2)
    p_cam = p_cam.reshape(-1, len(FACE_NODES), 3)
    imaged = (p_cam[..., 2] > 0).all(axis=1) & np.isfinite(lens_image).all(axis=(1, 2))
    p_cam, lens_image = p_cam[imaged], lens_image[imaged]
    weights = FACE_WEIGHTS * p_cam[..., 2] / (p_cam**2).sum(axis=2) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    lens_centroids = pinhole_image(camera.to_pixels((weights[..., None] * lens_image).sum(axis=1)), camera)
    pinhole_centroids = (weights[..., None] * p_cam[..., :2] / p_cam[..., 2:]).sum(axis=1)
    image = observations.image.copy()
    image[imaged] -= lens_centroids - pinhole_centroids
    return replace(observations, image=image)


def position_slopes(x: Floats) -> Floats:
    """Derivatives (3, 6) of `centre - R^T t` by the rotation vector and t."""
    R_cam_world, by_vector = cv2.Rodrigues(x[:3])
    slopes = np.empty((3, 6))
    slopes[:, :3] = -(x[3:] @ by_vector.reshape(3, 3, 3)).T
    slopes[:, 3:] = -R_cam_world.T
    return slopes
