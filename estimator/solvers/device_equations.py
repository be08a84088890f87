"""Equations of a device's frames: residuals and slopes of one frame by its own unknowns and the device's.

A frame's own unknowns are its pose and the new error of its camera. The common ones are what the device is told with a
standard deviation and is the same in all its frames: errors of the camera, the accelerometer and the map
(`estimator.solvers.self_calibration`).
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError
from scipy.spatial.transform import Rotation

from estimator.camera.intrinsics import intrinsic_slopes_px, with_errors
from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.camera.projection import images_px, project
from estimator.compiled import compact, compiled
from estimator.io.camera import INTRINSICS, Camera
from estimator.io.led_map import Led, Luminaire, MapDatum

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

FACE = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])


@dataclass(frozen=True, eq=False)
class DeviceView:
    """A frame as the adjustment uses it: n spots of LEDs, a reading of gravity, and a pose to start from.

    `centroids_px` (n, 2) have the covariances `covariance_px2` (n, 2, 2). `tilt_rad` (2,) are the rig's tilts by the
    accelerometer; `tilt_shot_sigma_rad` (2,) is their standard deviation, new in each frame, infinite if gravity is not
    used. The accelerometer's constant error (2,), of standard deviation `tilt_device_sigma_rad`, adds to the tilts with
    the factors `tilt_lever` (2,). `luminaires` and `datum` are the map's.
    """

    camera: Camera
    leds: tuple[Led, ...]
    luminaires: Mapping[int, Luminaire]
    datum: MapDatum | None
    centroids_px: Floats
    covariance_px2: Floats
    tilt_rad: Floats
    tilt_shot_sigma_rad: Floats
    tilt_device_sigma_rad: float
    tilt_lever: Floats
    pose: Pose

    def only(self, chosen: NDArray[np.bool_]) -> "DeviceView":
        """The same frame with the chosen spots, (n,)."""
        return replace(
            self,
            leds=tuple(led for led, use in zip(self.leds, chosen, strict=True) if use),
            centroids_px=self.centroids_px[chosen],
            covariance_px2=self.covariance_px2[chosen],
        )


class Unknowns:
    """The common unknowns of a device: those whose stated standard deviation is not zero.

    The vector of all of them, (count,), is in units of their standard deviations `sigma` (count,), which are the stated
    ones times the factor of their kind in `scales`.
    """

    def __init__(self, views: Sequence[DeviceView], scales: Mapping[str, float]) -> None:
        """Collect the unknowns of cameras, gravity, luminaires, LEDs and datum that the frames of a device show."""
        self.scales = scales
        self.cameras: list[Camera] = []
        self._index: dict[tuple[str, int], Indices] = {}
        self.names: list[tuple[str, int, int]] = []
        sigma: list[float] = []

        def add(kind: str, key: int, sigmas: Iterable[float]) -> None:
            if (kind, key) not in self._index:
                places = []
                for component, one in enumerate(sigmas):
                    places.append(len(sigma) if one > 0 else -1)
                    if one > 0:
                        self.names.append((kind, key, component))
                        sigma.append(float(one) * scales.get(kind, 1.0))
                self._index[kind, key] = np.array(places, dtype=np.intp)

        frames_of_led = Counter(led.id for view in views for led in view.leds)
        for view in views:
            if view.camera not in self.cameras:
                self.cameras.append(view.camera)
            camera, stated = self.cameras.index(view.camera), view.camera.uncertainty
            rotation_sigma = 0.0
            if stated is not None:
                add("camera", camera, stated.device_sigmas())
                rotation_sigma = np.radians(stated.rotation_sigma_deg)
            add("gravity", camera, [float(np.hypot(view.tilt_device_sigma_rad, rotation_sigma))] * 2)
            if view.datum is not None:
                add("datum", 0, view.datum.sigmas())
            for led in view.leds:
                if led.luminaire is not None and led.luminaire in view.luminaires:
                    of = view.luminaires[led.luminaire]
                    add("luminaire", of.id, of.sigmas())
                if frames_of_led[led.id] > 1:
                    add("led", led.id, led.light_sigmas_m())
        self.sigma: Floats = np.array(sigma, dtype=np.float64)
        self.kinds = np.array([kind for kind, _, _ in self.names])
        self.frames_of_led = frames_of_led

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return len(self.sigma)

    def places(self, kind: str, key: int, size: int) -> Indices:
        """Places in the vector of the components of an unknown, (size,); -1 for one that is known."""
        return self._index.get((kind, key), np.full(size, -1, dtype=np.intp))

    def values(self, places: Indices, vector: Floats) -> Floats:
        """Values, in their own units, of the unknowns at places of any shape; 0 for a known one."""
        if not self.count:
            return np.zeros(places.shape)
        return np.where(places >= 0, (vector * self.sigma)[places], 0.0)


@dataclass(frozen=True, eq=False)
class Linear:
    """A frame's equations with its own unknowns x and the common unknowns y at the places `columns`.

    `x = x0 - G y`, and left is `rows y = rest`; `own` (k, k) is the covariance of x for known y. The spots' residuals
    and derivatives, whitened, come first among the rows.
    """

    columns: Indices
    G: Floats
    x0: Floats
    own: Floats
    rows: Floats
    rest: Floats
    projector: Floats
    """Of the residuals of the spots onto what the frame's own unknowns explain of them, (2n, 2n)."""


