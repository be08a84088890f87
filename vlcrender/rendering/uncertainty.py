"""What an estimator is told with errors: standard deviations of the lens, the map of LEDs and the mounting.

All errors are independent, normal, with mean 0. "True from told" (datasets/FORMAT.md): f_x = K00 (1 + focal) (1 +
aspect / 2), f_y = K11 (1 + focal) (1 - aspect / 2); the principal point and the coefficients k1, p1, p2 add theirs; and
an LED at P of a luminaire with centre C is at

    (1 + scale) (C + d_luminaire + (I + [w]x) (P - C) + d_led) + d_datum,

with the small rotation w of the luminaire. This module has the derivatives of these two sentences.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose, rotation_cam_world
from vlcrender.camera.rig import MAIN, Mounted, pose_of
from vlcrender.scene.leds import Leds

Array = NDArray[np.float64]

INTRINSICS = ("focal", "aspect", "cx_px", "cy_px", "k1", "p1", "p2")
"""Unknowns of the lens, in the order of all arrays of them."""
LUMINAIRE_UNKNOWNS = 6
"""Shift along x, y, z, m, and rotation about x, y, z through the luminaire's centre, radians."""
DATUM_UNKNOWNS = 4
"""Shift of the whole map along x, y, z, m, and its scale about the world's origin."""


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations (sigmas) of what an estimator is told; the LEDs are those of a scene, in its order."""

    intrinsics: Array
    """(7,), in the order of INTRINSICS: 1, 1, px, px, 1, 1, 1."""
    luminaire_of_led: NDArray[np.int64]
    """Index of each LED's luminaire, (n,)."""
    luminaires: Array
    """(luminaires, 6): shift along x, y, z, m; rotation about x, y, z, radians."""
    led_positions_m: Array
    """Of each LED within its luminaire, (n, 3)."""
    led_sizes: Array
    """Of the radius or side, relative, (n,)."""
    led_gradients: Array
    """Of the luminance's gradient along x and along y, relative change from the centre to the edge, (n,)."""
    led_faces_rad: Array
    """Of the tilt of the LED's face about x and about y, radians, (n,)."""
    datum_m: Array
    """Of the whole map, (3,)."""
    scale: float = 0.0
    """Of the whole map's scale, relative."""
    mounting_rad: float = 0.0
    """Of the rotation of a further camera on its rig, about each axis; does not apply to the camera `main`."""

    @classmethod
    def none(cls, leds: int) -> "Uncertainty":
        """All sigmas 0, for a scene of so many LEDs, each a luminaire of its own."""
        each = np.arange(leds)
        zeros = np.zeros
        return cls(zeros(7), each, zeros((leds, 6)), zeros((leds, 3)), zeros(leds), zeros(leds), zeros(leds), zeros(3))

    @property
    def is_zero(self) -> bool:
        """Whether everything is known without error."""
        arrays = (
            self.intrinsics,
            self.luminaires,
            self.led_positions_m,
            self.led_sizes,
            self.led_gradients,
            self.led_faces_rad,
        )
        return not any(a.any() for a in (*arrays, self.datum_m)) and self.scale == 0 and self.mounting_rad == 0

    def luminaire_centers_m(self, leds: Leds) -> Array:
        """Centre of each luminaire, the mean of its LEDs' told positions, (luminaires, 3), m, world."""
        count = np.bincount(self.luminaire_of_led, minlength=len(self.luminaires))
        sums = np.stack([np.bincount(self.luminaire_of_led, x, len(self.luminaires)) for x in leds.centers_m.T], axis=1)
        centers: Array = sums / np.maximum(count, 1)[:, None]
        return centers


