"""Nuisance parameters of LED images, with Gaussian priors.

What a device does not know exactly: its intrinsics, the place and rotation of each luminaire, the place of each LED in
it, the map's origin and scale, the size and the tilts of each LED's face and the luminance over it. Each nuisance z is
in units of its prior's standard deviation, so that its prior is N(0, 1).
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimator.camera.intrinsics import CAMERA_PARAMETERS, with_errors
from estimator.camera.pose import Pose
from estimator.io.camera import Camera
from estimator.io.device import DeviceFrame
from estimator.io.led_map import led_arrays
from estimator.pixels.led_model import FACE_PARAMETERS, PROFILE_PARAMETERS, ImageState
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
        if self == NO_COMPONENTS:
            return stated
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
        return Nuisances(*(_ratio(v, s) for v, s in zip(vars(self).values(), sigmas, strict=True)))

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


def _ratio(values: Floats, sigmas: Floats) -> Floats:
    """Values in standard deviations, 0 where these are."""
    if not values.any():
        return values
    return np.divide(values, sigmas, out=np.zeros_like(values), where=sigmas > 0)


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
