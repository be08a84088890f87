"""Nuisance parameters of LED images, with Gaussian priors, and the step of pose and nuisances that a linear fit gives.

What a device does not know exactly: its intrinsics, the place and rotation of each luminaire, the place of each LED in
it, the map's origin and scale, the size and the tilts of each LED's face and the luminance over it. Each nuisance z is
in units of its prior's standard deviation, so that its prior is N(0, 1).

An LED's image depends on the LOCAL parameters: pose, intrinsics, size, tilts, profile. An LED that moves by d in the
world moves its image as the camera does that moves by -d. So the information of each LED about its LOCAL parameters is
all that the fit needs. Orthogonal elimination (QR) removes first what is an LED's own, then what is a luminaire's:
normal equations would lose the digits of what a loose prior leaves of a precise measurement.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimator.camera.intrinsics import CAMERA_PARAMETERS, with_errors
from estimator.camera.pose import POSE_PARAMETERS, Pose
from estimator.errors import EstimationFailure
from estimator.io.camera import Camera
from estimator.io.device import DeviceFrame
from estimator.io.led_map import led_arrays
from estimator.pixels.led_model import FACE_PARAMETERS, LOCAL_PARAMETERS, PROFILE_PARAMETERS, ImageState
from estimator.solvers.shutter_motion import motion_prior

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LED_PARAMETERS = 3 + FACE_PARAMETERS + PROFILE_PARAMETERS
"""An LED's own: shift along x, y and z of the world, size, two tilts of the face, profile."""
SIZE, TILTS, PROFILE = 3, slice(4, 6), slice(6, LED_PARAMETERS)
"""Columns of an LED's own size, tilts and profile."""
LUMINAIRE_PARAMETERS = 6
"""A luminaire's: shift along x, y and z, rotation about x, y and z."""
DATUM_PARAMETERS = 4
"""The map's: shift along x, y and z, scale."""

# A map that errs does not say how level the LEDs hang: standard deviation of a face's tangents, next to no knowledge.
# Luminaires hang by some 0.1 to 1 deg, and real rims are not perfectly round. Taken as level, a face would tell the
# camera's tilt to 0.01 deg, better than the place of the LEDs does.
FREE_TILT = 1.0
# Directions with less than this share of the largest information of an LED hold rounding errors alone.
MIN_INFORMATION_SHARE = 1e-13


