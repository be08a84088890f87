"""From a frame's images to identified LEDs: what pipelines that work on spots start from."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.io.dataset import DeviceFrame
from estimator.spots.detect import Readout, detect
from estimator.spots.identify import Correspondence, identify

Floats = NDArray[np.float64]
Image = NDArray[np.float32]


def correspondences(
    frame: DeviceFrame, denoise: Callable[[Image], Image] | None = None, reach_px: int = 0
) -> list[Correspondence]:
    """The LEDs in a frame; `denoise` averages over `reach_px` pixels on each side. Raises EstimationFailure."""
    readouts = []
    for part in frame.parts:
        raw = frame.electrons(part)
        image = raw if denoise is None else denoise(raw)
        noise = {"floor_e2": frame.sensor.floor_e2(), "prnu": frame.sensor.prnu}
        readouts.append(Readout(part.row, part.column, image, raw, frame.clipped(part), **noise))
    decoded_px = np.array([(spot.u_px, spot.v_px) for spot in frame.spots]).reshape(-1, 2)
    corners = any(frame.leds[spot.led].shape == "square" for spot in frame.spots)
    spots = detect(readouts, frame.camera.width_px * frame.camera.height_px, reach_px, decoded_px, corners)
    return list(identify(spots, frame.spots, frame.leds))


def led_positions_m(seen: Sequence[Correspondence]) -> Floats:
    """Centres of the LEDs seen, (n, 3), world metres."""
    return np.array([correspondence.led.position_m for correspondence in seen])


def centroids_px(seen: Sequence[Correspondence]) -> Floats:
    """Centroids (u, v) of their spots, (n, 2), continuous pixels with pixel centres at +0.5."""
    return np.array([(correspondence.spot.u_px, correspondence.spot.v_px) for correspondence in seen])