class DeviceEquations:
    """Residuals and slopes of one frame of a device, in standard deviations."""

    def __init__(self, view: DeviceView, unknowns: Unknowns) -> None:
        """Sort out which unknowns the frame depends on."""
        self.view, self.unknowns = view, unknowns
        self.camera_index = unknowns.cameras.index(view.camera)
        stated = view.camera.uncertainty
        shot_sigma = np.zeros(len(INTRINSICS)) if stated is None else stated.shot_sigmas()
        self.shot_places = np.flatnonzero(shot_sigma > 0)
        self.shot_sigma = shot_sigma[self.shot_places] * unknowns.scales.get("shot", 1.0)
        self.tilt_sigma_rad = view.tilt_shot_sigma_rad * unknowns.scales.get("reading", 1.0)
        self.with_gravity = bool(np.isfinite(view.tilt_shot_sigma_rad).all())
        self.extent_m = np.sqrt([2 * led.mean_square_extent_m2 for led in view.leds])
        self.told_m: Floats = np.array([led.position_m for led in view.leds], dtype=np.float64).reshape(-1, 3)
        of_led = np.array([-1 if led.luminaire is None else led.luminaire for led in view.leds])
        shown = [view.luminaires[one] for one in sorted(set(of_led.tolist())) if one in view.luminaires]
        self.luminaires = [(one, of_led == one.id) for one in shown]
        self.whitening = self._whitening()
        parts = [unknowns.places("camera", self.camera_index, len(INTRINSICS))]
        parts += [unknowns.places("gravity", self.camera_index, 2), unknowns.places("datum", 0, 4)]
        parts += [unknowns.places("luminaire", one.id, 6) for one, _ in self.luminaires]
        self.led_places = np.array([unknowns.places("led", led.id, 3) for led in view.leds], dtype=np.intp).reshape(
            -1, 3
        )
        places = np.concatenate([*parts, self.led_places.ravel()])
        self.map_is_exact = bool((places[len(INTRINSICS) + 2 :] < 0).all())
        self.present = places >= 0
        self.columns: Indices = places[self.present]

    def _whitening(self) -> Floats:
        """Matrices (n, 2, 2) that make the spots' errors unit ones, with those of LEDs that no other frame shows."""
        covariance = self.view.covariance_px2 * self.unknowns.scales.get("spots", 1.0) ** 2
        slopes: Floats | None = None
        for k, led in enumerate(self.view.leds):
            if self.unknowns.frames_of_led[led.id] > 1 or not led.states_errors:
                continue
            if slopes is None:
                slopes = project(self.told_m, self.view.pose, self.view.camera).slopes[:, :, :3]
            by_led = slopes[k] * led.light_sigmas_m() * self.unknowns.scales.get("led", 1.0)
            covariance[k] += by_led @ by_led.T
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))

    def positions_m(self, common: Floats) -> Floats:
        """Positions (n, 3) of the LEDs, world metres, with the errors of the map."""
        if self.map_is_exact:
            return self.told_m
        positions_m = self.told_m.copy()
        for luminaire, member in self.luminaires:
            error = self.unknowns.values(self.unknowns.places("luminaire", luminaire.id, 6), common)
            arm_m = positions_m[member] - luminaire.position_m
            positions_m[member] += error[:3] + Rotation.from_rotvec(error[3:]).apply(arm_m) - arm_m
        positions_m += self.unknowns.values(self.led_places, common)
        datum = self.unknowns.values(self.unknowns.places("datum", 0, 4), common)
        return np.asarray((1 + datum[3]) * positions_m + datum[:3])

    def camera(self, shot: Floats, common: Floats) -> Camera:
        """The camera with its errors: those of the device and of the frame."""
        places = self.unknowns.places("camera", self.camera_index, len(INTRINSICS))
        error = self.unknowns.values(places, common) + shot
        return with_errors(self.view.camera, error) if error.any() else self.view.camera

    def residuals(self, pose: Pose, shot: Floats, common: Floats) -> Floats:
        """Residuals in standard deviations: spots (2n), gravity (2 or none), camera error of the frame."""
        positions_m = self.positions_m(common)
        predicted = _centroids_px(positions_m, self.extent_m, pose, self.camera(shot, common))
        spots = np.einsum("nij,nj->ni", self.whitening, self.view.centroids_px - predicted).ravel()
        return np.concatenate([spots, self._gravity(pose, common), -shot[self.shot_places] / self.shot_sigma])

    def _gravity(self, pose: Pose, common: Floats) -> Floats:
        if not self.with_gravity:
            return np.zeros(0)
        bias = self.unknowns.values(self.unknowns.places("gravity", self.camera_index, 2), common)
        off = self.view.tilt_rad - pose.rig_angles(self.view.camera)[:2] - self.view.tilt_lever * bias
        return np.asarray(((off + np.pi) % (2 * np.pi) - np.pi) / self.tilt_sigma_rad)

    def linear(self, pose: Pose, shot: Floats, common: Floats, residuals: Floats) -> Linear:
        """The equations of a step from here, the frame's own unknowns eliminated; raises LinAlgError.

        `residuals` are those here.
        """
        view, n = self.view, len(self.view.leds)
        positions_m = self.positions_m(common)
        camera = self.camera(shot, common)
        seen = project(positions_m, pose, camera)
        by_camera = intrinsic_slopes_px(seen.p_cam, camera.normalized(seen.pixels), camera)
        own = np.concatenate([seen.slopes, by_camera[:, :, self.shot_places]], axis=2)
        own = (self.whitening @ own).reshape(2 * n, -1)
        shared = np.zeros((2 * n, 0))
        if len(self.columns):
            by_common = self.whitening @ self._by_common(seen.slopes, by_camera, common)
            shared = by_common.reshape(2 * n, -1)[:, self.present]
        gravity = 2 if self.with_gravity else 0
        below = np.zeros((gravity + len(self.shot_places), own.shape[1]))
        shared_below = np.zeros((len(below), len(self.present)))
        if gravity:
            below[:2, 3:5] = np.diag(1 / self.tilt_sigma_rad)
            first = len(INTRINSICS)
            shared_below[:2, first : first + 2] = np.diag(view.tilt_lever / self.tilt_sigma_rad)
        below[gravity:, POSE_PARAMETERS:] = np.diag(1 / self.shot_sigma)
        own = np.vstack([own, below])
        shared = np.vstack([shared, shared_below[:, self.present]]) * self.unknowns.sigma[self.columns]
        scale = np.linalg.norm(own, axis=0)
        if not (np.isfinite(own).all() and np.isfinite(residuals).all() and (scale > 0).all()):
            raise LinAlgError("the spots do not determine the pose")
        Q, R = np.linalg.qr(own / scale)
        inverse = np.linalg.inv(R) / scale[:, None]
        shared_in, rest_in = Q.T @ shared, Q.T @ residuals
        spots = Q[: 2 * n]
        return Linear(
            columns=self.columns,
            G=inverse @ shared_in,
            x0=inverse @ rest_in,
            own=inverse @ inverse.T,
            rows=shared - Q @ shared_in,
            rest=residuals - Q @ rest_in,
            projector=spots @ spots.T,
        )

    def _by_common(self, slopes: Floats, by_camera: Floats, common: Floats) -> Floats:
        """Derivatives (n, 2, all) of the pixels by the common unknowns of the frame, in the order of the columns."""
        positions_m = self.positions_m(common)
        n = len(positions_m)
        by_position = -slopes[:, :, :3]
        by_scale = np.einsum("nij,nj->ni", by_position, positions_m)[:, :, None]
        parts = [by_camera, np.zeros((n, 2, 2)), by_position, by_scale]
        zero = np.zeros(n)
        for luminaire, member in self.luminaires:
            turn = self.unknowns.values(self.unknowns.places("luminaire", luminaire.id, 6), common)[3:]
            x, y, z = Rotation.from_rotvec(turn).apply(self.told_m - luminaire.position_m).T
            turned = np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(2, 0, 1)
            parts.append(np.concatenate([by_position, by_position @ turned], axis=2) * member[:, None, None])
        of_leds = np.zeros((n, 2, n, 3))
        of_leds[np.arange(n), :, np.arange(n)] = by_position
        return np.concatenate([*parts, of_leds.reshape(n, 2, 3 * n)], axis=2)