@dataclass(frozen=True, eq=False)
class Priors:
    """Standard deviations of the nuisances of n LEDs of l luminaires; 0 for what is known exactly.

    `camera` (7,) in the units of `with_errors`; `datum` (4,) metres and relative scale; `luminaires` (l, 6) metres and
    radians; `leds` (n, 9): metres, relative size, tilts, profile coefficients. `positions_m` (n, 3) are the LEDs'
    positions by the map, `centres_m` (l, 3) the points that luminaires turn about, `luminaire` (n,) each LED's, -1 for
    none. `motion` (6,) are those of the velocity of a camera with a rolling shutter, `velocity` (6,) is its expectation
    (`estimator.solvers.shutter_motion`); both are (0,) for a global shutter.
    """

    camera: Floats
    datum: Floats
    luminaires: Floats
    leds: Floats
    positions_m: Floats
    centres_m: Floats
    luminaire: Ints
    motion: Floats = field(default_factory=lambda: np.zeros(0))
    velocity: Floats = field(default_factory=lambda: np.zeros(0))

    @staticmethod
    def of(frame: DeviceFrame) -> "Priors":
        """What a frame's device states about itself and the LEDs of its map; what it does not state is known."""
        uncertainty, datum, leds = frame.camera.uncertainty, frame.map_datum, led_arrays(frame.leds)
        camera = np.zeros(CAMERA_PARAMETERS)
        if uncertainty is not None:
            camera = np.hypot(uncertainty.device_sigmas(), uncertainty.shot_sigmas())
        hung = set(leds.luminaires.tolist())
        ids = [key for key in frame.luminaires if key in hung]
        luminaire = np.full(len(leds.luminaires), -1)
        for number, key in enumerate(ids):
            luminaire[leds.luminaires == key] = number
        stated = [frame.luminaires[one] for one in ids]
        of_luminaire = np.array([one.sigmas() for one in stated]).reshape(-1, LUMINAIRE_PARAMETERS)
        own = np.zeros((len(leds.sigmas), LED_PARAMETERS))
        own[:, :3] = leds.sigmas[:, :3]
        np.divide(leds.sigmas[:, 3], leds.half_widths_m, out=own[:, SIZE], where=leds.sigmas[:, 3] > 0)
        own[:, PROFILE][:, :2] = leds.sigmas[:, 4:]
        if own[:, :3].any() or of_luminaire.any():
            own[:, TILTS] = FREE_TILT
        motion = motion_prior(frame)
        return Priors(
            camera=camera,
            datum=np.zeros(DATUM_PARAMETERS) if datum is None else datum.sigmas(),
            luminaires=of_luminaire,
            leds=own,
            positions_m=leds.positions_m,
            centres_m=np.array([one.position_m for one in stated]).reshape(-1, 3),
            luminaire=luminaire,
            motion=np.zeros(0) if motion is None else motion.sigmas,
            velocity=np.zeros(0) if motion is None else motion.velocity,
        )

    @property
    def exact(self) -> bool:
        """Whether nothing is uncertain."""
        parts = self.camera, self.datum, self.luminaires, self.leds, self.motion
        return not any(part.any() for part in parts)

    def scaled(self, factor: float) -> "Priors":
        """Priors with all stated standard deviations times a factor, but for those of a motion and of free tilts."""
        leds = self.leds * factor
        leds[:, TILTS] = self.leds[:, TILTS]
        of_frame = self.camera * factor, self.datum * factor, self.luminaires * factor
        return replace(self, camera=of_frame[0], datum=of_frame[1], luminaires=of_frame[2], leds=leds)

    def position_sigma_m(self) -> Floats:
        """Standard deviation (n,) of each LED's position along its worst axis, without the datum."""
        of_luminaire = np.zeros((len(self.leds), 3))
        has = self.luminaire >= 0
        chosen = self.luminaire[has]
        arm_m = np.linalg.norm(self.positions_m[has] - self.centres_m[chosen], axis=1, keepdims=True)
        of_luminaire[has] = np.hypot(
            self.luminaires[chosen, :3], self.luminaires[chosen, 3:].max(axis=1, keepdims=True) * arm_m
        )
        return np.asarray(np.hypot(self.leds[:, :3], of_luminaire).max(axis=1))

    def only(self, leds: Ints) -> "Priors":
        """The priors of the LEDs with these indices, and of all luminaires."""
        return replace(self, leds=self.leds[leds], positions_m=self.positions_m[leds], luminaire=self.luminaire[leds])

    def arms(self) -> Floats:
        """Derivatives (n, 3, 6) of an LED's shift by its luminaire's nuisances."""
        slopes = np.zeros((len(self.leds), 3, LUMINAIRE_PARAMETERS))
        has = self.luminaire >= 0
        chosen = self.luminaire[has]
        x, y, z = (self.positions_m[has] - self.centres_m[chosen]).T
        o = np.zeros_like(x)
        slopes[has, :, :3] = np.eye(3)
        # Columns: the cross products of the axes with (x, y, z).
        slopes[has, :, 3:] = np.array([[o, z, -y], [-z, o, x], [y, -x, o]]).transpose(2, 0, 1)
        return slopes

    def datum_slopes(self) -> Floats:
        """Derivatives (n, 3, 4) of an LED's shift by the datum's nuisances."""
        shift = np.broadcast_to(np.eye(3), (len(self.leds), 3, 3))
        return np.concatenate([shift, self.positions_m[:, :, None]], axis=2)


