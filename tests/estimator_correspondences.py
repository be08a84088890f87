"""Simulated correspondences: centroids of points with normal errors, without an image."""

import json
from dataclasses import replace

import numpy as np
from estimator_synthetic import Array, View, description

from estimator.io.camera import Camera, CameraUncertainty
from estimator.io.device import Accelerometer, DeviceFrame
from estimator.io.led_map import DiscLed
from estimator.io.sensor import Sensor
from estimator.spots.detect import Spot
from estimator.spots.identify import Correspondence

POINT_M = 1e-6
"""A radius without eccentricity: at 3 m it lifts an LED by 3e-13 m."""


EXACT = CameraUncertainty(parameters=(), device_sigma=(), shot_sigma=(), offset_sigma_m=0.0, rotation_sigma_deg=0.0)
"""Statement of a camera that it is known exactly."""


def device(
    view: View, error_deg: float, rng: np.random.Generator | None = None, uncertainty: CameraUncertainty | None = EXACT
) -> DeviceFrame:
    """A frame without an image; with `rng` its accelerometer has the error on both tilts that it states."""
    of = description(view, 1, np.zeros((0, 3)), POINT_M)
    off = np.zeros(2) if rng is None else error_deg * rng.standard_normal(2)
    held = replace(view, tilt_x_deg=view.tilt_x_deg + off[0], tilt_y_deg=view.tilt_y_deg + off[1])
    x, y, z = held.gravity_m_s2.tolist()
    return DeviceFrame(
        parts=(),
        camera=Camera.model_validate_json(json.dumps(of["cameras"]["main"])).model_copy(  # type: ignore[index]
            update={"uncertainty": uncertainty}
        ),
        sensor=Sensor.model_validate(of["sensor"]),
        accelerometer_m_s2=(x, y, z),
        accelerometer=Accelerometer(kind="tilt-error", error_deg=error_deg),
        exposure_s=1e-3,
        spots=(),
        leds={},
    )


def simulated(
    view: View, leds_m: Array, sigma_px: float = 0.0, rng: np.random.Generator | None = None
) -> list[Correspondence]:
    """Points (n, 3) seen from a view, with normal errors of their pixels where `rng` is given."""
    pixels = view.project(leds_m)
    if rng is not None:
        pixels = pixels + rng.normal(0, sigma_px, pixels.shape)
    return [
        Correspondence(
            DiscLed(id=k, position_m=(x, y, z), radius_m=POINT_M),
            Spot(u, v, sigma_px**2 * np.eye(2), u, v, 50, 1000.0, touches_border=False, saturated=False),
        )
        for k, ((x, y, z), (u, v)) in enumerate(zip(leds_m.tolist(), pixels.tolist(), strict=True))
    ]