def _centroids_px(positions_m: Floats, extent_m: Floats, pose: Pose, camera: Camera) -> Floats:
    """Centroids (n, 2) of the images of horizontal faces, pixels, by four points of each that have its mean squares.

    Their images are weighted by the irradiance of the lens, z / |X|^4 (`estimator.solvers.observations`).
    """
    points_m = _face_points(compact(positions_m), extent_m)
    return _face_means(*images_px(points_m, pose, camera))


@compiled
def _face_points(positions_m: Floats, extent_m: Floats) -> Floats:
    """Four points of each face, (4n, 3), at the distances `extent_m` (n,) from the centres `positions_m` (n, 3)."""
    points_m = np.empty((4 * len(positions_m), 3))
    for i in range(len(positions_m)):
        for k in range(4):
            for axis in range(3):
                points_m[4 * i + k, axis] = positions_m[i, axis] + extent_m[i] * FACE[k, axis]
    return points_m


@compiled
def _face_means(pixels: Floats, p_cam: Floats) -> Floats:
    """Means (n, 2) of the pixels of every four points, (4n, 2), in camera axes (4n, 3), weighted by irradiance."""
    means = np.zeros((len(pixels) // 4, 2))
    for i in range(len(means)):
        total = 0.0
        for k in range(4 * i, 4 * i + 4):
            distance2 = p_cam[k, 0] ** 2 + p_cam[k, 1] ** 2 + p_cam[k, 2] ** 2
            weight = p_cam[k, 2] / (distance2 * distance2)
            total += weight
            for axis in range(2):
                means[i, axis] += weight * pixels[k, axis]
        for axis in range(2):
            means[i, axis] /= total
    return means