@dataclass(frozen=True)
class Components:
    """Standard deviations that the images of a frame reveal beside those that the device states; 0 for none.

    `place_m` of each LED's x, y and z, metres, which leaves the faces' tilts free; `size`, relative; `profile` of each
    coefficient.
    """

    place_m: float = 0.0
    size: float = 0.0
    profile: float = 0.0

    def added(self, stated: Priors) -> Priors:
        """Priors with both."""
        extra = np.array([self.place_m] * 3 + [self.size] + [0.0] * 2 + [self.profile] * PROFILE_PARAMETERS)
        leds = np.hypot(stated.leds, extra)
        if self.place_m > 0:
            leds[:, TILTS] = FREE_TILT
        return replace(stated, leds=leds)

    def updated(self, stated: Priors, values: "Nuisances", redundancy: Floats, used: NDArray[np.bool_]) -> "Components":
        """Components whose priors agree with the values of the LEDs used, (n,), and their redundancy (n, 9).

        Foerstner (1979): the squares of residuals, in units of the variance assumed, over their redundancy. A component
        of 0 stays 0, and so does one that is not controlled.
        """
        total = self.added(stated)
        z2 = (values.standardized(total).leds ** 2)[used]
        new = {}
        for name, columns in COLUMNS_OF_COMPONENT.items():
            now = getattr(self, name)
            controlled = float(redundancy[used][:, columns].sum())
            if now > 0 and controlled > MIN_REDUNDANCY:
                ratio = float(z2[:, columns].sum()) / controlled
                variance = (
                    ratio * (total.leds[used][:, columns] ** 2).mean() - (stated.leds[used][:, columns] ** 2).mean()
                )
                now = float(np.sqrt(max(variance, (MIN_COMPONENT * now) ** 2)))
            new[name] = now
        return Components(**new)

    def differs(self, other: "Components") -> bool:
        """Whether a component is other than in `other` by more than a twentieth."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return any(abs(a - b) > 0.05 * max(a, b) for a, b in pairs)


NO_COMPONENTS = Components()
# Columns of an LED's own nuisances that have one component.
COLUMNS_OF_COMPONENT = {"place_m": [0, 1, 2], "size": [SIZE], "profile": list(range(LED_PARAMETERS)[PROFILE])}
# Redundancy of a component below which it is not estimated.
MIN_REDUNDANCY = 0.5
# Smallest ratio of a component to its former value.
MIN_COMPONENT = 0.1


@dataclass(frozen=True, eq=False)
class Nuisances:
    """Values of the nuisances: true less stated; shapes and units as in `Priors`."""

    camera: Floats
    datum: Floats
    luminaires: Floats
    leds: Floats
    motion: Floats = field(default_factory=lambda: np.zeros(0))

    @staticmethod
    def zero(priors: Priors) -> "Nuisances":
        """All as the device states."""
        parts = priors.camera, priors.datum, priors.luminaires, priors.leds, priors.motion
        return Nuisances(*(np.zeros_like(one) for one in parts))

    def only(self, leds: Ints) -> "Nuisances":
        """The values of the LEDs with these indices, and all others."""
        return replace(self, leds=self.leds[leds])

    def updated(self, leds: Ints, values: "Nuisances") -> "Nuisances":
        """These with new values, of the LEDs with these indices alone."""
        of_leds = self.leds.copy()
        of_leds[leds] = values.leds
        return replace(values, leds=of_leds)

    def moved(self, step: "Nuisances", factor: float = 1.0) -> "Nuisances":
        """These plus a step times a factor."""
        return Nuisances(*(a + factor * b for a, b in zip(vars(self).values(), vars(step).values(), strict=True)))

    def standardized(self, priors: Priors) -> "Nuisances":
        """These in standard deviations of their priors; 0 for what is known exactly."""
        sigmas = (priors.camera, priors.datum, priors.luminaires, priors.leds, priors.motion)
        pairs = zip(vars(self).values(), sigmas, strict=True)
        return Nuisances(*(np.divide(v, s, out=np.zeros_like(v), where=s > 0) for v, s in pairs))

    def deviance(self, priors: Priors) -> float:
        """Sum of squares in standard deviations: minus twice the logarithm of the prior."""
        return float(sum((one**2).sum() for one in vars(self.standardized(priors)).values()))

    def profile(self) -> Floats:
        """Profile coefficients (n, 3) of the LEDs."""
        return self.leds[:, PROFILE]

    def shifts_m(self, priors: Priors) -> Floats:
        """Shifts (n, 3) of the LEDs from their positions by the map, world metres."""
        shifts = self.leds[:, :3] + self.datum[:3] + self.datum[3] * priors.positions_m
        has = priors.luminaire >= 0
        if has.any():
            shifts[has] += np.einsum("nij,nj->ni", priors.arms()[has], self.luminaires[priors.luminaire[has]])
        return np.asarray(shifts)

    def state(self, pose: Pose, camera: Camera, priors: Priors) -> ImageState:
        """State of the LED images under a pose and these nuisances; `camera` is the stated one."""
        sizes, tilts = 1 + self.leds[:, SIZE], self.leds[:, TILTS]
        velocity = priors.velocity + self.motion if len(self.motion) else None
        return ImageState(pose, with_errors(camera, self.camera), self.shifts_m(priors), sizes, tilts, velocity)


@dataclass(frozen=True, eq=False)
class Gravity:
    """Prior of the rig's tilts by the accelerometer: means (2,) and standard deviations (2,), radians."""

    tilts: Floats
    sigma: Floats

    def scaled(self, factor: float) -> "Gravity":
        """The same with a standard deviation times a factor."""
        return replace(self, sigma=self.sigma * factor)

    def residual(self, angles: Floats) -> Floats:
        """Measured minus the rig's (tilt_x, tilt_y, yaw), in standard deviations, (2,)."""
        residual = self.tilts - angles[:2]
        return np.asarray((residual - 2 * np.pi * np.round(residual / (2 * np.pi))) / self.sigma)

    def deviance(self, angles: Floats) -> float:
        """Sum of the squared residuals of the tilts, in standard deviations."""
        return float((self.residual(angles) ** 2).sum())


