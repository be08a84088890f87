"""Self-calibration: one least-squares fit of all frames of a device, with the errors of its knowledge as unknowns.

A device is told a camera, an accelerometer and a map with their standard deviations. Their errors are the same in every
frame of the device, so its frames reveal them together (self-calibrating bundle adjustment: Brown 1971, Fraser 1997).
Minimized is the sum of squares, in standard deviations, of

- the spots' reprojection errors, by the covariances of their centroids;
- gravity: the tilts that the accelerometer reads less those of the pose and the accelerometer's constant error;
- each unknown that has a prior: the constant errors of a camera (focal length, aspect, principal point, distortion), of
  the accelerometer, of each luminaire's position and rotation, of each LED within its luminaire and of the map's datum
  (common unknowns), and the new error of the camera in each frame.

Each Gauss-Newton step eliminates pose and camera error of each frame by QR, which leaves a dense system of the common
unknowns, in units of their priors. In these units its matrix is the identity plus a positive semidefinite one, so that
unknowns that no frame determines keep their priors and cannot spoil it. An LED that one frame alone shows is no common
unknown: its error adds to its centroid's covariance. The covariance of a position is that of the frame by itself, plus
that of the common unknowns propagated to it; correlations within and between the frames are in it. Spots that disagree
are found by data snooping (Baarda 1968): each residual by the covariance that the adjustment gives it.

Stated standard deviations may be wrong. The adjustment estimates the variance of each kind of unknown (Foerstner 1979):
the sum of squares of its values in units of their priors is, to first order, chi-square with as many degrees of freedom
as the frames determine of them, `count - trace` of their covariance. A kind whose sum of squares is as improbable as an
outlier has its standard deviations multiplied by the root of the ratio, and the frames are fitted again. A kind of
which too little is determined keeps the factor that `adjust` was given.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from estimator.camera.intrinsics import intrinsic_slopes_px, with_errors
from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.camera.projection import project
from estimator.io.device import INTRINSICS, Camera, Led, Luminaire, MapDatum
from estimator.solvers.chi_square import chi2_limit

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

MAX_STEPS = 30
MAX_HALVINGS = 8
# A step that lowers the sum of squares by less than this moves no unknown by more than its root, 0.1 %, in standard
# deviations.
CONVERGED_CHI2 = 1e-6
# Probability that the test of a true spot exceeds the limit: one spot in a million.
OUTLIER_PROBABILITY = 1e-6
# Upper limit of centroid errors that the image model leaves out (`estimator.solvers.robust_fit`).
MODEL_ERROR_PX = 0.1
# Each round leaves out spots, or corrects standard deviations.
MAX_ROUNDS = 20
# Ratio of chi-squares up to which outliers are left out in one round.
SIMILAR = 10.0
MAX_RATIO = 100.0
# Degrees of freedom from which on a kind's variance is estimated.
MIN_FREEDOM = 8.0
MIN_SPOTS = 4
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


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A frame after the adjustment: its pose, the covariance (3, 3) of its position, m^2, and the spots used, (n,)."""

    pose: Pose
    covariance_m2: Floats
    used: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Result of `adjust`: a frame each, None for a frame that too few spots agree on, and the common unknowns.

    `chi2` is the minimized sum of squares, `freedom` its degrees of freedom. `unknowns` gives each common unknown's
    value and standard deviation by (kind, key, component); `scales` are the factors, by kind, of the stated standard
    deviations. Kind "camera" with the index of the camera and one of
    INTRINSICS, "gravity" with the index of the camera and 0 or 1, "luminaire" with an id and 0 to 5 (x, y, z in metres,
    rotations about them in radians), "led" with an id and 0 to 2 (metres), "datum" with 0 and 0 to 3 (metres, then the
    relative scale).
    """

    frames: tuple[Adjusted | None, ...]
    chi2: float
    freedom: int
    unknowns: dict[tuple[str, int, int], tuple[float, float]]
    scales: dict[str, float]


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
class _State:
    """Values of all unknowns: of each frame its pose and its camera error, (7,), and the common unknowns."""

    poses: tuple[Pose, ...]
    shots: tuple[Floats, ...]
    common: Floats


@dataclass(frozen=True, eq=False)
class _Linear:
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


class _Frame:
    """Residuals and derivatives of one frame."""

    def __init__(self, view: DeviceView, unknowns: Unknowns) -> None:
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
        self.present = places >= 0
        self.columns: Indices = places[self.present]

    def _whitening(self) -> Floats:
        """Matrices (n, 2, 2) that make the spots' errors unit ones, with those of LEDs that no other frame shows."""
        covariance = self.view.covariance_px2 * self.unknowns.scales.get("spots", 1.0) ** 2
        slopes: Floats | None = None
        for k, led in enumerate(self.view.leds):
            if self.unknowns.frames_of_led[led.id] > 1 or not led.light_sigmas_m().any():
                continue
            if slopes is None:
                slopes = project(self.told_m, self.view.pose, self.view.camera).slopes[:, :, :3]
            by_led = slopes[k] * led.light_sigmas_m() * self.unknowns.scales.get("led", 1.0)
            covariance[k] += by_led @ by_led.T
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))

    def positions_m(self, common: Floats) -> Floats:
        """Positions (n, 3) of the LEDs, world metres, with the errors of the map."""
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

    def linear(self, pose: Pose, shot: Floats, common: Floats) -> _Linear:
        """The equations of a step from here, the frame's own unknowns eliminated; raises LinAlgError."""
        view, n = self.view, len(self.view.leds)
        positions_m = self.positions_m(common)
        camera = self.camera(shot, common)
        seen = project(positions_m, pose, camera)
        by_camera = intrinsic_slopes_px(seen.p_cam, camera.normalized(seen.pixels), camera)
        own = np.concatenate([seen.slopes, by_camera[:, :, self.shot_places]], axis=2)
        own = np.einsum("nij,njk->nik", self.whitening, own).reshape(2 * n, -1)
        by_common = np.einsum("nij,njk->nik", self.whitening, self._by_common(seen.slopes, by_camera, common))
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
        residuals = self.residuals(pose, shot, common)
        scale = np.linalg.norm(own, axis=0)
        if not (np.isfinite(own).all() and np.isfinite(residuals).all() and (scale > 0).all()):
            raise LinAlgError("the spots do not determine the pose")
        Q, R = np.linalg.qr(own / scale)
        inverse = np.linalg.inv(R) / scale[:, None]
        shared_in, rest_in = Q.T @ shared, Q.T @ residuals
        spots = Q[: 2 * n]
        return _Linear(
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
    points_m = positions_m[:, None] + extent_m[:, None, None] * FACE
    seen = project(points_m.reshape(-1, 3), pose, camera)
    p_cam = seen.p_cam.reshape(-1, 4, 3)
    weights = p_cam[..., 2] / (p_cam**2).sum(axis=2) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    return np.asarray((weights[..., None] * seen.pixels.reshape(-1, 4, 2)).sum(axis=1))


def adjust(views: Sequence[DeviceView], scale: float = 1.0) -> Adjustment:
    """Fit all frames of a device and its common unknowns; spots that disagree are left out.

    A frame is left out, None in the result, where fewer than MIN_SPOTS spots agree, or no more than half of them. The
    stated standard deviations of camera, map and accelerometer count `scale` times to begin with.
    """
    used = [np.ones(len(view.leds), dtype=bool) for view in views]
    starts = [view.pose for view in views]
    taken = [len(view.leds) > 0 for view in views]
    scales = dict.fromkeys(("camera", "shot", "luminaire", "led", "gravity", "reading"), scale)
    common: dict[tuple[str, int, int], tuple[float, float]] = {}
    for round_ in range(MAX_ROUNDS):
        frames = [k for k, use in enumerate(taken) if use]
        chosen = [replace(views[k].only(used[k]), pose=starts[k]) for k in frames]
        try:
            solution = _Solution(chosen, scales, common)
        except LinAlgError:
            return Adjustment((None,) * len(views), 0.0, 0, {}, scales)
        common = solution.named()
        for k, pose in zip(frames, solution.state.poses, strict=True):
            starts[k] = pose
        if round_ == MAX_ROUNDS - 1:
            break
        outliers = _outliers(solution.tests())
        for place, chosen_spots in outliers.items():
            k = frames[place]
            used[k] = used[k].copy()
            used[k][np.flatnonzero(used[k])[chosen_spots]] = False
            taken[k] = bool(used[k].sum() >= MIN_SPOTS and 2 * used[k].sum() > len(used[k]))
        if outliers:
            continue
        ratios = solution.variance_ratios()
        if not ratios:
            break
        scales = {**scales, **{kind: scales.get(kind, 1.0) * np.sqrt(ratio) for kind, ratio in ratios.items()}}
        # Spots that disagreed by the former standard deviations may agree by these.
        used = [np.ones(len(view.leds), dtype=bool) for view in views]
        taken = [len(view.leds) > 0 for view in views]
    results: list[Adjusted | None] = [None] * len(views)
    for k, pose, covariance_m2 in zip(frames, solution.state.poses, solution.position_covariances(), strict=True):
        results[k] = Adjusted(pose, covariance_m2, used[k]) if taken[k] else None
    return Adjustment(tuple(results), solution.chi2, solution.freedom, solution.named(), scales)


def _outliers(tests: Sequence[Floats]) -> dict[int, Indices]:
    """Spots to leave out next, by the place of their frame: the worst of each frame that has about the worst of all.

    An outlier pulls the true spots of its frame, and a frame of outliers other frames: both are judged without it. The
    worst frame is left out whole if most of its spots disagree.
    """
    limit = chi2_limit(OUTLIER_PROBABILITY, 2)
    largest = max(float(test.max()) for test in tests)
    found = {}
    for place, test in enumerate(tests):
        if test.max() > max(limit, largest / SIMILAR):
            whole = test.max() == largest and np.median(test) > limit
            found[place] = np.arange(len(test)) if whole else np.array([np.argmax(test)])
    return found


class _Solution:
    """The minimum for a set of frames; raises LinAlgError if there is none."""

    def __init__(
        self,
        views: Sequence[DeviceView],
        scales: Mapping[str, float],
        start: Mapping[tuple[str, int, int], tuple[float, float]],
    ) -> None:
        self.unknowns = Unknowns(views, scales)
        self.frames = [_Frame(view, self.unknowns) for view in views]
        shots = tuple(np.zeros(len(INTRINSICS)) for _ in views)
        common = np.array([start.get(name, (0.0, 0.0))[0] for name in self.unknowns.names]) / self.unknowns.sigma
        self.state = _State(tuple(view.pose for view in views), shots, common)
        self.chi2 = self._cost(self.state)
        for _ in range(MAX_STEPS):
            promised = self._step()
            if promised < CONVERGED_CHI2:
                break
        self.lines, factor, _ = self._equations()
        identity = np.eye(self.unknowns.count)
        self.covariance = cho_solve(factor, identity, overwrite_b=True) if self.unknowns.count else identity

    @property
    def freedom(self) -> int:
        """Degrees of freedom: observations less unknowns without a prior."""
        return sum(2 * len(f.view.leds) + 2 * f.with_gravity - POSE_PARAMETERS for f in self.frames)

    def _cost(self, state: _State) -> float:
        """Sum of squares; infinite where a spot has no image."""
        total = float(state.common @ state.common)
        for frame, pose, shot in zip(self.frames, state.poses, state.shots, strict=True):
            total += float((frame.residuals(pose, shot, state.common) ** 2).sum())
        return total if np.isfinite(total) else np.inf

    def _equations(self) -> tuple[list[_Linear], tuple[Floats, bool], Floats]:
        """Equations of the frames, and the factor and right side of the common unknowns' system."""
        state, count = self.state, self.unknowns.count
        lines = [
            frame.linear(pose, shot, state.common)
            for frame, pose, shot in zip(self.frames, state.poses, state.shots, strict=True)
        ]
        normal, right = np.eye(count), -state.common
        for line in lines:
            normal[np.ix_(line.columns, line.columns)] += line.rows.T @ line.rows
            right[line.columns] += line.rows.T @ line.rest
        factor = cho_factor(normal, lower=True, overwrite_a=True) if count else (normal, True)
        return lines, factor, right

    def _step(self) -> float:
        """Take one Gauss-Newton step, halved until the sum of squares falls; returns the decrease that it promised."""
        lines, factor, right = self._equations()
        common = cho_solve(factor, right) if len(right) else right
        residual = sum(float(line.rest @ line.rest) for line in lines) + float(self.state.common @ self.state.common)
        promised = self.chi2 - residual + float(right @ common)
        steps = [line.x0 - line.G @ common[line.columns] for line in lines]
        share = 1.0
        for _ in range(MAX_HALVINGS):
            state = self._moved(steps, common, share)
            cost = self._cost(state)
            if cost <= self.chi2:
                self.state, self.chi2 = state, cost
                return promised
            share /= 2
        return 0.0

    def _moved(self, steps: Sequence[Floats], common: Floats, share: float) -> _State:
        poses, shots = [], []
        for frame, pose, shot, step in zip(self.frames, self.state.poses, self.state.shots, steps, strict=True):
            poses.append(pose.moved(share * step[:POSE_PARAMETERS], frame.view.camera))
            moved = shot.copy()
            moved[frame.shot_places] += share * step[POSE_PARAMETERS:]
            shots.append(moved)
        return _State(tuple(poses), tuple(shots), self.state.common + share * common)

    def position_covariances(self) -> list[Floats]:
        """Covariance (3, 3) of each frame's position, m^2."""
        found = []
        for line in self.lines:
            of_common = self.covariance[np.ix_(line.columns, line.columns)]
            found.append((line.own + line.G @ of_common @ line.G.T)[:3, :3])
        return found

    def tests(self) -> list[Floats]:
        """Chi-square, of two degrees of freedom, of each frame's spots (n,) by the covariance of their residuals."""
        found = []
        for frame, pose, shot, line in zip(self.frames, self.state.poses, self.state.shots, self.lines, strict=True):
            n = len(frame.view.leds)
            residuals = frame.residuals(pose, shot, self.state.common)[: 2 * n].reshape(n, 2)
            rows = line.rows[: 2 * n]
            spread = np.eye(2 * n) - line.projector
            spread -= rows @ self.covariance[np.ix_(line.columns, line.columns)] @ rows.T
            own = np.array([spread[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(n)]).reshape(n, 2, 2)
            own = own + MODEL_ERROR_PX**2 * frame.whitening @ frame.whitening.transpose(0, 2, 1)
            found.append(np.einsum("ni,ni->n", residuals, np.linalg.solve(own, residuals[:, :, None])[:, :, 0]))
        return found

    def variance_ratios(self) -> dict[str, float]:
        """Estimated over assumed variance by kind of unknown, of those that are improbable by OUTLIER_PROBABILITY."""
        found = {}
        redundancy = 1 - np.diag(self.covariance)
        for kind in ("camera", "gravity", "luminaire", "led"):
            of_kind = self.unknowns.kinds == kind
            total = float((self.state.common[of_kind] ** 2).sum())
            found[kind] = total, float(redundancy[of_kind].sum())
        total = freedom = 0.0
        for frame, shot, line in zip(self.frames, self.state.shots, self.lines, strict=True):
            of_common = self.covariance[np.ix_(line.columns, line.columns)]
            own = (line.own + line.G @ of_common @ line.G.T)[POSE_PARAMETERS:, POSE_PARAMETERS:]
            total += float(((shot[frame.shot_places] / frame.shot_sigma) ** 2).sum())
            freedom += float((1 - np.diag(own) / frame.shot_sigma**2).sum())
        found["shot"] = total, freedom
        return {kind: ratio for kind, one in found.items() if (ratio := _ratio(*one)) is not None}

    def named(self) -> dict[tuple[str, int, int], tuple[float, float]]:
        """Value and standard deviation of each common unknown by its name."""
        sigma = np.sqrt(np.diag(self.covariance)) * self.unknowns.sigma
        value = self.state.common * self.unknowns.sigma
        return {
            name: (float(one), float(spread))
            for name, one, spread in zip(self.unknowns.names, value, sigma, strict=True)
        }


def _ratio(total: float, freedom: float) -> float | None:
    """A sum of squares over its degrees of freedom; None where it is probable or there are fewer than MIN_FREEDOM."""
    if freedom < MIN_FREEDOM:
        return None
    half = OUTLIER_PROBABILITY / 2
    if chi2_limit(1 - half, freedom) <= total <= chi2_limit(half, freedom):
        return None
    return float(np.clip(total / freedom, 1 / MAX_RATIO, MAX_RATIO))
