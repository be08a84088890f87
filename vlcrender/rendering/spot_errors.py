"""What the errors of lens, map and accelerometer do to a position that is found from the spots of one frame.

A frame's measurements are the image positions of its LEDs and the accelerometer's two tilts. To first order they are

    z = A x + noise + sum over unknowns of B e,

with x the pose, e errors of unit variance, and B their effect times their sigma. With the covariance C of all that is
not A x, generalised least squares finds the pose with the gain G = (A' C^-1 A)^-1 A' C^-1. The position then errs by
G B e, and by G times the noise: the contributions of independent unknowns add up to its covariance, (A' C^-1 A)^-1.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from vlcrender.camera.rig import MAIN
from vlcrender.rendering.crlb import MAX_CONDITION, FrameSlopes
from vlcrender.rendering.face_motions import moved
from vlcrender.rendering.uncertainty import (
    LUMINAIRE_UNKNOWNS,
    MapLevers,
    Uncertainty,
    intrinsics_displacements_px,
    mounting_tilt_slopes,
)
from vlcrender.scene.leds import Leds

Array = NDArray[np.float64]

NOISE = "noise"
ACCELEROMETER = "accelerometer"
POSE_STEP = 1e-6
"""Step of the differences of spots by the pose, m or radian: 0.01 px of 15 000 px; slopes are right to some 1e-9."""
DISC_SHIFT, SQUARE_SHIFT = 1 / 4, 1 / 3
"""Centroid of a face of luminance 1 + g x / r: at g r / 4 for a disc of radius r, g r / 3 for a square of side 2 r."""
WHOLE = 1 - 1e-9
"""Visible share of an LED from which it counts as whole: a cut image has no centroid of the LED."""


@dataclass(frozen=True)
class SpotErrors:
    """First-order model of one frame's spots and tilts: n spots, so m = 2 n + 2 measurements, px and radians."""

    led_ids: NDArray[np.int64]
    """The LEDs of the spots, in their order, (n,)."""
    pose: Array
    """A, (m, 6): slopes by x, y, z, m, and tilt_x, tilt_y, yaw of `main`, radians."""
    lever: Array
    """Jacobian of the camera's position to the same, (3, 6)."""
    effects: Mapping[str, Array]
    """Effect of each unknown in units of its sigma, (m, its errors); NOISE and ACCELEROMETER among them."""

    @classmethod
    def of_frame(
        cls, slopes: FrameSlopes, tilt_sigmas_deg: tuple[float, float], leds: Leds, uncertainty: Uncertainty
    ) -> "SpotErrors | None":
        """The model of the whole LEDs of a frame, whose noise is the bound of `FrameSlopes.spot_covariances_px2`.

        None for a frame without such LEDs.

        Effects: NOISE, ACCELEROMETER, "mounting", "focal", "aspect", "principal_point", "radial", "decentering",
        "luminaire_xy", "luminaire_z", "luminaire_tilt", "luminaire_yaw", "led_xy", "led_z", "led_gradient", "datum" and
        "scale".
        """
        whole = {led.led_id for led in slopes.seen if led.visible_fraction >= WHOLE}
        noise = {i: c for i, c in slopes.spot_covariances_px2(leds).items() if int(leds.ids[i]) in whole}
        indices = np.array(sorted(noise), dtype=np.int64)
        n = len(indices)
        if not n:
            return None
        posed = slopes.mounted.posed(slopes.main)
        spots = posed.project(leds.centers_m[indices])
        pose = np.zeros((2 * n + 2, 6))
        for unknown in range(6):
            plus, minus = (
                slopes.mounted.posed(moved(slopes.main, unknown, sign * POSE_STEP)).project(leds.centers_m[indices])
                for sign in (1, -1)
            )
            pose[: 2 * n, unknown] = ((plus - minus) / (2 * POSE_STEP)).ravel()
        pose[2 * n, 3] = pose[2 * n + 1, 4] = 1.0
        by_position = -pose[: 2 * n, :3].reshape(n, 2, 3)

        def of_spots(effect: Array) -> Array:
            return np.concatenate([effect.reshape(2 * n, -1), np.zeros((2, effect.size // (2 * n)))])

        def of_tilts(effect: Array) -> Array:
            return np.concatenate([np.zeros((2 * n, effect.shape[1])), effect])

        def each(by_led: Array) -> Array:
            """Effects of the LEDs' own errors: (n, 2, q) as (m, n q), every LED with columns of its own."""
            wide = np.zeros((n, 2, n, by_led.shape[2]))
            wide[np.arange(n), :, np.arange(n)] = by_led
            return of_spots(wide)

        lens = intrinsics_displacements_px(slopes.mounted.camera, spots[:, 0], spots[:, 1])
        lens = np.moveaxis(lens, 0, -1).swapaxes(0, 1) * uncertainty.intrinsics  # (n, 2, 7)
        levers = MapLevers(uncertainty, leds, indices)
        shared = np.einsum("iux,ixs->ius", by_position, levers.shared)
        luminaires = shared[:, :, 4:].reshape(n, 2, -1, LUMINAIRE_UNKNOWNS)
        own = by_position * uncertainty.led_positions_m[indices][:, None, :]
        shift = np.where(leds.squares[indices], SQUARE_SHIFT, DISC_SHIFT) * leds.half_widths_m[indices]
        shift = shift * uncertainty.led_gradients[indices]
        is_main = slopes.mounted.name == MAIN or uncertainty.mounting_rad == 0
        mounting = np.zeros((2, 3)) if is_main else mounting_tilt_slopes(slopes.mounted, slopes.main)
        return cls(
            leds.ids[indices],
            pose,
            slopes.lever(),
            {
                NOISE: each(np.linalg.cholesky(np.stack([noise[i] for i in indices]))),
                ACCELEROMETER: of_tilts(np.diag(np.radians(tilt_sigmas_deg))),
                "mounting": of_tilts(mounting * uncertainty.mounting_rad),
                "focal": of_spots(lens[:, :, 0:1]),
                "aspect": of_spots(lens[:, :, 1:2]),
                "principal_point": of_spots(lens[:, :, 2:4]),
                "radial": of_spots(lens[:, :, 4:5]),
                "decentering": of_spots(lens[:, :, 5:7]),
                "luminaire_xy": of_spots(luminaires[:, :, :, 0:2]),
                "luminaire_z": of_spots(luminaires[:, :, :, 2:3]),
                "luminaire_tilt": of_spots(luminaires[:, :, :, 3:5]),
                "luminaire_yaw": of_spots(luminaires[:, :, :, 5:6]),
                "led_xy": each(own[:, :, :2]),
                "led_z": each(own[:, :, 2:]),
                "led_gradient": each(by_position[:, :, :2] * shift[:, None, None]),
                "datum": of_spots(shared[:, :, :3]),
                "scale": of_spots(shared[:, :, 3:4]),
            },
        )

    @cached_property
    def _products(self) -> dict[str, Array]:
        return {name: effect @ effect.T for name, effect in self.effects.items()}

    def gain(self, scales: Mapping[str, float] | None = None) -> Array | None:
        """G of the position, (3, m), of the estimator that takes each unknown's sigma times its scale, 1 if not given.

        None where the measurements do not determine a position.
        """
        covariance = np.zeros((len(self.pose), len(self.pose)))
        for name, product in self._products.items():
            covariance += product * (scales or {}).get(name, 1.0) ** 2
        rows, columns = np.arange(len(self.pose)), np.arange(6)
        if not covariance[-2:, -2:].any():  # both tilts are known
            rows, columns = rows[:-2], np.array([0, 1, 2, 5])
        if len(rows) < len(columns):
            return None
        root = np.linalg.cholesky(covariance[np.ix_(rows, rows)])
        whitened = solve_triangular(root, self.pose[np.ix_(rows, columns)], lower=True)
        basis, triangle = np.linalg.qr(whitened)
        units = np.linalg.norm(triangle, axis=0)
        if not units.all() or np.linalg.cond(triangle / units) ** 2 > MAX_CONDITION:
            return None
        by_whitened = self.lever[:, columns] @ np.linalg.solve(triangle, basis.T)
        gain = np.zeros((3, len(self.pose)))
        gain[:, rows] = solve_triangular(root, by_whitened.T, lower=True, trans="T").T
        return gain

    def contributions_m2(self, gain: Array, scales: Mapping[str, float] | None = None) -> dict[str, Array]:
        """Covariance of the position by each unknown, (3, 3), m2, for an estimator of this gain.

        scales: factors of the unknowns' true sigmas, 1 if not given.
        """
        through = {name: gain @ effect * (scales or {}).get(name, 1.0) for name, effect in self.effects.items()}
        return {name: effect @ effect.T for name, effect in through.items()}