NO_GRAVITY = Gravity(np.zeros(2), np.full(2, np.inf))


@dataclass(frozen=True, eq=False)
class Solution:
    """A step of pose and nuisances; covariance of the view, and of each LED's own nuisances.

    The view is the pose (6,), and the velocity (6,) for a rolling shutter: `view_step` (v,), `covariance` (v, v).
    `redundancy` (n, 9) is the share of its prior that each LED's own nuisance keeps, 1 less its variance in prior
    units. `step2` is the squared length of the step of the view in standard deviations, `information` (v, v) the
    inverse of the view's covariance.
    """

    view_step: Floats
    step: Nuisances
    covariance: Floats
    redundancy: Floats
    step2: float
    information: Floats

    @property
    def pose_step(self) -> Floats:
        """The step of the pose, (6,)."""
        return self.view_step[:POSE_PARAMETERS]


def _triangle(matrix: Floats) -> Floats:
    """Triangular factor of QR, of a matrix or of each of n."""
    return np.asarray(np.linalg.qr(matrix, mode="r"), dtype=np.float64)


def square_root(information: Floats, gradient: Floats) -> tuple[Floats, Floats]:
    """Rows (n, r, p) and right-hand sides (n, r) of least squares with the information (n, p, p), gradient (n, p).

    There are as many rows as parameters of which any of the n has information.
    """
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    informed = np.flatnonzero((diagonal > 0).any(axis=0))
    diagonal = diagonal[:, informed]
    scale = np.divide(1.0, np.sqrt(np.maximum(diagonal, 0.0)), out=np.zeros_like(diagonal), where=diagonal > 0)
    scaled = information[:, informed[:, None], informed] * scale[:, :, None] * scale[:, None]
    values, vectors = np.linalg.eigh(np.clip(scaled, -1.0, 1.0))
    kept = values > MIN_INFORMATION_SHARE * values[:, -1:]
    root = np.sqrt(np.where(kept, values, 0.0))
    rows = np.zeros((*values.shape, information.shape[2]))
    rows[:, :, informed] = (vectors * root[:, None]).transpose(0, 2, 1) * np.sqrt(np.maximum(diagonal, 0.0))[:, None]
    right = np.einsum("nij,ni->nj", vectors, gradient[:, informed] * scale)
    return rows, np.divide(right, root, out=np.zeros_like(right), where=kept)


