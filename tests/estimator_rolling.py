"""Pictures of a rolling shutter for the estimator's tests: every line by a pose and with gains of its own."""

from collections.abc import Callable, Sequence

import numpy as np
from estimator_synthetic import Array, View
from scipy.spatial.transform import Rotation

Gain = Callable[[Array], Array]
"""Gain of an LED at rows (n,) of the image."""


def pose_at(view: View, velocity: Array, time_s: float) -> tuple[Array, Array]:
    """Position (3,) and R_cam_world (3, 3) at a time after the middle of the readout; velocity (6,): rad/s, m/s."""
    turned = Rotation.from_rotvec(velocity[:3] * time_s).as_matrix().T
    return np.asarray(view.position_m) + velocity[3:] * time_s, turned @ view.R_cam_world


def rolling_picture(
    view: View,
    leds_m: Array,
    radius_m: float,
    velocity: Array,
    row_time_s: float,
    led_e: float = 4000.0,
    background_e: float = 40.0,
    samples: int = 16,
    gains: Sequence[Gain] | None = None,
) -> Array:
    """Expected electrons, (height, width), of a sensor read downwards: horizontal discs, all pixels supersampled.

    Inside an LED's image a pixel has `led_e`, or with gains the background and gain times the rest.
    """
    image = np.full((view.height_px, view.width_px), float(background_e))
    sub = (np.arange(samples) + 0.5) / samples
    to_ray = np.linalg.inv(view.K)
    for k, led in enumerate(leds_m):
        # The image lies where poses of all times put it.
        around = np.linspace(0, 2 * np.pi, 24)
        rim = led + radius_m * np.column_stack([np.cos(around), np.sin(around), 0 * around])
        seen = []
        for time_s in np.linspace(-0.5, 0.5, 5) * view.height_px * row_time_s:
            position, R = pose_at(view, velocity, float(time_s))
            p = (rim - position) @ R.T @ view.K.T
            seen.append(p[:, :2] / p[:, 2:])
        low = np.maximum(np.floor(np.min(seen, axis=(0, 1))) - 2, 0).astype(int)
        high = np.minimum(np.ceil(np.max(seen, axis=(0, 1))) + 2, (view.width_px, view.height_px)).astype(int)
        if (low >= high).any():
            continue
        u = (np.arange(low[0], high[0])[:, None] + sub).ravel()
        for row in range(low[1], high[1]):
            position, R = pose_at(view, velocity, (row + 0.5 - view.height_px / 2) * row_time_s)
            uu, vv = np.meshgrid(u, row + sub)
            rays = np.stack([uu, vv, np.ones_like(uu)], axis=-1) @ to_ray.T @ R
            at = position[:2] + rays[..., :2] * ((led[2] - position[2]) / rays[..., 2])[..., None]
            inside = ((at - led[:2]) ** 2).sum(axis=-1) <= radius_m**2
            cover = inside.reshape(samples, high[0] - low[0], samples).mean(axis=(0, 2))
            gain = 1.0 if gains is None else float(gains[k](np.array([row]))[0])
            image[row, low[0] : high[0]] += gain * (led_e - background_e) * cover
    return image