@dataclass(frozen=True)
class MapLevers:
    """How the positions of some LEDs depend on the unknowns of the map, in units of these unknowns' sigmas."""

    uncertainty: Uncertainty
    leds: Leds
    indices: NDArray[np.int64]
    """The LEDs in view, (k,), as indices of the scene's."""

    @cached_property
    def luminaires(self) -> NDArray[np.int64]:
        """Luminaires with an LED in view, in ascending order."""
        return np.unique(self.uncertainty.luminaire_of_led[self.indices])

    @cached_property
    def of_datum(self) -> Array:
        """d position / d (shift, scale), (k, 3, 4), m."""
        told = self.leds.centers_m[self.indices]
        shift = np.broadcast_to(np.diag(self.uncertainty.datum_m), (len(told), 3, 3))
        return np.concatenate([shift, (told * self.uncertainty.scale)[:, :, None]], axis=2)

    @cached_property
    def of_luminaires(self) -> Array:
        """d position / d (shift, rotation) of each LED's own luminaire, (k, 3, 6), m."""
        own = self.uncertainty.luminaire_of_led[self.indices]
        arm = self.leds.centers_m[self.indices] - self.uncertainty.luminaire_centers_m(self.leds)[own]
        x, y, z = arm.T
        lever = np.zeros((len(own), 3, LUMINAIRE_UNKNOWNS))
        lever[:, :, :3] = np.eye(3)
        lever[:, 0, 4], lever[:, 0, 5] = z, -y  # w x arm
        lever[:, 1, 3], lever[:, 1, 5] = -z, x
        lever[:, 2, 3], lever[:, 2, 4] = y, -x
        scaled: Array = lever * self.uncertainty.luminaires[own][:, None, :]
        return scaled

    @cached_property
    def shared(self) -> Array:
        """d position / d all shared unknowns, (k, 3, 4 + 6 luminaires): datum, scale, then each luminaire in view."""
        count = DATUM_UNKNOWNS + LUMINAIRE_UNKNOWNS * len(self.luminaires)
        place = np.searchsorted(self.luminaires, self.uncertainty.luminaire_of_led[self.indices])
        levers = np.zeros((len(self.indices), 3, count))
        levers[:, :, :DATUM_UNKNOWNS] = self.of_datum
        for number, lever in enumerate(self.of_luminaires):
            first = DATUM_UNKNOWNS + LUMINAIRE_UNKNOWNS * int(place[number])
            levers[number, :, first : first + LUMINAIRE_UNKNOWNS] = lever
        return levers


def intrinsics_displacements_px(camera: Camera, u: Array, v: Array) -> Array:
    """Displacement of the image at pixel positions u and v, of one shape, by each unknown of the lens: (7, 2, ...), px.

    An equidistant lens has no k1, p1, p2: their displacements are 0.
    """
    (fx, skew, _), (_, fy, _), _ = camera.matrix.tolist()
    x_d, y_d = camera.sensor_position(u, v)
    one, zero = np.ones_like(x_d), np.zeros_like(x_d)
    first = [(fx * x_d, fy * y_d), (fx * x_d / 2, -fy * y_d / 2), (one, zero), (zero, one)]
    if camera.projection == "equidistant":
        return np.stack([np.stack(pair) for pair in (*first, *[(zero, zero)] * 3)])
    x, y, z = camera.unproject(u, v)
    x, y = x / z, y / z
    r2 = x * x + y * y
    bent = [(x * r2, y * r2), (2 * x * y, r2 + 2 * y * y), (r2 + 2 * x * x, 2 * x * y)]
    return np.stack([np.stack(pair) for pair in (*first, *((fx * dx + skew * dy, fy * dy) for dx, dy in bent))])


def tilt_covariance_rad2(
    mounted: Mounted, main: Pose, tilt_sigmas_deg: tuple[float, float], mounting_rad: float
) -> Array:
    """Covariance (2, 2) of the accelerometer's tilt_x and tilt_y of `main`, as a further camera of the rig sees them.

    Its mounting's rotation errs, so that it knows the tilts of `main` less well than `main` does.
    """
    own = np.diag(np.radians(tilt_sigmas_deg) ** 2)
    if mounted.name == MAIN or mounting_rad == 0:
        return own
    slopes = mounting_tilt_slopes(mounted, main)
    covariance: Array = own + mounting_rad**2 * slopes @ slopes.T
    return covariance


def mounting_tilt_slopes(mounted: Mounted, main: Pose) -> Array:
    """d (tilt_x, tilt_y) of `main` / d rotation of the mounting about x, y, z of the camera, (2, 3), camera fixed."""
    step = 1e-6
    rotation = mounted.rotation @ main.rotation  # of the camera, which its image determines
    slopes = np.zeros((2, 3))
    for axis in range(3):
        tilts = []
        for sign in (1, -1):
            turn = _small_rotation(axis, sign * step)
            turned = pose_of(np.array(main.position_m), (turn @ mounted.rotation).T @ rotation)
            tilts.append(np.radians([turned.tilt_x_deg, turned.tilt_y_deg]))
        slopes[:, axis] = (tilts[0] - tilts[1]) / (2 * step)
    return slopes


def _small_rotation(axis: int, angle_rad: float) -> Array:
    angles = [0.0, 0.0, 0.0]
    angles[axis] = float(np.degrees(angle_rad))
    return rotation_cam_world(*angles)
