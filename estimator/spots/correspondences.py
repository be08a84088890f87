"""Correspondences: from a frame's images to spots of identified LEDs, the input of methods that work on spots."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.io.device import DeviceFrame
from estimator.spots.detect import Readout, detect
from estimator.spots.identify import Correspondence, gate_px, identify
from estimator.spots.sampling import lens_blur

Floats = NDArray[np.float64]
Image = NDArray[np.float32]


def find_correspondences(
    frame: DeviceFrame, denoise: Callable[[Image], Image] | None = None, denoise_radius_px: int = 0
) -> list[Correspondence]:
    """Spots in a frame that are identified as LEDs.

    `denoise` maps an image of electrons to a denoised one; each of its pixels depends on a square of
    2 `denoise_radius_px` + 1. Raises EstimationFailure if no LED is detected or identified.
    """
    readouts, sensor = [], frame.sensor
    for part in frame.parts:
        raw = frame.electrons(part)
        image = raw if denoise is None else denoise(raw)
        noise = sensor.floor_e2(), sensor.prnu, sensor.rounding_e2()
        readouts.append(Readout(part.row, part.column, image, raw, frame.clipped(part), *noise))
    decoded_px = np.array([(spot.u_px, spot.v_px) for spot in frame.spots]).reshape(-1, 2)
    any_square = any(frame.leds[spot.led].shape == "square" for spot in frame.spots)
    sensor_px = frame.camera.width_px * frame.camera.height_px
    # A denoiser may move light by its radius: Algorithm 1 as printed does by half of it.
    gate = gate_px(frame.camera.width_px) + denoise_radius_px
    lens = lens_blur(frame.camera)
    spots = detect(readouts, sensor_px, denoise_radius_px, decoded_px, any_square, gate, lens, sensor.crosstalk)
    return list(identify(spots, frame.spots, frame.leds, gate))


def led_positions_m(correspondences: Sequence[Correspondence]) -> Floats:
    """Centres of the LEDs, (n, 3), world metres."""
    return np.array([correspondence.led.position_m for correspondence in correspondences]).reshape(-1, 3)


def centroids_px(correspondences: Sequence[Correspondence]) -> Floats:
    """Centroids (u, v) of the spots, (n, 2), continuous pixels with pixel centres at +0.5."""
    return np.array([(one.spot.u_px, one.spot.v_px) for one in correspondences]).reshape(-1, 2)