def solve(
    rows: Floats,
    right: Floats,
    priors: Priors,
    now: Nuisances,
    gravity: Gravity,
    angles: Floats,
    damping: Floats | None = None,
) -> Solution:
    """Step of pose and nuisances that minimizes the squares of `rows` (n, r, p) x step - `right` (n, r), and priors.

    The columns are the LOCAL_PARAMETERS and those of the motion; `angles` (3,) are the rig's; `damping` (v, v), if
    given, is an information that keeps the view where it is (Levenberg-Marquardt), and is part of
    `Solution.covariance`. Raises EstimationFailure if the pose is not determined.
    """
    n = len(rows)
    z = now.standardized(priors)
    of_camera = slice(POSE_PARAMETERS, POSE_PARAMETERS + CAMERA_PARAMETERS)
    shifted = -rows[:, :, :3]  # by a shift of the LED
    of_led = slice(POSE_PARAMETERS + CAMERA_PARAMETERS, LOCAL_PARAMETERS)
    # What is known exactly is no unknown.
    uncertain = np.flatnonzero(priors.leds.any(axis=0))
    own = np.concatenate([shifted, rows[:, :, of_led]], axis=2)[:, :, uncertain] * priors.leds[:, None, uncertain]
    uncertain_datum, uncertain_camera = np.flatnonzero(priors.datum), np.flatnonzero(priors.camera)
    common = np.concatenate(
        [
            (shifted @ (priors.datum_slopes() * priors.datum))[:, :, uncertain_datum],
            (rows[:, :, of_camera] * priors.camera)[:, :, uncertain_camera],
            rows[:, :, :POSE_PARAMETERS],
            rows[:, :, LOCAL_PARAMETERS:] * priors.motion,
        ],
        axis=2,
    )
    own_count, common_count = len(uncertain), common.shape[2]
    has = priors.luminaire >= 0
    luminaire_count = LUMINAIRE_PARAMETERS if has.any() else 0
    of_luminaire = shifted[:, :, :0]
    if luminaire_count > 0:
        arms = priors.arms()
        arms[has] *= priors.luminaires[priors.luminaire[has]][:, None]
        of_luminaire = shifted @ arms
    system = np.concatenate([own, of_luminaire, common, right[:, :, None]], axis=2)
    prior_rows = np.zeros((n, own_count, system.shape[2]))
    prior_rows[:, :, :own_count] = np.eye(own_count)
    prior_rows[:, :, -1] = -z.leds[:, uncertain]
    triangles = _triangle(np.concatenate([prior_rows, system], axis=1))
    led_rows, rest = triangles[:, :own_count], triangles[:, own_count:, own_count:]

    remaining = [rest[~has][:, :, luminaire_count:].reshape(-1, common_count + 1)]
    luminaire_rows = {}
    for k in np.unique(priors.luminaire[has]).tolist():
        block = rest[priors.luminaire == k].reshape(-1, rest.shape[2])
        prior = np.zeros((LUMINAIRE_PARAMETERS, rest.shape[2]))
        prior[:, :LUMINAIRE_PARAMETERS] = np.eye(LUMINAIRE_PARAMETERS)
        prior[:, -1] = -z.luminaires[k]
        triangle = _triangle(np.concatenate([prior, block]))
        luminaire_rows[k] = triangle[:LUMINAIRE_PARAMETERS]
        remaining.append(triangle[LUMINAIRE_PARAMETERS:, LUMINAIRE_PARAMETERS:])
    prior = np.zeros((common_count, common_count + 1))
    known = len(uncertain_datum) + len(uncertain_camera)
    prior[:known, :known] = np.eye(known)
    prior[:known, -1] = -np.concatenate([z.datum[uncertain_datum], z.camera[uncertain_camera]])
    tilt = [known + 3, known + 4]
    prior[tilt, tilt] = 1 / gravity.sigma
    prior[tilt, -1] = gravity.residual(angles)
    of_motion = np.arange(known + POSE_PARAMETERS, common_count)
    prior[of_motion, of_motion] = 1.0
    prior[of_motion, -1] = -z.motion
    # From the unknowns of the view to their units: those of the motion are in standard deviations.
    units = np.concatenate([np.ones(POSE_PARAMETERS), priors.motion])
    total = np.concatenate([prior, *remaining])
    if damping is not None:
        held = np.zeros((len(units), common_count + 1))
        held[:, known:-1] = np.linalg.cholesky(damping).T * units
        total = np.concatenate([total, held])
    scale = np.linalg.norm(total[:, :-1], axis=0)
    if not np.isfinite(total).all() or not (scale > 0).all():
        raise EstimationFailure("fit", UNDETERMINED)
    triangle = _triangle(np.column_stack([total[:, :-1] / scale, total[:, -1]]))
    R, q = triangle[:common_count, :-1], triangle[:common_count, -1]
    if not np.abs(np.diag(R)).min() > MIN_DETERMINED:
        raise EstimationFailure("fit", UNDETERMINED)
    inverse = np.linalg.inv(R) / scale[:, None]
    covariance = inverse @ inverse.T
    x = inverse @ q

    of_luminaires = -z.luminaires
    for k, row in luminaire_rows.items():
        rhs = row[:, -1] - row[:, LUMINAIRE_PARAMETERS:-1] @ x
        of_luminaires[k] = np.linalg.solve(row[:, :LUMINAIRE_PARAMETERS], rhs)
    lead, on_luminaire = led_rows[:, :, :own_count], led_rows[:, :, own_count : -common_count - 1]
    on_common = led_rows[:, :, -common_count - 1 : -1]
    rhs = led_rows[:, :, -1] - on_common @ x
    if luminaire_count > 0:
        rhs[has] -= np.einsum("nij,nj->ni", on_luminaire[has], of_luminaires[priors.luminaire[has]])
    of_leds, of_datum, of_intrinsics = np.zeros_like(z.leds), np.zeros_like(z.datum), np.zeros_like(z.camera)
    of_leds[:, uncertain] = np.linalg.solve(lead, rhs[:, :, None])[:, :, 0]
    of_datum[uncertain_datum], of_intrinsics[uncertain_camera] = np.split(x[:known], [len(uncertain_datum)])
    inverse_lead = np.linalg.inv(lead)
    # Of what is common, the luminaires' uncertainty is left out.
    through = inverse_lead @ on_common @ inverse
    redundancy = np.zeros_like(z.leds)
    redundancy[:, uncertain] = 1 - (inverse_lead**2).sum(axis=2) - (through**2).sum(axis=2)
    view_step, view_covariance = x[known:] * units, covariance[known:, known:] * np.outer(units, units)
    root = R[known:, known:] * (scale[known:] / units)
    return Solution(
        view_step=view_step,
        step=Nuisances(
            camera=of_intrinsics * priors.camera,
            datum=of_datum * priors.datum,
            luminaires=of_luminaires * priors.luminaires,
            leds=of_leds * priors.leds,
            motion=view_step[POSE_PARAMETERS:],
        ),
        covariance=view_covariance,
        redundancy=np.clip(redundancy, 0.0, 1.0),
        step2=float(((root @ view_step) ** 2).sum()),
        information=root.T @ root,
    )


UNDETERMINED = "the LEDs in view do not determine a position"
# Smallest diagonal element of the triangular factor, with columns of unit length, of a determined pose.
MIN_DETERMINED = 1e-10
