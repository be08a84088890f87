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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.io.camera import INTRINSICS
from estimator.solvers.chi_square import chi2_limit
from estimator.solvers.device_equations import DeviceEquations, DeviceView, Linear, Unknowns

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

MAX_STEPS = 30
MAX_HALVINGS = 8
# A step that lowers the sum of squares by less than this moves no unknown by more than its root, 0.1 %, in standard
# deviations.
CONVERGED_CHI2 = 1e-6
# Probability that the test of a true spot exceeds the limit: one spot in a million.
OUTLIER_PROBABILITY = 1e-6
# Upper limit of centroid errors that the image model leaves out (`estimator.solvers.data_snooping`).
MODEL_ERROR_PX = 0.1
# Each round leaves out spots, or corrects standard deviations.
MAX_ROUNDS = 20
# Ratio of chi-squares up to which outliers are left out in one round.
SIMILAR = 10.0
MAX_RATIO = 100.0
# Degrees of freedom from which on a kind's variance is estimated.
MIN_FREEDOM = 8.0
MIN_SPOTS = 4


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


@dataclass(frozen=True, eq=False)
class _State:
    """Values of all unknowns: of each frame its pose and its camera error, (7,), and the common unknowns."""

    poses: tuple[Pose, ...]
    shots: tuple[Floats, ...]
    common: Floats


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
        self.frames = [DeviceEquations(view, self.unknowns) for view in views]
        shots = tuple(np.zeros(len(INTRINSICS)) for _ in views)
        common = np.array([start.get(name, (0.0, 0.0))[0] for name in self.unknowns.names]) / self.unknowns.sigma
        self.state = _State(tuple(view.pose for view in views), shots, common)
        self.residuals, self.chi2 = self._residuals(self.state)
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

    def _residuals(self, state: _State) -> tuple[list[Floats], float]:
        """Residuals of each frame and the sum of squares, infinite where a spot has no image."""
        of_frames = zip(self.frames, state.poses, state.shots, strict=True)
        residuals = [frame.residuals(pose, shot, state.common) for frame, pose, shot in of_frames]
        total = float(state.common @ state.common) + sum(float((one**2).sum()) for one in residuals)
        return residuals, total if np.isfinite(total) else np.inf

    def _equations(self) -> tuple[list[Linear], tuple[Floats, bool], Floats]:
        """Equations of the frames, and the factor and right side of the common unknowns' system."""
        state, count = self.state, self.unknowns.count
        lines = [
            frame.linear(pose, shot, state.common, residuals)
            for frame, pose, shot, residuals in zip(self.frames, state.poses, state.shots, self.residuals, strict=True)
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
            residuals, cost = self._residuals(state)
            if cost <= self.chi2:
                self.state, self.residuals, self.chi2 = state, residuals, cost
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
        for frame, line, of_frame in zip(self.frames, self.lines, self.residuals, strict=True):
            n = len(frame.view.leds)
            residuals = of_frame[: 2 * n].reshape(n, 2)
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
